"""The machine as an estimator of other libraries: `river` and scikit-learn's conventions.

Both are a machine with a single action: its states are the clusters, and how one follows another
is learnt beside them. Each adapter needs the library that it is for.
"""

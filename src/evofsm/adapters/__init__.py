"""The machine as an estimator of other libraries: `river` and scikit-learn's conventions.

Both are a machine with a single action: its states are the clusters, and how one follows another
is learnt beside them. Each adapter needs the library that it is for.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

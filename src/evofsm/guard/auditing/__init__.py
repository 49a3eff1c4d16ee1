"""The audit log of a reviser: written while driving, verified and replayed afterwards.

`form` is what its records hold; `participants` writes down who drives; `log` is what writes while
driving; `replay` is the audit.
"""

"""The audit log of a reviser: written while driving, verified and replayed afterwards.

`chain` is the file, and knows nothing of driving; `form` is what its records hold; `participants`
writes down who drives; `log` is what writes while driving; `replay` is the audit.
"""

from evofsm.files import Fault, Finding, Head, Sync
from evofsm.guard.auditing.form import Misfit
from evofsm.guard.auditing.log import AuditLog
from evofsm.guard.auditing.replay import Audit, Difference, Replay, audit

__all__ = [
    "Audit",
    "AuditLog",
    "Difference",
    "Fault",
    "Finding",
    "Head",
    "Misfit",
    "Replay",
    "Sync",
    "audit",
]

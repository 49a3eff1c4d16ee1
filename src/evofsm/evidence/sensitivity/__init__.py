"""How far the paper's claims depend on the settings that it leaves open.

`parameters` says what is varied and within which limits, `setting` drives the paper's study with
one choice of them, `designs` chooses, `study` does it many times, and `shares` reads the result.
"""

from evofsm.evidence.sensitivity.designs import Design
from evofsm.evidence.sensitivity.parameters import PARAMETERS, Parameter, Scale, Standing
from evofsm.evidence.sensitivity.setting import Row, Scaling, Setting, evaluate, recovered
from evofsm.evidence.sensitivity.shares import Index, Share, first_order, share_of, worst_sweeps
from evofsm.evidence.sensitivity.study import Plan, Reach, Sensitivity, run_sensitivity

__all__ = [
    "PARAMETERS",
    "Design",
    "Index",
    "Parameter",
    "Plan",
    "Reach",
    "Row",
    "Scale",
    "Scaling",
    "Sensitivity",
    "Setting",
    "Share",
    "Standing",
    "evaluate",
    "first_order",
    "recovered",
    "run_sensitivity",
    "share_of",
    "worst_sweeps",
]

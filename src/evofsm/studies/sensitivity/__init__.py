"""How far the paper's claims depend on the settings that it leaves open.

`parameters` says what is varied and within which limits, `setting` drives the paper's study with
one choice of them, `designs` chooses, `study` does it many times, and `shares` reads the result.
"""

from evofsm.studies.sensitivity.designs import Design
from evofsm.studies.sensitivity.parameters import PARAMETERS, Parameter, Scale, Standing
from evofsm.studies.sensitivity.setting import Row, Scaling, Setting, evaluate, recovered
from evofsm.studies.sensitivity.shares import Index, Share, first_order, share_of, worst_sweeps
from evofsm.studies.sensitivity.study import Plan, Reach, Sensitivity, run_sensitivity

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

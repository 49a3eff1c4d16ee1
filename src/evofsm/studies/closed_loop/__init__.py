"""The closed loop: whether the reviser prevents collisions, at what cost, and against whom."""

from evofsm.studies.closed_loop.learner import SAFETY_RULE, Learner
from evofsm.studies.closed_loop.outcomes import (
    Outcome,
    Reference,
    Row,
    outcome,
    reference,
    summarise,
)
from evofsm.studies.closed_loop.policies import FIXED_MEASURES, Group, fixed_policies
from evofsm.studies.closed_loop.shift import ShiftPlan
from evofsm.studies.closed_loop.study import ClosedLoop, Plan, run_closed_loop

__all__ = [
    "FIXED_MEASURES",
    "SAFETY_RULE",
    "ClosedLoop",
    "Group",
    "Learner",
    "Outcome",
    "Plan",
    "Reference",
    "Row",
    "ShiftPlan",
    "fixed_policies",
    "outcome",
    "reference",
    "run_closed_loop",
    "summarise",
]

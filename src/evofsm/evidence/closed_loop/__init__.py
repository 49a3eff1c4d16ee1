"""The closed loop: whether the reviser prevents collisions, at what cost, and against whom."""

from evofsm.driving import (
    FIXED_MEASURES,
    SAFETY_RULE,
    Group,
    Outcome,
    Reference,
    Row,
    fixed_policies,
    outcome,
    reference,
    summarise,
)
from evofsm.evidence.closed_loop.shift import ShiftPlan
from evofsm.evidence.closed_loop.study import ClosedLoop, Plan, run_closed_loop

__all__ = [
    "FIXED_MEASURES",
    "SAFETY_RULE",
    "ClosedLoop",
    "Group",
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

"""Detection: who sees danger, how early, and at how many false alarms."""

from evofsm.evidence.detection.measures import Ours
from evofsm.evidence.detection.plan import FAMILIES, GRID, Plan
from evofsm.evidence.detection.rows import Reliable, Row
from evofsm.evidence.detection.study import Detection, run_detection
from evofsm.evidence.detection.watch import HORIZON, Target

__all__ = [
    "FAMILIES",
    "GRID",
    "HORIZON",
    "Detection",
    "Ours",
    "Plan",
    "Reliable",
    "Row",
    "Target",
    "run_detection",
]

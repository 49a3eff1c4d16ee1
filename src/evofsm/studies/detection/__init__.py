"""Detection: who sees danger, how early, and at how many false alarms."""

from evofsm.studies.detection.measures import Ours
from evofsm.studies.detection.plan import FAMILIES, GRID, Plan
from evofsm.studies.detection.rows import Reliable, Row
from evofsm.studies.detection.study import Detection, run_detection
from evofsm.studies.detection.watch import HORIZON, Target

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

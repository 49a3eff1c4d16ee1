"""Real data: whether risk that was learnt on some runs foretells what came in others."""

from evofsm.evidence.real.moments import Kind, Moment
from evofsm.evidence.real.study import (
    FEWEST_EVENTS,
    Drives,
    Plan,
    RealStudy,
    Row,
    read_folder,
    run_real,
)
from evofsm.evidence.real.targets import TARGETS, Target

__all__ = [
    "FEWEST_EVENTS",
    "TARGETS",
    "Drives",
    "Kind",
    "Moment",
    "Plan",
    "RealStudy",
    "Row",
    "Target",
    "read_folder",
    "run_real",
]

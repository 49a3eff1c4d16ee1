"""Online recognition of latent risk with an evolving finite state machine.

The public names load on first use, so that ``import evofsm`` itself costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from evofsm.actions import IntervalActions
    from evofsm.crowding import WhenFull
    from evofsm.divergence import jensen_shannon
    from evofsm.explanation import Explanation
    from evofsm.forecast import Forecasts
    from evofsm.machine import EvolvingFSM
    from evofsm.model import FSMModel
    from evofsm.naming import Labels
    from evofsm.observations import Category, Missing, ObservationEncoder
    from evofsm.states import Edges, FailureSplit, Novelty, Paper
    from evofsm.step import Event, Step, Trace

__version__ = "0.1.0"

_HOMES = {
    "Category": "observations",
    "Edges": "states.edges",
    "Event": "step",
    "EvolvingFSM": "machine",
    "Explanation": "explanation",
    "FSMModel": "model",
    "FailureSplit": "states.failure",
    "Forecasts": "forecast",
    "IntervalActions": "actions",
    "Labels": "naming",
    "Missing": "observations",
    "Novelty": "states.novelty",
    "ObservationEncoder": "observations",
    "Paper": "states.ets",
    "Step": "step",
    "Trace": "step",
    "WhenFull": "crowding",
    "jensen_shannon": "divergence",
}

__all__ = [
    "Category",
    "Edges",
    "Event",
    "EvolvingFSM",
    "Explanation",
    "FSMModel",
    "FailureSplit",
    "Forecasts",
    "IntervalActions",
    "Labels",
    "Missing",
    "Novelty",
    "ObservationEncoder",
    "Paper",
    "Step",
    "Trace",
    "WhenFull",
    "jensen_shannon",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'evofsm' has no attribute {name!r}")
    value = getattr(import_module(f"evofsm.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

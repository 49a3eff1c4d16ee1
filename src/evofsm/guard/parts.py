"""The parts that a guard is made of, as plain data: no file and no log holds code.

Judges, revisers and measures stand in it by the name of their class, which an installed package
declares as an entry point of ``evofsm.participants``. What was learnt stands in arrays elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.machine import EvolvingFSM
from evofsm.guard.actions import ActionSet, BoxActions, Choices
from evofsm.guard.api import ActionJudge, LearningJudge, Reviser
from evofsm.guard.reviser import ActionReviser

# Guards import this module, so that it cannot import them.
_Guard = Any


@cache
def _entry_points() -> Mapping[str, EntryPoint]:
    return {point.name: point for point in entry_points(group="evofsm.participants")}


def part_class(name: Any) -> Any:
    """The class that a name stands for; a ValueError if no installed package declares it."""
    if name not in _entry_points():
        raise ValueError(f"no installed package declares a guard part {name!r}")
    return _entry_points()[name].load()


def part_name(part: object) -> str | None:
    """The name of a thing's class, if that stands for this very class."""
    name = type(part).__name__
    return name if name in _entry_points() and part_class(name) is type(part) else None


def outline(guard: _Guard) -> dict[str, Any]:
    """All of a guard but what machine and judge have learnt; None for what is not known here."""
    reviser, judge = guard.reviser, None if guard.judge is None else part_name(guard.judge)
    description: dict[str, Any] | None = None
    if type(reviser) is ActionReviser:
        asks = judge is not None and reviser.risk is guard.judge  # a known one that learns
        settings = settings_of(reviser)
        description = {"class": "ActionReviser", "asks_judge": asks, "settings": settings}
    elif (name := part_name(reviser)) and hasattr(reviser, "described"):
        made_of = reviser.described()
        description = None if made_of is None else {"class": name, **made_of}
    if type(guard.actions) not in (IntervalActions, Choices, BoxActions):
        description = None  # it would be made again as another
    return {"actions": asdict(guard.actions), "judge": judge, "reviser": description}


def can_be_made_again(guard: _Guard) -> bool:
    """Whether `rebuild` needs no more than the `outline`, and learning no code that was given."""
    parts, judge = outline(guard), guard.judge
    functions = (getattr(judge, "__dict__", {}).get(name) for name in ("model", "backup"))
    asks_code = guard.learn and any(map(callable, functions))
    knows_judge = judge is None or parts["judge"] is not None
    reviser: Any = parts["reviser"] or {"asks_judge": False}
    return knows_judge and not asks_code and bool(reviser.get("asks_judge", True))


def rebuild(
    told: Mapping[str, Any],
    files: Mapping[str, NDArray[np.uint8]],
    judge: ActionJudge | type[LearningJudge] | None,
) -> dict[str, Any]:
    """The parts of an `outline`, with the files of machine and judge, of which one may be empty.

    ``judge`` is its class, or the one that is asked, where the outline knows none.
    """
    fields, reviser = told["actions"], told["reviser"]
    kind = IntervalActions if "width" in fields else BoxActions if "low" in fields else Choices
    actions: ActionSet = kind(**fields)
    machine, action_judge = None, None if isinstance(judge, type) else judge
    risk: LearningJudge | None = None
    if files["machine"].size:
        machine = EvolvingFSM.load(BytesIO(files["machine"].tobytes()))
    if files["judge"].size:
        if told["judge"] is None and not isinstance(judge, type):
            raise ValueError("no installed package declares its judge; give the judge's class")
        judge_class = judge if isinstance(judge, type) else part_class(told["judge"])
        action_judge = risk = judge_class.load(BytesIO(files["judge"].tobytes()))
    parts = {"machine": machine, "judge": risk}
    if reviser["class"] != "ActionReviser":
        return parts | {"reviser": part_class(reviser["class"]).restored(reviser, actions)}
    if reviser["asks_judge"] and risk is None:
        raise ValueError(f"what its {told['judge']} has learnt is missing")
    if action_judge is None:
        raise ValueError("no installed package declares its judge; give the judge as it is")
    again = ActionReviser(action_judge, actions)
    set_again(again, reviser["settings"])
    return parts | {"reviser": again}


def settings_of(reviser: Reviser) -> dict[str, Any]:
    """What may be changed about a reviser while driving."""
    if not isinstance(reviser, ActionReviser):
        return {}
    return {"tolerance": reviser.tolerance, "mode": reviser.mode.value}


def set_again(reviser: Reviser, settings: Mapping[str, Any]) -> None:
    """Give a reviser the `settings_of` another time."""
    if isinstance(reviser, ActionReviser):
        reviser.tolerance, reviser.mode = settings["tolerance"], settings["mode"]

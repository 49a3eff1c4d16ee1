"""Who takes part in a drive, written down so that the drive can be repeated: plain data, no code.

Machine and judge are kept as the files that they save themselves to. A reviser is described by its
settings. Judges, revisers and measures are known by the entry points of the group
``evofsm.participants`` that an installed package declares: a name, and the class that it stands
for. What is not known, such as a reviser of someone's own, is written by its name: its decisions
are kept all the same, but cannot be replayed.
"""

from __future__ import annotations

import base64
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict
from functools import cache
from hashlib import sha256
from importlib.metadata import EntryPoint, entry_points
from io import BytesIO
from typing import Any, Protocol

import numba
import numpy as np

import evofsm
from evofsm.fsm import EvolvingFSM, IntervalActions
from evofsm.guard.actions import ActionSet, BoxActions, Choices
from evofsm.guard.protocols import (
    ActionJudge,
    LearningJudge,
    Participants,
    Reviser,
)
from evofsm.guard.reviser import ActionReviser, Mode, Way

# The judge of logs that do not name it.
_JUDGE = "LatentRisk"


@cache
def _entry_points() -> Mapping[str, EntryPoint]:
    return {point.name: point for point in entry_points(group="evofsm.participants")}


def participant_class(name: str) -> Any:
    """The class that a name stands for.

    Raises
    ------
    ValueError
        If no installed package declares it.
    """
    if name not in _entry_points():
        raise ValueError(f"no installed package declares a participant {name!r}")
    return _entry_points()[name].load()


def participant_name(one: object) -> str | None:
    """The name of a thing's class, if that stands for this very class."""
    name = type(one).__name__
    return name if name in _entry_points() and participant_class(name) is type(one) else None


class CannotBeReplayedError(Exception):
    """Says why."""


# -- What is written ------------------------------------------------------------------------------


def describe(who: Participants) -> dict[str, Any]:
    """All that it takes to begin where they are now."""
    return {
        **outline(who),
        "machine": None if who.machine is None else _file(who.machine),
        "made_by": made_by(),
        "risk": None if who.risk is None else _file(who.risk),
    }


def outline(who: Participants) -> dict[str, Any]:
    """The set of actions and the reviser: all but the files of machine and judge."""
    return {"actions": asdict(who.actions), "reviser": _reviser(who)}


def made_by() -> dict[str, str]:
    """What computes: floats are the same to the last bit only where this is."""
    return {
        "evofsm": evofsm.__version__,
        "numba": numba.__version__,
        "numpy": np.__version__,
        "processor": platform.machine(),
        "python": platform.python_version(),
    }


def settings(reviser: Reviser) -> dict[str, Any]:
    """What may be changed while driving."""
    if not isinstance(reviser, ActionReviser):
        return {}
    return {
        "mode": reviser.mode.value,
        "overridden": reviser.overridden,
        "release": reviser.release,
        "tolerance": reviser.tolerance,
        "way": reviser.way.value,
    }


def learnt(machine: EvolvingFSM | None, risk: LearningJudge | None) -> dict[str, float]:
    """A few sums that whatever is learnt changes."""
    sums: dict[str, float] = {}
    if machine is not None:
        sums["states"] = machine.n_states
        sums["failures"] = math.fsum(machine.endings.tolist())
        sums["potential"] = math.fsum(machine.potentials.tolist())
        sums["transitions"] = math.fsum(machine.decisions.ravel().tolist())
    if risk is not None:
        sums |= risk.sums(0 if machine is None else machine.n_states)
    return sums


class _Saved(Protocol):
    def save(self, path: BytesIO) -> None: ...


def _file(saved: _Saved) -> dict[str, str]:
    file = BytesIO()
    saved.save(file)
    data = file.getvalue()
    return {"file": base64.b64encode(data).decode(), "sha256": sha256(data).hexdigest()}


def _reviser(who: Participants) -> dict[str, Any]:
    """By what it is made of; without it only the class, if it is not known how to make it."""
    reviser = who.reviser
    described: dict[str, Any] = {"class": type(reviser).__name__, "known": True}
    if type(reviser) is ActionReviser:
        described |= {"judge": _judge(reviser.risk, who), "settings": settings(reviser)}
        described["known"] = described["judge"] is not None and reviser.actions == who.actions
        return described
    made_of = reviser.described() if participant_name(reviser) else None  # type: ignore[attr-defined]
    return described | (made_of or {}) | {"known": made_of is not None}


def _judge(judge: ActionJudge, who: Participants) -> dict[str, Any] | None:
    """Whom the reviser asks, if those who learn are whom it asks."""
    name = participant_name(judge)
    if name is None:
        return None
    if judge is who.risk:
        return {"class": name}
    if getattr(judge, "risk", None) is who.risk and getattr(judge, "machine", None) is who.machine:
        return {"class": name, **judge.described()}  # type: ignore[attr-defined]
    return None


# -- What is made of it again ---------------------------------------------------------------------


def restore(described: Mapping[str, Any]) -> Participants:
    """Those that `describe` wrote down.

    Raises
    ------
    CannotBeReplayedError
        If the reviser is not known here.
    KeyError, TypeError, ValueError
        If they are described as nothing that there is.
    """
    reviser = described["reviser"]
    if not reviser["known"]:
        raise CannotBeReplayedError(
            f"{reviser['class']} is no reviser that is known here, or asks a risk that was not "
            "told what happened"
        )
    who = rebuild(described, _data(described["machine"]), _data(described["risk"]))
    if _names(described) | _names(outline(who)) != _names(described):
        raise ValueError("the actions or the reviser are described by other names than are written")
    return who


def rebuild(
    described: Mapping[str, Any],
    machine_file: bytes,
    judge_file: bytes,
    judge: ActionJudge | type[LearningJudge] | None = None,
) -> Participants:
    """Those of an `outline`, from the files of machine and judge; an empty one stands for none.

    ``judge`` is the judge's class, or a judge as it is, where its name is not known.
    """
    reviser = described["reviser"]
    actions = _actions(described["actions"])
    machine = EvolvingFSM.load(BytesIO(machine_file)) if machine_file else None
    risk: LearningJudge | None = None
    if judge_file:
        kind = judge if isinstance(judge, type) else _kind_of_judge(reviser)
        risk = kind.load(BytesIO(judge_file))
    if reviser["class"] != "ActionReviser":
        again: Reviser = participant_class(reviser["class"]).restored(reviser, actions)
        return Participants(actions, again, machine, risk)
    if judge is None:
        asked = _restored_judge(reviser["judge"], machine, risk)
    elif risk is None and isinstance(judge, type):
        raise ValueError(f"no {judge.__name__} is in it; give a judge as it is")
    else:
        asked = judge if risk is None else risk  # type: ignore[assignment]
    again = ActionReviser(asked, actions)
    set_again(again, reviser["settings"])
    return Participants(actions, again, machine, risk)


def _actions(described: Mapping[str, Any]) -> ActionSet:
    """Of the class that has these fields."""
    if "n_actions" in described:
        return Choices(**described)
    return BoxActions(**described) if "levels" in described else IntervalActions(**described)


def _names(described: Any) -> Any:
    """Without what they stand for."""
    if not isinstance(described, Mapping):
        return None
    return {name: _names(value) for name, value in described.items()}


def _kind_of_judge(reviser: Mapping[str, Any]) -> Any:
    """The class of what learns: the judge's own, or of what it asks in turn."""
    described = reviser.get("judge", {"class": _JUDGE})
    if described is None:
        raise ValueError("no installed package declares its judge; give the judge's class")
    kind = participant_class(described["class"])
    return kind if hasattr(kind, "load") else participant_class(_JUDGE)


def _data(kept: Mapping[str, Any] | None) -> bytes:
    """A file that was written down; empty where there was none."""
    if kept is None:
        return b""
    data = base64.b64decode(kept["file"], validate=True)
    if sha256(data).hexdigest() != kept["sha256"]:
        raise ValueError("a file in it has not the SHA-256 that is said")
    return data


def _restored_judge(
    described: Mapping[str, Any], machine: EvolvingFSM | None, risk: LearningJudge | None
) -> ActionJudge:
    if risk is None:
        raise ValueError("the reviser asks a judge, but none is there; give it")
    kind = participant_class(described["class"])
    if kind is type(risk):
        return risk
    if machine is None:
        raise ValueError("the reviser asks the states of a machine, but none is there")
    judge: ActionJudge = kind.restored(described, machine, risk)
    return judge


def set_again(reviser: Reviser, kept: Mapping[str, Any]) -> None:
    """Give a reviser the `settings` that it had."""
    if not isinstance(reviser, ActionReviser):
        raise ValueError("settings are of an ActionReviser, but it is none")
    reviser.mode, reviser.way = Mode(kept["mode"]), Way(kept["way"])
    reviser.release, reviser.tolerance = float(kept["release"]), float(kept["tolerance"])
    if kept["overridden"]:
        reviser.take_over()
    else:
        reviser.hand_back()

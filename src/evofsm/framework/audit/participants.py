"""Who takes part in a drive, written down so that the drive can be repeated: plain data, no code.

Machine and risk are kept as the files that they save themselves to. A reviser is described by its
settings. What is not known here, such as a reviser of someone's own, is written by its name: its
decisions are kept all the same, but cannot be replayed.
"""

from __future__ import annotations

import base64
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict
from hashlib import sha256
from io import BytesIO
from typing import Any, NamedTuple, Protocol, TypeVar

import numba
import numpy as np

import evofsm
from evofsm.actions import IntervalActions
from evofsm.framework.reviser import (
    ActionReviser,
    AlwaysBrake,
    EnvelopeReviser,
    Mode,
    Unrevised,
    Way,
)
from evofsm.machine import EvolvingFSM
from evofsm.protocols import Reviser, RiskMeasure
from evofsm.risk.by_state import RiskByState
from evofsm.risk.drac import DecelerationToAvoidCollision
from evofsm.risk.fuzzy import FuzzySafety
from evofsm.risk.headway import TimeHeadway
from evofsm.risk.mttc import ModifiedTimeToCollision
from evofsm.risk.outcome import ActionJudge, LatentRisk
from evofsm.risk.picud import Picud
from evofsm.risk.r157 import PerformanceModel
from evofsm.risk.rss import ResponsibilitySensitiveSafety
from evofsm.risk.ttc import TimeToCollision

# Only these are made from a log, whatever it says.
_MEASURES: Mapping[str, type[RiskMeasure]] = {
    measure.__name__: measure
    for measure in (
        DecelerationToAvoidCollision,
        FuzzySafety,
        ModifiedTimeToCollision,
        PerformanceModel,
        Picud,
        ResponsibilitySensitiveSafety,
        TimeHeadway,
        TimeToCollision,
    )
}


class Participants(NamedTuple):
    """Everything that a decision depends on but the observation and the proposal."""

    actions: IntervalActions
    reviser: Reviser
    machine: EvolvingFSM | None
    risk: LatentRisk | None


class CannotBeReplayedError(Exception):
    """Says why."""


# -- What is written ------------------------------------------------------------------------------


def describe(who: Participants) -> dict[str, Any]:
    """All that it takes to begin where they are now."""
    return {
        "actions": asdict(who.actions),
        "machine": None if who.machine is None else _file(who.machine),
        "made_by": made_by(),
        "reviser": _reviser(who),
        "risk": None if who.risk is None else _file(who.risk),
    }


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


def learnt(machine: EvolvingFSM | None, risk: LatentRisk | None) -> dict[str, float]:
    """A few sums that whatever is learnt changes."""
    sums: dict[str, float] = {}
    if machine is not None:
        sums["states"] = machine.n_states
        sums["failures"] = math.fsum(machine.endings.tolist())
        sums["potential"] = math.fsum(machine.potentials.tolist())
        sums["transitions"] = math.fsum(machine.decisions.ravel().tolist())
    if risk is not None:
        everywhere = np.ones(max(1, machine.n_states if machine is not None else 1))
        sums["brakes"] = risk.brakes.decel
        sums["manoeuvres"] = len(risk.manoeuvres) + risk.manoeuvres.gentle
        sums["seconds"] = risk.seconds_seen(everywhere)
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
    elif type(reviser) is EnvelopeReviser:
        measure = type(reviser.measure)
        described["dt"] = reviser.dt
        described["known"] = measure is _MEASURES.get(measure.__name__)
        if described["known"]:
            described["measure"] = {"class": measure.__name__, **asdict(reviser.measure)}  # type: ignore[call-overload]
    else:
        described["known"] = type(reviser) in (Unrevised, AlwaysBrake)
    return described


def _judge(judge: ActionJudge, who: Participants) -> dict[str, Any] | None:
    """Whom the reviser asks, if those who learn are whom it asks."""
    if type(judge) is LatentRisk and judge is who.risk:
        return {"class": "LatentRisk"}
    if type(judge) is RiskByState and judge.risk is who.risk and judge.machine is who.machine:
        return {"class": "RiskByState", "caution": judge.caution}
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
    actions = IntervalActions(**described["actions"])
    machine = _restored(EvolvingFSM, described["machine"])
    risk = _restored(LatentRisk, described["risk"])
    again = _restored_reviser(reviser, actions, machine, risk)
    who = Participants(actions, again, machine, risk)
    if _names(described["actions"]) != _names(asdict(actions)) or (
        _names(reviser) != _names(_reviser(who))
    ):
        raise ValueError("the actions or the reviser are described by other names than are written")
    return who


def _names(described: Any) -> Any:
    """Without what they stand for."""
    if not isinstance(described, Mapping):
        return None
    return {name: _names(value) for name, value in described.items()}


_Kept = TypeVar("_Kept", EvolvingFSM, LatentRisk)


def _restored(kind: type[_Kept], kept: Mapping[str, Any] | None) -> _Kept | None:
    if kept is None:
        return None
    data = base64.b64decode(kept["file"], validate=True)
    if sha256(data).hexdigest() != kept["sha256"]:
        raise ValueError(f"the {kind.__name__} in it has not the SHA-256 that is said")
    return kind.load(BytesIO(data))


def _restored_reviser(
    described: Mapping[str, Any],
    actions: IntervalActions,
    machine: EvolvingFSM | None,
    risk: LatentRisk | None,
) -> Reviser:
    match described["class"]:
        case "ActionReviser":
            judge = _restored_judge(described["judge"], machine, risk)
            reviser = ActionReviser(judge, actions)
            set_again(reviser, described["settings"])
            return reviser
        case "EnvelopeReviser":
            given = dict(described["measure"])
            measure = _MEASURES[given.pop("class")](**given)
            return EnvelopeReviser(measure, actions, described["dt"])
        case "Unrevised":
            return Unrevised(actions)
        case "AlwaysBrake":
            return AlwaysBrake(actions)
    raise ValueError(f"there is no reviser {described['class']!r}")


def _restored_judge(
    described: Mapping[str, Any], machine: EvolvingFSM | None, risk: LatentRisk | None
) -> ActionJudge:
    if risk is None:
        raise ValueError("the reviser asks a risk, but none is there")
    if described["class"] == "LatentRisk":
        return risk
    if machine is None:
        raise ValueError("the reviser asks the states of a machine, but none is there")
    return RiskByState(risk, machine, described["caution"])


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

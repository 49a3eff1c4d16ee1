"""The learnt judge in a file: what it learnt beside its dynamics."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm import Disturbances, Here
from evofsm.guard.learnt.backups import Backups
from evofsm.guard.learnt.remembering import Situations
from evofsm.store import COUNT, FROM_1, SIZE, Kind, Numbers

# Names of the arrays of situations.
_SITUATIONS = ("situations", "changes", "actions_before")
_SOME = Numbers(least=-math.inf, most=math.inf)
_SHAPES: dict[str, tuple[int | str, ...]] = {
    "residuals": ("k", "h", "m"),
    "jump_at": ("k", "m"),
    "jump_to": ("k", "m"),
    "jump_slope": ("k", "m", "m"),
    "jump_from": ("k", "m", "m", 2),
    "landing": ("k", "m", 2),
    "situations": ("s", "m"),
    "changes": ("s", "m"),
    "actions_before": ("s", "a"),
    "policies": ("b", "a", "f"),
    "scores": ("b",),
    "variables": ("m",),
    "flips": ("m",),
    "actions": ("a",),
    "turns": ("a",),
}
#: Attributes of the judge that are numbers, which it goes on with.
NUMBERS = ("margin", "broken", "horizon", "takes", "believed", "n_studied", "n_scanned")


_TIME = Numbers(least=0.0, most=1e6)
KIND = Kind(
    "learntrisk",
    {
        **{name: _SOME.of(*shape) for name, shape in _SHAPES.items()},
        "dynamics": Numbers(("bytes",), dtype=np.uint8),
    },
    {
        "dt": SIZE,
        **dict.fromkeys(("margin", "takes", "believed", "doubt"), _TIME),
        **dict.fromkeys(("seed", "broken", "n_studied", "n_scanned"), COUNT),
        "n_constant": COUNT,
        "horizon": FROM_1,
        "told_horizon": SIZE._replace(optional=True),
        "share": Numbers(least=0.0, most=1.0),
        "since": COUNT,
        "worse": Numbers(least=-1.0, most=1e15),
    },
)


class Kept(NamedTuple):
    """What the judge learnt, but for its numbers; None where that is nothing yet."""

    situations: Situations
    backups: Backups | None
    disturbances: Disturbances | None


def arrays_of(kept: Kept) -> dict[str, NDArray[Any]]:
    """All of it as arrays; empty ones stand for what was not learnt yet."""
    arrays: dict[str, NDArray[Any]] = {
        name: np.zeros([n if isinstance(n, int) else 0 for n in shape])
        for name, shape in _SHAPES.items()
    }
    if kept.disturbances is not None:
        arrays |= kept.disturbances._asdict()
    if len(kept.situations):
        arrays |= dict(zip(_SITUATIONS, kept.situations.arrays(), strict=True))
    if (backups := kept.backups) is not None:
        arrays |= {
            "policies": backups.policies,
            "scores": backups.scores,
            "variables": backups.variables.astype(np.float64),
            "flips": backups.flips,
            "actions": backups.actions.astype(np.float64),
            "turns": backups.turns,
        }
    return arrays


def restored(n_constant: int, arrays: dict[str, NDArray[Any]]) -> Kept:
    """What such arrays hold, with so many constant backups.

    Raises
    ------
    ValueError
        If arrays contradict each other.
    """
    situations, disturbances = Situations(), None
    if len(arrays["residuals"]):
        disturbances = Disturbances(*(arrays[name] for name in Disturbances._fields))
    for row in zip(*(arrays[name] for name in _SITUATIONS), strict=True):
        situations.kept.append(Here(*(np.array(part) for part in row)))
    backups = _backups(n_constant, arrays) if len(arrays["policies"]) else None
    return Kept(situations, backups, disturbances)


def _backups(n_constant: int, arrays: dict[str, NDArray[Any]]) -> Backups:
    policies, orders = arrays["policies"], {}
    for name, count in (("variables", policies.shape[2] - 1), ("actions", policies.shape[1])):
        orders[name] = arrays[name].astype(int)
        if sorted(orders[name].tolist()) != list(range(count)):
            raise ValueError(f"{name} of the backups are in no order")
    if n_constant > len(policies):
        raise ValueError(f"there are {len(policies)} backups, not {n_constant} constant ones")
    backups = object.__new__(Backups)
    backups.n_constant = n_constant
    backups.policies, backups.scores = policies, arrays["scores"]
    backups.variables, backups.actions = orders["variables"], orders["actions"]
    backups.flips, backups.turns = arrays["flips"], arrays["turns"]
    backups.ranks = np.argsort(-backups.scores, kind="stable")
    return backups

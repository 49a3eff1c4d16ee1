"""The learnt judge in a file: what it learnt beside the machine."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evofsm.core import Disturbances, Here
from evofsm.files import ranges
from evofsm.guard.learnt.backups import Backups

if TYPE_CHECKING:
    from evofsm.guard.learnt.risk import LearntRisk

_SOME = ranges.Range(-math.inf, math.inf)
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
    "variables": ("v",),
    "flips": ("v",),
    "actions": ("c",),
    "turns": ("c",),
}
_NUMBERS = ("margin", "broken", "horizon", "n_studied", "n_scanned")
KIND = ranges.register(
    ranges.Kind(
        "learntrisk",
        {name: ranges.Member(shape, _SOME) for name, shape in _SHAPES.items()},
        {
            "dt": ranges.SIZE,
            "margin": ranges.Range(0.0, 1e6),
            **dict.fromkeys(("seed", "broken", "n_studied", "n_scanned"), ranges.COUNT),
            "n_constant": ranges.COUNT,
            "horizon": ranges.FROM_1,
            "told_horizon": ranges.SIZE,
            "takes": ranges.Range(0.0, 1e6),
        },
    )
)


def content_of(judge: LearntRisk) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Settings and counts, and arrays; empty ones stand for what was not learnt yet."""
    backups, disturbances = judge.backups, judge.disturbances
    arrays: dict[str, NDArray[Any]] = {
        name: np.zeros([n if isinstance(n, int) else 0 for n in shape])
        for name, shape in _SHAPES.items()
    }
    if disturbances is not None:
        arrays |= disturbances._asdict()
    if len(judge.situations):
        named = ("situations", "changes", "actions_before")
        arrays |= dict(zip(named, judge.situations.arrays(), strict=True))
    if backups is not None:
        arrays |= {
            "policies": backups.policies,
            "scores": backups.scores,
            "variables": backups.variables.astype(np.float64),
            "flips": backups.flips,
            "actions": backups.actions.astype(np.float64),
            "turns": backups.turns,
        }
    content = {name: getattr(judge, name) for name in ("dt", "seed", "told_horizon", *_NUMBERS)}
    content |= {"without": sorted(judge.without), "takes": judge._takes}
    content |= {"names": list(judge.labels.names), "units": list(judge.labels.units)}
    return content | {"n_constant": 0 if backups is None else backups.n_constant}, arrays


def restore(judge: LearntRisk, content: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
    """Give a new judge what was learnt.

    Raises
    ------
    ValueError
        If arrays contradict each other.
    """
    judge._takes = content["takes"]
    for name in _NUMBERS:
        setattr(judge, name, content[name])
    if len(arrays["residuals"]):
        judge.disturbances = Disturbances(*(arrays[name] for name in Disturbances._fields))
    named = ("situations", "changes", "actions_before")
    for row in zip(*(arrays[name] for name in named), strict=True):
        judge.situations.kept.append(Here(*(np.array(part) for part in row)))
    if len(arrays["policies"]):
        judge.backups = _backups(int(content["n_constant"]), arrays)


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

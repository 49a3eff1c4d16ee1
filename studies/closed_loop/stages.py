"""Tests on the way, while a policy learns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

#: Collision rate at most for `until_safe`.
SAFE_RATE = 0.01


class Point(NamedTuple):
    """A point of the learning curve."""

    learning_seed: int
    episodes: int  #: learnt from
    collisions: int  #: of `held_out`
    held_out: int
    mobility: float
    states: int
    train_collisions: int  #: so far, while learning
    policy: str = "evofsm"


def until_safe(curve: Sequence[Point]) -> int | None:
    """Episodes learnt from before the first test with so few collisions; None without one."""
    safe = (one.episodes for one in curve if one.collisions <= SAFE_RATE * one.held_out)
    return next(safe, None)

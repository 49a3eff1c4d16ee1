"""What happens when the world changes: brakes weaken, or leaders brake harder, and no one is told.

A stream of episodes, the second half shifted. Ours goes on learning; a safe distance keeps the
constants that were right before.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from evofsm.driving import (
    EnvelopeReviser,
    Family,
    ResponsibilitySensitiveSafety,
    drive,
    guard_for_family,
    held_out,
    teach,
    training,
)
from evofsm.evidence.closed_loop.plan import ShiftPlan
from evofsm.guard import Guard

#: Episodes after the shift at which what was learnt so far is tested on held-out draws.
AFTER = (0, 1, 2, 5, 10, 20, 30)


class Stream(NamedTuple):
    """Collisions along a stream; the shift stands before index ``before``."""

    policy: str
    learning_seed: int
    collided: tuple[bool, ...]


class Check(NamedTuple):
    """A held-out test, learning frozen."""

    policy: str
    learning_seed: int
    episodes_after: int  #: -1 for a test before the shift
    collisions: int
    held_out: int


def run_shift(family: Family, plan: ShiftPlan, learning_seed: int) -> dict[str, list[Any]]:
    """Drive the stream of one learning seed, with our policy and with the one never told."""
    shifted = family.shifted
    if shifted is None:
        raise ValueError(f"family {family.name!r} has no shift")
    stream = [
        *training(family, plan.seed, learning_seed, plan.before),
        *training(shifted, plan.seed, learning_seed, plan.after, first=plan.before),
    ]
    constants = ResponsibilitySensitiveSafety.matched(family.decel, family.leader_decel)
    unchanged = EnvelopeReviser(constants, family.actions, family.interval)
    guard = Guard.of(unchanged, interval=family.interval, learn=False)
    streams = [
        Stream(
            "rss-unchanged",
            learning_seed,
            tuple(driven.episode.collided for driven in teach(guard, stream)),
        )
    ]
    checks = [
        _check("rss-unchanged", learning_seed, -1, family, plan, guard),
        _check("rss-unchanged", learning_seed, plan.after, shifted, plan, guard),
    ]
    guard = guard_for_family(family, tolerance=plan.tolerance)
    collided = []
    for index, draw in enumerate(stream):
        after = index - plan.before
        if after == 0:
            checks.append(_check("evofsm", learning_seed, -1, family, plan, guard))
        if after in AFTER:
            checks.append(_check("evofsm", learning_seed, after, shifted, plan, guard))
        collided.append(drive(guard, draw).episode.collided)
    streams.append(Stream("evofsm", learning_seed, tuple(collided)))
    return {"streams": streams, "checks": checks}


def _check(
    policy: str, seed: int, after: int, family: Family, plan: ShiftPlan, guard: Guard
) -> Check:
    """Drive held-out draws with what was learnt so far."""
    frozen = guard.copy(states=False)
    frozen.freeze()
    drives = teach(frozen, held_out(family, plan.seed, plan.held_out))
    return Check(policy, seed, after, sum(one.episode.collided for one in drives), len(drives))

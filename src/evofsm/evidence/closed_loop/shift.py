"""What happens when the world changes: brakes weaken, or leaders brake harder, and no one is told.

A stream of episodes, the second half shifted. Ours goes on learning; a safe distance keeps the
constants that were right before.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from evofsm.driving import (
    EnvelopeReviser,
    Family,
    Learner,
    ResponsibilitySensitiveSafety,
    drive_alone,
    held_out,
    training,
)
from evofsm.evidence.closed_loop.plan import ShiftPlan
from evofsm.guard import Reviser

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
    streams = [
        Stream(
            "rss-unchanged",
            learning_seed,
            tuple(
                drive_alone(
                    shifted if index >= plan.before else family, draw, unchanged, None
                ).episode.collided
                for index, draw in enumerate(stream)
            ),
        )
    ]
    checks = [
        _check("rss-unchanged", learning_seed, -1, family, plan, unchanged),
        _check("rss-unchanged", learning_seed, plan.after, shifted, plan, unchanged),
    ]
    learner = Learner.new(family)
    reviser = learner.reviser(family, plan.tolerance)
    collided = []
    for index, draw in enumerate(stream):
        after = index - plan.before
        if after == 0:
            checks.append(_check_frozen(learner, learning_seed, -1, family, plan))
        if after in AFTER:
            checks.append(_check_frozen(learner, learning_seed, after, shifted, plan))
        now = family if after < 0 else shifted
        drive = learner.drive(now, draw, reviser, learn=True)
        collided.append(drive.episode.collided)
    streams.append(Stream("evofsm", learning_seed, tuple(collided)))
    return {"streams": streams, "checks": checks}


def _check_frozen(
    learner: Learner, seed: int, after: int, family: Family, plan: ShiftPlan
) -> Check:
    frozen = learner.frozen()
    reviser = frozen.reviser(family, plan.tolerance)
    return _check("evofsm", seed, after, family, plan, reviser, frozen)


def _check(
    policy: str,
    seed: int,
    after: int,
    family: Family,
    plan: ShiftPlan,
    reviser: Reviser,
    learner: Learner | None = None,
) -> Check:
    draws = held_out(family, plan.seed, plan.held_out)
    risk = learner.risk if learner else None
    collisions = sum(drive_alone(family, draw, reviser, risk).episode.collided for draw in draws)
    return Check(policy, seed, after, collisions, len(draws))

"""What was asked of the machine that was told nothing but failures, before it was measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from evofsm.cli import count, decimals, percent
from evofsm.paper.report.asked import Asked, at_least, at_most
from studies.closed_loop.comparison import Line, ours
from studies.closed_loop.machine import LATE, MACHINE
from studies.closed_loop.over_seeds import around_shift
from studies.closed_loop.stages import SAFE_RATE
from studies.closed_loop.study import ClosedLoop

# Of these families: collisions of the worst seed at most, and mobility at least, of the median and
# of the worst seed.
_ASKED = {"emergency": (0.005, 0.91, 0.89), "cut_in": (0.005, 0.96, 0.0)}
# Of others: so many more collisions than ours that was told more, and so much less mobility.
_BESIDE, _MORE, _LESS = ("stop_and_go", "rare", "ncap", "weak_brakes"), 0.01, 0.05
# With noise: collisions at most, mobility at least.
_NOISY, _NOISY_MOBILITY = 0.01, 0.85
# Collisions while learning, of the worst seed: of all episodes, and of the late ones.
_LEARNING, _LATE = 6, 1
# It was asked of so many training episodes.
_TRAINED = 100
# So many episodes after a shift it must be safe again.
_RECOVERED = 10


def machine_claims(study: ClosedLoop) -> Iterator[Asked]:
    """All of it that this family and these amounts can answer."""
    middle, worst = ours(study, policy=MACHINE), ours(study, "worst seed", MACHINE)
    if middle is None or worst is None:
        return
    name, is_taught = study.family.name, middle.train_episodes >= _TRAINED
    if is_taught and study.plan.switches:
        if study.plan.switches == "noise":
            yield _at_most("collisions with noise, median seed", middle.collision_rate, _NOISY)
            yield _at_least("mobility with noise, median seed", middle.mobility, _NOISY_MOBILITY)
    elif is_taught and name in _ASKED:
        yield from _alone(study, middle, worst, *_ASKED[name])
    elif is_taught and name in _BESIDE:
        yield from _beside(middle, ours(study))
    for one in around_shift(study):
        if one.after == _RECOVERED and one.machine is not None:
            what = f"collisions {_RECOVERED} episodes after the shift, median seed"
            yield _at_most(what, one.machine.median, SAFE_RATE)


def _alone(
    study: ClosedLoop, middle: Line, worst: Line, most: float, mobility: float, least: float
) -> Iterator[Asked]:
    yield _at_most("collisions, worst seed", worst.collision_rate, most)
    yield _at_least("mobility, median seed", middle.mobility, mobility)
    if not least:
        return
    rows = [row for row in study.rows if row.policy == MACHINE]
    yield _at_least("mobility, worst seed", min(row.mobility for row in rows), least)
    learning = max(row.train_collisions for row in rows)
    yield _at_most("collisions while learning, worst seed", learning, _LEARNING, count)
    early = {
        point.learning_seed: point.train_collisions
        for point in study.curve
        if point.policy == MACHINE and point.episodes == LATE
    }
    late = [
        row.train_collisions - early[row.learning_seed]
        for row in rows
        if row.learning_seed in early
    ]
    if late:
        yield _at_most(f"those from episode {LATE + 1} on, worst seed", max(late), _LATE, count)


def _beside(middle: Line, told: Line | None) -> Iterator[Asked]:
    if told is None:
        return
    most, least = told.collision_rate + _MORE, told.mobility - _LESS
    yield _at_most("collisions, median seed", middle.collision_rate, most)
    yield _at_least("mobility, median seed", middle.mobility, least)


def _at_most(what: str, value: float, most: float, show: Callable[[float], str] = percent) -> Asked:
    return at_most(f"{MACHINE}: {what}", value, most, show)


def _at_least(what: str, value: float, least: float) -> Asked:
    return at_least(f"{MACHINE}: {what}", value, least, decimals(3))

"""What the learning seeds have in common: medians and ranges, over training and after a shift."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from studies.closed_loop.beside import Check
from studies.closed_loop.machine import MACHINE
from studies.closed_loop.study import ClosedLoop

#: The policy that learns, by name.
OURS = "evofsm"
#: Episodes of a stream that are averaged.
WINDOW = 10

K = TypeVar("K")
V = TypeVar("V")


def gathered(values: Iterable[V], key: Callable[[V], K]) -> dict[K, list[V]]:
    """Values by their key, in the order in which they come."""
    found: dict[K, list[V]] = {}
    for value in values:
        found.setdefault(key(value), []).append(value)
    return found


class Spread(NamedTuple):
    """A number over learning seeds."""

    low: float
    median: float
    high: float


def spread(values: Sequence[float]) -> Spread:
    """Median and range."""
    return Spread(min(values), float(np.median(values)), max(values))


class Stage(NamedTuple):
    """A test on the way, learning frozen."""

    episodes: int  #: learnt from
    collision_rate: Spread
    mobility: Spread
    states: Spread
    train_collisions: Spread  #: so far, while learning


def learning_curve(study: ClosedLoop, policy: str = OURS) -> list[Stage]:
    """The tests on the way of a policy that learns, in their order."""
    mine = (point for point in study.curve if point.policy == policy)
    return [
        Stage(
            episodes,
            spread([p.collisions / p.held_out for p in points]),
            spread([p.mobility for p in points]),
            spread([float(p.states) for p in points]),
            spread([float(p.train_collisions) for p in points]),
        )
        for episodes, points in sorted(gathered(mine, lambda p: p.episodes).items())
    ]


class CaseOverSeeds(NamedTuple):
    """One of the paper's cases under the machine that was told nothing but failures."""

    name: str
    unrevised_collided: bool
    collided: int  #: learning seeds with which it collides
    seeds: int
    changed: Spread
    changed_late: Spread


def cases_over_seeds(study: ClosedLoop) -> list[CaseOverSeeds]:
    """The paper's cases in their order."""
    return [
        CaseOverSeeds(
            name,
            runs[0].unrevised_collided,
            sum(run.collided for run in runs),
            len(runs),
            spread([run.changed for run in runs]),
            spread([run.changed_late for run in runs]),
        )
        for name, runs in gathered(study.machine_cases, lambda run: run.name).items()
    ]


class AroundShift(NamedTuple):
    """Collision rates of a test before or after the shift."""

    after: int  #: episodes; -1 before the shift
    ours: Spread
    theirs: Spread | None  #: of the policy that is never told
    machine: Spread | None  #: of ours that was told nothing but failures, where it was tried then


def when(after: int) -> str:
    """A test's place in the stream."""
    if after < 0:
        return "before the shift"
    if after == 0:
        return "right after the shift"
    return f"{after} episode{'' if after == 1 else 's'} after the shift"


def around_shift(study: ClosedLoop) -> list[AroundShift]:
    """The tests around the shift, in their order.

    The policy that is never told learns nothing: what it does at once after the shift, it does for
    ever.
    """
    own = gathered((c for c in study.checks if c.policy == OURS), lambda c: c.episodes_after)
    machine = gathered((c for c in study.checks if c.policy == MACHINE), lambda c: c.episodes_after)
    learn_nothing = (c for c in study.checks if c.policy not in (OURS, MACHINE))
    other = gathered(learn_nothing, lambda c: c.episodes_after >= 0)
    theirs = {shifted: _rates(checks) for shifted, checks in other.items()}
    return [
        AroundShift(
            after,
            _rates(checks),
            theirs.get(after >= 0),
            _rates(machine[after]) if after in machine else None,
        )
        for after, checks in sorted(own.items())
    ]


def _rates(checks: Iterable[Check]) -> Spread:
    return spread([check.collisions / check.held_out for check in checks])


class Rolling(NamedTuple):
    """A policy's collision rate over the last episodes of a stream, for each episode."""

    policy: str
    mean: NDArray[np.float64]  #: over learning seeds
    low: NDArray[np.float64]  #: the middle 80 % of them begin
    high: NDArray[np.float64]  #: and end


def along_stream(study: ClosedLoop) -> list[Rolling]:
    """What the streams of each policy come to; the average begins anew at the shift."""
    found = []
    for policy, streams in gathered(study.streams, lambda stream: stream.policy).items():
        runs = np.array([stream.collided for stream in streams], dtype=float)
        parts = np.split(runs, [study.plan.shift.before], axis=1)
        rates = np.concatenate([_rolling(part) for part in parts], axis=1)
        low, high = np.quantile(rates, [0.1, 0.9], axis=0)
        found.append(Rolling(policy, rates.mean(axis=0), low, high))
    return found


def _rolling(runs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over the last episodes of each run."""
    total = np.cumsum(np.pad(runs, ((0, 0), (1, 0))), axis=1)
    last = np.arange(1, runs.shape[1] + 1)
    first = np.maximum(last - WINDOW, 0)
    means: NDArray[np.float64] = (total[:, last] - total[:, first]) / (last - first)
    return means

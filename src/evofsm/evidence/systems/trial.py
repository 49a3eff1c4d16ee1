"""One trial: a judge learns a system while controlling it, and is then tried, frozen.

Decisions are timed around ``decide`` alone. Times depend on the machine; nothing else does.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np

from evofsm.driving import guard_for_family
from evofsm.evidence.scores import share_of
from evofsm.evidence.systems import make_system
from evofsm.evidence.systems.cars import Cars
from evofsm.evidence.systems.system import Action, Start, System, Vector
from evofsm.guard import Guard

#: From this episode on, counted from 0, a failure while learning is a late one.
LATE = 30


class Decided(Protocol):
    """What a judge decided."""

    @property
    def executed(self) -> Action:
        """What is to be done."""


class Judge(Protocol):
    """What is tried: a `Guard`, or anything with these methods of it."""

    def begin(self) -> None:
        """Begin an episode."""

    def decide(self, observation: Vector, proposal: Action) -> Decided:
        """What to execute instead of a proposal."""

    def end(self, failed: bool = False, observation: Vector | None = None) -> None:
        """End the episode, and learn from it unless frozen."""

    def freeze(self) -> None:
        """Learn nothing from now on."""


@dataclass(frozen=True)
class Row:
    """What came of one judge on one system with one learning seed."""

    system: str
    controller: str
    judge: str
    without: str  #: parts that were taken away, joined by +; empty for none
    seed: int  #: learning seed
    trained: int  #: episodes that were learnt from
    failed_while_learning: int  #: of those
    failed_late: int  #: of those from the 31st on
    episodes: int  #: held out
    failed: int  #: of the held-out ones
    failed_low: float  #: 95 % interval of their share (Clopper and Pearson 1934)
    failed_high: float
    unrevised_failed: int  #: of the same episodes, the controller alone
    kept: float  #: share of proposals that were executed exactly
    mean_change: float  #: of an action, in halves of its range; of discrete ones the share changed
    measure: str  #: what `score` is: ``"mobility"`` or ``"return"``
    score: float  #: mean over held-out episodes
    p50_ms: float  #: of a held-out decision
    p99_ms: float
    speed: float = math.nan  #: mean over held-out episodes [m/s]; NaN where nothing drives

    def as_dict(self) -> dict[str, Any]:
        """For JSON: the score under its name, the other one None."""
        values = asdict(self)
        measure, score = values.pop("measure"), values.pop("score")
        names = ("mobility", "return")
        return values | {name: score if name == measure else None for name in names}


class Ended(NamedTuple):
    """What came of one episode."""

    failed: bool
    score: float
    kept: int  #: proposals that were executed exactly
    changes: float  #: sum over decisions, see `Row.mean_change`
    times: list[float]  #: of each decision [s]
    speed: float = math.nan  #: mean [m/s]; NaN where nothing drives


class Unrevised:
    """Executes what is proposed."""

    def begin(self) -> None:
        """Nothing to begin."""

    def decide(self, observation: Vector, proposal: Action) -> _Executed:
        """The proposal."""
        return _Executed(proposal)

    def end(self, failed: bool = False, observation: Vector | None = None) -> None:
        """Nothing to learn."""

    def freeze(self) -> None:
        """Nothing to freeze."""


class _Executed(NamedTuple):
    executed: Action


def _unrevised(system: System, without: Sequence[str], seed: int) -> Judge:
    return Unrevised()


def _kinematic(system: System, without: Sequence[str], seed: int) -> Judge:
    if not isinstance(system, Cars):
        raise ValueError(f"{system.name} has no cars; the kinematic judge knows nothing else")
    return guard_for_family(system.family, seed=seed)


def _learnt(system: System, without: Sequence[str], seed: int) -> Judge:
    from evofsm.guard import learnt_guard

    told: dict[str, Any] = {} if system.horizon is None else {"horizon": system.horizon}
    guard: Judge = learnt_guard(
        **system.actions.settings,
        interval=system.interval,
        seed=seed,
        without=tuple(without),
        **told,
    )
    return guard


def _scene(system: System, without: Sequence[str], seed: int) -> Judge:
    from evofsm.guard import SceneRisk

    if not hasattr(system, "columns"):
        raise ValueError(f"{system.name} shows no objects; the judge of scenes knows nothing else")
    shown: Any = system
    n_actions = shown.actions.n_actions
    judge = SceneRisk(shown.interval, n_actions, columns=shown.columns, relative=shown.relative)
    return Guard(n_actions=n_actions, interval=shown.interval, judge=judge, seed=seed)


#: By name: makes a judge for a system, without some parts, with a seed.
JUDGES: dict[str, Callable[[System, Sequence[str], int], Judge]] = {
    "learnt": _learnt,
    "unrevised": _unrevised,
    "kinematic": _kinematic,
    "scene": _scene,
}


def trial(
    system: str,
    controller: str | None = None,
    without: Sequence[str] = (),
    seed: int = 0,
    train: int | None = None,
    test: int = 100,
    judge: str | Callable[[System, Sequence[str], int], Judge] = "learnt",
    base: int = 0,
) -> Row:
    """Let one judge learn one system while controlling it, and try it on held-out episodes.

    Parameters
    ----------
    system : str
        One of `SYSTEMS`.
    controller : str, optional
        One of the system's; without it the first.
    without : sequence of str
        Parts of the learnt judge that are taken away.
    seed : int
        Of the training episodes, and of the judge.
    train : int, optional
        Training episodes; without it as many as the system's own.
    test : int
        Held-out episodes, the same for every seed.
    judge : str or callable
        One of `JUDGES`, or what makes one from the system, ``without`` and ``seed``.
    base : int
        Of everything: another one draws other episodes, held-out ones too.

    Returns
    -------
    Row

    Examples
    --------
    >>> row = trial("acc", judge="unrevised", train=2, test=5)
    >>> row.failed, row.kept, row.mean_change
    (5, 1.0, 0.0)
    """
    controlled = make_system(system, controller)
    train = controlled.train if train is None else train
    make = JUDGES[judge] if isinstance(judge, str) else judge
    name = judge if isinstance(judge, str) else getattr(judge, "__name__", "own")
    learner = make(controlled, without, seed)
    starts = (Start.training(base, seed, episode) for episode in range(train))
    learnt = [run(controlled, learner, start).failed for start in starts]
    learner.freeze()
    tried = [run(controlled, learner, start) for start in _held_out(base, test)]
    share = share_of([one.failed for one in tried])
    times = 1e3 * np.array([took for one in tried for took in one.times])
    middle, slow = np.quantile(times, [0.5, 0.99])
    return Row(
        system=system,
        controller=controlled.controller,
        judge=name,
        without="+".join(without),
        seed=seed,
        trained=train,
        failed_while_learning=sum(learnt),
        failed_late=sum(learnt[LATE:]),
        episodes=test,
        failed=share.held,
        failed_low=share.low,
        failed_high=share.high,
        unrevised_failed=_unrevised_failures(system, controlled.controller, test, base),
        kept=sum(one.kept for one in tried) / len(times),
        mean_change=sum(one.changes for one in tried) / len(times),
        measure=controlled.measure,
        score=float(np.mean([one.score for one in tried])),
        p50_ms=float(middle),
        p99_ms=float(slow),
        speed=float(np.mean([one.speed for one in tried])),
    )


def run(system: System, judge: Judge, start: Start) -> Ended:
    """One episode of a system under a judge, which learns from it unless it is frozen."""
    observation = system.reset(start)
    judge.begin()
    times: list[float] = []
    kept, changes = 0, 0.0
    while True:
        proposal = system.propose(observation)
        asked = time.perf_counter()
        executed = judge.decide(observation, proposal).executed
        times.append(time.perf_counter() - asked)
        kept += np.array_equal(executed, proposal)
        changes += system.actions.change(executed, proposal)
        step = system.step(executed)
        observation = step.observation
        if step.over:
            judge.end(step.failed, observation)
            return Ended(step.failed, system.score, kept, changes, times, system.speed)


def _held_out(base: int, test: int) -> Iterable[Start]:
    return (Start.held_out(base, episode) for episode in range(test))


@lru_cache
def _unrevised_failures(system: str, controller: str, test: int, base: int) -> int:
    controlled, alone = make_system(system, controller), Unrevised()
    return sum(run(controlled, alone, start).failed for start in _held_out(base, test))

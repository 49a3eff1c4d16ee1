"""One trial: a judge learns a system while controlling it, and is then tried, frozen.

Decisions are timed around ``decide`` alone. Times depend on the machine; nothing else does.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from evofsm.cli import imported
from evofsm.driving import TOLD, guard_for_family
from evofsm.guard import Guard
from studies.old.scores import share_of
from studies.systems import make_system
from studies.systems.cars import Cars
from studies.systems.rivals.counted import Counted
from studies.systems.rivals.rival import Unrevised
from studies.systems.system import Judge, Start, System

#: From this episode on, counted from 0, a failure while learning is a late one.
LATE = 30


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
    speed: float | None  #: mean over held-out episodes [m/s]; None where nothing drives

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


def _counted(system: System, without: Sequence[str], seed: int) -> Judge:
    return Counted(system)


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
    "counted": _counted,
    "scene": _scene,
}


def make_judge(name: str, system: System, without: Sequence[str] = (), seed: int = 0) -> Judge:
    """A judge by its name.

    Parameters
    ----------
    name : str
        One of `JUDGES` or of the system's ``rivals``, or ``module:Name`` of a class that is made
        with the system and a seed. It has the methods of a `Judge`, or, as an `ActionJudge`, says
        how dangerous actions are: then a guard is made of it.
    system : System
    without : sequence of str
        Parts of the learnt judge that are taken away.
    seed : int

    Raises
    ------
    ValueError
        If there is no such judge.
    TypeError
        If what is named makes no judge.
    """
    if ":" in name:
        own = imported(name)(system, seed)
        if all(hasattr(own, method) for method in ("begin", "decide", "end", "freeze")):
            made: Judge = own  # a guard, too, which has a judge beside
            return made
        if hasattr(own, "judge"):
            return Guard(**system.actions.settings, interval=system.interval, judge=own, seed=seed)
        raise TypeError(
            f"{name} makes a {type(own).__name__}, which is no judge: it has neither judge, "
            "nor begin, decide, end and freeze"
        )
    if name in JUDGES:
        return JUDGES[name](system, without, seed)
    rivals = system.rivals
    if name not in rivals:
        known = [*JUDGES, *rivals]
        raise ValueError(f"{system.name} has no judge {name!r}; there are {', '.join(known)}")
    return rivals[name]()


# What judges of ours are told that stand in a guard.
_TOLD = {
    "LearntRisk": TOLD["learnt"],
    "LatentRisk": TOLD["kinematic"],
    "SceneRisk": f"{TOLD['learnt']}, and how a row is laid out",
}


def told_to(judge: Judge) -> str:
    """What a judge is told, in a few words: as it says itself in ``told``, if it is not ours."""
    inside: Any = judge
    if isinstance(judge, Guard):  # its own judge is None where that does not learn
        inside = getattr(judge.reviser, "risk", judge.judge)
    return str(getattr(inside, "told", _TOLD.get(type(inside).__name__, "not said")))


class Tried(NamedTuple):
    """All that one judge did with one learning seed."""

    learnt: list[Ended]  #: training episodes
    held_out: list[Ended]
    told: str


def try_judge(system: System, judge: Judge, seed: int, train: int, test: int, base: int) -> Tried:
    """Let a judge learn a system while controlling it, freeze it, and try it on held-out episodes.

    Parameters
    ----------
    system : System
    judge : Judge
    seed : int
        Of the training episodes.
    train, test : int
        Episodes to learn from, and held-out ones, which are the same for every seed.
    base : int
        Of everything: another one draws other episodes, held-out ones too.
    """
    starts = (Start.training(base, seed, episode) for episode in range(train))
    learnt = [run(system, judge, start) for start in starts]
    judge.freeze()
    return Tried(
        learnt, [run(system, judge, start) for start in _held_out(base, test)], told_to(judge)
    )


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
        As `make_system` takes it.
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
        As `make_judge` takes it, or what makes one from the system, ``without`` and ``seed``.
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
    if isinstance(judge, str):
        name, learner = judge, make_judge(judge, controlled, without, seed)
    else:
        name, learner = getattr(judge, "__name__", "own"), judge(controlled, without, seed)
    learnt, held_out, _ = try_judge(controlled, learner, seed, train, test, base)
    return Row(
        system=system,
        controller=controlled.controller,
        judge=name,
        without="+".join(without),
        seed=seed,
        trained=train,
        failed_while_learning=sum(one.failed for one in learnt),
        failed_late=sum(one.failed for one in learnt[LATE:]),
        unrevised_failed=unrevised_failures(system, controlled.controller, test, base),
        **counted(held_out),
        measure=controlled.measure,
        score=float(np.mean([one.score for one in held_out])),
    )


def counted(held_out: Sequence[Ended]) -> dict[str, Any]:
    """What is counted in held-out episodes, under the names that it has in a `Row`."""
    share = share_of([one.failed for one in held_out])
    speed = float(np.mean([one.speed for one in held_out]))
    times = 1e3 * np.array([took for one in held_out for took in one.times])
    middle, slow = np.quantile(times, [0.5, 0.99])
    return {
        "episodes": len(held_out),
        "failed": share.held,
        "failed_low": share.low,
        "failed_high": share.high,
        "kept": sum(one.kept for one in held_out) / len(times),
        "mean_change": sum(one.changes for one in held_out) / len(times),
        "p50_ms": float(middle),
        "p99_ms": float(slow),
        "speed": None if math.isnan(speed) else speed,
    }


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
def unrevised_failures(system: str, controller: str, test: int, base: int) -> int:
    """Held-out episodes in which a controller alone fails."""
    controlled, alone = make_system(system, controller), Unrevised()
    return sum(run(controlled, alone, start).failed for start in _held_out(base, test))

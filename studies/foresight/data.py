"""What is learnt from and judged: episodes of mixed controllers, and what came after each step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm import IntervalActions
from evofsm.guard import ActionSet, BoxActions, Choices
from studies.systems import Action, Box, Start, System, Vector, make_system

#: Controllers beside those of the system: actions drawn anew in each step, or held for a while, and
#: feedback that would hold the system, were three in ten of its actions not drawn.
RANDOM, WANDER, HOLDS = "random", "wander", "holds"
# How likely the one that wanders takes another action, and how likely any action is drawn instead,
# in general and of the one that holds.
_CHANGES, _DRAWN, _DRAWN_HOLDING = 0.1, 0.1, 0.3
# Feedback that holds a task; the controllers of these lose it almost always within a second or two,
# so that without it there would be nothing to foresee.
_FEEDBACK: dict[str, Callable[[Vector], Action]] = {
    "cartpole": lambda z: int(z @ np.array([0.05, 0.1, 1.0, 0.5]) > 0.0),
    "pendulum": lambda z: float(np.clip(-10.0 * z[0] - 2.0 * z[1], -2.0, 2.0)),
}
# Intervals of an action that is one number, for who counts by action.
_INTERVALS = 5


class Run(NamedTuple):
    """One episode: T actions, and the observations before and after each."""

    observations: NDArray[np.float64]  #: (T + 1, m)
    actions: NDArray[np.float64]  #: (T, a) executed; of choices a one among zeros, else in [-1, 1]
    executed: tuple[Action, ...]  #: the same T actions as the system took them
    failed: bool  #: by the last action


class Cases(NamedTuple):
    """n steps of some episodes, in their order; what was known there, and what came."""

    z: NDArray[np.float64]  #: (n, m) observation
    change: NDArray[np.float64]  #: (n, m) since the one before
    earlier: NDArray[np.float64]  #: (n, m) change before that one
    before: NDArray[np.float64]  #: (n, a) action before
    action: NDArray[np.float64]  #: (n, a) that is taken now
    left: NDArray[np.float64]  #: (n,) steps to the failure; infinite where none came
    known: NDArray[np.float64]  #: (n,) steps that were seen after this one
    episode: NDArray[np.intp]  #: (n,) from 0
    episodes: int

    def where(self, rows: NDArray[np.bool_]) -> Cases:
        """Some of them."""
        columns: tuple[Any, ...] = self[:-1]
        return Cases._make([*(column[rows] for column in columns), self.episodes])

    def truth(self, steps: int) -> NDArray[np.bool_]:
        """(n,) whether it failed within so many steps."""
        return np.asarray(self.left <= steps)

    def judged(self, steps: int) -> NDArray[np.bool_]:
        """(n,) whether that is known: it is not where time was up before."""
        return np.asarray(np.isfinite(self.left) | (self.known >= steps))


def gather(name: str, starts: Sequence[Start]) -> list[Run]:
    """Run episodes, each with a controller drawn for it: one of the system's, or of ours here."""
    system = make_system(name)
    kinds = list(dict.fromkeys((*system.controllers, RANDOM, WANDER)))
    kinds += [HOLDS] if name in _FEEDBACK else []
    return [_run(system, start, kinds) for start in starts]


def _run(system: System, start: Start, kinds: Sequence[str]) -> Run:
    draw = start.rng(7)
    kind = kinds[int(draw.integers(len(kinds)))]
    propose = _controller(system, kind, draw)
    share = _DRAWN_HOLDING if kind == HOLDS else _DRAWN
    observations, over, failed = [system.reset(options={"start": start})[0]], False, False
    executed: list[Action] = []
    while not over:
        action = propose(observations[-1])
        if draw.random() < share:
            action = drawn(system, draw)
        observation, _, failed, truncated, _ = system.step(action)
        executed.append(action)
        observations.append(observation)
        over = failed or truncated
    actions = np.array([encoded(system, one) for one in executed])
    return Run(np.array(observations), actions, tuple(executed), failed)


def _controller(system: System, kind: str, draw: np.random.Generator) -> Callable[[Vector], Action]:
    if kind in system.controllers:
        return system.controllers[kind]
    if kind == HOLDS:
        return _FEEDBACK[system.name]
    held = drawn(system, draw)

    def propose(z: Vector) -> Action:
        nonlocal held
        if kind == RANDOM or draw.random() < _CHANGES:
            held = drawn(system, draw)
        return held

    return propose


def drawn(system: System, draw: np.random.Generator) -> Action:
    """Any action of a system, each alike."""
    return system.actions.drawn(draw)


def encoded(system: System, action: Action) -> NDArray[np.float64]:
    """(a,) of choices a one among zeros, else in [-1, 1]."""
    actions = system.actions
    if not isinstance(actions, Box):
        return np.asarray(np.eye(actions.n_actions)[int(action)])
    low, high = np.array(actions.low), np.array(actions.high)
    return np.asarray(2.0 * (np.atleast_1d(action) - low) / (high - low) - 1.0)


def action_set(system: System) -> ActionSet:
    """Actions by index, for who counts by action."""
    actions = system.actions
    if not isinstance(actions, Box):
        return Choices(actions.n_actions)
    if len(actions.low) > 1:
        return BoxActions(actions.low, actions.high)
    (first,), (last,) = actions.low, actions.high
    return IntervalActions(first, last, (last - first) / _INTERVALS, outside="clip")


def cases(runs: Sequence[Run], every: int) -> Cases:
    """Every so many steps of each episode, the last one before a failure included.

    Steps are counted back from the end, and the first two are left out: extrapolation needs them.
    """
    parts = []
    for number, run in enumerate(runs):
        z, T = run.observations, len(run.actions)
        t = np.arange(T - 1, 1, -every)[::-1]
        left = (T - t).astype(np.float64)
        parts.append(
            (
                z[t],
                z[t] - z[t - 1],
                z[t - 1] - z[t - 2],
                run.actions[t - 1],
                run.actions[t],
                left if run.failed else np.full(len(t), np.inf),
                left,
                np.full(len(t), number),
            )
        )
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return Cases._make([*columns, len(runs)])

"""What a decision of the learnt judge costs beside the kinematic one's, and a step that learns."""

from __future__ import annotations

import time
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm import EvolvingFSM, Guard
from evofsm.driving import Family, drive, guard_for_family, load_family
from evofsm.guard import LearntRisk
from turns import Result, Work, compare

_FAMILY = "emergency"
# Episodes that are learnt from, by when there are as many stretches as are ever remembered.
_LEARNT, _SHORT = 40, 4
# Episodes of a turn, on which nothing was learnt.
_TURN, _FIRST_OF_TURN = 8, 1_000


class Taught(NamedTuple):
    """Two guards that learnt from the same draws, and episodes to decide on."""

    learnt: Guard
    kinematic: Guard
    episodes: list[list[tuple[NDArray[np.float64], float]]]  #: observations and proposals


@cache
def taught(short: bool) -> Taught:
    """Both, frozen; the episodes are those that the learnt one comes to."""
    family = load_family(_FAMILY)
    learnt, kinematic = _guard(family), guard_for_family(family)
    count = _SHORT if short else _LEARNT
    for guard in (learnt, kinematic):
        for episode in range(count):
            drive(guard, family.draw(0, episode))
        guard.freeze()
    driven = [
        drive(learnt, family.draw(0, _FIRST_OF_TURN + k)) for k in range(1 if short else _TURN)
    ]
    episodes = [
        [(one.situation.observation.copy(), float(one.revision.proposed)) for one in each.decisions]
        for each in driven
    ]
    return Taught(learnt, kinematic, episodes)


def _guard(family: Family) -> Guard:
    actions = family.actions
    return Guard(actions.low, actions.high, interval=family.interval, width=actions.width)


def decision(quantile: float, repeats: int, short: bool) -> Result:
    """A quantile of the time of a decision, over the decisions of some episodes."""
    learnt, kinematic, episodes = taught(short)
    name = "median" if quantile == 0.5 else f"{quantile:.0%} quantile"
    return compare(
        f"one decision of the learnt judge, {_FAMILY}: {name}",
        _deciding(learnt, episodes, quantile),
        "kinematic judge",
        _deciding(kinematic, episodes, quantile),
        repeats,
        notes=[f"{len(_dynamics(learnt).stretches)} stretches are remembered"],
    )


def step(repeats: int, short: bool) -> Result:
    """What `observe` and `act` cost dynamics, and a machine."""
    learnt, _, episodes = taught(short)
    machine, dynamics = learnt.machine, _dynamics(learnt)
    assert machine is not None
    index = [[learnt.actions.encode(action) for _, action in one] for one in episodes]
    bare = EvolvingFSM(machine.n_actions, max_states=200, belief_tolerance=machine.belief_tolerance)
    for one, actions in zip(episodes, index, strict=True):
        bare.learn_many(np.array([z for z, _ in one]), actions)
    count = sum(map(len, episodes))

    def with_machine(own: EvolvingFSM) -> Work:
        def work() -> float:
            seconds, twin = 0.0, own.copy()
            for one, actions in zip(episodes, index, strict=True):
                twin.start_episode()  # what is learnt of a whole episode is no step
                begun = time.perf_counter()
                for (z, _), i in zip(one, actions, strict=True):
                    twin.observe(z)
                    twin.act(i)
                seconds += time.perf_counter() - begun
            return seconds / count

        return work

    def alone() -> float:
        seconds, twin = 0.0, dynamics.copy()
        for one in episodes:
            begun = time.perf_counter()
            for z, action in one:
                twin.observe(z)
                twin.act(twin.encode(action))
            seconds += time.perf_counter() - begun
            twin.break_off()
        return seconds / count

    return compare(
        "a step that learns: dynamics",
        alone,
        "machine",
        with_machine(bare),
        repeats,
    )


def _dynamics(guard: Guard) -> Any:
    assert isinstance(guard.judge, LearntRisk)
    return guard.judge.dynamics


def _deciding(guard: Guard, episodes: list[Any], quantile: float) -> Work:
    def work() -> float:
        seconds = []
        for one in episodes:
            guard.begin()
            for z, proposal in one:
                begun = time.perf_counter()
                guard.decide(z, proposal)
                seconds.append(time.perf_counter() - begun)
            guard.end()
        return float(np.quantile(seconds, quantile))

    return work

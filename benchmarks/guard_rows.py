"""Rows of the guard: what a decision costs, and what a fresh install compiles."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm import Guard
from evofsm.driving import drive, guard_for_family, load_family
from evofsm.fsm.rules import Novelty
from timing import Result, Work, compare

FAMILY = "emergency"

# -- Decisions ------------------------------------------------------------------------------------

# Episodes to learn from, after which the disturbance library is full.
_LEARNT, _SHORT = 40, 4
# Episodes of a turn, on which nothing is learnt.
_TURN, _FIRST_OF_TURN = 8, 1_000

Stream = list[list[tuple[NDArray[np.float64], float]]]  # by episode: observations and proposals


class Taught(NamedTuple):
    """Two guards that learnt from the same draws, and episodes to decide on."""

    learnt: Guard
    kinematic: Guard
    episodes: Stream


@cache
def taught(short: bool) -> Taught:
    """Both, frozen; the episodes are those that the learnt one comes to."""
    family = load_family(FAMILY)
    low, high = family.actions.low, family.actions.high
    learnt, kinematic = Guard(low, high, interval=family.interval), many_states()
    for guard in (learnt, kinematic):
        for episode in range(_SHORT if short else _LEARNT):
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


def many_states() -> Guard:
    """A guard for cars whose machine creates many states."""
    family = load_family(FAMILY)
    return guard_for_family(family, rule=Novelty(radius=1.0, scales=(2.0, 1.0, 1.0)))


def learnt_decision(quantile: float, repeats: int, short: bool) -> Result:
    """A quantile of the time of a decision of the learnt judge."""
    learnt, kinematic, episodes = taught(short)
    name = "median" if quantile == 0.5 else f"{quantile:.0%} quantile"
    return compare(
        f"one decision of the learnt judge, {FAMILY}: {name}",
        deciding(learnt, episodes, quantile),
        "kinematic judge",
        deciding(kinematic, episodes, quantile),
        repeats,
    )


def kinematic_decision(repeats: int, short: bool) -> Result:
    """The 99 % quantile of the kinematic judge's decision; the reference is its median."""
    _, kinematic, episodes = taught(short)
    assert kinematic.machine is not None
    return compare(
        f"one decision of the kinematic judge, {kinematic.machine.n_states} states: 99 % quantile",
        deciding(kinematic, episodes, 0.99),
        "its median",
        deciding(kinematic, episodes, 0.5),
        repeats,
    )


def deciding(guard: Guard, episodes: Stream, quantile: float) -> Work:
    """The episodes decided on once; the quantile of the seconds of a decision."""

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


# -- A fresh install ------------------------------------------------------------------------------

_OBSERVE = """
import time, numpy as np, evofsm
machine, z = evofsm.EvolvingFSM(2), np.zeros((9, 3))
begun = time.process_time()
machine.observe(z[0])
print(time.process_time() - begun)
"""
_CARTPOLE = """
import time, gymnasium, numpy as np
begun = time.process_time()
from evofsm import Guard
env, guard = gymnasium.make("CartPole-v1"), Guard(n_actions=2, interval=0.02)
draw = np.random.default_rng(0)
for episode in range(2):
    z, _ = env.reset(seed=episode)
    failed = False
    while not failed:
        z, _, failed, _, _ = env.step(guard.decide(z, int(draw.integers(2))).executed)
    guard.end(failed, z)
print(time.process_time() - begun)
"""
_DRIVE = """
import os, subprocess, sys
command = [sys.executable, "-m", "evofsm", "drive", "emergency", "--episodes", "1"]
subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
times = os.times()
print(times.children_user + times.children_system)
"""
#: What is run, and the most processor time that it may take [s].
FIRST: dict[str, tuple[str, str, float]] = {
    "first_observe": ("the first observe", _OBSERVE, 6.0),
    "first_episodes": ("a guard from import to the end of the second CartPole", _CARTPOLE, 12.0),
    "first_drive": ("evofsm drive emergency --episodes 1", _DRIVE, 20.0),
}


def first(id_: str, repeats: int, short: bool) -> Result:
    """Processor time with empty caches of kernels, beside that with full ones."""
    what, code, _ = FIRST[id_]
    cold: list[float] = []
    warm: list[float] = []
    for _ in range(1 if short else min(repeats, 3)):
        with tempfile.TemporaryDirectory() as caches:
            cold.append(_seconds(code, caches))
            warm.append(_seconds(code, caches))
    return {
        "what": f"{what}, no kernels compiled yet",
        "ours_s": float(np.median(cold)),
        "reference": "the same, kernels cached",
        "reference_s": float(np.median(warm)),
        "ours_turns_s": cold,
        "reference_turns_s": warm,
    }


def _seconds(code: str, caches: str) -> float:
    environment = {**os.environ, "NUMBA_CACHE_DIR": caches}
    command = [sys.executable, "-c", code]
    finished = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return float(finished.stdout)

"""Compile before it is needed, what follows a first failure too: nobody expects to wait then."""

from functools import cache

import numpy as np

from evofsm.fsm.kernels import COMPILES, announce_compiling
from evofsm.fsm.machine import EvolvingFSM
from evofsm.guard.api import TOLERANCE, Situation
from evofsm.guard.learnt.judge import LearntRisk


def warm() -> None:
    """Compile now what machines and guards need; say so where it takes long.

    Compiled code is kept on disk, so that this is quick from the second time on. A guard that is
    made compiles what it needs itself.

    Examples
    --------
    >>> from evofsm import warm
    >>> warm()
    """
    warm_machine()
    warm_judge()


@cache
def warm_machine() -> None:
    """Compile what machines need."""
    if not COMPILES:
        return
    announce_compiling()
    machine = EvolvingFSM(1)
    machine.learn_many([[0.0, 0.0], [9.0, 0.0]], [0, 0])
    machine.observe([np.nan, 0.0], partial=True, failed=True)


@cache
def warm_judge() -> None:
    """Compile what learnt judges need."""
    if not COMPILES:
        return
    announce_compiling()
    judge, random = LearntRisk(1.0, -1.0, 1.0), np.random.default_rng(0)
    for _ in range(3):
        for z in random.normal(size=(12, 2)).cumsum(axis=0):
            judge.observe(z)
            here = Situation(z, np.ones(1), None, 0.0, 0.0)
            judge.search(here, 0.5, tolerance=TOLERANCE, revising=False)
            judge.act(0.5)
            judge.learn(z, 0.5, here.belief)
        judge.end(None, failed=True)

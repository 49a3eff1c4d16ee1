"""Compile before it is needed."""

import numpy as np

from evofsm.fsm.kernels import announce_compiling
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.observations import Missing
from evofsm.guard.guard import Guard


def warm() -> None:
    """Compile now what machines and guards need; say so where it takes long.

    Compiled code is kept on disk, so that this is quick from the second time on.

    Examples
    --------
    >>> from evofsm import warm
    >>> warm()
    """
    announce_compiling()
    for most in (None, 1):
        machine = EvolvingFSM(1, max_states=most)
        machine.learn_many([[0.0, 0.0], [9.0, 0.0]], [0, 0])
        machine.observe([np.nan, 0.0], missing=Missing.PARTIAL, failed=True)
    guard = Guard(low=-1.0, high=1.0, interval=0.1)
    random = np.random.default_rng(0)
    for _ in range(3):  # what follows a first failure is among it
        walk = random.normal(size=(12, 2)).cumsum(axis=0)
        for z in walk:
            guard.decide(z, 0.5)
        guard.end(failed=True, observation=walk[-1])

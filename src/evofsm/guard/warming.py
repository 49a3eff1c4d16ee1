"""Compile before it is needed, what follows a first failure too: nobody expects to wait then."""

from functools import cache

import numpy as np

from evofsm.fsm.kernels import COMPILES, announce_compiling
from evofsm.fsm.machine import EvolvingFSM
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
    LearntRisk.warm()


@cache
def warm_machine() -> None:
    """Compile what machines need."""
    if not COMPILES:
        return
    announce_compiling()
    machine = EvolvingFSM(1)
    machine.learn_many([[0.0, 0.0], [9.0, 0.0]], [0, 0])
    machine.observe([np.nan, 0.0], partial=True, failed=True)

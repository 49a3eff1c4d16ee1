"""The paper's rule, which also creates states at the edges of the data.

The paper's condition takes only observations nearer the mean of everything seen than any centre,
so a rare corner never gets a state. Here it gets one where it lies farther out than every centre.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from evofsm.fsm.kernels import inner_kernel
from evofsm.fsm.learnt import Clusters
from evofsm.fsm.states import paper
from evofsm.fsm.states.clusters import CREATED, UNCHANGED, exceeds

CODE = 1


@dataclass(frozen=True)
class Edges:
    """The paper's rule, and a state at each edge, with the machine's settings.

    An observation also creates a state where its potential lies below every centre's and it is
    farther than ``radius`` from every centre.

    Parameters
    ----------
    memory : int, optional
        Number of observations after which older ones fade, as `Paper` has it.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=1, radius=0.5, rule=Edges())
    >>> machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0]).n_states
    array([1, 1, 2, 3])
    """

    memory: int | None = None
    scales: ClassVar[Sequence[float]] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "memory", paper.check_memory(self.memory))

    @property
    def table(self) -> Mapping[str, float]:
        """What the kernel judges by, in place of the machine's settings."""
        return {"code": CODE, "memory": self.memory or math.inf}


@inner_kernel
def judge(
    clusters: Clusters,
    n: int,
    potential: float,
    highest: float,
    squared_distance: float,
    radius: float,
) -> int:
    """Judge as the paper does, and create a state at an edge."""
    event = paper.judge(potential, highest, squared_distance, radius)
    if event != UNCHANGED or not exceeds(squared_distance, radius * radius):
        return event
    for i in range(n):
        if not exceeds(clusters.potentials[i], potential):
            return UNCHANGED
    return CREATED

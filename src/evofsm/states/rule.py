"""What a state rule is: frozen settings, and numbers in which it tells its kernel of them.

(`_compile` makes kernels anew where a file that names it was edited: their order matters there.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


class RuleSettings(NamedTuple):
    """What the kernels are told of how states are determined and recognised."""

    code: float  #: which rule's kernel judges an observation
    radius: float  #: how far from a centre an observation is no longer near it
    distance_weight: float  #: how fast distance to new data lowers a centre's potential
    spread: float  #: width of recognition, in the rule's own measure
    failure_share: float  #: a failure founds a state where fewer stays ended so; 0: none does
    failure_distance: float  #: and only farther than this from the nearest centre
    memory: float  #: number of observations after which older ones fade; infinity: never
    weights: NDArray[np.float64]  #: (m,) 1 / scale of each variable, where m is known


class StateRule(Protocol):
    """When an observation founds or moves a state, and how wide a state is recognised.

    A rule is a frozen dataclass of settings in a file of its own, with a kernel that judges an
    observation; `evofsm.states.dispatch` lists the rules. All distances, potentials and variances
    are those of observations divided by the rule's scales, where it has some.
    """

    @property
    def scales(self) -> Sequence[float]:
        """Difference that counts as 1, for each of the m variables; empty: 1 for each."""
        ...

    def _tell(self, machine: RuleSettings) -> RuleSettings:
        """The machine's settings, with the rule's own in place of some."""
        ...

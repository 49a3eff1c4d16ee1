"""What a state rule is: frozen settings, and numbers in which it tells its kernel of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

from evofsm.fsm.layout import PerVariable, Setting


class RuleSettings(NamedTuple):
    """What the kernels are told of how states are determined and recognised."""

    code: Setting  #: which rule's kernel judges an observation
    radius: Setting  #: how far from a centre an observation is no longer near it
    distance_weight: Setting  #: how fast distance to new data lowers a centre's potential
    spread: Setting  #: width of recognition, in the rule's own measure
    failure_share: Setting  #: a failure creates a state where fewer stays ended so; 0: none does
    failure_distance: Setting  #: and only farther than this from the nearest centre
    memory: Setting  #: number of observations after which older ones fade; infinity: never
    weights: PerVariable  #: 1 / scale of each variable, where m is known


class StateRule(Protocol):
    """When an observation creates or moves a state, and how wide a state is recognised.

    A rule is a frozen dataclass of settings, made known with `register_rule`: a small table of
    numbers for the kernel that judges an observation, which is that of a rule there is or, in the
    package, one of its own. All distances, potentials and variances are those of observations
    divided by the rule's scales, where it has some.

    Examples
    --------
    >>> from evofsm import Novelty
    >>> Novelty(radius=0.5, scales=(4.0, 2.0, 2.0)).scales
    (4.0, 2.0, 2.0)
    """

    @property
    def scales(self) -> Sequence[float]:
        """Difference that counts as 1, for each of the m variables; empty: 1 for each."""
        ...

    @property
    def table(self) -> Mapping[str, float]:
        """What its kernel judges by: fields of `RuleSettings`, in place of the machine's.

        At least ``code``, unless it is that of the paper's rule.
        """
        ...

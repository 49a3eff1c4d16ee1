"""Another rule, and a state wherever a failure happened amid a state that was mostly safe.

A state that holds both safe situations and failures says little about either. A *stay* in a
state is a run of observations of one episode that are all recognised as it. Observations are
judged by the other rule (``dispatch.py``); at a failure, ``fsm/step.py`` calls `splits`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from evofsm.fsm.kernels import inner_kernel
from evofsm.fsm.states.clusters import exceeds
from evofsm.fsm.states.novelty import Novelty
from evofsm.fsm.states.rule import RuleSettings, StateRule
from evofsm.fsm.validation import positive


@dataclass(frozen=True)
class FailureSplit:
    """Create states as another rule does, and at failures in states that were mostly safe.

    Where an episode ends in failure, let s be the most probable state at its last observation.
    If, of the stays in s that began before the failure, fewer than ``share`` ended in a failure,
    and the observation is farther than ``distance`` from the centre of s, it creates a state. A
    stay is a run of observations of one episode that are all recognised as s.

    Parameters
    ----------
    base : StateRule
        The rule that creates and moves all other states, and says how wide they are recognised.
    share : float
        Share of stays that end in failure from which on a state is no longer safe, in (0, 1].
    distance : float
        Least distance from the centre, in the scales of ``base``.

    Raises
    ------
    TypeError
        If ``base`` is no rule, or is itself a `FailureSplit`.
    ValueError
        If a number is not positive and finite, or ``share`` is above 1.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=1, rule=FailureSplit(Novelty(radius=2.0), distance=0.5))
    >>> trace = machine.learn_many([[0.0], [1.5], [0.0]], [0, 0, 0])
    >>> machine.observe([1.5], failed=True).event.name
    'CREATED'
    """

    base: StateRule = field(default_factory=Novelty)
    share: float = 0.5
    distance: float = 0.25

    def __post_init__(self) -> None:
        if isinstance(self.base, type | FailureSplit) or not hasattr(self.base, "table"):
            raise TypeError(f"base is {self.base!r}; it must be another rule, as an object")
        object.__setattr__(self, "share", positive("share", self.share))
        object.__setattr__(self, "distance", positive("distance", self.distance))
        if self.share > 1.0:
            raise ValueError(f"share is {self.share}; it must be at most 1")

    @property
    def scales(self) -> Sequence[float]:
        """Those of ``base``."""
        return self.base.scales

    @property
    def table(self) -> Mapping[str, float]:
        """What the kernel judges by, in place of the machine's settings."""
        of_failures = {"failure_share": self.share, "failure_distance": self.distance}
        return {**self.base.table, **of_failures}


@inner_kernel
def splits(
    settings: RuleSettings,
    squared_distance: float,
    visits: float,
    returns: float,
    endings: float,
) -> bool:
    """Whether the latest observation, at which an episode failed, creates a state.

    Its nearest state was recognised in ``visits`` observations, ``returns`` of which followed
    one in the same state, and ``endings`` episodes failed in it.
    """
    if not exceeds(squared_distance, settings.failure_distance**2):
        return False
    # Of all visits, those that did not come from the state itself began a stay.
    return endings < settings.failure_share * (visits - returns)

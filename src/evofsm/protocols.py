"""The few shapes that rooms agree on: who proposes, who measures, who revises."""

from __future__ import annotations

from enum import IntFlag
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


class Proposal(NamedTuple):
    """What a controller wants to do.

    Examples
    --------
    >>> Proposal(1.2)
    Proposal(action=1.2, candidates=())
    """

    action: float  #: acceleration [m/s²]
    candidates: tuple[float, ...] = ()  #: others it could do as well [m/s²]


class Intake(IntFlag):
    """What was wrong with an observation, and so what was done about it."""

    WHOLE = 0  #: nothing
    PARTIAL = 1  #: variables are missing: recognised by the others, and not learnt from
    HELD = 2  #: the same, but recognised by the values of before
    GAP = 4  #: it came long after the one before: no transition is learnt to it
    REPEATED = 8  #: as old as the one before: nothing new is known, or learnt
    LATE = 16  #: older than the one before: left out


#: Observations that bring nothing new, and such as lack something.
STALE, INCOMPLETE = Intake.REPEATED | Intake.LATE, Intake.PARTIAL | Intake.HELD


class Situation(NamedTuple):
    """Where the vehicle is, as it was observed and as the machine recognised it."""

    observation: NDArray[np.float64]  #: (3,) gap [m], v_follower [m/s], v_leader [m/s]
    belief: NDArray[np.float64]  #: (n,) distribution over states
    state: int | None  #: index of the most probable state; None where there is none yet
    surprise: float  #: divergence of forecast and belief [bit]; NaN where nothing was forecast
    time: float  #: [s]
    intake: Intake = Intake.WHOLE  #: whether the observation was whole and in time


class Revision(NamedTuple):
    """What a reviser made of a proposal, and why."""

    executed: float  #: acceleration to command [m/s²]
    proposed: float  #: acceleration that the controller wanted [m/s²]; NaN where it had none
    risk_proposed: float  #: probability of failure under the proposal; NaN where not judged
    risk_executed: float  #: the same for what is executed
    interval: tuple[float, float]  #: 90 % interval of `risk_executed`
    reason: str  #: in a few words
    evidence: float  #: number of leaders' braking manoeuvres that the risks rest on
    seen: float  #: time spent in states like this one before [s]; NaN where that is not known
    advised: float  #: what the reviser would execute, whether or not it may act [m/s²]
    explanation: str = ""  #: what a machine's experience says of it, where that was asked for


class Controller(Protocol):
    """Anything that drives the follower."""

    def propose(self, observation: NDArray[np.float64], time: float = 0.0) -> Proposal:
        """What it wants to do at ``time`` [s], seeing ``observation``.

        The observation is ``[gap [m], v_follower [m/s], v_leader [m/s]]``, the gap from bumper
        to bumper.
        """
        ...


class Reviser(Protocol):
    """Anything that keeps a proposal or replaces it by a better action."""

    def start_episode(self) -> None:
        """Forget what was under way."""
        ...

    def revise(self, situation: Situation, proposal: Proposal) -> Revision:
        """What to execute instead of the proposal; the proposal itself where it will do."""
        ...


class RiskMeasure(Protocol):
    """Anything that says how dangerous a situation is."""

    def score(self, observations: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """Danger of each row of an episode, from it and the rows before it only.

        Parameters
        ----------
        observations : (T, 3) ndarray
            Gap [m], speed of the follower and of the leader [m/s], in the order of time.
        dt : float
            Time between two rows [s].

        Returns
        -------
        (T,) ndarray
            In the measure's own unit; higher is more dangerous. Above 0 it calls for braking.
        """
        ...

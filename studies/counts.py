"""What came within a horizon, counted: the risk of going on as one drives.

The direct estimate: for each state and action, in how many cases a failure followed within h
seconds, whatever was done after. It needs no kinematics and holds for any system, but it answers
another question than the latent risk: not what can still be avoided, only what usually comes.
Counts never fade, so that a rare failure is not averaged away.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.fsm import wilson_bounds
from evofsm.fsm.validation import (
    check_action,
    positive,
    real_array,
    refuse_unless_distribution,
    whole,
)

# Cases of a more general kind that are added to those that were seen.
_LEAN = 2.0


class Outcome(NamedTuple):
    """Probability of failure within the horizon, and how well it is known."""

    probability: float
    interval: tuple[float, float]  #: 90 %
    evidence: float  #: number of cases, weighed by the belief


class OutcomeCounts:
    """Counts, for each state and action, whether a failure came within the horizon.

    Parameters
    ----------
    n_actions : int
    horizon : float
        Looked ahead [s].
    dt : float
        Time between decisions [s].

    Examples
    --------
    >>> counts = OutcomeCounts(n_actions=1, horizon=0.5, dt=0.25)
    >>> for _ in range(4):
    ...     counts.learn([1.0], 0)
    >>> counts.end_episode(failed=True)  # two of the four were followed by a failure
    >>> counts.outcome([1.0], 0).probability
    0.5
    """

    def __init__(self, n_actions: int, horizon: float = 5.0, dt: float = 0.25) -> None:
        self.n_actions = whole("n_actions", n_actions)
        self.horizon = positive("horizon", horizon)
        self.dt = positive("dt", dt)
        if self.horizon < self.dt:
            raise ValueError(f"horizon is {horizon} s; it must span a decision, {dt} s, or more")
        self._open: deque[tuple[NDArray[np.float64], int]] = deque()
        self._cases = np.zeros((self.n_actions, 0))
        self._failures = np.zeros((self.n_actions, 0))

    def learn(self, belief: ArrayLike, action: int) -> None:
        """Take in a decision: where it was taken (n,), and the index of the action."""
        action = check_action(action, self.n_actions)
        states = real_array("belief", belief, 1)
        refuse_unless_distribution("belief", states)
        self._open.append((states, action))
        if len(self._open) > round(self.horizon / self.dt):
            self._close(failed=False)

    def end_episode(self, *, failed: bool) -> None:
        """Of an episode that ended well it is not known what would have come: that is left out."""
        while failed and self._open:
            self._close(failed=True)
        self._open.clear()

    def outcome(self, belief: ArrayLike, action: int) -> Outcome:
        """Probability of failure within the horizon.

        Where an action was rarely taken in a state it leans on the share of failures after any
        action there, and that on the share among all cases: as if so many more had been seen (an
        empirical Bayes estimate).
        """
        weights = np.asarray(belief, dtype=np.float64)[: self._cases.shape[1]]
        n, action = len(weights), check_action(action, self.n_actions)
        cases, failures = self._cases[:, :n] @ weights, self._failures[:, :n] @ weights
        anywhere = (self._failures.sum() + 0.5) / (self._cases.sum() + 1.0)
        here = (failures.sum() + _LEAN * anywhere) / (cases.sum() + _LEAN)
        probability = (failures[action] + _LEAN * here) / (cases[action] + _LEAN)
        interval = wilson_bounds(float(probability), float(cases[action]) + _LEAN)
        return Outcome(float(probability), interval, float(cases[action]))

    def _close(self, *, failed: bool) -> None:
        belief, action = self._open.popleft()
        n, missing = len(belief), len(belief) - self._cases.shape[1]
        if missing > 0:
            self._cases = np.pad(self._cases, ((0, 0), (0, missing)))
            self._failures = np.pad(self._failures, ((0, 0), (0, missing)))
        self._cases[action, :n] += belief
        if failed:
            self._failures[action, :n] += belief

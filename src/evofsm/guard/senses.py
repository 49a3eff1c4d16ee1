"""Observations as they come in life: late, twice, after a hole in time, or with a sensor missing.

What is done about each is decided here, once for all who drive, and told with the situation, so
that a reviser knows when it drives on less.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm import Missing
from evofsm.guard.protocols import Intake

# Longer than so many intervals is a hole in time.
_HOLE = 1.5
_FLAGS = {Missing.PARTIAL: Intake.PARTIAL, Missing.HOLD: Intake.HELD}


def has_gaps(observation: NDArray[np.float64]) -> bool:
    """Whether a variable of usable numbers is NaN: the quickest way to ask it."""
    return math.isnan(observation.dot(observation))


class Senses:
    """Tells what is wrong with observations, and remembers what was seen last.

    Parameters
    ----------
    missing : Missing
        What to do where a variable was not observed (NaN).
    interval : float, optional
        Time between observations [s]; without it no hole in time is told.

    Examples
    --------
    >>> senses = Senses(interval=0.25)
    >>> senses.take(np.array([30.0, 20.0, 20.0]), 0.0)
    <Intake.WHOLE: 0>
    >>> senses.take(np.array([np.nan, 20.0, 20.0]), 0.25), senses.held
    (<Intake.PARTIAL: 1>, array([30., 20., 20.]))
    >>> senses.take(np.array([29.0, 20.0, 20.0]), 0.25), senses.take(np.zeros(3), 0.1)
    (<Intake.REPEATED: 8>, <Intake.LATE: 16>)
    >>> senses.take(np.array([25.0, 20.0, 20.0]), 2.0)
    <Intake.GAP: 4>
    """

    def __init__(self, missing: Missing = Missing.PARTIAL, interval: float | None = None) -> None:
        self.missing = missing
        self.interval = interval
        #: The latest value of each variable; NaN of one that was never seen.
        self.held: NDArray[np.float64] = np.empty(0)
        self._time = math.nan

    def take(self, observation: NDArray[np.float64], time: float) -> Intake:
        """What is wrong with an observation at ``time`` [s]; one out of order is not taken in.

        Raises
        ------
        ValueError
            If a variable is missing, and that is to be rejected.
        """
        if time == self._time:
            return Intake.REPEATED
        if time < self._time:
            return Intake.LATE
        found = Intake.WHOLE
        if has_gaps(observation):
            found = self._without(np.isnan(observation), observation, time)
        else:
            self.held = observation.copy()
        if self.interval is not None and time - self._time > _HOLE * self.interval:
            found |= Intake.GAP
        self._time = time
        return found

    def _without(
        self, absent: NDArray[np.bool_], observation: NDArray[np.float64], time: float
    ) -> Intake:
        """Some variables are missing: what was seen of them before is still held."""
        if self.missing is Missing.REJECT:
            gone = np.flatnonzero(absent).tolist()
            raise ValueError(f"variables {gone} of the observation at {time:g} s are missing")
        known = len(self.held) == len(observation)
        self.held = np.where(absent, self.held, observation) if known else observation.copy()
        return _FLAGS[self.missing]

"""A recorded drive as a controller."""

from __future__ import annotations

from typing import Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.fsm import real_array, refuse_unusable
from evofsm.guard import Proposal

# Clocks that should agree may differ in the last digits [s].
_SAME_TIME = 1e-9


class Recording(Protocol):
    """What a world's `Episode` has, and any other record may have."""

    @property
    def time(self) -> NDArray[np.float64]:
        """(T,) ndarray [s]."""
        ...

    @property
    def accelerations(self) -> NDArray[np.float64]:
        """(T,) ndarray: commanded after each row [m/s²]."""
        ...


class RecordedController:
    """A controller that does again what was done, whatever it sees.

    Each value holds until the next one, and the last one holds on for ever: end a trace with 0.0
    for a car that then keeps its speed.

    Parameters
    ----------
    times : (T,) array_like
        When each value was commanded [s], ascending.
    accelerations : (T,) array_like
        What was commanded [m/s²].

    Raises
    ------
    ValueError
        If the two do not match, times do not ascend, or a value is not finite.

    Examples
    --------
    >>> replay = RecordedController([0.0, 1.0, 3.0], [1.5, -2.0, 0.0])
    >>> anything = np.array([10.0, 5.0, 5.0])
    >>> [replay.propose(anything, time).action for time in (0.0, 0.99, 1.0, 2.5, 60.0)]
    [1.5, 1.5, -2.0, -2.0, 0.0]
    """

    def __init__(self, times: ArrayLike, accelerations: ArrayLike) -> None:
        self.times = real_array("times", times, 1)
        self.accelerations = real_array("accelerations", accelerations, 1)
        if len(self.times) != len(self.accelerations):
            raise ValueError(
                f"there are {len(self.times)} times and {len(self.accelerations)} accelerations; "
                "each acceleration needs its time"
            )
        refuse_unusable("times", self.times)
        refuse_unusable("accelerations", self.accelerations)
        late = np.flatnonzero(np.diff(self.times) <= 0.0)
        if len(late):
            before, after = self.times[late[0] : late[0] + 2]
            raise ValueError(
                f"times do not ascend: {after:g} s follows {before:g} s "
                "(are there several recordings in one?)"
            )

    @classmethod
    def of(cls, recording: Recording) -> Self:
        """Do again what was commanded in an `Episode`, or in anything like it.

        In the same scenario it drives the same way, be it in another world; the last command, which
        the recording never came to carry out, holds on after its end.

        Parameters
        ----------
        recording : Episode
            Or anything with ``time`` and ``accelerations``.

        Returns
        -------
        RecordedController
        """
        return cls(recording.time, recording.accelerations)

    def propose(self, observation: NDArray[np.float64], time: float = 0.0) -> Proposal:
        """What was commanded at ``time`` [s], whatever is observed.

        Raises
        ------
        ValueError
            If that is before the recording begins.
        """
        row = int(np.searchsorted(self.times, time + _SAME_TIME, side="right")) - 1
        if row < 0:
            raise ValueError(
                f"the recording begins at {self.times[0]:g} s and says nothing for {time:g} s"
            )
        return Proposal(float(self.accelerations[row]))

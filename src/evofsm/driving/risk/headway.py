"""Time headway: how long the follower needs to where the leader is now.

K. Vogel, "A comparison of headway and time to collision as safety indicators", Accident Analysis
& Prevention 35, 2003. Below 1 s Sweden fines, which is the threshold here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.risk.kinematics import check_arguments, columns, time_to_cover, urgency


def time_headway(observations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Time until the follower reaches the place at which the leader's rear bumper is.

    Parameters
    ----------
    observations : (..., 3) ndarray
        Gap [m], speed of the follower and of the leader [m/s].

    Returns
    -------
    (...) ndarray
        Gap over speed of the follower [s]; infinite where it stands, 0 where the cars have met.

    Examples
    --------
    >>> time_headway(np.array([[30.0, 20.0, 25.0], [5.0, 0.0, 0.0]]))
    array([1.5, inf])
    """
    gap, speed, _ = columns(observations)
    return time_to_cover(gap, speed)


@dataclass(frozen=True)
class TimeHeadway:
    """Danger where the follower drives close behind.

    Parameters
    ----------
    threshold : float
        Time headway below which it calls for braking [s].

    Raises
    ------
    ValueError
        If the threshold is not positive and finite.

    Examples
    --------
    >>> TimeHeadway().score(np.array([[30.0, 20.0, 25.0], [10.0, 20.0, 25.0]]), dt=0.1)
    array([-0.33333333,  1.        ])
    """

    threshold: float = 1.0

    def __post_init__(self) -> None:
        check_arguments(self)

    def score(self, observations: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """1 / time headway − 1 / threshold [1/s]; infinite where the cars have met."""
        return urgency(time_headway(observations), self.threshold)

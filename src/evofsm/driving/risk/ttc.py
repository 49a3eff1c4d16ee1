"""Time to collision (Hayward 1972): the measure in widest use, blind at equal speeds.

J. C. Hayward, "Near-miss determination through use of a scale of danger", Highway Research
Record 384, 1972. The threshold of 1.5 s is that of the Swedish conflict technique (C. Hydén, "The
development of a method for traffic safety evaluation", Lund, 1987).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.risk.kinematics import check_arguments, columns, time_to_cover, urgency


def time_to_collision(observations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Time until the cars meet if both kept their speed.

    Parameters
    ----------
    observations : (..., 3) ndarray
        Gap [m], speed of the follower and of the leader [m/s].

    Returns
    -------
    (...) ndarray
        Gap over closing speed [s]; infinite where the follower is not the faster one, 0 where
        the cars have met.

    Examples
    --------
    >>> time_to_collision(np.array([[20.0, 25.0, 20.0], [2.0, 20.0, 20.0]]))
    array([ 4., inf])
    """
    gap, speed, leader_speed = columns(observations)
    return time_to_cover(gap, speed - leader_speed)


@dataclass(frozen=True)
class TimeToCollision:
    """Danger where the time to collision is short.

    Parameters
    ----------
    threshold : float
        Time to collision below which it calls for braking [s].

    Raises
    ------
    ValueError
        If the threshold is not positive and finite.

    Examples
    --------
    >>> TimeToCollision().score(np.array([[20.0, 25.0, 20.0], [5.0, 25.0, 20.0]]), dt=0.1) > 0.0
    array([False,  True])
    """

    threshold: float = 1.5

    def __post_init__(self) -> None:
        check_arguments(self)

    def score(self, observations: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """1 / time to collision − 1 / threshold [1/s]; infinite where the cars have met."""
        return urgency(time_to_collision(observations), self.threshold)

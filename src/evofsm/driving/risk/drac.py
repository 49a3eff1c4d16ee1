"""Deceleration to avoid collision, DRAC (Cooper & Ferguson 1976): blind at equal speeds.

D. F. Cooper, N. Ferguson, "Traffic studies at T-junctions: a conflict simulation model", Traffic
Engineering & Control 17, 1976. The threshold of 3.35 m/s² is that of J. Archer, "Indicators for
traffic safety assessment and prediction", KTH Stockholm, 2005; others take 3.4 m/s².
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.risk.kinematics import check_arguments, columns, unsafe_once_met


def deceleration_to_avoid_collision(observations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Braking with which the follower just avoids a leader that keeps its speed.

    Parameters
    ----------
    observations : (..., 3) ndarray
        Gap [m], speed of the follower and of the leader [m/s].

    Returns
    -------
    (...) ndarray
        Square of the closing speed over twice the gap [m/s²]; 0 where the follower is not the
        faster one, infinite where the cars have met.

    Examples
    --------
    >>> deceleration_to_avoid_collision(np.array([[10.0, 30.0, 20.0], [10.0, 20.0, 20.0]]))
    array([5., 0.])
    """
    gap, speed, leader_speed = columns(observations)
    closing = np.maximum(speed - leader_speed, 0.0)
    needed = np.zeros_like(gap)
    with np.errstate(over="ignore"):
        np.divide(closing**2, 2.0 * gap, out=needed, where=gap > 0.0)
    return unsafe_once_met(gap, needed)


@dataclass(frozen=True)
class DecelerationToAvoidCollision:
    """Danger where hard braking is needed.

    Parameters
    ----------
    threshold : float
        Needed deceleration above which it calls for braking [m/s²].

    Raises
    ------
    ValueError
        If the threshold is not positive and finite.

    Examples
    --------
    >>> DecelerationToAvoidCollision().score(np.array([[10.0, 30.0, 20.0]]), dt=0.1)
    array([1.65])
    """

    threshold: float = 3.35

    def __post_init__(self) -> None:
        check_arguments(self)

    def score(self, observations: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """Needed deceleration − threshold [m/s²]; infinite where the cars have met."""
        return deceleration_to_avoid_collision(observations) - self.threshold

"""Performance models of UN Regulation No. 157: what must be avoidable behind a slower car.

UN Regulation No. 157 (Automated Lane Keeping Systems), paragraph 5.2.5.2 and Annex 4 Appendix 3.
A collision must be avoided if the time to collision, when the other car has cut in, is longer than
closing speed / (2·decel) + reaction. The leader keeps its speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.risk.kinematics import check_arguments, columns, unsafe_once_met

_GRAVITY = 9.81


def distance_to_avoid(
    observations: NDArray[np.float64], reaction: float, decel: float
) -> NDArray[np.float64]:
    """Gap from which the follower can still avoid a leader that keeps its speed.

    Parameters
    ----------
    observations : (..., 3) ndarray
        Gap [m], which does not matter here, speed of the follower and of the leader [m/s].
    reaction : float
        Time before the follower brakes [s].
    decel : float
        Its braking then [m/s²], positive.

    Returns
    -------
    (...) ndarray
        closing² / (2·decel) + closing·reaction [m], the regulation's time to collision times the
        closing speed; 0 where the follower is not the faster one.

    Examples
    --------
    >>> distance_to_avoid(np.array([[50.0, 30.0, 18.0], [50.0, 18.0, 30.0]]), 0.5, 6.0)
    array([18.,  0.])
    """
    _, speed, leader_speed = columns(observations)
    closing = np.maximum(speed - leader_speed, 0.0)
    return np.asarray(closing**2 / (2.0 * decel) + closing * reaction)


@dataclass(frozen=True)
class PerformanceModel:
    """Danger where a driver of the regulation could not avoid the collision any more.

    The regulation compares times to collision; here they are multiplied by the closing speed, so
    that the score is a distance and defined at any speeds. Its sign stays the same.

    Parameters
    ----------
    reaction : float
        Time before the follower brakes [s]; 0 is allowed.
    decel : float
        Its braking then [m/s²], positive.

    Raises
    ------
    ValueError
        If ``decel`` is not positive and finite, or ``reaction`` is negative or not finite.

    Examples
    --------
    >>> observations = np.array([[15.0, 30.0, 18.0], [17.0, 30.0, 18.0]])
    >>> PerformanceModel.regulation().score(observations, dt=0.1)
    array([ 1.2, -0.8])
    """

    reaction: float
    decel: float

    def __post_init__(self) -> None:
        check_arguments(self, "reaction")

    @classmethod
    def regulation(cls) -> Self:
        """The minimum for a car that cuts in, paragraph 5.2.5.2: 0.35 s and 6 m/s²."""
        return cls(reaction=0.35, decel=6.0)

    @classmethod
    def careful_human(cls) -> Self:
        """The competent and careful human driver of Annex 4 Appendix 3: 0.75 s and 0.774 g.

        Its 0.6 s from the first to full braking are left out.
        """
        return cls(reaction=0.75, decel=0.774 * _GRAVITY)

    def score(self, observations: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """Distance to avoid − gap [m]; infinite where the cars have met."""
        gap = columns(observations)[0]
        needed = distance_to_avoid(observations, self.reaction, self.decel)
        return unsafe_once_met(gap, needed - gap)

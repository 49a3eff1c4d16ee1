"""Responsibility-Sensitive Safety (Shalev-Shwartz et al. 2017), its longitudinal part.

S. Shalev-Shwartz, S. Shammah, A. Shashua, "On a formal model of safe and scalable self-driving
cars", arXiv:1708.06374, 2017.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.risk.kinematics import check_arguments, columns, unsafe_once_met


def safe_distance(
    observations: NDArray[np.float64],
    response: float,
    accel: float,
    decel: float,
    leader_decel: float,
) -> NDArray[np.float64]:
    """Gap from which the follower can still stop behind a leader that brakes in full.

    Parameters
    ----------
    observations : (..., 3) ndarray
        Gap [m], which does not matter here, speed of the follower and of the leader [m/s].
    response : float
        Time before the follower brakes [s].
    accel : float
        Acceleration of the follower until then [m/s²].
    decel, leader_decel : float
        Braking that the follower is sure to reach, and the hardest of the leader [m/s²], positive.

    Returns
    -------
    (...) ndarray
        v·ρ + a·ρ²/2 + (v + ρ·a)² / (2·decel) − v_leader² / (2·leader_decel) [m], or 0 if that is
        negative, where v is the follower's speed, ρ the response and a ``accel``.

    Examples
    --------
    >>> safe_distance(np.array([50.0, 20.0, 20.0]), 0.5, 2.0, 5.0, 8.0)
    array(29.35)
    """
    _, speed, leader_speed = columns(observations)
    fastest = speed + response * accel
    travelled = (speed + fastest) / 2.0 * response
    stopping = travelled + fastest**2 / (2.0 * decel)
    return np.asarray(np.maximum(stopping - leader_speed**2 / (2.0 * leader_decel), 0.0))


@dataclass(frozen=True)
class ResponsibilitySensitiveSafety:
    """Danger where the gap is shorter than the safe distance.

    Parameters
    ----------
    response : float
        Time before the follower brakes [s]; 0 is allowed.
    accel : float
        Acceleration of the follower until then [m/s²]; 0 is allowed.
    decel, leader_decel : float
        Braking that the follower is sure to reach, and the hardest of the leader [m/s²], positive.

    Raises
    ------
    ValueError
        If an argument is negative or not finite, or a deceleration is 0.

    Examples
    --------
    >>> rss = ResponsibilitySensitiveSafety(0.5, 2.0, decel=5.0, leader_decel=8.0)
    >>> rss.score(np.array([[50.0, 20.0, 20.0], [25.0, 20.0, 20.0]]), dt=0.1)
    array([-20.65,   4.35])
    """

    response: float
    accel: float
    decel: float
    leader_decel: float

    def __post_init__(self) -> None:
        check_arguments(self, "response", "accel")

    @classmethod
    def r157(cls) -> Self:
        """Constants with which RSS was compared for UN Regulation No. 157.

        Response 0.75 s, acceleration 3 m/s², 6 m/s² of braking for both cars, as in the published
        implementation (JRC-FSM) behind K. Mattas et al., "Driver models for the definition of
        safety requirements of automated vehicles in international regulations. Application to
        motorway driving conditions", Accident Analysis & Prevention 174, 2022.
        """
        return cls(response=0.75, accel=3.0, decel=6.0, leader_decel=6.0)

    @classmethod
    def matched(
        cls, decel: float, leader_decel: float, response: float = 0.25, accel: float = 2.5
    ) -> Self:
        """RSS told what both cars can truly do [m/s²]; responding at the next decision [s]."""
        return cls(response, accel, decel, leader_decel)

    def score(self, observations: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """Safe distance − gap [m]; infinite where the cars have met."""
        gap = columns(observations)[0]
        safe = safe_distance(observations, self.response, self.accel, self.decel, self.leader_decel)
        return unsafe_once_met(gap, safe - gap)

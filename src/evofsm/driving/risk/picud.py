"""PICUD, possibility index for collision with urgent deceleration (Uno et al. 2002).

N. Uno, Y. Iida, S. Itsubo, S. Yasuhara, "A microscopic analysis of traffic conflict caused by
lane-changing vehicle at weaving section", 13th Mini-EURO Conference, 2002. Their constants are
3.3 m/s² for both cars and 1 s to react.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.risk.kinematics import check_arguments, columns, unsafe_once_met


def picud(observations: NDArray[np.float64], decel: float, reaction: float) -> NDArray[np.float64]:
    """Gap that is left when both cars have braked to standstill.

    Parameters
    ----------
    observations : (..., 3) ndarray
        Gap [m], speed of the follower and of the leader [m/s].
    decel : float
        Braking of both cars [m/s²], positive.
    reaction : float
        Time after which the follower brakes too [s].

    Returns
    -------
    (...) ndarray
        gap + v_leader² / (2·decel) − v·reaction − v² / (2·decel) [m]; below 0 they collide.

    Examples
    --------
    >>> picud(np.array([[30.0, 20.0, 20.0], [30.0, 20.0, 10.0]]), decel=3.0, reaction=1.0)
    array([ 10., -40.])
    """
    gap, speed, leader_speed = columns(observations)
    braked = (leader_speed**2 - speed**2) / (2.0 * decel)
    return np.asarray(gap + braked - speed * reaction)


@dataclass(frozen=True)
class Picud:
    """Danger where the cars would collide if the leader braked now and the follower after it.

    Parameters
    ----------
    decel : float
        Braking of both cars [m/s²], positive.
    reaction : float
        Time after which the follower brakes too [s]; 0 is allowed.

    Raises
    ------
    ValueError
        If ``decel`` is not positive and finite, or ``reaction`` is negative or not finite.

    Examples
    --------
    >>> Picud().score(np.array([[30.0, 20.0, 20.0], [15.0, 20.0, 20.0]]), dt=0.1)
    array([-10.,   5.])
    """

    decel: float = 3.3
    reaction: float = 1.0

    def __post_init__(self) -> None:
        check_arguments(self, "reaction")

    def score(self, observations: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """Minus the gap left [m]; infinite where the cars have met."""
        left = picud(observations, self.decel, self.reaction)
        return unsafe_once_met(columns(observations)[0], -left)

"""Modified time to collision (Ozbay et al. 2008): it sees the leader brake, once it brakes.

K. Ozbay, H. Yang, B. Bartin, S. Mudigonda, "Derivation and validation of new simulation-based
surrogate safety measure", Transportation Research Record 2083, 2008.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.risk.kinematics import (
    acceleration,
    check_arguments,
    columns,
    time_to_cover,
    urgency,
)


def modified_time_to_collision(observations: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
    """Time until the cars meet if both kept their acceleration.

    It is the first t > 0 at which Δa·t²/2 + Δv·t = gap, where Δv and Δa are the speed and the
    acceleration of the follower minus the leader's. As published, it lets cars roll backwards
    where they would in truth have come to a standstill.

    Parameters
    ----------
    observations : (..., T, 3) ndarray
        Gap [m], speed of the follower and of the leader [m/s], in the order of time.
    dt : float
        Time between two rows [s]. Accelerations are those since the row before, and 0 in the
        first row.

    Returns
    -------
    (..., T) ndarray
        [s]; infinite where the cars would never meet, 0 where they have met.

    Raises
    ------
    ValueError
        If ``dt`` is not positive and finite.

    Examples
    --------
    The leader begins to brake by 4 m/s² in front of a follower as fast as itself.

    >>> modified_time_to_collision(np.array([[10.0, 20.0, 20.0], [8.0, 20.0, 18.0]]), dt=0.5)
    array([       inf, 1.56155281])
    """
    gap, speed, leader_speed = columns(observations)
    closing = speed - leader_speed
    discriminant = closing**2 + 2.0 * acceleration(closing, dt) * gap
    # Gap over the mean closing speed until then: the first positive root, whatever the sign of Δa.
    mean = np.where(discriminant >= 0.0, (closing + np.sqrt(np.maximum(discriminant, 0.0))) / 2, 0)
    return time_to_cover(gap, mean)


@dataclass(frozen=True)
class ModifiedTimeToCollision:
    """Danger where the modified time to collision is short.

    Parameters
    ----------
    threshold : float
        Modified time to collision below which it calls for braking [s]; by default that of
        `TimeToCollision`, so that the two differ in nothing but the accelerations.

    Raises
    ------
    ValueError
        If the threshold is not positive and finite.

    Examples
    --------
    >>> episode = np.array([[10.0, 20.0, 20.0], [8.0, 20.0, 18.0], [5.0, 20.0, 16.0]])
    >>> ModifiedTimeToCollision().score(episode, dt=0.5) > 0.0
    array([False, False,  True])
    """

    threshold: float = 1.5

    def __post_init__(self) -> None:
        check_arguments(self)

    def score(self, observations: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """1 / modified time to collision − 1 / threshold [1/s]; infinite where the cars met."""
        return urgency(modified_time_to_collision(observations, dt), self.threshold)

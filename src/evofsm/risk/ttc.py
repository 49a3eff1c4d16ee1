"""Time to collision (Hayward 1972): the measure in widest use, blind at equal speeds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


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
    gap, speed, leader_speed = np.moveaxis(np.asarray(observations, dtype=np.float64), -1, 0)
    closing = speed - leader_speed
    ttc = np.full_like(gap, np.inf)
    np.divide(gap, closing, out=ttc, where=closing > 0.0)
    return np.where(gap <= 0.0, 0.0, ttc)

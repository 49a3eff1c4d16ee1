"""Dead ends by oracle: situations in which a braking leader could no longer be avoided.

Only a simulation knows both cars' true limits. The oracle scores what was learnt; nothing
learns from it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def is_dead_end(
    observations: NDArray[np.float64], decel: float, leader_decel: float
) -> NDArray[np.bool_]:
    """Whether the cars collide if both brake in full from now until standstill.

    Parameters
    ----------
    observations : (..., 3) ndarray
        Gap [m], speed of the follower and of the leader [m/s].
    decel, leader_decel : float
        Hardest braking of the follower and of the leader [m/s²], positive.

    Returns
    -------
    (...) ndarray of bool

    Examples
    --------
    >>> is_dead_end(np.array([[30.0, 20.0, 20.0], [25.0, 20.0, 20.0]]), 4.0, 9.0)
    array([False,  True])
    """
    gap, speed, leader_speed = np.moveaxis(np.asarray(observations, dtype=np.float64), -1, 0)
    stopped = gap + leader_speed**2 / (2 * leader_decel) - speed**2 / (2 * decel)
    smallest = np.minimum(gap, stopped)
    # A follower who brakes harder is nearest when the speeds meet, if both still move then.
    if decel > leader_decel:
        meeting = (speed - leader_speed) / (decel - leader_decel)
        moving = (meeting > 0.0) & (meeting < leader_speed / leader_decel)
        nearest = gap - (speed - leader_speed) ** 2 / (2 * (decel - leader_decel))
        smallest = np.where(moving, np.minimum(smallest, nearest), smallest)
    return np.asarray(smallest <= 0.0)

"""The Fuzzy Safety Model of UN Regulation No. 157: it brakes gently before it must brake hard.

K. Mattas et al., "Fuzzy Surrogate Safety Metrics for real-time assessment of rear-end collision
risk", Accident Analysis & Prevention 148, 2020, and "Driver models for the definition of safety
requirements of automated vehicles in international regulations", the same 174, 2022.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.risk.kinematics import acceleration, check_arguments, columns


def proactive_fuzzy(
    observations: NDArray[np.float64],
    reaction: float,
    comfortable_decel: float,
    decel: float,
    leader_decel: float,
    margin: float,
) -> NDArray[np.float64]:
    """PFS, how unsafe the gap is should the leader brake in full.

    With the distance s(b) = v·reaction + v² / (2·b) − v_leader² / (2·leader_decel), it is 1 for
    gap − margin below s(decel), 0 above s(comfortable_decel) + margin, and linear in between.

    Parameters
    ----------
    observations : (..., 3) ndarray
        Gap [m], speed of the follower and of the leader [m/s].
    reaction : float
        Time before the follower brakes [s].
    comfortable_decel, decel, leader_decel : float
        Comfortable and hardest braking of the follower, braking of the leader [m/s²], positive.
    margin : float
        Gap to be left at standstill, and once more before the follower must brake [m].

    Returns
    -------
    (...) ndarray
        From 0, safe, to 1, unsafe; 1 where the cars have met.

    Examples
    --------
    >>> observations = np.array([[50.0, 20.0, 20.0], [32.0, 20.0, 20.0], [20.0, 20.0, 20.0]])
    >>> proactive_fuzzy(observations, 1.0, 4.0, 5.0, 5.0, margin=2.0).round(2)
    array([0.  , 0.17, 1.  ])
    """
    gap, speed, leader_speed = columns(observations)
    shared = speed * reaction - leader_speed**2 / (2.0 * leader_decel)
    unsafe = shared + speed**2 / (2.0 * decel)
    safe = shared + speed**2 / (2.0 * comfortable_decel) + margin
    return np.where(gap <= 0.0, 1.0, _membership(gap - margin, unsafe, safe))


def critical_fuzzy(
    observations: NDArray[np.float64],
    dt: float,
    reaction: float,
    comfortable_decel: float,
    decel: float,
) -> NDArray[np.float64]:
    """CFS, how unsafe the gap is while the follower closes in on a leader that keeps its speed.

    Until it reacts, the follower keeps its acceleration, or brakes by ``comfortable_decel`` where
    it brakes harder than that. If it is then still the faster one, CFS is 1 for gaps from which
    ``decel`` would not do, 0 for gaps from which ``comfortable_decel`` does, and linear in
    between. If not, it is 1 for gaps from which the present braking does not do, and 0 else.

    Parameters
    ----------
    observations : (..., T, 3) ndarray
        Gap [m], speed of the follower and of the leader [m/s], in the order of time.
    dt : float
        Time between two rows [s]. The acceleration is the one since the row before, and 0 in the
        first row.
    reaction : float
        Time before the follower reacts [s].
    comfortable_decel, decel : float
        Comfortable and hardest braking of the follower [m/s²], positive.

    Returns
    -------
    (..., T) ndarray
        From 0, safe, to 1, unsafe; 0 where the follower is not the faster one, 1 where the cars
        have met.

    Raises
    ------
    ValueError
        If ``dt`` is not positive and finite.

    Examples
    --------
    >>> observations = np.array([[30.0, 20.0, 10.0], [21.0, 20.0, 10.0], [5.0, 20.0, 10.0]])
    >>> critical_fuzzy(observations, 0.5, 1.0, comfortable_decel=4.0, decel=5.0)
    array([0. , 0.6, 1. ])
    """
    gap, speed, leader_speed = columns(observations)
    closing = speed - leader_speed
    accel = acceleration(speed, dt)
    change = np.maximum(accel, -comfortable_decel) * reaction
    later = closing + change
    travelled = (closing + later) / 2.0 * reaction
    approaches = closing > 0.0
    slows = approaches & (later < 0.0)
    # What the present braking needs until the speeds are equal.
    present = np.zeros_like(gap)
    np.divide(closing**2, -2.0 * accel, out=present, where=slows)
    unsafe = np.where(slows, present, travelled + later**2 / (2.0 * decel))
    safe = np.where(slows, present, travelled + later**2 / (2.0 * comfortable_decel))
    critical = np.where(approaches, _membership(gap, unsafe, safe), 0.0)
    return np.where(gap <= 0.0, 1.0, critical)


def _membership(
    gap: NDArray[np.float64], unsafe: NDArray[np.float64], safe: NDArray[np.float64]
) -> NDArray[np.float64]:
    """1 below ``unsafe``, 0 from ``safe`` on, and linear in between."""
    member = np.asarray(gap < unsafe, dtype=np.float64)
    np.divide(safe - gap, safe - unsafe, out=member, where=(gap >= unsafe) & (gap < safe))
    return member


@dataclass(frozen=True)
class FuzzySafety:
    """Danger where the Fuzzy Safety Model begins to brake.

    Parameters
    ----------
    reaction : float
        Time before the follower reacts [s]; 0 is allowed.
    comfortable_decel, decel, leader_decel : float
        Comfortable and hardest braking of the follower, braking of the leader [m/s²], positive;
        ``decel`` is not the weaker one.
    margin : float
        Gap to be left at standstill, and once more before the follower must brake [m]; 0 is
        allowed.
    threshold : float
        Degree of danger above which it calls for braking, from 0 to below 1; the model itself
        brakes from 0 on, the harder the more dangerous it is.

    Raises
    ------
    ValueError
        If an argument is out of range or not finite.

    Examples
    --------
    >>> FuzzySafety().score(np.array([[60.0, 20.0, 20.0], [25.0, 20.0, 20.0]]), dt=0.1).round(3)
    array([0.   , 0.827])
    """

    reaction: float = 0.75
    comfortable_decel: float = 4.0
    decel: float = 6.0
    leader_decel: float = 7.0
    margin: float = 2.0
    threshold: float = 0.0

    def __post_init__(self) -> None:
        check_arguments(self, "reaction", "margin", "threshold")
        if self.decel < self.comfortable_decel:
            raise ValueError(
                f"FuzzySafety decel is {self.decel}; it must not be below comfortable_decel, "
                f"which is {self.comfortable_decel}"
            )
        if self.threshold >= 1.0:
            raise ValueError(f"FuzzySafety threshold is {self.threshold}; it must be below 1")

    def score(self, observations: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """The larger one of PFS and CFS − threshold; 1 − threshold where the cars have met."""
        proactive = proactive_fuzzy(
            observations,
            self.reaction,
            self.comfortable_decel,
            self.decel,
            self.leader_decel,
            self.margin,
        )
        critical = critical_fuzzy(
            observations, dt, self.reaction, self.comfortable_decel, self.decel
        )
        return np.maximum(proactive, critical) - self.threshold

"""What the classic measures of danger have in common."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm import positive


def columns(observations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gap [m], speed of the follower and of the leader [m/s], one after the other.

    Parameters
    ----------
    observations : (..., 3) ndarray

    Returns
    -------
    (3, ...) ndarray

    Examples
    --------
    >>> columns(np.array([[30, 20, 10], [29, 21, 10]])).tolist()
    [[30.0, 29.0], [20.0, 21.0], [10.0, 10.0]]
    """
    return np.moveaxis(np.asarray(observations, dtype=np.float64), -1, 0)


def acceleration(speed: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
    """Mean acceleration since the row before; 0 in the first row, which has none.

    Parameters
    ----------
    speed : (..., T) ndarray
        [m/s], in the order of time.
    dt : float
        Time between two rows [s].

    Returns
    -------
    (..., T) ndarray
        [m/s²].

    Raises
    ------
    ValueError
        If ``dt`` is not positive and finite.

    Examples
    --------
    >>> acceleration(np.array([10.0, 11.0, 10.5]), 0.5)
    array([ 0.,  2., -1.])
    """
    return np.diff(speed, prepend=speed[..., :1]) / positive("dt", dt)


def time_to_cover(gap: NDArray[np.float64], speed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Time to cover a gap at a speed.

    Parameters
    ----------
    gap, speed : (...) ndarray
        [m], [m/s].

    Returns
    -------
    (...) ndarray
        [s]; infinite where the speed is not positive, 0 where the gap is not.

    Examples
    --------
    >>> time_to_cover(np.array([20.0, 20.0, -1.0]), np.array([5.0, 0.0, 0.0]))
    array([ 4., inf,  0.])
    """
    time = np.full_like(gap, np.inf)
    with np.errstate(over="ignore"):
        np.divide(gap, speed, out=time, where=speed > 0.0)
    return np.where(gap <= 0.0, 0.0, time)


def urgency(time: NDArray[np.float64], threshold: float) -> NDArray[np.float64]:
    """How far a time is below a threshold, finite where the time is infinite.

    Parameters
    ----------
    time : (...) ndarray
        Time left [s], 0 or more.
    threshold : float
        [s].

    Returns
    -------
    (...) ndarray
        1 / time − 1 / threshold [1/s]; infinite where no time is left.

    Examples
    --------
    >>> urgency(np.array([np.inf, 2.0, 1.0, 0.0]), 2.0)
    array([-0.5,  0. ,  0.5,  inf])
    """
    with np.errstate(divide="ignore", over="ignore"):
        return np.asarray(1.0 / time - 1.0 / threshold)


def unsafe_once_met(gap: NDArray[np.float64], score: NDArray[np.float64]) -> NDArray[np.float64]:
    """The score, and infinity where the cars have met.

    Examples
    --------
    >>> unsafe_once_met(np.array([1.0, 0.0]), np.array([-5.0, -6.0]))
    array([-5., inf])
    """
    return np.where(gap <= 0.0, np.inf, score)


def check_arguments(measure: Any, *may_be_zero: str) -> None:
    """Raise unless every argument of a measure is a positive, finite number, or an allowed 0.

    Parameters
    ----------
    measure : dataclass
    *may_be_zero : str
        Names of arguments that may be 0.

    Raises
    ------
    ValueError
        Naming the first argument that is wrong.
    """
    for field in fields(measure):
        value = getattr(measure, field.name)
        if not (field.name in may_be_zero and value == 0.0):
            positive(f"{type(measure).__name__} {field.name}", value)

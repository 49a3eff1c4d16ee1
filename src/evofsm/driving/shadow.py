"""What a guard would have said of a drive that was recorded."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.driving.framework import Decision, Drive
from evofsm.driving.worlds.motion import (
    COMMANDED,
    GAP,
    GAP_BEHIND,
    LEADER_ACCELERATION,
    LEADER_SPEED,
    REALISED,
    RUN_COLUMNS,
    SPEED,
)
from evofsm.driving.worlds.road import Episode
from evofsm.guard import Guard, Mode, Proposal


def shadow_drive(
    guard: Guard,
    times: ArrayLike,
    observations: ArrayLike,
    accelerations: ArrayLike,
    *,
    failed: bool = False,
) -> Drive:
    """Let a guard in shadow mode decide on each row of one recorded episode, and learn from it.

    Parameters
    ----------
    guard : Guard
        For cars (`guard_for_cars`), in `Mode.SHADOW` or `Mode.OFF`: what was recorded cannot be
        changed any more.
    times : (T,) array_like
        Rising, as far apart as the guard's interval [s].
    observations : (T, 3) array_like
        Gap [m], speed of the follower and of the leader [m/s].
    accelerations : (T,) array_like
        What the follower did after each row [m/s²]; that of the last row is not read.
    failed : bool
        Whether the episode ended in failure; a last gap of 0 or less is one anyway.

    Returns
    -------
    Drive
        With a decision for each row but the last, in which what was done stands as the proposal,
        and what the guard would have done as ``advised``.

    Raises
    ------
    ValueError
        If the guard would act, there are fewer than two rows, or the shapes do not fit.

    Examples
    --------
    >>> from evofsm.driving import guard_for_cars
    >>> guard = guard_for_cars(low=-8.0, high=3.0, interval=0.1, mode=Mode.SHADOW)
    >>> rows = [[40.0, 20.0, 20.0], [39.9, 20.0, 19.0], [39.7, 20.0, 18.0]]
    >>> drive = shadow_drive(guard, [0.0, 0.1, 0.2], rows, [0.0, 0.0, 0.0])
    >>> len(drive.decisions), drive.executed.tolist()
    (2, [0.0, 0.0])
    """
    mode = getattr(guard.reviser, "mode", Mode.ACT)
    if mode not in (Mode.SHADOW, Mode.OFF):
        raise ValueError(f"the guard's mode is {mode.value}; what was recorded needs shadow or off")
    time, seen = np.asarray(times, np.float64), np.asarray(observations, np.float64)
    did = np.asarray(accelerations, np.float64)
    if len(time) < 2 or seen.shape != (len(time), 3) or did.shape != time.shape:
        raise ValueError(
            f"times, observations and accelerations have the shapes {time.shape}, {seen.shape} and "
            f"{did.shape}; they must be (T,), (T, 3) and (T,), with T of 2 or more"
        )
    record = _record(time, seen, did)
    guard.begin()
    decisions = []
    for row in range(len(time) - 1):
        situation = guard.recognise(seen[row], float(time[row]))
        revision = guard.revise(situation, Proposal(float(did[row])))
        decisions.append(Decision(situation, revision, float(record[row, REALISED])))
    guard.end(failed or bool(seen[-1, 0] <= 0.0), seen[-1])
    return Drive(Episode(time, record), tuple(decisions))


def _record(
    time: NDArray[np.float64], seen: NDArray[np.float64], did: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The rows of an episode without a car behind."""
    record = np.zeros((len(time), len(RUN_COLUMNS)))
    record[:, [GAP, SPEED, LEADER_SPEED]] = seen
    record[:, GAP_BEHIND] = np.inf
    steps = np.diff(time)
    record[:-1, COMMANDED] = did[:-1]
    record[:-1, REALISED] = np.diff(seen[:, 1]) / steps
    record[:-1, LEADER_ACCELERATION] = np.diff(seen[:, 2]) / steps
    return record

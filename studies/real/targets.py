"""What is to be foretold, and at which decisions it came within a horizon."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import measures
from studies.datasets.episodes import Episode

#: Slower than this a short time to collision is mostly creeping to a stop [m/s].
CREEPING = 5.0


@dataclass(frozen=True)
class Target:
    """An event: a time to collision below a threshold, or braking beyond one.

    Parameters
    ----------
    name : str
    time : float, optional
        It happens where the time to collision is below this [s] and the follower drives faster
        than `CREEPING`.
    braking : float, optional
        It happens where the follower brakes harder than this [m/s²]; then ``time`` is not used.
    """

    name: str
    time: float = 0.0
    braking: float = 0.0

    @property
    def title(self) -> str:
        """In words."""
        if self.braking > 0.0:
            return f"the follower brakes harder than {self.braking:g} m/s²"
        return f"time to collision below {self.time:g} s"

    def happens(self, episode: Episode) -> NDArray[np.bool_]:
        """(T,) ndarray: whether it happens in each row."""
        if self.braking > 0.0:
            return np.asarray(episode.accelerations < -self.braking)
        seen = episode.observations
        return (measures.time_to_collision(seen) < self.time) & (seen[:, 1] > CREEPING)


#: In the order in which they are reported.
TARGETS = (
    Target("ttc-3", time=3.0),
    Target("ttc-2", time=2.0),
    Target("ttc-1.5", time=1.5),
    Target("braking-3", braking=3.0),
)


#: What happens, in words, by the name of the target.
TITLES = {target.name: target.title for target in TARGETS}


class Coming(NamedTuple):
    """Whether an event came within a horizon after each row."""

    came: NDArray[np.bool_]  #: (T,)
    known: NDArray[np.bool_]  #: (T,) False where it is happening already, or the episode ends first


def coming(happens: NDArray[np.bool_], steps: int) -> Coming:
    """Look ahead from each row, that row itself left out.

    Parameters
    ----------
    happens : (T,) ndarray of bool
        Whether the event happens in each row.
    steps : int
        How many rows are looked ahead.

    Examples
    --------
    >>> came, known = coming(np.array([False, False, True, False, False]), steps=2)
    >>> came.tolist(), known.tolist()
    ([True, True, False, False, False], [True, True, False, False, False])
    """
    rows = len(happens)
    so_far = np.append(0, np.cumsum(happens))
    row = np.arange(rows)
    last = np.minimum(row + steps, rows - 1)
    came = so_far[last + 1] > so_far[row + 1]
    return Coming(came, (came | (row + steps < rows)) & ~happens)


def onsets(happens: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rows in which an event begins; one that an episode begins with has no beginning."""
    return np.flatnonzero(happens[1:] & ~happens[:-1]) + 1

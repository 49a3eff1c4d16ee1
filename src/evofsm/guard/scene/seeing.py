"""What is observed of a scene: oneself and a set of objects, in whatever order they come."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm import whole

_Floats = NDArray[np.float64]


class Seen(NamedTuple):
    """A scene at one time, of k objects."""

    own: _Floats  #: (p + q,) place, then all else
    away: _Floats  #: (k, p) places of the objects, relative to one's own
    other: _Floats  #: (k, q) all else of them, not relative


@dataclass(frozen=True)
class Layout:
    """How an observation is made of rows.

    Parameters
    ----------
    columns : int
        Numbers in a row. The first is above 0.5 where the row is in use; the first row is oneself,
        each other one an object.
    place : sequence of int
        Columns that say where something is.
    relative : bool
        Whether rows of objects are relative to oneself in all columns but the first.

    Raises
    ------
    ValueError
        If columns of the place are not among those after the first, or all of them are.
    """

    columns: int
    place: tuple[int, ...] = (1, 2)
    relative: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns", whole("columns", self.columns))
        object.__setattr__(self, "place", tuple(int(column) for column in self.place))
        among = set(range(1, self.columns))
        if not 0 < len(set(self.place)) == len(self.place) < len(among) or set(self.place) - among:
            raise ValueError(
                f"place is {self.place}; it must name some, not all, of the columns from 1 to "
                f"{self.columns - 1}, each once"
            )

    @property
    def rest(self) -> list[int]:
        """Columns of all else."""
        return [column for column in range(1, self.columns) if column not in self.place]

    def read(self, observation: Sequence[float] | _Floats) -> Seen:
        """What an observation shows; a row with a missing number (NaN) is not in use.

        Raises
        ------
        ValueError
            If it is no whole number of rows, or has none.

        Examples
        --------
        >>> rows = [1.0, 10.0, 4.0, 20.0, 1.0, 15.0, 0.0, -2.0, 0.0, 0.0, 0.0, 0.0]
        >>> Layout(4).read(rows)
        Seen(own=array([10.,  4., 20.]), away=array([[15.,  0.]]), other=array([[18.]]))
        """
        rows = np.asarray(observation, np.float64)
        if not rows.size or rows.size % self.columns:
            raise ValueError(f"{rows.size} numbers are no rows of {self.columns}")
        rows = rows.reshape(-1, self.columns)
        place, rest = list(self.place), self.rest
        own, objects = rows[0], rows[1:]
        objects = objects[(objects[:, 0] > 0.5) & np.isfinite(objects).all(1)]
        away, other = objects[:, place], objects[:, rest]
        if self.relative:
            other = other + own[rest]
        else:
            away = away - own[place]
        return Seen(np.concatenate([own[place], own[rest]]), away, other)

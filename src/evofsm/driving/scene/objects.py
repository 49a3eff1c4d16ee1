"""A scene: oneself and the objects around, and which of them one may meet, as pairs.

Every pair is one car behind another, with a gap and two speeds, as every measure of this room takes
it; what differs is whose bumper it is, and who can do something about it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.fsm import real_array

#: What a row of a scene holds; the first is 1 where the row is in use.
COLUMNS = ("present", "x", "y", "vx", "vy", "length", "width")

# Who will be in one's path within this time at the present lateral speed cuts in, or crosses [s].
_AHEAD = 2.0


class Object(NamedTuple):
    """Something on the road, along which x is counted.

    Examples
    --------
    >>> lorry = Object("lorry", x=40.0, y=0.0, vx=20.0, length=12.0)
    >>> lorry.x - 0.5 * lorry.length  # its rear bumper
    34.0
    """

    id: str
    x: float  #: of its centre, along the road [m]
    y: float  #: of its centre, to the left [m]
    vx: float  #: [m/s]
    vy: float = 0.0  #: [m/s]
    length: float = 5.0  #: along its heading [m]
    width: float = 1.8  #: [m]
    lane: str | None = None  #: for people; who is in whose way is told from y


class Role(Enum):
    """Where the other one of a pair is."""

    AHEAD = "ahead"
    CUTTING_IN = "cutting in"
    CROSSING = "crossing"
    BEHIND = "behind"  #: it follows, and oneself is its leader


class Pair(NamedTuple):
    """Two that may meet if neither does anything about it."""

    role: Role
    number: int  #: of the object in its scene; 0 is oneself
    gap: float  #: from bumper to bumper [m]; 0 or less where they touch
    v_follower: float  #: [m/s]
    v_leader: float  #: [m/s]

    @property
    def observation(self) -> NDArray[np.float64]:
        """(3,) ndarray: gap [m], speed of the follower and of the leader [m/s]."""
        return np.array([self.gap, self.v_follower, self.v_leader])


class Scene:
    """Oneself and the objects around.

    Parameters
    ----------
    own : Object
    others : sequence of Object

    Examples
    --------
    >>> own = Object("me", x=0.0, y=0.0, vx=25.0)
    >>> slow = Object("lorry", x=40.0, y=0.0, vx=20.0, length=12.0)
    >>> fast = Object("van", x=-20.0, y=0.0, vx=30.0)
    >>> far = Object("bus", x=0.0, y=3.5, vx=20.0)  # in the lane beside
    >>> scene = Scene(own, [slow, fast, far])
    >>> for pair in scene.pairs():
    ...     print(scene.objects[pair.number].id, pair.role.value, pair.gap)
    van behind 15.0
    lorry ahead 31.5
    """

    def __init__(self, own: Object, others: Sequence[Object] = ()) -> None:
        #: Oneself, then the others, the closest along the road first.
        self.objects = (own, *sorted(others, key=lambda each: abs(each.x - own.x)))

    def pairs(self) -> list[Pair]:
        """With whom one may meet, the closest first."""
        return pairs_of(self.rows(len(self.objects) - 1))

    def rows(self, most: int) -> NDArray[np.float64]:
        """The scene as an observation, for a guard.

        Parameters
        ----------
        most : int
            Number of objects that it has room for; of more the closest along the road stay.

        Returns
        -------
        ((most + 1) * 7,) ndarray
            A row of `COLUMNS` for each of `objects`, oneself first; zeros where there is none.
        """
        rows = np.zeros((most + 1, len(COLUMNS)))
        for row, each in zip(rows, self.objects, strict=False):
            row[:] = 1.0, *each[1:7]
        return rows.ravel()


def pairs_of(rows: ArrayLike) -> list[Pair]:
    """With whom one may meet, told from a scene's `rows`; the closest first.

    An object is in one's lane where their sides overlap; it cuts in, or crosses if it moves across
    more than along the road, where they will within 2 s. Rows that hold NaN are left out.

    Raises
    ------
    ValueError
        If these are no rows of seven numbers.

    Examples
    --------
    >>> pairs_of([1, 0, 0, 25, 0, 5, 2] + [1, 30, 3, 20, -1, 5, 2])[0].role
    <Role.CUTTING_IN: 'cutting in'>
    """
    flat = real_array("rows", rows, 1)
    if len(flat) % len(COLUMNS):
        raise ValueError(f"{len(flat)} numbers are no rows of {len(COLUMNS)}: {', '.join(COLUMNS)}")
    own, *others = flat.reshape(-1, len(COLUMNS)).tolist()
    found = []
    for index, other in enumerate(others, start=1):
        if other[0] > 0.5 and not math.isnan(sum(other)):
            pair = _pair(own, other, index)
            if pair is not None:
                found.append(pair)
    return sorted(found, key=lambda pair: pair.gap)


def _pair(own: list[float], other: list[float], index: int) -> Pair | None:
    _, x, y, vx, vy, length, width = other
    apart, beside = x - own[1], y - own[2]
    crosses = abs(vy) > abs(vx)
    along, across = (width, length) if crosses else (length, width)
    free = abs(beside) - 0.5 * (own[6] + across)  # between the sides
    closing = (own[4] - vy) * math.copysign(1.0, beside)
    if free >= max(0.0, closing * _AHEAD):  # not in one's path, nor soon
        return None
    gap = abs(apart) - 0.5 * (own[5] + along)
    if apart < 0.0:
        # Who moves across behind is none of one's business.
        return None if crosses else Pair(Role.BEHIND, index, gap, vx, own[3])
    role = Role.AHEAD if free < 0.0 else Role.CUTTING_IN
    return Pair(Role.CROSSING if crosses else role, index, gap, own[3], max(vx, 0.0))

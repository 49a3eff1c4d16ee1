"""Pairs from tables of objects: where everybody is at each time, and on which lane.

A row is an object at one time: ``id``, ``t`` [s], ``x`` and ``y`` of the middle of its box [m],
``vx`` and ``vy`` [m/s], ``length`` [m], ``lane``; rows of one time stand together. ``heading``
[rad] may say where it points; without it, it points where it moves, and where it stands, where it
moved last. One without a lane follows nobody, and is followed by nobody.

The leader of a vehicle is the nearest one on its lane that is ahead of it. The gap is the distance
between the middles, in a straight line, less half of both lengths: where a lane bends, it is a
little too small.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.io.following import Following, Moment
from evofsm.io.tables import Table

#: The columns that a table of objects has, and by which it is known.
COLUMNS = ("id", "t", "x", "y", "vx", "vy", "length", "lane")
HEADING = "heading"

_NUMBERS = ("t", "x", "y", "vx", "vy", "length")
# Whoever is slower [m/s] points where it pointed before.
_STANDING = 0.1
# On one lane at one time; beyond it the file is no recording of a road.
_MOST_ON_A_LANE = 1000
# Whose direction is remembered.
_MOST_OBJECTS = 1_000_000


class Object(NamedTuple):
    """A vehicle at one time."""

    id: str
    lane: str  #: empty where none is known
    x: float  #: of the middle of its box [m]
    y: float  #: [m]
    vx: float  #: [m/s]
    vy: float  #: [m/s]
    length: float  #: [m]
    heading: float  #: where it points, from the x axis [rad]; NaN where it is not known


class Scene(NamedTuple):
    """All objects at one time."""

    time: float  #: [s]
    place: str  #: where it stands, for a message
    objects: list[Object]


def holds_objects(columns: Sequence[str]) -> bool:
    """Whether these are the columns of a table of objects."""
    return set(COLUMNS) <= set(columns)


def scenes_of(table: Table) -> Iterator[Scene]:
    """Read a table, scene by scene.

    Raises
    ------
    ValueError
        If a length is not positive; the message names the row.
    """
    may_lack = [HEADING] if HEADING in table.columns else []
    present: Scene | None = None
    for piece in table.pieces([*_NUMBERS, *may_lack], ["id", "lane"], gaps=may_lack):
        columns = [piece.numbers[name].tolist() for name in _NUMBERS]
        headings = piece.numbers.get(HEADING, np.full(len(piece.places), np.nan)).tolist()
        rows = zip(piece.texts["id"], piece.texts["lane"], *columns, headings, strict=True)
        for row, (name, lane, time, x, y, vx, vy, length, heading) in enumerate(rows):
            if not length > 0.0:
                raise ValueError(f"{piece.at(row)}: the length is {length:g}; it must be positive")
            if present is None or time != present.time:
                if present is not None:
                    yield present
                present = Scene(time, piece.at(row), [])
            present.objects.append(Object(name, lane, x, y, vx, vy, length, heading))
    if present is not None:
        yield present


def pairs_of_scenes(path: str, scenes: Iterable[Scene]) -> Iterator[Moment]:
    """At each time, the vehicles of which one follows the other.

    Raises
    ------
    ValueError
        If no object is on a lane, two of one time have one name, or a lane holds too many.

    Examples
    --------
    >>> ego = Object("ego", "1", 0.0, 0.0, 20.0, 0.0, 4.0, np.nan)
    >>> other = ego._replace(id="other", x=30.0, vx=18.0, length=6.0)
    >>> next(pairs_of_scenes("drive.csv", [Scene(0.0, "", [ego, other])])).pairs
    [Following(who=('1', 'ego', 'other'), gap=25.0, v_follower=20.0, v_leader=18.0)]
    """
    pointed: dict[str, float] = {}
    has_lanes = False
    for scene in scenes:
        lanes: defaultdict[str, list[Object]] = defaultdict(list)
        names = set[str]()
        for one in scene.objects:
            if one.id in names:
                raise ValueError(
                    f"{scene.place}: {one.id[:40]!r} is there twice at {scene.time:g} s (several "
                    "recordings in one file?)"
                )
            names.add(one.id)
            if one.lane:
                lanes[one.lane].append(_pointing(one, pointed))
        has_lanes = has_lanes or bool(lanes)
        pairs = [pair for lane in lanes.values() for pair in _following(scene, lane)]
        yield Moment(scene.time, scene.place, pairs)
    if not has_lanes:
        raise ValueError(
            f"{path}: no object is on a lane, and who follows whom is told by lanes (recorded "
            "without a map? assign the lanes first)"
        )


def _pointing(one: Object, pointed: dict[str, float]) -> Object:
    """The same object with a heading, if it is known from now or before."""
    heading = one.heading if np.isfinite(one.heading) else np.nan
    if np.isnan(heading) and np.hypot(one.vx, one.vy) >= _STANDING:
        heading = float(np.arctan2(one.vy, one.vx))
    if np.isnan(heading):
        heading = pointed.get(one.id, np.nan)
    elif one.id in pointed or len(pointed) < _MOST_OBJECTS:
        pointed[one.id] = heading
    return one._replace(heading=heading)


def _following(scene: Scene, lane: Sequence[Object]) -> Iterator[Following]:
    """Each vehicle of a lane and the nearest one ahead of it."""
    if len(lane) > _MOST_ON_A_LANE:
        raise ValueError(
            f"{scene.place}: {len(lane):,} objects on the lane {lane[0].lane[:40]!r} at one time "
            "(rows not sorted by time, or the clock of a coarse step?)"
        )
    if len(lane) == 1:
        return
    apart = _distances(lane)
    nearest = apart.argmin(axis=1)
    for i, (follower, j) in enumerate(zip(lane, nearest.tolist(), strict=True)):
        leader = lane[j]
        if np.isfinite(apart[i, j]):
            yield Following(
                (follower.lane, follower.id, leader.id),
                float(apart[i, j]) - 0.5 * (follower.length + leader.length),
                float(np.hypot(follower.vx, follower.vy)),
                float(np.hypot(leader.vx, leader.vy)),
            )


def _distances(lane: Sequence[Object]) -> NDArray[np.float64]:
    """From each to each that is ahead of it; infinite to others, and where nobody knows."""
    places = np.array([(one.x, one.y) for one in lane])
    headings = np.array([one.heading for one in lane])
    ways = places[None, :, :] - places[:, None, :]
    along = ways[..., 0] * np.cos(headings)[:, None] + ways[..., 1] * np.sin(headings)[:, None]
    return np.where(along > 0.0, np.hypot(ways[..., 0], ways[..., 1]), np.inf)

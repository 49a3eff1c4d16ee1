"""Who follows whom in recordings of many vehicles: SUMO's FCD, tables of objects, ASAM OSI.

A pair is a vehicle and the next one ahead of it on the same lane. Its episode lasts for as long as
the two stay a pair from one time to the next; a leader beyond the end of the lane is not seen.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, groupby, pairwise
from operator import itemgetter
from typing import Any, NamedTuple, NoReturn
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.naming import VARIABLES
from evofsm.extras import needs
from evofsm.io.tables import OnRead, Piece, Source, Table, Wanted, explained
from evofsm.store import LARGEST_OBSERVATION

#: The action of a pair of vehicles: what the follower did until the next time.
ACTION = "a_follower"
#: What is known of a pair at one time.
COLUMNS = ("time", *VARIABLES, ACTION)

_ROWS_AT_ONCE = 8192
# Rows that pairs on the road may have waiting before all are handed on, each of 32 bytes. It
# bounds memory, at the price of one transition for each pair cut.
_MOST_WAITING = 1_000_000
# More on one lane at one time are no recording of a road, and would fill the memory.
_MOST_ON_A_LANE = 1000

#: Says where something stands, for a message.
Place = Callable[[], str]


class Following(NamedTuple):
    """A vehicle and the one that it follows, at one time."""

    who: tuple[str, str, str]  #: lane, follower, leader
    gap: float  #: bumper to bumper [m]
    v_follower: float  #: [m/s]
    v_leader: float  #: [m/s]


class Moment(NamedTuple):
    """All pairs that there are at one time."""

    time: float  #: [s]
    place: Place
    pairs: Sequence[Following]


class PairTable(Table):
    """The pairs of a file, as a table with a row for each pair and time; episodes end to end."""

    columns = COLUMNS

    def __init__(self, path: str, moments: Iterable[Moment]) -> None:
        self.path = path
        self._moments = moments

    def pieces(self, wanted: Wanted) -> Iterator[Piece]:
        """All columns, whichever are wanted."""
        before, starts, waiting, names = 0, [0], list[NDArray[np.float64]](), list[str]()
        for (_, follower, leader), rows in chain(self._episodes(), [(("", "", ""), None)]):
            if rows is not None:
                waiting.append(rows)
                names.append(f"{follower} behind {leader}")
                starts.append(starts[-1] + len(rows))
            if waiting and (rows is None or starts[-1] >= _ROWS_AT_ONCE):
                numbers = dict(zip(COLUMNS, np.concatenate(waiting).T, strict=True))
                yield Piece.of_numbers(self.path, before, numbers, starts[:-1], names)
                before, starts, waiting, names = before + starts[-1], [0], [], []
        if before == 0:
            raise ValueError(f"{self.path}: no vehicle ever follows another one on the same lane")

    def _episodes(self) -> Iterator[tuple[tuple[str, str, str], NDArray[np.float64] | None]]:
        """Rows of a pair for as long as it stays one, or until too many wait."""
        open_pairs: dict[tuple[str, str, str], array[float]] = {}
        waiting, before = 0, -math.inf
        for moment in self._moments:
            if not moment.time > before:
                raise ValueError(
                    f"{moment.place()}: time goes from {before:g} to {moment.time:g}; it must run "
                    "forward (rows not sorted by time, or two recordings in one file?)"
                )
            before = moment.time
            present: dict[tuple[str, str, str], array[float]] = {}
            for pair in moment.pairs:
                rows = open_pairs.pop(pair.who, None) or array("d")
                rows.extend((moment.time, pair.gap, pair.v_follower, pair.v_leader))
                present[pair.who] = rows
            waiting += len(moment.pairs)
            for who, rows in open_pairs.items():
                waiting -= len(rows) // 4
                yield who, _with_actions(rows)
            open_pairs = present
            if waiting > _MOST_WAITING:
                yield from ((who, _with_actions(rows)) for who, rows in open_pairs.items())
                open_pairs, waiting = {}, 0
        yield from ((who, _with_actions(rows)) for who, rows in open_pairs.items())


def _with_actions(rows: array[float]) -> NDArray[np.float64]:
    """(T, 5) `COLUMNS`; the action is NaN in the last row, and where it is beyond any number."""
    table = np.array(rows).reshape(-1, 4)
    with np.errstate(over="ignore"):
        actions = np.append(np.diff(table[:, 2]) / np.diff(table[:, 0]), np.nan)
    actions[np.isinf(actions)] = np.nan
    return np.column_stack([table, actions])


# -- FCD ------------------------------------------------------------------------------------------

#: The column by which an FCD table is known.
FCD_TIME = "timestep_time"

_BYTES_AT_ONCE = 1 << 16
# SUMO writes neither longer tags or comments [byte] nor more tags within tags.
_LONGEST_TAG, _DEEPEST = 1_000_000, 16


@dataclass
class VehicleLengths:
    """Lengths assumed for vehicles in SUMO's FCD, which holds none, by their type.

    Parameters
    ----------
    default : float
        Length of a type not named [m]; 5 m is SUMO's passenger car.
    by_type : dict
        Lengths of single types [m].
    """

    default: float = 5.0
    by_type: dict[str, float] = field(default_factory=dict)
    seen: set[str] = field(default_factory=set, init=False)  #: types met so far

    def of(self, kind: str) -> float:
        """Length of a vehicle of the given type [m]."""
        kind = kind.partition("@")[0]  # a vehicle changed on its own has the type `car@id`
        self.seen.add(kind)
        return self.by_type.get(kind, self.default)

    def refuse_unknown(self) -> None:
        """Raise if a length was given for a type that no leader had: most likely a slip."""
        for kind in self.by_type:
            if kind not in self.seen:
                raise ValueError(
                    f"no leading vehicle has the type {kind!r} of --vehicle-length; the types "
                    f"are {', '.join(sorted(self.seen)) or 'not in the file'}"
                )

    def __str__(self) -> str:
        named = [f"{kind} {length:g} m" for kind, length in self.by_type.items()]
        return ", ".join([*named, f"{'others ' if named else ''}{self.default:g} m"])


# Texts of a vehicle, or without a lane of a time at which there may be none: where it stands, time
# [s] and number of the timestep, id, lane, position of the front bumper along it [m], speed [m/s],
# type.
_FcdRow = tuple[Place, tuple[float, int], str | None, str, str | None, str | None, str]


def pairs_of_fcd(path: str, rows: Iterable[_FcdRow], lengths: VehicleLengths) -> Iterator[Moment]:
    """At each time, the vehicles of which one follows the other."""
    has_vehicles = False
    for (time, _), of_time in groupby(rows, key=itemgetter(1)):
        vehicles, places = list[tuple[str, float, str, str, float]](), list[Place]()
        for place, _, name, lane, position, speed, kind in of_time:
            places = places or [place]
            if not lane:  # persons, empty timesteps and vehicles off the road have none
                continue
            if name is None:
                _refuse_lack(place(), "id")
            along, v = _number(place, "pos", position), _number(place, "speed", speed)
            vehicles.append((lane, along, name, kind, v))
        has_vehicles = has_vehicles or bool(vehicles)
        pairs = [
            Following((a[0], a[2], b[2]), b[1] - lengths.of(b[3]) - a[1], a[4], b[4])
            for a, b in pairwise(sorted(vehicles))
            if a[0] == b[0]
        ]
        yield Moment(time, places[0], pairs)
    if not has_vehicles:
        raise ValueError(
            f"{path} holds no vehicle on a lane (an empty simulation, or persons only?)"
        )


def fcd_of_xml(path: str, on_read: OnRead) -> Iterator[_FcdRow]:
    """Read FCD in XML, with a parser that keeps nothing and knows its line."""
    reader = _FcdReader(path)
    with Source(path, on_read) as source:
        while data := source.read(_BYTES_AT_ONCE):
            yield from reader.feed(data)
        yield from reader.feed(b"", last=True)


class _FcdReader:
    def __init__(self, path: str) -> None:
        self._path = path
        # Told the encoding, it asks no codec for the one that a file names: SUMO writes UTF-8.
        parser = self._parser = expat.ParserCreate("utf-8")
        self._fed = self._depth = 0
        self._lanes_seen, self._without = False, ""  # and where a vehicle had none
        self._time = (math.nan, 0)
        self._rows: list[_FcdRow] = []
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        # Entities could grow without end, or be read from elsewhere.
        parser.StartDoctypeDeclHandler = self._refuse_doctype

    def feed(self, data: bytes, last: bool = False) -> list[_FcdRow]:
        """Parse more of the file; returns the rows that began in it."""
        try:
            self._parser.Parse(data, last)
        except expat.ExpatError as error:
            raise ValueError(
                f"{self._path}, line {error.lineno}: this XML is cut off or damaged: "
                f"{expat.ErrorString(error.code)} (was SUMO or a copy interrupted?)"
            ) from error
        self._fed += len(data)
        if self._fed - self._parser.CurrentByteIndex > _LONGEST_TAG:
            self._refuse(f"a tag or comment of more than {_LONGEST_TAG:,} bytes begins here")
        if last and self._without and not self._lanes_seen:
            _refuse_lack(self._without, "lane")
        rows, self._rows = self._rows, []
        return rows

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth > _DEEPEST:
            self._refuse(f"there are more than {_DEEPEST} tags within each other")
        if self._depth == 1 and name != "fcd-export":
            raise ValueError(
                f"{self._path} is XML but not SUMO's FCD output: it begins with <{name[:40]}> "
                "instead of <fcd-export> (written with another option than --fcd-output?)"
            )
        if name not in ("timestep", "vehicle"):
            return
        place = partial("{}, line {}".format, self._path, self._parser.CurrentLineNumber)
        if name == "timestep":
            self._time = _number(place, "time", attributes.get("time")), self._time[1] + 1
            self._rows.append((place, self._time, None, "", None, None, ""))
            return
        lane = attributes.get("lane")
        if lane is None and not self._without:
            self._without = place()
        self._lanes_seen = self._lanes_seen or bool(lane)
        who, along, speed = (attributes.get(name) for name in ("id", "pos", "speed"))
        kind = attributes.get("type", "")
        self._rows.append((place, self._time, who, lane or "", along, speed, kind))

    def _end(self, name: str) -> None:
        self._depth -= 1

    def _refuse_doctype(self, name: str, *_: object) -> None:
        self._refuse(f"there is a <!DOCTYPE {name[:40]}>, and entities are not read")

    def _refuse(self, why: str) -> NoReturn:
        raise ValueError(
            f"{self._path}, line {self._parser.CurrentLineNumber}: {why}; SUMO writes no such "
            "thing (is this another program's file?)"
        )


def fcd_of_table(table: Table) -> Iterator[_FcdRow]:
    """Read FCD in CSV or Parquet: a row per vehicle, consecutive rows of a time together."""
    if list(table.columns) == [FCD_TIME]:  # all that SUMO writes of an empty road
        return
    # SUMO names the columns after what it writes first, be it a person.
    prefix = "person" if "person_id" in table.columns else "vehicle"
    names = [f"{prefix}_{name}" for name in ("id", "lane", "pos", "speed")]
    for name in names:
        if name not in table.columns:
            _refuse_lack(table.path, name)
    kinds = [name for name in [f"{prefix}_type"] if name in table.columns]
    for place, time, name, lane, along, speed, *kind in _rows(
        table, Wanted([FCD_TIME], [*names, *kinds])
    ):
        yield place, (time, 0), name, lane, along, speed, kind[0] if kind else ""


def _rows(table: Table, wanted: Wanted) -> Iterator[tuple[Any, ...]]:
    """Place, numbers and texts of each row."""
    for piece in table.pieces(wanted):
        columns = [piece.numbers[name].tolist() for name in wanted.numbers]
        columns += [piece.texts[name].to_list() for name in wanted.texts]
        for row, values in enumerate(zip(*columns, strict=True)):
            yield partial(piece.at, row), *values


def _number(place: Place, name: str, text: str | None) -> float:
    if text is None:
        _refuse_lack(place(), name)
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not abs(number) <= LARGEST_OBSERVATION:
        is_clock = name == "time" and ":" in text
        why = f"{text[:40]!r} is no number (written with --human-readable-time?)"
        raise ValueError(f"{place()}, {name}: {why if is_clock else explained(text)}")
    return number


def _refuse_lack(place: str, name: str) -> NoReturn:
    raise ValueError(
        f"{place}: there is no {name!r}; SUMO writes it unless --fcd-output.attributes leaves it "
        "out (id,lane,pos,speed,type are needed)"
    )


# -- Objects --------------------------------------------------------------------------------------

#: The columns that a table of objects has, and by which it is known. ``x`` and ``y`` are of the
#: middle of the box; units are those of the SI.
OBJECT_COLUMNS = ("id", "t", "x", "y", "vx", "vy", "length", "lane")
_HEADING = "heading"
# Whoever is slower [m/s] points where it pointed before.
_STANDING = 0.1


class Object(NamedTuple):
    """A vehicle at one time."""

    id: str
    lane: str
    x: float  #: of the middle of its box [m]
    y: float  #: [m]
    vx: float  #: [m/s]
    vy: float  #: [m/s]
    length: float  #: [m]
    #: Where it points, from the x axis [rad]; where it is NaN, it points where it moves or, where
    #: it stands, where it moved last.
    heading: float


class Scene(NamedTuple):
    """All objects at one time."""

    time: float  #: [s]
    place: Place
    objects: list[Object]


def scenes_of_table(table: Table) -> Iterator[Scene]:
    """Read a table of objects, whose rows of one time stand together."""
    headings = [_HEADING] if _HEADING in table.columns else []
    numbers = ["x", "y", "vx", "vy", "length"]
    wanted = Wanted(["t", *numbers, *headings], ["id", "lane"], [*numbers, *headings])
    for time, of_time in groupby(_rows(table, wanted), key=itemgetter(1)):
        objects, places = list[Object](), list[Place]()
        for place, _, x, y, vx, vy, length, *heading, name, lane in of_time:
            places = places or [place]
            if not lane:  # whoever follows nobody may lack anything
                continue
            for column, value in zip(numbers, (x, y, vx, vy, length), strict=True):
                if not abs(value) <= LARGEST_OBSERVATION:
                    raise ValueError(f"{place()}, column {column!r}: {explained(f'{value:g}')}")
            if not length > 0.0:
                raise ValueError(f"{place()}: the length is {length:g}; it must be positive")
            objects.append(Object(name, lane, x, y, vx, vy, length, *(heading or [math.nan])))
        yield Scene(time, places[0], objects)


def pairs_of_scenes(path: str, scenes: Iterable[Scene]) -> Iterator[Moment]:
    """At each time, each vehicle and the nearest one ahead of it on its lane.

    The gap is the distance between the middles, in a straight line, less half of both lengths:
    where a lane bends, it is a little too small.
    """
    pointed: dict[str, float] = {}
    has_lanes = False
    for scene in scenes:
        lanes: defaultdict[str, list[Object]] = defaultdict(list)
        names = set[str]()
        for one in scene.objects:
            if one.id in names:
                raise ValueError(
                    f"{scene.place()}: {one.id[:40]!r} is there twice at {scene.time:g} s (several "
                    "recordings in one file?)"
                )
            names.add(one.id)
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
    heading = one.heading if math.isfinite(one.heading) else math.nan
    if math.isnan(heading) and math.hypot(one.vx, one.vy) >= _STANDING:
        heading = math.atan2(one.vy, one.vx)
    if math.isnan(heading):
        heading = pointed.get(one.id, math.nan)
    else:
        pointed[one.id] = heading
    return one._replace(heading=heading)


def _following(scene: Scene, lane: Sequence[Object]) -> Iterator[Following]:
    if len(lane) > _MOST_ON_A_LANE:
        raise ValueError(
            f"{scene.place()}: {len(lane):,} objects on the lane {lane[0].lane[:40]!r} at one time "
            "(rows not sorted by time, or the clock of a coarse step?)"
        )
    if len(lane) == 1:
        return
    x, y, headings = np.array([(one.x, one.y, one.heading) for one in lane]).T
    dx, dy = x[None, :] - x[:, None], y[None, :] - y[:, None]
    along = dx * np.cos(headings)[:, None] + dy * np.sin(headings)[:, None]
    apart = np.where(along > 0.0, np.hypot(dx, dy), np.inf)  # of those that are ahead
    for follower, nearest, distance in zip(lane, apart.argmin(1), apart.min(1), strict=True):
        leader = lane[int(nearest)]
        if np.isfinite(distance):
            yield Following(
                (follower.lane, follower.id, leader.id),
                float(distance) - 0.5 * (follower.length + leader.length),
                math.hypot(follower.vx, follower.vy),
                math.hypot(leader.vx, leader.vy),
            )


# -- ASAM OSI -------------------------------------------------------------------------------------

_MOST_BYTES = 1 << 28  # of a message; one of a sensor with images has a few million
_LENGTH = struct.Struct("<I")


def scenes_of_osi(path: str, on_read: OnRead) -> Iterator[Scene]:
    """Read ground truth, or that within sensor views, from a ``.osi`` file, scene by scene."""
    osi = _osi(path)
    with Source(path, on_read) as source:
        is_view, number = False, 0
        while head := source.read(_LENGTH.size):
            number += 1
            size = _LENGTH.unpack(head)[0] if len(head) == _LENGTH.size else 0
            if size > _MOST_BYTES:
                raise ValueError(
                    f"{path}, message {number}: {size:,} bytes long by what stands before it; "
                    "this is no trace of OSI, or it is damaged there"
                )
            data = source.read(size)
            if len(head) < _LENGTH.size or len(data) < size:
                raise ValueError(
                    f"{path} ends within message {number} (was a copy or a simulation interrupted?)"
                )
            if number == 1:
                is_view = _is_view(osi, data)
            yield _scene(osi, f"{path}, message {number}", data, is_view)


def scenes_of_mcap(path: str, on_read: OnRead) -> Iterator[Scene]:
    """Read OSI in MCAP: the first channel of ground truth or of sensor views."""
    with needs("mcap", "mcap", f"{path}: MCAP"):
        from mcap.records import Channel, Message, Schema

        from evofsm.io.runs import records
    osi = _osi(path)
    kinds, channels = dict[int, str](), dict[int, str]()
    chosen, number = None, 0
    for record in records(path, _MOST_BYTES):
        if isinstance(record, Schema):
            kinds[record.id] = record.name.rpartition(".")[2]
        elif isinstance(record, Channel):
            channels[record.id] = kinds.get(record.schema_id, "")
        elif isinstance(record, Message):
            kind = channels.get(record.channel_id, "")
            if chosen is None and kind in ("GroundTruth", "SensorView"):
                chosen = record.channel_id
            if record.channel_id == chosen:
                number += 1
                on_read(len(record.data))
                place = f"{path}, message {number}"
                yield _scene(osi, place, record.data, kind == "SensorView")
    if chosen is None:
        names = ", ".join(sorted(set(kinds.values()))) or "none"
        raise ValueError(
            f"{path}: no channel of it holds GroundTruth or SensorView of OSI; its schemas are "
            f"{names} (if they are of ROS 2: the header names no profile, as after merging; "
            "ros2 bag convert writes it anew)"
        )


def _osi(path: str) -> Any:
    with needs("betterosi", "osi", f"{path}: ASAM OSI"):
        import betterosi
    return betterosi


def _is_view(osi: Any, data: bytes) -> bool:
    """Whether a message is a sensor view: the seventh field of ground truth is a traffic light."""
    try:
        truth = osi.SensorView.from_binary(data).global_ground_truth
        return truth is not None and truth.has_field("timestamp")
    except ValueError:
        return False


def _scene(osi: Any, place: str, data: bytes, is_view: bool) -> Scene:
    """The moving objects on lanes, but pedestrians and animals."""
    try:
        message = (osi.SensorView if is_view else osi.GroundTruth).from_binary(data)
    except ValueError as error:
        raise ValueError(
            f"{place} is not ground truth of OSI, nor a sensor view (damaged, or a trace of "
            f"another message?): {error}"
        ) from error
    truth = message.global_ground_truth if is_view else message
    stamp = (truth and truth.timestamp) or message.timestamp or osi.Timestamp()
    on_foot = (osi.MovingObject.Type.PEDESTRIAN, osi.MovingObject.Type.ANIMAL)
    objects = [
        _object(place, moving, lane)
        for moving in (truth.moving_object if truth else ())
        if moving.base and moving.type not in on_foot and (lane := _lane(moving))
    ]
    return Scene(stamp.seconds + 1e-9 * stamp.nanos, lambda: place, objects)


def _lane(moving: Any) -> str:
    """Where it is; empty where that is not known: it follows nobody, and nobody follows it."""
    classified = moving.moving_object_classification
    lanes = (classified and classified.assigned_lane_id) or moving.assigned_lane_id
    return str(lanes[0].value) if lanes else ""


def _object(place: str, moving: Any, lane: str) -> Object:
    base = moving.base
    name = str(moving.id.value) if moving.id else "without an id"
    x, y = (base.position.x, base.position.y) if base.position else (math.nan, math.nan)
    vx, vy = (base.velocity.x, base.velocity.y) if base.velocity else (math.nan, math.nan)
    length = base.dimension.length if base.dimension else math.nan
    largest = np.abs([x, y, vx, vy, length]).max()
    if not (largest <= LARGEST_OBSERVATION and length > 0.0):
        raise ValueError(
            f"{place}: object {name} is {length:g} m long, at ({x:g}, {y:g}) m, with "
            f"({vx:g}, {vy:g}) m/s; it needs a length, and numbers"
        )
    heading = base.orientation.yaw if base.orientation else math.nan
    return Object(name, lane, x, y, vx, vy, length, heading)

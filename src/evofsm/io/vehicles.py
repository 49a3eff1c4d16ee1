"""Who follows whom in recordings of many vehicles: SUMO's FCD, tables of objects, ASAM OSI.

A pair is a vehicle and the next one ahead of it on the same lane. Its episode lasts for as long as
the two stay a pair from one time to the next; a leader beyond the end of the lane is not seen.
"""

from __future__ import annotations

import cmath
import math
import struct
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from typing import Any, NamedTuple, NoReturn
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.naming import VARIABLES
from evofsm.extras import needs
from evofsm.io.tables import Piece, Skips, Source, Table, Wanted, explained, in_row, mcap_messages
from evofsm.store import LARGEST_OBSERVATION

ACTION = "a_follower"  #: of a pair of vehicles: what the follower did until the next time
COLUMNS = ("time", *VARIABLES, ACTION)  #: what is known of a pair at one time

_ROWS_AT_ONCE = 8192
# Rows that may wait before all are handed on, of 32 bytes each; a pair that is cut loses one step.
_MOST_WAITING = 1_000_000
_MOST_ON_A_LANE = 1000  # more at one time are no recording of a road, and fill the memory

Place = Callable[[], str]  #: says where something stands, for a message


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
    derives = True

    def __init__(self, path: str, moments: Iterable[Moment], skips: Skips) -> None:
        self.path, self.skips = path, skips
        self._moments = moments

    def pieces(self, wanted: Wanted) -> Iterator[Piece]:
        """All columns, whichever are wanted."""
        before, starts, blocks, names = 0, [0], list[NDArray[np.float64]](), list[str]()
        for (_, follower, leader), rows in chain(self._episodes(), [(("", "", ""), None)]):
            if rows is not None:
                blocks.append(_with_actions(rows))
                names.append(f"{follower} behind {leader}")
                starts.append(starts[-1] + len(blocks[-1]))
            if blocks and (rows is None or starts[-1] >= _ROWS_AT_ONCE):
                numbers = dict(zip(COLUMNS, np.concatenate(blocks).T, strict=True))
                find, begins = partial(in_row, self.path, numbers, before), starts[:-1]
                yield Piece(starts[-1], numbers, find, self.skips, starts=begins, names=names)
                before, starts, blocks, names = before + starts[-1], [0], [], []
        if before == 0:
            self.skips.refuse_nothing(
                f"{self.path}: no vehicle ever follows another one on the same lane"
            )

    def _episodes(self) -> Iterator[tuple[tuple[str, str, str], array[float] | None]]:
        """Rows of a pair for as long as it stays one, or until too many wait."""
        open_pairs: dict[tuple[str, str, str], array[float]] = {}
        before = -math.inf
        for moment in self._moments:
            if not moment.time > before:
                self.skips.leave_out(
                    "time",
                    f"{moment.place()}: time goes from {before:g} to {moment.time:g}; it must run "
                    "forward (rows not sorted by time, or two recordings in one file?)",
                )
                continue
            before = moment.time
            present: dict[tuple[str, str, str], array[float]] = {}
            for pair in moment.pairs:
                rows = open_pairs.pop(pair.who, None) or array("d")
                rows.extend((moment.time, pair.gap, pair.v_follower, pair.v_leader))
                present[pair.who] = rows
            yield from open_pairs.items()  # who has parted
            open_pairs = present
            if sum(map(len, present.values())) > 4 * _MOST_WAITING:
                yield from open_pairs.items()
                open_pairs = {}
        yield from open_pairs.items()


def _with_actions(rows: array[float]) -> NDArray[np.float64]:
    """(T, 5) `COLUMNS`; the action is NaN in the last row, and where it is beyond any number."""
    table = np.array(rows).reshape(-1, 4)
    with np.errstate(over="ignore"):
        actions = np.append(np.diff(table[:, 2]) / np.diff(table[:, 0]), np.nan)
    actions[np.isinf(actions)] = np.nan
    return np.column_stack([table, actions])


# -- FCD ------------------------------------------------------------------------------------------

#: Columns of FCD tables, whose names begin by what SUMO was told to (--output.column-header).
FCD_COLUMNS = ("timestep_time", "time", "id", "lane", "pos", "speed", "vehicle_id", "vehicle_lane")

_BYTES_AT_ONCE = 1 << 16
# SUMO writes neither longer tags or comments [byte] nor more tags within tags.
_LONGEST_TAG, _DEEPEST = 1_000_000, 16
# A vehicle as long and as wide as SUMO's passenger car [m], where nobody said.
_USUAL_LENGTH, _USUAL_WIDTH = 5.0, 1.8
# Who is less aside is in line; and who is that near may be beside by its place in the plane [m].
_IN_LINE, _BESIDE_WITHIN = 0.4, 20.0
# What the parser says where a file ends early.
_CUT = {expat.errors.XML_ERROR_NO_ELEMENTS, expat.errors.XML_ERROR_UNCLOSED_TOKEN}
_CUT |= {expat.errors.XML_ERROR_PARTIAL_CHAR}


@dataclass
class VehicleLengths:
    """Lengths assumed for vehicles in SUMO's FCD, which holds none, by their type; and widths.

    Parameters
    ----------
    lengths, widths : dict
        Of single types [m]; of others, under an empty name, those of SUMO's passenger car.
    """

    lengths: dict[str, float] = field(default_factory=lambda: {"": _USUAL_LENGTH})
    widths: dict[str, float] = field(default_factory=lambda: {"": _USUAL_WIDTH})
    seen: set[str] = field(default_factory=set, init=False)  #: types met so far
    #: Times that one of a type was not beside, but not in line either, where it overlaps.
    overlaps: Counter[str] = field(default_factory=Counter, init=False)

    def size_of(self, kind: str) -> tuple[float, float]:
        """Length and width of a vehicle of the given type [m]."""
        kind = kind.partition("@")[0]  # a vehicle changed on its own has the type `car@id`
        self.seen.add(kind)
        length = self.lengths.get(kind, self.lengths[""])
        return length, self.widths.get(kind, self.widths[""])

    def refuse_unknown(self) -> None:
        """Raise if a length was given for a type that no vehicle had: most likely a slip."""
        for kind in self.lengths:
            if kind and kind not in self.seen:
                raise ValueError(
                    f"no vehicle has the type {kind!r} of --vehicle-length; the types "
                    f"are {', '.join(sorted(self.seen)) or 'not in the file'}"
                )

    def __str__(self) -> str:
        texts = [f"{kind} {length:g} m" for kind, length in self.lengths.items() if kind]
        return ", ".join([*texts, f"{'others ' if texts else ''}{self.lengths['']:g} m"])


class _Car(NamedTuple):
    lane: str
    along: float  #: of the front bumper, along the lane [m]
    name: str
    speed: float  #: [m/s]
    kind: str
    length: float  #: [m]
    width: float  #: [m]
    #: Where it is across its lane [m], in the plane [m], and where it points; NaN if not told.
    lateral: float
    place: complex
    heading: complex


# Time [s], where it stands, and all that is there then: where, and what stands there by its name.
_Timestep = tuple[float, Place, list[tuple[Place, Mapping[str, str]]]]


def pairs_of_fcd(
    path: str, steps: Iterable[_Timestep], lengths: VehicleLengths, skips: Skips
) -> Iterator[Moment]:
    """At each time, the vehicles of which one follows the other."""
    has_vehicles = False
    for time, place, entries in steps:
        cars = dict[str, _Car]()
        with skips.leaving_out("timestep"):  # without one of them, others would be taken for pairs
            for where, attributes in entries:
                if attributes.get("lane"):  # persons, and vehicles off the road, have none
                    car = _car(where, attributes, lengths)
                    if car.name in cars:
                        skips.leave_out("twice", f"{where()}: {car.name[:40]!r} is there twice")
                    cars.setdefault(car.name, car)
            has_vehicles = has_vehicles or bool(cars)
            yield Moment(time, place, list(_queues(sorted(cars.values()), lengths)))
    if not has_vehicles:
        skips.refuse_nothing(
            f"{path} holds no vehicle on a lane (an empty simulation, persons only, or "
            "--fcd-output.attributes without lane?)"
        )


def _car(place: Place, told: Mapping[str, str], lengths: VehicleLengths) -> _Car:
    along, speed = (_number(place, name, told.get(name)) for name in ("pos", "speed"))
    x, y, angle, lateral = (
        _number(place, name, told[name]) if told.get(name) else math.nan
        for name in ("x", "y", "angle", "posLat")
    )
    if "id" not in told:
        _refuse_lack(place(), "id")
    kind, heading = told.get("type", ""), cmath.rect(1.0, math.radians(90.0 - angle))
    fields = told["lane"], along, told["id"], speed, kind, *lengths.size_of(kind)
    return _Car(*fields, lateral, complex(x, y), heading)


def _queues(cars: Sequence[_Car], lengths: VehicleLengths) -> Iterator[Following]:
    """Each vehicle and the next one ahead on its lane, not beside its way nor towards it."""
    for place, car in enumerate(cars):
        for leader in cars[place + 1 :]:
            if leader.lane != car.lane:
                break
            aside = abs(leader.lateral - car.lateral)
            if aside != aside and leader.along - car.along < _BESIDE_WITHIN:
                aside = float(_across(leader.place - car.place, car.heading + leader.heading))
            is_oncoming = abs(car.heading + leader.heading) < 1.0
            if not (is_oncoming or aside >= 0.5 * (car.width + leader.width)):
                gap = leader.along - leader.length - car.along
                if gap <= 0.0 and aside > _IN_LINE:
                    lengths.overlaps[leader.kind] += 1
                yield Following((car.lane, car.name, leader.name), gap, car.speed, leader.speed)
                break


def _across(apart: Any, headings: Any) -> Any:
    """How far apart two are across the way, in the complex plane, by the sum of their headings."""
    return abs((apart * headings.conjugate()).imag) / (abs(headings) + 1e-9)


def fcd_of_xml(path: str, skips: Skips) -> Iterator[_Timestep]:
    """Read FCD in XML, with a parser that keeps nothing and knows its line."""
    # Told the encoding, it asks no codec for the one that a file names: SUMO writes UTF-8.
    parser = expat.ParserCreate("utf-8")
    step: _Timestep = math.nan, str, []
    depth, whole = 0, list[_Timestep]()

    def refuse(why: str) -> NoReturn:
        raise ValueError(
            f"{path}, line {parser.CurrentLineNumber}: {why}; SUMO writes no such thing (is this "
            "another program's file?)"
        )

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth, step
        depth += 1
        if depth > _DEEPEST:
            refuse(f"there are more than {_DEEPEST} tags within each other")
        if depth == 1 and name != "fcd-export":
            raise ValueError(
                f"{path} is XML but not SUMO's FCD output: it begins with <{name[:40]}> instead of "
                "<fcd-export> (written with another option than --fcd-output?)"
            )
        place = partial("{}, line {}".format, path, parser.CurrentLineNumber)
        if name == "timestep":
            step = _number(place, "time", attributes.get("time")), place, []
        elif name == "vehicle":
            step[2].append((place, attributes))

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1
        if name == "timestep":
            whole.append(step)

    parser.StartElementHandler, parser.EndElementHandler = start, end
    # Entities could grow without end, or be read from elsewhere.
    parser.StartDoctypeDeclHandler = lambda name, *_: refuse(
        f"there is a <!DOCTYPE {name[:40]}>, and entities are not read"
    )
    n_bytes, data = 0, b" "
    with Source(path, skips) as source:
        while data:
            data = source.read(_BYTES_AT_ONCE)
            try:
                parser.Parse(data, not data)
            except expat.ExpatError as error:
                why = expat.ErrorString(error.code)
                message = f"{path}, line {error.lineno}: this XML is cut off or damaged: {why}"
                message += " (was SUMO or a copy interrupted?)"
                if data or not n_bytes or why not in _CUT:
                    raise ValueError(message) from error
                skips.leave_out("cut", message)
            n_bytes += len(data)
            if n_bytes - parser.CurrentByteIndex > _LONGEST_TAG:
                refuse(f"a tag or comment of more than {_LONGEST_TAG:,} bytes begins here")
            yield from whole
            whole.clear()


def fcd_of_table(table: Table) -> Iterator[_Timestep] | None:
    """Read FCD in CSV or Parquet, rows of a time together; None of another table.

    SUMO names columns after what it writes first, be it a person; or by --output.column-header.
    """
    columns = table.columns
    if list(columns) == ["timestep_time"]:  # all that SUMO writes of an empty road
        return iter(())
    whose = [name[:-2] for name in columns if name == "id" or name.endswith("_id")]
    whose.sort(key=lambda p: (f"{p}lane" not in columns, "vehicle" not in p))
    prefix = whose[0] if whose else "vehicle_"
    needed = [f"{prefix}{name}" for name in ("id", "lane", "pos", "speed")]
    time = "timestep_time" if prefix or "timestep_time" in columns else "time"
    if time not in columns or not (prefix or set(needed) <= set(columns)):
        return None
    for name in needed:
        if name not in columns:
            _refuse_lack(table.path, name)
    optional = [f"{prefix}{name}" for name in ("type", "posLat", "x", "y", "angle")]
    names = [*needed, *(name for name in optional if name in columns)]
    plain = [name.removeprefix(prefix) for name in names]
    return (
        (at, rows[0][0], [(place, dict(zip(plain, row, strict=True))) for place, *row in rows])
        for at, rows in _by_time(table, Wanted([time], names))
    )


def _by_time(table: Table, wanted: Wanted) -> Iterator[tuple[float, list[tuple[Any, ...]]]]:
    """Place, numbers and texts of all rows of a time, unless one is left out."""
    now, rows, is_whole = math.nan, list[tuple[Any, ...]](), True
    for piece in table.pieces(wanted):
        piece.leave_out_unusable(wanted.numbers[0])
        columns = [piece.numbers[name].tolist() for name in wanted.numbers]
        columns += [piece.texts[name].to_list() for name in wanted.texts]
        bad = set(np.flatnonzero(piece.bad).tolist())
        lost_rows = {row for row in bad if math.isnan(columns[0][row])}  # of this time or of that
        breaks = {*piece.anew, *lost_rows, *(row + 1 for row in lost_rows)}
        for row, (time, *values) in enumerate(zip(*columns, strict=True)):
            is_whole = is_whole and row not in breaks
            if time != now:
                if rows and is_whole:
                    yield now, rows
                now, rows, is_whole = time, [], row not in breaks
            is_whole = is_whole and row not in bad
            rows.append((partial(piece.at, row), *values))
        is_whole = is_whole and piece.rows not in breaks
    if rows and is_whole:
        yield now, rows


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
_TURNS_ABOVE = 0.1  # whoever is slower [m/s] points where it pointed before


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
    heading: float = math.nan
    width: float = math.nan  #: [m], where it is known

    def refuse_unfit(self, place: Place) -> None:
        """Raise where it has no length, or lacks a number."""
        numbers = self.x, self.y, self.vx, self.vy, self.length
        if not (all(abs(x) <= LARGEST_OBSERVATION for x in numbers) and self.length > 0.0):
            raise ValueError(
                f"{place()}: object {self.id[:40]} is {self.length:g} m long, at ({self.x:g}, "
                f"{self.y:g}) m, with ({self.vx:g}, {self.vy:g}) m/s; it needs a length and numbers"
            )


class Scene(NamedTuple):
    """All objects at one time."""

    time: float  #: [s]
    place: Place
    objects: list[Object]


def scenes_of_table(table: Table) -> Iterator[Scene]:
    """Read a table of objects, whose rows of one time stand together."""
    optional = [name for name in ("heading", "width") if name in table.columns]
    numbers = ["x", "y", "vx", "vy", "length"]
    for time, rows in _by_time(table, Wanted(["t", *numbers, *optional], ["id", "lane"])):
        with table.skips.leaving_out("scene"):
            objects = []
            for place, *values, name, lane in rows:
                if not lane:  # whoever follows nobody may lack anything
                    continue
                fields = dict(zip([*numbers, *optional], values, strict=True))
                objects.append(Object(name, lane, **fields))
                objects[-1].refuse_unfit(place)
            yield Scene(time, rows[0][0], objects)


def pairs_of_scenes(path: str, scenes: Iterable[Scene], skips: Skips) -> Iterator[Moment]:
    """At each time, each vehicle and the nearest one ahead of it on its lane, or nearly beside it.

    The gap is the distance between the middles, in a straight line, less half of both lengths:
    where a lane bends, it is a little too small.
    """
    headings: dict[str, float] = {}
    has_lanes = False
    for scene in scenes:
        lanes: defaultdict[str, list[Object]] = defaultdict(list)
        names = set[str]()
        for obj in scene.objects:
            if obj.id in names:
                skips.leave_out(
                    "twice",
                    f"{scene.place()}: {obj.id[:40]!r} is there twice at {scene.time:g} s (several "
                    "recordings in one file?)",
                )
                continue
            names.add(obj.id)
            heading = obj.heading
            if not math.isfinite(heading):
                moves = math.hypot(obj.vx, obj.vy) >= _TURNS_ABOVE
                heading = math.atan2(obj.vy, obj.vx) if moves else headings.get(obj.id, math.nan)
            headings[obj.id] = heading
            lanes[obj.lane].append(obj._replace(heading=heading))
        has_lanes = has_lanes or bool(lanes)
        pairs = [pair for lane in lanes.values() for pair in _following(scene, lane)]
        yield Moment(scene.time, scene.place, pairs)
    if not has_lanes:
        skips.refuse_nothing(
            f"{path}: no object is on a lane, and who follows whom is told by lanes (recorded "
            "without a map? assign the lanes first)"
        )


def _following(scene: Scene, lane: Sequence[Object]) -> Iterator[Following]:
    if len(lane) > _MOST_ON_A_LANE:
        raise ValueError(
            f"{scene.place()}: {len(lane):,} objects on the lane {lane[0].lane[:40]!r} at one time "
            "(rows not sorted by time, or the clock of a coarse step?)"
        )
    if len(lane) == 1:
        return
    x, y, headings = np.array([(obj.x, obj.y, obj.heading) for obj in lane]).T
    dx, dy = x[None, :] - x[:, None], y[None, :] - y[:, None]
    along = dx * np.cos(headings)[:, None] + dy * np.sin(headings)[:, None]
    widths = np.array([obj.width for obj in lane])
    widths[~(widths > 0.0)] = _USUAL_WIDTH
    leader_headings = np.where(np.isnan(headings), headings[:, None], headings)
    mean = np.exp(1j * headings[:, None]) + np.exp(1j * leader_headings)
    beside = _across(dx + 1j * dy, mean) >= 0.5 * (widths[:, None] + widths)
    left_out = (beside & (along < _BESIDE_WITHIN)) | (abs(mean) < 1.0)  # or oncoming
    ahead = (along > 0.0) & ~left_out
    apart = np.where(ahead, np.hypot(dx, dy), np.inf)
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


def scenes_of_osi(path: str, skips: Skips) -> Iterator[Scene]:
    """Read ground truth, or that within sensor views, from a ``.osi`` file, scene by scene."""
    osi = _osi(path)
    with Source(path, skips) as source:
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
                why = "(was a copy or a simulation interrupted?)"
                skips.leave_out("cut", f"{path} ends within message {number} {why}")
                return
            if number == 1:
                is_view = _is_view(osi, data)
            with skips.leaving_out("message"):
                yield _scene(osi, f"{path}, message {number}", data, is_view)


def scenes_of_mcap(path: str, skips: Skips) -> Iterator[Scene]:
    """Read OSI in MCAP: the first channel of ground truth or of sensor views."""
    osi = _osi(path)
    channel_id, number, kinds = None, 0, set[str]()
    for schema, channel, message in mcap_messages(path, _MOST_BYTES, skips):
        kind = "" if schema is None else schema.name.rpartition(".")[2]
        kinds.add(kind)
        if channel_id is None and kind in ("GroundTruth", "SensorView"):
            channel_id = channel.id
        if channel.id == channel_id:
            number += 1
            skips.on_read(len(message.data))
            with skips.leaving_out("message"):
                yield _scene(osi, f"{path}, message {number}", message.data, kind == "SensorView")
    if channel_id is None:
        names = ", ".join(sorted(kinds - {""})) or "none"
        skips.refuse_nothing(
            f"{path}: no channel of it holds GroundTruth or SensorView of OSI; its schemas are "
            f"{names} (of a bag of ROS 2 --topics says what they mean, whatever its header says)"
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
        _object(place, vehicle, lane)
        for vehicle in (truth.moving_object if truth else ())
        if vehicle.base and vehicle.type not in on_foot and (lane := _lane(vehicle))
    ]
    return Scene(stamp.seconds + 1e-9 * stamp.nanos, lambda: place, objects)


def _lane(moving: Any) -> str:
    """Where it is; empty where that is not known: it follows nobody, and nobody follows it."""
    classification = moving.moving_object_classification
    lanes = (classification and classification.assigned_lane_id) or moving.assigned_lane_id
    if lanes or not (classification and classification.logical_lane_assignment):
        return str(lanes[0].value) if lanes else ""
    return f"logical {classification.logical_lane_assignment[0].assigned_lane_id.value}"


def _object(place: str, moving: Any, lane: str) -> Object:
    base = moving.base
    name = str(moving.id.value) if moving.id else "without an id"
    x, y = (base.position.x, base.position.y) if base.position else (math.nan, math.nan)
    vx, vy = (base.velocity.x, base.velocity.y) if base.velocity else (math.nan, math.nan)
    length = base.dimension.length if base.dimension else math.nan
    heading = base.orientation.yaw if base.orientation else math.nan
    width = base.dimension.width if base.dimension else math.nan
    obj = Object(name, lane, x, y, vx, vy, length, heading, width or math.nan)
    obj.refuse_unfit(lambda: place)
    return obj

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
from itertools import chain, islice
from typing import Any, NamedTuple, NoReturn
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.naming import VARIABLES
from evofsm.driving.rehearsal import Three
from evofsm.extras import needs
from evofsm.io import tables
from evofsm.io.tables import MISSING, Piece, Skips, Source, Table, Wanted, explained, in_row
from evofsm.store import LARGEST_OBSERVATION

ACTION = "a_follower"  #: of a pair of vehicles: what the follower did until the next time
COLUMNS = ("time", *VARIABLES, ACTION)  #: what is known of a pair at one time

_ROWS_AT_ONCE = 8192
# Rows that may wait before all are handed on, of 32 bytes each; a pair that is cut loses one step.
_MOST_WAITING = 1_000_000
_JUMP = 3.0  # by which a gap changes more [m] and stays, and a name is another vehicle's
_MOST_ON_A_LANE = 1000  # more at one time are no recording of a road, and take long

# What is said where nothing is on a lane.
_NO_CAR = (
    " holds no vehicle on a lane (an empty simulation, persons only, or --fcd-output.attributes "
    "without lane?)"
)
_NO_VEHICLE = ": no vehicle is in it (empty, or messages of another kind, such as SensorData?)"
_NO_OBJECT = (
    ": no object is on a lane, and who follows whom is told by lanes (recorded without a map? "
    "assign the lanes first)"
)

Place = Callable[[], str]  #: says where something stands, for a message


class Vehicle(NamedTuple):
    """Where a vehicle is at one time, and how it moves."""

    where: Place
    lanes: Sequence[str]
    name: str
    place: complex  #: in the plane [m]; NaN if not told
    heading: complex  #: of length 1; NaN if not told
    speed: float  #: [m/s], negative where it reverses
    front: float  #: from its place to its front bumper [m]
    rear: float  #: and to the rear one
    width: float  #: [m]
    along: float = math.nan  #: its place along the lane [m], if told; else it is where it points
    lateral: float = math.nan  #: its place across the lane [m], if told
    kind: str = ""
    is_towed: bool = False


#: Time [s], where it stands, and all that is there then: where, and what stands there by its name.
Moment = tuple[float, Place, list[tuple[Place, Mapping[str, Any]]]]
#: A vehicle's heading, and where it was on the road: its lanes, places in the plane and along.
_Track = tuple[complex, Sequence[str], complex, float]
_Pair = tuple[str, str]  #: follower and leader, on whichever lane


@dataclass
class PairTable(Table):
    """The pairs of a file, as a table with a row for each pair and time; episodes end to end."""

    path: str
    moments: Iterable[Moment]
    skips: Skips
    lengths: VehicleLengths | None = None  #: of FCD
    in_degrees: bool = field(default=False, init=False)  #: as somebody drove on a lane and showed

    columns = COLUMNS
    derives = True

    def pieces(self, wanted: Wanted) -> Iterator[Piece]:
        """All columns, whichever are wanted."""
        before, starts, blocks, names = 0, [0], list[NDArray[np.float64]](), list[str]()
        for (follower, leader), rows in chain(self._episodes(), [(("", ""), None)]):
            for block in () if rows is None else map(_with_actions, _apart(rows)):
                blocks.append(block)
                names.append(f"{follower} behind {leader}")
                starts.append(starts[-1] + len(blocks[-1]))
            if blocks and (rows is None or starts[-1] >= _ROWS_AT_ONCE):
                numbers = dict(zip(COLUMNS, np.concatenate(blocks).T, strict=True))
                find, begins = partial(in_row, self.path, numbers, before), starts[:-1]
                yield Piece(starts[-1], numbers, find, self.skips, starts=begins, names=names)
                before, starts, blocks, names = before + starts[-1], [0], [], []
        if before == 0:
            fault = "no vehicle ever follows another one on the same lane"
            self.skips.refuse_nothing(f"{self.path}: {fault}")

    def _episodes(self) -> Iterator[tuple[_Pair, array[float] | None]]:
        """Rows of a pair for as long as it stays one, or until too many wait."""
        open_pairs: dict[_Pair, array[float]] = {}
        vehicle_of = _object if self.lengths is None else partial(_car, self.lengths)
        before, tracks, has_lanes, has_any = -math.inf, dict[str, _Track](), False, False
        for time, where, entries in self.moments:
            try:  # persons, and vehicles off the road, have no lane
                cars = [vehicle_of(*entry) for entry in entries if _is_on_lane(entry[1])]
            except ValueError as error:  # without one of them, others would be taken for pairs
                self.skips.leave_out("timestep", str(error))
                continue
            has_lanes, has_any = has_lanes or bool(cars), has_any or bool(entries)
            lanes = self._lanes(time, cars, tracks)
            if not time > before:
                cause = "rows not sorted by time, or two recordings in one file?"
                fault = f"time goes from {before:g} to {time:g}; it must run forward ({cause})"
                self.skips.leave_out("time", f"{where()}: {fault}")
                continue
            before = time
            present: dict[_Pair, array[float]] = {}
            nearest: dict[str, tuple[float, _Pair, Three]] = {}
            for pair, numbers in chain.from_iterable(map(self._pairs, lanes)):
                entry = numbers[0], pair, numbers  # of all lanes that it is on
                nearest[pair[0]] = min(entry, nearest.get(pair[0], entry))
            for _, pair, numbers in nearest.values():
                rows = open_pairs.pop(pair, None) or array("d")
                rows.extend((time, *numbers))
                present[pair] = rows
            yield from open_pairs.items()  # who has parted
            open_pairs = present
            if sum(map(len, present.values())) > 4 * _MOST_WAITING:
                yield from open_pairs.items()
                open_pairs = {}
        yield from open_pairs.items()
        if not has_lanes:
            fault = _NO_OBJECT if has_any else _NO_VEHICLE
            self.skips.refuse_nothing(self.path + (fault if self.lengths is None else _NO_CAR))

    def _lanes(
        self, time: float, cars: Iterable[Vehicle], tracks: dict[str, _Track]
    ) -> Iterable[list[Vehicle]]:
        """Who is on each lane, once; who does not say where it points does so as before.

        SUMO puts who parks beside the road there at once, and only the plane tells.
        """
        lanes: defaultdict[str, list[Vehicle]] = defaultdict(list)
        names = set[str]()
        for car in cars:
            if car.name in names:
                fault = f"{car.name[:40]!r} is there twice at {time:g} s"
                why = f"{car.where()}: {fault} (several recordings in one file?)"
                self.skips.leave_out("twice", why)
                continue
            names.add(car.name)
            here = car.lanes, car.place, car.along
            heading, ways, place, along = tracks.get(car.name, (car.heading, (), *here[1:]))
            if car.heading != car.heading:
                car = car._replace(heading=heading)
            drives = not car.speed < _TURNS_ABOVE
            apart, way = car.place - place, abs(car.along - along)
            if car.lanes == ways and 0.1 < way > 100.0 * abs(apart):
                self.in_degrees = True
            apart = _metres(apart, car) if self.in_degrees else apart
            aside = abs(apart) - 2.0 * way
            parks = not drives and car.lanes == ways and aside > _USUAL_WIDTH
            # Who was never seen to drive on a lane may have been beside it from the first.
            is_known = drives or (car.lanes == ways and not parks)
            tracks[car.name] = car.heading, *(here if is_known else (ways, place, along))
            for lane in dict.fromkeys(() if parks else car.lanes):
                lanes[lane].append(car)
        return [lanes[name] for name in sorted(lanes)] if self.lengths else lanes.values()

    def _pairs(self, lane: list[Vehicle]) -> Iterator[tuple[_Pair, Three]]:
        """Each vehicle of a lane and the nearest one ahead, not beside its way nor towards it.

        With it come the gap, bumper to bumper [m], and both speeds [m/s].
        """
        if self.lengths:  # by their places along the lane
            lane.sort(key=lambda car: (car.along, car.name))
        places = np.array([car.place for car in lane])
        for order, car in enumerate(lane):
            if car.is_towed:
                continue
            for leader, along, distance in _ahead(car, lane, order, places):
                is_told = leader.heading == leader.heading
                headings = car.heading + (leader.heading if is_told else car.heading)
                aside = abs(leader.lateral - car.lateral)
                if aside != aside and along < _BESIDE_WITHIN:  # across the way, as both point
                    apart = leader.place - car.place
                    apart = _metres(apart, car) if abs(apart) < 0.01 * along else apart
                    aside = abs((apart * headings.conjugate()).imag)
                    aside /= abs(headings) + 1e-9
                is_oncoming = abs(headings) < 1.0
                if not (is_oncoming or aside >= 0.5 * (car.width + leader.width)):
                    gap = distance - (car.front + leader.rear)
                    if self.lengths and gap <= 0.0 and aside > _IN_LINE:
                        self.lengths.overlaps[leader.kind] += 1
                    yield (car.name, leader.name), (gap, car.speed, leader.speed)
                    break


def _metres(apart: complex, near: Vehicle) -> complex:
    """Of degrees (--fcd-output.geo), which are next to nothing for a way along a lane."""
    return complex(apart.real * math.cos(math.radians(near.place.imag)), apart.imag) * _DEGREE


def _is_on_lane(told: Mapping[str, Any]) -> bool:
    return str(told.get("lane") or "").strip().lower() not in MISSING


def _ahead(
    car: Vehicle, lane: Sequence[Vehicle], order: int, places: NDArray[np.complex128]
) -> Iterator[tuple[Vehicle, float, float]]:
    """Who is ahead, the nearest one first: how far along the way, and away."""
    if car.along == car.along:
        for leader in islice(lane, order + 1, None):
            yield leader, leader.along - car.along, leader.along - car.along
        return
    if len(lane) > _MOST_ON_A_LANE:
        fault = f"{len(lane):,} objects on the lane {car.lanes[0][:40]!r} at one time"
        cause = "rows not sorted by time, or the clock of a coarse step?"
        raise ValueError(f"{car.where()}: {fault} ({cause})")
    apart = places - car.place
    along, distances = (apart * car.heading.conjugate()).real, np.abs(apart)
    for place in np.argsort(distances).tolist():
        if along[place] > 0.0:
            yield lane[place], float(along[place]), float(distances[place])


def _apart(rows: array[float]) -> list[NDArray[np.float64]]:
    """(T, 4) Rows of a pair, apart where its gap jumps and stays there; a single one is noise."""
    table = np.array(rows).reshape(-1, 4)

    def jumps(n: int) -> NDArray[np.bool_]:
        times, gaps, *_ = np.abs(table[n:] - table[:-n]).T
        speeds = np.abs(table[n:, 2:]) + np.abs(table[:-n, 2:])
        excess: NDArray[np.float64] = gaps - times * speeds.sum(axis=1)  # they cannot have driven
        return excess > _JUMP

    with np.errstate(over="ignore"):
        anew, noise = jumps(1), ~jumps(2)
    noise &= anew[:-1] & anew[1:]
    anew[:-1] &= ~noise
    anew[1:] &= ~noise
    return np.split(table, np.flatnonzero(anew) + 1)


def _with_actions(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """(T, 5) `COLUMNS`; the action is NaN in the last row, and where it is beyond any number."""
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
_DEGREE = 111_195.0  # of latitude [m]
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
                kinds = ", ".join(sorted(self.seen)) or "not in the file"
                fault = f"no vehicle has the type {kind!r} of --vehicle-length"
                raise ValueError(f"{fault}; the types are {kinds}")

    def __str__(self) -> str:
        texts = [f"{kind} {length:g} m" for kind, length in self.lengths.items() if kind]
        return ", ".join([*texts, f"{'others ' if texts else ''}{self.lengths['']:g} m"])


def _car(lengths: VehicleLengths, place: Place, told: Mapping[str, str]) -> Vehicle:
    along, speed = (_number(place, name, told.get(name)) for name in ("pos", "speed"))
    x, y, angle, lateral = (
        _number(place, name, told[name]) if told.get(name) else math.nan
        for name in ("x", "y", "angle", "posLat")
    )
    if "id" not in told:
        _refuse_lack(place(), "id")
    kind, heading = told.get("type", ""), cmath.rect(1.0, math.radians(90.0 - angle))
    length, width = lengths.size_of(kind)
    sizes = 0.0, length, width  # its place is that of the front bumper
    where = place, [told["lane"]], told["id"], complex(x, y)
    return Vehicle(*where, heading, speed, *sizes, along, lateral, kind)


def fcd_of_xml(path: str, skips: Skips) -> Iterator[Moment]:
    """Read FCD in XML, with a parser that keeps nothing and knows its line."""
    # Told the encoding, it asks no codec for the one that a file names: SUMO writes UTF-8.
    parser = expat.ParserCreate("utf-8")
    step: Moment = math.nan, str, []
    depth, whole = 0, list[Moment]()

    def refuse(why: str) -> NoReturn:
        hint = "SUMO writes no such thing (is this another program's file?)"
        raise ValueError(f"{path}, line {parser.CurrentLineNumber}: {why}; {hint}")

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth, step
        depth += 1
        if depth > _DEEPEST:
            refuse(f"there are more than {_DEEPEST} tags within each other")
        if depth == 1 and name != "fcd-export":
            fault = f"it begins with <{name[:40]}> instead of <fcd-export>"
            cause = "written with another option than --fcd-output?"
            raise ValueError(f"{path} is XML but not SUMO's FCD output: {fault} ({cause})")
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


def fcd_of_table(table: Table) -> Iterator[Moment] | None:
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
    return _by_time(table, Wanted([time], names), prefix)


def _by_time(table: Table, wanted: Wanted, prefix: str = "") -> Iterator[Moment]:
    """All rows of a time, unless one is left out."""
    now, rows, is_whole = math.nan, list[tuple[Place, Mapping[str, Any]]](), True
    names = [name.removeprefix(prefix) for name in (*wanted.numbers[1:], *wanted.texts)]
    for piece in table.pieces(wanted):
        piece.leave_out(wanted.numbers[0], piece.unusable(wanted.numbers[0]))
        columns = [piece.numbers[name].tolist() for name in wanted.numbers]
        columns += [piece.texts[name].to_list() for name in wanted.texts]
        bad = set(np.flatnonzero(piece.bad).tolist())
        lost_rows = {row for row in bad if math.isnan(columns[0][row])}  # of this time or of that
        breaks = {*piece.anew, *piece.headers, *lost_rows, *(row + 1 for row in lost_rows)}
        for row, (time, *values) in enumerate(zip(*columns, strict=True)):
            is_whole = is_whole and row not in breaks
            if time != now:
                if rows and is_whole:
                    yield now, rows[0][0], rows
                now, rows, is_whole = time, [], row not in breaks
            is_whole = is_whole and row not in bad
            rows.append((partial(piece.at, row), dict(zip(names, values, strict=True))))
        is_whole = is_whole and piece.rows not in breaks
    if rows and is_whole:
        yield now, rows[0][0], rows


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
    why = "SUMO writes it unless --fcd-output.attributes leaves it out"
    raise ValueError(f"{place}: there is no {name!r}; {why} (id,lane,pos,speed,type are needed)")


# -- Objects --------------------------------------------------------------------------------------

#: The columns that a table of objects has, and by which it is known. ``x`` and ``y`` are of the
#: middle of the box; units are those of the SI.
OBJECT_COLUMNS = ("id", "t", "x", "y", "vx", "vy", "length", "lane")
_TURNS_ABOVE = 0.1  # whoever is slower [m/s] points where it pointed before


def objects_of_table(table: Table) -> Iterator[Moment]:
    """Read a table of objects, whose rows of one time stand together."""
    optional = [name for name in ("heading", "width") if name in table.columns]
    numbers = ["t", "x", "y", "vx", "vy", "length", *optional]
    return _by_time(table, Wanted(numbers, ["id", "lane"]))


def _object(place: Place, told: Mapping[str, Any]) -> Vehicle:
    """One whose heading, where nobody tells it, is the way that it moves; else not known."""
    numbers = x, y, vx, vy, length = [told[name] for name in ("x", "y", "vx", "vy", "length")]
    name, heading, width = told["id"], told.get("heading", math.nan), told.get("width", math.nan)
    if not (all(abs(number) <= LARGEST_OBSERVATION for number in numbers) and length > 0.0):
        fault = f"{length:g} m long, at ({x:g}, {y:g}) m, with ({vx:g}, {vy:g}) m/s"
        raise ValueError(f"{place()}: object {name[:40]} is {fault}; it needs a length and numbers")
    speed, half = math.hypot(vx, vy), 0.5 * length
    if not math.isfinite(heading):
        heading = math.atan2(vy, vx) if speed >= _TURNS_ABOVE else math.nan
    elif vx * math.cos(heading) + vy * math.sin(heading) < 0.0:
        speed = -speed
    width = width if width > 0.0 else _USUAL_WIDTH
    ahead, lanes = cmath.rect(1.0, heading), told["lane"]
    where = place, [lanes] if isinstance(lanes, str) else lanes, name, complex(x, y)
    return Vehicle(*where, ahead, speed, half, half, width, is_towed=told.get("towed", False))


# -- ASAM OSI -------------------------------------------------------------------------------------

_MOST_BYTES = 1 << 28  # of a message; one of a sensor with images has a few million
_LENGTH = struct.Struct("<I")


def objects_of_osi(path: str, skips: Skips) -> Iterator[Moment]:
    """Read ground truth, or that within sensor views, of a ``.osi`` file or the first in MCAP."""
    with needs("betterosi", "osi", f"{path}: ASAM OSI"):
        import betterosi as osi
    is_mcap = tables.file_kind(path) == "mcap"
    messages = _of_mcap(path, skips) if is_mcap else _of_file(path, osi, skips)
    for number, (data, is_view) in enumerate(messages, 1):
        try:
            yield _moment(osi, f"{path}, message {number}", data, is_view)
        except ValueError as error:
            skips.leave_out("message", str(error))


def _of_file(path: str, osi: Any, skips: Skips) -> Iterator[tuple[bytes, bool]]:
    """Messages, and whether they are sensor views, as the first one tells."""
    with Source(path, skips) as source:
        is_view, number = False, 0
        while head := source.read(_LENGTH.size):
            number += 1
            size = _LENGTH.unpack(head)[0] if len(head) == _LENGTH.size else 0
            if size > _MOST_BYTES:
                fault = f"{size:,} bytes long by what stands before it"
                cause = "this is no trace of OSI, or it is damaged there"
                raise ValueError(f"{path}, message {number}: {fault}; {cause}")
            data = source.read(size)
            if len(head) < _LENGTH.size or len(data) < size:
                why = "(was a copy or a simulation interrupted?)"
                skips.leave_out("cut", f"{path} ends within message {number} {why}")
                return
            if number == 1:
                is_view = _is_view(osi, data)
            yield data, is_view


def _is_view(osi: Any, data: bytes) -> bool:
    """Whether a message is a sensor view: the seventh field of ground truth is a traffic light."""
    try:
        truth = osi.SensorView.from_binary(data).global_ground_truth
        return truth is not None and truth.has_field("timestamp")
    except ValueError:
        return False


def _of_mcap(path: str, skips: Skips) -> Iterator[tuple[bytes, bool]]:
    """The same of the first channel of ground truth or of sensor views."""
    channel_id, kinds = None, set[str]()
    for schema, channel, message in tables.mcap_messages(path, _MOST_BYTES, skips):
        kind = "" if schema is None else schema.name.rpartition(".")[2]
        kinds.add(kind)
        if channel_id is None and kind in ("GroundTruth", "SensorView"):
            channel_id = channel.id
        if channel.id == channel_id:
            skips.on_read(len(message.data))
            yield message.data, kind == "SensorView"
    if channel_id is None:
        names = ", ".join(sorted(kinds - {""})) or "none"
        fault = f"no channel of it holds GroundTruth or SensorView of OSI; its schemas are {names}"
        hint = "of a bag of ROS 2 --topics says what they mean, whatever its header says"
        skips.refuse_nothing(f"{path}: {fault} ({hint})")


def _moment(osi: Any, place: str, data: bytes, is_view: bool) -> Moment:
    try:
        message = (osi.SensorView if is_view else osi.GroundTruth).from_binary(data)
    except ValueError as error:
        cause = "damaged, or a trace of another message?"
        fault = f"is not ground truth of OSI, nor a sensor view ({cause})"
        raise ValueError(f"{place} {fault}: {error}") from error
    truth = message.global_ground_truth if is_view else message
    stamp = (truth and truth.timestamp) or message.timestamp or osi.Timestamp()
    on_foot = (osi.MovingObject.Type.PEDESTRIAN, osi.MovingObject.Type.ANIMAL)
    vehicles = truth.moving_object if truth else ()
    kinds = [vehicle.vehicle_classification for vehicle in vehicles]
    trailers = {k.trailer_id.value for k in kinds if k and k.has_trailer and k.trailer_id}
    entries: list[tuple[Place, Mapping[str, Any]]] = [
        (lambda: place, _row_of(vehicle) | {"towed": vehicle.id and vehicle.id.value in trailers})
        for vehicle in vehicles
        if vehicle.base and vehicle.type not in on_foot
    ]
    return stamp.seconds + 1e-9 * stamp.nanos, lambda: place, entries


def _lanes(vehicle: Any) -> list[str]:
    """Where it is; none where that is not known: it follows nobody, and nobody follows it."""
    classification = vehicle.moving_object_classification
    lanes = (classification and classification.assigned_lane_id) or vehicle.assigned_lane_id
    if lanes or not (classification and classification.logical_lane_assignment):
        return [str(lane.value) for lane in lanes]
    lanes = [entry.assigned_lane_id for entry in classification.logical_lane_assignment]
    return [f"logical {lane.value}" for lane in lanes]


def _row_of(vehicle: Any) -> dict[str, Any]:
    """The same as a row of a table of objects."""
    base, size, unknown = vehicle.base, vehicle.base.dimension, (math.nan, math.nan)
    x, y = (base.position.x, base.position.y) if base.position else unknown
    vx, vy = (base.velocity.x, base.velocity.y) if base.velocity else unknown
    length, width = (size.length, size.width) if size else unknown
    heading = base.orientation.yaw if base.orientation else math.nan
    name = str(vehicle.id.value) if vehicle.id else "without an id"
    row = {"id": name, "lane": _lanes(vehicle), "x": x, "y": y, "vx": vx, "vy": vy}
    return row | {"length": length, "width": width, "heading": heading}

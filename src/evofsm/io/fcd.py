"""Derive leader-follower pairs from SUMO's floating car data (FCD) output.

SUMO's ``pos`` is the front bumper's position along the lane, so the gap to the vehicle ahead is
``pos_leader - length_leader - pos_follower``; FCD holds no lengths, they are assumed. A pair is
a vehicle and the next one ahead of it on the same lane. Its episode lasts from one timestep to
the next as long as nobody comes between and neither leaves the lane. Without the road network,
a leader beyond the end of the lane is not seen.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple, Self
from xml.parsers import expat

from evofsm.fsm import positive
from evofsm.io.files import OnRead, damage_explained, open_unpacked
from evofsm.io.following import Following, Moment
from evofsm.io.tables import Table, explain_text
from evofsm.store import LARGEST_OBSERVATION

#: The column by which an FCD table is known.
TIME = "timestep_time"

_BYTES_AT_ONCE = 1 << 16
# Those that the parser knows itself; for any other it would ask Python's codecs.
_ENCODINGS = ("utf-8", "us-ascii", "iso-8859-1", "utf-16")
# What SUMO writes stays far below these, which bound what a file can make of memory: bytes of a tag
# or a comment, tags within tags, characters of a name, vehicles at one time, types remembered.
_LONGEST_TAG = 1_000_000
_DEEPEST = 16
_LONGEST_NAME = 256
_MOST_VEHICLES = 250_000
_MOST_TYPES = 1000


@dataclass
class VehicleLengths:
    """Lengths assumed for vehicles, by their SUMO type.

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

    @classmethod
    def parse(cls, texts: Iterable[str]) -> Self:
        """Lengths from texts such as ``5.0`` and ``truck=12``.

        Examples
        --------
        >>> VehicleLengths.parse(["4.5", "truck=12"]).by_type
        {'truck': 12.0}
        """
        lengths = cls()
        for text in texts:
            kind, _, number = text.rpartition("=")
            try:
                length = positive("length", float(number))
            except ValueError:
                raise ValueError(
                    f"--vehicle-length is {text!r}; write a positive length such as 5.0, or "
                    "truck=12 for one type"
                ) from None
            if kind:
                lengths.by_type[kind] = length
            else:
                lengths.default = length
        return lengths

    def of(self, kind: str) -> float:
        """Length of a vehicle of the given type [m]."""
        kind = kind.partition("@")[0]  # a vehicle changed on its own has the type `car@id`
        if len(self.seen) < _MOST_TYPES or kind in self.by_type:
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


class Vehicle(NamedTuple):
    """A vehicle on a lane; sorted, vehicles stand in the order in which they drive."""

    lane: str
    position: float  #: of the front bumper, along the lane [m]
    id: str
    kind: str
    speed: float  #: [m/s]


class Timestep(NamedTuple):
    """All vehicles that are on a lane at one time."""

    time: float  #: [s]
    place: str  #: where it stands, for a message
    vehicles: list[Vehicle]


def pairs_on_lanes(timesteps: Iterable[Timestep], lengths: VehicleLengths) -> Iterator[Moment]:
    """At each time, the vehicles of which one follows the other."""
    for timestep in timesteps:
        yield Moment(timestep.time, timestep.place, list(_neighbours(timestep, lengths)))


def _neighbours(timestep: Timestep, lengths: VehicleLengths) -> Iterator[Following]:
    for follower, leader in pairwise(sorted(timestep.vehicles)):
        if follower.lane == leader.lane:
            gap = leader.position - lengths.of(leader.kind) - follower.position
            who = (follower.lane, follower.id, leader.id)
            yield Following(who, gap, follower.speed, leader.speed)


def not_empty(path: str, timesteps: Iterable[Timestep]) -> Iterator[Timestep]:
    """The same timesteps, once it is seen that vehicles are on lanes."""
    lanes = False
    for timestep in timesteps:
        lanes = lanes or bool(timestep.vehicles)
        yield timestep
    if not lanes:
        raise ValueError(
            f"{path} holds no vehicle on a lane (an empty simulation, or persons only?)"
        )


# -- XML ------------------------------------------------------------------------------------------


def xml_timesteps(path: str, on_read: OnRead) -> Iterator[Timestep]:
    """Read FCD in XML, with a parser that keeps nothing and knows its line."""
    parser = expat.ParserCreate()
    reader = _XmlReader(path, parser)
    with (
        open_unpacked(path, on_read) as file,
        damage_explained(path, lambda: parser.CurrentLineNumber),
    ):
        while data := file.read(_BYTES_AT_ONCE):
            yield from reader.feed(data)
        yield from reader.feed(b"", last=True)


class _XmlReader:
    """Gathers vehicles until their timestep ends."""

    def __init__(self, path: str, parser: expat.XMLParserType) -> None:
        self._path = path
        self._parser = parser
        self._fed = 0
        self._depth = 0
        self._root = ""
        self._lanes_seen = False
        self._present: Timestep | None = None
        self._finished: list[Timestep] = []
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.XmlDeclHandler = self._refuse_encoding
        # Entities could grow without end, or be read from elsewhere.
        parser.StartDoctypeDeclHandler = self._refuse_doctype

    def feed(self, data: bytes, last: bool = False) -> list[Timestep]:
        """Parse more of the file; returns the timesteps that ended in it."""
        try:
            self._parser.Parse(data, last)
        except expat.ExpatError as error:
            raise ValueError(
                f"{self._path}, line {error.lineno}: this is not whole XML: "
                f"{expat.ErrorString(error.code)} (was SUMO or a copy interrupted?)"
            ) from error
        self._fed += len(data)
        if self._fed - self._parser.CurrentByteIndex > _LONGEST_TAG:
            raise ValueError(
                f"{self._place}: a tag or comment of more than {_LONGEST_TAG:,} bytes begins here; "
                "SUMO writes none"
            )
        finished, self._finished = self._finished, []
        return finished

    def _refuse_encoding(self, version: str, encoding: str | None, standalone: int) -> None:
        if encoding is not None and encoding.lower() not in _ENCODINGS:
            raise ValueError(
                f"{self._path}, line 1: the encoding is {encoding[:40]!r}; SUMO writes UTF-8 (was "
                "the file changed?)"
            )

    def _refuse_doctype(self, name: str, *_: object) -> None:
        raise ValueError(
            f"{self._place}: there is a <!DOCTYPE {name[:40]}>; SUMO writes none, and entities are "
            "not read (is this another program's file?)"
        )

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth > _DEEPEST:
            raise ValueError(
                f"{self._place}: more than {_DEEPEST} tags within each other; SUMO writes no more "
                "than a few"
            )
        if name == "vehicle" and self._present is not None:
            vehicle = self._vehicle(attributes)
            if vehicle is not None:
                _add(self._present, vehicle)
        elif name == "timestep":
            self._present = Timestep(
                _number(self._place, "time", attributes.get("time")), self._place, []
            )
        elif not self._root and name != "fcd-export":
            raise ValueError(
                f"{self._path} is XML but not SUMO's FCD output: it begins with <{name[:40]}> "
                "instead of <fcd-export> (written with another option than --fcd-output?)"
            )
        self._root = self._root or name

    def _end(self, name: str) -> None:
        self._depth -= 1
        if name == "timestep" and self._present is not None:
            self._finished.append(self._present)
            self._present = None

    def _vehicle(self, attributes: dict[str, str]) -> Vehicle | None:
        lane = attributes.get("lane")
        if lane is None and not self._lanes_seen:
            raise _lacks(self._place, "lane")
        if not lane:  # off the road for a while
            return None
        self._lanes_seen = True
        return _vehicle(
            self._place,
            attributes.get("id"),
            lane,
            attributes.get("pos"),
            attributes.get("speed"),
            attributes.get("type", ""),
        )

    @property
    def _place(self) -> str:
        return f"{self._path}, line {self._parser.CurrentLineNumber}"


# -- Tables ---------------------------------------------------------------------------------------


def table_timesteps(table: Table) -> Iterator[Timestep]:
    """Read FCD in CSV or Parquet: a row per vehicle, consecutive rows of a time together."""
    if table.columns == (TIME,):  # all that SUMO writes of an empty road
        return
    # SUMO names the columns after what it writes first, be it a person.
    prefix = "person" if "person_id" in table.columns else "vehicle"
    names = [f"{prefix}_{name}" for name in ("id", "lane", "pos", "speed")]
    for name in names:
        if name not in table.columns:
            raise _lacks(table.path, name)
    kind = f"{prefix}_type"
    kinds = [kind] if kind in table.columns else []
    present: Timestep | None = None
    for piece in table.pieces([TIME], names + kinds):
        times = piece.numbers[TIME].tolist()
        columns = [piece.texts[name] for name in names + kinds]
        for row, (time, name, lane, *rest) in enumerate(zip(times, *columns, strict=True)):
            if present is None or time != present.time:
                if present is not None:
                    yield present
                present = Timestep(time, piece.at(row), [])
            if lane:  # persons, empty timesteps and vehicles off the road have none
                _add(present, _vehicle(piece.at(row), name, lane, *rest))
    if present is not None:
        yield present


# -- What both share ------------------------------------------------------------------------------


def _vehicle(
    place: str, name: str | None, lane: str, position: str | None, speed: str | None, kind: str = ""
) -> Vehicle:
    if name is None:
        raise _lacks(place, "id")
    for text in (name, lane, kind):
        if len(text) > _LONGEST_NAME:
            raise ValueError(
                f"{place}: an id, a lane or a type of {len(text):,} characters; it must be at most "
                f"{_LONGEST_NAME} long"
            )
    return Vehicle(
        lane, _number(place, "pos", position), name, kind, _number(place, "speed", speed)
    )


def _add(timestep: Timestep, vehicle: Vehicle) -> None:
    timestep.vehicles.append(vehicle)
    if len(timestep.vehicles) > _MOST_VEHICLES:
        raise ValueError(
            f"{timestep.place}: more than {_MOST_VEHICLES:,} vehicles at one time (rows not sorted "
            "by time, or the clock of a coarse step?)"
        )


def _number(place: str, name: str, text: str | None) -> float:
    if text is None:
        raise _lacks(place, name)
    try:
        number = float(text)
    except ValueError:
        cause = explain_text(text)
        if name == "time" and ":" in text:
            cause = f"{text[:40]!r} is no number (written with --human-readable-time?)"
        raise ValueError(f"{place}, {name}: {cause}") from None
    if not abs(number) <= LARGEST_OBSERVATION:
        raise ValueError(f"{place}, {name}: {number} cannot be learnt; it must be finite")
    return number


def _lacks(place: str, name: str) -> ValueError:
    return ValueError(
        f"{place}: there is no {name!r}; SUMO writes it unless --fcd-output.attributes leaves it "
        "out (id,lane,pos,speed,type are needed)"
    )

"""Derive leader-follower pairs from SUMO's floating car data (FCD) output.

SUMO's ``pos`` is the front bumper's position along the lane, so the gap to the vehicle ahead is
``pos_leader - length_leader - pos_follower``; FCD holds no lengths, they are assumed. A pair is
a vehicle and the next one ahead of it on the same lane. Its episode lasts from one timestep to
the next as long as nobody comes between and neither leaves the lane. Without the road network,
a leader beyond the end of the lane is not seen.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain, pairwise
from typing import NamedTuple, Self
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from evofsm.core import positive
from evofsm.driving import VARIABLES
from evofsm.files import LARGEST_OBSERVATION
from evofsm.io.files import OnRead, damage_explained, open_unpacked
from evofsm.io.tables import Piece, Table, explain_text

#: The action of a pair of vehicles: what the follower did until the next timestep.
ACTION = "a_follower"
#: What is known of a pair at one time.
COLUMNS = ("time", *VARIABLES, ACTION)
#: The column by which an FCD table is known.
TIME = "timestep_time"

_BYTES_AT_ONCE = 1 << 16
_ROWS_AT_ONCE = 8192
# Those that the parser knows itself; for any other it would ask Python's codecs.
_ENCODINGS = ("utf-8", "us-ascii", "iso-8859-1", "utf-16")
# What SUMO writes stays far below these, which bound what a file can make of memory: bytes of a tag
# or a comment, tags within tags, characters of a name, vehicles at one time, types remembered.
_LONGEST_TAG = 1_000_000
_DEEPEST = 16
_LONGEST_NAME = 256
_MOST_VEHICLES = 250_000
_MOST_TYPES = 1000
# Rows that pairs on the road may have waiting before all are handed on, each of 32 bytes. It
# bounds memory, at the price of one transition for each pair cut.
_MOST_WAITING = 1_000_000


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


class Episode(NamedTuple):
    """A pair for as long as it stays one: T timesteps."""

    rows: NDArray[np.float64]  #: (T, 5) `COLUMNS`; the action is NaN in the last row
    was_cut: bool  #: the pair went on, in an episode of its own


class PairTable:
    """The pairs in FCD output, as a table with a row for each pair and time.

    Parameters
    ----------
    path : str
        For messages.
    timesteps : iterable of Timestep
    lengths : VehicleLengths
    """

    columns: tuple[str, ...] = COLUMNS

    def __init__(self, path: str, timesteps: Iterable[Timestep], lengths: VehicleLengths) -> None:
        self.path = path
        self._episodes = pair_episodes(checked(path, timesteps), lengths)

    def holds_dates(self, name: str) -> bool:
        """Never: SUMO's clock counts seconds."""
        return False

    def pieces(self, *_: Sequence[str]) -> Iterator[Piece]:
        """All columns, whichever are asked for; episodes end to end, some thousand rows at once."""
        reached, waiting, count = 0, list[Episode](), 0
        for episode in chain(self._episodes, [None]):
            if episode is not None:
                waiting.append(episode)
                count += len(episode.rows)
            if count >= (_ROWS_AT_ONCE if episode is not None else 1):
                for piece in self._joined(waiting, reached):
                    reached += len(piece.places)
                    yield piece
                waiting, count = [], 0
        if reached == 0:
            raise ValueError(f"{self.path}: no vehicle ever follows another one on the same lane")

    def _joined(self, episodes: Sequence[Episode], reached: int) -> Iterator[Piece]:
        table = np.concatenate([episode.rows for episode in episodes])
        starts = np.cumsum([0, *(len(episode.rows) for episode in episodes[:-1])])
        cuts = sum(episode.was_cut for episode in episodes)
        for first in range(0, len(table), _ROWS_AT_ONCE):
            part = table[first : first + _ROWS_AT_ONCE]
            places = np.arange(reached + first + 1, reached + first + len(part) + 1)
            within = starts[(starts >= first) & (starts < first + len(part))] - first
            numbers = dict(zip(COLUMNS, part.T, strict=True))
            yield Piece(self.path, "row", places, numbers, {}, within, 0 if first else cuts)


def pair_episodes(timesteps: Iterable[Timestep], lengths: VehicleLengths) -> Iterator[Episode]:
    """Follow every pair through time; an episode comes out when it ends."""
    open_pairs: dict[tuple[str, str, str], array[float]] = {}
    waiting = 0
    for timestep in timesteps:
        present: dict[tuple[str, str, str], array[float]] = {}
        for follower, leader in pairwise(sorted(timestep.vehicles)):
            if follower.lane != leader.lane:
                continue
            pair = (follower.lane, follower.id, leader.id)
            rows = open_pairs.pop(pair, None) or array("d")
            gap = leader.position - lengths.of(leader.kind) - follower.position
            rows.extend((timestep.time, gap, follower.speed, leader.speed))
            present[pair] = rows
            waiting += 1
        for rows in open_pairs.values():
            waiting -= len(rows) // 4
            yield _episode(rows)
        open_pairs = present
        if waiting > _MOST_WAITING:
            for rows in open_pairs.values():
                yield _episode(rows, was_cut=True)
            open_pairs, waiting = {}, 0
    for rows in open_pairs.values():
        yield _episode(rows)


def _episode(rows: array[float], was_cut: bool = False) -> Episode:
    table = np.array(rows).reshape(-1, 4)
    times, speeds = table[:, 0], table[:, 2]
    with np.errstate(over="ignore"):
        actions = np.append(np.diff(speeds) / np.diff(times), np.nan)
    actions[np.isinf(actions)] = np.nan  # beyond any number: none is known
    return Episode(np.column_stack([table, actions]), was_cut)


def checked(path: str, timesteps: Iterable[Timestep]) -> Iterator[Timestep]:
    """The same timesteps, once it is seen that time runs forward and vehicles are on lanes."""
    before = -math.inf
    lanes = False
    for timestep in timesteps:
        if not timestep.time > before:
            raise ValueError(
                f"{timestep.place}: time goes from {before:g} to {timestep.time:g}; it must run "
                "forward (outputs of two simulations in one file?)"
            )
        before = timestep.time
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

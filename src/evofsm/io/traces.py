"""Read traces of any size from files, in chunks that fit a machine's `learn_many`."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import VARIABLES
from evofsm.fsm import Category, ObservationEncoder
from evofsm.io import fcd, objects
from evofsm.io.blocks import Blocks
from evofsm.io.conditions import Condition
from evofsm.io.fcd import VehicleLengths
from evofsm.io.files import OnRead, file_kind, silent
from evofsm.io.following import ACTION, PairTable
from evofsm.io.osi import mcap_scenes, osi_scenes
from evofsm.io.rosbag import BagTable, Topics
from evofsm.io.tables import CsvTable, ParquetTable, Piece, Table, refuse_unusable
from evofsm.io.units import KNOWN, of_columns

#: Columns that tell episodes apart where nothing else was said and they exist.
USUAL_EPISODE = ("run", "pair", "segment")
#: Steps longer than the usual one times this, or as much shorter, begin a new episode.
LONGEST_STEP = 1.5
# Rows of a file whose steps tell the usual one.
_FIRST_ROWS = 8192
# Speeds [m/s] and usual steps [s] beyond these are most likely in another unit.
_FASTEST, _LONGEST_STEP = 60.0, 10.0
_SPEED = re.compile(r"v([_0-9]|$)|.*(speed|velocity)", re.IGNORECASE)
_MICROSECOND = 1e-6
# Share by which the usual steps of two files may differ.
_SAME_STEP = 0.05


class Chunk(NamedTuple):
    """T consecutive rows of a trace, m variables each."""

    source: str  #: file they come from
    observations: NDArray[np.float64]  #: (T, m)
    actions: NDArray[np.float64]  #: (T,) action taken after each, NaN where none is known
    times: NDArray[np.float64]  #: (T,) [s]
    starts: NDArray[np.int64]  #: (E,) rows at which an episode begins
    dt: float  #: usual time from a row to the next [s]; NaN while no two rows belong together
    jumps: int = 0  #: episodes that begin because of a hole in time
    cuts: int = 0  #: episodes that end because too many pairs were on the road to wait for
    #: (K,) rows with which an episode ended in failure; None where nothing tells of failures
    failures: NDArray[np.int64] | None = None


@dataclass
class Noted:
    """What was noticed while traces were read, for people."""

    units: dict[str, str] = field(default_factory=dict)  #: that columns were converted from
    leaderless: int = 0  #: rows without a leader, left out
    after_failure: int = 0  #: rows left out because the failure before them still held
    unplaced: int = 0  #: failures in rows without a leader, which belong to no episode
    fastest: dict[str, float] = field(default_factory=dict)  #: by variable, beyond belief [m/s]
    longest_step: float = 0.0  #: the usual one, beyond belief [s]

    def see(self, chunk: Chunk, names: Sequence[str]) -> None:
        """Look for speeds and steps that are beyond belief."""
        for name, values in zip(names, chunk.observations.T, strict=True):
            if _SPEED.match(name) and (fastest := float(np.abs(values).max())) > _FASTEST:
                self.fastest[name] = max(fastest, self.fastest.get(name, 0.0))
        if chunk.dt > _LONGEST_STEP:
            self.longest_step = max(chunk.dt, self.longest_step)

    def warnings(self, time: str = "time") -> list[str]:
        """What is most likely a mistake, and what would mend it."""
        found = [
            f"{name} reaches {fastest:,.0f} m/s, faster than any car on a road: is it in km/h or "
            f"mph? --unit {name}=km/h converts it"
            for name, fastest in self.fastest.items()
        ]
        if self.longest_step:
            found.append(
                f"there is a row every {self.longest_step:,.6g} s: is the time in ms? --unit "
                f"{time}=ms converts it"
            )
        if self.unplaced:
            found.append(
                f"{self.unplaced:,} failures lie in rows without a leader, belong to no episode, "
                "and were not counted"
            )
        return found


@dataclass(frozen=True)
class LogColumns:
    """Which columns of a log mean what.

    Parameters
    ----------
    observe : ObservationEncoder
        The variables, each a column of its name.
    action : str
        Column of the action taken from a row to the next.
    time : str
        Column of the time [s]; not read if ``dt`` is given.
    episode : sequence of str, optional
        An episode begins where one of these columns changes, and in each file; without it,
        those of run, pair and segment that exist. The rows of an episode stand together.
    dt : float, optional
        Time from a row to the next [s], for a log without a clock.
    failed : Condition, optional
        The row with which it first holds ends the episode in failure; those after it in which it
        still holds are left out. Without it nothing tells of failures.
    units : mapping, optional
        Units by the column, or the beginning of columns, that are not those of the SI; see
        `evofsm.io.units`.
    leader_may_lack : bool
        Whether a row in which an observed number is missing (an empty field, NaN, infinity) ends
        the episode, and is left out; else it is refused.
    """

    observe: ObservationEncoder = field(default_factory=lambda: ObservationEncoder(*VARIABLES))
    action: str = ACTION
    time: str = "time"
    episode: Sequence[str] | None = None
    dt: float | None = None
    failed: Condition | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    leader_may_lack: bool = False


def read_traces(
    paths: Iterable[str],
    columns: LogColumns | None = None,
    lengths: VehicleLengths | None = None,
    on_read: OnRead = silent,
    noted: Noted | None = None,
    topics: Topics | None = None,
) -> Iterator[Chunk]:
    """Read logs (CSV, Parquet), and recordings in which many vehicles follow each other.

    These are FCD output of SUMO (XML, CSV, Parquet), tables of objects (CSV, Parquet; see
    `evofsm.io.objects`) and traces of ASAM OSI (``.osi``, MCAP). All but Parquet and MCAP may be
    gzipped. Bags of ROS 2 (a folder, or a single ``.mcap`` or ``.db3``) are read as a log is.

    Parameters
    ----------
    paths : iterable of str
        Files, in the order in which they are learnt.
    columns : LogColumns, optional
        What the columns of a log mean. Recordings of many vehicles give gap, v_follower, v_leader
        and a_follower.
    lengths : VehicleLengths, optional
        Lengths assumed for vehicles in FCD.
    on_read : callable, optional
        Called with the number of bytes whenever some were read.
    noted : Noted, optional
        Collects what is noticed in reading.
    topics : Topics, optional
        What the topics of bags mean.

    Yields
    ------
    Chunk
        Some thousand rows, however large the files are. Every file begins an episode.

    Raises
    ------
    ValueError
        If a file is not what it should be; the message names file, line and likely cause. So
        where an episode comes back after another one, of the first 262,144 episodes of a file.

    Notes
    -----
    A file that grows meanwhile is read up to where it was as it was opened, and to the end of that
    line; a warning is logged.
    """
    columns = columns or LogColumns()
    lengths = lengths or VehicleLengths()
    noted = noted or Noted()
    clock = _Clock(columns.dt)
    for path in paths:
        clock.open(path)
        rows, left_out = 0, noted.leaderless
        for chunk in _read_file(path, columns, lengths, clock, on_read, noted, topics):
            rows += len(chunk.times)
            noted.see(chunk, columns.observe.names)
            yield chunk
        if rows == 0 and noted.leaderless > left_out:
            raise ValueError(
                f"{path}: no row has a leader; {', '.join(columns.observe.names)} must all be there"
            )
        if rows == 0:
            raise ValueError(f"{path} has a header but no rows")
    lengths.refuse_unknown()


def _read_file(
    path: str,
    columns: LogColumns,
    lengths: VehicleLengths,
    clock: _Clock,
    on_read: OnRead,
    noted: Noted,
    topics: Topics | None,
) -> Iterator[Chunk]:
    table = _open(path, columns, lengths, on_read, topics)
    if isinstance(table, PairTable):
        columns = _columns_of_pairs(path, columns)
    return _read_table(table, columns, clock, noted)


def _open(
    path: str,
    columns: LogColumns,
    lengths: VehicleLengths,
    on_read: OnRead,
    topics: Topics | None,
) -> Table:
    """The rows of a file, whatever it holds."""
    kind = file_kind(path)
    if kind == "bag":
        if topics is None:
            raise ValueError(
                f"{path} is a bag of ROS 2; --topics names a file that says which field of which "
                "topic is which variable (docs/how-to/logs-of-others.md has one)"
            )
        return BagTable(path, topics, on_read)
    if kind == "run":
        raise ValueError(
            f"{path} is a run that evofsm drove and learnt from: evofsm watch replays it, and "
            "evofsm inspect prints its model"
        )
    if kind in ("osi", "mcap"):
        scenes = (osi_scenes if kind == "osi" else mcap_scenes)(path, on_read)
        return PairTable(path, objects.pairs_of_scenes(path, scenes))
    if kind == "xml":
        return _pairs_of_fcd(path, fcd.xml_timesteps(path, on_read), lengths)
    table: Table = CsvTable(path, on_read) if kind == "csv" else ParquetTable(path, on_read)
    if fcd.TIME in table.columns:
        return _pairs_of_fcd(path, fcd.table_timesteps(table), lengths)
    if objects.holds_objects(table.columns) and not set(columns.observe.names) <= set(
        table.columns
    ):
        return PairTable(path, objects.pairs_of_scenes(path, objects.scenes_of(table)))
    return table


def _pairs_of_fcd(
    path: str, timesteps: Iterator[fcd.Timestep], lengths: VehicleLengths
) -> PairTable:
    return PairTable(path, fcd.pairs_on_lanes(fcd.not_empty(path, timesteps), lengths))


class LoggedRow(NamedTuple):
    """A row of a log, whatever kind of file it comes from."""

    begins: bool  #: an episode
    time: float  #: [s]
    values: dict[str, float]  #: of the variables by name; of a discrete one its codes
    action: float  #: done from this row to the next; NaN where none is known
    failed: bool  #: it ends its episode in failure


def rows_of(chunks: Iterable[Chunk], names: Sequence[str] = VARIABLES) -> Iterator[LoggedRow]:
    r"""The rows of traces, one by one, for whoever decides on each.

    Parameters
    ----------
    chunks : iterable of Chunk
        As `read_traces` yields them.
    names : sequence of str
        Of the variables: ``columns.observe.names``.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "a.csv"
    ...     _ = path.write_text("time,gap,v_follower,v_leader,a_follower\n0,9,20,19,-1\n")
    ...     row = next(rows_of(read_traces([str(path)])))
    >>> row.begins, row.values, row.action
    (True, {'gap': 9.0, 'v_follower': 20.0, 'v_leader': 19.0}, -1.0)
    """
    for chunk in chunks:
        begins = np.zeros(len(chunk.times), np.bool_)
        begins[chunk.starts] = True
        fails = np.zeros(len(chunk.times), np.bool_)
        if chunk.failures is not None:
            fails[chunk.failures] = True
        columns = (begins, chunk.times, chunk.observations, chunk.actions, fails)
        for first, time, values, action, failed in zip(
            *(column.tolist() for column in columns), strict=True
        ):
            yield LoggedRow(first, time, dict(zip(names, values, strict=True)), action, failed)


# -- Time -----------------------------------------------------------------------------------------


class _Clock:
    """Sees that time runs forward, and finds the holes in it.

    The usual step of a file is the median of the steps in the first rows read of it.
    """

    def __init__(self, dt: float | None) -> None:
        self.ticks = dt is None
        self.dt = np.nan if dt is None else dt
        self._first_path = ""

    def open(self, path: str) -> None:
        """Begin a file."""
        self._path = path
        self._last = np.nan
        self._usual = np.nan

    def holes(
        self,
        times: NDArray[np.float64],
        starts: NDArray[np.bool_],
        at: Callable[[int], str],
    ) -> NDArray[np.bool_]:
        """Mark rows that come too late, or too soon, to follow the row before in its episode."""
        steps = np.diff(times, prepend=self._last)
        steps[starts] = np.nan
        self._last = times[-1]
        if (steps <= 0.0).any():
            row = int(np.argmax(steps <= 0.0))
            raise ValueError(
                f"{at(row)}: time goes from {times[row] - steps[row]:g} to {times[row]:g} within "
                "an episode; it must run forward (rows not sorted by time, or several episodes "
                "mixed? --episode names the columns that tell them apart)"
            )
        first = steps[:_FIRST_ROWS]
        if np.isnan(self._usual) and not np.isnan(first).all():
            self._settle(round(float(np.nanmedian(first)), 9))
        unusual = (steps > LONGEST_STEP * self._usual) | (steps < self._usual / LONGEST_STEP)
        return np.asarray(unusual)

    def _settle(self, usual: float) -> None:
        if usual <= 0.0:
            raise ValueError(
                f"{self._path}: a row follows the one before within less than a nanosecond; the "
                "time must be in seconds"
            )
        if np.isnan(self.dt):
            self.dt, self._first_path = usual, self._path
        if not abs(usual / self.dt - 1.0) < _SAME_STEP:
            raise ValueError(
                f"{self._path} has a row every {usual:g} s, but {self._first_path} has one every "
                f"{self.dt:g} s; a machine knows only one step: resample, or learn them apart"
            )
        self._usual = usual


# -- Logs -----------------------------------------------------------------------------------------


class _Sieve:
    """Finds the rows that are learnt, and where episodes begin and fail because of others.

    It knows of the row before the present ones whether a condition held in it, and whether it
    ended its episode.
    """

    def __init__(self, noted: Noted) -> None:
        self._noted = noted
        self._held = self._ended = False

    def sift(
        self,
        anew: NDArray[np.bool_],
        starts: NDArray[np.bool_],
        holds: NDArray[np.bool_] | None,
        lacking: NDArray[np.bool_] | None,
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which rows are kept, and which of them fail; marks ``starts`` after those that end one.

        An episode begins ``anew`` where the log says so, and at ``starts``. What still ``holds``
        is no second failure, and a hole in time does not make it one.
        """
        rows = len(starts)
        kept = np.ones(rows, np.bool_) if lacking is None else ~lacking
        fails = np.zeros(rows, np.bool_)
        if holds is not None:
            before = np.concatenate([[self._held], holds[:-1]]) & ~anew
            self._held = bool(holds[-1])
            fails = holds & ~before
            still = holds & before
            self._noted.unplaced += int((fails & ~kept).sum())
            self._noted.after_failure += int((still & kept).sum())
            fails &= kept
            kept &= ~still
        if lacking is not None:
            self._noted.leaderless += int(lacking.sum())
        ends = fails | ~kept
        starts |= np.concatenate([[self._ended], ends[:-1]])
        self._ended = bool(ends[-1])
        return kept, fails


def _read_table(table: Table, columns: LogColumns, clock: _Clock, noted: Noted) -> Iterator[Chunk]:
    variables = columns.observe.variables
    observed = [v for v in variables if isinstance(v, str)]
    learnt = [*observed, columns.action]
    episode = _episode_columns(table, columns.episode)
    texts = [*episode, *(v.name for v in variables if isinstance(v, Category))]
    others = [columns.time] if clock.ticks else []
    failed = columns.failed
    compared = [failed.column] if failed is not None and failed.sign else []
    texts += [failed.column] if failed is not None and not failed.sign else []
    _refuse_missing(table, columns, [*learnt, *others, *compared], texts)
    dates = [name for name in others if table.holds_dates(name)]
    numbers = [*learnt, *compared, *(name for name in others if name not in dates)]
    factors = _factors(table, columns, numbers, noted)
    only_compared = [name for name in compared if name not in learnt]  # may be infinite
    gaps = learnt if columns.leader_may_lack else []

    rows_before = 0
    blocks = Blocks(episode)
    first_date = np.nan
    sieve = _Sieve(noted)
    for piece in table.pieces(numbers, texts, dates, [*gaps, *only_compared]):
        rows = len(piece.places)
        if rows == 0:
            continue
        for name, factor in factors.items():
            piece.numbers[name] = piece.numbers[name] * factor
        if piece.starts is None:
            starts = blocks.starts(piece)
        else:
            starts = np.zeros(rows, np.bool_)
            starts[piece.starts] = True
        anew, holes = starts.copy(), np.zeros(rows, np.bool_)
        if clock.ticks:
            times = piece.numbers[columns.time]
            if dates:
                first_date = times[0] if np.isnan(first_date) else first_date
                times = (times - first_date) * _MICROSECOND
            holes = clock.holes(times, starts, piece.at)
            starts |= holes
        else:
            times = np.arange(rows_before, rows_before + rows) * np.float64(clock.dt)
        rows_before += rows
        lacking = _lacking(piece, observed) if columns.leader_may_lack else None
        holds = None if failed is None else failed.holds(piece)
        kept, fails = sieve.sift(anew, starts, holds, lacking)
        if not kept.any():
            continue
        for name in gaps:
            if piece.starts is None or name in observed:  # else the action may be derived
                refuse_unusable(piece, name, np.where(kept, piece.numbers[name], 0.0))
        for name in only_compared:
            lacks = kept & np.isnan(piece.numbers[name])
            refuse_unusable(piece, name, np.where(lacks, np.nan, 0.0))
        rows_learnt = slice(None) if kept.all() else kept  # a slice copies nothing
        yield Chunk(
            source=table.path,
            observations=np.column_stack([_encode(piece, v) for v in variables])[rows_learnt],
            actions=piece.numbers[columns.action][rows_learnt],
            times=times[rows_learnt],
            starts=np.flatnonzero(starts[rows_learnt]),
            dt=clock.dt,
            jumps=int(holes[rows_learnt].sum()),
            cuts=piece.cuts,
            failures=None if failed is None else np.flatnonzero(fails[rows_learnt]),
        )


def _factors(
    table: Table, columns: LogColumns, numbers: Sequence[str], noted: Noted
) -> dict[str, float]:
    """What turns columns into units of the SI, by name, for those that need it."""
    try:
        given = of_columns(columns.units, numbers, table.columns, columns.time)
    except ValueError as error:
        raise ValueError(f"{table.path}: {error}") from None
    noted.units |= given
    return {name: KNOWN[unit][1] for name, unit in given.items()}


def _lacking(piece: Piece, observed: Sequence[str]) -> NDArray[np.bool_]:
    """Rows in which a number is missing."""
    lacking = np.zeros(len(piece.places), np.bool_)
    for name in observed:
        lacking |= ~np.isfinite(piece.numbers[name])
    return lacking


def _episode_columns(table: Table, asked: Sequence[str] | None) -> Sequence[str]:
    return [name for name in USUAL_EPISODE if name in table.columns] if asked is None else asked


def _refuse_missing(
    table: Table, columns: LogColumns, numbers: Sequence[str], texts: Sequence[str]
) -> None:
    for name in (*numbers, *texts):
        if name not in table.columns:
            option = {columns.action: "--action", columns.time: "--time"}.get(name)
            option = option or ("--episode" if name in (columns.episode or ()) else "--observe")
            if columns.failed is not None and name == columns.failed.column:
                option = option if name in columns.observe.names else "--failed"
            raise ValueError(
                f"{table.path} has no column {name!r}; it has {_listed(table.columns)} "
                f"({option} names the right one"
                f"{', and --dt stands in for a clock' if option == '--time' else ''})"
            )


def _listed(names: Sequence[str], most: int = 20) -> str:
    more = f" and {len(names) - most:,} more" if len(names) > most else ""
    return ", ".join(name[:40] for name in names[:most]) + more


def _encode(piece: Piece, variable: str | Category) -> NDArray[np.float64]:
    """Columns of the observation for one variable."""
    if isinstance(variable, str):
        return piece.numbers[variable]
    encoder = ObservationEncoder(variable)
    codes = {value: encoder.encode({variable.name: value}) for value in variable.values}
    texts = piece.texts[variable.name]
    for row, value in zip(texts.firsts, texts.values, strict=True):
        if value not in codes:
            raise ValueError(
                f"{piece.at(row)}, column {variable.name!r}: {value[:40]!r} is none of the values "
                f"that --observe names: {', '.join(variable.values)}"
            )
    return np.repeat([codes[value] for value in texts.values], texts.lengths, axis=0)


def _columns_of_pairs(path: str, columns: LogColumns) -> LogColumns:
    """What is read of a recording of many vehicles, with a clock and episodes of its own.

    Raises
    ------
    ValueError
        If something else was asked for.
    """
    asked = [f"--observe {name}" for name in columns.observe.names if name not in VARIABLES]
    asked += [f"--action {columns.action}"] if columns.action != ACTION else []
    asked += ["--episode"] if columns.episode is not None else []
    asked += ["--dt"] if columns.dt is not None else []
    asked += ["--unit"] if columns.units else []
    failed = columns.failed
    if failed is not None and not (failed.sign and failed.column in (*VARIABLES, ACTION)):
        asked += [f"--failed {failed} (but with 'gap<=0')"]
    if asked:
        raise ValueError(
            f"{path} holds many vehicles (FCD of SUMO, objects, OSI), with a clock and episodes of "
            f"their own; it gives {', '.join(VARIABLES)} and the action {ACTION}, and cannot be "
            f"read with {', '.join(asked)}"
        )
    return replace(columns, time="time", leader_may_lack=False)

"""Read traces of any size from files, in chunks that fit a machine's `learn_many`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.io import fcd
from evofsm.io.blocks import Blocks
from evofsm.io.fcd import VehicleLengths
from evofsm.io.files import OnRead, ignore, kind_of
from evofsm.io.plain import Texts
from evofsm.io.tables import CsvTable, ParquetTable, Piece, Table
from evofsm.naming import VARIABLES
from evofsm.observations import Category, ObservationEncoder

#: Columns that tell episodes apart where nothing else was said and they exist.
USUAL_EPISODE = ("run", "pair", "segment")
#: Steps longer than the usual one times this, or as much shorter, begin a new episode.
LONGEST_STEP = 1.5
# Rows of a file whose steps tell the usual one.
_FIRST_ROWS = 8192
# Share by which the usual steps of two files may differ.
_SAME_STEP = 0.05

_ROWS_AT_ONCE = 8192


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
    """

    observe: ObservationEncoder = field(default_factory=lambda: ObservationEncoder(*VARIABLES))
    action: str = fcd.ACTION
    time: str = "time"
    episode: Sequence[str] | None = None
    dt: float | None = None


def read_traces(
    paths: Iterable[str],
    columns: LogColumns | None = None,
    lengths: VehicleLengths | None = None,
    on_read: OnRead = ignore,
) -> Iterator[Chunk]:
    """Read logs (CSV, Parquet) and FCD output of SUMO (XML, CSV, Parquet), gzipped or not.

    Parameters
    ----------
    paths : iterable of str
        Files, in the order in which they are learnt.
    columns : LogColumns, optional
        What the columns of a log mean. FCD gives gap, v_follower, v_leader and a_follower.
    lengths : VehicleLengths, optional
        Lengths assumed for vehicles in FCD.
    on_read : callable, optional
        Is told the number of bytes whenever some were read.

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
    clock = _Clock(columns.dt)
    for path in paths:
        clock.open(path)
        rows = 0
        for chunk in _read_file(path, columns, lengths, clock, on_read):
            rows += len(chunk.times)
            yield chunk
        if rows == 0:
            raise ValueError(f"{path} has a header but no rows")
    lengths.refuse_unknown()


def _read_file(
    path: str, columns: LogColumns, lengths: VehicleLengths, clock: _Clock, on_read: OnRead
) -> Iterator[Chunk]:
    kind = kind_of(path)
    if kind == "xml":
        return _read_fcd(path, fcd.xml_timesteps(path, on_read), columns, lengths, clock)
    table: Table = CsvTable(path, on_read) if kind == "csv" else ParquetTable(path, on_read)
    if fcd.TIME in table.columns:
        return _read_fcd(path, fcd.table_timesteps(table), columns, lengths, clock)
    return _read_log(table, columns, clock)


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


def _read_log(table: Table, columns: LogColumns, clock: _Clock) -> Iterator[Chunk]:
    variables = columns.observe.variables
    numbers = [*(v for v in variables if isinstance(v, str)), columns.action]
    numbers += [columns.time] if clock.ticks else []
    episode = _episode_columns(table, columns.episode)
    texts = [*episode, *(v.name for v in variables if isinstance(v, Category))]
    _refuse_missing(table, columns, numbers, texts)

    rows_before = 0
    key_before: list[str] | None = None
    blocks = Blocks(episode)
    for piece in table.pieces(numbers, texts):
        rows = len(piece.places)
        if rows == 0:
            continue
        keys = [piece.texts[name] for name in episode]
        starts = np.zeros(rows, np.bool_)
        for key in keys:
            starts[key.firsts] = True
        starts[0] = key_before != _key(keys, 0)
        blocks.see(piece, keys, starts)
        jumps = 0
        if clock.ticks:
            times = piece.numbers[columns.time]
            holes = clock.holes(times, starts, piece.at)
            jumps = int(holes.sum())
            starts |= holes
        else:
            times = np.arange(rows_before, rows_before + rows) * np.float64(clock.dt)
        yield Chunk(
            source=table.path,
            observations=np.column_stack([_encode(piece, variable) for variable in variables]),
            actions=piece.numbers[columns.action],
            times=times,
            starts=np.flatnonzero(starts),
            dt=clock.dt,
            jumps=jumps,
        )
        rows_before, key_before = rows_before + rows, _key(keys, rows - 1)


def _key(columns: Sequence[Texts], row: int) -> list[str]:
    """What tells the episode of a row from others."""
    return [column.at(row) for column in columns]


def _episode_columns(table: Table, asked: Sequence[str] | None) -> Sequence[str]:
    return [name for name in USUAL_EPISODE if name in table.columns] if asked is None else asked


def _refuse_missing(
    table: Table, columns: LogColumns, numbers: Sequence[str], texts: Sequence[str]
) -> None:
    for name in (*numbers, *texts):
        if name not in table.columns:
            option = {columns.action: "--action", columns.time: "--time"}.get(name)
            option = option or ("--episode" if name in (columns.episode or ()) else "--observe")
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


# -- FCD ------------------------------------------------------------------------------------------


def _read_fcd(
    path: str,
    timesteps: Iterable[fcd.Timestep],
    columns: LogColumns,
    lengths: VehicleLengths,
    clock: _Clock,
) -> Iterator[Chunk]:
    chosen = _fcd_variables(path, columns)
    waiting: list[fcd.Episode] = []
    rows = 0
    found = False
    for episode in fcd.pair_episodes(fcd.checked(path, timesteps), lengths):
        found = True
        waiting.append(episode)
        rows += len(episode.times)
        if rows >= _ROWS_AT_ONCE:
            yield from _join(path, waiting, chosen, clock)
            waiting, rows = [], 0
    if waiting:
        yield from _join(path, waiting, chosen, clock)
    if not found:
        raise ValueError(f"{path}: no vehicle ever follows another one on the same lane")


def _fcd_variables(path: str, columns: LogColumns) -> list[int]:
    asked = [f"--observe {name}" for name in columns.observe.names if name not in VARIABLES]
    asked += [f"--action {columns.action}"] if columns.action != fcd.ACTION else []
    asked += ["--episode"] if columns.episode is not None else []
    asked += ["--dt"] if columns.dt is not None else []
    if asked:
        raise ValueError(
            f"{path} is FCD output of SUMO, with a clock and episodes of its own; it gives "
            f"{', '.join(VARIABLES)} and the action {fcd.ACTION}, and cannot be read with "
            f"{', '.join(asked)}"
        )
    return [VARIABLES.index(name) for name in columns.observe.names]


def _join(
    path: str, episodes: Sequence[fcd.Episode], chosen: list[int], clock: _Clock
) -> Iterator[Chunk]:
    """Episodes end to end, cut into chunks of a bounded number of rows."""
    times = np.concatenate([episode.times for episode in episodes])
    observations = np.vstack([episode.observations for episode in episodes])[:, chosen]
    actions = np.concatenate([episode.actions for episode in episodes])
    lengths = [len(episode.times) for episode in episodes]
    starts = np.zeros(len(times), np.bool_)
    starts[np.cumsum([0, *lengths[:-1]])] = True
    holes = clock.holes(times, starts, lambda row: path)
    starts |= holes
    cuts = sum(episode.was_cut for episode in episodes)
    for first in range(0, len(times), _ROWS_AT_ONCE):
        part = slice(first, first + _ROWS_AT_ONCE)
        yield Chunk(
            source=path,
            observations=observations[part],
            actions=actions[part],
            times=times[part],
            starts=np.flatnonzero(starts[part]),
            dt=clock.dt,
            jumps=int(holes[part].sum()),
            cuts=cuts if first == 0 else 0,
        )

"""Logs and recordings of any size as chunks that fit a machine's `learn_many`."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from itertools import chain, pairwise
from operator import attrgetter
from shlex import quote
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.naming import RANGES, VARIABLES
from evofsm.driving.naming import UNITS as CAR_UNITS
from evofsm.fsm.naming import in_a_line
from evofsm.fsm.observations import Category, ObservationEncoder
from evofsm.guard.foresight import DATES
from evofsm.io import tables, vehicles
from evofsm.io.tables import MISSING, CsvTable, ParquetTable, Piece, Skips, Table, Wanted, is_number
from evofsm.io.vehicles import ACTION, PairTable, VehicleLengths

if TYPE_CHECKING:
    from evofsm.io.rosbag import Topics

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
#: Columns that tell episodes apart where nothing else was said and they exist.
USUAL_EPISODE = ("run", "pair", "segment", "episode")
#: Steps longer than the usual one times this, or as much shorter, begin a new episode.
LONGEST_STEP = 1.5
_FIRST_ROWS = 8192  # rows of a file whose steps tell the usual one
SKIPPED = 10  #: bad rows of a file that are left out where nobody said how many
# Signals are joined where so many values of each and no whole row are among the first ones.
_FEWEST_VALUES = 5
OLDEST = 0.5  #: so old may a value be that is held, as `Topics` has it [s]
_SAME_STEP = 0.05  # share by which the usual steps of two files may differ
#: Numbers that stand for none, where they are so many times as far out as others of a column.
STAND_INS = [999, 9999, 99999, 999999, 32767, 32768, 65535, 2**31 - 1, 2**31, 2**32 - 1]
_FAR_OUT = 3.0
# Speeds [m/s] and usual steps [s] beyond these are most likely in another unit.
_FASTEST, _LONGEST_USUAL = 60.0, 5.0
# Two witnesses of one thing are compared in more rows than so, and where they go up and down
# together as far as that (a correlation).
_COMPARED, _CORRELATED = 50, 0.9
_SPEED = re.compile(r"v([_0-9]|$)|.*((?i:speed|velocity))")  # V are volts
_MICROSECOND = 1e-6
#: A date with a zone; months in which clocks are put on or back.
ZONE, _CHANGES = re.compile(r"(Z|UTC|[+-]\d\d:?\d\d)$"), (3, 4, 9, 10, 11)
_NO_CAR = "{!r} cannot be right (another unit? --unit; a stand-in for nobody? --no-leader); in SI "

# What may be done about a number that is missing.
_HELD = "signals of several clocks in one table? --hold 0.5 holds the latest values)"
_NO_ACTION = f" (a missing or failed measurement, or {_HELD}"
_LEFT_OUT = "? --no-leader end leaves such rows out; or " + _HELD
_MISSING = " (a missing or failed measurement" + _LEFT_OUT
_NO_LEADER = " (a missing or failed measurement, or no leader" + _LEFT_OUT
_CUT = "{!r} has no line end behind it, and may be cut off: with one it would be a failure"
_MANY_TEXTS = 10  # so many texts of a column are shown
BECOME = ("mean", "last", "max", "min")  #: what the values of a step may become
_HOLE = 10.0  # in steps of what is resampled, the longest hole within an episode
# A value in quotes; and what stands between conditions, outside of quotes.
_IN_QUOTES = re.compile(r"""(["'])(.*)\1$""", re.DOTALL)
_OUTSIDE = r"""(?=(?:[^"']|"[^"]*"|'[^']*')*$)"""
_OR, _AND = (re.compile(rf"\s+{word}\s+{_OUTSIDE}") for word in ("or", "and"))
_SIGNS = {"<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt}
_SIGNS |= {"==": operator.eq, "!=": operator.ne}
_NO_TEXT = {*MISSING} - {"none"}  # which may be a state of its own
_TRUTHS = dict.fromkeys(("true", "yes", "1", "1.0"), True)
_TRUTHS |= dict.fromkeys(("false", "no", "0", "0.0"), False)


class Chunk(NamedTuple):
    """T consecutive rows of a trace, m variables each."""

    observations: Floats  #: (T, m)
    actions: Floats  #: (T,) action taken after each, NaN where none is known
    times: Floats  #: (T,) [s]
    begins: Bools  #: (T,) whether an episode begins with it
    fails: Bools  #: (T,) whether an episode ended with it in failure
    dt: float  #: usual time from a row to the next [s]; NaN while no two rows belong together
    jumps: int = 0  #: episodes that begin because of a hole in time
    tells: bool = False  #: whether anything tells of failures
    names: Sequence[str] = ()  #: of its episodes: who followed whom, in a recording of vehicles

    @property
    def failed(self) -> bool:
        """Whether an episode of it ended in failure."""
        return bool(self.fails.any())

    def rows(self, first: int, end: int) -> Chunk:
        """Some of its rows."""
        before, within = self.begins[:first].sum(), self.begins[:end].sum()
        parts = {name: getattr(self, name)[first:end] for name in _BY_ROW}
        return self._replace(**parts, names=self.names[before:within])


_BY_ROW = ("observations", "actions", "times", "begins", "fails")


@dataclass
class Noted:
    """What was noticed while logs were read, for people."""

    units: dict[str, str] = field(default_factory=dict)  #: of columns, as they were told
    untold: list[str] = field(default_factory=list)  #: columns of which no unit was told
    #: What was left out because it cannot be right, by its kind: how many, and the first.
    skipped: dict[str, tuple[int, str]] = field(default_factory=dict)
    told: list[str] = field(default_factory=list)  #: what else is to be said, as sentences
    #: How many times a rate is what another column says, where they differ: of gap, and action.
    rates: dict[str, float] = field(default_factory=dict)
    leaderless: int = 0  #: rows without a leader, or in which a number is missing, left out
    elsewhere: int = 0  #: rows left out for ``where``
    resampled: int = 0  #: rows of which those that are learnt were made
    crossed: int = 0  #: transitions that nobody knows, across holes within an episode
    after_failure: int = 0  #: rows left out because the failure before them still held
    unplaced: int = 0  #: failures in rows without a leader, which belong to no episode
    began: float = 0.0  #: time 0, where that is a date, since 1970 [s]
    in_utc: bool = False  #: whether times of day are, wherever the log is from
    failing: int = 0  #: rows that meet what tells of failures
    #: By column compared for that, the ends of its range in SI, or texts that were there.
    compared: dict[str, list[float]] = field(default_factory=dict)
    texts: dict[str, list[str]] = field(default_factory=dict)
    fastest: dict[str, float] = field(default_factory=dict)  #: by variable, beyond belief [m/s]
    longest_step: float = 0.0  #: the usual one, beyond belief [s]
    #: By variable, the number below 0 or far out (0 where there are several), and in how many rows.
    below: dict[str, tuple[float, int]] = field(default_factory=dict)
    failed: int = 0  #: episodes
    failed_at_once: int = 0  #: of them, those with one row
    #: What a variable was whenever an episode failed at once, if always the same.
    at_once: dict[str, float] = field(default_factory=dict)

    def si_units(self, names: Sequence[str]) -> list[str]:
        """The units of columns as they were read: of the SI, if they have one there."""
        told_units = dict(zip(VARIABLES, CAR_UNITS, strict=True)) | self.units
        return [tables.SI.get(unit, unit) for unit in (told_units.get(name, "") for name in names)]

    def see(self, chunk: Chunk, names: Sequence[str], *, first: bool = False) -> None:
        """Look for what is beyond belief; in the first rows also for what contradicts itself."""
        if first and set(VARIABLES) <= set(names):
            self._compare_rates(chunk, *(names.index(name) for name in VARIABLES))
        for name, values in zip(names, chunk.observations.T, strict=True):
            if _SPEED.match(name) and (fastest := float(np.abs(values).max())) > _FASTEST:
                self.fastest[name] = max(fastest, self.fastest.get(name, 0.0))
            if len(below := values[(values < 0.0) | are_stand_ins(values)]):
                value, rows = self.below.get(name, (float(below[0]), 0))
                self.below[name] = value if (below == value).all() else 0.0, rows + len(below)
        if chunk.dt > _LONGEST_USUAL:
            self.longest_step = max(chunk.dt, self.longest_step)
        self.failed += int(chunk.fails.sum())
        for row in chunk.observations[chunk.fails & chunk.begins].tolist():
            here = dict(zip(names, row, strict=True))
            before = self.at_once if self.failed_at_once else here
            self.at_once = dict(pair for pair in before.items() if pair in here.items())
            self.failed_at_once += 1

    def _compare_rates(self, chunk: Chunk, gap: int, follower: int, leader: int) -> None:
        """The gap changes as speeds differ, and the own speed as the action says."""
        within = (np.diff(chunk.times) > 0.0) & ~chunk.begins[1:]
        steps = np.diff(chunk.times)[within]
        observations, changes = chunk.observations, np.diff(chunk.observations, axis=0)[within]
        gap_rates = observations[:, leader] - observations[:, follower]
        witnesses = {
            "gap": (changes[:, gap] / steps, 0.5 * (gap_rates[1:] + gap_rates[:-1])[within]),
            "action": (changes[:, follower] / steps, chunk.actions[:-1][within]),
        }
        for kind, (slopes, reports) in witnesses.items():
            is_known = np.isfinite(reports)
            x, y = reports[is_known], slopes[is_known]
            if len(x) > _COMPARED and x.std() > 0.0 < y.std():
                alike = float(np.corrcoef(x, y)[0, 1])
                rate = alike * float(y.std() / x.std())
                if abs(alike) > _CORRELATED and not 0.8 < rate < 1.25:
                    self.rates[kind] = rate


# -- What columns mean ----------------------------------------------------------------------------


def units_of(units: Mapping[str, str], used: Sequence[str]) -> dict[str, str]:
    """The unit of each column in use that was given one, by its name or the beginning of it."""
    column_units: dict[str, str] = {}
    for name in sorted(units, key=lambda name: (name in used, len(name))):
        fit = [name] if name in used else [column for column in used if column.startswith(name)]
        if not fit:
            fault = "no column that is read is called so, or begins so"
            raise ValueError(f"--unit {name}={units[name]}: {fault}; read are {', '.join(used)}")
        column_units |= dict.fromkeys(fit, units[name])
    return column_units


class Term(NamedTuple):
    """A column of truth values, or one that is compared with a number or a text."""

    column: str
    sign: str  #: of the comparison; empty for truth values
    value: float | str

    @classmethod
    def parse(cls, text: str) -> Term:
        """From ``collided``, ``gap<=0`` or ``Status=='off'``; a ValueError if it is none."""
        name, rest = tables.quoted_name(text)
        column, sign, value, *_ = *re.split("([<>]=?|[=!]=|=)", rest, maxsplit=1), "", ""
        column, value, quotation = name + column.strip(), value.strip(), _IN_QUOTES.match(value)
        sign = "==" if sign == "=" else sign
        if not column or bool(sign) != bool(value) or (not sign and _IN_QUOTES.match(column)):
            raise ValueError(text)
        if sign and not quotation and is_number(value) and np.isfinite(float(value)):
            return cls(column, sign, float(value))
        is_odd = not quotation and (is_number(value) or re.search("[<>=]", value))
        if sign[:1] in ("<", ">") or is_odd:
            raise ValueError(text)
        return cls(column, sign, quotation[2] if quotation else value)

    @property
    def of_number(self) -> bool:
        """Whether the column is compared with a number."""
        return isinstance(self.value, float)

    def holds(self, piece: Piece, truth: bool = True) -> Bools:
        """In which rows of a piece it holds, or does not; where nothing stands it never does."""
        if self.of_number:
            values = piece.numbers[self.column]
            return np.asarray((_SIGNS[self.sign](values, self.value) == truth) & ~np.isnan(values))
        texts = piece.texts[self.column].str.strip_chars()
        kinds = texts.unique().to_list()
        return texts.is_in([kind for kind in kinds if self.truth_of(kind) is truth]).to_numpy()

    def leave_out(self, piece: Piece) -> None:
        """Leave out rows of a piece in which there is no truth value, if it asks for one."""
        if not self.sign:
            texts = piece.texts[self.column].str.strip_chars().str.to_lowercase()
            piece.leave_out(
                self.column,
                ~texts.is_in([*_TRUTHS]).to_numpy(),
                "{!r} is no truth value; here a column of 0 and 1, true and false or yes and no is "
                f"needed, or a comparison such as '{self.column}>0' or \"{self.column}=='on'\"",
            )

    def may_end(self, piece: Piece) -> bool:
        """Whether it holds in the last row, perhaps, only as a number was cut off there."""
        if self.column != piece.cut or not self.of_number:
            return False
        value, holds = piece.numbers[self.column][-1], _SIGNS[self.sign]
        with_exponent = 0.0 if value % 1.0 else value
        ends = math.copysign(math.inf, value), with_exponent
        return self.sign == "!=" or not all(holds(end, self.value) for end in ends)

    def fault(self, value: Any) -> str:
        """Why it cannot be told of one value, if that is so."""
        if self._there(value) is None or self.truth_of(value) is not None:
            return ""
        if not self.sign:
            return f"is {value!r}; it must be a truth value: true and false, 1 and 0, yes and no"
        kind = "number" if self.of_number else "text"
        return f"is {value!r}; it is compared with the {kind} {self.value!r}"

    def truth_of(self, value: Any) -> bool | None:
        """Whether it holds of one value; None of nothing, and of what it cannot be told of."""
        value = self._there(value)
        if not self.sign:
            return _TRUTHS.get(str(value).lower())
        target = self.value
        if isinstance(value, bool) and isinstance(target, str):  # JSON's true, for a log's TRUE
            target = _TRUTHS.get(target.lower(), "")
        if value is None or isinstance(value, str) != isinstance(target, str):
            return None
        return bool(_SIGNS[self.sign](value, target))

    def _there(self, value: Any) -> Any:
        """What stands in a field, if anything does; what is compared with always does."""
        text = value.strip() if isinstance(value, str) else value
        is_nothing = str(text).lower() in _NO_TEXT and text != self.value
        return None if is_nothing else text


class Condition(NamedTuple):
    """What holds of some rows: any of these, of each of which all terms hold."""

    either: Sequence[Sequence[Term]] = ()  #: of none it holds nowhere

    @classmethod
    def parse(cls, text: str, option: str = "--failed") -> Condition:
        """Terms with ``and`` and ``or`` between; a name with a sign in it is in double quotes."""
        try:
            return cls([[*map(Term.parse, _AND.split(part))] for part in _OR.split(text)])
        except ValueError:
            raise ValueError(
                f"{option} is {text!r}; write a column of truth values, such as collided, or "
                "compare one with a number or a text, such as 'gap<=0' or \"Status=='off'\", "
                "with 'and' or 'or' between several"
            ) from None

    @property
    def terms(self) -> list[Term]:
        """All of them."""
        return [term for terms in self.either for term in terms]

    def holds(self, piece: Piece, truth: bool = True) -> Bools:
        """In which rows of a piece it holds, or surely does not."""
        inner, outer = (np.logical_and, np.logical_or)[:: 1 if truth else -1]
        parts = [inner.reduce([t.holds(piece, truth) for t in terms]) for terms in self.either]
        start = np.full(piece.rows, bool(parts) and not truth)
        return np.asarray(outer.reduce([start, *parts]))

    def holds_of(self, row: Mapping[str, Any]) -> bool | None:
        """Whether it holds of one row, of values by column; None where that cannot be told."""
        truths = [[t.truth_of(row.get(t.column)) for t in terms] for terms in self.either]
        is_false = all(False in terms for terms in truths)
        return any(map(all, truths)) or (False if is_false else None)


class Resample(NamedTuple):
    """How rows become fewer: those of a step are one."""

    step: float  #: [s]
    #: Of columns: ``"last"``, ``"max"``, ``"min"``; the mean of others.
    how: Mapping[str, str] = {}


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
        those of run, pair, segment and episode that exist. The rows of an episode stand together.
    dt : float, optional
        Time from a row to the next [s], for a log without a clock.
    failed : str, optional
        A column of truth values, or a comparison such as ``"gap<=0"``. The row with which it first
        holds ends the episode in failure. Without it nothing tells of failures.
    units : mapping, optional
        Units by the column, or the beginning of columns, that are not those of the SI: ``"km/h"``.
    usual_units : mapping, optional
        Units by the column of CSV, where neither a row of units nor ``units`` says others.
    no_leader : str, optional
        Rows that end the episode, and are left out: ``"end"``, in which an observed number is
        missing; or a condition, as ``failed`` takes one.
    hold : float, optional
        A field without a value has the latest one, if it is not older than this [s]; rows are those
        with an action. Where no row has all values, 0.5 s.
    skip_bad : int
        So many bad rows of a file are left out, and counted; with more it is refused.
    where : str, optional
        A condition: rows in which it does not hold are left out, and end the episode.
    resample : Resample, optional
        Rows of a step become one; the row that failed stays as it is.
    hole : float, optional
        A hole in time of up to this [s] costs one transition, a longer one begins an episode.
        Without it each does; with ``resample`` it is ten of its steps.
    lengths : VehicleLengths
        Lengths assumed for vehicles in FCD.
    topics : Topics, optional
        What the topics of bags mean.
    acts : bool
        Whether somebody acts; else the action is any column, and means nothing.
    """

    observe: ObservationEncoder = field(default_factory=lambda: ObservationEncoder(*VARIABLES))
    action: str = ACTION
    time: str = "time"
    episode: Sequence[str] | None = None
    dt: float | None = None
    failed: str | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    usual_units: Mapping[str, str] = field(default_factory=dict)
    no_leader: str | None = None
    hold: float | None = None
    skip_bad: int = SKIPPED
    where: str | None = None
    resample: Resample | None = None
    hole: float | None = None
    lengths: VehicleLengths = field(default_factory=VehicleLengths)
    topics: Topics | None = None
    acts: bool = True

    @property
    def longest_hole(self) -> float | None:
        """Up to which a hole costs no episode [s]."""
        return self.hole or (self.resample and _HOLE * self.resample.step)

    @property
    def conditions(self) -> dict[str, Condition]:
        """Those that tell of rows, by their options."""
        nobody = None if self.no_leader == "end" else self.no_leader
        texts = {"--failed": self.failed, "--where": self.where, "--no-leader": nobody}
        return {o: Condition.parse(text, o) for o, text in texts.items() if text is not None}


# -- Reading --------------------------------------------------------------------------------------


def read_traces(
    paths: Iterable[str],
    columns: LogColumns | None = None,
    noted: Noted | None = None,
    on_read: tables.OnRead = lambda count: None,
) -> Iterator[Chunk]:
    r"""Read logs (CSV, Parquet), and recordings in which many vehicles follow each other.

    These are FCD output of SUMO (XML, CSV, Parquet), tables of objects (CSV, Parquet) and traces of
    ASAM OSI (``.osi``, MCAP). All but Parquet and MCAP may be gzipped. Bags of ROS 2 (a folder, or
    a single ``.mcap`` or ``.db3``) are read as a log is.

    Parameters
    ----------
    paths : iterable of str
        Files, in the order in which they are learnt.
    columns : LogColumns, optional
        What the columns of a log mean. Recordings of many vehicles give gap, v_follower, v_leader
        and a_follower.
    noted : Noted, optional
        Collects what is noticed in reading.
    on_read : callable, optional
        Called with the number of bytes whenever some were read.

    Yields
    ------
    Chunk
        Some thousand rows, however large the files are. Every file begins an episode.

    Raises
    ------
    ValueError
        If a file is not what it should be; the message names file, line and likely cause.
    ModuleNotFoundError
        If what reads such a file is not installed; the message has the command that does it.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "a.csv"
    ...     _ = path.write_text("time,gap,v_follower,v_leader,a_follower\n0,9,20,19,-1\n")
    ...     next(read_traces([str(path)])).observations
    array([[ 9., 20., 19.]])
    """
    columns = columns or LogColumns()
    notes, clock, lengths = noted or Noted(), _Clock(columns), columns.lengths
    for path in paths:
        clock.open(path)
        rows, left_out = 0, notes.leaderless + notes.elsewhere
        skips = Skips(columns.skip_bad, notes.skipped, notes.told, on_read)
        table = open_table(path, columns, skips)
        file_columns = _columns_of_pairs(path, columns) if isinstance(table, PairTable) else columns
        chunks = _Reader(table, file_columns, clock, notes).chunks()
        if file_columns.longest_hole:
            chunks = _on_one_clock(chunks, file_columns, notes)
        for chunk in chunks:
            rows += len(chunk.times)
            notes.see(chunk, columns.observe.names, first=rows == len(chunk.times))
            # Before a hole the action is unknown still, where somebody acts.
            yield chunk if columns.acts else chunk._replace(actions=0.0 * chunk.actions)
        if rows == 0 and notes.leaderless + notes.elsewhere > left_out:
            meets = f", and --where {columns.where} must hold" if columns.where else ""
            names = ", ".join(columns.observe.names)
            raise ValueError(f"{path}: no row is left; {names} must all be there{meets}")
        if rows == 0:
            skips.refuse_nothing(f"{path} has a header but no rows")
    lengths.refuse_unknown()
    for kind, times in lengths.overlaps.most_common(1):
        length, width = lengths.size_of(kind)
        notes.told.append(
            f"{times:,} times a vehicle overlaps another one that is not in line with it (type "
            f"{kind!r}): is it narrower than {width:g} m? --vehicle-length "
            f"{quote(f'{kind}={length:g}x0.8')} says its length and width"
        )


def are_unusual(steps: Floats, usual: float) -> Bools:
    """(T,) which steps are much longer or shorter than the usual one."""
    return np.asarray((steps > LONGEST_STEP * usual) | (steps < usual / LONGEST_STEP))


def hours_unsaid(times: Floats, sample: str, before: float = 0.0) -> Floats:
    """(T,) how many hours more went by than dates [s] of a clock say that is put back and on.

    So is one without a zone, as the sample shows, in the night of some Sundays; a step is taken for
    that if it is one of some rows but for the hour. Before the first row so many hours were unsaid.
    """
    steps, hours = np.diff(times), np.zeros(len(times))
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else math.nan
    odd = np.flatnonzero(are_unusual(steps, usual))
    for hour in (1, -1) if not ZONE.search(sample) else ():
        later = steps[odd] + 3600.0 * hour  # of irregular rows a longer step
        is_near = (later >= 0.0) & (later < (1800.0 if hour > 0 else min(12.0 * usual, 1800.0)))
        for row in odd[is_near | ~are_unusual(later, usual)] + 1:
            at = datetime.fromtimestamp(times[row], UTC)
            if at.weekday() == 6 and at.hour < 4 and at.month in _CHANGES:
                hours[row] = hour
    if not (before or hours.any()):  # nearly always
        return hours
    hours = before + np.cumsum(hours)
    anew = np.append(False, steps < -86400.0)  # of another machine, perhaps
    latest = np.maximum.accumulate(np.where(anew, np.arange(len(times)), 0))
    return hours - np.where(latest > 0, hours[latest], 0.0)


def are_stand_ins(values: Floats) -> Bools:
    """(T,) which numbers stand for none, such as -9999 among those from 0 to 100.

    >>> are_stand_ins(np.array([0.0, 1.0, -9999.0, 999.0, np.nan])).tolist()
    [False, False, True, True, False]
    """
    size = np.abs(values)
    are_likely = np.isin(size, STAND_INS)
    usual = size[~are_likely & np.isfinite(size)]
    return np.asarray(are_likely & (size > _FAR_OUT * usual.max(initial=0.0)) & bool(usual.any()))


def episodes_of(chunks: Iterable[Chunk]) -> Iterator[Chunk]:
    """The episodes of chunks, each as one chunk, however many it was read in.

    Parameters
    ----------
    chunks : iterable of Chunk
        As `read_traces` yields them.

    Yields
    ------
    Chunk
        Its ``jumps`` are not told apart by episode.

    Examples
    --------
    >>> t = np.arange(5.0)
    >>> chunk = Chunk(t[:, None], 0.0 * t, t, begins=t % 3.0 == 0.0, fails=t < 0.0, dt=1.0)
    >>> [episode.times.tolist() for episode in episodes_of([chunk.rows(0, 1), chunk.rows(1, 5)])]
    [[0.0, 1.0, 2.0], [3.0, 4.0]]
    """
    parts: list[Chunk] = []
    for chunk in chunks:
        inner = 1 + np.flatnonzero(chunk.begins[1:])
        for first, end in pairwise([0, *inner.tolist(), len(chunk.times)]):
            if chunk.begins[first] and parts:
                yield _joined(parts)
                parts = []
            parts.append(chunk.rows(first, end))
    if parts:
        yield _joined(parts)


class LoggedRow(NamedTuple):
    """A row of a trace, for whoever decides on each."""

    begins: bool  #: an episode
    time: float  #: [s]
    values: dict[str, float]  #: of the variables, by their names
    action: float  #: taken after it, NaN where none is known
    failed: bool  #: whether the episode ended with it in failure


def rows_of(chunks: Iterable[Chunk], names: Sequence[str] = VARIABLES) -> Iterator[LoggedRow]:
    """The rows of chunks, one by one; names are ``columns.observe.names``.

    >>> z, u, no = np.array([[9.0, 20.0, 19.0]]), np.array([-1.0]), np.zeros(1, np.bool_)
    >>> next(rows_of([Chunk(z, u, np.zeros(1), ~no, no, dt=0.1)])).values
    {'gap': 9.0, 'v_follower': 20.0, 'v_leader': 19.0}
    """
    for chunk in chunks:
        columns = (chunk.begins, chunk.times, chunk.observations, chunk.actions, chunk.fails)
        for first, time, values, *rest in zip(*(a.tolist() for a in columns), strict=True):
            yield LoggedRow(first, time, dict(zip(names, values, strict=True)), *rest)


def _joined(parts: Sequence[Chunk]) -> Chunk:
    """Chunks as one; ``jumps`` are those of the last one."""
    arrays: Any = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _BY_ROW}
    return parts[-1]._replace(names=[name for part in parts for name in part.names], **arrays)


def _on_one_clock(chunks: Iterable[Chunk], columns: LogColumns, noted: Noted) -> Iterator[Chunk]:
    """The rows of a step as one, at its end; before a hole within an episode the action is unknown.

    Of a step in which it failed only the row that did is left: what was before was never a whole
    step. The last row may belong to a step that goes on, or have a hole behind it: a chunk leaves
    it to the next one.
    """
    import polars

    step = columns.resample and columns.resample.step
    methods = columns.resample.how if columns.resample else {}
    variables, names = columns.observe.variables, columns.observe.names
    hows = [methods.get(name, "mean") if name in variables else "last" for name in names]
    hows.append(methods.get(columns.action, "mean"))
    remainder: Chunk | None = None
    for chunk in chain(chunks, [None]):
        if not (parts := [part for part in (remainder, chunk) if part is not None]):
            return
        noted.resampled += 0 if chunk is None else len(chunk.times)
        whole = _joined(parts)
        times, fails = whole.times, whole.fails
        begins, places, usual = whole.begins | fails | (not step), times, whole.dt
        begins[0] = True
        if step:
            offset = noted.began % step  # steps are those of the clock
            places, usual = np.floor((times + offset) / step + 1e-9), 1.0
            begins[1:] |= places[1:] != places[:-1]
            times = np.where(fails, times, step * (places + 1.0) - offset)
        first = np.flatnonzero(begins)
        rows = polars.DataFrame(np.column_stack([whole.observations, whole.actions]))
        rows = rows.fill_nan(None).with_columns(step=np.cumsum(begins))  # what lacks does not count
        become = (getattr(polars.nth(k), how)() for k, how in enumerate(hows))
        rows = rows.group_by("step", maintain_order=True).agg(become).drop("step")
        is_whole = np.ones(len(first), np.bool_)
        if step:
            goes_on = ~whole.begins[first[1:]]
            is_whole[:-1] = ~(fails[first[1:]] & (np.diff(places[first]) <= 0.0) & goes_on)
        *observations, actions = rows.to_numpy()[is_whole].T.copy()
        keeps = int(is_whole.sum()) - (chunk is not None and not fails[-1])
        last, first = first[-1], first[is_whole]
        starts = np.diff(np.cumsum(whole.begins)[first], prepend=0) > 0
        holes = are_unusual(np.diff(places[first]), usual) & ~starts[1:]
        actions[:-1][holes] = np.nan
        step_rows = whole._replace(
            observations=np.column_stack(observations),
            actions=actions,
            times=times[first],
            begins=starts,
            fails=fails[first],
        )
        noted.crossed += int(holes[:keeps].sum())
        remainder = None
        if keeps < len(first):
            remainder = whole.rows(int(last), len(fails))._replace(jumps=0)
        if keeps:
            yield step_rows.rows(0, keeps)


def open_table(path: str, columns: LogColumns, skips: Skips) -> Table:
    """The rows of a file, whatever it holds."""
    kind = tables.file_kind(path)
    if kind == "bag" or (kind == "mcap" and columns.topics):  # whatever its profile says
        if columns.topics is None:
            hint = "--topics names a file that says which field of which topic is which variable"
            fault = f"{path} is a bag of ROS 2; {hint}"
            raise ValueError(f"{fault} (docs/how-to/logs-of-others.md has one)")
        from evofsm.io.rosbag import BagTable

        return BagTable(path, columns.topics, columns.observe.names, skips)
    if kind in ("osi", "mcap"):
        return PairTable(path, vehicles.objects_of_osi(path, skips), skips)
    if kind == "xml":
        return PairTable(path, vehicles.fcd_of_xml(path, skips), skips, columns.lengths)
    log_names = {*columns.observe.names, columns.action, columns.time}
    names = log_names.union(vehicles.OBJECT_COLUMNS, vehicles.FCD_COLUMNS)
    table: Table = ParquetTable(path, skips) if kind == "parquet" else CsvTable(path, names, skips)
    if {*columns.observe.names} <= {*table.columns}:
        return table
    if moments := vehicles.fcd_of_table(table):
        return PairTable(path, moments, skips, columns.lengths)
    if {*vehicles.OBJECT_COLUMNS} <= {*table.columns}:
        return PairTable(path, vehicles.objects_of_table(table), skips)
    return table


def _columns_of_pairs(path: str, columns: LogColumns) -> LogColumns:
    """What is read of a recording of many vehicles; what else was asked for is refused."""
    options = [f"--observe {name}" for name in columns.observe.names if name not in VARIABLES]
    options += [f"--action {columns.action}"] if columns.action != ACTION else []
    names = "episode", "dt", "hold", "where", "hole", "resample"
    options += [f"--{name}" for name in names if getattr(columns, name) is not None]
    if columns.no_leader not in (None, "end"):  # who has none is no pair
        options += [f"--no-leader {columns.no_leader}"]
    terms = [] if columns.failed is None else Condition.parse(columns.failed).terms
    if not all(term.of_number and term.column in (*VARIABLES, ACTION) for term in terms):
        options += [f"--failed {columns.failed} (but with 'gap<=0')"]
    options += ["--unit: write it in s, m and m/s"] * bool(columns.units)  # the last one
    if options:
        kind = "many vehicles (FCD of SUMO, objects, OSI), with a clock and episodes of their own"
        columns_there = f"{', '.join(VARIABLES)} and the action {ACTION}"
        fault = f"it gives {columns_there}, and cannot be read with {', '.join(options)}"
        raise ValueError(f"{path} holds {kind}; {fault}")
    return replace(columns, time="time", no_leader=None)


class _Clock:
    """Finds holes in time, by the median step of the first rows; time must run forward."""

    def __init__(self, columns: LogColumns) -> None:
        self.ticks = columns.dt is None
        step = columns.resample.step if columns.resample else columns.dt
        self.dt = np.nan if step is None else step
        self._longest, self._resampled = columns.longest_hole or 0.0, columns.resample is not None
        self._first_path = ""

    def open(self, path: str) -> None:
        self._path, self.began = path, 0.0  # since 1970, of one with dates
        self._last = self._usual = np.nan

    def holes(self, times: Floats, starts: Bools, piece: Piece) -> tuple[Bools, Bools]:
        """Mark rows after a hole in time within an episode, and those that bring nothing later."""
        late = np.zeros(piece.rows, np.bool_)
        if self._longest:  # a row without a time costs no more than itself
            rows = np.where(np.isnan(times), 0, np.arange(1, len(times) + 1))
            times = np.append(self._last, times)[np.maximum.accumulate(rows)]
        steps = np.diff(times, prepend=self._last)
        steps[starts] = np.nan
        if ((steps < 0.0) | ((steps == 0.0) & ~piece.bad & (not self._resampled))).any():
            late = self._late(times, starts, piece)
            on = np.flatnonzero(~late)
            steps[late], steps[on] = np.nan, np.diff(times[on], prepend=self._last)
            steps[starts] = np.nan
            times = np.append(self._last, times[on])
        self._last = times[-1]
        first = steps[:_FIRST_ROWS]
        if np.isnan(self._usual) and not np.isnan(first).all():
            exact = -math.log10(np.spacing(np.nanmax(abs(times))))  # digits that times can have
            # Some stand still for a while, and write less then: of means only what no step fits.
            usual = float(np.nanquantile(first, 0.1 if self._resampled else 0.5))
            self._settle(round(usual, min(9, int(exact))))
        if self._longest:
            return np.asarray(steps > self._longest), late
        return are_unusual(steps, self._usual), late

    def _late(self, times: Floats, starts: Bools, piece: Piece) -> Bools:
        late, latest, began = np.zeros(piece.rows, np.bool_), self._last, self.began
        for row, (time, begins) in enumerate(zip(times.tolist(), starts.tolist(), strict=True)):
            is_late = time < latest or (time == latest and not self._resampled)
            late[row] = not begins and is_late and not piece.bad[row]
            if late[row]:
                summer = "summer time that ends? a larger --skip-bad leaves its hour out; or "
                cause = summer if began and 1800.0 < latest - time <= 3600.0 else ""
                step = f"from {tables.date(began + latest)} to {tables.date(began + time)}"
                piece.skips.leave_out(
                    "time",
                    f"{piece.at(row)}: time goes {step} within an episode; it must run forward "
                    f"({cause}a row twice, rows not sorted by time, a clock of too few digits, or "
                    "several episodes mixed? --episode names the columns that tell them apart, and "
                    "--dt stands in for a clock)",
                )
            latest = latest if late[row] else time
        return late

    def _settle(self, usual: float) -> None:
        self._usual = usual
        if self._resampled:
            if usual > LONGEST_STEP * self.dt:
                steps = f"a row every {usual:g} s, and --resample makes one every {self.dt:g} s"
                hint = f"--resample {usual:g}s at least"
                raise ValueError(f"{self._path} has {steps}, of which most would be holes: {hint}")
            return
        if usual <= 0.0:
            fault = "a row follows the one before within less than a nanosecond"
            raise ValueError(f"{self._path}: {fault}; the time must be in seconds")
        if np.isnan(self.dt):
            self.dt, self._first_path = usual, self._path
        if not abs(usual / self.dt - 1.0) < _SAME_STEP:
            steps = f"a row every {usual:g} s, but {self._first_path} has one every {self.dt:g} s"
            hint = f"--resample {2.0 * max(usual, self.dt):g}s, or learn them apart"
            raise ValueError(f"{self._path} has {steps}; a machine knows only one step: {hint}")


class _Reader:
    """Turns one file into chunks; knows what matters of the rows before those it is given."""

    def __init__(self, table: Table, columns: LogColumns, clock: _Clock, noted: Noted) -> None:
        self._table, self._columns, self._clock, self._noted = table, columns, clock, noted
        self._variables = columns.observe.variables
        self._observed = [v for v in self._variables if isinstance(v, str)]
        usual = [name for name in USUAL_EPISODE if name in table.columns]
        self._episode = usual if columns.episode is None else list(columns.episode)
        self._conditions = columns.conditions
        self._failed = self._conditions.get("--failed", Condition())
        self._terms = [term for c in self._conditions.values() for term in c.terms]
        self._before = 0  # rows
        self._first_date = self._last_date = np.nan
        self._hours = 0.0  # that went by unsaid, as summer time ended
        # How long values are held, 0 for not at all; and those held, with their times.
        self._hold = columns.hold
        self._held_numbers: dict[str, tuple[float, float]] = {}
        self._held_texts: dict[str, str] = {}
        # Episodes that there were, and the latest one.
        self._known: set[tuple[str, ...]] = set()
        self._latest: tuple[str, ...] | None = None
        self._begins = False  # whether one began behind the last row that counts
        # Whether the condition held in the row before, and whether that ended its episode.
        self._held = self._ended = False
        self._kept = self._failed_before = False  # that row; whether what failed turned out later
        self._unknown: Callable[[], str] | None = None  # says where that row has no action

    def chunks(self) -> Iterator[Chunk]:
        action, clock = self._columns.action, self._clock
        request, factors = self._wanted()
        uses = {*self._observed, *(t.column for t in self._terms)}  # who compares knows better
        last_chunk: Chunk | None = None  # until it is known whether its last row failed
        for piece in filter(attrgetter("rows"), self._table.pieces(request)):
            if action not in uses and (odd := are_stand_ins(piece.numbers[action])).any():
                for row in np.flatnonzero(odd).tolist():
                    piece.skips.leave_out("stand-in", partial(piece.told, row, action), 0)
                piece.numbers[action] = np.where(odd, np.nan, piece.numbers[action])
            for name, factor in factors.items():
                piece.numbers[name] = piece.numbers[name] * factor
            if clock.ticks and not request.dates:
                piece.leave_out(self._columns.time, piece.unusable(self._columns.time))
            times = self._times(piece, is_date=bool(request.dates))
            signals = self._fill(piece, times) if clock.ticks else None
            starts, reports = self._starts(piece), np.zeros(piece.rows + 1, np.bool_)
            self._note_compared(piece)
            if signals is not None:
                starts, reports = self._between(starts, *signals)
                piece, times = piece.take(signals[0]), times[signals[0]]
            if not piece.rows:
                if reports[0] and self._kept and last_chunk is not None:  # of the latest row
                    last_chunk.fails[-1] = self._held = self._ended = True
                    self._noted.failing += 1
                continue
            anew, late, holes = starts.copy(), *np.zeros((2, piece.rows), np.bool_)
            if not self._columns.longest_hole:
                starts[[row for row in piece.anew if row < piece.rows]] = True
            if clock.ticks:
                holes, late = clock.holes(times, starts, piece)
            starts |= holes
            self._before += piece.rows
            observations = np.column_stack([_encoded(piece, v) for v in self._variables])
            is_kept, fails = self._sift(piece, anew, starts, late, reports)
            if self._failed_before and last_chunk is not None:
                last_chunk.fails[-1] = True
            if not is_kept.any():
                continue
            if last_chunk is not None:
                yield last_chunk
            first_rows = np.flatnonzero(starts & is_kept)
            episodes = np.searchsorted(piece.starts or (), first_rows, "right") - 1
            rows = slice(None) if is_kept.all() else is_kept  # a slice copies nothing
            last_chunk = Chunk(
                observations=observations[rows],
                actions=piece.numbers[action][rows],
                times=times[rows],
                begins=starts[rows],
                fails=fails[rows],
                dt=clock.dt,
                jumps=int(holes[rows].sum()),
                tells="--failed" in self._conditions,
                names=[piece.names[k] for k in episodes] if piece.names else (),
            )
        if last_chunk is not None:
            yield last_chunk

    def _fill(self, piece: Piece, times: Floats) -> tuple[NDArray[np.int64], Bools] | None:
        """Fill in latest values; say which rows count and tell of failures; None of one clock."""
        there = {name: np.isfinite(values) for name, values in piece.numbers.items()}
        if self._hold is None:
            is_whole = np.logical_and.reduce(list(there.values())).any()
            is_joined = not is_whole and all(mask.sum() > _FEWEST_VALUES for mask in there.values())
            self._hold = OLDEST if is_joined else 0.0
            if self._hold:
                self._noted.told.append(
                    f"{piece.at(0)}: no row has all values, as where signals of several clocks are "
                    f"joined: rows are those with {self._columns.action}, other values the latest, "
                    f"none older than {OLDEST:g} s (--hold)"
                )
        if not self._hold:
            return None
        tells = self._failed.holds(piece)
        tells[-1] &= not any(term.may_end(piece) for term in self._terms)
        rows = np.arange(piece.rows + 1)
        for name in set(piece.numbers) - {self._columns.time}:
            value, since = self._held_numbers.get(name, (np.nan, -np.inf))
            values, when = np.append(value, piece.numbers[name]), np.append(since, times)
            latest = np.maximum.accumulate(np.where(np.append(True, there[name]), rows, 0))
            self._held_numbers[name] = float(values[latest[-1]]), float(when[latest[-1]])
            age = np.abs(times - when[latest[1:]])  # below 0 where another episode begins
            too_old = age > self._hold * (1.0 + 1e-9)
            piece.numbers[name] = np.where(too_old, np.nan, values[latest[1:]])
        for name, texts in piece.texts.items():
            series = texts.replace("", None).forward_fill()
            piece.texts[name] = series.fill_null(self._held_texts.get(name, ""))
            self._held_texts[name] = piece.texts[name][-1]
        return np.flatnonzero(there[self._columns.action]), tells

    def _wanted(self) -> tuple[Wanted, dict[str, float]]:
        """What is read, and what turns columns into units of the SI, for those that need it."""
        table, columns = self._table, self._columns
        clock = []
        if self._clock.ticks:  # a date and a time of day may be two columns
            clock = [columns.time] if columns.time in table.columns else columns.time.split(",")
        categories = [v.name for v in self._variables if isinstance(v, Category)]
        options = {
            **{t.column: option for option, c in self._conditions.items() for t in c.terms},
            **dict.fromkeys([*self._observed, *categories], "--observe"),
            **dict.fromkeys(self._episode, "--episode"),
            **dict.fromkeys(clock, "--time"),
        }
        options.setdefault(columns.action, "--action")  # one that is observed, where nobody acts
        for name, option in options.items():
            if name not in table.columns:
                short = [in_a_line(name[:40]) for name in table.columns[:20]]
                names = ", ".join(f'"{name}"' if "," in name else name for name in short)
                more = f" and {len(table.columns) - 20:,} more" if len(table.columns) > 20 else ""
                how = ", and --dt stands in for a clock" if option == "--time" else ""
                titles = map(in_a_line, table.columns)
                if commas := [title for title in titles if "," in title and name in title]:
                    how = f"; a name with a comma stands in double quotes: '\"{commas[0]}\"'"
                raise ValueError(
                    f"{table.path} has no column {name!r}; it has {names}{more} ({option} names "
                    f"the right one{how})"
                )
        form = columns.units.get(columns.time, "")
        form = form if "%" in form else ""
        is_dated = clock and (form or tables.is_date(" ".join(map(table.first, clock))))
        if len(clock) > 1 and not is_dated:
            fault = f"{' and '.join(clock)} are no date and time of day (--time)"
            hint = "of seconds and nanoseconds make one column, as polars adds them"
            raise ValueError(f"{table.path}: {fault}; {hint}")
        numbers = [*self._observed, columns.action, *(t.column for t in self._terms if t.of_number)]
        numbers = [*dict.fromkeys([*numbers, *([] if is_dated else clock)])]
        usual = columns.usual_units if isinstance(table, CsvTable) else {}
        units = {name: unit for name in numbers if (unit := {**usual, **table.units}.get(name))}
        of_options = {name: unit for name, unit in columns.units.items() if unit != form}
        try:
            units |= units_of(of_options, numbers)
        except ValueError as error:
            raise ValueError(f"{table.path}: {error}") from None
        for name in numbers:
            self._refuse_unit(name, units.get(name, ""))
        self._noted.units |= units
        self._noted.untold += [name for name in numbers if name not in units]
        texts = [*self._episode, *categories, *(t.column for t in self._terms if not t.of_number)]
        factors = {n: tables.UNITS[u] for n, u in units.items() if u in tables.UNITS}
        spares = partial(self._spared, factors)
        return Wanted(numbers, texts, clock if is_dated else (), form, spares), factors

    def _spared(self, factors: Mapping[str, float], piece: Piece) -> Bools:
        """Rows that --where or --no-leader surely leaves out, whatever else stands in them."""
        names = {term.column for term in self._terms if term.of_number}
        si = {name: piece.numbers[name] * factors.get(name, 1.0) for name in names}
        piece = replace(piece, numbers=si)
        nobody, where = (self._conditions.get(o, Condition()) for o in ("--no-leader", "--where"))
        return nobody.holds(piece) | where.holds(piece, truth=False)

    def _refuse_unit(self, name: str, unit: str) -> None:
        """Raise where it is none of the column, or not that of the files before, as both tell."""
        fault, notes = "", self._noted
        if unit in tables.UNITS and (unit in tables.TIMES) != (name == self._columns.time):
            fault = f"the unit {unit}; the column of the time needs a unit of time, and no other "
            fault += "one may have it (--unit says which it has)"
        elif name in notes.units or name in notes.untold:
            before = notes.units.get(name, "")
            factor = tables.UNITS.get(unit or before, 1.0)
            is_other = tables.SI.get(unit, unit) != tables.SI.get(before, before)
            if is_other and ((unit and before) or factor != 1.0):
                remedy = f"--unit {quote(f'{name}={unit or before}')} says one for all"
                remedy = remedy if factor != 1.0 else "learn them apart"
                before = before or "no unit"
                fault = f"{unit or 'no unit'}, and {before} in the files before; {remedy}"
        if fault:
            raise ValueError(f"{self._table.path}: column {name!r} has {fault}")

    def _times(self, piece: Piece, *, is_date: bool) -> Floats:
        if not self._clock.ticks:
            return np.arange(self._before, self._before + piece.rows) * np.float64(self._clock.dt)
        times = np.where(piece.bad, np.nan, piece.numbers[self._columns.time])
        if not is_date:
            is_excel = np.abs(times - 3.9e9) < 8e8  # days since 1899-12-30
            self._noted.in_utc |= bool(times[0] >= DATES and not is_excel[0])
            return np.where(is_excel, times - 2_209_161_600.0, times)
        if np.isnan(self._first_date):
            self._first_date = times[np.argmin(np.isnan(times))]
            self._noted.began = self._clock.began = float(self._first_date) * _MICROSECOND
        dates = np.append(self._last_date, times) * _MICROSECOND
        sample = self._table.first(self._columns.time.rpartition(",")[2])
        self._noted.in_utc |= ZONE.search(sample) is not None
        hours = hours_unsaid(dates, sample, self._hours)
        for row in np.flatnonzero(np.diff(hours))[: not self._hours]:
            self._noted.told.append(
                f"{piece.at(int(row))}: summer time ends or begins; hours run on there, and what "
                "is said of later rows is as if the clock had not been changed"
            )
        self._last_date, self._hours = times[-1], hours[-1]
        return (times - self._first_date) * _MICROSECOND + 3600.0 * hours[1:]

    def _starts(self, piece: Piece) -> Bools:
        """The rows that begin another episode, of which all rows have to stand together."""
        starts = np.zeros(piece.rows, np.bool_)
        if piece.starts is not None:
            starts[piece.starts] = True
            return starts
        keys = [piece.texts[name] for name in self._episode]
        for key in keys:
            starts[1:] |= (key[1:] != key[:-1]).to_numpy()
        starts[0] = self._latest != tuple(key[0] for key in keys)
        self._latest = tuple(key[-1] for key in keys)
        rows = np.flatnonzero(starts)
        texts, ends = (key.gather(rows) for key in keys), [*rows[1:].tolist(), piece.rows]
        for row, end, *episode in zip(rows.tolist(), ends[: len(rows)], *texts, strict=True):
            if piece.spared[row:end].all():  # what is between batches comes back
                continue
            if tuple(episode) in self._known and any(map(str.strip, episode)):
                names = ", ".join(self._episode)
                raise ValueError(
                    f"{piece.at(row)}: the episode {', '.join(text[:40] for text in episode)} "
                    f"({names}) comes back after another one, and each block of its rows would be "
                    f"taken for an episode of its own; sort the file by {names} and then by time"
                )
            self._known.add(tuple(episode))
        starts[[row for row in piece.headers if row < piece.rows]] = True
        return starts

    def _between(self, starts: Bools, rows: NDArray[np.int64], tells: Bools) -> tuple[Bools, Bools]:
        """Of rows that count which begin an episode, and which failed as one between them tells.

        That is the next one of its episode, else the one before; the first is of a piece before.
        """
        counts = np.cumsum(np.append(self._begins, starts))  # episodes
        there, episodes = np.concatenate([[0], counts[rows + 1], [-1]]), counts[1:][tells]
        self._begins = counts[-1] > there[-2]
        place = np.searchsorted(rows, np.flatnonzero(tells)) + 1
        place -= there[place] != episodes
        place = place[there[place] == episodes]
        return np.diff(there[:-1]) > 0, np.isin(np.arange(len(rows) + 1), place)

    def _sift(
        self, piece: Piece, anew: Bools, starts: Bools, late: Bools, reports: Bools
    ) -> tuple[Bools, Bools]:
        """Which rows are kept, and which of them fail; marks ``starts`` after those that end one.

        An episode begins ``anew`` where the log says so, and at ``starts``. A condition that still
        holds is no second failure, and a hole in time does not make it one. Some rows fail as
        others say, by ``reports``; the first of these is of the row before.
        """
        columns, failed = self._columns, self._failed
        action = columns.action
        is_incomplete, elsewhere = np.zeros((2, piece.rows), np.bool_)
        if columns.no_leader or columns.resample or self._hold:
            for name in self._observed:
                is_incomplete |= ~np.isfinite(piece.numbers[name])
        nobody = self._conditions.get("--no-leader", Condition()).holds(piece)
        if "--where" in self._conditions:
            elsewhere = ~self._conditions["--where"].holds(piece)
        is_incomplete |= nobody
        is_left_out = is_incomplete | elsewhere
        cars = VARIABLES if self._observed == [*VARIABLES] else ()
        for name in self._observed:
            hint = _NO_LEADER if cars else _MISSING
            piece.leave_out(name, piece.unusable(name) & ~is_left_out, hint=hint)
        for name, span in zip(cars, RANGES, strict=False):
            why = f"{_NO_CAR}it lies between {span[0]:g} and {span[1]:g}"
            piece.leave_out(name, piece.unusable(name, *span) & ~is_left_out, why)
        unknown = np.isnan(piece.numbers[action])
        piece.leave_out(action, piece.unusable(action) & ~is_left_out & ~unknown)
        if not (self._table.derives or columns.resample or action in self._observed):
            self._count_unknown(piece, unknown & ~is_left_out, starts)
        for term in failed.terms:
            if term.of_number and term.column not in self._observed:
                piece.leave_out(term.column, np.isnan(piece.numbers[term.column]) & ~is_left_out)
        for term in self._terms:
            term.leave_out(piece)
        holds = (failed.holds(piece) | reports[1:]) & ~nobody
        is_kept = ~(is_left_out | piece.bad | late)
        for row in np.flatnonzero(late)[::-1]:  # whose time the row before has
            holds[max(row - 1, 0)] |= holds[row]
        for row in np.flatnonzero(late):
            holds[row] = holds[row - 1] if row else self._held
        self._noted.failing += int(holds.sum() + reports[0])
        before = np.append(self._held, holds[:-1]) & ~anew
        self._held = bool(holds[-1])
        fails, still = holds & ~before, holds & before
        if fails[-1] and any(term.may_end(piece) for term in failed.terms):
            piece.leave_out(piece.cut, np.arange(piece.rows) == piece.rows - 1, _CUT)
            fails[-1] = is_kept[-1] = False
        # What fails as it is left out is the end of the episode before.
        prior_ends = fails & ~is_kept & ~starts & np.append(self._kept, is_kept[:-1])
        still |= prior_ends  # it is over
        self._noted.unplaced += int((fails & ~is_kept & ~prior_ends).sum())
        self._noted.after_failure += int((still & is_kept).sum())
        self._failed_before = bool(prior_ends[0] | (reports[0] & self._kept))
        fails = (fails & is_kept) | np.append(prior_ends[1:], False)
        is_kept &= ~still
        self._noted.elsewhere += int((elsewhere & ~is_incomplete).sum())
        self._noted.leaderless += int(is_incomplete.sum())
        if columns.no_leader or not columns.longest_hole:
            elsewhere |= is_incomplete
        if not columns.longest_hole:
            elsewhere |= piece.bad
        ends = fails | still | elsewhere
        ends[late] = False
        starts |= np.append(self._ended, ends[:-1])
        counts = np.cumsum(starts)  # an episode whose first rows are left out begins with the next
        starts[is_kept] = np.diff(counts[is_kept], prepend=0) > 0
        self._ended = bool(ends[-1] or counts[-1] > counts[is_kept].max(initial=0))
        self._kept = bool(is_kept[-1])
        return is_kept, fails

    def _note_compared(self, piece: Piece) -> None:
        """What stands in the columns that tell of failures, should no row meet what is asked."""
        for term in self._failed.terms:
            if term.of_number:
                ends = self._noted.compared.setdefault(term.column, [])
                values = piece.numbers[term.column]
                values = np.append(ends, values[np.isfinite(values)])
                ends[:] = [values.min(), values.max()] if len(values) else []
            elif term.sign:
                texts = self._noted.texts.setdefault(term.column, [])
                texts[:] = sorted({*texts, *piece.texts[term.column].unique()})[:_MANY_TEXTS]

    def _count_unknown(self, piece: Piece, unknown: Bools, starts: Bools) -> None:
        """Count rows without an action, but the last ones of episodes, which need none."""
        if self._unknown is not None and not starts[0]:
            piece.skips.leave_out("action", self._unknown)
        message = partial(piece.told, name=self._columns.action, hint=_NO_ACTION)
        for row in np.flatnonzero(unknown[:-1] & ~starts[1:]).tolist():
            piece.skips.leave_out("action", partial(message, row))
        self._unknown = partial(message, piece.rows - 1) if unknown[-1] else None


def _encoded(piece: Piece, variable: str | Category) -> Floats:
    if isinstance(variable, str):
        return piece.numbers[variable]
    encoder = ObservationEncoder(variable)
    codes = np.array([encoder.encode({variable.name: value}) for value in variable.values])
    places = {value: place for place, value in enumerate(variable.values)}
    indices = piece.texts[variable.name].replace_strict(places, default=-1).to_numpy()
    if (indices < 0).any():
        why = "{!r} is none of the values that --observe names: " + ", ".join(variable.values)
        piece.leave_out(variable.name, indices < 0, why)
    return np.asarray(codes[indices], np.float64)

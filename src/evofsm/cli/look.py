"""A first look at a log, before anybody said what its columns mean: what is in it, what to ask."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from shlex import quote

import numpy as np
import polars
from numpy.typing import NDArray

from evofsm.cli.learning import range_of, unit_in
from evofsm.cli.options import in_quotes, quoted, seconds
from evofsm.cli.show import facts, say, show
from evofsm.guard.foresight import span
from evofsm.io import tables
from evofsm.io.logs import SKIPPED, USUAL_EPISODE, are_stand_ins, are_unusual, hours_unsaid
from evofsm.io.tables import TIMES, CsvTable, ParquetTable, Skips, Wanted, explained, is_date

Pairs = list[tuple[str, str]]
Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

# So many fields and rows are looked at; columns of more texts are no list of states.
_MOST_FIELDS, _ROWS_LOOKED_AT, _MOST_TEXTS = 20_000_000, 500_000, 12
_EPOCHS = {"ns": 1e9, "us": 1e6, "ms": 1e3, "s": 1.0}  # times since 1970 are larger by far
_COLUMNS_SHOWN, _RISING = 40, 0.9  # columns; in so many steps rises what only counts
_SIGNS = "<>=! "  # what in a name of a condition is ambiguous
_FAR = 2.0  # far outside is what lies so many ranges of 99 % of the rows beyond them
_NEAR = 3  # rows before a failure that are never proposed to be left out
# A larger share of steps, and so many, that are no usual one make no clock; of bad rows no log.
_ODD, _MANY, _MANY_BAD = 0.001, 10, 0.05
_NAME = "(time|zeit|timestamp|sec|epoch|x_value)([^a-z]|$)"  # the last is LabVIEW's
_TIME = re.compile(rf"ts?([\W_]*[mun]?s|[\W_]+(min|h|d))?\W*$|{_NAME}", re.IGNORECASE)
_CLOCK = re.compile("times?|(time)?stamps?|ticks?|sec(ond)?s?|epoch|elapsed|zeit(stempel)?", re.I)
_FRAME = re.compile("frame([^a-z]|$)", re.IGNORECASE)  # it counts steps of the same length
# Other dates: the year first, or the day or the month, which may be a name.
_OTHER = re.compile(r"(\d+)([/ -])(\w+)\2(\d{2,4})(,? )\d\d?:\d\d(:\d\d(\.\d+)?)?( [AP]M)?$", re.I)
# Numbers that are dates, by how many digits they have; no clock since 1970 has so many.
_COMPACT = {14: "%Y%m%d%H%M%S", 12: "%Y%m%d%H%M"}
_WORDS = re.compile(r"[A-ZÄÖÜ]+(?![a-zäöüß])|[A-ZÄÖÜ]?[^\W\d_A-ZÄÖÜ]+")  # in a name
# What somebody sets is called so, or has such a word; or one of these, and none of the last.
_ACTION = re.compile("u|acc(el(eration)?)?", re.IGNORECASE)
_SET = re.compile("actions?|cmd|commands?|throttle|setpoint|soll.*|.*soll|stell.*", re.IGNORECASE)
_MAY_SET = re.compile("set|valves?|.*ventil", re.IGNORECASE)
_MEASURED = re.compile("temp.*|press.*|.*druck|vib.*|rms|curr.*|strom|flow|leak.*|no|nr|id", re.I)
_FAILURE = re.compile(
    "st(ö|oe)r|(?<!de)fault|fail|trip|alarm|error|fehler|defek|ausfall|crash|colli|not-?aus|emerg",
    re.IGNORECASE,
)
# How well it went: no failure, and nothing that a live row has before it acts.
_OUTCOME = re.compile(
    r"(is_?)?success(ful)?|(goal_?)?reached(_goal)?|goal|solved|(timelimit\.)?truncated|time_?out|"
    "reward|return|next_.*",
    re.IGNORECASE,
)
_TRUTH = re.compile("true|false|yes|no|ja|nein|wahr|falsch|", re.IGNORECASE)
_TAG = re.compile("(^|_)tag|signal|sensor|variab|channel|kanal|param|messst|name|entity", re.I)
_WHO = re.compile("ma(sch|ch)ine|device|ger(ä|ae)t|asset|unit|anlage|pump|motor|(^|_)id$", re.I)
_CODE = re.compile(f"{_FAILURE.pattern}|stat|zustand|code", re.IGNORECASE)
_LONG = "20ms 50ms 100ms 200ms 500ms 1s 2s 5s 10s 20s 30s 1min 2min 5min 10min 30min 1h 5h 10h 1d"
_NICE = [(seconds("", text), text) for text in _LONG.split()]
_RUNS = "--episode", "run"  # where runs are numbered first


def show_look(files: Sequence[str], table: CsvTable | ParquetTable) -> None:
    """Print what is in the first of some logs, and a way to learn from them."""
    file, title = files[0], f"What {files[0]} holds"
    contents, options, before = look_at(table)
    if len(files) > 1:
        title += f", the first of {len(files):,} files; the others were not looked at"
        options = [option for option in options if option != _RUNS]
    show(facts(title, contents))
    if not (options or before):
        texts = (explained(table.first(n)) for n in table.columns if table.holds(n) == "text")
        why = next((f": {text}" for text in texts if "thousands" in text), "")
        kind = "other column" if "two columns" in dict(contents) else "column"
        raise ValueError(f"{file} has no {kind} of numbers that change{why}")
    to_file = "--guard" if any(name == "--failed" for name, _ in options) else "--out"
    options += [(to_file, f"{to_file[2:]}.evofsm")] if options else []
    say("\nA way to learn from it:")
    if before and len(files) == 1:
        kind = "csv" if isinstance(table, CsvTable) else "parquet"
        mark, how = f", separator={table.separator!r}" * (kind == "csv"), ", infer_schema=False"
        suffix = "runs" if _RUNS in options else "sorted"
        files = [f"{Path(file).name.partition('.')[0]}-{suffix}.{kind}"]
        read = f"p.read_{kind}({file!r}{mark}{how * bool(mark)})"
        code = f"{read}{before}.write_{kind}({files[0]!r}{mark})"
        say(f"  python -c {in_quotes(f'import polars as p; {code}')}")
    command = [f"evofsm learn {' '.join(map(quote, files))}"]
    command += (f"{name} {in_quotes(value)}" for name, value in options)
    say("  " + " \\\n      ".join(command))


def look_at(table: CsvTable | ParquetTable) -> tuple[Pairs, Pairs, str]:
    """What the first rows hold, options that could be asked for, and how polars sorts before."""
    skips, odd, asides = dict[str, tuple[int, str]](), dict[str, int](), Pairs()
    table.skips = Skips(1 << 60, skips)
    frame, clock, form = _first_rows(table, odd, asides)
    if not len(frame):
        table.skips.refuse_nothing(f"{table.path} has a header but no rows")
    numbers = [name for name, kind in frame.schema.items() if kind.is_numeric() and name != clock]
    units = {n: table.units.get(n) or unit_in(n, is_time=False) for n in ("", *numbers)}
    values, stand_ins = dict[str, Floats](), dict[str, Floats]()
    for name, z in ((name, frame[name].to_numpy()) for name in numbers):
        if np.isfinite(z).any():
            for_none, z = are_stand_ins(z), z * tables.UNITS.get(units[name], 1.0)
            stand_ins[name] = np.unique(z[for_none])
            values[name] = np.where(for_none | np.isinf(z), np.nan, z)
    texts = [name for name in frame.columns if frame[name].dtype == polars.String]
    runs, still = np.ones(len(frame), np.bool_), next((n for n in values if _stands(values[n])), "")
    limit = _round(0.1 * float(np.nanquantile(np.abs(values[still]), 0.95))) if still else 0.0
    runs = values[still] > limit if still else runs
    outcomes = [name for name in (*texts, *values) if _OUTCOME.fullmatch(name)]
    rare = [*_rare(frame, [n for n in (*texts, *values) if n not in {*USUAL_EPISODE, *outcomes}])]
    likely = [row for row in rare if _FAILURE.search(row[1])]
    kinds = {name: frame[name].unique().to_list() for name in texts}
    truths = {name for name in texts if all(map(_TRUTH.fullmatch, kinds[name]))}
    remarks = {name for name in texts if len({*kinds[name]} - {*tables.MISSING}) == 1}
    marks = [row for row in rare if row[0] in {*values, *truths}]
    rare = likely or marks or [row for row in rare if row[0] in remarks and len(row[-1]) > 1]
    markers = {name for name, *_ in rare}  # which do not tell episodes apart
    groups = [name for name in (*USUAL_EPISODE, *texts, *values) if name in frame.columns]
    groups = [n for n in groups if n not in {*markers, *outcomes} and not _FAILURE.search(n)]
    group, order = _episodes(frame, clock, groups)
    segments = _numbered(frame[group])[order] if group else np.zeros(len(frame))
    is_count = bool(clock) and not group and table.holds(clock) == "number"
    begins = _begins_anew(frame[clock].to_numpy()) if is_count else None
    segments = segments if begins is None else np.cumsum(begins)
    places, is_mixed = np.argsort(order), bool((np.diff(order) != 1).any())
    ends = [np.append(np.flatnonzero(np.diff(segments)), -1)]
    ends += [places[rows] for *_, rows in rare[:1]]
    last = np.concatenate(ends)  # of an episode, or a failure's first
    columns = dict[str, str]()
    for name, z in values.items():
        columns[name] = _range(name, z[order], (runs | (name == still))[order], last)
        if tables.UNITS.get(units[name], 1.0) != 1.0:
            columns[name] += f" {tables.SI[units[name]]}, from {units[name]}"
        if len(stand_ins[name]):
            columns[name] += f"; {', '.join(f'{x:g}' for x in stand_ins[name])} for none"
    columns |= {name: _told(frame[name]) for name in texts}
    facts = [*columns.items()][:_COLUMNS_SHOWN]
    if more := len(columns) - len(facts):
        facts.append(("...", f"and {more:,} more columns"))
    if twice := dict.fromkeys(n for n in table.columns if n and table.columns.count(n) > 1):
        facts.append(("two columns", f"are called {', '.join(twice)}; each needs its own name"))
    n_partial = int(np.isnan([runs, *values.values()]).any(0).sum())
    facts += [("incomplete", f"{n_partial:,} rows, in which a number is missing")] * (n_partial > 0)
    facts += [("bad fields", f"{n:,} {text}") for text, n in odd.items()]
    facts += [(f"bad {kind}s", f"{n:,}, the first: {first}") for kind, (n, first) in skips.items()]
    if is_mixed and not group:
        asides.append(("time runs", "backwards; turn the rows round first, as below"))
    facts += [*asides, ("rows looked at", f"{len(frame):,}")]
    counts = not clock or _FRAME.match(clock) is not None
    options = [("--dt", "1")] if counts and not form else [("--time", clock or form)]
    options += [("--unit", form)] if form and not counts else []
    bad = sum(n for kind, (n, _) in skips.items() if kind != "letter") + sum(odd.values())
    if not counts:
        at, rows = frame[clock].to_numpy()[order], np.ones(len(frame), np.bool_)
        there = {name: np.isfinite(z[order]) for name, z in values.items()}
        there = {name: rows for name, rows in there.items() if rows.sum() > _MANY}
        if there and not np.logical_and.reduce([*there.values()]).any():  # of several clocks
            age = max(float(np.median(np.diff(at[rows]))) for rows in there.values())
            hold = next((nice for nice, _ in _NICE if nice >= 3.0 * age), _NICE[-1][0])
            options.append(("--hold", f"{hold:g}"))
            rows = there[next(filter(_is_set, there), next(iter(there)))]
            at, n_partial = at[rows], 0
        further, n_late = _of_steps(at, segments[rows], facts, n_partial)
        options, bad = options + further, bad + n_late
    bad = max(bad, n_partial * ("--resample" not in dict(options)))  # there they cost nothing else
    if bad > max(SKIPPED, _MANY_BAD * len(frame)):
        facts.append(("to repair", f"{bad:,} rows, as above: too many to be left out (--skip-bad)"))
    elif bad > SKIPPED:
        options.append(("--skip-bad", f"{_round(2.0 * bad):.0f}"))
    if still:
        options.append(("--where", f"{_named(still, _SIGNS)}>{limit:g}"))
        facts.append(("stands still", f"in {1.0 - runs.mean():.1%} of rows, by {still}"))
    tags = [name for name in texts if _TAG.search(name) and group in ("", name)]
    tag = next((name for name in tags if group or _takes_turns(frame[name])), "")
    many = [n for n, z in values.items() if len(np.unique(z)) > 1 and "qual" not in n.lower()]
    if clock and tag and len(many) == 1:
        facts.append(("a row?", f"of each {tag} its own: make columns of them, and look again"))
        pivot = f"{tag!r}, index={clock.split(',')}, values={many}"
        return facts, [], f".pivot({pivot}, aggregate_function='last')"
    facts += [("a failure?", f"{text} {frequency}") for _, text, frequency, _ in rare]
    untold = "no column tells of one; docs/logs.md makes one of times, or of the last rows of runs"
    facts += [] if rare else [("a failure?", untold)]
    if rare and 1 < len(rare[0][-1]) == len({*segments.tolist()}):
        facts.append(("", "all episodes end so: if some end well, another condition has to say it"))
    if outcomes:
        facts.append(("left out", f"{', '.join(outcomes)}: how well it went, not where it fails"))
    options += [("--failed", text) for _, text, *_ in rare[:1]]
    before = f".sort({group!r}, maintain_order=True)" if group else ".reverse()"
    if begins is not None:
        facts.append(("an episode?", f"where {clock} begins anew: number these runs"))
        options, is_mixed = [*options, _RUNS], True
        falls = f"(p.col({clock!r}).cast(float).diff() < 0).fill_null(False)"
        before = f".with_columns(run={falls}.cum_sum())"
    if group:
        mend = f", but mixed: sort rows by {group} and then by {clock} first, as below"
        facts.append(("an episode?", f"each {group}{mend if is_mixed else ''}"))
        options.append(("--episode", _named(group, ",")))
    labels = {n for n, z in values.items() if _FAILURE.search(n) and {*np.unique(z)} == {0.0, 1.0}}
    no_variables = {group, *markers, *labels, *outcomes}
    spans = {n: z[runs] for n, z in values.items() if n not in no_variables}
    spans = {n: np.nanquantile(z, (0.02, 0.98)) for n, z in spans.items()}
    if still in spans and spans[still][1] < 1.05 * spans[still][0]:  # it is always the same
        del spans[still]
    there = {n: np.isfinite(values[n][order]) for n in spans}
    moves = {n: np.diff(values[n][order][rows]) for n, rows in there.items()}
    steps = {n: moves[n][np.diff(segments[rows]) == 0.0].tolist() for n, rows in there.items()}
    # What goes on by the same from row to row of an episode is a count of them.
    steady = {n: e.tolist() for n, e in spans.items() if e[1] > e[0] and len({*steps[n]}) > 1}
    one_way = [n for n in steady if len(last) > 2 and len(set(np.sign(moves[n])) - {0.0}) == 1]
    if one_way and len(one_way) < len(steady):
        facts.append(("left out", f"{', '.join(one_way)}: never comes back, as an odometer"))
        steady = {n: ends for n, ends in steady.items() if n not in one_way}
    if action := next(filter(_is_set, steady), ""):
        facts.append(("an action?", f"{action}, by its name; where nobody sets it: --action ''"))
    nobody = [f"{_named(n, _SIGNS)}=={x:.17g}" for n in steady if n != action for x in stand_ins[n]]
    options += [("--no-leader", " or ".join(nobody))] if nobody else []
    for n in dict.fromkeys((*steady, still)):
        if units[n] and not table.units.get(n):
            options.append(("--unit", f"{_named(n, '=')}={units[n]}"))
    levels = np.unique(values[action][np.isfinite(values[action])]) if action else np.zeros(0)
    return facts, _of_numbers(steady, action, levels, options), before if is_mixed else ""


def _first_rows(
    table: CsvTable | ParquetTable, odd: dict[str, int], asides: Pairs
) -> tuple[polars.DataFrame, str, str]:
    """Their columns, the clock in seconds, which one that is, and how it is written if oddly."""
    firsts = {name: table.first(name).strip() for name in table.columns if table.holds(name)}
    pairs = [*zip(firsts, [*firsts][1:], strict=False)]
    date_columns = [name for name, text in firsts.items() if is_date(text)]
    of_day = [name for name, text in firsts.items() if re.match(r".*:|\d{4}(\d\d)?$", text)]
    alone = ((a, b) for a, b in pairs if a not in date_columns and b in of_day)
    together = (f"{a},{b}" for a, b in alone if is_date(f"{firsts[a]} {firsts[b]}"))
    early = next(table.pieces(Wanted([], date_columns))).texts if date_columns else {}
    table.skips.kinds.clear()  # said where all rows are read
    clocks = (name for name, dates in early.items() if dates.n_unique() > 1)  # no date of an export
    clock, form = next(clocks, "") or next(together, ""), ""
    for name in date_columns:
        if clock in early and early[name].n_unique() > 1 and not early[name].equals(early[clock]):
            asides.append(("a clock, too?", f"{name}; its columns are read at times of {clock}"))
    dates = clock.split(",") if clock else []
    numbers = [name for name in firsts if table.holds(name) == "number"]
    texts = [name for name in firsts if name not in {*numbers, *date_columns, *dates}]
    frame = polars.DataFrame()
    for piece in table.pieces(Wanted(numbers, texts, dates)):
        frame.vstack(polars.DataFrame({**piece.numbers, **piece.texts}), in_place=True)
        if len(frame) >= min(_ROWS_LOOKED_AT, _MOST_FIELDS // len(firsts)):
            break
    if not len(frame):
        return frame, clock, form
    frame = frame.with_columns(polars.col(polars.String).str.strip_chars())
    for name in texts:  # of which the first alone is no number
        fields = frame[name]
        fields = fields.set(fields.str.to_lowercase().is_in(tables.MISSING), None)
        floats = fields.str.replace(",", ".", literal=True).cast(polars.Float64, strict=False)
        bad = fields.filter(floats.is_null() & fields.is_not_null())
        if floats.n_unique() > _MOST_TEXTS and 2 * len(bad) < len(fields.drop_nulls()):
            frame = frame.with_columns(floats.fill_null(math.nan).alias(name))
            if len(bad):
                odd[f"in column {name!r}, the first: {str(bad.first())!r}"] = len(bad)
    texts = [name for name in texts if frame[name].dtype == polars.String]
    numbers = [name for name in firsts if name in frame.columns and frame[name].dtype.is_numeric()]
    compact = [(n,) for n in numbers if firsts[n].isdigit() and 1.99e11 < float(firsts[n]) < 2.1e13]
    apart = (names for names in [*zip(texts, strict=True), *pairs] if {*names} <= {*texts})
    titles = [*compact, *apart]
    for names in titles if not clock else ():
        if not clock and (outcome := _dates(frame, names, asides)):
            dates, (frame, clock, form) = [*names], outcome
    since = ""
    if not clock:
        clock, unit, since = _clock_of(frame, numbers)
        name_unit = table.units.get(clock) or unit_in(clock, is_time=True)
        unit = name_unit if name_unit in TIMES and not since else unit
        form = f"{_named(clock, '=')}={unit}" if unit != "s" else ""
        frame = frame.with_columns(frame[clock] * TIMES[unit]) if clock else frame
    if dates:
        at = frame[clock].to_numpy() * 1e-6
        hours = hours_unsaid(at, table.first(dates[-1]))
        for row in np.flatnonzero(np.diff(hours))[:1] + 1:
            when = datetime.fromtimestamp(at[row], UTC)
            asides.append(("summer time", f"ends or begins {when:%Y-%m-%d}; time runs on there"))
        frame = frame.with_columns(polars.Series(clock, at + 3600.0 * hours))
    since = ", a number of steps (--dt)" if _FRAME.match(clock) else since
    if not clock:  # of texts that look like dates --unit says more
        like_dates = [n for n in texts if "a date?" in explained(firsts[n])]
        like_dates += [n for n in texts if _TIME.match(n)]
        form = next((n for n in like_dates if frame[n].n_unique() > _MOST_TEXTS), "")
        since = f"{form}, dates that are not read: --unit says how ({form}=%d-%b-%y)" * bool(form)
    asides.insert(0, ("the clock", clock + since or "no column (--dt)"))
    return frame, clock, form


def _clock_of(frame: polars.DataFrame, names: Sequence[str]) -> tuple[str, str, str]:
    """The column of numbers that is a clock, by values or name; its unit, and since when."""
    epochs = dict[str, str]()
    for name in names:
        z = frame[name].filter(frame[name].is_finite()).to_numpy()
        low, high, steps = (z.min(), z.max(), np.diff(z)) if len(z) else (0.0, 0.0, z)
        if low < high and ((steps >= 0).all() or np.median(np.abs(steps)) < 0.1 * (high - low)):
            fit = [unit for unit, n in _EPOCHS.items() if 9e8 * n < low < high < 2.6e9 * n]
            excel = ["d"] * bool(3.6e4 < low < high < 5.5e4 and 0.0 < np.median(abs(steps)) < 0.05)
            epochs |= zip([name], fit or excel, strict=False)
    for name in (*filter(_TIME.match, epochs), *epochs):
        since = {"d": "1899-12-30, as Excel has it"}.get(epochs[name], "1970")
        return name, epochs[name], f", {epochs[name]} since {since}"
    counts = [*filter(_FRAME.match, names)]
    likely = [name for name in names if any(map(_CLOCK.fullmatch, _WORDS.findall(name)))]
    pairs = ((n, np.sign(np.diff(frame[n].drop_nans().to_numpy()))) for n in (*likely, *counts))
    rises = {name: sign.sum() / max(1.0, abs(sign).sum()) for name, sign in pairs}
    least = 1.0 if any(rises[name] == 1.0 for name in counts) else 0.8  # a time of laps falls
    clocks = *filter(_TIME.match, names), *(n for n in likely if rises[n] >= least), *counts
    clock = next((name for name in clocks if frame[name].drop_nans().n_unique() > 1), "")
    most = float(str(frame[clock].abs().max())) if clock else 0.0
    return clock, next((unit for unit, n in _EPOCHS.items() if most > 1e8 * n), "s"), ""


def _dates(
    frame: polars.DataFrame, names: Sequence[str], asides: Pairs
) -> tuple[polars.DataFrame, str, str] | None:
    """Rows with dates as `_forms` has them, in one column or two; None of others."""
    texts = frame[names[0]]
    texts = texts.cast(polars.Int64, strict=False) if texts.dtype.is_numeric() else texts
    texts = texts.cast(polars.String)
    for name in names[1:]:
        texts = texts + " " + frame[name]
    if not (forms := _forms(str(texts[0]))) or texts.n_unique() < 2:
        return None
    read = {}
    for form in forms:
        at = texts.str.to_datetime(form.replace(".%f", "%.f"), strict=False).dt.epoch("us")
        read[form] = at.null_count(), int(_odd(np.diff(at.drop_nulls())).sum()), at
    form = min(read, key=lambda form: read[form][:2])
    if 2 * read[form][0] > len(texts):
        return None
    if len({faults[:2] for faults in read.values()}) < len(read):
        text = f"day or month first cannot be told of {texts[0]}; it is read as {form} (--unit)"
        asides.append(("the dates", text))
    clock = ",".join(names)
    frame = frame.drop(names).with_columns(read[form][2].cast(polars.Float64).alias(clock))
    return frame, clock, f"{clock}={form}"


def _forms(text: str) -> list[str]:
    """How a date may be written that is no date of ISO 8601, the likeliest first."""
    if not (match := _OTHER.match(text)):
        return [_COMPACT[len(text)]] if text.isdigit() and len(text) in _COMPACT else []
    first, sign, second, third, space, has_seconds, has_parts, half = match.groups("")
    year = "%Y" if len(first + third) > 4 else "%y"
    month = "%m" if second.isdigit() else "%B" if len(second) > 3 else "%b"
    days = [("%d", month, year), ("%m", "%d", year)][: 1 + second.isdigit()]
    days = [("%Y", month, "%d")] if len(first) == 4 else days
    hour = space + ("%I:%M" if half else "%H:%M")
    hour += ":%S" * bool(has_seconds) + ".%f" * bool(has_parts) + " %p" * bool(half)
    days = days[:: -1 if half else 1]  # who writes AM has the month first
    return [sign.join(day) + hour for day in days]


def _begins_anew(at: Floats) -> NDArray[np.bool_] | None:
    """(n,) where a clock falls back to where it began, if it does, and nowhere else."""
    steps = np.diff(at, prepend=at[:1])
    falls = steps < 0.0
    begins = np.abs(at - at[0]) <= 3.0 * np.median(np.abs(steps))
    lengths = np.diff([0, *np.flatnonzero(falls), len(at)])
    return falls if begins[falls].all() and len(at) > lengths.min() >= _MANY else None


def _odd(steps: Floats) -> NDArray[np.bool_]:
    """Which of them are no usual ones: far from the median of those that go on."""
    later = steps[steps > 0.0]
    usual = float(np.median(later)) if len(later) else math.nan
    return (steps <= 0.0) | are_unusual(steps, usual)


def _episodes(frame: polars.DataFrame, clock: str, names: Sequence[str]) -> tuple[str, Rows]:
    """The column that tells episodes apart, if any, and the order of rows in which time runs on."""
    at, rows = frame[clock].to_numpy() if clock else np.zeros(0), np.arange(len(frame))
    if group := next((name for name in names if _is_in_blocks(frame[name])), ""):
        return group, rows
    n_odd = int(_odd(np.diff(at)).sum())
    for name in names if clock else ():
        if 1 < frame[name].n_unique() <= len(at) / 10:
            places = _numbered(frame[name])
            order = np.argsort(places, kind="stable")
            n_within = int(_odd(np.diff(at[order])[np.diff(places[order]) == 0]).sum())
            takes_turns = _WHO.search(name) and _takes_turns(frame[name])
            if 10 * n_within < (len(at) if takes_turns else n_odd - _MANY):
                return name, order
    return "", rows[::-1] if 2 * (np.diff(at) < 0.0).sum() > len(rows) else rows


def _of_steps(at: Floats, segments: Floats, facts: Pairs, lacking: int) -> tuple[Pairs, int]:
    """What makes one clock of these times, if so many rows are left out; and rows that are late."""
    within = np.diff(segments) == 0.0
    steps = np.diff(at)[within]
    later, odd = steps[steps > 0.0], _odd(steps)
    usual = float(np.median(later)) if len(later) else math.nan
    if len(later):
        often = span(float(f"{usual:.2g}")) if usual < 3600.0 else f"{usual / 3600.0:.3g} h"
        facts[-1] = facts[-1][0], f"{facts[-1][1]}, one every {often}"
    parts = np.split(at, np.flatnonzero(~within) + 1)
    latest = np.concatenate([np.fmax.accumulate(part) for part in parts])
    n_twice, n_earlier = int((steps == 0.0).sum()), int((at < latest).sum())
    if 20 * n_earlier > len(at):  # one time is wrong, not so many
        when = tables.date(float(np.median(latest[at < latest])))
        cause = "is its time right, or did the clock begin anew?"
        facts.append(("late rows", f"{n_earlier:,}, after a row of {when}: {cause}"))
        n_earlier = 0
    if odd.sum() + lacking < max(_MANY, _ODD * len(steps)):
        return [], n_twice + n_earlier
    if odd.any():
        facts.append(("other steps", f"{odd.sum():,}, the longest {span(later.max())}"))
    least = max(usual, 3.5 * float(np.median(steps)))  # of few digits many times are the same
    step = next((nice for nice in _NICE if nice[0] >= least), _NICE[-1])
    hole = next((nice for nice in _NICE if nice[0] >= 10.0 * step[0]), _NICE[-1])
    return [("--resample", step[1]), ("--hole", hole[1])], n_earlier


def _of_numbers(ends: dict[str, list[float]], action: str, levels: Floats, options: Pairs) -> Pairs:
    """With what to observe of numbers that go from here to there, and what somebody sets."""
    if not ends:
        return []
    variables = [name for name in ends if name != action] or [action]
    apart = {name: _round((high - low) / 4.0) for name, (low, high) in ends.items()}
    acts = [("--action", _named(action, ""))]
    if between := range_of(levels.tolist()) if action else "":
        acts.append(("--action-range", between))
        last = f",{_named(action, ',=')}=last"  # no mean of them is one of them
        options = [(name, value + last * (name == "--resample")) for name, value in options]
    elif action:
        width, (low, high) = apart[action], ends[action]
        low, high = math.floor(low / width) * width, math.ceil(high / width) * width
        acts.append(("--action-range", f"{low:.6g}:{high:.6g}:{width:g}"))
    scales = [("--scale", f"{_named(name, '=')}={apart[name]:g}") for name in variables]
    text = ",".join(_named(name, ",=") for name in variables)
    return [("--observe", text), *acts, *options, ("--rule", "novelty"), *scales]


def _round(number: float) -> float:
    return float(f"{number:.0e}")


def _named(name: str, signs: str) -> str:
    """A column's name as options take it, in double quotes where one of these is in it."""
    return quoted([name]) if set(name) & {*signs, '"'} else name


def _is_set(name: str) -> bool:
    """Whether a column is called as what somebody sets."""
    words = _WORDS.findall(name)
    may_be = any(map(_MAY_SET.fullmatch, words)) and not any(map(_MEASURED.fullmatch, words))
    return bool(_ACTION.fullmatch(" ".join(words)) or any(map(_SET.fullmatch, words)) or may_be)


def _stands(z: Floats) -> bool:
    """Whether numbers are near 0 for a while, and else far from it."""
    z = z[np.isfinite(z)]
    if (np.diff(z) > 0.0).sum() > _RISING * len(z):  # a count of ticks, which may begin anew
        return False
    size = np.abs(z)
    low, mid = (float(np.mean(size < x * np.quantile(size, 0.95))) for x in (0.05, 0.5))
    return 0.01 < low < 0.9 and mid - low < 0.02 and len(np.unique(size)) > _MOST_TEXTS


def _rare(frame: polars.DataFrame, columns: Sequence[str]) -> Iterator[tuple[str, str, str, Rows]]:
    """Columns, conditions that hold of few of their rows, and how often: by a text, or a code."""
    for name in columns:
        kinds = frame[name].unique(maintain_order=True)
        is_number = kinds.dtype.is_numeric()
        is_code = not is_number or (
            (kinds % 1.0 == 0.0).all()
            and (kinds.is_in([0.0, 1.0]).all() or _CODE.search(name) is not None)
        )
        for kind in kinds if is_code and len(kinds) <= _MOST_TEXTS else ():
            here = (frame[name] == kind).to_numpy()
            if kind and str(kind).lower() not in tables.MISSING and here.mean() < 0.25:
                first = np.flatnonzero(here > np.append(False, here[:-1]))
                text = f"{kind:g}" if is_number else kind
                value = text if is_number or re.fullmatch(r"[^\W\d]\w*", text) else f"'{text}'"
                often = "once" if len(first) == 1 else f"{len(first):,} times"
                frequency = f"({often}, {here.mean():.2%} of rows)"
                yield name, f"{_named(name, _SIGNS)}=={value}", frequency, first


def _numbered(values: polars.Series) -> Floats:
    """Of each row which of the different values it has, as a number."""
    return values.rank("dense").fill_null(0).cast(polars.Float64).to_numpy()


def _takes_turns(values: polars.Series) -> bool:
    """Whether some values change from row to row in most."""
    return values.n_unique() <= len(values) / 10 and 2 * len(values.rle()) > len(values)


def _is_in_blocks(values: polars.Series) -> bool:
    """Whether the rows of each of several values stand together, some of them at least."""
    lengths = values.rle().struct.field("len").to_list()
    n_values, n_rows = values.n_unique(), len(values)
    is_label = n_values == 2 and min(lengths) < n_rows / 20  # of what comes at the end
    return 1 < n_values == len(lengths) <= n_rows / 10 and not is_label


def _range(name: str, z: Floats, runs: NDArray[np.bool_], ends: Rows) -> str:
    """From where to where numbers go; where some that run are far outside, what is to be done.

    What leads to one of these ends stays: it is what is to be foreseen.
    """
    text = f"{np.nanmin(z):.5g} to {np.nanmax(z):.5g}"
    numbers = z[runs & np.isfinite(z)]
    low, high = np.quantile(numbers, (0.005, 0.995)) if len(numbers) else (0.0, 0.0)
    unit, beyond, column = _round(high - low) or 1.0, _FAR * (high - low), _named(name, _SIGNS)
    least, most = math.floor((low - beyond) / unit) * unit, math.ceil((high + beyond) / unit) * unit
    sides = {f"{column}>{least:.6g}": runs & (z < least), f"{column}<{most:.6g}": runs & (z > most)}
    n_far = sum(int(far.sum()) for far in sides.values())
    if not high > low or not n_far:
        return text
    text += f"; 99 % in {low:.5g} to {high:.5g}, {n_far:,} far outside"
    near = np.add.outer(ends % len(z), np.arange(-_NEAR, 1)).clip(0)
    parts = [part for part, far in sides.items() if far.any() and not far[near].any()]
    if not parts:
        return f"{text}, right before failures or the end: what is to be foreseen"
    return f"{text} (--where {in_quotes(' and '.join(parts))} leaves them out)"


def _told(texts: polars.Series) -> str:
    """The texts of a column, in words."""
    if (n := texts.n_unique()) > _MOST_TEXTS:
        lists = "; make a column of each number in it" * str(texts[0]).startswith("[")
        return f"{n:,} different texts, such as {texts[0]!r}{lists}"
    counts = texts.value_counts(sort=True, name="rows").rows()
    return ", ".join(f"{text or 'nothing'} {n / len(texts):.2%}" for text, n in counts)

"""A first look at a log, before anybody said what its columns mean: what is in it, what to ask."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence

import numpy as np
import polars
from numpy.typing import NDArray

from evofsm.cli.options import in_quotes, quoted, seconds
from evofsm.guard.foresight import span
from evofsm.io.logs import LONGEST_STEP, SKIPPED, USUAL_EPISODE
from evofsm.io.tables import TIMES, CsvTable, ParquetTable, Skips, Wanted, is_date

Pairs = list[tuple[str, str]]

# So many fields and rows are looked at; columns of more texts are no list of states.
_MOST_FIELDS, _ROWS_LOOKED_AT, _MOST_TEXTS = 20_000_000, 500_000, 12
_EPOCHS = {"ns": 1e17, "us": 1e14, "ms": 1e11}  # times since 1970 are larger
_COLUMNS_SHOWN = 40  # columns
_SIGNS = "<>=! "  # what in a name of a condition is ambiguous
# Far outside is what lies so many ranges of 99 % of the rows beyond them.
_FAR = 2.0
# A larger share of steps, and so many, that are no usual one make no clock.
_ODD, _MANY = 0.001, 10
_TIME = re.compile("(t|time|zeit|timestamp|sec|epoch)([^a-z]|$)", re.IGNORECASE)
_SET = re.compile("acc|action|valve|ventil|soll|set|^u$|cmd|throttle", re.IGNORECASE)
_FAILURE = re.compile(
    "st(ö|oe)r|fault|fail|trip|alarm|error|fehler|defek|ausfall|crash|colli|not-?aus|emergency",
    re.IGNORECASE,
)
_CODE = re.compile(f"{_FAILURE.pattern}|stat|zustand|code", re.IGNORECASE)
_LONG = "20ms 50ms 100ms 200ms 500ms 1s 2s 5s 10s 20s 30s 1min 2min 5min 10min 30min 1h 5h 10h 1d"
_NICE = [(seconds("", text), text) for text in _LONG.split()]


def look_at(table: CsvTable | ParquetTable) -> tuple[Pairs, Pairs]:
    """What the first rows hold, by column and in all, and options that could be asked for."""
    skips, odd = dict[str, tuple[int, str]](), dict[str, int]()
    table.skips = Skips(1 << 60, skips)
    frame, clock, form = _first_rows(table, odd)
    if not len(frame):
        return [], []
    numbers = [name for name, kind in frame.schema.items() if kind.is_numeric() and name != clock]
    values = {name: frame[name].to_numpy() for name in numbers}
    values = {name: z for name, z in values.items() if np.isfinite(z).any()}
    texts = [name for name in frame.columns if frame[name].dtype == polars.String]
    runs, still = np.ones(len(frame), np.bool_), next((n for n in values if _stands(values[n])), "")
    limit = _round(0.1 * float(np.nanquantile(np.abs(values[still]), 0.95))) if still else 0.0
    runs = values[still] > limit if still else runs
    columns = {name: _range(name, z, z if name == still else z[runs]) for name, z in values.items()}
    columns |= {name: _told(frame[name]) for name in texts}
    facts = [*columns.items()][:_COLUMNS_SHOWN]
    if more := len(columns) - len(facts):
        facts.append(("...", f"and {more:,} more columns"))
    n_partial = int(np.isnan([*values.values()]).any(0).sum())
    facts += [("incomplete", f"{n_partial:,} rows, in which a number is missing")] * (n_partial > 0)
    facts += [("bad fields", f"{n:,} {text}") for text, n in odd.items()]
    facts += [(f"bad {kind}s", f"{n:,}, the first: {first}") for kind, (n, first) in skips.items()]
    facts.append(("the clock", clock or "no column (--dt)"))
    facts.append(("rows looked at", f"{len(frame):,}"))
    options = [("--time", clock) if clock else ("--dt", "1"), *([("--unit", form)] if form else [])]
    groups = (name for name in (*USUAL_EPISODE, *texts, *values) if name in frame.columns)
    group = next((name for name in groups if _is_in_blocks(frame[name])), "")
    if (bad := max(n_partial, sum(n for n, _ in skips.values()) + sum(odd.values()))) > SKIPPED:
        options.append(("--skip-bad", f"{_round(2.0 * bad):.0f}"))
    if clock:
        within = ~np.diff(frame[group].rle_id().to_numpy()).astype(bool) if group else slice(None)
        options += _of_steps(np.diff(frame[clock].to_numpy())[within], facts, n_partial)
    if still:
        options.append(("--where", f"{_named(still, _SIGNS)}>{limit:g}"))
        facts.append(("stands still", f"in {1.0 - runs.mean():.1%} of rows, by {still}"))
    rare = [*_rare(frame, [*texts, *values])]
    likely = [row for row in rare if _FAILURE.search(row[1])]
    rare = likely or [row for row in rare if row[0] in values]
    facts += [("a failure?", f"{text} {frequency}") for _, text, frequency in rare]
    options += [("--failed", text) for _, text, _ in rare[:1]]
    if group:
        facts.append(("an episode?", f"each {group}"))
        options.append(("--episode", _named(group, ",")))
    markers = {group, *(name for name, *_ in rare)}
    ends = {n: np.nanquantile(z[runs], (0.02, 0.98)) for n, z in values.items() if n not in markers}
    if still in ends and ends[still][1] < 1.05 * ends[still][0]:  # as it runs it is always the same
        del ends[still]
    # What goes on by the same from row to row is a count of them.
    spans = {n: e.tolist() for n, e in ends.items() if e[1] > e[0] and np.ptp(np.diff(values[n]))}
    return facts, _of_numbers(spans, options)


def _first_rows(
    table: CsvTable | ParquetTable, odd: dict[str, int]
) -> tuple[polars.DataFrame, str, str]:
    """Their columns, the clock in seconds, which one that is, and how it is written if oddly."""
    firsts = {name: table.first(name).strip() for name in table.columns if table.holds(name)}
    pairs = zip(firsts, [*firsts][1:], strict=False)
    together = (f"{a},{b}" for a, b in pairs if is_date(f"{firsts[a]} {firsts[b]}"))
    date_columns = [name for name, text in firsts.items() if is_date(text)]
    clock, form = next(iter(date_columns), "") or next(together, ""), ""
    dates = clock.split(",") if clock else []
    numbers = [name for name in firsts if table.holds(name) == "number"]
    texts = [name for name in firsts if name not in {*numbers, *date_columns, *dates}]
    frame = polars.DataFrame()
    for piece in table.pieces(Wanted(numbers, texts, dates)):
        frame.vstack(polars.DataFrame({**piece.numbers, **piece.texts}), in_place=True)
        if len(frame) >= min(_ROWS_LOOKED_AT, _MOST_FIELDS // len(firsts)):
            break
    for name in texts if len(frame) else ():  # of which the first alone is no number
        fields = frame[name].str.strip_chars().replace("", None)
        floats = fields.str.replace(",", ".", literal=True).cast(polars.Float64, strict=False)
        bad = fields.filter(floats.is_null() & fields.is_not_null())
        if floats.n_unique() > _MOST_TEXTS and 2 * len(bad) < len(fields.drop_nulls()):
            frame = frame.with_columns(floats.fill_null(math.nan).alias(name))
            if len(bad):
                odd[f"in column {name!r}, the first: {str(bad.first())!r}"] = len(bad)
    texts = [name for name in texts if len(frame) and frame[name].dtype == polars.String]
    numbers = [name for name in firsts if name in frame.columns and frame[name].dtype.is_numeric()]
    if not clock and (form := next(filter(None, map(_form, map(frame.get_column, texts))), "")):
        clock, _, pattern = form.partition("=")
        at = frame[clock].str.to_datetime(pattern, strict=False)
        frame = frame.with_columns(at.dt.epoch("us").alias(clock))
    scale = 1e-6
    if not clock and (clock := next(filter(_TIME.match, numbers), "")) and len(frame):
        since = frame[clock].abs().max()  # 1970, if it is large
        unit = next((name for name, least in _EPOCHS.items() if float(str(since)) > least), "s")
        form, scale = "" if unit == "s" else f"{_named(clock, '=')}={unit}", TIMES[unit]
    if clock and len(frame):
        frame = frame.with_columns(frame[clock] * scale)
    return frame, clock, form


def _of_steps(steps: NDArray[np.float64], facts: Pairs, lacking: int) -> Pairs:
    """What makes one clock of such steps within episodes, if so many rows are left out."""
    later = steps[steps > 0.0]
    usual = float(np.median(later)) if len(later) else math.nan
    odd = (steps == 0.0) | (steps > LONGEST_STEP * usual) | (steps < usual / LONGEST_STEP)
    facts[-1] = facts[-1][0], f"{facts[-1][1]}, one every {usual:.2g} s"
    holes = steps > LONGEST_STEP * usual
    if len(late := steps[steps <= 0.0]):
        twice, earlier = (late == 0.0).sum(), (late < 0.0).sum()
        text = f"{twice:,} at the time of the row before, {earlier:,} earlier"
        facts.append(("late rows", f"{text} (rows twice, unsorted, or --episode?)"))
    if odd.sum() + lacking < max(_MANY, _ODD * len(steps)):
        if holes.any():
            text = f"{holes.sum():,}, the longest {span(later.max())}, together"
            text += f" {span(float((steps[holes] - usual).sum()))}; each begins an episode (--hole)"
            facts.append(("holes", text))
        return []
    facts.append(("other steps", f"{odd.sum():,}, the longest {span(later.max())}"))
    least = max(usual, 3.5 * float(np.median(steps)))  # of few digits many times are the same
    step = next((nice for nice in _NICE if nice[0] >= least), _NICE[-1])
    hole = next((nice for nice in _NICE if nice[0] >= 10.0 * step[0]), _NICE[-1])
    return [("--resample", step[1]), ("--hole", hole[1])]


def _of_numbers(ends: dict[str, list[float]], options: Pairs) -> Pairs:
    """With what to observe of numbers that go from here to there, and what somebody sets."""
    if not ends:
        return []
    action = next(filter(_SET.search, ends), "")  # else nobody acts
    variables = [name for name in ends if name != action] or [action]
    apart = {name: _round((high - low) / 4.0) for name, (low, high) in ends.items()}
    acts = [("--action", _named(action, ""))]
    if action:
        width, (low, high) = apart[action], ends[action]
        low, high = math.floor(low / width) * width, math.ceil(high / width) * width
        acts.append(("--action-range", f"{low:.6g}:{high:.6g}:{width:g}"))
    scales = [("--scale", f"{_named(name, '=')}={apart[name]:g}") for name in variables]
    text = ",".join(_named(name, ",=") for name in variables)
    return [("--observe", text), *acts, *options, ("--rule", "novelty"), *scales]


def _form(texts: polars.Series) -> str:
    """How dates with slashes are written, as --unit takes it; of others nothing."""
    match = re.match(r"\d\d?/\d\d?/\d{4} \d\d?:\d\d(:\d\d)?( [AP]M)?$", texts[0] or "")
    if not match:
        return ""
    is_usual = match[2] or int(str(texts.str.extract(r"/(\d\d?)/").cast(polars.Int8).max())) > 12
    day, hour = "%m/%d" if is_usual else "%d/%m", "%I:%M" if match[2] else "%H:%M"
    return f"{texts.name}={day}/%Y {hour}{':%S' if match[1] else ''}{' %p' if match[2] else ''}"


def _round(number: float) -> float:
    return float(f"{number:.0e}")


def _named(name: str, signs: str) -> str:
    """A column's name as options take it, in double quotes where one of these is in it."""
    return quoted([name]) if set(name) & {*signs, '"'} else name


def _stands(z: NDArray[np.float64]) -> bool:
    """Whether numbers are near 0 for a while, and else far from it."""
    size = np.abs(z[np.isfinite(z)])
    low, mid = (float(np.mean(size < x * np.quantile(size, 0.95))) for x in (0.05, 0.5))
    return 0.01 < low < 0.9 and mid - low < 0.02 and len(np.unique(size)) > 2


def _rare(frame: polars.DataFrame, columns: Sequence[str]) -> Iterator[tuple[str, str, str]]:
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
            if kind and here.mean() < 0.25:
                times = int((here > np.append(False, here[:-1])).sum())
                text = f"{kind:g}" if is_number else kind
                value = text if is_number or re.fullmatch(r"[^\W\d]\w*", text) else f"'{text}'"
                often = "once" if times == 1 else f"{times:,} times"
                frequency = f"({often}, {here.mean():.2%} of rows)"
                yield name, f"{_named(name, _SIGNS)}=={value}", frequency


def _is_in_blocks(values: polars.Series) -> bool:
    """Whether the rows of each of several values stand together, some of them at least."""
    blocks = int(str(values.rle_id().max())) + 1
    return 1 < values.n_unique() == blocks <= len(values) / 10


def _range(name: str, values: NDArray[np.float64], seen: NDArray[np.float64]) -> str:
    """From where to where numbers go; where some seen are far outside, what leaves those out."""
    text = f"{np.nanmin(values):.5g} to {np.nanmax(values):.5g}"
    numbers = seen[np.isfinite(seen)]
    low, high = np.quantile(numbers, (0.005, 0.995)) if len(numbers) else (0.0, 0.0)
    unit, beyond, column = _round(high - low) or 1.0, _FAR * (high - low), _named(name, _SIGNS)
    least, most = math.floor((low - beyond) / unit) * unit, math.ceil((high + beyond) / unit) * unit
    below, above = int((numbers < least).sum()), int((numbers > most).sum())
    if not high > low or not below + above:
        return text
    parts = [f"{column}>{least:.6g}"] * (below > 0) + [f"{column}<{most:.6g}"] * (above > 0)
    text += f"; 99 % in {low:.5g} to {high:.5g}, {below + above:,} far outside"
    return f"{text} (--where {in_quotes(' and '.join(parts))} leaves them out)"


def _told(texts: polars.Series) -> str:
    """The texts of a column, in words."""
    if (n := texts.n_unique()) > _MOST_TEXTS:
        return f"{n:,} different texts, such as {texts[0]!r}"
    counts = texts.value_counts(sort=True, name="rows").rows()
    return ", ".join(f"{text or 'nothing'} {n / len(texts):.2%}" for text, n in counts)

"""Learn a machine from a stream of traces, say what was odd in them, and teach a guard."""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

import numpy as np

from evofsm import store
from evofsm.cli.options import Judge, imported
from evofsm.cli.show import warn
from evofsm.driving import SAFETY_RULE
from evofsm.driving.cars import guard_of_monitor
from evofsm.driving.naming import VARIABLES
from evofsm.fsm import EvolvingFSM, FSMModel, IntervalActions, Novelty, ObservationEncoder
from evofsm.fsm.proportions import outward, poisson_bounds
from evofsm.fsm.rules import describe_rule, rule_named
from evofsm.fsm.validation import counted, positive
from evofsm.guard import ActionReviser, Foresight, Guard, LearntRisk, Mode
from evofsm.guard.actions import limits
from evofsm.guard.foresight import span
from evofsm.io import Chunk, LogColumns, episodes_of, read_traces
from evofsm.io.logs import STAND_INS, Noted
from evofsm.io.tables import IN_UTC, SI, TIMES, UNITS, quoted_name, unit_of

# A unit at the end of a column's name, behind another letter or as a word of its own.
_WORD = "(?:^|[^A-Za-z]|(?<=[a-z])(?=[A-Z]))"
_CALLED = re.compile(_WORD + "((?i:km[/_ ]?p?h|kph|mph|knots|feet|ft|cm|mm|km))[^A-Za-z]*$")
_TIME_CALLED = re.compile(  # but for times of day, and times per hour
    _WORD + r"(?<![oO]f)(?<![oO]f.)(?<!per.)"
    "((?i:[mnu\u00b5\u03bc]s|min(?:ute)?s?|h(?:ou)?rs?|days?|(?<![A-Za-z])[hd]))(?:ec)?[^A-Za-z]*$"
)
# Units of time that logs are in, of which that counts by which a row comes every 0.1 s or so.
_SHORTER = ("ms", "us", "ns")
_MATCHES = 0.02  # so near must a unit come to what two columns differ by, to be named
# What is said of what was left out, where it is no row.
_LEFT_OUT = {
    "comment": "comment{s} between rows {were} passed over",
    "action": "row{s} {have} no action, and what leads on from there was not learnt",
    "stand-in": "number{s} of the action {are} far from all others, and {were} read as missing",
    "cut": "file ends early, and what is whole was read",
    "letter": "line{s} {have} letters of another encoding than most, read as '\ufffd'",
}
_ONE = {"s": "", "were": "was", "have": "has", "are": "is"}
_SEVERAL = {word: word for word in _ONE}
_NO_SPEED = 500.0  # no car's speed in any unit [m/s]: revolutions, perhaps
#: Columns of more different numbers are no choice among some; and the most intervals for those.
MOST_LEVELS, _MOST_INTERVALS = 12, 50
_MOST_ACTIONS = 1000
_NOBODY = (0.0, -1.0, 255.0, *STAND_INS)  # stand for that in many recordings


class Learning(NamedTuple):
    """What was learnt, and from what."""

    model: FSMModel
    machine: EvolvingFSM  #: can go on learning
    actions: IntervalActions
    #: Rows, episodes, transitions, episodes that began because of a hole in time (jumps) or ended
    #: in failure (failures), actions put into the first and last interval (clipped_below, _above).
    counts: Counter[str]
    seconds: float  #: between the first and the last rows of the episodes, together
    levels: set[float]  #: numbers of the action, while they are few


def learn_traces(
    chunks: Iterable[Chunk],
    machine: EvolvingFSM,
    actions: IntervalActions,
    names: Sequence[str] = (),
    units: Callable[[], Sequence[str]] = tuple,
) -> Learning:
    """Learn all chunks in their order, each row once; units are known once they are read."""
    machine, counts, levels = machine.copy(), Counter[str](), set[float]()
    dt, last_time, seconds = math.nan, math.nan, 0.0
    for chunk in chunks:
        learn_chunk(machine, chunk, actions)
        dt, steps = chunk.dt, np.diff(chunk.times, prepend=last_time)
        last_time, seconds = float(chunk.times[-1]), seconds + float(steps[~chunk.begins].sum())
        counts.update(
            rows=len(steps),
            episodes=int(chunk.begins.sum()),
            clipped_below=int((chunk.actions < actions.low).sum()),
            clipped_above=int((chunk.actions > actions.high).sum()),
            jumps=chunk.jumps,
            failures=int(chunk.fails.sum()),
        )
        if len(levels) <= MOST_LEVELS:
            levels.update(np.unique(chunk.actions[~np.isnan(chunk.actions)]).tolist())
    machine.start_episode()  # so that the last one counts, too
    step = None if math.isnan(dt) else dt
    model = machine.model(actions=actions, names=names, units=units(), dt=step)
    counts["transitions"] = int(model.uses.sum())
    if not counts["transitions"]:
        fault = "no row with an action is followed by another row of its episode"
        cause = "is every row an episode? are the rows sorted by episode and time?"
        if 2 * counts["failures"] > counts["episodes"]:  # which a failure ends
            cause = "most episodes fail with their first row: does --failed say the reverse?"
        raise ValueError(f"no transition could be learnt: {fault} ({cause})")
    return Learning(model, machine, actions, counts, seconds, levels)


# -- What was noticed in reading ------------------------------------------------------------------


def unit_in(name: str, *, is_time: bool) -> str:
    """The unit that is part of a column's name, if it is none of the SI."""
    match = (_TIME_CALLED if is_time else _CALLED).search(name)
    if match is None:
        return ""
    unit = unit_of(match[1].lower())
    return {"feet": "ft"}.get(unit) or (unit if unit in UNITS else "km/h")


def warnings_of(noted: Noted, columns: LogColumns | None = None) -> list[str]:
    """What is most likely a mistake, and what would mend it."""
    columns = columns or LogColumns()
    time, cars = columns.time, columns.observe.names == VARIABLES
    of_objects = "; a table of objects has to be in s, m and m/s" * cars
    units = {name: unit for name in noted.untold if (unit := unit_in(name, is_time=name == time))}
    warnings = [
        f"{name} reaches {fastest:,.0f} m/s, faster than any car on a road: is it in km/h or "
        f"mph? --unit {quote(f'{name}=km/h')} converts it{of_objects}"
        for name, fastest in noted.fastest.items()
        if name not in units and fastest < _NO_SPEED
    ]
    warnings += [
        f"{name} is called as if it were in {unit}, and was read as one of the SI: --unit "
        f"{quote(f'{name}={unit}')} converts it, before --failed compares it "
        f"(--unit {quote(f'{name}={SI[unit]}')}: it is right)"
        for name, unit in units.items()
    ]
    if columns.failed and not noted.failing:
        goes = [f"{name} is {', '.join(map(repr, texts))}" for name, texts in noted.texts.items()]
        for name, (low, high) in ((k, v) for k, v in noted.compared.items() if v):
            text = f"{name}, as compared, goes from {low:.6g} to {high:.6g} "
            goes.append(text + SI.get(noted.units.get(name, ""), ""))
        text = ": ".join([f"no row meets --failed {quote(columns.failed)}", *goes])
        warnings.append(text.rstrip())
    is_untold = time in noted.untold and time not in units and not noted.resampled
    step = noted.longest_step
    ratio = max(step / 60.0, 60.0 / max(step, 1e-9))  # machines have parts of minutes, or several
    if step > 0.0 and is_untold and (cars or abs(ratio - round(ratio)) > 0.05):
        unit = min(_SHORTER, key=lambda unit: abs(np.log10(step * TIMES[unit]) + 1.0))
        cause = f"is the time in {unit}? --unit {time}={unit} converts it{of_objects}"
        warnings.append(f"there is a row every {step:,.6g} s: {cause}")
    nobody = " (no leader)" * cars

    def missing(condition: str) -> str:
        return f"a missing value{nobody}? --no-leader {quote(condition)} leaves such rows out"

    share = f"{noted.failed_at_once:,} of {noted.failed:,}"
    constant = [kv for kv in noted.at_once.items() if kv[1] in _NOBODY or noted.failed_at_once > 1]
    if constant and noted.failed_at_once >= noted.failed / 2:
        name, value = min(constant, key=lambda kv: kv[1] not in _NOBODY)
        fault = f"fail with their first row, and {name} is {value:g} there each time"
        hint = f"does that stand for {missing(f'{name}=={value:g}')}"
        warnings.append(f"{share} failed episodes {fault}: {hint}")
    if noted.failed_at_once:
        why = "right after a hole or standstill: what led there was not recorded"
        if 2 * noted.failed_at_once > noted.failed:
            why = (
                "with an episode's first row: does --failed mark all its rows? Mark the last alone"
            )
        warnings.append(f"{share} failures came {why}")
    if alone := [(name, *pair) for name, pair in noted.below.items() if pair[0] and pair[1] > 2]:
        name, value, rows = min(alone, key=lambda entry: entry[1] not in _NOBODY)
        hint = f"is that {missing(f'{name}=={value!r}')}"
        warnings.append(
            f"{name} is {value!r} in {counted(rows, 'row')}, apart from all others: {hint}"
        )
    warnings += _contradictions(noted, columns)
    if noted.unplaced:
        lie = "failure lies" if noted.unplaced == 1 else "failures lie"
        why = "in rows that are left out, outside of any episode: not counted"
        warnings.append(f"{noted.unplaced:,} {lie} {why}")
    for kind, (count, first) in noted.skipped.items():
        text = _LEFT_OUT.get(kind, "bad row{s} {were} left out (--skip-bad)")
        text = text.format_map(_ONE if count == 1 else _SEVERAL)
        warnings.append(f"{count:,} {text}, the first: {first}")
    return [*warnings, *noted.told]


def _contradictions(noted: Noted, columns: LogColumns) -> Iterator[str]:
    """Where two columns say different things of one, with the unit or the sign that mends it."""
    speeds = list(VARIABLES[1:])
    of_units = {  # of which columns, and whether their unit makes the rate larger
        "gap": {"m/s": (speeds, 1), "m": (["gap"], -1)},
        "action": {"m/s²": ([columns.action], 1), "m/s": (speeds, -1)},
    }
    for kind, rate in noted.rates.items():
        is_gap = kind == "gap"
        mend = "is one of them in another unit, or mixed up with another one?"
        if abs(rate + 1.0) < _MATCHES:
            mend = "are the speeds mixed up?" if is_gap else "is a brake above 0 there?"
        for unit, (names, power) in ((u, of_units[kind].get(SI[u], ([], 1))) for u in SI):
            if UNITS[unit] != 1.0 and names and abs(rate * UNITS[unit] ** -power - 1.0) < _MATCHES:
                options = (f"--unit {quote(f'{name}={unit}')}" for name in names)
                mend = f"{' '.join(options)} converts from {unit}"
        column, cause = ("gap", " and ".join(speeds)) if is_gap else ("v_follower", columns.action)
        yield f"{column} changes {rate:.3g} times as fast as {cause} say in the first rows: {mend}"


def episodes_read(
    path: str, columns: LogColumns, notes: Noted, *, dated: bool, fewest: int = 2
) -> Iterator[Chunk]:
    """The episodes of a log of so many rows, dated if they shall be; then what was noticed."""
    for episode in episodes_of(read_traces([path], columns, notes)):
        if len(episode.times) >= fewest:
            yield episode._replace(times=episode.times + notes.began) if dated else episode
    for warning in warnings_of(notes, columns):
        warn(f"warning: {warning}")
    if dated and notes.in_utc:
        warn(IN_UTC)


# -- A guard --------------------------------------------------------------------------------------


def guard_of_log(
    kind: Judge, model: FSMModel, machine: EvolvingFSM, brakes: float, tolerance: float
) -> Guard:
    """A guard that is to be taught what somebody did, in shadow mode."""
    assert model.dt is not None
    assert model.actions is not None
    if kind == "kinematic":
        return guard_of_monitor(model.dt, brakes, tolerance)
    actions, labels = model.actions, model.labels
    ends: dict[str, Any] = {"low": actions.low, "high": actions.high}
    learnt = LearntRisk(model.dt, **ends, names=labels.names, units=labels.units)
    reviser = ActionReviser(learnt, actions, tolerance=tolerance, mode=Mode.SHADOW)
    return Guard.of(reviser, interval=model.dt, machine=machine)


def teach(guard: Guard, chunks: Iterable[Chunk], show: Callable[[int], object]) -> float:
    """The share in which a guard refuses, of the later half of a log; ``show`` is told of rows."""
    n_rows, refusals, reviser = 0, bytearray(), guard.reviser
    assert isinstance(reviser, ActionReviser)
    for episode in episodes_of(chunks):
        rows, times = episode.observations, episode.times - episode.times[0]
        actions = episode.actions
        if isinstance(guard.judge, LearntRisk):  # what lies beyond is at an end, as for states
            actions = np.clip(actions, *limits(guard.actions))
        for row, proposal, at in zip(rows[:-1], actions, times, strict=False):
            guard.decide(row, proposal, at)
            refusals.append(reviser.refuses)
        guard.end(episode.failed, rows[-1])  # with its last row
        show(n_rows := n_rows + len(episode.times))
    return float(np.mean(np.array(refusals[len(refusals) // 2 :])))


def refusing(share: float) -> str:
    """What is said of a guard that refuses in such a share of the time; of few nothing."""
    why = "what moves the system is not observed (a valve, a set point, a load: name it in "
    why += "--observe), a column is in another unit, or no action in the range averts the failure"
    return f"refuses {share:.0%} of the time: perhaps {why}" if share > 0.5 else ""


def learn_chunk(machine: EvolvingFSM, chunk: Chunk, actions: Any) -> None:
    """Learn the rows of a chunk; where an action is not known, no transition."""
    indices = np.full(len(chunk.times), -1)
    is_known = ~np.isnan(chunk.actions)
    indices[is_known] = actions.encode(chunk.actions[is_known])
    failures = np.flatnonzero(chunk.fails) if chunk.tells else None
    machine.learn_many(chunk.observations, indices, np.flatnonzero(chunk.begins), failures)


def range_of(levels: Sequence[float]) -> str:
    """The --action-range in which each of some rising numbers is an action; or nothing.

    >>> range_of([10.0, 20.0, 30.0]), range_of([0.5])
    ('5:35:10', '')
    """
    width = float(min(np.diff(levels), default=0.0))
    if len(levels) > MOST_LEVELS or not levels[-1] - levels[0] < _MOST_INTERVALS * width:
        return ""
    return f"{levels[0] - width / 2.0:.6g}:{levels[-1] + width / 2.0:.6g}:{width:.6g}"


# -- What was asked for ---------------------------------------------------------------------------


def actions_of(text: str) -> IntervalActions:
    """The intervals of --action-range."""
    try:
        low, high, width = map(float, text.split(":"))
        if width > 0.0 and (high - low) / width > _MOST_ACTIONS:
            raise ValueError(f"more than {_MOST_ACTIONS} intervals; make them wider")
        return IntervalActions(low, high, width, outside="clip")
    except ValueError as error:
        hint = "write LOW:HIGH:WIDTH, such as -2.5:2.5:0.3"
        raise ValueError(f"--action-range is {text!r}: {error}; {hint}") from None


def machine_of(
    n_actions: int,
    rule: str,
    scale: list[str] | None,
    max_states: int | None,
    encoder: ObservationEncoder,
) -> EvolvingFSM:
    """A machine that has seen nothing, with the rule of states that was named."""
    if scale and rule != "novelty":
        raise ValueError(f"--scale is for --rule novelty, not {rule}")
    if rule == "novelty":
        part: Any = Novelty(1.0, _scales(scale, encoder))
    else:
        part = imported(rule) if ":" in rule else rule_named(rule)
    state_rule = part() if isinstance(part, type) else part
    return EvolvingFSM(n_actions, max_states=max_states, rule=state_rule)


def _scales(scale: list[str] | None, encoder: ObservationEncoder) -> list[float]:
    """The difference that counts as 1, for each number that is observed."""
    scales = {}
    for text in scale or ():
        column, _, number = text.rpartition("=")
        try:
            scales["".join(quoted_name(column))] = positive("it", float(number))
        except ValueError:
            hint = "write COLUMN=NUMBER, such as gap=4"
            raise ValueError(f"--scale is {text!r}; {hint}") from None
    single = [name for name in encoder.variables if isinstance(name, str)]
    if unknown := [column for column in scales if column not in single]:
        raise ValueError(f"--scale names {unknown[0]!r}; observed are {', '.join(single)}")
    scales = dict(zip(VARIABLES, SAFETY_RULE.scales, strict=True)) | scales
    if omissions := [column for column in single if column not in scales]:
        fault = f"--rule novelty has to know the difference that counts as 1 in {omissions[0]!r}"
        hint = f"--scale {quote(omissions[0])}=NUMBER, a fifth of what it spans or so"
        raise ValueError(f"{fault}: {hint}")
    return [scales.get(name, 1.0) for name in encoder.names]


def size_of(file: str) -> int:
    """Bytes of a file, or of those in a folder."""
    path = Path(file)
    return sum(part.stat().st_size for part in (path.iterdir() if path.is_dir() else [path]))


def judge_of(judge: Judge | None, columns: LogColumns) -> Judge:
    """By what the guard is to judge, from what is observed where nobody said."""
    names = columns.observe.names
    if any(not isinstance(variable, str) for variable in columns.observe.variables):
        raise ValueError("--guard takes numbers alone, and --observe names a discrete column")
    judge = judge or ("kinematic" if names == VARIABLES else "learnt")
    judge = judge if columns.acts else "learnt"
    if judge == "kinematic" and len(names) != len(VARIABLES):
        kind = f"--judge kinematic knows cars by their {', '.join(VARIABLES)}"
        fault = f"has to name the three columns in this order, and names {', '.join(names)}"
        raise ValueError(f"{kind}; --observe {fault}")
    if judge == "learnt" and columns.failed is None:
        raise ValueError(
            "--guard learns from failures, and which there were is not known: --failed COLUMN or "
            "--failed 'gap<=0' says it (of times or last rows docs/logs.md makes one); of cars in "
            "pairs --judge kinematic needs none"
        )
    return judge


def check_out(out: Path | None, kind: str, option: str = "--out") -> None:
    """Refuse before the long work what could not be saved after it: a model, or a guard."""
    if out is None:
        return
    if not out.parent.is_dir():
        raise FileNotFoundError(f"{option} {out}: there is no folder {out.parent}")
    if not (os.access(out.parent, os.W_OK) or os.access(out, os.W_OK)):
        raise PermissionError(f"{option} {out}: the folder {out.parent} may not be written")
    if out.is_dir():
        raise IsADirectoryError(f"{option} {out} is a folder; name a file in it")
    if out.exists():
        if not out.is_file():
            raise OSError(f"{option} {out} is a device, a pipe or a socket; name a file")
        try:
            content = f"holds a {store.read_header(out).kind}"
        except (ValueError, OSError):  # so are ours called, whatever wrote them: .evofsm
            content = f"holds a {kind}" if out.suffix == ".evofsm" else "is no file of evofsm"
        if content != f"holds a {kind}":
            raise ValueError(f"{option} {out} {content}; it was left alone")


# -- What came of it ------------------------------------------------------------------------------


def told_of_guard(
    guard: Guard, path: Path | None, units: Mapping[str, str], brakes: float, beyond: float
) -> Iterator[str]:
    """Where it is, what it takes, and what it reckons with."""
    judge = guard.judge
    assert judge is not None
    names = map(judge.labels.variable, range(len(guard.variables)))
    also = "" if isinstance(judge, Foresight) else ", and proposal, the action"
    takes = f"evofsm monitor --guard {path} takes rows of {', '.join(['time [s]', *names])}{also}."
    texts = ", ".join(f"{name} in {unit}" for name, unit in units.items())
    takes += f" CSV without a row of units has {texts}." * bool(units)
    yield f"The guard was saved to {path}. {takes}"
    if isinstance(judge, Foresight):
        words, days = judge.alarm_in_words, judge.days
        if (rate := judge.alarm) is None:
            text = f"one in {days:.2g} days is {1.0 / max(days, 1e-9):.2g} a day; fewer columns, or"
            hint = f" ({text} a longer log or --horizon?)" * ("chance" in words)
            yield f"It never alarms: {words}{hint}."
        else:
            soon = f"up to {span(judge.horizon * judge.dt)} before a failure (--horizon)"
            n = int(judge.held_out[rate, 1])
            bound = outward(math.ceil, poisson_bounds(n)[1] / days, 2)
            text = f"{n:,} false in {days:.2g} days: it may be up to {bound:,g} a day (95 %)"
            yield f"{words.capitalize()} (--false-a-day), {soon}; {text}."
        judges = "evofsm monitor LOG --summary, with the same options, judges such alarms held out"
        yield f"{judges}; evofsm inspect {path} prints its states."
    elif isinstance(judge, LearntRisk):
        note = "" if judge.state.knows_failure else " nothing yet"
        yield f"It judges{note}: {judge.told_by_experience}."
        if beyond:
            yield f"It knows no action beyond --action-range, where {beyond:.1%} of the log's are."
    else:
        yield f"It reckons with brakes of {brakes:g} m/s² of the own car (--brakes)."


def read_of(learning: Learning, action: str) -> Iterator[tuple[str, str]]:
    """What was read, and the actions and the rule that it was learnt with."""
    actions, counts = learning.actions, learning.counts
    yield "rows", f"{counts['rows']:,}, one every {learning.model.dt:g} s"
    yield "episodes", f"{counts['episodes']:,}, together {span(learning.seconds)}"
    yield "transitions", f"{counts['transitions']:,}"
    text = f"{actions.n_actions} intervals of {action} from {actions.low:g} to {actions.high:g}"
    below, above = counts["clipped_below"], counts["clipped_above"]
    share = f"{(below + above) / counts['rows']:.1%} of rows"
    beyond = f"{below:,} below and {above:,} above ({share}) were put into the end intervals"
    text += f"; {beyond if below + above else 'none was beyond'}"
    if 0 < len(indices := np.flatnonzero(learning.model.uses)) < actions.n_actions:
        low, high = actions.edges[[indices[0], indices[-1] + 1]].tolist()
        text += f"; it was in {len(indices)}, {low:g} to {high:g}: what others do is extrapolated"
    numbers = sorted(learning.levels) if len(learning.levels) <= MOST_LEVELS else []
    places = [actions.encode(number) for number in numbers]
    meanings = [f"{n:g} is a({k + 1})" for n, k in zip(numbers, places, strict=True)]
    text += f"; {', '.join(meanings)}" * (len(numbers) > 1)
    if len({*places}) < len(places):
        apart = range_of(numbers)
        text += ": several are one action"
        text += f" (--action-range {apart} tells them apart)" * bool(apart)
    yield "actions", text if action else "none: nobody acts (--action '')"
    settings = describe_rule(learning.machine.rule)
    for name in ("radius", "spread"):  # which the rule may have itself
        settings.setdefault(name, learning.machine.settings[name])
    rule = settings.pop("name")
    texts = (f"{name} {value}" for name, value in settings.items())
    yield "rule", f"{rule} (--rule), {', '.join(texts)}"


def read_otherwise(
    noted: Noted, columns: LogColumns, counts: Counter[str]
) -> Iterator[tuple[str, str]]:
    """What was not learnt as it stands in the files."""
    if columns.failed is None:
        yield "failures", "not known; --failed COLUMN or --failed 'gap<=0' says them"
    else:
        text = f"{counted(counts['failures'], 'episode')} ended with {columns.failed}"
        left_out = f"; {noted.after_failure:,} rows after them, still so, were left out"
        yield "failures", text + (left_out if noted.after_failure else "")
    hole = columns.longest_hole
    if columns.resample:
        step, ways = columns.resample
        extras = "".join(f", the {way} of {name}" for name, way in ways.items())
        means = f"{noted.resampled:,} became means of {step:g} s{extras}"
        yield "resampled", f"{means} (--resample {step:g}s,NAME=max: others are min, last)"
    if noted.crossed:
        yield "holes", f"{noted.crossed:,} of at most {hole:g} s (--hole) cost a transition each"
    if jumps := counts["jumps"]:
        yield "time jumps", f"{jumps:,}; each begins an episode (a longer --hole bridges them)"
    if noted.leaderless:
        nobody = columns.no_leader not in (None, "end")
        why = "a number is missing" + f", or {columns.no_leader}" * nobody
        ends = "" if hole and not columns.no_leader else "; there an episode ends"
        yield "left out", f"{counted(noted.leaderless, 'row')}: {why}{ends}"
    if noted.elsewhere:
        why = f"--where {columns.where} does not hold; there an episode ends"
        yield "left out", f"{counted(noted.elsewhere, 'row')}: {why}"
    units = (f"{name} from {u}" for name, u in noted.units.items() if UNITS.get(u, 1.0) != 1.0)
    if text := ", ".join(units):
        yield "converted", f"{text} to units of the SI"

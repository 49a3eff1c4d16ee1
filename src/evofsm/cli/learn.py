"""`evofsm learn`."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

from evofsm.cli.inspect import model_document, tables_of
from evofsm.cli.options import (
    BRAKES,
    TOLERANCE,
    Brakes,
    FalseADay,
    Horizon,
    Json,
    Judge,
    Persist,
    Reading,
    Tolerance,
    argument,
    given_of,
    imported,
    option,
    reads_logs,
    refuse_other_limit,
)
from evofsm.cli.show import facts, print_json, progress, say, show, warn

if TYPE_CHECKING:
    from evofsm.cli.learning import Learning
    from evofsm.fsm.actions import IntervalActions
    from evofsm.fsm.machine import EvolvingFSM
    from evofsm.fsm.observations import ObservationEncoder
    from evofsm.guard import Guard
    from evofsm.io import Chunk, LogColumns
    from evofsm.io.logs import Noted


_MOST_ACTIONS = 1000


@reads_logs
def learn(
    files: Annotated[
        list[str], argument("Logs, recordings of traffic (FCD, ASAM OSI, objects), bags of ROS 2.")
    ],
    reading: partial[Reading],
    action_range: Annotated[
        str, option("Intervals of --action, LOW:HIGH:WIDTH; the end ones take what lies beyond.")
    ] = "-2.5:2.5:0.3",
    rule: Annotated[
        str, option("Rule of states: paper, novelty (for logs), or module:Name.")
    ] = "paper",
    scale: Annotated[
        list[str] | None,
        option("Novelty: the difference that counts as 1, by column: gap=4. May be repeated."),
    ] = None,
    max_states: Annotated[
        int | None, option("At so many, two are merged for each new one.")
    ] = None,
    out: Annotated[Path | None, option("File to save the model to.")] = None,
    guard: Annotated[Path | None, option("File to save a guard to, for evofsm monitor.")] = None,
    judge: Annotated[Judge | None, option("Of --guard: kinematic (of cars) or learnt.")] = None,
    brakes: Brakes = BRAKES,
    tolerance: Tolerance = TOLERANCE,
    horizon: Horizon = None,
    persist: Persist = 0.0,
    false_a_day: FalseADay = None,
    as_json: Json = False,
) -> None:
    """Learn a state machine from logs of your own, of any size, row by row.

    A log holds a row per time step; after a hole in time an episode begins. Of recordings of
    traffic, each vehicle and the next one ahead on its lane are a pair. Without --failed nobody
    knows what failed.

    With --guard, a guard in shadow mode then goes through all rows and learns from them too. Where
    nobody acts (--action ''), it learns alarms (--false-a-day).

    Of a log whose columns nobody named, evofsm learn LOG prints what is in it, and what to ask.
    """
    from evofsm.cli.foreseen import alarms_of, guard_where_nobody_acts
    from evofsm.cli.learning import learn_traces, refusing, teach, warnings_of
    from evofsm.driving.cars import guard_of_monitor
    from evofsm.guard import ActionReviser, Foresight, Guard, LearntRisk, Mode
    from evofsm.io import episodes_of
    from evofsm.io.logs import Noted

    _check_out(out)
    _check_out(guard, "--guard")
    columns, lengths, _, acts = read = reading()
    if _is_looked_at(files, read):
        if out or guard or given_of(reading):
            raise ValueError(f"say what is observed in {files[0]}: --observe; a way stands above")
        return
    if guard is not None and out is not None and guard.resolve() == out.resolve():
        raise ValueError(f"--out and --guard are both {out}; give each a file of its own")
    refuse_other_limit(acts, false_a_day, None if tolerance == TOLERANCE else tolerance)
    actions = _actions(action_range if acts else "0:1:1")
    encoder = columns.observe
    machine = _machine(actions.n_actions, rule, scale, max_states, encoder)
    kind = None if guard is None else _judge_of(judge if acts else "learnt", columns)
    notes = Noted()
    sources = [{"name": file, "bytes": _size(file)} for file in files]
    with progress("Learning", sum(file["bytes"] for file in sources)) as move:  # type: ignore[misc]
        chunks: Iterable[Chunk] = read.traces(files, notes, lambda count: move(advance=count))
        chunks = list(chunks) if guard is not None and not acts else chunks
        units_of = partial(notes.si_units, encoder.names)
        lesson = learn_traces(chunks, machine, actions, encoder.names, units_of)
    provenance = {"files": sources, "rows": lesson.read.rows, "episodes": lesson.read.episodes}
    provenance |= {"transitions": lesson.transitions, "failures": lesson.read.failures}
    provenance["read with"] = {k: v for k, v in given_of(reading).items() if k != "topics"}
    warnings = warnings_of(notes, columns)
    for warning in warnings:
        warn(f"warning: {warning}")
    if out is not None:
        lesson.model.save(out, provenance)
    new_guard = None
    if guard is not None:
        assert lesson.model.dt is not None
        dt, labels = lesson.model.dt, lesson.model.labels
        names, units = labels.names, labels.units
        if acts:
            if kind == "kinematic":
                new_guard = guard_of_monitor(dt, brakes, tolerance)
            else:
                learnt = LearntRisk(dt, actions.low, actions.high, names=names, units=units)
                reviser = ActionReviser(learnt, actions, tolerance=tolerance, mode=Mode.SHADOW)
                new_guard = Guard.of(reviser, interval=dt, machine=machine.copy())
            with progress("Teaching the guard", lesson.read.rows) as move:
                share = teach(new_guard, read.traces(files), lambda count: move(count))
            if refusal := refusing(share):
                warn(f"warning: in the later half of the log the guard {refusal}")
        else:
            requests = horizon, persist, false_a_day
            episodes = [chunk for chunk in episodes_of(chunks) if len(chunk.times) > 1]
            new_guard = guard_where_nobody_acts(episodes, labels, *requests, lesson.machine)
        new_guard.save(guard, provenance)
    if as_json:
        document = {"files": files, "saved": out, "guard": guard}
        document |= _document(lesson, provenance)
        print_json({**document, "noted": notes, "warnings": warnings})
        return
    pairs = [*_read(lesson, columns.action * acts), *_read_otherwise(notes, columns, lesson)]
    if lengths.seen:
        pairs.append(("vehicle lengths", f"assumed, for FCD has none: {lengths}"))
    learner = new_guard and new_guard.judge
    tables = alarms_of(learner) if isinstance(learner, Foresight) else tables_of(lesson.model)
    show(facts("What was read", pairs), *tables)
    say("")
    if out is None and new_guard is None:
        say("Nothing was saved; --out MODEL saves the model.")
    elif out is not None:
        say(f"Saved to {out}. Look at it again: evofsm inspect {out}")
    if new_guard is not None:
        beyond = (lesson.read.clipped_below + lesson.read.clipped_above) / lesson.read.rows
        for line in _of_guard(new_guard, guard, brakes, beyond):
            say(line)


# -- What was asked for ---------------------------------------------------------------------------


def _actions(text: str) -> IntervalActions:
    from evofsm.fsm.actions import IntervalActions

    try:
        low, high, width = map(float, text.split(":"))
        if width > 0.0 and (high - low) / width > _MOST_ACTIONS:
            raise ValueError(f"more than {_MOST_ACTIONS} intervals; make them wider")
        return IntervalActions(low, high, width, outside="clip")
    except ValueError as error:
        hint = "write LOW:HIGH:WIDTH, such as -2.5:2.5:0.3"
        raise ValueError(f"--action-range is {text!r}: {error}; {hint}") from None


def _machine(
    n_actions: int,
    rule: str,
    scale: list[str] | None,
    max_states: int | None,
    encoder: ObservationEncoder,
) -> EvolvingFSM:
    from evofsm.fsm.machine import EvolvingFSM
    from evofsm.fsm.rules import Novelty, rule_named

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
    from evofsm.driving import SAFETY_RULE
    from evofsm.driving.naming import VARIABLES
    from evofsm.fsm.validation import positive
    from evofsm.io.tables import quoted_name

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
        raise ValueError(
            f"--rule novelty has to know the difference that counts as 1 in {omissions[0]!r}: "
            f"--scale {quote(omissions[0])}=2 (a fifth of what it spans, or so)"
        )
    return [scales.get(name, 1.0) for name in encoder.names]


def _size(file: str) -> int:
    """Bytes of a file, or of those in a folder."""
    path = Path(file)
    return sum(part.stat().st_size for part in (path.iterdir() if path.is_dir() else [path]))


def _judge_of(judge: Judge | None, columns: LogColumns) -> Judge:
    """By what the guard is to judge, from what is observed where nobody said."""
    from evofsm.driving.naming import VARIABLES

    names = columns.observe.names
    if any(not isinstance(variable, str) for variable in columns.observe.variables):
        raise ValueError("--guard takes numbers alone, and --observe names a discrete column")
    judge = judge or ("kinematic" if names == VARIABLES else "learnt")
    if judge == "kinematic" and len(names) != len(VARIABLES):
        raise ValueError(
            f"--judge kinematic knows cars by their {', '.join(VARIABLES)}; --observe has to name "
            f"the three columns in this order, and names {', '.join(names)}"
        )
    if judge == "learnt" and columns.failed is None:
        raise ValueError(
            "--guard learns from failures, and which there were is not known: --failed COLUMN or "
            "--failed 'gap<=0' says it (of times or last rows docs/logs.md makes one); of cars in "
            "pairs --judge kinematic needs none"
        )
    return judge


def _check_out(out: Path | None, option: str = "--out") -> None:
    """Refuse before the long work what could not be saved after it."""
    from evofsm import store

    if out is None:
        return
    if not out.parent.is_dir():
        raise FileNotFoundError(f"{option} {out}: there is no folder {out.parent}")
    if not (os.access(out.parent, os.W_OK) or os.access(out, os.W_OK)):
        raise PermissionError(f"{option} {out}: the folder {out.parent} may not be written")
    if out.is_dir():
        raise IsADirectoryError(f"{option} {out} is a folder; name a file in it")
    if out.exists() and out.suffix != ".evofsm":  # so are ours called, whatever wrote them
        try:
            store.read_header(out)
        except (ValueError, OSError):
            fault = "exists and is no file of evofsm; it was left alone"
            raise ValueError(f"{option} {out}: {fault}") from None


def _is_looked_at(files: list[str], reading: Reading) -> bool:
    """Whether nobody said what is observed in a log of no cars; then what it holds was printed."""
    from evofsm.driving.naming import VARIABLES
    from evofsm.io.logs import open_table
    from evofsm.io.tables import CsvTable, ParquetTable, Skips

    columns = reading.columns
    if columns.observe.names != VARIABLES:
        return False
    table = open_table(files[0], columns, reading.lengths, reading.topics, Skips())
    if not isinstance(table, CsvTable | ParquetTable) or {*VARIABLES} & {*table.columns}:
        return False
    from evofsm.cli.look import show_look

    show_look(files, table)
    return True


# -- What came of it ------------------------------------------------------------------------------


def _of_guard(guard: Guard, path: Path | None, brakes: float, beyond: float) -> Iterator[str]:
    """Where it is, what it takes, and what it reckons with."""
    from evofsm.guard import Foresight, LearntRisk
    from evofsm.guard.foresight import span

    assert guard.judge is not None
    names = map(guard.judge.labels.variable, range(len(guard.variables)))
    keys = ", ".join(["time [s]", *names])
    also = "" if isinstance(guard.judge, Foresight) else ", and proposal, the action"
    takes = f"evofsm monitor --guard {path} takes rows of {keys}{also}."
    yield f"The guard was saved to {path}. {takes}"
    if isinstance(guard.judge, Foresight):
        soon = f"up to {span(guard.judge.horizon * guard.judge.dt)} before a failure (--horizon)"
        words = guard.judge.alarm_in_words
        if guard.judge.alarm is None:
            hint = " (fewer columns, or a longer --horizon?)" * ("chance" in words)
            yield f"It never alarms: {words}{hint}."
        else:
            yield f"{words.capitalize()} (--false-a-day), {soon}."
        judges = "evofsm monitor LOG --summary, with the same options, judges such alarms held out"
        yield f"{judges}; evofsm inspect {path} prints its states."
        return
    if not isinstance(guard.judge, LearntRisk):
        yield f"It reckons with brakes of {brakes:g} m/s² of the own car (--brakes)."
        return
    note = "" if len(guard.judge.state.forms) else " nothing yet"
    yield f"It judges{note}: {guard.judge.told_by_experience}."
    if beyond:
        yield f"It knows no action beyond --action-range, where {beyond:.1%} of the log's are."


def _document(learning: Learning, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """All that is printed, for JSON; states and actions from 0."""
    names = ("rows", "episodes", "seconds", "clipped_below", "clipped_above", "jumps", "failures")
    totals = {name: getattr(learning.read, name) for name in names}
    if not learning.model.failures_told:
        totals["failures"] = None
    model = {**model_document(learning.model), "provenance": provenance}
    return {**totals, "transitions": learning.transitions, "model": model}


def _read(learning: Learning, action: str) -> Iterator[tuple[str, str]]:
    from evofsm.cli.learning import MOST_LEVELS, range_of
    from evofsm.fsm.rules import describe_rule

    read, actions = learning.read, learning.model.actions
    yield "rows", f"{read.rows:,}, one every {learning.model.dt:g} s"
    minutes = read.seconds / 60.0
    together = f"{read.seconds:.1f} s" if minutes < 2.0 else f"{minutes:,.1f} min"
    yield "episodes", f"{read.episodes:,}, together {together}"
    yield "transitions", f"{learning.transitions:,}"
    assert actions is not None
    text = f"{actions.n_actions} intervals of {action} from {actions.low:g} to {actions.high:g}"
    if n_beyond := read.clipped_below + read.clipped_above:
        text += f"; {read.clipped_below:,} below and {read.clipped_above:,} above "
        text += f"({n_beyond / read.rows:.1%} of rows) were put into the end intervals"
    text = text if n_beyond else f"{text}; none was beyond"
    numbers = sorted(read.levels) if len(read.levels) <= MOST_LEVELS else []
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


def _read_otherwise(
    noted: Noted, columns: LogColumns, learning: Learning
) -> Iterator[tuple[str, str]]:
    """What was not learnt as it stands in the files."""
    from evofsm.io.tables import UNITS

    if columns.failed is None:
        yield "failures", "not known; --failed COLUMN or --failed 'gap<=0' says them"
    else:
        several = "" if learning.read.failures == 1 else "s"
        text = f"{learning.read.failures:,} episode{several} ended with {columns.failed}"
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
    if jumps := learning.read.jumps:
        yield "time jumps", f"{jumps:,}; each begins an episode (a longer --hole bridges them)"
    if noted.leaderless:
        nobody = columns.no_leader not in (None, "end")
        why = "a number is missing" + f", or {columns.no_leader}" * nobody
        ends = "" if hole and not columns.no_leader else "; there an episode ends"
        yield "left out", f"{noted.leaderless:,} rows: {why}{ends}"
    if noted.elsewhere:
        why = f"--where {columns.where} does not hold; there an episode ends"
        yield "left out", f"{noted.elsewhere:,} rows: {why}"
    conversions = {name: unit for name, unit in noted.units.items() if UNITS.get(unit, 1.0) != 1.0}
    if conversions:
        texts = (f"{name} from {unit}" for name, unit in conversions.items())
        yield "converted", f"{', '.join(texts)} to units of the SI"

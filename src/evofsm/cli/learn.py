"""`evofsm learn`."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from evofsm.cli import options
from evofsm.cli.options import argument, option

if TYPE_CHECKING:
    from evofsm.io import LogColumns


@options.reads_logs
def learn(
    files: Annotated[
        list[str], argument("Logs, recordings of traffic (FCD, ASAM OSI, objects), bags of ROS 2.")
    ],
    reading: dict[str, Any],
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
    judge: Annotated[
        options.Judge | None, option("Of --guard: kinematic (of cars) or learnt.")
    ] = None,
    brakes: options.Brakes = options.BRAKES,
    tolerance: options.Tolerance = options.TOLERANCE,
    horizon: options.Horizon = None,
    persist: options.Persist = 0.0,
    false_a_day: options.FalseADay = None,
    as_json: options.Json = False,
) -> None:
    """Learn a state machine from logs of your own, of any size, row by row.

    A log holds a row per time step; after a hole in time an episode begins. Of recordings of
    traffic, each vehicle and the next one ahead on its lane are a pair. Without --failed nobody
    knows what failed.

    With --guard, a guard in shadow mode then goes through all rows and learns from them too. Where
    nobody acts (--action ''), it learns alarms (--false-a-day).

    Of a log whose columns nobody named, evofsm learn LOG prints what is in it, and what to ask.
    """
    from evofsm.cli import foreseen, learning
    from evofsm.cli.models import model_document, tables_of
    from evofsm.cli.show import facts, print_json, progress, say, show, warn
    from evofsm.guard import Foresight, Guard
    from evofsm.io import Chunk, episodes_of, read_traces
    from evofsm.io.logs import Noted
    from evofsm.io.tables import UNITS

    learning.check_out(out, "model")
    learning.check_out(guard, "guard", "--guard")
    columns = options.reading_of(**reading)
    if _is_looked_at(files, columns):
        if out or guard or reading:
            raise ValueError(f"say what is observed in {files[0]}: --observe; a way stands above")
        return
    if guard is not None and out is not None and guard.resolve() == out.resolve():
        raise ValueError(f"--out and --guard are both {out}; give each a file of its own")
    own_tolerance = None if tolerance == options.TOLERANCE else tolerance
    alarms = horizon, persist, false_a_day
    options.refuse_other_limit(columns.acts, alarms, own_tolerance)
    actions = learning.actions_of(action_range if columns.acts else "0:1:1")
    encoder = columns.observe
    machine = learning.machine_of(actions.n_actions, rule, scale, max_states, encoder)
    kind = None if guard is None else learning.judge_of(judge, columns)
    notes, places = Noted(), [Path(file).resolve() for file in files]
    if twice := [f for f, place in zip(files, places, strict=True) if places.count(place) > 1]:
        raise ValueError(f"{twice[0]} is named twice; what failed there would be learnt twice, too")
    sizes = [learning.size_of(file) for file in files]
    with progress("Learning", sum(sizes)) as move:
        chunks: Iterable[Chunk] = read_traces(
            files, columns, notes, lambda count: move(advance=count)
        )
        chunks = list(chunks) if guard is not None and not columns.acts else chunks
        units_of = partial(notes.si_units, encoder.names)
        lesson = learning.learn_traces(chunks, machine, actions, encoder.names, units_of)
    if kind == "learnt" and columns.acts and len(lesson.levels) < 2:
        fault = "is always the same, so that nothing tells what others would do (--action '')"
        raise ValueError(f"--guard: {columns.action} {fault}")
    model, counts = lesson.model, lesson.counts
    provenance: dict[str, Any] = {
        "files": [{"name": n, "bytes": size} for n, size in zip(files, sizes, strict=True)],
        **{name: counts[name] for name in ("rows", "episodes", "transitions", "failures")},
        "read with": {k: v for k, v in reading.items() if k != "topics"},
        "units": {name: unit for name, unit in notes.units.items() if UNITS.get(unit, 1.0) != 1.0},
    }
    warnings = learning.warnings_of(notes, columns)
    for warning in warnings:
        warn(f"warning: {warning}")
    if out is not None:
        model.save(out, provenance)
    new_guard: Guard | None = None
    if guard is not None and kind is not None:
        if columns.acts:
            new_guard = learning.guard_of_log(kind, model, machine, brakes, tolerance)
            with progress("Teaching the guard", counts["rows"]) as move:
                share = learning.teach(new_guard, read_traces(files, columns), move)
            if new_guard.machine is not None:
                new_guard.machine.tell_of_failures(told=model.failures_told)
            if refusal := learning.refusing(share):
                warn(f"warning: in the later half of the log the guard {refusal}")
        else:
            episodes = [chunk for chunk in episodes_of(chunks) if len(chunk.times) > 1]
            new_guard = foreseen.guard_where_nobody_acts(
                episodes, model.labels, alarms, lesson.machine
            )
        new_guard.save(guard, provenance)
    if as_json:
        document: dict[str, Any] = {"files": files, "saved": out, "guard": guard, **counts}
        document |= {"seconds": lesson.seconds, "noted": notes, "warnings": warnings}
        document |= {} if model.failures_told else {"failures": None}
        print_json({**document, "model": {**model_document(model), "provenance": provenance}})
        return
    pairs = [*learning.read_of(lesson, columns.action * columns.acts)]
    pairs += learning.read_otherwise(notes, columns, counts)
    if columns.lengths.seen:
        pairs.append(("vehicle lengths", f"assumed, for FCD has none: {columns.lengths}"))
    learner = new_guard and new_guard.judge
    tables = foreseen.alarms_of(learner) if isinstance(learner, Foresight) else tables_of(model)
    show(facts("What was read", pairs), *tables)
    say("")
    if out is None and new_guard is None:
        say("Nothing was saved; --out MODEL saves the model.")
    elif out is not None:
        say(f"Saved to {out}. Look at it again: evofsm inspect {out}")
    if new_guard is not None:
        beyond = (counts["clipped_below"] + counts["clipped_above"]) / counts["rows"]
        for line in learning.told_of_guard(new_guard, guard, provenance["units"], brakes, beyond):
            say(line)


def _is_looked_at(files: list[str], columns: LogColumns) -> bool:
    """Whether nobody said what is observed in a log of no cars; then what it holds was printed."""
    from evofsm.driving.naming import VARIABLES
    from evofsm.io.logs import open_table
    from evofsm.io.tables import CsvTable, ParquetTable, Skips

    if columns.observe.names != VARIABLES:
        return False
    table = open_table(files[0], columns, Skips())
    if not isinstance(table, CsvTable | ParquetTable) or {*VARIABLES} & {*table.columns}:
        return False
    from evofsm.cli.look import show_look

    show_look(files, table)
    return True

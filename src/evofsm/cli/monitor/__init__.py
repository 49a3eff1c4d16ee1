"""`evofsm monitor`: the guard beside a stack of others; rows or scenes in, decisions out."""

from __future__ import annotations

from contextlib import ExitStack, nullcontext
from dataclasses import replace
from functools import partial
from hashlib import sha256
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

from typer import Context

from evofsm.cli import options
from evofsm.cli.options import argument, option

_SAME_STEP = 0.05  # share by which the step of a log may differ from that of the guard
_INTERVAL = 0.1  # of rows of cars, where nobody said another one [s]
# What other files end with holds live rows; so does CSV without --summary.
_LOGS = (".csv", ".parquet", ".xml", ".gz", ".mcap", ".db3", ".osi")
_OF_LOGS = ("hold", "dt", "skip_bad", "vehicle_length", "topics")  # as live rows are not read
# And how a guard is made, which a saved one says itself.
_OF_GUARDS = ("low", "high", "n_actions", "interval", "horizon", "persist", "brakes")
_SAVED = b'{"__metadata__"'  # in the beginning of what was saved


@options.reads_logs
def monitor(
    ctx: Context,
    files: Annotated[
        list[Path] | None,
        argument(
            "Rows in JSON or CSV; a log; a guard. [default: standard input]", metavar="[FILE]"
        ),
    ] = None,
    guard: Annotated[Path | None, option("A saved guard. [default: see --brakes]")] = None,
    low: Annotated[
        str | None, option("Lowest action, of a guard that begins; with commas: of each component.")
    ] = None,
    high: Annotated[str | None, option("Highest action, as --low.")] = None,
    n_actions: Annotated[
        int | None, option("Number of actions, where one is an index from 0.", min=2)
    ] = None,
    interval: Annotated[
        float | None,
        option("Time between two rows [s], without --guard. [default: of cars 0.1]", min=0.0),
    ] = None,
    brakes: options.Brakes = options.BRAKES,
    tolerance: Annotated[
        float | None, option("Highest risk that is accepted. [default: of --guard, or 0.02]")
    ] = None,
    traffic: Annotated[bool, option("Judge all objects of scenes.", "--traffic")] = False,
    mode: Annotated[options.ModeName, option("How far it goes: in shadow all passes.")] = "shadow",
    learn: Annotated[bool, option("Learn from what comes.", "--learn")] = False,
    state: Annotated[Path | None, option("Save all in this file, and go on from it.")] = None,
    audit: Annotated[Path | None, option("Write an audit log to this file.")] = None,
    episode: Annotated[
        str | None, option("Rows of an episode at most, 6000; or columns that tell them apart.")
    ] = None,
    socket: Annotated[Path | None, option("Listen to a UNIX socket.")] = None,
    zenoh: Annotated[str | None, option("Rows at KEY/row, answers at KEY/decision.")] = None,
    text: Annotated[
        bool, option("Print alarms and failures alone, in words, for people.", "--text")
    ] = False,
    warm: Annotated[bool, option("Compile before the first row comes.", "--warm")] = False,
    summary: Annotated[
        bool, option("Print how often it would have alarmed, and the worst moments.", "--summary")
    ] = False,
    observe: Annotated[str | None, option("Variables of rows. [default: the guard's]")] = None,
    *,
    reading: dict[str, Any],
    horizon: options.Horizon = None,
    persist: options.Persist = 0.0,
    false_a_day: options.FalseADay = None,
    split: Annotated[
        float, option("Of --summary without --guard: the share that is learnt from.", min=0, max=1)
    ] = 0.6,
    plot: Annotated[Path | None, option("Of --summary, where nobody acts: a picture.")] = None,
    as_json: options.Json = False,
) -> int | None:
    """Decide alongside a stack of your own: rows in, decisions out, a JSON line each.

    A row: {"time": 0.1, "gap": 32, "v_follower": 20, "v_leader": 18, "proposal": 0.5}, in s, m,
    m/s and m/s²; docs/monitor.md describes all messages. Without --learn only a guard that begins
    learns; nothing is changed without --mode act, and with it nothing beyond the guard's range is
    executed. Ctrl-C or SIGTERM ends it, with everything saved.
    Rows are read as options from --observe to --hole say, without one as the guard's log was,
    whatever default stands there; live rows have all values themselves: --hold needs --summary.

    To begin a guard of any system say what is observed (--observe), how often (--interval or
    --resample), and who acts: --low and --high, --n-actions, or nobody (--action '').

    With --summary it reads FILE, such lines or a log, and prints how often it would have alarmed.
    Where nobody acts, alarms stand beside plain thresholds; without --guard the log's first part
    is learnt from (--split).
    """
    file = None
    for path in files or ():
        with path.open("rb") if path.is_file() and guard is None else nullcontext() as stream:
            if stream is not None and _SAVED in stream.read(64):
                guard = path  # rows then come from elsewhere
            elif file is not None:
                raise ValueError(f"one FILE is read; cat joins several, names and all: {path}")
            else:
                file = path
    if [file, socket, zenoh].count(None) < 2:
        raise ValueError("give one of FILE, --socket and --zenoh")
    file = None if file == Path("-") else file  # as which others name standard input
    if plot is not None and not summary:
        raise ValueError("--plot draws what --summary says, where nobody acts")
    if plot is not None:
        options.require(matplotlib="plot")
        options.refuse_unnamed(plot)
    is_log = file is not None and (file.suffix in _LOGS[not summary :] or file.is_dir())
    if is_log and not summary:
        raise ValueError(f"{file} is read with --summary; live rows are JSON or CSV, a line each")
    logs = f"logs ({', '.join(_LOGS)}), read with --summary"
    options.refuse_typed(ctx, () if is_log else _OF_LOGS, logs)
    guards = f"a guard that is made here; {guard} has learnt its own"
    options.refuse_typed(ctx, () if guard is None else _OF_GUARDS, guards)
    if traffic and (guard or state or learn or is_log):
        raise ValueError("--traffic judges scenes alone: no log, --guard, --state or --learn")
    if summary and (file is None or state or audit):
        raise ValueError("--summary needs FILE, and goes with no --state or --audit")
    from evofsm.cli.models import load_learning
    from evofsm.cli.monitor.decider import EPISODE, Decider, begun, prepare
    from evofsm.cli.monitor.slots import Slots
    from evofsm.cli.monitor.state import State
    from evofsm.cli.monitor.summary import Text, decided_on_lines, decided_on_log, summary_of
    from evofsm.cli.monitor.transports import Server, Stream, json_line, transport_of
    from evofsm.cli.show import show, warn
    from evofsm.driving.cars import assumptions, guard_of_monitor
    from evofsm.driving.naming import VARIABLES
    from evofsm.fsm import Labels
    from evofsm.guard import AuditLog, Foresight
    from evofsm.guard.foresight import span
    from evofsm.io.tables import is_number

    parts = {"low": low, "high": high, "n_actions": n_actions, "observe": observe}
    system = {name: part for name, part in parts.items() if part is not None}
    alarms = horizon, persist, false_a_day
    how: Any = brakes, options.TOLERANCE if tolerance is None else tolerance
    make: Any = partial(guard_of_monitor, interval or _INTERVAL, *how, traffic=traffic)
    log_options, units = options.read_with(guard or state)
    notice, reader = assumptions(*how), {**log_options, **reading}
    if guard is not None:
        make = partial(load_learning, guard, reader.get("failed"))
        notice = f"assumed: what {guard} was given and has learnt"
    elif not is_log and (system or "action" in reading):
        if traffic:
            raise ValueError("--traffic is of cars, and goes with no --observe or --action")
        new_guard = begun(system, reading, interval, tolerance, alarms)
        make, learn = (lambda: new_guard), True
        notice = f"a guard of {', '.join(new_guard.variables)} learns from what comes"
    rows, learnt_of = EPISODE, reader.pop("observe", None)
    observe = observe or learnt_of
    if episode is not None and is_number(episode) and not is_log:
        if not (episode.isdecimal() and int(episode)):
            raise ValueError(f"--episode is {episode!r}; it is a number of rows, or columns")
        rows = int(episode)
    elif episode is not None:
        reader["episode"] = episode
    with ExitStack() as stack:
        chunks, keeper, slots = None, None, None
        if summary and file is not None and is_log:
            from evofsm.cli.foreseen import show_foreseen
            from evofsm.cli.learning import episodes_read
            from evofsm.io.logs import Noted

            sentry = make() if guard else None
            alone = reader.get("action") == "" or isinstance(sentry and sentry.judge, Foresight)
            names = sentry.variables if sentry else VARIABLES
            if observe is None or {*options.split_names(observe)} == {*names}:  # in its own order
                observe = options.quoted(names)
            if alone:
                reader["action"] = ""
            log_format = replace(options.reading_of(**reader, observe=observe), usual_units=units)
            fewest = 1 if alone else 2  # a failure that comes at once counts as well
            notes = Noted()
            episodes = episodes_read(str(file), log_format, notes, dated=alone, fewest=fewest)
            if (first := next(episodes, None)) is None:
                raise ValueError(f"{file}: no episode has two rows")
            chunks, interval = chain([first], episodes), first.dt
            if sentry and not abs(interval / sentry.interval - 1.0) < _SAME_STEP:
                warning = f"{file} has a row every {span(interval)}, and {guard} decides each"
                warn(f"warning: {warning} {sentry.interval:g} s: --resample {sentry.interval:g}s")
            if alone:
                options.refuse_other_limit(False, alarms, tolerance)
                every, names = list(chunks), log_format.observe.names
                labels = Labels(names=names, units=tuple(notes.si_units(names)))
                about = labels, alarms, split, plot
                show_foreseen(file, every, sentry, *about, as_json=as_json)
                return None
        if summary and (as_json or plot):
            raise ValueError("--json and --plot are for logs where nobody acts: --action ''")
        if state is not None:
            is_other = guard is not None and guard.resolve() != state.resolve()
            digest = sha256(guard.read_bytes()).hexdigest() if guard and is_other else None
            basics = {"interval": interval, "brakes": brakes} if guard is None else {}
            ends = [rows, reader["episode"]] if "episode" in reader else rows
            ways = {"mode": mode, "learn": learn, "tolerance": tolerance, "episode": ends}
            ways["false_a_day"] = false_a_day
            columns = {k: v for k, v in reader.items() if k != "topics"}
            log = {"read with": {**columns, "observe": observe} if observe else {}, "units": units}
            settings = {"guard": digest, **columns, **basics, **ways, **system}
            keeper = State(state, settings, log)
            stack.callback(keeper.close)
        elif learn and not summary:
            warn("nothing of what is learnt is saved; --state FILE saves it")
        sentry = make() if keeper is None else keeper.guard(make, reader.get("failed"))
        prepare(sentry, mode, tolerance, alarms)
        sentry.learn = learn
        if audit is not None:
            sentry.audit = stack.enter_context(AuditLog(audit, sync="episode"))
        if not (is_log or traffic):
            if observe is None or sentry.variables != VARIABLES:  # cars' may have other names
                observe = options.quoted(sentry.variables or VARIABLES)
            row_format = options.reading_of(**{**reader, "observe": observe, "dt": None})
            slots = Slots(replace(row_format, usual_units=units))
        decider = Decider(sentry, episode=rows, slots=slots)
        stack.callback(decider.close)
        if slots is not None and (live := {k: v for k, v in reader.items() if k not in _OF_LOGS}):
            si = "; in JSON all but its column of the time is in the SI" * ("unit" in reader)
            notice += f"; rows are read as in a log: {options.typed(live)}{si}"
        if slots is not None and "hold" in reader:
            notice += "; its log had several clocks (--hold), but each row has to have all values"
        if units:
            texts = ", ".join(f"{name} in {unit}" for name, unit in units.items())
            notice += f"; CSV has {texts} as in the guard's log, unless a row of units says others"
        if summary and file is not None:
            warn(notice)
            answers = decided_on_log(decider, chunks) if chunks else decided_on_lines(decider, file)
            show(*summary_of(decider, answers, str(file)))
            return None
        words = Text()
        line = words.line if text else json_line
        if warm:
            decider.warm()
            warn("compiled")
        if keeper is not None:
            again = keeper.begin(decider, words.line)
            if decider.n:
                warn(f"goes on after decision {decider.n} ({again} rows taken in again)")
            if words.standing:
                warn(words.standing)
        server = Server(decider, keeps=keeper is not None, line=line)
        transport, where = transport_of(file, socket, zenoh, stack)
        if keeper is not None and isinstance(transport, Stream) and file and file.is_file():
            transport.source.seek(keeper.pass_over(file, decider))
        warn(notice)
        warn(f"ready: {where}")
        try:
            server.run(transport)
            if file and not decider.n:
                warn(f"no row of {file} was decided on")
                return 2  # as --summary does
        except BrokenPipeError:
            warn("nobody reads the decisions any more")
            return 1
        finally:
            if keeper is None and decider.rows:
                decider.end()
    return None

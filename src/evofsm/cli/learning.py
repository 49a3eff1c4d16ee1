"""Learn a machine from a stream of traces, say what was odd in them, and teach a guard."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from shlex import quote
from typing import Any, NamedTuple

import numpy as np

from evofsm.cli.options import Reading
from evofsm.cli.show import warn
from evofsm.driving.cars import guard_of_monitor
from evofsm.driving.naming import VARIABLES
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.model import FSMModel
from evofsm.guard import ActionReviser, Guard, LearntRisk, Mode
from evofsm.io import Chunk, episodes_of
from evofsm.io.logs import LogColumns, Noted
from evofsm.io.tables import SI, TIMES, UNITS

# A unit at the end of a column's name, behind another letter or as a word of its own.
_WORD = "(?:^|[^A-Za-z]|(?<=[a-z])(?=[A-Z]))"
_CALLED = re.compile(_WORD + "((?i:km[/_ ]?p?h|kph|mph|knots|feet|ft|cm|mm|km))[^A-Za-z]*$")
_TIME_CALLED = re.compile(_WORD + "((?i:ms|us|ns))(?:ec)?[^A-Za-z]*$")
# Units of time that logs are in, of which that counts by which a row comes every 0.1 s or so.
_SHORTER = ("ms", "us", "ns")
# So near must a unit come to what two columns differ by, to be named.
_MATCHES = 0.02
# What is said of what was left out, where it is no row.
_LEFT_OUT = {
    "comment": "comments between rows were passed over",
    "action": "rows have no action, and what leads on from them was not learnt",
    "cut": "file ends early, and what is whole was read",
}
# What reaches so far is no car's speed in any unit [m/s]: revolutions, perhaps.
_NO_SPEED = 500.0
# Numbers that stand for nobody in many recordings.
_NOBODY = (0.0, -1.0, 255.0, 999.0, 9999.0, 65535.0)


@dataclass
class Read:
    """What was read."""

    rows: int = 0  #: observations
    episodes: int = 0
    seconds: float = 0.0  #: time between the first and the last row of the episodes, together [s]
    clipped_below: int = 0  #: actions below the range, put into its first interval
    clipped_above: int = 0  #: actions above the range, put into its last interval
    jumps: int = 0  #: episodes that began because of a hole in time
    failures: int = 0  #: episodes that ended in failure
    dt: float = np.nan  #: usual time between two rows [s]
    last_time: float = np.nan  #: of the latest row [s]


class Learning(NamedTuple):
    """What was learnt, and from what."""

    machine: EvolvingFSM  #: can go on learning
    model: FSMModel
    read: Read
    transitions: int


def learn_traces(
    chunks: Iterable[Chunk],
    machine: EvolvingFSM,
    actions: IntervalActions,
    names: Sequence[str] = (),
    units: Callable[[], Sequence[str]] = tuple,
) -> Learning:
    """Learn all chunks in their order, each row once; units are known once they are read."""
    machine, read = machine.copy(), Read()
    for chunk in chunks:
        learn_chunk(machine, chunk, actions)
        _count(read, chunk, actions)
    model = machine.model(
        actions=actions, names=names, units=units(), dt=None if np.isnan(read.dt) else read.dt
    )
    if (transitions := int(model.uses.sum())) == 0:
        raise ValueError(
            "no transition could be learnt: no row with an action is followed by another row of "
            "its episode (is every row an episode? are the rows sorted by episode and time?)"
        )
    return Learning(machine, model, read, transitions)


# -- What was noticed in reading ------------------------------------------------------------------


def _called(name: str, *, is_time: bool) -> str:
    """The unit that is part of a column's name, if it is none of the SI."""
    match = (_TIME_CALLED if is_time else _CALLED).search(name)
    if match is None:
        return ""
    word = match[1].lower()
    return {"feet": "ft", "knots": "kn"}.get(word) or (word if word in UNITS else "km/h")


def warnings_of(noted: Noted, columns: LogColumns | None = None) -> list[str]:
    """What is most likely a mistake, and what would mend it."""
    columns = columns or LogColumns()
    time = columns.time
    units = {name: unit for name in noted.untold if (unit := _called(name, is_time=name == time))}
    warnings = [
        f"{name} reaches {fastest:,.0f} m/s, faster than any car on a road: is it in km/h or "
        f"mph? --unit {quote(f'{name}=km/h')} converts it"
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
        goes = []
        for name, (start, *more) in ((k, v) for k, v in noted.compared.items() if v):
            if isinstance(start, str):
                goes.append(f"{name} is {', '.join(map(repr, [start, *more]))}")
            else:
                text = f"{name}, as compared, goes from {start:.6g} to {more[0]:.6g} "
                goes.append(text + SI.get(noted.units.get(name, ""), ""))
        text = ": ".join([f"no row meets --failed {quote(columns.failed)}", *goes])
        warnings.append(text.rstrip())
    is_untold = time in noted.untold and time not in units and not noted.resampled
    cars, step = columns.observe.names == VARIABLES, noted.longest_step
    ratio = max(step / 60.0, 60.0 / max(step, 1e-9))  # machines have parts of minutes, or several
    if step > 0.0 and is_untold and (cars or abs(ratio - round(ratio)) > 0.05):
        unit = min(_SHORTER, key=lambda unit: abs(np.log10(step * TIMES[unit]) + 1.0))
        cause = f"is the time in {unit}? --unit {time}={unit} converts it"
        warnings.append(f"there is a row every {step:,.6g} s: {cause}")
    nobody = " (no leader)" * cars
    constant = [kv for kv in noted.at_once.items() if kv[1] in _NOBODY or noted.failed_at_once > 1]
    if constant and noted.failed_at_once >= noted.failed / 2:
        name, value = min(constant, key=lambda kv: kv[1] not in _NOBODY)
        warnings.append(
            f"{noted.failed_at_once:,} of {noted.failed:,} failed episodes fail with their first "
            f"row, and {name} is {value:g} there each time: does that stand for a missing "
            f"value{nobody}? --no-leader {quote(f'{name}=={value:g}')} leaves such rows out"
        )
    if noted.failed_at_once:
        warnings.append(
            f"{noted.failed_at_once:,} of {noted.failed:,} failures came right after a hole or "
            "standstill: what led there was not recorded, so no alarm could foresee them"
        )
    if alone := [(name, *pair) for name, pair in noted.below.items() if pair[0] and pair[1] > 2]:
        name, value, rows = min(alone, key=lambda entry: entry[1] not in _NOBODY)
        warnings.append(
            f"{name} is {value!r} in {rows:,} rows, and else never below 0: is that a missing "
            f"value{nobody}? --no-leader {quote(f'{name}=={value!r}')} leaves such rows out"
        )
    warnings += _contradictions(noted, columns)
    if noted.unplaced:
        lie = "failure lies" if noted.unplaced == 1 else "failures lie"
        why = "in rows that are left out, outside of any episode: not counted"
        warnings.append(f"{noted.unplaced:,} {lie} {why}")
    for kind, (count, first) in noted.skipped.items():
        text = _LEFT_OUT.get(kind, "bad rows were left out (--skip-bad)")
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
    path: str,
    reading: Reading,
    notes: Noted,
    *,
    dated: bool,
    fewest: int = 2,
) -> Iterator[Chunk]:
    """The episodes of a log that have so many rows; then what was noticed.

    They have dates where these are wanted, and where the log has some.
    """
    for episode in episodes_of(reading.traces([path], notes)):
        if len(episode.times) >= fewest:
            yield episode._replace(times=episode.times + notes.began) if dated else episode
    for warning in warnings_of(notes, reading.columns):
        warn(f"warning: {warning}")


# -- A guard --------------------------------------------------------------------------------------


def guard_of_log(
    judge: str,
    dt: float,
    brakes: float,
    tolerance: float,
    actions: IntervalActions,
    machine: EvolvingFSM,
    names: Sequence[str],
    units: Sequence[str],
) -> Guard:
    """A guard in shadow mode that has learnt nothing yet, of cars or of any other system."""
    if judge == "kinematic":
        return guard_of_monitor(dt, brakes, tolerance)
    learnt = LearntRisk(dt, actions.low, actions.high, names=names, units=units)
    reviser = ActionReviser(learnt, actions, tolerance=tolerance, mode=Mode.SHADOW)
    return Guard.of(reviser, interval=dt, machine=machine.copy())


def teach(guard: Guard, chunks: Iterable[Chunk], show: Callable[[int], object]) -> float:
    """The share in which a guard refuses, of the later half of a log; ``show`` is told of rows."""
    n_rows, refusals, reviser = 0, bytearray(), guard.reviser
    assert isinstance(reviser, ActionReviser)
    for episode in episodes_of(chunks):
        rows, times = episode.observations, episode.times - episode.times[0]
        for row, proposal, at in zip(rows[:-1], episode.actions, times, strict=False):
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
    machine.learn_many(chunk.observations, indices, chunk.starts, chunk.failures)


def _count(read: Read, chunk: Chunk, actions: IntervalActions) -> None:
    """Count what is in a chunk."""
    read.dt = chunk.dt
    steps = np.diff(chunk.times, prepend=read.last_time)
    steps[chunk.starts] = 0.0
    read.last_time = float(chunk.times[-1])
    read.seconds += float(steps.sum())
    read.rows += len(steps)
    read.episodes += len(chunk.starts)
    read.jumps += chunk.jumps
    read.failures += 0 if chunk.failures is None else len(chunk.failures)
    read.clipped_below += int((chunk.actions < actions.low).sum())
    read.clipped_above += int((chunk.actions > actions.high).sum())

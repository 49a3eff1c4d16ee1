"""Where nobody acts: alarms that are learnt from a log, and what came of them in another one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evofsm.cli.options import picture
from evofsm.cli.show import facts, print_json, show, table
from evofsm.fsm import EvolvingFSM, Labels
from evofsm.fsm.proportions import poisson_bounds
from evofsm.guard import ActionReviser, Choices, Foresight, Guard, Mode
from evofsm.guard.foresight import DATES, RATES, Runs, false_times, span
from evofsm.io import Chunk

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from rich.console import RenderableType

    Floats = NDArray[np.float64]

#: False alarms a day that are accepted, where nobody says how risky it may be.
RATE = 0.3
#: The share of a log that is learnt from, where the rest is to judge it.
LEARNT = 0.6
# Alarms that are listed.
_LISTED = 12
_CAME = ("ahead", "false/day")
_HEADER = ("stated", "foreseen", *_CAME, "thresholds", *_CAME)


def guard_where_nobody_acts(
    episodes: Sequence[Chunk],
    labels: Labels,
    horizon: float | None,
    hold: float,
    tolerance: float | None,
    machine: EvolvingFSM | None = None,
) -> Guard:
    """A guard that alarms before failures, as it was learnt from the episodes of a log.

    The tolerance is by default such that there are `RATE` false alarms a day.
    """
    runs, dt = _runs(episodes), float(episodes[0].dt)
    rows, names, units = [e.observations for e in episodes], labels.names, labels.units
    settings: dict[str, Any] = {"dt": dt, "horizon": horizon, "hold": hold}
    judge = Foresight.learn_log(rows, runs.failed, **settings, names=names, units=units)
    tolerance = judge.tolerance_of(RATE) if tolerance is None else tolerance
    return _guard_of(judge, tolerance, machine, learn=False)


def guard_from_zero(
    dt: float, names: Sequence[str], horizon: float | None, hold: float, tolerance: float | None
) -> Guard:
    """The same, of one that has seen nothing, and learns as it goes."""
    judge = Foresight.from_zero(dt=dt, names=names, horizon=horizon, hold=hold)
    machine = EvolvingFSM(1, max_states=200)
    return _guard_of(judge, 0.5 if tolerance is None else tolerance, machine, learn=True)


def _guard_of(
    judge: Foresight, tolerance: float, machine: EvolvingFSM | None, *, learn: bool
) -> Guard:
    reviser = ActionReviser(judge, Choices(1), tolerance=tolerance, mode=Mode.SHADOW)
    return Guard.of(reviser, interval=judge.dt, machine=machine, learn=learn)


def show_foreseen(
    file: Path,
    episodes: Sequence[Chunk],
    guard: Guard | None,
    labels: Labels,
    asked: tuple[float | None, float, float | None],
    plot: Path | None,
    *,
    as_json: bool,
) -> None:
    """Say what came of the alarms of a guard, or of one that learns from the log's first part.

    What is asked for are the horizon, the hold time and the tolerance.
    """
    title, held_out = str(file), "; not held out, if this guard learnt from them"
    if guard is None:
        rows = np.cumsum([len(e.times) for e in episodes])
        first = int((rows <= LEARNT * rows[-1]).sum())
        first_part, episodes = _of_two_rows(episodes[:first]), episodes[first:]
        if not (first_part and _of_two_rows(episodes)):
            raise ValueError(f"{file}: it takes two episodes at least, to learn and to judge")
        guard = guard_where_nobody_acts(first_part, labels, *asked)
        title += f": learnt from its first {len(first_part):,} episodes, judged by the rest"
        held_out = f", held out (the last {1.0 - LEARNT:.0%} of the rows)"
    at_once = sum(e.failed for e in episodes if len(e.times) == 1)
    episodes = _of_two_rows(episodes)
    reviser, judge = guard.reviser, guard.judge
    assert isinstance(reviser, ActionReviser)
    assert isinstance(judge, Foresight)
    tolerance = reviser.tolerance if asked[-1] is None else asked[-1]
    runs, times = _runs(episodes), np.concatenate([e.times for e in episodes])
    columns = judge.columns(runs.rows, runs.starts)
    if plot is not None:
        _draw(judge, tolerance, guard.machine, runs, times, columns, plot)
    document = {**_document(judge, tolerance, runs, times, columns), "failures_at_once": at_once}
    if as_json:
        print_json({"file": file, **document})
    else:
        show(*_tables(document, judge, title, held_out))


def _of_two_rows(episodes: Sequence[Chunk]) -> Sequence[Chunk]:
    """Those of which something can be foreseen."""
    return [episode for episode in episodes if len(episode.times) > 1]


def _runs(episodes: Sequence[Chunk]) -> Runs:
    return Runs.of([e.observations for e in episodes], [e.failed for e in episodes])


def _document(
    judge: Foresight, tolerance: float, runs: Runs, times: Floats, columns: Floats
) -> dict[str, Any]:
    own_rate, alarms, limits = judge.rate_of(tolerance), [], []
    for rate, budget in enumerate(RATES):
        row: dict[str, Any] = {"stated": budget, "is_own": rate == own_rate}
        for kind, plain in (("learnt", None), ("plain", True)):
            tally, _ = judge.tally(runs, rate, plain=plain, columns=columns)
            row[kind] = {**tally._asdict(), "false_a_day": tally.rate}
        alarms.append(row)
        row = {"stated": budget, "kind": ("learnt", "plain", "none")[int(judge.held_out[rate, 3])]}
        row |= {"share_right": judge.shares[rate], "learnt": judge.words(rate) or "none"}
        row |= {"plain": judge.words(rate, plain=True) or "none"}
        row["thresholds"] = [
            {"variable": judge.labels.names[int(v)], "above" if sign > 0.0 else "below": at}
            for *_, v, _, sign, at in judge.of_rate(rate, plain=True).tolist()
        ]
        limits.append(row)
    head: dict[str, Any] = {"rows": len(times), "episodes": len(runs.starts)}
    head |= {"failures": int(runs.failed.sum()), "seconds": len(times) * judge.dt}
    head |= {"horizon": judge.horizon * judge.dt, "tolerance": tolerance}
    entries = [] if own_rate is None else list(_listed(judge, own_rate, runs, times, columns))
    misses = [row for row in entries if "lasts" not in row]
    hits = [row for row in entries if "lasts" in row]
    fails = [dict(zip(("where", "came", "failed"), row, strict=True)) for row in judge.fails(runs)]
    tables = {"alarms": alarms, "limits": limits, "fails": fails}
    return {**head, **tables, "listed": hits, "missed": misses}


def _listed(
    judge: Foresight, rate: int, runs: Runs, times: Floats, columns: Floats
) -> Iterator[dict[str, Any]]:
    """Each alarm, and each failure that none was before, which lasts for no time."""
    _, on = judge.tally(runs, rate, columns=columns)
    horizon = judge.horizon
    for k, (first, end) in enumerate(pairwise([*runs.starts.tolist(), len(times)])):
        edges = np.flatnonzero(np.diff(on[first:end], prepend=False, append=False)) + first
        fails, why = end - 1 if runs.failed[k] else end + horizon, ""
        foreseen = not runs.failed[k]
        for onset, stop in edges.reshape(-1, 2).tolist():
            if onset == fails:
                why = "; one came with it"
                continue
            false = false_times(onset, stop, fails, horizon)
            right = bool(runs.failed[k]) and false * horizon < stop - onset
            foreseen |= right
            limits = judge.passed(columns[:, onset])
            row = {"episode": k, "row": onset, "time": times[onset], "failed": right}
            row |= {"lasts": (stop - onset) * judge.dt, "false": int(false)}
            yield {**row, "reason": judge.reason(rate, runs.rows[onset], limits)}
        if not foreseen:
            row = {"episode": k, "row": fails, "time": times[fails]}
            yield {**row, "reason": f"no alarm within {span(horizon * judge.dt)} before it{why}"}


def _tables(
    found: dict[str, Any], judge: Foresight, title: str, held_out: str
) -> Iterator[RenderableType]:
    days = found["seconds"] / 86400.0
    soon = f"an alarm is right if one comes within {span(found['horizon'])}"
    text, rows, bold = "none: cross-validated, no alarm was better than chance", [], []
    for k, alarm in enumerate(found["alarms"]):
        row = [f"{alarm['stated']:g}"]
        for tally in (alarm["learnt"], alarm["plain"]):
            share, ahead = f"{tally['foreseen']} of {tally['failures']}", span(tally["lead"])
            row += [share, ahead, f"{tally['false_a_day']:.2g}"]
        rows.append(row)
        if alarm["is_own"]:
            text = f"{row[1]} failures foreseen, {row[2]} ahead (mean; not foreseen: 0)"
            text += f", {(false := alarm['learnt']['false']):,} false"
            if poisson_bounds(false)[0] > days * alarm["stated"]:
                text += f": more than the {row[0]} a day that were stated, from too short a log"
                text += ", or one that changed"
            bold = [k]
    rows_read = f"{found['rows']:,} in {found['episodes']:,} episodes, {days:.3g} days of rows"
    pairs = [("rows", rows_read + held_out)]
    at_once = f", and {found['failures_at_once']:,} right after a hole or standstill"
    failures = f"{found['failures']:,}{at_once * (found['failures_at_once'] > 0)}; {soon}"
    pairs += [("failures", failures), ("alarms", text)]
    yield facts(title, pairs)
    title = "\nAlarms by the false ones a day that were stated, and plain thresholds"
    yield table(title, _HEADER, rows, bold=bold)
    places = []
    for rates, k in judge.alarms.items():
        limit = found["limits"][k]
        is_other = limit["kind"] != "plain" and limit["plain"] != "none"
        beside = f"; plain thresholds would be {limit['plain']}" if is_other else ""
        places.append((rates, f"{judge.of(k)}{beside}"))
    yield facts("\nWhere they alarm, by false alarms a day", places)
    rows = [[x["where"], f"{x['came']:,}", f"{x['failed']:,}"] for x in found["fails"]]
    header = "it fails where", "episodes that came there", "of them failed"
    yield table("\nWhere it fails, as it was learnt", header, rows)
    rows = []
    for hit in found["listed"][-_LISTED:]:
        false = {0: [], 1: ["no"]}.get(hit["false"], [f"{hit['false']} times no"])
        failed = ", then ".join([*false, *["yes"] * hit["failed"]])
        why = hit["reason"].partition("; after")[0]
        rows.append([f"{hit['episode'] + 1}", date(hit["time"]), span(hit["lasts"]), failed, why])
    title = _last(found["listed"], "Alarms")
    yield table(title, ("episode", "time", "lasts", "failed", "why"), rows, left=(0, 4))
    if misses := found["missed"]:
        rows = [[f"{x['episode'] + 1}", date(x["time"]), x["reason"]] for x in misses[-_LISTED:]]
        header = "episode", "time", "why"
        yield table(_last(misses, "Failures that were not foreseen"), header, rows, left=(0, 2))


def _last(hits: Sequence[Any], what: str) -> str:
    n = len(hits)
    return f"\n{what}: {'all' if n <= _LISTED else f'the last {_LISTED} of'} {n:,}"


def date(time: float) -> str:
    """A time [s], as people read it."""
    if time < DATES:
        return f"{time:.10g}"
    return f"{datetime.fromtimestamp(time, UTC):%Y-%m-%d %H:%M}"


def _draw(
    judge: Foresight,
    tolerance: float,
    machine: EvolvingFSM | None,
    runs: Runs,
    times: Floats,
    columns: Floats,
    out: Path,
) -> None:
    """Variables, states, risk, alarms and failures over time: all of it, and the last failure."""
    from evofsm import plot

    own_rate = judge.rate_of(tolerance)
    on = judge.tally(runs, own_rate or 0, columns=columns)[1]
    risk = on * (0.0 if own_rate is None else judge.shares[own_rate])  # as a live row tells it
    failed, ends = np.zeros(len(risk), np.bool_), runs.last
    failed[ends[runs.failed]] = True
    # Of those that lasted for a while, if there are any, the last one that failed, if one did.
    number = int(np.lexsort([runs.starts, runs.failed, runs.lengths > judge.horizon])[-1])
    last = int(ends[number])
    near = max(int(runs.starts[number]), last - 4 * judge.horizon)
    limits = [] if own_rate is None else judge.thresholds(own_rate)
    rate_text = next((rates for rates, last in judge.alarms.items() if own_rate == last), "")
    alarm = f", alarm for {rate_text} false a day" if rate_text else ", no alarm"
    names = [judge.labels.variable(v) for v in range(runs.rows.shape[1])]
    model = None if machine is None or not machine.n_states else machine.model()
    count = len(names) + 1 + (model is not None)
    with picture(out, 10.0, 1.3 * count) as figure:
        axes = figure.subplots(count, 2, sharex="col")
        title = f"Episode {number + 1:,}{', before it failed' if runs.failed[number] else ''}"
        title += f": {date(times[last])}" * bool(times[last] >= DATES)
        parts = {f"{len(ends):,} episodes{alarm}": slice(None), title: slice(near, last + 1)}
        for column, (title, part) in zip(axes.T, parts.items(), strict=True):
            series = times[part], runs.rows[part], names, risk[part], failed[part]
            plot.history(column, *series, tolerance, model=model, limits=limits)
            column[0].set_title(title, loc="left")
        axes[-1, 1].get_legend().remove()

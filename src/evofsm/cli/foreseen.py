"""Where nobody acts: alarms that are learnt from a log, and what came of them in another one."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import RenderableType

from evofsm.cli.options import Alarms, picture
from evofsm.cli.show import facts, print_json, show, table
from evofsm.fsm import EvolvingFSM, Labels
from evofsm.fsm.proportions import poisson_bounds
from evofsm.fsm.validation import counted
from evofsm.guard import ActionReviser, Choices, Foresight, Guard, Mode
from evofsm.guard.foresight import DATES, RATE, RATES, Runs, false_times, span
from evofsm.io import Chunk
from evofsm.io.tables import date

Floats = NDArray[np.float64]

_ANY_ALARM = 1e-6  # a lower share of alarms is right for none: which it is the judge says
_LISTED = 12  # alarms
_CAME = ("ahead", "false/day")
_HEADER = ("stated", "foreseen", *_CAME, "thresholds", *_CAME)


def guard_where_nobody_acts(
    episodes: Sequence[Chunk], labels: Labels, alarms: Alarms, machine: EvolvingFSM | None = None
) -> Guard:
    """A guard that alarms before failures, as it was learnt from the episodes of a log."""
    rows, failed = [e.observations for e in episodes], [e.failed for e in episodes]
    settings: dict[str, Any] = {"dt": float(episodes[0].dt), "horizon": alarms[0]}
    settings |= {"hold": alarms[1], "names": labels.names, "units": labels.units}
    judge = Foresight.learn_log(rows, failed, **settings)
    return guard_of_alarms(judge, alarms, machine, learn=False)


def guard_of_alarms(
    judge: Foresight, alarms: Alarms, machine: EvolvingFSM | None, *, learn: bool
) -> Guard:
    """A guard where nobody acts, with so many false alarms a day that are stated."""
    judge.stated = RATE if alarms[-1] is None else alarms[-1]
    reviser = ActionReviser(judge, Choices(1), tolerance=_ANY_ALARM, mode=Mode.SHADOW)
    return Guard.of(reviser, interval=judge.dt, machine=machine, learn=learn)


def show_foreseen(
    file: Path,
    episodes: Sequence[Chunk],
    guard: Guard | None,
    labels: Labels,
    asked: Alarms,
    split: float,
    plot: Path | None,
    *,
    as_json: bool,
) -> None:
    """Say what came of the alarms of a guard, or of one that learns from the log's first part."""
    title, held_out = str(file), "; not held out, if this guard learnt from them"
    first = before = 0
    if guard is None:
        rows = np.cumsum([len(e.times) for e in episodes])
        first = int((rows <= split * rows[-1]).sum())
        first_part, episodes = _of_two_rows(episodes[:first]), episodes[first:]
        before = len(first_part)
        fault = ""
        if not any(e.failed for e in (*first_part, *episodes)):
            fault = "no episode failed, so there is nothing to foresee (--failed says what did)"
        elif not (first_part and _of_two_rows(episodes)):
            fault = "it takes two episodes at least, to learn and to judge"
        elif not any(e.failed for e in first_part):
            fault = f"none failed in the first {split:.0%} of the rows, which it learns from, but "
            fault += f"{sum(e.failed for e in episodes):,} later did (--split)"
        if fault:
            raise ValueError(f"{file}: {fault}")
        guard = guard_where_nobody_acts(first_part, labels, asked)
        learnt_from = "episode" if first == 1 else f"{before:,} episodes"
        title += f": learnt from its first {learnt_from}, judged by the rest"
        held_out = f", held out (the last {1.0 - rows[first - 1] / rows[-1]:.0%} of the rows)"
    at_once = sum(e.failed for e in episodes if len(e.times) == 1)
    numbers = [k for k, e in enumerate(episodes, first) if len(e.times) > 1]
    episodes = _of_two_rows(episodes)
    judge = guard.judge
    if not isinstance(judge, Foresight):
        raise ValueError("--action '' says that nobody acts; this guard judges who does")
    judge.stated = judge.stated if asked[-1] is None else asked[-1]
    runs = judge.runs([e.observations for e in episodes], [e.failed for e in episodes])
    times = np.concatenate([e.times for e in episodes])
    columns = judge.columns(runs)
    document = {**_document(judge, runs, times, columns), "failures_at_once": at_once}
    document["episodes_before"] = before
    for entry in (*document["listed"], *document["missed"]):
        entry["episode"] = numbers[entry["episode"]]  # counted in the log, as `evofsm watch` does
    if plot is not None:
        _draw(judge, guard.machine, runs, numbers, times, document, plot)
    if as_json:
        print_json({"file": file, **document})
    else:
        show(*_tables(document, judge, title, held_out))


def _of_two_rows(episodes: Sequence[Chunk]) -> Sequence[Chunk]:
    """Those of which something can be foreseen."""
    return [episode for episode in episodes if len(episode.times) > 1]


def _document(judge: Foresight, runs: Runs, times: Floats, columns: Floats) -> dict[str, Any]:
    own_rate, alarms, limits = judge.alarm, [], []
    for rate, budget in enumerate(RATES):
        row: dict[str, Any] = {"stated": budget, "is_own": rate == own_rate}
        for kind, plain in (("learnt", None), ("plain", True)):
            tally, _ = judge.tally(runs, rate, plain=plain, columns=columns, times=times)
            row[kind] = {**tally._asdict(), "false_a_day": tally.false / tally.days}
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
    head |= {"horizon": judge.horizon * judge.dt}
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
    horizon = judge.horizon * judge.dt
    for k, (first, end) in enumerate(pairwise([*runs.starts.tolist(), len(times)])):
        edges = np.flatnonzero(np.diff(on[first:end], prepend=False, append=False)) + first
        fails, why = times[end - 1] if runs.failed[k] else math.inf, ""
        foreseen = not runs.failed[k]
        for onset, stop in edges.reshape(-1, 2).tolist():
            began, over = times[onset], times[stop] if stop < end else times[end - 1] + judge.dt
            if began >= fails:
                why = "; one came with it"
                continue
            false, right = false_times(over - began, fails - began, horizon)
            foreseen |= right
            row = {"episode": k, "row": onset, "rows": stop - onset, "time": began}
            row |= {"failed": right, "lasts": min(over, fails) - began, "false": int(false)}
            yield {**row, "reason": judge.reason(runs.rows[onset], columns[:, onset])}
        if not foreseen:
            row = {"episode": k, "row": end - 1, "time": fails}
            yield {**row, "reason": f"no alarm within {span(horizon)} before it{why}"}


def _tables(
    found: dict[str, Any], judge: Foresight, title: str, held_out: str
) -> Iterator[RenderableType]:
    days = found["seconds"] / 86400.0
    horizon = span(found["horizon"])
    soon = f"an alarm is right if one comes within {horizon}"
    if any(hit["false"] > 1 - hit["failed"] for hit in found["listed"]):
        soon += f"; one that stays on counts anew each {horizon}"
    text, rows, bold, worse = f"none: {judge.alarm_in_words}", [], [], []
    for k, alarm in enumerate(found["alarms"]):
        row = [f"{alarm['stated']:g}"]
        for tally in (alarm["learnt"], alarm["plain"]):
            share, ahead = f"{tally['foreseen']} of {tally['failures']}", span(tally["lead"])
            star = "*" * bool(poisson_bounds(tally["false"])[0] > days * alarm["stated"])
            row += [share, ahead, f"{tally['false_a_day']:.2g}{star}"]
        worse += [k] * len(star)  # plain thresholds are no choice at this rate
        rows.append(row)
        if alarm["is_own"]:
            mean = f"(mean, {horizon} at most; not foreseen: 0)"
            text = f"{row[1]} failures foreseen, {row[2]} ahead {mean}"
            text += f", {alarm['learnt']['false']:,} false"
            if "*" in row[3]:
                text += f": more than the {row[0]} a day that were stated, beyond what is by chance"
            bold = [k]
    episodes = counted(found["episodes"], "episode")
    rows_read = f"{found['rows']:,} in {episodes}, {days:.3g} days of rows"
    pairs = [("rows", rows_read + held_out)]
    at_once = f", and {found['failures_at_once']:,} right after a hole or standstill"
    soon = soon if found["failures"] else "of alarms nothing is judged here but how many are false"
    failures = f"{found['failures']:,}{at_once * (found['failures_at_once'] > 0)}; {soon}"
    pairs += [("failures", failures), ("alarms", text)]
    yield facts(title, pairs)
    title = "\nAlarms by the false ones a day that were stated, and plain thresholds"
    title += " (*: more are false, beyond chance)" * any("*" in "".join(row) for row in rows)
    yield table(title, _HEADER, rows, bold=bold)
    yield from alarms_of(judge, worse)
    if rows := [[x["where"], f"{x['came']:,}", f"{x['failed']:,}"] for x in found["fails"]]:
        header = "it fails where", "judged episodes that came there", "of them failed"
        yield table("\nWhere it fails, as it was learnt", header, rows)
    rows = []
    for hit in found["listed"][-_LISTED:]:
        times, failed = hit["false"] + hit["failed"], "yes" if hit["failed"] else "no"
        if times > 1:
            failed += f", the last of {times}" if hit["failed"] else f", {times} times"
        why = hit["reason"].partition("; after")[0]
        rows.append([f"{hit['episode'] + 1}", date(hit["time"]), span(hit["lasts"]), failed, why])
    if rows:
        title = _last(found["listed"], "Alarms")
        yield table(title, ("episode", "time", "lasts", "failed", "why"), rows, left=(0, 4))
    if misses := found["missed"]:
        rows = [[f"{x['episode'] + 1}", date(x["time"]), x["reason"]] for x in misses[-_LISTED:]]
        header = "episode", "time", "why"
        yield table(_last(misses, "Failures that were not foreseen"), header, rows, left=(0, 2))


def alarms_of(judge: Foresight, worse: Collection[int] = ()) -> Iterator[RenderableType]:
    """What each alarm is, and how often it was right, beside plain thresholds but the worse."""
    places = []
    for rates, rate in judge.alarms.items():
        text, plain = judge.of(rate), judge.words(rate, plain=True)
        is_said = rate in worse or text.startswith("plain thresholds do as well")
        beside = f"; plain thresholds would be {plain}" * bool(plain and not is_said)
        places.append((rates, f"{text}{beside}"))
    yield facts("\nWhere they alarm, by false alarms a day, counted in rows", places)


def _last(hits: Sequence[Any], what: str) -> str:
    n = len(hits)
    return f"\n{what}: {'all' if n <= _LISTED else f'the last {_LISTED} of'} {n:,}"


def _draw(
    judge: Foresight,
    machine: EvolvingFSM | None,
    runs: Runs,
    numbers: Sequence[int],
    times: Floats,
    document: dict[str, Any],
    out: Path,
) -> None:
    """Variables, states, alarms and failures over time: all of it, one foreseen, and one missed."""
    from evofsm import plot

    alarms, failures = np.zeros((2, len(times)), np.int64)
    failures[runs.last[runs.failed]] = 1
    failures[[row["row"] for row in document["missed"]]] = 2
    for hit in document["listed"]:
        alarms[hit["row"] : hit["row"] + hit["rows"]] = 1 if hit["failed"] else 2
    limits = [] if judge.alarm is None else judge.thresholds(judge.alarm)
    parts = {_headline(document): slice(None)}
    for kind, word in ((1, "foreseen"), (2, "not foreseen")):
        ends = np.flatnonzero(failures == kind)
        if len(ends):  # the one whose episode lasted as long as most
            places = np.searchsorted(runs.last, ends)
            typical = int(np.argsort(runs.lengths[places])[len(ends) // 2])
            first, last = int(runs.starts[places[typical]]), int(ends[typical])
            title = f"{word}: episode {numbers[places[typical]] + 1:,}"
            title += f", {date(times[last])}" * bool(times[last] >= DATES)
            parts[title] = slice(max(first, last - 4 * judge.horizon), last + 1)
    names = [judge.labels.variable(v) for v in range(runs.rows.shape[1])]
    model = None if machine is None or not machine.n_states else machine.model()
    count = len(names) + 1 + (model is not None)
    heights = [1.0] * (count - 1) + [0.35]
    with picture(out, 5.0 * len(parts), 1.3 * count) as figure:
        axes = figure.subplots(
            count, len(parts), sharex="col", squeeze=False, height_ratios=heights
        )
        for column, (title, part) in zip(axes.T, parts.items(), strict=True):
            series = times[part], runs.rows[part], names, alarms[part], failures[part]
            plot.history(column, *series, model=model, limits=limits)
            column[0].set_title(title, loc="left", pad=16.0)
        for ax in axes[-1, 1:]:
            ax.get_legend().remove()


def _headline(document: dict[str, Any]) -> str:
    """What came of the alarm, in a line."""
    rows = [row for row in document["alarms"] if row["is_own"]]
    if not rows:
        return f"{counted(document['failures'], 'failure')}, no alarm"
    tally = rows[0]["learnt"]
    rates = f"{tally['false_a_day']:.2g} false a day ({rows[0]['stated']:g} stated)"
    ahead = f"{tally['foreseen']} of {tally['failures']} failures foreseen, {span(tally['lead'])}"
    return f"{ahead} ahead, {rates}"

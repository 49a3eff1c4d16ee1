"""Where nobody acts: alarms that are learnt from a log, and what came of them in another one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from evofsm.cli.options import require
from evofsm.cli.show import facts, table
from evofsm.fsm.machine import EvolvingFSM
from evofsm.guard import ActionReviser, Choices, Foresight, Guard, Mode
from evofsm.guard.foresight import RATES, Runs, Tally, runs_of, span
from evofsm.io import Chunk

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from rich.console import RenderableType

#: False alarms a day that are accepted, where nobody says how risky it may be.
RATE = 0.3
#: The share of a log that is learnt from, where the rest is to judge it.
LEARNT = 0.6
# Alarms that are listed; times from here on are dates [s].
_LISTED, _DATES = 12, 1e8


class Told(NamedTuple):
    """Episodes of a log, one after the other."""

    runs: Runs
    times: NDArray[np.float64]  #: (T,) [s]

    def date(self, row: int) -> str:
        """When a row was."""
        time = float(self.times[row])
        return (
            f"{datetime.fromtimestamp(time, UTC):%Y-%m-%d %H:%M}"
            if time > _DATES
            else f"{time:.10g}"
        )


def told_by(chunks: Sequence[Chunk]) -> Told:
    """The episodes of chunks."""
    failed = [one.failures is not None and len(one.failures) > 0 for one in chunks]
    runs = runs_of([one.observations for one in chunks], failed)
    return Told(runs, np.concatenate([one.times for one in chunks]))


def split(chunks: Sequence[Chunk]) -> tuple[Sequence[Chunk], Sequence[Chunk]]:
    """The episodes of the first part of a log, and the others."""
    rows = np.cumsum([len(one.times) for one in chunks])
    first = int((rows <= LEARNT * rows[-1]).sum())
    return chunks[:first], chunks[first:]


def guard_where_nobody_acts(
    chunks: Sequence[Chunk],
    names: Sequence[str],
    units: Sequence[str],
    *,
    horizon: float | None,
    persist: float,
    tolerance: float | None,
    machine: EvolvingFSM | None = None,
) -> Guard:
    """A guard that alarms before failures, as it was learnt from the episodes of a log."""
    told, dt = told_by(chunks), float(chunks[0].dt)
    median = float(np.median([len(one.times) for one in chunks])) * dt
    ahead = horizon or max(median / 20.0, 10.0 * dt)
    named: dict[str, Any] = {
        "names": names,
        "units": units,
        "horizon": ahead,
        "hold": persist,
        "dt": dt,
    }
    judge = Foresight.learn_log([one.observations for one in chunks], told.runs.failed, **named)
    accepted = judge.tolerance_of(RATE) if tolerance is None else tolerance
    reviser = ActionReviser(judge, Choices(1), tolerance=accepted, mode=Mode.SHADOW)
    return Guard.of(reviser, interval=dt, machine=machine, learn=False)


def document(guard: Guard, told: Told) -> dict[str, Any]:
    """What came of all alarms in a log, beside plain thresholds; rows count from 0."""
    judge, reviser = guard.judge, guard.reviser
    assert isinstance(judge, Foresight)
    assert isinstance(reviser, ActionReviser)
    chosen, rows = judge.rate_of(reviser.tolerance), []
    for rate, stated in enumerate(RATES):
        for rows_held in sorted({judge.hold, max(judge.hold, judge.horizon // 10)}):
            hold = (rows_held - 1) * judge.dt
            both = [judge.tally(told.runs, rate, plain=p, hold=hold)[0] for p in (None, True)]
            rows.append(
                {
                    "stated": stated,
                    "hold": hold,
                    "is_own": rate == chosen and rows_held == judge.hold,
                    **dict(zip(("learnt", "plain"), (_told(one) for one in both), strict=True)),
                }
            )
    limits = [
        {
            "stated": stated,
            "share_right": float(judge.shares[rate]),
            "kind": ("learnt", "plain", "none")[int(judge.held_out[rate, 2])],
            "learnt": list(map(judge.told, judge.of_rate(rate))),
            "plain": list(map(judge.told, judge.of_rate(rate, plain=True))),
        }
        for rate, stated in enumerate(RATES)
    ]
    own = [] if chosen is None else list(_listed(judge, chosen, told))
    seconds = len(told.times) * judge.dt
    head = {"rows": len(told.times), "episodes": len(told.runs.starts), "seconds": seconds}
    head |= {"failures": int(told.runs.failed.sum()), "horizon": judge.horizon * judge.dt}
    return {**head, "tolerance": reviser.tolerance, "alarms": rows, "limits": limits, "listed": own}


def _told(found: Tally) -> dict[str, Any]:
    return {**found._asdict(), "false_a_day": found.rate}


def _listed(judge: Foresight, rate: int, told: Told) -> Iterator[dict[str, Any]]:
    """Each alarm, and each failure that none was before."""
    runs, (_, on) = told.runs, judge.tally(told.runs, rate)
    for k, (first, end) in enumerate(pairwise([*runs.starts.tolist(), len(told.times)])):
        edges = np.flatnonzero(np.diff(on[first:end], prepend=False, append=False)) + first
        for begun, over in edges.reshape(-1, 2).tolist():
            came = bool(runs.failed[k]) and over == end and begun < end - 1
            passed = judge.passed(runs.rows[first : begun + 1])
            said = {"reason": judge.reason(rate, runs.rows[begun], passed), "failed": came}
            lasted = (over - begun) * judge.dt
            yield {"episode": k, "row": begun, "time": told.times[begun], "lasts": lasted, **said}
        if runs.failed[k] and not (len(edges) and edges[-1] == end and edges[-2] < end - 1):
            where = {"episode": k, "row": end - 1, "time": told.times[end - 1], "lasts": 0.0}
            yield {**where, "reason": "no alarm was on", "failed": True}


def tables_of(found: dict[str, Any], told: Told, title: str) -> Iterator[RenderableType]:
    """The same for people."""
    ahead = span(found["horizon"])
    days = f"{found['seconds'] / 86400.0:.3g} days"
    pairs = [("rows", f"{found['rows']:,} in {found['episodes']:,} episodes, {days}")]
    pairs += [("failures", f"{found['failures']:,}; an alarm is right if one comes within {ahead}")]
    own = next((one for one in found["alarms"] if one["is_own"]), None)
    if own is None:
        pairs.append(("alarms", "none: on episodes held out, no alarm was better than chance"))
    else:
        one = own["learnt"]
        text = (
            f"{one['foreseen']} of {one['failures']} failures foreseen, {span(one['lead'])} ahead"
        )
        pairs.append(("alarms", f"{text} (mean; not foreseen: 0), {one['false']:,} false"))
    yield facts(title, pairs)
    rows = [
        (f"{one['stated']:g}", span(one["hold"]), *_cells(one["learnt"]), *_cells(one["plain"]))
        for one in found["alarms"]
    ]
    header = (
        "stated",
        "hold",
        *("foreseen", "ahead", "false/day"),
        "thresholds",
        "ahead",
        "false/day",
    )
    bold = [k for k, one in enumerate(found["alarms"]) if one["is_own"]]
    yield table(
        "\nAlarms by the false ones a day that were stated, and plain thresholds",
        header,
        rows,
        bold=bold,
    )
    said = []
    for one in found["limits"]:
        plain = " or ".join(one["plain"]) or "none"
        text = f"{' or '.join(one['learnt'])} ({one['share_right']:.0%} were right, held out)"
        if one["kind"] == "plain":
            text = f"plain thresholds do as well, so it is {text}"
        elif one["kind"] == "none":
            text = f"none: nothing was better than chance; plain thresholds would be {plain}"
        else:
            text += f"; plain thresholds would be {plain}"
        said.append((f"{one['stated']:g}", text))
    yield facts("\nWhere they alarm, by false alarms a day", said)
    if latest := found["listed"][-_LISTED:]:
        cells = [
            (
                f"{one['episode'] + 1}",
                told.date(one["row"]),
                span(one["lasts"]),
                "yes" if one["failed"] else "no",
                one["reason"].partition(";")[0],
            )
            for one in latest
        ]
        title = f"\nThe last of {len(found['listed'])} alarms"
        yield table(title, ("episode", "time", "lasts", "failed", "why"), cells, left=(0, 4))


def _cells(one: dict[str, Any]) -> tuple[str, ...]:
    ahead = span(one["lead"])
    return f"{one['foreseen']} of {one['failures']}", ahead, f"{one['false_a_day']:.2g}"


def draw(guard: Guard, told: Told, out: Path) -> None:
    """Variables, states, risk, alarms and failures over time: all of it, and the last failure."""
    require(matplotlib="plot")
    from matplotlib.figure import Figure
    from matplotlib.style import context

    from evofsm import plot

    judge, reviser, runs = guard.judge, guard.reviser, told.runs
    assert isinstance(judge, Foresight)
    assert isinstance(reviser, ActionReviser)
    on = [judge.tally(runs, rate)[1] * judge.shares[rate] for rate in range(len(RATES))]
    risk = np.max(on, axis=0)
    ends = np.append(runs.starts[1:], len(risk)) - 1
    last = int(ends[runs.failed][-1]) if runs.failed.any() else len(risk) - 1
    near = max(int(runs.starts[runs.starts <= last][-1]), last - 4 * judge.horizon)
    names = [judge.labels.variable(v) for v in range(runs.rows.shape[1])]
    model = None if guard.machine is None or not guard.machine.n_states else guard.machine.model()
    with context(["default", "evofsm.paper.house"]):
        figure = Figure((10.0, 1.3 * (len(names) + 2)), layout="constrained")
        for column, part in enumerate((slice(0, len(risk)), slice(near, last + 1))):
            z, failed = runs.rows[part], np.isin(np.arange(len(risk)), ends[runs.failed])[part]
            given = told.times[part], z, names, risk[part], failed
            plot.history(figure, *given, reviser.tolerance, model=model, place=(column, 2))
        figure.savefig(out)

"""Where nobody acts: alarms that are learnt from a log, and what came of them in another one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from itertools import chain, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from evofsm.cli.options import require
from evofsm.cli.show import facts, print_json, show, table
from evofsm.fsm import EvolvingFSM, Labels
from evofsm.guard import ActionReviser, Choices, Foresight, Guard, Mode
from evofsm.guard.foresight import RATES, Runs, span
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
_CAME = ("ahead", "false/day")
_HEADER = ("stated", "hold", "foreseen", *_CAME, "thresholds", *_CAME)


class Asked(NamedTuple):
    """What alarms are to be."""

    horizon: float | None = None  #: [s]; a twentieth of the median episode
    persist: float = 0.0  #: [s]
    tolerance: float | None = None  #: such that there are `RATE` false alarms a day


class Told(NamedTuple):
    """Episodes of a log, one after the other."""

    runs: Runs
    times: NDArray[np.float64]  #: (T,) [s]

    @classmethod
    def of(cls, chunks: Sequence[Chunk]) -> Told:
        """The episodes that are chunks."""
        failed = [one.failures is not None and len(one.failures) > 0 for one in chunks]
        runs = Runs.of([one.observations for one in chunks], failed)
        return cls(runs, np.concatenate([one.times for one in chunks]))


def guard_where_nobody_acts(
    chunks: Sequence[Chunk], labels: Labels, asked: Asked, machine: EvolvingFSM | None = None
) -> Guard:
    """A guard that alarms before failures, as it was learnt from the episodes of a log."""
    rows, dt = [one.observations for one in chunks], float(chunks[0].dt)
    horizon = asked.horizon or max(float(np.median([*map(len, rows)])) / 20.0, 10.0) * dt
    given: dict[str, Any] = {"dt": dt, "horizon": horizon, "hold": asked.persist}
    given |= {"names": labels.names, "units": labels.units}
    judge = Foresight.learn_log(rows, Told.of(chunks).runs.failed, **given)
    tolerance = judge.tolerance_of(RATE) if asked.tolerance is None else asked.tolerance
    reviser = ActionReviser(judge, Choices(1), tolerance=tolerance, mode=Mode.SHADOW)
    return Guard.of(reviser, interval=dt, machine=machine, learn=False)


def show_foreseen(
    file: Path,
    chunks: Sequence[Chunk],
    guard: Guard | None,
    labels: Labels,
    asked: Asked,
    plot: Path | None,
    *,
    as_json: bool,
) -> None:
    """Say what came of the alarms of a guard, or of one that learns from the log's first part."""
    title = str(file)
    if guard is None:
        rows = np.cumsum([len(one.times) for one in chunks])
        first = int((rows <= LEARNT * rows[-1]).sum())
        if not 0 < first < len(chunks):
            raise ValueError(f"{file}: it takes two episodes at least, to learn and to judge")
        guard, chunks = guard_where_nobody_acts(chunks[:first], labels, asked), chunks[first:]
        title += f": learnt from its first {first:,} episodes, judged by the rest"
    reviser = guard.reviser
    assert isinstance(reviser, ActionReviser)
    assert isinstance(reviser.risk, Foresight)
    reviser.tolerance = reviser.tolerance if asked.tolerance is None else asked.tolerance
    told, judge = Told.of(chunks), reviser.risk
    found = _document(judge, reviser.tolerance, told)
    if plot is not None:
        _draw(judge, reviser.tolerance, guard.machine, told, plot)
    if as_json:
        print_json({"file": file, **found})
    else:
        show(*_tables(found, title))


def _document(judge: Foresight, tolerance: float, told: Told) -> dict[str, Any]:
    """What came of all alarms in a log, beside plain thresholds; rows count from 0."""
    chosen, rows, limits = judge.rate_of(tolerance), [], []
    for rate, stated in enumerate(RATES):
        for held in sorted({judge.hold, max(judge.hold, judge.horizon // 10)}):
            row: dict[str, Any] = {"stated": stated, "hold": (held - 1) * judge.dt}
            row["is_own"] = rate == chosen and held == judge.hold
            for kind, plain in (("learnt", None), ("plain", True)):
                came, _ = judge.tally(told.runs, rate, plain=plain, hold=row["hold"])
                row[kind] = {**came._asdict(), "false_a_day": came.rate}
            rows.append(row)
        kind = ("learnt", "plain", "none")[int(judge.held_out[rate, 2])]
        row = {"stated": stated, "kind": kind, "share_right": float(judge.shares[rate])}
        for name, plain in (("learnt", None), ("plain", True)):
            row[name] = " or ".join(map(judge.told, judge.of_rate(rate, plain=plain))) or "none"
        row["thresholds"] = [
            {"variable": judge.labels.names[int(v)], "above" if sign > 0.0 else "below": at}
            for *_, v, _, sign, at in judge.of_rate(rate, plain=True).tolist()
        ]
        limits.append(row)
    head: dict[str, Any] = {"rows": len(told.times), "episodes": len(told.runs.starts)}
    head |= {"failures": int(told.runs.failed.sum()), "seconds": len(told.times) * judge.dt}
    head |= {"horizon": judge.horizon * judge.dt, "tolerance": tolerance}
    own = [] if chosen is None else list(_listed(judge, chosen, told))
    return {**head, "alarms": rows, "limits": limits, "listed": own}


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


def _tables(found: dict[str, Any], title: str) -> Iterator[RenderableType]:
    """The same for people."""
    days = f"{found['seconds'] / 86400.0:.3g} days"
    soon = f"an alarm is right if one comes within {span(found['horizon'])}"
    pairs = [("rows", f"{found['rows']:,} in {found['episodes']:,} episodes, {days}")]
    pairs += [("failures", f"{found['failures']:,}; {soon}")]
    text = "none: on episodes held out, no alarm was better than chance"
    for one in (one["learnt"] for one in found["alarms"] if one["is_own"]):
        text = f"{_share(one)} failures foreseen, {span(one['lead'])} ahead (mean; not foreseen: 0)"
        text += f", {one['false']:,} false"
    yield facts(title, [*pairs, ("alarms", text)])
    rows = []
    for one in found["alarms"]:
        each = ((_share(o), span(o["lead"]), f"{o['false_a_day']:.2g}") for o in _both(one))
        rows.append((f"{one['stated']:g}", span(one["hold"]), *chain(*each)))
    bold = [k for k, one in enumerate(found["alarms"]) if one["is_own"]]
    title = "\nAlarms by the false ones a day that were stated, and plain thresholds"
    yield table(title, _HEADER, rows, bold=bold)
    said = []
    for one in found["limits"]:
        ours, plain = _both(one)
        text = f"{ours} ({one['share_right']:.0%} were right, held out)"
        if one["kind"] == "plain":
            text = f"plain thresholds do as well, so it is {text}"
        elif one["kind"] == "none":
            text = f"none: nothing was better than chance; plain thresholds would be {plain}"
        else:
            text += f"; plain thresholds would be {plain}"
        said.append((f"{one['stated']:g}", text))
    yield facts("\nWhere they alarm, by false alarms a day", said)
    rows = []
    for one in found["listed"][-_LISTED:]:
        failed, why = "yes" if one["failed"] else "no", one["reason"].partition(";")[0]
        rows.append((f"{one['episode'] + 1}", _date(one["time"]), span(one["lasts"]), failed, why))
    title = f"\nThe last of {len(found['listed'])} alarms"
    yield table(title, ("episode", "time", "lasts", "failed", "why"), rows, left=(0, 4))


def _both(one: dict[str, Any]) -> tuple[Any, Any]:
    return one["learnt"], one["plain"]


def _share(one: dict[str, Any]) -> str:
    return f"{one['foreseen']} of {one['failures']}"


def _date(time: float) -> str:
    return (
        f"{datetime.fromtimestamp(time, UTC):%Y-%m-%d %H:%M}" if time > _DATES else f"{time:.10g}"
    )


def _draw(
    judge: Foresight, tolerance: float, machine: EvolvingFSM | None, told: Told, out: Path
) -> None:
    """Variables, states, risk, alarms and failures over time: all of it, and the last failure."""
    require(matplotlib="plot")
    from matplotlib.figure import Figure
    from matplotlib.style import context

    from evofsm import plot

    runs, chosen = told.runs, judge.rate_of(tolerance)
    on = np.array([judge.tally(runs, rate)[1] for rate in range(len(RATES))])
    if chosen is not None:
        on[judge.shares > tolerance] &= on[chosen]
    risk = np.max(on * judge.shares[:, None], axis=0)
    failed, ends = np.zeros(len(risk), np.bool_), runs.starts + runs.lengths - 1
    failed[ends[runs.failed]] = True
    last = int(np.flatnonzero(failed)[-1]) if failed.any() else len(risk) - 1
    near = max(int(runs.starts[runs.starts <= last][-1]), last - 4 * judge.horizon)
    names = [judge.labels.variable(v) for v in range(runs.rows.shape[1])]
    model = None if machine is None or not machine.n_states else machine.model()
    with context(["default", "evofsm.paper.house"]):
        count = len(names) + 1 + (model is not None)
        figure = Figure((10.0, 1.3 * count), layout="constrained")
        axes = figure.subplots(count, 2, sharex="col")
        for column, part in zip(axes.T, (slice(None), slice(near, last + 1)), strict=True):
            seen = told.times[part], runs.rows[part], names, risk[part], failed[part]
            plot.history(column, *seen, tolerance, model=model)
        figure.savefig(out)

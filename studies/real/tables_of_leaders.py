"""Leaders' brakes in real drives, and alarms in shadow mode, as tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import zip_longest

from evofsm.driving import REAL_DRIVES, LeaderBrakes
from evofsm.guard import TOLERANCE
from studies.old.shim import Column, Table, count, decimals
from studies.real.leaders import TOLD, Alarms, Braked, LeaderStudy, Limits

# So many are to be seen until an assumed one weighs no more than the tolerance.
_NEEDED = math.ceil(1.0 / TOLERANCE - 1e-9) - 1
# The reviser's own.
_BRAKES: tuple[Column[Braked], ...] = (
    Column("drives", "source"),
    Column("runs", "runs", count),
    Column("hours", "brakes.hours", decimals(1)),
    Column("gentle", "brakes.gentle", count),
    Column("hard", "seen", count),
    Column("waves", "waves", count),
    Column("hardest", lambda one: one.hardest if one.seen else None, decimals(1), "m/s²"),
    Column("hard an hour", lambda one: one.seen / one.brakes.hours, decimals(1)),
    Column(
        f"hours to {_NEEDED}",
        lambda one: _NEEDED * one.brakes.hours / one.seen if one.seen else math.inf,
        decimals(1),
    ),
)


def leader_tables(study: LeaderStudy, limits: Limits) -> tuple[Table, ...]:
    """What was counted: brakes by source and by how hard they were, alarms by what was told."""
    every = study.braked[-1].brakes
    brakes = Table.of(
        "Hard brakes of leaders, 2.5 m/s² and more",
        _BRAKES,
        study.braked,
        f"With {_NEEDED} remembered, a leader who is only assumed weighs no more "
        f"than {TOLERANCE:.0%}. Waves: hard brakes less than 10 s apart in a run count once. "
        f"{_unseen(every)}",
    )
    bins: tuple[Column[tuple[float, int, int]], ...] = (
        Column("harder than", lambda row: row[0], "{:.2f}".format, "m/s²"),
        Column("in these drives", lambda row: row[1], count),
        Column("in the shipped table", lambda row: row[2], count),
    )
    both = zip_longest(every.counts, REAL_DRIVES.counts, fillvalue=0)
    rows = [(every.hard + 0.25 * k, mine, shipped) for k, (mine, shipped) in enumerate(both)]
    return (
        brakes,
        Table.of(
            "The same by how hard they were, as evofsm.driving.leaders holds it",
            bins,
            rows,
            f"Shipped: {REAL_DRIVES.source}; {REAL_DRIVES.hours:g} h.",
        ),
        *_alarms(study, limits),
    )


def _unseen(brakes: LeaderBrakes) -> str:
    seen = sum(brakes.counts)
    share = math.ceil(1000.0 * (1.0 - 0.05 ** (1.0 / seen) if seen else 1.0)) / 10.0
    return (
        f"That none of {seen} was harder than the hardest says that at most "
        f"{share:.1f} % are (95 %), if each is drawn by itself; brakes of one wave are not."
    )


def _alarms(study: LeaderStudy, limits: Limits) -> Iterator[Table]:
    found = {(one.source, one.told): one for one in study.alarms}

    def share(told: str) -> Callable[[Alarms], float]:
        return lambda one: found[one.source, told].alarms / found[one.source, told].decisions

    if found:
        yield Table.of(
            "Alarms in shadow mode, of all rows",
            (
                Column[Alarms]("drives", "source"),
                Column("runs", "runs", count),
                Column("rows", "decisions", count),
                *(Column(told, share(told), _percent) for told in TOLD),
            ),
            [one for one in study.alarms if one.told == TOLD[0]],
            f"The driver's own acceleration is the proposal, every row a decision, the tolerance "
            f"{TOLERANCE:.0%}. Own brakes: {limits.decel:g} m/s² of {-limits.lowest:g} that can "
            "be commanded; untold, 60 % are assumed. The shipped table may come from these very "
            "drives; leaders of the other runs leave out the run that is judged.",
        )


def _percent(share: float) -> str:
    return f"{100.0 * share:.2f} %"

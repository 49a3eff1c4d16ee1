"""Leaders' brakes in real drives, and alarms in shadow mode, as tables."""

from __future__ import annotations

import math

from evofsm.app import NONE, Table, count, number
from evofsm.driving import REAL_DRIVES, LeaderBrakes, needed
from evofsm.evidence.real.leaders import TOLD, Braked, LeaderStudy, Limits

# The reviser's own.
_TOLERANCE = 0.02


def leader_tables(study: LeaderStudy, limits: Limits) -> tuple[Table, ...]:
    """What was counted: brakes by source and by how hard they were, alarms by what was told."""
    every = study.braked[-1].brakes
    tables = [
        Table(
            "Hard brakes of leaders, 2.5 m/s² and more",
            (
                "drives",
                "runs",
                "hours",
                "gentle",
                "hard",
                "waves",
                "hardest [m/s²]",
                "hard an hour",
                f"hours to {needed(_TOLERANCE)}",
            ),
            tuple(map(_braked_row, study.braked)),
            f"With {needed(_TOLERANCE)} remembered, a leader who is only assumed weighs no more "
            f"than {_TOLERANCE:.0%}. Waves: hard brakes less than 10 s apart in a run count once. "
            f"{_unseen(every)}",
        ),
        Table(
            "The same by how hard they were, as evofsm.driving.risk.leaders holds it",
            ("harder than [m/s²]", "in these drives", "in the shipped table"),
            _bins(every),
            f"Shipped: {REAL_DRIVES.source}; {REAL_DRIVES.hours:g} h.",
        ),
    ]
    if study.alarms:
        tables.append(_alarms(study, limits))
    return tuple(tables)


def _braked_row(one: Braked) -> tuple[str, ...]:
    seen, hours = sum(one.brakes.counts), one.brakes.hours
    until = one.brakes.hours_until(_TOLERANCE)
    return (
        one.source,
        count(one.runs),
        number(hours, 1),
        count(one.brakes.gentle),
        count(seen),
        count(one.waves),
        number(one.hardest, 1) if seen else NONE,
        number(seen / hours, 1),
        number(until, 1) if math.isfinite(until) else NONE,
    )


def _unseen(brakes: LeaderBrakes) -> str:
    seen = sum(brakes.counts)
    share = math.ceil(1000.0 * brakes.at_most_harder) / 10.0
    return (
        f"That none of {seen} was harder than the hardest says that at most {share:.1f} % are "
        "(95 %), if each is drawn by itself; brakes of one wave are not."
    )


def _bins(every: LeaderBrakes) -> tuple[tuple[str, ...], ...]:
    here, shipped = every.counts, REAL_DRIVES.counts
    bins = max(len(here), len(shipped))
    padded = [counts + (0,) * (bins - len(counts)) for counts in (here, shipped)]
    return tuple(
        (f"{every.hard + 0.25 * k:.2f}", count(mine), count(its))
        for k, (mine, its) in enumerate(zip(*padded, strict=True))
    )


def _alarms(study: LeaderStudy, limits: Limits) -> Table:
    sources = dict.fromkeys(one.source for one in study.alarms)
    found = {(one.source, one.told): one for one in study.alarms}
    rows = []
    for source in sources:
        some = [found[source, told] for told in TOLD]
        shares = [f"{one.alarms / one.decisions:.2%}".replace("%", " %") for one in some]
        rows.append((source, count(some[0].runs), count(some[0].decisions), *shares))
    return Table(
        "Alarms in shadow mode, of all rows",
        ("drives", "runs", "rows", *TOLD),
        tuple(rows),
        f"The driver's own acceleration is the proposal, every row a decision, the tolerance "
        f"{_TOLERANCE:.0%}. Own brakes: {limits.decel:g} m/s² of {-limits.lowest:g} that can be "
        f"commanded; untold, 60 % are assumed. The shipped table may come from these very drives; "
        "leaders of the other runs leave out the run that is judged.",
    )

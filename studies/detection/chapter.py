"""The study of detection as a chapter: who sees danger, how early, and where ours does not."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from studies.detection.figures import sketches
from studies.detection.measures import Ours
from studies.detection.rows import Row
from studies.detection.study import ASSUMED, IN_GRID, Detection
from studies.detection.watch import HORIZON, WHAT, Target
from studies.old.against import ahead
from studies.old.asked import Asked, at_least, failures, tables_of_asked
from studies.old.chapter import Chapter
from studies.old.html import Setting
from studies.old.shim import (
    Column,
    Table,
    bare_percent,
    decimals,
    listed,
    number,
    percent,
    seeds_text,
    span,
)
from studies.policies import Group

# Measures that stand in the columns of tables over families.
_AREAS = (Ours.DEFAULT, Ours.STATES, Ours.PAPER, "rss-r157", "rss-tuned", "rss-matched", "ttc")
_LEADS = (Ours.DEFAULT, Ours.COUNTS, Ours.PAPER, "rss-r157", "rss-matched", "headway", "ttc")
_SEEDS = (Ours.DEFAULT, Ours.STATES, Ours.COUNTS, Ours.PAPER)
_BRIERS = (Ours.DEFAULT, Ours.COUNTS, Ours.PAPER, "rss-r157", "rss-matched", "ttc")
# A rival warns earlier if it does so by more than this [s].
_EARLIER = 0.25
_ASKED_LEAD, _ASKED_MARGIN = 5.0, 0.2


def tell(study: Detection) -> Chapter:
    """Who sees danger, how early, and where ours does not."""
    asked = list(claims(study))
    met = sum(claim.met for claim in asked)
    headline = f"{met} of the {len(asked)} targets that can be judged are met."
    if asked and met == len(asked):
        headline = f"All {len(asked)} targets that can be judged are met."
    return Chapter(
        id=study.plan.id,
        title=study.plan.question,
        about="Nobody acts here. Each decision of unrevised episodes is a case, and every measure "
        "scores it from what was seen until then. Two things may come: a dead end (by an oracle: "
        "if both cars braked as hard as they truly can from now on, they would collide), and a "
        f"collision within {HORIZON:g} s, going on as driven. Ours has watched {study.plan.train} "
        "other episodes without acting and was told nothing; on dead ends it is nearly perfect "
        "because the oracle is kinematics with the true brakes, and ours the same kinematics with "
        "brakes that it learnt: what is shown is that they can be learnt by watching. An alarm "
        "holds for 1 s after it was raised, and is false if the target does not hold within 5 s; "
        "thresholds are chosen on draws of their own.",
        headline=headline,
        answer=tuple(_answer(study)),
        fails=failures(asked),
        losses=tuple(losses(study)),
        tables=(*tables_of_asked(asked), *(one for one in _tables(study) if one.rows)),
        sketches=tuple(sketches(study)),
        plan=tuple(_plan(study)),
        packages=("scipy",),
    )


# -- What was asked for ---------------------------------------------------------------------------


def claims(study: Detection) -> Iterator[Asked]:
    """The targets that were set before, as far as their worlds were judged."""

    def of(family: str, measure: str = Ours.DEFAULT) -> Row | None:
        return study.row(family, measure, Target.DEAD_END)

    for family, least in (("emergency", 0.97), ("rare", 0.9)):
        if row := of(family):
            yield at_least(f"AUROC on {family}", row.auroc, least, decimals(4))
    for family in ("weak_brakes", "shift"):
        if (row := of(family)) and (other := of(family, "rss-r157")):
            what = f"AUROC on {family}: at least rss-r157's"
            yield at_least(what, row.auroc, other.auroc, decimals(4))
    for target in Target:
        if leads := _against_ttc(study, target):
            longer = leads[0] - leads[1]
            yield Asked(
                f"Lead time on paper beyond TTC's, {WHAT[target]}",
                f"≥ {_ASKED_LEAD:g} s",
                f"{longer:.1f} s",
                longer >= _ASKED_LEAD,
            )
    for measure in (Ours.DEFAULT, Ours.STATES):
        if (row := of("rare", measure)) and (paper := of("rare", Ours.PAPER)):
            what = f"AUROC on rare, {measure}: {Ours.PAPER}'s + {_ASKED_MARGIN:g}"
            yield at_least(what, row.auroc, paper.auroc + _ASKED_MARGIN, decimals(4))


def _against_ttc(study: Detection, target: Target) -> tuple[float, float] | None:
    """Median lead times in the paper's cases: ours, and that of time to collision [s]."""
    rows = [study.row("paper", measure, target) for measure in (Ours.DEFAULT, "ttc")]
    mine, other = (row.lead_median_1 if row else None for row in rows)
    return None if mine is None or other is None else (mine, other)


def _answer(study: Detection) -> Iterator[str]:
    for target in Target:
        best = [_best(study, family, target) == Ours.DEFAULT for family in study.families]
        rows = (study.row(family, Ours.DEFAULT, target) for family in study.families)
        areas = [row.auroc for row in rows if row and math.isfinite(row.auroc)]
        if areas:
            yield (
                f"{WHAT[target].capitalize()}: AUROC of ours from {min(areas):.3f} to "
                f"{max(areas):.3f}, best in {sum(best)} of {len(best)} worlds, those that are told "
                "the truth included."
            )
    if leads := _against_ttc(study, Target.DEAD_END):
        yield (
            f"In the paper's cases, at one false alarm per hour, ours warns {leads[0]:.1f} s "
            f"before the collision (median), time to collision {leads[1]:.1f} s."
        )


def _best(study: Detection, family: str, target: Target) -> str:
    """The measure that ranks best in a world; of equals ours."""
    rows = [row for row in _rivals(study.rows) if (row.family, row.target) == (family, target)]
    return max(rows, key=lambda row: (np.nan_to_num(row.auroc), _is_ours(row))).measure


# -- Where it loses -------------------------------------------------------------------------------


def _is_ours(row: Row) -> bool:
    return row.measure == Ours.DEFAULT


def _rivals(rows: Iterable[Row]) -> list[Row]:
    """The default and all others, but for those that are other readings of ours."""
    return [row for row in rows if _is_ours(row) or row.measure not in list(Ours)]


def losses(study: Detection) -> Iterator[str]:
    """Where a rival does better than ours, the most important first."""
    for target in Target:
        found = [
            f"{one.family} ({one.measure} {one.auroc:.4f}, ours {mine.auroc:.4f})"
            for one, mine in _ahead(study, target, _clearly_above, lambda row: row.auroc)
        ]
        if found:
            yield f"AUROC, {WHAT[target]}: another measure is clearly better on {listed(found)}."
    for target in Target:
        found = [
            f"{one.family} ({one.measure} {number(one.lead_median_1, 1)} s, in alarm for "
            f"{percent(one.false_time_1)} of the time without, ours "
            f"{number(mine.lead_median_1, 1)} s, {percent(mine.false_time_1)})"
            for one, mine in _ahead(study, target, _earlier, lambda row: row.lead_median_1)
        ]
        if found:
            yield (
                f"Lead time at one false alarm per hour, {WHAT[target]}: another one warns "
                f"earlier on {listed(found)}."
            )
    yield from _lost_in_grid(study)
    alone = [row for row in study.rows if row.measure in (Ours.STATES, "rss-r157")]
    found = [
        f"{mine.family} ({mine.auroc:.3f} against {other.auroc:.3f})"
        for other, mine in ahead(
            [row for row in alone if row.target == Target.DEAD_END],
            lambda row: row.measure == Ours.STATES,
            lambda row: row.family,
            _clearly_above,
        )
    ]
    if found:
        yield (
            "Read through its states alone, ours tells dead ends less well than RSS with R157's "
            f"constants on {listed(found)}: states are coarse."
        )


def _ahead(
    study: Detection,
    target: Target,
    better: Callable[[Row, Row], bool],
    best: Callable[[Row], Any],
) -> list[tuple[Row, Row]]:
    """In each world the best rival that is better than ours."""
    rows = [row for row in _rivals(study.rows) if row.target == target]
    return ahead(rows, _is_ours, lambda row: row.family, better, best)


def _clearly_above(one: Row, mine: Row) -> bool:
    return one.auroc_low > mine.auroc_high


def _earlier(one: Row, mine: Row) -> bool:
    leads = one.lead_median_1, mine.lead_median_1
    return None not in leads and (leads[0] or 0.0) > (leads[1] or 0.0) + _EARLIER


def _lost_in_grid(study: Detection) -> Iterator[str]:
    """What caution costs where brakes are good, and where ours tells worst."""
    cells = _rivals(study.grid)
    if cautious := [row for row in cells if _is_ours(row) and row.called is not None]:
        worst = max(cautious, key=lambda row: row.called or 0.0)
        yield (
            f"Where its own brakes were never seen at work it stays cautious: with brakes of "
            f"{worst.decel:g} and leaders up to {worst.leader_decel:g} m/s² it calls for braking "
            f"in {percent(worst.called)} of the decisions that are no dead end."
        )
    finite = [row for row in cells if math.isfinite(row.auroc)]
    if not (mine := [row for row in finite if _is_ours(row)]):
        return
    least = min(mine, key=lambda row: row.auroc)
    for best, _ in ahead(
        finite,
        lambda row: row is least,
        lambda row: (row.decel, row.leader_decel),
        lambda one, other: one.auroc > other.auroc,
        lambda row: row.auroc,
    ):
        yield (
            f"In the grid, with own brakes of {least.decel:g} and leaders up to "
            f"{least.leader_decel:g} m/s², where {percent(least.share)} of the decisions are dead "
            f"ends, its AUROC is {least.auroc:.3f}, that of {best.measure} {best.auroc:.3f}."
        )


# -- Tables ---------------------------------------------------------------------------------------


def _tables(study: Detection) -> Iterator[Table]:
    """All that apply; those without rows do not."""
    for target in Target:
        yield _over_worlds(
            study,
            f"AUROC, {WHAT[target]}",
            (_AREAS, target, "auroc", decimals(3)),
            "Half is chance; below, danger is where the measure says safety. states, paper: ours "
            "read through the states of the default and of the paper's rule. tuned, matched: RSS, "
            "told the truth in training, and told the true limits. Intervals, and all other "
            "measures, are in detection.json.",
        )
    yield _over_worlds(
        study,
        f"AUROC over {study.plan.seeds - 1} other learning seeds, dead end",
        (_SEEDS, Target.DEAD_END, "auroc_seeds", _range),
        "From the lowest to the highest; on fewer held-out episodes than above."
        f"{_margin_by_seed(study)}",
        lambda seeds: all(seeds),
    )
    for target in Target:
        yield _over_worlds(
            study,
            f"Median lead time at one false alarm per hour, in seconds: {WHAT[target]}",
            (_LEADS, target, "lead_median_1", decimals(1)),
            "From the first alarm that stays on to the collision; 0 where there was none. counts, "
            "paper: failures counted in the states of the default and of the paper's rule. Worlds "
            "without enough hours for this rate are left out.",
            lambda leads: any(lead is not None for lead in leads),
        )
    for family, target in product(("paper", "emergency"), Target):
        yield _of_world(study, family, target)
    yield _briers(study)
    yield _grid_table(study)


def _over_worlds(
    study: Detection,
    title: str,
    cells: tuple[Sequence[str], Target, str, Callable[..., str]],
    note: str,
    shown: Callable[[list[Any]], bool] = lambda values: True,
) -> Table:
    """A number of several measures, world by world; ``shown`` tells of its values if a world is."""
    measures, target, what, show = cells

    def of(measure: str, world: str) -> Any:
        return getattr(study.row(world, measure, target), what, None)

    return Table.of(
        title,
        (
            Column("world", str),
            *(Column(_short_name(one), partial(of, one), show) for one in measures),
        ),
        [world for world in study.families if shown([of(one, world) for one in measures])],
        note,
    )


def _short_name(measure: str) -> str:
    """As it fits above a narrow column; the note says what it is."""
    if measure in ("rss-r157", "evofsm"):
        return measure
    return measure.removeprefix("evofsm-").removeprefix("rss-")


def _range(*seeds: float) -> str:
    return span(3)(min(seeds), max(seeds))


def _margin_by_seed(study: Detection) -> str:
    """The margin over the paper's preset is not the same with every learning seed."""
    found = [study.row("rare", one, Target.DEAD_END) for one in (Ours.STATES, Ours.PAPER)]
    states, paper = (row.auroc_seeds if row else () for row in found)
    if not (states and paper):
        return ""
    clear = sum(a >= b + _ASKED_MARGIN for a, b in zip(states, paper, strict=True))
    return (
        f" On rare {Ours.STATES} is better than {Ours.PAPER} by the margin of {_ASKED_MARGIN:g} "
        f"with {clear} of {len(paper)} of them."
    )


_OF_WORLD: tuple[Column[Row], ...] = (
    Column("measure", "measure"),
    Column("median", "lead_median_1", decimals(1)),
    Column("95 %", "lead_median_1_low lead_median_1_high", span(1)),
    Column("10 %", "lead_p10_1", decimals(1)),
    Column("0.1/h", "lead_median_01", decimals(1)),
    Column("false/h", "false_alarms_1", decimals(2)),
    Column("alarm %", "false_time_1", bare_percent),
    Column("warn %", "warned_1", bare_percent),
)


def _of_world(study: Detection, family: str, target: Target) -> Table:
    rows = [row for row in study.rows if (row.family, row.target) == (family, target)]
    rows = [row for row in rows if row.lead_median_1 is not None]
    counted = f"Before {rows[0].collisions} collisions in {rows[0].hours:.1f} h" if rows else ""
    return Table.of(
        f"{family}, {WHAT[target]}: lead times, and what came of the alarms",
        _OF_WORLD,
        rows,
        f"{counted}, in seconds: median, and "
        "what is exceeded in 90 %, at one false alarm per hour; and the median at one in ten "
        "hours. false/h: those that came on held-out draws at the threshold that was chosen "
        "elsewhere; alarm: share of the decisions without the target that are in alarm; warn: of "
        "collisions before which an alarm stayed on.",
        ours=lambda row: row.group == Group.LEARNT,
    )


def _briers(study: Detection) -> Table:
    def of(measure: str, what: str, world: str) -> Any:
        return getattr(study.row(world, measure, Target.COLLISION), what, None)

    def base(world: str) -> float | None:
        shares = (of(measure, "share", world) for measure in _BRIERS)
        return next((share * (1.0 - share) for share in shares if share is not None), None)

    return Table.of(
        f"Brier score, {WHAT[Target.COLLISION]}",
        (
            Column("world", str),
            Column("base", base, decimals(3)),
            *(Column(_short_name(one), partial(of, one, "brier"), decimals(3)) for one in _BRIERS),
            Column("own", partial(of, Ours.COUNTS, "brier_own"), decimals(3)),
        ),
        study.families,
        "Lower is better; base: always saying the share of cases. Scores became probabilities by "
        "isotonic regression on other draws; own: the probability of counts, as it was counted.",
    )


def _grid_table(study: Detection) -> Table:
    def over(what: str, of: Callable[[list[float]], Any]) -> Callable[[str], float | None]:
        def value(measure: str) -> float | None:
            found = [getattr(row, what) for row in study.grid if row.measure == measure]
            known = [one for one in found if one is not None and math.isfinite(one)]
            return float(of(known)) if known else None

        return value

    return Table.of(
        "Brakes that nobody was told of: own × leader's",
        (
            Column[str]("measure", str),
            Column("lowest AUROC", over("auroc", min), decimals(4)),
            Column("median", over("auroc", np.median), decimals(4)),
            Column("most missed", over("missed", max), percent),
            Column("missed", over("missed", np.mean), percent),
            Column("called", over("called", np.mean), percent),
        ),
        [one for one in IN_GRID if over("auroc", min)(one) is not None],
        f"Over {len({(r.decel, r.leader_decel) for r in study.grid})} worlds; ours has watched "
        f"{study.plan.grid_train} episodes of each. missed, called: at the measure's own "
        "threshold, mean share of dead ends missed and of other decisions called dead ends. "
        f"rss-assumed counts on {ASSUMED[0]:g} and {ASSUMED[1]:g} m/s².",
        ours=lambda measure: measure == Ours.DEFAULT,
    )


def _plan(study: Detection) -> Iterator[Setting]:
    plan = study.plan
    yield Setting("worlds", ", ".join(study.families))
    yield Setting("seed", f"{plan.seed}; {seeds_text(plan.seeds)}")
    yield Setting("watched", f"{plan.train} episodes, after a shift {plan.since} more")
    yield Setting(
        "held out",
        f"{plan.hours:g} h of each world, {plan.long_hours:g} h of {listed(plan.long)}; as much "
        "again for thresholds and calibration",
    )
    yield Setting("bootstrap", f"{plan.rounds} rounds over episodes")
    yield Setting("grid", f"{plan.grid_train} episodes watched, {plan.grid_hours:g} h held out")
    yield Setting("paper", "the four cases, with gap, top speed and the driver's change drawn")
    yield Setting("r157", "seven fixed runs: training and test are the same")
    yield Setting("shift", "judged after the shift; shift-at-once: before anything was seen of it")

"""What the closed-loop study says, in sentences."""

from __future__ import annotations

from collections.abc import Iterator

from evofsm.app import count, listed, number, percent, seeds_text
from evofsm.driving import Group
from evofsm.evidence.closed_loop.comparison import Line, ours, standing, unrevised
from evofsm.evidence.closed_loop.losses import RECOVERED_AFTER, never_safe
from evofsm.evidence.closed_loop.over_seeds import around_shift
from evofsm.evidence.closed_loop.study import SAFE_RATE, ClosedLoop
from evofsm.evidence.report.asked import Asked

# What was asked of one family; of all, that its tolerance is kept.
_FAMILY_ASKED, _MOST_COLLISIONS, _LEAST_MOBILITY = "emergency", 0.005, 0.8


def headline(study: ClosedLoop) -> str:
    """What changed, in a line."""
    mine, alone = ours(study), unrevised(study)
    if mine is None:
        return "Nothing was learnt in this study"
    before = f"{percent(alone.collision_rate)} → " if alone else ""
    return (
        f"Collisions {before}{percent(mine.collision_rate)}, at mobility {number(mine.mobility, 3)}"
    )


def answer(study: ClosedLoop) -> list[str]:
    """Three sentences: what it does, what that costs, and who does better."""
    mine, worst, alone = ours(study), ours(study, "worst seed"), unrevised(study)
    if mine is None or worst is None:
        return ["The study has no row of a policy that learnt online."]
    before = (
        f"Left alone, the driver collides in {percent(alone.collision_rate)} of "
        f"{alone.episodes:,} held-out episodes; revised"
        if alone
        else "Revised"
    )
    does = (
        f"{before} by {mine.policy}, after {mine.train_episodes:,} training episodes, in "
        f"{percent(mine.collision_rate)} (median of {seeds_text(mine.seeds)}; worst seed "
        f"{percent(worst.collision_rate)})."
    )
    costs = (
        f"It costs mobility, which is {number(mine.mobility, 3)} of the unrevised driver's, "
        f"{percent(mine.intervention_rate)} of the decisions, which are changed, and "
        f"{count(mine.train_collisions)} collisions while learning (medians)."
    )
    return [does, costs, _who_does_better(study, mine)]


def _who_does_better(study: ClosedLoop, mine: Line) -> str:
    found = standing(study, mine)
    n = len(found.rivals)
    if not n:
        return "No baseline was driven."
    if found.better:
        names = listed(f"{line.policy} ({line.group})" for line in found.better)
        verb = "does" if len(found.better) == 1 else "do"
        return (
            f"Of {n} baselines {len(found.better)} {verb} better, colliding no more often at no "
            f"less mobility: {names}."
        )
    if not found.as_safe:
        return f"None of {n} baselines collides as rarely."
    best = found.most_mobile
    return (
        f"None of {n} baselines is at once as safe and as mobile; of the {len(found.as_safe)} that "
        f"collide as rarely the most mobile is {best.policy} ({best.group}), with "
        f"{number(best.mobility, 3)}."
    )


def note_on_the_table(study: ClosedLoop) -> str:
    """How the table is to be read."""
    mine = ours(study)
    held_out = study.rows[0].episodes if study.rows else 0
    seeds = (
        f"Ours is given over {seeds_text(mine.seeds)}: each column's median by itself, and the "
        "seed with most collisions (of those, least mobility). "
        if mine
        else ""
    )
    return (
        f"All policies drive the same {held_out:,} held-out episodes. {seeds}"
        "In brackets 95 % intervals, by Clopper and Pearson for collisions, by bootstrap over "
        "episodes for mobility; over seeds, the medians of their ends. Mobility: distance until "
        "the leader's brake, in those of the unrevised driver. Interventions: share of decisions "
        "that were changed. Change: mean of |executed − proposed| over all decisions. Until safe: "
        f"training episodes after which, learning frozen, at most {percent(SAFE_RATE)} of "
        f"{checked_on(study):,} held-out episodes collide."
    )


def checked_on(study: ClosedLoop) -> int:
    """Held-out episodes of a test on the way."""
    return study.curve[0].held_out if study.curve else 0


def what_was_asked(study: ClosedLoop) -> list[Asked]:
    """What had to hold, as far as it was driven here."""
    return [*_asked_of_the_table(study), *_asked_beside(study)]


def _asked_of_the_table(study: ClosedLoop) -> Iterator[Asked]:
    mine, worst = ours(study), ours(study, "worst seed")
    if mine is None or worst is None:
        return
    rates = [("worst seed", worst, study.plan.tolerance)]
    if study.family.name == _FAMILY_ASKED:
        rates.insert(0, ("median over seeds", mine, _MOST_COLLISIONS))
        yield Asked(
            "Mobility, median over seeds",
            f"≥ {_LEAST_MOBILITY:g}",
            number(mine.mobility, 3),
            mine.mobility >= _LEAST_MOBILITY,
        )
    for which, line, most in rates:
        yield Asked(
            f"Collisions, {which}",
            f"≤ {percent(most)}",
            percent(line.collision_rate),
            line.collision_rate <= most,
        )
    fixed = [line for line in standing(study, mine).better if line.group == Group.FIXED]
    yield Asked(
        "Fixed constants with no more collisions at no less mobility",
        "none",
        listed(line.policy for line in fixed) if fixed else "none",
        not fixed,
    )
    never = never_safe(study, mine)
    yield Asked(
        f"Learning seeds that never come to {percent(SAFE_RATE)} of collisions",
        "none",
        f"{never} of {mine.seeds}" if never else "none",
        not never,
    )


def _asked_beside(study: ClosedLoop) -> Iterator[Asked]:
    tested = {one.after: one for one in around_shift(study)}
    if (then := tested.get(RECOVERED_AFTER)) is not None:
        yield Asked(
            f"Collisions {RECOVERED_AFTER} episodes after the shift, median over seeds",
            f"≤ {percent(SAFE_RATE)}",
            percent(then.ours.median),
            then.ours.median <= SAFE_RATE,
        )
    if study.cases:
        collided = [case.name for case in study.cases if case.collided]
        yield Asked(
            "Collisions in the paper's cases, revised",
            "none",
            listed(collided) if collided else "none",
            not collided,
        )
    if study.worlds:
        counts = [one.collisions for one in study.worlds]
        yield Asked(
            f"Collisions in {listed(one.world for one in study.worlds)}",
            "equal",
            listed(map(str, counts)),
            len(set(counts)) == 1,
        )

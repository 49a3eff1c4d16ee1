"""The closed-loop study as a chapter: what it says, what was asked of it, and where it loses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from evofsm.cli import NONE, Column, Table, count, listed, number, percent, seeds_text
from evofsm.paper.report.asked import Asked, at_most, failures, tables_of_asked
from evofsm.paper.report.chapter import Chapter, Section
from evofsm.paper.report.drawing import Sketch
from evofsm.paper.report.html import Setting
from studies.closed_loop.comparison import (
    Line,
    has_third_car,
    never_safe,
    ours,
    standing,
    unrevised,
)
from studies.closed_loop.figures import sketches
from studies.closed_loop.losses import RECOVERED_AFTER, Loss, losses
from studies.closed_loop.machine import MACHINE
from studies.closed_loop.over_seeds import around_shift
from studies.closed_loop.stages import SAFE_RATE
from studies.closed_loop.study import ClosedLoop
from studies.closed_loop.tables import (
    policy_table,
    side_tables,
    table_of_names,
    why_not_by_state,
)
from studies.closed_loop.targets import machine_claims
from studies.policies import Group

# What was asked of one family; of all, that its tolerance is kept.
_FAMILY_ASKED, _MOST_COLLISIONS, _LEAST_MOBILITY = "emergency", 0.005, 0.8


def closed_loop_chapter(study: ClosedLoop) -> Chapter:
    """What the study found."""
    figures = {one.name: one for one in sketches(study)}
    lost = losses(study)
    return Chapter(
        id=study.plan.id,
        title=study.plan.question,
        about="A controller proposes an action at every decision; a reviser may execute a more "
        "careful one. Ours is told how cars follow each other: it asks how probable a failure "
        "still is if this action is taken now and caution follows, and it has learnt that answer "
        "from driving alone. It accepts a risk of "
        f"{percent(study.plan.tolerance)}. Held against it stand fixed constants from the "
        "literature and from regulation, measures that were tuned on the same training scenarios, "
        f"and one that was told the true limits. Family {study.family.name}: {study.family.about}",
        headline=headline(study),
        answer=tuple(answer(study)),
        fails=failures(asked := what_was_asked(study)),
        losses=tuple(
            f"{one.what}: {one.who}, {one.theirs}, against {one.ours} of ours" for one in lost
        ),
        losses_table=_table_of_losses(study, lost),
        tables=(policy_table(study), *tables_of_asked(asked), table_of_names(study)),
        sketches=tuple(figures[name] for name in ("trade-off",) if name in figures),
        sections=tuple(_sections(study, figures)),
        plan=tuple(_plan(study)),
        packages=("scipy", *(("libsumo",) if study.worlds else ())),
    )


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
    """What it does, what that costs, who does better, and what becomes of it told less."""
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
    return [does, costs, _who_does_better(study, mine), *_told_less(study)]


def _told_less(study: ClosedLoop) -> Iterator[str]:
    """What the machine by itself comes to."""
    machine, worst = ours(study, policy=MACHINE), ours(study, "worst seed", MACHINE)
    if machine is None or worst is None:
        return
    hit = max(row.train_collisions for row in study.rows if row.policy == MACHINE)
    yield (
        f"Told {machine.told}, not how cars follow each other, {MACHINE} collides in "
        f"{percent(machine.collision_rate)} of {machine.episodes:,} held-out episodes "
        f"(worst of {seeds_text(machine.seeds)} {percent(worst.collision_rate)}) at mobility "
        f"{number(machine.mobility, 3)}, after {machine.train_episodes:,} training episodes in "
        f"which {count(machine.train_collisions)} collided (median; at most {hit:,})."
    )


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


# -- What was asked -------------------------------------------------------------------------------


def what_was_asked(study: ClosedLoop) -> list[Asked]:
    """What had to hold, as far as it was driven here."""
    return [*_asked_of_the_table(study), *_asked_beside(study), *machine_claims(study)]


def _none(what: str, found: Sequence[str]) -> Asked:
    return Asked(what, "none", listed(found) if found else "none", not found)


def _asked_of_the_table(study: ClosedLoop) -> Iterator[Asked]:
    mine, worst = ours(study), ours(study, "worst seed")
    if mine is None or worst is None:
        return
    if study.family.name == _FAMILY_ASKED:
        yield Asked(
            "Mobility, median over seeds",
            f"≥ {_LEAST_MOBILITY:g}",
            number(mine.mobility, 3),
            mine.mobility >= _LEAST_MOBILITY,
        )
        what = "Collisions, median over seeds"
        yield at_most(what, mine.collision_rate, _MOST_COLLISIONS, percent)
    most = study.plan.tolerance
    yield at_most("Collisions, worst seed", worst.collision_rate, most, percent)
    better = standing(study, mine).better
    fixed = [line.policy for line in better if line.group == Group.FIXED]
    yield _none("Fixed constants with no more collisions at no less mobility", fixed)
    never = never_safe(study, mine)
    yield _none(
        f"Learning seeds that never come to {percent(SAFE_RATE)} of collisions",
        [f"{never} of {mine.seeds}"] if never else [],
    )


def _asked_beside(study: ClosedLoop) -> Iterator[Asked]:
    for one in around_shift(study):
        if one.after == RECOVERED_AFTER:
            what = f"Collisions {RECOVERED_AFTER} episodes after the shift, median over seeds"
            yield at_most(what, one.ours.median, SAFE_RATE, percent)
    if study.cases:
        collided = [case.name for case in study.cases if case.collided]
        yield _none("Collisions in the paper's cases, revised", collided)
    if study.worlds:
        counts = [one.collisions for one in study.worlds]
        yield Asked(
            f"Collisions in {listed(one.world for one in study.worlds)}",
            "equal",
            listed(map(str, counts)),
            len(set(counts)) == 1,
        )


def _table_of_losses(study: ClosedLoop, lost: Sequence[Loss]) -> Table | None:
    if not lost:
        return None
    return Table.of(
        "Every row and measure in which ours loses",
        (
            Column("in what", "what"),
            Column("to whom", "who"),
            Column("theirs", "theirs"),
            Column("ours", "ours"),
            Column("95 % intervals", "apart", {True: "apart", False: "overlap"}.get),
        ),
        lost,
        "Found by comparing all numbers on this page with those of evofsm after all training "
        "(median over seeds unless said): every baseline that is better on both axes, that "
        "collides less, or that pays less while colliding no more often, every measure that tells "
        "dead ends apart better, and every test that it fails. ✗ marks what breaks something that "
        f"was asked for.{_told(study)}",
        in_words=True,
        failing=lambda one: one.loud,
    )


def _told(study: ClosedLoop) -> str:
    """Our own reviser where it did not have to learn, which is no rival."""
    mine = ours(study)
    found = standing(study, mine).told if mine else []
    if not found:
        return ""
    each = listed(
        f"{line.policy} {percent(line.collision_rate)} at {number(line.mobility, 3)}"
        for line in found
    )
    return f" No rival, but our own reviser with nothing to learn: {each}."


# -- Sections -------------------------------------------------------------------------------------

_TITLES = {
    "learning": ("Learning", "learning"),
    "machine": ("Learning, told nothing but failures", ""),
    "shift": ("When the world shifts", "stream"),
    "calibration": ("Are the probabilities right?", "reliability"),
    "separation": ("Telling dead ends", ""),
    "states": ("States alone", ""),
    "cases": ("The paper's cases", ""),
    "machine_cases": ("The paper's cases, told nothing but failures", ""),
    "worlds": ("Both worlds", ""),
}


def _sections(study: ClosedLoop, figures: dict[str, Sketch]) -> Iterator[Section]:
    tables = side_tables(study)
    for name, (title, figure) in _TITLES.items():
        table = (tables[name],) if name in tables else ()
        shown = (figures[figure],) if figure in figures else ()
        if shown or table:
            text = why_not_by_state(study) if name == "states" else ""
            yield Section(name, title, text, table, sketches=shown)


def _plan_of_the_machine(study: ClosedLoop) -> str:
    machine, plan = ours(study, policy=MACHINE), study.plan
    if machine is None:
        return ""
    streams = len({one.learning_seed for one in study.streams if one.policy == MACHINE})
    shifted = f"; around the shift {seeds_text(streams)}" if streams else ""
    return (
        f"{machine.train_episodes:,} training and {machine.episodes:,} held-out episodes, "
        f"{plan.machine_checks:,} in tests on the way{shifted}"
    )


def _plan(study: ClosedLoop) -> Iterator[Setting]:
    plan, shift, actions = study.plan, study.plan.shift, study.family.actions
    told = {
        "seed of everything": str(plan.seed),
        "learning seeds": f"{plan.seeds}, from 0",
        "training episodes": f"{plan.train:,} for each learning seed",
        "held-out episodes": f"{plan.test:,}; nothing learns from them",
        MACHINE: _plan_of_the_machine(study),
        "tolerance": f"{plan.tolerance:g}",
        "studies beside": f"{plan.side_train:,} to learn, {plan.side_test:,} held out",
        "state rules": f"{plan.rule_seeds} seeds, {plan.rule_test:,} held out",
        "both worlds": f"{plan.world_test:,} episodes in each" if study.worlds else "",
        "stream": f"{shift.before:,} episodes, then {shift.after:,} shifted ones",
        "tests around the shift": f"{shift.held_out:,} held out",
        "decisions": f"every {study.family.interval:g} s",
        "actions": f"{actions.n_actions} from {actions.low:g} to {actions.high:g} m/s²".replace(
            "-", "−"
        ),
        "third car behind": "yes" if has_third_car(study) else NONE,
    }
    if not study.streams:
        del told["stream"], told["tests around the shift"]
    yield from (Setting(name, text) for name, text in told.items() if text)

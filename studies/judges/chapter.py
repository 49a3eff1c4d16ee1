"""The study of judges as a chapter: what fails, what each part is worth, and where it loses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from evofsm.cli import NONE, Column, Table, count, listed, number, percent, seeds_text
from studies.judges.amounts import PARTS
from studies.judges.figures import sketches
from studies.judges.study import Judges
from studies.judges.summary import Effect, Summary, Worth, effects, summary
from studies.judges.targets import claims
from studies.old.asked import failures, tables_of_asked
from studies.old.chapter import Chapter, Section
from studies.old.html import Setting
from studies.old.trials import (
    FAILED,
    KEPT,
    TIMES,
    WORST,
    failing,
    hardly_kept,
    scores,
    settings,
)
from studies.systems.trial import LATE

# A score that is nearer to another one's is no worse.
_MOBILITY = 0.01
#: The longest that a decision may take, in 99 of 100 cases [ms].
_SLOW = 1.5


def tell(found: Judges) -> Chapter:
    """What fails, what each part is worth, and where it loses."""
    asked = list(claims(found))
    every = effects(found)
    return Chapter(
        id=found.plan.id,
        title=found.plan.question,
        about=_ABOUT,
        headline=_headline(found),
        answer=tuple(_answer(found, every)),
        losses=tuple(_losses(found, every)),
        fails=failures(asked),
        tables=(*tables_of_asked(asked), _table(found), *_worth(every)),
        sketches=tuple(sketches(found)),
        plan=tuple(_plan(found)),
        packages=("scipy", "gymnasium"),
        sections=tuple(_sections(found)),
    )


_ABOUT = (
    "The learnt judge is told the range of the action, the time between decisions, and which "
    "episodes failed; nothing else, and the same settings everywhere. It learns while it decides; "
    "then it is frozen, and decides held-out episodes, the same ones for every judge. A proposal "
    "is kept if exactly it is executed. Change: of the action, in halves of its range; of discrete "
    "actions the share that is changed. Score: mobility of cars, else the sum of rewards: as "
    "published on acc, what was fed to the reactor, and the number of steps elsewhere. Nothing "
    "is safe before the first failure of each kind, as long as nobody tells of it."
)


# -- Words ----------------------------------------------------------------------------------------


def _headline(found: Judges) -> str:
    failed, episodes = _failures(found)
    alone = _failures(found, "unrevised")
    return (
        f"{count(failed)} of {count(episodes)} held-out episodes fail on {len(found.systems)} "
        f"system{'' if len(found.systems) == 1 else 's'}, "
        f"where the controllers alone fail in {percent(alone[0] / alone[1])}."
    )


def _failures(found: Judges, judge: str = "learnt") -> tuple[int, int]:
    rows = found.of(judge=judge)
    return sum(row.failed for row in rows), sum(row.episodes for row in rows)


def _answer(found: Judges, every: Sequence[Effect]) -> Iterator[str]:
    rows = found.of()
    worst = max(rows, key=lambda row: row.failed_while_learning)
    yield (
        f"While learning at most {count(worst.failed_while_learning)} of {worst.trained} episodes "
        f"fail ({worst.system}, {worst.controller})."
    )
    for part in dict.fromkeys(one.part for one in every):
        needed = [one for one in every if (one.part, one.worth) == (part, Worth.NEEDED)]
        if needed:
            where = listed(f"{one.system} ({one.text})" for one in needed)
            yield f"Without {part} ({PARTS[part]}) it does clearly worse on {where}."
    idle, open_ = _idle(every)
    if open_:
        yield f"More runs have to tell whether anything is owed to: {listed(open_)}."
    if idle:
        yield (
            f"What adds nothing that is clear on any of these systems: {listed(idle)}. It has no "
            "reason to decide anything."
        )


def _idle(every: Sequence[Effect]) -> tuple[list[str], list[str]]:
    """Parts that are clearly needed nowhere: those that do nothing, and those that may do some."""
    worths: dict[str, set[Worth]] = {}
    for one in every:
        worths.setdefault(one.part, set()).add(one.worth)
    not_needed = [part for part, found in worths.items() if Worth.NEEDED not in found]
    unclear = [part for part in not_needed if Worth.UNCLEAR in worths[part]]
    return [part for part in not_needed if part not in unclear], unclear


def _losses(found: Judges, every: Sequence[Effect]) -> Iterator[str]:
    """What goes against the learnt judge, the most important first."""
    whole = list(_by_controller(found))
    ours = [one for one in whole if one.judge == "learnt"]
    yield from failing(ours)
    for one in ours:
        if one.late:
            yield (
                f"{one.who}: up to {count(one.late)} failures while learning come after episode "
                f"{LATE}."
            )
    told = {one.system: one for one in whole if one.judge == "kinematic"}
    for one in ours:
        other = told.get(one.system)
        if other and other.failed.value < one.failed.value:
            yield (
                f"{one.system}: the kinematic judge, which is told the physics, fails less often "
                f"({percent(other.failed.value)}, learnt {percent(one.failed.value)})."
            )
        if other and other.score > one.score + _MOBILITY:
            yield (
                f"{one.system}: the kinematic judge, which is told the physics, gets further "
                f"(mobility {number(other.score, 3)}, learnt {number(one.score, 3)})."
            )
    for less in every:
        if less.worth is Worth.HARMS:
            yield f"{less.system}: without {less.part} it does clearly better ({less.text})."
    yield from hardly_kept(ours)
    if slow := [one for one in ours if one.p99 > _SLOW]:
        most = max(slow, key=lambda one: one.p99)
        yield (
            f"One in a hundred decisions takes longer than {_SLOW:g} ms on "
            f"{listed(dict.fromkeys(one.system for one in slow))} (up to {number(most.p99, 1)} ms, "
            f"{most.who}), with all cores of the machine at work."
        )


# -- Tables ---------------------------------------------------------------------------------------


def _by_controller(found: Judges) -> Iterator[Summary]:
    """Every judge, whole, on every system with every controller."""
    for system in found.systems:
        for controller in dict.fromkeys(r.controller for r in found.rows if r.system == system):
            for judge in ("unrevised", "kinematic", "learnt"):
                if rows := found.of(system, controller, judge):
                    yield summary(rows)


_COLUMNS: tuple[Column[Summary], ...] = (
    *FAILED,
    WORST,
    Column("learning", "learning", count),
    Column("late", "late", count),
    *KEPT,
    Column("score", "score", scores(3)),
    Column("worst score", "score_worst", scores(3)),
    *TIMES,
)
_NOTE = (
    "Failed: held-out episodes of all learning seeds, with a 95 % interval as if they were "
    "independent; worst: of the worst run. Learning: failures while learning in the worst run; "
    f"late: of those the ones after episode {LATE}. Kept, change, score, p50: median over runs; "
    "p99: of the worst run, with all cores of the machine at work."
)


def _table(found: Judges) -> Table:
    columns = (
        Column[Summary]("system, controller: judge", lambda one: f"{one.who}: {one.judge}"),
        *_COLUMNS,
    )
    return Table.of(
        "The judges on every system",
        columns,
        _by_controller(found),
        _NOTE,
        ours=lambda one: one.judge == "learnt",
    )


def _sections(found: Judges) -> Iterator[Section]:
    """A table for each system: whole, and without each part."""
    tables = []
    for system in found.systems if found.parts else ():
        rows = [summary(found.of(system))]
        taken = (found.of(system, without=part) for part in found.parts)
        rows += [summary(one) for one in taken if one]
        columns = (Column[Summary]("judge", lambda one: one.name), *_COLUMNS)
        title = f"{system}: whole, and without each part"
        tables.append(Table.of(title, columns, rows, ours=lambda one: not one.without))
    if tables:
        yield Section(
            "parts",
            "Each part taken away",
            "Of all controllers and learning seeds of a system. "
            + " ".join(f"Without {part}: {what}." for part, what in PARTS.items()),
            tuple(tables),
        )


def _worth(every: Sequence[Effect]) -> Iterator[Table]:
    """Where each part is needed, in words."""

    def where(worth: Worth) -> Column[str]:
        def text(part: str) -> str:
            found = [one for one in every if (one.part, one.worth) == (part, worth)]
            return ", ".join(f"{one.system} {one.text}".strip() for one in found) or NONE

        return Column(_WORTH[worth], text)

    parts = list(dict.fromkeys(one.part for one in every))
    if parts:
        yield Table.of(
            "What each part is worth",
            (Column[str]("part", lambda part: part), *map(where, _WORTH)),
            parts,
            "The part is taken away, all else being the same; runs are compared one by one. "
            "Systems without a name here show nothing that is clear. The first of these that "
            "differs by more than a little, and by more than chance (Student's t over runs, 99 %), "
            "decides: failures held out, failures while learning, score, proposals kept, change. "
            "Of so many comparisons a few are beyond that by chance.",
            in_words=True,
        )


_WORTH = {
    Worth.NEEDED: "needed on",
    Worth.UNCLEAR: "perhaps on",
    Worth.HARMS: "better without on",
}


def _plan(found: Judges) -> Iterator[Setting]:
    plan, trained = found.plan, {row.system: row.trained for row in found.of()}
    yield from settings(plan.seed, seeds_text(plan.seeds), trained, plan.test)
    yield Setting("parts taken away", ", ".join(found.parts) or "none")

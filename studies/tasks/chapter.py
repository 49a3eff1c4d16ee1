"""The study of tasks as a chapter: what fails, what it costs, and where it loses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from evofsm.cli import (
    NONE,
    Column,
    Table,
    bare_percent,
    count,
    decimals,
    number,
    percent,
    seeds_text,
)
from studies.old.asked import failures, tables_of_asked
from studies.old.chapter import Chapter, Section, Source
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
from studies.systems import TASKS
from studies.tasks.amounts import ACC
from studies.tasks.figures import sketches
from studies.tasks.rows import LATE, OURS, Row
from studies.tasks.study import Tasks
from studies.tasks.summary import Summary, own_share, policies, summaries
from studies.tasks.targets import SEEDS, TRAIN, claims

# Returns less apart than this are the same.
_SAME = 0.01
# How returns are written.
_score_text = scores(2)


def tell(found: Tasks) -> Chapter:
    """What fails, what it costs, and where it loses."""
    asked = list(claims(found))
    every = list(summaries(found))
    return Chapter(
        id=found.plan.id,
        title=found.plan.question,
        about=_ABOUT,
        headline=_headline(every),
        answer=tuple(_answer(found, every)),
        losses=tuple(_losses(found, every)),
        fails=failures(asked),
        tables=(*tables_of_asked(asked), *_tables(every), *_policies(found)),
        sketches=tuple(sketches(found)),
        plan=tuple(_plan(found)),
        packages=("scipy", "gymnasium"),
        sections=(_learning(found),),
        sources=_SOURCES,
    )


_ABOUT = (
    "Tasks as others set them, with their equations, actions and rewards. The learnt judge is told "
    "the range of the action, the time between decisions, and which episodes failed; the same "
    "settings everywhere. What its rivals are told stands beside them. Those that learn do so "
    "while they decide; then all are tried on the same held-out episodes. An unsafe step ends an "
    "episode as a failure. A proposal is kept if exactly it is executed. Nothing is safe before "
    "the first failure of each kind, as long as nobody tells of it."
)
_SOURCES = (
    Source(
        "ACC: G. Anderson et al., Guiding Safe Exploration with Weakest Preconditions, 2023",
        "arXiv:2209.14148",
        "https://arxiv.org/abs/2209.14148",
    ),
    Source(
        "Labelled tasks: A. W. Goodall et al., MASA-Safe-RL, 2025",
        "github.com/sacktock/MASA-Safe-RL",
        "https://github.com/sacktock/MASA-Safe-RL",
    ),
)


# -- Words ----------------------------------------------------------------------------------------


def _headline(every: Sequence[Summary]) -> str:
    ours = [one for one in every if one.judge in OURS]
    alone = [one for one in every if one.judge == "unrevised"]
    tasks = len({one.task for one in ours})
    return (
        f"{count(sum(one.failed.held for one in ours))} of "
        f"{count(sum(one.failed.tried for one in ours))} held-out episodes fail on {tasks} "
        f"task{'' if tasks == 1 else 's'} of others, where the controllers alone fail in "
        f"{percent(_share(alone))}."
    )


def _share(some: Sequence[Summary]) -> float:
    return sum(one.failed.held for one in some) / sum(one.failed.tried for one in some)


def _answer(found: Tasks, every: Sequence[Summary]) -> Iterator[str]:
    ours = [one for one in every if one.judge in OURS]
    if ours:  # none where a task of one's own names no learners of ours
        worst = max(ours, key=lambda one: one.learning)
        yield (
            f"While learning at most {count(worst.learning)} of {worst.trained} episodes fail "
            f"({worst.who})."
        )
    told = [one for one in every if not one.told.startswith("nothing")]
    if told:
        yield (
            f"Judges that are told more fail in {count(sum(one.failed.held for one in told))} of "
            f"{count(sum(one.failed.tried for one in told))} held-out episodes."
        )
    for training in dict.fromkeys(one.controller for one in policies(found)):
        if (share := own_share(found, training)) is not None:
            yield (
                f"CartPole, {training}: {percent(share)} of the safety is the policy's own, which "
                "is what is left with the filter off."
            )
    yield from found.left_out
    if any(found.of(task) for task in ACC) and not list(claims(found)):
        yield f"Nothing was judged: that takes {SEEDS} learning seeds of {TRAIN} episodes on acc."


def _losses(found: Tasks, every: Sequence[Summary]) -> Iterator[str]:
    """What goes against the learnt judge, the most important first."""
    ours = [one for one in every if one.judge in OURS]
    yield from failing(ours)
    for one in ours:
        if one.late:
            yield f"{one.who}: up to {count(one.late)} failures while learning are late ones."
    for one in ours:
        beside = [r for r in every if r[:2] == one[:2] and r.judge not in (*OURS, "unrevised")]
        for other in beside:
            knows = f"{one.who}: {other.judge} (told {other.told})"
            if other.failed.value < one.failed.value:
                yield (
                    f"{knows} fails less often ({percent(other.failed.value)}, ours "
                    f"{percent(one.failed.value)})."
                )
            elif other.failed.held or one.failed.held:
                continue
            elif other.score > one.score + _SAME * abs(one.score):
                yield (
                    f"{knows} returns more ({_score_text(other.score)}, ours "
                    f"{_score_text(one.score)})."
                )
            elif other.kept > one.kept + 0.05 and other.score > one.score - _SAME * abs(one.score):
                yield (
                    f"{knows} keeps more proposals ({percent(other.kept)}, ours "
                    f"{percent(one.kept)})."
                )
    yield from hardly_kept(ours)
    yield from _slower(ours, [one for one in every if not one.told.startswith("nothing")])
    for one in policies(found):
        if one.judge == "filter off" and one.failed.held and "no filter" not in one.controller:
            yield (
                f"CartPole, {one.controller}: with the filter off {percent(one.failed.value)} of "
                "the held-out episodes fail."
            )


def _slower(ours: Sequence[Summary], told: Sequence[Summary]) -> Iterator[str]:
    if ours and told:
        mine, theirs = max(one.p50 for one in ours), max(one.p50 for one in told)
        if mine > theirs:
            yield (
                f"A decision takes up to {number(mine, 2)} ms in the median, one of judges that "
                f"are told more up to {number(theirs, 2)} ms."
            )


# -- Tables ---------------------------------------------------------------------------------------


def _while(name: str) -> Column[Summary]:
    """A count of training episodes; none of who does not learn."""
    return Column(name, lambda one: getattr(one, name) if one.learns else None, count)


def _return_text(value: float, low: float, high: float) -> str:
    return f"{_score_text(value)} ({_score_text(low)}–{_score_text(high)})"


_FAILS: tuple[Column[Summary], ...] = (
    _while("trained"),
    _while("learning"),
    _while("late"),
    *FAILED,
    WORST,
)
_COSTS: tuple[Column[Summary], ...] = (
    Column("return", "score score_low score_high", _return_text),
    Column("worst", "score_worst", _score_text),
    Column("of told [%]", "of_told", bare_percent),
    Column("speed [m/s]", "speed", decimals(1)),
    *KEPT,
    *TIMES,
)
_ON_FAILS = (
    "Trained: episodes that were learnt from. Learning: failures in them, in the worst run; late: "
    f"of those the ones after episode {LATE}, or in the second half of fewer than {2 * LATE}. "
    "Failed: held-out episodes of all learning seeds, with a 95 % interval as if they were "
    "independent (Clopper and Pearson); worst: of the worst run."
)
_ON_COSTS = (
    "Return: of the run in the middle, with its 95 % interval (bootstrap over episodes), and of "
    "the worst run. Of told: that return, as a share of the highest one of those judges that are "
    "told more and never failed. Kept, change, p50: median over runs; p99: of the worst run, with "
    "all cores of the machine at work."
)


def _tables(every: Sequence[Summary]) -> Iterator[Table]:
    for title, columns, note in (
        ("What fails", _FAILS, _ON_FAILS),
        ("What it costs", _COSTS, _ON_COSTS),
    ):
        who = Column[Summary]("task, controller: judge", lambda one: f"{one.who}: {one.judge}")
        head = (who, Column[Summary]("told", "told"))
        yield Table.of(title, (*head, *columns), every, note, ours=lambda one: one.judge in OURS)


def _policies(found: Tasks) -> Iterator[Table]:
    """With the filter off and on."""

    def own(one: Summary) -> float | None:
        return own_share(found, one.controller) if one.judge == "filter off" else None

    columns = (
        Column[Summary]("trained with", lambda one: one.controller.removeprefix("policy: ")),
        Column[Summary]("then", "judge"),
        Column[Summary]("episodes", "trained", count),
        Column[Summary]("failed in them", "learning", count),
        *FAILED,
        Column[Summary]("return", "score score_low score_high", _return_text),
        KEPT[0],
        Column[Summary]("own safety [%]", own, bare_percent),
    )
    if found.policies:
        yield Table.of(
            "Policies of CartPole, with the filter off after training under it",
            columns,
            policies(found),
            "Linear policies, found by the cross-entropy method; the penalty is "
            f"{found.plan.penalty:g} for each action that is changed. Failed in them: training "
            "episodes, in the worst run. Own safety: held-out episodes that are survived with the "
            "filter off, of those survived with it on.",
        )


def _learning(found: Tasks) -> Section:
    """Which training episodes failed, seed by seed."""

    def which(row: Row) -> str:
        shown = [str(place) for place in row.failures[:8]]
        more = len(row.failures) - len(shown)
        return ", ".join([*shown, f"and {more} more"] if more else shown) or NONE

    columns: tuple[Column[Row], ...] = (
        Column("task, controller", lambda row: f"{row.task}, {row.controller}"),
        Column("seed", "seed", count),
        Column("episodes", "trained", count),
        Column("failed", which),
        Column("return by then", "score_by_late", _score_text),
        Column("held out", lambda row: f"{row.failed} of {row.episodes}"),
        Column("return", "score", _score_text),
    )
    rows = [row for task in dict.fromkeys(r.task for r in found.rows) for row in found.of(task)]
    note = (
        f"Return by then: mean of the ten training episodes that end with episode {LATE}, or with "
        f"the first half of fewer than {2 * LATE}."
    )
    table = Table.of("Learning, seed by seed: the learnt judge", columns, rows, note)
    text = "Training episodes that failed, counted from 1."
    return Section("learning", "While learning", text, (table,))


def _plan(found: Tasks) -> Iterator[Setting]:
    plan = found.plan
    learnt = f"{seeds_text(plan.seeds)}, acc with {plan.seeds_of('acc')}"
    trained = {row.task: row.trained for row in found.rows if row.judge in OURS}
    yield from settings(plan.seed, learnt, trained, plan.test)
    if missing := [name for name in TASKS if not found.of(name)]:
        yield Setting("tasks not run", ", ".join(missing))

"""The closed-loop study as a chapter: its table, its figures, and where it loses."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from evofsm.app import NONE, Table, count, interval, listed, number, part, percent, percents
from evofsm.driving import FIXED_MEASURES
from evofsm.evidence.closed_loop.comparison import (
    Line,
    chosen,
    has_third_car,
    ours,
    settings,
    standing,
    table_groups,
)
from evofsm.evidence.closed_loop.over_seeds import WINDOW
from evofsm.evidence.closed_loop.study import ClosedLoop
from evofsm.evidence.report.asked import failures, tables_of_asked
from evofsm.evidence.report.beside import side_tables, why_not_by_state
from evofsm.evidence.report.chapter import Chapter, Section
from evofsm.evidence.report.comparison import answer, headline, note_on_the_table, what_was_asked
from evofsm.evidence.report.html import Setting
from evofsm.evidence.report.losses import InWords, losses_in_words
from evofsm.extras import needs

with needs("matplotlib", "plot", "drawing figures"):
    from evofsm.evidence.report.drawing import Drawing, Sketch, draw_all
    from evofsm.evidence.report.of_policies import (
        draw_learning,
        draw_reliability,
        draw_stream,
        draw_trade_off,
    )


def closed_loop_chapter(
    study: ClosedLoop,
    folder: Path,
    command: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Chapter:
    """Draw the figures of the study and say what it found.

    Parameters
    ----------
    study : ClosedLoop
    folder : Path
        Where the figures are put.
    command : str
        What was typed to get it.
    progress : callable
        Told how many figures are done, of how many.
    """
    figures = {one.name: one for one in draw_all(closed_loop_sketches(study), folder, progress)}
    lost = losses_in_words(study)
    return Chapter(
        id="closed-loop",
        title="Does latent risk, learnt online, prevent collisions, at what cost, and against "
        "whom?",
        about=_about(study),
        headline=headline(study),
        answer=tuple(answer(study)),
        fails=failures(asked := what_was_asked(study)),
        losses=tuple(map(_in_a_line, lost)),
        losses_table=_table_of_losses(study, lost),
        tables=(policy_table(study), *tables_of_asked(asked), _table_of_names(study)),
        figures=tuple(figures[name] for name in ("trade-off",) if name in figures),
        sections=tuple(_sections(study, figures)),
        plan=tuple(_plan(study)),
        command=command,
        packages=("scipy", *(("libsumo",) if study.worlds else ())),
    )


def _about(study: ClosedLoop) -> str:
    return (
        "A controller proposes an action at every decision; a reviser may execute a more careful "
        "one. Ours asks how probable a failure still is if this action is taken now and caution "
        "follows, and it has learnt that answer from driving alone. It accepts a risk of "
        f"{percent(study.plan.tolerance)}. Held against it stand fixed constants from the "
        "literature and from regulation, measures that were tuned on the same training scenarios, "
        f"and one that was told the true limits. Family {study.family.name}: {study.family.about}"
    )


def _in_a_line(loss: InWords) -> str:
    return f"{loss.what}: {loss.who}, {loss.theirs}, against {loss.ours} of ours"


def _table_of_losses(study: ClosedLoop, lost: Sequence[InWords]) -> Table | None:
    if not lost:
        return None
    apart = {None: NONE, True: "apart", False: "overlap"}
    return Table(
        "Every row and measure in which ours loses",
        ("in what", "to whom", "theirs", "ours", "95 % intervals"),
        tuple((one.what, one.who, one.theirs, one.ours, apart[one.apart]) for one in lost),
        "Found by comparing all numbers on this page with those of evofsm after all training "
        "(median over seeds unless said): every baseline that is better on both axes, that "
        "collides less, or that pays less while colliding no more often, every measure that tells "
        "dead ends apart better, and every test that it fails. ✗ marks what breaks something that "
        f"was asked for.{_told(study)}",
        in_words=True,
        failing=tuple(place for place, one in enumerate(lost) if one.loud),
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


# -- The table ------------------------------------------------------------------------------------


def _header(study: ClosedLoop) -> list[str]:
    header = [
        "policy",
        "collisions (95\N{NO-BREAK SPACE}%)",
        "mobility (95\N{NO-BREAK SPACE}%)",
        "interventions",
        "mean change [m/s²]",
        "RMS jerk [m/s³]",
        "episodes until safe",
        "collisions while learning",
    ]
    return [*header, "rear-end collisions"] if has_third_car(study) else header


def policy_table(study: ClosedLoop) -> Table:
    """All policies: the value, and below it what it was counted in or its interval."""
    lines = [line for _, found in table_groups(study) for line in found]
    third_car = has_third_car(study)
    return Table(
        "All policies",
        tuple(_header(study)),
        tuple((_name(line), *_cells(line, third_car)) for line in lines),
        note_on_the_table(study),
        ours=tuple(place for place, line in enumerate(lines) if line.is_ours),
    )


def _name(line: Line) -> str:
    """The policy, and below it what it was told."""
    if not line.is_ours:
        return f"{line.policy}\n{line.group}"
    of_seeds = "of" if line.which == "worst seed" else "over"
    return (
        f"{line.policy}, {line.train_episodes:,} episodes\n"
        f"{line.group}, {line.which} {of_seeds} {line.seeds}"
    )


def _cells(line: Line, third_car: bool) -> Iterator[str]:
    yield (
        f"{percent(line.collision_rate)} ({percents(line.collision_low, line.collision_high)})\n"
        f"{part(line.collisions, line.episodes)}"
    )
    ends = interval(line.mobility_low, line.mobility_high, lambda x: number(x, 3))
    yield f"{number(line.mobility, 3)}\n{ends}"
    yield percent(line.intervention_rate)
    yield number(line.mean_change, 2)
    yield number(line.jerk, 2)
    yield _until_safe(line)
    if math.isnan(line.train_collisions):
        yield NONE
    else:
        yield f"{count(line.train_collisions)}\nof {line.train_episodes:,}"
    if third_car:
        yield f"{count(line.rear_ends)}\nof {line.episodes:,}"


def _until_safe(line: Line) -> str:
    if math.isinf(line.until_safe):
        return f"not in {line.train_episodes}"
    return count(line.until_safe)


def _table_of_names(study: ClosedLoop) -> Table:
    rows = tuple(_made_of(study))
    return Table("What the names stand for", ("policy", "made of"), rows, in_words=True)


def _made_of(study: ClosedLoop) -> Iterator[tuple[str, str]]:
    """What each baseline is made of; of the tuned ones, what tuning chose."""
    driven = {row.policy for row in study.rows}
    yield ("unrevised", "the family's controller, left alone")
    yield ("always-brake", "hardest braking at every decision")
    yield ("oracle", "our reviser, told how hard this very leader brakes, and the brakes")
    for name, measure in FIXED_MEASURES.items():
        if name in driven:
            yield (name, _short(repr(measure)))
    limits = f"own {study.family.decel:g}, leader's {study.family.leader_decel:g} m/s²"
    yield ("rss-matched", f"the safe distance, told the true limits: {limits}")
    for policy, points in settings(study).items():
        if policy in driven and policy.endswith("-tuned"):
            made = _short(chosen(points).setting)
            yield (policy, f"{made}, chosen from {len(points)} settings")


def _short(made: str) -> str:
    """How a measure was made, without the digits that floats bring along."""
    return re.sub(r"\d+\.\d+", lambda found: f"{float(found[0]):g}", made)


# -- Figures --------------------------------------------------------------------------------------


def closed_loop_sketches(study: ClosedLoop) -> list[Callable[[], Sketch]]:
    """The figures that apply, to be drawn."""
    drawn = [
        (study.rows, _sketch_trade_off),
        (study.curve, _sketch_learning),
        (study.streams, _sketch_stream),
        (study.reliabilities, _sketch_reliability),
    ]
    return [partial(sketch, study) for found, sketch in drawn if found]


def _sketch_trade_off(study: ClosedLoop) -> Sketch:
    return Sketch(
        "trade-off",
        "Collisions against mobility",
        "Best is the lower right corner. Points: all policies on the held-out episodes, with 95 % "
        "intervals; ours is the median over seeds after all training. Solid line: ours over its "
        f"tolerance (the point's is {percent(study.plan.tolerance)}), one seed, on the first "
        "held-out episodes. Broken lines: of the tuned baselines the settings that none beats on "
        "both axes (small dots: the others), on the training episodes they were tuned on. The "
        "vertical scale is linear up to 1 % and logarithmic beyond, to show 0.",
        "Scatter of collision rate over mobility, a named point for each policy.",
        draw_trade_off(study),
    )


def _sketch_learning(study: ClosedLoop) -> Sketch:
    seeds = len({point.learning_seed for point in study.curve})
    return Sketch(
        "learning",
        "Learning curve",
        f"Tests with learning frozen, on {study.curve[0].held_out:,} held-out episodes each. Line: "
        f"median over {seeds} learning seeds; band: their range. The last panel counts the states "
        "of the machine.",
        "Collision rate, mobility and number of states over the number of training episodes.",
        draw_learning(study),
    )


def _sketch_stream(study: ClosedLoop) -> Sketch:
    seeds = len({stream.learning_seed for stream in study.streams})
    return Sketch(
        "stream",
        "Collisions along a stream that shifts",
        f"Mean over the last {WINDOW} episodes and {seeds} learning seeds (the mean begins anew at "
        "the shift); band: the middle 80 % of seeds. Nobody is told of the shift. rss-unchanged "
        "is the safe distance, told the limits that were true before it.",
        "Collision rate over the episodes of the stream, for evofsm and rss-unchanged.",
        draw_stream(study),
    )


def _sketch_reliability(study: ClosedLoop) -> Sketch:
    return Sketch(
        "reliability",
        "Reliability of the probabilities",
        "Above: of the cases with a predicted probability in each tenth, how many came true. On "
        "the broken line a prediction means what it says; above it, risk is understated. Below: "
        "how many cases there were. Cases of one episode depend on one another.",
        "Reliability diagrams with the number of cases in each bin.",
        draw_reliability(study.reliabilities),
    )


# -- Sections -------------------------------------------------------------------------------------

_TITLES = {
    "learning": ("Learning", "learning"),
    "shift": ("When the world shifts", "stream"),
    "calibration": ("Are the probabilities right?", "reliability"),
    "separation": ("Telling dead ends", ""),
    "states": ("States alone", ""),
    "cases": ("The paper's cases", ""),
    "worlds": ("Both worlds", ""),
}


def _sections(study: ClosedLoop, figures: dict[str, Drawing]) -> Iterator[Section]:
    tables = side_tables(study)
    for name, (title, figure) in _TITLES.items():
        table = (tables[name],) if name in tables else ()
        shown = (figures[figure],) if figure in figures else ()
        if shown or table:
            text = why_not_by_state(study) if name == "states" else ""
            yield Section(name, title, text, table, shown)


def _plan(study: ClosedLoop) -> Iterator[Setting]:
    plan = study.plan
    yield Setting("seed of everything", str(plan.seed))
    yield Setting("learning seeds", f"{plan.seeds}, from 0")
    yield Setting("training episodes", f"{plan.train:,} for each learning seed")
    yield Setting("held-out episodes", f"{plan.test:,}; nothing learns from them")
    yield Setting("tolerance", f"{plan.tolerance:g}")
    yield Setting("studies beside", f"{plan.side_train:,} to learn, {plan.side_test:,} held out")
    yield Setting("state rules", f"{plan.rule_seeds} seeds, {plan.rule_test:,} held out")
    if study.worlds:
        yield Setting("both worlds", f"{plan.world_test:,} episodes in each")
    if study.streams:
        shift = plan.shift
        yield Setting("stream", f"{shift.before:,} episodes, then {shift.after:,} shifted ones")
        yield Setting("tests around the shift", f"{shift.held_out:,} held out")
    actions = study.family.actions
    yield Setting("decisions", f"every {study.family.interval:g} s")
    yield Setting(
        "actions",
        f"{actions.n_actions} from {actions.low:g} to {actions.high:g} m/s²".replace("-", "−"),
    )
    yield Setting("third car behind", "yes" if has_third_car(study) else NONE)

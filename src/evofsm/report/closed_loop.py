"""The closed-loop study on one page: its table, its figures, and where it loses."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

from evofsm._extras import needs
from evofsm.report.beside import side_tables, why_not_by_state
from evofsm.report.comparison import answer, headline, note_on_the_table
from evofsm.report.documents import without_nan
from evofsm.report.html import Setting, inline, versions, write_html
from evofsm.report.losses import losses_in_words
from evofsm.report.words import NONE, count, interval, number, part, percent, percents
from evofsm.studies.closed_loop import FIXED_MEASURES, ClosedLoop
from evofsm.studies.closed_loop.comparison import (
    Line,
    chosen,
    has_third_car,
    settings,
    table_groups,
)
from evofsm.studies.closed_loop.over_seeds import WINDOW
from evofsm.studies.table import Table

with needs("matplotlib", "plot", "drawing figures"):
    from evofsm.report.drawing import Drawing, Sketch, draw_all
    from evofsm.report.of_policies import (
        draw_learning,
        draw_reliability,
        draw_stream,
        draw_trade_off,
    )


class _Cell(NamedTuple):
    value: str
    beside: str = ""  # smaller, below it


class _Shown(NamedTuple):
    """A line of the table, in words."""

    name: str
    which: str
    ours: bool
    cells: list[_Cell]


class _Section(NamedTuple):
    id: str
    title: str
    text: str
    figures: list[tuple[Drawing, str, int]]
    table: Table | None


def write_closed_loop(
    study: ClosedLoop,
    out: Path,
    command: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Write ``closed-loop.json``, the figures, and ``index.html``, which needs nothing beside it.

    Parameters
    ----------
    study : ClosedLoop
    out : Path
        Folder; made if it is not there.
    command : str
        What was typed to get it.
    progress : callable
        Told how many figures are done, of how many.

    Returns
    -------
    Path
        The page.
    """
    out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(without_nan(study.as_dict()), allow_nan=False, indent=1)
    (out / "closed-loop.json").write_text(f"{text}\n", encoding="utf-8")
    drawings = draw_all(closed_loop_sketches(study), out, progress)
    figures = {
        drawing.name: (drawing, inline(drawing.paths["svg"]), place)
        for place, drawing in enumerate(drawings, 1)
    }
    lost = losses_in_words(study)
    return write_html(
        out / "index.html",
        "closed_loop.html.j2",
        family=study.family.name,
        about=study.family.about,
        tolerance=percent(study.plan.tolerance),
        headline=headline(study),
        answer=answer(study),
        losses=lost,
        loud=[loss for loss in lost if loss.loud],
        header=_header(study),
        groups=[
            (name, [_shown(line, study) for line in lines]) for name, lines in table_groups(study)
        ],
        note=note_on_the_table(study),
        constants=list(_constants(study)),
        trade_off=[figures[name] for name in ("trade-off",) if name in figures],
        sections=list(_sections(study, figures)),
        plan=list(_plan(study)),
        versions=list(versions(("scipy",), sumo=bool(study.worlds))),
        command=command,
    )


# -- The table ------------------------------------------------------------------------------------


def _header(study: ClosedLoop) -> list[str]:
    header = [
        "policy",
        "collisions (95 %)",
        "mobility (95 %)",
        "interventions",
        "mean change [m/s²]",
        "RMS jerk [m/s³]",
        "episodes until safe",
        "collisions while learning",
    ]
    return [*header, "rear-end collisions"] if has_third_car(study) else header


def _shown(line: Line, study: ClosedLoop) -> _Shown:
    cells = [
        _Cell(
            f"{percent(line.collision_rate)} ({percents(line.collision_low, line.collision_high)})",
            part(line.collisions, line.episodes),
        ),
        _Cell(
            number(line.mobility, 3),
            interval(line.mobility_low, line.mobility_high, lambda x: number(x, 3)),
        ),
        _Cell(percent(line.intervention_rate)),
        _Cell(number(line.mean_change, 2)),
        _Cell(number(line.jerk, 2)),
        _Cell(_until_safe(line)),
        _Cell(
            count(line.train_collisions),
            "" if math.isnan(line.train_collisions) else f"of {line.train_episodes:,}",
        ),
    ]
    if has_third_car(study):
        cells.append(_Cell(count(line.rear_ends), f"of {line.episodes:,}"))
    if not line.is_ours:
        return _Shown(line.policy, "", False, cells)
    name = f"{line.policy}, {line.train_episodes:,} episodes"
    of_seeds = "of" if line.which == "worst seed" else "over"
    return _Shown(name, f"{line.which} {of_seeds} {line.seeds}", True, cells)


def policy_table(study: ClosedLoop) -> Table:
    """All policies, as a plain table."""
    lines = [_shown(line, study) for _, found in table_groups(study) for line in found]
    return Table(
        "All policies",
        tuple(_header(study)),
        tuple(
            (
                f"{line.name}, {line.which}" if line.which else line.name,
                *(cell.value for cell in line.cells),
            )
            for line in lines
        ),
        ours=tuple(place for place, line in enumerate(lines) if line.ours),
    )


def _until_safe(line: Line) -> str:
    if math.isinf(line.until_safe):
        return f"not in {line.train_episodes}"
    return count(line.until_safe)


def _constants(study: ClosedLoop) -> Iterator[Setting]:
    """What each baseline is made of; of the tuned ones, what tuning chose."""
    driven = {row.policy for row in study.rows}
    yield Setting("unrevised", "the family's controller, left alone")
    yield Setting("always-brake", "hardest braking at every decision")
    yield Setting("oracle", "our reviser, told how hard this very leader brakes, and the brakes")
    for name, measure in FIXED_MEASURES.items():
        if name in driven:
            yield Setting(name, _short(repr(measure)))
    limits = f"own {study.family.decel:g}, leader's {study.family.leader_decel:g} m/s²"
    yield Setting("rss-matched", f"the safe distance, told the true limits: {limits}")
    for policy, points in settings(study).items():
        if policy in driven and policy.endswith("-tuned"):
            made = _short(chosen(points).setting)
            yield Setting(policy, f"{made}, chosen from {len(points)} settings")


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


def _sections(
    study: ClosedLoop, figures: dict[str, tuple[Drawing, str, int]]
) -> Iterator[_Section]:
    tables = side_tables(study)
    for name, (title, figure) in _TITLES.items():
        shown = [figures[figure]] if figure in figures else []
        if shown or name in tables:
            text = why_not_by_state(study) if name == "states" else ""
            yield _Section(name, title, text, shown, tables.get(name))


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

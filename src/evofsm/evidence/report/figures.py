"""The figures of the paper's study, each as PNG and SVG: drawn from what is there."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from evofsm.evidence.paper.claims import LARGEST_DIVERGENCE
from evofsm.evidence.paper.runs import PaperStudy, Run
from evofsm.extras import needs

with needs("matplotlib", "plot", "drawing figures"):
    from evofsm.evidence.report.drawing import Drawing, Sketch, draw_all
    from evofsm.evidence.report.of_states import draw_graph, draw_matrices, draw_space
    from evofsm.evidence.report.over_time import (
        draw_case,
        draw_divergence,
        draw_growth,
        in_dead_end,
    )
    from evofsm.plot import label_of


def paper_figures(
    study: PaperStudy,
    folder: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Drawing]:
    """Draw the figures of the paper's study.

    Parameters
    ----------
    study : PaperStudy
        With any number of rounds, states and collisions.
    folder : Path
        Where the files are put; made if it is not there.
    progress : callable
        Told how many figures are done, of how many.

    Returns
    -------
    list of Drawing
        In the order in which a reader wants them.
    """
    return draw_all(_sketches(study), folder, progress)


def _sketches(study: PaperStudy) -> list[Callable[[], Sketch]]:
    """The figures, to be drawn one by one."""
    of_the_study = (
        _sketch_divergence,
        _sketch_growth,
        _sketch_space,
        _sketch_graph,
        _sketch_matrices,
    )
    return [
        *(partial(_sketch_case, study, run) for run in study.last_round),
        *(partial(sketch, study) for sketch in of_the_study),
    ]


def _sketch_case(study: PaperStudy, run: Run) -> Sketch:
    actions = study.settings.actions
    tint = (
        "Tinted: a dead end, by an oracle who knows how both can brake, as long as it lasts; until "
        "the leader brakes it can still be left, as in case 3. "
        if in_dead_end(study, run).any()
        else ""
    )
    if study.dead_end >= 0:
        tint += f"{label_of(study.dead_end)} is the state in which collisions happen. "
    return Sketch(
        f"case-{run.case}",
        f"Result of {run.name}",
        f"Last round (run {len(study.runs) - len(study.last_round) + run.case} of "
        f"{len(study.runs)}). {tint}Vertical lines: {_named_moments(study, run)}. Action a(r) is "
        f"the interval in which the acceleration lies, from a(1), {_interval(study, 0)}, to "
        f"a({actions.n_actions}), {_interval(study, actions.n_actions - 1)} m/s².",
        "Gap, speeds, acceleration, recognised state and action over time in "
        f"{run.name}, which {_ending(run)}.",
        draw_case(study, run),
    )


def _named_moments(study: PaperStudy, run: Run) -> str:
    names = ["change of the driver (dashed)"] if run.case in study.settings.switch_at else []
    names.append("begin of the leader's full brake (dotted)")
    names += ["collision (solid, with a cross)"] if run.episode.collided else []
    return ", ".join(names)


def _interval(study: PaperStudy, action: int) -> str:
    return study.settings.actions.label(action).replace("-", "−")


def _ending(run: Run) -> str:
    end = f"{run.episode.time[-1]:.1f} s"
    return f"ends in a collision at {end}" if run.episode.collided else "ends without a collision"


def _sketch_divergence(study: PaperStudy) -> Sketch:
    return Sketch(
        "divergence",
        "Divergence of forecast and recognised state",
        "Jensen–Shannon divergence of the one-step forecast and the distribution over states "
        "recognised then, in the last round: 0 where they are equal, 1 bit where they have "
        "nothing in common. A run's first forecast is set apart, as in the paper: it starts from "
        f"the uniform distribution. The paper's bound on all others is {LARGEST_DIVERGENCE:g} bit. "
        "Vertical lines as in the figures of the cases. The forecast may jump where the action "
        "changes: each action has a matrix of its own. The table of forecasts sets simpler ones "
        "beside it.",
        "Four panels, one for each case, with the divergence over time below the paper's bound "
        "or above it; the largest value is written beside its place.",
        draw_divergence(study),
    )


def _sketch_growth(study: PaperStudy) -> Sketch:
    founded = study.model.n_states
    return Sketch(
        "growth",
        "Growth of the number of states",
        f"{founded} states were founded in {len(study.runs)} runs. Discs are numbered by the order "
        "of founding and stand where it happened, with the time within the run"
        + (
            f"; the hexagon is the dead end, {label_of(study.dead_end)}."
            if study.dead_end >= 0
            else "."
        ),
        f"Steps of the number of states from 0 to {founded} over {len(study.runs)} runs.",
        draw_growth(study),
    )


def _sketch_space(study: PaperStudy) -> Sketch:
    return Sketch(
        "space",
        "States and trajectories in the space of observations",
        "The last round over the gap: the follower's speed above (solid), the leader's below "
        "(dashed). Numbered discs are the states' centres; where two would overlap they are moved "
        "apart and point to their place. A state is recognised by the distance to its centre in "
        "all three variables, so neither plane alone decides which one it is. The gap is drawn by "
        "its root, to give the small gaps room.",
        "Eight panels, four cases by two speeds, with the trajectory of each case and the centres "
        f"of {study.model.n_states} states.",
        draw_space(study),
    )


def _sketch_graph(study: PaperStudy) -> Sketch:
    return Sketch(
        "graph",
        "State graph",
        "(a) What the machine has learnt: the probability that one state follows another in the "
        "next step, over all actions as often as each was used; arrows are as wide as they are "
        "probable, and staying is written beside the state. Belief is spread over all states, and "
        "so are the transitions that are learnt from it. (b) How often the most probable state "
        "changed from one to another; the width of an arrow is its count.",
        f"Two graphs of {study.model.n_states} states on a circle: learnt probabilities, and "
        "counted changes of the recognised state.",
        draw_graph(study),
    )


def _sketch_matrices(study: PaperStudy) -> Sketch:
    model = study.model
    used = int((model.uses > 0.0).sum())
    idle = [f"a({action + 1})" for action in range(model.n_actions) if not model.uses[action]]
    return Sketch(
        "matrices",
        "Transition matrices by action",
        f"One matrix for each of the {used} actions that were used"
        + (f" (never used: {', '.join(idle)})" if idle else "")
        + ", all on one scale. A row holds the probabilities of the next state, given the present "
        "one. Where the rows of a matrix look alike, the forecast hardly depends on the present "
        "state.",
        f"{used} heat maps of {model.n_states} by {model.n_states} transition probabilities.",
        draw_matrices(model, study.dead_end),
    )

"""Say in the terminal what was learnt; readable in 80 columns, and plain text when piped.

States and actions are counted from 1 here, as people read them; in the documents for programs
they are counted from 0, as in the code.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from evofsm.cli.learning import Learning, Skill, passages
from evofsm.cli.text.columns import Facts, print_columns, print_facts
from evofsm.cli.text.columns import console as console
from evofsm.fsm import FSMModel

_SECOND_STEPS = {
    "marginal": "all actions alike, as in the paper",
    "hold": "the same action, held",
    "observed": "actions as often as they were used",
}
# With less of the belief, the most probable state is hardly told apart from the others.
_UNCERTAIN = 0.5

# -- For people -----------------------------------------------------------------------------------


def print_learning(
    out: Console,
    learning: Learning,
    *,
    action: str,
    lengths: str | None,
    further: Iterable[tuple[str, str]] = (),
) -> None:
    """Print what was read, the states, the transitions and the skill.

    Parameters
    ----------
    out : Console
    learning : Learning
    action : str
        Name of the action.
    lengths : str, optional
        Lengths assumed for vehicles, where they mattered.
    further : iterable of (str, str)
        What else is to be said of how it was read.
    """
    model = learning.model
    facts = [*_read_facts(learning), ("actions", _action_text(learning, action)), *further]
    if lengths:
        facts.append(("vehicle lengths", f"assumed, for FCD has none: {lengths}"))
    print_facts(out, "What was read", facts)
    _print_states(out, model)
    if model.n_states > 1 and learning.certainty < _UNCERTAIN:
        out.print(
            f"States are hardly told apart: the most probable one has {learning.certainty:.0%} of "
            f"the belief on average ({1 / model.n_states:.0%} is a blind guess). A smaller "
            "--spread sharpens recognition.\n",
            style="yellow",
        )
    _print_passages(out, model)
    _print_skills(out, learning.skills)


def print_model(out: Console, model: FSMModel, facts: Facts) -> None:
    """Print a model: the given facts about it, its states, transitions and actions."""
    print_facts(out, "Model", [*facts, *_model_facts(model)])
    _print_states(out, model)
    _print_passages(out, model)
    _print_actions(out, model)


def _read_facts(learning: Learning) -> Facts:
    facts = [
        ("rows", f"{learning.rows:,}, one every {learning.model.dt:g} s"),
        ("episodes", f"{learning.episodes:,}, together {_duration(learning.seconds)}"),
        ("transitions", f"{learning.transitions:,}"),
    ]
    if learning.jumps:
        facts.append(("time jumps", f"{learning.jumps:,}; each begins an episode"))
    if learning.cuts:
        facts.append(("pairs cut", f"{learning.cuts:,} long ones go on in an episode of their own"))
    return facts


def _action_text(learning: Learning, action: str) -> str:
    actions = learning.model.actions
    assert actions is not None
    text = f"{actions.n_actions} intervals of {action} from {actions.low:g} to {actions.high:g}"
    clipped = learning.clipped_below + learning.clipped_above
    if not clipped:
        return f"{text}; none was beyond"
    return (
        f"{text}; {learning.clipped_below:,} below and {learning.clipped_above:,} above "
        f"({_percent(clipped / learning.rows)} of rows) were put into the end intervals"
    )


def _model_facts(model: FSMModel) -> Facts:
    settings = ", ".join(f"{name} {value:g}" for name, value in model.settings.items())
    return [
        ("observations", f"{model.visits.sum():,.0f}, {_step_text(model.dt)}"),
        ("transitions", f"{model.uses.sum():,.0f}, under {model.n_actions} actions"),
        ("states", f"{model.n_states}, of {model.n_variables} variables"),
        ("settings", settings or "not known"),
        ("failures", _failures_text(model)),
    ]


def _failures_text(model: FSMModel) -> str:
    if not model.failures_told:
        return "none was ever told"
    return f"{model.endings.sum():,.0f} episodes ended in one"


def _step_text(dt: float | None) -> str:
    return "the step is not known" if dt is None else f"one every {dt:g} s"


def _print_states(out: Console, model: FSMModel) -> None:
    total = max(float(model.visits.sum()), 1.0)
    stays = np.diag(model.changes) / np.maximum(model.changes.sum(axis=1), 1.0)
    centers = zip(*(_aligned(column) for column in model.centers.T), strict=True)
    rows = [
        (
            f"#{i + 1}",
            *center,
            _percent(float(model.visits[i]) / total),
            f"{stays[i]:.3f}",
            f"{model.founded[i]:,.0f}",
        )
        for i, center in enumerate(centers)
    ]
    out.print("States (stays: share of its steps; first seen: at which row)", style="bold")
    print_columns(out, ("", *_headers(model), "share\nof time", "stays", "first\nseen"), rows)
    out.print()


def _aligned(values: NDArray[np.float64]) -> list[str]:
    """Numbers with the same number of decimals, such that the largest has four digits."""
    largest = float(np.abs(values).max(initial=0.0))
    decimals = max(3 - math.floor(math.log10(largest)), 0) if largest > 0.0 else 2
    return [f"{value:.{decimals}f}" for value in values]


def _headers(model: FSMModel) -> list[str]:
    names = model.names or [f"variable {j + 1}" for j in range(model.n_variables)]
    units = model.units or [""] * model.n_variables
    headers = [name.replace("=", "=\n") for name in names]  # light=red
    return [
        f"{name}\n[{unit}]" if unit else name for name, unit in zip(headers, units, strict=True)
    ]


def _print_passages(out: Console, model: FSMModel) -> None:
    found = passages(model)
    if not found:
        out.print("The recognised state never changed.\n")
        return
    rows = []
    for passage in found:
        row = [f"#{passage.origin + 1} → #{passage.target + 1}", f"{passage.times:,}"]
        row += [f"{passage.share:.4f}", f"{passage.learnt:.3f}"]
        if passage.action is None:
            row += ["", "", ""]
        else:
            row += [_action_name(model, passage.action), f"{passage.under_action:.3f}"]
            row += [f"{passage.taken:,.0f}×"]
        rows.append(row)
    out.print(f"Transitions that matter: the {len(found)} most frequent", style="bold")
    header = ("from → to", "times", "share", "learnt", "most under", "there", "tried")
    print_columns(out, header, rows, left=(0, 4))
    out.print()
    out.print(
        "Times and share: of the steps from that state, as recognised. Learnt: probability per "
        "step that the matrices give; most under which action, how probable there, and about how "
        "often that action was taken in the state. Where learnt is far above the share, beliefs "
        "are wide.\n"
    )


def _print_actions(out: Console, model: FSMModel) -> None:
    total = max(float(model.uses.sum()), 1.0)
    rows = [
        (_action_name(model, r), f"{uses:,.0f}", _percent(float(uses) / total))
        for r, uses in enumerate(model.uses)
    ]
    out.print("Actions", style="bold")
    print_columns(out, ("action", "used", "share"), rows)
    out.print()


def _action_name(model: FSMModel, r: int) -> str:
    number = f"a({r + 1})"
    return f"{number:6}{model.actions.label(r)}" if model.actions else number


def _print_skills(out: Console, skills: Sequence[Skill]) -> None:
    rows = [
        (
            f"{skill.seconds:g} s",
            "-" if skill.policy is None else _SECOND_STEPS[skill.policy],
            f"{skill.divergence:.2g}",
            f"{skill.persistence:.2g}",
            _skill_text(skill.skill),
        )
        for skill in skills
    ]
    out.print("Forecasts against persistence", style="bold")
    header = ("ahead", "actions after the first", "forecast [bit]", "persistence [bit]", "skill")
    print_columns(out, header, rows, left=(0, 1))
    out.print(
        "\nMean Jensen-Shannon divergence from the belief that came; each forecast was made before "
        "its rows were learnt. Persistence: the belief stays as it is. Skill: 1 is perfect, 0 as "
        "good as persistence, below 0 worse."
    )
    if len(skills) == 1:
        out.print("The step is too long for a separate forecast of 1 s ahead.")


def _skill_text(skill: float) -> str:
    if math.isnan(skill):
        return "none"
    return f"{skill:+.2f}" if abs(skill) < 10.0 else f"{skill:+,.0f}"


def _percent(share: float) -> str:
    return f"{share:.1%}"


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.1f} s"
    minutes = seconds / 60.0
    return f"{minutes:.1f} min" if minutes < 120.0 else f"{minutes / 60.0:.1f} h"


# -- For programs ---------------------------------------------------------------------------------


def learning_document(learning: Learning) -> dict[str, Any]:
    """All that `print_learning` prints, for JSON; states and actions from 0."""
    facts = {name: value for name, value in vars(learning).items() if name not in _APART}
    skills = [{**asdict(skill), "skill": skill.skill} for skill in learning.skills]
    return {**facts, "skills": skills, "model": model_document(learning.model)}


_APART = ("machine", "model", "skills")


def model_document(model: FSMModel) -> dict[str, Any]:
    """All that `print_model` prints, for JSON; states and actions from 0."""
    return {
        "dt": model.dt,
        "names": model.names,
        "units": model.units,
        "settings": dict(model.settings),
        "failures_told": model.failures_told,
        "states": [
            {
                "state": i,
                "center": model.centers[i].tolist(),
                "visits": float(model.visits[i]),
                "first_seen": int(model.founded[i]),
            }
            for i in range(model.n_states)
        ],
        "transitions": [passage._asdict() for passage in passages(model)],
        "actions": [
            {
                "action": r,
                "interval": model.actions.interval(r) if model.actions else None,
                "uses": float(model.uses[r]),
            }
            for r in range(model.n_actions)
        ],
    }

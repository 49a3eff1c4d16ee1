"""Say in the terminal what was learnt; states and actions are counted from 1 here."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from evofsm.cli.inspect import model_document, tables_of
from evofsm.cli.learning import Learning, Skill
from evofsm.cli.show import facts, show, table

if TYPE_CHECKING:
    from rich.console import RenderableType

_SECOND_STEPS = {
    "marginal": "all alike, as in the paper",
    "hold": "the same, held",
    "observed": "as often as they were used",
}
# With less of the belief, the most probable state is hardly told apart from the others.
_UNCERTAIN = 0.5


def print_learning(
    learning: Learning,
    *,
    action: str,
    lengths: str | None,
    further: Iterable[tuple[str, str]] = (),
) -> None:
    """Print what was read, the states, the transitions and the skill.

    ``lengths`` were assumed for vehicles, where they mattered; ``further`` is what else is to be
    said of how it was read.
    """
    model = learning.model
    read = [*_read_facts(learning), ("actions", _action_text(learning, action)), *further]
    if lengths:
        read.append(("vehicle lengths", f"assumed, for FCD has none: {lengths}"))
    show(facts("What was read", read), *tables_of(model))
    if model.n_states > 1 and learning.certainty < _UNCERTAIN:
        show(
            f"\nStates are hardly told apart: the most probable one has {learning.certainty:.0%} "
            f"of the belief on average ({1 / model.n_states:.0%} is a blind guess). A smaller "
            "--spread sharpens recognition."
        )
    show("", *_skills(learning.skills))


def _read_facts(learning: Learning) -> list[tuple[str, str]]:
    found = [
        ("rows", f"{learning.rows:,}, one every {learning.model.dt:g} s"),
        ("episodes", f"{learning.episodes:,}, together {_duration(learning.seconds)}"),
        ("transitions", f"{learning.transitions:,}"),
    ]
    if learning.jumps:
        found.append(("time jumps", f"{learning.jumps:,}; each begins an episode"))
    if learning.cuts:
        found.append(("pairs cut", f"{learning.cuts:,} long ones go on in an episode of their own"))
    return found


def _action_text(learning: Learning, action: str) -> str:
    actions = learning.model.actions
    assert actions is not None
    text = f"{actions.n_actions} intervals of {action} from {actions.low:g} to {actions.high:g}"
    clipped = learning.clipped_below + learning.clipped_above
    if not clipped:
        return f"{text}; none was beyond"
    return (
        f"{text}; {learning.clipped_below:,} below and {learning.clipped_above:,} above "
        f"({clipped / learning.rows:.1%} of rows) were put into the end intervals"
    )


def _skills(skills: Sequence[Skill]) -> Iterator[RenderableType]:
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
    header = ("ahead", "actions after the first", "forecast [bit]", "persistence [bit]", "skill")
    yield table("Forecasts compared with persistence", header, rows, left=(0, 1))
    yield (
        "\nMean Jensen-Shannon divergence from the belief that came; each forecast was made before "
        "its rows were learnt. Persistence: the belief stays as it is. Skill: 1 is perfect, 0 as "
        "good as persistence, below 0 worse."
    )
    if len(skills) == 1:
        yield "The step is too long for a separate forecast of 1 s ahead."


def _skill_text(skill: float) -> str:
    if math.isnan(skill):
        return "none"
    return f"{skill:+.2f}" if abs(skill) < 10.0 else f"{skill:+,.0f}"


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.1f} s"
    minutes = seconds / 60.0
    return f"{minutes:.1f} min" if minutes < 120.0 else f"{minutes / 60.0:.1f} h"


def learning_document(learning: Learning) -> dict[str, Any]:
    """All that `print_learning` prints, for JSON; states and actions from 0."""
    apart = ("machine", "model", "skills")
    read = {name: value for name, value in vars(learning).items() if name not in apart}
    skills = [{**asdict(skill), "skill": skill.skill} for skill in learning.skills]
    return {**read, "skills": skills, "model": model_document(learning.model)}

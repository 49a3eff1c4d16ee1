"""`evofsm explain`."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evofsm.cli.commands.common import load_model, print_json, say
from evofsm.cli.commands.declared import argument, option
from evofsm.cli.commands.groups import WithJson

if TYPE_CHECKING:
    from evofsm.fsm import Explanation, FSMModel

_WIDTH = 80
_UNTOLD = (
    "What was learnt tells nothing of failures: none was ever told. From a log, evofsm learn "
    "--failed COLUMN or --failed 'gap<=0' tells of them."
)


@dataclass(frozen=True, kw_only=True)
class Explain(WithJson):
    """Say what was learnt of a situation: where it lies, how often it was seen, what came of it.

    All numbers were counted, once for each episode that came to a state; intervals are of 90 %.
    That one action ended better than another does not say that it was the reason.
    """

    file: Path = argument("A machine or a model that was saved, or a folder of evofsm drive --out.")
    state: int | None = option(None, "Number of a state, from 1; without it all.")
    observation: str | None = option(
        None,
        "An observation, its values with commas between them: which state it is, and what is known "
        "of it.",
    )
    action: int | None = option(None, "Number of an action, from 1: what came of it.")

    def run(self) -> None:
        """Print a paragraph for each situation."""
        if self.state is not None and self.observation is not None:
            raise ValueError("--state and --observation exclude each other")
        model, _ = load_model(self.file)
        action = _index("--action", self.action, model.n_actions)
        state = _index("--state", self.state, model.n_states)
        if self.observation is not None:
            found = [model.explain(action=action, observation=_values(self.observation))]
        else:
            states = range(model.n_states) if state is None else [state]
            found = [model.explain(each, action) for each in states]
        if self.as_json:
            situations = [_document(model, each) for each in found]
            print_json({"file": str(self.file), "situations": situations})
            return
        if not model.failures_told:
            print(textwrap.fill(_UNTOLD, _WIDTH))
        for each in found:
            say(textwrap.fill(each.text, _WIDTH, subsequent_indent="   "))


def _index(option: str, number: int | None, count: int) -> int | None:
    """From what people count from 1."""
    if number is not None and not 1 <= number <= count:
        raise ValueError(f"{option} is {number}; there are 1 to {count}")
    return None if number is None else number - 1


def _values(text: str) -> list[float]:
    try:
        return [float(value) for value in text.split(",")]
    except ValueError:
        raise ValueError(f"--observation is {text!r}; write numbers, such as 9,24,24") from None


def _document(model: FSMModel, found: Explanation) -> dict[str, Any]:
    from evofsm.cli.text.documents import spelled_out

    document: dict[str, Any] = spelled_out(found)
    document["center"] = None if found.state is None else model.centers[found.state].tolist()
    for name in ("here", "action", "after_better"):
        if (tally := getattr(found, name)) is not None:
            document[name]["interval"] = list(tally.interval)
    return document

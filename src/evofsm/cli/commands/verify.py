"""`evofsm verify`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path

from evofsm.cli.commands.common import load_model, print_json, say
from evofsm.cli.commands.declared import argument, option
from evofsm.cli.commands.groups import WithJson

# Both engines count the same steps of the same process: beyond rounding they may not differ.
_SAME = 1e-9
_NAMES = {"own": "our own computation", "storm": "Storm"}


class EngineName(StrEnum):
    """Who computes."""

    AUTO = "auto"
    OWN = "own"
    STORM = "storm"


@dataclass(frozen=True, kw_only=True)
class Verify(WithJson):
    """Check a property of what was learnt, such as 'Pmax=? [F<=20 "failed"]'.

    The process is that of evofsm export --to prism: a choice of action in each state, each with the
    probabilities that were learnt. It says what follows from these, not that they are right.
    """

    model: Path = argument(
        "A machine, a model or a guard that was saved, a folder of results, or a log of runs."
    )
    asked: str = argument(
        "The property, in PRISM's language; labels are failed, unknown, state_1, ...",
        metavar="PROPERTY",
    )
    engine: EngineName = option(
        EngineName.AUTO, "Storm, our own computation, or Storm where it is installed."
    )
    state: int | None = option(
        None, "From which state on, #1 being 1. [default: the one founded first]", min=1
    )
    evidence: float = option(1.0, "Leave out actions that rest on fewer decisions.", min=0.0)
    least: float = option(0.0, "Leave out transitions that are less probable.", min=0.0, max=1.0)

    def run(self) -> int | None:
        """Check it; 1 where both engines answer and differ."""
        from evofsm.io import Property, process_of, solve, solve_by_storm

        model, _ = load_model(self.model)
        _refuse_untold(self.model, model.failures_told, float(model.failures.sum()), self.asked)
        process = process_of(model, self.evidence, self.least)
        first = process.checked(self.state)
        by_storm = self.engine is EngineName.STORM or (
            self.engine is EngineName.AUTO and find_spec("stormpy") is not None
        )
        answers: dict[str, float] = {}
        if by_storm:
            answers["storm"] = solve_by_storm(model, self.asked, first, self.evidence, self.least)
        try:
            own = solve(process, Property.parse(self.asked))
            answers["own"] = float(own[first])
        except ValueError:
            if not by_storm:
                raise
        engine = next(iter(answers))
        apart = abs(answers["storm"] - answers["own"]) if len(answers) > 1 else None
        differ = apart is not None and apart > _SAME
        if self.as_json:
            print_json(
                {
                    "property": self.asked,
                    "state": first - 1,
                    "probability": answers[engine],
                    "engine": engine,
                    "answers": answers,
                    "same": None if apart is None else not differ,
                    "states": process.n_states,
                    "unknown_states": len(process.unknown),
                }
            )
            return 1 if differ else None
        say(f"{self.asked} from #{first}: {answers[engine]:.12g} ({_NAMES[engine]})")
        if apart is not None:
            word = "DIFFERS" if differ else "the same"
            say(f"{_NAMES['own'].capitalize()}: {answers['own']:.12g}, {word} (apart {apart:.1g})")
        elif by_storm:
            say("Our own computation does not know this property; nothing stands beside Storm's.")
        if process.unknown:
            say(
                f"{len(process.unknown)} of {process.n_states} states have no action with the "
                "evidence: nothing leads on from them, which is not to be taken for safe."
            )
        return 1 if differ else None


def _refuse_untold(place: Path, told: bool, failures: float, asked: str) -> None:
    """Raise where a probability of failure would be 0 for want of knowledge."""
    if "failed" not in asked:
        return
    if not told:
        raise ValueError(
            f"{place}: the model was never told of failures, so nothing is known of them "
            "(evofsm learn --failed, or failed= of a guard)"
        )
    if failures == 0.0:
        raise ValueError(
            f"{place}: no decision that was counted failed; a probability of 0 would say nothing"
        )

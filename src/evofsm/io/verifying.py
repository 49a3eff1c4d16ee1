"""Properties of a learnt process, in PRISM's language: by our own computation, or by Storm.

Ours counts back from the end: after no step the probability is 1 where the target is reached and 0
elsewhere; one step earlier it is that of the best (``Pmax``) or worst (``Pmin``) action. What it
knows is bounded by a number of steps, so nothing has to converge. Storm knows far more; both take
the very same process, `evofsm.io.graphs.to_prism`, with its twelve decimals.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from evofsm.extras import install, needs
from evofsm.fsm import FSMModel
from evofsm.io.graphs import to_prism
from evofsm.io.process import Process

Engine = Literal["own", "storm"]

#: More steps are a mistake, or better asked without a bound.
MOST_STEPS = 1_000_000
_LABEL = r'(!?)\s*(true|"(\w+)")'
_PROPERTY = re.compile(
    rf"\s*P\s*(max|min)?\s*=\s*\?\s*\[\s*(?:F|{_LABEL}\s*U)\s*(?:<(=?)\s*(\d+))\s*{_LABEL}\s*\]\s*"
)
_WANTED = (
    'such as Pmax=? [F<=20 "failed"], Pmin=? [F<20 "unknown"] or P=? [!"state_3" U<=5 "failed"]'
)


@dataclass(frozen=True)
class States:
    """States with a label, or those without it."""

    label: str | None  #: None for all states
    negated: bool = False

    def found(self, process: Process) -> NDArray[np.bool_]:
        """(1 + n,) ndarray: which they are; failure is 0.

        Raises
        ------
        ValueError
            If there is no such label.
        """
        marked = np.zeros(process.n_states + 1, np.bool_)
        if self.label is None:
            marked[:] = True
        elif self.label not in process.labels:
            raise ValueError(
                f'there is no label "{self.label}"; there are "failed", "unknown" and "state_1" to '
                f'"state_{process.n_states}"'
            )
        else:
            marked[list(process.labels[self.label])] = True
        return ~marked if self.negated else marked


@dataclass(frozen=True)
class Property:
    """How likely a target is reached within some steps, by way of certain states.

    Examples
    --------
    >>> asked = Property.parse('Pmax=? [F<=20 "failed"]')
    >>> asked.best, asked.steps, asked.target.label
    ('max', 20, 'failed')
    """

    best: str | None  #: ``"max"``, ``"min"``, or None where there is nothing to choose
    steps: int
    way: States  #: that it may lead through
    target: States

    @classmethod
    def parse(cls, text: str) -> Property:
        """Read a property.

        Raises
        ------
        ValueError
            If it is none that our own computation knows; the text says what does know more.
        """
        match = _PROPERTY.fullmatch(text)
        if match is None:
            raise ValueError(
                f"our own computation does not know the property {text!r}; it knows bounded ones "
                f"{_WANTED}. Storm knows more: {install('verify')}, and --engine storm"
            )
        best, not_way, any_way, way, equal, bound, not_target, any_target, target = match.groups()
        steps = int(bound) - (0 if equal else 1)
        if not 0 <= steps <= MOST_STEPS:
            raise ValueError(f"{text!r}: the bound must leave from 0 to {MOST_STEPS:,} steps")
        return cls(
            best,
            steps,
            States(way, bool(not_way)) if any_way else States(None),
            States(target, bool(not_target)) if any_target else States(None),
        )


def solve(process: Process, asked: Property) -> NDArray[np.float64]:
    """How likely it is from each state.

    Parameters
    ----------
    process : Process
    asked : Property

    Returns
    -------
    (1 + n,) ndarray
        Probabilities; the first is that of failure itself, the others of the states in turn.

    Raises
    ------
    ValueError
        If there is no such label, or actions to choose from and nothing said of which.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> from evofsm.io.process import process_of
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0], failures=[3])
    >>> process = process_of(machine.model(), evidence=2.0)
    >>> solve(process, Property.parse('Pmax=? [F<=1 "failed"]')).round(3)
    array([1.   , 0.333, 0.   ])
    """
    most = max((len(each) for each in process.commands), default=0)
    if asked.best is None and most > 1:
        raise ValueError(
            f"up to {most} actions are there to choose from in a state: ask Pmax=? or Pmin=?"
        )
    target, way = asked.target.found(process), asked.way.found(process)
    acts = [state for state, each in enumerate(process.commands, 1) if each]
    first = np.cumsum([0, *(len(process.commands[state - 1]) for state in acts)])[:-1]
    commands = [command for each in process.commands for command in each]
    chances = np.zeros((len(commands), process.n_states + 1))
    for row, command in enumerate(commands):
        for state, chance in command.chances:
            chances[row, state] = chance
    pick = np.minimum if asked.best == "min" else np.maximum
    reached = target.astype(np.float64)
    for _ in range(asked.steps if acts else 0):
        before = reached.copy()
        reached[acts] = pick.reduceat(chances @ before, first)
        reached[~way] = 0.0  # it may not lead on from there
        reached[target] = 1.0
    return reached


def solve_by_storm(
    model: FSMModel, text: str, first: int, evidence: float = 1.0, least: float = 0.0
) -> float:
    """How likely it is from one state, as Storm answers.

    Parameters
    ----------
    model : FSMModel
    text : str
        The property, in all of PRISM's language.
    first : int
        The state, from 1.
    evidence, least : float
        As in `to_prism`.

    Raises
    ------
    ModuleNotFoundError
        If stormpy is not installed.
    ValueError
        If Storm refuses the property, or answers with no number, or the property is filtered.
    """
    if "filter" in text:
        raise ValueError(f"{text!r}: what is asked for is one state's probability; name the state")
    with needs("stormpy", "verify", "checking with Storm"):
        import stormpy
    with TemporaryDirectory() as folder:
        file = Path(folder) / "model.prism"
        file.write_text(to_prism(model, evidence, least, first), encoding="utf-8")
        try:
            program = stormpy.parse_prism_program(str(file))
            asked = stormpy.parse_properties(text, program)
            if len(asked) != 1:
                raise ValueError(f"{text!r} holds {len(asked)} properties; one is checked")
            process = stormpy.build_model(program, asked)
            answer = stormpy.model_checking(process, asked[0])
        except RuntimeError as error:
            raise ValueError(f"Storm refuses {text!r}: {str(error).splitlines()[0]}") from None
    if not hasattr(answer, "get_value"):  # it holds truth values then
        raise ValueError(f"{text!r} asks whether, not how likely; write =?")
    return float(answer.get_value(process.initial_states[0]))

"""What a model counted as a Markov decision process: the one that is exported, and checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm import FSMModel

#: Probabilities have so many decimals; those of a command add up to 1 exactly.
DECIMALS = 12
_ONE = 10**DECIMALS


class Command(NamedTuple):
    """What one action does in a state."""

    action: int
    decided: float  #: decisions that it rests on
    failed: float  #: of them
    parts: tuple[tuple[int, int], ...]  #: targets, 0 for failure, and 10**12 times how likely

    @property
    def chances(self) -> tuple[tuple[int, float], ...]:
        """Targets, and how likely each is."""
        return tuple((target, part / _ONE) for target, part in self.parts)

    @property
    def decimals(self) -> tuple[tuple[int, str], ...]:
        """Targets, and how likely each is, as a decimal number."""
        return tuple(
            (target, "1" if part == _ONE else f"0.{part:0{DECIMALS}d}")
            for target, part in self.parts
        )


@dataclass(frozen=True)
class Process:
    """The process of a model: in which states is which command, as `process_of` finds them."""

    #: Of each state in turn; none where no action has the evidence, and nothing leads on.
    commands: tuple[tuple[Command, ...], ...]
    first: int  #: the state that it begins in, from 1; 0 is failure

    @property
    def n_states(self) -> int:
        """How many there are, failure left out."""
        return len(self.commands)

    @property
    def unknown(self) -> tuple[int, ...]:
        """States without a command, from 1."""
        return tuple(state for state, each in enumerate(self.commands, 1) if not each)

    @property
    def labels(self) -> dict[str, frozenset[int]]:
        """The states that each label stands for: failure is 0, others count from 1."""
        states = {f"state_{i}": frozenset([i]) for i in range(1, self.n_states + 1)}
        return {"failed": frozenset([0]), "unknown": frozenset(self.unknown), **states}

    def checked(self, first: int | None) -> int:
        """A state that it may begin in, its own if none is named.

        Raises
        ------
        ValueError
            If there is no such state.
        """
        if first is None:
            return self.first
        if not 1 <= first <= self.n_states:
            raise ValueError(f"there is no state #{first}; there are #1 to #{self.n_states}")
        return first


def process_of(model: FSMModel, evidence: float = 1.0, least: float = 0.0) -> Process:
    """The process that a model counted.

    Parameters
    ----------
    model : FSMModel
        Of a machine that counted its decisions.
    evidence : float
        How many decisions a command must rest on, at least.
    least : float
        Transitions to states below this probability are left out, but for failure.

    Raises
    ------
    ValueError
        If the model has no states or counted no decisions, ``evidence`` is not positive, or
        ``least`` no probability.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0], failures=[3])
    >>> process = process_of(machine.model(), evidence=2.0)
    >>> process.unknown, process.commands[0][0].decimals[0]
    ((2,), (0, '0.333333333333'))
    """
    refuse_no_probability(least)
    if not evidence > 0.0:
        raise ValueError(f"evidence is {evidence}; it must be positive")
    if not model.decisions.any():
        raise ValueError(
            "the model counted no decisions, so there is no action to choose "
            "(has its machine been told its actions, and by evofsm 0.1 or newer?)"
        )
    return Process(
        tuple(_commands(model, state, evidence, least) for state in range(model.n_states)),
        int(np.argmin(model.founded)) + 1,
    )


def refuse_no_probability(least: float) -> None:
    """Raise unless it is one."""
    if not 0.0 <= least <= 1.0:
        raise ValueError(f"least is {least}; it must be a probability, from 0 to 1")


def _commands(model: FSMModel, state: int, evidence: float, least: float) -> tuple[Command, ...]:
    """A command for each action that was tried often enough in a state."""
    commands = []
    for action in np.flatnonzero(model.decisions[:, state] >= evidence).tolist():
        decided, failed = model.decisions[action, state], model.failures[action, state]
        share = failed / decided
        row = model.transition_matrices[action, state]
        row = np.where(row >= min(least, row.max()), row, 0.0)
        chances = np.concatenate([[share], (1.0 - share) * row / row.sum()])
        commands.append(Command(action, float(decided), float(failed), _parts(chances)))
    return tuple(commands)


def _parts(chances: NDArray[np.float64]) -> tuple[tuple[int, int], ...]:
    """Places and probabilities in whole parts whose sum is 1 to the last digit."""
    parts: list[int] = np.rint(chances * _ONE).astype(np.int64).tolist()
    parts[int(np.argmax(parts))] += _ONE - sum(parts)
    return tuple((place, part) for place, part in enumerate(parts) if part)

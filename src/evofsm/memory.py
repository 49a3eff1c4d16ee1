"""All that a machine has learnt, in one flat buffer that a kernel takes as a single argument.

Named views into the buffer make it readable; `open_memory` is the only place that knows the
layout. There is room for ``capacity`` states, of which the first ``n_states`` are in use.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm._compile import kernel
from evofsm.states.clusters import Clusters
from evofsm.states.rule import RuleSettings
from evofsm.transitions import Outcomes, Transitions
from evofsm.validation import refuse_unless_distribution, refuse_unless_outcomes

NO_ACTION = -1

# Room before the arrays, for sizes, `Parameters` and counters: whole cache lines, so that rows of
# a capacity that is a multiple of 8 lie in as few lines as they can.
_HEAD = 24


class Parameters(NamedTuple):
    """The settings of a machine; the paper's symbols are phi, epsilon-bar."""

    learning_rate: float
    prior_frequency: float
    rule: RuleSettings


class Learnt(NamedTuple):
    """What the next step needs, and what people ask of the states."""

    n_states: NDArray[np.float64]  # (1,)
    action: NDArray[np.float64]  # (1,) taken after the latest observation, or NO_ACTION
    chained: NDArray[np.float64]  # (1,) 1 where `belief` belongs to the present episode
    state: NDArray[np.float64]  # (1,) the most probable state at the latest observation
    belief: NDArray[np.float64]  # (capacity,)
    visits: NDArray[np.float64]  # (capacity,) observations in which it was the most probable
    founded: NDArray[np.float64]  # (capacity,) number of the observation that did it, from 1
    changes: NDArray[np.float64]  # (capacity, capacity) steps from a state (row) to a state
    clusters: Clusters
    transitions: Transitions
    outcomes: Outcomes


class Scratch(NamedTuple):
    """Room in which a step works; worth nothing after it."""

    observation: NDArray[np.float64]  # (m,)
    predicted: NDArray[np.float64]  # (capacity,)
    recognised: NDArray[np.float64]  # (capacity,)


class Memory(NamedTuple):
    """The whole buffer."""

    parameters: Parameters
    learnt: Learnt
    scratch: Scratch


def _open_memory(buffer: NDArray[np.float64]) -> Memory:
    """Views into a buffer made by `allocate`; compiled for kernels as `open_memory`."""
    m, q, capacity = int(buffer[0]), int(buffer[1]), int(buffer[2])
    counters = buffer[11:17]
    start = _HEAD
    matrices = buffer[start : start + q * capacity * capacity]
    start += q * capacity * capacity
    changes = buffer[start : start + capacity * capacity]
    start += capacity * capacity
    per_state = buffer[start : start + (8 + m) * capacity].reshape((8 + m, capacity))
    start += (8 + m) * capacity
    per_action = buffer[start : start + 3 * q * capacity].reshape((3, q, capacity))
    start += 3 * q * capacity
    uses = buffer[start : start + q]
    start += q
    per_variable = buffer[start : start + 5 * m].reshape((5, m))
    return Memory(
        Parameters(
            float(buffer[3]),
            float(buffer[4]),
            RuleSettings(
                float(buffer[5]),
                float(buffer[6]),
                float(buffer[7]),
                float(buffer[8]),
                float(buffer[9]),
                float(buffer[10]),
                per_variable[4],
            ),
        ),
        Learnt(
            counters[0:1],
            counters[1:2],
            counters[2:3],
            counters[5:6],
            per_state[0],
            per_state[1],
            per_state[2],
            changes.reshape((capacity, capacity)),
            Clusters(
                counters[3:4],
                per_variable[0],
                per_variable[3],
                per_variable[1],
                counters[4:5],
                per_state[8:],
                per_state[3],
                per_state[4],
            ),
            Transitions(
                matrices.reshape((q, capacity, capacity)),
                per_action[0],
                uses,
            ),
            Outcomes(per_action[1], per_action[2], per_state[7]),
        ),
        Scratch(per_variable[2], per_state[5], per_state[6]),
    )


open_memory = kernel(_open_memory)


def allocate(
    n_variables: int, n_actions: int, capacity: int, parameters: Parameters
) -> NDArray[np.float64]:
    """Buffer of a machine that has seen nothing."""
    m, q = n_variables, n_actions
    *numbers, weights = parameters.rule
    per_action = 1 + 3 * capacity + capacity**2
    buffer = np.zeros(_HEAD + 5 * m + (8 + m) * capacity + q * per_action + capacity**2)
    buffer[:11] = (m, q, capacity, parameters.learning_rate, parameters.prior_frequency, *numbers)
    memory = view(buffer)
    memory.parameters.rule.weights[:] = weights
    memory.learnt.action[0] = NO_ACTION
    return buffer


def view(buffer: NDArray[np.float64]) -> Memory:
    """Views into a buffer, for Python."""
    return _open_memory(buffer)


def resize(buffer: NDArray[np.float64], capacity: int) -> NDArray[np.float64]:
    """Copy of a buffer with room for another number of states."""
    old = view(buffer)
    resized = allocate(int(buffer[0]), int(buffer[1]), capacity, old.parameters)
    new = dict(leaves(view(resized).learnt))
    for name, array in leaves(old.learnt):
        common = tuple(
            slice(min(sizes)) for sizes in zip(array.shape, new[name].shape, strict=True)
        )
        new[name][common] = array[common]
    return resized


def leaves(learnt: NamedTuple) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Every array in a tuple of arrays and further such tuples, with its name."""
    for name, value in zip(learnt._fields, learnt, strict=True):
        if isinstance(value, np.ndarray):
            yield name, value
        else:
            yield from leaves(value)


def refuse_impossible(learnt: Learnt) -> None:
    """Raise where numbers that a file gave could not have come from learning.

    Kernels take counts and indices from the buffer on trust.
    """
    n, n_actions = len(learnt.belief), len(learnt.transitions.uses)
    for name, array in leaves(learnt):
        if not np.isfinite(array).all():
            raise ValueError(f"{name} holds NaN or infinity")
    if learnt.n_states[0] != n:
        raise ValueError(f"n_states is {learnt.n_states[0]:g}, but there are {n} states")
    if learnt.action[0] not in range(NO_ACTION, n_actions):
        raise ValueError(f"action is {learnt.action[0]:g}, but there are {n_actions} actions")
    if learnt.state[0] not in range(n):
        raise ValueError(f"state is {learnt.state[0]:g}, but there are {n} states")
    if learnt.clusters.n_observations[0] < n or learnt.clusters.scatter[0] < 0.0:
        raise ValueError("n_observations or scatter is too small")
    refuse_unless_outcomes(*learnt.outcomes)
    refuse_unless_distribution("belief", learnt.belief)
    refuse_unless_distribution("a row of matrices", learnt.transitions.matrices)

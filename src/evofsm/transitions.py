"""Identify, expand and use one transition matrix per action: the paper's Section 2.3.

The paper keeps joint frequencies F and origin frequencies F_o and divides them for P. Both
decay at every use, and in a long run both underflow to 0/0. Here P itself is kept, row by row,
with F_o as the weight of each row: the same in exact arithmetic, and never NaN::

    F_o' = (1 - phi) F_o + phi tau_i          P_i += (phi tau_i / F_o') (gamma - P_i)

Rows are "from" and columns "to", so a forecast is ``belief @ P``. (The paper prints the product
the other way round, with the same meaning of rows.)
"""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from evofsm._compile import kernel
from evofsm.validation import whole

Policy = Literal["marginal", "hold", "observed"]

# A weight below this is taken as 0: smaller numbers turn denormal and slow every step.
_LOWEST_FREQUENCY = 1e-290


class Transitions(NamedTuple):
    """One row-stochastic matrix per action, the first n of ``capacity`` states in use."""

    matrices: NDArray[np.float64]  # (q, capacity, capacity)
    origin_frequency: NDArray[np.float64]  # (q, capacity)
    uses: NDArray[np.float64]  # (q,) transitions identified with each action


class Outcomes(NamedTuple):
    """Evidence on failure, in counts that never forget: a rare failure must not fade.

    It is kept apart from `Transitions.origin_frequency`, which forgets.
    """

    decisions: NDArray[np.float64]  # (q, capacity) belief-weighted transitions from each state
    failures: NDArray[np.float64]  # (q, capacity) those of them that led straight into failure
    endings: NDArray[np.float64]  # (capacity,) failures whose last observation was the state


@kernel
def count(counts: NDArray[np.float64], belief: NDArray[np.float64], n: int) -> None:
    """Count one event, shared out over the first ``n`` states by belief."""
    for i in range(n):
        counts[i] += belief[i]


@kernel
def expand(transitions: Transitions, n: int, prior_frequency: float) -> None:
    """Add state ``n`` to all matrices: its row and column of F are the prior frequency."""
    new = n
    for r in range(len(transitions.uses)):
        matrix = transitions.matrices[r]
        origin_frequency = transitions.origin_frequency[r]
        for i in range(new):
            before = origin_frequency[i]
            origin_frequency[i] = before + prior_frequency
            kept = before / origin_frequency[i]
            for j in range(new):
                matrix[i, j] *= kept
            matrix[i, new] = prior_frequency / origin_frequency[i]
        origin_frequency[new] = (new + 1) * prior_frequency
        for j in range(new + 1):
            matrix[new, j] = 1.0 / (new + 1)


@kernel
def identify(
    transitions: Transitions,
    action: int,
    n: int,
    origin: NDArray[np.float64],
    reached: NDArray[np.float64],
    learning_rate: float,
) -> None:
    """Learn one transition under ``action`` from belief ``origin`` to belief ``reached``."""
    matrix = transitions.matrices[action]
    origin_frequency = transitions.origin_frequency[action]
    transitions.uses[action] += 1.0
    for i in range(n):
        gain = learning_rate * origin[i]
        frequency = (1.0 - learning_rate) * origin_frequency[i] + gain
        if frequency < _LOWEST_FREQUENCY:
            origin_frequency[i] = 0.0
            continue
        origin_frequency[i] = frequency
        rate = gain / frequency
        for j in range(n):
            matrix[i, j] += rate * (reached[j] - matrix[i, j])


@kernel
def forecast(
    transitions: Transitions,
    action: int,
    n: int,
    belief: NDArray[np.float64],
    predicted: NDArray[np.float64],
) -> None:
    """One step ahead: ``belief @ P`` under ``action``."""
    matrix = transitions.matrices[action]
    for j in range(n):
        predicted[j] = 0.0
    for i in range(n):
        for j in range(n):
            predicted[j] += belief[i] * matrix[i, j]


def marginal(
    matrices: NDArray[np.float64], uses: NDArray[np.float64], policy: Policy = "marginal"
) -> NDArray[np.float64]:
    """Average the (q, n, n) matrices: over all actions alike, or as often as each was used."""
    if policy not in ("marginal", "observed"):
        raise ValueError(f"policy is {policy!r}; an average is 'marginal' or 'observed'")
    if policy == "observed" and uses.sum() > 0.0:
        mixed: NDArray[np.float64] = np.tensordot(uses / uses.sum(), matrices, axes=1)
        return mixed
    average: NDArray[np.float64] = matrices.mean(axis=0)
    return average


def propagate(
    matrices: NDArray[np.float64],
    uses: NDArray[np.float64],
    belief: NDArray[np.float64],
    action: int | None,
    horizon: int,
    policy: Policy,
) -> NDArray[np.float64]:
    """Forecast ``horizon`` steps: the first under ``action``, the others by ``policy``.

    Without an action the policy rules from the first step on.
    """
    if policy not in get_args(Policy):
        raise ValueError(f"policy is {policy!r}; it must be one of {', '.join(get_args(Policy))}")
    horizon = whole("horizon", horizon)
    if action is None and policy == "hold":
        raise ValueError("policy 'hold' needs the action that is held")
    if action is not None:
        belief = belief @ matrices[action]
        horizon -= 1
    if horizon > 0:
        then = matrices[action] if policy == "hold" else marginal(matrices, uses, policy)
        belief = belief @ np.linalg.matrix_power(then, horizon)
    return belief

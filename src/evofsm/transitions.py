"""Identify, expand and use one transition matrix per action: the paper's Section 2.3.

The paper keeps joint frequencies F and origin frequencies F_o and divides them for P. Both
decay at every use, and in a long run both underflow to 0/0. Here P itself is kept, row by row,
with F_o as the weight of each row: the same in exact arithmetic, and never NaN::

    F_o' = (1 - phi) F_o + phi tau_i          P_i += (phi tau_i / F_o') (gamma - P_i)

Rows are "from" and columns "to", so a forecast is ``belief @ P``. (The paper prints the product
the other way round, with the same meaning of rows.)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple, get_args

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from evofsm._compile import inner_kernel, lanes, rare_kernel
from evofsm._elementary import fma
from evofsm.validation import whole

Policy = Literal["marginal", "hold", "observed"]

# A weight below this is taken as 0: smaller numbers turn denormal and slow every step.
_LOWEST_FREQUENCY = 1e-290
# A row with less left of it than this is rounding.
_LEAST_KEPT = 1e-12
#: The place of an action without a matrix.
NOT_OPEN = -1.0


class Transitions(NamedTuple):
    """One row-stochastic matrix per action, the first n of ``capacity`` states in use.

    An action has a place among the s matrices from its first use on. One that was never used
    has none, and costs nothing: all its transitions are alike.
    """

    places: NDArray[np.float64]  # (q,) of each action's matrix, or NOT_OPEN
    uses: NDArray[np.float64]  # (q,) transitions identified with each action
    matrices: NDArray[np.float64]  # (s, capacity, capacity)
    origin_frequency: NDArray[np.float64]  # (s, capacity)


class Outcomes(NamedTuple):
    """Evidence on failure, in counts that never forget: a rare failure must not fade.

    It is kept apart from `Transitions.origin_frequency`, which forgets. Places are the same.
    """

    decisions: NDArray[np.float64]  # (s, capacity) belief-weighted transitions from each state
    failures: NDArray[np.float64]  # (s, capacity) those of them that led straight into failure
    endings: NDArray[np.float64]  # (capacity,) failures whose last observation was the state


@inner_kernel
def count(counts: NDArray[np.float64], belief: NDArray[np.float64], n: int) -> None:
    """Count one event, shared out over the first ``n`` states by belief."""
    for i in range(n):
        counts[i] += belief[i]


@register_jitable
def count_open(transitions: Transitions) -> int:
    """Number of actions that have a matrix."""
    open_ = 0
    for place in transitions.places:
        open_ += place != NOT_OPEN
    return open_


@inner_kernel
def place_of(transitions: Transitions, action: int, n: int, prior_frequency: float) -> int:
    """Where the action's matrix is; at its first use, one of ``n`` states without evidence."""
    if transitions.places[action] == NOT_OPEN:
        place = count_open(transitions)
        transitions.places[action] = place
        for i in range(n):
            forget_row(transitions, place, i, n, prior_frequency)
    return int(transitions.places[action])


@rare_kernel
def forget_row(
    transitions: Transitions, place: int, i: int, n: int, prior_frequency: float
) -> None:
    """Give a row of a matrix of ``n`` states the prior frequencies, which are all alike."""
    for j in range(n):
        transitions.matrices[place, i, j] = 1.0 / n
    transitions.origin_frequency[place, i] = n * prior_frequency


@rare_kernel
def expand(transitions: Transitions, new: int, n: int, prior_frequency: float) -> None:
    """Add a state to all matrices, ``n`` with it: its row and column of F are the prior frequency.

    Its index ``new`` is the last, or that of a state given up, whose column is 0.
    """
    for place in range(len(transitions.matrices)):
        matrix = transitions.matrices[place]
        origin_frequency = transitions.origin_frequency[place]
        for i in range(n):
            before = origin_frequency[i]
            origin_frequency[i] = before + prior_frequency
            kept = before / origin_frequency[i]
            for j in range(n):
                matrix[i, j] *= kept
            matrix[i, new] = prior_frequency / origin_frequency[i]
        forget_row(transitions, place, new, n, prior_frequency)


@rare_kernel
def merge_states(transitions: Transitions, kept: int, given: int, n: int) -> None:
    """Add the frequencies of transitions from and to a state to those of another one."""
    for place in range(len(transitions.matrices)):
        matrix = transitions.matrices[place]
        frequency = transitions.origin_frequency[place]
        together = frequency[kept] + frequency[given]
        share = frequency[given] / together if together > 0.0 else 0.0
        for j in range(n):
            matrix[kept, j] += share * (matrix[given, j] - matrix[kept, j])
            matrix[given, j] = 0.0
        frequency[kept], frequency[given] = together, 0.0
        for i in range(n):
            matrix[i, kept] += matrix[i, given]
            matrix[i, given] = 0.0


@rare_kernel
def retire_state(transitions: Transitions, given: int, n: int, prior_frequency: float) -> None:
    """Take the frequencies of transitions from and to a state away."""
    for place in range(len(transitions.matrices)):
        matrix = transitions.matrices[place]
        frequency = transitions.origin_frequency[place]
        frequency[given] = 0.0
        for i in range(n):
            kept = 1.0 - matrix[i, given]
            if kept <= _LEAST_KEPT:  # nothing else is known of where it leads
                forget_row(transitions, place, i, n, prior_frequency)
                kept = 1.0 - matrix[i, given]
            matrix[i, given] = 0.0
            frequency[i] *= kept
            for j in range(n):
                matrix[i, j] /= kept


@inner_kernel
def forecast_and_identify(
    transitions: Transitions,
    place: int,
    n: int,
    origin: NDArray[np.float64],
    reached: NDArray[np.float64],
    learning_rate: float,
    predicted: NDArray[np.float64],
    rates: NDArray[np.float64],
) -> None:
    """Forecast one step, ``origin @ P``, then learn the transition from ``origin`` to ``reached``.

    Both in one pass over the matrix, which is most of what a step costs. A row whose state was
    not believed in plays no part in either. ``rates`` is room to work in.
    """
    matrix = transitions.matrices[place]
    frequencies = transitions.origin_frequency[place]
    for i in range(lanes(n)):
        gain = learning_rate * origin[i]
        frequency = (1.0 - learning_rate) * frequencies[i] + gain
        known = frequency >= _LOWEST_FREQUENCY
        frequencies[i] = frequency if known else 0.0
        rates[i] = gain / frequency if known else 0.0
        predicted[i] = 0.0
    for i in range(n):
        believed, rate = origin[i], rates[i]
        if believed == 0.0:
            continue
        for j in range(lanes(n)):
            probability = matrix[i, j]
            predicted[j] = fma(believed, probability, predicted[j])
            matrix[i, j] = fma(rate, reached[j] - probability, probability)


def marginal(
    matrices: NDArray[np.float64],
    uses: NDArray[np.float64],
    n_actions: int,
    policy: Policy = "marginal",
) -> NDArray[np.float64]:
    """Average the matrices of all actions: each alike, or as often as it was used.

    Given are the (s, n, n) matrices of some actions and their (s,) uses; those of all others were
    never used, so that they hold 1 / n.
    """
    if policy not in ("marginal", "observed"):
        raise ValueError(f"policy is {policy!r}; an average is 'marginal' or 'observed'")
    if policy == "observed" and uses.sum() > 0.0:
        mixed: NDArray[np.float64] = np.tensordot(uses / uses.sum(), matrices, axes=1)
        return mixed
    unused = (n_actions - len(matrices)) / max(matrices.shape[-1], 1)
    average: NDArray[np.float64] = (matrices.sum(axis=0) + unused) / n_actions
    return average


def propagate(
    belief: NDArray[np.float64],
    matrix_of: Callable[[int], NDArray[np.float64]],
    averaged: Callable[[Policy], NDArray[np.float64]],
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
        belief = belief @ matrix_of(action)
        horizon -= 1
    if horizon > 0:
        then = matrix_of(action) if action is not None and policy == "hold" else averaged(policy)
        belief = belief @ np.linalg.matrix_power(then, horizon)
    return belief

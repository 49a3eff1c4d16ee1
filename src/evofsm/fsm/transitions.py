"""Identify, expand and use one transition matrix per action: the paper's Section 2.3.

The paper keeps joint frequencies F and origin frequencies F_o and divides them for P. Both decay at
every use, and in a long run both underflow to 0/0. Here P itself is kept, row by row, with F_o as
the weight of each row: the same in exact arithmetic, and never NaN::

    F_o' = (1 - phi) F_o + phi tau_i          P_i += (phi tau_i / F_o') (gamma - P_i)

Rows are "from" and columns "to", so a forecast is ``belief @ P``. (The paper prints the product the
other way round, with the same meaning of rows.)
"""

from __future__ import annotations

from evofsm.fsm.arrays import NO_ACTION, NOT_OPEN, Learnt, Settings
from evofsm.fsm.kernels import inner_kernel, kernel, lanes, spliced_kernel
from evofsm.fsm.validation import Floats

# A weight below this is taken as 0: smaller numbers turn denormal and slow every step.
_LOWEST_FREQUENCY = 1e-290


@kernel
def room_for(learnt: Learnt, settings: Settings) -> tuple[int, int]:
    """Numbers of states and of matrices with which the next step cannot lack room."""
    now, capacity, places = learnt.now[0], len(learnt.belief), len(learnt.matrices)
    if now.action != NO_ACTION and learnt.actions[now.action].place == NOT_OPEN:
        places = max(places, now.n_places + 1)
    if now.n_states == capacity and capacity < settings.max_states:
        capacity = lanes(capacity + max(capacity // 2, 1))
    return capacity, places


@inner_kernel
def place_of(learnt: Learnt, action: int, prior_frequency: float) -> int:
    """Where the action's matrix is; at its first use, one without evidence."""
    if learnt.actions[action].place == NOT_OPEN:
        learnt.actions[action].place = learnt.now[0].n_places
        learnt.now[0].n_places += 1
        n = learnt.now[0].n_states
        for i in range(n):
            forget_row(learnt, learnt.actions[action].place, i, n, prior_frequency)
    return int(learnt.actions[action].place)


@inner_kernel
def forecast_and_identify(
    matrix: Floats,
    origin_frequency: Floats,
    n: int,
    origin: Floats,
    reached: Floats,
    learning_rate: float,
    predicted: Floats,
) -> None:
    """Forecast one step, ``origin @ P``, then learn the transition from ``origin`` to ``reached``.

    Both in one pass over the matrix, which is most of what a step costs. A row whose state was
    not believed in plays no part in either.
    """
    for j in range(lanes(n)):
        predicted[j] = 0.0
    for i in range(n):
        believed = origin[i]
        gain = learning_rate * believed
        frequency = (1.0 - learning_rate) * origin_frequency[i] + gain
        known = frequency >= _LOWEST_FREQUENCY
        origin_frequency[i] = frequency if known else 0.0
        if believed > 0.0:
            rate = gain / frequency if known else 0.0
            for j in range(lanes(n)):
                probability = matrix[i, j]
                predicted[j] += believed * probability
                matrix[i, j] = (1.0 - rate) * probability + rate * reached[j]


@spliced_kernel
def forget_row(learnt: Learnt, place: int, i: int, n: int, prior_frequency: float) -> None:
    """Give a row of a matrix of ``n`` states the prior frequencies, which are all alike."""
    for j in range(n):
        learnt.matrices[place, i, j] = 1.0 / n
    learnt.origin_frequency[place, i] = n * prior_frequency


@spliced_kernel
def expand(learnt: Learnt, new: int, n: int, prior_frequency: float) -> None:
    """Add a state to all matrices, ``n`` with it: its row and column of F are the prior frequency.

    Its index ``new`` is the last, or that of a state merged into another, whose column is 0.
    """
    for place in range(learnt.now[0].n_places):
        matrix, origin_frequency = learnt.matrices[place], learnt.origin_frequency[place]
        for i in range(n):
            before = origin_frequency[i]
            origin_frequency[i] = before + prior_frequency
            for j in range(n):
                matrix[i, j] *= before / origin_frequency[i]
            matrix[i, new] = prior_frequency / origin_frequency[i]
        forget_row(learnt, place, new, n, prior_frequency)


@spliced_kernel
def merge_states(learnt: Learnt, kept: int, given: int, n: int) -> None:
    """Add the frequencies of transitions from and to a state to those of another one."""
    for place in range(learnt.now[0].n_places):
        matrix, frequency = learnt.matrices[place], learnt.origin_frequency[place]
        together = frequency[kept] + frequency[given]
        share = frequency[given] / together if together > 0.0 else 0.0
        for j in range(n):
            matrix[kept, j] += share * (matrix[given, j] - matrix[kept, j])
            matrix[given, j] = 0.0
        frequency[kept], frequency[given] = together, 0.0
        for i in range(n):
            matrix[i, kept] += matrix[i, given]
            matrix[i, given] = 0.0

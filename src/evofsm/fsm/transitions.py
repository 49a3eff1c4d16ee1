"""Identify, expand and use one transition matrix per action: the paper's Section 2.3.

The paper keeps joint frequencies F and origin frequencies F_o and divides them for P. Both
decay at every use, and in a long run both underflow to 0/0. Here P itself is kept, row by row,
with F_o as the weight of each row: the same in exact arithmetic, and never NaN::

    F_o' = (1 - phi) F_o + phi tau_i          P_i += (phi tau_i / F_o') (gamma - P_i)

Rows are "from" and columns "to", so a forecast is ``belief @ P``. (The paper prints the product
the other way round, with the same meaning of rows.)
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from evofsm.fsm.elementary import fma, total, work_on_line, work_on_two_lines
from evofsm.fsm.kernels import LINE, inner_kernel, lanes, rare_kernel
from evofsm.fsm.learnt import NOT_OPEN, SMALLEST_SCALE, Outcomes, Transitions

# A weight below this is taken as 0: smaller numbers turn denormal and slow every step.
_LOWEST_FREQUENCY = 1e-290
# A row that moves farther at once is worked on as a whole.
_MOST_BY_SCALE = 0.5
# A row with less left of it than this is rounding: scaled up it would no longer sum to 1.
_LEAST_KEPT = 1e-9


@inner_kernel
def count(counts: NDArray[np.float64], belief: NDArray[np.float64], n: int) -> None:
    """Count one event, shared out over the first ``n`` states by belief."""
    for i in range(n):
        counts[i] += belief[i]


@inner_kernel
def tick(outcomes: Outcomes, begins: bool) -> None:
    """Count an observation, with which an episode may begin."""
    outcomes.clock[0] += 1.0
    if begins:
        outcomes.began[0] = outcomes.clock[0]


@inner_kernel
def count_visit(outcomes: Outcomes, state: int) -> None:
    """Count that the present episode is in a state; once for each episode."""
    if outcomes.latest_visit[state] < outcomes.began[0]:
        outcomes.episodes[state] += 1.0
    outcomes.latest_visit[state] = outcomes.clock[0]


@inner_kernel
def count_try(outcomes: Outcomes, place: int, state: int) -> None:
    """Count that the present episode took an action in a state; once for each episode."""
    if outcomes.latest_try[place, state] < outcomes.began[0]:
        outcomes.tried[place, state] += 1.0
    outcomes.latest_try[place, state] = outcomes.clock[0]


@rare_kernel
def count_failure(outcomes: Outcomes, n: int, horizon: float) -> None:
    """The present episode failed: so did all that it did within the horizon before."""
    since = max(outcomes.began[0], outcomes.clock[0] - horizon)
    for i in range(n):
        outcomes.failed_soon[i] += outcomes.latest_visit[i] >= since
    for place in range(len(outcomes.tried)):
        for i in range(n):
            outcomes.failed_after[place, i] += outcomes.latest_try[place, i] >= since


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
    transitions.scales[place, i] = 1.0
    transitions.origin_frequency[place, i] = n * prior_frequency


@rare_kernel
def multiply_out(transitions: Transitions, place: int, i: int, n: int) -> None:
    """Store a row as it is, with a scale of 1."""
    for j in range(lanes(n)):
        transitions.matrices[place, i, j] *= transitions.scales[place, i]
    transitions.scales[place, i] = 1.0


@inner_kernel
def fade_row(transitions: Transitions, place: int, i: int, n: int, kept: float) -> None:
    """Multiply a row by ``kept``."""
    transitions.scales[place, i] *= kept
    if transitions.scales[place, i] < SMALLEST_SCALE:
        multiply_out(transitions, place, i, n)


@rare_kernel
def expand(transitions: Transitions, new: int, n: int, prior_frequency: float) -> None:
    """Add a state to all matrices, ``n`` with it: its row and column of F are the prior frequency.

    Its index ``new`` is the last, or that of a state given up, whose column is 0.
    """
    for place in range(len(transitions.matrices)):
        matrix, scale = transitions.matrices[place], transitions.scales[place]
        origin_frequency = transitions.origin_frequency[place]
        for i in range(n):
            before = origin_frequency[i]
            origin_frequency[i] = before + prior_frequency
            fade_row(transitions, place, i, n, before / origin_frequency[i])
            matrix[i, new] = prior_frequency / origin_frequency[i] / scale[i]
        forget_row(transitions, place, new, n, prior_frequency)


@rare_kernel
def merge_states(transitions: Transitions, kept: int, given: int, n: int) -> None:
    """Add the frequencies of transitions from and to a state to those of another one."""
    for place in range(len(transitions.matrices)):
        matrix = transitions.matrices[place]
        frequency = transitions.origin_frequency[place]
        multiply_out(transitions, place, kept, n)
        multiply_out(transitions, place, given, n)
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
            multiply_out(transitions, place, i, n)
            kept = 1.0 - matrix[i, given]
            if kept <= _LEAST_KEPT:  # nothing else is known of where it leads
                forget_row(transitions, place, i, n, prior_frequency)
                kept = 1.0 - matrix[i, given]
            matrix[i, given] = 0.0
            frequency[i] *= kept
            for j in range(n):
                matrix[i, j] /= kept


@inner_kernel
def forecast(
    transitions: Transitions,
    place: int,
    n: int,
    belief: NDArray[np.float64],
    predicted: NDArray[np.float64],
) -> None:
    """One step ahead: ``belief @ P``."""
    for j in range(lanes(n)):
        predicted[j] = 0.0
    for i in range(n):
        believed = belief[i] * transitions.scales[place, i]
        if believed > 0.0:
            for j in range(lanes(n)):
                predicted[j] = fma(believed, transitions.matrices[place, i, j], predicted[j])


@inner_kernel
def _set_rates(
    transitions: Transitions,
    place: int,
    n: int,
    origin: NDArray[np.float64],
    learning_rate: float,
    rates: NDArray[np.float64],
    predicted: NDArray[np.float64],
) -> None:
    """How far each row moves; its frequency decays and grows, and the forecast starts from 0."""
    frequencies = transitions.origin_frequency[place]
    for i in range(lanes(n)):
        gain = learning_rate * origin[i]
        frequency = (1.0 - learning_rate) * frequencies[i] + gain
        known = frequency >= _LOWEST_FREQUENCY
        frequencies[i] = frequency if known else 0.0
        rates[i] = gain / frequency if known else 0.0
        predicted[i] = 0.0


@inner_kernel
def forecast_and_identify(
    transitions: Transitions,
    place: int,
    n: int,
    origin: NDArray[np.float64],
    reached: NDArray[np.float64],
    learning_rate: float,
    by_lines: bool,
    predicted: NDArray[np.float64],
    rates: NDArray[np.float64],
    lines: NDArray[np.float64],
) -> float:
    """Forecast one step, ``origin @ P``, then learn the transition from ``origin`` to ``reached``.

    Both in one pass over the matrix, which is most of what a step costs. A row whose state was
    not believed in plays no part in either.

    ``by_lines``, where few states are reached, only the lines with their columns are touched, and
    the others decay by the scale of their row; the forecast is then written for those columns
    alone. Returns how much of it is missing. ``rates`` and ``lines`` are room to work in.
    """
    _set_rates(transitions, place, n, origin, learning_rate, rates, predicted)
    if by_lines:
        n_lines = _lines_above_0(reached, n, lines)
        for i in range(n):
            if origin[i] == 0.0:
                continue
            if rates[i] < _MOST_BY_SCALE:
                _by_lines(
                    transitions, place, i, n, origin, reached, rates, predicted, lines, n_lines
                )
            else:
                _whole_row(transitions, place, i, n, origin, reached, rates, predicted)
        return max(1.0 - total(predicted, lanes(n)), 0.0)
    for i in range(0, n - 1, 2):
        _two_rows(transitions, place, i, n, origin, reached, rates, predicted)
    if n % 2 == 1:
        _whole_row(transitions, place, n - 1, n, origin, reached, rates, predicted)
    return 0.0


@inner_kernel
def _whole_row(
    transitions: Transitions,
    place: int,
    i: int,
    n: int,
    origin: NDArray[np.float64],
    reached: NDArray[np.float64],
    rates: NDArray[np.float64],
    predicted: NDArray[np.float64],
) -> None:
    matrix, scale = transitions.matrices[place], transitions.scales[place, i]
    transitions.scales[place, i] = 1.0
    believed, kept = origin[i] * scale, (1.0 - rates[i]) * scale
    for j in range(0, n, LINE):
        work_on_line(matrix, i, j, predicted, reached, believed, kept, rates[i])


@inner_kernel
def _two_rows(
    transitions: Transitions,
    place: int,
    i: int,
    n: int,
    origin: NDArray[np.float64],
    reached: NDArray[np.float64],
    rates: NDArray[np.float64],
    predicted: NDArray[np.float64],
) -> None:
    """`_whole_row` for i and the next one: what both read and add to is loaded once."""
    matrix, scales = transitions.matrices[place], transitions.scales[place]
    gain, believed, kept = rates[i], origin[i] * scales[i], (1.0 - rates[i]) * scales[i]
    k = i + 1
    gain_k, believed_k, kept_k = rates[k], origin[k] * scales[k], (1.0 - rates[k]) * scales[k]
    scales[i] = scales[k] = 1.0
    for j in range(0, n, LINE):
        work_on_two_lines(
            matrix, i, j, predicted, reached, believed, kept, gain, believed_k, kept_k, gain_k
        )


@inner_kernel
def _by_lines(
    transitions: Transitions,
    place: int,
    i: int,
    n: int,
    origin: NDArray[np.float64],
    reached: NDArray[np.float64],
    rates: NDArray[np.float64],
    predicted: NDArray[np.float64],
    lines: NDArray[np.float64],
    n_lines: int,
) -> None:
    """A row of which only some lines are touched."""
    matrix, rate = transitions.matrices[place], rates[i]
    fade_row(transitions, place, i, n, 1.0 - rate)
    scale = transitions.scales[place, i]
    believed, gain = origin[i] * scale / (1.0 - rate), rate / scale
    for k in range(n_lines):
        work_on_line(matrix, i, int(lines[k]), predicted, reached, believed, 1.0, gain)


@inner_kernel
def _lines_above_0(values: NDArray[np.float64], n: int, lines: NDArray[np.float64]) -> int:
    """Write where the lines begin that hold anything above 0; returns how many there are."""
    found = 0
    for begin in range(0, n, LINE):
        largest_there = 0.0
        for i in range(begin, begin + LINE):
            largest_there = max(largest_there, values[i])
        lines[found] = begin
        found += largest_there > 0.0
    return found

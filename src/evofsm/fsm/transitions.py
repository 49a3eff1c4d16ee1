"""Identify, expand and use one transition matrix per action: the paper's Section 2.3.

The paper keeps joint frequencies F and origin frequencies F_o and divides them for P. Both decay at
every use, and in a long run both underflow to 0/0. Here P itself is kept, row by row, with F_o as
the weight of each row: the same in exact arithmetic, and never NaN::

    F_o' = (1 - phi) F_o + phi tau_i          P_i += (phi tau_i / F_o') (gamma - P_i)

Rows are "from" and columns "to", so a forecast is ``belief @ P``. (The paper prints the product the
other way round, with the same meaning of rows.)
"""

from __future__ import annotations

from typing import Any

from evofsm.fsm.arrays import EPISODES, NO_ACTION, NOT_OPEN, VISITS, Learnt, Settings
from evofsm.fsm.clusters import measure_distances, nearest_center
from evofsm.fsm.kernels import inner_kernel, kernel, lanes, rare_kernel, spliced_kernel
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
    learnt: Learnt, settings: Settings, place: int, n: int, reached: Floats, predicted: Floats
) -> None:
    """Forecast one step, ``belief @ P``, then learn the transition from there to ``reached``.

    Both in one pass over the matrix, which is most of what a step costs. A row whose state was
    not believed in plays no part in either.
    """
    matrix, origin_frequency = learnt.matrices[place], learnt.origin_frequency[place]
    learning_rate = settings.learning_rate
    for j in range(lanes(n)):
        predicted[j] = 0.0
    for i in range(n):
        belief = learnt.belief[i]
        gain = learning_rate * belief
        frequency = (1.0 - learning_rate) * origin_frequency[i] + gain
        is_known = frequency >= _LOWEST_FREQUENCY
        origin_frequency[i] = frequency if is_known else 0.0
        if belief > 0.0:
            rate = gain / frequency if is_known else 0.0
            for j in range(lanes(n)):
                probability = matrix[i, j]
                predicted[j] += belief * probability
                matrix[i, j] = (1.0 - rate) * probability + rate * reached[j]


@rare_kernel  # within the kernel of every step it costs a fifth of a step with 64 states
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


@rare_kernel
def merge_closest(learnt: Learnt, settings: Settings, nearest: int) -> Any:
    """Merge the two closest of all n states and the newcomer; returns the index that is free.

    That index goes to the new state, so that no other changes. The newcomer is the latest
    observation, closest to the centre ``nearest``. Where it is one of the two, n is returned.
    """
    n, weights, far = learnt.now[0].n_states, settings.weights, learnt.squared_distances
    closest, survivor, donor = far[nearest], nearest, n
    for i in range(1, n):
        measure_distances(learnt.centers, weights, i, learnt.centers[:, i], far)
        j = nearest_center(far, i)
        if far[j] < closest:
            closest, survivor, donor = far[j], j, i
    if donor < n:
        _merge(learnt, weights, survivor, donor, n)
    # The latest observation again, from centres of which one may have moved.
    measure_distances(learnt.centers, weights, n, learnt.variables["latest"], far)
    return donor


@rare_kernel
def _merge(learnt: Learnt, weights: Floats, kept: int, given: int, n: int) -> None:
    """Move what was learnt of a state to another, whose centre moves between theirs, by visits."""
    now, sums, a, b = learnt.now[0], learnt.sums, learnt.states[kept], learnt.states[given]
    share = sums[VISITS, given] / max(sums[VISITS, kept] + sums[VISITS, given], 1.0)
    for k in range(len(weights)):
        center = learnt.centers[k]
        center[kept] += share * (center[given] - center[kept])
    for i in range(n):
        learnt.changes[kept, i] += learnt.changes[given, i]
        learnt.changes[given, i] = 0.0
    for i in range(n):
        learnt.changes[i, kept] += learnt.changes[i, given]
        learnt.changes[i, given] = 0.0
    # Of the present episode it is known that it came to both; of those before it is not.
    sums[EPISODES, kept] -= a.latest_visit >= now.began and b.latest_visit >= now.began
    for k in range(len(sums)):
        sums[k, kept] += sums[k, given]
        sums[k, given] = 0.0
    a.latest_visit = max(a.latest_visit, b.latest_visit)
    a.joined, b.joined, b.latest_visit = 1.0, 0.0, 0.0
    learnt.potentials[kept] = max(learnt.potentials[kept], learnt.potentials[given])
    learnt.belief[kept] += learnt.belief[given]
    learnt.belief[given] = learnt.potentials[given] = 0.0
    for place in range(now.n_places):
        _merge_actions(learnt, place, kept, given, n)
    now.state = kept if now.state == given else now.state


@spliced_kernel
def _merge_actions(learnt: Learnt, place: int, kept: int, given: int, n: int) -> None:
    """Move the transitions from and to a state by one action, and its counts, to another state."""
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
    for counts in (learnt.decisions[place], learnt.failures[place]):
        counts[kept] += counts[given]
        counts[given] = 0.0
    now, record, addition = learnt.now[0], learnt.tries[place, kept], learnt.tries[place, given]
    in_both = record.latest_try >= now.began and addition.latest_try >= now.began
    record.tried += addition.tried - in_both
    record.failed_after += addition.failed_after
    record.latest_try = max(record.latest_try, addition.latest_try)
    addition.tried = addition.failed_after = addition.latest_try = 0.0

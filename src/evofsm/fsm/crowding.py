"""What happens where a state is created and there are as many as allowed: one is given up.

Its index goes to the new state, so that no other index changes; `state_ids` tell the two apart.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.kernels import inner_kernel, rare_kernel
from evofsm.fsm.layout import joined_by
from evofsm.fsm.learnt import NOT_OPEN
from evofsm.fsm.memory import Memory
from evofsm.fsm.states.clusters import measure_distances
from evofsm.fsm.transitions import merge_states, retire_state

# What may happen besides what `evofsm.fsm.states.clusters` knows.
MERGED: int = 4
RETIRED: int = 8
# Returned instead of an index where the new state itself is left out.
NEWCOMER = -1
# Numbers of the arrays that are joined by their sum, and by the larger of both.
_SUMMED_STATES, _LARGER_STATES = joined_by("sum", "state"), joined_by("most", "state")
_SUMMED_PLACES, _LARGER_PLACES = joined_by("sum", "place"), joined_by("most", "place")


class WhenFull(IntEnum):
    """Which state is given up where ``max_states`` exist and another one is created.

    ``MERGE`` joins the two whose centres are closest, the newcomer among them: evidence is added
    up, and the centre lies between theirs, by visits. If the newcomer is one of the two, it is
    left out, and the other one stays where it is.

    ``RETIRE`` gives up the least useful one, with all that was learnt of it: the one visited for
    the smallest share of the time since it was created (the utility of Angelov and Filev's
    simpl_eTS, 2005). The present state is kept, and so are those in which failures ended while
    there are others.

    Examples
    --------
    >>> from evofsm import EvolvingFSM, Novelty
    >>> Z, I = [[0.0], [4.0], [9.0]], [0, 0, 0]
    >>> machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=1.0), max_states=2)
    >>> machine.learn_many(Z, I).event, machine.centers.ravel()
    (array([2, 2, 6], dtype=int8), array([2., 9.]))
    >>> machine = EvolvingFSM(
    ...     n_actions=1, rule=Novelty(radius=1.0), max_states=2, when_full=WhenFull.RETIRE
    ... )
    >>> machine.learn_many(Z, I).event, machine.centers.ravel()
    (array([ 2,  2, 10], dtype=int8), array([9., 4.]))
    """

    MERGE = 0
    RETIRE = 1


# For kernels, in which a member of an enumeration is no number.
RETIRE = int(WhenFull.RETIRE)


@rare_kernel
def merge_closest(memory: Memory, n: int, nearest: int) -> int:
    """Merge the two closest of ``n`` states and the newcomer; returns the index that is free.

    The newcomer is the latest observation, and ``nearest`` the centre closest to it.
    """
    now, weights = memory.learnt, memory.parameters.rule.weights
    clusters = now.clusters
    closest = clusters.squared_distances[nearest]
    kept, given = nearest, NEWCOMER
    for i in range(n):
        for j in range(i):
            squared_distance = 0.0
            for k in range(len(weights)):
                offset = (clusters.centers[k, i] - clusters.centers[k, j]) * weights[k]
                squared_distance += offset * offset
            if squared_distance < closest:
                closest, kept, given = squared_distance, j, i
    if given != NEWCOMER:
        _merge(memory, kept, given, n)
    return given


@rare_kernel
def _merge(memory: Memory, kept: int, given: int, n: int) -> None:
    now = memory.learnt
    clusters, counted = now.clusters, now.outcomes
    share = counted.visits[given] / max(counted.visits[kept] + counted.visits[given], 1.0)
    for k in range(len(clusters.centers)):
        center = clusters.centers[k]
        center[kept] += share * (center[given] - center[kept])
    merge_states(now.transitions, kept, given, n)
    for i in range(n):
        counted.changes[kept, i] += counted.changes[given, i]
    for i in range(n):
        counted.changes[i, kept] += counted.changes[i, given]
    # Of the present episode it is known that it came to both; of those before it is not.
    counted.episodes[kept] -= _both(counted.latest_visit, kept, given, counted.began[0])
    for place in range(len(counted.tried)):
        latest = counted.latest_try[place]
        counted.tried[place, kept] -= _both(latest, kept, given, counted.began[0])
        _join(memory.per_place[:, place], _SUMMED_PLACES, _LARGER_PLACES, kept, given)
    _join(memory.per_state, _SUMMED_STATES, _LARGER_STATES, kept, given)
    counted.joined[kept] = 1.0
    if now.state[0] == given:
        now.state[0] = kept
    if now.before[0] == given:
        now.before[0] = kept
    _clear(memory, given, n)
    measure_distances(
        clusters.centers,
        memory.parameters.rule.weights,
        n,
        clusters.latest,
        clusters.squared_distances,
    )


@inner_kernel
def _both(latest: NDArray[np.float64], kept: int, given: int, began: float) -> bool:
    return bool(latest[kept] >= began and latest[given] >= began)


@rare_kernel
def _join(
    arrays: NDArray[np.float64],
    summed: tuple[int, ...],
    larger: tuple[int, ...],
    kept: int,
    given: int,
) -> None:
    """Give what the table says of one state to another: arrays (all of a kind, capacity)."""
    for number in summed:
        arrays[number, kept] += arrays[number, given]
    for number in larger:
        arrays[number, kept] = max(arrays[number, kept], arrays[number, given])


@rare_kernel
def retire_least_useful(memory: Memory, n: int) -> int:
    """Give up one of ``n`` states; returns its index."""
    now, counted = memory.learnt, memory.learnt.outcomes
    given, least, failed = NEWCOMER, 0.0, True
    for i in range(n):
        utility = counted.visits[i] / (now.clusters.n_observations[0] - counted.founded[i] + 1.0)
        ended = counted.endings[i] > 0.0
        if i != now.state[0] and (
            given == NEWCOMER or (failed and not ended) or (failed == ended and utility < least)
        ):
            given, least, failed = i, utility, ended
    if given != NEWCOMER:
        retire_state(now.transitions, given, n, memory.parameters.prior_frequency)
        kept = 1.0 - now.belief[given]
        now.belief[given] = 0.0
        for i in range(n):
            now.belief[i] /= kept
        if now.before[0] == given:
            now.before[0] = NOT_OPEN
        _clear(memory, given, n)
    return given


@rare_kernel
def _clear(memory: Memory, given: int, n: int) -> None:
    """Make an index as good as new."""
    changes = memory.learnt.outcomes.changes
    for i in range(n):
        changes[given, i] = 0.0
        changes[i, given] = 0.0
    for number in _SUMMED_STATES + _LARGER_STATES:
        memory.per_state[number, given] = 0.0
    for number in _SUMMED_PLACES + _LARGER_PLACES:
        for place in range(memory.per_place.shape[1]):
            memory.per_place[number, place, given] = 0.0

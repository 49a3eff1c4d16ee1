"""What happens where a state is founded and there are as many as allowed: one is given up.

Its index goes to the new state, so that no other index changes; `state_ids` tell the two apart.
"""

from __future__ import annotations

from enum import IntEnum

from evofsm.core.kernels import rare_kernel
from evofsm.core.memory import Memory
from evofsm.core.states.clusters import measure_distances
from evofsm.core.transitions import Outcomes, merge_episodes, merge_states, retire_state

# What may happen besides what `evofsm.core.states.clusters` knows.
MERGED: int = 4
RETIRED: int = 8
# Stands for the newcomer where it is itself given up.
NEWCOMER = -1


class WhenFull(IntEnum):
    """Which state is given up where ``max_states`` exist and another one is founded.

    ``MERGE`` joins the two whose centres are closest, the newcomer among them: evidence is added
    up, and the centre lies between theirs, by visits. If the newcomer is one of the two, it is
    left out, and the other one stays where it is.

    ``RETIRE`` gives up the least useful one, with all that was learnt of it: the one visited for
    the smallest share of the time since it was founded (the utility of Angelov and Filev's
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
    """Merge the two closest of ``n`` states and the newcomer; answers the index that is free.

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
    clusters = now.clusters
    share = now.visits[given] / max(now.visits[kept] + now.visits[given], 1.0)
    for k in range(len(clusters.centers)):
        center = clusters.centers[k]
        center[kept] += share * (center[given] - center[kept])
    clusters.potentials[kept] = max(clusters.potentials[kept], clusters.potentials[given])
    merge_states(now.transitions, kept, given, n)
    for i in range(n):
        now.changes[kept, i] += now.changes[given, i]
    for i in range(n):
        now.changes[i, kept] += now.changes[i, given]
    _merge_outcomes(now.outcomes, kept, given)
    now.visits[kept] += now.visits[given]
    now.belief[kept] += now.belief[given]
    if now.state[0] == given:
        now.state[0] = kept
    _clear(memory, given, n)
    measure_distances(
        clusters.centers,
        memory.parameters.rule.weights,
        n,
        clusters.latest,
        clusters.squared_distances,
    )


@rare_kernel
def _merge_outcomes(outcomes: Outcomes, kept: int, given: int) -> None:
    began = outcomes.began[0]
    for place in range(len(outcomes.decisions)):
        outcomes.decisions[place, kept] += outcomes.decisions[place, given]
        outcomes.failures[place, kept] += outcomes.failures[place, given]
        tried, latest = outcomes.tried[place], outcomes.latest_try[place]
        merge_episodes(tried, outcomes.failed_after[place], latest, kept, given, began)
    episodes, latest_visit = outcomes.episodes, outcomes.latest_visit
    merge_episodes(episodes, outcomes.failed_soon, latest_visit, kept, given, began)
    outcomes.joined[kept] = 1.0
    outcomes.endings[kept] += outcomes.endings[given]


@rare_kernel
def retire_least_useful(memory: Memory, n: int) -> int:
    """Give up one of ``n`` states; answers its index."""
    now = memory.learnt
    given, least, failed = NEWCOMER, 0.0, True
    for i in range(n):
        utility = now.visits[i] / (now.clusters.n_observations[0] - now.founded[i] + 1.0)
        ended = now.outcomes.endings[i] > 0.0
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
        _clear(memory, given, n)
    return given


@rare_kernel
def _clear(memory: Memory, given: int, n: int) -> None:
    """Make an index as good as new."""
    now = memory.learnt
    for i in range(n):
        now.changes[given, i] = 0.0
        now.changes[i, given] = 0.0
    outcomes = now.outcomes
    for of_places in (
        outcomes.decisions,
        outcomes.failures,
        outcomes.tried,
        outcomes.failed_after,
        outcomes.latest_try,
    ):
        for place in range(len(of_places)):
            of_places[place, given] = 0.0
    for of_states in (
        outcomes.endings,
        outcomes.episodes,
        outcomes.failed_soon,
        outcomes.latest_visit,
        outcomes.joined,
    ):
        of_states[given] = 0.0
    now.visits[given] = 0.0
    now.belief[given] = 0.0

"""The state limit: where a state is created and there are as many as allowed, two are merged.

The index that becomes free goes to the new state, so that no other index changes; `state_ids` tell
the two apart.
"""

from __future__ import annotations

from typing import Any

from evofsm.fsm.arrays import EPISODES, VISITS, Learnt, Settings
from evofsm.fsm.kernels import rare_kernel, spliced_kernel
from evofsm.fsm.transitions import merge_states
from evofsm.fsm.validation import Floats

# What may happen besides what `evofsm.fsm.clusters` knows.
MERGED: int = 4


@rare_kernel
def merge_closest(learnt: Learnt, settings: Settings, nearest: int) -> Any:
    """Merge the two closest of all n states and the newcomer; returns the index that is free.

    The newcomer is the latest observation, and ``nearest`` the centre closest to it. Where it is
    one of the two, that is n: it is left out.
    """
    n, weights = learnt.now[0].n_states, settings.weights
    closest = learnt.squared_distances[nearest]
    kept, given = nearest, n
    for i in range(n):
        for j in range(i):
            squared_distance = 0.0
            for k in range(len(weights)):
                offset = (learnt.centers[k, i] - learnt.centers[k, j]) * weights[k]
                squared_distance += offset * offset
            if squared_distance < closest:
                closest, kept, given = squared_distance, j, i
    if given < n:
        _merge(learnt, weights, kept, given, n)
    return given


@rare_kernel
def _merge(learnt: Learnt, weights: Floats, kept: int, given: int, n: int) -> None:
    """Add what was learnt of a state to another, whose centre moves between theirs, by visits."""
    now, sums, one, other = learnt.now[0], learnt.sums, learnt.states[kept], learnt.states[given]
    share = sums[VISITS, given] / max(sums[VISITS, kept] + sums[VISITS, given], 1.0)
    for k in range(len(weights)):
        center = learnt.centers[k]
        center[kept] += share * (center[given] - center[kept])
    merge_states(learnt, kept, given, n)
    for i in range(n):
        learnt.changes[kept, i] += learnt.changes[given, i]
    for i in range(n):
        learnt.changes[i, kept] += learnt.changes[i, given]
    # Of the present episode it is known that it came to both; of those before it is not.
    sums[EPISODES, kept] -= one.latest_visit >= now.began and other.latest_visit >= now.began
    for k in range(len(sums)):
        sums[k, kept] += sums[k, given]
    one.latest_visit = max(one.latest_visit, other.latest_visit)
    one.joined = 1.0
    learnt.potentials[kept] = max(learnt.potentials[kept], learnt.potentials[given])
    learnt.belief[kept] += learnt.belief[given]
    for place in range(now.n_places):
        learnt.decisions[place, kept] += learnt.decisions[place, given]
        learnt.failures[place, kept] += learnt.failures[place, given]
        done, more = learnt.tries[place, kept], learnt.tries[place, given]
        both = done.latest_try >= now.began and more.latest_try >= now.began
        done.tried += more.tried - both
        done.failed_after += more.failed_after
        done.latest_try = max(done.latest_try, more.latest_try)
    now.state = kept if now.state == given else now.state
    now.before = kept if now.before == given else now.before
    _forget(learnt, given, n)
    # The latest observation, from centres of which one has moved.
    for i in range(n):
        squared_distance = 0.0
        for k in range(len(weights)):
            offset = (learnt.variables[k].latest - learnt.centers[k, i]) * weights[k]
            squared_distance += offset * offset
        learnt.squared_distances[i] = squared_distance


@spliced_kernel
def _forget(learnt: Learnt, given: int, n: int) -> None:
    """Make an index as good as new."""
    learnt.states[given].joined = learnt.states[given].latest_visit = 0.0
    for k in range(len(learnt.sums)):
        learnt.sums[k, given] = 0.0
    learnt.belief[given] = learnt.potentials[given] = 0.0
    for i in range(n):
        learnt.changes[given, i] = learnt.changes[i, given] = 0.0
    for place in range(learnt.now[0].n_places):
        learnt.decisions[place, given] = learnt.failures[place, given] = 0.0
        done = learnt.tries[place, given]
        done.tried = done.failed_after = done.latest_try = 0.0

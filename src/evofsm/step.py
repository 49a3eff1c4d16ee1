"""One observation through the machine: the paper's Section 2 on one screen.

An observation may found a state (`states.ets`), is recognised as a distribution over states
(`states.spread`), and, where an action was taken after the observation before it, teaches that
action's transition matrix (`transitions`).
"""

from __future__ import annotations

from enum import IntFlag
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm._compile import kernel
from evofsm.divergence import jensen_shannon_kernel
from evofsm.memory import NO_ACTION, Memory, open_memory
from evofsm.states import ets, spread
from evofsm.transitions import expand, forecast, identify
from evofsm.validation import LARGEST_OBSERVATION

# What `step` answers instead of an event where it did nothing.
FULL, REFUSED = -1, -2


class Event(IntFlag):
    """What an observation did to the states (the paper's Section 2.2.1).

    ``NONE`` left them as they were, ``MOVED`` put the nearest one on the observation, and
    ``CREATED`` founded a new one there.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=1)
    >>> machine.observe([0.0]).event is Event.CREATED
    True
    >>> Event(machine.learn_many([[0.0], [0.1]], [0, 0]).event[1])
    <Event.NONE: 0>
    """

    NONE = ets.UNCHANGED
    MOVED = ets.MOVED
    CREATED = ets.CREATED


#: By value: looking one up is quicker than making one.
EVENTS = (Event.NONE, Event.MOVED, Event.CREATED)


class Step(NamedTuple):
    """What the machine made of one observation; n states exist after it.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=1)
    >>> step = machine.learn_one([0.0], 0)
    >>> step.state, step.event.name, len(step.predicted), step.surprise
    (0, 'CREATED', 0, nan)
    >>> machine.observe([0.1]).predicted
    array([1.])
    """

    state: int  #: index of the most probable state
    belief: NDArray[np.float64]  #: (n,) distribution over states
    event: Event  #: what happened to the states
    predicted: NDArray[np.float64]  #: (n,) forecast made one step before; empty where none was
    surprise: float  #: divergence of `predicted` and `belief` [bit]; NaN where none was


class Trace(NamedTuple):
    """What the machine made of T observations, a row each; n states exist after the last.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0], belief=True)
    >>> trace.state, trace.surprise.round(2)
    (array([0, 0, 0, 1]), array([ nan, 0. , 0. , 0.31]))
    >>> trace.belief.round(2)
    array([[1.  , 0.  ], [1.  , 0.  ], [1.  , 0.  ], [0.37, 0.63]])
    """

    state: NDArray[np.int64]  #: (T,) index of the most probable state
    n_states: NDArray[np.int64]  #: (T,) number of states after the row
    event: NDArray[np.int8]  #: (T,) values of `Event`
    surprise: NDArray[np.float64]  #: (T,) [bit], NaN where nothing was predicted
    belief: NDArray[np.float64] | None = None  #: (T, n), 0 for states not yet founded


def widen(belief: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """Beliefs (..., n) over n states, 0 for those founded since."""
    missing = n - belief.shape[-1]
    return np.pad(belief, [(0, 0)] * (belief.ndim - 1) + [(0, missing)]) if missing else belief


@kernel
def step(memory: Memory) -> tuple[int, int, float]:
    """Take in the observation in ``memory.scratch``; answers event, state and surprise."""
    parameters, now, scratch = memory.parameters, memory.learnt, memory.scratch
    n = int(now.n_states[0])
    if n == len(now.belief):
        return FULL, 0, np.nan
    if len(scratch.observation) == 0:
        return REFUSED, 0, np.nan
    for value in scratch.observation:
        if not abs(value) <= LARGEST_OBSERVATION:  # also true of NaN
            return REFUSED, 0, np.nan

    # Section 2.2.1: does the observation move a state, or found one?
    event = ets.determine(
        now.clusters, n, scratch.observation, parameters.radius, parameters.distance_weight
    )
    if event == ets.CREATED:
        expand(now.transitions, n, parameters.prior_frequency)
        now.founded[n] = now.clusters.n_observations[0]
        n += 1

    # Section 2.2.2: which state is this?
    width = parameters.spread * ets.total_variance(now.clusters)
    state = spread.recognise(now.clusters.squared_distances, n, width, scratch.recognised)

    # Section 2.3: was it foreseen, and what does it teach about the action taken before it?
    surprise = np.nan
    action = int(now.action[0])
    if now.chained[0] and action != NO_ACTION:
        forecast(now.transitions, action, n, now.belief, scratch.predicted)
        surprise = jensen_shannon_kernel(scratch.predicted, scratch.recognised, n)
        identify(
            now.transitions, action, n, now.belief, scratch.recognised, parameters.learning_rate
        )

    if now.chained[0]:
        now.changes[int(now.state[0]), state] += 1.0
    for i in range(n):
        now.belief[i] = scratch.recognised[i]
    now.state[0] = state
    now.visits[state] += 1.0
    now.n_states[0] = n
    now.action[0] = NO_ACTION
    now.chained[0] = 1.0
    return event, state, surprise


@kernel
def observe(buffer: NDArray[np.float64]) -> tuple[int, int, float]:
    """`step`, with the whole machine in a single argument."""
    return step(open_memory(buffer))


@kernel
def learn_rows(
    buffer: NDArray[np.float64],
    observations: NDArray[np.float64],
    actions: NDArray[np.int64],
    starts: NDArray[np.bool_],
    row: int,
    trace: Trace,
    beliefs: NDArray[np.float64],
) -> int:
    """Step through the rows from ``row`` on; answers where it stopped for want of room.

    ``beliefs`` is (T, capacity), or empty where nobody wants them.
    """
    memory = open_memory(buffer)
    now = memory.learnt
    while row < len(observations):
        if starts[row]:
            now.chained[0] = 0.0
        for j in range(observations.shape[1]):
            memory.scratch.observation[j] = observations[row, j]
        event, state, surprise = step(memory)
        if event == FULL:
            break
        now.action[0] = actions[row]
        n = int(now.n_states[0])
        trace.state[row] = state
        trace.n_states[row] = n
        trace.event[row] = event
        trace.surprise[row] = surprise
        if len(beliefs) > 0:
            for i in range(n):
                beliefs[row, i] = now.belief[i]
        row += 1
    return row

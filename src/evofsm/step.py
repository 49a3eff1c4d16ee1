"""One observation through the machine: the paper's Section 2 on one screen.

An observation may found a state (`states.ets`, or another rule), is recognised as a distribution
over states (`states.spread`), and, where an action was taken after the observation before it,
teaches that action's transition matrix (`transitions`). An episode may end in failure, which is no
state of the machine: it is counted, and the next observation begins another episode.
"""

from __future__ import annotations

from enum import IntFlag
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm._compile import kernel
from evofsm.divergence import jensen_shannon_kernel
from evofsm.memory import NO_ACTION, Memory, open_memory
from evofsm.states import clusters, failure, spread
from evofsm.states.dispatch import determine, width
from evofsm.transitions import count, expand, forecast, identify
from evofsm.validation import LARGEST_OBSERVATION

# What `step` answers instead of an event where it did nothing.
FULL, REFUSED = -1, -2


class Event(IntFlag):
    """What an observation did to the states (the paper's Section 2.2.1).

    ``NONE`` left them as they were, ``MOVED`` put the nearest one on the observation, and
    ``CREATED`` founded a new one there. ``MERGED`` and ``RETIRED`` are kept for states that are
    joined or given up, which nothing does yet. Events may be combined.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=1)
    >>> machine.observe([0.0]).event is Event.CREATED
    True
    >>> Event(machine.learn_many([[0.0], [0.1]], [0, 0]).event[1])
    <Event.NONE: 0>
    """

    NONE = clusters.UNCHANGED
    MOVED = clusters.MOVED
    CREATED = clusters.CREATED
    MERGED = 4
    RETIRED = 8


#: Those that occur, by value: looking one up is quicker than making one.
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
def step(memory: Memory, failed: bool) -> tuple[int, int, float]:
    """Take in the observation in ``memory.scratch``; answers event, state and surprise.

    Where the episode ``failed`` it ends in failure after this observation.
    """
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
    event = determine(parameters.rule, now.clusters, n, scratch.observation)
    if failed and event == clusters.UNCHANGED:
        event = _split(memory, n)
    if event == clusters.CREATED:
        _connect(memory, n)
        n += 1

    # Section 2.2.2: which state is this?
    state = _recognise(memory, n)

    # Section 2.3: was it foreseen, and what does it teach about the action taken before it?
    surprise = np.nan
    action = int(now.action[0])
    if now.chained[0] and action != NO_ACTION:
        forecast(now.transitions, action, n, now.belief, scratch.predicted)
        surprise = jensen_shannon_kernel(scratch.predicted, scratch.recognised, n)
        identify(
            now.transitions, action, n, now.belief, scratch.recognised, parameters.learning_rate
        )
        _decide(memory, n, failed)

    if now.chained[0]:
        now.changes[int(now.state[0]), state] += 1.0
    for i in range(n):
        now.belief[i] = scratch.recognised[i]
    now.state[0] = state
    now.visits[state] += 1.0
    now.n_states[0] = n
    now.action[0] = NO_ACTION
    now.chained[0] = 1.0
    if failed:
        _end(memory)
    return event, state, surprise


@kernel
def observe(buffer: NDArray[np.float64]) -> tuple[int, int, float]:
    """`step`, with the whole machine in a single argument."""
    return step(open_memory(buffer), False)


@kernel
def observe_failure(buffer: NDArray[np.float64]) -> tuple[int, int, float]:
    """`observe`, and the episode ends in failure."""
    return step(open_memory(buffer), True)


@kernel
def fail(buffer: NDArray[np.float64]) -> bool:
    """End the episode in failure, to which the pending action led from the latest observation.

    Answers whether there was room for a state that this may found.
    """
    memory = open_memory(buffer)
    now = memory.learnt
    n = int(now.n_states[0])
    if n == len(now.belief):
        return False
    if _split(memory, n) == clusters.CREATED:
        _connect(memory, n)
        n += 1
        now.n_states[0] = n
        now.state[0] = _recognise(memory, n)
        for i in range(n):
            now.belief[i] = memory.scratch.recognised[i]
    if now.action[0] != NO_ACTION:
        _decide(memory, n, True)
    _end(memory)
    return True


@kernel
def _split(memory: Memory, n: int) -> int:
    """Let a failure at the latest observation found a state, where the rule does so."""
    now = memory.learnt
    return failure.split(
        memory.parameters.rule, now.clusters, n, now.outcomes.endings, now.visits, now.changes
    )


@kernel
def _connect(memory: Memory, n: int) -> None:
    """Give the state that was founded at index ``n`` its transitions."""
    now = memory.learnt
    expand(now.transitions, n, memory.parameters.prior_frequency)
    now.founded[n] = now.clusters.n_observations[0]


@kernel
def _recognise(memory: Memory, n: int) -> int:
    """Recognise the latest observation, into ``scratch.recognised``."""
    held = memory.learnt.clusters
    wide = width(memory.parameters.rule, held)
    return spread.recognise(held.squared_distances, n, wide, memory.scratch.recognised)


@kernel
def _decide(memory: Memory, n: int, failed: bool) -> None:
    """Count that the pending action was taken from the belief, and whether it led to failure."""
    now = memory.learnt
    action = int(now.action[0])
    count(now.outcomes.decisions[action], now.belief, n)
    if failed:
        count(now.outcomes.failures[action], now.belief, n)


@kernel
def _end(memory: Memory) -> None:
    """Count the failure where the episode was last, and clear the chain."""
    now = memory.learnt
    now.outcomes.endings[int(now.state[0])] += 1.0
    now.action[0] = NO_ACTION
    now.chained[0] = 0.0


@kernel
def learn_rows(
    buffer: NDArray[np.float64],
    observations: NDArray[np.float64],
    actions: NDArray[np.int64],
    starts: NDArray[np.bool_],
    failures: NDArray[np.bool_],
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
        event, state, surprise = step(memory, failures[row])
        if event == FULL:
            break
        if not failures[row]:
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

"""One observation through the machine: the paper's Section 2 on one screen.

An observation may create a state (`states.paper`, or another rule), is recognised as a distribution
over states (`states.spread`), and, where an action was taken after the observation before it,
teaches that action's transition matrix (`transitions`). An episode may end in failure, which is no
state of the machine: it is counted, and the next observation begins another episode.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntFlag
from functools import cache
from threading import Lock
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from evofsm.fsm import crowding
from evofsm.fsm.crowding import (
    MERGED,
    NEWCOMER,
    RETIRE,
    RETIRED,
    merge_closest,
    retire_least_useful,
)
from evofsm.fsm.divergence import jensen_shannon_kernel
from evofsm.fsm.kernels import NOT_COMPILED, inner_kernel, kernel, lanes, rare_kernel
from evofsm.fsm.learnt import NO_ACTION, NOT_OPEN
from evofsm.fsm.memory import Memory, Parameters, is_closed, open_memory
from evofsm.fsm.notebook import step_html
from evofsm.fsm.states import clusters, spread
from evofsm.fsm.states.clusters import place_center, potential_of, total_variance
from evofsm.fsm.states.dispatch import determine, width
from evofsm.fsm.states.failure import splits
from evofsm.fsm.transitions import (
    count,
    count_failure,
    count_open,
    count_try,
    count_visit,
    expand,
    forecast,
    forecast_and_identify,
    place_of,
    tick,
)
from evofsm.store import LARGEST_OBSERVATION

# Returned by `step` instead of an event: it did nothing, for there was no room for a state.
FULL = -1
# The same, for the observation or the action is none that the machine knows.
REFUSED = -2
# Returned by `_update` where it did nothing [bit]; no surprise is below 0.
DECLINED = -1.0
_COMPILING = Lock()
# Whether a machine may have to give up states (`evofsm.fsm.crowding`): a number, or None. Numba
# compiles a kernel for each of the two, and that without a limit in a fraction of the time.
Limit: TypeAlias = int | None


class Event(IntFlag):
    """What an observation did to the states (the paper's Section 2.2.1).

    ``NONE`` left them as they were, ``MOVED`` put the nearest one on the observation, and
    ``CREATED`` founded a new one there. Where there were ``max_states`` before, two were
    ``MERGED`` or one was ``RETIRED`` to make room, and the new one has the index that became
    free; ``MERGED`` alone says that none was created, for the nearest one was close enough.

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
    MERGED = crowding.MERGED
    RETIRED = crowding.RETIRED


#: By value: looking one up is quicker than making one.
EVENTS = tuple(Event(value) for value in range(16))


class Step(NamedTuple):
    """What the machine made of one observation; n states exist after it.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=1)
    >>> step = machine.learn_one([0.0], 0)
    >>> step.state, step.event.name, len(step.predicted), step.surprise
    (0, 'CREATED', 0, nan)
    >>> machine.observe([0.1])
    Step(state=0, belief=1 of 1 states, event=NONE, surprise=0)
    >>> machine.belief
    array([1.])
    """

    state: int  #: index of the most probable state
    belief: NDArray[np.float64]  #: (n,) distribution over states
    event: Event  #: what happened to the states
    predicted: NDArray[np.float64]  #: (n,) forecast made one step before; empty where none was
    surprise: float  #: divergence of `predicted` and `belief` [bit]; NaN where none was
    missing: tuple[int, ...] = ()  #: variables that were not observed, so that nothing was learnt
    explanation: str = ""  #: what experience says of the state, where that was asked for

    def __repr__(self) -> str:
        belief = float(self.belief[self.state]) if len(self.belief) else math.nan
        missing = f", missing={self.missing}" if self.missing else ""
        return (
            f"{type(self).__name__}(state={self.state}, belief={belief:.3g} of "
            f"{len(self.belief)} states, event={self.event.name}, surprise={self.surprise:.3g}"
            f"{missing})"
        )

    def _repr_html_(self) -> str:
        return step_html(self)


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
    belief: NDArray[np.float64] | None = None  #: (T, n), 0 for states not yet created


def widen(belief: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """Beliefs (..., n) over n states, 0 for those created since."""
    missing = n - belief.shape[-1]
    return np.pad(belief, [(0, 0)] * (belief.ndim - 1) + [(0, missing)]) if missing else belief


@inner_kernel
def step(
    memory: Memory, z: NDArray[np.float64], failed: bool, whole: bool, limit: Limit
) -> tuple[int, int, float]:
    """Take in one observation; returns event, state and surprise.

    Where the episode ``failed`` it ends in failure after this observation. If the ``whole``
    forecast is wanted it stands in ``scratch``.
    """
    parameters, now, scratch = memory.parameters, memory.learnt, memory.scratch
    if not _has_room(memory):
        return FULL, 0, np.nan
    if not _is_usable(memory, z):
        return REFUSED, 0, np.nan
    n = int(now.n_states[0])
    tick(now.outcomes, not now.chained[0])
    now.before[0] = now.state[0] if now.chained[0] else -1.0

    # Section 2.2.1: does the observation move a state, or create one?
    event, nearest, potential = determine(parameters.rule, now.clusters, n, z)
    if event == clusters.CREATED:
        event, nearest = _found(memory, n, nearest, potential, limit)
    elif event == clusters.UNCHANGED and failed and _splits(memory, nearest):
        event, nearest = _split(memory, n, nearest, limit)
    n = int(now.n_states[0])

    # Section 2.2.2: which state is this?
    _recognise(memory, n, nearest)

    # Section 2.3: was it foreseen, and what does it teach about the action taken before it?
    surprise = np.nan
    action = int(now.action[0])
    if now.chained[0] and action != NO_ACTION:
        place = place_of(now.transitions, action, n, parameters.prior_frequency)
        surprise = _learn(memory, place, n, whole)
        now.transitions.uses[action] += 1.0
        _decide(memory, place, n, failed)

    if now.chained[0]:
        now.outcomes.changes[int(now.state[0]), nearest] += 1.0
    for i in range(lanes(n)):
        now.belief[i] = scratch.recognised[i]
    now.state[0] = nearest
    now.outcomes.visits[nearest] += 1.0
    count_visit(now.outcomes, nearest)
    now.action[0] = NO_ACTION
    now.chained[0] = 1.0
    if failed:
        _end(memory)
    return event, nearest, surprise


@inner_kernel
def _learn(memory: Memory, place: int, n: int, whole: bool) -> float:
    """Learn the transition from the belief to what was recognised; returns the surprise.

    Where few states take part, all of the forecast is only made if asked for: a state that was
    not reached adds half of its forecast to the divergence, whichever it is.
    """
    parameters, now, scratch = memory.parameters, memory.learnt, memory.scratch
    tolerant = parameters.belief_tolerance > 0.0
    if tolerant and whole:
        forecast(now.transitions, place, n, now.belief, scratch.forecast)
    predicted, reached = scratch.predicted, scratch.recognised
    elsewhere = forecast_and_identify(
        now.transitions,
        place,
        n,
        now.belief,
        reached,
        parameters.learning_rate,
        tolerant,
        predicted,
        scratch.rates,
        scratch.lines,
    )
    divergence = jensen_shannon_kernel(predicted, reached, lanes(n), scratch.terms)
    return min(divergence + 0.5 * elsewhere, 1.0)


@inner_kernel
def step_and_act(
    memory: Memory,
    z: NDArray[np.float64],
    action: int,
    starts: bool,
    failed: bool,
    whole: bool,
    limit: Limit,
) -> tuple[int, int, float]:
    """`step`, in a new episode if it ``starts`` one, then an action (or `NO_ACTION`).

    After a failure there is nobody to act.
    """
    now = memory.learnt
    if starts:
        now.chained[0] = 0.0
    event, state, surprise = step(memory, z, failed, whole, limit)
    if event >= 0 and not failed:
        now.action[0] = action
    return event, state, surprise


@kernel
def _observe(
    buffer: NDArray[np.float64], z: NDArray[np.float64], action: int, failed: bool, limit: Limit
) -> tuple[int, int, float]:
    """`step_and_act`, with the whole machine in a single argument."""
    memory = open_memory(buffer)
    if not NO_ACTION <= action < len(memory.learnt.transitions.uses):
        return REFUSED, 0, np.nan
    return step_and_act(memory, z, action, False, failed, True, limit)


@kernel
def _update(
    buffer: NDArray[np.float64], z: NDArray[np.float64], action: int, limit: Limit
) -> float:
    """The same with fewer things to hand over: only the surprise, or `DECLINED`.

    It takes no lock: a call of a kernel is one step for the interpreter, between which and the
    next one threads take turns. A buffer that somebody is at work on is closed to it.
    """
    if is_closed(buffer):
        return DECLINED
    memory = open_memory(buffer)
    if not 0 <= action < len(memory.learnt.transitions.uses):
        return DECLINED
    event, _, surprise = step_and_act(memory, z, action, False, False, False, limit)
    return surprise if event >= 0 else DECLINED


@cache
def observer(limit: Limit) -> Callable[..., tuple[int, int, float]]:
    """`_observe`, for arrays of float64 without gaps only.

    For any other type of array it raises a TypeError, where Numba would compile it once more.
    """
    _compile_plain(_observe, "float64[::1], float64[::1], int64, boolean", limit)
    return _observe


@cache
def updater(limit: Limit) -> Callable[..., float]:
    """`_update`, in the same way; the quickest call there is to take one step."""
    _compile_plain(_update, "float64[::1], float64[::1], int64", limit)
    return _update


def _compile_plain(kernel: Any, arguments: str, limit: Limit) -> None:
    if NOT_COMPILED:
        return
    with _COMPILING:  # whichever thread comes first
        kernel.disable_compile(False)
        kernel.compile(f"({arguments}, {'none' if limit is None else 'int64'})")
        kernel.disable_compile()


@kernel
def fail(buffer: NDArray[np.float64], limit: Limit) -> bool:
    """End the episode in failure, to which the pending action led from the latest observation.

    Returns whether there was room for what this may found.
    """
    memory = open_memory(buffer)
    now = memory.learnt
    if not _has_room(memory):
        return False
    n = int(now.n_states[0])
    nearest = int(now.state[0])
    is_whole = now.outcomes.latest_visit[nearest] == now.outcomes.clock[0]
    if is_whole and _splits(memory, nearest):
        nearest = _split(memory, n, nearest, limit)[1]
        n = int(now.n_states[0])
        now.state[0] = nearest
        _recognise(memory, n, nearest)
        count_visit(now.outcomes, nearest)
        for i in range(n):
            now.belief[i] = memory.scratch.recognised[i]
    action = int(now.action[0])
    if action != NO_ACTION:
        place = place_of(now.transitions, action, n, memory.parameters.prior_frequency)
        _decide(memory, place, n, True)
    _end(memory)
    return True


def limit_of(parameters: Parameters) -> Limit:
    """What a machine tells its kernels of a limit to its states."""
    return None if parameters.max_states == np.inf else 1


@register_jitable
def room_for(memory: Memory) -> tuple[int, int]:
    """Numbers of states and of matrices with which the next step cannot lack room."""
    now = memory.learnt
    capacity, places = len(now.belief), len(now.transitions.matrices)
    action = int(now.action[0])
    if action != NO_ACTION and now.transitions.places[action] == NOT_OPEN:
        places = max(places, count_open(now.transitions) + 1)
    if now.n_states[0] == capacity and capacity < memory.parameters.max_states:
        capacity = lanes(capacity + capacity // 2)
    return capacity, places


@inner_kernel
def _has_room(memory: Memory) -> bool:
    """Whether another state could be created, and the pending action have a matrix."""
    capacity, places = room_for(memory)
    now = memory.learnt
    return capacity == len(now.belief) and places == len(now.transitions.matrices)


@inner_kernel
def _is_usable(memory: Memory, z: NDArray[np.float64]) -> bool:
    """Whether the observation has the machine's variables, all of them finite numbers."""
    if len(z) == 0 or len(z) != len(memory.learnt.clusters.first):
        return False
    usable = True
    for value in z:
        usable &= abs(value) <= LARGEST_OBSERVATION  # false of NaN
    return usable


@inner_kernel
def _splits(memory: Memory, nearest: int) -> bool:
    """Whether a failure at the latest observation creates a state, amid its nearest one."""
    now = memory.learnt
    return splits(
        memory.parameters.rule,
        now.clusters.squared_distances[nearest],
        now.outcomes.visits[nearest],
        now.outcomes.changes[nearest, nearest],
        now.outcomes.endings[nearest],
    )


@inner_kernel
def _split(memory: Memory, n: int, nearest: int, limit: Limit) -> tuple[int, int]:
    """Create a state for a failure; the observation is absorbed and counts in its potential."""
    held = memory.learnt.clusters
    potential = potential_of(held, memory.parameters.rule.weights, held.latest)
    return _found(memory, n, nearest, potential, limit)


@rare_kernel
def _found(memory: Memory, n: int, nearest: int, potential: float, limit: Limit) -> tuple[int, int]:
    """Create a state on the latest observation; returns what happened and the nearest state.

    Where there are as many states as allowed, one of them, or the newcomer, is given up.
    """
    parameters, now = memory.parameters, memory.learnt
    new, event = n, clusters.CREATED
    if limit is None:  # known as this is compiled: what gives up states is left out then
        n += 1
    elif n >= parameters.max_states:
        if parameters.when_full == RETIRE:
            new, event = retire_least_useful(memory, n), clusters.CREATED | RETIRED
        else:
            new, event = merge_closest(memory, n, nearest), clusters.CREATED | MERGED
        if new == NEWCOMER:
            return MERGED, nearest
    else:
        n += 1
    place_center(now.clusters, new, now.clusters.latest, potential)
    expand(now.transitions, new, n, parameters.prior_frequency)
    now.ids[new] = now.n_founded[0]
    now.outcomes.founded[new] = now.clusters.n_observations[0]
    now.n_founded[0] += 1.0
    now.n_states[0] = n
    return event, new


@inner_kernel
def _recognise(memory: Memory, n: int, nearest: int) -> None:
    """Recognise the latest observation, into ``scratch.recognised``."""
    parameters, held = memory.parameters, memory.learnt.clusters
    spread.recognise(
        held.squared_distances,
        lanes(n),
        nearest,
        width(parameters.rule, total_variance(held)),
        parameters.belief_tolerance,
        memory.scratch.recognised,
    )


@inner_kernel
def _decide(memory: Memory, place: int, n: int, failed: bool) -> None:
    """Count that the pending action was taken from the belief, and whether it led to failure."""
    now, outcomes = memory.learnt, memory.learnt.outcomes
    count(outcomes.decisions[place], now.belief, lanes(n))
    if failed:
        count(outcomes.failures[place], now.belief, lanes(n))
    count_try(outcomes, place, int(now.state[0]))


@inner_kernel
def _end(memory: Memory) -> None:
    """Count the failure where the episode was last and what it did before; clear the chain."""
    now = memory.learnt
    now.outcomes.endings[int(now.state[0])] += 1.0
    count_failure(now.outcomes, int(now.n_states[0]), memory.parameters.failure_horizon)
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
    limit: Limit,
) -> int:
    """Step through the rows from ``row`` on; returns where it stopped for want of room.

    ``beliefs`` is (T, capacity), or empty where nobody wants them.
    """
    memory = open_memory(buffer)
    now = memory.learnt
    while row < len(observations):
        event, state, surprise = step_and_act(
            memory, observations[row], actions[row], starts[row], failures[row], False, limit
        )
        if event == FULL:
            break
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

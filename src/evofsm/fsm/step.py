"""One observation through the machine: the paper's Section 2 on one screen.

An observation may create a state and is recognised as a distribution over states (`clusters`), and
teaches the transition matrix of the action taken before it (`transitions`). Failure, in which an
episode may end, is no state of the machine: it is counted.
"""

from __future__ import annotations

from enum import IntFlag
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.arrays import ENDINGS, EPISODES, FAILED_SOON, NO_ACTION, VISITS, Learnt, Settings
from evofsm.fsm.clusters import CREATED, MERGED, MOVED, UNCHANGED, determine, recognise, width_of
from evofsm.fsm.divergence import jensen_shannon_kernel
from evofsm.fsm.kernels import inner_kernel, kernel, lanes, rare_kernel, spliced_kernel
from evofsm.fsm.transitions import expand, forecast_and_identify, merge_closest, place_of, room_for
from evofsm.fsm.validation import Floats

#: Rows of the room in which a step works, (3, capacity).
RECOGNISED, PREDICTED, TERMS = 0, 1, 2


@spliced_kernel
def step(
    learnt: Learnt, settings: Settings, scratch: Floats, z: Floats, failed: bool
) -> tuple[int, int, float]:
    """Take in one observation; returns event, state and surprise. There must be room for it.

    Where the episode ``failed`` it ends in failure after this observation.
    """
    now, new_belief, forecast = learnt.now[0], scratch[RECOGNISED], scratch[PREDICTED]
    _tick(now)

    # Section 2.2.1: does the observation move a state, or create one?
    event, nearest, potential = determine(learnt, settings, z)
    if event == CREATED:
        event, nearest = _create(learnt, settings, nearest, potential)
    n = now.n_states

    # Section 2.2.2: which state is this?
    width = width_of(settings, now.scatter / now.n_observations)
    far, tolerance = learnt.squared_distances, settings.belief_tolerance
    recognise(far, lanes(n), nearest, width, tolerance, new_belief)

    # Section 2.3: was it foreseen, and what does it teach about the action taken before it?
    surprise = np.nan
    if now.chained and now.action != NO_ACTION:
        place = place_of(learnt, now.action, settings.prior_frequency)
        forecast_and_identify(learnt, settings, place, n, new_belief, forecast)
        surprise = jensen_shannon_kernel(forecast, new_belief, lanes(n), scratch[TERMS])
        learnt.actions[now.action].uses += 1.0
        _count_decision(learnt, place, n, failed)

    if now.chained:
        learnt.changes[now.state, nearest] += 1.0
    for i in range(lanes(n)):
        learnt.belief[i] = new_belief[i]
    there = learnt.states[nearest]
    learnt.sums[VISITS, nearest] += 1.0
    learnt.sums[EPISODES, nearest] += there.latest_visit < now.began  # once for each episode
    there.latest_visit = now.clock
    now.state, now.action, now.chained = nearest, NO_ACTION, 1
    if failed:
        _end(learnt, settings)
    return event, nearest, surprise


@kernel
def learn_rows(
    learnt: Learnt,
    settings: Settings,
    observations: Floats,
    actions: NDArray[np.int64],
    starts: NDArray[np.bool_],
    failures: NDArray[np.bool_],
    told: bool,
    scratch: Floats,
    row: int,
    trace: Trace,
    beliefs: Floats,  # (T, capacity), or empty where nobody wants them
) -> int:
    """Step through the rows from ``row`` on; returns where it stopped for want of room."""
    now, room = learnt.now[0], (len(learnt.belief), len(learnt.matrices))
    while row < len(observations) and room_for(learnt, settings) == room:
        now.chained = 0 if starts[row] else now.chained
        now.failures_told = 1 if told else now.failures_told
        event, state, surprise = step(learnt, settings, scratch, observations[row], failures[row])
        now.action = NO_ACTION if failures[row] else actions[row]
        trace.state[row], trace.n_states[row] = state, now.n_states
        trace.event[row], trace.surprise[row] = event, surprise
        if len(beliefs) > 0:
            for i in range(now.n_states):
                beliefs[row, i] = learnt.belief[i]
        row += 1
    return row


@kernel
def believe(learnt: Learnt, settings: Settings, belief: Floats, failed: bool) -> None:
    """Go on with a belief over all states, or end without any where it is empty.

    It teaches no state, and no transition to one. The action before it was taken; and the state is
    visited, if the episode came to it before. Where the episode ``failed`` it ends in failure.
    There must be room for the action's matrix.
    """
    now = learnt.now[0]
    if now.action != NO_ACTION:
        place = place_of(learnt, now.action, settings.prior_frequency)
        _count_decision(learnt, place, now.n_states, failed)
    if len(belief) > 0:
        _tick(now)
        for i in range(now.n_states):
            learnt.belief[i] = belief[i]
        now.state, now.action, now.chained = np.argmax(belief), NO_ACTION, 1
        there = learnt.states[now.state]
        there.latest_visit = now.clock if there.latest_visit >= now.began else there.latest_visit
    if failed:
        _end(learnt, settings)


@rare_kernel
def _create(learnt: Learnt, settings: Settings, nearest: int, potential: float) -> tuple[int, int]:
    """Create a state, at the limit by merging two; returns what happened and the nearest."""
    now, n = learnt.now[0], learnt.now[0].n_states
    new, event = n, CREATED
    if n < settings.max_states:
        now.n_states += 1
    else:
        new, event = merge_closest(learnt, settings, nearest), CREATED | MERGED
        if new == n:
            return MERGED, nearest
    for j in range(len(learnt.variables)):
        learnt.centers[j, new] = learnt.variables[j].latest
    learnt.potentials[new] = potential
    learnt.squared_distances[new] = 0.0
    expand(learnt, new, now.n_states, settings.prior_frequency)
    learnt.states[new].id = now.n_created
    learnt.states[new].created = now.n_observations
    now.n_created += 1
    return event, new


# -- Counts ---------------------------------------------------------------------------------------


@inner_kernel
def _tick(now: Any) -> None:
    now.clock += 1
    now.began = now.began if now.chained else now.clock


@inner_kernel
def _count_decision(learnt: Learnt, place: int, n: int, failed: bool) -> None:
    """Count that the pending action was taken from the belief, and whether it led to failure.

    An episode tried it in a state that it visited: not where nothing was seen whole.
    """
    now, belief = learnt.now[0], learnt.belief
    for i in range(lanes(n)):
        learnt.decisions[place, i] += belief[i]
    if failed:
        for i in range(n):
            learnt.failures[place, i] += belief[i]
    tries, visit = learnt.tries[place, now.state], learnt.states[now.state].latest_visit
    if visit >= now.began:
        tries.tried += tries.latest_try < now.began
        tries.latest_try = visit


@rare_kernel
def _end(learnt: Learnt, settings: Settings) -> None:
    """Count the failure, and all that the episode did within the horizon; clear the chain."""
    now = learnt.now[0]
    learnt.sums[ENDINGS, now.state] += 1.0
    since = max(float(now.began), now.clock - settings.failure_horizon)
    for i in range(now.n_states):
        learnt.sums[FAILED_SOON, i] += learnt.states[i].latest_visit >= since
        for place in range(now.n_places):
            tries = learnt.tries[place, i]
            tries.failed_after += tries.latest_try >= since
    now.action, now.chained, now.failures_told = NO_ACTION, 0, 1


# -- What people get ------------------------------------------------------------------------------


class Event(IntFlag):
    """What an observation did to the states (the paper's Section 2.2.1).

    ``NONE`` left them as they were, ``MOVED`` put the nearest one on the observation, and
    ``CREATED`` put a new one there. With ``max_states`` two were ``MERGED`` first; ``MERGED`` alone
    says that the observation was left to the nearest one.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> Event(EvolvingFSM(n_actions=1).learn_many([[0.0], [0.1]], [0, 0]).event[0])
    <Event.CREATED: 2>
    """

    NONE = UNCHANGED
    MOVED = MOVED
    CREATED = CREATED
    MERGED = MERGED


#: By value: looking one up is quicker than making one.
EVENTS = tuple(Event(value) for value in range(8))


class Step(NamedTuple):
    """What the machine made of one observation; n states exist after it."""

    state: int  #: index of the most probable state
    belief: Floats  #: (n,) distribution over states
    event: Event  #: what happened to the states
    predicted: Floats  #: (n,) forecast made one step before; empty where none was
    surprise: float  #: divergence of `predicted` and `belief` [bit]; NaN without one of them

    def __repr__(self) -> str:
        return (
            f"Step(state={self.state}, belief={self.belief[self.state]:.3g} of "
            f"{len(self.belief)} states, event={self.event.name}, surprise={self.surprise:.3g})"
        )


class Trace(NamedTuple):
    """What the machine made of T observations, a row each; n states exist after the last."""

    state: NDArray[np.int64]  #: (T,) index of the most probable state
    n_states: NDArray[np.int64]  #: (T,) number of states after the row
    event: NDArray[np.int8]  #: (T,) values of `Event`
    surprise: Floats  #: (T,) [bit], NaN where nothing was predicted
    belief: Floats | None = None  #: (T, n), 0 for states not yet created


def blank_trace(rows: int) -> Trace:
    """Room for what is made of so many observations."""
    integers = np.empty(rows, np.int64), np.empty(rows, np.int64), np.empty(rows, np.int8)
    return Trace(*integers, np.empty(rows))

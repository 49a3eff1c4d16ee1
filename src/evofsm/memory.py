"""All that a machine has learnt, in one flat buffer that a kernel takes as a single argument.

Named views into the buffer make it readable; this file is the only place that knows the layout.
There is room for ``capacity`` states, of which the first ``n_states`` are in use, and for the
matrices of as many actions as were used. The matrices come last: a fleet may hold them apart from
the rest, in single precision.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from evofsm._compile import LINE, inner_kernel, kernel, lanes, part
from evofsm.states.clusters import Clusters
from evofsm.states.rule import RuleSettings
from evofsm.transitions import NOT_OPEN, Outcomes, Transitions
from evofsm.validation import refuse_more_failures, refuse_unless_distribution

NO_ACTION = -1

# A buffer begins with its sizes (m, q, capacity, places), `Parameters`, whether anybody told of
# failures, and counters.
_FAILURES_TOLD, _COUNTERS, _HEAD = 17, 20, 32
# Then, for each kind of thing there is, so many numbers; centres are further rows of states.
_PER_STATE, _PER_PLACE, _PER_ACTION, _PER_VARIABLE = 17, 7, 2, 5
# Where the centre of a state that is not there stands: too far for any belief.
_NOWHERE = np.inf


class Parameters(NamedTuple):
    """The settings of a machine; the paper's symbols are phi, epsilon-bar."""

    learning_rate: float
    prior_frequency: float
    belief_tolerance: float
    max_states: float  #: infinity for no limit
    when_full: float  #: a value of `evofsm.crowding.WhenFull`
    failure_horizon: float  #: observations; infinity for all of an episode
    rule: RuleSettings


class Learnt(NamedTuple):
    """What the next step needs, and what people ask of the states."""

    n_states: NDArray[np.float64]  # (1,)
    n_founded: NDArray[np.float64]  # (1,) states so far, with those given up
    action: NDArray[np.float64]  # (1,) taken after the latest observation, or NO_ACTION
    chained: NDArray[np.float64]  # (1,) 1 where `belief` belongs to the present episode
    state: NDArray[np.float64]  # (1,) the most probable state at the latest observation
    belief: NDArray[np.float64]  # (capacity,)
    ids: NDArray[np.float64]  # (capacity,) number of its founding, from 0
    visits: NDArray[np.float64]  # (capacity,) observations in which it was the most probable
    founded: NDArray[np.float64]  # (capacity,) number of the observation that did it, from 1
    changes: NDArray[np.float64]  # (capacity, capacity) steps from a state (row) to a state
    clusters: Clusters
    transitions: Transitions
    outcomes: Outcomes


class Scratch(NamedTuple):
    """Room in which a step works; worth nothing after it."""

    predicted: NDArray[np.float64]  # (capacity,)
    recognised: NDArray[np.float64]  # (capacity,)
    rates: NDArray[np.float64]  # (capacity,)
    terms: NDArray[np.float64]  # (capacity,)
    lines: NDArray[np.float64]  # (capacity,)
    forecast: NDArray[np.float64]  # (capacity,) all of it, where `predicted` is only a part


class Memory(NamedTuple):
    """The whole buffer."""

    parameters: Parameters
    learnt: Learnt
    scratch: Scratch


class _Sections(NamedTuple):
    """Where the parts of a buffer begin."""

    of_states: int
    changes: int
    of_places: int
    of_actions: int
    of_variables: int
    matrices: int


@register_jitable
def _sections(m: int, q: int, capacity: int, places: int) -> _Sections:
    of_states = _HEAD
    changes = of_states + (_PER_STATE + m) * capacity
    of_places = changes + capacity * capacity
    of_actions = of_places + _PER_PLACE * places * capacity
    of_variables = of_actions + _PER_ACTION * q
    matrices = lanes(of_variables + _PER_VARIABLE * m)
    return _Sections(of_states, changes, of_places, of_actions, of_variables, matrices)


@register_jitable
def _sizes(buffer: NDArray[np.float64]) -> tuple[int, int, int, int]:
    return int(buffer[0]), int(buffer[1]), int(buffer[2]), int(buffer[3])


@register_jitable
def matrices_of(buffer: NDArray[np.float64]) -> int:
    """Where the matrices begin in a whole buffer."""
    return _sections(*_sizes(buffer)).matrices


@register_jitable
def lengths(m: int, q: int, capacity: int, places: int) -> tuple[int, int]:
    """Numbers in a buffer without its matrices, and in those."""
    return _sections(m, q, capacity, places).matrices, places * capacity * capacity


@inner_kernel
def open_memory(buffer: NDArray[np.float64]) -> Memory:
    """Views into a whole buffer, for kernels."""
    return open_apart(buffer, buffer[matrices_of(buffer) :])


def _open_apart(buffer: NDArray[np.float64], matrices: NDArray[Any]) -> Memory:
    """Views into a buffer whose matrices are somewhere else; for kernels `open_apart`."""
    m, q, capacity, places = _sizes(buffer)
    begin = _sections(m, q, capacity, places)
    counters = part(buffer, _COUNTERS, (9, 1))
    of_states = part(buffer, begin.of_states, (_PER_STATE + m, capacity))
    of_places = part(buffer, begin.of_places, (_PER_PLACE, places, capacity))
    of_actions = part(buffer, begin.of_actions, (_PER_ACTION, q))
    of_variables = part(buffer, begin.of_variables, (_PER_VARIABLE, m))
    return Memory(
        Parameters(
            float(buffer[4]),
            float(buffer[5]),
            float(buffer[6]),
            float(buffer[7]),
            float(buffer[8]),
            float(buffer[9]),
            RuleSettings(
                float(buffer[10]),
                float(buffer[11]),
                float(buffer[12]),
                float(buffer[13]),
                float(buffer[14]),
                float(buffer[15]),
                float(buffer[16]),
                of_variables[4],
            ),
        ),
        Learnt(
            counters[0],
            counters[1],
            counters[2],
            counters[3],
            counters[4],
            of_states[0],
            of_states[1],
            of_states[2],
            of_states[3],
            part(buffer, begin.changes, (capacity, capacity)),
            Clusters(
                counters[5],
                of_variables[0],
                of_variables[1],
                of_variables[2],
                counters[6],
                of_states[_PER_STATE:],
                of_states[4],
                of_states[5],
            ),
            Transitions(
                of_actions[0],
                of_actions[1],
                part(matrices, 0, (places, capacity, capacity)),
                of_places[0],
                of_places[1],
            ),
            Outcomes(
                of_places[2],
                of_places[3],
                of_states[6],
                counters[7],
                counters[8],
                of_states[7],
                of_states[8],
                of_states[9],
                of_states[10],
                of_places[4],
                of_places[5],
                of_places[6],
            ),
        ),
        Scratch(
            of_states[11],
            of_states[12],
            of_states[13],
            of_states[14],
            of_states[15],
            of_states[16],
        ),
    )


open_apart = inner_kernel(_open_apart)


def allocate(
    n_variables: int, n_actions: int, capacity: int, places: int, parameters: Parameters
) -> NDArray[np.float64]:
    """Buffer of a machine that has seen nothing."""
    buffer = _blank(n_variables, n_actions, capacity, places)
    *numbers, rule = parameters
    *rule_numbers, weights = rule
    buffer[4:17] = (*numbers, *rule_numbers)
    memory = view(buffer)
    memory.parameters.rule.weights[:] = weights
    memory.learnt.action[0] = NO_ACTION
    memory.learnt.transitions.places[:] = NOT_OPEN
    _vacate(memory.learnt.clusters, 0)
    return buffer


def _blank(*sizes: int) -> NDArray[np.float64]:
    """A buffer of these sizes with zeros; it begins with a cache line."""
    length = sum(lengths(*sizes))
    some = np.zeros(length + LINE)
    first = -(some.ctypes.data // some.itemsize) % LINE
    buffer = some[first : first + length]
    buffer[: len(sizes)] = sizes
    return buffer


@register_jitable
def _vacate(clusters: Clusters, n: int) -> None:
    """Put the centres from the n-th on where a state that is not there has its own."""
    clusters.centers[:, n:] = _NOWHERE
    clusters.squared_distances[n:] = _NOWHERE


def view(buffer: NDArray[np.float64]) -> Memory:
    """Views into a buffer, for Python."""
    return _open_apart(buffer, buffer[matrices_of(buffer) :])


def resize(buffer: NDArray[np.float64], capacity: int, places: int) -> NDArray[np.float64]:
    """Copy of a buffer with room for another number of states and matrices."""
    m, q, *_ = _sizes(buffer)
    resized = _blank(m, q, capacity, places)
    move(buffer, buffer[matrices_of(buffer) :], resized, resized[matrices_of(resized) :])
    return resized


@kernel
def move(
    buffer: NDArray[np.float64],
    matrices: NDArray[Any],
    resized: NDArray[np.float64],
    resized_matrices: NDArray[Any],
) -> None:
    """Copy a buffer to a blank one of other sizes: all of it, or as much as there is room for."""
    m, q, old, old_places = _sizes(buffer)
    m, q, new, new_places = _sizes(resized)
    begin, begins = _sections(m, q, old, old_places), _sections(m, q, new, new_places)
    n, places = min(old, new), min(old_places, new_places)
    for i in range(4, _HEAD):
        resized[i] = buffer[i]
    for i in range(_PER_ACTION * q):
        resized[begins.of_actions + i] = buffer[begin.of_actions + i]
    for i in range(_PER_VARIABLE * m):
        resized[begins.of_variables + i] = buffer[begin.of_variables + i]
    _copy_rows(buffer, begin.of_states, old, resized, begins.of_states, new, _PER_STATE + m, n)
    _copy_rows(buffer, begin.changes, old, resized, begins.changes, new, n, n)
    for kind in range(_PER_PLACE):
        start = begin.of_places + kind * old_places * old
        starts = begins.of_places + kind * new_places * new
        _copy_rows(buffer, start, old, resized, starts, new, places, n)
    for place in range(places):
        start, starts = place * old * old, place * new * new
        _copy_rows(matrices, start, old, resized_matrices, starts, new, n, n)
    _vacate(open_apart(resized, resized_matrices).learnt.clusters, n)


@inner_kernel
def _copy_rows(
    source: NDArray[np.float64],
    start: int,
    stride: int,
    target: NDArray[np.float64],
    target_start: int,
    target_stride: int,
    rows: int,
    n: int,
) -> None:
    """Copy the first ``n`` numbers of each of some rows."""
    for row in range(rows):
        for i in range(n):
            target[target_start + row * target_stride + i] = source[start + row * stride + i]


def failures_told(buffer: NDArray[np.float64]) -> bool:
    """Whether anybody told of failures: of one, or that there was none."""
    return bool(buffer[_FAILURES_TOLD])


def tell_of_failures(buffer: NDArray[np.float64], at: int | NDArray[np.int64] = 0) -> None:
    """Note that failures are told, of the machines whose memories begin ``at`` a place."""
    buffer[at + _FAILURES_TOLD] = 1.0


def leaves(learnt: NamedTuple) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Every array in a tuple of arrays and further such tuples, with its name."""
    for name, value in zip(learnt._fields, learnt, strict=True):
        if isinstance(value, np.ndarray):
            yield name, value
        else:
            yield from leaves(value)


def refuse_impossible(learnt: Learnt) -> None:
    """Raise where numbers that a file gave contradict each other; `ranges` has what each may be.

    Kernels take counts and indices from the buffer on trust.
    """
    n, n_actions = len(learnt.belief), len(learnt.transitions.uses)
    if learnt.n_states[0] != n:
        raise ValueError(f"n_states is {learnt.n_states[0]:g}, but there are {n} states")
    if learnt.action[0] not in range(NO_ACTION, n_actions):
        raise ValueError(f"action is {learnt.action[0]:g}, but there are {n_actions} actions")
    if learnt.state[0] not in range(n):
        raise ValueError(f"state is {learnt.state[0]:g}, but there are {n} states")
    if learnt.clusters.n_observations[0] < n:
        raise ValueError(f"n_observations is too small for {n} states")
    open_ = learnt.transitions.places[learnt.transitions.places != NOT_OPEN]
    if sorted(open_) != list(range(len(learnt.transitions.matrices))):
        raise ValueError("places of matrices are not those that there are")
    refuse_more_failures(learnt.outcomes)
    refuse_unless_distribution("belief", learnt.belief)
    scales = learnt.transitions.scales
    refuse_unless_distribution("a row of matrices", learnt.transitions.matrices * scales[..., None])

"""All that a machine has learnt, in one flat buffer that a kernel takes as a single argument.

Named views into the buffer make it readable; this file is the only place that knows the layout.
There is room for ``capacity`` states, of which the first ``n_states`` are in use, and for the
matrices of as many actions as were used. The matrices come last: a fleet may hold them apart from
the rest, in single precision.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from evofsm.fsm.kernels import LINE, inner_kernel, kernel, lanes
from evofsm.fsm.layout import (
    ALL,
    COUNTS,
    FIELDS,
    PLACES,
    SHAPES,
    SIZES,
    AllPerPlace,
    AllPerState,
    Array,
    PerState,
    Place,
    Setting,
    build,
    number_fields,
    opener,
)
from evofsm.fsm.learnt import NO_ACTION, NOT_OPEN, Clusters, Learnt, Outcomes
from evofsm.fsm.states.rule import RuleSettings
from evofsm.fsm.transitions import count_open
from evofsm.fsm.validation import refuse_more_failures, refuse_unless_distribution

# A buffer begins with its sizes (m, q, capacity, places); settings follow from here on, whether
# anybody told of failures, whether it is closed, and counters.
_SETTINGS = 4
# Where the centre of a state that is not there stands: too far for any belief.
_NOWHERE = np.inf


class Parameters(NamedTuple):
    """The settings of a machine; the paper's symbols are phi, epsilon-bar."""

    learning_rate: Setting
    prior_frequency: Setting
    belief_tolerance: Setting
    max_states: Setting  #: infinity for no limit
    when_full: Setting  #: a value of `evofsm.fsm.crowding.WhenFull`
    failure_horizon: Setting  #: observations; infinity for all of an episode
    rule: RuleSettings


class Scratch(NamedTuple):
    """Room in which a step works; worth nothing after it."""

    predicted: PerState
    recognised: PerState
    rates: PerState
    terms: PerState
    lines: PerState
    forecast: PerState  # all of it, where `predicted` is only a part


class Memory(NamedTuple):
    """The whole buffer."""

    parameters: Parameters
    learnt: Learnt
    scratch: Scratch
    per_state: AllPerState
    per_place: AllPerPlace


number_fields(Memory)
_FAILURES_TOLD = _SETTINGS + COUNTS["setting"]
_CLOSED = _FAILURES_TOLD + 1
_COUNTERS = _CLOSED + 1
_HEAD = lanes(_COUNTERS + COUNTS["counter"])
_PER_STATE = COUNTS["state"]
_PER_PLACE = COUNTS["place"]
_PER_ACTION = COUNTS["action"]
_PER_VARIABLE = COUNTS["variable"]

# The counters that tell where the present episode is; the first belief stands behind them all.
_ACTION, _CHAINED, _STATE, _BEFORE, _CLOCK, _BEGAN = (
    _COUNTERS + PLACES[cast(Array, array)].number
    for array in (
        Learnt.action,
        Learnt.chained,
        Learnt.state,
        Learnt.before,
        Outcomes.clock,
        Outcomes.began,
    )
)


@dataclass(frozen=True, slots=True)
class Held:
    """A buffer with the views into it: together, for one without the other is of no use."""

    buffer: NDArray[np.float64]
    memory: Memory


class _Sections(NamedTuple):
    """Where the arrays of each kind begin."""

    setting: int
    counter: int
    state: int
    center: int
    change: int
    place: int
    action: int
    variable: int
    matrix: int  # apart from the others, or behind them


@register_jitable
def _sections(m: int, q: int, capacity: int, places: int) -> _Sections:
    center = _HEAD + _PER_STATE * capacity
    change = center + m * capacity
    place = change + capacity * capacity
    action = place + _PER_PLACE * places * capacity
    variable = action + _PER_ACTION * q
    matrix = lanes(variable + _PER_VARIABLE * m)
    return _Sections(_SETTINGS, _COUNTERS, _HEAD, center, change, place, action, variable, matrix)


@register_jitable
def _sizes(buffer: NDArray[np.float64]) -> tuple[int, int, int, int]:
    return int(buffer[0]), int(buffer[1]), int(buffer[2]), int(buffer[3])


@register_jitable
def matrices_of(buffer: NDArray[np.float64]) -> int:
    """Where the matrices begin in a whole buffer."""
    return _sections(*_sizes(buffer)).matrix


@register_jitable
def lengths(m: int, q: int, capacity: int, places: int) -> tuple[int, int]:
    """Numbers in a buffer without its matrices, and in those."""
    return _sections(m, q, capacity, places).matrix, places * capacity * capacity


@inner_kernel
def open_memory(buffer: NDArray[np.float64]) -> Memory:
    """A whole buffer, for kernels."""
    return open_apart(buffer, buffer[matrices_of(buffer) :])


@inner_kernel
def open_apart(buffer: NDArray[np.float64], matrices: NDArray[Any]) -> Memory:
    """A buffer whose matrices are somewhere else, for kernels."""
    sizes = _sizes(buffer)
    memory: Memory = _opened(buffer, matrices, sizes, tuple(_sections(*sizes)))
    return memory


def view(buffer: NDArray[np.float64]) -> Memory:
    """Views into a whole buffer, for Python."""
    sizes = _sizes(buffer)
    begins = _sections(*sizes)
    return _view(buffer, buffer[begins.matrix :], sizes, begins)


def _view(
    buffer: NDArray[np.float64],
    matrices: NDArray[Any],
    sizes: Sequence[int],
    begins: Sequence[int],
) -> Memory:
    lengths = {"one": 1, **dict(zip(SIZES, sizes, strict=True))}
    where = dict(zip(_Sections._fields, begins, strict=True)) | {"matrix": 0}

    def value(place: Place) -> Any:
        begin, source = where[place.kind], matrices if place.kind == "matrix" else buffer
        if place.kind == "setting":
            return float(buffer[begin + place.number])
        shape = [lengths[size] for size in SHAPES[place.kind]]
        if place.number == ALL:
            shape.insert(0, COUNTS[place.kind])
        begin += max(place.number, 0) * math.prod(shape)
        return source[begin : begin + math.prod(shape)].reshape(shape)

    memory: Memory = build(Memory, value)
    return memory


_opened = opener(Memory, _view)


def allocate(
    n_variables: int, n_actions: int, capacity: int, places: int, parameters: Parameters
) -> NDArray[np.float64]:
    """Buffer of a machine that has seen nothing."""
    buffer = _blank(n_variables, n_actions, capacity, places)
    *numbers, rule = parameters
    *rule_numbers, weights = rule
    buffer[_SETTINGS:_FAILURES_TOLD] = (*numbers, *rule_numbers)
    memory = view(buffer)
    memory.parameters.rule.weights[:] = weights
    memory.learnt.action[0] = NO_ACTION
    memory.learnt.before[0] = NOT_OPEN
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


def resize(buffer: NDArray[np.float64], capacity: int, places: int) -> NDArray[np.float64]:
    """Copy of a buffer with room for another number of states and matrices.

    Raises
    ------
    ValueError
        If there would be less room than is used.
    """
    now = view(buffer).learnt
    n, used = int(now.n_states[0]), count_open(now.transitions)
    if capacity < n or places < used:
        raise ValueError(
            f"room for {capacity} states and {places} matrices, but {n} and {used} are in use"
        )
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
    for i in range(_SETTINGS, _HEAD):
        resized[i] = buffer[i]
    for i in range(_PER_ACTION * q):
        resized[begins.action + i] = buffer[begin.action + i]
    for i in range(_PER_VARIABLE * m):
        resized[begins.variable + i] = buffer[begin.variable + i]
    _copy_rows(buffer, begin.state, old, resized, begins.state, new, _PER_STATE + m, n)
    _copy_rows(buffer, begin.change, old, resized, begins.change, new, n, n)
    for kind in range(_PER_PLACE):
        start = begin.place + kind * old_places * old
        starts = begins.place + kind * new_places * new
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


@register_jitable
def is_closed(buffer: NDArray[np.float64]) -> bool:
    """Whether somebody is at work on the machine, or it has gone on with another buffer."""
    return bool(buffer[_CLOSED] != 0.0)


def close(buffer: NDArray[np.float64]) -> bool:
    """Close a buffer; returns whether it was open."""
    was_open = not is_closed(buffer)
    buffer[_CLOSED] = 1.0
    return was_open


def reopen(buffer: NDArray[np.float64]) -> None:
    """Let whoever does not ask for the lock step again."""
    buffer[_CLOSED] = 0.0


def failures_told(buffer: NDArray[np.float64]) -> bool:
    """Whether anybody told of failures: of one, or that there was none."""
    return bool(buffer[_FAILURES_TOLD])


def tell_of_failures(buffer: NDArray[np.float64], at: int | NDArray[np.int64] = 0) -> None:
    """Note that failures are told, of the machines whose memories begin ``at`` a place."""
    buffer[at + _FAILURES_TOLD] = 1.0


# What these two change lies side by side: one assignment does it, so that an interrupt comes
# before or after, and never in between.
def believe(buffer: NDArray[np.float64], belief: NDArray[np.float64]) -> None:
    """Go on in the episode with a belief over all states, from which nothing else is learnt."""
    present = buffer[: _HEAD + len(belief)].copy()
    present[_CLOCK] += 1.0
    if not present[_CHAINED]:
        present[_BEGAN] = present[_CLOCK]
    present[_BEFORE] = present[_STATE] if present[_CHAINED] else NOT_OPEN
    present[_ACTION], present[_CHAINED], present[_STATE] = NO_ACTION, 1.0, belief.argmax()
    present[_HEAD:] = belief
    buffer[: len(present)] = present


def forget_present(buffer: NDArray[np.float64]) -> None:
    """Leave the episode, so that the next observation begins another one."""
    buffer[_ACTION : _CHAINED + 1] = NO_ACTION, 0.0


def leaves(learnt: object) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Every array in a part and the parts in it, with its name."""
    for name in FIELDS[type(learnt)]:
        value = getattr(learnt, name)
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
    if learnt.before[0] not in range(-1, n):
        raise ValueError(f"before is {learnt.before[0]:g}, but there are {n} states")
    if learnt.clusters.n_observations[0] < n:
        raise ValueError(f"n_observations is too small for {n} states")
    open_ = learnt.transitions.places[learnt.transitions.places != NOT_OPEN]
    if sorted(open_) != list(range(len(learnt.transitions.matrices))):
        raise ValueError("places of matrices are not those that there are")
    refuse_more_failures(learnt.outcomes)
    refuse_unless_distribution("belief", learnt.belief)
    scales = learnt.transitions.scales
    refuse_unless_distribution("a row of matrices", learnt.transitions.matrices * scales[..., None])

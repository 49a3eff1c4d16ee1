"""Many machines at once: one for each vehicle, stepped together on all cores.

Each is what `EvolvingFSM` is, bit for bit: the same step, over memory that lies in two arrays for
all vehicles. A vehicle's part of them grows with its states and with the actions it has used, so
that vehicles may differ, enter at different times, and be silent for a while.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from evofsm.fsm import (
    FULL,
    LINE,
    NO_ACTION,
    NOT_OPEN,
    Dynamics,
    EvolvingFSM,
    Inside,
    Limit,
    Memory,
    check_actions,
    check_rows,
    encoded_rows,
    fetch_ahead,
    follow,
    follow_end,
    inner_kernel,
    kernel,
    lengths,
    matrices_of,
    move,
    open_apart,
    parallel_kernel,
    real_rows,
    refuse_too_large,
    refuse_unusable,
    room_for,
    step_and_act,
    tell_of_failures,
    whole,
)

# Room for so much more than is needed when the arrays are made anew.
_SPARE = 1.5
# Lines of a vehicle that are fetched while others are stepped: all of one with eight states.
_LINES_AHEAD = 31
_SINGLE = np.dtype(np.float32)


class FleetStep(NamedTuple):
    """What the machines made of one observation each, a row for each vehicle that was observed.

    Examples
    --------
    >>> fleet = Fleet(EvolvingFSM(n_actions=1, radius=0.5), 2)
    >>> fleet.observe([[0.0], [7.0]], [0, 0]).n_states
    array([1, 1])
    """

    state: NDArray[np.int64]  #: (K,) index of the most probable state
    n_states: NDArray[np.int64]  #: (K,) number of states
    event: NDArray[np.int8]  #: (K,) values of `Event`
    surprise: NDArray[np.float64]  #: (K,) [bit], NaN where nothing was predicted


class Fleet:
    """V machines that learn side by side, each from its own vehicle.

    Parameters
    ----------
    machine : EvolvingFSM
        Each vehicle starts with a copy of it: its settings, and all that it has learnt. If it has
        `dynamics`, each vehicle has its own; they learn one after another, in Python.
    n_vehicles : int
        Number V of vehicles.
    dtype : float64 or float32
        Of the transition matrices, which are most of the memory; the rest is always float64.
        In single precision a probability is off by some 1e-7 of itself a step, and machines are
        no longer those of `EvolvingFSM` bit for bit.

    Raises
    ------
    TypeError
        If ``machine`` is no machine, or ``dtype`` is another one.
    ValueError
        If ``n_vehicles`` is no whole number of at least 1, or ``machine`` has observed nothing
        and the first observations are refused.

    Examples
    --------
    >>> fleet = Fleet(EvolvingFSM(n_actions=2, radius=0.5), 3)
    >>> for z in (0.0, 0.1, 2.0, 1.0):
    ...     step = fleet.observe([[z], [z + 1.0], [7.0]], [0, 1, 0])
    >>> step.state, fleet.n_states
    (array([1, 1, 0]), array([2, 2, 1]))
    >>> alone = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = alone.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
    >>> np.array_equal(fleet[0].transition_matrices, alone.transition_matrices)
    True
    """

    def __init__(
        self, machine: EvolvingFSM, n_vehicles: int, dtype: DTypeLike = np.float64
    ) -> None:
        if not isinstance(machine, EvolvingFSM):
            raise TypeError(f"machine is {machine!r}; it must be an EvolvingFSM")
        if np.dtype(dtype) not in (np.dtype(np.float64), _SINGLE):
            raise TypeError(f"dtype is {np.dtype(dtype)}; it must be float64 or float32")
        self._machine = machine.copy()
        self._n_vehicles = whole("n_vehicles", n_vehicles)
        self._dtype = np.dtype(dtype)
        self._everyone = np.arange(self._n_vehicles)
        moves = self._machine.dynamics
        self._dynamics: list[Dynamics] = (
            [] if moves is None else [moves.copy() for _ in self._everyone]
        )
        self._fill(Inside(machine).buffer)

    def __len__(self) -> int:
        return self._n_vehicles

    def __getitem__(self, vehicle: int) -> EvolvingFSM:
        """A copy of one vehicle's machine."""
        vehicle = range(len(self))[vehicle]
        at, at_matrices = self._at[vehicle]
        machine = self._machine.copy()
        length, of_matrices = lengths(*self._small[at : at + 4].astype(int).tolist())
        small = self._small[at : at + length]
        matrices = self._matrices[at_matrices : at_matrices + of_matrices]
        Inside(machine).use(np.concatenate([small, matrices]))
        if self._dynamics:
            Inside(machine).dynamics = self._dynamics[vehicle].copy()
        if self._dtype == _SINGLE:
            _sum_to_1(machine)
        return machine

    @property
    def n_states(self) -> NDArray[np.int64]:
        """(V,) ndarray: number of states of each machine."""
        found = np.empty(len(self), np.int64)
        _count_states(self._small, self._matrices, self._at, found)
        return found

    @property
    def nbytes(self) -> int:
        """Memory of states and transitions, with room for the next states [byte]."""
        return self._small.nbytes + self._matrices.nbytes

    def observe(
        self,
        Z: ArrayLike,
        A: ArrayLike | None = None,
        *,
        vehicles: Sequence[int] | NDArray[np.integer] | None = None,
        episode_starts: Sequence[int] | NDArray[np.integer] = (),
        failures: Sequence[int] | NDArray[np.integer] | None = None,
        executed: ArrayLike | None = None,
    ) -> FleetStep:
        """One observation of each vehicle, then the action commanded after it.

        Parameters
        ----------
        Z : (K, m) array_like
            Observations, as `EvolvingFSM.observe` takes them.
        A : (K,) array_like of int, optional
            Index of each vehicle's action, -1 where there was none; without it nobody acted.
        vehicles : (K,) array_like of int, optional
            Which vehicles were observed, each at most once; without it all, K = V. All others
            stay as they are.
        episode_starts : array_like of int
            Rows whose vehicle begins an episode with this observation.
        failures : array_like of int, optional
            Rows whose vehicle's episode ended in failure with this observation; an empty one tells
            that none did.
        executed : (K,) or (K, d) array_like, optional
            The actions themselves, as `EvolvingFSM.act` takes them.

        Returns
        -------
        FleetStep

        Raises
        ------
        TypeError, ValueError
            If anything cannot be used; no machine has then changed.

        Examples
        --------
        >>> fleet = Fleet(EvolvingFSM(n_actions=2, radius=0.5), 3)
        >>> step = fleet.observe([[0.0], [1.0]], [0, 1], vehicles=[2, 0])
        >>> fleet.n_states
        array([1, 0, 1])
        """
        rows = self._observations(Z)
        chosen = self._everyone if vehicles is None else self._vehicles(vehicles)
        if len(rows) != len(chosen):
            raise ValueError(f"there are {len(rows)} observations of {len(chosen)} vehicles")
        if A is None:
            actions = np.full(len(rows), NO_ACTION)
        else:
            actions = check_actions(A, len(rows), self._machine.n_actions)
        starts = check_rows("episode_starts", episode_starts, len(rows))
        ends = check_rows("failures", () if failures is None else failures, len(rows))
        inner: list[NDArray[np.float64] | None] = []
        if self._dynamics:
            refuse_too_large(rows)
            inner = encoded_rows(self._dynamics[0], actions, executed)
        # The number of variables is known from the first observation on.
        if len(rows) and self._small[self._at[0, 0]] == 0:
            Inside(self._machine).check(rows[:1])
            self._fill(Inside(self._machine).buffer)
        if failures is not None:
            tell_of_failures(self._small, self._at[chosen, 0])
        answer = FleetStep(
            np.empty(len(rows), np.int64),
            np.empty(len(rows), np.int64),
            np.full(len(rows), FULL, np.int8),
            np.empty(len(rows)),
        )
        before = self._look_at(chosen)
        given = chosen, rows, actions, starts, ends
        while _step_all(
            self._small, self._matrices, self._at, *given, *answer, Inside(self._machine).limit
        ):
            self._grow(chosen[answer.event == FULL])
        if self._dynamics:
            self._follow(chosen, rows, inner, starts, ends, before)
        return answer

    def start_episode(self, vehicles: Sequence[int] | NDArray[np.integer] | None = None) -> None:
        """Begin a new episode of some vehicles, or of all, as `EvolvingFSM.start_episode` does.

        Parameters
        ----------
        vehicles : sequence of int, optional
            Their indices, from 0.

        Examples
        --------
        >>> fleet = Fleet(EvolvingFSM.paper(), 3)
        >>> fleet.start_episode([0, 2])
        """
        chosen = self._everyone if vehicles is None else self._vehicles(vehicles)
        _start_episodes(self._small, self._matrices, self._at, chosen)
        for vehicle in chosen.tolist() if self._dynamics else ():
            follow_end(self._dynamics[vehicle], 0.0, failed=False)

    # -- Inside ---------------------------------------------------------------------------------

    def _look_at(self, vehicles: NDArray[np.int64]) -> NDArray[np.float64]:
        """(K, 4) for dynamics: whether in an episode, state, its identity, and the clock."""
        found = np.zeros((len(vehicles), 4))
        if self._dynamics:
            _look_at_all(self._small, self._matrices, self._at, vehicles, found)
        return found

    def _follow(
        self,
        vehicles: NDArray[np.int64],
        rows: NDArray[np.float64],
        inner: Sequence[NDArray[np.float64] | None],
        starts: NDArray[np.bool_],
        ends: NDArray[np.bool_],
        before: NDArray[np.float64],
    ) -> None:
        """Have the dynamics of each vehicle learn from its row, as those of a machine do."""
        clocks = self._look_at(vehicles)[:, 3]
        onsets = np.full(len(vehicles), -1)
        for row, vehicle in enumerate(vehicles.tolist()):
            dynamics = self._dynamics[vehicle]
            chained, failed = bool(before[row, 0]) and not starts[row], bool(ends[row])
            now = float(clocks[row])
            acted = None if failed else inner[row]
            if follow(dynamics, rows[row], now, chained=chained, failed=failed, action=acted):
                state, identity = before[row, 1:3].astype(int).tolist()
                if self[vehicle].state_ids[state] != identity:  # it was given up for another one
                    state = self[vehicle].nearest(dynamics.before).state
                onsets[row] = state
        _count_onsets(self._small, self._matrices, self._at, vehicles, onsets)

    def _fill(self, buffer: NDArray[np.float64]) -> None:
        """Every vehicle gets a copy of one machine's buffer."""
        small, matrices = np.split(buffer, [matrices_of(buffer)])
        self._small = np.tile(small, len(self))
        self._matrices = np.tile(matrices.astype(self._dtype), len(self))
        steps = np.array([len(small), len(matrices)])
        self._at = self._everyone[:, None] * steps
        self._used = steps * len(self)

    def _observations(self, Z: ArrayLike) -> NDArray[np.float64]:
        rows = real_rows("observations", Z)
        m = int(self._small[self._at[0, 0]])
        if m not in (0, rows.shape[1]):
            raise ValueError(
                f"an observation has {rows.shape[1]} variables, but these machines were started "
                f"with {m}"
            )
        refuse_unusable("observations", rows)
        return rows

    def _vehicles(self, vehicles: ArrayLike) -> NDArray[np.int64]:
        chosen = np.asarray(vehicles)
        if chosen.ndim != 1 or (chosen.dtype.kind not in "iu" and chosen.size):
            raise TypeError(f"vehicles are {vehicles!r}; they must be a list of whole numbers")
        marked = check_rows("vehicles", chosen, len(self))
        if marked.sum() != len(chosen):
            raise ValueError("a vehicle is named twice; it can be observed once at a time")
        return chosen.astype(np.int64)

    def _grow(self, vehicles: NDArray[np.int64]) -> None:
        """Move vehicles to where there is room for what their next step may need."""
        sizes, needed = self._measure(vehicles)
        if (self._used + needed.sum(axis=0) <= [len(self._small), len(self._matrices)]).all():
            begins = self._used + np.cumsum(needed, axis=0) - needed
            self._move(vehicles, sizes, self._small, self._matrices, begins)
        else:  # all of them, to larger arrays and without the holes that were left behind
            vehicles = self._everyone
            sizes, needed = self._measure(vehicles)
            small, matrices = (_SPARE * needed.sum(axis=0)).astype(int).tolist()
            begins = np.cumsum(needed, axis=0) - needed
            self._move(vehicles, sizes, np.zeros(small), np.zeros(matrices, self._dtype), begins)
        self._used = begins[-1] + needed[-1]

    def _measure(self, vehicles: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The sizes (K, 4) of vehicles' buffers with room for the next step, and their lengths."""
        sizes, needed = np.empty((len(vehicles), 4), np.int64), np.empty((len(vehicles), 2), int)
        _measure_all(self._small, self._matrices, self._at, vehicles, sizes, needed)
        return sizes, needed

    def _move(
        self,
        vehicles: NDArray[np.int64],
        sizes: NDArray[np.int64],
        small: NDArray[np.float64],
        matrices: NDArray[Any],
        begins: NDArray[np.int64],
    ) -> None:
        _move_all(self._small, self._matrices, self._at, vehicles, sizes, small, matrices, begins)
        self._small, self._matrices = small, matrices
        self._at[vehicles] = begins


def _sum_to_1(machine: EvolvingFSM) -> None:
    """Make rows distributions to the last digit again, which single precision does not keep."""
    n, transitions = machine.n_states, Inside(machine).memory.learnt.transitions
    sums = (transitions.scales[..., None] * transitions.matrices)[:, :n, :n].sum(axis=2)
    transitions.scales[:, :n] /= np.where(sums > 0.0, sums, 1.0)


@inner_kernel
def _open(small: NDArray[np.float64], matrices: NDArray[Any], at: NDArray[np.int64]) -> Memory:
    """One vehicle's memory."""
    return open_apart(small[at[0] :], matrices[at[1] :])


@parallel_kernel
def _step_all(
    small: NDArray[np.float64],
    matrices: NDArray[Any],
    at: NDArray[np.int64],
    vehicles: NDArray[np.int64],
    observations: NDArray[np.float64],
    actions: NDArray[np.int64],
    starts: NDArray[np.bool_],
    failures: NDArray[np.bool_],
    state: NDArray[np.int64],
    n_states: NDArray[np.int64],
    event: NDArray[np.int8],
    surprise: NDArray[np.float64],
    limit: Limit,
) -> int:
    """Step those that did not step yet; returns how many could not for want of room.

    Its arrays are not in tuples: Numba loses what a ``prange`` writes to an array in a tuple.
    """
    full = 0
    for row in numba.prange(len(vehicles)):
        if row + 2 < len(vehicles):  # a vehicle's memory is far away until it is asked for
            _fetch_states(small, at[vehicles[row + 2]])
            _fetch_matrix(small, matrices, at[vehicles[row + 1]])
        if event[row] == FULL:
            n_states[row], event[row], state[row], surprise[row] = _step_one(
                small,
                matrices,
                at[vehicles[row]],
                observations[row],
                actions[row],
                starts[row],
                failures[row],
                limit,
            )
            full += event[row] == FULL
    return full


@inner_kernel
def _fetch_states(small: NDArray[np.float64], at: NDArray[np.int64]) -> None:
    """Have a vehicle's states brought near, while others are stepped.

    How many it has is not asked: that would be waiting for what is far away.
    """
    for line in range(_LINES_AHEAD):
        fetch_ahead(small, at[0] + line * LINE)


@inner_kernel
def _fetch_matrix(
    small: NDArray[np.float64], matrices: NDArray[Any], at: NDArray[np.int64]
) -> None:
    """The same of the matrix that its latest action is about."""
    now = _open(small, matrices, at).learnt
    action = int(now.action[0])
    if action == NO_ACTION or now.transitions.places[action] == NOT_OPEN:
        return
    held, place, capacity = now.transitions, int(now.transitions.places[action]), len(now.belief)
    counted = now.outcomes
    for of_places in (
        held.scales,
        held.origin_frequency,
        counted.decisions,
        counted.tried,
        counted.latest_try,
    ):
        fetch_ahead(of_places, place * capacity)
    size = capacity * capacity
    for i in range(0, min(size, _LINES_AHEAD * LINE), LINE):
        fetch_ahead(held.matrices, place * size + i)


@inner_kernel
def _step_one(
    small: NDArray[np.float64],
    matrices: NDArray[Any],
    at: NDArray[np.int64],
    z: NDArray[np.float64],
    action: int,
    starts: bool,
    failed: bool,
    limit: Limit,
) -> tuple[int, int, int, float]:
    memory = _open(small, matrices, at)
    event, state, surprise = step_and_act(memory, z, action, starts, failed, False, limit)
    return int(memory.learnt.n_states[0]), event, state, surprise


@kernel
def _start_episodes(
    small: NDArray[np.float64],
    matrices: NDArray[Any],
    at: NDArray[np.int64],
    vehicles: NDArray[np.int64],
) -> None:
    for vehicle in vehicles:
        now = _open(small, matrices, at[vehicle]).learnt
        now.chained[0] = 0.0
        now.action[0] = NO_ACTION


@kernel
def _count_states(
    small: NDArray[np.float64],
    matrices: NDArray[Any],
    at: NDArray[np.int64],
    found: NDArray[np.int64],
) -> None:
    for vehicle in range(len(at)):
        found[vehicle] = int(_open(small, matrices, at[vehicle]).learnt.n_states[0])


@kernel
def _look_at_all(
    small: NDArray[np.float64],
    matrices: NDArray[Any],
    at: NDArray[np.int64],
    vehicles: NDArray[np.int64],
    found: NDArray[np.float64],
) -> None:
    for row in range(len(vehicles)):
        now = _open(small, matrices, at[vehicles[row]]).learnt
        found[row, 0], found[row, 1] = now.chained[0], now.state[0]
        if now.n_states[0] > 0.0:
            found[row, 2] = now.ids[int(now.state[0])]
        found[row, 3] = now.outcomes.clock[0]


@kernel
def _count_onsets(
    small: NDArray[np.float64],
    matrices: NDArray[Any],
    at: NDArray[np.int64],
    vehicles: NDArray[np.int64],
    states: NDArray[np.int64],
) -> None:
    for row in range(len(vehicles)):
        if states[row] >= 0:
            _open(small, matrices, at[vehicles[row]]).learnt.outcomes.onsets[states[row]] += 1.0


@kernel
def _measure_all(
    small: NDArray[np.float64],
    matrices: NDArray[Any],
    at: NDArray[np.int64],
    vehicles: NDArray[np.int64],
    sizes: NDArray[np.int64],
    needed: NDArray[np.int64],
) -> None:
    for row in range(len(vehicles)):
        memory = _open(small, matrices, at[vehicles[row]])
        now = memory.learnt
        m, q = len(now.clusters.first), len(now.transitions.uses)
        capacity, places = room_for(memory)
        sizes[row, 0], sizes[row, 1], sizes[row, 2], sizes[row, 3] = m, q, capacity, places
        needed[row, 0], needed[row, 1] = lengths(m, q, capacity, places)


@kernel
def _move_all(
    small: NDArray[np.float64],
    matrices: NDArray[Any],
    at: NDArray[np.int64],
    vehicles: NDArray[np.int64],
    sizes: NDArray[np.int64],
    to_small: NDArray[np.float64],
    to_matrices: NDArray[Any],
    begins: NDArray[np.int64],
) -> None:
    for row in range(len(vehicles)):
        source, target = at[vehicles[row]], begins[row]
        for i in range(4):
            to_small[target[0] + i] = sizes[row, i]
        move(
            small[source[0] :],
            matrices[source[1] :],
            to_small[target[0] :],
            to_matrices[target[1] :],
        )

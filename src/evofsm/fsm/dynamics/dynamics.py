"""How a system moves, what disturbs it and where it fails: learnt online beside the states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.fsm.dynamics.ahead import are_misleading, misled_by_lags
from evofsm.fsm.dynamics.consequents import (
    Consequents,
    Disturbances,
    Here,
    Stretch,
    is_unforeseen,
    lags,
    n_features,
    n_products,
    pack,
    residuals,
)
from evofsm.fsm.dynamics.drift import (
    LEARNT,
    Drift,
    Recent,
    as_it_was,
    compared,
    correction,
)
from evofsm.fsm.dynamics.failures import explain_failures, probe
from evofsm.fsm.dynamics.observer import best_gains, corrected, tried, untried
from evofsm.fsm.dynamics.regression import (
    MOVING,
    Sums,
    count_ends,
    have_jumped,
    learn_latest,
    solve,
    take_in,
)
from evofsm.fsm.dynamics.undoing import Whole, held, side_by_side
from evofsm.fsm.validation import real_array, refuse_unusable, whole

_Floats = NDArray[np.float64]

#: Parts that can be left out, to see what each is worth.
DYNAMICS_PARTS: tuple[str, ...] = (
    *("stretches", "memory", "products", "lags", "doubt", "jumps", "carried", "drift"),
    "observer",
)

# Observations before anything is expected: an episode may fail after so few.
_FIRST = 8
# Of what was learnt so far, what still counts an episode later.
_KEPT = 0.999
# Steps, and between how many of them weights are solved for again.
_SCHEDULE = ((300, 5), (1500, 20))
# Residuals of so many scales are the onset of a stretch; at most so many an episode, so far apart.
ONSET, _ONSETS, APART = 4.0, 3, 3
# A stretch has at least so many steps.
_SHORTEST = 4
# An episode that goes on for so many steps is studied, and goes on.
_LONGEST = 1024
# An extreme is a saturation if it was reached, by moving, in so many episodes, or if a variable
# rested there although it was expected to go on.
_REACHED = 2
MOST_KEPT = 200
# Jumps that would have shown no dependence, for each variable.
_JUMP_PRIOR = 3.0
# Of one that is where it saturates, a noisy sensor may say that it is so many residuals from there.
_CLOSE = 3.0
# So many times the stretches that are kept there may be until somebody chooses.
_SPARE = 4


class Episode(NamedTuple):
    """An episode that is over, without the transition that failed."""

    observations: _Floats  #: (T + 1, m)
    actions: _Floats  #: (T, a)
    residuals: _Floats  #: (T - 1, m) what was not expected, from the second observation on
    failed: bool


class Dynamics:
    """Learns how a system moves under actions, what disturbs it for a while, and where it fails.

    It is told nothing of the system but observations, actions and which episodes failed. Give one
    to `EvolvingFSM`, which feeds it; by itself it is fed by `observe`, `act` and `end`.

    Parameters
    ----------
    low, high : array_like, optional
        Range of the action, where that is one number or several, in the unit of the action.
    n_actions : int, optional
        Number of actions, where they are told apart by their index alone.
    horizon : int
        Steps of a stretch.
    stretches : int
        Number of stretches that are kept where somebody chooses among them (`keep`); of those that
        nobody has chosen yet, the newest, so that there are at most four times as many.
    without : sequence of str
        Parts of `DYNAMICS_PARTS` that are left out.

    Raises
    ------
    ValueError
        If not one of a range and ``n_actions`` is given, ``low`` is not below ``high`` or not
        finite, a number is no whole number of at least 1, or ``without`` names no part.

    Notes
    -----
    Each variable's change is linear in the observation, its latest change, the action, the one
    before, bends of the action and products of variables and actions (the consequents of eTS,
    Angelov & Filev 2004), learnt by sums that machines can add up. Where a system fails is known
    only after it failed there once, or where it is told; nothing here says that something is safe.

    Examples
    --------
    A cart that is pushed by the action, to the left, not at all or to the right:

    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=3, radius=0.5, dynamics=Dynamics(n_actions=3))
    >>> draw, speed = np.random.default_rng(0), 0.0
    >>> for t in range(80):
    ...     i = int(draw.integers(3))
    ...     step = machine.learn_one([speed], i)
    ...     speed += 0.1 * (i - 1) - 0.1 * speed
    >>> machine.start_episode()
    >>> machine.dynamics.n_episodes, machine.dynamics.ready
    (1, True)
    """

    sums: Sums

    def __init__(
        self,
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
        *,
        n_actions: int | None = None,
        horizon: int = 48,
        stretches: int = 16,
        without: Sequence[str] = (),
    ) -> None:
        self.choices = 0 if n_actions is None else whole("n_actions", n_actions)
        self.low, self.high = _range(low, high, is_none=n_actions is not None)
        self._middle, self._half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        self.size = self.choices or len(self.low)
        self.horizon = whole("horizon", horizon)
        self.n_stretches = whole("stretches", stretches)
        if unknown := set(without) - set(DYNAMICS_PARTS):
            raise ValueError(
                f"without names {sorted(unknown)}; there are {', '.join(DYNAMICS_PARTS)}"
            )
        self.without = frozenset(without)
        self.n_variables = 0
        self.told: Callable[[_Floats], bool] | None = None
        self.stretches: list[Stretch] = []
        self.n_episodes = 0
        self.latest: Episode | None = None
        self.used = np.zeros((self.size, 2))
        self.is_noisy = False
        self.clock = 0.0  # of the machine that feeds it, at the latest observation
        self.quiet = 0.0  # observations since one that was not expected
        self._begin()

    @property
    def settings(self) -> dict[str, Any]:
        """What it was made with, by name."""
        told: dict[str, Any] = {"horizon": self.horizon, "stretches": self.n_stretches}
        if self.choices:
            told["n_actions"] = self.choices
        else:
            told |= {"low": self.low.tolist(), "high": self.high.tolist()}
        return told | {"without": sorted(self.without)}

    def copy(self) -> Self:
        """One of its own in the same state; ``told``, which is code, is shared.

        Returns
        -------
        Dynamics

        Examples
        --------
        >>> Dynamics(n_actions=2).copy()
        Dynamics(n_actions=2, 0 episodes, 0 variables, 0 stretches)
        """
        twin = object.__new__(type(self))
        twin.__dict__.update(held(self))
        return twin

    def frozen(self) -> Self:
        """A copy to be asked, of which nobody learns any more: of the episode it has the end.

        Returns
        -------
        Dynamics

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> for t in range(40):
        ...     dynamics.observe(np.array([t % 7.0]))
        ...     dynamics.act(dynamics.encode(t % 2))
        >>> len(dynamics.frozen().under_way[0])
        2
        """
        twin = self.copy()
        twin._Z, twin._U = twin._Z[-2:], twin._U[max(0, len(twin._Z) - 2) :]
        twin.latest = None
        return twin

    def __copy__(self) -> Self:
        return self.copy()

    def __deepcopy__(self, memo: Any) -> Self:
        return self.copy()

    def __getstate__(self) -> dict[str, Any]:
        return held(self) | {"told": None}  # code is told again

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if self.n_variables:
            self.sums = side_by_side(self.sums)

    @property
    def most_stretches(self) -> int:
        """Number of stretches up to which nobody has to choose."""
        return _SPARE * self.n_stretches

    @property
    def consequents(self) -> Consequents:
        """What is expected, as kernels see it."""
        return self._consequents

    @consequents.setter
    def consequents(self, known: Consequents) -> None:
        self._consequents, self._packed = known, pack(known)
        #: Whether some variables are not taken as they are seen.
        self.is_noisy = bool((known.gains < 1.0).any())

    @property
    def whole(self) -> Whole:
        """A context in which all is learnt, or nothing where it is broken off."""
        if not self.n_variables:
            return Whole(self)
        return Whole(self, self.sums.counts.base)

    def __repr__(self) -> str:
        actions = f"n_actions={self.choices}"
        if not self.choices:
            low, high = (edge.tolist() for edge in (self.low, self.high))
            actions = f"low={low[0]}, high={high[0]}" if self.size == 1 else f"{low=}, {high=}"
        counts = {"episode": self.n_episodes, "variable": self.n_variables}
        counts["stretch"] = len(self.stretches)
        return f"{type(self).__name__}({actions}, {', '.join(map(_some, counts, counts.values()))})"

    # -- Actions --------------------------------------------------------------------------------

    def encode(self, action: Any) -> _Floats:
        """(a,) what kernels call an action.

        Parameters
        ----------
        action : int, float or array_like
            As it was executed, in its own unit.

        Returns
        -------
        (a,) ndarray
            In [-1, 1], or a one among zeros.

        Examples
        --------
        >>> Dynamics(-2.5, 2.5).encode(1.25), Dynamics(n_actions=3).encode(2)
        (array([0.5]), array([0., 0., 1.]))
        """
        if self.choices:
            chosen = np.zeros(self.choices)
            chosen[int(action)] = 1.0
            return chosen
        scaled: _Floats = (np.asarray(action, np.float64) - self._middle) / self._half
        return scaled

    def decode(self, inner: _Floats) -> _Floats:
        """(d,) the action itself; the index of a choice.

        Parameters
        ----------
        inner : (a,) ndarray
            As `encode` returns it.

        Returns
        -------
        (d,) ndarray

        Examples
        --------
        >>> Dynamics(-2.5, 2.5).decode(np.array([0.5]))
        array([1.25])
        """
        if self.choices:
            return np.array([float(inner.argmax())])
        found: _Floats = self._middle + self._half * inner
        return np.minimum(np.maximum(found, self.low), self.high)

    # -- Learning -------------------------------------------------------------------------------

    def _begin(self) -> None:
        self._Z: list[_Floats] = []
        self._U: list[_Floats] = []

    def begin(self, z: _Floats) -> None:
        """Make room for what is learnt; variables are counted from the first observation on.

        Parameters
        ----------
        z : (m,) ndarray
            The first observation.

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> dynamics.begin(np.zeros(3))
        >>> dynamics.n_variables
        3
        """
        m, a = len(z), self.size
        p = n_features(m, a, box=not self.choices)
        self.n_variables = m
        self.origin = z.copy()
        sums = Sums(
            counts=np.zeros(2),
            squares=np.zeros((p, p)),
            products=np.zeros((p, m)),
            mean=np.zeros(m),
            scatter=np.zeros(m),
            variance=np.zeros(m),
            unit=np.zeros(m),
            early=np.zeros((200, m)),
            least=np.zeros(m),
            most=np.zeros(m),
            scale=np.zeros(m),
            noise=np.zeros(m),
            low=z.copy(),
            high=z.copy(),
            moving=np.zeros(m),
        )
        self.sums = side_by_side(sums)
        self.lowest, self.highest = np.full(m, np.inf), np.full(m, -np.inf)
        self.reached = np.zeros((m, 2))
        self.failures: list[_Floats] = []
        self.jumps: list[list[_Floats]] = [[] for _ in range(m)]
        self.sides: list[tuple[int, float, float]] = []
        #: What the last episodes say of the model, and where it was corrected, by time.
        self.recent = Recent.nothing(p, m, self.n_episodes)
        self.drifts: list[Drift] = []
        self.weights = np.zeros((p, m))
        #: What gains of its observer miss.
        self.missed = untried(m)
        #: That latest changes and the previous action foresee anything but one step.
        self.doubt_of_lags = 0.0
        self.ready = False
        self._jumped = np.zeros(m)
        self._rebuild()

    def observe(self, z: _Floats) -> None:
        """Take in an observation, and learn the transition before the one to it.

        Parameters
        ----------
        z : (m,) ndarray
            Observation, all finite.

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> dynamics.observe(np.array([1.0]))
        >>> dynamics.here.z
        array([1.])
        """
        if not self.n_variables:
            self.begin(z)
        if len(self._Z) >= _LONGEST:
            self._study(failed=False)
            self._Z, self._U = self._Z[-3:], self._U[-3:]  # the last transition is learnt next
        self._Z.append(z.copy())
        sums = self.sums
        take_in(sums.counts, sums.mean, sums.scatter, z, self.origin)
        if self.told is not None and not self.sides and sums.counts[1] >= 1.0:
            self.sides = probe(self.told, z, np.where(sums.unit > 0.0, sums.unit, 1e-9))
            self._rebuild()
        if len(self._Z) >= 3:
            self._learn(len(self._Z) - 3)
        n = float(sums.counts[0])
        if not self.ready:
            if n % 20 == 0:
                self._solve()
            return
        for until, every in _SCHEDULE:
            if n < until:
                if n % every == 0:
                    self._solve()
                break

    def act(self, action: _Floats) -> None:
        """What was done after the latest observation, as `encode` returns it.

        Parameters
        ----------
        action : (a,) ndarray
            As `encode` returns it; a second one replaces the first.

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> dynamics.observe(np.array([1.0]))
        >>> dynamics.act(dynamics.encode(1))
        >>> dynamics.has_acted
        True
        """
        lowest = -1.0 if self.choices else -0.6
        for replaced in self._U[len(self._Z) - 1 :]:
            count_ends(self.used, replaced, lowest, -1.0)
        del self._U[len(self._Z) - 1 :]
        self._U.append(action)
        count_ends(self.used, action, lowest, 1.0)

    def end(self, *, failed: bool) -> None:
        """The episode is over; its last observation was taken in.

        Parameters
        ----------
        failed : bool
            Whether it ended in failure with the latest observation.

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> for t in range(40):
        ...     dynamics.observe(np.array([t % 7.0]))
        ...     dynamics.act(dynamics.encode(t % 2))
        >>> dynamics.observe(np.array([9.0]))
        >>> dynamics.end(failed=True)
        >>> dynamics.sides
        [(0, 1.0, 6.0)]
        """
        if self.n_variables:
            if not failed and len(self._Z) > 2 and len(self._U) >= len(self._Z) - 1:
                self._learn(len(self._Z) - 2)
            self._study(failed=failed)
        self._begin()

    def begins(self) -> bool:
        """Whether the latest change is the first for a while that was not expected; ask it once.

        Returns
        -------
        bool

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> dynamics.observe(np.array([1.0]))
        >>> dynamics.begins()
        False
        """
        self.quiet += 1.0
        if not self.is_surprised:
            return False
        was_quiet, self.quiet = self.quiet > APART, 0.0
        return was_quiet

    def forget_episode(self) -> None:
        """Nothing is under way; nothing more is learnt of what was.

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> dynamics.observe(np.array([1.0]))
        >>> dynamics.forget_episode()
        >>> dynamics.is_under_way
        False
        """
        self._begin()

    def break_off(self) -> None:
        """What comes does not follow from what was.

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> for t in range(40):
        ...     dynamics.observe(np.array([t % 7.0]))
        ...     dynamics.act(dynamics.encode(t % 2))
        >>> dynamics.break_off()
        >>> dynamics.n_episodes, dynamics.is_under_way
        (1, False)
        """
        if self.n_variables and len(self._Z) > 2:
            self._study(failed=False)
        self._begin()

    def _learn(self, i: int) -> None:
        """From the transition i -> i + 1."""
        Z, last, first = self._Z, i + 2 >= len(self._Z), i == 0
        before, after = max(i - 1, 0), i + 1 if last else i + 2
        jumped = self._jumped
        learnt: Any = self.sums.counts.base
        if learn_latest(
            learnt,
            self._packed,
            self.choices,
            *(Z[before], Z[i], Z[i + 1], Z[after]),
            *(self._U[before], self._U[i]),
            first,
            last,
            jumped,
        ):
            if first:
                return
            for j in np.flatnonzero(jumped):
                known = self.jumps[j][1 - MOST_KEPT :]
                self.jumps[j] = [*known, np.append(Z[i], Z[i + 1][j])]

    def _solve(self) -> None:
        if self.sums.counts[0] < _FIRST:
            return
        with suppress(np.linalg.LinAlgError):  # numbers of sizes that have nothing in common
            weights = self._solved("lags" in self.without or are_misleading(self.doubt_of_lags))
            if np.isfinite(weights).all():
                self.weights, self.ready = weights, True
        self._rebuild()

    def _solved(self, without_lags: bool) -> _Floats:
        m, a = self.n_variables, self.size
        left_out = np.zeros(len(self.sums.squares))
        if "products" in self.without:
            left_out[len(left_out) - n_products(m, a) :] = 1.0
        if without_lags:
            left_out[lags(m, a)] = 1.0
        return solve(self.sums, m, a, left_out)

    def refute(self, starts: NDArray[np.int64], steps: int) -> None:
        """Hold the model against what came from where it had foreseen failure that never came.

        Parameters
        ----------
        starts : (k,) ndarray of int
            Observations of the latest episode from which it went on for so many steps, from 0.
        steps : int

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> for t in range(40):
        ...     dynamics.observe(np.array([t % 7.0]))
        ...     dynamics.act(dynamics.encode(t % 2))
        >>> dynamics.end(failed=False)
        >>> dynamics.refute(np.array([3, 4]), 20)
        >>> 0.0 <= dynamics.doubt_of_lags <= 1.0
        True
        """
        assert self.latest is not None
        Z, U = self.latest.observations, self.latest.actions
        starts = starts[starts <= len(U) - steps]
        if not len(starts) or "doubt" in self.without:
            return
        known, was = self.consequents, are_misleading(self.doubt_of_lags)
        with suppress(np.linalg.LinAlgError):
            asked, left_out = (
                known._replace(weights=self._solved(without)) for without in (False, True)
            )
            worse = misled_by_lags(asked, left_out, Z, U, starts, steps, self.sums.unit)
            if self.latest.failed:
                worse = max(0.0, worse)
            self.doubt_of_lags = max(0.0, self.doubt_of_lags + worse)
        if are_misleading(self.doubt_of_lags) != was:
            self._solve()

    def _rebuild(self) -> None:
        sums = self.sums
        reach = 1.5 * np.maximum(np.abs(sums.least), np.abs(sums.most))
        lowest = np.where(self.reached[:, 0] >= _REACHED, self.lowest, -np.inf)
        highest = np.where(self.reached[:, 1] >= _REACHED, self.highest, np.inf)
        for j, sign, _ in self.sides:  # one does not saturate where one fails
            (lowest if sign < 0.0 else highest)[j] = sign * np.inf
        variance = sums.scatter / max(1.0, sums.counts[0] - 1.0)
        worth = 1.0 / (1.25 * sums.unit + 1e-300)
        inverse = 1.0 / np.sqrt(np.where(variance > 0.0, variance, 1.0))
        gains = best_gains(self.missed)
        self.consequents = Consequents(
            weights=self.weights,
            origin=self.origin,
            reach=reach,
            lowest=lowest,
            highest=highest,
            least=sums.least.copy(),
            most=sums.most.copy(),
            sides=np.array(
                [[j, sign, at, worth[j]] for j, sign, at in self.sides], np.float64
            ).reshape(-1, 4),
            anew=self.anew,
            mean=self.origin + sums.mean,
            inverse=inverse,
            close=np.where(gains < 1.0, _CLOSE * np.sqrt(sums.noise), 1e-9 / inverse),
            gains=gains,
            choices=self.choices,
        )

    def _study(self, *, failed: bool) -> None:
        """Learn from an episode as a whole."""
        Z, U = np.array(self._Z), np.array(self._U).reshape(-1, self.size)
        safe = Z[:-1] if failed else Z
        self._extremes(safe)
        if failed:
            self.failures = [*self.failures[1 - MOST_KEPT :], Z[-1]]
        self.settle()
        self.sums.squares[:] *= _KEPT
        self.sums.products[:] *= _KEPT
        self.latest = None
        T = len(safe) - 1
        if self.ready and T > 4:
            if self.sums.scale[0] > 0.0:
                if "drift" not in self.without:
                    self._follow_drift(safe, U[:T])
                if "observer" not in self.without:
                    self.missed = tried(self.missed, self.consequents, safe, U[:T], self.sums.unit)
                    self._rebuild()
            found = np.zeros((T - 1, self.n_variables))
            residuals(self.consequents, Z, U, T - 1, False, found)
            self._held(found, safe)
            self._rescale(found, safe)
            self.latest = Episode(safe, U[:T], found, failed)
            if "stretches" not in self.without:
                self.remember(self.onsets(found))
        self.n_episodes += 1

    def _follow_drift(self, Z: _Floats, U: _Floats) -> None:
        """Correct the model of what moves otherwise; what was unforeseen before stays so."""
        sums, before, young = self.sums, self.consequents, self._young
        self.recent = compared(self.recent, before, sums, Z, U, self.n_episodes, bool(young))
        begun = self.recent.overthrown()
        self.drifts += [Drift(j, int(self.recent.since[j]), self.n_episodes) for j in begun]
        moved = sorted({*begun, *young})
        if not moved:
            return
        change = np.diff(Z, axis=0)
        change[have_jumped(change, sums.unit)] = 0.0
        sums.least[begun], sums.most[begun] = change.min(0)[begun], change.max(0)[begun]
        self.weights = self.weights.copy()
        self.weights[:, moved] += correction(self.recent, before.weights, sums, self.size)[:, moved]
        sums.products[:, moved] = sums.squares @ self.weights[:, moved]
        self._solve()
        self.stretches = [
            as_it_was(one, before, self.consequents, moved, self._carried) for one in self.stretches
        ]
        self.recent.doubt[moved], self.recent.since[moved] = 0.0, float(self.n_episodes)

    @property
    def anew(self) -> _Floats:
        """(m,) 1 of variables that move otherwise than they did, -1 of others then; 0 without."""
        found = np.full(self.n_variables, -1.0 if self.drifts else 0.0)
        found[[one.variable for one in self.drifts]] = 1.0
        return found

    @property
    def _carried(self) -> bool:
        return "carried" not in self.without

    @property
    def _young(self) -> list[int]:
        """Variables of which the model was corrected a short while ago."""
        return [one.variable for one in self.drifts if self.n_episodes - one.noticed < LEARNT]

    def settle(self) -> None:
        """Make of all sums what is known: weights, and where it fails.

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> for t in range(40):
        ...     dynamics.observe(np.array([t % 7.0]))
        ...     dynamics.act(dynamics.encode(t % 2))
        >>> dynamics.settle()
        >>> dynamics.ready
        True
        """
        self._solve()
        if self.told is None:
            self.sides = explain_failures(
                np.array(self.failures).reshape(-1, self.n_variables),
                self.lowest,
                self.highest,
                np.maximum(self.sums.unit, 1e-300),
                np.where(self.reached < _REACHED, self.sums.scale[:, None], 0.0),
            )
        self._rebuild()

    def _extremes(self, safe: _Floats) -> None:
        """How far variables went, and in how many episodes they came to those ends by moving."""
        if not len(safe):
            return
        low, high = safe.min(0), safe.max(0)
        self.lowest, self.highest = self.lowest.copy(), self.highest.copy()
        self.reached = self.reached.copy()
        for j in range(self.n_variables):
            close = 1e-9 * (high[j] - low[j])
            if low[j] < self.lowest[j] - close:
                self.lowest[j], self.reached[j, 0] = low[j], 0.0
            if high[j] > self.highest[j] + close:
                self.highest[j], self.reached[j, 1] = high[j], 0.0
            moving = (
                np.abs(np.diff(safe[:, j])) > close
            )  # it arrived there, and did not start there
            self.reached[j, 0] += ((safe[1:, j] <= self.lowest[j] + close) & moving).any()
            self.reached[j, 1] += ((safe[1:, j] >= self.highest[j] - close) & moving).any()

    def _held(self, found: _Floats, safe: _Floats) -> None:
        """Know ends by variables that rested there although they were expected to go on.

        Whoever never leaves an end does not come to it by moving.
        """
        rests, far = safe[1:-1] == safe[2:], ONSET * self.sums.scale
        held = np.column_stack(
            [
                (rests & (safe[2:] == self.lowest) & (found > far)).any(0),
                (rests & (safe[2:] == self.highest) & (found < -far)).any(0),
            ]
        )
        held[(self.sums.moving <= MOVING) | (self.sums.scale[0] == 0.0)] = False
        if held.any():
            np.maximum(self.reached, _REACHED, out=self.reached, where=held)
            self._rebuild()

    def _rescale(self, found: _Floats, safe: _Floats) -> None:
        sums, size = self.sums, np.abs(found)
        at_end = (safe[2:] == sums.low) | (safe[2:] == sums.high)
        size[(safe[1:-1] == safe[2:]) & at_end & (sums.moving > MOVING)] = 0.0
        scale = 1.4826 * np.median(size, 0)
        known = sums.scale[0] > 0.0
        new = 0.8 * sums.scale + 0.2 * scale if known else scale
        square = (size**2).mean(0)
        if young := self._young:  # what is learnt anew is no outlier
            jumped = have_jumped(np.diff(safe[1:], axis=0), sums.unit)
            ordinary = np.where(jumped, 0.0, size**2).mean(0)
            new[young] = np.maximum(new, np.sqrt(ordinary))[young]
        sums.scale[:] = np.maximum(new, 1e-3 * np.sqrt(sums.variance) + 1e-300)
        sums.noise[:] = 0.8 * sums.noise + 0.2 * square if known else square

    def onsets(self, found: _Floats) -> list[int]:
        """Steps of an episode at which something large began.

        Parameters
        ----------
        found : (T, m) ndarray
            What was not expected.

        Returns
        -------
        list of int

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> for t in range(40):
        ...     dynamics.observe(np.array([t % 7.0]))
        ...     dynamics.act(dynamics.encode(t % 2))
        >>> dynamics.end(failed=False)
        >>> found = np.zeros((20, 1))
        >>> found[7] = 100.0 * dynamics.sums.scale
        >>> dynamics.onsets(found)
        [7]
        """
        size = np.abs(found / self.sums.scale).max(1)
        starts: list[int] = []
        while len(starts) < _ONSETS and size.max() >= ONSET:
            t = int(size.argmax())
            starts.append(t)
            size[max(0, t - APART) : t + APART + 1] = 0.0
        return starts

    def remember(self, starts: Sequence[int]) -> None:
        """Keep the stretches of the latest episode that begin at these steps of its residuals.

        Parameters
        ----------
        starts : sequence of int
            From 0.

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> for t in range(40):
        ...     dynamics.observe(np.array([t % 7.0]))
        ...     dynamics.act(dynamics.encode(t % 2))
        >>> dynamics.end(failed=False)
        >>> before = len(dynamics.stretches)
        >>> dynamics.remember([3])
        >>> len(dynamics.stretches) - before
        1
        """
        assert self.latest is not None
        Z, U = self.latest.observations, self.latest.actions
        for t in starts:
            L = min(self.horizon, len(U) - 1 - t)
            if L >= _SHORTEST:
                observed, done = Z[t : t + L + 2].copy(), U[t : t + L + 1].copy()
                nothing = np.empty((0, self.n_variables))
                self.stretches.append(Stretch(observed, done, self.n_episodes, nothing))
        self.stretches = self.stretches[-self.most_stretches :]

    def keep(self, which: Sequence[int]) -> None:
        """Forget all stretches but these.

        Parameters
        ----------
        which : sequence of int
            Numbers of stretches, from 0.

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> for t in range(40):
        ...     dynamics.observe(np.array([t % 7.0]))
        ...     dynamics.act(dynamics.encode(t % 2))
        >>> dynamics.end(failed=False)
        >>> dynamics.keep([])
        >>> dynamics.stretches
        []
        """
        self.stretches = [self.stretches[k] for k in which]

    # -- What it says ---------------------------------------------------------------------------

    @property
    def here(self) -> Here:
        """Where one is."""
        z = self._Z[-1]
        change = z - self._Z[-2] if len(self._Z) > 1 else np.zeros(len(z))
        before = self._U[len(self._Z) - 2] if len(self._Z) > 1 else np.zeros(self.size)
        return Here(z, change, before)

    @property
    def under_way(self) -> tuple[_Floats, _Floats]:
        """(T, m) observations and (T or T - 1, a) actions of the episode that is going on."""
        Z, U = np.array(self._Z), np.array(self._U)
        return Z.reshape(-1, self.n_variables), U.reshape(-1, self.size)

    def go_on(self, observations: _Floats, actions: _Floats) -> None:
        """Be in an episode of which this was observed and done.

        Parameters
        ----------
        observations : (T, m) ndarray
        actions : (T or T - 1, a) ndarray
            As `encode` returns them.

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> dynamics.begin(np.zeros(1))
        >>> dynamics.go_on(np.zeros((2, 1)), np.eye(2)[:1])
        >>> dynamics.has_acted
        False
        """
        self._Z, self._U = list(observations), list(actions)

    @property
    def is_under_way(self) -> bool:
        """Whether something was observed in this episode."""
        return self.n_under_way > 0

    @property
    def n_under_way(self) -> int:
        """Number of observations of this episode that are not studied yet."""
        return len(self._Z)

    @property
    def has_acted(self) -> bool:
        """Whether it is known what was done after the latest observation."""
        return len(self._U) >= len(self._Z) > 0

    @property
    def before(self) -> _Floats:
        """(m,) the last but one observation of this episode."""
        return self._Z[-2]

    @property
    def is_surprised(self) -> bool:
        """Whether something in the latest change was not expected."""
        Z, U, n = self._Z, self._U, len(self._Z)
        scale = self.sums.scale
        if n < 3 or not self.ready or not scale[0] > 0.0:
            return False
        latest = Z[-3], Z[-2], Z[-1], U[n - 3], U[n - 2]
        return bool(is_unforeseen(self._packed, self.choices, *latest, scale, ONSET))

    def corrected(self, here: Here, action: _Floats, seen: _Floats) -> _Floats:
        """Where one is, from what was expected and what is seen.

        Parameters
        ----------
        here : Here
            Where one was a step ago, as it was corrected.
        action : (a,) ndarray
            What was done then, as `encode` returns it.
        seen : (m,) ndarray
            What is observed now.

        Returns
        -------
        (m,) ndarray
            ``seen`` itself as long as no sensor is known to be noisy.

        Examples
        --------
        >>> dynamics, draw = Dynamics(n_actions=2), np.random.default_rng(0)
        >>> for episode in range(30):
        ...     x = 0.0
        ...     for t in range(60):
        ...         i = int(draw.integers(2))
        ...         dynamics.observe(np.array([x + draw.normal()]))
        ...         dynamics.act(dynamics.encode(i))
        ...         x += 2.0 * i - 1.0
        ...     dynamics.end(failed=False)
        >>> dynamics.is_noisy
        True
        >>> here = Here(np.zeros(1), np.zeros(1), dynamics.encode(0))
        >>> dynamics.corrected(here, dynamics.encode(1), np.array([2.0])).round(1)
        array([1.3])
        """
        if not self.is_noisy:
            return seen
        return corrected(self.consequents, here, action, seen, self.sums.unit)

    def disturbances(self, steps: int | None = None) -> Disturbances:
        """Residuals of what is remembered, as they are seen now; number 0 is none at all.

        Parameters
        ----------
        steps : int, optional
            Of each of them; without it all that a stretch may have.

        Returns
        -------
        Disturbances

        Examples
        --------
        >>> dynamics = Dynamics(n_actions=2)
        >>> for t in range(40):
        ...     dynamics.observe(np.array([t % 7.0]))
        ...     dynamics.act(dynamics.encode(t % 2))
        >>> dynamics.break_off()
        >>> found = dynamics.disturbances()
        >>> len(found.residuals) - len(dynamics.stretches)
        1
        """
        m, count = self.n_variables, 1 + len(self.stretches)
        steps = steps or self.horizon
        found = Disturbances.nothing(count, steps, m)
        for k, (Z, U, _, unforeseen) in enumerate(self.stretches, 1):
            L = min(len(U) - 1, steps)
            if len(unforeseen):
                found.residuals[k, :L] = unforeseen[:L]
            else:
                residuals(self.consequents, Z, U, L, self._carried, found.residuals[k])
        if "jumps" not in self.without:
            self._find_jumps(found)
        return found

    def _find_jumps(self, found: Disturbances) -> None:
        """What stretches jump to: for each variable and direction, after on before."""
        for j in range(self.n_variables):
            seen = np.array(self.jumps[j]).reshape(-1, self.n_variables + 1)
            if not len(seen):
                continue
            for k, (Z, *_) in enumerate(self.stretches, 1):
                change = np.diff(Z[:, [j]], axis=0)
                alone = have_jumped(change, self.sums.unit[[j]])[1:, 0]
                size = np.abs(change[1:, 0])
                left = np.abs(found.residuals[k, : len(size), j])
                n = len(left)
                at = np.flatnonzero(alone[:n] & (left > 0.5 * size[:n]))
                if not len(at):
                    continue
                t = int(at[0])
                before, after = Z[t + 1], Z[t + 2, j]
                alike = seen[(seen[:, -1] > seen[:, j]) == (after > before[j])]
                if not len(alike):
                    continue
                slopes = _slopes(alike[:, :-1], alike[:, -1])
                found.jump_at[k, j] = t
                found.jump_slope[k, j] = slopes
                found.jump_to[k, j] = after - slopes @ before
                seen_from = alike[:, :-1]
                found.jump_from[k, j] = np.stack([seen_from.min(0), seen_from.max(0)], 1)
                found.landing[k, j] = alike[:, -1].min(), alike[:, -1].max()


def _slopes(before: _Floats, after: _Floats) -> _Floats:
    """(m,) how where a variable lands depends on where all were, as far as jumps tell."""
    off = before - before.mean(0)
    squares = off.T @ off
    size = np.diag(squares)
    if len(after) < 3 or not size.any():
        return np.zeros(len(size))
    scale = np.sqrt(np.where(size > 0.0, size, 1.0))  # variables have units of their own
    held = squares / np.outer(scale, scale) + (_JUMP_PRIOR / len(after) + 1e-9) * np.eye(len(size))
    found: _Floats = np.linalg.solve(held, off.T @ (after - after.mean()) / scale) / scale
    return found


def _range(
    low: ArrayLike | None, high: ArrayLike | None, *, is_none: bool
) -> tuple[_Floats, _Floats]:
    """The ends of the range of actions, (d,) each; empty where there is to be none."""
    if is_none != (low is None) or (low is None) != (high is None):
        raise ValueError("give either low and high, or n_actions")
    if low is None or high is None:
        return np.zeros(0), np.zeros(0)
    ends = [real_array(name, np.atleast_1d(end), 1) for name, end in (("low", low), ("high", high))]
    for name, end in zip(("low", "high"), ends, strict=True):
        refuse_unusable(name, end)
    if ends[0].shape != ends[1].shape or not (ends[0] < ends[1]).all():
        raise ValueError(f"low is {low} and high is {high}; low must be below high")
    return ends[0], ends[1]


def _some(thing: str, number: int) -> str:
    plural = "stretches" if thing == "stretch" else f"{thing}s"
    return f"{number:,} {thing if number == 1 else plural}"

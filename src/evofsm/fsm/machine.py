"""The evolving finite state machine (e-FSM): it grows from what it observes.

What happens to an observation stands in `evofsm.fsm.step`, in the order of the paper; this is what
people hold in their hands.

References
----------
T. Han, D. Filev, U. Ozguner, "An online evolving framework for modeling the safe autonomous
vehicle control system via online recognition of latent risks", arXiv:1908.10823 (2019).
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from functools import wraps
from threading import RLock
from typing import Any, Self, SupportsIndex, TypeVar, cast
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.crowding import WhenFull
from evofsm.fsm.divergence import jensen_shannon
from evofsm.fsm.explanation import Explanation, explain, nothing_known
from evofsm.fsm.kernels import LINE, lanes
from evofsm.fsm.known import Known, Nearest, Policy, recognise_rows
from evofsm.fsm.layout import PLACES, Array
from evofsm.fsm.learnt import MACHINE, NO_ACTION, NOT_OPEN, Learnt
from evofsm.fsm.memory import (
    Held,
    Memory,
    Parameters,
    allocate,
    believe,
    close,
    failures_told,
    forget_present,
    leaves,
    refuse_impossible,
    reopen,
    resize,
    tell_of_failures,
    view,
)
from evofsm.fsm.model import FSMModel
from evofsm.fsm.naming import Labels
from evofsm.fsm.notebook import machine_html
from evofsm.fsm.observations import Missing
from evofsm.fsm.states.dispatch import check_rule, describe_rule, reach, weights, width
from evofsm.fsm.states.paper import Paper
from evofsm.fsm.states.rule import RuleSettings, StateRule
from evofsm.fsm.step import (
    DECLINED,
    EVENTS,
    FULL,
    REFUSED,
    Event,
    Step,
    Trace,
    fail,
    learn_rows,
    limit_of,
    observer,
    room_for,
    updater,
    widen,
)
from evofsm.fsm.transitions import count_open
from evofsm.fsm.validation import (
    check_action,
    check_actions,
    check_rows,
    positive,
    real_array,
    real_rows,
    refuse_unusable,
    whole,
)

Method = TypeVar("Method", bound=Callable[..., Any])

_FLOAT64 = np.dtype(np.float64)
# The paper's epsilon, where neither the rule nor the user has another one, in the unit of z.
_RADIUS = 0.3
# Width of recognition, in total variances of all observations, where nobody has another one.
_SPREAD = 3.0
_SETTINGS = ("n_actions", "radius", "distance_weight", "learning_rate", "prior_frequency", "spread")
# What a machine does not have to be told, with what holds if it is not.
_OPTIONS = {
    "max_states": None,
    "when_full": WhenFull.MERGE,
    "belief_tolerance": 0.0,
    "failure_horizon": None,
}
# Every machine there is, by its identity, for a process that is forked.
_MACHINES: WeakValueDictionary[int, EvolvingFSM] = WeakValueDictionary()


def _alone(method: Method) -> Method:
    """A method during which no other thread changes the machine."""

    @wraps(method)
    def locked(self: EvolvingFSM, *args: Any, **kwargs: Any) -> Any:
        with self._lock:
            was_open = close(self._held.buffer)
            returned = method(self, *args, **kwargs)
            if was_open:  # else it is done within another method that is alone
                reopen(self._held.buffer)
            return returned  # after an error `update` will find it closed, and reopen it

    return cast(Method, locked)


class EvolvingFSM(Known):
    """A finite state machine that grows its states and transitions from what it observes.

    Parameters
    ----------
    n_actions : int
        Number q of discrete actions; each has a transition matrix of its own.
    radius : float, optional
        The paper's epsilon, in the unit of the observations: an observation that is denser
        than every centre moves the nearest one if that is closer than this, else it creates
        a state. 0.3 for `Paper` and `Edges`; other rules have their own.
    distance_weight : float
        The paper's rho, how fast distance to new data lowers a centre's potential.
    learning_rate : float
        The paper's phi, the weight of the newest transition, in (0, 1).
    prior_frequency : float
        The paper's epsilon-bar, the frequency given to every transition of a new state.
    spread : float, optional
        Width of recognition: the similarity to a centre is
        ``exp(-distance^2 / (spread * total variance of all observations))``. 3 for `Paper` and
        `Edges`; other rules have their own.
    rule : StateRule, optional
        How states are determined, as an object: `Edges`, `Novelty`, `FailureSplit`; without it
        the paper's rule, `Paper`. Where it has a radius and a spread of its own, other ones may
        not be given beside it.
    max_states : int, optional
        Number of states at which another one is only created where one is given up; without it
        there is no limit.
    when_full : WhenFull
        Which one is given up: ``MERGE`` joins the two that are closest, ``RETIRE`` forgets the
        least useful.
    belief_tolerance : float
        How far a belief may be from the exact one, summed over all states, in [0, 1). States
        that are less likely get no part in the belief, and take no part in the step: with
        hundreds of states this saves most of the time, 1e-6 for example. A jump to a state that
        got none teaches nothing about it until it is recognised. 0 leaves nothing out.
    failure_horizon : int, optional
        A failure within this many observations of a visit is counted in `failed_soon`; without
        it, every failure later in the same episode.

    Raises
    ------
    TypeError
        If ``rule`` is no rule (or the class of one).
    ValueError
        If ``n_actions`` is no whole number of at least 1, another setting is not positive, or
        beyond its range in ``evofsm.fsm.learnt``, ``learning_rate`` is 1 or more, ``radius`` or
        ``spread`` contradicts the rule's, ``belief_tolerance`` is not in its range, or
        ``failure_horizon`` is no whole number of at least 1.

    Notes
    -----
    Rows of a transition matrix are "from", columns "to": a forecast is ``belief @ P``. States
    and actions are counted from 0 here, and from 1 (``#3``) in what people read.

    Threads may share a machine: each method is whole, and no observation is lost. But its episode
    is one stream; observations of two threads are learnt as if one followed the other, so give each
    source of observations a machine of its own. An interrupt (Ctrl-C) leaves a machine as it was
    before the observation or as it is after; `learn_many` has then learnt its first rows.

    Examples
    --------
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> for z in ([0.0], [0.1], [2.0], [1.0], [1.1]):
    ...     step = machine.learn_one(z, 0)
    >>> machine.n_states
    2
    >>> machine.predict(0).round(3)
    array([0.48, 0.52])
    """

    _kind = MACHINE
    _update: Callable[..., float]  # the quickest kernel that takes a step, once it is loaded

    def __init__(
        self,
        n_actions: int,
        radius: float | None = None,
        distance_weight: float = 0.85,
        learning_rate: float = 0.01,
        prior_frequency: float = 1e-3,
        spread: float | None = None,
        rule: StateRule | None = None,
        max_states: int | None = None,
        when_full: WhenFull = WhenFull.MERGE,
        belief_tolerance: float = 0.0,
        failure_horizon: int | None = None,
    ) -> None:
        self._rule = Paper() if rule is None else check_rule("rule", rule)
        given = RuleSettings(
            code=0,
            radius=_RADIUS if radius is None else positive("radius", radius),
            distance_weight=positive("distance_weight", distance_weight),
            spread=_SPREAD if spread is None else positive("spread", spread),
            failure_share=0.0,
            failure_distance=0.0,
            memory=np.inf,
            weights=np.empty(0),
        )
        told = given._replace(**cast(Any, self._rule.table))
        for name, value in (("radius", radius), ("spread", spread)):
            if value not in (None, getattr(told, name)):
                raise ValueError(f"{name} is {value}, but the rule has its own: {self._rule}")
        parameters = Parameters(
            positive("learning_rate", learning_rate),
            positive("prior_frequency", prior_frequency),
            _tolerance(belief_tolerance),
            np.inf if max_states is None else whole("max_states", max_states),
            WhenFull(when_full),
            np.inf if failure_horizon is None else whole("failure_horizon", failure_horizon),
            told,
        )
        if parameters.learning_rate >= 1.0:
            raise ValueError(f"learning_rate is {learning_rate}; it must lie below 1")
        self._share()
        self._use(allocate(0, whole("n_actions", n_actions), LINE, 0, parameters))
        MACHINE.refuse_others(self._content)

    @classmethod
    def paper(cls) -> Self:
        """The machine of the paper's Section 3, with the settings that it leaves open recovered.

        Observations are ``[gap [m], v_follower [m/s], v_leader [m/s]]``; the 17 actions are those
        of ``IntervalActions(-2.5, 2.5, 0.3)`` [m/s²].

        Returns
        -------
        EvolvingFSM
            A machine that has observed nothing yet.

        Examples
        --------
        >>> EvolvingFSM.paper()
        EvolvingFSM(n_actions=17, radius=0.3, distance_weight=0.85, learning_rate=0.01, \
prior_frequency=0.001, spread=3.0)
        """
        return cls(n_actions=17)

    # -- Learning -------------------------------------------------------------------------------

    @_alone
    def observe(
        self,
        z: ArrayLike,
        *,
        failed: bool | None = None,
        missing: Missing = Missing.REJECT,
        explained: Labels | None = None,
    ) -> Step:
        """Take in one observation: determine states, recognise, and learn the transition to it.

        One step of the paper's Sections 2.2.1, 2.2.2 and 2.3.2, in that order.

        Parameters
        ----------
        z : (m,) array_like
            Observation, in units of your own; the first one fixes m.
        failed : bool, optional
            Whether the episode ended in failure with this observation. It is learnt like any
            other; then the failure is counted, and the next observation begins an episode. Without
            it nothing is said of failures: see `failures_told`.
        missing : Missing
            What to do where entries are NaN or masked: that they were not observed. Such an
            observation is recognised and no more: no state moves, no transition to it is learnt,
            and `Step.missing` tells the variables.
        explained : Labels, optional
            What the numbers mean: with it `Step.explanation` says what was learnt of the state so
            far, as `explain` does.

        Returns
        -------
        Step
            The present state and belief, and how well they were foreseen [bit].

        Raises
        ------
        TypeError
            If ``z`` does not hold real numbers.
        ValueError
            If ``z`` has another length than before, or an entry is NaN, infinite or beyond
            1e100; if NaN is allowed, and there is nothing yet to recognise it by. The machine is
            then as it was.

        Examples
        --------
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> step = machine.observe([1.1])
        >>> step.state, step.predicted.round(2), step.belief.round(2), round(step.surprise, 2)
        (1, array([0.6, 0.4]), array([0.32, 0.68]), 0.06)
        """
        step = None
        if missing is not Missing.REJECT:
            given = real_array("observation", z, ndim=1)
            if (absent := np.isnan(given)).any():
                step = self._observe_partly(given, absent, missing, failed=bool(failed))
        if step is None:
            step = self._step(z, NO_ACTION, bool(failed))
        if failed is not None:
            tell_of_failures(self._buffer)
        if explained is None:
            return step
        text = explain(self, step.belief, None, explained, self._nearest(step.state)).text
        return step._replace(explanation=text)

    @_alone
    def act(self, i: SupportsIndex) -> None:
        """Say which action was commanded after the latest observation.

        It labels exactly one transition, the one to the next observation; a second call
        replaces the first. Without it the next observation teaches no transition.

        Parameters
        ----------
        i : int
            Index of the action, from 0; `IntervalActions.encode` gives it for a number.

        Raises
        ------
        TypeError
            If ``i`` is not an integer.
        ValueError
            If there is no such action, or nothing was observed yet in this episode.

        Examples
        --------
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> step = machine.observe([0.0])
        >>> machine.act(1)
        >>> step = machine.observe([0.1])
        >>> machine.model().uses
        array([0., 1.])
        """
        i = check_action(i, self.n_actions)
        now = self._memory.learnt
        if not now.chained[0]:
            raise ValueError("act before observe: this episode has no observation to act on yet")
        now.action[0] = i

    @_alone
    def learn_one(self, z: ArrayLike, i: SupportsIndex) -> Step:
        """Observe ``z``, then act with ``i``.

        Parameters
        ----------
        z : (m,) array_like
            Observation, as `observe` takes it.
        i : int
            Index of the action commanded after it, from 0, as `act` takes it.

        Returns
        -------
        Step
            What `observe` returns; the action shows in the next step.

        Raises
        ------
        TypeError, ValueError
            As `observe` and `act`. The machine is then as it was.

        Examples
        --------
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> [machine.learn_one([z], 0).state for z in (0.0, 0.1, 2.0, 1.0)]
        [0, 0, 0, 1]
        """
        i = check_action(i, self.n_actions)
        return self._step(z, i, False)

    def update(self, z: NDArray[np.float64], i: int) -> float:
        """Observe ``z``, then act with ``i``, and return nothing but the surprise.

        The same step as `learn_one`, for those who count nanoseconds: most of the time of that
        goes into the arrays of what that returns. What they say can still be asked of the machine.

        Parameters
        ----------
        z : (m,) ndarray
            Observation; quickest as an array of float64.
        i : int
            Index of the action commanded after it, from 0.

        Returns
        -------
        float
            Divergence of forecast and belief [bit]; NaN where nothing was forecast.

        Raises
        ------
        TypeError, ValueError
            As `learn_one`. The machine is then as it was.

        Examples
        --------
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> Z = np.array([[0.0], [0.1], [2.0], [1.0]])
        >>> [round(machine.update(z, 0), 2) for z in Z]
        [nan, 0.0, 0.0, 0.31]
        >>> machine.state, machine.belief.round(2)
        (1, array([0.37, 0.63]))
        """
        if type(i) is int and type(z) is np.ndarray and z.dtype is _FLOAT64:
            try:
                surprise = self._update(self._held.buffer, z, i, self._limit)
            except (TypeError, OverflowError):  # z has gaps or is read-only; i is beyond any index
                surprise = DECLINED
            if surprise != DECLINED:
                return surprise
            self._update = updater(self._limit)
        i = check_action(i, self.n_actions)
        with self._lock:
            close(self._held.buffer)
            surprise = self._take(z, i, False)[2]
            reopen(self._held.buffer)  # also where an error or an interrupt had left it closed
        return surprise

    @_alone
    def learn_many(
        self,
        Z: ArrayLike,
        I: ArrayLike,
        episode_starts: Sequence[int] | NDArray[np.integer] = (),
        failures: Sequence[int] | NDArray[np.integer] | None = None,
        *,
        belief: bool = False,
    ) -> Trace:
        """Learn from many observations at once, bit for bit as `observe` and `act` would.

        Parameters
        ----------
        Z : (T, m) array_like
            Observations, in the order of time and the units of `observe`.
        I : (T,) array_like of int
            The action commanded after each observation; -1 where none was.
        episode_starts : (E,) array_like of int
            Rows at which an episode begins. Without row 0 the present episode goes on.
        failures : (K,) array_like of int, optional
            Rows with which an episode ended in failure, as ``observe(z, failed=True)`` tells it.
            The action in such a row is not used, and the next row begins an episode. An empty one
            tells that there was none; without it nothing is said of failures.
        belief : bool
            Whether the trace holds the belief of every row as well.

        Returns
        -------
        Trace
            A row for each observation; surprise in [bit].

        Raises
        ------
        TypeError, ValueError
            As `observe` and `act`, before any row is learnt; the message names the row.

        Examples
        --------
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0]).n_states
        array([1, 1, 1, 2])
        """
        observations = self._check_observations(Z)
        actions = check_actions(I, len(observations), self.n_actions)
        starts = check_rows("episode_starts", episode_starts, len(observations))
        ends = check_rows("failures", () if failures is None else failures, len(observations))
        if len(observations):
            self._fit(observations[0])
        if failures is not None:
            tell_of_failures(self._buffer)
        rows = len(observations)
        trace = Trace(
            np.empty(rows, np.int64),
            np.empty(rows, np.int64),
            np.empty(rows, np.int8),
            np.empty(rows),
        )
        beliefs = np.zeros((rows if belief else 0, self._capacity))
        given = observations, actions, starts, ends
        row = learn_rows(self._buffer, *given, 0, trace, beliefs, self._limit)
        while row < rows:
            self._grow()
            beliefs = widen(beliefs, self._capacity)
            row = learn_rows(self._buffer, *given, row, trace, beliefs, self._limit)
        return trace._replace(belief=beliefs[:, : self.n_states]) if belief else trace

    @_alone
    def start_episode(self) -> None:
        """Begin a new episode: no transition is learnt from the last observation to the next.

        Only the belief is cleared; all that was learnt stays.

        Examples
        --------
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> machine.start_episode()
        >>> machine.n_states, machine.state, machine.belief
        (2, None, array([0.5, 0.5]))
        """
        forget_present(self._buffer)

    @_alone
    def fail(self) -> None:
        """End the episode in failure, without a further observation.

        The action commanded after the latest observation led there; where none was, the failure
        is counted for the state alone. The next observation begins a new episode.

        Raises
        ------
        ValueError
            If nothing was observed yet in this episode.

        Examples
        --------
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 1])
        >>> machine.fail()
        >>> machine.failures.round(2), machine.endings
        (array([[0.  , 0.  ],
               [0.37, 0.63]]), array([0., 1.]))
        """
        if not self._memory.learnt.chained[0]:
            raise ValueError("fail before observe: this episode has no observation to fail after")
        if not fail(self._buffer, self._limit):
            self._grow()
            fail(self._buffer, self._limit)
        tell_of_failures(self._buffer)

    @_alone
    def onset(self) -> None:
        """Count that something unexpected began in the state before the latest observation's.

        Whoever has a model of how the system moves says so, as `evofsm.Guard` does. Nothing is
        counted where the episode has no earlier observation, or its state was given up.

        Examples
        --------
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> machine.onset()
        >>> machine.onsets
        array([1., 0.])
        """
        now = self._memory.learnt
        if now.before[0] >= 0.0:
            now.outcomes.onsets[int(now.before[0])] += 1.0

    def tell_of_failures(self) -> None:
        """Say that failures are told: an episode that ends without one is known to have had none.

        The same is said by `observe` with ``failed=False`` and by `learn_many` with
        ``failures=[]``. Where nobody says so, and no failure was ever told, `explain` does not take
        the silence for safety.

        Examples
        --------
        >>> machine = EvolvingFSM(n_actions=1)
        >>> trace = machine.learn_many([[0.0], [0.1]], [0, 0])
        >>> machine.failures_told
        False
        >>> machine.tell_of_failures()
        >>> machine.failures_told
        True
        """
        tell_of_failures(self._buffer)

    # -- Forecasting ----------------------------------------------------------------------------

    @_alone
    def predict(
        self, i: SupportsIndex, horizon: int = 1, policy: Policy = "marginal"
    ) -> NDArray[np.float64]:
        """Forecast the state ``horizon`` steps ahead; nothing is changed by asking.

        The forecast equations of the paper's Section 2.3.2, for one step and for k.

        Parameters
        ----------
        i : int
            Index of the action taken now, from 0.
        horizon : int
            Number of steps, each as long as the time between two observations; at least 1.
        policy : {"marginal", "hold", "observed"}
            Actions after the first step: each alike, as in the paper's k-step equation; ``i``
            again; or each as often as it was used so far.

        Returns
        -------
        (n,) ndarray
            Distribution over states: ``belief @ P[i] @ P*^(horizon - 1)``. At the start of an
            episode the belief is uniform; before any observation it is empty.

        Raises
        ------
        TypeError
            If ``i`` is not an integer.
        ValueError
            If there is no such action or policy, or ``horizon`` is no whole number of at least 1.

        Examples
        --------
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> machine.predict(0).round(3), machine.predict(1).round(3)  # 1 was never tried
        (array([0.602, 0.398]), array([0.5, 0.5]))
        >>> machine.predict(0, horizon=10, policy="hold").round(3)
        array([0.686, 0.314])
        """
        return self._ahead(self.belief, check_action(i, self.n_actions), horizon, policy)

    @_alone
    def explain(
        self, action: SupportsIndex | None = None, labels: Labels | None = None
    ) -> Explanation:
        """What experience says of the present situation; nothing is changed by asking.

        Parameters
        ----------
        action : int, optional
            Index of an action, from 0: what came of taking it there.
        labels : Labels, optional
            What the numbers mean, for words.

        Returns
        -------
        Explanation
            As `FSMModel.explain` gives it.

        Raises
        ------
        TypeError
            If ``action`` is not an integer.
        ValueError
            If there is no such action.

        Examples
        --------
        >>> from evofsm import Labels
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 1, 0, 0], [0, 2], [3])
        >>> step = machine.observe([0.9])
        >>> print(machine.explain(0, Labels(names=("gap",), units=("m",))))
        #2: gap 0.9 m (belief 63 %, next #1 37 %). 1 episode came here (2 observations);
        1 of 1 (at least 26 %) failed later on; none of them is known to have tried a(1) here.
        Most often reached from #1: 1 of 1 times.
        """
        index = None if action is None else check_action(action, self.n_actions)
        if self.state is None:
            return nothing_known("Nothing was observed yet in this episode.")
        labels, nearest = Labels() if labels is None else labels, self._nearest(self.state)
        return explain(self, self.belief, index, labels, nearest)

    # Asked of a machine, all of an answer is of one moment.
    recognise = _alone(Known.recognise)
    nearest = _alone(Known.nearest)
    propagate = _alone(Known.propagate)
    averaged_matrix = _alone(Known.averaged_matrix)
    stationary_distribution = _alone(Known.stationary_distribution)
    committor_forward = _alone(Known.committor_forward)
    mfpt = _alone(Known.mfpt)
    simulate = _alone(Known.simulate)
    onset_rates = _alone(Known.onset_rates)
    joint_frequency = property(_alone(cast(Any, Known.joint_frequency).fget))

    # -- What it was told -----------------------------------------------------------------------

    @property
    def settings(self) -> dict[str, Any]:
        """Its settings by name, but for the rule; those that were left as they are, left out."""
        given = {name: getattr(self, name) for name in (*_SETTINGS, *_OPTIONS)}
        return {name: value for name, value in given.items() if value != _OPTIONS.get(name, ...)}

    @property
    def n_actions(self) -> int:
        """Number q of actions."""
        return len(self._memory.learnt.transitions.uses)

    @property
    def radius(self) -> float:
        """The paper's epsilon, or the rule's own."""
        return self._memory.parameters.rule.radius

    @property
    def distance_weight(self) -> float:
        """The paper's rho."""
        return self._memory.parameters.rule.distance_weight

    @property
    def learning_rate(self) -> float:
        """The paper's phi."""
        return self._memory.parameters.learning_rate

    @property
    def prior_frequency(self) -> float:
        """The paper's epsilon-bar."""
        return self._memory.parameters.prior_frequency

    @property
    def spread(self) -> float:
        """Width of recognition, in total variances of all observations or the rule's measure."""
        return self._memory.parameters.rule.spread

    @property
    def rule(self) -> StateRule:
        """How states are determined."""
        return self._rule

    @property
    def max_states(self) -> int | None:
        """Number of states from which on one is given up for another; None for no limit."""
        most = self._memory.parameters.max_states
        return None if most == np.inf else int(most)

    @property
    def when_full(self) -> WhenFull:
        """Which state is given up."""
        return WhenFull(int(self._memory.parameters.when_full))

    @property
    def belief_tolerance(self) -> float:
        """How far a belief may be from the exact one, summed over all states."""
        return self._memory.parameters.belief_tolerance

    @property
    def failure_horizon(self) -> int | None:
        """Observations after which a failure no longer counts as soon; None for no limit."""
        most = self._memory.parameters.failure_horizon
        return None if most == np.inf else int(most)

    # -- What it knows --------------------------------------------------------------------------

    @property
    def nbytes(self) -> int:
        """Memory that holds what was learnt, with room for the next states [byte].

        Examples
        --------
        >>> machine = EvolvingFSM(n_actions=17)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0]], [0, 0, 1])
        >>> once = machine.nbytes
        >>> trace = machine.learn_many([[0.0], [0.1]], [0, 0])  # action 1 got its matrix
        >>> machine.nbytes - once  # 8 states in a line: 8 x 8 probabilities, 7 x 8 of rows
        960
        """
        return self._buffer.nbytes

    @property
    def n_states(self) -> int:
        """Number of states."""
        return int(self._memory.learnt.n_states[0])

    @property
    def n_variables(self) -> int:
        """Number m of variables in an observation; 0 before the first."""
        return len(self._memory.learnt.clusters.first)

    @property
    @_alone
    def state_ids(self) -> NDArray[np.int64]:
        """(n,) ndarray: identities of the states, the number of each one's creation from 0.

        They equal the indices, unless states were given up (``max_states``): an index that became
        free goes to a new state, with a new identity.
        """
        return self._memory.learnt.ids[: self.n_states].astype(np.int64)

    @property
    @_alone
    def centers(self) -> NDArray[np.float64]:
        """(n, m) ndarray: the observation at the centre of each state."""
        return self._memory.learnt.clusters.centers[:, : self.n_states].T.copy()

    @property
    @_alone
    def transition_matrices(self) -> NDArray[np.float64]:
        """(q, n, n) ndarray: for each action, probabilities from state (row) to state (column).

        An action never used has a matrix of 1 / n here; the machine holds none for it.
        """
        transitions = self._memory.learnt.transitions
        return self._of_actions(transitions.scales[..., None] * transitions.matrices, 1.0)

    @property
    @_alone
    def origin_frequency(self) -> NDArray[np.float64]:
        """(q, n) ndarray: the paper's F_o, the recency-weighted frequency of each row."""
        unused = self.n_states**2 * self.prior_frequency
        return self._of_actions(self._memory.learnt.transitions.origin_frequency, unused)

    @property
    def failures_told(self) -> bool:
        """Whether anybody told of failures: of one, or that there was none."""
        return failures_told(self._buffer) or bool(self.endings.any())

    @property
    @_alone
    def width(self) -> float:
        """Width of recognition, a squared distance; 0 before the first observation."""
        held = self._memory.learnt.clusters
        if not held.n_observations[0]:
            return 0.0
        return width(self._memory.parameters.rule, held.scatter[0] / held.n_observations[0])

    @property
    @_alone
    def belief(self) -> NDArray[np.float64]:
        """(n,) ndarray: the present distribution over states, uniform as an episode starts."""
        n = self.n_states
        if self._memory.learnt.chained[0]:
            return self._memory.learnt.belief[:n].copy()
        return np.full(n, 1.0 / max(n, 1))

    @property
    @_alone
    def state(self) -> int | None:
        """Index of the most probable state; None until an episode's first observation."""
        now = self._memory.learnt
        return int(now.state[0]) if now.chained[0] else None

    @_alone
    def model(
        self,
        *,
        actions: IntervalActions | None = None,
        names: Sequence[str] = (),
        units: Sequence[str] = (),
        dt: float | None = None,
    ) -> FSMModel:
        """Snapshot for analysis, which later learning does not change.

        Parameters
        ----------
        actions : IntervalActions, optional
            What the action indices mean.
        names, units : sequence of str, optional
            Names and units of the m variables.
        dt : float, optional
            Time between two observations [s].

        Returns
        -------
        FSMModel
            The states and transitions of now.

        Raises
        ------
        ValueError
            If ``actions``, ``names`` or ``units`` are of another number than the machine's, or
            ``dt`` is not positive and finite.

        Examples
        --------
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> model = machine.model(names=["gap"], units=["m"], dt=0.1)
        >>> step = machine.observe([1.1])
        >>> model.visits, machine.model().visits
        (array([3., 1.]), array([3., 2.]))
        """
        known = [entry.name for entry in fields(Known)]
        return FSMModel(
            **{name: getattr(self, name) for name in known},
            actions=actions,
            names=tuple(names),
            units=tuple(units),
            dt=dt,
        )

    # -- Keeping it -----------------------------------------------------------------------------

    def copy(self) -> Self:
        """An independent machine in the same state.

        Returns
        -------
        EvolvingFSM
            A machine that shares nothing with this one.

        Examples
        --------
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> twin = machine.copy()
        >>> step = twin.observe([-0.2])
        >>> twin.state, machine.state
        (0, 1)
        """
        return copy.copy(self)

    @property
    def _content(self) -> dict[str, Any]:
        """The settings, and whether failures were told, for JSON."""
        told = {"failures_told": True} if self.failures_told else {}
        return {**self.settings, "rule": describe_rule(self._rule), **told}

    def _kept(self) -> dict[str, NDArray[Any]]:
        # Without spare room the shapes of the arrays tell the sizes, and nothing else is stored.
        return dict(leaves(self._trimmed()))

    @classmethod
    def _restored(cls, content: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Self:
        told = content.pop("failures_told")
        machine = cls(**content)
        machine = machine._holding(arrays) if arrays["centers"].shape[1] else machine
        if told:
            tell_of_failures(machine._buffer)
        return machine

    # The views belong to one buffer: a copy, or what another process gets, needs its own. So does
    # its lock.
    @_alone
    def __getstate__(self) -> dict[str, Any]:
        buffer = self._buffer.copy()
        reopen(buffer)
        return {"rule": self._rule, "buffer": buffer}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._rule = state["rule"]
        self._share()
        self._use(np.require(state["buffer"], requirements="W"))  # a file mapped for reading is not

    @_alone
    def _repr_html_(self) -> str:
        return machine_html(self)

    def __repr__(self) -> str:
        shown = self.settings | ({} if self._rule == Paper() else {"rule": self._rule})
        settings = ", ".join(f"{name}={value}" for name, value in shown.items())
        return f"{type(self).__name__}({settings})"

    # -- Inside ---------------------------------------------------------------------------------

    def _parameters(self, m: int) -> Parameters:
        """The settings, now that there are m variables."""
        parameters = self._memory.parameters
        told = parameters.rule._replace(weights=weights(self._rule, m))
        return parameters._replace(rule=told)

    @_alone
    def _trimmed(self) -> Learnt:
        """A copy of all that was learnt, without spare room."""
        open_ = count_open(self._memory.learnt.transitions)
        return view(resize(self._buffer, self.n_states, open_)).learnt

    def _holding(self, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """A machine of the same settings that has learnt these arrays, by their names."""
        m, n = arrays["centers"].shape
        places = len(arrays["matrices"])
        buffer = allocate(m, self.n_actions, n, places, self._parameters(m))
        for name, array in leaves(view(buffer).learnt):
            if arrays[name].shape != array.shape:
                raise ValueError(f"{name} has shape {arrays[name].shape}, not {array.shape}")
            array[:] = arrays[name]
        refuse_impossible(view(buffer).learnt)
        machine = self.copy()
        machine._use(resize(buffer, lanes(n), places))
        return machine

    @property
    def _buffer(self) -> NDArray[np.float64]:
        return self._held.buffer

    @property
    def _memory(self) -> Memory:
        return self._held.memory

    def _share(self) -> None:
        """Be ready for threads. They wait for whoever steps, grows, or takes a copy."""
        self._lock = RLock()
        _MACHINES[id(self)] = self

    def _use(self, buffer: NDArray[np.float64]) -> None:
        """Go on with another buffer: in one assignment, so that an interrupt parts nothing."""
        memory = view(buffer)
        self._limit = limit_of(memory.parameters)  # the same for all buffers of a machine
        self._held = Held(buffer, memory)
        self._update = _cannot_update

    def _nearest(self, state: int | None) -> Nearest | None:
        """How far the latest observation is from its state, if it was seen whole."""
        now = self._memory.learnt
        if state is None or now.outcomes.latest_visit[state] != now.outcomes.clock[0]:
            return None
        beyond = reach(self._rule, self.width)
        return Nearest(state, float(np.sqrt(now.clusters.squared_distances[state])), beyond)

    def _step(
        self,
        z: ArrayLike,
        action: int,
        failed: bool,
    ) -> Step:
        """Observe, then act; return the whole step."""
        event, state, surprise = self._take(z, action, failed)
        memory = self._held.memory
        parameters, now, scratch = memory.parameters, memory.learnt, memory.scratch
        n = int(now.n_states[0])
        forecast = scratch.forecast if parameters.belief_tolerance else scratch.predicted
        predicted = forecast[: n if surprise == surprise else 0].copy()
        return Step(state, now.belief[:n].copy(), EVENTS[event], predicted, surprise)

    def _observe_partly(
        self,
        z: NDArray[np.float64],
        absent: NDArray[np.bool_],
        missing: Missing,
        *,
        failed: bool,
    ) -> Step:
        """Recognise what some variables are missing of; only the belief changes."""
        now, n = self._memory.learnt, self.n_states
        gone = tuple(np.flatnonzero(absent).tolist())
        if n == 0:
            raise ValueError(f"variables {gone} of a machine's first observation are missing")
        if missing is Missing.HOLD and not now.chained[0]:
            raise ValueError(f"variables {gone} are missing, and nothing to hold since the start")
        filled = np.where(absent, now.clusters.latest, self._fit(z))
        refuse_unusable("observation", filled)
        action = int(now.action[0])
        predicted = self.predict(action) if now.chained[0] and action != NO_ACTION else np.empty(0)
        if missing is Missing.PARTIAL and absent.all():
            belief = predicted if len(predicted) else self.belief
        else:
            rule = self._memory.parameters.rule
            counted = rule.weights * ~absent if missing is Missing.PARTIAL else rule.weights
            held, belief = now.clusters, np.empty(n)
            centers, distances = np.ascontiguousarray(held.centers[:, :n]), np.empty(n)
            rows = filled[None], self.width
            recognise_rows(centers, counted, *rows, distances, belief[None])
        surprise = jensen_shannon(predicted, belief) if len(predicted) else np.nan
        if failed:  # both, or neither
            grown = self._grown()
            believe(grown, belief)
            fail(grown, self._limit)
            self._use(grown)
        else:
            believe(self._buffer, belief)
        return Step(int(belief.argmax()), belief, Event.NONE, predicted, surprise, gone)

    def _take(self, z: ArrayLike, action: int, failed: bool) -> tuple[int, int, float]:
        if not self.n_variables or type(z) is not np.ndarray or z.dtype is not _FLOAT64:
            z = self._checked(z)
        while True:
            event, state, surprise = REFUSED, 0, np.nan
            with suppress(TypeError):  # z has gaps, is read-only or is no vector
                event, state, surprise = observer(self._limit)(
                    self._held.buffer, z, action, failed, self._limit
                )
            if event >= 0:
                return event, state, surprise
            if event == FULL:
                self._grow()
            else:
                z = self._checked(z)

    def _checked(self, z: ArrayLike) -> NDArray[np.float64]:
        """An observation as a vector of its own, of as many variables as the first one had."""
        vector = self._fit(real_array("observation", z, ndim=1))
        refuse_unusable("observation", vector)
        return vector

    def _grow(self) -> None:
        """Make room for what the next step may need."""
        self._use(self._grown())

    def _grown(self) -> NDArray[np.float64]:
        """A copy of the buffer with that room."""
        return resize(self._buffer, *room_for(self._memory))

    @property
    def _capacity(self) -> int:
        return len(self._memory.learnt.belief)

    def _matrix(self, i: int) -> NDArray[np.float64]:
        """(n, n) transition probabilities under an action."""
        n, transitions = self.n_states, self._memory.learnt.transitions
        if transitions.places[i] == NOT_OPEN:
            return np.full((n, n), 1.0 / max(n, 1))
        place = int(transitions.places[i])
        return transitions.scales[place, :n, None] * transitions.matrices[place, :n, :n]

    def _matrices(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(s, n, n) and (s,): the matrices of all actions that were used, and their uses."""
        n, transitions = self.n_states, self._memory.learnt.transitions
        used = np.flatnonzero(transitions.places != NOT_OPEN)
        places = transitions.places[used].astype(int)
        scales, stored = transitions.scales[places, :n, None], transitions.matrices[places, :n, :n]
        return scales * stored, transitions.uses[used]

    @_alone
    def _array(self, array: Array) -> NDArray[np.float64]:
        """An array of the table, as people see it."""
        n, memory, place = self.n_states, self._memory, PLACES[array]
        if array.kind == "state":
            values = memory.per_state[place.number]
        elif array.kind == "place":
            values = memory.per_place[place.number]
        else:
            values = dict(leaves(memory.learnt))[array.name]
        if array.latest:  # what belongs to an episode that is going on is not shown yet
            values = values - self._under_way(getattr(memory.learnt.outcomes, array.latest))
        if array.kind == "place":
            return self._of_actions(values, 0.0)
        seen: NDArray[np.float64] = values[tuple(slice(n) for _ in values.shape)]
        return values.copy() if array.kind == "action" else seen.copy()

    def _of_actions(self, of_places: NDArray[np.float64], unused: float) -> NDArray[np.float64]:
        """An array with a row for each action; those never used get equal shares of ``unused``."""
        n, places = self.n_states, self._memory.learnt.transitions.places
        used = np.flatnonzero(places != NOT_OPEN)
        per_state = of_places.shape[1:]
        rows = np.full((len(places), *(n for _ in per_state)), unused / max(n, 1))
        of_used = of_places[places[used].astype(int)]
        rows[used] = of_used[:, :n] if of_used.ndim == 2 else of_used[:, :n, :n]
        return rows

    def _under_way(self, latest: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether what was done ``latest`` belongs to an episode that is going on."""
        now = self._memory.learnt
        return np.asarray((latest >= now.outcomes.began[0]) & (now.chained[0] > 0.0))

    def _fit(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Settle the number of variables with the first observation, and hold to it after."""
        if self.n_states == 0:
            refuse_unusable("observation", z)
            parameters = self._parameters(len(z))
            buffer = allocate(len(z), self.n_actions, LINE, 0, parameters)
            if failures_told(self._buffer):
                tell_of_failures(buffer)
            self._use(buffer)
        started_with = self._memory.learnt.clusters.first
        if z.shape != started_with.shape:
            raise ValueError(
                f"observation has {len(z)} variables, but this machine was started with "
                f"{len(started_with)}"
            )
        return z

    def _check_observations(self, Z: ArrayLike) -> NDArray[np.float64]:
        observations = real_rows("observations", Z)
        if self.n_states and len(observations):
            self._fit(observations[0])
        refuse_unusable("observations", observations)
        return observations


def _unlock_all() -> None:
    """In a process just forked: it lacks the threads that held locks and would release them."""
    for machine in _MACHINES.values():
        machine._lock = RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_unlock_all)


# In place of the kernel, until there is something to load it for.
def _cannot_update(*_: object) -> float:
    return DECLINED


def _tolerance(tolerance: float) -> float:
    if tolerance == 0.0:
        return 0.0
    if positive("belief_tolerance", tolerance) >= 1.0:
        raise ValueError(f"belief_tolerance is {tolerance}; it must lie below 1")
    return float(tolerance)

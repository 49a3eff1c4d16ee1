"""The evolving finite state machine (e-FSM): it grows from what it observes.

What happens to an observation stands in `evofsm.fsm.step`, in the order of the paper; what can be
asked of what was learnt, in `evofsm.fsm.model`.

References
----------
T. Han, D. Filev, U. Ozguner, "An online evolving framework for modeling the safe autonomous
vehicle control system via online recognition of latent risks", arXiv:1908.10823 (2019).
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from operator import methodcaller
from typing import Any, Self, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm import store
from evofsm.fsm import arrays, rules
from evofsm.fsm import step as stepping
from evofsm.fsm import validation as valid
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.arrays import MACHINE, NO_ACTION, NOT_OPEN, OF_ACTIONS, OF_MODEL, Learnt, Settings
from evofsm.fsm.clusters import width_of
from evofsm.fsm.divergence import jensen_shannon
from evofsm.fsm.explanation import Explanation, explain
from evofsm.fsm.kernels import LINE, Entry, uncompiled
from evofsm.fsm.model import FSMModel, believed
from evofsm.fsm.naming import Labels
from evofsm.fsm.rules import StateRule
from evofsm.fsm.sharing import Retraced, alone, share, step, unshared
from evofsm.fsm.step import EVENTS, PREDICTED, Event, Step, Trace, blank_trace
from evofsm.fsm.transitions import room_for
from evofsm.fsm.validation import Floats, positive, probability, whole
from evofsm.store import Place

# What a machine does not have to be given, with what holds if it is not.
_LIMITS = {"max_states": None, "failure_horizon": None}
_OPTIONS = {**_LIMITS, "belief_tolerance": 0.0}
_SETTINGS = ("n_actions", "radius", "distance_weight", "learning_rate", "prior_frequency", "spread")
# What of a snapshot a machine answers with, beside what is its own.
_ASKED = {*arrays.OF_MODEL, "averaged_matrix", "joint_frequency", "marginal_matrix"}
# So many states, of observations not twice as many, tell nothing.
_MANY_STATES = 500
_TOO_FINE = (
    "{:,} states of {:,} observations: nearly each makes one of its own, which tells nothing and "
    "is slow. Is a scale, or the radius, too small, or is a variable noise, or a clock?"
)
# Compiled code of a step.
_LEARN_ROWS = Entry(stepping.learn_rows)


class EvolvingFSM(Retraced):
    """A finite state machine that grows its states and transitions from what it observes.

    It has the arrays of a snapshot, `FSMModel`, under their names, as `visits`.

    Parameters
    ----------
    n_actions : int
        Number q of discrete actions; each has a transition matrix of its own.
    radius : float, optional
        The paper's epsilon: how close the nearest state must be to be moved. 0.3 for `Paper`;
        other rules have their own.
    distance_weight : float
        The paper's rho, how fast distance to new data lowers a centre's potential.
    learning_rate : float
        The paper's phi, the weight of the newest transition, in (0, 1).
    prior_frequency : float
        The paper's epsilon-bar, the frequency given to every transition of a new state.
    spread : float, optional
        Width of recognition, in total variances of all observations. 3 for `Paper`; other rules
        have their own.
    rule : StateRule, optional
        How states are determined: `Paper` (without it) or `Novelty`.
    max_states : int, optional
        Number of states at which, before another one, the two that are closest are merged.
    belief_tolerance : float
        How far a belief may be from the exact one, summed over all states, in [0, 1): 1e-6 saves
        most of the time with hundreds of states.
    failure_horizon : int, optional
        A failure within this many observations of a visit is counted in `failed_soon`; without it,
        every failure later in the same episode.

    Notes
    -----
    States and actions are counted from 0 here, and from 1 (``#3``) in what people read.
    Threads may share a machine, but its episode is one stream. An interrupt (Ctrl-C) leaves it as
    it was before an observation or as it is after; `learn_many` has then learnt its first rows.

    Examples
    --------
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
    >>> step = machine.observe([1.1])
    >>> step.state, step.predicted.round(2), step.belief.round(2), round(step.surprise, 2)
    (1, array([0.6, 0.4]), array([0.32, 0.68]), 0.06)
    >>> machine.predict(0).round(3), machine.predict(1).round(3)  # 1 was never tried
    (array([0.48, 0.52]), array([0.5, 0.5]))
    """

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
        belief_tolerance: float = 0.0,
        failure_horizon: int | None = None,
    ) -> None:
        self._rule = rules.Paper() if rule is None else rule
        rules.describe_rule(self._rule)
        table = rules.table_of(self._rule)
        for name, value in (("radius", radius), ("spread", spread)):
            if value is not None and table.setdefault(name, positive(name, value)) != value:
                raise ValueError(f"{name} is {value}, but the rule has its own: {self._rule}")
        tolerance = belief_tolerance and probability("belief_tolerance", belief_tolerance)
        settings: dict[str, Any] = {
            "radius": 0.3,
            "spread": 3.0,
            "distance_weight": positive("distance_weight", distance_weight),
            "learning_rate": probability("learning_rate", learning_rate),
            "prior_frequency": positive("prior_frequency", prior_frequency),
            "belief_tolerance": float(tolerance),
            "max_states": _or_infinity("max_states", max_states),
            "failure_horizon": _or_infinity("failure_horizon", failure_horizon),
            **table,
        }
        self._settings = Settings(**settings | {"rule": int(table["rule"])}, weights=np.empty(0))
        self._learnt = arrays.blank(0, whole("n_actions", n_actions), 0, 0)
        self._share()
        MACHINE.refuse_others(self._content)

    @classmethod
    def paper(cls) -> Self:
        """The machine of the paper's Section 3: ``[gap [m], v_follower [m/s], v_leader [m/s]]``.

        Its 17 actions are those of ``IntervalActions(-2.5, 2.5, 0.3)`` [m/s²].
        """
        return cls(n_actions=17)

    # -- Learning -------------------------------------------------------------------------------

    @alone
    def observe(self, z: ArrayLike, *, failed: bool | None = None, partial: bool = False) -> Step:
        """Take in one observation: determine states, recognise, and learn the transition to it.

        One step of the paper's Sections 2.2.1, 2.2.2 and 2.3.2, in that order.

        Parameters
        ----------
        z : (m,) array_like
            Observation, in units of your own; the first one fixes m.
        failed : bool, optional
            Whether the episode ended in failure with this observation, so that the next one begins
            an episode. Without it nothing is said of failures: see `failures_told`.
        partial : bool
            Whether entries may be NaN or masked: that they were not observed. It is then recognised
            by the others, no state moves, and no transition to it is learnt; the action before it
            is counted, and the state as visited where the episode came to it before.

        Raises
        ------
        TypeError, ValueError
            If ``z`` holds no real numbers of at most 1e100, or has another length than before. The
            machine is then as it was.
        """
        failed = None if failed is None else valid.truth("failed", failed)
        if partial:
            vector = valid.real_array("observation", z, ndim=1)
            if (absent := np.isnan(vector)).any():
                return self._observe_partly(vector, absent, failed)
        return self._step(valid.usable_array("observation", z), NO_ACTION, failed)

    @alone
    @step
    def act(self, i: SupportsIndex) -> None:
        """Say which action (from 0) was commanded after the latest observation.

        It labels exactly one transition, the one to the next observation, which teaches none
        without it; a second call replaces the first.
        """
        i = valid.check_action(i, self.n_actions)
        now = self._learnt.now
        if not now["chained"][0]:
            raise ValueError("act before observe: this episode has no observation to act on yet")
        now["action"] = i

    @alone
    def learn_one(self, z: ArrayLike, i: SupportsIndex) -> Step:
        """Observe, then act; the action shows in the next step.

        Parameters
        ----------
        z, i
            As `observe` and `act` take them.
        """
        vector = valid.usable_array("observation", z)
        return self._step(vector, valid.check_action(i, self.n_actions), None)

    @alone
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

        An error is raised before any row is learnt, and names the row.

        Parameters
        ----------
        Z : (T, m) array_like
            Observations, in the order of time and the units of `observe`.
        I : (T,) array_like of int
            The action commanded after each observation; -1 where none was.
        episode_starts : (E,) array_like of int
            Rows at which an episode begins. Without row 0 the present episode goes on.
        failures : (K,) array_like of int, optional
            Rows with which an episode ended in failure; their actions are not used. An empty one
            tells that there was none; without it nothing is said of failures.
        belief : bool
            Whether the trace holds the belief of every row as well.
        """
        observations = valid.real_array("observations", Z, ndim=2, copy=False)
        rows = len(observations)
        valid.refuse_unusable("observations", observations)
        observations = np.require(observations, requirements="W")
        actions = valid.check_actions(I, rows, self.n_actions)
        starts = valid.check_rows("episode_starts", episode_starts, rows)
        ends = valid.check_rows("failures", () if failures is None else failures, rows)
        if rows:
            self._fit(observations.shape[1])
        trace, row = blank_trace(rows), 0
        beliefs = np.zeros((rows if belief else 0, self._capacity))
        self._known = None
        while row < rows:
            arguments = self._learnt, self._settings, observations, actions, starts
            is_told, scratch = failures is not None, np.empty((3, self._capacity))
            row = stepping.learn_rows(*arguments, ends, is_told, scratch, row, trace, beliefs)
            if row < rows:
                self._make_room()
                beliefs = np.pad(beliefs, [(0, 0), (0, self._capacity - beliefs.shape[1])])
        return trace._replace(belief=beliefs[:, : self.n_states]) if belief else trace

    @alone
    @step
    def start_episode(self) -> None:
        """Begin a new episode: no transition is learnt from the last observation to the next."""
        self._learnt.now[["action", "chained"]] = NO_ACTION, 0

    @alone
    @step
    def fail(self) -> None:
        """End the episode in failure, to which the action after the latest observation led."""
        if not self._learnt.now["chained"][0]:
            raise ValueError("fail before observe: this episode has no observation to fail after")
        self._make_room()
        stepping.believe(self._learnt, self._settings, np.empty(0), failed=True)

    @alone
    @step
    def tell_of_failures(self, *, told: bool = True) -> None:
        """Say that failures are told: an episode that ends without one is known to have had none.

        So does ``failed=False``. Without it, or if not ``told``, `explain` does not take silence
        for safety.
        """
        self._learnt.now["failures_told"] = told

    # -- Asking ---------------------------------------------------------------------------------

    @alone
    def predict(self, i: SupportsIndex, horizon: int = 1) -> Floats:
        """(n,) forecast of the state, ``belief @ P[i] @ P*^(horizon - 1)``: Section 2.3.2.

        At the start of an episode the belief is uniform; before any observation it is empty.

        Parameters
        ----------
        i : int
            Index of the action taken now, from 0.
        horizon : int
            Number of steps, at least 1; after the first all actions count alike.
        """
        action, n = valid.check_action(i, self.n_actions), self.n_states
        if whole("horizon", horizon) > 1:
            return self.model().propagate(self.belief, action, horizon)
        place = self._learnt.actions["place"][action]
        if place == NOT_OPEN:
            return np.full(n, 1.0 / max(n, 1))
        return np.asarray(self.belief @ self._learnt.matrices[place, :n, :n])

    @alone
    def explain(
        self, action: SupportsIndex | None = None, labels: Labels | None = None
    ) -> Explanation:
        """What experience says of the present situation, as `FSMModel.explain` tells it.

        Parameters
        ----------
        action, labels : int, Labels, optional
            What came of taking it there; what the numbers mean.
        """
        index = None if action is None else valid.check_action(action, self.n_actions)
        if self.state is None:
            return Explanation("Nothing was observed yet in this episode.")
        model, learnt = self.model(), self._learnt
        is_whole = learnt.states["latest_visit"][self.state] == learnt.now["clock"][0]
        nearest = model.nearest(learnt.variables["latest"]) if is_whole else None
        return explain(model, self.belief, index, labels or Labels(), nearest)

    @alone
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
        actions, names, units, dt
            What its numbers mean, as `Labels` takes them.
        """
        contents, now = arrays.by_name(self._learnt), self._learnt.now[0]
        q, n = self.n_actions, self.n_states
        if now["chained"]:  # what belongs to an episode that is going on is not shown yet
            contents["episodes"] -= contents["latest_visit"] >= now["began"]
            contents["tried"] -= contents["latest_try"] >= now["began"]
        indices = np.flatnonzero(contents["place"] != NOT_OPEN)
        of_actions = {
            "transition_matrices": np.full((q, n, n), 1.0 / max(n, 1)),
            "origin_frequency": np.full((q, n), n * self.prior_frequency),
            **{name: np.zeros((q, n)) for name in OF_ACTIONS},
        }
        contents["transition_matrices"] = contents["matrices"]
        for name, array in of_actions.items():
            array[indices] = contents[name][contents["place"][indices]]
        parts: dict[str, Any] = {name: contents[name] for name in OF_MODEL} | of_actions
        parts["centers"] = contents["centers"].T
        for name in ("width", "rule", "failures_told", "settings"):
            parts[name] = getattr(self, name)
        labels = Labels(actions, tuple(names), tuple(units), dt)
        return FSMModel(**parts, **labels._asdict())

    def __getattr__(self, name: str) -> Any:
        """A setting, or an array of the snapshot of now."""
        if name in _LIMITS:
            most = getattr(self._settings, name)
            return None if most == np.inf else int(most)
        if name in Settings._fields:
            return getattr(self._settings, name)
        if name in _ASKED:
            return getattr(self.model(), name).copy()
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    @property
    def settings(self) -> dict[str, Any]:
        """Its settings by name, but for the rule; those that were left as they are, left out."""
        values = {name: getattr(self, name) for name in (*_SETTINGS, *_OPTIONS)}
        return {name: value for name, value in values.items() if value != _OPTIONS.get(name, ...)}

    @property
    def n_actions(self) -> int:
        """Number q of actions."""
        return len(self._learnt.actions)

    @property
    def rule(self) -> StateRule:
        """How states are determined."""
        return self._rule

    @property
    def nbytes(self) -> int:
        """Memory that holds what was learnt, with room for the next states [byte]."""
        return sum(array.nbytes for array in self._learnt)

    @property
    def n_states(self) -> int:
        """Number of states."""
        return int(self._learnt.now["n_states"][0])

    @property
    def n_variables(self) -> int:
        """Number m of variables in an observation; 0 before the first."""
        return len(self._learnt.variables)

    @property
    @alone
    def state_ids(self) -> NDArray[np.int64]:
        """(n,) number of each state's creation, from 0.

        An index that became free (``max_states``) goes to a new state, with a new number.
        """
        return self._learnt.states["id"][: self.n_states].astype(np.int64)

    @property
    @alone
    def centers(self) -> Floats:
        """(n, m) the observation at the centre of each state."""
        return self._learnt.centers[:, : self.n_states].T.copy()

    @property
    def failures_told(self) -> bool:
        """Whether anybody told of failures: of one, or that there was none."""
        return bool(self._learnt.now["failures_told"][0])

    @property
    @alone
    def width(self) -> float:
        """Width of recognition, a squared distance; 0 before the first observation."""
        now = self._learnt.now[0]
        count = now["n_observations"]
        return float(uncompiled(width_of)(self._settings, now["scatter"] / count)) if count else 0.0

    @property
    @alone
    def belief(self) -> Floats:
        """(n,) the present distribution over states, uniform as an episode starts."""
        n = self.n_states
        if self._learnt.now["chained"][0]:
            return self._learnt.belief[:n].copy()
        return np.full(n, 1.0 / max(n, 1))

    @property
    @alone
    def state(self) -> int | None:
        """Index of the most probable state; None until an episode's first observation."""
        now = self._learnt.now[0]
        return int(now["state"]) if now["chained"] else None

    savepoint = alone(Retraced.savepoint)
    _twin = staticmethod(copy.copy)  # which has arrays of its own

    # -- Files and copies -------------------------------------------------------------------------

    def copy(self) -> Self:
        """An independent machine in the same state."""
        return copy.copy(self)

    @alone
    def save(self, path: Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write it to a file: arrays and a JSON header.

        Parameters
        ----------
        path : str, path-like or binary file
            It is replaced, or left as it was where this cannot be written.
        provenance : mapping, optional
            What it learnt from, for JSON.
        """
        store.write(path, MACHINE, self._content, arrays.by_name(self._learnt), provenance)

    @classmethod
    def load(cls, path: Place) -> Self:
        """Read it from a file; it goes on bit for bit as if it had never been stopped.

        An OSError says that it may not be read, a ValueError that it is damaged, or something else.
        """
        content, learnt = store.read(path, MACHINE)
        with store.explained(path):
            machine = cls(**{**content, "rule": rules.restore_rule(content["rule"])})
            if m := len(learnt["first"]):
                machine._fit(m)
            machine._learnt = arrays.from_names(learnt, m, machine.n_actions)
            return machine

    @property
    def _content(self) -> dict[str, Any]:
        return self.settings | {"rule": rules.describe_rule(self._rule)}

    # A copy, or what another process gets, has a lock and arrays of its own.
    @alone
    def __getstate__(self) -> dict[str, Any]:
        learnt = [array.copy() for array in self._learnt]
        return {**unshared(self), "_learnt": learnt, "_known": None, "_one": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        # A file that is mapped for reading cannot be written to.
        self._learnt = Learnt(*(np.require(array, None, ("C", "W")) for array in self._learnt))
        self._share()

    def __repr__(self) -> str:
        entries = self.settings | ({} if self._rule == rules.Paper() else {"rule": self._rule})
        settings = ", ".join(f"{name}={value}" for name, value in entries.items())
        return f"{type(self).__name__}({settings})"

    # -- Inside ---------------------------------------------------------------------------------

    def _share(self) -> None:
        """Be ready for threads. They wait for whoever steps, grows, or takes a copy."""
        share(self)
        self._known = None
        # Room for a single row.
        flags = np.zeros((2, 1), np.bool_)
        self._one = np.empty(1, np.int64), *flags, blank_trace(1), np.empty((0, 0))

    @property
    def _capacity(self) -> int:
        return len(self._learnt.belief)

    @step
    def _step(self, z: Floats, action: int, failed: bool | None) -> Step:
        """Observe, then act: a single row."""
        if z.shape != self._learnt.variables.shape:
            self._fit(len(z))
        row = z[None]
        actions, starts, failures, trace, beliefs = self._one
        actions[0], failures[0] = action, bool(failed)
        scratch = np.empty((3, len(self._learnt.belief)))
        arguments = self._settings, row, actions, starts, failures, failed is not None
        while not _LEARN_ROWS.call(self._learnt, *arguments, scratch, 0, trace, beliefs):
            self._make_room()
            scratch = np.empty((3, len(self._learnt.belief)))
        n, surprise = trace.n_states.item(), trace.surprise.item()
        forecast = scratch[PREDICTED, : n if surprise == surprise else 0].copy()
        event = EVENTS[trace.event.item()]
        belief = self._learnt.belief[:n].copy()
        return Step(trace.state.item(), belief, event, forecast, surprise)

    @step
    def _observe_partly(self, z: Floats, absent: NDArray[np.bool_], failed: bool | None) -> Step:
        """Recognise what some variables are missing of; only the belief changes."""
        now, n = self._learnt.now[0], self.n_states
        if n == 0:
            gaps = np.flatnonzero(absent).tolist()
            raise ValueError(f"variables {gaps} of a machine's first observation are missing")
        self._fit(len(z))
        vector = valid.usable_array("observation", np.where(absent, 0.0, z))
        action = int(now["action"])
        forecast = self.predict(action) if now["chained"] and action >= 0 else np.empty(0)
        if absent.all():
            belief = forecast if len(forecast) else self.belief
        else:
            centers, weights = self._learnt.centers[:, :n], self._settings.weights * ~absent
            belief = believed(centers, weights, vector[None], self.width)[0]
        surprise = np.nan if absent.all() or not len(forecast) else jensen_shannon(forecast, belief)
        # In a copy, which takes the place of what there was as a whole.
        learnt = arrays.resized(self._learnt, *room_for(self._learnt, self._settings))
        stepping.believe(learnt, self._settings, belief, failed=bool(failed))
        if failed is not None:
            learnt.now["failures_told"] = 1
        self._learnt = learnt
        return Step(int(belief.argmax()), belief, Event.NONE, forecast, surprise)

    def _fit(self, m: int) -> None:
        """Make room for observations of ``m`` variables; raise where the first had others."""
        if self.n_states and m != self.n_variables:
            before = f"this machine was started with {self.n_variables}"
            raise ValueError(f"observation has {m} variables, but {before}")
        if self.n_states == 0:
            self._settings = self._settings._replace(weights=rules.weights_of(self._rule, m))
            learnt = arrays.blank(m, self.n_actions, LINE, 0)
            learnt.now["failures_told"] = self._learnt.now["failures_told"]
            self._learnt = learnt

    def _make_room(self) -> None:
        """Make room for what the next step may need."""
        room = room_for(self._learnt, self._settings)
        if room != (self._capacity, len(self._learnt.matrices)):
            n, n_observations = self.n_states, int(self._learnt.now["n_observations"][0])
            if _MANY_STATES <= n < 1.5 * _MANY_STATES and n_observations < 2 * n:  # once
                warnings.warn(_TOO_FINE.format(n, n_observations), RuntimeWarning, stacklevel=4)
            self._learnt = arrays.resized(self._learnt, *room)


def _refuse(name: str, *_: object) -> None:
    raise AttributeError(f"{name} of a machine is read only: settings are given as it is made")


# What a machine answers by name is read only; others cost nothing more to set.
for _name in {*_ASKED, *_LIMITS, *Settings._fields}.difference(dir(EvolvingFSM)):
    _answer = methodcaller("__getattr__", _name)
    setattr(EvolvingFSM, _name, property(_answer, partial(_refuse, _name), doc=""))


def opened(machine: EvolvingFSM) -> tuple[Learnt, Settings]:
    """What a machine has learnt and was given, itself."""
    return machine._learnt, machine._settings


def _or_infinity(name: str, most: SupportsIndex | None) -> float:
    return np.inf if most is None else float(whole(name, most))

"""What decides: an action passes if after it some backup survives all that is remembered."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from evofsm import store
from evofsm.fsm.naming import Labels
from evofsm.fsm.proportions import poisson_bounds
from evofsm.fsm.sharing import Rollback
from evofsm.fsm.validation import action_name, positive, real_array, refuse_unusable, whole
from evofsm.guard.api import ActionJudge, Fallback, Judgement, Search, Situation
from evofsm.guard.harm import SETTINGS, Harm
from evofsm.guard.learnt import files, words
from evofsm.guard.learnt.learn import disturbance_scale, learn
from evofsm.guard.learnt.rollout import (
    CUT_SHORT,
    KEPT,
    Floats,
    Ints,
    Model,
    pairs,
    search,
    value_of,
)
from evofsm.guard.learnt.state import Episode, Settings, State, model_of, residuals_of
from evofsm.guard.learnt.words import Remembered
from evofsm.store import Place

JUDGE_PARTS = ("margin", "backups", "dead-ends", "stretches", "regions", "rivals", "products", "lags", "doubt", "jumps", "carried", "places")
_LONGEST = 1024


class Parts(NamedTuple):
    """What decides, made of a state."""

    model: Model
    daring: Model  #: while it learns
    residuals: Floats
    scale: float
    exposure: float


class LearntRisk(ActionJudge):
    def __init__(self, dt, low=None, high=None, *, n_actions=None, horizon=None, seed=0, without=(), names=(), units=(), settings=Settings()):
        self.dt = positive("dt", dt)
        self.given_horizon = None if horizon is None else positive("horizon", horizon)
        steps = None if horizon is None else max(1, round(horizon / self.dt))
        self.seed, self.without, self.settings = operator.index(seed), frozenset(without), settings
        self.labels = Labels(names=tuple(names), units=tuple(units), dt=self.dt)
        self.choices = 0 if n_actions is None else whole("n_actions", n_actions)
        none = n_actions is not None
        self.low = np.zeros(0) if none else np.atleast_1d(np.asarray(low, float))
        self.high = np.zeros(0) if none else np.atleast_1d(np.asarray(high, float))
        self._middle, self._half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        self.size = self.choices or len(self.low)
        self.steps = steps
        self.state = State.none(0, self.size, self.choices, settings, steps)
        if "margin" in self.without:
            self.state = self.state._replace(margin=0.0)
        self.failed = None
        self.learning = True
        self.harm = Harm()
        self.n_violated = 0
        self.dynamics = self
        self.parts = None
        self._forget()

    @property
    def n_variables(self):
        return len(self.state.origin)

    def encode(self, action: Any) -> Floats:
        if self.choices:
            chosen = np.zeros(self.choices)
            chosen[int(action)] = 1.0
            return chosen
        return np.asarray((np.asarray(action, np.float64) - self._middle) / self._half)

    def decode(self, inner: Floats) -> Floats:
        if self.choices:
            return np.array([float(inner.argmax())])
        found = self._middle + self._half * inner
        return np.minimum(np.maximum(found, self.low), self.high)

    @property
    def fallback(self):
        if self.choices:
            return Fallback(0.0, "the first action")
        middle = self._middle
        return Fallback(middle if len(middle) > 1 else float(middle[0]), "the middle of the range")

    def refuse_unfit(self, low, high): ...

    @property
    def remembered(self):
        return Remembered(len(self.state.windows), float(self.state.n_seen) * self.dt)

    # -- Deciding

    @property
    def margin(self):
        return self.state.margin

    @property
    def effort(self):
        few = self.settings.n_asked if len(pairs(self.n_variables)[0]) else 2
        count = self.parts.residuals.shape[2]
        model = self.parts.model
        each = (model.weights.size + model.dead_ends.size) * count
        s = self.settings
        return few, max(min(s.work, s.work_rate * self.dt) / each, few * self.state.horizon)

    def search(self, situation, wanted, *, tolerance, revising):
        here, one = self._here(situation.observation), np.array([wanted])
        parts = self.parts
        if parts is None:
            return Search(one, _unjudged(1), 0, words.NOTHING_LEARNT)
        if here is None:
            return Search(one, _unjudged(1), 0, words.NOTHING_SEEN)
        if not len(self.state.forms):
            return Search(one, _unjudged(1), 0, words.NO_FAILURE)
        model = parts.daring if self.learning else parts.model
        if not len(model.forms):
            return Search(one, _unjudged(1), 0, words.DOUBTED)
        proposal, scale = self.encode(wanted), parts.scale
        few, most = self.effort
        remembered, ranks = self.remembered, self._ranks[:few]
        allowed = self._allowed(tolerance, remembered)
        margin = self.state.margin + self._added
        asked = model, here, self.state.policies, ranks, parts.residuals, scale
        how, action, which, left = search(*asked, proposal, margin, allowed, most)
        tried = None
        if which != ranks[0]:
            self._ranks = np.append(which, self._ranks[self._ranks != which])
        passes, self._refused, cut = how < CUT_SHORT, how != KEPT, how == CUT_SHORT
        self._holds = passes
        if not passes:
            if self._certified and not cut:
                how = search(*asked, action, 0.0, allowed, most, lasting=False)[0]
                self._holds = how < CUT_SHORT
            self._certified &= how != CUT_SHORT
            tried = self._untried(action) if self.learning and left < self.settings.alike else None
            action = action if tried is None else tried
        judged, self._lost, after = self._judged(
            situation, here, np.array((proposal, action) if self._refused else (proposal,)),
            left if passes and not allowed else None,
        )
        self._fails_after = max(self._fails_after, after)
        if not self._refused:
            return Search(one, judged, 0, words.kept(str(which), remembered, left, allowed))
        why = words.refused(self._unsurvived, remembered, margin, scale, allowed)
        executed = np.reshape(self.decode(action), np.shape(wanted))
        return Search(np.array((one[0], executed)), judged, 1, why)

    def judge(self, situation, actions):
        given, here = np.asarray(actions, np.float64), self._here(situation.observation)
        if here is None or self.parts is None or not len(self.state.forms):
            return _unjudged(len(given))
        return self._judged(situation, here, np.array([self.encode(one) for one in given]))[0]

    def why(self, judged):
        return words.refused(self._unsurvived, self.remembered, self.margin, self.parts.scale)

    def _judged(self, situation, here, actions, passes=None):
        asked = actions if passes is None else actions[:-1]
        each = [self._foresee(here, action[None], self._ranks[: self.settings.n_asked]) for action in asked]
        if passes is not None:
            each.append((0.0, passes, 0.0))
        unsurvived, left, after = zip(*each, strict=True)
        self._unsurvived = -1 if math.isinf(unsurvived[0]) else int(unsurvived[0])
        remembered = self.remembered
        soon = self._soon(remembered.seconds)
        risk, low, high = np.array([self._risk(one, soon) for one in unsurvived]).T
        judged = Judgement(risk, low, high, np.array(left), float(remembered.number), situation.seen)
        return judged, math.isinf(unsurvived[-1]), max(after)

    def _foresee(self, here, plan, ranks):
        policies, steps = self.state.policies[ranks], self.parts.residuals.shape[0]
        ends = value_of(self.parts.model, here[None], policies, self.parts.residuals, 1.0, plan, 0.0)[0]
        fails = ends[ends < 0.0]
        unsurvived = math.inf if ends[0] < 0.0 else float(len(fails))
        return unsurvived, float(ends.min()), float(fails.max(initial=-1.0 - steps)) + 1.0 + steps

    def _soon(self, exposure):
        return self.state.horizon * self.dt / max(exposure, 1e-300)

    def _risk(self, unsurvived, soon):
        if math.isinf(unsurvived):
            return 1.0, 0.0, 1.0
        low, high = poisson_bounds(int(unsurvived))
        high = high if unsurvived < self.settings.n_disturbances else math.inf
        return -math.expm1(-unsurvived * soon), -math.expm1(-low * soon), -math.expm1(-high * soon)

    def _allowed(self, tolerance, remembered):
        soon, most, allowed = self._soon(remembered.seconds), tolerance * remembered.number, 0
        while allowed + 1 <= most and self._risk(allowed + 1, soon)[2] <= tolerance:
            allowed += 1
        return allowed

    def _here(self, z):
        at, m, has_gaps = self._at, len(z), math.isnan(z.dot(z))
        if at is None:
            return None if has_gaps else np.append(z, np.zeros(m + self.size))
        if has_gaps:
            z = np.where(np.isnan(z), at[:m] + at[m : 2 * m], z)
        return np.concatenate([z, z - at[:m], self._action])

    def _untried(self, best):
        used, tries = self.state.used + self._used, self.settings.tries
        if self.choices:
            i = int(used[:, 1].argmin())
            return np.eye(len(used))[i] if used[i, 1] < tries and used[i, 1] < used[:, 1].max() else None
        k, end = divmod(int(used.argmin()), 2)
        if used[k, end] < tries and used[k, end] < used[k, 1 - end]:
            best = best.copy()
            best[k] = (-1.0, 1.0)[end]
            return best
        return None

    # -- Learning

    def observe(self, observation):
        self._z.append(observation.copy())
        return False

    def act(self, action):
        if self._z:
            inner = self.encode(action)
            lowest = -1.0 if self.choices else -0.6
            if len(self._u) == len(self._z):
                self._u[-1] = inner
            else:
                self._u.append(inner)
            self._used = self._used + np.array([inner < lowest, inner > 0.6]).T

    def learn(self, observation, action, belief):
        if "margin" not in self.without and self.parts is not None:
            violated = self._certified and not self._holds
            self.n_violated += violated
            s = self.settings
            margin = self.state.margin + s.margin_step * (violated - s.violation_rate)
            self.state = self.state._replace(margin=min(s.margin_max, max(s.margin_step, margin)))
        self._certified = self._holds
        self._take_in(observation, action)

    def watch(self, observation, action, belief):
        self._certified = False
        self._take_in(observation, action)

    def _take_in(self, observation, action):
        self.follow(observation, action)
        self._notes.append((self._refused, self._lost, self._certified))
        if len(self._z) > _LONGEST:
            self._study(self._z, self._u[:-1], False, False)
            k = 3
            self._z, self._u, self._notes = self._z[-k:], self._u[-k:], self._notes[-k:]
            self._ranks = np.arange(len(self.state.policies))

    def follow(self, observation, action):
        here = self._here(np.array(observation, np.float64))
        if here is not None:
            self._at, self._action = here, self.encode(action)

    def start_episode(self, *, learn=True):
        if learn:
            self.end(None, failed=False)
        else:
            self._forget()

    def end(self, observation, *, failed, terminated=False):
        if len(self._z) > 1 or (failed and self._z):
            self._study(self._z, self._u[: len(self._z) - 1], failed, terminated and not failed)
        self._forget()

    def _study(self, z, u, failed, terminated):
        notes = np.array(self._notes[: len(u)], float).reshape(-1, 3)
        notes = np.vstack([notes, np.zeros((len(u) - len(notes), 3))])
        episode = Episode(np.array(z), np.array(u).reshape(-1, self.size), failed, terminated, *notes.T, self._fails_after)
        if not self.n_variables:
            margin = self.state.margin
            self.state = State.none(len(z[0]), self.size, self.choices, self.settings, self.steps)._replace(margin=margin)
        self.state = learn(self.state, episode, self.settings, self.seed, self.without, self.given_horizon, self.failed)
        self.parts = self._made()

    def _made(self):
        s = self.state
        if not len(s.policies):
            return None
        known = model_of(s, self.settings)
        return Parts(
            known, model_of(s, self.settings, daring=True), residuals_of(s, known, s.horizon),
            disturbance_scale(s, self.settings), s.n_seen * self.dt,
        )

    def remake(self) -> None:
        """Decide by `state`, between two episodes."""
        self.parts = self._made()
        self._forget()

    def _forget(self):
        self._at, self._action, self._added = None, np.zeros(0), 0.0
        self._z, self._u, self._notes = [], [], []
        self._certified = self._holds = self._refused = self._lost = False
        self._unsurvived, self._fails_after = 0, 0.0
        self._used = np.zeros((self.size, 2))
        self._ranks = np.arange(len(self.state.policies))

    def sums(self, n_states):
        return {}

    def save(self, path: Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write what was learnt to a file, with what it learnt from, for people (`provenance`)."""
        numbers, arrays = files.packed(self.state)
        settings = {
            **{name: getattr(self, name) for name in ("dt", "seed", "given_horizon", "n_violated")},
            **{name: getattr(self, name).tolist() for name in ("low", "high")},
            **{name: list(getattr(self.labels, name)) for name in ("names", "units")},
            "n_actions": self.choices or None,
            "without": sorted(self.without),
            "harm": {name: getattr(self.harm, name) for name in SETTINGS},
            "settings": asdict(self.settings),
            "state": numbers,
        }
        arrays["harm"] = np.array(self.harm.outcomes, np.float64).reshape(-1, 4)
        store.write(path, files.KIND, settings, arrays, provenance)

    @classmethod
    def load(cls, path: Place) -> Self:
        """Read what was learnt, between two episodes; a ValueError if the file is damaged."""
        settings, arrays = store.read(path, files.KIND)
        with store.explained(path):
            names = ("n_actions", "seed", "without", "names", "units")
            given = {name: settings[name] for name in names}
            if given["n_actions"] is None:
                given |= {"low": settings["low"], "high": settings["high"]}
            given |= {"horizon": settings["given_horizon"]}
            judge = cls(settings["dt"], settings=Settings(**settings["settings"]), **given)
            of = judge.choices, judge.settings
            judge.state = files.unpacked(settings["state"], arrays, *of)
            if len(judge.state.used) != judge.size:
                raise ValueError(f"used is of other actions than those of {judge.size} numbers")
            judge.harm = Harm.restored(settings["harm"], arrays["harm"])
            judge.n_violated = settings["n_violated"]
            judge.remake()
        return judge

    @property
    def told_by_experience(self) -> str:
        """What was learnt so far, in words."""
        told = words.experience(self.state, self.remembered, self.called, self._nothing)
        return told + words.harm(self.harm, learning=self.learning)

    def told_here(self, observation: Floats) -> tuple[str, Floats | None]:
        """What was learnt of an observation, in words, and the centre of the dead end it is near.

        Empty, and None, where it is in and near none, nor near a form of failures.
        """
        if math.isnan(observation.dot(observation)) or self.parts is None:
            return "", None
        near = self.settings.margin_max
        return words.here(self.state, self.parts.model, self.called, observation, near)

    @property
    def called(self) -> Sequence[str]:
        """Names of variables, as people read them."""
        return self.labels.names or [f"variable {j + 1}" for j in range(self.n_variables)]

    @property
    def _nothing(self) -> str:
        """Why nothing is refused, as long as nothing is."""
        return words.no_threshold(self.state.n_failed, is_given=self.failed is not None)


def _unjudged(count):
    nothing = np.full(count, math.nan)
    return Judgement(nothing, nothing, nothing, nothing, 0.0)

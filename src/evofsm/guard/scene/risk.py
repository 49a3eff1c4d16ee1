"""A judge of scenes: failure is to meet one of the objects around, and nothing of it was told.

An action is as dangerous as the best of what can follow it: each action, taken for good. What comes
of it is forecast for oneself and for every object by what was remembered (`memory.Memory`), and how
close is too close is learnt from the failures (`contact.learn`).
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.fsm import Labels, positive, wilson_bounds
from evofsm.guard.actions import Action
from evofsm.guard.protocols import Fallback, Judgement, Search, Situation, Trial
from evofsm.guard.scene.keeping import KIND, arrays_of, episodes_of
from evofsm.guard.scene.memory import ANALOGS, Episode, Foreseen, Memory
from evofsm.guard.scene.seeing import Layout, Seen
from evofsm.store import Place, storage

_Floats = NDArray[np.float64]

# Steps that are looked ahead unless told otherwise.
_AHEAD = 5


class SceneRisk:
    """Judges one of a few actions among any number of objects, told only which episodes failed.

    It learns three things, each from all objects alike: how oneself moves under each action, how
    objects go on, and how close is too close. The risk of an action is the probability to meet an
    object within the horizon, if the best of all actions follows it for good.

    For decisions that are few and coarse, such as once a second; actions are `Choices`.

    Parameters
    ----------
    dt : float
        Time between two decisions [s].
    n_actions : int
    columns, place, relative
        How an observation is made of rows: see `Layout`.
    horizon : float, optional
        How far it looks ahead [s]; without it five decisions.

    Raises
    ------
    ValueError
        If a number is out of its range.

    Notes
    -----
    Before the first failure all is kept. Failures that no object explains (a border, time) are
    not learnt. How objects answer to one's own action is not forecast: they go on as such objects
    went on before. The 90 % interval is that of a share of so many analogs (Wilson 1927).

    Examples
    --------
    >>> from evofsm.guard import Guard
    >>> judge = SceneRisk(1.0, 5)
    >>> guard = Guard(n_actions=5, interval=1.0, judge=judge)
    >>> ego, car = [1.0, 0.0, 4.0, 25.0, 0.0], [1.0, 30.0, 0.0, -5.0, 0.0]
    >>> guard.decide(ego + car, proposal=3).reason
    'no failure is known yet, so nothing is refused'
    """

    _seen: list[Seen]
    _actions: list[int]

    def __init__(
        self,
        dt: float,
        n_actions: int,
        *,
        columns: int = 5,
        place: Sequence[int] = (1, 2),
        relative: bool = True,
        horizon: float | None = None,
    ) -> None:
        self.dt = positive("dt", dt)
        self.told_horizon = None if horizon is None else positive("horizon", horizon)
        self.layout = Layout(columns, tuple(place), relative)
        steps = _AHEAD if horizon is None else max(1, round(horizon / self.dt))
        #: What was learnt.
        self.memory = Memory(operator.index(n_actions), steps)
        self.labels = Labels(dt=self.dt)
        self.start_episode(learn=False)

    @property
    def fallback(self) -> Fallback:
        """What is done without a usable proposal, and then revised like any."""
        return Fallback(0.0, "the first action")

    def trial(self) -> Trial | None:
        """None: it tries nothing."""
        return None

    def effective(self, situation: Situation, actions: _Floats) -> _Floats:
        """All actions as they are."""
        return actions

    def refuse_unfit(self, low: Action, high: Action) -> None:
        """Raise a ValueError if there are other actions than it was made for."""
        if (low, high) != (0.0, self.memory.n_actions - 1.0):
            raise ValueError(
                f"the judge was made for {self.memory.n_actions} choices, but actions lie from "
                f"{low} to {high}"
            )

    # -- Deciding -------------------------------------------------------------------------------

    def search(
        self, situation: Situation, wanted: Action, *, tolerance: float, revising: bool
    ) -> Search:
        """The action within the tolerance that is closest to ``wanted`` in what it brings oneself.

        Where none is within the tolerance, it is one of those that are as little risky as any, and
        of these one after which it lasts as long as after any, both up to the tolerance.

        Parameters
        ----------
        situation : Situation
        wanted : float
        tolerance : float
            Highest risk that is accepted.
        revising : bool
            Not used.

        Returns
        -------
        Search
        """
        found = self._foreseen(situation)
        if found is None:
            return Search(np.array([wanted]), self._unjudged(1), 0, self._nothing)
        risks, proposed = found.risks.min(1), int(wanted)
        ahead = f"within {self.memory.steps * self.dt:g} s"
        if risks[proposed] <= tolerance:
            said = f"risk {ahead} is within the tolerance"
            return Search(np.array([wanted]), self._judged(risks[[proposed]]), 0, said)
        why, after = self.why(self._judged(risks[[proposed]])), found.after
        good, what = np.flatnonzero(risks <= tolerance), "the closest in effect that can"
        if not len(good):
            good = np.flatnonzero(risks <= risks.min() + tolerance)
            lasting = found.lasting[good].max(1)
            good = good[lasting >= lasting.max() - tolerance]
            what = "nothing can, the one that lasts longest"
        if proposed in good:
            best, what = proposed, "nothing can, nor does anything last longer"
        else:
            best = int(good[self.memory.apart(after[good], after[proposed]).argmin()])
        judged = self._judged(risks[[proposed, best]])
        options = np.array([wanted, float(best)])
        return Search(options, judged, int(best != proposed), f"{why}; {what}")

    def judge(self, situation: Situation, actions: ArrayLike) -> Judgement:
        """Risk of each action.

        Parameters
        ----------
        situation : Situation
        actions : (k,) array_like

        Returns
        -------
        Judgement
            NaN as long as nothing can be said.
        """
        given, found = np.asarray(actions, np.float64), self._foreseen(situation)
        if found is None:
            return self._unjudged(len(given))
        return self._judged(found.risks.min(1)[given.astype(int)])

    def why(self, judged: Judgement) -> str:
        """Why the first action that was judged is dangerous, in a few words.

        Examples
        --------
        >>> judge = SceneRisk(1.0, 5)
        >>> judge.why(Judgement(np.array([0.25]), *np.zeros((3, 1)), evidence=3.0))
        'whatever follows, an object is met within 5 s: 25 %'
        """
        ahead, risk = self.memory.steps * self.dt, 100.0 * judged.risk[0]
        return f"whatever follows, an object is met within {ahead:g} s: {risk:.2g} %"

    @property
    def _nothing(self) -> str:
        if self.memory.contact is None:
            return "no failure is known yet, so nothing is refused"
        return "own row is not seen"

    def _foreseen(self, situation: Situation) -> Foreseen | None:
        """What comes of each action; None where nothing can be said."""
        seen = self.layout.read(situation.observation)
        if self.memory.contact is None or not np.isfinite(seen.own).all():
            return None
        return self.memory.foresee(seen)

    def _judged(self, risks: _Floats) -> Judgement:
        low, high = np.transpose([wilson_bounds(float(risk), ANALOGS) for risk in risks])
        unknown = np.full(len(risks), math.nan)
        return Judgement(risks, low, high, unknown, float(self.memory.failures))

    @staticmethod
    def _unjudged(count: int) -> Judgement:
        nothing = np.full(count, math.nan)
        return Judgement(nothing, nothing, nothing, nothing, 0.0)

    # -- Learning -------------------------------------------------------------------------------

    def learn(self, observation: ArrayLike, action: Action, belief: ArrayLike) -> None:
        """Take in an observation and what was done after it."""
        seen = self.layout.read(np.asarray(observation, np.float64))
        if not np.isfinite(seen.own).all():  # what follows begins anew
            self._remember(failed=False)
            return
        self._seen.append(seen)
        self._actions.append(int(action))

    watch = learn

    def follow(self, observation: ArrayLike, action: Action) -> None:
        """Nothing: what it decides depends on the present observation alone."""

    def start_episode(self, *, learn: bool = True) -> None:
        """What comes is not a consequence of what was; the episode before is learnt from."""
        if learn:
            self._remember(failed=False)
        self._seen, self._actions = [], []

    def end(self, observation: NDArray[np.float64] | None, *, failed: bool) -> None:
        """Learn from an episode, and from its last observation if there is one."""
        if observation is not None:
            last = self.layout.read(observation)
            if np.isfinite(last.own).all():
                self._seen.append(last)
        self._remember(failed=failed)
        self.start_episode(learn=False)

    def _remember(self, *, failed: bool) -> None:
        """Keep what was seen, if it was more than a moment."""
        if len(self._seen) > 1:
            actions = self._actions[: len(self._seen) - 1]
            self.memory.add(Episode.of(self._seen, actions, failed))
        self._seen, self._actions = [], []

    # -- Keeping it -----------------------------------------------------------------------------

    def sums(self, n_states: int) -> dict[str, float]:
        """A few sums that whatever is learnt changes."""
        episodes = self.memory.episodes
        return {
            "episodes": float(len(episodes)),
            "failures": float(self.memory.failures),
            "moments": float(sum(len(one.own) for one in episodes)),
            "places": math.fsum(float(one.away.sum()) for one in episodes),
        }

    def save(self, path: Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write what was learnt to a file.

        Parameters
        ----------
        path : path-like, or file open for writing bytes
        provenance : mapping, optional
            What it learnt from, for people; kept in the file.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        content = {
            "dt": self.dt,
            "n_actions": self.memory.n_actions,
            "columns": self.layout.columns,
            "place": list(self.layout.place),
            "relative": self.layout.relative,
            "horizon": self.told_horizon,
            "failures": self.memory.failures,
            "fitted": self.memory.fitted,
        }
        storage.write(path, KIND.name, content, arrays_of(self.memory.episodes), provenance)

    @classmethod
    def load(cls, path: Place) -> Self:
        """Read what was learnt, between two episodes.

        Raises
        ------
        OSError
            If there is no such file, or it may not be read.
        ValueError
            If the file holds something else or is damaged.
        """
        content, arrays = storage.read(path, KIND.name)
        with storage.explained(path):
            counted = {name: int(content.pop(name)) for name in ("failures", "fitted")}
            judge = cls(content.pop("dt"), content.pop("n_actions"), **content)
            judge.memory.restore(episodes_of(arrays), **counted)
        return judge

    def __repr__(self) -> str:
        return f"{type(self).__name__}(dt={self.dt:g}, n_actions={self.memory.n_actions})"

"""The learnt judge: it is told nothing but which episodes failed."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.core import Disturbances, Dynamics, Here
from evofsm.guard.learnt.search import CHANGED, KEPT, NOTHING_PASSES, harm, search, worth

_Floats = NDArray[np.float64]

PARTS = ("margin", "backups", "states")

# Backups that are asked in a decision, and linear ones that evolve.
_ASKED, _LINEAR = 3, 3
# Mutants an episode; disturbances that they are tried on, beside none.
_MUTANTS, _TRIED_ON = 40, 5
# Situations that are remembered; of those as many are asked for what harms.
_SITUATIONS, _SCANNED = 32, 8
_MOST_STARTS = 160
# The margin [ordinary changes]: at first, at most, what is left of it an episode later, and what a
# broken certificate adds, for a rate of those of.
_MARGIN, _LARGEST, _FADES, _ADDED, _RATE = 3.0, 8.0, 0.9, 0.25, 0.001
_RELEASE = 0.0
# Disturbances are taken to be harder by so many of the number of episodes, and at most.
_CAUTION = 4.0
# Backups closer than this are alike; an action that was used less often is tried.
_ALIKE, _TRIES = 0.02, 8


class Found(NamedTuple):
    """What a search came to."""

    action: _Floats
    how: int
    backup: int


class LearntRisk:
    """Judges actions by replays of what may begin here."""

    def __init__(self, dynamics: Dynamics, *, seed: int = 0, without: Sequence[str] = ()) -> None:
        self.dynamics = dynamics
        self.seed = seed
        self.without = frozenset(without)
        self.margin = 0.0 if "margin" in self.without else _MARGIN
        self.broken = 0
        self.studied = 0
        self.learning = True
        self.explored = 0
        self.counts = np.zeros(3, int)
        self.policies = np.zeros((0, 0, 0))
        self.ranks = np.zeros(0, int)
        self.base = np.zeros(0, int)
        self.situations: list[Here] = []
        self.disturbances: Disturbances | None = None
        self.start()

    def start(self) -> None:
        """Nothing is certified yet."""
        self._certified = False
        self._tight: list[bool] = []
        self.ranks = self.base.copy()
        self._order = np.arange(
            0 if self.disturbances is None else len(self.disturbances.residuals)
        )
        self._revising = False

    @property
    def harder(self) -> float:
        """By how much more than they were disturbances are taken to be."""
        return 1.0 + min(0.5 * _CAUTION, _CAUTION / max(1, self.studied))

    def decide(self, here: Here, proposal: _Floats) -> Found:
        """The closest action that passes."""
        known = self.dynamics.consequents
        if self.disturbances is None or not len(known.sides):
            self._tight.append(False)
            return Found(proposal, KEPT, -1)
        best, d = np.empty(len(proposal)), self.disturbances
        ranks = self.ranks[:_ASKED]
        keep = self.margin + (_RELEASE if self._revising else 0.0)
        how, backup, apart = search(
            known,
            here,
            proposal,
            self.policies,
            ranks,
            d,
            self._order,
            self.harder,
            self.margin,
            keep,
            0,
            best,
        )
        self.counts[how] += 1
        self._revising = how != KEPT
        self._tight.append(how != KEPT)
        self.ranks = np.array([backup, *(q for q in self.ranks if q != backup)])
        if not self.learning:
            return Found(best, how, backup)
        if how == NOTHING_PASSES and apart < _ALIKE:
            best = self._untried(best)
        broken = False
        if how == NOTHING_PASSES and self._certified:
            trial = np.empty(len(proposal))
            again, _, _ = search(
                known,
                here,
                best,
                self.policies,
                ranks,
                d,
                self._order,
                self.harder,
                0.0,
                0.0,
                0,
                trial,
            )
            broken = again == NOTHING_PASSES
        if "margin" not in self.without:
            self.broken += broken
            self.margin = min(_LARGEST, max(0.0, self.margin + _ADDED * (broken - _RATE)))
        self._certified = how != NOTHING_PASSES or (self._certified and not broken)
        return Found(best, how, backup)

    def _untried(self, best: _Floats) -> _Floats:
        """An action whose effect is hardly known, if there is one."""
        used = self.dynamics.used
        if self.dynamics.choices:
            i = int(used[:, 1].argmin())
            if used[i, 1] < _TRIES and used[i, 1] < used[:, 1].max():
                self.explored += 1
                return np.eye(len(used))[i]
            return best
        i, end = np.unravel_index(int(used.argmin()), used.shape)
        if used[i, end] < _TRIES and used[i, end] < used[i, 1 - end]:
            self.explored += 1
            best = best.copy()
            best[i] = (-1.0, 1.0)[end]
        return best

    # -- Learning from an episode ---------------------------------------------------------------

    def study(self) -> None:
        """Learn from the episode that the dynamics have just learnt from."""
        dynamics = self.dynamics
        self.margin *= _FADES
        episode = dynamics.latest
        if episode is None or not dynamics.ready:
            return
        random = np.random.default_rng([self.seed, dynamics.n_episodes])
        if not len(self.policies):
            self._frame()
        Z, U, T = episode.observations, episode.actions, len(episode.actions)
        # situations
        ts = list(random.integers(1, T, 1))
        tight = np.flatnonzero(self._tight[1:T]) + 1
        if len(tight):
            ts.append(int(random.choice(tight)))
        if episode.failed:
            span = max(3, min(T, dynamics.horizon))
            ts += list(np.maximum(1, T - 1 - random.integers(2, span, 3)))
        for t in ts:
            one = Here(Z[t], Z[t] - Z[t - 1], U[t - 1])
            if len(self.situations) < _SITUATIONS:
                self.situations.append(one)
            else:
                self.situations[int(random.integers(_SITUATIONS))] = one
        known = dynamics.consequents
        if "stretches" not in dynamics.without and len(known.sides) and len(self.situations) > 3:
            self._scan(random)
        self._select(random)
        if len(known.sides) and len(self.situations) >= 3:
            self._evolve(random)

    def _arrays(
        self, which: Sequence[int] | NDArray[np.int64] | None = None
    ) -> tuple[_Floats, ...]:
        some = self.situations if which is None else [self.situations[int(i)] for i in which]
        return tuple(np.array([getattr(one, name) for one in some]) for name in Here._fields)

    def _scan(self, random: np.random.Generator) -> None:
        """Remember the starts of the latest episode that would harm most."""
        dynamics = self.dynamics
        episode = dynamics.latest
        assert episode is not None
        H, m, n = dynamics.horizon, dynamics.n_variables, len(episode.residuals)
        known, best = dynamics.consequents, self.policies[self.base[:1]]
        none = _disturbances(np.zeros((1, H, m)))
        base = np.empty((1, len(self.situations)))
        harm(known, *self._arrays(), best, none, 1.0, base)
        ok = np.flatnonzero(base[0] > 0.0)
        if len(ok):
            ok = random.permutation(ok)[:_SCANNED]
            ts = np.arange(n)
            if n > _MOST_STARTS:
                ts = np.sort(random.permutation(n)[:_MOST_STARTS])
            padded = np.vstack([episode.residuals, np.zeros((H, m))])
            windows = np.array([padded[t : t + H] for t in ts])
            found = np.empty((len(ts), len(ok)))
            harm(known, *self._arrays(ok), best, _disturbances(windows), 1.0, found)
            taken = dynamics.onsets(episode.residuals)
            starts: list[int] = []
            for c in range(len(ok)):
                t = int(ts[found[:, c].argmin()])
                if all(abs(t - other) > 3 for other in [*starts, *taken]):
                    starts.append(t)
            dynamics.remember(starts)
        self.studied += 1

    def _select(self, random: np.random.Generator) -> None:
        dynamics = self.dynamics
        found = dynamics.disturbances()
        K, H = dynamics.n_stretches, dynamics.horizon
        if "memory" in dynamics.without:
            self._pool = np.vstack(
                [
                    getattr(self, "_pool", np.zeros((0, dynamics.n_variables))),
                    dynamics.latest.residuals,
                ]
            )[-3000:]
            rows = self._pool[random.integers(len(self._pool), size=(K, H))]
            found = _disturbances(np.vstack([np.zeros((1, H, dynamics.n_variables)), rows]))
        elif len(dynamics.stretches) > K:
            keep = list(range(len(dynamics.stretches)))
            if len(dynamics.consequents.sides) and self.situations:
                M = np.empty((len(found.residuals), len(self.situations)))
                harm(
                    dynamics.consequents,
                    *self._arrays(),
                    self.policies[self.base[:2]],
                    found,
                    self.harder,
                    M,
                )
                M = M[1:]
                M = np.where(M < -1.0 - (H - 3), 1e9, M)  # lost at once, whatever one does
                value = np.minimum(M, 100.0).mean(1)
                while len(keep) > K:
                    ks = np.array(keep)
                    worst = set(ks[M[ks].argmin(0)])
                    free = [k for k in keep if k not in worst] or keep
                    keep.remove(max(free, key=lambda k: value[k]))
            else:
                keep = keep[-K:]
            dynamics.keep(keep)
            which = np.array([0, *(1 + k for k in keep)])
            found = Disturbances(*(array[which] for array in found))
        self.disturbances = found

    def _frame(self) -> None:
        """The first backups, and an order of variables and actions that no one chose.

        It follows from what was seen: so it makes no difference in which order, unit or sign
        variables and actions come.
        """
        dynamics = self.dynamics
        episode = dynamics.latest
        assert episode is not None
        Z, U, m, a = episode.observations, episode.actions, dynamics.n_variables, dynamics.size
        off = Z - Z.mean(0)
        spread = np.sqrt((off**2).mean(0))
        self._variables = np.argsort(
            np.abs(np.diff(Z, axis=0)).mean(0) / np.where(spread > 0, spread, 1.0), kind="stable"
        )
        self._flips = np.where((off**3).sum(0) < 0.0, -1.0, 1.0)
        if dynamics.choices:
            self._actions = np.argsort(-U.sum(0), kind="stable")
            self._turns = np.ones(a)
            constants = np.eye(a)[self._actions]
        else:
            self._actions = np.argsort(np.abs(U).mean(0), kind="stable")
            self._turns = np.where(U.sum(0) < 0.0, -1.0, 1.0)
            corners = list(product((-1.0, 1.0), repeat=a)) if a <= 3 else [*np.eye(a), *-np.eye(a)]
            constants = np.array([*corners, np.zeros(a)])
            put = np.empty_like(constants)
            put[:, self._actions] = constants
            constants = put * self._turns
        linear = 0 if "backups" in self.without else _LINEAR
        self.policies = np.zeros((len(constants) + linear, a, 1 + m))
        self.policies[: len(constants), :, 0] = constants
        self._scores = np.full(len(self.policies), -np.inf)
        self._constant = len(constants)
        self.base = np.arange(len(self.policies))

    def _mutation(self, random: np.random.Generator) -> _Floats:
        a, m = self.policies.shape[1], self.policies.shape[2] - 1
        size = 10.0 ** random.uniform(-1.5, 0.7)
        drawn = (random.random((a, 1 + m)) < 0.6) * size * random.standard_normal((a, 1 + m))
        put = np.empty_like(drawn)
        columns = np.append(0, 1 + self._variables)
        put[np.ix_(self._actions, columns)] = drawn
        put *= np.append(1.0, self._flips)
        if not self.dynamics.choices:
            put *= self._turns[:, None]
        return put

    def _evolve(self, random: np.random.Generator) -> None:
        dynamics, d = self.dynamics, self.disturbances
        assert d is not None
        count = len(d.residuals)
        which = np.arange(count)
        if count > 1 + _TRIED_ON:
            which = np.append(0, 1 + random.permutation(count - 1)[:_TRIED_ON])
        arrays, known, harder = self._arrays(), dynamics.consequents, self.harder

        def value(policy: _Floats) -> float:
            return worth(known, *arrays, policy, d, which, harder)

        scores = self._scores
        for q, policy in enumerate(self.policies):
            scores[q] = value(policy)
        linear = np.arange(self._constant, len(self.policies))
        for _ in range(_MUTANTS if len(linear) else 0):
            if random.random() < 0.8:
                parent = self.policies[linear[scores[linear].argmax()]]
            else:
                parent = self.policies[int(random.integers(len(self.policies)))]
            child = parent + self._mutation(random)
            reached = value(child)
            worst = linear[scores[linear].argmin()]
            if reached > scores[worst]:
                self.policies[worst], scores[worst] = child, reached
        self.base = np.argsort(-scores, kind="stable")


def _disturbances(residuals: _Floats) -> Disturbances:
    k, _, m = residuals.shape
    nothing = np.zeros((k, m))
    return Disturbances(
        residuals,
        nothing - 1.0,
        nothing,
        np.zeros((k, m, m)),
        np.zeros((k, m, m, 2)),
        np.zeros((k, m, 2)),
    )

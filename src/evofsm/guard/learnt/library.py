"""What is remembered, and what would be done about it: disturbances, situations, and backups.

*The disturbance library* keeps what would harm most in situations that are kept as well, some of
them tight. A situation is a row: an observation, its change, and the action before.

*Backup policies* are constant, or linear feedback that evolves. With the share v_q(s) of the
horizon that backup q survives from situation s, over some disturbances, and a little for the
distance to failure, the backups Q together are worth

    F(Q) = mean_s max_q v_q(s) + 0.01 sum_q mean_s v_q(s).

A mutant takes the place of the linear backup for which F grows most, if it grows. They are asked in
the order in which each adds most to F of those before it, the greedy order for a submodular
function (Nemhauser, Wolsey & Fisher 1978).

*Certificate violations* tell whether disturbances are still those that are remembered: a cumulative
sum (Page, "Continuous inspection schemes", Biometrika 1954).
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from dataclasses import replace as replaced
from itertools import product
from typing import NamedTuple, Self, TypeVar, cast

import numpy as np

from evofsm.guard.learnt.dynamics import Dynamics, Episode
from evofsm.guard.learnt.replay import Disturbances, Floats, Ints, Model, replay

# Situations that are kept, and those on which the starts of an episode are tried.
KEPT, _TRIED = 32, 8
# Of an episode that failed, so many of its last ones.
_BEFORE_FAILURE = 3
# Starts of an episode that are tried, and how far those are apart that are remembered.
_MOST_STARTS, _APART = 160, 3
# What is lost in so few steps, whatever one does, is no argument; nor is what is survived by more.
_AT_ONCE, _BY_FAR = 3, 100.0
# What is lost in more than this share of situations that nothing else disturbs begins in its place.
_HOPELESS = 0.5
# Linear policies; mutants that are tried an episode, and of those how many of the best one.
_LINEAR, _MUTANTS, _OF_BEST = 3, 40, 0.8
# Products in the replays that a decision may wait for: some 10 ms.
_PART = 5e7
# A mutant differs in this share of its numbers, by a size of 10 to a power between these.
_CHANGED, _SIZES = 0.6, (-1.5, 0.7)
# What a policy is worth by itself counts so much, compared with what it adds to the others.
_BY_ITSELF = 0.01
# By so much less a linear policy wants the next of the choices.
_PREFERRED = 1e-9
# Digits of actions and scores: what differs by rounding alone is equal, in whatever units it comes.
_ROUNDED = 9
# Boxes of more dimensions have an action along each axis, not one in each corner.
_MOST_CORNERS = 3


_T = TypeVar("_T")
#: What is done in parts, of so much work each that a decision may wait for one.
Parts = Generator[None, None, _T]


def at_once(parts: Parts[_T]) -> _T:
    """What comes of parts if nothing is done between them."""
    while True:
        try:
            next(parts)
        except StopIteration as over:
            return cast(_T, over.value)


def fewer(number: int, m: int) -> int:
    """So many as are tried or kept with m variables: with more than 12 each replay costs more."""
    return max(1, number * 12 // max(m, 12))


# -- Disturbances and situations ------------------------------------------------------------------


def harm(
    model: Model,
    situations: Floats,
    policies: Floats,
    disturbances: Disturbances,
    scale: float = 1.0,
    plan: Floats | None = None,
    enough: float = math.inf,
) -> Floats:
    """(K, S) how each disturbance ends in each situation under the best of the policies.

    As `Ends.value` has it; once all are ``enough`` no other policy is asked. A ``plan`` (T, a) is
    executed first.
    """
    each = disturbances.residuals.shape[2]
    plan = np.empty((0, policies.shape[1])) if plan is None else plan
    found = np.full(len(situations) * each, -np.inf)
    for policy in policies:
        ends = replay(model, situations, plan, policy, disturbances, scale)
        np.maximum(found, ends.value, out=found)
        if enough < math.inf and found.min() >= enough:
            break
    return found.reshape(len(situations), each).T


def _harm_in_parts(
    model: Model, situations: Floats, policies: Floats, disturbances: Disturbances, scale: float
) -> Parts[Floats]:
    """`harm` of all situations, a few at a time."""
    each, found = disturbances.residuals.size * len(model.weights) * len(policies), []
    few = max(1, int(_PART / each))
    for k in range(0, len(situations), few):
        if k:
            yield
        found.append(harm(model, situations[k : k + few], policies, disturbances, scale))
    return np.hstack(found)


def noted(
    situations: Floats,
    episode: Episode,
    tight: Sequence[bool],
    horizon: int,
    random: np.random.Generator,
) -> Floats:
    """Situations with one more of an episode, a tight one, and some before failure."""
    z, u = episode.observations, episode.actions
    T, most = len(u), fewer(KEPT, z.shape[1])
    steps = list(random.integers(1, T, 1))
    tights = np.flatnonzero(tight[1:T]) + 1
    if len(tights):
        steps.append(int(random.choice(tights)))
    if episode.failed:
        back = random.integers(2, max(3, min(T, horizon)), _BEFORE_FAILURE)
        steps += list(np.maximum(1, T - 1 - back))
    for t in steps:
        one = np.concatenate([z[t], z[t] - z[t - 1], u[t - 1]])
        if len(situations) < most:
            situations = np.vstack([situations.reshape(-1, len(one)), one])
        else:
            situations = situations.copy()
            situations[int(random.integers(most))] = one
    return situations


def scan(
    dynamics: Dynamics,
    situations: Floats,
    horizon: int,
    policies: Floats,
    random: np.random.Generator,
) -> Parts[None]:
    """Remember those starts of the latest episode that would harm most in a few situations."""
    episode, model = dynamics.latest, dynamics.model
    assert episode is not None
    (n, m), calm = episode.residuals.shape, Disturbances.none(1, horizon, dynamics.n_variables)
    safe = np.flatnonzero(harm(model, situations, policies, calm)[0] > 0.0)
    if not len(safe):
        return
    safe = random.permutation(safe)[:_TRIED]
    steps, most = np.arange(n), fewer(_MOST_STARTS, m)
    if n > most:
        steps = np.sort(random.permutation(n)[:most])
    rest = np.vstack([episode.residuals, np.zeros((horizon, m))])
    begun = Disturbances.none(len(steps), horizon, m)
    begun.residuals[:] = rest[np.arange(horizon)[:, None] + steps].transpose(0, 2, 1)
    ends = np.zeros((len(steps), horizon, m))
    for k, t in enumerate(steps.tolist()):
        L = min(n - t, horizon)
        ends[k, :L] = (episode.observations[2:] - episode.residuals)[t : t + L]
    begun = yield from placed(dynamics, situations, policies, begun, ends)
    found = yield from _harm_in_parts(model, situations[safe], policies, begun, 1.0)
    taken = dynamics.onsets(episode.residuals)
    known = len(taken)
    for t in steps[found.argmin(0)].tolist():
        if (np.abs(np.array(taken) - t) > _APART).all():
            taken.append(t)
    dynamics.remember(taken[known:])


def choose(
    dynamics: Dynamics, situations: Floats, horizon: int, policies: Floats, scale: float
) -> Parts[Disturbances]:
    """Keep the most harmful sequences of all that are remembered; return what is kept."""
    found, most, n = dynamics.disturbances(horizon), dynamics.remembered, len(dynamics.sequences)
    if dynamics.fails and len(situations):
        ends = np.zeros((1 + n, horizon, dynamics.n_variables))
        for k, one in enumerate(dynamics.sequences, 1):
            L = min(len(one.actions) - 1, horizon)
            ends[k, :L] = one.observations[2 : 2 + L] - found.residuals[:L, :, k]
        found = yield from placed(dynamics, situations, policies, found, ends)
    keep = np.arange(n)
    if n <= most:
        dynamics.keep(keep.tolist(), found)
        return found
    if dynamics.fails and len(situations):
        asked = dynamics.model, situations, policies, found, scale
        ends = (yield from _harm_in_parts(*asked))[1:]
        ends = np.where(ends < _AT_ONCE - 1.0 - horizon, 1e9, ends)
        value = np.minimum(ends, _BY_FAR).mean(1)
        while len(keep) > most:  # what is worst nowhere goes first
            free = np.delete(keep, ends[keep].argmin(0))
            free = free if len(free) else keep
            keep = keep[keep != free[value[free].argmax()]]
    else:
        keep = keep[-most:]
    dynamics.keep(keep.tolist(), found)
    return found.of(np.append(0, 1 + keep))


def placed(
    dynamics: Dynamics, situations: Floats, policies: Floats, found: Disturbances, ends: Floats
) -> Parts[Disturbances]:
    """With where they begin, if they could be survived almost nowhere beginning anywhere.

    What can be survived is prepared for wherever one is.
    """
    place = dynamics.where(found, ends)
    some = np.flatnonzero(place[:, 0] >= 0.0)
    nowhere = found.place.copy()
    nowhere[:, 0] = -1.0
    found = found._replace(place=nowhere)
    if not len(some):
        return found
    calm = Disturbances.none(1, len(found.residuals), dynamics.n_variables)
    safe = harm(dynamics.model, situations, policies, calm)[0] > 0.0
    if not safe.any():
        return found
    asked = dynamics.model, situations[safe], policies, found.of(some)
    ends = yield from _harm_in_parts(*asked, 1.0)
    hopeless = (ends < 0.0).sum(1) > _HOPELESS * safe.sum()
    lost = {tuple(row) for row in place[some[hopeless], :2].tolist()}
    lost |= {one.place[:2] for one in dynamics.sequences}  # what has a place keeps it
    for k in some:
        if tuple(place[k, :2].tolist()) in lost:
            nowhere[k] = place[k]
    return found


def failing_after(
    model: Model, situations: Floats, policies: Floats, disturbances: Disturbances
) -> Parts[int]:
    """Steps after which it fails at the latest where it does, under the best of the policies."""
    steps = len(disturbances.residuals)
    ends = yield from _harm_in_parts(model, situations, policies, disturbances, 1.0)
    return int(ends[ends < 0.0].max(initial=-1.0 - steps) + 1 + steps)


# -- Backup policies ------------------------------------------------------------------------------


@dataclass
class Backups:
    """Constant policies, and linear ones u = sat(b + K'z) that evolve by mutation.

    An order of variables and actions, and a direction of each, come from the first episode: so it
    makes no difference to what evolves in which order, unit or sign they come.
    """

    policies: Floats  #: (b, a, 1 + m), the constant ones first
    n_constant: int
    scores: Floats  #: (b,) what each adds to those before it
    variables: Ints  #: (m,) in their order
    flips: Floats  #: (m,) their directions, 1 or -1
    actions: Ints  #: (a,) in their order
    turns: Floats  #: (a,) their directions

    @classmethod
    def of(cls, z: Floats, u: Floats, *, choices: bool, evolving: bool = True) -> Backups:
        """Those that nothing was learnt of yet, by observations and actions of the first episode.

        Where an action is one of a few ``choices`` the largest of b + K'z is taken. There are
        linear ones if they are ``evolving``.
        """
        a, m = u.shape[1], z.shape[1]
        off = z - z.mean(0)
        spread = np.sqrt((off**2).mean(0))
        pace = np.abs(np.diff(z, axis=0)).mean(0) / np.where(spread > 0.0, spread, 1.0)
        if choices:
            actions, turns, corners = _order(-u), np.ones(a), np.eye(a)
        else:
            actions, turns = _order(np.abs(u)), np.where(u.sum(0) < 0.0, -1.0, 1.0)
            ends = np.vstack([-np.eye(a), np.eye(a)])
            if a <= _MOST_CORNERS:
                ends = np.array(list(product((-1.0, 1.0), repeat=a)))
            corners = np.vstack([ends, np.zeros(a)])
        constants = np.empty_like(corners)
        constants[:, actions] = corners
        policies = np.zeros((len(constants) + (_LINEAR if evolving else 0), a, 1 + m))
        policies[: len(constants), :, 0] = constants * turns
        if choices:  # of equals the first in that order, whatever its index
            policies[:, actions, 0] -= _PREFERRED * np.arange(a)
        return cls(
            policies=policies,
            n_constant=len(constants),
            scores=np.full(len(policies), -np.inf),
            variables=np.argsort(pace, kind="stable"),
            flips=np.where((off**3).sum(0) < 0.0, -1.0, 1.0),
            actions=actions,
            turns=turns,
        )

    @classmethod
    def restored(cls, n_constant: int, m: int, a: int, arrays: dict[str, Floats]) -> Self:
        """Those that arrays of a file hold, of m variables and actions of a numbers.

        A ValueError if arrays contradict that, or each other: kernels check no index.
        """
        count, size, features = arrays["policies"].shape
        if (size, features) != (a, 1 + m):
            raise ValueError(f"backups are not of {m} variables and actions of {a} numbers")
        orders = {name: arrays[name].astype(int) for name in ("variables", "actions")}
        for name, order in orders.items():
            if sorted(order.tolist()) != list(range(len(order))):
                raise ValueError(f"{name} of the backups are in no order")
        if n_constant > count:
            raise ValueError(f"there are {count} backups, not {n_constant} constant ones")
        return cls(n_constant=n_constant, **{**arrays, **orders})

    @property
    def ranks(self) -> Ints:
        """(b,) ndarray of int: those first that add most to the ones before them."""
        return np.argsort(-self.scores, kind="stable")

    def evolved(
        self,
        model: Model,
        situations: Floats,
        disturbances: Disturbances,
        scale: float,
        random: np.random.Generator,
    ) -> Parts[Backups]:
        """With mutants in the place of linear ones where all together are worth more then."""
        policies, ranks = self.policies.copy(), self.ranks
        linear = np.arange(self.n_constant, len(policies))
        each, nothing = disturbances.residuals.shape[2], np.empty((0, policies.shape[1]))

        def worth(policy: Floats) -> Floats:
            """(S,) how well it ends in each situation, in the mean of all disturbances."""
            ends = replay(model, situations, nothing, policy, disturbances, scale)
            return np.asarray(ends.worth.reshape(-1, each).mean(1))

        shape, columns = policies.shape[1:], np.append(0, 1 + self.variables)
        own_order = np.ix_(np.argsort(self.actions), np.argsort(columns))
        signs = np.append(1.0, self.flips) * self.turns[:, None]
        part = max(
            1, int(_PART / (disturbances.residuals.size * len(situations) * len(model.weights)))
        )
        values = np.empty((len(policies), len(situations)))
        for q, policy in enumerate(policies):
            values[q] = worth(policy)
            if q % part == part - 1:
                yield
        for n in range(fewer(_MUTANTS, len(self.variables)) if len(linear) else 0):
            parent = linear[values[linear].mean(1).round(_ROUNDED).argmax()]
            if random.random() >= _OF_BEST:
                parent = ranks[int(random.integers(len(policies)))]
            size = 10.0 ** random.uniform(*_SIZES)
            drawn = (random.random(shape) < _CHANGED) * size * random.standard_normal(shape)
            child = policies[parent] + drawn[own_order] * signs
            reached = worth(child)
            tried = np.repeat(values[None], 1 + len(linear), 0)  # as they are, and with the child
            tried[1 + np.arange(len(linear)), linear] = reached
            together = tried.max(1).mean(1) + _BY_ITSELF * tried.mean(2).sum(1)
            best = int(together.round(_ROUNDED).argmax())  # of equals the first: nothing changes
            if best:
                policies[linear[best - 1]], values[linear[best - 1]] = child, reached
            if n % part == part - 1:
                yield
        scores = np.empty(len(policies))
        left, most = list(range(len(values))), np.full(values.shape[1], -1.0)
        while left:  # first the one that is worth most, then whichever adds most
            adds = np.maximum(values[left] - most, 0.0).mean(1)
            adds = (adds + _BY_ITSELF * values[left].mean(1)).round(_ROUNDED)
            q = left.pop(int(adds.argmax()))
            scores[q] = adds.max()  # never more than that of the one before
            most = np.maximum(most, values[q])
        return replaced(self, policies=policies, scores=scores)


def _order(rows: Floats) -> Ints:
    """Of columns by their mean, of equals by the first rows in which they differ."""
    exact = rows.round(_ROUNDED)
    return np.lexsort((*exact[::-1], exact.mean(0).round(_ROUNDED)))


# -- Certificate violations -----------------------------------------------------------------------
#
# A certificate says that all that is remembered is survived. Where it is suddenly violated in every
# second episode, what is remembered is no measure any more of what may begin.

# Of the share of episodes with a violation: what it is at first, how much more it may be than of
# late, what would be worse, and from where on nothing is told apart from that.
_SHARE, _MORE, _WORSE, _USUAL = 0.5, 0.05, 0.5, 0.2
# Weight of an episode in that share; log likelihood ratio from which on it is believed.
_WEIGHT, _BELIEVED = 0.05, 6.0


class Violations(NamedTuple):
    """In how many episodes certificates were violated, and the doubt that it is still so."""

    share: float = _SHARE  #: of episodes, those of late count most
    doubt: float = 0.0  #: that it is still so: a log likelihood ratio
    since: int = 0  #: the episode that brought it up, from 0
    worse: int = -1  #: since which episode disturbances are worse, from 0; -1: since none

    def after(self, episode: int, *, violated: bool, failed: bool = False) -> Violations:
        """What it is after an episode, whose number is from 0.

        One in which a certificate was violated and which ``failed`` says twice as much.
        """
        share = self.share + _MORE
        likelier = _WORSE / share if violated else (1.0 - _WORSE) / (1.0 - share)
        times = 2.0 if failed else 1.0
        doubt = max(0.0, self.doubt + times * math.log(likelier)) if share < _USUAL else 0.0
        since = self.since if self.doubt > 0.0 else episode
        if doubt > _BELIEVED:
            return Violations(worse=since)
        if doubt > 0.0:  # before a doubt it was as ever
            return Violations(self.share, doubt, since, self.worse)
        share = self.share + _WEIGHT * (violated - self.share)
        return Violations(share, 0.0, since, self.worse)

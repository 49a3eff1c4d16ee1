"""The disturbance library: what is worth remembering, and whether it is still a measure.

Disturbances are kept that would harm most in situations that are kept as well, some of them tight.

A situation is a row: an observation, its change since the one before, and the action before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evofsm.guard.learnt.dynamics import Dynamics, Episode
from evofsm.guard.learnt.replay import Disturbances, Ends, Floats, Model, replay

# Situations that are kept, and those on which the starts of an episode are tried.
_KEPT, _TRIED = 32, 8
# Of an episode that failed, so many of its last ones.
_BEFORE_FAILURE = 3
# Starts of an episode that are tried, and how far those are apart that are remembered.
_MOST_STARTS, _APART = 160, 3
# What is lost in so few steps, whatever one does, is no argument; nor is what is survived by more.
_AT_ONCE, _BY_FAR = 3, 100.0
# Residuals that disturbances without memory are drawn from.
_POOL = 3000


def situation(z: Floats, change: Floats, before: Floats) -> Floats:
    """(2m + a,) where one is, and how one got there."""
    return np.concatenate([z, change, before])


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

    The least distance to failure; where none escapes, the steps left as it fails, negative, less 1.
    The first policy after which it is ``enough`` will do. A ``plan`` (T, a) is executed first.
    """
    steps, _, each = disturbances.residuals.shape
    count = len(situations) * each
    plan = np.empty((0, policies.shape[1])) if plan is None else plan
    found, ends = np.full(count, -np.inf), Ends.of(count)
    for policy in policies:
        replay(model, situations, plan, policy, disturbances, scale, 0.0, count, ends)
        value = np.where(ends.survived == steps, ends.least, ends.survived - steps - 1.0)
        found = np.where(found < enough, np.maximum(found, value), found)
        if found.min() >= enough:
            break
    return found.reshape(len(situations), each).T


def noted(
    situations: Floats,
    episode: Episode,
    tight: Sequence[bool],
    horizon: int,
    random: np.random.Generator,
) -> Floats:
    """Situations with one more of an episode, a tight one, and some before failure."""
    z, u = episode.observations, episode.actions
    T = len(u)
    steps = list(random.integers(1, T, 1))
    tights = np.flatnonzero(tight[1:T]) + 1
    if len(tights):
        steps.append(int(random.choice(tights)))
    if episode.failed:
        back = random.integers(2, max(3, min(T, horizon)), _BEFORE_FAILURE)
        steps += list(np.maximum(1, T - 1 - back))
    for t in steps:
        one = situation(z[t], z[t] - z[t - 1], u[t - 1])
        if len(situations) < _KEPT:
            situations = np.vstack([situations.reshape(-1, len(one)), one])
        else:
            situations = situations.copy()
            situations[int(random.integers(_KEPT))] = one
    return situations


def scan(
    dynamics: Dynamics,
    situations: Floats,
    horizon: int,
    policies: Floats,
    random: np.random.Generator,
) -> None:
    """Remember those starts of the latest episode that would harm most in a few situations."""
    episode, model = dynamics.latest, dynamics.model
    assert episode is not None
    (n, m), calm = episode.residuals.shape, Disturbances.none(1, horizon, dynamics.n_variables)
    safe = np.flatnonzero(harm(model, situations, policies, calm)[0] > 0.0)
    if not len(safe):
        return
    safe = random.permutation(safe)[:_TRIED]
    steps = np.arange(n)
    if n > _MOST_STARTS:
        steps = np.sort(random.permutation(n)[:_MOST_STARTS])
    rest = np.vstack([episode.residuals, np.zeros((horizon, m))])
    begun = Disturbances.none(len(steps), horizon, m)
    begun.residuals[:] = rest[np.arange(horizon)[:, None] + steps].transpose(0, 2, 1)
    found = harm(model, situations[safe], policies, begun)
    taken = dynamics.onsets(episode.residuals)
    known = len(taken)
    for t in steps[found.argmin(0)].tolist():
        if (np.abs(np.array(taken) - t) > _APART).all():
            taken.append(t)
    dynamics.remember(taken[known:])


def choose(
    dynamics: Dynamics, situations: Floats, horizon: int, policies: Floats, scale: float
) -> Disturbances:
    """Keep the most harmful sequences of all that are remembered; return what is kept."""
    found, most, n = dynamics.disturbances(horizon), dynamics.remembered, len(dynamics.sequences)
    if n <= most:
        return found
    keep = np.arange(n)
    if dynamics.thresholds and len(situations):
        ends = harm(dynamics.model, situations, policies, found, scale)[1:]
        ends = np.where(ends < _AT_ONCE - 1.0 - horizon, 1e9, ends)
        value = np.minimum(ends, _BY_FAR).mean(1)
        while len(keep) > most:  # what is worst nowhere goes first
            free = np.delete(keep, ends[keep].argmin(0))
            free = free if len(free) else keep
            keep = keep[keep != free[value[free].argmax()]]
    else:
        keep = keep[-most:]
    dynamics.keep(keep.tolist())
    return found.of(np.append(0, 1 + keep))


def shuffled(
    dynamics: Dynamics, pool: Floats, horizon: int, random: np.random.Generator
) -> tuple[Disturbances, Floats]:
    """As many disturbances whose steps have nothing to do with each other, and what they are of."""
    assert dynamics.latest is not None
    pool = np.vstack([pool.reshape(-1, dynamics.n_variables), dynamics.latest.residuals])[-_POOL:]
    made = Disturbances.none(1 + dynamics.remembered, horizon, dynamics.n_variables)
    for k in range(dynamics.remembered):
        made.residuals[:, :, 1 + k] = pool[random.integers(len(pool), size=horizon)]
    return made, pool


def failing_after(
    model: Model, situations: Floats, policies: Floats, disturbances: Disturbances
) -> int:
    """Steps after which it fails at the latest where it does, under the best of the policies."""
    steps = len(disturbances.residuals)
    ends = harm(model, situations, policies, disturbances)
    return int(ends[ends < 0.0].max(initial=-1.0 - steps) + 1 + steps)


# -- Certificate violations: whether disturbances are still those that are remembered --------------
#
# A certificate says that all that is remembered is survived. It is violated where something begins
# that is worse than all of that. That happens now and then; where it suddenly happens in every
# second episode, what is remembered is no measure any more of what may begin.

# Of the share of episodes with a violation: what it is at first, how much more it may be than of
# late, what would be worse, and from where on nothing is told apart from that.
_SHARE, _MORE, _WORSE, _USUAL = 0.5, 0.05, 0.5, 0.2
# Weight of an episode in that share; log likelihood ratio from which on it is believed.
_WEIGHT, _BELIEVED = 0.05, 6.0


class Violations(NamedTuple):
    """In how many episodes certificates were violated, and the doubt that it is still so.

    Examples
    --------
    >>> violations = Violations()
    >>> for episode in range(60):
    ...     violations = violations.after(episode, violated=episode < 10)
    >>> for episode in range(60, 64):
    ...     violations = violations.after(episode, violated=True)
    >>> violations.worse
    60
    """

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

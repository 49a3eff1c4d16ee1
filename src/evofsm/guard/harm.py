"""Whether a guard does harm: time to failure, guarded against the controller alone.

A guard that learns may be wrong, and then fail sooner than the controller would alone. It compares
steps to failure, in rank: of each pair of a guarded episode and one of the controller alone, which
failed surely before the other (an episode that did not fail only says that it would have been
later: a goal that is reached sooner is no harm). The sum over all pairs is Gehan's statistic
(Biometrika 52, 1965); how often chance alone makes it as large is counted exactly, over all ways to
deal the episodes out. Ranks assume nothing about how failures are distributed, and judge by a few.

Episodes before anything was refused are those of the controller alone. Later ones are driven in
*shadow* (proposals pass) only while there is doubt: where guarded episodes fail sooner, and chance
alone would have it so in at most one case of four; or where all of the latest five failed, and
fewer than three of the controller alone are known. Where they do not fail, nothing has to be
tested; where they fail sooner, what is known says that the controller alone would last longer, so
that a shadow episode is not expected to cost anything. In doubt every second episode is one.

From a chance of one in a hundred on the guard *steps back*: proposals pass, and now and then an
episode is tried guarded, after 2, 4, 8 and then 10 of the controller alone. One that lasts no
shorter than half of those has the next one tried, too; two such in succession, and it acts again.
Frozen it acts only if guarded episodes of late did not fail sooner, by chance or not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.store import COUNT, SHARE, Numbers

# Episodes of each kind that are compared, the latest: a guard that learns gets better.
_KEPT = 20
# So many are known of the controller alone, or there is doubt once that many guarded ones failed.
_KNOWN, _ALL_FAILED = 3, 5
# Chances of so much sooner failures, below which it is not frozen to act; from which on there is
# doubt; and it steps back.
_EVEN, _DOUBT, _SURE = 0.5, 0.25, 0.01
# Most episodes of the controller alone between two that are tried; so many that last bring it back.
_RARELY, _LASTING = 10, 2
# Decisions over which the share of proposals that are kept is counted, and at least for a word.
_DECISIONS, _SOME = 500, 100
# Steps of who never fails.
_FOREVER = 1 << 52


class Outcome(NamedTuple):
    """How an episode ended."""

    episode: int  #: its number, from 1
    steps: int
    failed: bool
    guarded: bool  #: or the controller drove alone


#: What a file holds of it: outcomes, a row each, and numbers.
OUTCOMES = COUNT.of("h", 4)
SETTINGS = {
    **dict.fromkeys(("n_episodes", "since"), COUNT),
    "refuses": bool,
    "chance": SHARE,
    **dict.fromkeys(("decided", "kept"), Numbers(least=0.0, most=COUNT.most)),
}


class Harm(NamedTuple):
    """How episodes ended, guarded and alone, and what follows from it."""

    outcomes: tuple[Outcome, ...] = ()
    n_episodes: int = 0
    refuses: bool = False  #: whether anything was refused yet: before, it is no guard
    chance: float = 1.0  #: of guarded episodes that fail so much sooner, were there no harm
    since: int = 0  #: the episode, from 1, from which on it steps back; 0: it does not
    decided: float = 0.0  #: decisions of late in which it could refuse
    kept: float = 0.0  #: and of these proposals that were kept

    @property
    def alone(self) -> list[Outcome]:
        """Of the controller alone."""
        return [one for one in self.outcomes if not one.guarded]

    @property
    def guarded(self) -> list[Outcome]:
        """Of the guard that acts; while it steps back, those that were tried since."""
        return [one for one in self.outcomes if one.guarded and one.episode >= self.since]

    def in_doubt(self, *, learning: bool) -> bool:
        """Whether guarded episodes fail sooner, perhaps by chance.

        While it learns, also if all of them fail, and little is known of the controller alone.
        """
        if self.since or not learning or self.chance <= _DOUBT:
            return not self.since and self.chance < _EVEN
        latest, alone = self.guarded[-_ALL_FAILED:], self.alone
        fails = len(latest) == _ALL_FAILED and all(one.failed for one in latest)
        long_ago = len(alone) < _KNOWN or self.n_episodes - alone[-1].episode >= _RARELY - 1
        return fails and long_ago

    @property
    def replaces(self) -> bool:
        """Whether hardly a proposal is kept."""
        return self.decided >= _SOME and self.kept < 0.05 * self.decided

    @classmethod
    def restored(cls, settings: Mapping[str, Any], outcomes: NDArray[Any]) -> Harm:
        """As it was in a file, whose rows and settings hold to what is declared."""
        rows = outcomes[-2 * _KEPT :].tolist()
        return cls(tuple(Outcome(int(n), int(k), f > 0, g > 0) for n, k, f, g in rows), **settings)

    @classmethod
    def merged(cls, parts: Sequence[Harm]) -> Harm:
        """Of guards that learnt apart: the newest outcomes of each, from which it is said anew."""
        outcomes, n_episodes = list[Outcome](), 0
        each = max(1, _KEPT // len(parts))
        for part in parts:
            newest = part.alone[-each:] + [one for one in part.outcomes if one.guarded][-each:]
            outcomes += (one._replace(episode=one.episode + n_episodes) for one in newest)
            n_episodes += part.n_episodes
        refuses = any(part.refuses for part in parts)
        return cls(tuple(sorted(outcomes)), n_episodes, refuses)._concluded()

    def passing(self, *, learning: bool) -> str:
        """Why proposals pass in the episode to come; empty where they are revised."""
        if self.since:
            tried = self.guarded
            again = bool(tried) and self._lasted(tried[-1])
            alone = self.n_episodes - (tried[-1].episode if tried else self.since - 1)
            is_tried = again or alone >= min(_RARELY, 2 ** (1 + len(tried)))
            return "" if learning and is_tried else f"steps back since episode {self.since}"
        if not learning:
            return "may do harm" if self.in_doubt(learning=False) else ""
        is_next = bool(self.outcomes) and self.outcomes[-1].guarded
        return "shadow" if is_next and self.in_doubt(learning=True) else ""

    def _lasted(self, one: Outcome) -> bool:
        """Whether an episode failed no sooner than half of those of the controller alone."""
        return earlier([one], self.alone) <= 0

    def after(
        self, driven: tuple[int, int, int], *, failed: bool, ended: bool = False, tests: bool = True
    ) -> Harm:
        """What it is after an episode.

        Of its decisions there were so many in which proposals could be refused (``driven``), in
        which they could not, and of the first in which they were kept. With both it is of neither
        kind, and is left out. One that ``ended`` by itself without failing never fails.
        """
        acted, watched, kept = driven
        refuses, n = self.refuses or kept < acted, self.n_episodes + 1
        now, fades = self._replace(n_episodes=n, refuses=refuses), math.exp(-acted / _DECISIONS)
        if refuses:
            now = now._replace(decided=fades * self.decided + acted, kept=fades * self.kept + kept)
        if bool(acted) == bool(watched):
            return now
        steps = _FOREVER if ended else acted + watched
        new = Outcome(n, steps, failed, refuses and acted > 0)
        alike = [one for one in self.outcomes if one.guarded == new.guarded]
        gone = alike[: max(0, len(alike) - _KEPT + 1)]
        now = now._replace(outcomes=(*(one for one in self.outcomes if one not in gone), new))
        return now._concluded() if tests else now

    def _concluded(self) -> Harm:
        """Whether it steps back, or acts again."""
        guarded, alone = self.guarded, self.alone
        if not self.since:
            chance = chance_of(guarded, alone)
            return self._replace(chance=chance, since=self.n_episodes + 1 if chance <= _SURE else 0)
        if len(latest := guarded[-_LASTING:]) < _LASTING or not all(map(self._lasted, latest)):
            return self
        outcomes = tuple(one for one in self.outcomes if not one.guarded or one in latest)
        return self._replace(outcomes=outcomes, since=0, chance=chance_of(latest, alone))


def earlier(some: Sequence[Outcome], others: Sequence[Outcome]) -> int:
    """Pairs in which one of ``some`` failed surely before one of ``others``, less the reverse."""
    return int(_before(some, others).sum() - _before(others, some).sum())


def _before(some: Sequence[Outcome], others: Sequence[Outcome]) -> NDArray[np.bool_]:
    """(s, o) whether each of some failed while the other went on; of a tie both, which cancels."""
    fails = np.array([one.steps if one.failed else math.inf for one in some])
    return fails[:, None] <= np.array([one.steps for one in others])


def chance_of(guarded: Sequence[Outcome], alone: Sequence[Outcome]) -> float:
    """How likely it is that guarded episodes fail so much sooner, or more, if there is no harm.

    Where the controller was never seen alone, it is taken not to have failed once.

    Examples
    --------
    >>> guarded = [Outcome(n, steps, True, True) for n, steps in enumerate((7, 3, 12))]
    >>> alone = [Outcome(n, steps, True, False) for n, steps in enumerate((104, 109))]
    >>> chance_of(guarded, alone)  # one of the ten ways to choose two of five
    0.1
    """
    alone = alone or [Outcome(0, _FOREVER, False, False)]
    found = earlier(guarded, alone)
    if found <= 0:
        return 1.0
    pooled = [*guarded, *alone]
    before = _before(pooled, pooled)
    scores = before.sum(1) - before.sum(0)
    # Ways to choose so many (rows) with such a sum (columns).
    middle = len(pooled) ** 2
    ways = np.zeros((1 + len(guarded), 1 + 2 * middle))
    ways[0, middle] = 1.0
    for score in scores.tolist():
        ways[1:] += np.roll(ways[:-1], score, 1)
    return float(ways[-1, middle + found :].sum() / ways[-1].sum())

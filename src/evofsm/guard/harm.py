"""Who drives an episode: the guard, or the controller alone, by how episodes of both ended.

A guard that learns may be wrong, and what it refuses keeps away the only evidence against it. So
there are two arms, *guarded* and *alone*, each with a record of its latest episodes. Of two
episodes the better one is found by rank, which assumes nothing about how failures are distributed:

1. One that failed while the other went on is worse (Gehan, Biometrika 52, 1965), less so if the
   other failed, too, only later. What was cut off before the other failed says nothing; what ended
   by itself without failure never fails.
2. Where neither failed, the higher score is better, if both are told and differ by more than 5 %;
   else what ended by itself, as at a goal, is better than what was cut off.

While it learns, who drives an episode is drawn by Thompson sampling with a Bayesian bootstrap
(Eckles & Kaptein 2014), and only where it costs little that the controller drives alone, in
*shadow*; frozen, the guard acts unless its record says that it harms, or does not help.
docs/machine-that-saves.md ("Who drives") has the rules.

Where in an episode a guard that has not failed of late keeps a quarter more of the proposals than
before, another controller seems to have come: what is known of the controller alone is of the other
one, and it drives the next episode, to show it. If that one fails, it is the same.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.validation import Floats
from evofsm.store import COUNT, Numbers

# Episodes of each arm that are kept, the latest; what is left of the weight of one an episode
# later, and where who drives may be another one by then.
_KEPT, _FADE, _FADE_SOONER = 20, 0.98, 0.9
# The weights of those that ended well, with which guarded and alone begin: who drives alone until
# the first refusal is known.
_HOPE, _HOPE_ALONE = 0.5, 0.25
# So many episodes after the latest of the controller alone one is drawn, and then as often.
_RARELY = 10
# What it counts that of two episodes that failed one did so later.
_SOONER = 0.3
# The largest share of the controller's failures per step that a guard leaves which helps, if it
# keeps all proposals, and if it replaces them all; frozen, who fails in a smaller share of episodes
# than the last is not asked for more than to end better.
_LEFT, _LEFT_BY_ITSELF, _FEW = 0.5, 0.1, 0.2
# Scores that differ by less than this share are equal.
_SAME_SCORE = 0.05
# The latest guarded episodes, if all failed, are reason enough for one draw to decide; else it
# takes as many that agree; of fewer alone hardly anything is known.
_CAREFUL = 3
# A guard that always fails drives so many episodes in a row at most, and so many, where the
# controller always fails as well, before draws decide.
_TURN, _TRIES = 2, 12
# Draws by which it is known how often the guard drives; below that share doubt is said.
_DRAWS, _SAID = 300, 0.5
# Decisions over which the share of proposals that are kept is counted; fewer do not tell.
_DECISIONS, _FEWEST_DECISIONS = 500, 100
# Where in an episode of so many decisions so much more is kept than before, although neither it nor
# the latest guarded ones failed, of which it would have learnt, it is another controller.
_NOTED, _ANOTHER, _SETTLED = 20, 0.25, 4
# Steps of who never fails.
_FOREVER = 1 << 52


class Outcome(NamedTuple):
    """How an episode ended."""

    episode: int  #: its number, from 1
    steps: int
    failed: bool
    guarded: bool  #: or the controller drove alone
    ended: bool = False  #: by itself, without failing
    score: float = math.nan  #: NaN where it was not told


#: What a file holds of it: a row for each outcome, the score last and before it whether it was
#: told; and numbers.
OUTCOMES = Numbers().of("h", 7)
SETTINGS = {
    **dict.fromkeys(("n_episodes", "changed", "idle", "moved"), COUNT),
    "refuses": bool,
    "ends": bool,
    **dict.fromkeys(("decided", "kept"), Numbers(least=0.0, most=COUNT.most)),
}


class Harm(NamedTuple):
    """How episodes ended, guarded and alone, and who drives the next."""

    outcomes: tuple[Outcome, ...] = ()
    n_episodes: int = 0
    refuses: bool = False  #: whether anything was refused yet: before, it is no guard
    ends: bool = False  #: whether an episode ever ended by itself, without failing
    decided: float = 0.0  #: decisions of late in which it could refuse
    kept: float = 0.0  #: and of these those in which it did not
    changed: int = 0  #: the latest episode in which another controller seems to have come, or 0
    idle: int = 0  #: failures of episodes in which it acted, if nothing was refused yet
    moved: int = 0  #: and after which the system moves otherwise

    @property
    def is_on_trial(self) -> bool:
        """Whether another controller seems to have come with the latest episode."""
        return 0 < self.changed == self.n_episodes

    def alone(self, *, learning: bool = True) -> list[Outcome]:
        """Of the controller alone: of this one; frozen, in the system as it moves now."""
        since = self.changed if learning else self.moved
        return [o for o in self.outcomes if o.episode > since and not o.guarded]

    @property
    def guarded(self) -> list[Outcome]:
        """Of the guard that acts."""
        return [outcome for outcome in self.outcomes if outcome.guarded]

    @property
    def spoiling(self) -> str:
        """What is said of a guard that keeps hardly a proposal, all, or from ending well."""
        arms = self.guarded, self.alone()
        (n, well), (n_alone, well_alone) = ((len(arm), sum(o.ended for o in arm)) for arm in arms)
        if min(n, n_alone) >= _CAREFUL and 2 * well * n_alone < well_alone * n:
            by_themselves = f"{well} of {n} guarded episodes, alone {well_alone} of {n_alone}"
            return f"keeps what it guards from ending by itself: {by_themselves}"
        if self.idle >= _CAREFUL:
            return f"refused nothing yet, though {self.idle} episodes failed in which it could"
        if self.decided < _FEWEST_DECISIONS or self.kept >= 0.05 * self.decided:
            return ""
        share = f"where it drives {self.kept / self.decided:.0%} of proposals pass"
        rest = "others are executed only where nothing lasts longer"
        return f"refuses nearly everything: {share}, {rest}; that is no filter"

    def helps(self, *, learning: bool) -> bool:
        """Whether guarded episodes end no worse than those alone, or of one kind none is known.

        Of three episodes at least, a guard that failed in all prevents nothing, however late; nor
        does one that fails more than half as often per step as the controller alone, down to a
        tenth, the more it refuses: one that refuses all would fly any controller's craft so. Frozen
        it is as it became of late, and few failures may be of a system that moves otherwise.
        """
        guarded, alone = self.guarded, self.alone(learning=learning)
        if _all_failed(guarded, max(_CAREFUL, len(guarded))):
            return False
        if not guarded or not alone:
            return True
        (g, share, rate), (a, _, rate_alone) = (self._record(o, learning) for o in (guarded, alone))
        change = 1.0 - self.kept / self.decided if self.decided >= _FEWEST_DECISIONS else 0.0
        most = _LEFT + (_LEFT_BY_ITSELF - _LEFT) * change
        is_asked = len(guarded) >= _CAREFUL and (learning or share > _FEW)
        if is_asked and rate > most * rate_alone:
            return False
        if rate_alone and not learning:  # who survived alone had it easier: scores tell nothing
            guarded, alone = ([o._replace(score=math.nan) for o in arm] for arm in (guarded, alone))
        return bool(g @ better(guarded, alone) @ a >= 0.0)

    def drives(self, draws: int) -> float:
        """In how many of some draws the guard would drive the next episode, as a share.

        The same for the same record.
        """
        well = Outcome(0, _FOREVER, failed=False, guarded=False, ended=self.ends)
        ideal = well._replace(ended=self.ends or self._replaces_most)
        arms = [[*self.guarded, well], [*self.alone(), ideal]]
        random = np.random.default_rng([self.n_episodes, draws])
        hopes = zip(arms, (_HOPE, _HOPE_ALONE), strict=True)
        weights = [np.append(self._weights(arm[:-1], learning=True), hope) for arm, hope in hopes]
        guarded, alone = (random.gamma(shape, size=(draws, len(shape))) for shape in weights)
        won = np.einsum("ni,ij,nj->n", guarded, better(*arms), alone)
        return float((won >= 0.0).mean())

    def _weights(self, outcomes: Sequence[Outcome], *, learning: bool) -> Floats:
        is_open = self.ends or any(o.failed for o in self.guarded[-_RARELY:])
        guarded = _FADE if learning else _FADE_SOONER
        alone = _FADE_SOONER if learning and is_open else _FADE
        fades = [guarded if o.guarded else alone for o in outcomes]
        return np.power(fades, [self.n_episodes - o.episode for o in outcomes])

    def _record(self, arm: Sequence[Outcome], learning: bool) -> tuple[Floats, float, float]:
        """Weights of an arm, which share of it failed, and its failures per step."""
        weights = self._weights(arm, learning=learning)
        fails, steps = weights @ [(o.failed, o.steps) for o in arm]
        return weights, float(fails / weights.sum()), float(fails / steps)

    def passing(self, *, learning: bool) -> str:
        """Why proposals pass in the episode to come; empty where they are revised."""
        if not learning:
            return "" if self.helps(learning=False) else "was not shown to help"
        if self.is_on_trial:
            return "shadow"
        if _all_failed(self.guarded, _CAREFUL):
            turn_is_over = all(outcome.guarded for outcome in self.outcomes[-_TURN:])
            if turn_is_over or not _all_failed(self.alone(), 1):
                return "shadow"
            if _all_failed(self.alone(), _CAREFUL) and len(self.guarded) < _TRIES:
                return ""
        fails = any(outcome.failed for outcome in self.outcomes[-1:])
        is_due = fails or (self._replaces_most and self._is_new) or self._long_ago
        is_drawn = self.refuses and (is_due or not self.helps(learning=True))
        return "shadow" if is_drawn and not self.drives(self._draws) else ""

    @property
    def _is_new(self) -> bool:
        """Whether hardly anything is known of the controller alone."""
        return len(self.alone()) < _CAREFUL

    @property
    def _replaces_most(self) -> bool:
        """Whether it keeps less than half of the proposals: what it takes away may be good."""
        return self.kept < 0.5 * self.decided

    @property
    def _long_ago(self) -> bool:
        """Whether it is long ago that the controller drove alone."""
        n = self.n_episodes - (self.alone()[-1].episode if self.alone() else self.changed)
        return n > 0 and n % _RARELY == 0

    @property
    def _draws(self) -> int:
        """The guard drives if it does in one of so many draws."""
        is_bold = self._is_new or self._long_ago or _all_failed(self.guarded, _CAREFUL)
        return 1 if is_bold else _CAREFUL

    def told(self, *, learning: bool) -> str:
        """How both arms ended, where it is not beyond doubt that the guard helps; else nothing."""
        guarded, alone = self.guarded, self.alone(learning=learning)
        if not guarded or not alone:
            return ""
        in_doubt = learning and (1.0 - self.drives(_DRAWS)) ** self._draws > 1.0 - _SAID
        if self.helps(learning=learning) and not in_doubt:
            return ""
        manner = "both are tried" if learning else "proposals pass"
        arms = f"guarded episodes {_ended(guarded)}, the controller alone {_ended(alone)}"
        return f"it was not shown to help: {arms}; {manner}"

    @classmethod
    def restored(cls, settings: Mapping[str, Any], outcomes: NDArray[Any]) -> Harm:
        """As it was in a file, whose rows and settings hold to what is declared."""
        rows = [
            Outcome(int(n), int(k), f > 0, g > 0, e > 0, score if has_score else math.nan)
            for n, k, f, g, e, has_score, score in outcomes[-2 * _KEPT :].tolist()
        ]
        return cls(tuple(rows), **settings)

    @property
    def rows(self) -> Floats:
        """(h, 7) outcomes, as a file holds them."""
        rows = np.array(self.outcomes, np.float64).reshape(-1, 6)
        return np.nan_to_num(np.insert(rows, 5, np.isfinite(rows[:, 5]), axis=1))

    def after(
        self,
        driven: tuple[int, int, int],
        *,
        failed: bool,
        ended: bool = False,
        score: float | None = None,
    ) -> Harm:
        """What it is after an episode.

        Of its decisions there were so many in which proposals could be refused (``driven``), in
        which they could not, and of the first in which they were kept. With both it is of neither
        kind, and is left out.
        """
        n_acted, n_watched, n_kept = driven
        refuses, n = self.refuses or n_kept < n_acted, self.n_episodes + 1
        ends = self.ends or (ended and not failed)
        idle = 0 if refuses else self.idle + (failed and n_acted > 0)
        now = self._replace(n_episodes=n, refuses=refuses, ends=ends, idle=idle)
        fades = math.exp(-n_acted / _DECISIONS)
        if refuses:
            now = now._replace(
                decided=fades * self.decided + n_acted, kept=fades * self.kept + n_kept
            )
        if bool(n_acted) == bool(n_watched):
            return now
        latest = [outcome.failed for outcome in self.guarded[-_SETTLED:]]
        is_settled = len(latest) == _SETTLED and not any((*latest, failed)) and n_acted >= _NOTED
        if is_settled and n_kept / n_acted > self.kept / self.decided + _ANOTHER:
            now = now._replace(changed=n, decided=float(n_acted), kept=float(n_kept))
        elif self.is_on_trial and failed:
            now = now._replace(changed=0)  # it is the same
        number = math.nan if score is None else score
        new = Outcome(n, n_acted + n_watched, failed, refuses and n_acted > 0, ended, number)
        alike = [o for o in self.outcomes if o.guarded == new.guarded]
        oldest = alike[: max(0, len(alike) - _KEPT + 1)]
        return now._replace(outcomes=(*(o for o in self.outcomes if o not in oldest), new))


def better(some: Sequence[Outcome], others: Sequence[Outcome]) -> Floats:
    """(s, o) 1 where one of ``some`` ended better than one of ``others``, -1 where worse; else 0.

    Where both failed it counts less.

    Examples
    --------
    >>> failed, later = Outcome(1, 30, True, False), Outcome(2, 90, True, False)
    >>> cut_off, landed = Outcome(3, 60, False, True), Outcome(4, 40, False, True, ended=True)
    >>> better([cut_off, landed], [failed, later, landed])
    array([[ 1.,  0., -1.],
           [ 1.,  1.,  0.]])
    >>> better([later], [failed])
    array([[0.3]])
    """
    (s_steps, s_fails, s_well, s_score), (o_steps, o_fails, o_well, o_score) = (
        np.array([(o.steps, o.failed, o.ended, o.score) for o in arm]).reshape(-1, 4).T
        for arm in (some, others)
    )
    s_last, o_last = np.where(s_well > 0, np.inf, s_steps), np.where(o_well > 0, np.inf, o_steps)
    worse = (s_fails[:, None] > 0) & (s_steps[:, None] <= o_last)
    best = (o_fails > 0) & (o_steps <= s_last[:, None])
    more, size = s_score[:, None] - o_score, np.maximum(np.abs(s_score)[:, None], np.abs(o_score))
    by_score = np.where(np.abs(more) > _SAME_SCORE * size, np.sign(more), 0.0)
    neither = np.where(by_score != 0.0, by_score, s_well[:, None] - o_well)
    fails = (s_fails[:, None] > 0) | (o_fails > 0)
    failed = (s_fails[:, None] > 0) & (o_fails > 0)
    return np.where(fails, np.where(failed, _SOONER, 1.0) * (best.astype(float) - worse), neither)


def _all_failed(outcomes: Sequence[Outcome], latest: int) -> bool:
    """Whether there are so many, and the latest of them failed."""
    return len(outcomes) >= latest and all(outcome.failed for outcome in outcomes[-latest:])


def _ended(outcomes: Sequence[Outcome]) -> str:
    """After how many steps episodes failed, and how those ended that did not."""
    steps = [o.steps for o in outcomes if o.failed]
    n, well = len(outcomes), sum(o.ended for o in outcomes)
    text = f"did not fail in {n}"
    if steps:
        text = f"failed after {np.median(steps):g} steps in the median ({len(steps)} of {n})"
    scores = [o.score for o in outcomes if o.score == o.score]
    text += f", {well} ended by themselves" if well else ""
    return text + (f", median score {np.median(scores):.3g}" if any(scores) else "")

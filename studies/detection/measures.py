"""What is compared: ours as it learns by watching, and the classic measures.

All score a decision from what was seen until then, never from what came after it.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from enum import StrEnum
from functools import partial
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import (
    Draw,
    Episode,
    Family,
    LatentRisk,
    Unrevised,
    drive,
    guard_for_family,
    learners_of,
    measures,
)
from evofsm.fsm import EvolvingFSM
from evofsm.guard import Guard, RiskMeasure
from studies.counts import OutcomeCounts
from studies.detection.watch import HORIZON, Exposure, Target, Watched
from studies.old.own_measure import own_measure
from studies.old.scores import auroc
from studies.policies import TUNED_MEASURES, Group

# Of a standard normal variable: the middles of seven parts that are as likely each.
_QUANTILES = (-1.465, -0.792, -0.366, 0.0, 0.366, 0.792, 1.465)
# So far from the edge of a dead end a situation is clear [m/s²].
_EDGE = 1.0
# Classic measures that are shown, by their name here.
_SHOWN = {
    "ttc": "aeb-ttc",
    **{name: name for name in ("mttc", "drac", "headway", "picud", "rss-r157", "r157-careful")},
    "fuzzy": "fuzzy",
}


class Ours(StrEnum):
    """Our measures by name.

    The default judges the situation itself. The others judge by states, those of the default rule
    or of the paper's, and by one of two risks: latent risk at the states' centres, or failures
    that were counted in them.
    """

    DEFAULT = "evofsm"  #: latent risk of the situation, behind the filter of noise
    STATES = "evofsm-states"  #: latent risk, states of the default rule
    COUNTS = "evofsm-counts"  #: failures counted, states of the default rule
    PAPER = "evofsm-paper"  #: failures counted, states of the paper's rule
    PAPER_STATES = "evofsm-paper-states"  #: latent risk, states of the paper's rule
    PAPER_ACTIONS = "evofsm-paper-actions"  #: failures counted by state and action, paper's rule


class Detector(NamedTuple):
    """Something that scores every decision of an exposure; higher is more dangerous."""

    name: str
    group: Group
    score: Callable[[Exposure], NDArray[np.float64]]
    #: Whether its score is a probability that a collision comes within `HORIZON`.
    is_probability: bool = False


# -- Ours -----------------------------------------------------------------------------------------


class Chain:
    """A machine, and the failures that were counted in its states.

    Parameters
    ----------
    machine : EvolvingFSM
    family : Family
        Whose actions it learns.
    """

    def __init__(self, machine: EvolvingFSM, family: Family) -> None:
        self.machine = machine
        self.by_state = OutcomeCounts(1, HORIZON, family.interval)
        self.by_action = OutcomeCounts(machine.n_actions, HORIZON, family.interval)

    def count(self, drive: Episode, family: Family) -> None:
        """Count what came after each decision of a drive that the machine has learnt."""
        for decision in drive.decisions:
            belief = decision.situation.belief
            self.by_state.learn(belief, 0)
            self.by_action.learn(belief, int(family.actions.encode(decision.revision.executed)))
        for counts in (self.by_state, self.by_action):
            counts.end_episode(failed=drive.collided)

    def of_states(self, exposure: Exposure) -> NDArray[np.float64]:
        """(n,) probability of failure within `HORIZON`: of the states, weighed by the belief."""
        return self._through(_of_each(self.by_state, self.machine.n_states), exposure, alike=True)

    def of_actions(self, exposure: Exposure) -> NDArray[np.float64]:
        """(n,) the same, of the action that the driver takes there."""
        return self._through(_of_each(self.by_action, self.machine.n_states), exposure, alike=False)

    def latent(self, risk: LatentRisk, exposure: Exposure) -> NDArray[np.float64]:
        """(n,) `LatentRisk.score` at the centres of the states, weighed by the belief [m/s²]."""
        centers = risk.score(self.machine.centers, exposure.family.interval)
        return self._through(centers[np.newaxis], exposure, alike=True)

    def _through(
        self, values: NDArray[np.float64], exposure: Exposure, *, alike: bool
    ) -> NDArray[np.float64]:
        """Values of actions and states, weighed by the belief; all actions may be ``alike``."""
        model, actions = self.machine.model(), exposure.family.actions
        found = []
        for one in exposure.watched:
            chosen = np.zeros(len(one.commands), int) if alike else actions.encode(one.commands)
            found.append(np.einsum("nk,nk->n", model.recognise(one.seen), values[chosen]))
        return np.concatenate(found)


def _of_each(counts: OutcomeCounts, n_states: int) -> NDArray[np.float64]:
    """(actions, states) probability of failure."""
    return np.array(
        [
            [counts.outcome(state, action).probability for state in np.eye(n_states)]
            for action in range(counts.n_actions)
        ]
    )


class Watcher:
    """Ours, and the paper's preset beside it, watching the same episodes without acting.

    Parameters
    ----------
    family : Family
    states : bool
        Whether the machines learn as well, or the latent risk alone, which is much quicker.
    """

    def __init__(self, family: Family, *, states: bool = True) -> None:
        # What is learnt of leaders and brakes, and the machine beside it.
        self.risk = LatentRisk(family.low, family.interval)
        machine, _ = learners_of(guard_for_family(family, judge=self.risk))
        self.default = Chain(machine, family)
        self.paper = Chain(EvolvingFSM(family.actions.n_actions), family)
        self.states = states

    def watch(self, draws: Iterable[tuple[Family, Draw]]) -> Self:
        """Learn from unrevised episodes, each with the family it is of."""
        for family, draw in draws:
            if not self.states:
                _drive(family, draw, None, self.risk)
                continue
            self.default.count(_drive(family, draw, self.default.machine, self.risk), family)
            self.paper.count(_drive(family, draw, self.paper.machine, None), family)
        return self

    def detectors(self) -> list[Detector]:
        """All that are ours."""
        found = [Detector(Ours.DEFAULT, Group.LEARNT, self.latent_risk)]
        if not self.states:
            return found
        by_default, by_paper = self.default, self.paper
        learnt = Group.LEARNT
        return [
            *found,
            Detector(Ours.STATES, learnt, lambda some: by_default.latent(self.risk, some)),
            Detector(Ours.COUNTS, learnt, by_default.of_states, is_probability=True),
            Detector(Ours.PAPER, learnt, by_paper.of_states, is_probability=True),
            Detector(Ours.PAPER_STATES, learnt, lambda some: by_paper.latent(self.risk, some)),
            Detector(Ours.PAPER_ACTIONS, learnt, by_paper.of_actions, is_probability=True),
        ]

    def latent_risk(self, exposure: Exposure) -> NDArray[np.float64]:
        """(n,) `LatentRisk.score` of where the follower most likely is [m/s²].

        Where sensors are noisy it is averaged over where the follower may be instead: gaps that
        are as likely each. Far on either side of the edge of a dead end all situations count
        alike, so that one that is nearly safe may not outweigh many that are not [1].
        """
        if not any(self.risk.perception.noise):
            return self.risk.score(_all_seen(exposure), exposure.family.interval)
        estimates = [_estimates(self.risk, one) for one in exposure.watched]
        mean = np.concatenate([where for where, _ in estimates])
        doubt = np.concatenate([deviation for _, deviation in estimates])
        nearness = np.zeros(len(mean))
        for quantile in _QUANTILES:
            where = mean.copy()
            where[:, 0] += quantile * doubt
            score = self.risk.score(where, exposure.family.interval)
            nearness += np.tanh(score / _EDGE) / len(_QUANTILES)
        return nearness


def _drive(
    family: Family, draw: Draw, machine: EvolvingFSM | None, risk: LatentRisk | None
) -> Episode:
    reviser = Unrevised(family.actions)
    return drive(Guard.of(reviser, interval=family.interval, machine=machine, judge=risk), draw)


def _all_seen(exposure: Exposure) -> NDArray[np.float64]:
    return np.concatenate([one.seen for one in exposure.watched])


def _estimates(risk: LatentRisk, one: Watched) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n, 3) where the follower most likely is, and (n,) how sure the gap is in that [m].

    From each row and those before it only: as the risk filters them before it judges an action.
    """
    perception = copy.deepcopy(risk.perception)
    perception.clear()
    brakes = risk.brakes
    before = last = 0.0
    where, doubt = [], []
    for row, command in zip(one.seen, one.commands.tolist(), strict=True):
        estimate = perception.see(
            tuple(row.tolist()), brakes.expected(before, last), sure=brakes.known, learn=False
        )
        _, speed, leader_speed = estimate.mean
        where.append(estimate.mean)
        # What is wrong about a speed adds up while both brake.
        doubt.append(estimate.deviation((1.0, -speed / brakes.decel, leader_speed / brakes.decel)))
        before, last = last, command
    return np.array(where), np.array(doubt)


# -- Others ---------------------------------------------------------------------------------------


def classic(name: str, group: Group, measure: RiskMeasure) -> Detector:
    """A measure that learns nothing."""
    return Detector(name, group, lambda exposure: _scores(measure, exposure))


def _scores(measure: RiskMeasure, exposure: Exposure) -> NDArray[np.float64]:
    interval = exposure.family.interval
    return np.concatenate([measure.score(one.seen, interval) for one in exposure.watched])


def fixed(family: Family) -> list[Detector]:
    """All that neither learn nor are tuned; the matched one is told the family's true limits."""
    matched = measures.ResponsibilitySensitiveSafety.matched(family.decel, family.leader_decel)
    return [
        *(classic(name, Group.FIXED, measures.FIXED_MEASURES[key]) for name, key in _SHOWN.items()),
        classic("rss-matched", Group.MATCHED, matched),
    ]


def own(name: str) -> list[Detector]:
    """A measure of one's own, which learns nothing; none where it has no name."""
    return [classic(name, Group.FIXED, own_measure(name))] if name else []


def behind_filter(family: Family, risk: LatentRisk) -> list[Detector]:
    """Safe distances behind our filter of noise, to tell what is owed to the filter alone."""
    rss = measures.ResponsibilitySensitiveSafety
    told = rss.matched(family.decel, family.leader_decel)

    def behind(measure: RiskMeasure, exposure: Exposure) -> NDArray[np.float64]:
        estimates = (one._replace(seen=_estimates(risk, one)[0]) for one in exposure.watched)
        return _scores(measure, Exposure(exposure.family, tuple(estimates)))

    return [
        Detector("rss-r157-filtered", Group.FIXED, partial(behind, rss.r157())),
        Detector("rss-matched-filtered", Group.MATCHED, partial(behind, told)),
    ]


def tuned(training: Exposure, target: Target) -> Detector:
    """The safe distance that tells a target best in training, where it is told the truth."""
    cases = training.cases(target)

    def area(measure: RiskMeasure) -> float:
        found = auroc(_scores(measure, training)[cases.rows], cases.truth)
        return -1.0 if np.isnan(found) else found

    return classic("rss-tuned", Group.TUNED, max(TUNED_MEASURES["rss-tuned"], key=area))

"""Latent risk of states: which of them are dead ends, and what they are worth to steer by.

A situation may be judged where it is, which is sharper, or by the states it is recognised as: then
the risk of an action is that at their centres, weighed by the belief.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from evofsm.driving.judge import LatentRisk
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.model import FSMModel
from evofsm.fsm.proportions import wilson_bounds
from evofsm.guard import Judgement, Situation

# States of a smaller belief are left out.
_LEAST_BELIEF = 1e-3


class RiskByState:
    """Judges actions by the states that a situation is recognised as.

    The ``risk`` answers all but how dangerous actions are. Where states disagree, ``caution``
    standard deviations are added to their mean risk.
    """

    labels, fallback = LatentRisk.labels, LatentRisk.fallback

    def __init__(self, risk: LatentRisk, machine: EvolvingFSM, caution: float = 1.0) -> None:
        self.risk, self.machine, self.caution = risk, machine, caution
        self.why, self.trial = risk.why, risk.trial
        self.effective, self.refuse_unfit = risk.effective, risk.refuse_unfit

    def judge(self, situation: Situation, accelerations: ArrayLike) -> Judgement:
        """Latent risk of each acceleration: of the states, weighed by the belief."""
        taking_part = np.flatnonzero(situation.belief >= _LEAST_BELIEF)
        if len(taking_part) == 0 or self.machine.n_states == 0:
            return self.risk.judge(situation, accelerations)
        belief, centers = situation.belief[taking_part], self.machine.centers[taking_part]
        critical = np.stack([self.risk.critical(center, accelerations) for center in centers])
        weights = belief / belief.sum()
        risks = self.risk.manoeuvres.harder(critical)
        risk = weights @ risks
        disagreement = np.sqrt(weights @ (risks - risk) ** 2)
        cautious = np.minimum(risk + self.caution * disagreement, 1.0)
        evidence = float(len(self.risk.manoeuvres))
        bounds = [wilson_bounds(each, evidence + 1.0) for each in cautious.tolist()]
        low, high = np.transpose(bounds)
        return Judgement(cautious, low, high, weights @ critical, evidence, situation.seen)


class StateRisk(NamedTuple):
    """How dangerous it is to be in a state."""

    state: int
    risk: float  #: latent risk if one brakes in full at once, with the leader: high in a dead end
    margin: float  #: escape margin: how much lower that is than if speed is kept
    critical: float  #: hardest braking of a leader that is then survived [m/s²]
    seconds: float  #: time for which the state was seen [s]
    failures: float  #: number of failures that ended in it

    @property
    def is_dead_end(self) -> bool:
        """Whether a hard brake of the leader now is more likely than not to end in failure."""
        return self.risk > 0.5


def assess_states(known: EvolvingFSM | FSMModel, risk: LatentRisk) -> list[StateRisk]:
    """Latent risk at the centre of every state, in the order of creation.

    Examples
    --------
    >>> machine = EvolvingFSM(n_actions=1, radius=0.5)
    >>> trace = machine.learn_many([[50.0, 5.0, 5.0], [9.0, 20.0, 20.0]], [0, 0])
    >>> risk = LatentRisk(lowest=-4.0)
    >>> [state.is_dead_end for state in assess_states(machine, risk)]
    [False]
    """
    actions = np.array([risk.lowest, 0.0])
    critical = [risk.critical(center, actions) for center in known.centers]
    braking, keeping = risk.manoeuvres.harder(np.reshape(critical, (-1, 2))).T
    hardest = [survived[0] for survived in critical]
    columns = braking, keeping - braking, hardest, known.visits * risk.dt, known.endings
    rows = zip(*(np.asarray(column).tolist() for column in columns), strict=True)
    return [StateRisk(state, *row) for state, row in enumerate(rows)]

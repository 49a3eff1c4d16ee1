"""Ours: chains and counts in the machine's states, and replays under what it learnt of motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.extras import needs
from evofsm.fsm import (
    NO_ACTION,
    Consequents,
    Disturbances,
    Dynamics,
    EvolvingFSM,
    Here,
    Novelty,
    advance,
    begin_at,
    compiled,
    futures,
)
from evofsm.guard import BELIEF_TOLERANCE
from studies.counts import OutcomeCounts
from studies.foresight.amounts import HORIZONS
from studies.foresight.data import Cases, Run, action_set
from studies.systems import make_system

with needs("scipy", "study", "replays of what was done"):
    from scipy.spatial import KDTree

# States are as far apart as this share of the spread of each variable.
_APART = 0.5
# Recorded behaviours that are replayed after an action.
_BEHAVIOURS = 8

_Floats = NDArray[np.float64]


class Learnt:
    """A machine with dynamics that has learnt some episodes, frozen.

    Parameters
    ----------
    name : str
        Of the system.
    runs : sequence of Run
    """

    def __init__(self, name: str, runs: Sequence[Run]) -> None:
        self.runs = runs
        system = make_system(name)
        self.actions = action_set(system)
        seen = np.concatenate([run.observations for run in runs])
        spread = np.maximum(seen.std(axis=0), 1e-9)
        self.machine = EvolvingFSM(
            self.actions.n_actions,
            rule=Novelty(1.0, tuple((_APART * spread).tolist())),
            belief_tolerance=BELIEF_TOLERANCE,
            dynamics=Dynamics(
                **make_system(name).actions.settings, horizon=max(HORIZONS), stretches=10
            ),
        )
        for run in runs:
            self.machine.learn_many(
                run.observations,
                self._indices(run),
                [0],
                [len(run.actions)] if run.failed else [],
                executed=[*run.executed, run.executed[-1]],
            )
        self.machine.start_episode()
        self.model = self.machine.model()
        self.beliefs = [self.model.recognise(run.observations) for run in runs]
        self._replayed: dict[int, _Floats] = {}

    def _indices(self, run: Run) -> list[int]:
        """Index of each action; none after the last observation."""
        return [*(int(self.actions.encode(one)) for one in run.executed), NO_ACTION]

    def _index(self, some: Cases) -> NDArray[np.intp]:
        """(n,) index of the action of each case."""
        dynamics = self.machine.dynamics
        assert dynamics is not None
        found = []
        for row in some.action:
            one = dynamics.decode(row)
            action: Any = one if len(one) > 1 else float(one[0])
            found.append(int(self.actions.encode(action)))
        return np.array(found, np.intp)

    @property
    def sides(self) -> _Floats:
        """(k, 4) where it fails, as far as it was seen."""
        assert self.machine.dynamics is not None
        return self.machine.dynamics.consequents.sides

    def chain(self, some: Cases, steps: int) -> _Floats:
        """(n,) by the machine's own matrices: one step under the action, the others under any.

        Of each state the share of observations at which it had failed is counted; a chain that
        comes there fails with that probability.
        """
        seen = np.sum([beliefs.sum(axis=0) for beliefs in self.beliefs], axis=0)
        ended = np.zeros_like(seen)
        for run, beliefs in zip(self.runs, self.beliefs, strict=True):
            ended += run.failed * beliefs[-1]
        fails = ended / np.maximum(seen, 1e-300)
        average = self.model.averaged_matrix("observed")
        later = np.zeros(len(fails))
        for _ in range(steps - 1):
            later = average @ (fails + (1.0 - fails) * later)
        of_action = self.model.transition_matrices @ (fails + (1.0 - fails) * later)
        belief = self.model.recognise(some.z)
        return np.asarray((belief * of_action[self._index(some)]).sum(axis=1))

    def counts(self, some: Cases, steps: int) -> _Floats:
        """(n,) failures within the horizon, counted by state and action in the same states."""
        counts = OutcomeCounts(self.actions.n_actions, float(steps), 1.0)
        for run, beliefs in zip(self.runs, self.beliefs, strict=True):
            for belief, action in zip(beliefs[:-1], self._indices(run), strict=False):
                counts.learn(belief, action)
            counts.end_episode(failed=run.failed)
        beliefs, actions = self.model.recognise(some.z), self._index(some)
        return np.array(
            [
                counts.outcome(belief, int(action)).probability
                for belief, action in zip(beliefs, actions, strict=True)
            ]
        )

    def replays(self, some: Cases, steps: int) -> _Floats:
        """(n,) by the learnt dynamics: the action, then what was done after the likest steps.

        Each recorded behaviour is replayed as if nothing began, and amid each of the disturbances
        that are remembered; these count by how often one begins within the horizon.
        """
        lasts = self._lasts(some)
        dynamics = self.machine.dynamics
        assert dynamics is not None
        failed = lasts <= steps
        alone = failed[:, :, 0].mean(axis=1)
        if failed.shape[2] == 1:
            return np.asarray(alone)
        amid = failed[:, :, 1:].mean(axis=(1, 2))
        rate = self.machine.may_begin().rate.rate
        begins = -np.expm1(-rate * steps) if np.isfinite(rate) else 0.0
        return np.asarray((1.0 - begins) * alone + begins * amid)

    def _lasts(self, some: Cases) -> _Floats:
        """(n, behaviours, disturbances) steps until it fails, in each replay; for all horizons."""
        if id(some) in self._replayed:
            return self._replayed[id(some)]
        dynamics = self.machine.dynamics
        assert dynamics is not None
        lengths = [len(run.actions) for run in self.runs]
        done = np.concatenate([run.actions for run in self.runs])
        ends = np.repeat(np.cumsum(lengths), lengths)  # of the episode of each action
        at = np.concatenate([run.observations[:-1] for run in self.runs])
        scale = np.maximum(at.std(axis=0), 1e-9)
        tree = KDTree(np.column_stack([at / scale, done]))
        count = min(_BEHAVIOURS, len(done))
        _, near = tree.query(np.column_stack([some.z / scale, some.action]), count)
        near = np.reshape(near, (-1, count))
        disturbances = dynamics.disturbances(max(HORIZONS))
        found = np.full((*near.shape, len(disturbances.residuals)), np.inf)
        _replay_all(
            dynamics.consequents,
            disturbances,
            some.z,
            some.change,
            some.before,
            some.action,
            done,
            near,
            ends[near],
            found,
        )
        self._replayed[id(some)] = found
        return found


@compiled
def _replay_all(
    known: Consequents,
    disturbances: Disturbances,
    z: _Floats,
    change: _Floats,
    before: _Floats,
    action: _Floats,
    done: _Floats,
    begin: NDArray[np.intp],
    end: NDArray[np.intp],
    found: _Floats,
) -> None:
    """Steps until failure, into ``found``; recorded actions go on from ``begin`` up to ``end``."""
    count = found.shape[2]
    room = futures(known, action.shape[1], np.arange(count), disturbances)
    for r in range(len(z)):
        for s in range(begin.shape[1]):
            begin_at(room, Here(z[r], change[r], before[r]))
            for t in range(disturbances.residuals.shape[1]):
                at = min(begin[r, s] + t, end[r, s] - 1)
                for i in range(action.shape[1]):
                    room.action[i] = action[r, i] if t == 0 else done[at, i]
                advance(known, disturbances, t, 1.0, room)
                for side in range(len(known.sides)):
                    one = known.sides[side]
                    for k in range(count):
                        if one[1] * (room.z[int(one[0]), k] - one[2]) >= 0.0:
                            found[r, s, k] = min(found[r, s, k], t + 1.0)

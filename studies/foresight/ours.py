"""Ours: chains and counts in the machine's states, and replays under what it learnt of motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.extras import needs
from evofsm.fsm import EvolvingFSM, Novelty
from evofsm.fsm.arrays import NO_ACTION
from evofsm.guard import BELIEF_TOLERANCE, LearntRisk
from evofsm.guard.learnt.replay import Ends, replay
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
        )
        judge = LearntRisk(1.0, **system.actions.settings, horizon=float(max(HORIZONS)))
        self.dynamics = judge.dynamics
        for run in runs:
            for t, z in enumerate(run.observations):
                last = t == len(run.actions)
                self.machine.observe(z, failed=last and run.failed)
                if judge.observe(z) and not (last and run.failed):
                    self.machine.onset()
                if not last:
                    self.machine.act(int(self.actions.encode(run.executed[t])))
                    judge.act(run.executed[t])
            self.dynamics.end(failed=run.failed)
            self.machine.start_episode()
        self.model = self.machine.model()
        self.beliefs = [self.model.recognise(run.observations) for run in runs]
        self._replayed: dict[int, _Floats] = {}

    def _indices(self, run: Run) -> list[int]:
        """Index of each action; none after the last observation."""
        return [*(int(self.actions.encode(one)) for one in run.executed), NO_ACTION]

    def _index(self, some: Cases) -> NDArray[np.intp]:
        """(n,) index of the action of each case."""
        found = []
        for row in some.action:
            one = self.dynamics.decode(row)
            action: Any = one if len(one) > 1 else float(one[0])
            found.append(int(self.actions.encode(action)))
        return np.array(found, np.intp)

    @property
    def sides(self) -> _Floats:
        """(k, 4) where it fails, as far as it was seen."""
        return self.dynamics.model.thresholds

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
        failed = lasts <= steps
        alone = failed[:, :, 0].mean(axis=1)
        if failed.shape[2] == 1:
            return np.asarray(alone)
        amid = failed[:, :, 1:].mean(axis=(1, 2))
        rate = self.machine.onsets.sum() / self.machine.visits.sum()
        begins = -np.expm1(-rate * steps)
        return np.asarray((1.0 - begins) * alone + begins * amid)

    def _lasts(self, some: Cases) -> _Floats:
        """(n, behaviours, disturbances) steps until it fails, in each replay; for all horizons."""
        if id(some) in self._replayed:
            return self._replayed[id(some)]
        lengths = [len(run.actions) for run in self.runs]
        done = np.concatenate([run.actions for run in self.runs])
        ends = np.repeat(np.cumsum(lengths), lengths)  # of the episode of each action
        at = np.concatenate([run.observations[:-1] for run in self.runs])
        scale = np.maximum(at.std(axis=0), 1e-9)
        tree = KDTree(np.column_stack([at / scale, done]))
        count = min(_BEHAVIOURS, len(done))
        _, near = tree.query(np.column_stack([some.z / scale, some.action]), count)
        near = np.reshape(near, (-1, count))
        horizon = max(HORIZONS)
        disturbances = self.dynamics.disturbances(horizon)
        count = disturbances.residuals.shape[2]
        found, ends_of = np.empty((*near.shape, count)), Ends.of(count)
        nobody = np.zeros((done.shape[1], 1 + some.z.shape[1]))  # the whole horizon is planned
        for r, behaviours in enumerate(near):
            situation = np.concatenate([some.z[r], some.change[r], some.before[r]])[None]
            for s, begin in enumerate(behaviours):
                rows = np.minimum(begin + np.arange(horizon), ends[begin] - 1)
                plan = done[rows]
                plan[0] = some.action[r]
                world = situation, plan, nobody, disturbances, 1.0, 0.0, count, ends_of
                replay(self.dynamics.model, *world)
                left = ends_of.value
                found[r, s] = np.where(left >= 0.0, np.inf, left + horizon + 2.0)
        self._replayed[id(some)] = found
        return found

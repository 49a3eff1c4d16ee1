"""A guard for every agent of a parallel environment of PettingZoo."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

from evofsm.extras import needs
from evofsm.guard import gym
from evofsm.guard.api import Revision
from evofsm.guard.guard import Guard
from evofsm.guard.gym import Failed, Lane, Observe, StepResult, Terms
from evofsm.guard.loop import parts_of

with needs("pettingzoo", "pettingzoo", "a wrapper for PettingZoo"):
    from pettingzoo import AECEnv, ParallelEnv
    from pettingzoo.utils.wrappers import BaseParallelWrapper

_Each = dict[Any, Any]


class RevisedAgents(gym._Settled, BaseParallelWrapper[Any, Any, Any]):  # type: ignore[misc]
    """Executes a guard's revision of each agent's action, and forwards all else as it is.

    All profit from what any agent meets: the guard learns each agent's episode **as a whole when
    it ends**, and meanwhile a twin decides for the agent, as in `RevisedVectorActions`. All agents
    observe and act alike. The ``info`` of an agent holds what `RevisedActions` says.

    Parameters
    ----------
    env : pettingzoo.ParallelEnv
        One step of it is one decision, ``guard.interval`` long [s].
    guard : Guard
        Shared by all; ask it nothing else while episodes run. It may be frozen.
    observe, failed, penalty
        As in `RevisedActions`: of a single agent. A reward that it does not get is NaN.

    Raises
    ------
    TypeError, ValueError
        As `RevisedVectorActions`.

    Examples
    --------
    ``examples/platoon.py`` puts a guard beside every car of a platoon.
    """

    def __init__(
        self,
        env: ParallelEnv[Any, Any, Any],
        guard: Guard,
        observe: Observe | None = None,
        failed: Failed | None = None,
        *,
        penalty: float = 0.0,
    ) -> None:
        gym.refuse_unless(not isinstance(env, AECEnv), env)
        super().__init__(env)
        self._guard, self._failed = guard, failed
        self._terms = partial(Terms, guard, observe=observe, failed=failed, penalty=penalty)
        self._lanes: dict[Any, Lane] = {}
        for agent in getattr(env, "possible_agents", ()):  # which an environment need not know
            self._enter(agent)
        gym.warn_of(env, guard, failed)

    @property
    def revisions(self) -> dict[Any, Revision]:
        """The latest decision of each agent that has acted."""
        return {agent: lane.revision for agent, lane in self._lanes.items() if lane.revision}

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[_Each, _Each]:
        """Begin episodes; those that are under way end without failure."""
        for lane in self._lanes.values():
            lane.end(failed=False)
            lane.is_open = False
        observations, infos = parts_of(self.env.reset(seed=seed, options=options))
        infos = {agent: infos[agent] or {} for agent in infos}
        self._begin(observations, infos)
        return observations, infos

    def step(self, actions: _Each) -> tuple[_Each, _Each, _Each, _Each, _Each]:
        """Execute the guard's revision of each agent's action."""
        decisions = {agent: self._enter(agent).decide(action) for agent, action in actions.items()}
        executed = {agent: decision.executed for agent, decision in decisions.items()}
        observations, rewards, terminated, truncated, infos = parts_of(self.env.step(executed), 5)
        infos, rewards = {agent: infos[agent] or {} for agent in infos}, dict(rewards)
        alive, steps = {*self.env.agents}, dict[Any, StepResult]()
        for agent in (agent for agent, lane in self._lanes.items() if lane.is_open):
            is_over, has_left = bool(terminated.get(agent)), agent not in alive
            ends = is_over, bool(truncated.get(agent)) or (has_left and not is_over)
            row, reward = observations.get(agent), rewards.get(agent, math.nan)
            steps[agent] = StepResult(row, reward, *ends, infos.get(agent, {}))
        over = [agent for agent, step in steps.items() if step.terminated]
        if len(over) > 1:  # whom another's failure ends does not end by itself
            fails = {agent: self._lanes[agent].terms.failed(steps[agent]) for agent in over}
            for agent in over if any(fails.values()) else ():
                if not fails[agent]:
                    steps[agent] = replace(steps[agent], terminated=False, truncated=True)
        for agent, step in steps.items():
            lane = self._lanes[agent]
            lane.follow(step)
            if agent not in decisions:  # what it does now follows from no action of before
                lane.end(failed=False)
        for agent, decision in decisions.items():
            if agent in rewards:
                rewards[agent] = decision.paid(rewards[agent])
            if agent in infos or agent in terminated:
                infos[agent] = {**infos.get(agent, {}), **decision.info}
        here = {agent: row for agent, row in observations.items() if agent in self.env.agents}
        self._begin(here, infos)
        return observations, rewards, terminated, truncated, infos

    def _begin(self, observations: _Each, infos: _Each) -> None:
        agents = [agent for agent in observations if not self._enter(agent).is_open]
        for agent in agents:
            self._lanes[agent].begin(observations[agent], infos.get(agent, {}))
        lanes = self._lanes.items() if agents else ()
        sizes = {agent: len(lane.seen) for agent, lane in lanes if lane.seen is not None}
        if len({*sizes.values()}) > 1:
            fault = f"agents observe different numbers of variables, {sizes}"
            hint = "a guard observes one kind: give observe= that makes them alike"
            raise ValueError(f"{fault}, and {hint}")

    def _enter(self, agent: Any) -> Lane:
        if agent not in self._lanes:
            spaces = self.env.observation_space(agent), self.env.action_space(agent)
            self._lanes[agent] = Lane(self._terms(*spaces), shared=True)
        return self._lanes[agent]

"""A guard beside every agent of a parallel environment of PettingZoo."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import ArrayLike

from evofsm.extras import needs
from evofsm.guard.guard import Guard
from evofsm.guard.gym import Lane, Terms, conversions, size_of, told
from evofsm.guard.protocols import Revision

with needs("pettingzoo", "pettingzoo", "a wrapper for PettingZoo"):
    from pettingzoo import ParallelEnv
    from pettingzoo.utils.wrappers import BaseParallelWrapper


class RevisedAgents(BaseParallelWrapper[Any, Any, Any]):  # type: ignore[misc]
    """Executes what a guard makes of the actions of each agent, and forwards all else as it is.

    What any agent meets, all profit from: the guard learns each agent's episode **as a whole when
    it ends**, and meanwhile a twin decides beside the agent, as `RevisedVectorActions` has it. All
    agents observe and act alike. In the ``info`` of an agent stands what `RevisedActions` says.

    Parameters
    ----------
    env : pettingzoo.ParallelEnv
        A step of it is one decision, ``guard.interval`` long [s].
    guard : Guard
        Shared by all; ask it nothing else while episodes run. It may be frozen.
    observe, failed, penalty
        As in `RevisedActions`: of a single agent.

    Raises
    ------
    ValueError
        As `RevisedActions`; also if the guard has an audit log, which follows one episode at a
        time.

    Examples
    --------
    >>> from evofsm.driving import Platoon, guard_for_cars
    >>> guard = guard_for_cars(low=-2.5, high=2.5)
    >>> env = RevisedAgents(Platoon(n_cars=2), guard, failed=lambda info: info["failed"])
    >>> observations, infos = env.reset(seed=1)
    >>> while env.agents:
    ...     full_throttle = {agent: [2.5] for agent in env.agents}
    ...     observations, rewards, ended, _, infos = env.step(full_throttle)
    >>> ended
    {'car_1': False, 'car_2': False}
    """

    def __init__(
        self,
        env: ParallelEnv[Any, Any, Any],
        guard: Guard,
        observe: Callable[[Any], ArrayLike | None] | None = None,
        failed: Callable[[dict[str, Any]], bool] | None = None,
        *,
        penalty: float = 0.0,
    ) -> None:
        super().__init__(env)
        if guard.audit is not None:
            raise ValueError("an audit log follows one episode at a time; give a guard without one")
        agent = env.possible_agents[0]
        self.guard = guard
        self._terms = Terms(
            guard,
            env.observation_space(agent) if observe is None else observe,
            failed,
            conversions(env.action_space(agent), guard.actions),
            penalty,
        )
        self._lanes = {one: Lane(guard) for one in env.possible_agents}
        #: The latest decision beside each agent.
        self.revisions: dict[Any, Revision] = {}

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[Any, Any], dict[Any, dict[str, Any]]]:
        """Begin episodes; those that are under way end as they are."""
        for lane in self._lanes.values():
            lane.end(failed=False)
            lane.close()
        observations, infos = self.env.reset(seed=seed, options=options)
        self._begin(observations)
        return observations, infos

    def step(
        self, actions: dict[Any, Any]
    ) -> tuple[
        dict[Any, Any],
        dict[Any, float],
        dict[Any, bool],
        dict[Any, bool],
        dict[Any, dict[str, Any]],
    ]:
        """Execute what the guard makes of each agent's action."""
        decided = {
            agent: self._lanes[agent].decide(self._terms.proposal(action))
            for agent, action in actions.items()
        }
        executed = {
            agent: self._terms.executed(actions[agent], revision)
            for agent, revision in decided.items()
        }
        observations, rewards, terminated, truncated, infos = self.env.step(executed)
        infos, rewards = dict(infos), dict(rewards)
        for agent, revision in decided.items():
            if agent not in terminated:
                continue
            info = infos.get(agent, {})
            failed = self._terms.failed(info, bool(terminated[agent]))
            over = bool(terminated[agent] or truncated[agent])
            lane = self._lanes[agent]
            lane.follow(self._terms.look(observations[agent]), over=over or failed, failed=failed)
            if over:
                lane.close()
            size = size_of(self.guard.actions, revision)
            if self._terms.penalty:
                rewards[agent] = float(rewards[agent]) - self._terms.penalty * size
            infos[agent] = {**info, **told(actions[agent], executed[agent], revision, size)}
        self.revisions |= decided
        self._begin({one: seen for one, seen in observations.items() if one in self.env.agents})
        return observations, rewards, terminated, truncated, infos

    def _begin(self, observations: dict[Any, Any]) -> None:
        """Begin the episodes of agents that are new."""
        for agent, observation in observations.items():
            lane = self._lanes.get(agent)
            if lane is not None and not lane.is_open:
                lane.begin(self._terms.look(observation))

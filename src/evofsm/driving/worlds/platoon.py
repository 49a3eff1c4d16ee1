"""A platoon as a parallel environment of PettingZoo: every car is an agent."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.driving.families.family import Family, load_family
from evofsm.driving.worlds.kinematic import KinematicWorld
from evofsm.driving.worlds.motion import SPEED, move
from evofsm.driving.worlds.road import Episode, Road
from evofsm.driving.worlds.scenario import Body, Scenario
from evofsm.extras import needs

with needs("pettingzoo", "pettingzoo", "a platoon for PettingZoo"):
    from gymnasium.spaces import Box
    from pettingzoo import ParallelEnv

from evofsm.driving.worlds.gym import HIGH, LOW

# Scenarios are drawn by an index below this.
_INDICES = 2**31
_Told = dict[str, dict[str, Any]]


class Platoon(ParallelEnv[str, NDArray[np.float64], NDArray[np.float64]]):  # type: ignore[misc]
    """Drive a platoon behind a leader who may brake, in scenarios of a family.

    The agents are ``car_1``, the first behind the leader of the scenario, ``car_2`` behind it, and
    so on. Each observes ``[gap [m], v [m/s], v ahead [m/s]]`` to the one ahead, from bumper to
    bumper and as it truly is, and acts by an acceleration [m/s²] in the family's range, commanded
    for the family's interval. All begin with the gap and the speed of the scenario.

    The reward of a step is the distance travelled in it [m], less ``collision_cost`` for whoever
    ran into the one ahead. A collision ends the run: who ran into the one ahead is terminated, and
    all others are truncated, as all are when time is up. An agent's ``info`` holds ``time`` [s],
    ``gap`` [m], ``distance`` [m] travelled in the step, ``failed``, whether it ran into the one
    ahead, ``rear_ended``, and which scenario it is: ``split`` and ``index``.

    Parameters
    ----------
    n_cars : int
        How many follow the leader.
    family : str, path or Family
        Name of a family of scenarios, a file with one, or one that `load_family` has made. Its
        sensors are not used, nor its car behind.
    seed : int
        Of the family's draws. The seed of `reset` picks among them.
    split : str
        Which scenarios to pick from, unless `reset` is told.
    collision_cost : float
        Taken from the reward of the step that ends in a collision [m].

    Raises
    ------
    ValueError
        If there is no car, or the cost is negative.

    Examples
    --------
    >>> platoon = Platoon(n_cars=2)
    >>> observations, infos = platoon.reset(seed=1)
    >>> platoon.agents
    ['car_1', 'car_2']
    >>> actions = {agent: [0.5] for agent in platoon.agents}
    >>> observations, rewards, terminations, truncations, infos = platoon.step(actions)
    >>> infos["car_2"]["time"], terminations
    (0.25, {'car_1': False, 'car_2': False})
    """

    metadata: dict[str, Any] = {"name": "evofsm_platoon_v0", "render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        n_cars: int = 4,
        family: str | PathLike[str] | Family = "emergency",
        *,
        seed: int = 0,
        split: str = "train",
        collision_cost: float = 1000.0,
    ) -> None:
        if n_cars < 1:
            raise ValueError(f"n_cars is {n_cars}; there must be one at least")
        if not 0.0 <= collision_cost < math.inf:
            raise ValueError(f"collision_cost is {collision_cost}; it must be finite, 0 or more")
        self.family = family if isinstance(family, Family) else load_family(family)
        self.seed = seed
        self.split = split
        self.collision_cost = collision_cost
        self.render_mode = None
        self.possible_agents = [f"car_{k + 1}" for k in range(n_cars)]
        self.agents: list[str] = []
        actions = self.family.actions
        self.observation_spaces = {
            one: Box(np.array(LOW), np.array(HIGH), dtype=np.float64)
            for one in self.possible_agents
        }
        self.action_spaces = {
            one: Box(actions.low, actions.high, (1,), np.float64) for one in self.possible_agents
        }
        self._random = np.random.default_rng()
        self._run = ExitStack()
        self._road: Road | None = None

    def observation_space(self, agent: str) -> Box:
        """What an agent may observe."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """What an agent may do."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float64]], _Told]:
        """Begin a scenario, drawn by the seed or chosen exactly.

        Parameters
        ----------
        seed : int, optional
            Of the draws from now on.
        options : dict, optional
            ``split`` and ``index`` of the scenario; others are for others.

        Returns
        -------
        (dict, dict)
            The first observation and info of each agent.

        Raises
        ------
        ValueError
            If there is no such split or index.
        """
        if seed is not None:
            self._random = np.random.default_rng(seed)
        asked = options or {}
        split = asked.get("split", self.split)
        index = int(asked.get("index", self._random.integers(_INDICES)))
        scenario = self.family.draw(self.seed, index, split).scenario
        self._which = {"split": split, "index": index}
        self.agents = list(self.possible_agents)
        self._run.close()
        world = KinematicWorld()
        self._road = self._run.enter_context(world.open(replace(scenario, behind=None)))
        self._behind = _Followers(scenario, len(self.agents) - 1)
        return self._observe(), self._infos(self._road.episode(), np.zeros(len(self.agents)))

    def step(
        self, actions: dict[str, ArrayLike]
    ) -> tuple[
        dict[str, NDArray[np.float64]],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        _Told,
    ]:
        """Drive for one interval with what each agent commands.

        Raises
        ------
        ValueError
            If an agent's action is missing, or no finite number.
        """
        road = self._road
        if road is None or not self.agents:  # as PettingZoo has it, once the run is over
            self.agents = []
            return {}, {}, {}, {}, {}
        commands = np.array([self._command(agent, actions) for agent in self.agents])
        steps = road.scenario.steps(self.family.interval)
        began, moved = road.row, self._behind.way.copy()
        for _ in range(steps):
            if road.over or self._behind.collided.any():
                break
            row = road.row
            road.advance(commands[0])
            self._behind.advance(commands[1:], road.episode(first=row))
        run = road.episode(first=began)
        first = float(np.trapezoid(run.observations[:, 1], run.time))
        ways = np.concatenate([[first], self._behind.way - moved])
        infos = self._infos(run, ways)
        failed = {agent: bool(infos[agent]["failed"]) for agent in self.agents}
        over = road.over or any(failed.values())
        rewards = {
            agent: infos[agent]["distance"] - self.collision_cost * failed[agent]
            for agent in self.agents
        }
        truncated = {agent: over and not failed[agent] for agent in self.agents}
        observations = self._observe()
        if over:
            self.agents = []
        return observations, rewards, failed, truncated, infos

    def render(self) -> None:
        """Nothing is drawn."""

    def close(self) -> None:
        """Leave the road."""
        self._road = None
        self.agents = []
        self._run.close()

    def _command(self, agent: str, actions: dict[str, ArrayLike]) -> float:
        if agent not in actions:
            raise ValueError(f"there is no action of {agent}")
        acceleration = float(np.asarray(actions[agent], dtype=np.float64).reshape(()))
        if not math.isfinite(acceleration):
            raise ValueError(f"action of {agent} is {acceleration}; it must be finite")
        return min(max(acceleration, self.family.actions.low), self.family.actions.high)

    def _rows(self) -> NDArray[np.float64]:
        """(n, 3) gap and speeds of each car."""
        assert self._road is not None
        first = self._road.episode(first=self._road.row).observations[-1]
        speeds = np.concatenate([[first[1]], self._behind.speeds])
        others = np.column_stack([self._behind.gaps, speeds[1:], speeds[:-1]])
        return np.vstack([first[None], others])

    def _observe(self) -> dict[str, NDArray[np.float64]]:
        rows = np.clip(self._rows(), LOW, HIGH)
        return {agent: row.copy() for agent, row in zip(self.agents, rows, strict=True)}

    def _infos(self, run: Episode, ways: NDArray[np.float64]) -> _Told:
        rows = self._rows()
        failed = rows[:, 0] <= 0.0
        hit = np.append(failed[1:], False)
        return {
            agent: {
                "time": float(run.time[-1]),
                "gap": float(rows[k, 0]),
                "distance": float(ways[k]),
                "failed": bool(failed[k]),
                "rear_ended": bool(hit[k]),
                **self._which,
            }
            for k, agent in enumerate(self.agents)
        }


class _Followers:
    """The cars behind the first one, moved as that one is."""

    def __init__(self, scenario: Scenario, count: int) -> None:
        self.gaps = np.full(count, scenario.initial_gap)  #: to the one ahead [m]
        self.speeds = np.full(count, scenario.initial_speed)  #: [m/s]
        self.way = np.zeros(count)  #: driven so far [m]
        self._dt = scenario.dt
        self._body: Body = scenario.body
        self._realised = np.zeros(count)
        late = scenario.steps(scenario.body.delay)
        self._told = [np.zeros(count) for _ in range(late)]  # not yet in effect

    @property
    def collided(self) -> NDArray[np.bool_]:
        """Who has run into the one ahead."""
        return self.gaps <= 0.0

    def advance(self, commands: NDArray[np.float64], ahead: Episode) -> None:
        """One step, in which the car ahead of them all moved so."""
        self._told.append(commands)
        change = self._body.jerk * self._dt
        wanted = np.clip(self._told.pop(0), self._body.lowest, self._body.highest)
        self._realised = np.clip(wanted, self._realised - change, self._realised + change)
        speeds = ahead.record[:, SPEED]
        ways = [0.5 * float(speeds[0] + speeds[-1]) * self._dt * (len(speeds) > 1)]
        for k, realised in enumerate(self._realised):
            way, self.speeds[k] = move(0.0, self.speeds[k], realised, self._dt)
            ways.append(way)
        self.way += ways[1:]
        self.gaps += np.array(ways[:-1]) - np.array(ways[1:])

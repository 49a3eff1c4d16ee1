"""A platoon as a parallel environment of PettingZoo, with and without a guard for every car.

    python examples/platoon.py

The first car follows the leader of a scenario of `emergency`, who brakes suddenly; each of the
others follows the one ahead of it. All drive too close. One guard is shared by all.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from evofsm.driving import KinematicWorld, guard_for_family, load_family
from evofsm.guard import RevisedAgents

LOW, HIGH = np.array([-10.0, 0.0, 0.0]), np.array([2000.0, 100.0, 100.0])


class Platoon(ParallelEnv[str, Any, Any]):  # type: ignore[misc]
    """Cars in a row, each of which observes ``[gap [m], v [m/s], v ahead [m/s]]``.

    An action is an acceleration [m/s²]. A collision ends the run: who ran into the one ahead is
    terminated, as ``info["failed"]`` says, and all others are truncated.
    """

    metadata: dict[str, Any] = {"name": "platoon", "render_modes": []}  # noqa: RUF012

    def __init__(self, n_cars: int = 4) -> None:
        self.family = load_family("emergency")
        self.possible_agents = [f"car_{k + 1}" for k in range(n_cars)]
        self.agents: list[str] = []
        self.render_mode = None

    def observation_space(self, agent: str) -> Box:
        """What an agent may observe."""
        return Box(LOW, HIGH, dtype=np.float64)

    def action_space(self, agent: str) -> Box:
        """What an agent may do."""
        return Box(self.family.actions.low, self.family.actions.high, (1,), np.float64)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin a scenario: that of ``options["index"]``, or of the seed."""
        index = (options or {}).get("index", seed or 0)
        scenario = self.family.draw(0, index, "test").scenario
        self._road = KinematicWorld().open(scenario).__enter__()
        self._steps = scenario.steps(self.family.interval)
        self.agents = list(self.possible_agents)
        others = len(self.agents) - 1
        self._gaps, self._speeds = np.full(others, scenario.initial_gap), np.zeros(others)
        return self._observe(), {agent: {"failed": False} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> Any:
        """Drive for one interval with what each agent commands."""
        actions_of = [float(np.ravel(actions[agent])[0]) for agent in self.agents]
        commands = np.clip(actions_of, self.family.actions.low, self.family.actions.high)
        dt, row = self._road.scenario.dt, self._road.row
        self._road.advance(float(commands[0]), self._steps)
        first = self._road.episode(first=row).observations[:, 1]
        for before, after in pairwise(first):
            reached = np.maximum(self._speeds + commands[1:] * dt, 0.0)
            ways = np.concatenate([[before + after], self._speeds + reached]) * 0.5 * dt
            self._gaps, self._speeds = self._gaps + ways[:-1] - ways[1:], reached
        seen = self._observe()
        failed = {agent: bool(row[0] <= 0.0) for agent, row in seen.items()}
        over = self._road.over or any(failed.values())
        truncated = {agent: over and not failed[agent] for agent in self.agents}
        infos = {agent: {"failed": failed[agent]} for agent in self.agents}
        rewards = {agent: float(seen[agent][1]) for agent in self.agents}
        if over:
            self.agents = []
        return seen, rewards, failed, truncated, infos

    def _observe(self) -> dict[str, NDArray[np.float64]]:
        first = self._road.episode(first=self._road.row).observations[-1]
        speeds = np.concatenate([first[1:2], self._speeds])
        others = np.column_stack([self._gaps, speeds[1:], speeds[:-1]])
        rows = np.clip(np.vstack([first, others]), LOW, HIGH)
        return dict(zip(self.agents, rows, strict=True))


def failures(env: Any, episodes: int) -> int:
    """Episodes in which one of the cars runs into the one ahead, all of them in a hurry."""
    found = 0
    for index in range(episodes):
        observations, infos = env.reset(options={"index": index})
        while env.agents:
            hasty = {
                agent: np.array([0.5 * (gap - 0.4 * speed) + ahead - speed])
                for agent, (gap, speed, ahead) in observations.items()
            }
            observations, _, _, _, infos = env.step(hasty)
        found += any(info["failed"] for info in infos.values())
    return found


def main(argv: Sequence[str] | None = None) -> tuple[int, int]:
    """Drive, print, and answer with the collisions: unguarded, guarded."""
    parser = argparse.ArgumentParser(description="A platoon, and a guard for every car.")
    parser.add_argument("--episodes", type=int, default=20)
    episodes = parser.parse_args(argv).episodes
    platoon = Platoon()
    guard = guard_for_family(platoon.family)
    guarded = RevisedAgents(platoon, guard, failed=lambda step: step.info["failed"])
    found = failures(platoon, episodes), failures(guarded, episodes)
    print(f"Of {episodes} runs end in a collision: {found[0]} unguarded, {found[1]} guarded")
    return found


if __name__ == "__main__":
    main()

"""A point that is pushed through the plane to a goal; it fails within 0.8 of the middle.

    evofsm watch examples/watched_disc.py

Its controller is careless, and heads straight for the goal. Failure is no threshold of one variable
here: the guard is given which episodes failed, and learns a region of two.
"""

from types import MappingProxyType

import gymnasium
import numpy as np

variables = ("x", "y", "speed x", "speed y", "goal y")
GOAL_X = 3.0


class Disc(gymnasium.Env):
    """Two accelerations from -1 to 1, each held for 0.1 s; terminated within the disc."""

    metadata = MappingProxyType({"render_fps": 10})
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (5,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))

    def reset(self, *, seed=None, options=None):
        """Begin on the left; the goal is on the right."""
        super().reset(seed=seed)
        place = self.np_random.uniform((-3.4, -2.5), (-2.6, 2.5))
        self.state = np.concatenate([place, self.np_random.uniform(-0.2, 0.2, 2)])
        self.goal = np.array([GOAL_X, self.np_random.uniform(-2.2, 2.2)])
        self.steps = 0
        return self.observation(), {}

    def observation(self):
        """Place, speed, and how high the goal is."""
        return np.append(self.state, self.goal[1]).astype(np.float32)

    def step(self, action):
        """Push for 0.1 s; it is over on arriving, too, which is no failure."""
        place, speed = self.state[:2], self.state[2:]
        push = np.clip(action, -1.0, 1.0)
        place = place + 0.1 * speed + 0.005 * push
        speed = speed + 0.1 * push + self.np_random.normal(0.0, 0.004, 2)
        self.state, self.steps = np.concatenate([place, speed]), self.steps + 1
        failed = bool(np.hypot(*place) < 0.8)
        arrived = bool(np.hypot(*(place - self.goal)) < 0.4)
        return self.observation(), 0.0, failed, arrived or self.steps >= 120, {}


def environment():
    """What is driven."""
    return Disc()


def controller(observation, random):
    """Straight to the goal, with a whim."""
    place, speed, goal = observation[:2], observation[2:4], np.array([GOAL_X, observation[4]])
    return 0.7 * (goal - place) - speed + 0.2 * random.normal(size=2)

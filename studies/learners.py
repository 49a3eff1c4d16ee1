"""Learners of Stable-Baselines3 under filters, and the tasks of `studies.peers` as environments.

This needs torch; `studies.peers` says what is asked, and what of each task was chosen by us.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from evofsm.driving import guard_for_cars
from evofsm.extras import needs
from evofsm.guard import Guard, RevisedActions
from studies.peers import FIRST_STATE, GOAL, LEAN, TASKS, WAYS
from studies.rivals import Rival, cart_shield, pendulum_shield
from studies.systems import Box, Discrete

with needs("stable-baselines3", "rl", "the study of peers"):
    import gymnasium
    import torch
    from stable_baselines3 import DDPG, PPO, SAC
    from stable_baselines3.common.buffers import ReplayBuffer
    from stable_baselines3.common.noise import NormalActionNoise

Env = gymnasium.Env[Any, Any]

# -- Tasks ----------------------------------------------------------------------------------------


class Upright(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Pendulum that begins about upright, is paid 1 more a step, and fails where it leans far."""

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        """Begin about upright."""
        _, info = self.env.reset(**given)
        pendulum: Any = self.unwrapped
        pendulum.state = pendulum.np_random.uniform(-1.0, 1.0, 2) * FIRST_STATE
        return pendulum._get_obs(), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Move, and end where it leans too far."""
        seen, reward, _, truncated, info = self.env.step(action)
        return seen, 1.0 + float(reward), bool(seen[0] < math.cos(LEAN)), truncated, info


def _gym(name: str, steps: int, **given: Any) -> Env:
    return gymnasium.make(name, max_episode_steps=steps, disable_env_checker=True, **given)


def _goal(steps: int) -> Env:
    """CartPole that pays for being near a place."""
    env = _gym("CartPole-v1", steps)
    cart: Any = env.unwrapped
    near = lambda _: math.exp(-((cart.state[0] - GOAL) ** 2))  # noqa: E731
    return gymnasium.wrappers.TransformReward(env, near)


def _upright(interval: float, steps: int) -> Env:
    env = _gym("Pendulum-v1", steps)
    pendulum: Any = env.unwrapped
    pendulum.dt = interval
    return Upright(env)


def _double(steps: int) -> Env:
    """The simulator's own step is 10 ms; here it is that between two decisions."""
    env = _gym("InvertedDoublePendulum-v5", steps, frame_skip=1)
    pendulum: Any = env.unwrapped
    pendulum.model.opt.timestep = TASKS["double-pendulum"].interval
    return env


def _cars(steps: int) -> Env:
    env = _gym("evofsm.driving.env:evofsm/CarFollowing-v0", steps, collision_cost=100.0)
    return gymnasium.wrappers.TransformReward(env, lambda reward: 0.1 * float(reward))


#: Makes the environment of a task, of so many steps an episode at most.
MAKE: dict[str, Callable[[int], Env]] = {
    "cartpole": partial(_gym, "CartPole-v1"),
    "cartpole-goal": _goal,
    "pendulum": partial(_upright, TASKS["pendulum"].interval),
    "pendulum-5ms": partial(_upright, TASKS["pendulum-5ms"].interval),
    "double-pendulum": _double,
    "hopper": partial(_gym, "Hopper-v5"),
    "walker2d": partial(_gym, "Walker2d-v5"),
    "car-following": _cars,
}
# What a network sees of cars is divided by this: gap [m] and speeds [m/s].
_CARS = np.array([100.0, 30.0, 30.0])


def begin(env: Env, task: str, held_out: int) -> Any:
    """First observation of a held-out episode, the same for all."""
    if task == "car-following":
        return env.reset(options={"split": "test", "index": held_out})[0]
    return env.reset(seed=1_000_000 + held_out)[0]


# -- Filters --------------------------------------------------------------------------------------


class Shielded(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Under a judge that is told its system; ``info`` has what it changed, as `RevisedActions`."""

    def __init__(self, env: Env, shield: Rival, actions: Box | Discrete, penalty: float) -> None:
        super().__init__(env)
        self.shield, self.actions, self.penalty = shield, actions, penalty

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self.seen, info = self.env.reset(**given)
        return self.seen, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Execute what the shield makes of an action."""
        proposal = np.asarray(action).item()
        executed = self.shield.action(np.asarray(self.seen, np.float64), proposal)
        size = self.actions.change(executed, proposal)
        if size > 0.0:
            action = executed if np.ndim(action) == 0 else np.array([executed], np.float32)
        self.seen, reward, *ends, info = self.env.step(action)
        info |= {"reviser/penalty": size, "reviser/executed_action": action}
        return self.seen, float(reward) - self.penalty * size, *ends, info


def told_shield(task: str) -> tuple[Rival, Box | Discrete]:
    """Who is told how a pole moves, and its actions."""
    if task.startswith("cartpole"):
        two = Discrete(2)
        return cart_shield(two), two
    torque = Box((-2.0,), (2.0,))
    return pendulum_shield(torque, LEAN, True, TASKS[task].interval), torque


def learning_guard(kind: str, task: str, actions: Any, seed: int) -> Guard:
    """A guard that is told nothing but failures, or of cars how they follow each other."""
    told: dict[str, Any] = {"interval": TASKS[task].interval, "seed": seed}
    if isinstance(actions, gymnasium.spaces.Discrete):
        return Guard(n_actions=int(actions.n), **told)
    for name in ("low", "high"):
        end = getattr(actions, name).astype(np.float64)
        told[name] = end if len(end) > 1 else end.item()
    return guard_for_cars(**told) if kind == "cars" else Guard(**told)


class Episode(NamedTuple):
    """What came of one."""

    steps: int
    returned: float  #: without what changes cost
    failed: bool


class Diary(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Notes all episodes, and which proposals were changed."""

    def __init__(self, env: Env, penalty: float) -> None:
        super().__init__(env)
        self.penalty = penalty
        self.episodes: list[Episode] = []
        self.changed: list[bool] = []

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self._steps, self._returned = 0, 0.0
        return self.env.reset(**given)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Go on, and note it."""
        seen, reward, terminated, truncated, info = self.env.step(action)
        size = float(info.get("reviser/penalty", 0.0))
        self._steps += 1
        self._returned += float(reward) + self.penalty * size
        self.changed.append(size > 0.0)
        if terminated or truncated:
            failed = bool(info.get("failed", terminated))
            self.episodes.append(Episode(self._steps, self._returned, failed))
        return seen, reward, terminated, truncated, info


def made(task: str, filtered: Guard | str | None = None, penalty: float = 0.0) -> Diary:
    """The environment of a task, under a guard, a shield (``"shield"``) or nothing."""
    env = MAKE[task](TASKS[task].episode)
    if isinstance(filtered, Guard):
        failed = lambda step: bool(step.info.get("failed", step.terminated))  # noqa: E731
        env = RevisedActions(env, filtered, failed=failed, penalty=penalty)
    elif filtered:
        env = Shielded(env, *told_shield(task), penalty)
    if task == "car-following":
        scaled = gymnasium.spaces.Box(-np.inf, np.inf, (3,))
        env = gymnasium.wrappers.TransformObservation(env, lambda z: np.float32(z / _CARS), scaled)
    return Diary(env, penalty)


# -- Learners -------------------------------------------------------------------------------------


class ExecutedBuffer(ReplayBuffer):  # type: ignore[misc]
    """Remembers what was executed and what it earned; where changes cost, the proposal as well.

    What an action led to is true of the action that was executed, and a cost of the change is one
    of the proposal: so each is remembered with its own reward (both, as in Krasowski et al., 2023).
    """

    def __init__(self, *given: Any, penalty: float = 0.0, **named: Any) -> None:
        super().__init__(*given, **named)
        self.penalty = penalty

    def add(
        self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: list[Any]
    ) -> None:
        """Of a single environment, whose actions are scaled to [-1, 1]."""
        size = infos[0].get("reviser/penalty", 0.0)
        if size > 0.0:
            if self.penalty > 0.0:
                super().add(obs, next_obs, action, reward, done, infos)
            low, high = self.action_space.low, self.action_space.high
            executed = np.asarray(infos[0]["reviser/executed_action"])
            action = (2.0 * (executed - low) / (high - low) - 1.0).reshape(np.shape(action))
        super().add(obs, next_obs, action, reward + self.penalty * size, done, infos)


def learner(task: str, env: Env, seed: int, steps: int, penalty: float | None = None) -> Any:
    """PPO, SAC or DDPG, set alike on all tasks; with a penalty its memory knows of changes."""
    settings: dict[str, Any] = {"seed": seed, "device": "cpu"}
    if TASKS[task].learner == "PPO":
        return PPO("MlpPolicy", env, n_steps=512, learning_rate=1e-3, **settings)
    settings |= {"policy_kwargs": {"net_arch": [64, 64]}, "learning_starts": 500}
    settings |= {"buffer_size": 2 * steps, "train_freq": 2, "gradient_steps": 1}
    if penalty is not None:
        settings["replay_buffer_class"] = ExecutedBuffer
        settings["replay_buffer_kwargs"] = {"penalty": penalty}
    if TASKS[task].learner == "SAC":
        return SAC("MlpPolicy", env, **settings)
    noise = NormalActionNoise(np.zeros(1), np.full(1, 0.2))
    return DDPG("MlpPolicy", env, action_noise=noise, **settings)


def tried(agent: Any, env: Diary, task: str, episodes: int) -> dict[str, Any]:
    """Failures and mean return of the final policy over held-out episodes."""
    for k in range(episodes):
        seen, over = begin(env, task, k), False
        while not over:
            seen, _, *ends, _ = env.step(agent.predict(seen, deterministic=True)[0])
            over = any(ends)
    found = env.episodes
    return {
        "failed": sum(one.failed for one in found),
        "return": float(np.mean([one.returned for one in found])),
        "changed": float(np.mean(env.changed)),
    }


def late_return(episodes: list[Episode], steps: int) -> float | None:
    """Mean return of the episodes that ended in the last tenth; of the last one if none did."""
    ends = np.cumsum([one.steps for one in episodes])
    late = [one.returned for one, end in zip(episodes, ends, strict=True) if end > 0.9 * steps]
    late = late or [one.returned for one in episodes[-1:]]
    return float(np.mean(late)) if late else None


def trained(task: str, way: str, seed: int, steps: int, held_out: int) -> dict[str, Any]:
    """Let a learner learn a task, and try what it learnt by itself and under its filter."""
    torch.set_num_threads(1)
    kind, penalty, stored = WAYS[way]
    guard: Guard | None = None
    filtered: Guard | str | None = "shield" if kind == "told" else None
    if kind in ("learnt", "cars"):
        filtered = guard = learning_guard(kind, task, made(task).action_space, seed)
    env = made(task, filtered, penalty)
    agent = learner(task, env, seed, steps, penalty if stored == "executed" else None)
    begun = time.perf_counter()
    agent.learn(steps)
    seconds = time.perf_counter() - begun
    said: list[Any] = []
    if guard is not None:
        filtered = guard = guard.copy()
        with warnings.catch_warnings(record=True) as said:  # that it lets proposals pass
            warnings.simplefilter("always")
            guard.freeze()
    alone = tried(agent, made(task), task, held_out)
    under = tried(agent, made(task, filtered), task, held_out) if filtered else {}
    done, quarter = env.changed, max(1, len(env.changed) // 4)
    return {
        "task": task,
        "way": way,
        "seed": seed,
        "steps": len(done),
        "episodes": len(env.episodes),
        "failed": sum(one.failed for one in env.episodes),
        "late_return": late_return(env.episodes, len(done)),
        "changed_first": float(np.mean(done[:quarter])),
        "changed_last": float(np.mean(done[-quarter:])),
        "held_out": held_out,
        **{f"alone_{name}": value for name, value in alone.items() if name != "changed"},
        **{f"under_{name}": under.get(name) for name in ("failed", "return", "changed")},
        "passes": bool(said) if guard is not None else None,
        "seconds": seconds,
    }

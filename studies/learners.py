"""Learners of Stable-Baselines3 under filters, and the tasks of `studies.peers` as environments.

This needs torch; `studies.peers` says what is asked, and what of each task was chosen by us.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from copy import deepcopy
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from evofsm.driving import guard_for_cars
from evofsm.extras import needs
from evofsm.guard import Guard, RevisedActions
from studies.peers import ALONE, FIRST_STATE, GOAL, LEAN, TASKS, WAYS
from studies.rivals import Rival, States, cart_shield, pendulum_shield
from studies.systems import Action, Box, Discrete, Vector, actions_of

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


class Planar(gymnasium.Env[Any, Any]):
    """A quadrotor in a plane: place [m], tilt, their rates; the two thrusts of up to its weight."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (6,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    dt = TASKS["planar-quadrotor"].interval

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begin anywhere in the inner half of the room, about upright, slowly."""
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1.0, 1.0, 6) * (1.5, 0.75, 0.1, 0.5, 0.5, 0.1)
        return np.float32(self.state), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Four steps of Euler's method; mass 1 kg, arms of 0.2 m, inertia 0.02 kg m²."""
        left, right = 0.5 * 9.81 * (1.0 + np.clip(action, -1.0, 1.0))
        for _ in range(4):
            tilt, lift = self.state[2], left + right
            rates = [-lift * math.sin(tilt), lift * math.cos(tilt) - 9.81, 10.0 * (right - left)]
            self.state[3:] += 0.25 * self.dt * np.array(rates)
            self.state[:3] += 0.25 * self.dt * self.state[3:]
        x, z, tilt = self.state[:3]
        failed = abs(x) > 3.0 or abs(z) > 1.5 or abs(tilt) > math.pi / 3.0
        return np.float32(self.state), math.exp(-(x**2) - z**2), bool(failed), False, {}


def _planar(steps: int) -> Env:
    return gymnasium.wrappers.TimeLimit(Planar(), steps)


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
    "planar-quadrotor": _planar,
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
        self.shield.begin()
        return self.seen, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Execute what the shield makes of an action."""
        proposal = action if np.size(action) > 1 else np.asarray(action).item()
        executed = self.shield.action(np.asarray(self.seen, np.float64), proposal)
        size = self.actions.change(executed, proposal)
        if size > 0.0:
            action = executed if np.ndim(action) == 0 else np.atleast_1d(np.float32(executed))
        self.seen, reward, *ends, info = self.env.step(action)
        if any(ends):
            failed = bool(info.get("failed", ends[0]))
            self.shield.end(failed, np.asarray(self.seen, np.float64), terminated=ends[0])
        info |= {"reviser/penalty": size, "reviser/executed_action": action}
        return self.seen, float(reward) - self.penalty * size, *ends, info


class SafetyCritic(Rival):
    """Executes the action least likely to fail where the proposal is likelier to than a limit.

    A network learns of all that was executed Q(z, u) = 1 where it failed, else the discounted least
    Q of the next state (Srinivasan et al. 2020, arXiv:2010.14603). Half of each batch led into
    failures (Thananjeyan et al. 2021, arXiv:2010.15920). Chosen by us: it begins with nothing, and
    all numbers.
    """

    told = "nothing but failures"
    _LIMIT, _DISCOUNT, _BATCH, _OPTIONS, _AVERAGE = 0.05, 0.9, 64, 16, 0.01

    def __init__(self, actions: Box | Discrete, width: int, seed: int) -> None:
        torch.manual_seed(seed)
        self._chance, self._actions = np.random.default_rng(seed), actions
        self._rows: list[tuple[Vector, Vector, Vector, float]] = []
        self._fatal: list[int] = []  # rows of the last steps before a failure
        self._scale, self._learns = np.ones(width), True
        width += actions.n_actions if isinstance(actions, Discrete) else len(actions.low)
        self._net = torch.nn.Sequential(
            torch.nn.Linear(width, 64), torch.nn.ReLU(),
            torch.nn.Linear(64, 64), torch.nn.ReLU(), torch.nn.Linear(64, 1), torch.nn.Sigmoid(),
        )  # fmt: skip
        self._slow = deepcopy(self._net)
        self._steps = torch.optim.Adam(self._net.parameters(), lr=1e-3)

    def begin(self) -> None:
        """Begin an episode."""
        self._last: tuple[Vector, Vector] | None = None
        if self._learns and self._rows:
            spread = np.std([row[0] for row in self._rows], axis=0)
            self._scale = np.where(spread > 1e-6, spread, 1.0)

    def action(self, observation: Vector, proposal: Action) -> Action:
        """The proposal, or of some actions that which is least likely to fail."""
        self._note(observation, failed=False)
        options = [proposal, *self._drawn()]
        if self._fatal:
            with torch.no_grad():
                risk = self._risk(self._net, observation[None], self._coded(options))[0]
            if risk[0] > self._LIMIT:
                proposal = options[int(risk.argmin())]
        self._last = observation, self._coded([proposal])[0]
        return proposal

    def end(self, failed: bool = False, observation: Vector | None = None, **how: Any) -> None:
        """End the episode."""
        assert observation is not None
        self._note(observation, failed)

    def freeze(self) -> None:
        """Learn nothing from now on."""
        self._learns = False

    def _note(self, observation: Vector, failed: bool) -> None:
        """Remember the last step, and learn from a batch."""
        if not self._learns or self._last is None:
            return
        if failed:
            self._fatal.append(len(self._rows))
        self._rows.append((*self._last, observation, float(failed)))
        if not self._fatal:
            return
        half = self._BATCH // 2
        drawn = self._chance.integers(0, len(self._rows), half)
        rows = [self._rows[k] for k in (*self._chance.choice(self._fatal, half), *drawn)]
        z, u, after, fails = map(np.array, zip(*rows, strict=True))
        with torch.no_grad():
            best = self._risk(self._slow, after, self._coded(self._drawn())).min(dim=1).values
        failed_at = torch.as_tensor(fails, dtype=torch.float32)
        target = failed_at + (1.0 - failed_at) * self._DISCOUNT * best
        risk = self._net(self._input(z, u))[:, 0]
        self._steps.zero_grad()
        torch.nn.functional.mse_loss(risk, target).backward()
        self._steps.step()
        for slow, fast in zip(self._slow.parameters(), self._net.parameters(), strict=True):
            slow.data.lerp_(fast.data, self._AVERAGE)

    def _drawn(self) -> list[Action]:
        if isinstance(self._actions, Discrete):
            return list(range(self._actions.n_actions))
        return [self._actions.drawn(self._chance) for _ in range(self._OPTIONS)]

    def _coded(self, options: list[Action]) -> Any:
        """(k, c) one in n of indices, else actions scaled to [-1, 1]."""
        if isinstance(self._actions, Discrete):
            return np.identity(self._actions.n_actions)[options]
        low, high = np.array(self._actions.low), np.array(self._actions.high)
        return 2.0 * (np.array(options).reshape(len(options), -1) - low) / (high - low) - 1.0

    def _risk(self, net: Any, states: States, options: States) -> Any:
        """(b, k) of each option in each state."""
        b, k = len(states), len(options)
        return net(self._input(np.repeat(states, k, axis=0), np.tile(options, (b, 1)))).view(b, k)

    def _input(self, states: States, options: States) -> Any:
        return torch.as_tensor(np.hstack([states / self._scale, options]), dtype=torch.float32)


def rival(kind: str, task: str, env: Env, seed: int) -> Rival:
    """Who is told how a pole moves, or learns a critic."""
    actions = actions_of(env.action_space)
    if kind == "critic":
        return SafetyCritic(actions, env.observation_space.shape[0], seed)  # type: ignore[index]
    if isinstance(actions, Discrete):
        return cart_shield(actions)
    return pendulum_shield(actions, LEAN, True, TASKS[task].interval)


def learning_guard(kind: str, task: str, actions: Any, seed: int) -> Guard:
    """A guard that is told nothing but failures, or of cars how they follow each other."""
    told = {"interval": TASKS[task].interval, "seed": seed, **actions_of(actions).settings}
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


def made(task: str, filtered: Guard | Rival | None = None, penalty: float = 0.0) -> Diary:
    """The environment of a task, under a guard, a rival or nothing."""
    env = MAKE[task](TASKS[task].episode)
    if isinstance(filtered, Guard):
        failed = lambda step: bool(step.info.get("failed", step.terminated))  # noqa: E731
        env = RevisedActions(env, filtered, failed=failed, penalty=penalty)
    elif filtered:
        env = Shielded(env, filtered, actions_of(env.action_space), penalty)
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
        """Of a single environment; actions of a box are scaled to [-1, 1]."""
        size = infos[0].get("reviser/penalty", 0.0)
        if size > 0.0:
            if self.penalty > 0.0:
                super().add(obs, next_obs, action, reward, done, infos)
            executed, space = np.asarray(infos[0]["reviser/executed_action"]), self.action_space
            if hasattr(space, "low"):
                executed = 2.0 * (executed - space.low) / (space.high - space.low) - 1.0
            action = executed.reshape(np.shape(action))
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
    filtered: Guard | Rival | None = None
    if kind in ("learnt", "cars"):
        filtered = guard = learning_guard(kind, task, made(task).action_space, seed)
    elif kind != ALONE:
        filtered = rival(kind, task, made(task), seed)
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
    elif filtered:
        filtered.freeze()
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

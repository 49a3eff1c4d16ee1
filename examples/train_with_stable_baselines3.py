"""PPO of Stable-Baselines3 under a guard, and what the guard did in TensorBoard.

    $ pip install '.[gym,study]' stable-baselines3 tensorboard
    $ python examples/train_with_stable_baselines3.py

docs/how-to/train-with-stable-baselines3.md shows what it prints. torch is no dependency of evofsm.
"""

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor

from evofsm.driving import guard_for_cars
from evofsm.guard import RevisedActions

SCALE = np.array([100.0, 30.0, 30.0])  # of gap [m] and speeds [m/s], for the network
KEYS = ("reviser/penalty", "reviser/risk", "reviser/risk_proposed")


def make(guard=None):
    """The environment, under a guard if there is one, scaled for the network."""
    env = gymnasium.make("evofsm.driving.env:evofsm/CarFollowing-v0")
    if guard is not None:  # innermost: it has to see metres and m/s²
        env = RevisedActions(env, guard, failed=lambda step: step.info["failed"], penalty=1.0)
    env = gymnasium.wrappers.RescaleAction(env, np.float32(-1.0), np.float32(1.0))
    seen = gymnasium.spaces.Box(-np.inf, np.inf, (3,))
    env = gymnasium.wrappers.TransformObservation(env, lambda z: np.float32(z / SCALE), seen)
    return Monitor(env)


class GuardBoard(BaseCallback):
    """What the guard did, as means over each rollout, under the one prefix ``reviser/``."""

    def _on_rollout_start(self):
        self.told = []

    def _on_step(self):
        self.told += [[info.get(key, np.nan) for key in KEYS] for info in self.locals["infos"]]
        return True

    def _on_rollout_end(self):
        told = np.array(self.told)
        self.logger.record("reviser/changed", np.mean(told[:, 0] > 0.0))
        for key, mean in zip(KEYS, np.nanmean(told, axis=0), strict=True):
            self.logger.record(key, mean)


def judged(agent, env, episodes=20):
    """Held-out episodes: how many collide, and how far it gets."""
    failed, way = 0, 0.0
    for index in range(episodes):
        seen, info = env.reset(options={"split": "test", "index": index})
        over = False
        while not over:
            seen, _, terminated, truncated, info = env.step(
                agent.predict(seen, deterministic=True)[0]
            )
            way += info["distance"]
            over = terminated or truncated
        failed += info["failed"]
    return f"{failed} of {episodes} collide, {way / episodes:.0f} m an episode"


guard = guard_for_cars(low=-2.5, high=2.5, interval=0.25)
env = make(guard)
agent = PPO(
    "MlpPolicy", env, n_steps=1024, gamma=0.98, seed=0, device="cpu", tensorboard_log="runs"
)
agent.learn(16_384, callback=GuardBoard())
assert guard.machine is not None
print(
    f"while training: {guard.machine.endings.sum():.0f} of {len(env.get_episode_rewards())} collide"
)
guard.freeze()
print("under the guard:", judged(agent, env))
print("the policy alone:", judged(agent, make()))

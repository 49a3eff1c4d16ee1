"""Train a deep Q-network on a task of highway-env, and keep its weights for the study of tasks.

    pip install torch highway-env
    python tools/train_dqn.py highway-fast

Weights go to ``studies/weights/NAME.npz``; NumPy alone reads them from then on
(``studies.systems.read_weights``). Deep Q-learning with a replay memory and a target network
(Mnih et al., "Human-level control through deep reinforcement learning", Nature 2015), and double
Q-learning (van Hasselt et al. 2016). Its reward is the environment's own; it knows no guard.
"""

from __future__ import annotations

import argparse
import time
from copy import deepcopy
from pathlib import Path
from typing import Any

import gymnasium
import highway_env  # noqa: F401  (registers its environments)
import numpy as np
import torch
from torch import nn

WEIGHTS = Path(__file__).parents[1] / "studies/weights"
# Of each task: decisions to learn from, and the discount of what comes a decision later.
TASKS = {"highway-fast": (20_000, 0.8), "merge": (15_000, 0.8), "intersection": (12_000, 0.95)}
HIDDEN, BATCH, MEMORY = 128, 64, 15_000
RATE, WARM_UP, TARGET_EVERY = 5e-4, 200, 50
# Share of random actions: at first, at last, and after which share of all decisions that is so.
FIRST, LAST, UNTIL = 1.0, 0.05, 0.6
SEED = 20_000  # of the first episode; those of the study are drawn elsewhere


def network(inputs: int, outputs: int) -> nn.Sequential:
    """From an observation, its axes flattened, to the value of each action."""
    return nn.Sequential(
        nn.Linear(inputs, HIDDEN),
        nn.ReLU(),
        nn.Linear(HIDDEN, HIDDEN),
        nn.ReLU(),
        nn.Linear(HIDDEN, outputs),
    )


def train(name: str, minutes: float) -> nn.Sequential:
    """Learn a task for its number of decisions, or until time is up."""
    decisions, discount = TASKS[name]
    torch.manual_seed(0)
    torch.set_num_threads(1)
    random = np.random.default_rng(0)
    env: Any = gymnasium.make(f"{name}-v0")
    inputs, outputs = int(np.prod(env.observation_space.shape)), int(env.action_space.n)
    values = network(inputs, outputs)
    target = deepcopy(values)
    optimizer = torch.optim.Adam(values.parameters(), lr=RATE)
    seen = torch.zeros(MEMORY, inputs)
    then = torch.zeros(MEMORY, inputs)
    did = torch.zeros(MEMORY, dtype=torch.long)
    paid, goes_on = torch.zeros(MEMORY), torch.zeros(MEMORY)
    began, episode, crashed = time.monotonic(), 0, []
    observation, _ = env.reset(seed=SEED)
    for step in range(decisions):
        here = torch.from_numpy(np.ravel(observation)).float()
        done = max(step / decisions, (time.monotonic() - began) / (60.0 * minutes))
        share = max(LAST, FIRST - (FIRST - LAST) * done / UNTIL)
        if random.random() < share:
            action = int(random.integers(outputs))
        else:
            with torch.no_grad():
                action = int(values(here).argmax())
        observation, reward, terminated, truncated, info = env.step(action)
        k = step % MEMORY
        seen[k], did[k], paid[k] = here, action, float(reward)
        then[k] = torch.from_numpy(np.ravel(observation)).float()
        goes_on[k] = float(not terminated)
        if terminated or truncated:
            crashed.append(bool(info["crashed"]))
            episode += 1
            observation, _ = env.reset(seed=SEED + episode)
        if step < WARM_UP:
            continue
        some = torch.from_numpy(random.integers(min(step + 1, MEMORY), size=BATCH))
        with torch.no_grad():
            best = values(then[some]).argmax(1, keepdim=True)
            later = target(then[some]).gather(1, best)[:, 0]
            wanted = paid[some] + discount * goes_on[some] * later
        expected = values(seen[some]).gather(1, did[some][:, None])[:, 0]
        loss = nn.functional.smooth_l1_loss(expected, wanted)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(values.parameters(), 10.0)
        optimizer.step()
        if step % TARGET_EVERY == 0:
            target.load_state_dict(values.state_dict())
        if step % 1000 == 0:
            print(step, f"{time.monotonic() - began:.0f} s", np.mean(crashed[-40:]), flush=True)
        if time.monotonic() - began > 60.0 * minutes:
            break
    print(f"{step + 1} decisions, {episode} episodes")
    return values


def main() -> None:
    """Train and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("--minutes", type=float, default=60.0, help="time after which it stops")
    chosen = parser.parse_args()
    values = train(chosen.task, chosen.minutes)
    layers = [layer for layer in values if isinstance(layer, nn.Linear)]
    arrays = {}
    for i, layer in enumerate(layers):
        arrays[f"weight{i}"] = layer.weight.detach().numpy().astype(np.float32)
        arrays[f"bias{i}"] = layer.bias.detach().numpy().astype(np.float32)
    WEIGHTS.mkdir(exist_ok=True)
    np.savez_compressed(WEIGHTS / f"{chosen.task}.npz", **arrays)


if __name__ == "__main__":
    main()

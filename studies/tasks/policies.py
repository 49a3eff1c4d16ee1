"""Policies of CartPole that are trained under the guard, and what they do once it is off.

A linear policy, left or right by the sign of a weighted sum, is searched for by the cross-entropy
method (Rubinstein 1999): of each generation the best ones say where the next one is drawn. Under
the guard nearly every policy survives; with a penalty on changes, one that needs no guard earns
more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

from evofsm.extras import needs
from evofsm.guard import Guard, RevisedActions
from studies.systems.cartpole import CartPole
from studies.systems.rivals.rival import Unrevised
from studies.systems.system import Action, Judge, Start, Vector
from studies.systems.trial import Ended, run, told_to
from studies.tasks.amounts import Amounts
from studies.tasks.rows import Row, row

with needs("gymnasium", "gym", "CartPole-v1"):
    import gymnasium

#: How policies are trained, in words; None without the guard, else the share of the plan's penalty.
TRAININGS = {
    "no filter": None,
    "filter, no penalty": 0.0,
    "filter, penalty": 1.0,
}
# Of a generation the share that the next one is drawn about, and how far the first one spreads.
_BEST, _SPREAD = 0.3, 1.0


class Driven(CartPole):
    """CartPole under a linear policy."""

    def __init__(self, weights: Vector) -> None:
        self._weights = weights
        super().__init__()

    @property
    def controllers(self) -> Mapping[str, Callable[[Vector], Action]]:
        """The policy alone."""
        return {"policy": lambda z: acts(self._weights, z)}


def acts(weights: Vector, observation: Vector) -> int:
    """Left or right."""
    return int(observation @ weights > 0.0)


def trained_policies(plan: Amounts) -> Iterator[partial[list[Row]]]:
    """A task for each way of training and learning seed."""
    for training in TRAININGS:
        for seed in range(plan.seeds):
            yield partial(_policy, plan, training, seed)


def _policy(plan: Amounts, training: str, seed: int) -> list[Row]:
    """Rows of one policy with the filter off, and on where there is one."""
    share = TRAININGS[training]
    env: gymnasium.Env[Any, Any] = gymnasium.make("CartPole-v1")
    guard: Guard | None = None
    if share is not None:
        guard = Guard(n_actions=2, interval=CartPole.interval, seed=seed)
        env = RevisedActions(env, guard, penalty=share * plan.penalty)
    weights, learnt = search(env, plan.generations, plan.population, plan.seed * 1000 + seed)
    off = _held_out(plan, weights, Unrevised())
    failed = sum(one.failed for one in off)
    who = ("cartpole", f"policy: {training}")
    rows = [row(plan, *who, "filter off", "nothing", seed, learnt, off, failed)]
    if guard is not None:
        guard.freeze()
        on = _held_out(plan, weights, guard)
        rows.append(row(plan, *who, "filter on", told_to(guard), seed, learnt, on, failed))
    return rows


def _held_out(plan: Amounts, weights: Vector, judge: Judge) -> list[Ended]:
    driven = Driven(weights)
    return [run(driven, judge, Start.held_out(plan.seed, k)) for k in range(plan.test)]


def search(
    env: gymnasium.Env[Any, Any], generations: int, population: int, seed: int
) -> tuple[Vector, list[Ended]]:
    """Weights of a policy that was found, and the episodes that it took."""
    chance = np.random.default_rng([seed, 2])
    size = env.observation_space.shape[0]  # type: ignore[index]
    mean, spread = np.zeros(size), np.full(size, _SPREAD)
    best = max(2, round(_BEST * population))
    learnt: list[Ended] = []
    for _ in range(generations):
        drawn = mean + spread * chance.normal(size=(population, size))
        ended = [_episode(env, weights, int(chance.integers(2**31))) for weights in drawn]
        learnt += ended
        order = np.argsort([-one.score for one in ended], kind="stable")[:best]
        mean, spread = drawn[order].mean(axis=0), drawn[order].std(axis=0) + 0.05
    return mean, learnt


def _episode(env: gymnasium.Env[Any, Any], weights: Vector, seed: int) -> Ended:
    observation, _ = env.reset(seed=seed)
    returned, decisions = 0.0, 0
    while True:
        observation, reward, failed, over, _ = env.step(acts(weights, observation))
        returned += float(reward)
        decisions += 1
        if failed or over:
            return Ended(bool(failed), returned, decisions, 0.0, [])

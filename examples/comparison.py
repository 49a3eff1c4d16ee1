"""What the examples share: drive some episodes, count collisions, print what came of it."""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from evofsm.fsm import wilson_bounds
from evofsm.guard import RevisedActions


class Settings(NamedTuple):
    """What the command line says."""

    episodes: int  # held out: driven with and without the reviser
    train: int  # driven under the reviser before that, to learn
    seed: int


class Result(NamedTuple):
    """What came of some episodes."""

    collisions: int
    speeds: list[NDArray[np.float64]]  # of each episode, after every step [m/s]

    def __str__(self) -> str:
        episodes = len(self.speeds)
        rate = self.collisions / episodes
        low, high = wilson_bounds(rate, float(episodes))
        return (
            f"{self.collisions:3d} of {episodes} episodes end in a collision "
            f"({rate:.0%}, 90 % interval {low:.0%} to {high:.0%})"
        )

    def kept(self, other: Result) -> float:
        """Share of the other's distance in the same episodes, until the other's ended."""
        driven = sum(
            mine[: len(theirs)].sum()
            for mine, theirs in zip(self.speeds, other.speeds, strict=True)
        )
        return float(driven / sum(theirs.sum() for theirs in other.speeds))


def settings(about: str, argv: Sequence[str] | None, episodes: int, train: int) -> Settings:
    """Read the command line."""
    parser = ArgumentParser(description=about)
    parser.add_argument("--episodes", type=int, default=episodes, help="held-out episodes")
    parser.add_argument("--train", type=int, default=train, help="episodes to learn from before")
    parser.add_argument("--seed", type=int, default=0)
    return Settings(**vars(parser.parse_args(argv)))


def drive(
    env: gymnasium.Env[Any, Any],
    policy: Callable[[Any, dict[str, Any]], Any],
    resets: Iterable[dict[str, Any]],
    failed: str,
    speed: Callable[[Any], float],
) -> Result:
    """Drive an episode for each of ``resets``, which are arguments of ``env.reset``."""
    collisions, speeds = 0, []
    for arguments in resets:
        observation, info = env.reset(**arguments)
        over, driven = False, []
        while not over:
            action = policy(observation, info)
            observation, _, terminated, truncated, info = env.step(action)
            driven.append(speed(observation))
            over = terminated or truncated
        speeds.append(np.array(driven))
        collisions += info[failed]
    return Result(collisions, speeds)


def compare(
    revised: RevisedActions,
    policy: Callable[[Any, dict[str, Any]], Any],
    training: Iterable[dict[str, Any]],
    held_out: Sequence[dict[str, Any]],
    speed: Callable[[Any], float],
    failed: str = "failed",
) -> tuple[Result, Result]:
    """Drive held-out episodes without the reviser, then, when it has learnt, with it.

    The last ``info`` of an episode says by the name ``failed`` whether it ended in a collision.
    """
    without = drive(revised.env, policy, held_out, failed, speed)
    print(f"unrevised      {without}")
    learning = drive(revised, policy, training, failed, speed)
    print(f"while learning {learning}")
    revised.guard.freeze()
    under = drive(revised, policy, held_out, failed, speed)
    print(f"revised        {under}")
    print(
        f"until the unrevised episodes ended they drove at {_mean(without.speeds):.1f} m/s, of "
        f"which the reviser kept {under.kept(without):.0%}; over whole episodes it drove at "
        f"{_mean(under.speeds):.1f} m/s"
    )
    return without, under


def _mean(speeds: list[NDArray[np.float64]]) -> float:
    return float(np.concatenate(speeds).mean())

"""Is a good controller left alone? A row for each system, seed, and way: alone, or guarded.

The guard learnt of a careless controller; then a good one takes over. A fresh one knows nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from itertools import chain, product
from typing import Annotated, Any

import numpy as np
import polars as pl
from typer import Option

from evofsm.paper import Page, Table
from studies import lib
from studies.judges import make_judge, run
from studies.rivals import Unrevised
from studies.shapes import NEEDS
from studies.systems import Start, System, Vector, make_system

ALONE, FRESH, FROZEN, LEARNING = "alone", "fresh", "frozen", "learning"
#: A system, the careless controller of which is learnt, and what a good one does.
GOOD: dict[tuple[str, str], Callable[[Any, Vector], Any]] = {
    ("acc", "full throttle"): lambda s, z: np.clip(-1.5 * (z[0] + 0.7) - 2.5 * z[1], -2.0, 2.0),
    ("cartpole", "random"): lambda s, z: int(z @ [0.1, 0.3, 3.0, 1.0] > 0.0),
    ("pendulum", "random"): lambda s, z: np.clip(-10.0 * z[0] - 2.0 * z[1], -2.0, 2.0),
    ("pendulum-cos", "random"): lambda s, z: np.clip(-10.0 * _angle(z[1::-1]) - 2.0 * z[2], -2, 2),
    ("tanks", "exchanged"): lambda s, z: np.clip(0.2 - 0.4 * (z[:2] - 1.0), 0.0, 1.0),
    ("reactor", "random"): lambda s, z: int(z[0] < 45.0 and z[1] < 0.3),
    ("disc", "careless"): lambda s, z: s._towards(_around(z[:2], s._goal), 0.7, 1.2, 0.1),
    ("diamond", "curious"): lambda s, z: s._towards(np.zeros(2), 1.0, 1.2, 0.1),
    ("landing", "careless"): lambda s, z: s._within(
        [1.0 + 2.0 * (-0.2 - 0.2 * max(z[0], 0.0) - z[1]), -1.5 * z[2] - 1.5 * z[3]]
    ),
    ("inverted-pendulum", "careless"): lambda s, z: s._within([z @ [0.74, 6.0, 0.87, 1.0]])[0],
    ("double-pendulum", "careless"): lambda s, z: s._within(
        [-0.23 * z[0] - 1.55 * _angle(z[1::2]) - 4.9 * _angle(z[2::2]) - z[5:8] @ [0.31, 0.8, 0.76]]
    )[0],
    ("lander", "careless"): lambda s, z: _piloted(s, z),
}


def _around(place: Vector, goal: Vector) -> Vector:
    """Where to head first, to pass a disc about the middle at a distance."""
    side = 1.0 if place[1] + goal[1] >= 0.0 else -1.0
    return goal if place[0] > 0.3 else np.array([0.5, 2.0 * side])


def _angle(sine_and_cosine: Vector) -> float:
    return float(np.arctan2(*sine_and_cosine[:2]))


def _piloted(system: Any, observation: Vector) -> int:
    """By Gymnasium's own pilot."""
    from gymnasium.envs.box2d.lunar_lander import heuristic

    act: Callable[..., int] = heuristic
    return int(act(system._env, observation))


class Driver:
    """A good controller of a system."""

    def __init__(self, system: System, act: Callable[[System, Vector], Any]) -> None:
        self.system, self.act = system, act

    def propose(self, observation: Vector, time: float = 0.0) -> Any:
        """What it wants; kept as the system's ``proposed``."""
        self.system.proposed = self.act(self.system, observation)
        return self.system.proposed


@dataclass(frozen=True, kw_only=True)
class Good(lib.Study):
    """Whether a good controller is left alone by guards that learnt of a careless one."""

    name = "good"
    train: Annotated[int, Option(min=10, help="Episodes of the careless controller.")] = 40
    episodes: Annotated[int, Option(min=1, help="Episodes of the good one, each way.")] = 20
    seeds: int = 5

    def shortened(self) -> Good:
        """One seed."""
        return self.smaller(seeds=1, episodes=5)

    def run(self, workers: int | None = None) -> dict[str, pl.DataFrame]:
        """Learn of the careless one, then let the good one drive."""
        tasks = [
            partial(driven, name, careless, self.seed + seed, self.train, self.episodes)
            for (name, careless), seed in product(GOOD, range(self.seeds))
            if name not in NEEDS or find_spec(NEEDS[name][0])
        ]
        return {"rows": lib.frame_of(chain(*lib.parallel(tasks, workers, "Driving")))}

    def page(self, found: lib.Frames) -> Page:
        """Sums over seeds, and the seed in which most was spoilt."""
        each = found["rows"].with_columns(
            share=pl.col("score") / pl.col("score").filter(way=ALONE).first().over("system", "seed")
        )
        sums = each.group_by("system", "way", maintain_order=True).agg(
            pl.col("failed", "goals", "episodes").sum(),
            pl.col("kept", "share").mean(),
            least=pl.col("kept").min(),
            worst=pl.col("share").min(),
        )
        lines = lib.with_share(sums, "failed", "episodes", "rate")
        shown = {
            **{"system": "{system}", "way": "{way}", "failed": "{failed} of {episodes}"},
            **{"at most (95 %)": "{rate_high:p}", "goals": "{goals}"},
            **{"kept": "{kept:.3f}", "worst seed": "{least:.3f}"},
            **{"return of alone": "{share:.3f}", "least": "{worst:.3f}"},
        }
        guarded = sums.filter(pl.col("way") != ALONE)
        more = guarded.join(sums.filter(way=ALONE), on="system", suffix="_alone")
        failures = more.select((pl.col("failed") - pl.col("failed_alone")).max()).item()
        least, worst = guarded.select(pl.col("least", "worst").min()).row(0)
        return self.shown(
            _ABOUT,
            [Table("Good controllers", lines, shown)],
            targets=[
                lib.at_most("failures more than alone, worst system", failures, 0.0, "{:.0f}"),
                lib.at_least("kept, worst seed", least, 0.9, "{:.2f}"),
                lib.at_least("return, worst seed", worst, 0.95, "{:.2f}"),
            ],
            lost=[
                Table(
                    "Spoilt: kept below 0.9, return below 0.95, or failures that it had not alone",
                    lines.join(more.select("system", "way", "failed_alone"), on=["system", "way"])
                    .filter(
                        (pl.col("least") < 0.9)
                        | (pl.col("worst") < 0.95)
                        | (pl.col("failed") > pl.col("failed_alone"))
                    )
                    .drop("failed_alone"),
                    shown,
                )
            ],
        )


_ABOUT = """Is a good controller left alone?

A guard learns of a careless controller; then a good one, which it never saw, drives the same draws
alone, under the frozen guard, under one that goes on learning, and under a fresh one."""


def driven(name: str, careless: str, seed: int, train: int, episodes: int) -> list[dict[str, Any]]:
    """What came of a good controller, alone and under a guard that learnt of a careless one."""
    system = make_system(name, careless)
    guard, fresh = (make_judge("learnt", system, (), seed) for _ in range(2))
    for k in range(train):
        run(system, guard, Start.training(0, seed, k))
    frozen = guard.copy()
    frozen.freeze()
    driver, rows = Driver(system, GOOD[name, careless]), []
    ways: dict[str, Any] = {ALONE: Unrevised(), FRESH: fresh, FROZEN: frozen, LEARNING: guard}
    for way, judge in ways.items():
        found = [run(system, judge, Start.training(1, seed, k), driver) for k in range(episodes)]
        rows.append(
            {
                "system": name,
                "seed": seed,
                "way": way,
                "episodes": episodes,
                "failed": sum(ended.failed for ended in found),
                "goals": sum(ended.arrived for ended in found),
                "kept": sum(ended.kept for ended in found) / sum(len(e.times) for e in found),
                "score": float(np.mean([ended.score for ended in found])),
            }
        )
    return rows

"""Reinforcement learning under the filter, on tasks of the newest papers and of our own.

Frame ``rows``: one learner on one task, in one way, with one seed. ``episodes`` and ``failed`` are
of training, of ``steps`` decisions; ``late_return`` is the mean return of episodes that ended in
the last tenth. Costs of changes are in no return. ``changed_first`` and ``changed_last`` are shares
of proposals in the first and the last quarter. The final policy is tried on ``held_out`` episodes
by itself (columns that begin with ``alone_``) and under its frozen filter (``under_``).
``seconds`` is the time that training took, and alone depends on the machine.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

import polars as pl
from scipy.stats import t as student
from typer import Option

from evofsm import warm
from evofsm.paper import Page, Table
from evofsm.store import replacing
from studies import lib
from studies.lib import ALL

# -- What is asked --------------------------------------------------------------------------------


class Way(NamedTuple):
    """What is between a learner and its task."""

    filter: str  #: alone, learnt, critic, told (a shield), or cars
    penalty: float  #: for a change of half a range, or to another index
    stored: str = "executed"  #: what a learner with a memory remembers of a change


ALONE = "alone"
WAYS = {
    ALONE: Way(ALONE, 0.0),
    "filter-0": Way("learnt", 0.0),
    "filter-0.3": Way("learnt", 0.3),
    "filter-1": Way("learnt", 1.0),
    "proposals-0": Way("learnt", 0.0, "proposed"),
    "told-1": Way("told", 1.0),
    "cars-1": Way("cars", 1.0),
    "critic-1": Way("critic", 1.0),
}
_TOLD = {
    ALONE: "no filter",
    "learnt": "nothing but failures",
    "told": "linear model and limits",
    "cars": "how cars follow; failures",
    "critic": "nothing but failures (safety critic)",
}


class Task(NamedTuple):
    """A task, and how much of it is learnt."""

    learner: str  #: PPO, SAC or DDPG
    interval: float  #: between decisions [s]
    episode: int  #: decisions, at most
    steps: int  #: of training
    ways: Sequence[str]
    cost: float  #: about so many seconds on one core, under the learnt filter
    source: str
    held_out: int = 20  #: episodes


#: Chosen by us where papers or Gymnasium leave it open: the place that `cartpole-goal` pays for [m]
#: (the track ends at 2.4), how far a pendulum may lean [rad], and how far off it begins, at most
#: [rad, rad/s].
GOAL, LEAN, FIRST_STATE = 1.5, 0.5, (0.1, 0.3)

_PLAIN = (ALONE, "filter-0", "filter-1", "critic-1")
_POLE = (*_PLAIN, "told-1")
_GYMNASIUM = "Gymnasium {}; it fails where it is terminated"
# Learner, interval, decisions of an episode, steps, ways, cost, source, held-out episodes.
TASKS = {
    "cartpole": Task(
        "PPO", 0.02, 500, 20_000, (*_POLE, "filter-0.3"), 65.0,
        _GYMNASIUM.format("CartPole-v1"),
    ),
    "cartpole-goal": Task(
        "PPO", 0.02, 500, 12_000, _POLE, 45.0,
        f"Goal-reaching CartPole, after Dyna-SAuR (arXiv:2604.25508). Chosen by us: CartPole-v1's "
        f"two forces and limits, goal at {GOAL} m, reward exp(-(x - goal)²) a step",
    ),
    "pendulum": Task(
        "SAC", 0.05, 200, 5_000, (*_POLE, "filter-0.3", "proposals-0"), 25.0,
        f"Gymnasium Pendulum-v1. Chosen by us: it begins about upright and fails beyond {LEAN} "
        f"rad; 1 is added to the reward, for else ending early would pay",
    ),
    "pendulum-5ms": Task(
        "SAC", 0.005, 800, 12_000, _POLE, 90.0,
        "As pendulum, decided every 5 ms, after Deep QP Safety Filter (arXiv:2601.21297). Chosen "
        "by us: all else, torque limit 2 as in Gymnasium",
    ),
    "double-pendulum": Task(
        "SAC", 0.005, 800, 6_000, _PLAIN, 50.0,
        "Gymnasium InvertedDoublePendulum-v5, decided every 5 ms, after Deep QP Safety Filter. "
        "Chosen by us: the simulator's step is 5 ms as well; it fails where it is terminated",
    ),
    "hopper": Task(
        "PPO", 0.008, 500, 6_000, _PLAIN, 60.0, _GYMNASIUM.format("Hopper-v5"), 5
    ),
    "walker2d": Task(
        "PPO", 0.008, 500, 6_000, _PLAIN, 60.0,
        _GYMNASIUM.format("Walker2d-v5, as in Dyna-SAuR"), 5,
    ),
    "planar-quadrotor": Task(
        "PPO", 0.05, 200, 20_000, _PLAIN, 90.0,
        "Ours: two thrusts hold a craft in a plane; reward exp(-distance²) to the middle; it fails "
        "outside of 6 by 3 m and tilted by more than 60°",
    ),
    "car-following": Task(
        "DDPG", 0.25, 400, 6_000, (*_PLAIN, "filter-0.3", "proposals-0", "cars-1"), 25.0,
        "DDPG in car following with and without a reviser (arXiv:2006.08092). Chosen by us: "
        "evofsm/CarFollowing-v0, of which leaders brake hard; reward a tenth of the metres "
        "travelled, less 10 for a collision; decisions every 0.25 s, ±2.5 m/s²",
    ),
}  # fmt: skip

#: What the papers themselves say, in their abstracts; their tasks, learners and counts of steps are
#: others.
PUBLISHED = (
    ("Dyna-SAuR, arXiv:2604.25508", "CartPole with a goal, MuJoCo Walker",
     "failures fewer by two orders of magnitude than with methods before it"),
    ("Deep QP Safety Filter, arXiv:2601.21297", "several systems, some of them learning tasks",
     "substantially fewer failures before convergence, higher returns sooner"),
    ("Han, Nageshrao, Filev, Özgüner, arXiv:2006.08092", "car following by DDPG",
     "no control failures after a few iterations"),
)  # fmt: skip

# -- The study ------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Peers(lib.Study):
    """How often learners of Stable-Baselines3 fail while they learn, alone and under the filter.

    What is finished is kept in a folder and not run again, so that a study that was stopped goes
    on. The filter is told nothing but failures, unless a row says more.
    """

    name = "peers"
    needed: ClassVar[dict[str, str]] = dict.fromkeys(("stable_baselines3", "mujoco"), "rl")

    tasks: Annotated[str, Option(help=f"Tasks with commas; all is {', '.join(TASKS)}.")] = ALL
    ways: Annotated[str, Option(help=f"Ways with commas; all is {', '.join(WAYS)}.")] = ALL
    seeds: Annotated[int, Option(min=1, help="Learning seeds.")] = 5
    steps: Annotated[
        int | None, Option(min=600, help="Training steps; each task's own if not given.")
    ] = None
    runs: Annotated[Path, Option(help="Folder of what is finished.")] = Path("evofsm-peers/runs")
    show: Annotated[
        bool, Option("--show", help="Train nothing: show what is finished, of all that is asked.")
    ] = False

    def shortened(self) -> Peers:
        """One seed of two tasks, 2,000 steps: two minutes on two cores."""
        tasks = "cartpole,pendulum" if self.tasks == ALL else self.tasks
        return replace(self, tasks=tasks, seeds=1, steps=min(self.steps or 2_000, 2_000))

    @property
    def jobs(self) -> list[Job]:
        """All that is asked, seed by seed, of each the longest first.

        `ValueError` if there is no such task or way.
        """
        known: dict[str, Sequence[str]] = {"task": list(TASKS), "way": list(WAYS)}
        named = dict(known)
        for what, given in {"task": self.tasks, "way": self.ways}.items():
            named[what] = known[what] if given == ALL else lib.names_in(given)
            if wrong := [name for name in named[what] if name not in known[what]]:
                all_of = ", ".join(known[what])
                raise ValueError(f"there is no {what} {wrong[0]!r}; there are {all_of}")
        seeds = range(self.seed, self.seed + self.seeds)
        found = [
            Job(name, way, seed, self.steps or TASKS[name].steps)
            for name, seed, way in product(named["task"], seeds, named["way"])
            if way in TASKS[name].ways
        ]
        return sorted(found, key=lambda job: (job.seed, -job.cost))

    def run(self, workers: int | None = None) -> dict[str, pl.DataFrame]:
        """Train what is not finished, and gather all that is."""
        jobs = self.jobs
        if not self.show:
            self.runs.mkdir(parents=True, exist_ok=True)
            warm()  # once, not in each process
            left = [partial(finish, job, self.runs) for job in jobs if not job.row(self.runs)]
            for why in lib.parallel(left, workers, "Training"):
                if why:
                    print(f"warning: {why}", file=sys.stderr)
        rows = [row for job in jobs if (row := job.row(self.runs))]
        if not rows:
            raise ValueError(f"nothing is finished in {self.runs}")
        order = {name: place for place, name in enumerate((*TASKS, *WAYS))}
        rows.sort(key=lambda row: (order[row["task"]], order[row["way"]], row["seed"]))
        return {"rows": lib.frame_of(rows)}

    def page(self, found: lib.Frames) -> Page:
        """A table for each task, what the papers say, and where it loses."""
        lines = summary(found["rows"])
        learnt = lines.filter(pl.col("told") == _TOLD["learnt"])
        both = learnt.join(lines.filter(way=ALONE), on="task", suffix="_of_alone")
        tables = [
            Table(
                f"{name}: {TASKS[name].learner}, {some['steps'][0]:,} steps",
                some,
                _SHOWN,
                f"{TASKS[name].source}.",
                pl.when(pl.col("told") == _TOLD["learnt"]).then(pl.lit("ours")),
            )
            for (name,), some in lines.group_by(["task"], maintain_order=True)
        ]
        said = Table(
            "What the papers say themselves",
            pl.DataFrame(PUBLISHED, ["source", "task", "said"], orient="row"),
            note="From their abstracts, which have no counts: other tasks, learners and steps than "
            "here, so that no row above compares with them.",
        )
        with_one = both.filter(way="filter-1")
        share = with_one.select((pl.col("failed") / pl.col("failed_of_alone")).max()).item()
        worst = with_one.select(pl.col("changed_last").max()).item()
        targets = [
            lib.at_most(f"{what}, penalty 1, worst task", value, most, "{:.3f}")
            for what, value, most in (
                ("failures in training, share of those alone", share, 0.01),
                ("proposals changed in the last quarter", worst, 0.1),
            )
            if value is not None
        ]
        lost = {
            "At least half as many failures in training as alone": pl.col("failed")
            >= 0.5 * pl.col("failed_of_alone"),
            "The policy that it trained fails by itself at least as often as one trained alone": (
                (pl.col("alone_failed") > 0)
                & (pl.col("alone_failed") >= pl.col("alone_failed_of_alone"))
            ),
            "It returns less, under its filter, than what was trained alone": pl.col("under_return")
            < pl.col("alone_return_of_alone"),
            "At least half of the proposals are changed in the last quarter": pl.col("changed_last")
            >= 0.5,
        }
        return self.shown(
            _ABOUT,
            [*tables, said],
            lost=[
                Table(title, both.filter(which), {"task": "{task}", **_SHOWN, **_OF_ALONE})
                for title, which in lost.items()
            ],
            targets=targets,
            packages=("gymnasium", "stable-baselines3", "torch", "mujoco"),
        )

    def write(self, found: lib.Frames, folder: Path) -> None:
        """The tables of all tasks, to be pasted into Markdown."""
        tables = [one for one in self.page(found).parts if isinstance(one, Table)]
        text = "\n\n".join(markdown(table) for table in tables)
        (folder / f"{self.name}.md").write_text(text + "\n")


_ABOUT = """How often do learners fail while they learn, alone and under the filter?

Learners of Stable-Baselines3 learn a task alone, under a guard that is told nothing but failures,
and, where there is one, under a filter that is told more. A guard learns at the same time, from the
same episodes; it is new with every seed. Then the policy is tried on held-out episodes, by itself
and under what it was trained under, frozen.

Intervals are Student's over seeds, of the mean, 95 %. Failed of held-out episodes: of all seeds,
which share them. A change costs the learner the penalty of the way's name; no return holds that
cost. SAC and DDPG remember the executed action, but in the way `proposals-0`."""
_MEANS = ("failed", "episodes", "late_return", "changed_first", "changed_last", "seconds")
# What has an interval, and the least that it can be.
_LEAST = {"failed": 0.0, "late_return": -math.inf}
_SHOWN = {
    "way": "{way}",
    "told": "{told}",
    "failed in training (95 %)": "{failed:.1f} ({failed_low:.1f}–{failed_high:.1f})",
    "of episodes": "{episodes:.0f}",
    "return at the end (95 %)": "{late_return:.4g} ({late_return_low:.4g}–{late_return_high:.4g})",
    "changed, first and last quarter": "{changed_first:%}, {changed_last:%}",
    "policy by itself: failed, return": "{alone_failed} of {held_out}, {alone_return:.4g}",
    "under its filter": "{under_failed} of {held_out}, {under_return:.4g}",
    "lets all pass": "{passes} of {runs}",
    "seconds": "{seconds:.0f}",
}
_OF_ALONE = {
    "trained alone": "{failed_of_alone:.1f}; {alone_failed_of_alone} of {held_out_of_alone}, "
    "{alone_return_of_alone:.4g}"
}


def summary(rows: pl.DataFrame) -> pl.DataFrame:
    """A line for each task and way: means over seeds with intervals, sums of held-out episodes."""
    counts = ["alone_failed", "under_failed", "passes", "held_out"]
    lines = rows.group_by("task", "way", maintain_order=True).agg(
        pl.col("steps").first(),
        pl.col(*_MEANS, "alone_return", "under_return").mean(),
        *[pl.when(pl.col(one).count() > 0).then(pl.col(one).sum()).alias(one) for one in counts],
        *[pl.col(name).std().alias(f"{name}_off") for name in _LEAST],
        runs=pl.len(),
    )
    times = [student.ppf(0.975, n - 1) / n**0.5 if n > 1 else None for n in lines["runs"]]
    off = {one: pl.Series(times, dtype=pl.Float64) * lines[f"{one}_off"] for one in _LEAST}
    return lines.with_columns(
        pl.Series("told", [_TOLD[WAYS[way].filter] for way in lines["way"]]),
        *[
            (pl.col(one) - off[one]).clip(least).alias(f"{one}_low")
            for one, least in _LEAST.items()
        ],
        *[(pl.col(one) + off[one]).alias(f"{one}_high") for one in _LEAST],
    )


def markdown(table: Table) -> str:
    """A table of a page as one of Markdown."""
    lines = [f"| {' | '.join(cells)} |" for cells in (table.header, *table.cells)]
    lines.insert(1, "|---" * len(table.header) + "|")
    return "\n\n".join(filter(None, [f"### {table.title}", table.note, "\n".join(lines)]))


# -- What is finished -----------------------------------------------------------------------------


class Job(NamedTuple):
    """One learner on one task, in one way, with one seed."""

    task: str
    way: str
    seed: int
    steps: int

    @property
    def cost(self) -> float:
        """About how long it takes; only the order counts."""
        share = 0.5 if WAYS[self.way].filter in (ALONE, "told") else 1.0
        return TASKS[self.task].cost * share * self.steps / TASKS[self.task].steps

    def file(self, runs: Path) -> Path:
        """Where its row is once it is finished."""
        return runs / f"{self.task}-{self.way}-{self.steps}-{self.seed}.json"

    def row(self, runs: Path) -> dict[str, Any]:
        """Its row; empty as long as it is not finished."""
        file = self.file(runs)
        found: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
        return found


def finish(job: Job, runs: Path) -> str:
    """Train, and keep the row; else why there is none, as others are to go on."""
    from studies.learners import trained

    try:
        row = trained(*job, TASKS[job.task].held_out)
    except Exception as error:
        return f"{job.task}, {job.way}, seed {job.seed} is left out: {error}"
    with replacing(job.file(runs)) as file:
        file.write(json.dumps(row).encode())
    return ""

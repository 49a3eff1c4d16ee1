"""The frozen benchmark of the learnt judge: `python -m studies judges --quick`.

A row is one case and one learning seed: a judge learns a system, also one that is noisy, weakened
or of which one number is wrong, is frozen, and is tried on held-out episodes. Beside each stands
what was accepted (``docs/results/benchmark.json``): the sums of the same seeds when the benchmark
was frozen.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from evofsm.driving import Draw, drive, held_out, load_family, teach, training
from evofsm.paper import Page, Table
from studies import lib
from studies.systems import System, Vector

#: What was accepted, and with which draws.
ACCEPTED = Path(__file__).parents[1] / "docs" / "results" / "benchmark.json"
DRAWS = 45


class Case(NamedTuple):
    """What is learnt, of how many episodes, and how many are held out."""

    system: str
    controller: str = ""  #: the first one if empty
    change: str = ""  #: see `CHANGES`
    train: int | None = None  #: as many as suit the system
    test: int = 60


#: Episode, from 0, in which one number is wrong, and its step.
GLITCHED, STEP = 9, 6
_NOISE = {  # standard deviations of sensors
    "acc": (0.01, 0.02),
    "cartpole": (0.004, 0.04, 0.006, 0.06),
    "disc": (0.01, 0.01, 0.01, 0.01),
}


class Changed:
    """A system as it is seen, or acts, after a change (one of `CHANGES`)."""

    def __init__(self, system: System, change: str) -> None:
        self._system, self._change = system, change

    def __getattr__(self, name: str) -> Any:
        return getattr(self._system, name)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        """Begin the episode; which it is says whether anything is wrong in it."""
        start = (options or {})["start"]
        self._step, self._late = 0, start.split == "test" or start.episode >= 30
        self._held: Vector | None = None
        self._wrong = start.split == "train" and start.episode == GLITCHED
        self._seen_by = np.random.default_rng([start.seed, start.episode, 77])
        z, info = self._system.reset(seed=seed, options=options)
        return self._seen(z), info

    def step(self, action: Any) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Execute an action; one row of the episode may be dropped."""
        if self._change == "weaker" and self._late:
            action = 0.6 * np.asarray(action)
        self._step += 1
        z, reward, ended, over, info = self._system.step(action)
        if self._wrong and self._change == "dropped" and self._step == STEP and not (ended or over):
            z, reward, ended, over, info = self._system.step(action)
        if self._wrong and self._change == "label" and (ended or over):
            info = {**info, "failed": not info["failed"]}
        return self._seen(z), reward, ended, over, info

    def _seen(self, z: Vector) -> Vector:
        """What sensors say."""
        if self._change == "late":
            seen, self._held = z if self._held is None else self._held, z
            return seen
        if self._change == "noise":
            return z + self._seen_by.normal(0.0, _NOISE[self._system.name])
        if not self._wrong:
            return z
        seen, k = z.copy(), len(z) // 2
        if self._change == "stuck" and STEP <= self._step < STEP + 20:
            seen[k] = self._held[k] if self._held is not None else z[k]
        elif self._change == "repeated" and self._step == STEP and self._held is not None:
            seen = self._held
        elif self._change in _VALUES and self._step == STEP:
            seen[k if self._change != "minus" else 0] = _VALUES[self._change]
        self._held = seen
        return seen


_VALUES = {"huge": 65535.0, "missing": -999.0, "minus": -1.0}
#: What may be wrong in one episode, and what is otherwise for good: late is a step.
GLITCHES = ("huge", "missing", "minus", "label", "dropped", "repeated", "stuck")
CHANGES = ("noise", "late", "weaker", *GLITCHES)

_GLITCHED = (("cartpole", "random"), ("oblique", ""), ("disc", ""), ("emergency", ""))
CASES: tuple[Case, ...] = (
    *(Case(name) for name in ("acc", "acc-5", "pendulum", "pendulum-cos", "cartpole-gusts")),
    *(Case("cartpole", one) for one in ("random", "badgain")),
    *(Case("tanks", one) for one in ("full", "exchanged")),
    *(Case("reactor", one) for one in ("hurried", "thermostat", "random")),
    *(Case(name, train=60) for name in ("emergency", "cut_in", "weak_brakes", "stop_and_go")),
    Case("emergency+noise", train=60),
    *(Case(name) for name in ("disc", "moving", "oblique", "diamond", "unicycle")),
    *(Case(name, "curious") for name in ("disc", "unicycle")),
    *(Case("landing", one) for one in ("careless", "random")),
    *(Case("drift", one) for one in ("skid", "wander")),
    *(Case(name, change="noise") for name in ("acc", "cartpole", "disc")),
    Case("cartpole", "random", "late"),
    Case("acc", change="weaker", train=60),
    *(Case(name, change="shifted", train=100, test=40) for name in ("shift", "shift_leader")),
    *(
        Case(name, controller, change, train=60, test=20)
        for name, controller in _GLITCHED
        for change in ("", *GLITCHES)
    ),
)
_BY = ["system", "controller", "change", "train"]


def tried(case: Case, seed: int, base: int, judge: str, without: str) -> dict[str, Any]:
    """The row of a case and a learning seed."""
    from studies.judges import trial

    begun = time.process_time()
    if case.change == "shifted":
        found = _shifted(case, seed, base, lib.names_in(without))
    else:
        found = trial(
            case.system,
            case.controller or None,
            judge,
            without=without,
            seed=seed,
            train=case.train,
            test=case.test,
            base=base,
            beside=False,
            rounds=2,
            change=case.change,
        )
    took = time.process_time() - begun
    row = case._asdict() | {"judge": judge, "without": without, "seed": seed}
    return row | {name: found[name] for name in _FOUND} | {"cpu_s": round(took, 1)}


_FOUND = ("failed", "failed_while_learning", "failed_late", "kept", "goals", "score", "p50_ms")


def _shifted(case: Case, seed: int, base: int, parts: Sequence[str]) -> dict[str, Any]:
    """A family of cars that changes once it was learnt: ten episodes later, and those ten."""
    from studies.judges import learnt_guard, taken_out

    family = load_family(case.system)
    assert family.shifted is not None
    assert case.train is not None
    guard = learnt_guard(
        low=family.actions.low,
        high=family.actions.high,
        interval=family.interval,
        seed=seed,
        without=parts,
    )
    drives: list[Draw] = [*training(family, base, seed, case.train)]
    drives += training(family.shifted, base, seed, 10, first=case.train)
    with taken_out(parts):
        collided = [drive(guard, one).collided for one in drives]
        guard.freeze()
        found = list(teach(guard, held_out(family.shifted, base, case.test)))
    return {
        "failed": sum(one.collided for one in found),
        "failed_while_learning": sum(collided),
        "failed_late": sum(collided[case.train :]),
        "kept": float(np.mean([1.0 - one.changed.mean() for one in found])),
        "goals": 0,
        "score": 0.0,
        "p50_ms": None,
    }


def chosen(only: str) -> list[Case]:
    """Of systems ``only`` those, with commas, if any are named."""
    return [one for one in CASES if not only or one.system in lib.names_in(only)]


def run(
    seeds: int, base: int, judge: str, without: Sequence[str], workers: int | None, only: str
) -> pl.DataFrame:
    """All rows of the cases that are `chosen`."""
    tasks = [
        partial(tried, case, seed, base, judge, part)
        for part in ("", *without)
        for case in chosen(only)
        for seed in range(seeds)
    ]
    return lib.frame_of(lib.parallel(tasks, workers, "Learning and trying"))


# -- What was accepted ----------------------------------------------------------------------------


@lru_cache
def accepted() -> pl.DataFrame:
    """Rows of the judge with which the benchmark was frozen."""
    return pl.DataFrame(json.loads(ACCEPTED.read_text("utf-8")), infer_schema_length=None)


def compared(rows: pl.DataFrame) -> pl.DataFrame:
    """A line for each case and part that is left out: sums of all seeds, and what was accepted.

    Scores and kept proposals are means. Accepted are: as many held-out failures; two more while
    learning, of the worst seed; goals and score that are less by what seeds differ (the standard
    error of both means, one-sided 95 %).
    """
    known = ["seed", *_BY]
    rows = rows.cast({"train": pl.Int64})  # all null where every system has its own
    theirs = accepted().join(rows.select(known).unique(), on=known, nulls_equal=True)
    lines = _summed(rows, [*_BY, "without"])
    lines = lines.join(_summed(theirs, _BY), on=_BY, how="left", nulls_equal=True, suffix="_then")
    few = lines.with_columns(
        (1.645 * (pl.col(f"{one}_error") ** 2 + pl.col(f"{one}_error_then") ** 2).sqrt())
        .fill_null(0.05 * pl.col(f"{one}_then").abs())
        .alias(f"{one}_slack")
        for one in ("goals", "score")
    )
    holds = {
        "failed": pl.col("failed") <= pl.col("failed_then"),
        "learning": pl.col("worst") <= pl.col("worst_then") + 2,
        "goals": pl.col("goals") >= pl.col("goals_then") - pl.col("goals_slack") - 1e-9,
        "score": pl.col("score") >= pl.col("score_then") - pl.col("score_slack") - 1e-9,
    }
    missed = [pl.when(~held).then(pl.lit(name)) for name, held in holds.items()]
    return few.with_columns(missed=pl.concat_str(missed, separator=", ", ignore_nulls=True))


def _summed(rows: pl.DataFrame, by: Sequence[str]) -> pl.DataFrame:
    mean, error = pl.col("goals", "score", "kept"), pl.col("goals", "score")
    return rows.group_by(by, maintain_order=True).agg(
        pl.col("failed").sum(),
        (pl.len() * pl.col("test").first()).alias("episodes"),
        pl.col("failed").max().alias("failed_worst"),
        pl.col("failed_while_learning").sum().alias("learning"),
        pl.col("failed_while_learning").max().alias("worst"),
        mean.mean(),
        (error.std() / pl.len().sqrt()).name.suffix("_error"),
        pl.col("p50_ms").median(),
        pl.col("cpu_s").sum(),
        pl.len().alias("runs"),
    )


def page(asked: lib.Study, rows: pl.DataFrame) -> Page:
    """All lines beside what was accepted and the ceilings, and those that miss it."""
    from studies.told import table

    lines = lib.with_share(compared(rows), "failed", "episodes", "rate")
    shown = {
        "system": "{system}",
        "controller": "{controller}",
        "changed": "{change}",
        "without": "{without}",
        "failed (then)": "{failed} ({failed_then}) of {episodes}",
        "at most (95 %)": "{rate_high:p}",
        "worst": "{failed_worst} ({failed_worst_then})",
        "learning": "{learning} ({learning_then})",
        "worst seed": "{worst} ({worst_then})",
        "kept": "{kept:.2f} ({kept_then:.2f})",
        "goals": "{goals:.1f} ({goals_then:.1f})",
        "score": "{score:.4g} ({score_then:.4g})",
        "p50 [ms]": "{p50_ms:.3f} ({p50_ms_then:.3f})",
        "CPU [s]": "{cpu_s:.0f} ({cpu_s_then:.0f})",
    }
    note = (
        "In brackets: the same seeds when the benchmark was frozen. Failed: of all seeds together. "
        "Times depend on the machine."
    )
    whole = lines.filter(without="")
    total = ("failed", "learning", "cpu_s", "failed_then", "learning_then", "cpu_s_then")
    sums = " · ".join(f"{name} {whole[name].sum():.0f}" for name in total)
    return asked.shown(
        "Is the learnt judge as good as it was?\n\nThe frozen benchmark, case by case.",
        [Table("The benchmark", lines, shown, note), table(lines)],
        lost=[
            Table(
                "Less than was accepted",
                lines.filter(pl.col("missed") != ""),
                {"missed": "{missed}", **shown},
            )
        ],
        facts={"sums": sums},
    )

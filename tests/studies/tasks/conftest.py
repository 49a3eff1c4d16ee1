"""Rows as the study has them, without running it."""

from functools import lru_cache

import pytest

pytest.importorskip("scipy")
pytest.importorskip("gymnasium")

from studies.old.scores import share_of
from studies.tasks.plan import Plan
from studies.tasks.rows import Row
from studies.tasks.study import Tasks

SEEDS = range(20)


@lru_cache
def _share(failed):
    return share_of([True] * failed + [False] * (100 - failed))


def make_row(task, controller, judge="learnt", told="nothing but failures", seed=0, **others):
    """A line as the study has it; nothing but what is told differs."""
    failed = others.pop("failed", 0)
    share = _share(failed)
    values = {
        "trained": 200,
        "failed_while_learning": 1,
        "late": 50,
        "failed_late": 0,
        "failures": (1,),
        "score_by_late": 548.0,
        "unrevised_failed": 98,
        "score": 550.0,
        "score_low": 549.0,
        "score_high": 551.0,
        "kept": 0.5,
        "mean_change": 0.1,
        "p50_ms": 0.25,
        "p99_ms": 1.0,
        "speed": None,
    }
    if judge not in ("learnt", "counted"):
        values |= {"trained": 0, "failed_while_learning": 0, "late": 0, "failures": ()}
        values["score_by_late"] = None
    return Row(
        task=task,
        controller=controller,
        judge=judge,
        told=told,
        seed=seed,
        episodes=100,
        failed=failed,
        failed_low=share.low,
        failed_high=share.high,
        **{**values, **others},
    )


@pytest.fixture
def found():
    """The learnt judge never fails, the one that is told the dynamics returns a little more."""
    rows = []
    for task, controller in (("acc", "full throttle"), ("pendulum", "random")):
        rows.append(make_row(task, controller, "unrevised", "nothing", failed=98, score=57.0))
        rows.append(make_row(task, controller, "barrier", "dynamics and noise", score=553.0))
        rows += [make_row(task, controller, seed=seed) for seed in SEEDS]
        rows += [make_row(task, controller, "counted", seed=seed, failed=90) for seed in range(5)]
    policies = [
        make_row("cartpole", f"policy: {training}", judge, seed=seed, trained=40, failed=failed)
        for training, judge, failed in (
            ("no filter", "filter off", 2),
            ("filter, no penalty", "filter off", 96),
            ("filter, no penalty", "filter on", 0),
            ("filter, penalty", "filter off", 10),
            ("filter, penalty", "filter on", 0),
        )
        for seed in range(5)
    ]
    return Tasks(Plan(), rows, policies, ("masa-road_1d is left out: it needs masa.",))


@pytest.fixture(name="make_row")
def row_maker():
    """Makes a line of the study."""
    return make_row

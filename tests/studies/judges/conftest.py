"""Rows as the study has them, without running it."""

import pytest

pytest.importorskip("scipy")
pytest.importorskip("gymnasium")

from studies.judges.amounts import PARTS
from studies.judges.plan import Plan
from studies.judges.study import Judges
from studies.old.scores import share_of
from studies.systems.trial import Row

#: Systems of these rows, with their controllers.
SYSTEMS = {
    "acc": ("full throttle",),
    "cartpole": ("random", "hasty"),
    "tanks": ("full",),
    "emergency": ("driver",),
}
SEEDS = range(3)
_SCORES = {"acc": 550.0, "cartpole": 500.0, "tanks": 300.0, "emergency": 0.915}


def make_row(system, controller, judge="learnt", without="", seed=0, failed=0, **others):
    """A line as the study has it; nothing but what is told differs."""
    share = share_of([True] * failed + [False] * (100 - failed))
    values = {
        "trained": 0 if judge == "unrevised" else 50,
        "failed_while_learning": 1,
        "failed_late": 0,
        "unrevised_failed": 98,
        "kept": 0.85,
        "mean_change": 0.1,
        "measure": "mobility" if system == "emergency" else "return",
        "score": _SCORES[system],
        "p50_ms": 0.25,
        "p99_ms": 1.0,
        "speed": None,
    }
    return Row(
        system=system,
        controller=controller,
        judge=judge,
        without=without,
        seed=seed,
        episodes=100,
        failed=failed,
        failed_low=share.low,
        failed_high=share.high,
        **{**values, **others},
    )


@pytest.fixture
def found():
    """The whole judge never fails; without stretches it does in most episodes."""
    rows = []
    for system, controllers in SYSTEMS.items():
        for controller in controllers:
            rows.append(make_row(system, controller, "unrevised", failed=98, kept=1.0))
            for seed in SEEDS:
                rows.append(make_row(system, controller, seed=seed))
                rows += [
                    make_row(system, controller, "learnt", part, seed, _without(part, seed))
                    for part in PARTS
                ]
                if system == "emergency":
                    rows.append(make_row(system, controller, "kinematic", seed=seed, score=0.911))
    return Judges(Plan(), rows)


def _without(part, seed):
    return {"stretches": 80 + 5 * seed, "memory": 60 + 10 * seed}.get(part, 0)

"""The paper's four cases, revised: learnt on them alone, run on to 60 s, and two unseen brakes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from evofsm.driving import Draw, Family, drive, guard_for_family, teach, unrevised
from evofsm.guard import Guard

#: Times of the leader's full brake in two runs that are not learnt from [s], as in the paper.
UNSEEN_BRAKES = (11.0, 15.0)
#: Case 3 is case 1 until its driver changes; from then on it should be left alone [s].
_SETTLED = 16.5


class CaseResult(NamedTuple):
    """One revised run."""

    name: str
    collided: bool
    end: float  #: of the run [s]
    changed: float  #: share of decisions in which the proposal was not executed
    changed_late: float  #: the same from 16.5 s on
    unrevised_collided: bool


def run_cases(family: Family, tolerance: float, seed: int = 0) -> dict[str, list[Any]]:
    """Learn from each case once, while revising; then drive all again with learning frozen."""
    guard = guard_for_family(family, tolerance=tolerance)
    cases = [family.draw(seed, index) for index in range(family.cases)]
    teach(guard, cases)
    frozen = guard.copy(states=False)
    frozen.freeze()
    runs = [(f"case {number}", draw) for number, draw in enumerate(cases, 1)]
    runs += [(f"brake at {time:g} s", _braking_at(cases[0], time)) for time in UNSEEN_BRAKES]
    return {"cases": [_result(family, frozen, name, draw) for name, draw in runs]}


def _braking_at(draw: Draw, time: float) -> Draw:
    leader = replace(draw.scenario.leader, brake_time=time)
    return draw._replace(scenario=replace(draw.scenario, leader=leader))


def _result(family: Family, frozen: Guard, name: str, draw: Draw) -> CaseResult:
    revised, alone = drive(frozen, draw), drive(unrevised(family), draw)
    changed = revised.changed
    late = np.array([decision.situation.time for decision in revised.decisions]) >= _SETTLED
    return CaseResult(
        name,
        revised.episode.collided,
        float(revised.episode.time[-1]),
        float(changed.mean()),
        float(changed[late].mean()) if late.any() else 0.0,
        alone.episode.collided,
    )

"""The machine that saves by itself: ours with the judge that was told nothing but which failed.

It learns from the same draws as ours that is told how cars follow each other, and is tried on the
same held-out ones, as far as it goes: its decisions take longer, so that it has amounts of its own.
Its states are made by the paper's rule; they decide nothing.
"""

from __future__ import annotations

from typing import Any

from evofsm.driving import Family, drive, guard_for_family, held_out, learners_of, training
from evofsm.guard import Guard
from studies.closed_loop.amounts import Amounts
from studies.closed_loop.beside import Check, Stream, check, revised_cases
from studies.closed_loop.course import Course, mobility_of
from studies.closed_loop.stages import Point, until_safe
from studies.policies import Group

#: Its name.
MACHINE = "evofsm-machine"
#: From this training episode on, counted from 0, a collision is a late one.
LATE = 30
# After so many training episodes it is tried.
_CHECKPOINTS = (0, 2, 5, 10, LATE, 100)
# The same for episodes after a shift.
_AFTER = (0, 10, 30)


def trained(plan: Amounts) -> int:
    """Episodes that it learns from."""
    return min(plan.machine_train, plan.train)


def _untaught(family: Family, plan: Amounts, seed: int) -> Guard:
    """As a guard of any system is made; each learning seed draws other random numbers."""
    return guard_for_family(
        family, tolerance=plan.tolerance, judge="learnt", rule=None, seed=plan.seed * 1000 + seed
    )


def run_machine(family: Family, plan: Amounts, seed: int) -> dict[str, list[Any]]:
    """Learn with one seed; test on the way and at the end."""
    guard, train = _untaught(family, plan, seed), trained(plan)
    tests = Course.held_out(family, plan.seed, min(plan.machine_test, plan.test))
    curve: list[Point] = []
    collisions = 0
    draws = training(family, plan.seed, seed, train)
    for episodes in range(train + 1):
        if episodes > 0:
            collisions += drive(guard, next(draws)).collided
        if episodes in {*_CHECKPOINTS, train}:
            outcomes = tests.first(plan.machine_checks).by(guard)
            collided = sum(o.collided for o in outcomes)
            states = learners_of(guard)[0].n_states
            mobility = mobility_of(outcomes)
            tried = len(outcomes)
            curve.append(
                Point(seed, episodes, collided, tried, mobility, states, collisions, MACHINE)
            )
    row = tests.row(
        MACHINE,
        Group.LEARNT,
        tests.by(guard),
        learning_seed=seed,
        train_episodes=train,
        episodes_until_safe=until_safe(curve),
        train_collisions=collisions,
    )
    cases = revised_cases(family, plan, guard, seed) if family.name == "paper" else []
    return {"rows": [row], "curve": curve, "machine_cases": cases}


def run_machine_shift(family: Family, plan: Amounts, seed: int) -> dict[str, list[Any]]:
    """Drive the stream of one learning seed, as `beside.run_shift` does with the others.

    Raises
    ------
    ValueError
        If the family does not shift.
    """
    shifted = family.shifted
    if shifted is None:
        raise ValueError(f"family {family.name!r} has no shift")
    before, after = plan.shift.before, plan.shift.after
    stream = [
        *training(family, plan.seed, seed, before),
        *training(shifted, plan.seed, seed, after, first=before),
    ]
    tried = min(plan.shift.machine_held_out, plan.shift.held_out)
    held, held_shifted = (held_out(now, plan.seed, tried) for now in (family, shifted))
    guard = _untaught(family, plan, seed)
    checks: list[Check] = []
    collided = []
    for place, draw in enumerate(stream, -before):
        if place == 0:
            checks.append(check(MACHINE, seed, -1, guard, held))
        if place in _AFTER:
            checks.append(check(MACHINE, seed, place, guard, held_shifted))
        collided.append(drive(guard, draw).collided)
    return {"streams": [Stream(MACHINE, seed, tuple(collided))], "checks": checks}

"""A guard for cars, and what is done with it in a family: teach it, test it, keep it."""

from __future__ import annotations

from dataclasses import astuple
from typing import Any

from evofsm.driving.family import Family
from evofsm.driving.judge import LatentRisk
from evofsm.driving.leaders import REAL_DRIVES
from evofsm.driving.naming import UNITS, VARIABLES
from evofsm.driving.traffic import TrafficRisk, guard_for_traffic
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.rules import Novelty, StateRule
from evofsm.fsm.validation import positive
from evofsm.guard import (
    BELIEF_TOLERANCE,
    TOLERANCE,
    ActionReviser,
    Guard,
    LearningJudge,
    LearntRisk,
    Mode,
)

#: What each judge is told, by its name.
TOLD: dict[str, str] = {"kinematic": "how cars follow each other", "learnt": "nothing but failures"}

#: The state rule for safety work: fine enough to steer by. The study compares the rules.
SAFETY_RULE = Novelty(radius=1.0, scales=(4.0, 2.0, 2.0))

# What a machine's explanations call soon [s].
_SOON = 5.0


def guard_for_cars(
    low: float,
    high: float,
    interval: float = 0.25,
    *,
    width: float = 0.3,
    tolerance: float = TOLERANCE,
    mode: Mode = Mode.ACT,
    rule: StateRule | None = SAFETY_RULE,
    machine: EvolvingFSM | None = None,
    judge: LearningJudge | str = "kinematic",
    seed: int = 0,
    **settings: Any,
) -> Guard:
    """A guard for a car that follows another.

    It observes gap [m], own speed and the leader's speed [m/s], and decides on the acceleration.

    Parameters
    ----------
    low, high : float
        The hardest braking that can be commanded, negative, and the hardest acceleration [m/s²].
    interval : float
        Time between two decisions [s].
    width : float
        Of an interval of accelerations, for the machine [m/s²].
    tolerance : float
        Highest risk that is accepted, in (0, 1).
    mode : Mode
    rule : StateRule, optional
        Of the machine that is made; None for the paper's.
    machine : EvolvingFSM, optional
        One that has learnt; without it a new one.
    judge : LearningJudge, "kinematic" or "learnt"
        One that has learnt, or which to make: a `LatentRisk`, which is told how cars follow each
        other and learns how hard they brake, or a `LearntRisk`, which is told nothing but which
        episodes failed, and prevents nothing before the first of them.
    seed : int
        Of the judge that is made, where that is a `LearntRisk`.
    **settings
        As in `Guard.of`: ``failed``, ``learn``, ``audit``, ``explaining``, ``shadow``.

    Examples
    --------
    >>> guard = guard_for_cars(low=-4.0, high=2.5)
    >>> guard.decide([150.0, 20.0, 20.0], proposal=0.5).reason
    'never seen before, as far as the states tell; risk is within the tolerance'
    >>> guard = guard_for_cars(low=-4.0, high=2.5, judge="learnt")
    >>> guard.decide([9.0, 20.0, 20.0], proposal=0.5).reason
    'nothing was learnt yet'
    """
    actions = IntervalActions(low, high, width, outside="clip")
    if machine is None and interval >= 2.0 * _SOON:
        raise ValueError(f"{interval:g} s from a decision to the next: too long for cars (in ms?)")
    if judge == "kinematic":
        judge = LatentRisk(actions.low, interval)
    elif judge == "learnt":
        how: dict[str, Any] = {"seed": seed, "names": VARIABLES, "units": UNITS}
        judge = LearntRisk(interval, actions.low, actions.high, **how)
    elif isinstance(judge, str):
        raise ValueError(f"there is no judge {judge!r}; there are {', '.join(TOLD)}")
    machine = machine or EvolvingFSM(
        actions.n_actions,
        rule=rule,
        belief_tolerance=BELIEF_TOLERANCE,
        failure_horizon=round(_SOON / interval),
    )
    reviser = ActionReviser(judge, actions, tolerance=tolerance, mode=mode)
    return Guard.of(reviser, interval=interval, machine=machine, judge=judge, **settings)


def guard_for_family(family: Family, **settings: Any) -> Guard:
    """The same for a family's set of actions and interval; settings as in `guard_for_cars`."""
    low, high, width, _ = astuple(family.actions)
    return guard_for_cars(low, high, family.interval, width=width, **settings)


def learners_of(guard: Guard) -> tuple[EvolvingFSM, LearningJudge]:
    """The machine and the judge of a guard, whichever it has; a TypeError if it lacks one."""
    if guard.machine is None or guard.judge is None:
        raise TypeError("the guard has no machine, or its judge does not learn")
    return guard.machine, guard.judge


def name_judge(judge: LearningJudge) -> str:
    """Which of the judges for cars it is; a TypeError if none."""
    for name, kind in zip(TOLD, (LatentRisk, LearntRisk), strict=True):
        if isinstance(judge, kind):
            return name
    raise TypeError(f"a {type(judge).__name__} is none of the judges for cars: {', '.join(TOLD)}")


# -- Where nobody gave a guard: what is assumed, on a log as beside a stack ------------------------

#: The strongest acceleration that may be proposed where no guard is given [m/s²].
HIGHEST = 2.5
# As hard a leader brakes in full [m/s²].
_FULL = 10.0
#: Leaders' brakes where no guard is given. Nobody brakes in an emergency in public drives, which
#: does not say that nobody does: with the one that a judge assumes anyway one in 20 is in full.
LEADERS = REAL_DRIVES._replace(counts=(*REAL_DRIVES.counts, *(0,) * 14, 3))


def guard_of_monitor(
    interval: float, brakes: float, tolerance: float = TOLERANCE, *, traffic: bool = False
) -> Guard:
    """A guard of car following that is given how hard its car brakes, in shadow mode.

    In ``traffic`` one of any number of objects, who is behind included, that learns nothing.
    """
    lowest, dt = -positive("brakes", brakes), positive("interval", interval)
    ahead = LatentRisk(lowest, dt, decel=brakes, leader_decel=_FULL, leaders=LEADERS)
    how: dict[str, Any] = {"tolerance": tolerance, "mode": Mode.SHADOW}
    if traffic:
        return guard_for_traffic(lowest, HIGHEST, brakes, dt, judge=TrafficRisk(ahead), **how)
    return guard_for_cars(lowest, HIGHEST, dt, judge=ahead, **how)


def assumptions(brakes: float, tolerance: float) -> str:
    """What such a guard reckons with, in a line."""
    share = (1 + LEADERS.counts[-1]) / (1 + sum(LEADERS.counts))
    return (
        f"assumed: the own car brakes with {brakes:g} m/s², at once (--brakes), {share:.0%} of "
        f"leaders' hard brakes are in full ({_FULL:g} m/s²), the others as in public drives ("
        f"{sum(REAL_DRIVES.counts)} are given); a risk of {tolerance:.3g} is accepted (--tolerance)"
    )

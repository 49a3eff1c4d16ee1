"""Episodes of cars under a guard, and what came of them: collisions, distance, comfort."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from evofsm.driving.family import Draw, Family
from evofsm.driving.revisers import Unrevised
from evofsm.driving.scenarios import Scenario, steps_between
from evofsm.driving.world import LEADER_ACCELERATION, SPEED, Drives, Episode, KinematicWorld, World
from evofsm.extras import needs
from evofsm.fsm.proportions import FailureRecord
from evofsm.guard import BoxActions, Guard, run_episode


def drive(
    guard: Guard,
    what: Draw | Scenario,
    world: World | None = None,
    controller: Drives | None = None,
) -> Episode:
    """Drive one scenario under a guard, which learns from it unless it is frozen.

    Parameters
    ----------
    guard : Guard
        Made with the interval between decisions.
    what : Draw or Scenario
    world : World, optional
        Without one, it is driven in closed form.
    controller : Controller or callable, optional
        From an observation to an acceleration [m/s²]; without one, the draw's own drives. Where it
        raises or proposes no number, the guard falls back.

    Raises
    ------
    ValueError
        If nobody drives, the guard's actions are vectors, or its interval is no multiple of the
        scenario's step.

    Examples
    --------
    >>> from evofsm.driving import guard_for_family, load_family
    >>> family = load_family("emergency")
    >>> draw = family.draw(seed=0, index=0)
    >>> [drive(make(family), draw).collided for make in (unrevised_guard, guard_for_family)]
    [True, False]
    """
    scenario = what.scenario if isinstance(what, Draw) else what
    if controller is None and isinstance(what, Draw):
        controller = what.controller
    if controller is None:
        raise ValueError("nobody drives: a Scenario has no controller of its own, so give one")
    if isinstance(guard.actions, BoxActions):
        raise ValueError("the guard's actions are vectors, but a car is driven by one number")
    steps = steps_between(guard.interval, scenario.dt)
    with (world or KinematicWorld()).open(scenario) as road:
        road.every = steps
        decisions = tuple(run_episode(road, guard, controller))
        return replace(road.episode(), decisions=decisions)


def teach(guard: Guard, draws: Iterable[Draw]) -> list[Episode]:
    """Drive each draw in turn, in closed form."""
    return [drive(guard, draw) for draw in draws]


class Reference(NamedTuple):
    """How far the unrevised controller came in a draw, and until when that counts."""

    distance: float  #: [m]
    until: int  #: row of the leader's brake, or of the run's end
    interval: float  #: time between decisions [s]


class Outcome(NamedTuple):
    """One driven draw."""

    collided: bool
    rear_ended: bool
    mobility: float  #: distance, in those of the unrevised controller
    changed: int  #: decisions in which the proposal was not executed
    decisions: int
    change: float  #: sum of the absolute differences of executed and proposed [m/s²]
    jerk: float  #: sum over decisions of the squared jerk [m²/s⁶]
    speed: float  #: mean [m/s]


def unrevised_guard(family: Family) -> Guard:
    """A guard that executes whatever is proposed, and learns nothing."""
    return Guard.of(Unrevised(family.actions), interval=family.interval, learn=False)


def reference_of(family: Family, draw: Draw, world: World | None = None) -> Reference:
    """How far the controller comes by itself in a draw, up to the leader's full brake.

    Parameters
    ----------
    family, draw, world
        As in `drive`.
    """
    alone = drive(unrevised_guard(family), draw, world)
    brake = -draw.scenario.leader.brake_decel
    braking = np.flatnonzero(alone.record[:, LEADER_ACCELERATION] == brake)
    until = int(braking[0]) if len(braking) else len(alone.time) - 1
    return Reference(_distance(alone, until), until, family.interval)


def outcome_of(episode: Episode, unrevised: Reference) -> Outcome:
    """What came of an episode, against the unrevised controller in the same draw."""
    change = np.abs(episode.executed - episode.proposed)
    accelerations = [d.realised for d in episode.decisions if math.isfinite(d.realised)]
    jerk = np.diff(accelerations) / unrevised.interval
    return Outcome(
        episode.collided,
        episode.rear_ended,
        # Where the leader brakes at once there is no way to be kept.
        _distance(episode, unrevised.until) / unrevised.distance if unrevised.distance > 0 else 1.0,
        int(episode.changed.sum()),
        len(episode.decisions),
        float(change[np.isfinite(change)].sum()),  # else there was no usable proposal
        float((jerk**2).sum()),
        float(episode.record[:, SPEED].mean()),
    )


def _distance(episode: Episode, until: int) -> float:
    dt = episode.time[1] - episode.time[0]
    return float(episode.record[: until + 1, SPEED].sum() * dt)


def try_out(
    guard: Guard, family: Family, draws: Sequence[Draw], alone: Sequence[Reference] | None = None
) -> list[Outcome]:
    """What comes of draws under a frozen copy of a guard, against the controller alone.

    The copy has no machine: the same is decided, and nothing is recognised.

    Parameters
    ----------
    guard : Guard
    family : Family
    draws : sequence of Draw
    alone : sequence of Reference, optional
        `reference_of` each draw; without them the controller is driven alone first.

    Examples
    --------
    >>> from evofsm.driving import guard_for_family, held_out, load_family
    >>> family = load_family("emergency")
    >>> outcomes = try_out(guard_for_family(family), family, held_out(family, seed=0, episodes=3))
    >>> [outcome.collided for outcome in outcomes]
    [False, False, False]
    """
    frozen = guard.copy(states=False)
    frozen.freeze()
    alone = alone or [reference_of(family, draw) for draw in draws]
    return [outcome_of(*pair) for pair in zip(teach(frozen, draws), alone, strict=True)]


@dataclass(frozen=True)
class Row:
    """A line of the table: one policy on the held-out draws of a family."""

    family: str
    policy: str
    episodes: int
    collisions: int  #: with the leader; not `rear_ends`
    collision_rate: float
    collision_low: float  #: 95 % interval (Clopper and Pearson 1934)
    collision_high: float
    rear_ends: int
    mobility: float
    mobility_low: float  #: 95 % interval (bootstrap over episodes)
    mobility_high: float
    intervention_rate: float
    mean_change: float  #: [m/s²]
    jerk: float  #: root mean square [m/s³]
    hours: float  #: driven, to complete decisions [h]
    kilometres: float  #: driven by the follower [km]

    @property
    def failures(self) -> FailureRecord:
        """How often it collides, per hour and per 1,000 km, and what that rests on."""
        return FailureRecord(self.collisions, self.hours, self.kilometres, self.episodes)


def summarise(family: str, policy: str, outcomes: Sequence[Outcome], interval: float) -> Row:
    """One line for the outcomes of a policy.

    Parameters
    ----------
    family, policy : str
        What stands in the line.
    outcomes : sequence of Outcome
    interval : float
        Time between two decisions [s].
    """
    with needs("scipy", "study", "the interval of a share"):
        from scipy.stats import binomtest
    n = len(outcomes)
    collisions = sum(o.collided for o in outcomes)
    exact = binomtest(collisions, n).proportion_ci(0.95, method="exact")
    mobility = np.array([o.mobility for o in outcomes])
    # By resampling; the same numbers give the same interval.
    rng = np.random.default_rng(0)
    means = [rng.choice(mobility, n).mean() for _ in range(1000)]
    low, high = np.quantile(means, [0.025, 0.975]).tolist()
    decisions = sum(o.decisions for o in outcomes)
    return Row(
        family=family,
        policy=policy,
        episodes=n,
        collisions=collisions,
        collision_rate=collisions / n,
        collision_low=float(exact.low),
        collision_high=float(exact.high),
        rear_ends=sum(o.rear_ended for o in outcomes),
        mobility=float(mobility.mean()),
        mobility_low=low,
        mobility_high=high,
        intervention_rate=sum(o.changed for o in outcomes) / decisions,
        mean_change=sum(o.change for o in outcomes) / decisions,
        jerk=float(np.sqrt(sum(o.jerk for o in outcomes) / decisions)),
        hours=decisions * interval / 3600.0,
        kilometres=sum(o.speed * o.decisions for o in outcomes) * interval / 1000.0,
    )

"""What came of driving: collisions, distance, interventions, comfort, with their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.framework import Drive
from evofsm.driving.worlds.motion import LEADER_ACCELERATION, SPEED
from evofsm.extras import needs
from evofsm.fsm import FailureRecord

with needs("scipy", "study", "the closed-loop study"):
    from scipy.stats import binomtest


class Reference(NamedTuple):
    """How far the unrevised controller came in a draw, and until when that counts."""

    distance: float  #: [m]
    until: int  #: row of the leader's brake, or of the run's end


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


def reference_of(drive: Drive, brake_decel: float) -> Reference:
    """What an unrevised run is compared by, whose leader's full brake is ``brake_decel`` [m/s²]."""
    braking = np.flatnonzero(drive.episode.record[:, LEADER_ACCELERATION] == -brake_decel)
    until = int(braking[0]) if len(braking) else len(drive.episode.time) - 1
    return Reference(_distance(drive, until), until)


def outcome_of(drive: Drive, unrevised: Reference, interval: float) -> Outcome:
    """What came of a run, against the unrevised controller in the same draw."""
    change = np.abs(drive.executed - drive.proposed)
    jerk = np.diff([d.realised for d in drive.decisions if np.isfinite(d.realised)]) / interval
    return Outcome(
        drive.episode.collided,
        drive.episode.rear_ended,
        # Where the leader brakes at once there is no way to be kept.
        _distance(drive, unrevised.until) / unrevised.distance if unrevised.distance > 0 else 1.0,
        int(drive.changed.sum()),
        len(drive.decisions),
        float(change[np.isfinite(change)].sum()),  # else there was no usable proposal
        float((jerk**2).sum()),
        float(drive.episode.record[:, SPEED].mean()),
    )


def _distance(drive: Drive, until: int) -> float:
    """Driven up to a row [m]."""
    dt = drive.episode.time[1] - drive.episode.time[0]
    return float(drive.episode.record[: until + 1, SPEED].sum() * dt)


@dataclass(frozen=True)
class Row:
    """A line of the table: one policy on the held-out draws of a family."""

    family: str
    policy: str
    group: str
    learning_seed: int | None
    train_episodes: int
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
    mean_speed: float  #: [m/s]
    episodes_until_safe: int | None = None
    train_collisions: int = 0
    hours: float = 0.0  #: driven, to whole decisions [h]
    kilometres: float = 0.0  #: driven by the follower [km]

    @property
    def failures(self) -> FailureRecord:
        """How often it collides, per hour and per 1,000 km, and what that rests on."""
        return FailureRecord(self.collisions, self.hours, self.kilometres, self.episodes)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def summarise(
    family: str,
    policy: str,
    group: str,
    outcomes: Sequence[Outcome],
    interval: float,
    *,
    learning_seed: int | None = None,
    train_episodes: int = 0,
    episodes_until_safe: int | None = None,
    train_collisions: int = 0,
) -> Row:
    """One line for the outcomes of a policy."""
    n = len(outcomes)
    collisions = sum(o.collided for o in outcomes)
    exact = binomtest(collisions, n).proportion_ci(0.95, method="exact")
    mobility = np.array([o.mobility for o in outcomes])
    low, high = bootstrap(mobility)
    decisions = sum(o.decisions for o in outcomes)
    return Row(
        family=family,
        policy=policy,
        group=group,
        learning_seed=learning_seed,
        train_episodes=train_episodes,
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
        mean_speed=float(np.mean([o.speed for o in outcomes])),
        episodes_until_safe=episodes_until_safe,
        train_collisions=train_collisions,
        hours=decisions * interval / 3600.0,
        kilometres=sum(o.speed * o.decisions for o in outcomes) * interval / 1000.0,
    )


def bootstrap(values: NDArray[np.float64], rounds: int = 1000) -> tuple[float, float]:
    """95 % interval of a mean, by resampling; the same numbers give the same interval."""
    rng = np.random.default_rng(0)
    means = [rng.choice(values, len(values)).mean() for _ in range(rounds)]
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)

"""Classic measures of danger, and which situations are dead ends in truth.

Every function takes ``observations``, a (..., 3) ndarray of the gap [m], the speed of the follower
and that of the leader [m/s]; where accelerations matter, a (..., T, 3) one in the order of time.
Every class scores them: above 0 it calls for braking, and most scores are infinite where the cars
have met. What hangs on a number that is NaN, is NaN, but that a row without one before it counts
as one without acceleration. A leader with a negative speed comes towards
oneself. An argument of a class that is not finite and positive raises a ValueError, except where 0
is allowed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.rehearsal import ONCOMING
from evofsm.fsm.validation import Floats, positive
from evofsm.guard import RiskMeasure

_GRAVITY = 9.81


def _columns(observations: Floats) -> Floats:
    return np.moveaxis(np.asarray(observations, dtype=np.float64), -1, 0)


def _acceleration(speed: Floats, dt: float) -> Floats:
    """Mean acceleration since the row before; 0 in a row that has none before it."""
    change = np.diff(speed, prepend=speed[..., :1]) / positive("dt", dt)
    return np.where(np.isnan(change), 0.0, change)


def _time_to_cover(gap: Floats, speed: Floats) -> Floats:
    """[s]; infinite where the speed is not positive, 0 where the gap is not."""
    time = np.asarray(gap + np.inf)  # or NaN
    with np.errstate(over="ignore"):
        np.divide(gap, speed, out=time, where=~(speed <= 0.0))
    return np.where(gap <= 0.0, 0.0, time)


def _way_to_stop(speed: Floats, decel: float) -> Floats:
    """[m]; negative of who drives backwards, as a leader that comes towards oneself."""
    return speed * np.abs(speed) / (2.0 * decel)


def _unsafe_once_met(gap: Floats, score: Floats) -> Floats:
    return np.where(gap <= 0.0, np.inf, score)


class _Measure:
    """A measure whose arguments are positive numbers, or an allowed 0."""

    _may_be_zero: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for field in fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            if not (field.name in self._may_be_zero and value == 0.0):
                positive(f"{type(self).__name__} {field.name}", value)


@dataclass(frozen=True)
class _ShortTime(_Measure):
    """Danger where a time is short: finite also where the time is infinite."""

    threshold: float
    _time: ClassVar[staticmethod[[Floats, float], Floats]]

    def score(self, observations: Floats, dt: float) -> Floats:
        """1 / time − 1 / threshold [1/s]; infinite where the cars have met."""
        time = self._time(observations, dt)
        with np.errstate(divide="ignore", over="ignore"):
            return np.asarray(1.0 / time - 1.0 / self.threshold)


def time_to_collision(observations: Floats) -> Floats:
    """Gap over closing speed [s]: until the cars meet if both kept their speed (Hayward 1972).

    Infinite where the follower is not the faster one, 0 where the cars have met.

    Examples
    --------
    >>> time_to_collision(np.array([[20.0, 25.0, 20.0], [2.0, 20.0, 20.0]]))
    array([ 4., inf])
    """
    gap, speed, leader_speed = _columns(observations)
    return _time_to_cover(gap, speed - leader_speed)


@dataclass(frozen=True)
class TimeToCollision(_ShortTime):
    """Danger where the time to collision is below a ``threshold`` [s]; blind at equal speeds.

    That of 1.5 s is of the Swedish conflict technique (Hydén 1987).
    """

    threshold: float = 1.5
    _time = staticmethod(lambda observations, _: time_to_collision(observations))


def modified_time_to_collision(observations: Floats, dt: float) -> Floats:
    """Time until the cars meet if both kept their acceleration [s] (Ozbay et al. 2008).

    It is the first t > 0 at which Δa·t²/2 + Δv·t = gap, where Δv and Δa are the speed and the
    acceleration of the follower minus the leader's; infinite where there is none, 0 where the cars
    have met. Accelerations are those since the row before, ``dt`` [s] ago, and 0 in the first row.
    As published, it lets cars roll backwards where they would in truth have come to a standstill.
    """
    gap, speed, leader_speed = _columns(observations)
    closing_speed = speed - leader_speed
    ahead = np.where(np.isinf(gap), 0.0, gap)  # to where no one is ahead it takes for ever
    radicand = closing_speed**2 + 2.0 * _acceleration(closing_speed, dt) * ahead
    # Gap over the mean closing speed until then: the first positive root, whatever the sign of Δa.
    mean = np.where(radicand < 0.0, 0, (closing_speed + np.sqrt(np.maximum(radicand, 0.0))) / 2)
    return _time_to_cover(gap, mean)


@dataclass(frozen=True)
class ModifiedTimeToCollision(_ShortTime):
    """Danger where the modified time to collision is below a ``threshold`` [s]."""

    threshold: float = 1.5
    _time = staticmethod(modified_time_to_collision)


def time_headway(observations: Floats) -> Floats:
    """Gap over speed of the follower [s]: until it is where the leader's rear bumper is.

    Infinite where it stands, 0 where the cars have met.
    """
    gap, speed, _ = _columns(observations)
    return _time_to_cover(gap, speed)


@dataclass(frozen=True)
class TimeHeadway(_ShortTime):
    """Danger where the time headway is below a ``threshold`` [s] (Vogel 2003)."""

    threshold: float = 1.0
    _time = staticmethod(lambda observations, _: time_headway(observations))


def deceleration_to_avoid_collision(observations: Floats) -> Floats:
    """Braking with which a leader that keeps its speed is just avoided [m/s²].

    The square of the closing speed over twice the gap; 0 where the follower is not the faster one,
    infinite where the cars have met.
    """
    gap, speed, leader_speed = _columns(observations)
    closing_speed = np.maximum(speed - leader_speed, 0.0)
    decel = np.zeros_like(gap)
    with np.errstate(over="ignore"):
        np.divide(closing_speed**2, 2.0 * gap, out=decel, where=~(gap <= 0.0))
    return _unsafe_once_met(gap, decel)


@dataclass(frozen=True)
class DecelerationToAvoidCollision(_Measure):
    """DRAC (Cooper and Ferguson 1976): danger where it is above a ``threshold`` [m/s²].

    That of 3.35 m/s² is of Archer (2005). It is blind at equal speeds.
    """

    threshold: float = 3.35

    def score(self, observations: Floats, dt: float) -> Floats:
        """Needed deceleration − threshold [m/s²]; infinite where the cars have met."""
        return deceleration_to_avoid_collision(observations) - self.threshold


@dataclass(frozen=True)
class ResponsibilitySensitiveSafety(_Measure):
    """RSS (Shalev-Shwartz et al. 2017, arXiv:1708.06374), its longitudinal part.

    Danger where the gap is shorter than the safe distance: the follower accelerates by ``accel`` at
    most for a ``response`` [s], both of which may be 0, and is sure to brake by ``decel`` then, the
    leader by ``leader_decel`` at most [m/s²].

    Examples
    --------
    >>> rss = ResponsibilitySensitiveSafety(0.5, 2.0, decel=5.0, leader_decel=8.0)
    >>> rss.score(np.array([[50.0, 20.0, 20.0], [25.0, 20.0, 20.0]]), dt=0.1)
    array([-20.65,   4.35])
    """

    response: float
    accel: float
    decel: float
    leader_decel: float

    _may_be_zero = ("response", "accel")

    @classmethod
    def r157(cls) -> Self:
        """Constants with which RSS was compared for UN Regulation No. 157.

        Response 0.75 s, acceleration 3 m/s², 6 m/s² of braking for both cars, as in the published
        implementation (JRC-FSM) behind Mattas et al. (2022), Accident Analysis & Prevention 174.
        """
        return cls(response=0.75, accel=3.0, decel=6.0, leader_decel=6.0)

    @classmethod
    def matched(cls, decel: float, leader_decel: float) -> Self:
        """Given what both cars can truly do [m/s²]; responding at the next decision, in 0.25 s."""
        return cls(0.25, 2.5, decel, leader_decel)

    def score(self, observations: Floats, dt: float) -> Floats:
        """Safe distance − gap [m]; infinite where the cars have met."""
        gap = _columns(observations)[0]
        return _unsafe_once_met(gap, self.safe_distance(observations) - gap)

    def safe_distance(self, observations: Floats) -> Floats:
        """Gap from which the follower can still stop behind a leader that brakes in full [m].

        v·ρ + a·ρ²/2 + (v + ρ·a)² / (2·decel) − v_leader² / (2·leader_decel), or 0 if that is
        negative, where v is the follower's speed, ρ the ``response`` and a ``accel``. A leader that
        comes towards oneself needs the same as the follower; the safe distance is the sum.
        """
        _, speed, leader_speed = _columns(observations)
        leader_way = _way_to_stop(leader_speed, self.leader_decel)
        approach = self._stopping_distance(-leader_speed)
        leader_way = np.where(leader_speed < ONCOMING, -approach, leader_way)
        return np.asarray(np.maximum(self._stopping_distance(speed) - leader_way, 0.0))

    def _stopping_distance(self, speed: Floats) -> Floats:
        fastest = speed + self.response * self.accel
        return (speed + fastest) / 2.0 * self.response + _way_to_stop(fastest, self.decel)


@dataclass(frozen=True)
class PerformanceModel(_Measure):
    """Danger where a driver of UN Regulation No. 157 could not avoid the collision any more.

    It brakes by ``decel`` [m/s²] after a ``reaction`` [s], which may be 0, behind a leader that
    keeps its speed, for which it needs closing² / (2·decel) + closing·reaction. The regulation
    (5.2.5.2 and Annex 4, Appendix 3) compares times to collision; here they are multiplied by the
    closing speed, so that the score is a distance and defined at any speeds.

    Examples
    --------
    >>> observations = np.array([[15.0, 30.0, 18.0], [17.0, 30.0, 18.0]])
    >>> PerformanceModel.regulation().score(observations, dt=0.1)
    array([ 1.2, -0.8])
    """

    reaction: float
    decel: float

    _may_be_zero = ("reaction",)

    @classmethod
    def regulation(cls) -> Self:
        """The minimum for a car that cuts in, paragraph 5.2.5.2: 0.35 s and 6 m/s²."""
        return cls(reaction=0.35, decel=6.0)

    @classmethod
    def careful_human(cls) -> Self:
        """The competent and careful human driver of Annex 4 Appendix 3: 0.75 s and 0.774 g.

        Its 0.6 s from the first to full braking are left out.
        """
        return cls(reaction=0.75, decel=0.774 * _GRAVITY)

    def score(self, observations: Floats, dt: float) -> Floats:
        """Distance to avoid the collision − gap [m]; infinite where the cars have met."""
        gap, speed, leader_speed = _columns(observations)
        closing_speed = np.maximum(speed - leader_speed, 0.0)
        distance = closing_speed**2 / (2.0 * self.decel) + closing_speed * self.reaction
        return _unsafe_once_met(gap, distance - gap)


def _membership(gap: Floats, unsafe: Floats, safe: Floats) -> Floats:
    """1 below ``unsafe``, 0 from ``safe`` on, and linear in between."""
    member = np.asarray(gap < unsafe, dtype=np.float64)
    np.divide(safe - gap, safe - unsafe, out=member, where=~((gap < unsafe) | (gap >= safe)))
    return member


@dataclass(frozen=True)
class FuzzySafety(_Measure):
    """Danger where the Fuzzy Safety Model of UN Regulation No. 157 begins to brake.

    It brakes gently before it must brake hard (Mattas et al. 2020, Accident Analysis & Prevention
    148; 2022, the same 174).

    After a ``reaction`` [s] the follower brakes, comfortably or, not weaker, by ``decel`` [m/s²].
    The ``margin`` [m] is to be left at standstill, and once more before it must brake. These two
    may be 0. The model brakes the harder the more dangerous it is.

    Examples
    --------
    >>> FuzzySafety().score(np.array([[60.0, 20.0, 20.0], [25.0, 20.0, 20.0]]), dt=0.1).round(3)
    array([0.   , 0.827])
    """

    reaction: float = 0.75
    comfortable_decel: float = 4.0
    decel: float = 6.0
    leader_decel: float = 7.0
    margin: float = 2.0

    _may_be_zero = ("reaction", "margin")

    def score(self, observations: Floats, dt: float) -> Floats:
        """The larger one of PFS and CFS; 1 where the cars have met."""
        return np.maximum(self.proactive(observations), self.critical(observations, dt))

    def proactive(self, observations: Floats) -> Floats:
        """PFS, how unsafe the gap is should the leader brake in full (Mattas et al. 2020).

        With the distance s(b) = v·reaction + v² / (2·b) − v_leader² / (2·leader_decel), it is 1,
        unsafe, for gap − margin below s(decel) and where the cars have met, 0 above
        s(comfortable_decel) + margin, and linear in between.
        """
        gap, speed, leader_speed = _columns(observations)
        common_distance = speed * self.reaction - _way_to_stop(leader_speed, self.leader_decel)
        unsafe = common_distance + _way_to_stop(speed, self.decel)
        safe = common_distance + _way_to_stop(speed, self.comfortable_decel) + self.margin
        return np.where(gap <= 0.0, 1.0, _membership(gap - self.margin, unsafe, safe))

    def critical(self, observations: Floats, dt: float) -> Floats:
        """CFS, how unsafe the gap is while the follower closes in on a leader that keeps its speed.

        Until it reacts, the follower keeps its acceleration (since the row before, ``dt`` [s] ago),
        or brakes comfortably where it brakes harder than that. If it is then still the faster one,
        CFS is 1, unsafe, for gaps from which ``decel`` would not do, 0 for gaps from which
        ``comfortable_decel`` does, and linear in between. If not, it is 1 for gaps from which the
        present braking does not do, and 0 else; 1 where the cars have met.
        """
        gap, speed, leader_speed = _columns(observations)
        closing_speed, comfortable = speed - leader_speed, self.comfortable_decel
        accel = _acceleration(speed, dt)
        later = closing_speed + np.maximum(accel, -comfortable) * self.reaction
        gap_loss = (closing_speed + later) / 2.0 * self.reaction
        approaches = ~(closing_speed <= 0.0)
        slows = approaches & (later < 0.0)
        # What the present braking needs until the speeds are equal.
        present = np.zeros_like(gap)
        np.divide(closing_speed**2, -2.0 * accel, out=present, where=slows)
        unsafe = np.where(slows, present, gap_loss + later**2 / (2.0 * self.decel))
        safe = np.where(slows, present, gap_loss + later**2 / (2.0 * comfortable))
        critical = np.where(approaches, _membership(gap, unsafe, safe), 0.0)
        return np.where(gap <= 0.0, 1.0, critical)


#: Measures with the constants of their sources, by the names of their revisers.
FIXED_MEASURES: Mapping[str, RiskMeasure] = {
    "aeb-ttc": TimeToCollision(),
    "mttc": ModifiedTimeToCollision(),
    "drac": DecelerationToAvoidCollision(),
    "headway": TimeHeadway(),
    "rss-r157": ResponsibilitySensitiveSafety.r157(),
    "r157-regulation": PerformanceModel.regulation(),
    "r157-careful": PerformanceModel.careful_human(),
    "fuzzy": FuzzySafety(),
}


def is_dead_end(observations: Floats, decel: float, leader_decel: float) -> NDArray[np.bool_]:
    """Whether the cars collide if both brake in full from now until standstill.

    Only a simulation knows both limits. It scores what was learnt; nothing learns from it. False
    where a number is NaN.

    Parameters
    ----------
    observations : (..., 3) ndarray
        As in all of these.
    decel, leader_decel : float
        The hardest braking of the follower and of the leader [m/s²], positive.

    Examples
    --------
    >>> is_dead_end(np.array([[30.0, 20.0, 20.0], [25.0, 20.0, 20.0]]), 4.0, 9.0)
    array([False,  True])
    """
    gap, speed, leader_speed = _columns(observations)
    final_gap = gap + _way_to_stop(leader_speed, leader_decel) - _way_to_stop(speed, decel)
    smallest = np.minimum(gap, final_gap)
    # A follower who brakes harder is nearest when the speeds meet, if both still move then.
    if decel > leader_decel:
        meeting_time = (speed - leader_speed) / (decel - leader_decel)
        are_moving = (meeting_time > 0.0) & (meeting_time < leader_speed / leader_decel)
        nearest = gap - (speed - leader_speed) ** 2 / (2 * (decel - leader_decel))
        smallest = np.where(are_moving, np.minimum(smallest, nearest), smallest)
    return np.asarray(smallest <= 0.0)

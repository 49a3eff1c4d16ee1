"""Cars that are guarded in a simulation of someone else's.

SUMO goes on driving them. A guard says how hard a car may accelerate in the next step, at most;
where that is less than its own driver might want, the speed is set, and SUMO still minds all else:
red lights, right of way, stops. What a driver wanted shows in what SUMO does; only where it is held
back, its car-following model is asked.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.attached.seen import Neighbour, Seeing
from evofsm.driving.naming import VARIABLES
from evofsm.driving.risk.latent import LatentRisk
from evofsm.driving.risk.manoeuvres import BrakeWatch, Manoeuvres
from evofsm.driving.traffic import Role, TrafficRisk, guard_for_traffic
from evofsm.guard import ActionReviser, Guard, Mode, Revision

# Leaders are assumed to brake so hard until they were seen to: SUMO's emergencyDecel [m/s²].
_LEADER_DECEL = 9.0
# A speed that is lower by no more is what the driver wanted [m/s].
_SAME = 1e-6
# SUMO's speed mode where a guard acts: no faster than safe, nor than the car can accelerate (bits 0
# and 1), but braking as hard as it has to (bit 2). Red lights and right of way stay as they were.
_ON, _OFF = 0b011, 0b100


class Told(NamedTuple):
    """What a guard said of a car for one step, and what came of it."""

    time: float  #: at which it was decided [s]
    car: str
    wish: float  #: acceleration that the car's own driver wanted [m/s²]
    deed: float  #: acceleration that it had [m/s²]
    revision: Revision
    other: str  #: the car that the risk is of; empty where there is none
    role: Role | None  #: where that one is


@dataclass(eq=False)
class _Car:
    id: str
    guard: Guard
    high: float  # the hardest acceleration
    mode: int | None = None  # SUMO's speed mode before it was taken over
    leader: str = ""
    speed: float = 0.0
    limit: float = 0.0  # the speed that was set
    wish: float = 0.0  # the speed that its model wants instead
    time: float = 0.0
    seen: NDArray[np.float64] | None = None  # what is decided on
    around: tuple[Neighbour | None, Neighbour | None] = (None, None)
    revision: Revision | None = None
    about: tuple[str, Role | None] = ("", None)


class Guarding:
    """Guards each car, by a guard of its own; what leaders do all of them share.

    Attributes
    ----------
    leaders : Manoeuvres
        How hard leaders were seen to brake.
    decisions : int
    revised : int
        Steps in which a car drove slower than its driver wanted; in shadow, would have.
    latest : dict from str to Told
        What was said last of each car that is there.
    """

    def __init__(
        self,
        sumo: Any,
        seeing: Seeing,
        guard: Guard | None,
        *,
        acts: bool,
        tolerance: float,
        learn: bool,
        tell: Callable[[Told], None] | None,
    ) -> None:
        self._vehicle, self._seeing, self._acts, self._tell = sumo.vehicle, seeing, acts, tell
        self._template, self._tolerance, self._learn = guard, tolerance, learn
        self._judges: dict[tuple[float, float, float], TrafficRisk] = {}
        self._cars: dict[str, _Car] = {}
        self._watches: dict[str, BrakeWatch] = {}
        self.leaders = _leaders_of(guard)
        if guard is not None:
            self._tolerance = guard.reviser.tolerance  # type: ignore[attr-defined]
        self.interval = seeing.dt if guard is None or guard.interval is None else guard.interval
        self._every = _steps(self.interval, seeing.dt)
        self._steps = 0
        self.decisions = self.revised = 0
        self.latest: dict[str, Told] = {}

    def __len__(self) -> int:
        return len(self._cars)

    def __iter__(self) -> Any:
        return iter(self._cars)

    def add(self, car: str) -> None:
        """Guard it from now on."""
        high = self._vehicle.getAccel(car)
        guard = self._guard_for(car, high)
        # What a guard cannot allow either way it does not forbid.
        self._cars[car] = _Car(car, guard, min(high, guard.actions.high))

    def remove(self, car: str) -> None:
        """Guard it no longer: it is handed back."""
        one = self._cars.get(car)
        if one is not None:
            self._hand_back(one)
        self.leave(car)

    def leave(self, car: str) -> None:
        """It has left the simulation."""
        self._cars.pop(car, None)
        self.latest.pop(car, None)

    def urgency(self) -> dict[str, int]:
        """0 to 2 of each car: free, held back, or at a risk that is not tolerable."""
        return {car: self._urgency(self.latest.get(car)) for car in self._cars}

    def _urgency(self, told: Told | None) -> int:
        if told is None:
            return 0
        if told.revision.risk_executed > self._tolerance:
            return 2
        return int(told.deed < told.wish - _SAME)

    def step(self, time: float) -> int:
        """Say what came of the step that is over, and decide on the next; returns how often."""
        decides = self._steps % self._every == 0
        self._steps += 1
        seen_leaders: dict[str, float] = {}
        before = self.decisions
        for one in self._cars.values():
            speed = self._vehicle.getSpeed(one.id)
            if one.seen is not None:
                self._look_back(one, speed)
            if decides:
                self._look(one, speed, time)
                if one.around[0] is not None:
                    seen_leaders[one.around[0].id] = one.around[0].speed
                if one.seen is not None and self._acts:
                    self._decide(one, one.high)
            one.speed, one.time = speed, time
            if self._acts:
                self._act(one, speed)
        if decides and self._learn:
            self._watch(seen_leaders)
        return self.decisions - before

    # -- A step ---------------------------------------------------------------------------------

    def _look(self, one: _Car, speed: float, time: float) -> None:
        """See what is around; without anybody, a guard of one leader has nothing to decide on."""
        ahead = self._seeing.ahead(one.id, speed)
        scene = isinstance(one.guard.reviser.risk, TrafficRisk)  # type: ignore[attr-defined]
        # Who is behind matters only where one brakes: if acting, because somebody is ahead.
        alone = ahead is None and self._acts
        behind = self._seeing.behind(one.id, speed) if scene and not alone else None
        one.around = ahead, behind
        leader = "" if ahead is None else ahead.id
        if leader != one.leader:  # what is known of the one before does not hold of this one
            one.leader = leader
            one.guard.begin()
        one.revision = None
        if ahead is None and behind is None:
            one.seen = None
        elif scene:
            one.seen = self._seeing.rows(one.id, speed, ahead, behind)
        else:
            assert ahead is not None
            one.seen = np.array([ahead.room, speed, ahead.speed])

    def _decide(self, one: _Car, proposal: float) -> None:
        assert one.seen is not None
        one.revision = one.guard.decide(one.seen, proposal)
        self.decisions += 1
        judge = one.guard.reviser.risk  # type: ignore[attr-defined]
        if isinstance(judge, TrafficRisk) and judge.worst is not None:
            other = one.around[judge.worst.number - 1]
            one.about = ("" if other is None else other.id, judge.worst.role)
        else:
            one.about = one.leader, Role.AHEAD if one.leader else None

    def _act(self, one: _Car, speed: float) -> None:
        """Set the speed, where the guard allows less than the car might want."""
        revision = one.revision
        if revision is None or revision.executed >= one.high:
            self._hand_back(one)
            return
        if one.mode is None:
            one.mode = self._vehicle.getSpeedMode(one.id)
            self._vehicle.setSpeedMode(one.id, one.mode & ~_OFF | _ON)
        reached = max(0.0, speed + float(revision.executed) * self._seeing.dt)
        # Nor faster than it would drive on a free road.
        one.limit = min(reached, self._vehicle.getAllowedSpeed(one.id))
        one.wish = self._seeing.wish(one.id, speed, one.around[0])
        self._vehicle.setSpeed(one.id, one.limit)

    def _hand_back(self, one: _Car) -> None:
        if one.mode is not None:
            self._vehicle.setSpeed(one.id, -1.0)
            self._vehicle.setSpeedMode(one.id, one.mode)
            one.mode = None

    def _look_back(self, one: _Car, speed: float) -> None:
        """What the driver wanted, now that it shows; in shadow it is what is judged."""
        wanted = speed
        # Slower than the limit is what SUMO itself wanted, such as to stop at a red light.
        if one.mode is not None and speed >= one.limit - _SAME:
            wanted = max(one.wish, speed)
        wish, deed = ((each - one.speed) / self._seeing.dt for each in (wanted, speed))
        if not self._acts and one.revision is None:
            self._decide(one, wish)
        revision = one.revision
        assert revision is not None
        if self._acts:
            self.revised += speed < wanted - _SAME
        else:
            self.revised += bool(revision.advised < wish - _SAME)
        told = Told(one.time, one.id, wish, deed, revision, *one.about)
        self.latest[one.id] = told
        if self._tell is not None:
            self._tell(told)

    def _watch(self, speeds: dict[str, float]) -> None:
        """Learn how hard leaders brake, each by itself, whoever follows it."""
        for leader, speed in speeds.items():
            watch = self._watches.get(leader)
            if watch is None:
                watch = self._watches[leader] = BrakeWatch(self.interval)
            self._remember(watch.see(0.0, speed, speed))
        for leader in sorted(self._watches.keys() - speeds.keys()):
            self._remember(self._watches.pop(leader).end())

    def _remember(self, decel: float | None) -> None:
        if decel is not None:
            self.leaders.remember(decel)

    # -- Guards ---------------------------------------------------------------------------------

    def _guard_for(self, car: str, high: float) -> Guard:
        mode = Mode.ACT if self._acts else Mode.SHADOW
        if self._template is None:
            vehicle = self._vehicle
            decel = vehicle.getDecel(car)
            low = -max(vehicle.getEmergencyDecel(car), decel)
            judge = self._judge_for(low, high, decel)
            dt, tolerated = self.interval, self._tolerance
            return guard_for_traffic(
                low, high, decel, dt, judge=judge, tolerance=tolerated, mode=mode
            )
        guard = self._template.copy()
        guard.freeze()
        reviser = guard.reviser
        assert isinstance(reviser, ActionReviser)
        reviser.mode = mode
        latent = reviser.risk.ahead if isinstance(reviser.risk, TrafficRisk) else reviser.risk
        if isinstance(latent, LatentRisk):
            latent.manoeuvres = self.leaders
        return guard

    def _judge_for(self, low: float, high: float, decel: float) -> TrafficRisk:
        """One for all cars that can do the same: it remembers nothing of any."""
        judge = self._judges.get((low, high, decel))
        if judge is None:
            judge = TrafficRisk.told(low, high, decel, self.interval, leader_decel=_LEADER_DECEL)
            judge.ahead.manoeuvres = self.leaders
            self._judges[low, high, decel] = judge
        return judge


def _leaders_of(guard: Guard | None) -> Manoeuvres:
    """What a guard knows of leaders; what is assumed without one."""
    if guard is None:
        return Manoeuvres(_LEADER_DECEL)
    if not isinstance(guard.reviser, ActionReviser):
        raise TypeError(f"the guard has a {type(guard.reviser).__name__}; it needs a judge")
    judge = guard.reviser.risk
    if isinstance(judge, TrafficRisk):
        return copy.deepcopy(judge.ahead.manoeuvres)
    if judge.labels.names != VARIABLES:
        raise ValueError(
            f"the guard's judge observes {judge.labels.names or 'unnamed variables'}; it must be a "
            f"TrafficRisk, or observe {', '.join(VARIABLES)}"
        )
    if isinstance(judge, LatentRisk):
        return copy.deepcopy(judge.manoeuvres)
    return Manoeuvres(_LEADER_DECEL)


def _steps(interval: float, dt: float) -> int:
    """Decision interval in steps of the simulation."""
    steps = round(interval / dt)
    if steps < 1 or abs(steps * dt - interval) > 1e-9 * steps:
        raise ValueError(
            f"the guard decides every {interval:g} s, which is no multiple of the simulation's "
            f"step of {dt:g} s"
        )
    return steps

"""Attach guards to a running SUMO simulation, or only watch: which cars, and what came of it.

A guard says how hard a car may accelerate in the next step, at most; where that is less than its
own driver might want, the speed is set, and SUMO still minds all else: red lights, right of way,
stops. What a driver wanted shows in what SUMO does; only where it is held back, its car-following
model is asked.

SUMO's ``getLeader`` and ``getFollower`` take off minGap of whoever follows; where it counts a
collision before the bumpers touch (``--collision.mingap-factor``), the gap ends there.
"""

from __future__ import annotations

import math
import time as clock
import warnings
import weakref
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from hashlib import blake2b
from importlib import import_module
from itertools import chain, count
from typing import Any, NamedTuple

import numpy as np

from evofsm.driving.judge import REGAIN, SLIGHT, STANDS, LatentRisk
from evofsm.driving.leaders import BrakeWatch, Manoeuvres
from evofsm.driving.measures import deceleration_to_avoid_collision, time_to_collision
from evofsm.driving.naming import VARIABLES
from evofsm.driving.scenarios import steps_between
from evofsm.driving.traffic import COLUMNS, Role, TrafficRisk, guard_for_traffic
from evofsm.fsm.validation import Floats
from evofsm.guard import TOLERANCE, ActionJudge, ActionReviser, Guard, Mode, Revision

# What is done with the chosen cars.
_MODES = ("act", "shadow", "watch")
_TYPE = "type:"
# What is seen is so exact [m/s²].
_SEEN_TO = 0.05
# Braking harder than this is hard [m/s²].
_HARD = 5.0
# Clocks of SUMO count thousandths; two times that differ by less are one [s].
_TICK = 5e-4
_SKIPPED = (
    "SUMO went on by several steps at once (simulationStep with a time, or loadState), in which no "
    "guard looked or acted and no collision was counted; cars begin anew. Go on step by step"
)
_OVERRULED = (
    "car {} drove otherwise than its guard, or its own driver, had it: a script (setSpeed, "
    "slowDown) or a device of SUMO set its speed. It is left to that, unguarded: a slower one "
    "until it drives faster, a faster one while that shows. So is every such car"
)
# Speeds that differ by more are not the same [m/s].
_DIFFERS = 1e-3
_MESOSCOPIC = (
    "this is SUMO's mesoscopic simulation (--mesosim), in which no car has a leader, so that a "
    "guard would see nobody. Attach to a microscopic one, without --mesosim"
)
_UNCOUNTED = (
    "with --collision.action none SUMO looks for no collisions, so that none can be counted; "
    "choose another, such as warn"
)
_ANOTHER = (
    "another simulation has begun, and what was attached to the one before goes on in it, guards "
    "as well as counts; where it is to end, call detach() before close()"
)
_NUMBERS = count()
_ATTACHED: weakref.WeakSet[Attachment] = weakref.WeakSet()
# Two that touched within this time before still do [s].
_SAME_COLLISION = 5.0
# How far one looks at least [m]; further by what it takes to stop.
_LOOKS_AHEAD, _GENTLE = 30.0, 3.0
_CAR_WIDTH = 1.8
# Nobody is nearer in what is judged [m]. SUMO keeps minGap itself: what is kept beside it [m].
_NEAREST, _MARGIN = 0.01, 0.1
# Limits are as coarse as that [m/s²], and so far a driver may want more.
_COARSE = 0.3
# A speed that differs by no more is the same [m/s].
_SAME_SPEED = 1e-6
# SUMO's speed mode where a guard acts: no faster than safe, nor than the car can accelerate (bits 0
# and 1), and where a guard asks for more than its `decel` (bit 2 off), SUMO may brake it as hard as
# it likes, harder than it can. Red lights and right of way stay as they were.
_ON, _OFF = 0b011, 0b100


class Neighbour(NamedTuple):
    """Another car in one's lane."""

    id: str
    gap: float  #: from bumper to bumper [m]
    room: float  #: what is left of it until SUMO counts a collision, in its step [m]
    speed: float  #: [m/s]
    most: float  #: the same, if the follower stands after whole steps [m]


class _Facts(NamedTuple):
    length: float  #: [m]
    min_gap: float  #: [m]
    accel: float  #: [m/s²]
    decel: float  #: [m/s²]
    hardest: float  #: braking [m/s²]
    tau: float  #: [s]
    late: bool  #: whether it decides less often than in each step, and than its ``tau``

    @property
    def strength(self) -> tuple[float, float, float]:
        """What a guard counts on: its ``decel``, hardest braking and ``accel``."""
        return self.decel, self.hardest, self.accel


class Seeing:
    """Reads the cars around one of them, by libsumo or traci."""

    def __init__(self, sumo: Any) -> None:
        self._vehicle, self._simulation = sumo.vehicle, sumo.simulation
        self._type = sumo.vehicletype
        self._types: dict[str, str] = {}
        self._bodies: dict[str, _Facts] = {}
        try:
            sumo.simulation.getTime()
        except _module(sumo).FatalTraCIError as error:
            raise ValueError("no simulation of SUMO runs; start one, then attach") from error
        self.look_up()

    def look_up(self) -> None:
        """Look up what holds in this simulation."""
        simulation = self._simulation
        if str(simulation.getOption("mesosim")).lower() in ("true", "1"):
            raise ValueError(_MESOSCOPIC)
        #: Whether SUMO looks for collisions.
        self.counts = str(simulation.getOption("collision.action")) != "none"
        factor = float(simulation.getOption("collision.mingap-factor"))
        # Share of minGap that SUMO wants kept; below 0 each model has its own, at most all of it.
        self._factor = factor if factor >= 0.0 else 1.0
        #: Time of a step [s].
        self.dt = float(simulation.getDeltaT())
        ballistic = str(simulation.getOption("step-method.ballistic")).lower() in ("true", "1")
        # In SUMO's Euler step a car drives all of it at the speed of its end. Against what is
        # rehearsed, a faster follower gets less far by half a step's worth of the difference, and a
        # slower one further; whoever comes to a standstill amid a step gets further, too, by up to
        # an eighth of its braking over the square of the step (`_further`).
        self.euler = 0.0 if ballistic else self.dt
        self.look_again()

    def look_again(self) -> None:
        """Look at the cars anew: in another step a script may have changed them, or their types."""
        self._types.clear()
        self._bodies.clear()

    def meet(self, car: str) -> None:
        """With an actionStepLength in any type SUMO steps ballistically, and no option says so.

        Cars are asked, no types: one may be a distribution, of which SUMO would draw.
        """
        if self._vehicle.getActionStepLength(car) > self.dt + _TICK:
            self.euler = 0.0

    def kind(self, car: str) -> str:
        """Its type; what a script changes of one car makes that a type of its own."""
        return self._types.get(car) or self._types.setdefault(car, self._vehicle.getTypeID(car))

    def body(self, car: str) -> _Facts:
        """Of a car, by its type."""
        if (kind := self.kind(car)) not in self._bodies:
            of = self._type
            decel, tau = of.getDecel(kind), of.getTau(kind)
            late = of.getActionStepLength(kind) > max(self.dt, tau) + _TICK
            brakes = decel, max(of.getEmergencyDecel(kind), decel)
            facts = of.getLength(kind), of.getMinGap(kind), of.getAccel(kind), *brakes, tau, late
            self._bodies[kind] = _Facts(*facts)
        return self._bodies[kind]

    def pair(self, car: str) -> tuple[float, float, float] | None:
        """Gap from bumper to bumper [m], its speed and that of whoever is ahead [m/s].

        Negative is the speed of who comes towards it, where either of them overtakes.
        """
        speed, angle = self._vehicle.getSpeed(car), self._vehicle.getAngle
        if (leader := self.neighbour(car, speed)) is None:
            return None
        is_oncoming = math.cos(math.radians(angle(car) - angle(leader.id))) < -0.5
        return leader.gap, speed, -leader.speed if is_oncoming else leader.speed

    def neighbour(self, car: str, speed: float, *, is_ahead: bool = True) -> Neighbour | None:
        """Whoever is ahead on its route, or behind, if near enough to matter."""
        find = self._vehicle.getLeader if is_ahead else self._vehicle.getFollower
        reach = _LOOKS_AHEAD + speed + 0.5 * speed * speed / _GENTLE
        neighbour, gap = find(car, reach) or ("", 0.0)
        if not neighbour:
            return None
        v, euler = self._vehicle.getSpeed(neighbour), self.euler
        cars, speeds = (car, neighbour), (speed, v)
        follower, leader = map(self.body, cars if is_ahead else cars[::-1])
        v_follower, v_leader = speeds if is_ahead else speeds[::-1]
        # Who is nearer than SUMO lets anybody be stands in a queue, or beside, where lanes merge.
        # Across a junction SUMO says 0 of all that is nearer than minGap.
        spare_gap = (1.0 - self._factor) * follower.min_gap if gap else 0.0
        room = gap + spare_gap + 0.5 * euler * (v_follower - v_leader)
        late = 0.125 * follower.decel * euler * euler  # at most, whatever the follower does
        most = room + _further(v_leader, leader.decel, euler)
        return Neighbour(neighbour, gap + follower.min_gap, max(room - late, _NEAREST), v, most)

    def wish(self, car: str, speed: float, ahead: Neighbour | None) -> float:
        """The speed that a car's own model wants after the next step [m/s], but for red lights."""
        vehicle, body = self._vehicle, self.body(car)
        # Where a speed limit drops, SUMO's cars brake no harder than by their `decel`.
        free = max(vehicle.getAllowedSpeed(car), speed - body.decel * self.dt)
        fastest = min(free, speed + body.accel * self.dt)
        if ahead is None:
            return float(fastest)
        gap = ahead.gap - body.min_gap  # as SUMO's models take it
        decel = vehicle.getApparentDecel(ahead.id)
        follow_speed = vehicle.getFollowSpeed(car, speed, gap, ahead.speed, decel, ahead.id)
        slowest = speed - body.hardest * self.dt
        return float(max(min(follow_speed, fastest), slowest, 0.0))

    def rows(
        self, car: str, speed: float, ahead: Neighbour | None, behind: Neighbour | None
    ) -> Floats:
        """The scene as `Scene.rows` has it, x counted from the front bumper of the car."""
        rows = np.zeros((3, len(COLUMNS)))  # oneself, ahead and behind
        length = self.body(car).length
        rows[0] = 1.0, -0.5 * length, 0.0, speed, 0.0, length, _CAR_WIDTH, 0.0
        for row, near, from_, way in ((rows[1], ahead, 0.0, 1.0), (rows[2], behind, -length, -1.0)):
            if near is not None:
                long, ax = self.body(near.id).length, self._vehicle.getAcceleration(near.id)
                x = from_ + way * (near.room + 0.5 * long)
                row[:] = 1.0, x, 0.0, near.speed, 0.0, long, _CAR_WIDTH, ax
        return rows.ravel()


class GuardedStep(NamedTuple):
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
    body: _Facts
    mode: int | None = None  # SUMO's speed mode before it was taken over
    taken: int = 0  # and since then
    speed: float = 0.0
    limit: float = 0.0  # the speed that was set
    wish: float = 0.0  # the speed that its model wants instead
    script: float = math.nan  # the speed that something else set, as far as that shows
    time: float = 0.0
    seen: Floats | None = None  # what is decided on
    around: tuple[Neighbour | None, Neighbour | None] = (None, None)
    revision: Revision | None = None
    about: tuple[str, Role | None] = ("", None)

    @property
    def high(self) -> float:
        """The hardest acceleration; what a guard cannot allow either way it does not forbid."""
        high: Any = self.guard.actions.high
        return float(min(self.body.accel, high))


def _module(sumo: Any) -> Any:
    """Where its classes are: a connection of traci has none, such as for where none runs."""
    return sumo if hasattr(sumo, "FatalTraCIError") else import_module("traci")


def _further(speed: float, decel: float, euler: float) -> float:
    """So much further a car gets until it stands [m], as that is amid an Euler step [s]."""
    if not euler:
        return 0.0
    part = speed / (decel * euler) % 1.0
    return 0.5 * decel * euler * euler * part * (1.0 - part)


class Guarding:
    """Guards each car, by a guard of its own; what leaders do they share, unless given a guard.

    A leader is taken to brake by the ``decel`` that SUMO says of it, until enough with the same one
    were seen to brake harder.
    """

    def __init__(
        self,
        sumo: Any,
        seeing: Seeing,
        guard: Guard | None,
        acts: bool,
        tolerance: float,
        regain: float,
        report: Callable[[GuardedStep], None] | None,
    ) -> None:
        self._sumo, self._vehicle, self._seeing = sumo, sumo.vehicle, seeing
        self._acts, self._mode, self._report = acts, Mode.ACT if acts else Mode.SHADOW, report
        self._template, self._tolerance, self._regain = guard, tolerance, regain
        self.cars: dict[str, _Car] = {}  #: by id
        self._watches: dict[str, tuple[BrakeWatch, Manoeuvres]] = {}
        judge = None if guard is None else _judge(guard)
        if not (judge is None or isinstance(judge, TrafficRisk) or judge.labels.names == VARIABLES):
            names = judge.labels.names or "unnamed variables"
            hint = f"it must be a TrafficRisk, or observe {', '.join(VARIABLES)}"
            raise ValueError(f"the guard's judge observes {names}; {hint}")
        #: How hard leaders were seen to brake, by their ``decel`` [m/s²].
        self.leaders: dict[float, Manoeuvres] = {}
        self.begin_anew()
        if guard is None:
            self._given(1.0, 1.0, 1.0)  # what it refuses it refuses now
        self.decisions = 0
        #: Steps in which a car braked harder, or accelerated less, than its driver wanted by more
        #: than 0.1 m/s²; in shadow, would have. Who stands, and goes on standing, is not counted.
        self.revised = 0
        self.limited = 0  #: steps in which a guard set a limit to the speed of a car
        self.overruled = 0  #: steps in which a car was left to a script that set its speed

    def begin_anew(self) -> None:
        """Another simulation, or another moment of it, begins."""
        self.interval = self._seeing.dt if self._template is None else self._template.interval
        self._every = steps_between(self.interval, self._seeing.dt)
        self._steps = 0
        self._watches.clear()

    def add(self, car: str) -> None:
        """Guard it from now on."""
        body = self._seeing.body(car)
        self.cars[car] = _Car(car, self._guard_for(body), body)

    def remove(self, car: str) -> None:
        """Guard it no longer: it is handed back."""
        self._hand_back(self.cars.pop(car))

    def step(self, time: float) -> None:
        """Say what came of the step that is over, and decide on the next."""
        decides = self._steps % self._every == 0
        self._steps += 1
        speeds: dict[str, float] = {}  # of leaders
        for car in self.cars.values():
            speed = self._vehicle.getSpeed(car.id)
            if car.seen is not None:
                self._look_back(car, speed)
            if decides:
                self._look(car, speed)
                if car.around[0] is not None:
                    speeds[car.around[0].id] = car.around[0].speed
                if car.seen is not None and self._acts:
                    self._decide(car, car.high)
            if self._acts:
                self._act(car, speed)
            car.speed, car.time = speed, time
        if decides:
            self._watch(speeds)

    def _look(self, car: _Car, speed: float) -> None:
        """See what is around; without anybody, a guard of one leader has nothing to decide on."""
        body, car.body = car.body, self._seeing.body(car.id)
        if self._template is None and car.body.strength != body.strength:  # as on a wet road
            car.guard, car.around = self._guard_for(car.body), (None, None)
        ahead, before = self._seeing.neighbour(car.id, speed), car.around[0]
        scene = isinstance(judge := _judge(car.guard), TrafficRisk)
        # Who is behind matters only where one brakes: if acting, because somebody is ahead.
        matters = scene and not (ahead is None and self._acts)
        behind = self._seeing.neighbour(car.id, speed, is_ahead=False) if matters else None
        car.around = ahead, behind
        if (ahead and ahead.id) != (before and before.id):
            car.guard.begin()  # what is known of the one before does not hold of this one
        if ahead and self._template is None and isinstance(judge, TrafficRisk):
            judge.ahead.manoeuvres = self._leaders_like(ahead.id)  # its brakes may have changed
        car.revision = car.seen = None
        if scene and (ahead or behind):
            car.seen = self._seeing.rows(car.id, speed, ahead, behind)
        elif ahead:
            car.seen = np.array([ahead.room, speed, ahead.speed])

    def _decide(self, car: _Car, proposal: float) -> Revision:
        assert car.seen is not None
        revision = car.revision = car.guard.decide(car.seen, proposal)
        self.decisions += 1
        worst = judge.worst if isinstance(judge := _judge(car.guard), TrafficRisk) else None
        neighbour = car.around[worst.number - 1 if worst else 0]
        car.about = (neighbour.id, worst.role if worst else Role.AHEAD) if neighbour else ("", None)
        return revision

    def _act(self, car: _Car, speed: float) -> None:
        """Set the speed, where the guard allows less than the car might want."""
        revision = car.revision
        is_old = car.time and not (revision is None and car.mode is None)
        if is_old and self._is_overruled(car, speed):
            return
        if revision is None or revision.executed >= car.high:
            self._hand_back(car)
            return
        car.limit = max(0.0, speed + float(revision.executed) * self._seeing.dt)
        car.wish = self._seeing.wish(car.id, speed, car.around[0])
        most = car.limit + _COARSE * self._seeing.dt
        is_safe = car.wish <= most or self._is_exactly_safe(car, speed)
        if is_safe and not car.body.late:
            self._hand_back(car)  # it drives as it would by itself, with its imperfections
            return
        if car.mode is None:
            car.mode = car.taken = self._vehicle.getSpeedMode(car.id)
        is_hard = car.limit < speed - car.body.decel * self._seeing.dt - _SAME_SPEED
        self._take(car, (car.mode & ~_OFF if is_hard else car.mode) | _ON)
        self.limited += 1
        self._vehicle.setSpeed(car.id, car.limit)

    def _take(self, car: _Car, mode: int) -> None:
        if mode != car.taken:
            self._vehicle.setSpeedMode(car.id, mode)
            car.taken = mode

    def _is_overruled(self, car: _Car, speed: float) -> bool:
        """Whether a script set its speed, which SUMO would forget; then it is left to it."""
        wish = self._vehicle.getSpeedWithoutTraCI(car.id)
        # Under a limit some models (EIDM) drive a little slower than they say.
        limit, slack = (wish, 0.0) if car.mode is None else (car.limit, _COARSE * self._seeing.dt)
        is_faster = speed > limit + _DIFFERS
        is_slower = speed < min(limit, wish) - max(slack, _DIFFERS)
        is_slower = is_slower and not self._vehicle.isStopped(car.id)
        differs = is_faster or is_slower
        if not (differs or speed <= car.script + _DIFFERS):
            car.script = math.nan
            return False
        most = car.body.hardest * self._seeing.dt + _DIFFERS
        is_sudden = is_slower and not car.taken & _OFF and car.speed - speed > most
        brakes_on = not differs and speed < car.script - _DIFFERS
        if car.mode is not None and (is_sudden or brakes_on):
            # So does SUMO itself, as where lanes merge: the next steps say who it was.
            car.script = speed
            self._take(car, car.mode | _ON | _OFF)
            return True
        if not self.overruled:
            warnings.warn(_OVERRULED.format(car.id), RuntimeWarning, stacklevel=5)
        self.overruled += 1
        if differs:  # else the speed that is set may be the guard's own
            car.script = speed if is_slower else -math.inf
            self._hand_back(car)
        return True

    def _is_exactly_safe(self, car: _Car, speed: float) -> bool:
        """Whether what its model wants is survived, if that is what it does in SUMO's step.

        Who keeps less time than a step (``tau``) drives into others, as SUMO warns, if they dawdle.
        """
        judge, ahead, dt, body = _judge(car.guard), car.around[0], self._seeing.dt, car.body
        if not (isinstance(judge, TrafficRisk) and ahead and body.tau >= dt):
            return False
        room = max(ahead.most - _further(car.wish, body.decel, self._seeing.euler), _NEAREST)
        # It may use up the margin, as SUMO's models do.
        here = room + judge.ahead.margin, speed, ahead.speed
        critical = judge.ahead.critical(here, [(car.wish - speed) / dt])
        tolerance = getattr(car.guard.reviser, "tolerance", self._tolerance)
        return bool(critical[0] >= judge.ahead.manoeuvres.exceeded_by(tolerance) - _SEEN_TO)

    def _hand_back(self, car: _Car) -> None:
        if car.mode is not None:
            if math.isnan(car.script):
                self._vehicle.setSpeed(car.id, -1.0)
            if self._vehicle.getSpeedMode(car.id) == car.taken:  # no script's
                self._vehicle.setSpeedMode(car.id, car.mode)
            car.mode = None

    def _look_back(self, car: _Car, speed: float) -> None:
        """What the driver wanted, now that it shows; in shadow it is what is judged."""
        desired_speed = speed
        # Slower than the limit is what SUMO itself wanted, such as to stop at a red light.
        if car.mode is not None and speed >= car.limit - _SAME_SPEED:
            desired_speed = max(car.wish, speed)
        wish, acceleration = ((v - car.speed) / self._seeing.dt for v in (desired_speed, speed))
        revision = car.revision or self._decide(car, wish)  # where it acts, that was decided before
        stands = max(car.speed, speed, desired_speed) < STANDS
        outcome = acceleration if self._acts else float(revision.advised)
        self.revised += not stands and outcome < wish - SLIGHT
        if self._report is not None:
            self._report(GuardedStep(car.time, car.id, wish, acceleration, revision, *car.about))

    def _watch(self, speeds: dict[str, float]) -> None:
        """Learn how hard leaders brake, each by itself, whoever follows it.

        Not of cars in which guards act, whoever attached them: what a guard makes a car do is not
        what leaders do, and of what such a car does by itself the gentle part would be left out.
        """
        groups = [a.guarding for a in _ATTACHED if a._sumo is self._sumo and a.guarding]
        for car in chain.from_iterable(group.cars for group in groups if group._acts):
            speeds.pop(car, None)
            self._watches.pop(car, None)
        arrivals = self._sumo.simulation.getDepartedIDList()  # maybe with the name of one before
        now = {leader: self._leaders_like(leader) for leader in speeds}
        for leader, (watch, brakes) in sorted(self._watches.items()):
            if now.get(leader) is not brakes or leader in arrivals:
                brakes.remember(watch.end())
                del self._watches[leader]
        for leader, speed in speeds.items():
            if leader not in self._watches:
                self._watches[leader] = BrakeWatch(self.interval), now[leader]
            watch, brakes = self._watches[leader]
            brakes.remember(watch.see(0.0, speed, speed))

    def _leaders_like(self, car: str) -> Manoeuvres:
        """What is known of leaders that brake as hard as it, by what SUMO says of them."""
        decel = self._seeing.body(car).decel
        if decel not in self.leaders:  # how hard SUMO's cars brake is exactly known, and has an end
            self.leaders[decel] = Manoeuvres(decel, width=_SEEN_TO)
        return self.leaders[decel]

    def _guard_for(self, body: _Facts) -> Guard:
        if self._template is None:
            return self._given(*body.strength)
        guard = self._template.copy()
        guard.freeze()
        if isinstance(guard.reviser, ActionReviser):
            guard.reviser.mode = self._mode
        return guard

    def _given(self, decel: float, hardest: float, high: float) -> Guard:
        """A guard that counts on one braking, of leaders too, and brakes harder if it has to."""
        how: Any = {"decel": decel, "margin": _MARGIN, "regain": self._regain}
        judge = TrafficRisk(LatentRisk(-decel, self.interval, leader_decel=decel, **how))
        limits = -hardest, high, decel, self.interval
        return guard_for_traffic(*limits, judge=judge, tolerance=self._tolerance, mode=self._mode)


def _judge(guard: Guard) -> ActionJudge | None:
    """Who judges actions; None where a formula alone decides, as in an `EnvelopeReviser`."""
    return getattr(guard.reviser, "risk", None)


def choose(vehicles: str | float | Iterable[str]) -> Callable[[Any, str], bool]:
    """A test of whether a vehicle is one of those that are meant, the same in every run."""
    if isinstance(vehicles, str) and vehicles == "all":
        return lambda seeing, car: True
    if isinstance(vehicles, str) and vehicles.startswith(_TYPE):
        kind = vehicles.removeprefix(_TYPE)
        # A type of which a script changed anything for one car is called NAME@car.
        return lambda seeing, car: f"{seeing.kind(car)}@".startswith(f"{kind}@")
    if isinstance(vehicles, (str, int, float)):
        text = str(vehicles)
        try:
            share = float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
        except ValueError:
            share = math.nan
        if not 0.0 < share <= 1.0 or vehicles == "1":  # which is an id
            shares = "a share above 0 up to 1, such as 0.1 or '10%'"
            hint = f"it is 'all', 'type:NAME', {shares}, or a list of ids"
            raise ValueError(f"vehicles is {vehicles!r}; {hint}")
        most = share * 2.0**64  # of a hash that mixes: crc32 has numbered ids in or out together
        return lambda _, car: int.from_bytes(blake2b(car.encode(), digest_size=8).digest()) < most
    ids = frozenset(vehicles)
    return lambda _, car: car in ids


class Watching:
    """Measures each car against whoever is ahead of it."""

    def __init__(self, seeing: Seeing) -> None:
        self._seeing = seeing
        self.cars: dict[str, None] = {}  #: by id
        self.step(0.0)

    def add(self, car: str) -> None:
        """Watch it from now on."""
        self.cars[car] = None

    def remove(self, car: str) -> None:
        """Watch it no longer; what was measured stays."""
        del self.cars[car]

    def step(self, time: float) -> None:
        """Look at every car."""
        observations = {car: pair for car in self.cars if (pair := self._seeing.pair(car))}
        self.ids = list(observations)  #: of cars with somebody ahead, now
        #: (n, 3) of each gap [m], its speed and the other's [m/s].
        self.observations = np.array(list(observations.values())).reshape(-1, 3)
        self.ttc = time_to_collision(self.observations)  #: of each time to collision [s]
        #: Of each the deceleration to avoid it [m/s²].
        self.drac = deceleration_to_avoid_collision(self.observations)


@dataclass
class _Ride:
    """How some cars drove: what guards cost, or what happened without them."""

    dt: float
    seconds: float = 0.0  # summed over the cars
    metres: float = 0.0
    lost: float = 0.0  # of that time, against the speed that each would drive on a free road [s]
    hard_brakes: int = 0
    jerks: float = 0.0  # sum of squares
    latest: dict[str, tuple[float, float]] = field(default_factory=dict)  # speed, acceleration

    def see(self, cars: Iterable[str], vehicle: Any) -> None:
        """Take in a step of cars that are here; others are forgotten."""
        before, self.latest, dt = self.latest, {}, self.dt
        for car in cars:
            if vehicle.isStopped(car):
                continue
            speed, free = vehicle.getSpeed(car), vehicle.getAllowedSpeed(car)
            self.seconds += dt
            self.metres += speed * dt
            self.lost += dt * max(0.0, 1.0 - speed / free) if free > 0.0 else 0.0
            last_speed, was = before.get(car, (speed, 0.0))
            acceleration = (speed - last_speed) / dt
            self.hard_brakes += acceleration < -_HARD <= was
            self.jerks += (acceleration - was) ** 2 / dt
            self.latest[car] = speed, acceleration


class Collision(NamedTuple):
    """A collision, told once for the two."""

    time: float  #: at which the step began, as SUMO writes it [s]
    collider: str  #: of two in a lane the one behind
    victim: str
    kind: str  #: as SUMO calls it


class Attachment:
    """What `attach` returns: which cars it is, and what came of them."""

    def __init__(
        self,
        sumo: Any,
        chosen: Callable[[Any, str], bool],
        seeing: Seeing,
        cars: Guarding | Watching,
        asks_again: bool = False,
    ) -> None:
        self._sumo, self._chosen, self._seeing, self._cars = sumo, chosen, seeing, cars
        self._asks_again = asks_again  # of cars that are known, as their types may change
        self.guarding = cars if isinstance(cars, Guarding) else None
        self.watching = cars if isinstance(cars, Watching) else None
        self._now: float | None = None
        self._key = f"evofsm.{next(_NUMBERS)}"  # of a parameter that no other simulation has
        self._known: set[str] = set()
        self._met: dict[tuple[str, str], float] = {}
        self._listener: int | None = None
        self.collisions: list[Collision] = []  #: of the whole simulation, other cars included
        self.ever: set[str] = set()  #: vehicles that were guarded, or watched, at any time
        self.looked = 0  #: cars that were looked at, summed over the steps
        self._ride = _Ride(seeing.dt)
        self.seconds = 0.0  #: that the attachment took
        self._counts = seeing.counts  # in each simulation until now

    @property
    def cars(self) -> list[str]:
        """Vehicles that are guarded, or watched, now."""
        return list(self._cars.cars)

    def listen(self) -> None:
        """Have SUMO call `step` after each of its own."""
        if getattr(self._sumo, "__name__", "") == "libsumo":
            # It keeps listeners where a simulation is closed. Whoever attaches anew is not guarded
            # twice, once by what was attached to the one before.
            for stale in [a for a in _ATTACHED if a._sumo is self._sumo and a._is_new()]:
                stale._listen_no_more()
        does = {"step": lambda *_: self.step(), "cleanUp": lambda *_: self._is_removed()}
        listener = type("Listener", (_module(self._sumo).StepListener,), does)()
        self._listener = self._sumo.addStepListener(listener)
        self._sumo.simulation.setParameter("", self._key, "1")
        _ATTACHED.add(self)

    def detach(self) -> None:
        """Hand every car back to SUMO, if it still runs, and listen no longer."""
        self._listen_no_more()
        self._hand_back()

    def _hand_back(self) -> None:
        if self.cars and not self._is_new():
            for car in set(self._sumo.vehicle.getIDList()).intersection(self.cars):
                self._cars.remove(car)
        self._cars.cars.clear()

    def _listen_no_more(self) -> None:
        if self._listener is not None:
            self._sumo.removeStepListener(self._listener)

    def _is_removed(self) -> None:
        """It listens no longer; traci removes whoever listens where it closes."""
        self._listener = None
        _ATTACHED.discard(self)

    def step(self) -> bool:
        """Take in a step of the simulation that is over, and decide on the next.

        In another simulation, after ``load`` or ``close`` and ``start``, and wherever time moved by
        anything but one step, all that is known of cars is forgotten, and they begin anew.
        """
        begin = clock.perf_counter()
        now, before = float(self._sumo.simulation.getTime()), self._now
        if self._is_new():
            warnings.warn(_ANOTHER, RuntimeWarning, stacklevel=2)
            self._begin_anew()
            if not self._seeing.counts:
                warnings.warn(_UNCOUNTED, RuntimeWarning, stacklevel=2)
            self._sumo.simulation.setParameter("", self._key, "1")
        elif before is not None and abs(now - before - self._seeing.dt) > _TICK:
            if now - before > self._seeing.dt:
                warnings.warn(_SKIPPED, RuntimeWarning, stacklevel=2)
            self._begin_anew()
        self._now = now
        self._seeing.look_again()
        self._count_cars()
        for collision in self._sumo.simulation.getCollisions():
            pair = collision.collider, collision.victim
            if now - self._met.get(pair, -math.inf) > _SAME_COLLISION:
                self.collisions.append(Collision(now - self._seeing.dt, *pair, collision.type))
            self._met[pair] = now
        self.looked += len(self._cars.cars)
        self._ride.see(self._cars.cars, self._sumo.vehicle)
        self._cars.step(now)
        self.seconds += clock.perf_counter() - begin
        return True

    def summary(self) -> dict[str, float]:
        """What came of the cars that are, or were, guarded or watched; numbers by name.

        ``cars``; ``car_seconds`` that they drove, without stops and parking; ``collisions`` of all
        cars (two that touch again within 5 s have one), ``of_guarded`` those in which one of them
        ran into another, ``into_guarded`` those in which another ran into one of them; mean
        ``speed`` [m/s]; ``hard_brakes``, each harder than 5 m/s² and counted once; RMS ``jerk``
        [m/s³]; ``time_lost`` against driving on a free road [s].
        Where guards decided, ``decisions``, ``limited`` (steps with a limit to the speed),
        ``revised`` (those that changed what the driver wanted, `Guarding.revised`), and
        ``microseconds`` for each decision, all that guarding takes.
        """
        collisions, cars, guards, ride = self.collisions, self.ever, self.guarding, self._ride
        seconds = ride.seconds or math.nan
        numbers = {
            "cars": len(cars),
            "collisions": len(collisions),
            "of_guarded": sum(c.collider in cars for c in collisions),
            "into_guarded": sum(c.victim in cars and c.collider not in cars for c in collisions),
            "car_seconds": ride.seconds,
            "speed": ride.metres / seconds,
            "hard_brakes": ride.hard_brakes,
            "jerk": math.sqrt(ride.jerks / seconds),
            "time_lost": ride.lost,
        }
        if not self._counts:
            numbers |= dict.fromkeys(("collisions", "of_guarded", "into_guarded"), math.nan)
        if guards is not None and guards.decisions:
            numbers |= {name: getattr(guards, name) for name in ("decisions", "limited", "revised")}
            numbers["microseconds"] = 1e6 * self.seconds / guards.decisions
        return numbers

    def _is_new(self) -> bool:
        """Whether another simulation runs than it was attached to, or none."""
        try:
            return bool(self._sumo.simulation.getParameter("", self._key) != "1")
        except _module(self._sumo).FatalTraCIError:
            return True

    def _begin_anew(self) -> None:
        """Forget the cars, which are other ones, or are elsewhere; who is here is handed back."""
        self._hand_back()
        self._ride.latest.clear()
        self._known.clear()
        self._met.clear()
        self._seeing.look_up()
        self._counts = self._counts and self._seeing.counts
        if self.guarding is not None:
            self.guarding.begin_anew()

    def _count_cars(self) -> None:
        """Cars that are inserted, or leave; who is teleported begins anew."""
        simulation, here = self._sumo.simulation, set(self._sumo.vehicle.getIDList())
        jumps = here & set(simulation.getStartingTeleportIDList())
        for car in jumps.intersection(self._cars.cars):
            self._cars.remove(car)
        # Who departs with the name of one that was here a step ago is another car.
        before = self._known - jumps - set(simulation.getDepartedIDList())
        if jumps:  # who does not end it at once is on its way
            here -= jumps.difference(simulation.getEndingTeleportIDList())
        for car in self._known - (before & here):
            self._cars.cars.pop(car, None)
            self._ride.latest.pop(car, None)
        for car in here - before:
            self._seeing.meet(car)
        candidates = here if self._asks_again else here - before
        picks = {car for car in candidates if self._chosen(self._seeing, car)}
        for car in candidates.intersection(self._cars.cars) - picks:
            self._cars.remove(car)
        for car in sorted(picks.difference(self._cars.cars)):
            self._cars.add(car)
            self.ever.add(car)
        self._known = here


def attach(
    sumo: Any,
    vehicles: str | float | Iterable[str] = "all",
    *,
    guard: Guard | None = None,
    mode: str = "act",
    tolerance: float = TOLERANCE,
    regain: float = REGAIN,
    report: Callable[[GuardedStep], None] | None = None,
) -> Attachment:
    """Guard, or watch, cars of a SUMO simulation that runs.

    From then on each ``simulationStep`` does the rest. SUMO drives a guarded car as before, but no
    faster than its guard allows, who minds who is ahead and behind in its lane; right of way, red
    lights and lane changes stay SUMO's.

    Parameters
    ----------
    sumo : module or connection
        libsumo, or traci, with a simulation started.
    vehicles : str, float or iterable of str
        ``"all"``, ``"type:NAME"``, a share such as 0.1 or ``"10%"``, or ids; those to come as well,
        and whoever changes to that type. The name of a vTypeDistribution is no type.
    guard : Guard, optional
        Each car gets a copy, frozen. It observes scenes (`guard_for_traffic`) or gap and speeds
        (`guard_for_cars`, or `Guard.of` an `EnvelopeReviser`). Without one, each counts on SUMO's
        ``decel`` of its car and of leaders, and brakes up to ``emergencyDecel`` where it has to.
    mode : {"act", "shadow", "watch"}
        Whether guards act, only say what they would do, or there are none: then only time to
        collision and needed deceleration are measured.
    tolerance : float
        Highest risk that is accepted. A ``guard`` has its own, and so it has the next.
    regain : float
        Within this time a gap that is not safe, such as after a lane change, is to be safe again
        [s], by no more braking than that takes; see `LatentRisk`.
    report : callable, optional
        Called with each `GuardedStep`: what a car's driver wanted, what it did, and why.

    Raises
    ------
    ValueError
        If there is no such mode or choice of vehicles, no simulation runs, or a mesoscopic one, or
        the guard decides at other times than those of steps, or observes something else.

    Notes
    -----
    Where a guard acts, the speed mode has "safe speed" and the limit of acceleration on, and where
    it brakes harder than ``decel`` that of braking off. It is put back as it was, with
    ``setSpeed(-1)``, as soon as the guard allows all that the car can do. A car that is seen to
    drive at another speed than its guard, or its own driver, had set (a script's) is left alone: a
    slower one until it drives faster, a faster one while that shows. Where you set a car's speed
    yourself, ask a `Guard` before you do instead.
    After ``load``, or ``close`` and ``start`` of libsumo, an attachment goes on with the new cars,
    and what it counts goes on, as a warning says; ``detach`` ends it, and so does whoever attaches
    anew. With ``--collision.action none``, in any of them, SUMO looks for no collisions, and their
    numbers are NaN.

    Examples
    --------
    >>> import libsumo
    >>> from evofsm.driving import SumoWorld, load_family
    >>> scenario = load_family("emergency").draw(seed=0, index=0).scenario
    >>> with SumoWorld() as world, world.open(scenario) as road:  # or your own simulation
    ...     watch = attach(libsumo, "all", mode="watch")
    ...     road.advance(0.0, steps=25)
    ...     watch.detach()
    >>> watch.looked
    50
    """
    if mode not in _MODES:
        raise ValueError(f"there is no mode {mode!r}; there are {', '.join(_MODES)}")
    if mode == "watch" and guard is not None:
        raise ValueError("mode 'watch' asks no guard; use mode 'shadow'")
    is_chosen, sight = choose(vehicles), Seeing(sumo)
    cars: Guarding | Watching = Watching(sight)
    if mode != "watch":
        cars = Guarding(sumo, sight, guard, mode == "act", tolerance, regain, report)
    by_type = isinstance(vehicles, str) and vehicles.startswith(_TYPE)
    attachment = Attachment(sumo, is_chosen, sight, cars, by_type)
    if not sight.counts:
        warnings.warn(_UNCOUNTED, RuntimeWarning, stacklevel=2)
    attachment.listen()
    return attachment

"""What SUMO says of the cars around one of them, put as this room takes it.

SUMO's ``getLeader`` and ``getFollower`` take off minGap of whoever follows; where it counts a
collision before the bumpers touch (``--collision.mingap-factor``), the gap ends there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.traffic import COLUMNS

# How far one looks at least [m]; further by what it takes to stop.
_NEAR, _GENTLE = 30.0, 3.0
_WIDTH = 1.8
#: Rows for the one ahead and the one behind.
AROUND = 2


class Neighbour(NamedTuple):
    """Another car in one's lane."""

    id: str
    gap: float  #: from bumper to bumper [m]
    room: float  #: what is left of it until SUMO counts a collision, in its step [m]
    speed: float  #: [m/s]


class Body(NamedTuple):
    """What does not change about a car."""

    length: float  #: [m]
    min_gap: float  #: [m]
    decel: float  #: [m/s²]


class Seeing:
    """Reads the cars around one of them.

    Parameters
    ----------
    sumo : module or connection
        libsumo or traci.
    """

    def __init__(self, sumo: Any) -> None:
        self._vehicle = sumo.vehicle
        factor = float(sumo.simulation.getOption("collision.mingap-factor"))
        # Share of minGap that SUMO wants kept; below 0 each model has its own, at most all of it.
        self._factor = factor if factor >= 0.0 else 1.0
        #: Time of a step [s].
        self.dt = float(sumo.simulation.getDeltaT())
        ballistic = str(sumo.simulation.getOption("step-method.ballistic")).lower() in ("true", "1")
        # In SUMO's Euler step a car drives all of it at the speed of its end. Against what is
        # rehearsed, a slower follower is nearer by half a step's worth of the difference; and
        # whoever brakes to a standstill within a step gets further by up to an eighth of its
        # braking over the square of the step. What the Euler step adds to the gap is not counted:
        # with an actionStepLength in any type SUMO steps ballistically, and no option says so.
        self._euler = 0.0 if ballistic else self.dt
        self._bodies: dict[str, Body] = {}

    def forget(self, car: str) -> None:
        """It has left."""
        self._bodies.pop(car, None)

    def body(self, car: str) -> Body:
        """Of a car; that its type changes is not noticed."""
        body = self._bodies.get(car)
        if body is None:
            vehicle = self._vehicle
            facts = vehicle.getLength(car), vehicle.getMinGap(car), vehicle.getDecel(car)
            body = self._bodies[car] = Body(*facts)
        return body

    def pair(self, car: str) -> tuple[float, float, float] | None:
        """Gap from bumper to bumper [m], its speed and that of whoever is ahead [m/s]."""
        speed = self._vehicle.getSpeed(car)
        found = self._vehicle.getLeader(car, _far(speed))
        if not found or not found[0]:
            return None
        return found[1] + self.body(car).min_gap, speed, self._vehicle.getSpeed(found[0])

    def ahead(self, car: str, speed: float) -> Neighbour | None:
        """Whoever is ahead on its route, if near enough to matter."""
        found = self._vehicle.getLeader(car, _far(speed))
        if not found or not found[0]:
            return None
        leader, gap = found
        its, body = self._vehicle.getSpeed(leader), self.body(car)
        return Neighbour(leader, gap + body.min_gap, self._room(gap, body, speed - its), its)

    def behind(self, car: str, speed: float) -> Neighbour | None:
        """Whoever is behind."""
        follower, gap = self._vehicle.getFollower(car, _far(speed))
        if not follower:
            return None
        its, body = self._vehicle.getSpeed(follower), self.body(follower)
        return Neighbour(follower, gap + body.min_gap, self._room(gap, body, its - speed), its)

    def wish(self, car: str, speed: float, ahead: Neighbour | None) -> float:
        """The speed that a car's own model wants after the next step [m/s].

        By whoever is ahead, the limit and what the car can do. Red lights and right of way may make
        it lower, dawdling too.
        """
        vehicle = self._vehicle
        fastest = min(vehicle.getAllowedSpeed(car), speed + vehicle.getAccel(car) * self.dt)
        if ahead is None:
            return float(fastest)
        gap = ahead.gap - self.body(car).min_gap  # as SUMO's models take it
        decel = vehicle.getApparentDecel(ahead.id)
        wanted = vehicle.getFollowSpeed(car, speed, gap, ahead.speed, decel, ahead.id)
        slowest = speed - vehicle.getEmergencyDecel(car) * self.dt
        return float(max(min(wanted, fastest), slowest, 0.0))

    def _room(self, gap: float, follower: Body, closing: float) -> float:
        euler = self._euler
        late = 0.125 * follower.decel * euler * euler - 0.5 * euler * min(0.0, closing)
        return gap + (1.0 - self._factor) * follower.min_gap - late

    def rows(
        self, car: str, speed: float, ahead: Neighbour | None, behind: Neighbour | None
    ) -> NDArray[np.float64]:
        """The scene as `Scene.rows` has it, x counted from the front bumper of the car."""
        rows = np.zeros((1 + AROUND, len(COLUMNS)))
        length = self.body(car).length
        rows[0] = 1.0, -0.5 * length, 0.0, speed, 0.0, length, _WIDTH
        if ahead is not None:
            its = self.body(ahead.id).length
            rows[1] = 1.0, ahead.room + 0.5 * its, 0.0, ahead.speed, 0.0, its, _WIDTH
        if behind is not None:
            its = self.body(behind.id).length
            rows[2] = 1.0, -length - behind.room - 0.5 * its, 0.0, behind.speed, 0.0, its, _WIDTH
        return rows.ravel()


def _far(speed: float) -> float:
    return _NEAR + speed + 0.5 * speed * speed / _GENTLE

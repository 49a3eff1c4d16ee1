"""The same cars in SUMO, through libsumo, under exact external control.

SUMO moves the cars and says where they are; both accelerations come from outside. What it takes
to have them carried out to the letter: speed mode 0 (SUMO checks nothing), a speed set for every
step, the ballistic update, and no teleporting, no gap added to collisions, no random speeds.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from evofsm.driving.scenarios import Scenario
from evofsm.driving.world import (
    ACCELERATIONS,
    GAP,
    GAP_BEHIND,
    SPEEDS,
    KinematicWorld,
    Road,
    World,
    decide,
)
from evofsm.extras import needs

_CARS = ["follower", "leader", "behind"]

_ROAD_LENGTH = 200_000.0
_FASTEST = 100.0
_VEHICLE_LENGTH = 5.0
# Where the front bumper of the last car stands at first.
_FIRST_PLACE = 10.0

_NET = f"""<net version="1.20">
    <location netOffset="0,0" convBoundary="0,0,{_ROAD_LENGTH:.2f},0"
              origBoundary="0,0,{_ROAD_LENGTH:.2f},0" projParameter="!"/>
    <edge id="road" from="begin" to="end" priority="1">
        <lane id="road_0" index="0" speed="{_FASTEST}" length="{_ROAD_LENGTH:.2f}"
              shape="0,0 {_ROAD_LENGTH:.2f},0"/>
    </edge>
    <junction id="begin" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,3.2"/>
    <junction id="end" type="dead_end" x="{_ROAD_LENGTH:.2f}" y="0" incLanes="road_0" intLanes=""
              shape="{_ROAD_LENGTH:.2f},0 {_ROAD_LENGTH:.2f},3.2"/>
</net>
"""

_ROUTES = f"""<routes>
    <vType id="car" length="{_VEHICLE_LENGTH}" minGap="0" maxSpeed="{_FASTEST}" accel="100"
           decel="100" emergencyDecel="100" speedFactor="1" speedDev="0" sigma="0"/>
    <route id="along" edges="road"/>
</routes>
"""


class SumoWorld(World, AbstractContextManager["SumoWorld"]):
    """The world that is SUMO itself; each run is a simulation of its own.

    Notes
    -----
    libsumo holds one simulation per process; a second one would silently end the first, and is
    refused here.
    """

    def __init__(self) -> None:
        with needs("libsumo", "sumo", "the world 'sumo'"):
            self._sumo: Any = import_module("libsumo")

    def __exit__(self, *error: object) -> None:
        """Nothing is open between two runs."""

    @contextmanager
    def open(self, scenario: Scenario) -> Iterator[Road]:
        """Put the cars on a road, for use in a ``with`` statement."""
        _refuse_what_sumo_cannot_drive(scenario)
        sumo = self._sumo
        if sumo.isLoaded():
            fault = "this process runs a SUMO simulation already, and libsumo has room for one"
            raise RuntimeError(f"{fault}: close that one, or use another process")
        with tempfile.TemporaryDirectory(prefix="evofsm-sumo-") as folder:
            net, routes = Path(folder) / "road.net.xml", Path(folder) / "road.rou.xml"
            net.write_text(_NET)
            routes.write_text(_ROUTES)
            sumo.start(
                [
                    "sumo",
                    *("--net-file", str(net), "--route-files", str(routes)),
                    *("--step-length", repr(scenario.dt), "--step-method.ballistic", "true"),
                    *("--collision.action", "warn", "--collision.mingap-factor", "0"),
                    *("--time-to-teleport", "-1", "--no-step-log", "true", "--no-warnings", "true"),
                ]
            )
        try:
            yield _Road(sumo, scenario)
        finally:
            if sumo.isLoaded():  # else it was closed from outside
                sumo.close()


#: The worlds there are.
WORLDS: Mapping[str, type[World]] = {"sumo": SumoWorld, "kinematic": KinematicWorld}


def open_world(name: str) -> World:
    """A world by its name, one of `WORLDS`."""
    if name not in WORLDS:
        raise ValueError(f"there is no world {name!r}; there are {', '.join(WORLDS)}")
    return WORLDS[name]()


def _refuse_what_sumo_cannot_drive(scenario: Scenario) -> None:
    milliseconds = scenario.dt * 1000.0
    if round(milliseconds) < 1 or abs(milliseconds - round(milliseconds)) > 1e-9:
        fault = "SUMO's clock counts whole milliseconds: it would drive another step"
        hint = "choose one of 0.001 s, 0.002 s, ..., or the kinematic world"
        raise ValueError(f"dt is {scenario.dt} s, but {fault}; {hint}")
    # Nobody is faster than this; what the leader needs, the follower does not exceed.
    farthest = _start(scenario) + scenario.initial_gap + _FASTEST * scenario.duration
    if farthest > _ROAD_LENGTH:
        cause = f"initial_gap {scenario.initial_gap:g} m and duration {scenario.duration:g} s"
        raise ValueError(f"{cause} may lead beyond the road's {_ROAD_LENGTH:g} m")


def _start(scenario: Scenario) -> float:
    """Where the follower's front bumper stands at first [m], behind it what else there is."""
    behind = scenario.behind
    return _FIRST_PLACE + (behind.gap + _VEHICLE_LENGTH if behind else 0.0)


class _Road(Road):
    """The cars of one run."""

    def __init__(self, sumo: Any, scenario: Scenario) -> None:
        super().__init__(scenario)
        self._sumo = sumo
        self._cars = _CARS if scenario.behind else _CARS[:2]
        start, speeds = _start(scenario), self._record[0, SPEEDS].tolist()
        starts = start, start + scenario.initial_gap + _VEHICLE_LENGTH, _FIRST_PLACE
        for car, position, speed in zip(self._cars, starts, speeds, strict=False):
            # Standing, as SUMO does not insert a car that is too fast for the one ahead.
            sumo.vehicle.add(
                car, "along", "car", depart="now", departPos=repr(position), departSpeed="0"
            )
            sumo.vehicle.setSpeedMode(car, 0)
            sumo.vehicle.setSpeed(car, speed)
        sumo.simulationStep()  # the first step only puts the cars on the road
        for car, speed in zip(self._cars, speeds, strict=False):
            sumo.vehicle.setPreviousSpeed(car, speed)
        self._observe()

    def advance(self, command: float, steps: int = 1) -> None:
        for _ in range(steps):
            decide(self._plan, self._record, self.row, command)
            if self.over:
                break
            vehicle, accelerations = self._sumo.vehicle, self._record[self.row, ACCELERATIONS]
            for car, acceleration in zip(self._cars, accelerations.tolist(), strict=False):
                speed = max(0.0, vehicle.getSpeed(car) + acceleration * self.scenario.dt)
                vehicle.setSpeed(car, speed)
            self._sumo.simulationStep()
            self.row += 1
            if self.row == self._plan.cut_in[0]:
                self._cut_in(*self._plan.cut_in[1:].tolist())
            self._observe()

    def _cut_in(self, gap: float, speed: float) -> None:
        vehicle = self._sumo.vehicle
        follower, leader = self._cars[:2]
        vehicle.moveTo(leader, "road_0", vehicle.getLanePosition(follower) + gap + _VEHICLE_LENGTH)
        vehicle.setPreviousSpeed(leader, speed)
        vehicle.setSpeed(leader, speed)

    def _observe(self) -> None:
        vehicle, now = self._sumo.vehicle, self._record[self.row]
        position = [vehicle.getLanePosition(car) for car in self._cars]
        now[SPEEDS[: len(position)]] = [vehicle.getSpeed(car) for car in self._cars]
        now[GAP] = position[1] - _VEHICLE_LENGTH - position[0]
        now[GAP_BEHIND] = math.inf
        if self.scenario.behind is not None:
            now[GAP_BEHIND] = position[0] - _VEHICLE_LENGTH - position[2]

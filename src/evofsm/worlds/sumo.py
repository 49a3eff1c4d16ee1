"""The same two cars in SUMO, through libsumo, under exact external control.

SUMO moves the cars and says where they are; both accelerations come from outside. What it takes
to have them carried out to the letter: speed mode 0 (SUMO checks nothing), a speed set for every
step, the ballistic update, and no teleporting, no gap added to collisions, no random speeds.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Self

from evofsm._extras import needs
from evofsm.protocols import Controller
from evofsm.worlds.episode import Episode, drive
from evofsm.worlds.scenario import Scenario

_ROAD_LENGTH = 200_000.0
_FASTEST = 100.0
_VEHICLE_LENGTH = 5.0
# Where the follower's front bumper stands at first.
_START = 10.0

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


class SumoWorld:
    """The world that is SUMO itself. Close it after use, or use it in a ``with`` statement.

    Parameters
    ----------
    options : sequence of str
        Further options of SUMO, such as ``("--fcd-output", "trace.xml")``.

    Raises
    ------
    ModuleNotFoundError
        If libsumo is not installed.

    Notes
    -----
    libsumo holds one simulation per process; a second one would silently end the first, and is
    refused here.
    """

    def __init__(self, options: Sequence[str] = ()) -> None:
        with needs("libsumo", "sumo", "the world 'sumo'"):
            self._sumo: Any = import_module("libsumo")
        self._options = list(options)
        self._folder: tempfile.TemporaryDirectory[str] | None = None  # while a simulation is open
        self._dt = 0.0
        self._runs = 0

    def run(self, scenario: Scenario, controller: Controller) -> Episode:
        """Drive the scenario with ``controller`` in the follower."""
        _refuse_what_sumo_cannot_drive(scenario)
        if self._folder is None or self._dt != scenario.dt or not self._sumo.isLoaded():
            self.close()
            self._start(scenario.dt)
        self._runs += 1
        with _Road(self._sumo, self._runs, scenario) as road:
            return drive(road, scenario, controller)

    def close(self) -> None:
        """End the simulation."""
        if self._folder is not None:
            if self._sumo.isLoaded():
                self._sumo.close()
            self._folder.cleanup()
            self._folder = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _start(self, dt: float) -> None:
        if self._sumo.isLoaded():
            raise RuntimeError(
                "this process runs a SUMO simulation already, and libsumo has room for one: "
                "close that one, or use another process"
            )
        folder = tempfile.TemporaryDirectory(prefix="evofsm-sumo-")
        net, routes = Path(folder.name) / "road.net.xml", Path(folder.name) / "road.rou.xml"
        net.write_text(_NET)
        routes.write_text(_ROUTES)
        try:
            self._sumo.start(
                [
                    "sumo",
                    *("--net-file", str(net)),
                    *("--route-files", str(routes)),
                    *("--step-length", repr(dt)),
                    *("--step-method.ballistic", "true"),
                    *("--collision.action", "warn"),
                    *("--collision.mingap-factor", "0"),
                    *("--time-to-teleport", "-1"),
                    *("--no-step-log", "true"),
                    *("--no-warnings", "true"),
                    *self._options,
                ]
            )
        except BaseException:
            folder.cleanup()
            raise
        self._folder, self._dt = folder, dt


def _refuse_what_sumo_cannot_drive(scenario: Scenario) -> None:
    milliseconds = scenario.dt * 1000.0
    if round(milliseconds) < 1 or abs(milliseconds - round(milliseconds)) > 1e-9:
        raise ValueError(
            f"dt is {scenario.dt} s, but SUMO's clock counts whole milliseconds: it would drive "
            "another step; choose one of 0.001 s, 0.002 s, ..., or the kinematic world"
        )
    # Nobody is faster than this; what the leader needs, the follower does not exceed.
    farthest = _START + scenario.initial_gap + _FASTEST * scenario.duration
    if farthest > _ROAD_LENGTH:
        raise ValueError(
            f"initial_gap {scenario.initial_gap:g} m and duration {scenario.duration:g} s may lead "
            f"beyond the road's {_ROAD_LENGTH:g} m"
        )


class _Road:
    """Two cars of their own for one run, in a simulation that goes on from run to run."""

    def __init__(self, sumo: Any, run: int, scenario: Scenario) -> None:
        self._sumo = sumo
        self._dt = scenario.dt
        self._follower, self._leader = f"follower{run}", f"leader{run}"
        leader_start = _START + scenario.initial_gap + _VEHICLE_LENGTH
        for car, start in ((self._leader, leader_start), (self._follower, _START)):
            sumo.vehicle.add(
                car, "along", "car", depart="now", departPos=repr(start), departSpeed="0"
            )
            sumo.vehicle.setSpeedMode(car, 0)
            sumo.vehicle.setSpeed(car, 0.0)
        sumo.simulationStep()  # the first step only puts the cars on the road

    def observe(self) -> tuple[float, float, float]:
        vehicle = self._sumo.vehicle
        rear = vehicle.getLanePosition(self._leader) - _VEHICLE_LENGTH
        return (
            rear - vehicle.getLanePosition(self._follower),
            vehicle.getSpeed(self._follower),
            vehicle.getSpeed(self._leader),
        )

    def advance(self, acceleration: float, leader_acceleration: float) -> None:
        vehicle = self._sumo.vehicle
        for car, wanted in ((self._follower, acceleration), (self._leader, leader_acceleration)):
            vehicle.setSpeed(car, max(0.0, vehicle.getSpeed(car) + wanted * self._dt))
        self._sumo.simulationStep()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for car in (self._follower, self._leader):
            if car in self._sumo.vehicle.getIDList():
                self._sumo.vehicle.remove(car)
        self._sumo.simulationStep()

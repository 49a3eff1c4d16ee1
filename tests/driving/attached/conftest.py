"""A short road in SUMO that is not ours: two cars, the first of which brakes hard."""

import pytest

libsumo = pytest.importorskip("libsumo")

NET = """<net version="1.20">
    <location netOffset="0,0" convBoundary="0,0,3000,0" origBoundary="0,0,3000,0"
              projParameter="!"/>
    <edge id="road" from="begin" to="end" priority="1">
        <lane id="road_0" index="0" speed="20" length="3000" shape="0,0 3000,0"/>
    </edge>
    <junction id="begin" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,3.2"/>
    <junction id="end" type="dead_end" x="3000" y="0" incLanes="road_0" intLanes=""
              shape="3000,0 3000,3.2"/>
</net>"""
CARS = """<routes>
    <vType id="calm" sigma="0" speedFactor="0.7" speedDev="0"/>
    <vType id="hasty" tau="0.2" minGap="0.5" accel="3.5" sigma="0" speedDev="0"
           actionStepLength="1.0"/>
    <route id="along" edges="road"/>
    <vehicle id="lead" type="calm" route="along" depart="0" departPos="150" departSpeed="14"/>
    <vehicle id="ego" type="hasty" route="along" depart="0" departPos="60" departSpeed="20">
        {ssm}
    </vehicle>
    {others}
</routes>"""


@pytest.fixture
def road(tmp_path):
    """Starts the simulation anew; returns libsumo."""

    def start(*options, others="", ssm=""):
        if libsumo.simulation.isLoaded():
            libsumo.close()
        (tmp_path / "road.net.xml").write_text(NET)
        (tmp_path / "cars.rou.xml").write_text(CARS.format(others=others, ssm=ssm))
        files = ["-n", str(tmp_path / "road.net.xml"), "-r", str(tmp_path / "cars.rou.xml")]
        quiet = ["--no-step-log", "--no-warnings", "--collision.action", "warn"]
        libsumo.start(["sumo", *files, *quiet, "--step-length", "0.1", *options])
        return libsumo

    yield start
    if libsumo.simulation.isLoaded():
        libsumo.close()


def drive(sumo, seconds, brakes_at=15.0):
    """Drive on; the first car brakes in full at a time, to a standstill. Returns ego's speeds."""
    speeds = []
    for _ in range(round(seconds / sumo.simulation.getDeltaT())):
        if sumo.simulation.getTime() >= brakes_at and "lead" in sumo.vehicle.getIDList():
            sumo.vehicle.setSpeedMode("lead", 0)
            speed = sumo.vehicle.getSpeed("lead")
            sumo.vehicle.setSpeed("lead", max(0.0, speed - 8.0 * sumo.simulation.getDeltaT()))
        sumo.simulationStep()
        if "ego" in sumo.vehicle.getIDList():
            speeds.append(sumo.vehicle.getSpeed("ego"))
    return speeds

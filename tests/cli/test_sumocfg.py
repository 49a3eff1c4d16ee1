"""`evofsm drive my.sumocfg`."""

import json
import re

import pytest
from tests.cli.test_watching import drive

from evofsm.cli.driving import trace_configuration
from evofsm.cli.options import reading_of
from evofsm.cli.watch import _is_log
from evofsm.cli.watch.session import watched_log
from evofsm.cli.watch.words import tell

CARS = """<routes>
    <vType id="calm" sigma="0" speedFactor="0.4" speedDev="0"/>
    <vType id="hasty" tau="0.2" minGap="0.5" accel="3.5" sigma="0" speedDev="0"
           actionStepLength="1.5"/>
    <vTypeDistribution id="any" vTypes="calm hasty"/>
    <route id="along" edges="road"/>
    <vehicle id="lead" type="calm" route="along" depart="0" departPos="400"/>
    <vehicle id="ego" type="hasty" route="along" depart="0" departPos="0" departSpeed="20"/>
</routes>"""
CONFIGURATION = """<configuration>
    <net-file value="road.net.xml"/>
    <route-files value="cars.rou.xml"/>
    <step-length value="0.1"/>
    <collision.action value="warn"/>
    <no-warnings value="true"/>
    <end value="80"/>
    <remote-port value="8813"/><num-clients value="2"/>
</configuration>"""


@pytest.fixture
def configuration(tmp_path, sumo_road):
    sumo_road(tmp_path, 1500)
    (tmp_path / "cars.rou.xml").write_text(CARS)
    (tmp_path / "my.sumocfg").write_text(CONFIGURATION)
    return tmp_path / "my.sumocfg"


def test_guards_act_where_they_are_told_to(evofsm, configuration):
    found = json.loads(evofsm("drive", configuration, "--vehicles", "type:hasty", "--json").output)
    alone = found["alone"]
    assert alone["collisions"] == alone["of_guarded"] > 0
    assert (found["collisions"], found["cars"]) == (0, 1)
    assert found["speed"] > 0.9 * alone["speed"]
    configuration = configuration.rename(configuration.with_name("my.sumo.cfg"))
    some = evofsm("drive", configuration, "--vehicles", "ego,eg")
    assert re.search(r"collisions +[1-9] +0\n", some.stdout)
    assert some.stderr.endswith("never came: eg\n")
    written = '<random value="true"/><statistic-output value="of.xml"/></configuration>'
    configuration.write_text(CONFIGURATION.replace("</configuration>", written))
    assert "draw other numbers" in evofsm("drive", configuration, "--vehicles", "ego").stderr
    assert (configuration.parent / "alone.of.xml").exists()
    assert (configuration.parent / "of.xml").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--mode", "off"], "act or shadow"),
        (["--vehicles", "lots%"], "vehicles is"),
        (["--seed", "0", "--reviser", "none"], "--reviser, --seed: only for families"),
        (["--vehicles", "type:hatsy"], "types are calm, hasty, ids ego, lead"),
        (["--vehicles", "1"], "nothing was guarded"),  # an id, no share
        (["--vehicles", "0.1%"], "it takes none of 2 cars in 80 s"),
    ],
)
def test_what_does_not_hold_for_a_configuration_is_refused(refused, configuration, options, said):
    assert said in refused("drive", configuration, *options)


def test_a_configuration_that_sumo_refuses_is_one_line(refused, configuration):
    (configuration.parent / "cars.rou.xml").unlink()
    assert "SUMO refuses it" in refused("drive", configuration)
    assert "no such file" in refused("drive", configuration.parent / "none.sumocfg")


@pytest.mark.parametrize("afterwards", ["teleport", "warn"])
def test_what_a_configuration_drives_is_watched_in_shadow_mode(configuration, tmp_path, afterwards):
    configuration.write_text(CONFIGURATION.replace('"warn"', f'"{afterwards}"'))
    log = tmp_path / "my.xml"
    assert trace_configuration(configuration, log, 30.0, 10**6)[:2] == (30.0, True)
    assert trace_configuration(configuration, log, 30.0, 40)[0] < 30.0
    *whole, collisions = trace_configuration(configuration, log, 600.0, 10**6)
    assert whole == [80.0, False]
    recorded = watched_log(str(log), reading_of(), collisions=collisions)
    assert recorded.start.cases[0] == "ego behind lead, from 0.0 s (collision)"
    frames = drive(recorded)
    met = collisions["ego behind lead"][0]  # whom SUMO takes away is not seen then
    assert frames[-1].time == pytest.approx(met - 0.1 * (afterwards == "teleport"), abs=0.01)
    told = tell(frames[-1], recorded.start)
    assert told.headline == "Collision (by SUMO)"
    assert "only watched, in shadow mode" in told.done
    assert "The reviser" not in told.done
    assert _is_log(str(configuration))

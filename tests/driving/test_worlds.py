import math
from dataclasses import replace
from pathlib import Path

import libsumo
import numpy as np
import pytest

from evofsm.driving import IDM, Body, ChangingIDM, KinematicWorld, Leader, Scenario, SumoWorld
from evofsm.driving.scenarios import Behind, CutIn, Sensors
from evofsm.driving.world import REALISED
from evofsm.paper import Settings
from evofsm.paper.runs import CASES

SETTINGS = Settings.load()
NORMAL = IDM(1.25, 25.0, 2.0, 1.5, 2.0)
GOLDEN = Path(__file__).parents[1] / "golden" / "paper_four_runs.npz"


def test_the_closed_form_drives_the_golden_runs():
    golden, world = np.load(GOLDEN)["observations"], KinematicWorld()
    runs = [world.run(SETTINGS.scenario, SETTINGS.drivers[case]).observations for case in CASES]
    assert np.abs(np.concatenate(runs) - golden).max() < 1e-9


def test_sumo_itself_reports_the_collision_at_the_last_step():
    reports = []
    with SumoWorld() as world, world.open(SETTINGS.scenario) as road:
        while not road.over:
            road.advance(SETTINGS.drivers[1].propose(road.observation, road.time).action)
            reports.append(len(libsumo.simulation.getCollisions()))
        driven = road.episode().observations
    assert np.array_equal(world.run(SETTINGS.scenario, SETTINGS.drivers[1]).observations, driven)
    assert reports[-1] == sum(reports) == 1


def test_where_a_library_of_the_system_is_missing_sumo_says_which(monkeypatch):
    def without_x11(name):
        raise ImportError("libX11.so.6: cannot open shared object file")

    monkeypatch.setattr("evofsm.driving.sumo.import_module", without_x11)
    with pytest.raises(ImportError, match=r"'sumo' needs libsumo, .* cannot be loaded: libX11"):
        SumoWorld()


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_controller_that_proposes_no_number_is_named(wrong):
    with pytest.raises(ValueError, match="controller proposed"):
        KinematicWorld().run(SETTINGS.scenario, lambda z: wrong)


@pytest.mark.parametrize(
    ("what", "change", "word"),
    [
        ("scenario", {"initial_gap": 0.0}, "initial_gap"),
        ("scenario", {"dt": 0.0}, "dt"),
        ("scenario", {"duration": 0.01}, "two steps"),
        ("leader", {"brake_decel": -9.0}, "brake_decel"),
        ("leader", {"brake_time": math.nan}, "brake_time"),
        ("leader", {"waves": ((2.0, 1.0), (1.0, 1.0))}, "in order"),
        ("body", {"lowest": 3.0, "highest": 2.0}, "body's bounds"),
        ("sensors", {"delay": -0.1}, "delay"),
        ("driver", {"accel": 0.0}, "accel"),
        ("driver", {"min_gap": -1.0}, "min_gap"),
        ("driver", {"desired_speed": math.nan}, "desired_speed"),
        ("driver", {"lowest": 3.0, "highest": 2.5}, "bounds"),
        *(("turns", {"changes": ((at, NORMAL),)}, "changes at") for at in (math.nan, -1.0)),
    ],
)
def test_what_is_impossible_is_refused_by_name(what, change, word):
    ours = {"scenario": SETTINGS.scenario, "driver": NORMAL, "turns": ChangingIDM(NORMAL, ())}
    with pytest.raises(ValueError, match=word):
        replace(ours.get(what) or getattr(SETTINGS.scenario, what), **change)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        *(({"dt": dt}, "whole milliseconds") for dt in (0.0125, 0.0005)),
        ({"duration": 5000.0}, "beyond the road"),
    ],
)
def test_what_sumos_clock_or_road_cannot_hold_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        SumoWorld().run(replace(SETTINGS.scenario, **change), SETTINGS.drivers[1])


def test_a_second_simulation_in_the_process_is_refused_until_the_first_ends_or_is_closed():
    world, short = SumoWorld(), replace(SETTINGS.scenario, duration=0.5)
    before = world.run(short, SETTINGS.drivers[1])
    for end in (lambda: None, libsumo.close):  # by itself, and from outside
        with world.open(short):
            with pytest.raises(RuntimeError, match="another process"):
                SumoWorld().run(short, SETTINGS.drivers[1])
            end()
        after = world.run(short, SETTINGS.drivers[1])
        assert np.array_equal(before.observations, after.observations)


IDM_LEADER = IDM(1.2, 25.0, 1.0, 1.0, 2.5)
FULL = Leader(IDM_LEADER, brake_decel=5.0, brake_time=8.0, initial_speed=12.0)
FULL = replace(FULL, waves=((1.0, -2.0), (3.0, 1.5)), cut_in=CutIn(5.0, gap=9.0, speed=11.0))
FULL = Scenario(FULL, initial_gap=20.0, initial_speed=14.0, duration=20.0)
FULL = replace(
    FULL,
    body=Body(lowest=-6.0, highest=2.0, delay=0.2, jerk=15.0),
    sensors=Sensors(gap_noise=0.5, speed_noise=0.3, delay=0.2, seed=3),
    behind=Behind(IDM(1.25, 25.0, 2.0, 1.0, 2.0, lowest=-8.0), gap=15.0),
)


# SUMO does not insert a car that is too fast for the one ahead.
CLOSE = Leader(IDM_LEADER, brake_decel=6.0, brake_time=0.0, initial_speed=14.0)
CLOSE = Scenario(CLOSE, initial_gap=6.0, initial_speed=14.0, duration=5.0)


@pytest.mark.parametrize(
    ("scenario", "driver"),
    [
        *((SETTINGS.scenario, SETTINGS.drivers[case]) for case in CASES),
        (FULL, IDM(2.25, 28.0, 0.8, 0.8, 2.0, lowest=-8.0, highest=2.5)),
        (CLOSE, SETTINGS.drivers[1]),
    ],
    ids=[*CASES, "all that there is", "close and under way"],
)
def test_both_worlds_agree_at_every_step(scenario, driver):
    closed_form = KinematicWorld().run(scenario, driver)
    with SumoWorld() as world:
        in_sumo = world.run(scenario, driver)
    np.testing.assert_allclose(in_sumo.record, closed_form.record, rtol=0.0, atol=1e-9)
    assert len(closed_form.time) > 900 or scenario is not FULL


def test_waves_then_the_brake_move_the_leader_whom_a_cut_in_replaces_at_its_time():
    episode = KinematicWorld().run(FULL, SETTINGS.drivers[2])
    assert episode.observations[500, 0] == pytest.approx(9.0)
    assert episode.observations[500, 2] == 11.0
    assert episode.observations[499, 2] != pytest.approx(11.0, abs=0.5)
    accelerations = episode.leader_accelerations
    assert accelerations[0] == IDM_LEADER.propose(np.array([np.inf, 12.0, 0.0])).action
    assert (accelerations[100:300] == -2.0).all()
    assert (accelerations[300:800] == 1.5).all()
    assert (accelerations[800:] == -5.0).all()


def test_a_body_is_late_limited_and_smooth():
    scenario = replace(FULL, sensors=Sensors(), behind=None)
    episode = KinematicWorld().run(scenario, lambda z: -9.0)
    realised = episode.record[:, REALISED]
    assert (realised[:20] == 0.0).all()
    assert np.diff(realised[:100]).min() == pytest.approx(-0.15)
    assert realised.min() == -6.0


def test_sensors_see_late_and_with_the_noise_of_their_seed():
    seen = []
    episode = KinematicWorld().run(replace(FULL, duration=5.0), lambda z: seen.append(z) or 0.0)
    late = np.array(seen)[20:] - episode.observations[:-20]
    assert late[:, 0].std() == pytest.approx(0.5, rel=0.2)
    assert late[:, 1].std() == pytest.approx(0.3, rel=0.2)


def test_who_is_asked_at_an_interval_keeps_its_command_between():
    seldom = KinematicWorld().run(FULL, SETTINGS.drivers[1], 0.25)
    commands = seldom.accelerations[:100].reshape(4, 25)
    assert (commands == commands[:, :1]).all()


@pytest.mark.parametrize("gap", [0.5, 0.0, -3.0])
def test_bounds_of_a_driver_hold_also_at_and_after_a_collision(gap):
    assert replace(NORMAL, lowest=-4.0).propose(np.array([gap, 20.0, 0.0])).action == -4.0

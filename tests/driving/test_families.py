"""Families of scenarios: what each states, how they are drawn, and files of one's own."""

import hashlib
import pickle
import subprocess
import sys
from dataclasses import asdict, replace

import numpy as np
import pytest

from evofsm.driving import FAMILIES, KinematicWorld, drive, load_family, unrevised_guard
from evofsm.driving.family import SWITCHES
from evofsm.driving.measures import is_dead_end
from evofsm.paper import Settings

LOADED = {name: load_family(name) for name in FAMILIES}
BEFORE_AND_AFTER = [
    one for family in LOADED.values() for one in (family, family.shifted) if one is not None
]

#: Digests of what is drawn, as it was when the numbers of the docs were measured.
DRAWN = {
    "paper": "580a0d8a25eb",
    "emergency": "89a3ba97fb6a",
    "stop_and_go": "79c43b869921",
    "cut_in": "3a20360498d0",
    "ncap": "3045a5306f57",
    "r157": "24ed00aabba7",
    "shift": "3dd455625764",
    "shift_leader": "a702bb3c19fe",
    "weak_brakes": "afc1ca0c95ce",
    "rare": "ad799a00ca9d",
}

MINE = """
from evofsm.driving import IDM, Body, Family, Leader, Scenario

def make(numbers):
    speed = numbers.between("values.speed", 10.0, 20.0)
    calm = IDM(1.5, 25.0, 1.0, 0.5, 2.0, lowest=-3.0, highest=2.0)
    leader = Leader(calm, brake_decel=5.0, brake_time=10.0, initial_speed=speed)
    return Scenario(leader, initial_gap=20.0, initial_speed=speed), calm

family = Family("mine", "One of mine.", make, -3.0, 2.0, decel=3.0, leader_decel=5.0, interval=0.5)
"""


@pytest.fixture
def mine(tmp_path):
    """A file of the user's own, with some of its text replaced."""

    def write(before="", after=""):
        assert before in MINE
        path = tmp_path / "mine.py"
        path.write_text(MINE.replace(before, after, 1))
        return path

    return write


# -- What every family is held to -----------------------------------------------------------------


@pytest.mark.parametrize("name", FAMILIES)
def test_every_family_drives_with_every_switch(name):
    family = LOADED[name]
    assert (family.name, family.interval, family.actions.outside) == (name, 0.25, "clip")
    plain = family.draw(3, 1)
    for switch in SWITCHES:
        switched = load_family(f"{name}+{switch}").draw(3, 1)
        assert switched.controller == plain.controller
        assert switched.scenario.leader == plain.scenario.leader
        assert switched.scenario != plain.scenario
        drive(unrevised_guard(family), switched)


@pytest.mark.parametrize("family", BEFORE_AND_AFTER, ids=lambda family: family.name)
def test_limits_are_true_and_reached_and_no_run_starts_in_a_dead_end(family):
    hardest = []
    for index in range(200):
        scenario, controller, _ = family.draw(1, index, "test")
        leader = scenario.leader
        assert (controller.parameters[:, 7] == family.actions.low).all()
        assert (controller.parameters[:, 8] == family.actions.high).all()
        assert max(scenario.body.lowest, family.actions.low) == -family.decel
        hardest.append(max([leader.brake_decel, *(-wave for _, wave in leader.waves)]))
        start = [scenario.initial_gap, scenario.initial_speed, leader.initial_speed]
        assert not is_dead_end(np.array(start), family.decel, family.leader_decel)
    assert 0.9 * family.leader_decel < max(hardest) <= family.leader_decel


# -- How draws are made ---------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "digest"), DRAWN.items())
def test_draws_stay_what_they_were(name, digest):
    """Numbers of the README and of the docs hang on them."""
    before = load_family(name)
    families = (before, before.with_switches(SWITCHES), before.shifted or before)
    keys = [(s, i, of) for s in (0, 7) for i in range(8) for of in ("train", "test")]
    drawn = repr([family.draw(*key) for family in families for key in keys])
    assert hashlib.sha256(drawn.encode()).hexdigest()[:12] == digest


def test_switches_are_on_before_and_after_a_shift():
    body = load_family("shift+jerk").shifted.draw(0, 0).scenario.body
    assert body == replace(LOADED["shift"].shifted.draw(0, 0).scenario.body, jerk=15.0)


# -- What happens in them -------------------------------------------------------------------------


def test_paper_is_what_the_study_drives():
    family, settings = LOADED["paper"], Settings.load()
    for case in range(1, 5):
        scenario, controller, _ = family.draw(0, case - 1)
        assert controller == settings.drivers[case]
        sensors = settings.scenario.sensors
        assert replace(scenario, duration=35.0, sensors=sensors) == settings.scenario
        driven = drive(unrevised_guard(family), family.draw(0, case - 1))
        assert driven.collided == (case in (1, 4))
    assert asdict(family.actions) == asdict(settings.actions) | {"low": -settings.decel}


def test_in_emergency_the_unrevised_collide_and_in_rare_they_seldom_do():
    for name, low, high in (("emergency", 0.93, 0.98), ("rare", 0.02, 0.16)):
        family = LOADED[name]
        draws = [family.draw(1, k, "test")[:2] for k in range(150)]
        runs = [KinematicWorld().run(*draw, family.interval) for draw in draws]
        assert low <= np.mean([run.collided for run in runs]) <= high


# -- Files of one's own ---------------------------------------------------------------------------


def test_a_file_of_ones_own_is_a_family_with_switches_and_in_other_processes(mine):
    path = mine()
    family = load_family(f"{path}+noise")
    assert (family.name, family.about, family.interval) == ("mine", "One of mine.", 0.5)
    draw = family.draw(1, 2)
    assert draw.variant == "mine"
    assert draw.scenario.sensors.gap_noise == 0.5
    assert drive(unrevised_guard(family), draw).decisions
    program = "import pickle, sys; print(pickle.load(sys.stdin.buffer).draw(1, 2))"
    told = subprocess.run(
        [sys.executable, "-c", program], input=pickle.dumps(family), capture_output=True, check=True
    )
    assert told.stdout.decode().strip() == repr(draw)
    parameters = FAMILIES["emergency"](low=-4.0, decel=3.0, leader_decel=6.0)
    assert pickle.loads(pickle.dumps(parameters)).draw(0, 0) == parameters.draw(0, 0)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("interval=0.5", "interval=0.0", r"mine\.py.*: family's interval is 0\.0; it must be posi"),
        ("leader_decel=5.0", "leader_decel=4.0", r"a leader brakes by 5 m/s², but leader_decel is"),
        ("make, -3.0", "make, -4.0", "can brake by 4 m/s², but decel is 3; bound its body"),
        ("brake_time=10.0", "brake_time=-1.0", r"mine\.py.*: leader's brake_time is -1"),
        ("initial_gap=20.0", "initial_gap='far'", r"mine\.py, line \d+, in make: TypeError: "),
        ("speed), calm", "speed), max", "who drives is .*; make gives an IDM or ChangingIDM"),
        ("10.0, 20.0", "20.0, 10.0", r"values\.speed is drawn from 20\.0 to 10\.0"),
        ("return Scenario", "return Scene", r"mine\.py, line .*: NameError: .*Scene"),
        ("family = Family", "mine = Family", "it defines no Family that is called family"),
        ("def make", "def", r"mine\.py: SyntaxError"),
    ],
)
def test_a_file_with_a_mistake_is_refused_with_its_name(mine, before, after, message):
    with pytest.raises(ValueError, match=message):
        load_family(mine(before, after))


@pytest.mark.parametrize(
    ("name", "which", "message"),
    [
        ("emergncy", (), "no family .* 'emergncy'; there are paper, emergency"),
        ("nowhere/none.py", (), r"no family .*none\.py"),
        ("emergency+fog", (), "no switch 'fog'; there are noise, delay"),
        ("emergency", (-1, 0, "train"), "seed is -1; it must be from 0"),
        ("emergency", (0, 2**32, "train"), "index is .* it must be from 0"),
        ("emergency", (0, 0, "validation"), "one of train, test"),
    ],
)
def test_a_family_or_a_draw_that_is_none_is_refused(name, which, message):
    with pytest.raises(ValueError, match=message):
        load_family(name).draw(*which)

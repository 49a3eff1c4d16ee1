import importlib.util
import math
from dataclasses import asdict, replace
from importlib.resources import files

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evofsm.driving.drivers import IDM, ChangingIDM
from evofsm.driving.episodes import drive, unrevised_guard
from evofsm.driving.families.family import FAMILIES, SWITCHES, load_family
from evofsm.driving.families.numbers import Numbers
from evofsm.driving.measures import is_dead_end
from evofsm.paper.settings import Settings

SEEDS = st.integers(0, 2**32 - 1)
LOADED = {name: load_family(name) for name in FAMILIES}
#: In these nothing is drawn at random.
FIXED = ("paper", "r157")

USERS_OWN = """
about = "One of mine."
interval = 0.5

[actions]
low = -3.0
high = 2.0
width = 0.5

[limits]
decel = 3.0
leader_decel = 5.0

[values]
speed = [10.0, 20.0]

[scenario]
initial_gap = { of = "speed", times = [1.0, 2.0], plus = 2.0 }
initial_speed = { of = "speed" }

[leader]
driver = "me"
initial_speed = { of = "speed" }
brake_decel = { one_of = [2.0, [4.0, 5.0]] }
brake_time = 10.0

[follower]
driver = "me"

[drivers.me]
accel = 1.5
desired_speed = 25.0
min_gap = 1.0
time_headway = 0.5
decel = 2.0
lowest = -3.0
highest = 2.0
"""


@pytest.fixture
def own(tmp_path):
    """A family from a file of the user's own, with some of its text replaced, and more of it."""

    def load(before="", after="", more=""):
        assert before in USERS_OWN
        path = tmp_path / "mine.toml"
        path.write_text(USERS_OWN.replace(before, after, 1) + more)
        return load_family(path)

    return load


def drive_many(family, count):
    return [drive(unrevised_guard(family), family.draw(1, index, "test")) for index in range(count)]


def dead_end_share(family, episodes):
    Z = np.concatenate([episode.observations for episode in episodes])
    return float(is_dead_end(Z, family.decel, family.leader_decel).mean())


# What every family is held to


def test_every_file_but_the_switches_is_a_family():
    names = {file.name for file in files("evofsm.driving.families").iterdir()}
    assert {name for name in names if name.endswith(".toml")} == {
        *(f"{name}.toml" for name in FAMILIES),
        "switches.toml",
    }


@pytest.mark.parametrize("name", FAMILIES)
def test_every_family_drives(name):
    family = LOADED[name]
    assert family.name == name
    assert family.about.endswith(".")
    assert family.interval == 0.25
    assert family.actions.outside == "clip"
    for index in range(20):
        drive(unrevised_guard(family), family.draw(3, index))


@pytest.mark.parametrize("name", FAMILIES)
@pytest.mark.parametrize("switch", SWITCHES)
def test_every_family_drives_with_every_switch(name, switch):
    family = LOADED[name].with_switches([switch])
    plain, switched = LOADED[name].draw(3, 1), family.draw(3, 1)
    assert switched.controller == plain.controller
    assert switched.scenario.leader == plain.scenario.leader
    assert switched.scenario != plain.scenario
    drive(unrevised_guard(family), switched)


@pytest.mark.parametrize("name", FAMILIES)
def test_the_controller_is_bounded_as_the_actions_are(name):
    family = LOADED[name]
    for index in range(20):
        controller = family.draw(5, index).controller
        assert (controller.parameters[:, 7] == family.actions.low).all()
        assert (controller.parameters[:, 8] == family.actions.high).all()


@pytest.mark.parametrize("name", FAMILIES)
def test_the_limits_are_true_and_reached(name):
    for family in filter(None, (LOADED[name], LOADED[name].shifted)):
        hardest = []
        for index in range(200):
            draw = family.draw(1, index)
            body, leader = draw.scenario.body, draw.scenario.leader
            assert max(body.lowest, family.actions.low) == -family.decel
            hardest.append(max([leader.brake_decel, *(-wave for _, wave in leader.waves)]))
        assert 0.9 * family.leader_decel < max(hardest) <= family.leader_decel


@pytest.mark.parametrize("name", FAMILIES)
def test_no_run_starts_in_a_dead_end(name):
    for family in filter(None, (LOADED[name], LOADED[name].shifted)):
        for index in range(200):
            scenario = family.draw(1, index, "test").scenario
            start = [scenario.initial_gap, scenario.initial_speed, scenario.leader.initial_speed]
            assert not is_dead_end(np.array(start), family.decel, family.leader_decel)


# How draws are made


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
@given(seed=SEEDS, index=st.integers(0, 10_000), split=st.sampled_from(["train", "test"]))
def test_a_draw_is_always_the_same(name, seed, index, split):
    again = load_family(name) if index == 0 else LOADED[name]
    assert LOADED[name].draw(seed, index, split) == again.draw(seed, index, split)


@pytest.mark.parametrize("name", [name for name in FAMILIES if name not in FIXED])
def test_no_two_draws_are_the_same_and_training_and_test_never_meet(name):
    family = LOADED[name].with_switches(["noise"])
    draws = [
        repr(family.draw(seed, index, split))
        for seed in (0, 1)
        for index in range(100)
        for split in ("train", "test")
    ]
    assert len(set(draws)) == len(draws)


def test_the_noise_is_another_one_in_every_draw():
    family = LOADED["paper"].with_switches(["noise"])
    seeds = {
        family.draw(seed, index, split).scenario.sensors.seed
        for seed in (0, 1)
        for index in range(20)
        for split in ("train", "test")
    }
    assert len(seeds) == 80


@given(seed=SEEDS, index=SEEDS)
def test_emergency_keeps_to_its_ranges(seed, index):
    family = LOADED["emergency"]
    scenario, controller, variant = family.draw(seed, index)
    assert variant == "emergency"
    assert 2.0 <= scenario.initial_gap <= 30.0
    assert 5.0 <= scenario.leader.brake_time <= 30.0
    assert 2.5 <= scenario.leader.brake_decel <= 4.5
    assert scenario.leader.driver == IDM(1.2, 25.0, 1.0, 1.0, 2.5)
    assert (scenario.initial_speed, scenario.leader.initial_speed) == (0.0, 0.0)
    assert (scenario.duration, scenario.dt) == (35.0, 0.01)
    assert (scenario.body.lowest, scenario.body.highest) == (-2.5, 2.5)
    assert controller == IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-2.5, highest=2.5)


@given(seed=SEEDS)
def test_cut_in_keeps_to_its_ranges(seed):
    scenario = LOADED["cut_in"].draw(seed, 0).scenario
    car, speed = scenario.leader.cut_in, scenario.initial_speed
    assert 20 / 3.6 - 1e-4 <= speed <= 60 / 3.6 + 1e-4
    assert 0.0 <= car.speed <= speed
    assert speed - car.speed <= 50 / 3.6
    assert scenario.leader.brake_time > car.time
    assert scenario.leader.initial_speed == speed


@given(seed=SEEDS)
def test_traffic_keeps_to_its_speeds(seed):
    leader = LOADED["stop_and_go"].draw(seed, 0).scenario.leader
    times, accelerations = np.transpose(leader.waves)
    speeds = np.cumsum(np.diff(times) * accelerations[:-1])
    assert speeds.min() > -1e-9
    assert speeds.max() < 20.0 + 1e-9
    assert times[-1] + 8.0 >= 35.0


@given(seed=SEEDS)
def test_lapses_come_in_order_and_end(seed):
    controller = LOADED["rare"].draw(seed, 0).controller
    phases = controller.parameters
    assert (np.diff(phases[:, 0]) > 0.0).all()
    assert len(phases) in (1, 3, 5)
    assert (phases[::2, 4] == 1.5).all()  # normal
    assert (phases[1::2, 4] == 0.3).all()  # aggressive


@given(
    seed=SEEDS,
    low=st.floats(-1e6, 1e6),
    width=st.floats(0.0, 1e6),
    times=st.floats(-3.0, 3.0),
)
def test_numbers_keep_to_what_the_file_says(seed, low, width, times):
    numbers = Numbers({"other": [low, low + width]}, seed, 0)
    other = numbers.draw({"of": "other"}, "a")
    assert low <= other <= low + width
    related = {"of": "other", "times": times, "plus": 1.0, "least": 0.0}
    assert numbers.draw(related, "b") == max(0.0, times * other + 1.0)
    assert numbers.draw({"one_of": [1, [2.0, 3.0]]}, "c") in (1.0, pytest.approx(2.5, abs=0.5))


@pytest.mark.parametrize(("seed", "index", "split"), [(-1, 0, "train"), (0, 2**32, "train")])
def test_a_seed_that_is_none_is_refused(seed, index, split):
    with pytest.raises(ValueError, match="it must be from 0"):
        LOADED["emergency"].draw(seed, index, split)


def test_a_split_that_is_none_is_refused():
    with pytest.raises(ValueError, match="one of train, test"):
        LOADED["emergency"].draw(0, 0, "validation")


# Variants, shifts, switches


def test_variants_come_in_turn_or_at_random():
    paper, ncap = LOADED["paper"], LOADED["ncap"]
    assert (paper.cases, LOADED["r157"].cases, ncap.cases) == (4, 7, 1)
    assert [paper.draw(0, i).variant for i in range(5)] == [*paper.variants, "case 1"]
    drawn = [ncap.draw(0, i).variant for i in range(300)]
    assert set(drawn) == set(ncap.variants) == {"CCRs", "CCRm", "CCRb"}
    assert min(map(drawn.count, ncap.variants)) > 70


def test_ncap_is_what_euro_ncap_states():
    for index in range(100):
        scenario, _, variant = LOADED["ncap"].draw(0, index)
        ego, leader = scenario.initial_speed * 3.6, scenario.leader
        target = leader.initial_speed * 3.6
        if variant == "CCRb":
            assert ego == target == pytest.approx(50, abs=1e-3)
            assert scenario.initial_gap in (12.0, 40.0)
            assert leader.brake_decel in (2.0, 6.0)
            assert leader.brake_time == 0.0
            continue
        assert target == pytest.approx({"CCRs": 0, "CCRm": 20}[variant], abs=1e-3)
        assert {"CCRs": 10, "CCRm": 30}[variant] - 1e-3 <= ego <= 80 + 1e-3
        assert scenario.initial_gap == pytest.approx((ego - target) / 3.6 * 4.0, abs=1e-3)
        assert leader.brake_time == math.inf


def test_r157_is_what_the_regulation_states():
    pairs = [(7.2, 1.0), (10, 1.1), (20, 1.2), (30, 1.3), (40, 1.4), (50, 1.5), (60, 1.6)]
    for index, (speed, headway) in enumerate(pairs):
        scenario, _, variant = LOADED["r157"].draw(0, index)
        assert variant == f"{speed:g} km/h"
        assert scenario.initial_speed * 3.6 == pytest.approx(speed, abs=1e-3)
        assert scenario.leader.initial_speed == scenario.initial_speed
        assert scenario.initial_gap == pytest.approx(scenario.initial_speed * headway)
        assert (scenario.leader.brake_decel, scenario.leader.brake_time) == (6.0, 0.0)


@given(seed=SEEDS)
def test_a_shift_changes_what_it_states_and_nothing_else(seed):
    family = LOADED["shift"]
    before, after = family.draw(seed, 0), family.shifted.draw(seed, 0)
    body = replace(before.scenario.body, lowest=-2.5)
    assert after == before._replace(scenario=replace(before.scenario, body=body))
    assert (family.decel, family.shifted.decel) == (4.5, 2.5)
    assert family.leader_decel == family.shifted.leader_decel
    assert family.actions == family.shifted.actions

    family = LOADED["shift_leader"]
    before, after = family.draw(seed, 0), family.shifted.draw(seed, 0)
    leader = replace(before.scenario.leader, brake_decel=after.scenario.leader.brake_decel)
    assert after == before._replace(scenario=replace(before.scenario, leader=leader))
    assert before.scenario.leader.brake_decel <= 6.0 <= leader.brake_decel <= 9.0
    assert (family.leader_decel, family.shifted.leader_decel) == (6.0, 9.0)


def test_only_some_families_shift_and_only_once():
    shifting = {name for name, family in LOADED.items() if family.shifted is not None}
    assert shifting == {"shift", "shift_leader"}
    assert LOADED["shift"].shifted.shifted is None


def test_switches_and_a_shift_go_together_in_either_order():
    one = LOADED["shift"].with_switches(["actuator", "jerk"]).shifted
    other = LOADED["shift"].shifted.with_switches(["actuator", "jerk"])
    assert one.draw(0, 0) == other.draw(0, 0)
    assert one.draw(0, 0).scenario.body == replace(
        LOADED["shift"].shifted.draw(0, 0).scenario.body, delay=0.2, jerk=15.0
    )


def test_switches_switch_on_what_they_say():
    scenario = LOADED["emergency"].with_switches(SWITCHES).draw(0, 0).scenario
    sensors, body, behind = scenario.sensors, scenario.body, scenario.behind
    assert (sensors.gap_noise, sensors.speed_noise, sensors.delay) == (0.5, 0.3, 0.2)
    assert (body.lowest, body.delay, body.jerk) == (-2.5, 0.2, 15.0)
    assert 10.0 <= behind.gap <= 40.0
    assert behind.driver.lowest == -6.0
    with pytest.raises(ValueError, match="no switch 'fog'; there are noise, delay"):
        LOADED["emergency"].with_switches(["fog"])


# What happens in them


def test_paper_is_what_the_study_drives():
    family, settings = LOADED["paper"], Settings.load()
    for case in range(1, 5):
        scenario, controller, variant = family.draw(0, case - 1)
        assert variant == f"case {case}"
        assert controller == settings.drivers[case]
        sensors = settings.scenario.sensors
        assert replace(scenario, duration=35.0, sensors=sensors) == settings.scenario
        driven = drive(unrevised_guard(family), family.draw(0, case - 1))
        assert driven.collided == (case in (1, 4))
    assert family.decel == settings.decel
    wider = asdict(settings.actions) | {"low": -settings.decel}
    assert asdict(family.actions) == wider
    assert set(settings.actions.edges) <= set(family.actions.edges)


def test_emergency_ends_in_a_collision_for_the_unrevised():
    share = np.mean([episode.collided for episode in drive_many(LOADED["emergency"], 200)])
    assert 0.93 <= share <= 0.98


@pytest.mark.slow
def test_in_rare_dead_ends_are_rare_but_there():
    family = LOADED["rare"]
    episodes = drive_many(family, 300)
    assert 0.005 < dead_end_share(family, episodes) < 0.02
    assert 0.02 < np.mean([episode.collided for episode in episodes]) < 0.15


@pytest.mark.parametrize("name", ["emergency", "stop_and_go", "cut_in"])
def test_both_worlds_agree(name):
    if importlib.util.find_spec("libsumo") is None:
        pytest.skip("libsumo is missing")
    from evofsm.driving.sumo import SumoWorld

    family = LOADED[name].with_switches(["third_car", "noise"])
    with SumoWorld() as sumo:
        for index in range(2):
            draw = family.draw(2, index)
            closed_form = drive(unrevised_guard(family), draw)
            episode = drive(unrevised_guard(family), draw, sumo)
            assert episode.observations.shape == closed_form.observations.shape
            assert np.abs(episode.observations - closed_form.observations).max() < 1e-9


# Files of one's own


def test_a_file_of_ones_own_is_a_family(own):
    family = own()
    assert (family.name, family.about, family.interval) == ("mine", "One of mine.", 0.5)
    assert (family.decel, family.leader_decel, family.cases) == (3.0, 5.0, 1)
    scenario, _, variant = family.draw(1, 2)
    assert variant == "mine"
    assert scenario.initial_speed == scenario.leader.initial_speed
    assert 1.0 <= (scenario.initial_gap - 2.0) / scenario.initial_speed <= 2.0
    drive(unrevised_guard(family), family.draw(1, 2))


def test_a_driver_changes_and_lapses_and_then_drives_as_is_due(own):
    family = own(
        'driver = "me"\n\n[drivers',
        """driver = "me"
changes = [[10.0, "calm"], [21.0, "me"]]
[follower.lapses]
driver = "wild"
count = 1
start = 20.0
duration = 5.0

[drivers""",
        "".join(
            f"\n[drivers.{name}]\naccel = 1.0\ndesired_speed = {speed}\nmin_gap = 1.0\n"
            "time_headway = 1.0\ndecel = 2.0\nlowest = -3.0\nhighest = 2.0\n"
            for name, speed in (("calm", 15.0), ("wild", 35.0))
        ),
    )
    controller = family.draw(0, 0).controller
    assert isinstance(controller, ChangingIDM)
    assert [(at, driver.desired_speed) for at, driver in controller.changes] == [
        (10.0, 15.0),
        (20.0, 35.0),
        (25.0, 25.0),
    ]


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("initial_gap", "initial_gpa", r"no 'scenario\.initial_gpa'; known are initial_gap"),
        ("[values]", "[value]", r"no 'value'; known are about"),
        ("accel = 1.5", "acel = 1.5", r"no 'drivers\.me\.acel'"),
        ("brake_time = 10.0", "brake_time = 'late'", r"leader\.brake_time is 'late'; it must be"),
        ("brake_time = 10.0", "brake_time = true", r"leader\.brake_time is True; it must be"),
        ("brake_time = 10.0", "brake_time = nan", r"leader\.brake_time is nan; it must be"),
        ("brake_time = 10.0", "brake_time = [1.0, inf]", "both ends of a range"),
        ("brake_time = 10.0", "brake_time = { one_of = [] }", "it must be a number, a range"),
        ("brake_time = 10.0", "brake_time = -1.0", "leader: leader's brake_time is -1.0"),
        ("interval = 0.5", "interval = [0.5, 1.0]", "interval is .* it must be one number"),
        ("interval = 0.5", "interval = 0", "interval is 0.0; it must be positive"),
        ("interval = 0.5", "", "interval is missing"),
        ("decel = 3.0", "", r"limits\.decel is missing"),
        ('about = "One of mine."', "about = 1", "about is 1; it must be a text"),
        ("interval = 0.5", "interval = 0.5\nin_turn = 1", "in_turn is 1; it must be true or"),
        ("[10.0, 20.0]", "[20.0, 10.0]", r"values\.speed is .* lower end .* first"),
        ("[10.0, 20.0]", "{ of = 'speed' }", "a value stands by itself"),
        ('initial_gap = { of = "speed"', 'initial_gap = { of = "sped"', "values are: speed"),
        ("times = [", "factor = [", r"initial_gap: there is no 'factor'; .* times, plus, least"),
        ("plus = 2.0", "plus = 'two'", r"initial_gap\.plus is 'two'"),
        ('driver = "me"', 'driver = "you"', r"leader\.driver is 'you', but drivers are: me"),
        ('driver = "me"\n\n[', "driver = 3\n\n[", r"follower\.driver is 3; it must be a text"),
        ("min_gap = 1.0", "", r"drivers\.me\.min_gap is missing"),
        ("brake_decel = { one_of = [2.0, [4.0, 5.0]] }", "", r"leader\.brake_decel is missing"),
        ("brake_decel = { one_of = [2.0, [4.0, 5.0]] }", "brake_decel = 6.0", "leader_decel is 5"),
        ("width = 0.5", "width = -0.5", "actions: width is -0.5"),
        ("[leader]", "[leader]\nwaves = [1.0]", r"leader\.waves is .* pairs"),
        ("[leader]", "[leader]\ntraffic.fast = 3.0", r"leader\.traffic\.slow is missing"),
        ("[follower]", "[follower]\nlapses = 3", r"follower\.lapses is 3; it must be a table"),
        ("[values]", "[values]\none_of = 3.0", "the name of a relation"),
        ("about", "= about", "is not TOML"),
        ("about", "deep = " + 10_000 * "[" + "\nabout", "is not TOML"),
        ("about", "long = " + 10_000 * "1" + "\nabout", "is not TOML"),
        ("about", "#" + (1 << 20) * "x" + "\nabout", "more than 1,048,576 bytes"),
        ("interval = 0.5", f"interval = {10**400}", "interval is 10.* it must be one number"),
        ("[10.0, 20.0]", "{ one_of = [{ of = 'speed' }] }", "a value stands by itself"),
        ("width = 0.5", "width = 1e-11", "more than 100,000 intervals"),
    ],
)
def test_a_file_with_a_mistake_is_refused_by_file_and_key(own, before, after, message):
    with pytest.raises(ValueError, match=rf"mine\.toml.*{message}"):
        own(before, after)


def test_a_follower_that_brakes_harder_than_the_limits_say_is_refused(own):
    with pytest.raises(ValueError, match=r"can brake by 4 m/s², but limits\.decel is 3"):
        own("low = -3.0", "low = -4.0")


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("[[variant]]\nbodies.lowest = -1.0", r"no 'variant\[0\]\.bodies'; known are name"),
        ("[[variant]]\nname = 1", r"variant\[0\]\.name is 1; it must be a text"),
        ("[[variant]]\nfollower.driver = 'you'", "drivers are: me"),
        ("[variant]\nname = 'one'", "variant is .* it must be a table"),
        ("[shift]\nactions.low = -1.0", r"no 'shift\.actions'"),
        ("[shift.body]\nlowest = 3.0\nhighest = 2.0", "body: body's bounds"),
        ("[[variant]]\n" * 10_001, "more than 10,000 variants"),
        ("[[variant]]\nscenario.duration = 1e12", "no more than 2,000,000 steps"),
        ("[[variant]]\nscenario.dt = 1e-300", "no more than 2,000,000 steps"),
        ("[[variant]]\nbody.delay = 1e12", "body's delay is .* no more than 2,000,000"),
        ("[[variant]]\nsensors.delay = 1e12", "sensors' delay is .* no more than 2,000,000"),
        (
            "[leader.traffic]\nfast = 9\nslow = 8\naccel = 1e99\ndecel = 1e99\n"
            "cruise = 1e-9\npause = 1e-9",
            "leader.traffic has more than 10,000 waves",
        ),
        (
            "[follower.lapses]\ncount = 1e12\ndriver = 'me'\nstart = 1.0\nduration = 1.0",
            "whole numbers up to 10,000",
        ),
        ("[follower.lapses]\ncount = 1.5\ndriver = 'me'\nstart = 1.0", "it must be whole numbers"),
        ("[follower.lapses]\ncount = 1\ndriver = 'me'\nduration = 1.0", "lapses.start is missing"),
    ],
)
def test_changes_with_a_mistake_are_refused_when_the_file_is_read(own, more, message):
    with pytest.raises(ValueError, match=rf"mine\.toml.*{message}"):
        own(more=more)


def test_a_family_that_is_none_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no family 'emergncy'; there are paper, emergency"):
        load_family("emergncy")
    with pytest.raises(ValueError, match=r"no family .*none\.toml"):
        load_family(tmp_path / "none.toml")

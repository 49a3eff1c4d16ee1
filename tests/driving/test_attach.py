"""Guards attached to a SUMO simulation of someone else's."""

import importlib
import xml.etree.ElementTree as ElementTree
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import libsumo
import numpy as np
import pytest

from evofsm import Guard, IntervalActions
from evofsm.driving import EnvelopeReviser, LatentRisk, attached, measures
from evofsm.driving.attached import attach, choose
from evofsm.driving.cars import guard_for_cars
from evofsm.driving.traffic import Role, guard_for_traffic

EXAMPLE = Path(__file__).parents[2] / "examples" / "your-own-sumo"
NO_GAP = ("--collision.mingap-factor", "0")
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
def road(tmp_path, sumo_road):
    """Starts the simulation anew; returns libsumo."""

    def start(*options, others="", ssm=""):
        if libsumo.simulation.isLoaded():
            libsumo.close()
        sumo_road(tmp_path, 3000)
        (tmp_path / "cars.rou.xml").write_text(CARS.format(others=others, ssm=ssm))
        files = ["-n", str(tmp_path / "road.net.xml"), "-r", str(tmp_path / "cars.rou.xml")]
        quiet = ["--no-step-log", "--no-warnings", "--collision.action", "warn"]
        start.options = [*files, *quiet, *options, "--step-length", "0.1"]
        libsumo.start(["sumo", *start.options])
        return libsumo

    yield start
    for each in [*attached._ATTACHED]:  # else it guards what the next test simulates
        each._listen_no_more()
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


def test_the_summary_says_what_guards_cost(road):
    alone, guarded = {}, {}
    for mode, found in (("watch", alone), ("act", guarded)):
        watch = attach(sumo := road(*NO_GAP), ["ego"], mode=mode)
        speeds = np.array(drive(sumo, 25.0))
        found |= watch.summary()
        watch.detach()
        accelerations = np.diff(speeds) / 0.1
        hard = accelerations < -5.0
        assert found["hard_brakes"] == hard[0] + (hard[1:] & ~hard[:-1]).sum()
        assert found["speed"] == pytest.approx(speeds.mean())
        assert found["time_lost"] == pytest.approx(0.1 * (1.0 - speeds / 20.0).clip(0.0).sum())
    assert (alone["collisions"], guarded["collisions"]) == (1, 0)
    assert guarded["cars"] == alone["cars"] == 1
    assert "decisions" not in alone
    assert guarded["decisions"] > guarded["limited"] > guarded["revised"] >= 0


USUAL = (
    '<vTypeDistribution id="mix"><vType id="usual" speedDev="0.1" probability="0.7"/>'
    '<vType id="truck" vClass="truck" probability="0.15"/>'
    '<vType id="bike" vClass="motorcycle" probability="0.15"/></vTypeDistribution>'
    '<flow id="car" type="mix" route="along" '
    'begin="1" end="40" period="2" departSpeed="max" departPos="0"/>'
)


@pytest.mark.parametrize("mode", ["watch", "shadow"])
def test_who_only_looks_changes_nothing(road, mode):
    def cars(sumo):
        return [(car, sumo.vehicle.getSpeed(car)) for car in sumo.vehicle.getIDList()]

    others = USUAL.replace("max", "random")  # of SUMO's own numbers
    alone = drive(sumo := road(*NO_GAP, others=others), 25.0), cars(sumo)
    sumo, told = road(*NO_GAP, others=others), []
    guards = attach(sumo, ["ego"], mode=mode, report=told.append)
    assert (drive(sumo, 25.0), cars(sumo)) == alone
    assert (mode == "watch") == (guards.guarding is None or guards.guarding.revised == 0)
    assert [each.collider for each in guards.collisions if each.collider == "ego"] == ["ego"]
    np.testing.assert_allclose([one.wish for one in told], [one.deed for one in told], atol=1e-9)


@pytest.mark.parametrize(
    ("step", "options"),  # where a step lasts as long as they keep, at the edge
    [
        pytest.param(0.1, (), marks=pytest.mark.slow),
        (0.5, ("--default.action-step-length", "1")),
        (1.0, ()),
        (1.0, ("--step-method.ballistic", "true")),
    ],
)
def test_where_drivers_keep_their_distance_guards_do_no_harm(road, step, options):
    found = []
    for mode in ("watch", "act"):
        sumo = road(others=USUAL)
        sumo.load([*road.options[:-1], str(step), "--seed", "1", *options])
        sumo.simulationStep()
        sumo.vehicle.setType("ego", "usual")  # nobody is hasty
        cars = attach(sumo, "all", mode=mode)
        drive(sumo, 40.0, brakes_at=np.inf)
        assert cars.summary().get("limited", 0) == 0  # nobody had to brake hard until now
        sumo.vehicle.setMaxSpeed("lead", 3.0)
        drive(sumo, 40.0, brakes_at=np.inf)
        sumo.vehicle.setSpeed("lead", 0.0)  # they come up to it, and creep on to `minGap`
        drive(sumo, 40.0, brakes_at=np.inf)
        found.append(cars.summary())
        cars.detach()
    alone, guarded = found
    assert guarded["revised"] == 0
    assert guarded["collisions"] == alone["collisions"] == 0
    assert guarded["hard_brakes"] <= alone["hard_brakes"] + 1
    assert guarded["speed"] >= 0.995 * alone["speed"]


@pytest.mark.parametrize("ballistic", ["true", "false"])
@pytest.mark.parametrize("options", [NO_GAP, ()])
def test_a_guarded_car_does_not_collide(road, options, ballistic):
    sumo = road(*options, "--step-method.ballistic", ballistic)
    told = []
    guards = attach(sumo, ["ego"], report=told.append)
    speeds = drive(sumo, 25.0)
    assert guards.collisions == []
    assert speeds[-1] == 0.0
    assert 0 < guards.guarding.limited < guards.guarding.decisions
    held = [one for one in told if one.revision.executed < 3.5]
    assert {(one.other, one.role) for one in held} == {("lead", Role.AHEAD)}
    for one in held:
        stands = speeds[round(one.time / 0.1)] == 0.0
        assert stands or one.deed <= one.revision.executed + 1e-6


@pytest.mark.parametrize(("mode", "vehicles"), [("act", "all"), ("act", "1%"), ("shadow", "all")])
def test_of_a_car_in_which_a_guard_acts_nothing_is_learnt(road, mode, vehicles):
    guards = attach(sumo := road(*NO_GAP), ["ego"])
    attach(sumo, vehicles, mode=mode)
    drive(sumo, 25.0)
    learnt = sum(len(brakes) for brakes in guards.guarding.leaders.values())
    assert learnt == ((mode, vehicles) != ("act", "all"))


def test_where_sumo_says_0_of_whatever_is_nearer_than_min_gap_the_car_stops(road):
    guards = attach(sumo := road(*NO_GAP), ["ego"])
    drive(sumo, 1.0)
    guards._seeing._vehicle = SimpleNamespace(**vars(sumo.vehicle))
    guards._seeing._vehicle.getLeader = lambda car, _: ("lead", 0.0)  # as at a junction
    assert drive(sumo, 8.0, brakes_at=0.0)[-1] < 0.3


def test_a_car_is_taken_over_only_where_it_has_to_be_and_handed_back(road):
    guards = attach(sumo := road(*NO_GAP), ["ego"])
    modes = [31]  # as SUMO has it
    while modes[-1] == 31:
        drive(sumo, 0.1)
        modes.append(sumo.vehicle.getSpeedMode("ego"))
    assert len(modes) > 2
    assert modes[-1] == 31 & ~4  # with harder braking allowed
    guards.detach()
    assert sumo.vehicle.getSpeedMode("ego") == 31
    assert guards.cars == []
    decisions = guards.guarding.decisions
    drive(sumo, 1.0)
    assert guards.guarding.decisions == decisions


@pytest.mark.parametrize("parking", [0, 1])
def test_stops_and_limits_stay_the_drivers(road, parking):
    stop = (
        '<vehicle id="third" type="hasty" route="along" depart="0" departPos="10">'
        f'<stop lane="road_0" endPos="300" duration="5" parking="{parking}"/></vehicle>'
    )
    sumo = road(*NO_GAP, others=stop)
    guards, here, stood = attach(sumo, "all"), 0, 0
    for _ in range(600):
        drive(sumo, 0.1, brakes_at=np.inf)
        here += sumo.vehicle.getIDCount()
        stood += sumo.vehicle.isStopped("third")
        for car in sumo.vehicle.getIDList():
            allowed = max(0.0, sumo.vehicle.getAllowedSpeed(car))  # below 0 where it parks
            assert sumo.vehicle.getSpeed(car) <= allowed + 1e-6
    assert stood > 0
    assert guards.guarding.overruled == 0
    assert guards.summary()["car_seconds"] == pytest.approx(0.1 * (here - stood))


def held(road):
    """Guards, in a simulation in which ego has just been taken over, as the first car brakes."""
    guards = attach(sumo := road(*NO_GAP), ["ego"])
    while sumo.vehicle.getSpeedMode("ego") == 31:
        drive(sumo, 0.1)
    return sumo, guards


def test_where_a_speed_limit_drops_a_guarded_car_brakes_no_harder_than_it_can(road):
    sumo, _ = held(road)
    sumo.edge.setMaxSpeed("road", 4.0)
    speeds = [sumo.vehicle.getSpeed("ego"), *drive(sumo, 4.0)]
    assert np.diff(speeds).min() >= -0.9001
    assert min(speeds) < 4.0


def test_where_sumo_itself_brakes_harder_than_a_car_can_it_is_no_script(road):
    sumo, guards = held(road)
    sumo.vehicle.setMaxSpeed("ego", 4.0)  # at once, as where lanes merge
    assert drive(sumo, 0.1)[-1] <= 4.0
    drive(sumo, 2.0, brakes_at=np.inf)
    sumo.vehicle.setMaxSpeed("ego", 50.0)
    assert drive(sumo, 20.0, brakes_at=np.inf)[-1] > 9.0  # as fast as who is ahead
    assert guards.guarding.overruled == 0


REACTS = measures.ResponsibilitySensitiveSafety(0.1, 3.5, 4.5, 9.0)
ACTIONS = IntervalActions(-9.0, 3.5, 0.3, outside="clip")
OWN = {
    "of a scene": guard_for_traffic(-9.0, 3.5, 4.5, interval=0.2),
    "of a formula": Guard.of(EnvelopeReviser(REACTS, ACTIONS, 0.1), interval=0.1, learn=False),
    "of one leader": guard_for_cars(
        -4.5, 3.5, interval=0.1, judge=LatentRisk(-4.5, 0.1, decel=4.5, leader_decel=9.0)
    ),
}


@pytest.mark.parametrize("mine", OWN.values(), ids=OWN)
def test_a_guard_of_ones_own_is_copied_and_left_as_it_was(road, mine):
    guards = attach(sumo := road(*NO_GAP), ["ego"], guard=mine)
    drive(sumo, 25.0)
    assert guards.collisions == []
    assert guards.guarding.decisions <= 25.0 / mine.interval
    if judge := getattr(mine.reviser, "risk", None):
        assert len(getattr(judge, "ahead", judge).manoeuvres) == 0


def test_a_guard_that_knows_gentler_cars_does_not_hold_back_on_a_free_road(road):
    sumo = road(*NO_GAP)
    mine = guard_for_traffic(-9.0, 1.0, 4.5, interval=0.1)
    guards = attach(sumo, ["lead"], guard=mine)
    drive(sumo, 5.0, brakes_at=np.inf)
    assert sumo.vehicle.getSpeedMode("lead") == 31
    assert guards.guarding.revised == 0


def test_who_attaches_anew_ends_what_was_attached_to_a_simulation_before(road):
    sumo = road(*NO_GAP)
    first = attach(sumo, ["ego"])
    drive(sumo, 5.0)
    sumo = road(*NO_GAP)
    second = attach(sumo, ["ego"], mode="shadow")
    decisions = first.guarding.decisions
    drive(sumo, 25.0)
    assert first.guarding.decisions == decisions
    assert second.collisions


@pytest.mark.parametrize("begin", [None, 0.3, 14.0, 1000.0, "step", "state", "start"])
def test_guards_go_on_wherever_time_moves_otherwise(road, tmp_path, begin):
    sumo, told = road(*NO_GAP), []
    guards = attach(sumo, ["ego"], report=told.append)
    drive(sumo, 1.0)
    sumo.simulation.saveState(str(tmp_path / "state.xml"))
    drive(sumo, 13.0)
    if begin == "state":
        sumo.simulation.loadState(str(tmp_path / "state.xml"))
    elif begin == "start":
        road(*NO_GAP)
    else:
        options = [*road.options[:-1], "0.05" if begin == "step" else "0.1"]
        if isinstance(begin, float):  # at 14 s time goes on as if it were the same simulation
            cars = tmp_path / "cars.rou.xml"
            cars.write_text(cars.read_text().replace('depart="0"', f'depart="{begin}"'))
            options += ["--begin", str(begin)]
        sumo.load(options)
    before, now = guards.guarding.decisions, sumo.simulation.getTime()
    is_new = pytest.warns(RuntimeWarning, match="another simulation")
    with nullcontext() if begin == "state" else is_new:
        drive(sumo, 40.0, brakes_at=now + 15.0)
    assert guards.collisions == []
    assert guards.guarding.decisions > before + 100
    assert max(abs(one.deed) for one in told) < 9.1  # no step is taken for another


def test_who_detaches_after_the_end_is_rid_of_the_guards(road):
    guards = attach(sumo := road(*NO_GAP), ["ego"])
    drive(sumo, 1.0)
    sumo.close()
    with pytest.raises(ValueError, match="no simulation of SUMO runs"):
        attach(sumo, ["ego"])
    guards.detach()
    assert guards.cars == []
    drive(road(*NO_GAP), 1.0)
    assert guards.guarding.decisions == 10


def test_where_sumo_looks_for_no_collisions_none_is_counted(road):
    sumo = road(*NO_GAP)
    sumo.load(["none" if option == "warn" else option for option in road.options])
    with pytest.warns(RuntimeWarning, match="looks for no collisions") as told:
        watch = attach(sumo, ["ego"], mode="watch")
    assert told[0].filename == __file__
    drive(sumo, 25.0)
    sumo.load(road.options)  # in this one it does
    with pytest.warns(RuntimeWarning, match="another simulation"):
        drive(sumo, 1.0)
    assert np.isnan(watch.summary()["collisions"])


def test_who_skips_steps_is_told_that_nobody_looked(road):
    sumo, told = road(*NO_GAP), []
    attach(sumo, ["ego"], report=told.append)
    drive(sumo, 1.0)
    with pytest.warns(RuntimeWarning, match="several steps at once"):
        sumo.simulationStep(5.0)
    drive(sumo, 2.0)
    assert max(abs(one.deed) for one in told) < 9.1


@pytest.mark.parametrize("driver", ["hasty", "usual"])  # whose guard acts, or has no need to
def test_who_sets_the_speed_of_a_guarded_car_is_told_that_it_is_not_guarded(road, driver):
    sumo = road(*NO_GAP, others=USUAL)
    sumo.vehicle.setType("ego", driver)
    guards = attach(sumo, ["ego"])

    def script():
        for _ in range(200):
            sumo.vehicle.setSpeedMode("ego", 0)
            sumo.vehicle.setSpeed("ego", 20.0)
            drive(sumo, 0.1, brakes_at=15.0 if driver == "hasty" else np.inf)

    with pytest.warns(RuntimeWarning, match="car ego drove otherwise than its guard"):
        script()
    assert guards.guarding.overruled > 5


def test_a_model_that_under_a_limit_drives_a_little_slower_than_it_says_is_no_script(road):
    """EIDM does."""
    vehicle = (sumo := road(*NO_GAP)).vehicle
    guards = attach(sumo, ["ego"])

    def says(car):
        return vehicle.getSpeedWithoutTraCI(car) + 0.02 * (vehicle.getSpeedMode(car) != 31)

    guards.guarding._vehicle = SimpleNamespace(**vars(vehicle) | {"getSpeedWithoutTraCI": says})
    drive(sumo, 25.0)
    assert guards.guarding.limited > 0
    assert guards.guarding.overruled == 0


def test_what_a_car_can_do_is_asked_anew_as_on_a_wet_road(road):
    guards = attach(sumo := road(*NO_GAP), ["ego"])
    drive(sumo, 5.0)
    guard = guards.guarding.cars["ego"].guard
    sumo.vehicle.setMinGap("ego", 0.6)  # of no concern to it
    drive(sumo, 0.1)
    assert guards.guarding.cars["ego"].guard is guard
    sumo.vehicle.setDecel("ego", 1.5)
    sumo.vehicle.setEmergencyDecel("ego", 1.5)
    for _ in range(20):
        before = drive(sumo, 0.1)[-1]
    speeds = np.array([before, *drive(sumo, 13.0, brakes_at=8.0)])
    assert np.diff(speeds).min() >= -0.1501
    assert guards.guarding.overruled == 0


def test_what_its_leader_can_do_is_asked_anew(road):
    sumo = road(*NO_GAP)
    sumo.vehicle.setDecel("lead", 1.0)
    sumo.vehicle.setEmergencyDecel("ego", 4.5)
    guards = attach(sumo, ["ego"])
    drive(sumo, 5.0)
    sumo.vehicle.setDecel("lead", 8.0)
    drive(sumo, 20.0)
    assert not guards.collisions
    assert [len(guards.guarding.leaders[decel]) for decel in (1.0, 8.0)] == [0, 1]


def test_whoever_is_of_the_type_now_is_guarded_and_who_is_not_is_not(road):
    sumo = road(*NO_GAP, others=USUAL)
    guards = attach(sumo, "type:hasty")
    drive(sumo, 0.5)
    sumo.vehicle.setType("ego", "usual")
    sumo.vehicle.setType("lead", "hasty")
    drive(sumo, 0.5)
    assert guards.cars == ["lead"]
    assert sumo.vehicle.getSpeedMode("ego") == 31
    sumo.vehicle.remove("lead")
    sumo.vehicle.add("lead", "along", "calm")  # another one of this name
    drive(sumo, 0.5)
    assert guards.cars == []
    assert guards.ever == {"ego", "lead"}


@pytest.mark.usefixtures("road")  # which closes it
def test_a_car_that_sumo_teleports_begins_anew(tmp_path):
    cars = tmp_path / "cars.rou.xml"
    cars.write_text(
        '<routes><vType id="late" actionStepLength="2"/><route id="way" edges="A1B1 B1C1 C1D1"/>'
        '<vehicle id="ahead" route="way" depart="0" departPos="60">'
        '<stop lane="A1B1_0" endPos="80" duration="100"/></vehicle>'
        '<vehicle id="ego" type="late" route="way" depart="0" departPos="40"/></routes>'
    )
    network = ["-n", str(EXAMPLE / "grid.net.xml.gz"), "-r", str(cars), "--time-to-teleport", "9"]
    libsumo.start(["sumo", *network, "--no-step-log", "--no-warnings"])
    guards = attach(libsumo, ["ego"])
    while "ego" not in libsumo.simulation.getStartingTeleportIDList():
        libsumo.simulationStep()
        libsumo.vehicle.setLaneChangeMode("ego", 0)
    assert guards.guarding.limited > 0
    speeds = [(libsumo.simulationStep(), libsumo.vehicle.getSpeed("ego"))[1] for _ in range(5)]
    assert min(speeds) > 5.0
    assert guards.guarding.overruled == 0


def test_a_car_that_a_script_stops_stays_stopped_until_the_script_lets_it_go(road):
    sumo, guards = held(road)
    sumo.vehicle.setSpeed("ego", 0.0)
    with pytest.warns(RuntimeWarning, match="a script"):
        speeds = drive(sumo, 15.0, brakes_at=np.inf)
    assert speeds[-1] == 0.0
    assert sumo.vehicle.getSpeedMode("ego") == 31
    overruled, now = guards.guarding.overruled, sumo.simulation.getTime()
    sumo.vehicle.setSpeed("ego", -1.0)
    assert max(drive(sumo, 25.0, brakes_at=now + 5.0)) > 10.0
    assert guards.guarding.overruled < overruled + 10  # its driver decides once a second
    assert guards.collisions == []


# -- Watching --------------------------------------------------------------------------------------


def test_sumo_as_referee_measures_the_same(road, tmp_path):
    """SUMO's SSM device, at every step."""
    given = {"measures": "TTC DRAC", "thresholds": "100 0.0", "range": "150", "extratime": "0"}
    given |= {"trajectories": "true", "file": tmp_path / "ssm.xml"}
    ssm = "".join(f'<param key="device.ssm.{key}" value="{given[key]}"/>' for key in given)
    ssm += '<param key="has.ssm.device" value="true"/>'
    sumo = road(*NO_GAP, "--precision", "6", ssm=ssm)
    watch = attach(sumo, ["ego"], mode="watch").watching
    measured = []
    for _ in range(170):
        drive(sumo, 0.1)
        measured.append((watch.ttc[0], watch.drac[0]))
    sumo.close()
    (conflict,) = ElementTree.parse(tmp_path / "ssm.xml").getroot()
    for tag, ours in zip(("TTCSpan", "DRACSpan"), np.transpose(measured), strict=True):
        theirs = conflict.find(tag).get("values").split()
        answered = [k for k, each in enumerate(theirs) if each != "NA"]
        assert len(answered) > 100
        both = np.array([(float(theirs[k]), ours[k]) for k in answered])
        np.testing.assert_allclose(both[:, 0], both[:, 1], rtol=1e-5, atol=2e-6)


def test_who_comes_towards_one_is_measured_with_a_negative_speed(road):
    watch = attach(sumo := road(*NO_GAP), ["ego"], mode="watch").watching
    angles = {"ego": 90.0, "lead": 270.0}  # as it overtakes on the oncoming lane
    watch._seeing._vehicle = SimpleNamespace(**vars(sumo.vehicle) | {"getAngle": angles.get})
    drive(sumo, 1.0)
    assert watch.observations[0, 2] == -sumo.vehicle.getSpeed("lead")
    assert watch.ttc[0] < 3.0


# -- What is refused, and which vehicles are meant -------------------------------------------------


@pytest.mark.parametrize(
    ("options", "given", "said"),
    [
        (NO_GAP, {"mode": "brake"}, "no mode 'brake'"),
        (NO_GAP, {"tolerance": 2.0}, "tolerance is 2"),
        (NO_GAP, {"regain": -1.0}, "regain is -1"),
        (NO_GAP, {"guard": guard_for_traffic(-9.0, 3.5, 4.5, 0.25)}, "no multiple"),
        ((), {"mode": "watch", "guard": guard_for_traffic(-9.0, 3.5, 4.5, 0.1)}, "asks no guard"),
        (("--mesosim",), {}, "--mesosim"),  # in which there is nobody to see
    ],
)
def test_what_cannot_be_is_refused(road, options, given, said):
    with pytest.raises(ValueError, match=said):
        attach(road(*options), "all", **given)


IDS = [str(k) for k in range(2000)]
OF_BUSES = {"7": "bus", "8": "bus@8"}  # of which a script changed one
TYPES = SimpleNamespace(kind=lambda car: OF_BUSES.get(car, "x"))


def chosen(vehicles):
    test = choose(vehicles)
    return {car for car in IDS if test(TYPES, car)}


def test_all_some_those_of_a_type_or_a_share_which_is_the_same_in_every_run():
    assert chosen("all") == chosen(1) == set(IDS)
    assert chosen(["1", "2", "gone"]) == chosen(np.array(["1", "2"])) == {"1", "2"}
    assert chosen("type:bus") == {"7", "8"}
    assert chosen("type:bu") == set()
    assert chosen(0.1) == chosen("10%")
    for name in ("", "car.", "flow_0."):
        half = sum(choose(0.5)(TYPES, f"{name}{k}") for k in range(1000))
        assert half == pytest.approx(500, abs=50)  # three standard deviations
    for wrong in ("none", "x%", "120%", "1", 0.0, -0.1, 1.5, float("nan")):
        with pytest.raises(ValueError, match="vehicles is"):
            choose(wrong)


@pytest.mark.slow
def test_in_the_example_collisions_of_hasty_cars_are_prevented_and_none_is_caused(monkeypatch):
    """A grid of streets by netgenerate, 600 cars, one in ten hasty."""
    monkeypatch.syspath_prepend(EXAMPLE)
    compare = importlib.import_module("compare")
    monkeypatch.setattr(compare, "END", 150.0)
    alone, guarded = (compare.drive(0, guarded=on) for on in (False, True))
    assert alone.by_hasty >= 10
    assert guarded.by_hasty <= 0.1 * alone.by_hasty
    assert guarded.into_hasty == 0
    assert guarded.speed >= 0.9 * alone.speed

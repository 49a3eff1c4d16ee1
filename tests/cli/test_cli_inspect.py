"""`evofsm explain`: what was learnt of a situation."""

import json

import pytest

from evofsm import EvolvingFSM, Guard
from evofsm.driving import guard_for_family, load_family, teach
from evofsm.guard import Mode


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """What unrevised driving into collisions has taught."""
    family, folder = load_family("emergency"), tmp_path_factory.mktemp("learnt")
    guard = guard_for_family(family, mode=Mode.OFF)
    teach(guard, [family.draw(0, index, split="train") for index in range(6)])
    guard.save(folder / "guard.evofsm", {"family": "emergency"})
    return folder, guard.machine


def test_states_are_explained_an_observation_is_recognised_and_an_action_counted(evofsm, saved):
    folder, machine = saved
    answer = evofsm("explain", folder, "--state", "all")
    assert answer.exit_code == 0
    told = answer.stdout.replace("\n   ", " ").splitlines()
    numbers = [line.split(":")[0] for line in told]
    assert numbers == [f"#{state + 1}" for state in range(machine.n_states)]
    assert all("m/s)" in line for line in told)
    assert max(map(len, answer.stdout.splitlines())) <= 80
    found = evofsm("explain", folder, "--observation", "9,14,14", "--action", "12", "--json")
    (one,) = json.loads(found.stdout)["situations"]
    assert one["state"] == machine.model().recognise([9.0, 14.0, 14.0]).argmax()
    assert one["here"]["episodes"] == machine.episodes[one["state"]]
    assert one["action"]["failed"] == machine.failed_after[11, one["state"]]
    assert "a(12)" in one["text"]
    assert "m/s²" in one["text"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--state", 0), "--state is 0; there are 1 to"),
        (("--observation", "a,b"), "write numbers"),
        (("--observation", "9,nan,14"), "--observation is '9,nan,14'; write numbers"),
        (("--observation", "1,2,3", "--state", 1), "name one situation"),
        (("--observation", "1,2"), "--observation has 2 values; it needs "),
        (("--state", 1, "--action", 99), "--action is 99; there are 1 to 17"),
        (("--action", 1), "name one situation"),
    ],
)
def test_what_is_not_there_is_refused_in_one_line(refused, saved, arguments, says):
    assert says in refused("explain", saved[0], *arguments)


def test_of_a_machine_it_is_said_that_failures_are_untold_and_what_was_never_seen(evofsm, tmp_path):
    machine = EvolvingFSM(1)
    machine.learn_many([[0.0], [5.0]] * 20, [0] * 40, range(0, 40, 2))
    machine.save(tmp_path / "machine")
    asked = "explain", tmp_path / "machine", "--observation", 500
    told = evofsm(*asked).stdout
    assert told.startswith("Which episodes failed is not known: nothing said so.")
    assert "Never seen" in told
    assert json.loads(evofsm(*asked, "--json").stdout)["situations"][0]["never_seen"] is True


def test_what_a_guard_has_learnt_is_said_and_drawn(evofsm, refused, tmp_path):
    guard, file, drawn = Guard(-1.0, 1.0, interval=0.1), tmp_path / "guard", tmp_path / "x.svg"
    for k, place in enumerate((0.0, 0.1, 0.2, 0.25, 0.3)):
        guard.decide([5.0, place], proposal=k % 2)
    guard.end(failed=True, observation=[5.0, 0.6])
    guard.save(file)
    log = "inspect", file, "--plot", drawn, "--log", "nowhere.csv"
    said = evofsm("inspect", file, "--plot", drawn).stdout
    assert "experience    fails where variable 2 is above 0.3" in said
    assert "<svg" in drawn.read_text()
    assert "6, one every 0.1 s" in said
    assert "neither --observe nor names= of a guard: an observation needs" in refused(*log)
    assert "is to be shown beneath a picture: --plot" in refused(*log[:2], *log[4:])
    for wrong, word in ((tmp_path, "is a folder"), (tmp_path / "x", "x.png")):
        assert word in refused("inspect", file, "--plot", wrong)
    assert {*tmp_path.iterdir()} == {file, drawn}
    (machine := EvolvingFSM(1)).learn_many([[0.0], [1.0]], [0, 0])
    machine.model().save(file)
    assert "under actions" not in evofsm("inspect", file).stdout

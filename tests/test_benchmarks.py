"""The references are writings of the same machine, and the harness judges as it says."""

import copy
import json

import numpy as np
import pytest

import clusterers
import speed
import tolerance
from evofsm.fsm.machine import EvolvingFSM
from fleets import each_step, fleet, in_blocks
from reference import NumpyFSM
from single import pair
from streams import LATTICE_RULE, LATTICES, PAPER_ROUND, lattice_stream, paper_stream
from table import Row, duration, judged, shown, worsened
from turns import compare
from vectorised import NumpyFleet

pytestmark = pytest.mark.slow

VEHICLES = 6


@pytest.fixture(scope="module")
def taught():
    return pair(7, PAPER_ROUND)


def test_numpy_over_vehicles_is_as_many_machines(taught):
    machine, reference, stream = taught
    machines = [machine.copy() for _ in range(VEHICLES)]
    for one in machines:
        one.start_episode()
    fleet = NumpyFleet(reference, VEHICLES)
    rows = np.arange(VEHICLES) * 2_003 + np.arange(400)[:, None]
    for Z, A in zip(stream.observations[rows], stream.actions[rows], strict=True):
        states, surprises = fleet.observe(Z, A)
        steps = [one.learn_one(z, a) for one, z, a in zip(machines, Z, A, strict=True)]
        assert states.tolist() == [step.state for step in steps]
        agree(surprises, [step.surprise for step in steps])
        agree(fleet.belief, [step.belief for step in steps])
    agree(fleet.centers.transpose(2, 1, 0), [one.centers for one in machines])
    agree(fleet.potentials.T, [one.potentials for one in machines])
    learnt = [one.transition_matrices for one in machines]
    agree(fleet.matrices.reshape(np.shape(learnt)), learnt)
    learnt = [one.origin_frequency for one in machines]
    agree(fleet.frequencies.reshape(np.shape(learnt)), learnt)


def agree(found, expected):
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_numpy_over_vehicles_moves_centers_too():
    rng = np.random.default_rng(3)
    reference = NumpyFSM(2, radius=0.3)
    for z in np.cumsum(rng.normal(size=(40, 2)), axis=0):
        reference.observe(z)
    assert len(reference.centers) > 1
    reference.belief, reference.radius = None, 100.0  # from now on a center moves, or none does
    singles, fleet = [copy.deepcopy(reference) for _ in range(3)], NumpyFleet(reference, 3)
    for Z in reference.mean + 0.3 * rng.normal(size=(300, 3, 2)):
        A = rng.integers(0, 2, 3)
        _, surprises = fleet.observe(Z, A)
        agree(surprises, [one.observe(z)[2] for one, z in zip(singles, Z, strict=True)])
        for one, action in zip(singles, A.tolist(), strict=True):
            one.act(action)
    agree(fleet.centers.transpose(2, 1, 0), [one.centers for one in singles])
    agree(fleet.potentials.T, [one.potentials for one in singles])
    assert all((one.centers != reference.centers).any() for one in singles)


def test_numpy_over_vehicles_refuses_to_found_a_state():
    reference = NumpyFSM(1, radius=0.01)
    for z in (0.0, 8.0):
        reference.observe(np.array([z]))
    fleet = NumpyFleet(reference, 2)
    with pytest.raises(ValueError, match="number of states is fixed"):
        fleet.observe(np.array([[0.0], [4.0]]), np.zeros(2, np.int64))


def test_vehicles_drive_on_through_the_stream_in_blocks(taught, monkeypatch):
    _, reference, stream = taught
    monkeypatch.setattr("fleets._BLOCK", 2)
    seen = []
    monkeypatch.setattr(NumpyFleet, "observe", lambda self, Z, A: seen.append((Z, A)))
    work = each_step(in_blocks(reference, 5), stream, n_vehicles=5, steps=3)
    assert work() > 0.0 < work()
    assert [len(A) for _, A in seen] == [2, 2, 1] * 6
    fourth = np.concatenate([Z for Z, _ in seen[9:12]])
    np.testing.assert_array_equal(fourth, stream.observations[3 + 13 * np.arange(5)])


@pytest.mark.parametrize("n_states", [7, 64])
def test_ours_and_the_loop_are_taught_alike(n_states):
    machine, reference, stream = pair(n_states, 50)
    for z, action in zip(stream.observations, stream.actions.tolist(), strict=True):
        step = machine.learn_one(z, action)
        state, belief, surprise = reference.observe(z)
        reference.act(action)
        assert step.state == state
        agree(step.belief, belief)
        agree(step.surprise, surprise)
    assert machine.n_states == n_states
    agree(machine.transition_matrices, reference.matrices)


@pytest.mark.parametrize("n_states", LATTICES)
def test_a_lattice_has_as_many_states_as_it_says_and_its_walk_founds_no_other(n_states):
    stream = lattice_stream(n_states, n_states + 200)
    machine = EvolvingFSM(1, rule=LATTICE_RULE)
    states = machine.learn_many(stream.observations, np.zeros_like(stream.actions)).n_states
    assert (states[n_states - 1 :] == n_states).all()


def test_beliefs_on_the_lattice_are_as_sure_as_they_should_be():
    machine = tolerance.walked(256, 17)
    spread = tolerance.perplexity(machine, tolerance.walk(256, 17, 500))
    assert 4.0 < np.median(spread) < spread.max() <= 16.0


def test_perplexity_of_a_belief_in_two_alike_is_two():
    machine = EvolvingFSM(1, radius=0.5)
    machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
    halfway = machine.centers.mean()
    stream = lattice_stream(7, 1)._replace(observations=np.array([[halfway]]))
    assert tolerance.perplexity(machine, stream._replace(actions=np.zeros(1, int))) == [2.0]


def test_a_round_of_the_paper_ends_where_another_begins():
    at_rest = paper_stream(PAPER_ROUND + 1).observations[[0, PAPER_ROUND]]
    np.testing.assert_array_equal(at_rest[0], at_rest[1])


def test_ours_and_the_reference_take_turns():
    turns = []

    def work(name, seconds):
        numbers = iter([100.0, *seconds])  # the first, which compiles, does not count
        return lambda: turns.append(name) or next(numbers)

    result = compare(
        "work", work("a", [3, 1, 2]), "b", work("b", [6, 8, 7]), 3, {"c": work("c", [1, 1, 9])}
    )
    assert turns == ["a", "b", "c"] * 4
    assert (result["ours_s"], result["reference_s"], result["beside"]) == (2, 7, {"c": 1})


def measured(ours, reference):
    return {"what": "work", "ours_s": ours, "reference": "other", "reference_s": reference}


FASTER, COST = Row(None, ">=", 10.0), Row(None, "<=", 1.25)


@pytest.mark.parametrize(
    ("row", "ours", "ratio", "reached"),
    [
        (FASTER, 1.0, 10.0, True),
        (FASTER, 1.1, 10 / 1.1, False),
        (COST, 12.5, 1.25, True),
        (COST, 13.0, 1.3, False),
        (Row(None, ">="), 20.0, 0.5, True),
    ],
)
def test_a_target_is_reached_or_missed(row, ours, ratio, reached):
    result = judged("row", row, measured(ours, 10.0))
    assert (result["ratio"], result["reached"]) == (pytest.approx(ratio), reached)
    assert ("missed" in shown(result, None)) is not reached


@pytest.mark.parametrize(
    ("row", "ours", "worse"),
    [
        (FASTER, 1.2, None),
        (FASTER, 1.3, "30%"),
        (FASTER, 0.1, None),
        (COST, 1.2, None),
        (COST, 1.3, "30%"),
        (COST, 0.1, None),
    ],
)
def test_a_ratio_may_worsen_by_the_margin_and_no_more(row, ours, worse):
    last = [judged("row", row, measured(1.0, 10.0)), judged("other", row, measured(0.01, 10.0))]
    told = worsened(judged("row", row, measured(ours, 10.0)), last)
    assert told is None if worse is None else worse in told


def test_a_ratio_on_other_cores_is_not_compared():
    last = judged("row", FASTER, measured(1.0, 10.0))
    now = judged("row", FASTER, measured(9.0, 10.0))
    assert worsened(now, [last])
    assert not worsened(now, [{**last, "cores": 1_000}])


@pytest.mark.parametrize(
    ("seconds", "text"), [(2.5e-8, "25 ns"), (1.234e-6, "1.23 µs"), (0.25, "250 ms"), (90, "90 s ")]
)
def test_durations_have_three_digits_and_a_unit(seconds, text):
    assert duration(seconds) == text


@pytest.fixture
def harness(monkeypatch, tmp_path, capsys):
    """The harness over made-up rows: exit status, what was printed, what was written."""

    def run(rows, *arguments):
        monkeypatch.setattr(speed, "ROWS", rows)
        file = tmp_path / "bench.json"
        status = speed.main(["--json", str(file), "--against", str(tmp_path / "no"), *arguments])
        return status, capsys.readouterr().out, json.loads(file.read_text())

    return run


def made_up(better, target, ours):
    return Row(lambda repeats, short: measured(ours, 10.0), better, target)


def broken(repeats, short):
    raise ZeroDivisionError


def absent(repeats, short):
    raise ModuleNotFoundError("No module named 'river'")


def test_the_harness_writes_what_it_prints_and_says_what_is_missed(harness):
    good, bad = made_up(">=", 5.0, 1.0), made_up("<=", 0.5, 6.0)
    status, out, written = harness({"good": good, "bad": bad})
    assert status == 0
    assert [result["id"] for result in written] == ["good", "bad"]
    assert {"id", "ours_s", "reference", "reference_s", "ratio"} <= written[0].keys()
    assert out.count("missed") == 1
    assert harness({"good": good, "bad": bad}, "--only", "good")[0] == 0


def test_one_row_that_fails_leaves_the_others(harness):
    good = made_up(">=", 5.0, 1.0)
    rows = {"broken": Row(broken, ">="), "absent": Row(absent, ">="), "good": good}
    status, out, written = harness(rows)
    assert status == 1
    assert [result["id"] for result in written] == ["good"]
    assert "No module named 'river'" in out


def test_the_harness_fails_where_a_ratio_is_worse_than_before(harness, tmp_path):
    last = tmp_path / "last.json"
    last.write_text(json.dumps([judged("row", FASTER, measured(0.1, 10.0))]))
    rows = {"row": made_up(">=", 5.0, 1.0)}
    assert harness(rows)[0] == 0
    status, out, _ = harness(rows, "--against", str(last))
    assert status == 1
    assert "WORSE" in out


def test_a_row_that_does_not_exist_is_refused(capsys):
    with pytest.raises(SystemExit):
        speed.main(["--only", "batch_8"])
    assert "batch_64" in capsys.readouterr().err


QUICK = "batch_7,call_64,states_1024"


def test_real_rows_run_and_the_table_is_no_wider_than_100_columns(tmp_path, capsys):
    file = tmp_path / "bench.json"
    arguments = ["--short", "--repeats", "1", "--json", str(file), "--only", QUICK]
    assert speed.main(arguments) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 100
    assert [result["id"] for result in json.loads(file.read_text())] == QUICK.split(",")
    for result in json.loads(file.read_text()):
        assert result["ours_s"] > 0.0 < result["reference_s"]


def test_a_fleet_is_measured_in_both_precisions():
    result = fleet(3, 1, True)
    assert result["ours_s"] > 0.0 < result["reference_s"]
    assert list(result["beside"]) == ["in float32"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # whatever others warn of
@pytest.mark.parametrize("row", [clusterers.stream_k_means, clusterers.db_stream])
def test_others_cluster_the_same_stream(row):
    pytest.importorskip("river")
    pytest.importorskip("deeptime")
    result = row(1, True)
    assert result["reference"].startswith("river ")
    assert any("deeptime" in what for what in result["beside"])


def test_the_table_of_states_has_a_line_for_each():
    assert len(tolerance.cost_and_memory(1, True).splitlines()) == 1 + 2 * 2

import io

import hypothesis
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evofsm.fleet.batch import Fleet
from evofsm.fsm.crowding import WhenFull
from evofsm.fsm.dynamics.dynamics import Dynamics
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.states.edges import Edges
from evofsm.fsm.states.failure import FailureSplit
from evofsm.fsm.states.novelty import Novelty
from evofsm.fsm.states.paper import Paper

Q = 4


def walks(vehicles, steps, seed=0):
    """Observations (steps, vehicles, 2) and actions; -1 where nobody acted."""
    rng = np.random.default_rng(seed)
    Z = np.cumsum(rng.normal(scale=0.4, size=(steps, vehicles, 2)), axis=0)
    return Z, rng.integers(-1, Q, (steps, vehicles))


def settings():
    return st.builds(
        dict,
        rule=st.sampled_from([Paper(), Edges(), Novelty(radius=0.7), FailureSplit(Novelty(1.0))]),
        max_states=st.sampled_from([None, 5]),
        when_full=st.sampled_from(list(WhenFull)),
        belief_tolerance=st.sampled_from([0.0, 1e-6]),
    )


@pytest.mark.slow
@hypothesis.settings(max_examples=15)
@given(settings=settings(), seed=st.integers(0, 100))
def test_each_vehicle_is_the_machine_alone_bit_for_bit(settings, seed):
    """With vehicles that enter late, are silent now and then, begin episodes, and fail."""
    vehicles, steps = 5, 60
    rng = np.random.default_rng(seed)
    Z, A = walks(vehicles, steps, seed)
    fleet = Fleet(EvolvingFSM(Q, **settings), vehicles)
    alone = [EvolvingFSM(Q, **settings) for _ in range(vehicles)]
    for t in range(steps):
        seen = np.flatnonzero(rng.random(vehicles) < 0.8)
        starts = np.flatnonzero(rng.random(len(seen)) < 0.05)
        ends = np.flatnonzero(rng.random(len(seen)) < 0.05)
        step = fleet.observe(
            Z[t, seen], A[t, seen], vehicles=seen, episode_starts=starts, failures=ends
        )
        for row, vehicle in enumerate(seen):
            trace = alone[vehicle].learn_many(
                Z[t, vehicle][None],
                A[t, vehicle][None],
                [0] * (row in starts),
                [0] * (row in ends),
            )
            assert trace.state[0] == step.state[row]
            assert trace.n_states[0] == step.n_states[row]
            assert trace.event[0] == step.event[row]
            assert trace.surprise[:1].tobytes() == step.surprise[row : row + 1].tobytes()
    for vehicle, machine in enumerate(alone):
        assert_same(fleet[vehicle], machine)


def assert_same(a, b):
    for name in ("centers", "potentials", "transition_matrices", "origin_frequency", "belief"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes()
    assert a.failures.tobytes() == b.failures.tobytes()
    assert repr(a) == repr(b)


def test_vehicles_start_with_what_the_machine_has_learnt():
    Z, A = walks(1, 50)
    machine = EvolvingFSM(Q, rule=Novelty(radius=0.5))
    machine.learn_many(Z[:, 0], A[:, 0])
    fleet = Fleet(machine, 3)
    fleet.observe(Z[:3, 0] + 9.0, [0, 1, 2])
    assert (fleet.n_states == machine.n_states + 1).all()
    assert fleet[1].state_ids.tolist() == list(range(machine.n_states + 1))
    assert machine.n_states < fleet.n_states[0]  # which was not changed


def test_vehicles_that_grow_leave_the_others_as_they_are():
    fleet = Fleet(EvolvingFSM(Q, rule=Novelty(radius=0.1)), 4)
    Z, A = walks(4, 300)
    fleet.observe(Z[0], A[0])
    silent = fleet[3]
    for t in range(1, 300):
        fleet.observe(Z[t, :3], A[t, :3], vehicles=[0, 1, 2])
    assert fleet.n_states[:3].min() > 100
    assert_same(fleet[3], silent)
    assert fleet.nbytes < 3 * sum(fleet[v].nbytes for v in range(4))


def test_an_episode_may_be_started_for_some():
    fleet = Fleet(EvolvingFSM(Q), 2)
    for _ in range(2):
        fleet.observe([[0.0], [0.0]], [0, 0])
    fleet.start_episode([1])
    assert np.isnan(fleet.observe([[0.0], [0.0]]).surprise).tolist() == [False, True]
    fleet.start_episode()
    assert fleet[0].state is None


@pytest.mark.slow
def test_single_precision_is_close_and_saves_memory():
    Z, A = walks(20, 500)
    machine = EvolvingFSM(Q, rule=Novelty(radius=0.8))
    double, single = (Fleet(machine, 20, dtype=kind) for kind in (np.float64, np.float32))
    for t in range(500):
        a, b = double.observe(Z[t], A[t]), single.observe(Z[t], A[t])
        assert a.state.tolist() == b.state.tolist()
        np.testing.assert_allclose(b.surprise, a.surprise, atol=2e-6)
    assert single.nbytes < 0.65 * double.nbytes
    for vehicle in range(20):
        np.testing.assert_allclose(
            single[vehicle].transition_matrices, double[vehicle].transition_matrices, atol=2e-6
        )


@pytest.mark.slow
def test_a_machine_out_of_a_fleet_in_single_precision_can_be_kept(tmp_path):
    machine = EvolvingFSM(1, learning_rate=1e-4, rule=Novelty(radius=0.5))
    fleet = Fleet(machine, 1, dtype=np.float32)
    for z in np.random.default_rng(0).normal(size=(20_000, 1, 1)):
        fleet.observe(z, [0])
    fleet[0].save(tmp_path / "machine")
    rows = EvolvingFSM.load(tmp_path / "machine").model().transition_matrices.sum(axis=2)
    np.testing.assert_allclose(rows, 1.0, rtol=1e-12)


def test_nobody_may_be_seen_at_first():
    fleet = Fleet(EvolvingFSM(Q), 2)
    assert len(fleet.observe(np.empty((0, 1)), [], vehicles=[]).state) == 0
    assert fleet.n_states.tolist() == [0, 0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (([[0.0, 0.0]], [0]), "1 observations of 2 vehicles"),
        (([[0.0], [0.0]], [0, 0]), "an observation has 1 variables, but .* with 2"),
        (([[0.0, np.nan], [0.0, 0.0]], [0, 0]), "row 0, variable 1: nan cannot be used"),
        (([[0.0, 0.0], [0.0, 0.0]], [0, Q]), f"action in row 1 is {Q}"),
        (([[0.0, 0.0], [0.0, 0.0]], [0]), "2 observations need"),
    ],
)
def test_what_cannot_be_used_is_refused_before_any_machine_has_changed(arguments, words):
    fleet = Fleet(EvolvingFSM(Q), 2)
    fleet.observe([[0.0, 1.0], [2.0, 3.0]], [0, 1])
    before = [fleet[0], fleet[1]]
    with pytest.raises(ValueError, match=words):
        fleet.observe(*arguments)
    for vehicle in range(2):
        assert_same(fleet[vehicle], before[vehicle])


@pytest.mark.parametrize(
    ("vehicles", "error", "words"),
    [
        ([0, 0], ValueError, "named twice"),
        ([0, 2], ValueError, "vehicles names row 2|there are 2"),
        ([0.5], TypeError, "whole numbers"),
    ],
)
def test_vehicles_that_are_not_there_are_refused(vehicles, error, words):
    fleet = Fleet(EvolvingFSM(Q), 2)
    with pytest.raises(error, match=words):
        fleet.observe([[0.0]] * len(vehicles), vehicles=vehicles)


def test_a_fleet_needs_a_machine_vehicles_and_a_known_precision():
    with pytest.raises(TypeError, match="must be an EvolvingFSM"):
        Fleet("machine", 2)
    with pytest.raises(ValueError, match="n_vehicles is 0"):
        Fleet(EvolvingFSM(Q), 0)
    with pytest.raises(TypeError, match="float16; it must be float64 or float32"):
        Fleet(EvolvingFSM(Q), 2, dtype=np.float16)
    with pytest.raises(IndexError):
        Fleet(EvolvingFSM(Q), 2)[2]


def moving(actions=3, **settings):
    return EvolvingFSM(actions, radius=1.0, max_states=5, dynamics=Dynamics(-1.0, 1.0, **settings))


@pytest.mark.slow
def test_a_fleet_with_dynamics_is_its_machines():
    draw = np.random.default_rng(0)
    fleet, alone = Fleet(moving(), 3), [moving() for _ in range(3)]
    Z = np.cumsum(draw.normal(size=(90, 3, 2)), axis=0)
    Z[70:75, 1] += 40.0
    I, U = draw.integers(0, 3, (90, 3)), draw.uniform(-1.0, 1.0, (90, 3))
    for t in range(90):
        who = [v for v in range(3) if (t + v) % 7]
        starts = [k for k, v in enumerate(who) if t in (30, 60) and v != 2]
        failures = [k for k, v in enumerate(who) if t == 50 and v == 1]
        fleet.observe(
            Z[t, who],
            I[t, who],
            vehicles=who,
            episode_starts=starts,
            failures=failures,
            executed=U[t, who],
        )
        for k, v in enumerate(who):
            if k in starts:
                alone[v].start_episode()
            alone[v].observe(Z[t, v], failed=k in failures)
            if k not in failures:
                alone[v].act(int(I[t, v]), U[t, v])
    fleet.start_episode([2])
    alone[2].start_episode()
    assert sum(machine.onsets.sum() for machine in alone) > 0
    for v, machine in enumerate(alone):
        files = []
        for one in (machine, fleet[v]):
            file = io.BytesIO()
            one.save(file)
            files.append(file.getvalue())
        assert files[0] == files[1]


@pytest.mark.slow
def test_what_a_fleet_with_dynamics_refuses_changes_none():
    fleet = Fleet(moving(), 2)
    for told, why in (({}, "executed is missing"), ({"executed": [0.0]}, "rows")):
        with pytest.raises(ValueError, match=why):
            fleet.observe([[0.0], [1.0]], [0, 1], **told)
    with pytest.raises(ValueError, match=r"at most 1e.30"):
        fleet.observe([[0.0], [1e31]], [0, 1], executed=[0.0, 0.0])
    assert not fleet.n_states.any()
    fleet.observe([[0.0], [1.0]])  # nobody acted
    assert fleet[0].dynamics.n_variables == 1

"""Forgetting: densities and variances of the recent past."""

import numpy as np
import pytest

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.merging import merge
from evofsm.fsm.states.edges import Edges
from evofsm.fsm.states.failure import FailureSplit
from evofsm.fsm.states.paper import Paper


def two_regimes(rows=4000, seed=0):
    rng = np.random.default_rng(seed)
    before = rng.normal([0.0, 0.0], 1.0, (rows, 2))
    after = rng.normal([30.0, -20.0], 1.0, (rows, 2))
    return np.concatenate([before, after]), rng.integers(0, 2, 2 * rows)


def variance(machine):
    clusters = machine._memory.learnt.clusters
    return float(clusters.scatter[0] / clusters.n_observations[0])


@pytest.mark.parametrize("rule", [Paper, Edges])
def test_up_to_its_memory_nothing_is_forgotten(rule, snapshot):
    Z, I = two_regimes(300)
    machines = EvolvingFSM(2, rule=rule()), EvolvingFSM(2, rule=rule(memory=600))
    for machine in machines:
        machine.learn_many(Z, I)
    np.testing.assert_array_equal(machines[0].centers, machines[1].centers)
    np.testing.assert_array_equal(machines[0].transition_matrices, machines[1].transition_matrices)
    np.testing.assert_array_equal(machines[0].potentials, machines[1].potentials)


def test_mean_and_variance_are_those_of_the_recent_past():
    Z, I = two_regimes()
    forgetful, faithful = EvolvingFSM(2, rule=Paper(memory=200)), EvolvingFSM(2)
    for machine in (forgetful, faithful):
        machine.learn_many(Z, I)
    assert variance(forgetful) == pytest.approx(2.0, rel=0.25)  # of the second regime alone
    assert variance(faithful) > 300.0


def test_mean_and_variance_are_weighted_exponentially():
    Z, I = two_regimes(100)
    machine = EvolvingFSM(2, rule=Paper(memory=50))
    machine.learn_many(Z, I)
    share = 1.0 / 50.0
    mean, var = Z[:50].mean(axis=0), Z[:50].var(axis=0).sum()
    for z in Z[50:]:
        off = z - mean
        mean = mean + share * off
        var = (1.0 - share) * (var + share * off @ off)
    held = machine._memory.learnt.clusters
    np.testing.assert_allclose(held.first + held.mean, mean, rtol=1e-12)
    assert variance(machine) == pytest.approx(var, rel=1e-12)


def test_a_new_regime_gets_states_where_the_paper_has_hardly_any():
    Z, I = two_regimes(20_000)
    founded = {}
    for memory in (None, 500):
        machine = EvolvingFSM(2, radius=0.3, rule=Paper(memory=memory))
        machine.learn_many(Z, I)
        founded[memory] = int((np.abs(machine.centers - [30.0, -20.0]).max(axis=1) < 5.0).sum())
    assert founded[500] > founded[None]


def test_every_path_forgets_alike_bit_for_bit(snapshot, tmp_path):
    Z, I = two_regimes(100)
    rule = FailureSplit(Paper(memory=30))
    batch, loop = EvolvingFSM(2, rule=rule), EvolvingFSM(2, rule=rule)
    batch.learn_many(Z, I)
    for z, i in zip(Z[:50], I[:50], strict=True):
        loop.learn_one(z, int(i))
    loop.save(tmp_path / "half.evofsm")
    loop = EvolvingFSM.load(tmp_path / "half.evofsm")
    assert loop.rule == rule
    for z, i in zip(Z[50:], I[50:], strict=True):
        loop.update(z, int(i))
    assert snapshot(loop) == snapshot(batch)


@pytest.mark.parametrize("memory", [0, 1, -3, 2.5, "long"])
def test_a_memory_that_is_none_is_refused(memory):
    with pytest.raises(ValueError, match="memory"):
        Paper(memory=memory)


def test_machines_that_forget_are_not_merged():
    Z, I = two_regimes(50)
    parts = [EvolvingFSM(2, rule=Edges(memory=40)) for _ in range(2)]
    for part in parts:
        part.learn_many(Z, I)
    with pytest.raises(ValueError, match="cannot be merged"):
        merge(parts)

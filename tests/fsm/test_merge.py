"""Machines that learnt apart become one: states matched, evidence added up, order of no matter."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.merging import merge
from evofsm.fsm.rules import Edges, Novelty, Paper

RULES = [Novelty(1.0, (2.0, 1.0)), Paper(), Edges()]


def taught(rule, seed, rows=150, q=3, **settings):
    """A machine that learnt from a walk of its own, with a failure on the way."""
    random = np.random.default_rng(seed)
    Z = np.cumsum(random.normal(size=(rows, 2)) * [0.8, 0.4], axis=0)
    machine = EvolvingFSM(q, rule=rule, **settings)
    machine.learn_many(Z, random.integers(-1, q, rows), [0, rows // 3], [rows // 2])
    return machine


seeds = st.lists(st.integers(0, 10_000), min_size=2, max_size=4, unique=True)


@settings(max_examples=30)
@given(st.sampled_from(RULES), seeds, st.randoms(use_true_random=False))
def test_order_of_the_parts_does_not_matter(snapshot, rule, seeds, random):
    parts = [taught(rule, seed, rows=20 + seed % 150) for seed in seeds]
    shuffled = random.sample(parts, len(parts))
    one, other = merge(parts), merge(shuffled)
    assert snapshot(one) == snapshot(other)


@settings(max_examples=30)
@given(st.sampled_from(RULES), seeds)
def test_evidence_adds_up_and_rows_remain_distributions(rule, seeds):
    parts = [taught(rule, seed, rows=20 + seed % 150) for seed in seeds]
    merged = merge(parts)
    model, models = merged.model(), [part.model() for part in parts]
    assert (model.uses == sum(one.uses for one in models)).all()
    for name in ("visits", "endings", "changes"):
        assert getattr(model, name).sum() == sum(getattr(one, name).sum() for one in models)
    for name in ("decisions", "failures"):
        total = sum(getattr(one, name).sum(axis=1) for one in models)
        np.testing.assert_allclose(getattr(model, name).sum(axis=1), total, rtol=1e-12)
    assert (model.transition_matrices >= 0.0).all()
    np.testing.assert_allclose(model.transition_matrices.sum(axis=-1), 1.0, atol=1e-12)
    assert ((merged.potentials > 0.0) & (merged.potentials <= 1.0)).all()
    rows = sum(one.visits.sum() for one in models)
    assert ((model.created >= 1.0) & (model.created <= rows)).all()
    assert max(part.n_states for part in parts) <= sum(one.n_states for one in models)
    assert {tuple(c) for c in merged.centers} <= {tuple(c) for one in parts for c in one.centers}


@given(st.sampled_from(RULES), st.integers(0, 10_000))
@settings(max_examples=10)
def test_what_has_observed_nothing_contributes_nothing(snapshot, rule, seed):
    part, nothing = taught(rule, seed), EvolvingFSM(3, rule=rule)
    before = part.copy()
    merged = merge([nothing, part, nothing])
    before.start_episode()
    assert snapshot(merged) == snapshot(before)
    assert merge([nothing, nothing]).n_states == 0


def test_potentials_are_those_of_all_the_data():
    random = np.random.default_rng(1)
    shards = [random.normal(size=(rows, 2)) * 3.0 + 1e4 for rows in (1, 2, 40, 100)]
    # With distance_weight 1 the paper's recursion is exact: density over the whole past.
    rule = Novelty(1.0, (2.0, 1.0))
    parts = [EvolvingFSM(1, distance_weight=1.0, rule=rule) for _ in shards]
    for part, Z in zip(parts, shards, strict=True):
        part.learn_many(Z, np.zeros(len(Z), int))
    merged = merge(parts)
    Z = np.concatenate(shards)
    scaled = Z / rule.scales
    merged.observe([1e4, 1e4])  # takes the latest into the potentials
    n = len(merged.centers)
    offsets = ((merged.centers[:, None] / rule.scales - scaled) ** 2).sum(axis=-1)
    expected = 1.0 / (1.0 + offsets.mean(axis=1))
    np.testing.assert_allclose(merged.potentials[:n], expected, rtol=1e-9)


def test_the_strongest_centre_leads_and_centres_stay_apart():
    parts = [taught(RULES[0], seed) for seed in range(6)]
    merged = merge(parts)
    scaled = merged.centers / RULES[0].scales
    distance = np.sqrt(((scaled[:, None] - scaled) ** 2).sum(axis=-1))
    assert distance[np.triu_indices(len(scaled), 1)].min() > 1.0
    strongest = max(parts, key=lambda part: part.model().visits.max())
    leads = strongest.centers[strongest.model().visits.argmax()]
    assert merged.centers[0].tolist() == leads.tolist()
    assert merge(parts, radius=4.0).n_states < merged.n_states < merge(parts, radius=0.2).n_states


@pytest.mark.parametrize(
    ("machines", "error", "message"),
    [
        ([], ValueError, "machines is empty"),
        ([EvolvingFSM(2), None], TypeError, "machine 1 is None"),
        ([EvolvingFSM(2), EvolvingFSM(3)], ValueError, "n_actions of machine 1 is 3, but 2"),
        ([EvolvingFSM(2), EvolvingFSM(2, max_states=4)], ValueError, "max_states of machine 1"),
        (
            [EvolvingFSM(2), EvolvingFSM(2), EvolvingFSM(2, rule=Edges())],
            ValueError,
            "rule of machine 2 is Edges",
        ),
    ],
)
def test_machines_that_differ_are_refused(machines, error, message):
    with pytest.raises(error, match=message):
        merge(machines)


def test_observations_of_other_sizes_and_impossible_radii_are_refused():
    parts = [EvolvingFSM(2), EvolvingFSM(2), EvolvingFSM(2)]
    parts[1].observe([0.0])
    parts[2].observe([0.0, 1.0])
    with pytest.raises(ValueError, match="n_variables of machine 2 is 2, but 1 of machine 1"):
        merge(parts)
    parts[0].observe([1.0])
    with pytest.raises(ValueError, match="radius is -1"):
        merge(parts[:2], radius=-1.0)


def score(machine, Z, I):
    """The mean log loss of forecasts of one step."""
    model = machine.model()
    belief = model.recognise(Z)
    forecasts = np.einsum("ti,tij->tj", belief[:-1], model.transition_matrices[I[:-1]])
    return -(belief[1:] * np.log(forecasts + 1e-12)).sum(axis=1).mean()


def steered(seed, rows):
    """A walk within walls, of which the action tells the direction."""
    random = np.random.default_rng(seed)
    I = np.repeat(random.integers(0, 3, rows // 10), 10)
    Z = np.zeros((rows, 2))
    steps = np.array([[0.4, 0.0], [-0.2, 0.35], [-0.2, -0.35]])[I]
    for k in range(1, rows):
        Z[k] = np.clip(Z[k - 1] + steps[k - 1] + 0.15 * random.normal(size=2), -6.0, 6.0)
    return Z, I


@pytest.mark.parametrize("rows", [300, 2000])
def test_it_forecasts_held_out_rows_as_well_as_one_machine_that_saw_all(rows):
    parts, whole = [], EvolvingFSM(3, rule=Novelty(1.0, spread=0.5))
    for seed in range(4):
        part = EvolvingFSM(3, rule=Novelty(1.0, spread=0.5))
        part.learn_many(*steered(seed, rows))
        whole.learn_many(*steered(seed, rows), episode_starts=[0])
        parts.append(part)
    held_out = steered(99, 4000)
    assert score(merge(parts), *held_out) < 1.05 * score(whole, *held_out)

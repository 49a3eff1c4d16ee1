"""The machine against a literal transcription of the paper's equations; see golden/README.md."""

from pathlib import Path

import numpy as np
import pytest

from evofsm import EvolvingFSM


@pytest.fixture(scope="module", params=["paper_four_runs", "random_walk"])
def golden(request):
    with np.load(Path(__file__).parents[1] / "golden" / f"{request.param}.npz") as archive:
        return dict(archive)


def machine_for(golden):
    q, distance_weight, radius, learning_rate, prior_frequency, spread = golden["params"]
    return EvolvingFSM(int(q), radius, distance_weight, learning_rate, prior_frequency, spread)


@pytest.fixture(scope="module")
def outcome(golden):
    machine, names = machine_for(golden), ("observations", "actions", "episode_starts")
    return machine, machine.learn_many(*(golden[name] for name in names), belief=True)


@pytest.mark.parametrize("name", ["state", "n_states", "event"])
def test_every_row_is_the_golden_one(name, golden, outcome):
    np.testing.assert_array_equal(getattr(outcome[1], name), golden[name])


def test_beliefs_and_surprise_are_the_golden_ones_and_missing_in_the_same_rows(golden, outcome):
    np.testing.assert_allclose(outcome[1].surprise, golden["jsd"], rtol=0, atol=1e-9)
    assert np.flatnonzero(np.isnan(outcome[1].surprise)).tolist() == list(golden["episode_starts"])
    np.testing.assert_allclose(outcome[1].belief[::25], golden["belief"], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "name", ["centers", "potentials", "transition_matrices", "joint_frequency", "origin_frequency"]
)
def test_what_is_learnt_in_the_end_is_the_golden_one(name, golden, outcome):
    np.testing.assert_allclose(getattr(outcome[0], name), golden[name], rtol=0, atol=1e-9)


def test_the_paper_preset_has_the_settings_of_the_papers_golden_run():
    with np.load(Path(__file__).parents[1] / "golden" / "paper_four_runs.npz") as archive:
        assert repr(EvolvingFSM.paper()) == repr(machine_for(archive))

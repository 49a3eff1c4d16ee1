"""The compiled machine against what others made of the paper.

A twin in plain NumPy, which is the paper on one screen, and a literal transcription of the
equations; see golden/README.md.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evofsm import EvolvingFSM
from reference import NumpyFSM


@st.composite
def streams(draw):
    """Settings of a machine, and random observations, actions and starts of episodes."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    m, rows = draw(st.integers(1, 4)), draw(st.integers(1, 150))
    Z = rng.normal(size=(rows, m)).cumsum(axis=0) * draw(st.sampled_from([0.1, 1.0, 20.0]))
    told = {
        "radius": draw(st.sampled_from([0.05, 0.5, 3.0])),
        "distance_weight": draw(st.sampled_from([0.5, 0.85, 2.0])),
        "learning_rate": draw(st.sampled_from([0.01, 0.2, 0.9])),
        "prior_frequency": draw(st.sampled_from([1e-3, 0.5])),
        "spread": draw(st.sampled_from([0.1, 3.0])),
    }
    return told, Z, rng.integers(-1, 3, rows), rng.random(rows) < 0.05


@settings(max_examples=60)
@given(streams())
def test_the_machine_is_its_twin(stream):
    told, Z, I, starts = stream
    machine, twin = EvolvingFSM(3, **told), NumpyFSM(3, **told)
    for z, i, begins in zip(Z, I, starts, strict=True):
        if begins:
            machine.start_episode()
            twin.start_episode()
        n = machine.n_states
        step = machine.observe(z)
        state, belief, surprise = twin.observe(z)
        assert len(twin.centers) == machine.n_states >= n
        assert step.belief[state] == pytest.approx(step.belief.max(), rel=1e-9)
        np.testing.assert_allclose(step.belief, belief, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(step.surprise, surprise, rtol=0.0, atol=1e-10)
        if i >= 0:
            machine.act(i)
            twin.act(i)
    for ours, theirs in (
        (machine.centers, twin.centers),
        (machine.potentials, twin.potentials),
        (machine.transition_matrices, twin.matrices),
        (machine.origin_frequency, twin.frequencies),
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-10)


# -- Golden vectors --------------------------------------------------------------------------------

LEARNT = "centers", "potentials", "transition_matrices", "joint_frequency", "origin_frequency"


def golden_of(name):
    """What is in a file, and a machine with its settings."""
    with np.load(Path(__file__).parents[1] / "golden" / f"{name}.npz") as archive:
        golden = dict(archive)
    q, distance_weight, radius, learning_rate, prior_frequency, spread = golden["params"]
    settings = radius, distance_weight, learning_rate, prior_frequency, spread
    return golden, EvolvingFSM(int(q), *settings)


@pytest.mark.parametrize("name", ["paper_four_runs", "random_walk"])
def test_every_row_and_what_is_learnt_in_the_end_are_the_golden_ones(name):
    golden, machine = golden_of(name)
    told = (golden[one] for one in ("observations", "actions", "episode_starts"))
    trace = machine.learn_many(*told, belief=True)
    for one in ("state", "n_states", "event"):
        np.testing.assert_array_equal(getattr(trace, one), golden[one], err_msg=one)
    np.testing.assert_allclose(trace.surprise, golden["jsd"], rtol=0, atol=1e-9)
    assert np.flatnonzero(np.isnan(trace.surprise)).tolist() == list(golden["episode_starts"])
    np.testing.assert_allclose(trace.belief[::25], golden["belief"], rtol=0, atol=1e-9)
    for one in LEARNT:
        learnt = getattr(machine, one)
        np.testing.assert_allclose(learnt, golden[one], rtol=0, atol=1e-9, err_msg=one)


def test_the_paper_preset_has_the_settings_of_the_papers_golden_run():
    assert repr(EvolvingFSM.paper()) == repr(golden_of("paper_four_runs")[1])

"""The compiled machine against its twin in plain NumPy, which is the paper on one screen."""

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

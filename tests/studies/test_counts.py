"""Failures within a horizon, counted."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from studies.counts import OutcomeCounts

DT = 0.25
EPISODES = st.lists(
    st.tuples(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 1)), max_size=9), st.booleans()),
    max_size=8,
)


@pytest.mark.slow
@given(EPISODES, st.integers(1, 5))
def test_counts_agree_with_looking_ahead(episodes, steps):
    counts = OutcomeCounts(n_actions=2, horizon=steps * DT, dt=DT)
    cases, failures = np.zeros((3, 2)), np.zeros((3, 2))
    for decisions, failed in episodes:
        for i, (state, action) in enumerate(decisions):
            counts.learn(np.eye(3)[state], action)
            left = len(decisions) - i  # until the end, in decisions
            if failed or left > steps:
                cases[state, action] += 1
                failures[state, action] += failed and left <= steps
        counts.end_episode(failed=failed)
    for state in range(3):
        for action in range(2):
            outcome = counts.outcome(np.eye(3)[state], action)
            n = cases[state, action]
            assert outcome.evidence == n
            low, high = outcome.interval
            assert 0.0 <= low <= outcome.probability <= high <= 1.0
            if n:  # it leans on all the others by a few cases
                share = failures[state, action] / n
                assert abs(outcome.probability - share) <= 2.0 / (n + 2.0) + 1e-12


def test_counts_refuse_what_they_cannot_count():
    with pytest.raises(ValueError, match="horizon"):
        OutcomeCounts(n_actions=1, horizon=0.1, dt=0.25)
    counts = OutcomeCounts(n_actions=1)
    for belief in ([math.nan], [[1.0]], [0.2, 0.2]):
        with pytest.raises(ValueError, match="belief"):
            counts.learn(belief, 0)
    with pytest.raises(ValueError, match="action"):
        counts.learn([1.0], 1)
    counts.end_episode(failed=True)
    assert counts.outcome([1.0], 0).evidence == 0.0

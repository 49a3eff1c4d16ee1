"""Some minutes of junk and restarts here; `benchmarks/monitor_soak.py` takes a day."""

import pytest

import monitor_soak

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("learn", [True, False])
def test_no_decision_is_lost_or_wrong(learn):
    found = monitor_soak.soak(0.15, seed=1, learn=learn, episode=900)
    assert found.wrong == 0
    assert found.rows > 2000
    assert min(found.alarms, found.junk, found.restarts) > 0

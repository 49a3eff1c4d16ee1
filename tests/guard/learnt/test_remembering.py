"""What is remembered: whole stretches, for what disturbs a system goes on for a while."""

import pytest

pytest.importorskip("scipy")
pytest.importorskip("gymnasium")

from studies.judges import trial


@pytest.mark.slow
def test_what_a_leader_does_for_seconds_is_not_made_of_steps_that_have_nothing_to_do_with_it():
    """With the same residuals in no order a leader never brakes for long, and is run into."""
    drives = {"train": 25, "test": 40, "base": 1}
    whole = trial("emergency", **drives)
    without = trial("emergency", without="memory", **drives)
    assert whole["failed"] <= 2
    assert without["failed"] >= 12

"""How often something begins, and how well that is known."""

import numpy as np
import pytest

from evofsm.fsm.proportions import FailureRecord, poisson_bounds


@pytest.mark.parametrize(
    ("count", "low", "high"),
    [(0, 0.0, 2.9957), (1, 0.0513, 4.7439), (10, 5.4254, 16.9622), (1000, 948.6, 1053.6)],
)
def test_intervals_of_counts_are_those_of_the_tables(count, low, high):
    np.testing.assert_allclose(poisson_bounds(count), (low, high), rtol=1e-3, atol=1e-9)


def test_failures_are_told_with_what_they_rest_on():
    assert str(FailureRecord(0, 9.0)) == "0 failures in 9 h: at most 0.34 per hour, 95 %, one-sided"
    text = str(FailureRecord(1, 0.0, 0.0, 1))
    assert text == "1 failure in 1 episode, 0 h, 0 km: nothing is known"
    text = str(FailureRecord(2, 120.7, 9000.0, 500))
    assert text.startswith("2 failures in 500 episodes, 120 h, 9,000 km: 0.017 per hour (0.0029 to")
    assert text.endswith("0.22 per 1,000 km (0.039 to 0.70), 90 %, two-sided")


def test_bounds_of_failures_are_rounded_outward():
    for failures in range(12):
        record = FailureRecord(failures, 7.3)
        said = str(record).partition(": ")[2]
        low, high = (0.0, said.split()[2]) if not failures else said.split("(")[1].split()[:3:2]
        low, high = float(low), float(str(high).rstrip("),"))
        exact = [bound / 7.3 for bound in poisson_bounds(failures)]
        assert low <= exact[0] <= exact[1] <= high <= 1.11 * exact[1]

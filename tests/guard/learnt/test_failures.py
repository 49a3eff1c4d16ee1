"""Where a system fails, from failures and from what was survived."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evofsm.guard.learnt.failures import explain_failures

EXACT = np.zeros((2, 2))


def box(failures, lowest=(0.0, 0.0), highest=(10.0, 10.0), blur=EXACT):
    ends = np.array(lowest), np.array(highest)
    return explain_failures(np.array(failures), *ends, np.ones(2), blur)


def test_an_end_that_all_failures_are_beyond_is_enough():
    assert box([[-1.0, 11.0], [-2.0, 5.0]]) == [(0, -1.0, 0.0)]


def test_of_two_that_explain_the_first_failures_alike_both_hold():
    assert set(box([[-1.0, 11.0]])) == {(0, -1.0, 0.0), (1, 1.0, 10.0)}


def test_a_failure_amid_what_was_survived_is_explained_by_no_end():
    assert box([[5.0, 5.0]]) == box([[0.5, 5.0]]) == []


def test_noise_blurs_the_ends_so_the_innermost_failure_says_where():
    assert box([[0.6, 5.0], [0.2, 4.0]], blur=EXACT + 0.2) == [(0, -1.0, 0.6)]
    assert box([[9.4, 5.0]], blur=EXACT + 0.2) == [(0, 1.0, 9.4)]
    assert box([[2.0, 5.0]], blur=EXACT + 0.2) == []  # farther in than any noise


def test_where_a_variable_saturates_nothing_is_blurred():
    """Who stands, stands at the end of its range, and does not fail for it."""
    only_above = np.array([[0.0, 0.2], [0.2, 0.2]])
    assert box([[0.0, 5.0]], blur=only_above) == []


def test_of_ends_that_explain_as_many_the_one_that_may_explain_most_is_taken():
    failures = [[-0.1, 13.0], [0.1, 4.0], [0.2, 5.0], [0.3, 6.0]]
    assert box(failures, blur=EXACT + 0.2) == [(0, -1.0, 0.3)]


@pytest.mark.parametrize("blur", [0.0, 0.1])
@given(st.integers(0, 2**32))
def test_order_unit_and_direction_make_no_difference(blur, seed):
    def explained(safe, lost, unit):
        low, high = safe.min(0), safe.max(0)
        return explain_failures(lost, low, high, unit, blur * np.tile(unit[:, None], 2))

    draw = np.random.default_rng(seed)
    safe, lost, unit = draw.normal(size=(6, 3)), draw.normal(size=(4, 3)), draw.uniform(0.1, 1.0, 3)
    order, times = draw.permutation(3), draw.choice([-2.0, 0.5], 3)  # so that none is rounded
    written = [(one * times)[..., order] for one in (safe, lost, unit)]
    otherwise = explained(*written[:2], np.abs(written[2]))
    back = {(i := order[j], sign * np.sign(times[i]), at / times[i]) for j, sign, at in otherwise}
    assert back == set(explained(safe, lost, unit))

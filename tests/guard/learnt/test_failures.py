"""Where a system fails, from failures and from what was survived."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evofsm.guard.learnt.failures import explain_failures

EXACT = np.zeros((2, 2))


AMID = [[-0.1, 13.0], [0.1, 4.0], [0.2, 5.0], [0.3, 6.0]]
ABOVE_ALONE = np.array([[0.0, 0.2], [0.2, 0.2]])  # who stands, does not fail for it


@pytest.mark.parametrize(
    ("failures", "blur", "ends"),
    [
        ([[-1.0, 11.0], [-2.0, 5.0]], EXACT, {(0, -1.0, 0.0)}),  # that explains all of them
        ([[-1.0, 11.0]], EXACT, {(0, -1.0, 0.0), (1, 1.0, 10.0)}),  # of one it may be either
        ([[5.0, 5.0]], EXACT, set()),  # amid what was survived
        ([[0.5, 5.0]], EXACT, set()),
        ([[0.6, 5.0], [0.2, 4.0]], EXACT + 0.2, {(0, -1.0, 0.6)}),  # the innermost says where
        ([[9.4, 5.0]], EXACT + 0.2, {(0, 1.0, 9.4)}),
        ([[9.4, 5.0], [9.8, 4.0]], EXACT + 0.2, {(0, 1.0, 9.4)}),
        ([[2.0, 5.0]], EXACT + 0.2, set()),  # farther in than any noise
        ([[0.0, 5.0]], ABOVE_ALONE, set()),  # where a variable saturates nothing is blurred
        (AMID, EXACT + 0.2, {(0, -1.0, 0.3)}),  # the one that may explain most
    ],
)
def test_failures_are_explained_by_ends_of_what_was_survived(failures, blur, ends):
    found = explain_failures(np.array(failures), np.zeros(2), np.full(2, 10.0), np.ones(2), blur)
    assert set(found) == ends


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

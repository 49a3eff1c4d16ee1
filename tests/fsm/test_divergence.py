from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evofsm import jensen_shannon


@st.composite
def pairs(draw):
    n = draw(st.integers(1, 6))
    weights = st.lists(st.floats(0, 1), min_size=n, max_size=n).filter(lambda w: sum(w) > 1e-3)
    return [np.array(w) / sum(w) for w in (draw(weights), draw(weights))]


def exactly(p, q):
    """The definition, in 60 digits."""
    with localcontext(prec=60):
        terms = []
        for a, b in zip(map(Decimal, p), map(Decimal, q), strict=True):
            middle = (a + b) / 2
            terms += [x * (x / middle).ln() for x in (a, b) if x > 0]
        return float(sum(terms) / 2 / Decimal(2).ln())


@pytest.mark.parametrize("difference", [*np.geomspace(1e-7, 0.5, 60), 0.01, 0.1, 0.25])
def test_it_is_exact_from_nearly_equal_to_disjoint_distributions(difference):
    for center in (0.5, 0.25):
        p = [center + difference * center, 1 - center - difference * center]
        q = [center - difference * center, 1 - center + difference * center]
        assert jensen_shannon(p, q) == pytest.approx(exactly(p, q), rel=1e-12, abs=1e-15)


@given(pairs())
def test_it_is_symmetric_between_0_and_1_and_0_of_itself(pair):
    p, q = pair
    assert jensen_shannon(p, q) == pytest.approx(jensen_shannon(q, p), abs=1e-15)
    assert 0.0 <= jensen_shannon(p, q) <= 1.0
    assert jensen_shannon(p, p) == 0.0


@pytest.mark.parametrize(
    ("p", "q", "words"),
    [
        ([0.5, 0.5], [1.0], r"p has shape \(2,\) and q has shape \(1,\)"),
        (1.0, 1.0, "number of states on their last axis"),
        ([1.5, -0.5], [0.5, 0.5], "p is no distribution"),
        ([0.5, 0.5], [np.nan, 0.5], "q is no distribution"),
    ],
)
def test_what_is_no_pair_of_distributions_is_refused(p, q, words):
    with pytest.raises(ValueError, match=words):
        jensen_shannon(p, q)

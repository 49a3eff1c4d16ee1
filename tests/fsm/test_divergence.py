from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evofsm.fsm.divergence import jensen_shannon


@st.composite
def pairs(draw):
    n = draw(st.integers(1, 6))
    weights = st.lists(st.floats(0, 1), min_size=n, max_size=n).filter(lambda w: sum(w) > 1e-3)
    return [np.array(w) / sum(w) for w in (draw(weights), draw(weights))]


def test_half_shared_is_worked_out_by_hand():
    # middle [3/4, 1/4]: (log2(4/3) + 1/2 log2(2/3) + 1/2 log2(2)) / 2
    expected = (np.log2(4 / 3) + 0.5 * np.log2(2 / 3) + 0.5) / 2
    assert jensen_shannon([1.0, 0.0], [0.5, 0.5]) == pytest.approx(expected, rel=1e-14)


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
        assert jensen_shannon(p, q) == pytest.approx(exactly(p, q), rel=1e-12, abs=0.0)


def test_disjoint_distributions_are_one_bit_apart():
    assert jensen_shannon([0.25, 0.75, 0, 0], [0, 0, 0.5, 0.5]) == 1.0


@given(pairs())
def test_it_is_symmetric_between_0_and_1_and_0_of_itself(pair):
    p, q = pair
    assert jensen_shannon(p, q) == pytest.approx(jensen_shannon(q, p), abs=1e-15)
    assert 0.0 <= jensen_shannon(p, q) <= 1.0
    assert jensen_shannon(p, p) == 0.0


@given(pairs())
def test_its_root_obeys_the_triangle_inequality(pair):
    p, q = pair
    r = np.full(len(p), 1.0 / len(p))
    direct, way = jensen_shannon(p, q), jensen_shannon(p, r) ** 0.5 + jensen_shannon(r, q) ** 0.5
    assert direct**0.5 <= way + 1e-7


def test_one_distribution_is_broadcast_against_many():
    many = np.array([[[1.0, 0.0], [0.5, 0.5]], [[0.0, 1.0], [0.9, 0.1]]])
    divergence = jensen_shannon(many, [1.0, 0.0])
    assert divergence.shape == (2, 2)
    for i, j in np.ndindex(2, 2):
        assert divergence[i, j] == jensen_shannon(many[i, j], [1.0, 0.0])


def test_two_distributions_give_a_plain_float():
    assert type(jensen_shannon([1.0, 0.0], [0.5, 0.5])) is float


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

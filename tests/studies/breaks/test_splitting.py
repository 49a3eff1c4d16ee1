"""Splitting against what is known: how often it says it, what it finds, what it does not know."""

import math

import numpy as np
import pytest
from studies.breaks.splitting import Amount, plain, split, to_chance
from studies.breaks.subjects import KNOWN, Toy


def fails_above(least):
    """A subject that fails with a probability of 1 - least."""

    def score(chance):
        return math.inf if chance("x") >= least else chance("x")

    return score


@pytest.mark.slow
def test_a_probability_of_1e_5_comes_out_within_chance():
    runs = [split(Toy().score, Amount(cases=100, moves=10), (1, k)) for k in range(16)]
    values = np.array([run.probability for run in runs])
    error = values.std(ddof=1) / math.sqrt(len(values))
    assert abs(values.mean() - KNOWN) < 3.3 * error  # 99.5 % of Student's t with 15 degrees
    assert error < 0.25 * KNOWN
    assert sum(run.tried for run in runs) < 200_000  # where plain sampling would see two


def test_splitting_and_plain_sampling_say_the_same_where_both_see():
    toy = Toy(probability=0.01)
    n = 5000
    share = plain(toy.score, n, [5]) / n
    values = [split(toy.score, Amount(cases=60, moves=5), (2, k)).probability for k in range(8)]
    error = math.hypot(np.std(values, ddof=1) / math.sqrt(8), math.sqrt(share * (1 - share) / n))
    assert 0.005 < share < 0.015
    assert abs(np.mean(values) - share) < 3.5 * error


def test_the_same_seed_finds_the_same_and_another_one_does_not():
    one, again, other = (
        split(fails_above(0.999), Amount(cases=30), (3, k)).probability for k in (0, 0, 1)
    )
    assert one == again != other


def test_what_is_found_failed_and_can_be_played_again():
    score = fails_above(0.9999)
    found = split(score, Amount(cases=40), [4])
    assert found.ended == "failed"
    assert len({case.latent["x"] for case in found.failed}) == len(found.failed) > 1
    for case in found.failed:
        assert score(case.chance) == math.inf
    levels = [level.score for level in found.levels]
    assert levels == sorted(set(levels))
    assert found.best < 0.9999


def test_places_that_depend_on_others_are_drawn_as_ever():
    """A second number is asked for by some cases alone; the answer is that of the mixture."""

    def score(chance):
        x = chance("x")
        if x < 0.5:
            return x
        return math.inf if chance("y") >= 0.98 else 0.5 + chance("y")

    values = [split(score, Amount(cases=80, moves=5), (6, k)).probability for k in range(10)]
    error = np.std(values, ddof=1) / math.sqrt(len(values))
    assert abs(np.mean(values) - 0.01) < 3.7 * error


def test_where_nothing_fails_it_says_how_far_it_came():
    flat = split(lambda chance: 1.0, Amount(cases=20), [0])
    assert (flat.probability, flat.ended, flat.best, flat.tried) == (0.0, "alike", 1.0, 20)
    never = split(lambda chance: chance("x"), Amount(cases=20, moves=2, least=1e-3), [0])
    assert (never.probability, never.ended) == (0.0, "least")
    assert 1e-3 <= never.levels[-1].probability < 2e-3
    assert 0.99 < never.best < 1.0
    assert never.failed == ()


def test_what_always_fails_has_a_probability_of_1():
    found = split(lambda chance: math.inf, Amount(cases=20), [0])
    assert (found.probability, found.tried, found.levels) == (1.0, 20, ())


def test_chances_are_below_1_whatever_the_number():
    assert 0.0 <= to_chance(-40.0) < to_chance(0.0) == 0.5 < to_chance(40.0) < 1.0

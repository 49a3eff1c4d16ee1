"""An alarm holds the rate of its errors, whatever comes."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evofsm.guard.conformal import ConformalAlarm

ANY = st.floats(allow_nan=True, allow_infinity=True)
KINDS = ("false alarms", "misses")


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(ANY, st.booleans()), min_size=1, max_size=300),
    st.sampled_from([0.02, 0.1, 0.5, 0.9]),
    st.sampled_from([0.005, 0.1, 2.0]),
    st.sampled_from(KINDS),
)
def test_the_rate_is_held_whatever_comes(came, rate, step, of):
    alarm = ConformalAlarm(rate, of=of, step=step, memory=50)
    errors = counted = 0
    for score, happened in came:
        counts = happened == (of == "misses")
        errors += counts and alarm.alarms(score) == (of == "false alarms")
        counted += counts
        alarm.update(score, happened)
        assert (alarm.errors, alarm.counted) == (errors, counted)
        if counted:
            low, high = alarm.held
            assert low - 1e-9 <= alarm.realised <= high + 1e-9


@pytest.mark.parametrize("of", KINDS)
@pytest.mark.parametrize("delay", [0, 30])
def test_an_adversary_gets_no_further_than_the_bound_and_one_error_more_per_update_of_delay(
    of, delay
):
    alarm, said = ConformalAlarm(0.05, of=of, step=0.01, memory=100), []
    sign = 1.0 if of == "false alarms" else -1.0
    for t in range(3000):  # each score is worse than all before
        said.append((sign * t, alarm.alarms(sign * t)))
        if t >= delay:
            score, alarmed = said[t - delay]
            alarm.update(score, of == "misses", alarmed=alarmed)
    assert alarm.errors <= 0.05 * alarm.counted + 0.05 / 0.01 + 0.95 + delay


@pytest.mark.parametrize("of", KINDS)
def test_only_the_order_of_scores_matters_and_nan_is_the_most_dangerous(of):
    rng = np.random.default_rng(5)
    one, other = (ConformalAlarm(0.1, of=of, step=0.03, memory=60) for _ in range(2))
    for score, came in zip(rng.normal(size=500), rng.random(500) < 0.3, strict=True):
        assert one.alarms(score) == other.alarms(math.exp(score))
        one.update(score, came)
        other.update(math.exp(score), came)
    assert one.alarms(math.nan)
    assert not one.alarms(-math.inf)


def test_until_enough_was_seen_it_is_silent_or_always_on():
    alarm = ConformalAlarm(0.1)
    assert not alarm.alarms(5.0)
    assert alarm.threshold == math.inf
    assert ConformalAlarm(0.1, of="misses").alarms(-5.0)
    alarm.update(3.0, True)  # an event: no false alarm is possible
    assert (alarm.counted, alarm.held) == (0, (0.0, 1.0))
    assert math.isnan(alarm.realised)


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        ({"rate": 0.0}, "rate is 0.0"),
        ({"rate": 1.0}, "below 1"),
        ({"of": "hits"}, "of is 'hits'"),
        ({"step": -1.0}, "step is -1.0"),
        ({"rate": 0.001, "memory": 900}, "needs 1,000 scores"),
        ({"memory": 0}, "memory is 0"),
    ],
)
def test_settings_out_of_range_are_refused(settings, what):
    with pytest.raises(ValueError, match=what):
        ConformalAlarm(**settings)

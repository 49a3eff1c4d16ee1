"""Certificates that break more often than they used to are noticed, others are not."""

import numpy as np
import pytest

from evofsm.guard.learnt.breaks import Breaks


def alarms(shares, seed):
    """Episodes at which disturbances were called worse, if certificates break in such shares."""
    draw, breaks, found = np.random.default_rng(seed), Breaks(), []
    for episode, share in enumerate(shares):
        later = breaks.after(episode, broke=bool(draw.random() < share))
        if later.worse != breaks.worse:
            found.append(episode)
            assert later.worse <= episode
        breaks = later
    return found


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9])
def test_what_goes_on_as_it_was_raises_few_alarms(share):
    assert sum(len(alarms([share] * 100, seed)) for seed in range(100)) <= 12


def test_what_gets_worse_is_noticed_within_ten_episodes():
    shares = [0.03] * 100 + [0.7] * 10
    noticed = [any(at >= 100 for at in alarms(shares, seed)) for seed in range(100)]
    assert sum(noticed) >= 90


def test_nothing_is_worse_as_long_as_all_is_being_learnt():
    """For 24 episodes the share is not low enough to tell anything from what would be worse."""
    assert alarms([0.0] * 23 + [1.0] * 40, 0) == []
    assert alarms([0.0] * 24 + [1.0] * 40, 0) != []


def test_failures_under_a_certificate_are_noticed_sooner():
    breaks = Breaks()
    for episode in range(60):
        breaks = breaks.after(episode, broke=False)
    broken, failed = breaks, breaks
    for episode in range(60, 62):
        broken = broken.after(episode, broke=True)
        failed = failed.after(episode, broke=True, failed=True)
    assert (broken.worse, failed.worse) == (-1, 60)

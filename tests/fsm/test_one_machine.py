"""Threads that share a machine lose nothing, and Ctrl-C never leaves one half done."""

import copy
import pickle
import sys
import threading
from collections import Counter

import pytest

import one_machine


@pytest.mark.parametrize("interval", [sys.getswitchinterval(), 1e-6])
def test_threads_on_one_machine_lose_no_observation(interval):
    one_machine.compile_all()
    assert one_machine.share(one_machine.growing(), 4, 100, interval) == 0


@pytest.mark.slow
@pytest.mark.parametrize("deed", one_machine.DEEDS)
def test_an_interrupt_at_any_line_leaves_a_whole_machine(deed):
    found = Counter(one_machine.harms(one_machine.DEEDS[deed]))
    assert found.total() >= 3
    assert set(found) == {""}


@pytest.mark.parametrize(
    "twin", [copy.copy, copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))]
)
def test_a_copy_goes_its_own_way_and_has_a_lock_of_its_own(grown, snapshot, twin):
    before = snapshot(grown)
    with grown._lock:
        another = twin(grown)
        assert snapshot(another) == before
        elsewhere = threading.Thread(target=another.learn_one, args=([0.1, 0.2], 0), daemon=True)
        elsewhere.start()
        elsewhere.join(20.0)
        assert not elsewhere.is_alive()
    assert snapshot(another) != before == snapshot(grown)

"""Numbers hold for ten million steps here; `make soak` takes a thousand million."""

import pytest

import soak


@pytest.mark.slow
def test_numbers_hold_for_ten_million_steps():
    found = list(soak.soak(10_000_000))
    assert [health.stream for health in found if not health.holds] == []
    sizes = {}
    for health in found:
        sizes.setdefault(health.stream, []).append(health.kilobytes)
    assert all(size[-1] == size[0] for size in sizes.values())


def test_what_does_not_hold_is_told():
    machine = soak.EvolvingFSM(1)
    machine.learn_many([[0.0], [1.0]], [0, 0])
    assert soak.look("fine", machine, 2).holds
    machine._learnt.matrices[:] *= 1.0 + 1e-8
    assert not soak.look("off", machine, 2).holds

"""Numbers hold for two million steps here; `make soak` takes a thousand million."""

import pytest

import soak


@pytest.mark.slow
def test_numbers_hold_for_two_million_steps():
    found = list(soak.soak(2_000_000))
    assert [health.stream for health in found if not health.holds] == []
    sizes = {}
    for health in found:
        sizes.setdefault(health.stream, []).append(health.kilobytes)
    assert all(size[-1] == size[0] for size in sizes.values())

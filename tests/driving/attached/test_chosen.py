"""Which vehicles are meant."""

from types import SimpleNamespace

import pytest

from evofsm.driving.attached.chosen import choose

CARS = [str(k) for k in range(2000)]
TYPES = SimpleNamespace(vehicle=SimpleNamespace(getTypeID=lambda car: "bus" if car == "7" else "x"))


def chosen(vehicles, seed=0):
    test = choose(vehicles, seed)
    return {car for car in CARS if test(TYPES, car)}


def test_all_some_or_those_of_a_type():
    assert chosen("all") == set(CARS)
    assert chosen(["1", "2", "gone"]) == {"1", "2"}
    assert chosen("type:bus") == {"7"}


def test_a_share_is_the_same_in_every_run():
    assert chosen(0.1) == chosen("10%")
    assert 150 < len(chosen(0.1)) < 250
    assert chosen(0.1) != chosen(0.1, seed=1)
    assert chosen(1) == set(CARS)


@pytest.mark.parametrize("vehicles", ["none", "x%", "120%", 0.0, -0.1, 1.5, float("nan")])
def test_anything_else_is_refused(vehicles):
    with pytest.raises(ValueError, match="vehicles is"):
        choose(vehicles)

"""What numbers are called: words where a package declares some, else names, units and values."""

import subprocess
import sys

from evofsm.fsm.naming import Labels


def test_places_of_car_following_are_told_in_words_whatever_was_imported():
    told = subprocess.run(
        [
            sys.executable,
            "-c",
            "from evofsm import IntervalActions, Labels\n"
            "labels = Labels(IntervalActions(-2.5, 2.5, 0.3), ('gap', 'v_follower', 'v_leader'))\n"
            "print(labels.place([9.2, 4.1, 3.0]), labels.action(16), sep='; ')",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    assert told.stdout == ("close (9 m), slow (4 m/s), closing at 1 m/s; a(17) [2.3, 2.5] m/s²\n")


def test_other_places_are_told_by_names_and_units_or_by_numbers():
    assert Labels(names=("x", "y"), units=("m", "")).place([1.0, 2.0]) == "x 1 m, y 2"
    assert Labels().place([1.0, 2.0]) == "(1, 2)"

"""Splitting against what is known, and what is found: scenarios as families that fail again."""

import math
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from studies.falsification import Chosen, Falsification, Toy, kept, load, plain, row_of, split

from evofsm.driving import FAMILIES, drive, guard_for_family, load_family, unrevised_guard
from evofsm.paper import write_page


def above(least):
    """Fails with a probability of 1 - least."""
    return lambda chance: math.inf if chance("x") >= least else chance("x")


def test_splitting_and_plain_sampling_say_the_same_where_both_see():
    toy, n = Toy(probability=0.01), 5000
    share = plain(toy.score, n, [5]) / n
    values = [split(toy.score, (2, k), cases=60, moves=5).probability for k in range(8)]
    error = math.hypot(np.std(values, ddof=1) / math.sqrt(8), math.sqrt(share * (1 - share) / n))
    assert 0.005 < share < 0.015
    assert abs(np.mean(values) - share) < 3.5 * error


STUDY = Falsification(
    family="toy,seldom,emergency", judge="none", runs=3, cases=20, moves=2, least=1e-3, plain=200
)


@pytest.fixture(scope="module")
def found():
    """The toy, and a family whose driver collides every time or never."""
    return replace(STUDY, keep=3).run(workers=1)


def test_every_row_rests_on_splitting_and_on_plain_samples(found):
    toy, seldom, emergency = found["rows"].to_dicts()
    assert (toy["known"], seldom["known"]) == (1e-5, None)
    assert toy["agrees"] is None  # 200 plain samples see nothing of it
    assert emergency["agrees"] is True
    assert emergency["plain_failed"] > 180
    assert 0.9 < emergency["probability"] <= 1.0
    assert 0.0 <= emergency["low"] <= emergency["probability"] <= emergency["high"] <= 1.0
    targets = STUDY.page(found).targets.filter(pl.col("target").str.contains("emergency"))
    assert targets["met"].to_list() == [True]


def test_cases_are_written_as_a_family_that_fails_as_often(found, tmp_path):
    STUDY.write(found, tmp_path)
    family = load_family(tmp_path / "found-emergency-none.py")
    guard = guard_for_family(family, learn=False)
    cases = found["cases"].filter(family="emergency")
    assert family.cases == cases["case"].max() == 3
    for k in range(3):
        draw = family.draw(seed=7, index=k)
        chances = dict(cases.filter(case=k + 1).select("place", "below").rows())
        assert draw[:2] == load("emergency").draw_by(Chosen(chances.__getitem__))[:2]
        assert drive(unrevised_guard(family), draw).collided
        assert not drive(guard, draw).collided
    gap, *_ = cases.filter(place="scenario.initial_gap").to_dicts()
    assert gap["value"] == pytest.approx(2.0 + 28.0 * gap["below"])
    far = cases["as_far"].to_list()
    assert far == sorted(far, reverse=True)  # the most ordinary first
    assert 0.0 < far[-1] <= far[0] <= 1.0


@pytest.mark.parametrize("name", [*FAMILIES, "cut_in+noise+delay+actuator+jerk+third_car"])
def test_what_is_kept_is_what_was_drawn_to_the_last_bit(name, tmp_path):
    family = load_family(name).shifted or load_family(name)
    cases = {f"case {k}": family.draw(0, k) for k in range(4)}
    (tmp_path / "kept.py").write_text(kept(family, cases, "All of them."), encoding="utf-8")
    again = load_family(tmp_path / "kept.py")
    for k, (case, drawn) in enumerate(cases.items()):
        assert again.draw(seed=5, index=k, split="test") == drawn._replace(variant=case)
    for name in ("interval", "actions", "decel", "leader_decel"):
        assert getattr(again, name) == getattr(family, name)
    assert (again.name, again.about) == ("kept", "All of them.")


def test_failures_under_a_guard_and_runs_that_disagree_are_among_the_losses(
    found, tmp_path, read_page
):
    runs = [split(above(least), [0], 20, 2, 1e-2) for least in (0.9, 2.0, 2.0)]
    rows = [
        row_of("seldom", "kinematic", runs, 1000, 0),
        row_of("rare", "kinematic", runs[1:], 1000, 1),
        row_of("seldom", "none", runs[:1] * 2, 1000, 900),
    ]
    assert [row["blind"] for row in rows] == [2, 2, 0]
    rows = pl.concat([found["rows"], pl.DataFrame(rows)], how="diagonal")
    page = STUDY.page({**found, "rows": rows})
    fails, doubtful = (table.frame.select("family", "judge").rows() for table in page.losses)
    assert fails == [("seldom", "kinematic"), ("rare", "kinematic")]
    assert ("seldom", "kinematic") in doubtful  # its runs do not agree
    assert doubtful[-1] == ("seldom", "none")  # 0.1 against 0.9
    assert page.holds is False
    table = next(part for part in page.parts if "emergency" in part.title)
    assert len(table.cells) == 3
    assert "scenario.initial_gap [m]" in table.header
    assert not any("sensors.seed" in name for name in table.header)
    read_page(write_page(tmp_path / "index.html", [page])).is_sound()

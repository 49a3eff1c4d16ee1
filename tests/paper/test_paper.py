"""The paper's claims follow from its runs, under its settings and under others."""

from pathlib import Path

import numpy as np
import pytest

from evofsm.driving import KinematicWorld
from evofsm.paper import Settings, check_claims, run_paper
from evofsm.paper.reproduction import divergences, page_of

PAGE = Path(__file__).parents[2] / "docs" / "paper.md"


def drive(rounds=1, progress=lambda done, total: None, **changes):
    settings = Settings.load(changes)
    return run_paper(KinematicWorld(), "kinematic", settings, rounds, progress)


@pytest.fixture(scope="module")
def study():
    return drive(rounds=20)


def test_all_ten_claims_hold_in_closed_form_as_the_page_on_the_paper_shows(study):
    claims, page = check_claims(study), PAGE.read_text("utf-8")
    assert len(claims) == 10
    for claim in claims:
        assert f"| {claim.claim} | {claim.paper} | {claim.measured} | yes |" in page
        assert claim.holds


@pytest.mark.parametrize(
    ("changes", "broken"),
    [
        # One that may brake in full never collides.
        (
            {"aggressive": {"lowest": -9.0}, "normal": {"lowest": -9.0}},
            {"collisions_by_case", "brake_at_11", "dead_end_state", "dead_end_share"}
            | {"case3_leaves_dead_end", "case4_enters_dead_end"},
        ),
        # The tempting other setting of the notes: cases 2 and 3 collide shortly after 35 s.
        (
            {
                "scenario": {"initial_gap": 10.0},
                "leader": {"brake_speed": 23.8, "brake_decel": 3.6},
                "aggressive": {"lowest": -2.5},
                "normal": {"lowest": -2.5},
            },
            {"collisions_by_case"},
        ),
        # The driver changes beyond the end.
        (
            {"scenario": {"duration": 3.0, "safe_until": 3.0}},
            {"case3_leaves_dead_end", "case4_enters_dead_end"},
        ),
        ({"cases": {"brake_at": [40.0]}, "leader": {"brake_speed": 99.0}}, {"brake_at_40"}),
    ],
)
def test_under_other_settings_claims_fail_that_have_to(changes, broken):
    study = drive(2, **changes)
    claims = check_claims(study)
    holds = {claim.id for claim in claims if claim.holds}
    assert not holds & broken
    told = f"{len(holds)} of {len(claims)} claims of the paper hold in the kinematic world"
    assert page_of(study).answer == told
    if "brake_at_40" in broken:
        assert claims[1].measured == "the leader did not brake"


def test_whoever_forecasts_better_is_where_it_loses(study):
    largest = {row["forecast"]: row["case 1"] for row in divergences(study).to_dicts()}
    assert round(largest["e-FSM"], 3) == 0.051
    assert largest["persistence"] < 0.001
    assert largest["e-FSM, all rounds"] > 0.15
    (lost,) = page_of(study).losses
    assert ("persistence", "case 1") in lost.frame.select("forecast", "where").rows()


def test_one_round_is_a_study_too_and_says_how_far_it_is_and_other_settings_are_refused():
    done = []
    study = drive(progress=lambda *at: done.append(at))
    assert done == sorted(done)
    assert done[-1] == (8, 8)
    assert np.isfinite(divergences(study).drop("forecast").to_numpy()).all()
    with pytest.raises(ValueError, match="at least once"):
        drive(rounds=0)
    with pytest.raises(ValueError, match=r"\[machine\]: there is no 'radios'; known are radius"):
        Settings.load({"machine": {"radios": 1.0}})

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from studies.sensitivity import (
    NEAR,
    PARAMETERS,
    Remembering,
    Sensitivity,
    Trial,
    evaluate,
    filling,
    find_edges,
    reach,
    recovered,
    shares_of,
)

from evofsm.driving import KinematicWorld
from evofsm.paper import check_claims, run_paper


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"brake_speed": 22.0, "initial_gap": 10.0, "bound": 2.5, "radius": 0.5},
        {"spread": 1.0, "learning_rate": 0.1, "prior_frequency": 0.1, "distance_weight": 0.7},
    ],
)
def test_the_fast_way_has_the_verdicts_of_the_papers_study(changes):
    setting = replace(recovered(), **changes)
    row = evaluate(Trial("", "", setting), Remembering(), rounds=3)
    slow = run_paper(KinematicWorld(), "kinematic", setting.paper_settings(), rounds=3)
    verdicts = {claim.id: claim.holds for claim in check_claims(slow)}
    assert verdicts == {claim: row[claim] for claim in verdicts}
    assert row["n_states"] == slow.model.n_states


def test_a_hypercube_fills_each_range_evenly_and_varies_what_its_name_says():
    trials = list(filling("everything", 48, seed=1))
    for one in PARAMETERS.values():
        places = np.array([one.place_of(getattr(trial.setting, one.name)) for trial in trials])
        bins = len(one.choices) or 48
        parts = np.minimum((places * bins).astype(int), bins - 1)
        assert np.array_equal(np.bincount(parts, minlength=bins), np.full(bins, 48 // bins))
    assert trials != list(filling("everything", 48, seed=2))
    assert len({trial.setting.noise_seed for trial in trials}) == 48
    for trial in filling("left open", 6, seed=0):
        assert (trial.setting.radius, trial.setting.noise) == (recovered().radius, 0.0)
        assert trial.setting.spread != recovered().spread
    for trial in filling("near", 6, seed=0):
        assert trial.setting.radius != recovered().radius
        assert trial.setting.radius == pytest.approx(recovered().radius, rel=NEAR)


@pytest.mark.slow
def test_the_edge_of_a_parameter_lies_between_a_value_that_holds_and_one_that_breaks():
    spread, world = PARAMETERS["spread"], Remembering()
    trials = [Trial("sweep", "spread", spread.moved(recovered(), x)) for x in (1.0, 3.0, 10.0)]
    sweep = [evaluate(one, world) for one in trials]
    tried = find_edges(spread, sweep, halvings=5, rounds=20)
    holds = {row["spread"]: row["holds"] for row in tried}
    least = min(value for value in holds if holds[value])
    assert len(holds) == 5
    assert 1.0 < max(value for value in holds if not holds[value]) < least < 3.0
    assert reach(pl.DataFrame([*sweep, *tried]), spread)["all_hold"] == f"{least:.4g} to ≥10"


@pytest.mark.slow
def test_the_study_tries_what_it_says_and_its_page_shows_it():
    study = Sensitivity(settings=8, levels=3, halvings=1, rounds=1)
    found = study.run(workers=1)
    tried = dict(found["rows"].group_by("design").len().iter_rows())
    assert [tried[name] for name in ("everything", "left open", "near")] == [8, 4, 2]
    assert len(found["rows"].filter(design="sweep", varied="order")) == 24
    shares = shares_of(found["rows"])
    held = found["rows"].filter(design="everything")["holds"].mean()
    assert (shares["claim"][-1], shares["everything"][-1]) == ("all of them", held)
    page = study.page(found)
    assert len(page.tables[1].cells) == len(shares) == 11
    assert page.parts[1].draw()

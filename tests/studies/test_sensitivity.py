from dataclasses import replace

import pytest
from studies.sensitivity import Remembering, Sensitivity, Trial, evaluate, recovered, shares_of

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

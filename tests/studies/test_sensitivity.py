from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from studies.sensitivity import (
    NEAR,
    PARAMETERS,
    SCALES,
    SPEED_NOISE,
    STANDARDISED,
    Parameter,
    Remembering,
    Sensitivity,
    Trial,
    evaluate,
    filling,
    find_edges,
    first_order,
    reach,
    recovered,
    shares_of,
    sweeps,
)

from evofsm.driving import KinematicWorld
from evofsm.paper import Settings, check_claims, run_paper

TINY = Sensitivity(settings=8, levels=3, halvings=1, rounds=1)


@pytest.fixture(scope="module")
def tiny():
    return TINY.run(workers=1)["rows"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {},
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


def test_a_setting_says_what_the_paper_study_is_told():
    settings = replace(recovered(), brake_speed=23.0, bound=3.0, radius=0.5).paper_settings()
    assert settings.scenario.leader.brake_speed == 23.0
    assert settings.decel == 3.0
    assert settings.machine["radius"] == 0.5
    assert recovered().paper_settings() == Settings.load()


def test_noise_is_seen_by_the_machine_alone_and_differs_from_run_to_run():
    setting = replace(recovered(), noise=0.2, noise_seed=3)
    settings = setting.paper_settings()
    episode = KinematicWorld().run(settings.scenario, settings.drivers[1])
    before = episode.observations.copy()
    first, again, other = (setting.observe(number, episode) for number in (0, 0, 1))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert np.array_equal(episode.observations, before)
    added = (first - before)[episode.observations[:, 1:].min(axis=1) > 3.0]
    assert added.std(axis=0) == pytest.approx([0.2, 0.2 * SPEED_NOISE, 0.2 * SPEED_NOISE], rel=0.1)
    scaled = replace(recovered(), scaling=STANDARDISED).observe(0, episode)
    assert scaled * SCALES == pytest.approx(before)


@pytest.mark.parametrize("one", PARAMETERS.values(), ids=lambda one: one.name)
def test_every_range_holds_the_recovered_value_and_its_levels_stay_within(one):
    levels = one.levels(9)
    assert levels.count(one.recovered) == 1
    if one.choices:
        assert levels == list(one.choices)
    else:
        assert (levels[0], levels[-1], len(levels)) == (one.low, one.high, 9)
        assert levels == sorted(set(levels))
        assert one.place_of(one.value_at(0.3)) == pytest.approx(0.3)


def test_a_sweep_moves_one_parameter_alone():
    for trial in sweeps(5, 0):
        for name in PARAMETERS.keys() - {trial.varied}:
            assert getattr(trial.setting, name) == getattr(recovered(), name)


def test_a_hypercube_fills_each_range_evenly_and_follows_from_its_seed():
    trials = list(filling("everything", 48, seed=1))
    for one in PARAMETERS.values():
        places = np.array([one.place_of(getattr(trial.setting, one.name)) for trial in trials])
        bins = len(one.choices) or 48
        parts = np.minimum((places * bins).astype(int), bins - 1)
        assert np.array_equal(np.bincount(parts, minlength=bins), np.full(bins, 48 // bins))
    assert trials == list(filling("everything", 48, seed=1))
    assert trials != list(filling("everything", 48, seed=2))
    assert len({trial.setting.noise_seed for trial in trials}) == 48


def test_a_space_varies_what_its_name_says():
    for trial in filling("left open", 6, seed=0):
        assert trial.setting.radius == recovered().radius
        assert trial.setting.noise == 0.0
        assert trial.setting.spread != recovered().spread
    for trial in filling("near", 20, seed=0):
        assert trial.setting.order == "1234"
        assert trial.setting.radius != recovered().radius
        for name in ("radius", "bound", "brake_speed"):
            assert getattr(trial.setting, name) == pytest.approx(
                getattr(recovered(), name), rel=NEAR
            )


def test_what_decides_is_found_and_chance_is_hardly_ever_taken_for_it():
    rng = np.random.default_rng(0)
    bound, spread, order = (PARAMETERS[name] for name in ("bound", "spread", "order"))
    places = rng.random((400, 3))
    values = {
        one.name: [one.value_at(place) for place in column]
        for one, column in zip((bound, spread, order), places.T, strict=True)
    }
    rows, verdicts = pl.DataFrame(values), places[:, 0] > 0.5
    assert first_order(rows, verdicts, bound) > 0.9
    assert first_order(rows, verdicts, spread) == 0.0
    assert first_order(rows, np.ones(400), bound) == 0.0
    by_chance = [first_order(rows, rng.random(400) < 0.3, order) for _ in range(100)]
    assert np.count_nonzero(by_chance) <= 3


@pytest.mark.slow
def test_the_edge_of_a_parameter_lies_between_a_value_that_holds_and_one_that_breaks():
    spread, world = PARAMETERS["spread"], Remembering()
    sweep = [
        evaluate(Trial("sweep", "spread", spread.moved(recovered(), value)), world)
        for value in (1.0, 3.0, 10.0)
    ]
    tried = find_edges(spread, sweep, halvings=5, rounds=20)
    values = {row["spread"]: row["holds"] for row in tried}
    assert len(values) == 5
    low, high = reach(pl.DataFrame([*sweep, *tried]), spread)["all_hold"].split(" to ")
    assert high == "≥10"
    assert float(low) == pytest.approx(min(value for value in values if values[value]), rel=1e-3)
    assert max(value for value in values if not values[value]) < float(low) < 3.0


def test_a_reach_ends_at_the_nearest_value_that_breaks():
    one = Parameter("bound", "", "", "", 1.0, 9.0)
    holds = {1.0: True, 2.0: False, 3.0: True, 4.0: True, 5.0: True, 6.0: False, 7.0: True}
    rows = [{"bound": value, "holds": held, "varied": "bound"} for value, held in holds.items()]
    assert reach(pl.DataFrame(rows), one)["all_hold"] == "3 to 5"


@pytest.mark.slow
def test_the_study_tries_what_it_says_and_its_page_shows_all_of_it(tiny):
    tried = dict(tiny.group_by("design").len().iter_rows())
    assert {name: tried[name] for name in ("everything", "left open", "near")} == {
        "everything": 8,
        "left open": 4,
        "near": 2,
    }
    assert len(tiny.filter(design="sweep", varied="order")) == 24
    page = TINY.page({"rows": tiny})
    shares = shares_of(tiny)
    assert (shares["everything"] == tiny.filter(design="everything")["holds"].mean())[-1]
    assert len(page.tables[1].cells) == len(shares) == 11
    for part in page.parts:
        part.draw() if hasattr(part, "draw") else part.cells

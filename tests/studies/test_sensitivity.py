import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from studies.old.scores import share_of
from studies.sensitivity.designs import NEAR, Design, filling, maps, sweeps
from studies.sensitivity.parameters import PARAMETERS, Parameter, Scale, Standing, parameter
from studies.sensitivity.plan import Plan
from studies.sensitivity.setting import (
    SCALES,
    SPEED_NOISE,
    Remembering,
    Row,
    Scaling,
    evaluate,
    recovered,
    study_of,
)
from studies.sensitivity.shares import first_order, worst_sweeps
from studies.sensitivity.study import _reach, _try_all, run_sensitivity

from evofsm.driving.world import KinematicWorld
from evofsm.fleet.executors import in_order
from evofsm.paper.claims import check_claims
from evofsm.paper.runs import CASES, Settings, run_paper

pytestmark = pytest.mark.slow

TINY = Plan(settings=8, levels=3, side=2, halvings=1, rounds=1)


@pytest.fixture(scope="module")
def world():
    return Remembering(KinematicWorld())


@pytest.fixture(scope="module")
def tiny():
    return run_sensitivity(TINY, workers=1)


def filled(names, values, verdicts):
    """Rows of a made-up design in which one parameter takes these values."""
    return [
        Row(Design.ALL, (names,), replace(recovered(), **{names: value}), {"c": bool(held)}, 7)
        for value, held in zip(values, verdicts, strict=True)
    ]


# -- One setting ----------------------------------------------------------------------------------


def test_all_ten_claims_hold_with_the_recovered_setting(world):
    row = evaluate(recovered(), world)
    assert row.holds
    assert row.held == len(row.verdicts) == 10
    assert row.n_states == 7


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"brake_speed": 22.0, "initial_gap": 10.0, "bound": 2.5, "radius": 0.5},
        {"spread": 1.0, "learning_rate": 0.1, "prior_frequency": 0.1, "distance_weight": 0.7},
    ],
)
def test_the_fast_way_is_the_papers_study_row_by_row(world, changes):
    setting = replace(recovered(), **changes)
    fast = study_of(setting, world, rounds=3)
    slow = run_paper(KinematicWorld(), "kinematic", setting.paper_settings(), rounds=3)
    assert [one.holds for one in check_claims(fast)] == [one.holds for one in check_claims(slow)]
    for one, other in zip(
        (*fast.runs, *fast.extra_runs), (*slow.runs, *slow.extra_runs), strict=True
    ):
        assert np.array_equal(one.state, other.state)
        assert np.array_equal(one.n_states, other.n_states)
        assert np.array_equal(one.surprise, other.surprise, equal_nan=True)
        assert np.array_equal(one.episode.record, other.episode.record)


def test_a_setting_says_what_the_paper_study_is_told():
    setting = replace(recovered(), brake_speed=23.0, bound=3.0, radius=0.5)
    settings = setting.paper_settings()
    assert settings.scenario.leader.brake_speed == 23.0
    assert settings.decel == 3.0
    assert settings.machine["radius"] == 0.5
    assert recovered().paper_settings() == Settings.load()


def test_noise_is_seen_by_the_machine_alone_and_differs_from_run_to_run(world):
    setting = replace(recovered(), noise=0.2, noise_seed=3)
    settings = setting.paper_settings()
    episode = KinematicWorld().run(settings.scenario, settings.drivers[1])
    before = episode.observations.copy()
    first, again, other = (setting.observe(number, episode) for number in (0, 0, 1))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert np.array_equal(episode.observations, before)
    fast = episode.observations[:, 1:].min(axis=1) > 3.0
    added = (first - before)[fast]
    assert added.std(axis=0) == pytest.approx([0.2, 0.2 * SPEED_NOISE, 0.2 * SPEED_NOISE], rel=0.1)
    assert first[:, 1:].min() >= 0.0
    study = study_of(setting, world, rounds=1)
    assert study.runs[0].episode.record == pytest.approx(episode.record)


def test_standardised_observations_are_divided_by_fixed_scales():
    settings = recovered().paper_settings()
    episode = KinematicWorld().run(settings.scenario, settings.drivers[2])
    seen = replace(recovered(), scaling=Scaling.STANDARDISED).observe(0, episode)
    assert seen * SCALES == pytest.approx(episode.observations)


def test_the_order_of_the_cases_is_the_order_in_which_they_are_driven(world):
    study = study_of(replace(recovered(), order=(3, 1, 4, 2)), world, rounds=2)
    assert [run.case for run in study.runs] == [3, 1, 4, 2, 3, 1, 4, 2]
    assert [run.case for run in study.last_round] == [1, 2, 3, 4]


def test_an_order_without_all_cases_is_refused():
    with pytest.raises(ValueError, match="each of the cases once"):
        run_paper(KinematicWorld(), "kinematic", Settings.load(), 1, order=(1, 1, 2, 3))


# -- Parameters -----------------------------------------------------------------------------------


@pytest.mark.parametrize("one", PARAMETERS, ids=lambda one: one.name)
def test_every_range_holds_the_recovered_value_and_its_levels_stay_within(one):
    levels = one.levels(9)
    assert levels.count(one.recovered) == 1
    assert len(set(levels)) == len(levels)
    if one.is_number:
        assert levels[0] == one.low
        assert levels[-1] == one.high
        assert len(levels) == 9
        assert levels == sorted(levels)
    else:
        assert set(levels) == set(one.choices)


@pytest.mark.parametrize("scale", list(Scale))
def test_places_and_values_belong_to_each_other(scale):
    one = Parameter("x", "x", "", "", Standing.OPEN, 0.5, 20.0, scale)
    for place in (0.0, 0.3, 0.99):
        assert one.place_of(one.value_at(place)) == pytest.approx(place)


def test_every_number_that_the_paper_leaves_open_is_varied():
    names = {one.name for one in PARAMETERS}
    assert names | {"noise_seed"} == set(recovered().as_dict())


# -- Designs --------------------------------------------------------------------------------------


def test_a_sweep_moves_one_parameter_and_a_map_two():
    for design, moved in ((sweeps(5, 0), 1), (maps(3, 0), 2)):
        for trial in design:
            assert len(trial.varied) == moved
            still = {one.name for one in PARAMETERS} - set(trial.varied)
            for name in still:
                assert getattr(trial.setting, name) == getattr(recovered(), name)


def test_a_hypercube_fills_each_range_evenly_and_follows_from_its_seed():
    trials = list(filling(Design.ALL, 48, seed=1))
    for one in PARAMETERS:
        places = np.array([one.place_of(getattr(trial.setting, one.name)) for trial in trials])
        bins = len(one.choices) or 48
        parts = np.minimum((places * bins).astype(int), bins - 1)
        assert np.array_equal(np.bincount(parts, minlength=bins), np.full(bins, 48 // bins))
    assert trials == list(filling(Design.ALL, 48, seed=1))
    assert trials != list(filling(Design.ALL, 48, seed=2))
    assert len({trial.setting.noise_seed for trial in trials}) == 48


def test_what_the_paper_states_stays_where_only_what_it_leaves_open_is_drawn():
    for trial in filling(Design.OPEN, 6, seed=0):
        assert trial.setting.radius == recovered().radius
        assert trial.setting.noise == 0.0
        assert trial.setting.scaling is Scaling.RAW
        assert trial.setting.spread != recovered().spread


def test_near_is_within_its_share_of_every_recovered_number():
    for trial in filling(Design.NEAR, 20, seed=0):
        for name in trial.varied:
            assert getattr(trial.setting, name) == pytest.approx(
                getattr(recovered(), name), rel=NEAR
            )
        assert trial.setting.order == CASES
        assert trial.setting.noise == 0.0


def test_only_three_designs_fill_a_space():
    with pytest.raises(ValueError, match="sweep fills no space"):
        next(filling(Design.SWEEP, 4, 0))


# -- Shares ---------------------------------------------------------------------------------------


def test_the_interval_of_a_share_is_exact():
    none = share_of([False] * 100)
    assert none.value == 0.0
    assert none.high == pytest.approx(1.0 - 0.025 ** (1 / 100))
    assert np.isnan(share_of([]).value)


def test_an_index_finds_the_parameter_that_decides_and_no_other():
    rng = np.random.default_rng(0)
    one, other = parameter("bound"), parameter("spread")
    places = rng.random((400, 2))
    verdicts = places[:, 0] > 0.5
    rows = [
        replace(row, setting=other.moved(row.setting, other.value_at(place)))
        for row, place in zip(
            filled("bound", [one.value_at(p) for p in places[:, 0]], verdicts),
            places[:, 1],
            strict=True,
        )
    ]
    decides, idle = (first_order(rows, verdicts, each) for each in (one, other))
    assert decides.value > 0.95
    assert decides.counts
    assert abs(idle.value) < 0.1
    assert not idle.counts


def test_chance_is_hardly_ever_called_an_effect():
    rng = np.random.default_rng(1)
    one = parameter("order")
    values = [one.value_at(place) for place in rng.random(300)]
    rows = filled("order", values, np.zeros(300))
    indices = [first_order(rows, rng.random(300) < 0.3, one) for _ in range(100)]
    assert np.mean([index.value for index in indices]) == pytest.approx(0.0, abs=0.01)
    assert sum(index.counts for index in indices) <= 3


def test_nothing_is_explained_where_nothing_varies():
    rows = filled("bound", np.linspace(2.5, 9.0, 50), [True] * 50)
    index = first_order(rows, [True] * 50, parameter("bound"))
    assert np.isnan(index.value)
    assert not index.counts


def test_the_worst_sweep_leaves_the_recovered_value_out():
    rows = filled("scaling", [Scaling.RAW, Scaling.STANDARDISED], [True, False])
    rows = [replace(row, design=Design.SWEEP) for row in rows]
    worst = worst_sweeps(rows, "c")
    assert [(harm.parameter.name, harm.kept) for harm in worst] == [("scaling", 0.0)]


# -- The study ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_study_tries_what_its_plan_says(tiny):
    assert len(tiny.of(Design.ALL)) == 8
    assert len(tiny.of(Design.OPEN)) == 4
    assert len(tiny.of(Design.NEAR)) == 2
    assert len(tiny.of(Design.SWEEP, "bound")) == 3
    assert len(tiny.of(Design.SWEEP, "order")) == 24
    assert len(tiny.of(Design.MAP, "brake_speed", "initial_gap")) == 4
    assert len(tiny.of(Design.RECOVERED)) == 1
    assert len(tiny.claims) == 10


def test_rows_are_plain_json_with_a_verdict_for_each_claim(tiny):
    rows = json.loads(json.dumps(tiny.frame.as_dicts(), allow_nan=False))
    assert len(rows) == len(tiny.rows)
    claims = [claim.id for claim in tiny.claims]
    for row in rows:
        assert row["held"] == sum(row[claim] for claim in claims)
        assert row["holds"] == all(row[claim] for claim in claims)
        assert {one.name for one in PARAMETERS} <= set(row)


@pytest.mark.slow
def test_the_same_rows_come_out_of_one_process_and_of_two():
    trials = list(filling(Design.ALL, 6, seed=0))
    tasks = [partial(_try_all, trials[:3], 1), partial(_try_all, trials[3:], 1)]
    one, two = (in_order(tasks, workers) for workers in (1, 2))
    assert one == two
    assert [row.setting for rows in one for row in rows] == [trial.setting for trial in trials]


def test_the_edge_of_a_parameter_lies_between_a_value_that_holds_and_one_that_breaks(world):
    one = parameter("spread")
    sweep = [
        evaluate(one.moved(recovered(), value), world, Design.SWEEP, ("spread",))
        for value in (1.0, 3.0, 10.0)
    ]
    reach, tried = _reach(one, sweep, Plan(halvings=5))
    assert 1.0 < reach.low < 3.0
    assert reach.broken_below == ("jsd_max_by_case",)
    assert not reach.low_is_end
    assert reach.high == 10.0
    assert reach.high_is_end
    assert len(tried) == 5
    assert evaluate(one.moved(recovered(), reach.low), world).holds


def test_progress_ends_with_everything_done():
    told = []
    run_sensitivity(replace(TINY, settings=4, levels=2), lambda *done: told.append(done), workers=1)
    assert told[-1][0] == told[-1][1]
    assert [done for done, _ in told] == sorted(done for done, _ in told)


@pytest.mark.parametrize("name", ["settings", "levels", "side", "rounds"])
def test_a_plan_of_nothing_is_refused(name):
    with pytest.raises(ValueError, match=f"{name} is 0"):
        Plan(**{name: 0})


def test_a_short_plan_is_no_larger_in_anything():
    short = Plan().shortened()
    assert short.settings < 200
    assert short.rounds == Plan().rounds == 20
    assert Plan(settings=10).shortened().settings == 10

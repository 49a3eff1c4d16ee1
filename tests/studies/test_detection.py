"""Who sees danger: scores, alarms, what is watched, and the study as a whole."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from studies.detection.alarms import (
    choose_threshold,
    count_alarms,
    is_measurable,
    lead_times,
)
from studies.detection.measures import Detector, Ours, Watcher, classic, fixed, tuned
from studies.detection.plan import Plan
from studies.detection.rows import Row, Scored, judge
from studies.detection.study import run_detection
from studies.detection.watch import (
    Cases,
    Exposure,
    Target,
    Watched,
    calibration_draws,
    expose,
    held_out_draws,
    watch,
)
from studies.detection.worlds import GRID, grid_world, world
from studies.old.frame import Frame
from studies.old.scores import Ranked, auprc, auroc, bootstrap, brier, isotonic
from studies.policies import Group

from evofsm.driving import measures
from evofsm.driving.episodes import drive, unrevised_guard
from evofsm.driving.families import load_family

TINY = Plan(
    train=6,
    since=3,
    seeds=2,
    hours=0.05,
    long_hours=0.05,
    rounds=5,
    seed_hours=0.02,
    grid=(2.0, 4.0),
    grid_leader=(6.0,),
    grid_train=4,
    grid_hours=0.02,
)


# -- Scores ---------------------------------------------------------------------------------------


def test_areas_are_those_of_their_definitions() -> None:
    rng = np.random.default_rng(0)
    score, truth = rng.integers(6, size=60).astype(float), rng.random(60) < 0.4
    above = score[truth][:, None] - score[~truth]
    assert auroc(score, truth) == pytest.approx(((above > 0) + 0.5 * (above == 0)).mean())
    thresholds = np.unique(score)[::-1]
    recall = np.array([truth[score >= t].sum() for t in thresholds]) / truth.sum()
    precision = np.array([truth[score >= t].mean() for t in thresholds])
    assert auprc(score, truth) == pytest.approx(np.diff(recall, prepend=0.0) @ precision)


def test_an_episode_counts_as_often_as_it_was_drawn() -> None:
    rng = np.random.default_rng(1)
    score, truth, episode = rng.random(30), rng.random(30) < 0.5, np.repeat(np.arange(3), 10)
    twice = np.concatenate([np.flatnonzero(episode == k) for k in (0, 0, 2)])
    by_weight = Ranked(score, truth, episode).areas([2, 0, 1])
    assert by_weight == pytest.approx(Ranked(score[twice], truth[twice]).areas())


def test_infinite_scores_have_a_rank_and_nan_has_none() -> None:
    truth = [False, True, False, True]
    assert auroc([-np.inf, np.inf, 0.0, np.inf], truth) == 1.0
    with pytest.raises(ValueError, match="NaN"):
        auroc([0.0, np.nan, 0.0, 1.0], truth)
    with pytest.raises(ValueError, match="equally long"):
        auroc([0.0], truth)


def test_areas_need_both_kinds() -> None:
    assert np.isnan(auroc([1.0, 2.0], [True, True]))
    assert auprc([1.0, 2.0], [True, True]) == 1.0
    assert np.isnan(auprc([1.0, 2.0], [False, False]))


def test_isotonic_probabilities_never_fall_and_fit_better_than_the_base_rate() -> None:
    rng = np.random.default_rng(2)
    score = np.append(rng.normal(size=400), [np.inf, -np.inf])
    truth = rng.random(402) < 1.0 / (1.0 + np.exp(-2.0 * score))
    calibrate = isotonic(score, truth)
    probability = calibrate(np.append(np.sort(score), np.inf))
    assert (np.diff(probability) >= 0.0).all()
    assert 0.0 <= probability[0] <= probability[-1] <= 1.0
    assert brier(calibrate(score), truth) < truth.var()


def test_a_bootstrap_leaves_out_what_has_no_number() -> None:
    values = np.arange(20.0)
    low, high = bootstrap(lambda chosen: float(values[chosen].mean()), 20)
    assert 5.0 < low < values.mean() < high < 14.0
    assert np.isnan(bootstrap(lambda chosen: float("nan"), 20, rounds=3)).all()


# -- Alarms ---------------------------------------------------------------------------------------


def cases(truth: list[bool]) -> Cases:
    """One episode, a decision every 0.25 s."""
    n = len(truth)
    return Cases(
        np.arange(n), np.array(truth), np.zeros(n, int), np.array([0, n]), n * 0.25 / 3600.0
    )


def raised(n: int, *rows: int) -> np.ndarray:
    score = np.zeros(n)
    score[list(rows)] = 1.0
    return score


def test_alarms_no_more_than_a_second_apart_are_one() -> None:
    safe = cases([False] * 40)
    assert count_alarms(raised(40, 5, 9), safe, 0.5, 0.25).false == 1
    assert count_alarms(raised(40, 5, 10), safe, 0.5, 0.25).false == 2


def test_an_alarm_holds_for_a_second() -> None:
    alarms = count_alarms(raised(40, 5), cases([False] * 40), 0.5, 0.25)
    assert alarms.false_decisions == 4


def test_an_alarm_comes_true_if_the_target_follows_while_it_is_on() -> None:
    late = cases([False] * 12 + [True] * 8)
    assert count_alarms(raised(20, 10), late, 0.5, 0.25)[:2] == (0, 1)
    assert count_alarms(raised(20, 2), late, 0.5, 0.25)[:2] == (1, 0)


def test_an_alarm_that_is_always_on_is_false_where_the_target_is_far() -> None:
    always = np.ones(60)
    near, far = cases([False] * 20 + [True] * 40), cases([False] * 21 + [True] * 39)
    assert count_alarms(always, near, 0.5, 0.25).false == 0
    assert count_alarms(always, far, 0.5, 0.25).false == 1


def test_the_threshold_keeps_the_rate_on_what_it_was_chosen_on() -> None:
    rng = np.random.default_rng(3)
    n = 4 * 3600 * 4
    some = cases((rng.random(n) < 0.02).tolist())
    score = rng.normal(size=n) + some.truth
    thresholds = [choose_threshold(score, some, rate, 0.25) for rate in (2.0, 10.0, 50.0)]
    assert thresholds == sorted(thresholds, reverse=True)
    for rate, threshold in zip((2.0, 10.0, 50.0), thresholds, strict=True):
        assert count_alarms(score, some, threshold, 0.25).false <= rate * some.hours
    assert choose_threshold(score, cases([True] * n), 1.0, 0.25) == -np.inf


def test_a_rate_needs_three_expected_events() -> None:
    assert is_measurable(1.0, 3.0)
    assert not is_measurable(0.1, 29.9)


def exposure(*collided: bool, n: int = 40) -> Exposure:
    """Episodes in which nothing moves, each as long."""
    still = np.tile([10.0, 0.0, 0.0], (n, 1))
    watched = (Watched(still, still, np.zeros(n), n * 0.25, one) for one in collided)
    return Exposure(load_family("emergency"), tuple(watched))


def test_lead_time_is_that_of_the_alarm_that_stays_on() -> None:
    three = exposure(True, False, True)
    score = np.concatenate([raised(40, 3, *range(30, 40)), np.ones(40), raised(40, 10)])
    assert lead_times(score, three, 0.5).tolist() == [2.5, 0.0]


# -- What is watched ------------------------------------------------------------------------------


def test_watching_is_driving_unrevised() -> None:
    family = load_family("rare").with_switches(["noise"])
    draw = family.draw(1, 2, split="test")
    one, driven = watch(family, draw), drive(unrevised_guard(family), draw)
    seen = [decision.situation.observation for decision in driven.decisions]
    assert np.array_equal(one.seen, seen)
    assert np.array_equal(one.commands, driven.executed)
    assert np.array_equal(one.true, driven.observations[::25][: len(seen)])
    assert (one.end, one.collided) == (driven.time[-1], driven.collided)


def test_runs_that_are_always_the_same_add_no_hours() -> None:
    family = load_family("r157")
    assert len(expose(family, held_out_draws(family, 0), hours=1.0).watched) == 7
    few_kinds = load_family("ncap")  # of which some draws are the same by chance
    assert len(expose(few_kinds, held_out_draws(few_kinds, 0), hours=0.2).watched) > 30


def test_hours_are_those_of_every_target() -> None:
    family = load_family("rare")
    some = expose(family, held_out_draws(family, 0), hours=0.1)
    assert 0.1 <= some.cases(Target.COLLISION).hours < some.cases(Target.DEAD_END).hours < 0.13


def test_draws_for_thresholds_are_nobody_elses() -> None:
    here = world("emergency", TINY)
    calibration = next(calibration_draws(here.family, 0))
    others = [draw for seed in range(3) for _, draw in here.training(TINY, seed)]
    assert calibration not in others
    assert calibration != next(held_out_draws(here.family, 0))


def test_what_would_have_come_after_the_end_is_left_out() -> None:
    safe, crash = exposure(False), exposure(True)
    assert len(safe.cases(Target.COLLISION).truth) == 21  # the last five seconds are not known
    truth = crash.cases(Target.COLLISION).truth
    assert truth.tolist() == [False] * 20 + [True] * 20


def test_worlds_by_name() -> None:
    shift, at_once = world("shift", TINY), world("shift-at-once", TINY)
    assert (shift.watched.decel, shift.family.decel, shift.since) == (4.5, 2.5, TINY.since)
    assert at_once.since == 0
    assert at_once.settled.decel == 4.5
    families = [family.decel for family, _ in shift.training(TINY, 0)]
    assert families == [4.5] * TINY.train + [2.5] * TINY.since
    noisy = world("emergency+noise", TINY).family.draw(0, 0).scenario.sensors
    assert noisy.gap_noise > 0.0
    paper = world("paper", TINY).family
    assert paper.name == "paper"
    assert paper.draw(0, 0).scenario.initial_gap != paper.draw(0, 4).scenario.initial_gap
    with pytest.raises(ValueError, match="no shift"):
        world("rare-at-once", TINY)


def test_worlds_of_the_grid_have_the_brakes_asked_for() -> None:
    family = grid_world(3.0, 7.5, Plan()).family
    assert (family.decel, family.leader_decel) == (3.0, 7.5)
    scenario = family.draw(0, 0).scenario
    assert scenario.body.lowest == -3.0
    assert 2.5 <= scenario.leader.brake_decel <= 7.5


# -- Measures -------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["emergency", "emergency+noise"])
def watcher(request: pytest.FixtureRequest) -> tuple[Watcher, Exposure]:
    """One that has watched, and what it is judged on."""
    here = world(request.param, TINY)
    return (
        Watcher(here.watched).watch(here.training(TINY, 0)),
        expose(here.family, held_out_draws(here.family, 0), 0.02),
    )


def test_scores_know_nothing_of_what_comes_later(watcher: tuple[Watcher, Exposure]) -> None:
    mine, some = watcher
    half = Exposure(
        some.family,
        tuple(
            one._replace(seen=one.seen[:20], true=one.true[:20], commands=one.commands[:20])
            for one in some.watched
        ),
    )
    first = np.append(0, np.cumsum([len(one.commands) for one in some.watched]))[:-1]
    rows = (first[:, None] + np.arange(20)).ravel()
    for detector in [*mine.detectors(), *fixed(some.family)]:
        np.testing.assert_allclose(
            detector.score(half), detector.score(some)[rows], atol=1e-12, err_msg=detector.name
        )


def test_ours_tells_dead_ends_and_states_are_coarser(watcher: tuple[Watcher, Exposure]) -> None:
    mine, some = watcher
    truth = some.cases(Target.DEAD_END).truth
    areas = {one.name: auroc(one.score(some), truth) for one in mine.detectors()}
    assert areas[Ours.DEFAULT] > 0.98
    assert areas[Ours.DEFAULT] > areas[Ours.PAPER_ACTIONS]


def test_without_noise_the_score_is_that_of_what_is_seen() -> None:
    here = world("emergency", TINY)
    mine = Watcher(here.watched, states=False).watch(here.training(TINY, 0))
    some = expose(here.family, held_out_draws(here.family, 0), 0.01)
    seen = np.concatenate([one.seen for one in some.watched])
    assert np.array_equal(mine.latent_risk(some), mine.risk.score(seen))
    assert [one.name for one in mine.detectors()] == [Ours.DEFAULT]


def test_tuning_takes_what_tells_best_in_training() -> None:
    family = load_family("weak_brakes")
    some = Exposure(family, tuple(watch(family, family.draw(0, index)) for index in range(12)))
    truth = some.cases(Target.DEAD_END).truth
    unmatched = measures.ResponsibilitySensitiveSafety.r157()
    best = auroc(tuned(some, Target.DEAD_END).score(some), truth)
    assert best >= auroc(classic("", Group.FIXED, unmatched).score(some), truth) - 0.01


# -- Rows -----------------------------------------------------------------------------------------


def oracle(target: Target) -> Detector:
    """Knows the truth of everything but what is never known."""

    def score(some: Exposure) -> np.ndarray:
        known = some.cases(target)
        scores = np.zeros(sum(len(one.commands) for one in some.watched))
        scores[known.rows] = np.where(known.truth, 1.0, -1.0)
        return scores

    return Detector("oracle", Group.BOUND, score)


def judged(target: Target, some: Exposure, other: Exposure) -> Row:
    seer = oracle(target)
    now, before = (Scored(one, seer.score(one)) for one in (some, other))
    return judge("emergency", seer, target, now, before, rounds=3).row


def test_who_knows_the_truth_is_perfect() -> None:
    family = load_family("emergency")
    some = expose(family, held_out_draws(family, 0), 0.1)
    row = judged(Target.DEAD_END, some, expose(family, calibration_draws(family, 0), 0.1))
    assert (row.auroc, row.auroc_low, row.auprc) == (1.0, 1.0, 1.0)
    assert (row.brier, row.missed, row.called) == (0.0, 0.0, 0.0)
    assert row.lead_median_1 is None  # of one false alarm per hour nothing is known after this
    assert row.false_alarms_1 is None


def test_with_hours_enough_lead_times_are_told() -> None:
    long = exposure(*720 * (True, False))
    row = judged(Target.COLLISION, long, long)
    assert row.hours > 3.0
    assert (row.false_alarms_1, row.warned_1, row.false_time_1) == (0.0, 1.0, 0.0)
    assert row.lead_median_1 == row.lead_p10_1 == 5.0
    assert row.lead_median_01 is None


# -- The study ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_study_does_not_depend_on_the_number_of_workers() -> None:
    plan = replace(TINY, grid=(2.0,), family="r157,ncap")
    seen: list[tuple[int, int]] = []
    alone = run_detection(plan, lambda done, total: seen.append((done, total)), workers=1)
    shared = run_detection(plan, workers=2)
    assert repr(alone) == repr(shared)
    assert seen[-1] == (5, 5)
    assert {row.family for row in alone.rows} == set(plan.families)
    assert {row.target for row in alone.rows} == set(Target)
    assert all(row.family == GRID for row in alone.grid)
    row = alone.row("ncap", Ours.DEFAULT, Target.DEAD_END)
    assert row is not None
    assert len(row.auroc_seeds) == plan.seeds - 1
    assert alone.row("ncap", "nobody", Target.DEAD_END) is None


def test_rows_are_plain_numbers() -> None:
    study = replace(TINY, seeds=1, family="r157", with_grid=False).run(workers=1)
    assert study.grid == []
    for row in study.rows:
        assert isinstance(row, Row)
        (document,) = Frame([row]).as_dicts()
        json.dumps(document)
        assert {"family", "measure", "target", "auroc", "auprc", "brier", "episodes"} < set(
            document
        )
        assert document["episodes"] == 7
        assert document["lead_median_1"] is None  # seven fixed runs are no hours


def test_a_wrong_family_is_told_before_anything_is_driven() -> None:
    with pytest.raises(ValueError, match="nowhere"):
        run_detection(replace(TINY, family="emergency,nowhere"))


def test_a_short_plan_still_measures_one_alarm_an_hour() -> None:
    plan = Plan(seed=3).shortened()
    assert is_measurable(1.0, plan.hours_of("paper"))
    assert plan.seed == 3
    assert plan.train < Plan().train

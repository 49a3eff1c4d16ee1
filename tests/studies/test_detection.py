"""Who sees danger: what is watched, alarms as events, and the study."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from studies import detection, lib
from studies.detection import OURS, PAPER, STATES, Danger, Detection, Exposure, Watched

from evofsm.driving import load_family
from evofsm.paper import write_page

TINY = Detection(train=6, since=3, seeds=2, hours=0.05, rounds=5, seed_hours=0.02)
TINY = replace(TINY, grid=(2.0,), grid_leader=(6.0,), grid_train=4, grid_hours=0.02)


def cases(truth):
    """One episode, a decision every 0.25 s."""
    n = len(truth)
    hours = n * 0.25 / 3600.0
    return detection.Cases(np.arange(n), np.array(truth), np.zeros(n, int), np.array([0, n]), hours)


def raised(n, *rows):
    score = np.zeros(n)
    score[list(rows)] = 1.0
    return score


def exposure(*collided, n=40):
    """Episodes in which nothing moves, each as long."""
    still = np.tile([10.0, 0.0, 0.0], (n, 1))
    watched = (Watched(still, still, np.zeros(n), n * 0.25, one) for one in collided)
    return Exposure(load_family("emergency"), tuple(watched))


def test_alarms_hold_for_a_second_and_come_true_if_the_danger_follows_soon():
    safe, late = cases([False] * 40), cases([False] * 12 + [True] * 8)
    near, far = cases([False] * 20 + [True] * 40), cases([False] * 21 + [True] * 39)
    for score, some, false in (
        (raised(40, 5, 9), safe, 1),  # no further apart they are one
        (raised(40, 5, 10), safe, 2),
        (raised(20, 10), late, 0),
        (raised(20, 2), late, 1),
        (np.ones(60), near, 0),
        (np.ones(60), far, 1),
    ):
        assert detection.count_alarms(score, some, 0.5, 0.25)[0] == false
    assert detection.count_alarms(raised(40, 5), safe, 0.5, 0.25) == (1, 4)


def test_lead_time_is_that_of_the_alarm_that_stays_on_and_what_came_after_the_end_is_left_out():
    three = exposure(True, False, True)
    score = np.concatenate([raised(40, 3, *range(30, 40)), np.ones(40), raised(40, 10)])
    assert detection.lead_times(score, three, 0.5).tolist() == [2.5, 0.0]
    safe, crash = exposure(False), exposure(True)
    assert len(safe.cases(Danger.COLLISION).truth) == 21  # the last five seconds are not known
    truth = crash.cases(Danger.COLLISION).truth
    assert truth.tolist() == [False] * 20 + [True] * 20


@pytest.mark.parametrize("name", ["emergency", "emergency+noise"])
def test_scores_know_nothing_of_what_comes_later_and_ours_tells_dead_ends(name):
    here = detection.world(name)
    watcher = detection.Watcher(here.watched).watch(here.training(0, 0, 6))
    some = detection.expose(here.family, detection.held_out_draws(here.family, 0), 0.02)
    half = some._replace(
        watched=tuple(
            one._replace(seen=one.seen[:20], true=one.true[:20], commands=one.commands[:20])
            for one in some.watched
        )
    )
    rows = (some.first[:-1, None] + np.arange(20)).ravel()
    scores = watcher.scores()
    assert set(scores) == {OURS, STATES, PAPER}
    for measure, score in (scores | detection.classics(some.family)).items():
        np.testing.assert_allclose(score(half), score(some)[rows], atol=1e-12, err_msg=measure)
    truth = some.cases(Danger.DEAD_END).truth
    assert lib.Ranked(scores[OURS](some), truth).areas().auroc > 0.98


@pytest.fixture(scope="module")
def found():
    return replace(TINY, family="r157,cut_in").run(workers=1)


def test_every_measure_is_judged_in_every_world(found):
    rows = found["rows"]
    assert set(rows["family"]) == {"r157", "cut_in"}
    assert set(rows["danger"]) == {str(one) for one in Danger}
    names = {OURS, STATES, PAPER, "rss-tuned", *detection.classics(load_family("r157"))}
    assert set(rows["measure"]) == names
    assert set(rows.filter(family="r157")["episodes"]) == {7}
    assert rows["lead"].null_count() == len(rows)  # so few hours cannot tell one alarm per hour
    assert rows.filter(measure=OURS, danger=Danger.DEAD_END)["auroc"].min() > 0.9
    assert len(found["seeds"]) == 2 * 3
    assert set(found["grid"]["measure"]) == {OURS, "rss-r157", "rss-matched"}


def test_the_page_says_where_ours_loses_and_is_sound(found, tmp_path, read_page):
    lead = pl.when(measure="ttc").then(9.0).otherwise(1.0)
    page = TINY.page({**found, "rows": found["rows"].with_columns(lead=lead, false_time=0.1)})
    read_page(write_page(tmp_path / "index.html", [page])).is_sound()
    assert "ttc" in set(page.losses[0].frame["measure"])

"""The prediction study: fair references, honest splits, the same with any number of workers."""

from dataclasses import replace

import numpy as np
import pytest
from studies.prediction.forecasters import REFERENCES, Method, Variant, batch, stays, teach
from studies.prediction.plan import Plan
from studies.prediction.scoring import Sums, score, skill, together
from studies.prediction.sources import (
    Episode,
    Pace,
    Source,
    drive,
    log_sources,
    read,
    split_logs,
)
from studies.prediction.study import run_prediction as run

from evofsm.fsm.rules import Novelty

pytestmark = pytest.mark.slow

TINY = Plan(
    train=10, test=4, fine_train=1, fine_test=1, seeds=2, fine_seeds=1, parts=2, ablation=(),
    rounds=50,
)  # fmt: skip


def write_log(path, seed, rows=400):
    """A follower behind a leader whose speed sways."""
    rng = np.random.default_rng(seed)
    t = np.round(np.arange(rows) * 0.1, 9)
    leader = 10.0 + 3.0 * np.sin(0.3 * t + rng.uniform(0, 6))
    follower = 10.0 + 3.0 * np.sin(0.3 * (t - 2.0) + rng.uniform(0, 0.2))
    gap = 15.0 + np.cumsum(leader - follower) * 0.1
    accel = np.gradient(follower, 0.1)
    lines = ["time,gap,v_follower,v_leader,a_follower"]
    columns = zip(t, gap, follower, leader, accel, strict=True)
    lines += [",".join(f"{value:.4f}" for value in row) for row in columns]
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    for k in range(3):
        write_log(folder / f"track_{k}.csv", k)
    write_log(folder / "lonely.csv", 9)
    (folder / "MANIFEST.csv").write_text("file,rows\ntrack_0.csv,400\n")
    return folder


@pytest.fixture(scope="module")
def study(logs):
    return run(TINY, log_sources(logs), workers=1, families=["stop_and_go"])


def test_every_method_has_a_row_at_every_horizon(study):
    simulated = {*Pace.STEPS.horizons, *Pace.DECISIONS.horizons}
    for method in Method:
        assert {row.horizon for row in study.of("stop_and_go", method)} == simulated
        assert {row.horizon for row in study.of("track", method)} == set(Pace.LOGS.horizons)


def test_ours_beats_persistence_and_the_paper_does_not(study):
    ours = {row.horizon: row for row in study.of("stop_and_go", Method.EVOFSM)}
    paper = {row.horizon: row for row in study.of("stop_and_go", Method.PAPER)}
    for horizon in (1.0, 2.0):
        assert ours[horizon].low > 0.1
        assert ours[horizon].log_low > 0.1
        assert paper[horizon].high < 0.0


def test_a_reference_has_no_skill_against_itself_and_all_are_judged_alike(study):
    for row in study.rows:
        persistence, _ = REFERENCES[Method(row.method)]
        rival = next(one for one in study.of(row.source, persistence) if one.horizon == row.horizon)
        assert row.forecasts == rival.forecasts
        if row.method == persistence:
            assert row.skill_persistence == row.log_skill_persistence == 0.0


@pytest.mark.slow
def test_workers_change_nothing():
    small = replace(TINY, train=3, test=2, fine_seeds=0)
    alone, shared = (run(small, workers=n, families=["cut_in"]) for n in (1, 2))
    assert alone.frame == shared.frame


def test_each_run_is_held_out_once_and_never_learnt_from_then(logs):
    (source,) = log_sources(logs)
    assert source.name == "track"
    held = []
    for part in range(2):
        train, test = split_logs(source, 0, part, 2)
        assert not set(train) & set(test)
        assert sorted(train + test) == sorted(source.files)
        held += test
    assert sorted(held) == sorted(source.files)


def test_logs_become_episodes(logs):
    (source,) = log_sources(logs)
    found = read(source, source.files[:1], source.files[1:])
    assert len(found.train) == 1
    assert len(found.test) == 2
    assert found.train[0].observations.shape == (400, 3)
    assert found.train[0].actions.max() <= 16


def test_a_folder_without_logs_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no two logs of one origin"):
        log_sources(tmp_path)


def test_training_and_test_drives_differ():
    source = drive("cut_in", Pace.DECISIONS, 0, 0, 2, 2)
    other = drive("cut_in", Pace.DECISIONS, 0, 1, 1, 2)
    assert not np.array_equal(source.train[0].observations[:5], source.test[0].observations[:5])
    assert not np.array_equal(source.train[0].observations[:5], other.train[0].observations[:5])
    np.testing.assert_array_equal(source.test[1].observations, other.test[1].observations)


def test_scores_by_hand():
    beliefs = np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]])
    episodes = [(beliefs, np.zeros(3, np.int64))]
    perfect = {"ahead": lambda b, a: beliefs[1:], "stays": stays}
    found = score(perfect, episodes, 1, 1, first=7)
    assert found["ahead"].divergence == pytest.approx([0.0], abs=1e-12)
    assert found["ahead"].excess == pytest.approx([0.0], abs=1e-5)
    assert found["ahead"].log_score == pytest.approx([1.0], abs=1e-5)
    # Half of what came had a forecast of 0, which counts as 1e-6 / 2; then half a bit more.
    missed = 0.5 * (-np.log2(5e-7)) - 1.0
    assert found["stays"].excess == pytest.approx([missed + 1.0], abs=1e-4)
    assert found["stays"].forecasts == [2.0]
    assert found["stays"].episodes == [7]


def test_an_episode_of_several_rounds_is_one():
    one = Sums(*(np.array([1.0, 2.0]) for _ in range(4)), np.array([0, 1]), 5)
    two = Sums(*(np.array([4.0, 8.0]) for _ in range(4)), np.array([1, 2]), 7)
    both = together([one, two])
    assert both.divergence.tolist() == [1.0, 6.0, 8.0]
    assert both.episodes.tolist() == [0, 1, 2]
    assert both.states == 6


def test_skill_is_nan_where_the_reference_is_perfect():
    assert skill(np.array([1.0]), np.array([2.0])) == 0.5
    assert np.isnan(skill(np.array([1.0]), np.array([0.0])))


def test_the_batch_counts_transitions_at_the_lag():
    path = np.array([[0.0], [9.0], [0.0], [9.0], [0.0], [9.0]])
    episode = Episode(path, np.zeros(6, np.int64))
    taught = teach(Source("line", Pace.LOGS, 1, [episode], [episode]), Novelty(radius=1.0))
    one, two = batch(taught, [1, 2])
    states, none = np.eye(2), np.zeros(2, np.int64)
    np.testing.assert_allclose(one(states, none), [[0.0, 1.0], [1.0, 0.0]])
    np.testing.assert_allclose(two(states, none), states)


def test_the_ablation_has_every_variant():
    plan = replace(TINY, train=4, test=2, seeds=0, fine_seeds=0, ablation=("cut_in",))
    study = run(plan, workers=1, families=["cut_in"])
    assert [row.method for row in study.ablation if row.horizon == 1.0] == list(Variant)
    assert all(row["ablation"] for row in study.frame.as_dicts() if row["method"] in list(Variant))

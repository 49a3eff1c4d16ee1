"""Real data: what is asked, what is learnt, and how it is judged, on small made-up drives."""

import json
import shutil

import numpy as np
import pytest
from studies.counts import OutcomeCounts
from studies.datasets.episodes import Episode
from studies.old.scores import auroc
from studies.real.cases import HORIZONS, Question, case_of, recent_acceleration
from studies.real.measures import MEASURES, ComingByState, approach, learn_logistic
from studies.real.moments import Kind, alarm_threshold, lead_before, leads, telling_moments
from studies.real.plan import Plan
from studies.real.study import fold_of_runs, read_folder, run_real
from studies.real.targets import TARGETS, coming, onsets

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.rules import Novelty

TINY = Plan(folds=2, rounds=20)
TTC_3, BRAKING = Question("ttc-3", 2.0), Question("braking-3", 2.0)


# -- Made-up drives -------------------------------------------------------------------------------


def drive(seed, seconds=60.0):
    """A follower who reacts late to a leader who brakes now and then: (T, 5) rows of a log."""
    rng = np.random.default_rng(seed)
    braking = rng.uniform(5.0, seconds - 8.0, size=2)
    gap, v, lead, accel, rows = 18.0, 15.0, 15.0, 0.0, []
    for k in range(round(10 * seconds)):
        time = k / 10.0
        hard = any(start <= time < start + 2.5 for start in braking)
        push = -5.0 if hard else 0.8 * (15.0 - lead)
        closing = v - lead
        wish = -6.0 if gap < 1.6 * closing + 4.0 else 0.6 * (15.0 - v) + 0.1 * (gap - 18.0)
        rows.append((time, gap, v, lead, accel))
        accel = float(np.clip(0.8 * accel + 0.2 * np.clip(wish, -6.0, 2.0), -6.0, 2.0))
        lead, v = max(lead + 0.1 * push, 0.0), max(v + 0.1 * accel, 0.0)
        gap = max(gap + 0.1 * (lead - v), 1.0)
    return np.array(rows)


def write_runs(folder, runs=range(4)):
    folder.mkdir(exist_ok=True)
    for run in runs:
        lines = ["run,pair,segment,time,gap,v_follower,v_leader,a_follower"]
        for pair in range(2):
            rows = drive(10 * run + pair)
            lines += [
                ",".join([f"made_{run}", f"v{pair}-v{pair + 1}", "0", *(f"{x:.3f}" for x in row)])
                for row in rows
            ]
        (folder / f"made_{run}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_runs(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def cases(folder):
    return read_folder(folder, TINY)[0]


@pytest.fixture(scope="module")
def study(cases):
    return run_real(cases, TINY, workers=1)


def episode(observations, accelerations=None, dt=0.1):
    rows = np.asarray(observations, dtype=np.float64)
    given = np.zeros(len(rows)) if accelerations is None else np.asarray(accelerations)
    return Episode("run", "v1-v2", dt * np.arange(len(rows)), rows, given, dt)


# -- What is asked --------------------------------------------------------------------------------


def test_a_short_time_to_collision_counts_only_while_driving():
    fast, slow = [10.0, 12.0, 7.0], [4.0, 4.0, 2.0]  # both 2 s before contact
    happens = TARGETS[0].happens(episode([fast, slow, fast]))
    assert happens.tolist() == [True, False, True]


def test_what_is_under_way_or_not_known_is_no_case():
    happens = np.array([False, False, False, True, True, False, False])
    came, known = coming(happens, 2)
    assert came.tolist() == [False, True, True, True, False, False, False]
    # While it happens nothing is asked; the last two rows do not see two steps ahead.
    assert known.tolist() == [True, True, True, False, False, False, False]


def test_an_event_before_the_end_is_known_even_if_the_end_is_near():
    came, known = coming(np.array([False, False, True]), 5)
    assert came.tolist() == [True, True, False]
    assert known.tolist() == [True, True, False]


def test_an_event_that_an_episode_begins_with_has_no_beginning():
    assert onsets(np.array([True, True, False, True])).tolist() == [3]


def test_events_between_two_decisions_are_not_overlooked():
    accelerations = np.zeros(40)
    accelerations[31] = -4.0  # an odd row, and decisions are made in even ones
    case = case_of(episode([[20.0, 10.0, 10.0]] * 40, accelerations))
    came, known = case.answers[BRAKING]
    assert case.times[came & known] == pytest.approx(np.arange(12, 31, 2) / 10.0)
    assert case.begins["braking-3"] == pytest.approx([3.1])


def test_rows_that_do_not_fall_on_decisions_are_refused():
    with pytest.raises(ValueError, match=r"run, v1-v2: a row every 0\.15 s"):
        case_of(episode([[20.0, 10.0, 10.0]] * 40, dt=0.15))


def test_nothing_that_is_observed_looks_ahead():
    full = case_of(episode(drive(3)[:, 1:4]))
    part = case_of(episode(drive(3)[:300, 1:4]))
    np.testing.assert_array_equal(approach(full)[:150], approach(part))
    assert recent_acceleration(np.array([3.0, 2.0])).tolist() == [0.0, 0.0]


# -- Runs and folds -------------------------------------------------------------------------------


def test_every_run_is_in_one_fold_and_sources_are_dealt_evenly():
    runs = [f"{source}_{k}" for source in ("ngsim", "openacc") for k in range(10)]
    folds = fold_of_runs(runs, 5, seed=3)
    for source in ("ngsim", "openacc"):
        counts = np.bincount([fold for run, fold in folds.items() if run.startswith(source)])
        assert counts.tolist() == [2] * 5
    assert folds != fold_of_runs(runs, 5, seed=4)


def test_lists_beside_the_runs_are_no_runs_and_are_counted_if_they_verify(folder, tmp_path):
    copied = shutil.copytree(folder, tmp_path / "copied")
    (copied / "SEGMENTS.csv").write_text("a,b\n1,2\n")
    cases, verified = read_folder(copied, TINY)
    assert {case.run for case in cases} == {f"made_{k}" for k in range(4)}
    assert verified == 0


def test_a_short_look_takes_a_few_runs(folder):
    cases, _ = read_folder(folder, Plan(folds=2, most_runs=2))
    assert len({case.run for case in cases}) == 2


def test_a_folder_with_too_few_runs_or_none_is_refused(folder, tmp_path):
    with pytest.raises(ValueError, match="holds 4 runs"):
        read_folder(folder, Plan(folds=5))
    with pytest.raises(NotADirectoryError, match="no such folder"):
        read_folder(tmp_path / "none", TINY)


# -- What is learnt -------------------------------------------------------------------------------


def test_what_followed_is_counted_as_outcome_counts_would():
    accelerations = np.zeros(80)
    accelerations[60:] = -4.0
    rows = np.column_stack([np.linspace(30.0, 10.0, 80), np.full(80, 10.0), np.full(80, 8.0)])
    case = case_of(episode(rows, accelerations))
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=5.0))
    machine.learn_many(case.observations, np.full(len(case.times), -1), [0])
    model = machine.model()
    counts = ComingByState(model)
    counts.learn(case.observations, case)
    online = OutcomeCounts(n_actions=1, horizon=2.0, dt=0.2)
    beliefs = model.recognise(case.observations)
    for belief in beliefs[:30]:  # row 30 is where the braking begins
        online.learn(belief, 0)
    online.end_episode(failed=True)
    answer = case.answers[BRAKING]
    assert (answer.known.sum(), (answer.came & answer.known).sum()) == (30, 10)
    anywhere = (10 + 0.5) / (30 + 1.0)
    for belief, here in zip(beliefs, counts.score(case.observations)[BRAKING], strict=True):
        # There the share after the action leans once more on that of the state, which is ours.
        found = online.outcome(belief, 0)
        failures = here * (found.evidence + 2.0) - 2.0 * anywhere
        expected = (failures + 2.0 * here) / (found.evidence + 2.0)
        assert found.probability == pytest.approx(expected)


def test_the_most_dangerous_state_comes_first(cases):
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=2.0, scales=(4.0, 2.0, 2.0)))
    for case in cases:
        machine.learn_many(case.observations, np.full(len(case.times), -1), [0])
    counts = ComingByState(machine.model())
    for case in cases:
        counts.learn(case.observations, case)
    shares = counts.shares(BRAKING)
    assert [one.share for one in shares] == sorted((one.share for one in shares), reverse=True)
    assert sum(one.seconds for one in shares) == pytest.approx(
        0.2 * sum(case.answers[BRAKING].known.sum() for case in cases)
    )


# -- Moments --------------------------------------------------------------------------------------


def test_a_lead_counts_from_the_first_alarm_that_stays_on():
    times = np.arange(6.0)
    assert lead_before(np.array([1, 0, 0, 1, 1, 0], bool), times, 5.0) == 2.0
    assert lead_before(np.array([1, 1, 1, 1, 0, 0], bool), times, 5.0) == 0.0


def test_the_threshold_is_exceeded_in_one_percent_of_quiet_time(cases):
    scores = [np.random.default_rng(k).random(len(case.times)) for k, case in enumerate(cases)]
    threshold = alarm_threshold(scores, cases, "braking-3", 2.0)
    quiet = np.concatenate(
        [
            score[answer.known & ~answer.came]
            for score, case in zip(scores, cases, strict=True)
            for answer in [case.answers[BRAKING]]
        ]
    )
    assert (quiet > threshold).mean() == pytest.approx(0.01, abs=2.0 / len(quiet))


def test_moments_show_where_ours_was_earlier_and_where_it_was_wrong(cases):
    def warns(lead):
        """A score that rises so long before every event."""
        scores = []
        for case in cases:
            score = np.zeros(len(case.times))
            for event in case.begins["braking-3"]:
                score[(case.times >= event - lead) & (case.times < event + 1.0)] = 1.0
            scores.append(score)
        return scores

    ours, other = warns(1.8), warns(0.6)
    first = cases[0].begins["braking-3"][0]
    ours[0][(cases[0].times >= first - 1.8) & (cases[0].times < first)] = 0.0  # one is missed
    moments = telling_moments(cases, "braking-3", 2.0, ours, other)
    kinds = [one.kind for one in moments]
    assert kinds.count(Kind.EARLIER) == 3
    assert kinds.count(Kind.LATER) == 1
    assert len({one.run for one in moments if one.kind is Kind.EARLIER}) == 3
    assert all(one.lead > one.other_lead for one in moments if one.kind is Kind.EARLIER)
    (later,) = (one for one in moments if one.kind is Kind.LATER)
    assert (later.run, later.time, later.lead) == (cases[0].run, pytest.approx(first), 0.0)
    np.testing.assert_allclose(leads(other, 0.5, cases, "braking-3"), 0.5, atol=0.21)


# -- The whole study ------------------------------------------------------------------------------


def test_every_question_is_put_to_every_measure(study):
    asked = {(row.target, row.horizon, row.measure) for row in study.rows}
    assert len(asked) == len(study.rows) == len(TARGETS) * len(HORIZONS) * len(MEASURES)


def test_rows_hold_what_they_say(study, cases):
    row = next(r for r in study.rows if (r.target, r.horizon) == TTC_3 and r.measure == "ttc")
    known = [case.answers[TTC_3].known for case in cases]
    assert row.decisions == sum(k.sum() for k in known)
    assert row.runs == 4
    assert row.over_ttc == 0.0
    assert row.low <= row.auroc <= row.high
    score = np.concatenate(
        [
            ((case.observations[:, 1] - case.observations[:, 2]) / case.observations[:, 0])[k]
            for case, k in zip(cases, known, strict=True)
        ]
    )
    came = np.concatenate([c.answers[TTC_3].came[k] for c, k in zip(cases, known, strict=True)])
    assert row.prevalence == pytest.approx(came.mean())
    # Where the gap opens all of them are alike to time to collision.
    assert row.auroc == pytest.approx(auroc(np.maximum(score, 0.0), came))


def test_states_learn_what_foretells_braking(study):
    found = {row.measure: row for row in study.of(*BRAKING)}
    assert found["evofsm-approach"].events > 5
    assert found["evofsm-approach"].auroc > 0.8
    assert found["evofsm-approach"].auprc > 5.0 * found["evofsm-approach"].prevalence


def test_what_a_run_shows_does_not_teach_how_it_is_judged(cases, study):
    """The runs of one fold are turned to noise: scores of the other fold's runs change, own not."""
    folds = fold_of_runs(sorted({case.run for case in cases}), 2, TINY.seed)
    changed = [
        case._replace(answers={q: a._replace(came=~a.came) for q, a in case.answers.items()})
        if folds[case.run] == 0
        else case
        for case in cases
    ]
    again = run_real(changed, TINY, workers=1)
    # Of fold 0 the first machine was taught by fold 1 alone, which is as it was.
    assert again.shares == study.shares


@pytest.mark.slow
def test_the_same_seed_gives_the_same_numbers_with_any_number_of_workers(cases, study):
    assert repr(run_real(cases, TINY, workers=2).rows) == repr(study.rows)


# -- Learnt on one folder, judged on another ------------------------------------------------------


def turned(cases):
    """The same drives, in which whatever came did not, and the other way round."""
    return [
        case._replace(answers={q: a._replace(came=~a.came) for q, a in case.answers.items()})
        for case in cases
    ]


def area(study, measure, question=BRAKING):
    return next(row.auroc for row in study.of(*question) if row.measure == measure)


@pytest.fixture(scope="module")
def others(tmp_path_factory):
    """Runs of another folder."""
    folder = write_runs(tmp_path_factory.mktemp("others"), range(4, 6))
    return read_folder(folder, TINY, dealt=False)[0]


@pytest.fixture(scope="module")
def apart(cases, others):
    return run_real(cases, TINY, workers=1, training=others)


def test_all_of_one_folder_is_judged_by_all_that_the_other_taught(cases, others, apart):
    assert apart.runs == tuple(f"made_{k}" for k in range(4))
    assert apart.episodes == len(cases)
    assert apart.taught_by.runs == 2
    assert apart.taught_by.hours == pytest.approx(
        0.2 / 3600.0 * sum(len(case.times) for case in others)
    )
    scores = [one[BRAKING] for one in learn_logistic(others, cases).scores["logistic"]]
    answers = [case.answers[BRAKING] for case in cases]
    score = np.concatenate([s[a.known] for s, a in zip(scores, answers, strict=True)])
    came = np.concatenate([a.came[a.known] for a in answers])
    assert area(apart, "logistic") == pytest.approx(auroc(score, came))


def test_what_is_judged_teaches_nothing(cases, others, apart):
    again = run_real(turned(cases), TINY, workers=1, training=others)
    assert again.shares == apart.shares
    assert again.states == apart.states
    # What ranked moments well ranks them as badly once the truth is turned: it learnt none of it.
    for measure in ("logistic", "evofsm-approach", "evofsm-states"):
        assert area(again, measure) == pytest.approx(1.0 - area(apart, measure))


def test_what_teaches_is_the_other_folder(cases, others, apart):
    again = run_real(cases, TINY, workers=1, training=turned(others))
    assert area(again, "ttc") == area(apart, "ttc")
    assert area(apart, "evofsm-approach") > 0.8
    assert area(again, "evofsm-approach") < 0.2


def test_a_recording_that_is_in_both_folders_is_refused_by_any_name(cases, others):
    renamed = cases[3]._replace(run="other_name")
    with pytest.raises(ValueError, match=r"made_1, v1-v2 is judged and learnt from \(as other"):
        run_real(cases, TINY, workers=1, training=[*others, renamed])


def test_one_run_is_enough_to_be_judged_or_to_teach(tmp_path):
    one = write_runs(tmp_path / "one", [0])
    assert {case.run for case in read_folder(one, TINY, dealt=False)[0]} == {"made_0"}
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"empty holds no runs \(\*\.csv"):
        read_folder(tmp_path / "empty", TINY, dealt=False)


# -- The command ----------------------------------------------------------------------------------


def bench_real(*arguments):
    pytest.importorskip("typer")
    from studies.__main__ import application
    from typer.testing import CliRunner

    return CliRunner().invoke(application(), ["real", *map(str, arguments)])


def test_the_command_learns_on_one_folder_and_judges_on_the_other(tmp_path):
    teaching, judged = write_runs(tmp_path / "a", [4]), write_runs(tmp_path / "b", [0])
    found = bench_real("--train", teaching, "--data", judged, "--workers", 1, "--json")
    assert found.exit_code == 0, found.stderr
    assert {row["runs"] for row in json.loads(found.stdout)} == {1}


def test_the_command_names_the_folder_that_is_wrong(tmp_path):
    runs = write_runs(tmp_path / "runs", [0])
    missing, strange = tmp_path / "missing", tmp_path / "strange"
    strange.mkdir()
    (strange / "x.csv").write_text("when,distance\n0,1\n", encoding="utf-8")
    for folder, said in (
        (missing, "missing: there is no such folder"),
        (strange, "x.csv has no column 'time'; it has when, distance"),
        (runs, "made_0, v0-v1 is judged and learnt from"),
    ):
        found = bench_real("--train", folder, "--data", runs, "--json")
        assert found.exit_code == 2
        assert said in found.stderr.replace("\n", " ")

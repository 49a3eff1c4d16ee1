"""Real drives: what is asked, what is learnt, and how it is judged, on small made-up ones."""

import hashlib

import numpy as np
import polars as pl
import pytest
from studies.drives import checksums_in, read_runs, runs_in
from studies.real import HORIZONS, TARGETS, TOLD, Leaders, Question, Real, case_of, coming

TTC_3, BRAKING = Question("ttc-3", 2.0), Question("braking-3", 2.0)


def drive(seed):
    """A follower who reacts late to a leader who brakes now and then: (T, 5) rows of a log."""
    rng = np.random.default_rng(seed)
    braking = rng.uniform(5.0, 52.0, size=2)
    gap, v, lead, accel, rows = 18.0, 15.0, 15.0, 0.0, []
    for k in range(600):
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


def write_run(folder, name, pairs):
    """A run of pairs, (T, 5) rows each."""
    folder.mkdir(exist_ok=True)
    columns = ("time", "gap", "v_follower", "v_leader", "a_follower")
    frames = [
        pl.DataFrame(np.round(rows, 3), schema=columns).with_columns(
            pair=pl.lit(f"v{pair}-v{pair + 1}"), segment=pl.lit("0")
        )
        for pair, rows in enumerate(pairs)
    ]
    pl.concat(frames).write_csv(folder / f"{name}.csv")


def write_runs(folder, runs):
    for run in runs:
        write_run(folder, f"made_{run}", [drive(10 * run + pair) for pair in range(2)])
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_runs(tmp_path_factory.mktemp("data"), range(4))


@pytest.fixture(scope="module")
def rows(folder):
    return Real(data=folder, folds=2, rounds=20).run(workers=1)["rows"]


# -- Files ----------------------------------------------------------------------------------------


def test_a_pair_is_parted_where_a_value_is_missing_no_gap_is_left_or_time_has_a_hole(tmp_path):
    rows = drive(0)[:200]
    rows[50, 2], rows[100, 1] = np.nan, 0.0
    rows[150:, 0] += 5.0
    rows[:, 1] = np.maximum(rows[:, 1], 0.0)
    write_run(tmp_path, "parted", [rows, drive(1)[:10]])  # the second is too short
    found = list(read_runs([tmp_path / "parted.csv"]))
    assert [len(one.times) for one in found] == [50, 49, 49, 50]
    assert {(one.run, one.pair, one.dt) for one in found} == {("parted", "v0-v1", 0.1)}
    np.testing.assert_allclose(found[1].observations, rows[51:100, 1:4], atol=1e-3)
    np.testing.assert_allclose(found[1].accelerations, rows[51:100, 4], atol=1e-3)


@pytest.mark.parametrize("listed", ["MANIFEST.csv", "SHA256SUMS"])
def test_a_file_that_is_not_what_the_list_says_is_refused(tmp_path, listed):
    write_run(tmp_path, "run", [drive(0)[:50]])
    path = tmp_path / "run.csv"
    checksum = hashlib.sha256(path.read_bytes()).hexdigest()
    said = f"file,sha256\ndev/run.csv,{checksum}\n" if listed[0] == "M" else f"{checksum} *run.csv"
    (tmp_path / listed).write_text(said)
    assert checksums_in(tmp_path) == {"run.csv": checksum}
    assert len(list(read_runs([path]))) == 1
    path.write_text(path.read_text() + "\n")
    with pytest.raises(ValueError, match=r"run.csv: its SHA-256 is .* or a download"):
        list(read_runs([path]))


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.csv", "when,distance\n0,1\n", "a.csv has no column 'time'; it has when, distance"),
        ("a.csv", "pair,segment,time,gap,v_follower,v_leader,a_follower\n", "nobody in it follows"),
        ("SHA256SUMS", "abc a.csv", "'abc' is no SHA-256"),
        ("MANIFEST.csv", "name\na\n", "needs the columns file and sha256"),
    ],
)
def test_what_is_no_run_and_no_list_is_refused_by_name(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=said):
        list(read_runs([tmp_path / (name if name[0] == "a" else "a.csv")]))


# -- What is asked and learnt, and how it is judged -----------------------------------------------


def test_what_is_under_way_or_not_known_is_no_case():
    happens = np.array([False, False, False, True, True, False, False])
    came, known = coming(happens, 2)
    assert came.tolist() == [False, True, True, True, False, False, False]
    # While it happens nothing is asked; the last two rows do not see two steps ahead.
    assert known.tolist() == [True, True, True, False, False, False, False]
    came, known = coming(np.array([False, False, True]), 5)  # known, though the end is near
    assert (came & known).tolist() == [True, True, False]


def test_every_question_is_put_to_every_measure_and_rows_hold_what_they_say(rows, folder):
    assert len(rows) == len(TARGETS) * len(HORIZONS) * rows["measure"].n_unique()
    row = rows.row(by_predicate=(pl.col("measure") == "ttc") & _asks(TTC_3), named=True)
    known = [case_of(one).answers[TTC_3].known for one in read_runs(runs_in(folder))]
    assert row["decisions"] == sum(k.sum() for k in known)
    assert (row["runs"], row["over_ttc"]) == (4, 0.0)
    assert row["auroc_low"] <= row["auroc"] <= row["auroc_high"]
    ours = rows.row(
        by_predicate=(pl.col("measure") == "evofsm-approach") & _asks(BRAKING), named=True
    )
    assert ours["events"] > 5
    assert ours["auroc"] > 0.8
    assert ours["auprc"] > 5.0 * ours["prevalence"]


def _asks(question):
    return (pl.col("target") == question.target) & (pl.col("horizon") == question.horizon)


def test_what_is_judged_teaches_nothing_and_a_recording_in_both_folders_is_refused(
    folder, tmp_path, monkeypatch
):
    others = write_runs(tmp_path / "others", range(4, 6))
    asked = Real(data=folder, train=others, rounds=2)

    def areas():
        rows = asked.run(workers=1)["rows"].filter(_asks(BRAKING))
        return dict(rows.select("measure", "auroc").iter_rows())

    def turned(self, path, *, dealt=False):
        """In the judged folder whatever came did not, and the other way round."""
        found = [case_of(one) for one in read_runs(runs_in(path))]
        if path == others:
            return found
        answers = [{q: a._replace(came=~a.came) for q, a in c.answers.items()} for c in found]
        return [c._replace(answers=a) for c, a in zip(found, answers, strict=True)]

    plain = areas()
    with monkeypatch.context() as patched:
        patched.setattr(Real, "cases_in", turned)
        judged = areas()
    for measure in ("logistic", "evofsm-approach", "evofsm-states"):
        assert judged[measure] == pytest.approx(1.0 - plain[measure])
    (others / "copied.csv").write_bytes((folder / "made_1.csv").read_bytes())
    with pytest.raises(ValueError, match=r"made_1, v0-v1 is judged and learnt from \(as copied"):
        areas()


@pytest.mark.slow
def test_the_page_says_what_is_better(folder, rows):
    asked = Real(data=folder, folds=2, rounds=20)
    better = rows.with_columns(auroc=pl.when(measure="ttc").then(1.0).otherwise("auroc"))
    page = asked.page({"rows": better.with_columns(enough=pl.lit(value=True))})
    assert set(page.losses[0].frame.filter(measure="ttc")["horizon"]) == set(HORIZONS)
    few = asked.page({"rows": rows.with_columns(enough=pl.lit(value=False))})
    assert (few.holds, few.answer) == (None, "Too few events in these runs to compare anything")


# -- Leaders --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_hard_brakes_are_counted_by_source_and_waves_once_and_knowledge_quiets_alarms(tmp_path):
    """Leaders brake [s, m/s²], a pair for each brake; drivers keep the leader's speed."""
    times = np.arange(0.0, 12.0, 0.1)
    for name, brakes in {"a_1": [(3.0, 4.2)], "a_2": [], "b_1": [(3.0, 3.1), (6.0, 2.9)]}.items():
        pairs = []
        for begins, decel in brakes or [(99.0, 1.0)]:
            v = 25.0 - decel * np.clip(times - begins, 0.0, 2.0)
            did = np.append(np.diff(v) / 0.1, 0.0)
            pairs.append(np.column_stack([times, np.full(len(v), 12.0), v, v, did]))
        write_run(tmp_path, name, pairs)
    asked = Leaders(data=tmp_path)
    found = asked.run(workers=1)
    rows, alarms = found["rows"], found["alarms"]
    assert rows["source"].to_list() == ["a", "b", "all"]
    assert rows["hard"].to_list() == [1, 2, 3]
    assert rows["waves"].to_list() == [1, 1, 2]
    assert rows["hardest"][-1] == pytest.approx(4.2, abs=0.05)
    assert rows["hours"][-1] == pytest.approx(4 * 12.0 / 3600.0)
    every = alarms.filter(source="all")
    assert every["decisions"].to_list() == [480] * len(TOLD)
    nothing, own, table, _ = every["alarms"]
    assert nothing > own > table
    assert table <= 0.05 * 480
    page = asked.page(found)
    assert "none of 3 was harder than the hardest says that at most 70.8 %" in page.tables[1].note

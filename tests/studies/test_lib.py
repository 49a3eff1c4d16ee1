"""What all studies share: commands, work over processes, intervals, scores."""

import json
import pickle
import time
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated

import numpy as np
import polars as pl
import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from studies import lib
from studies.__main__ import REAL, STUDIES, study
from typer.testing import CliRunner

from evofsm.paper import Page, Table

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True, kw_only=True)
class Made(lib.Study):
    """Help of it."""

    name = "made"
    needed = {}  # noqa: RUF012
    throws: Annotated[int, typer.Option(min=1, help="Throws.")] = 1000
    depth: int = 7

    def shortened(self):
        return replace(self, throws=10)

    def run(self, workers=None):
        if self.throws == 13:
            raise ValueError("13 brings no luck")
        return {"rows": pl.DataFrame({"throws": [self.throws], "odds": [float("nan")]})}

    def page(self, found):
        return Page("made", "Is it?\n\nYes.", [Table("Rows", found["rows"])], "python")


def invoke(*arguments, kind=Made):
    app = typer.Typer()
    app.command()(lib.command(kind))
    return CliRunner().invoke(app, [str(one) for one in arguments])


def test_options_of_a_command_are_the_annotated_fields_and_it_writes_its_page_and_rows(tmp_path):
    told = json.loads(invoke("--json", "--throws", 3).stdout)
    assert told == {"rows": [{"throws": 3, "odds": None}]}
    assert json.loads(invoke("--json", "--short").stdout)["rows"][0]["throws"] == 10
    assert invoke("--depth", 3).exit_code == 2
    assert invoke("--seed", -1).exit_code == 2
    said = invoke("--out", tmp_path / "out").stdout
    assert "Is it?" in said
    assert str(tmp_path / "out" / "index.html") in said
    assert pl.read_parquet(tmp_path / "out" / "made.parquet")["throws"].to_list() == [1000]


def test_what_a_user_can_mend_is_one_line_and_status_2():
    done = invoke("--throws", 13)
    assert (done.exit_code, done.stderr) == (2, "studies: 13 brings no luck\n")

    class Lacking(Made):
        needed = {"no_such_package": "gym"}  # noqa: RUF012

    done = invoke(kind=Lacking)
    assert done.exit_code == 2
    assert "needs no_such_package: pip install 'evofsm[gym]'" in done.stderr


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_asks_a_question_has_a_short_form_and_stands_in_the_evidence(name):
    kind = study(name)
    assert kind.name == name
    given = {"data": "drives"} if name in REAL else {}
    short = kind(seed=3, **given).shortened()
    assert short.shortened() == short
    assert short.seed == 3
    page = (ROOT / "docs" / "evidence.md").read_text("utf-8")
    assert f"`make {name}`" in page or f"`python -m studies {name}" in page


@pytest.mark.slow
def test_the_study_of_the_readme_runs(tmp_path, monkeypatch):
    text = (ROOT / "studies" / "README.md").read_text("utf-8")
    (tmp_path / "coin.py").write_text(text.split("```python\n")[1].split("```")[0], "utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    coin = import_module("coin").Coin
    done = invoke("--short", "--out", tmp_path / "out", "--workers", 2, kind=coin)
    assert "Is the coin fair?" in done.stdout
    assert {path.suffix for path in (tmp_path / "out").iterdir()} >= {".html", ".parquet"}


def test_results_keep_the_order_of_the_tasks_whatever_the_number_of_workers():
    tasks = [partial(divmod, number, 3) for number in range(6)]
    assert lib.parallel(tasks, 1) == lib.parallel(tasks, 2) == [divmod(n, 3) for n in range(6)]
    slow_first = [partial(time.sleep, 0.3), partial(int, 7)]
    assert lib.parallel(slow_first, 2) == [None, 7]
    with pytest.raises((AttributeError, pickle.PicklingError), match="lambda"):
        lib.parallel([partial(lambda: 1)], 1)  # so that a test with one finds it
    with pytest.raises(ZeroDivisionError):
        lib.parallel([*tasks, partial(divmod, 1, 0)], 2)


# -- Intervals and scores -------------------------------------------------------------------------


@given(st.lists(st.tuples(st.integers(0, 4), st.booleans(), st.integers(0, 2)), max_size=12))
def test_areas_are_those_of_their_definitions_with_any_weights(cases):
    score, truth, weight = np.array(cases, float).reshape(-1, 3).T
    found = lib.Ranked(score, truth.astype(bool)).areas(weight)
    true, false = weight * truth, weight * (1.0 - truth)
    pairs = np.outer(true, false)
    wins = np.greater.outer(score, score) + 0.5 * np.equal.outer(score, score)
    auroc = (pairs * wins).sum() / pairs.sum() if pairs.sum() else np.nan
    assert found.auroc == pytest.approx(auroc, nan_ok=True)
    auprc, before = 0.0, 0.0
    for threshold in sorted(set(score), reverse=True):
        above = score >= threshold
        recall = true[above].sum() / true.sum() if true.sum() else np.nan
        if recall > before:
            auprc += (recall - before) * true[above].sum() / (true + false)[above].sum()
            before = recall
    assert found.auprc == pytest.approx(auprc if true.sum() else np.nan, nan_ok=True)


def test_episodes_are_resampled_as_a_whole():
    rng = np.random.default_rng(0)
    episode = np.repeat(np.arange(20), 50)
    score = rng.normal(size=20)[episode]
    truth = (rng.normal(size=20) + 0.5 * score[::50] > 0.0)[episode]
    low, high = lib.Ranked(score, truth, episode).interval()[0]
    alone = lib.Ranked(score, truth).interval()[0]
    assert high - low > 3.0 * (alone.high - alone.low)

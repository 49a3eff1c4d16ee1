"""Fair references, honest splits, and scores by hand."""

from dataclasses import replace
from functools import partial

import numpy as np
import polars as pl
import pytest
from studies import forecasts
from tests.studies.test_real import drive, write_run


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Drives, three of one origin and a lonely one."""
    folder = tmp_path_factory.mktemp("logs")
    for k, name in enumerate(("track_0", "track_1", "track_2", "lonely")):
        write_run(folder, name, [drive(k)[:400]])
    (folder / "MANIFEST.csv").write_text("file,rows\ntrack_0.csv,400\n")
    return folder


def test_each_run_is_held_out_once_and_never_learnt_from_then(logs):
    (source,) = forecasts.logs_in(logs)
    assert source.name == "track"
    held = []
    for part in range(2):
        found = forecasts.read_part(source, 0, part, 2)
        seen = [[one.observations.tobytes() for one in some] for some in (found.train, found.test)]
        assert not set(seen[0]) & set(seen[1])
        assert len(seen[0]) + len(seen[1]) == 3
        held += seen[1]
    assert len(set(held)) == 3
    assert found.train[0].observations.shape == (400, 3)
    assert found.train[0].actions.max() <= 16
    with pytest.raises(ValueError, match="no two logs of one origin"):
        forecasts.logs_in(logs / "..")


@pytest.mark.slow
def test_ours_beats_persistence_and_the_paper_does_not():
    draws = "stop_and_go", forecasts.DECISIONS, 0, 0, 10, 4
    sums = forecasts.compare(partial(forecasts.drive, *draws))
    rows = pl.DataFrame(list(forecasts.add_up(pl.DataFrame(sums), 50, 0)))
    assert len(rows) == len(forecasts.REFERENCES) * len(forecasts.DECISIONS.horizons)
    assert rows["forecasts"].n_unique() == len(forecasts.DECISIONS.horizons)
    later = rows.filter(pl.col("horizon").is_in([1.0, 2.0]))
    ours = later.filter(method=forecasts.OURS)
    assert ours.select(pl.min_horizontal("low", "log_low")).min().item() > 0.1
    assert later.filter(method=forecasts.PAPER)["high"].max() < 0.0
    still = rows.filter(method=forecasts.STAYS)
    assert (still["skill"] == 0.0).all()
    assert (still["log_skill"] == 0.0).all()


def test_scores_by_hand():
    beliefs = np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]])
    episodes = [(beliefs[:1], np.zeros(1, np.int64)), (beliefs, np.zeros(3, np.int64))]
    perfect = {"ahead": lambda b, a: beliefs[1:], "stays": forecasts.stays}
    ahead, still = forecasts.score(perfect, episodes, 1, 1)  # the first is too short to be asked
    assert ahead["divergence"] == pytest.approx(0.0, abs=1e-12)
    assert ahead["excess"] == pytest.approx(0.0, abs=1e-5)
    # Half of what came had a forecast of 0, which counts as 1e-6 / 2; then half a bit more.
    assert still["excess"] == pytest.approx(-0.5 * np.log2(5e-7), abs=1e-4)
    assert (still["forecasts"], still["episode"]) == (2, 1)


@pytest.mark.slow
def test_a_page_says_where_others_are_better(logs, monkeypatch):
    monkeypatch.setattr("studies.forecasts.FAMILIES", ("cut_in",))
    tiny = forecasts.ForecastStudy(seeds=1, train=3, test=2, fine_train=1, fine_test=1, parts=2)
    tiny = replace(tiny, data=logs, rounds=10)
    one = tiny.run(workers=1)
    best = pl.when(method=forecasts.BATCH).then(0.9).otherwise("skill")
    rows = one["rows"].with_columns(skill=best)
    page = tiny.page(one | {"rows": rows})
    better = next(table for table in page.lost if "References" in table.title).frame
    assert set(better.filter(source="track")["method"]) >= {forecasts.BATCH}
    assert all(table.cells or table.frame.is_empty() for table in [*page.tables, *page.lost])

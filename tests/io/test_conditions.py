"""What a log tells of failures, units, dates and missing leaders."""

import re

import numpy as np
import pytest

from evofsm.driving.naming import VARIABLES
from evofsm.io import tables
from evofsm.io.conditions import Condition
from evofsm.io.dates import microseconds
from evofsm.io.traces import LogColumns, Noted, read_traces
from evofsm.io.units import of_columns, parse_units

HEADER = "pair,time,gap,v_follower,v_leader,a_follower,crash"


def write(path, rows, header=HEADER):
    path.write_text("\n".join([header, *rows, ""]))
    return str(path)


def rows(gaps, pair="p", crash=None):
    for k, gap in enumerate(gaps):
        hit = int(gap <= 0) if crash is None else crash[k]
        yield f"{pair},{k / 10:.1f},{gap},10,11,-0.5,{hit}"


def read(path, noted=None, **columns):
    """All chunks as one: gaps, starts, failures."""
    chunks = list(read_traces([path], LogColumns(**columns), noted=noted))
    before = np.cumsum([0, *(len(chunk.times) for chunk in chunks)])
    together = list(zip(before, chunks, strict=False))
    starts = np.concatenate([first + chunk.starts for first, chunk in together])
    told = [first + c.failures for first, c in together if c.failures is not None]
    gaps = np.concatenate([chunk.observations[:, 0] for chunk in chunks])
    return gaps.tolist(), starts.tolist(), np.concatenate(told).tolist() if told else None


# -- Failures --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text", ["gap<=0", " gap <= 0 ", "gap<1e-9", "crash", "crash==1", "crash>.5"]
)
@pytest.mark.parametrize("ending", ["csv", "odd.csv", "parquet"])
@pytest.mark.parametrize("at_once", [1, 1 << 20])
def test_the_first_row_in_which_it_holds_ends_the_episode(
    tmp_path, monkeypatch, text, ending, at_once
):
    found = [*rows([3, 1, 0, -1, -1, 2, 0, 5]), *rows([-1, 4], "q"), *rows([5, 6], "r")]
    path = write(tmp_path / "a.csv", found)
    if ending == "odd.csv":  # left to Python's own reader
        path = write(tmp_path / "b.csv", ['"p\n",0,9,10,11,0,0', *found])
    if ending == "parquet":
        polars = pytest.importorskip("polars")
        frame = polars.read_csv(path).with_columns(polars.col("crash").cast(polars.Boolean))
        if text not in ("gap<=0", " gap <= 0 ", "gap<1e-9", "crash"):
            frame = frame.with_columns(polars.col("crash").cast(polars.Int8))
        path = str(tmp_path / "a.parquet")
        frame.write_parquet(path)
    monkeypatch.setattr(tables, "_CSV_BYTES", at_once)
    monkeypatch.setattr(tables, "_PARQUET_ROWS", min(at_once, 65536))
    noted = Noted()
    gaps, starts, failures = read(path, noted, failed=Condition.parse(text))
    shift = int(ending == "odd.csv")
    assert gaps[shift:] == [3, 1, 0, 2, 0, 5, -1, 4, 5, 6]
    assert [row - shift for row in starts if row >= shift] == [0, 3, 5, 6, 7, 8]
    assert [row - shift for row in failures] == [2, 4, 6]
    assert noted.after_failure == 2


def test_a_hole_in_time_makes_no_second_failure(tmp_path):
    lines = [f"p,{t},{gap},1,1,0,0" for t, gap in ((0, 1), (1, 1), (2, 0), (9, 0), (10, 0))]
    assert read(write(tmp_path / "a.csv", lines), failed=Condition.parse("gap<=0")) == (
        [1, 1, 0],
        [0],
        [2],
    )


def test_without_a_word_nothing_is_told(tmp_path):
    assert read(write(tmp_path / "a.csv", rows([1, 0, 1])))[2] is None


@pytest.mark.parametrize(
    "text", ["", "gap<", "<0", "gap<x", "gap<0<1", "gap<inf", "0<gap", "a b<=nan"]
)
def test_what_is_no_condition_is_refused(text):
    with pytest.raises(ValueError, match=re.escape(f"--failed is {text!r}")):
        Condition.parse(text)


def test_what_is_only_compared_may_be_infinite_but_must_be_there(tmp_path):
    path = write(tmp_path / "a.csv", rows([1, 2, 3], crash=["inf", 0.4, 9]))
    assert read(path, failed=Condition.parse("crash<.5"))[2] == [1]
    path = write(tmp_path / "b.csv", rows([1, 2, 3], crash=[1, "", 9]))
    with pytest.raises(ValueError, match="line 3, column 'crash': nan"):
        read(path, failed=Condition.parse("crash<.5"))


def test_a_field_that_is_no_truth_value_is_named(tmp_path):
    path = write(tmp_path / "a.csv", rows([1, 2, 3], crash=[0, "maybe", 1]))
    with pytest.raises(ValueError, match=r"line 3, column 'crash': 'maybe' is no truth value"):
        read(path, failed=Condition.parse("crash"))
    with pytest.raises(ValueError, match=r"no column 'hit'.*--failed names the right one"):
        read(path, failed=Condition.parse("hit"))


# -- No leader -------------------------------------------------------------------------------------


@pytest.mark.parametrize("nothing", ["", "nan", "NA", "inf", " "])
@pytest.mark.parametrize("at_once", [1, 1 << 20])
def test_rows_without_a_leader_end_an_episode(tmp_path, monkeypatch, nothing, at_once):
    monkeypatch.setattr(tables, "_CSV_BYTES", at_once)
    path = write(
        tmp_path / "a.csv", rows([nothing or "", 1, 2, nothing, nothing, 3], crash=[0] * 6)
    )
    noted = Noted()
    assert read(path, noted, leader_may_lack=True)[:2] == ([1, 2, 3], [0, 2])
    assert noted.leaderless == 3
    with pytest.raises(ValueError, match="column 'gap'"):
        read(path)


def test_parquet_s_nulls_end_an_episode_too(tmp_path):
    polars = pytest.importorskip("polars")
    path = write(tmp_path / "a.csv", rows([1, "", 2], crash=[0, 0, 0]))
    polars.read_csv(path).write_parquet(tmp_path / "a.parquet")
    assert read(str(tmp_path / "a.parquet"), leader_may_lack=True)[:2] == ([1, 2], [0, 1])


def test_what_lacks_in_a_row_with_a_leader_is_refused(tmp_path):
    lines = [line.replace("-0.5", "") for line in rows([1, 2], crash=[0, 0])]
    path = write(tmp_path / "a.csv", lines)
    with pytest.raises(ValueError, match="line 2, column 'a_follower'"):
        read(path, leader_may_lack=True)
    path = write(tmp_path / "b.csv", rows(["", ""], crash=[0, 0]))
    with pytest.raises(ValueError, match="no row has a leader"):
        read(path, leader_may_lack=True)


def test_a_failure_without_a_leader_belongs_to_no_episode_and_is_said(tmp_path):
    noted = Noted()
    path = write(tmp_path / "a.csv", rows([1, "", 2], crash=[0, 1, 0]))
    read(path, noted, leader_may_lack=True, failed=Condition.parse("crash"))
    assert "1 failures lie in rows without a leader" in " ".join(noted.warnings())


# -- Dates -----------------------------------------------------------------------------------------


def dated(texts):
    return [f"p,{text},{k},10,11,0,0" for k, text in enumerate(texts)]


ZONED = [f"2026-03-29T01:59:59.{k}+01:00" for k in range(8, 10)]
ZONED += [f"2026-03-29T03:00:00.{k}+02:00" for k in range(3)]  # summer time begins


@pytest.mark.parametrize(
    "texts",
    [
        ZONED,
        [f"2026-03-14 09:26:53.{k}" for k in range(5)],
        [f"2026-03-14T09:26:53.{k}Z" for k in range(5)],
    ],
)
@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_times_may_be_dates(tmp_path, texts, ending):
    path = write(tmp_path / "a.csv", dated(texts))
    if ending == "parquet":
        polars = pytest.importorskip("polars")
        polars.read_csv(path).write_parquet(tmp_path / "a.parquet")
        path = str(tmp_path / "a.parquet")
    (chunk,) = read_traces([path])
    assert chunk.times == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4], abs=1e-12)
    assert chunk.dt == 0.1
    assert chunk.starts.tolist() == [0]


@pytest.mark.parametrize("unit", ["ns", "us", "ms"])
@pytest.mark.parametrize("zone", [None, "Europe/Berlin"])
def test_parquet_s_own_dates_are_read(tmp_path, unit, zone):
    polars = pytest.importorskip("polars")
    frame = polars.read_csv(write(tmp_path / "a.csv", dated(ZONED))).with_columns(
        polars.Series("time", microseconds(ZONED).astype(np.int64)).cast(
            polars.Datetime("us", "UTC")
        )
    )
    time = polars.col("time").dt.convert_time_zone(zone or "UTC")
    time = time if zone else time.dt.replace_time_zone(None)
    frame.with_columns(time.dt.cast_time_unit(unit)).write_parquet(tmp_path / "a.parquet")
    (chunk,) = read_traces([str(tmp_path / "a.parquet")])
    assert chunk.times == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4], abs=1e-12)


@pytest.mark.parametrize(
    ("texts", "says"),
    [
        (["2026-03-14T09:26:53", "later"], "line 3, column 'time'.*ISO 8601"),
        (["2026-03-14T09:26:53", "2026-03-14T09:26:54Z"], "some have a zone"),
        (["2026-03-14T09:26:53", "2026-03-14T09:26:52"], "must run forward"),
        (["09:26:53", "09:26:54"], "line 2, column 'time': '09:26:53' is no number"),
    ],
)
def test_dates_that_are_none_are_refused(tmp_path, texts, says):
    with pytest.raises(ValueError, match=says):
        list(read_traces([write(tmp_path / "a.csv", dated(texts))]))


# -- Units -----------------------------------------------------------------------------------------


def test_units_are_converted_before_anything_is_learnt(tmp_path):
    lines = [f"p,{100 * k},{1000 * k},36,72,0,0" for k in range(4)]
    path, noted = write(tmp_path / "a.csv", lines), Noted()
    units = parse_units(["v=km/h", "time=ms", "gap=cm"])
    (chunk,) = read_traces([path], LogColumns(units=units), noted=noted)
    assert chunk.observations[1] == pytest.approx([10.0, 10.0, 20.0])
    assert chunk.dt == 0.1
    assert noted.units == {"v_follower": "km/h", "v_leader": "km/h", "time": "ms", "gap": "cm"}
    assert noted.warnings() == []


def test_the_longest_name_counts_and_a_column_s_own_most():
    used, existing = ["v", "v_leader", "v_l"], ["v", "v_leader", "v_l"]
    assert of_columns({"v": "mph"}, used, existing, None) == {"v": "mph"}
    given = {"v_": "mph", "v_lead": "km/h"}
    assert of_columns(given, used, existing, None) == {"v_leader": "km/h", "v_l": "mph"}


@pytest.mark.parametrize(
    ("texts", "says"),
    [
        (["v=knots"], "--unit is 'v=knots'; write NAME=UNIT with one of s, ms"),
        (["km/h"], "--unit is 'km/h'"),
        (["v=km/h", "v=mph"], "names 'v' twice"),
        (["speed=km/h"], "no column that is read is called so"),
        (["time=km/h"], "needs a unit of time"),
        (["v=ms"], "needs a unit of time"),
    ],
)
def test_units_that_cannot_be_are_refused(tmp_path, texts, says):
    path = write(tmp_path / "a.csv", rows([1, 2]))
    with pytest.raises(ValueError, match=re.escape(says)):
        list(read_traces([path], LogColumns(units=parse_units(texts))))


def test_speeds_and_steps_beyond_belief_name_the_likely_cause(tmp_path):
    noted = Noted()
    path = write(tmp_path / "a.csv", [f"p,{100 * k},9,120,50,0,0" for k in range(4)])
    list(read_traces([path], noted=noted))
    speed, step = noted.warnings("time")
    assert "v_follower reaches 120 m/s" in speed
    assert "--unit v_follower=km/h" in speed
    assert "a row every 100 s" in step
    assert "--unit time=ms" in step


# -- FCD -------------------------------------------------------------------------------------------


def fcd(path, gaps):
    steps = [
        f'<timestep time="{k / 10}"><vehicle id="a" lane="e" pos="{50 + gap}" speed="1" type="c"/>'
        f'<vehicle id="b" lane="e" pos="45" speed="1" type="c"/></timestep>'
        for k, gap in enumerate(gaps)
    ]
    path.write_text(f"<fcd-export>{''.join(steps)}</fcd-export>")
    return str(path)


def test_fcd_tells_of_failures_by_a_comparison_only(tmp_path):
    path, noted = fcd(tmp_path / "fcd.xml", [2, 1, 0, -1, 3, 4]), Noted()
    failed = Condition.parse("gap<=0")
    assert read(path, noted, failed=failed) == ([2, 1, 0, 3, 4], [0, 3], [2])
    assert noted.after_failure == 1
    with pytest.raises(ValueError, match="cannot be read with --failed crash"):
        read(path, failed=Condition.parse("crash"))
    with pytest.raises(ValueError, match="cannot be read with --unit"):
        read(path, units={"v": "km/h"})
    assert VARIABLES[0] == failed.column

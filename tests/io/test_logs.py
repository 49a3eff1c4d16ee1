"""Logs in CSV and Parquet: what is read, and what is refused with which words."""

import csv
import gzip
import io
import math
import re
import sys
import tracemalloc
from dataclasses import replace

import numpy as np
import polars
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evofsm import Category, ObservationEncoder
from evofsm.cli.learning import warnings_of
from evofsm.cli.options import reading_of
from evofsm.io import LogColumns, episodes_of, read_traces, tables
from evofsm.io.logs import Noted, Resample
from evofsm.io.tables import CsvTable, Wanted

HEADER = "run,pair,segment,time,gap,v_follower,v_leader,a_follower"
SHORT = "pair,time,gap,v_follower,v_leader,a_follower,crash"


def log(rows=10, pair="v1-v2", start=0.0, step=0.1):
    """Lines of one episode; the gap counts the rows."""
    return [f"r,{pair},0,{start + step * k:.3f},{k}.5,10,11,-0.25" for k in range(rows)]


def short(gaps, pair="p", crash=None):
    """Lines of one episode with these gaps."""
    for k, gap in enumerate(gaps):
        hit = int(gap <= 0) if crash is None else crash[k]
        yield f"{pair},{k / 10:.1f},{gap},10,11,-0.5,{hit}"


def write(path, lines, header=HEADER):
    path.write_text("\n".join([header, *lines, ""]))
    return str(path)


def read(*paths, noted=None, **columns):
    return list(read_traces(paths, LogColumns(**columns), noted=noted))


def together(*paths, noted=None, **columns):
    """Of all chunks as one: gaps, starts, failures."""
    chunks = read(*paths, noted=noted, **columns)
    of_each = ((chunk.observations[:, 0], chunk.begins, chunk.fails) for chunk in chunks)
    gaps, *marks = map(np.concatenate, zip(*of_each, strict=True))
    return gaps.tolist(), *(np.flatnonzero(x).tolist() for x in marks)


def refusal(*paths, **columns):
    """What is said where no bad row is left out."""
    with pytest.raises(ValueError, match=re.escape(str(paths[-1]))) as caught:
        read(*map(str, paths), skip_bad=0, **columns)
    return str(caught.value)


@pytest.fixture(params=[1, 1 << 20])
def pieces(request, monkeypatch):
    """So much is read at once: row by row, or all."""
    monkeypatch.setattr(tables, "_CSV_BYTES", request.param)
    monkeypatch.setattr(tables, "_PARQUET_ROWS", request.param)
    return request.param


# -- What is read ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        lambda text: "\ufeff" + text,
        lambda text: text.replace(",", ", "),
        lambda text: text.replace("v1-v2", '"v1-v2"').replace("10,", '"10",'),
        lambda text: text.rstrip("\n"),
        lambda text: gzip.compress(text.encode()),
    ],
)
def test_what_spreadsheets_do_to_a_csv_changes_nothing(tmp_path, change):
    path = write(tmp_path / "a.csv", log(5))
    changed = change((tmp_path / "a.csv").read_text())
    other = tmp_path / "wrong.parquet"  # a file is known by its content and not by its name
    other.write_bytes(changed if isinstance(changed, bytes) else changed.encode())
    (plain,), (changed,) = read(path), read(str(other))
    for field in ("observations", "actions", "times", "begins"):
        assert np.array_equal(getattr(plain, field), getattr(changed, field))


@pytest.mark.parametrize(
    ("name", "foreign", "encoding"),
    [
        ("Größe", "Straße", "latin1"),
        ("x,x,,", "1,2,,", "utf8"),
        ("note", "z" * 200_000, "utf8"),
        ("note", '"a\n' + "y" * 200_000 + '"', "utf8"),
        ("note", 'a 5" wheel\b', "utf8"),
        ("ab", "\ufeff\0😀", "utf8"),
    ],
)
@pytest.mark.parametrize("before", ["", "\ufeff", "sep=,\n"])
def test_columns_that_nobody_asked_for_may_hold_anything(tmp_path, name, foreign, encoding, before):
    lines, path = log(5), tmp_path / "a.csv"
    text = "\n".join([f"{HEADER},{name}", *(f"{line},{foreign}" for line in lines), ""])
    path.write_bytes(((before if encoding == "utf8" else "") + text).encode(encoding))
    (chunk,), (plain,) = read(str(path)), read(write(tmp_path / "b.csv", lines))
    assert (chunk.observations == plain.observations).all()
    if name == "Größe":  # and is read where somebody does
        light = ObservationEncoder("gap", Category("Größe", ["Straße", "Weg"]))
        assert read(str(path), observe=light)[0].observations.shape == (5, 3)


FIELDS = st.text(st.sampled_from('ab ",;\n\t\u00e9'), max_size=5).map(str.strip)
NUMBERS = st.floats(-1e90, 1e90) | st.integers(-(10**20), 10**20) | st.floats(-9, 9, width=16)


@settings(max_examples=150, deadline=None)
@given(
    rows=st.lists(st.tuples(NUMBERS, FIELDS, NUMBERS), min_size=1, max_size=12),
    separator=st.sampled_from(",;\t|"),
    end=st.sampled_from(["\n", "\r\n", "\n\n"]),
    quoting=st.sampled_from([csv.QUOTE_MINIMAL, csv.QUOTE_ALL, csv.QUOTE_NONNUMERIC]),
    size=st.sampled_from([1, 40, 1 << 20]),
)
def test_any_table_is_read_as_python_s_own_reader_reads_it(
    tmp_path_factory, rows, separator, end, quoting, size
):
    file = io.StringIO()
    writer = csv.writer(file, delimiter=separator, lineterminator=end, quoting=quoting)
    writer.writerows([["x", "a text", "y"], *rows])
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(file.getvalue().encode())
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(tables, "_CSV_BYTES", size)
        pieces = list(CsvTable(str(path)).pieces(Wanted(["y", "x"], ["a text"])))
    wanted = list(csv.reader(io.StringIO(file.getvalue(), newline=""), delimiter=separator))
    wanted = [row for row in wanted if row][1:]
    for place, name in ((0, "x"), (2, "y")):
        found = np.concatenate([piece.numbers[name] for piece in pieces])
        assert found.tolist() == [float(row[place]) for row in wanted]
    assert [t for piece in pieces for t in piece.texts["a text"]] == [row[1] for row in wanted]


def test_memory_does_not_grow_with_the_file(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "_CSV_BYTES", 1 << 18)

    def peak(rows):
        path = write(tmp_path / f"{rows}.csv", log(rows))
        tracemalloc.start()
        for _ in read_traces([path]):
            pass
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    peak(20_000)  # what is only done once
    assert peak(100_000) < 1.5 * peak(20_000)


# -- What is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "cause"),
    [
        ("nan", "missing or failed measurement"),
        ("-Infinity", "missing or failed measurement"),
        ("1e200", "cannot be learnt"),
        ("", "the field is empty"),
        ("fast", "a text"),
        ("3.5 m", "a unit behind the number"),
        ("1_0", "no number"),
        ('"1,5"', "decimal comma"),
    ],
)
@pytest.mark.parametrize("column", ["time", "gap", "a_follower"])
def test_a_bad_value_is_named_with_its_line_and_column(tmp_path, value, cause, column):
    lines = log(900)
    fields = lines[850].split(",")
    fields[HEADER.split(",").index(column)] = value
    lines[850] = ",".join(fields)
    message = refusal(write(tmp_path / "a.csv", [*lines[:4], "", *lines[4:]]))
    assert f"a.csv, line 853, column '{column}': " in message
    assert cause in message


def test_episodes_that_come_back_are_refused_with_the_remedy(tmp_path, pieces):
    """Each block would be an episode of its own, and no row would look wrong."""
    lines = [row for k in range(8) for pair in ("v1", "v2") for row in log(10, pair, start=k)]
    message = refusal(write(tmp_path / "a.csv", lines))
    assert "a.csv, line 22: the episode r, v1, 0 (run, pair, segment) comes back" in message
    assert "sort the file by run, pair, segment and then by time" in message


def test_between_batches_nothing_may_stand_or_what_is_left_out(tmp_path, pieces):
    for idle, where in (("", None), (" ", None), ("idle", "batch!=idle")):
        names = "aa", idle, idle, "bb", "cc", idle, "dd"
        lines = [f"{k},{k},1,{name}" for k, name in enumerate(names)]
        path = write(tmp_path / "a.csv", lines, "time,x,u,batch")
        columns = {"observe": ObservationEncoder("x"), "action": "u", "episode": ["batch"]}
        episodes = episodes_of(read(path, where=where, **columns))
        expected = [[0], [1, 2], [3], [4], [5], [6]] if where is None else [[0], [3], [4], [6]]
        assert [one.times.tolist() for one in episodes] == expected


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"\xef\xbb\xbf\n \n", "is empty"),
        (gzip.compress(b"", mtime=0), "is empty"),
        (HEADER.encode(), "has a header but no rows"),
        ("# é\n".encode("latin1") + f"# ääää\n{HEADER}\n".encode(), "header but no rows"),
        (b"# drive 7\n0,1\n1,2\n", "line 2: '0,1' is no header"),
        (b"# drive\n" * 200 + b"x,y\n# 1\n", "has no column 'gap'; it has x, y"),
        (b'# "x, m";y\n0;1\n1;2\n', "no column 'gap'; it has \"x, m\", y"),
        (b"x\x1b[2J,y\n0,1\n1,2\n", r"it has x\u001b[2J, y"),
        (b"\x89MCAP0\r\n\x01" + bytes(8) + b"\4\0\0\0ros2", "is a bag of ROS 2; --topics"),
        (b"\x00\x01\x02\xff\xfe" * 50, "not text in UTF-8"),
        (b"ORC\n\x1a\n\x03\0", "is Apache ORC"),
        (b"ORC_power,LOGGER\n0,1\n", "has no column 'gap'; it has ORC_power"),
        (b"LOGGER,y\n0,1\n", "has no column 'gap'; it has LOGGER"),
        (b"\xfd7zXZ\0" + bytes(50), "compressed by xz; unpack it"),
        (b"PK\3\4" + bytes(50), "an Excel workbook"),
        (b'[\n  {"time": 0}]', "is JSON"),
        (b"(1436509052.249713) vcan0 044#2A366C2BBA\n", "is a CAN log (candump)"),
        (HEADER.encode() + b"\r0,1,2,3,4\r", "lines that end in CR alone"),
        (b"date Mon Nov 30 10:00:00.000 am 2026\nbase hex  timestamps absolute\n", "Vector (ASC)"),
        (b"tank,plant=a level=1.2,valve=3i 1465839830100400200\n", "line protocol of InfluxDB"),
        (b"$GPRMC,123519,A,4807.038,N,01131.000,E*6A\r\n", "holds sentences of NMEA 0183"),
        (b"SQLite format 3\0" + bytes(9) + b"CREATE TABLE plant(", "of SQLite, and no bag"),
        (HEADER.encode("utf-16-le"), "UTF-8 (an archive, binary data, or text in UTF-16"),
        (b"version https://git-lfs.github.com/spec/v1\n", "is a pointer of Git LFS"),
        (gzip.compress(b"PAR1" * 9, mtime=0), "is gzipped, and cannot be read so; unpack it"),
        (f"{HEADER}\nr,a,0,0,1,1,1,1\nr,\0é".encode("latin1"), "after line 2: this is not text"),
        (f"{HEADER.replace('segment', 'gap')}\n1,2".encode(), "two columns are called 'gap'"),
        (f'{HEADER}\nr,"v1,0,1\n{"x" * 90}'.encode(), "unclosed quote"),
        (f'{HEADER}\nr,"a"b,0,0,1,1,1,1\n'.encode(), "line 2: ',' expected after '\"'"),
        (f"{HEADER}\n{'x,' * 5_000_000}".encode(), "a line of more than 1,000,000 bytes"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path, content, said):
    (tmp_path / "a.csv").write_bytes(content)
    assert said in refusal(str(tmp_path / "a.csv"))


def test_of_a_gzip_that_ends_early_the_beginning_is_read_and_a_damaged_one_refused(tmp_path):
    whole = gzip.compress("\n".join([HEADER, *log(20000)]).encode())
    path = tmp_path / "a.csv.gz"
    middle = len(whole) // 2
    for kept in (20, middle, -6):
        path.write_bytes(whole[:kept])
        message = refusal(str(path))
        assert re.search(r"a\.csv\.gz, after line \d+: the gzip data ends early", message)
    noted = Noted()
    assert len(together(str(path), noted=noted)[0]) == 20000
    assert "1 file ends early, and what is whole was read" in warnings_of(noted)[0]
    path.write_bytes(whole[:middle] + bytes(100) + whole[middle + 100 :])
    assert "damaged" in refusal(str(path))


def test_parquet_with_holes_texts_or_half_a_file_is_refused(tmp_path, monkeypatch):
    whole = polars.read_csv(write(tmp_path / "a.csv", log(100)))
    path = tmp_path / "a.parquet"
    gap = polars.col("gap")
    hole = polars.when(polars.col("time") > 8.95).then(None).otherwise(gap)
    for frame, said in (
        (whole.with_columns(gap=hole), "a.parquet, row 91, column 'gap': the field is empty"),
        (whole.with_columns(gap=gap.cast(polars.String)), "'gap' holds String, not numbers"),
        (whole.drop("gap"), "no column 'gap'"),
        (whole.head(0), "no rows"),
    ):
        frame.write_parquet(path)
        assert said in refusal(str(path))
    lasting = polars.duration(milliseconds=1000 * polars.col("time"))
    whole.with_columns(time=lasting).write_parquet(path)
    assert read(str(path))[0].times == pytest.approx(whole["time"].to_numpy())
    path.write_bytes(path.read_bytes()[:-50])
    assert "cannot be read as Parquet" in refusal(str(path))
    monkeypatch.setitem(sys.modules, "polars", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'evofsm\[tables\]'"):
        read(str(tmp_path / "a.csv"))


@pytest.mark.parametrize("name", ["~/x.parquet", "s3://bucket/x"])
def test_a_name_that_looks_like_an_address_is_a_file_like_any_other(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    table = polars.read_csv(write(tmp_path / "a.csv", log(10)))
    place = tmp_path / name
    place.parent.mkdir(parents=True, exist_ok=True)
    with place.open("wb") as file:
        table.write_parquet(file)
    assert len(read(name)[0].times) == 10


# -- Bad rows, and lines that are none ------------------------------------------------------------

BAD_ROWS = {
    "twice": (["p,0.3,3,10,11,-0.5,0"], "line 6: time goes from 0.3 to 0.3 within", [0]),
    "time goes back": (["p,0.1,9,10,11,-0.5,0"] * 2, "line 6: time goes from 0.3 to 0.1", [0]),
    "cut off": (["p,0.4,4,10"], "line 6: 4 fields, but the header names 7", [0, 4]),
    "too long": (["p,0.4,4,10,11,-0.5,0,0,0"], "line 6: 9 fields, but", [0, 4]),
    "missing": (["p,0.4,4,,11,-0.5,0"], "line 6, column 'v_follower': the field is empty", [0, 4]),
    "no time": (["p,later,4,10,11,-0.5,0"], "line 6, column 'time': 'later' is no", [0, 4]),
    "a quote": (['p,"0"4,4,10,11,-0.5,0'], "line 6: ',' expected after '\"'", [0, 4]),
    "zeros": (["\0" * 99], "line 6: 1 fields", [0, 4]),
    "no truth": (["p,0.4,4,10,11,-0.5,perhaps"], "column 'crash': 'perhaps' is no truth", [0, 4]),
}


@pytest.mark.parametrize(("bad", "said", "starts"), BAD_ROWS.values(), ids=BAD_ROWS.keys())
def test_bad_rows_are_left_out_and_counted_up_to_a_number(tmp_path, pieces, bad, said, starts):
    good = list(short([7, 1, 2, 3, 4, 5, 6, 7]))
    after = good[5:] if starts == [0, 4] else good[4:]  # in place of a row, or beside it
    path, noted = write(tmp_path / "a.csv", [*good[:4], *bad, *after], SHORT), Noted()
    kept = [7, 1, 2, 3, *([] if starts == [0, 4] else [4]), 5, 6, 7]
    assert together(path, noted=noted, failed="crash") == (kept, starts, [])
    (warning,) = warnings_of(noted, LogColumns())
    rows = "1 bad row was" if len(bad) == 1 else f"{len(bad)} bad rows were"
    assert f"{rows} left out (--skip-bad), the first: {path}, " in warning
    assert said in warning
    assert said in refusal(path, failed="crash")
    path = write(tmp_path / "b.csv", [*good[:4], *bad * 11], SHORT)
    with pytest.raises(ValueError, match="--skip-bad 10 leaves out so many bad rows") as caught:
        read(path, failed="crash")
    assert said in str(caught.value)
    assert together(path, failed="crash", skip_bad=22)[0] == [7, 1, 2, 3]


def test_without_a_clock_a_row_that_is_left_out_ends_an_episode(tmp_path):
    lines = list(short([1, 2, 3, 4, 5]))
    lines[2] = "p,0.2"
    assert together(write(tmp_path / "a.csv", lines, SHORT), dt=0.1)[:2] == ([1, 2, 4, 5], [0, 2])


def test_a_failure_at_a_time_that_is_there_twice_is_one(tmp_path):
    rows = [*short([3, 2, 1]), "p,0.2,0,10,11,-0.5,1", "p,0.3,9,10,11,-0.5,0"]
    path = write(tmp_path / "a.csv", rows, SHORT)
    assert together(path, failed="crash") == ([3, 2, 1, 9], [0, 3], [2])


@pytest.mark.parametrize(("runs", "says"), [("pq", "2 rows have"), ("p", "1 row has")])
def test_a_missing_action_is_counted_where_another_row_follows(tmp_path, pieces, runs, says):
    lines = [
        f"{p},{k / 10:.1f},{k},10,11,{'' if k in (2, 3) else 1},0" for p in runs for k in range(4)
    ]
    chunks = read(write(tmp_path / "a.csv", lines, SHORT), noted=(noted := Noted()))
    actions = np.concatenate([chunk.actions for chunk in chunks])
    assert np.isnan(actions).tolist() == [False, False, True, True] * len(runs)
    (warning,) = warnings_of(noted)
    assert f"{says} no action" in warning
    assert "line 4, column 'a_follower'" in warning


ABOVE = {
    "many comments": "# drive 7\n\n" * 150 + "{}",
    "comments": "# drive 7\n% of Monday\n//\n{}",
    "notes": "Drive 7\n\nrecorded,2026-03-14\ntime,of day\n{}",
    "blank": "\n\n{}",
    "sep": "sep=,\n# drive 7\n{}",
}


@pytest.mark.parametrize("delimiter", [" ", ",", ";", "\t"])
@pytest.mark.parametrize("comments", ["# ", "%", ""])
def test_what_numpy_saves_is_read(tmp_path, delimiter, comments):
    names, rows = SHORT.split(",")[1:6], np.arange(50.0).reshape(10, 5)
    header = delimiter.join(names)
    options = {"delimiter": delimiter, "header": header, "comments": comments}
    np.savetxt(tmp_path / "a.csv", rows, **options)
    (chunk,) = read(str(tmp_path / "a.csv"))
    assert (chunk.observations == rows[:, 1:4]).all()


@pytest.mark.parametrize("above", ABOVE.values(), ids=ABOVE.keys())
def test_names_may_stand_below_comments_or_behind_a_mark(tmp_path, above):
    header = above.format(SHORT)
    path, noted = write(tmp_path / "a.csv", short([3, 2, 1]), header), Noted()
    assert together(path, noted=noted)[0] == [3, 2, 1]
    assert warnings_of(noted) == []
    path = write(tmp_path / "b.csv", [*short([3, 2]), "# stop", *short([1])], header)
    read(path, noted=noted)
    assert f"line {header.count(chr(10)) + 4}: a comment" in warnings_of(noted)[0]
    bad = write(tmp_path / "c.csv", [*short([3, 2, 1]), "p,0.3,x,1,1,1,0"], header)
    assert f"line {header.count(chr(10)) + 5}, column 'gap'" in refusal(bad)


def test_what_was_appended_is_read_by_its_own_names(tmp_path, pieces):
    other = "note,v_leader,v_follower,gap,time,a_follower,pair"
    more = [f"x,21,20,{gap},{gap / 10},1,p" for gap in (1, 2, 3)]
    path = write(tmp_path / "a.csv", [*short([7, 8]), SHORT, *short([9]), other, *more], SHORT)
    chunks = read(path, episode=[])
    seen = np.concatenate([chunk.observations for chunk in chunks]).tolist()
    assert seen == [[7, 10, 11], [8, 10, 11], [9, 10, 11], *([gap, 20, 21] for gap in (1, 2, 3))]
    for columns in ({}, {"hole": 60.0}, {"resample": Resample(0.1)}, {"no_leader": "end"}):
        assert together(path, episode=[], **columns)[1] == [0, 2, 3]
    lacks = write(tmp_path / "b.csv", [*short([7]), other.replace("gap", "distance"), *more], SHORT)
    assert "line 3: it names the columns anew, without 'gap'" in refusal(lacks)


@pytest.mark.parametrize("name", ["gap, in m", 'a "gap"', " gap", "gap<=", "gap=3", "a,b,c"])
def test_any_name_of_a_column_can_be_said(tmp_path, name):
    quoted, path = '"' + name.replace('"', '""') + '"', tmp_path / "a.parquet"
    frame = {"time": [0.0, 0.1, 0.2], name: [3.0, 1.0, 0.0], "light": ["a", "b", "a"]}
    polars.DataFrame(frame | {"u, own": [0.0] * 3}).write_parquet(path)
    asked = f'{quoted}, "light"=a/b', '"u, own"', "time", quoted, None, f"{quoted}<=0"
    columns = reading_of(*asked, [f"{quoted}=cm"], None, None, None, 0, None)
    (chunk,) = read_traces([str(path)], replace(columns, episode=None))
    assert chunk.observations[:, 0].tolist() == [0.03, 0.01, 0.0]
    assert np.flatnonzero(chunk.fails).tolist() == [2]
    assert columns.episode == [name]


# -- Two witnesses ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, []),
        ({"v_follower": 3.6, "v_leader": 3.6}, ["gap", "--unit v_follower=km/h --unit v_leader="]),
        ({"gap": 1 / 0.3048}, ["gap changes 3.28 times", "--unit gap=ft"]),
        ({"a_follower": 1 / 9.80665}, ["a_follower say", "--unit a_follower=g"]),
        ({"a_follower": -1.0}, ["v_follower changes -1 times", "is a brake above 0"]),
        ({"time": 0.5}, ["gap changes 2 times", "one of them in another unit"]),
    ],
)
def test_what_columns_say_of_each_other_is_compared(tmp_path, change, said):
    rows, gap, own = [], 20.0, 20.0  # one car behind another, where all agree
    for k in range(300):
        lead = 20.0 + 3.0 * math.sin(k / 30)
        rows.append((0.1 * k, gap, own, lead, 0.3 * (gap - 20.0) + 0.8 * (lead - own)))
        gap, own = gap + 0.1 * (lead - own), own + 0.1 * rows[-1][-1]
    frame = polars.DataFrame(rows, HEADER.split(",")[3:], orient="row")
    path, noted = tmp_path / "a.parquet", Noted()
    scaled = (polars.col(name) * factor for name, factor in change.items())
    frame.with_columns(*scaled).write_parquet(path)
    read(str(path), noted=noted)
    told = " ".join(warnings_of(noted))
    assert all(text in told for text in said)
    assert bool(told) == bool(said)
    frame.rename({"v_follower": "v_leader", "v_leader": "v_follower"}).write_parquet(path)
    read(str(path), noted=(noted := Noted()))
    assert "are the speeds mixed up?" in " ".join(warnings_of(noted))


# -- Signals of several clocks ---------------------------------------------------------------------


@pytest.mark.parametrize("pieces", [1 << 11, 1 << 20], indirect=True)
@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_signals_of_several_clocks_are_held_at_the_times_of_actions(tmp_path, pieces, ending):
    rows, noted = [], Noted()
    for k in range(40):
        rows.append(f"p,{k / 10:.2f},{k},,,,")
        rows.append(f"p,{k / 10 + 0.03:.2f},,10,,{k / 100},{int(k == 30)}")
        rows += [f"p,{k / 10 + 0.06:.2f},,,{11 + k},,"] * (k != 20)
    path = write(tmp_path / "a.csv", rows, SHORT)
    if ending == "parquet":
        polars.read_csv(path).write_parquet(tmp_path / "a.parquet")
        path = str(tmp_path / "a.parquet")
    chunks = read(path, noted=noted, failed="crash")
    seen = np.concatenate([chunk.observations for chunk in chunks])
    assert seen[0].tolist() == [1, 10, 11]  # at 0.03 s nothing is known of the leader
    assert seen[19:21].tolist() == [[20, 10, 30], [21, 10, 30]]
    assert chunks[0].times[:2].tolist() == [0.13, 0.23]
    assert together(path, failed="crash")[2] == [29]
    (told,) = warnings_of(noted)
    assert "no row has all values" in told
    assert "none older than 0.5 s (--hold)" in told
    assert noted.leaderless == 1
    seen = np.concatenate([chunk.observations for chunk in read(path, hold=0.1)])
    assert [20, 10, 30] in seen.tolist()
    assert [21, 10, 30] not in seen.tolist()  # of 0.17 s before


@pytest.mark.parametrize("pieces", [1, 1 << 8, 1 << 20], indirect=True)
@pytest.mark.parametrize("tell", ["p,9,0,,,,", "p,9,,,,,1"])
@pytest.mark.parametrize("follows", [[], ["p,9.03,,10,,1,"], ["p,9.01,5,,,,0", "p,9.03,,10,,1,"]])
def test_a_failure_that_a_row_without_an_action_tells_is_that_of_the_next_or_the_last_row(
    tmp_path, pieces, tell, follows
):
    run = [f"p,{8.9 - k / 10:.2f},,10,11,1,0\np,{8.95 - k / 10:.2f},9,,,," for k in range(12)][::-1]
    again = [f"q,{k / 10},,10,11,1,0\nq,{k / 10 + 0.05},8,,,," for k in range(5)]
    path = write(tmp_path / "a.csv", [*run, tell, *follows, *again], SHORT)
    condition = "crash==1 or gap<=0"
    gaps, starts, failures = together(path, failed=condition, hold=0.5)
    last = 10 + bool(follows and pieces > 1)  # the next row of those that are read at once
    assert (starts[:2], failures) == ([0, last + 1], [last])
    path = write(tmp_path / "b.csv", [*run, tell], SHORT)
    gaps, _, failures = together(path, failed=condition, hold=0.5)
    assert (len(gaps), failures) == (11, [10])


# -- Failures, and rows without a leader -----------------------------------------------------------


@pytest.mark.parametrize("condition", [" gap <= 0 ", "gap<1e-9", "crash", "crash==1"])
@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_the_first_row_in_which_it_holds_ends_the_episode(tmp_path, pieces, condition, ending):
    hole = [f"s,{t},{gap},1,1,0,{hit}" for t, gap, hit in ((0, 1, 0), (0.1, 0, 1), (9, 0, 1))]
    lines = [*short([3, 1, 0, -1, -1, 2, 0]), *short([-1, 4], "q"), "r,0,5,1,1,0,0", *hole]
    path = write(tmp_path / "a.csv", lines, SHORT)
    if ending == "parquet":
        kind = polars.Boolean if condition == "crash" else polars.Int8
        frame = polars.read_csv(path).with_columns(polars.col("crash").cast(kind))
        path = str(tmp_path / "a.parquet")
        frame.write_parquet(path)
    noted = Noted()
    gaps, starts, failures = together(path, noted=noted, failed=condition)
    assert gaps == [3, 1, 0, 2, 0, -1, 4, 5, 1, 0]
    assert starts == [0, 3, 5, 6, 7, 8]
    assert failures == [2, 4, 5, 9]
    assert noted.after_failure == 3
    assert not read(path)[0].tells  # nothing tells of them


def test_what_only_tells_of_failures_may_be_infinite_but_must_be_there(tmp_path):
    path = write(tmp_path / "a.csv", short([1, 2], crash=["inf", 0.4]), SHORT)
    assert together(path, failed="crash<.5")[2] == [1]
    path = write(tmp_path / "b.csv", short([1, 2, 3], crash=[1, "", 9]), SHORT)
    assert "line 3, column 'crash': the field is empty" in refusal(path, failed="crash<.5")


@pytest.mark.parametrize("nothing", ["", "nan", "NA", "inf", " "])
def test_rows_without_a_leader_end_an_episode(tmp_path, pieces, nothing):
    lines = short([nothing, 1, 2, nothing, nothing, 3], crash=[0] * 6)
    path, noted = write(tmp_path / "a.csv", lines, SHORT), Noted()
    assert together(path, noted=noted, no_leader="end")[:2] == ([1, 2, 3], [0, 2])
    assert noted.leaderless == 3
    assert "column 'gap'" in refusal(path)
    lines = [f"p,0,{nothing},10,11,1,1", "p,0.1,2,10,11,,0"]
    path, noted = write(tmp_path / "b.csv", lines[:1], SHORT), Noted()
    assert "no row is left" in refusal(path, no_leader="end")
    path = write(tmp_path / "c.csv", [*lines, "p,0.2,2,10,11,1,0"], SHORT)
    assert "line 3, column 'a_follower'" in refusal(path, no_leader="end")
    path = write(tmp_path / "d.csv", lines, SHORT)  # what leads on from a last row is not needed
    read(path, noted=noted, no_leader="end", failed="crash")
    assert "1 failure lies in rows that are left out" in " ".join(warnings_of(noted))


@pytest.mark.parametrize("sign", "\t|,")
@pytest.mark.parametrize("first", ["10,125", "20"])
def test_decimal_commas_are_known_by_one_that_parts_no_thousands(
    tmp_path, sign, first, monkeypatch
):
    gaps = [first] * 6 + ["12,375"]
    rows = [f'{k} "{gap}" 10 "{"0,125" if k == 6 else 9}" 1' for k, gap in enumerate(gaps)]
    header = "time gap v_follower v_leader a_follower".replace(" ", sign)
    path = write(tmp_path / "a.csv", [row.replace(" ", sign) for row in rows], header)
    assert together(path)[0] == [float(gap.replace(",", ".")) for gap in gaps]
    table = CsvTable(path)
    monkeypatch.setattr(tables, "_CSV_BYTES", 1)  # row by row; most of them have no comma
    numbers = [piece.numbers["gap"][0] for piece in table.pieces(Wanted(["gap"]))]
    assert numbers == [float(gap.replace(",", ".")) for gap in gaps]


def test_a_number_may_name_a_column_and_a_text_has_no_decimal_commas(tmp_path):
    lines = ["time\tgap\t1\tlanes", "0.1\t1,234\t2\ta", "0.2\t5\t3\t1,2"]
    table = CsvTable(write(tmp_path / "a.csv", lines, "rig\tx\ty\tz"), ["time", "gap"])
    assert (list(table.columns), table.holds("gap")) == (["time", "gap", "1", "lanes"], "text")


@pytest.mark.parametrize("odd", ["", ";;;;"])
def test_where_fields_end_at_a_semicolon_numbers_may_have_a_decimal_comma(tmp_path, odd):
    lines = [f"{k / 10}; {20 - k / 3}; 10,5; 11; -0,5".replace(".", ",") for k in range(4)]
    header = "time; gap; v_follower; v_leader; a_follower"
    path = write(tmp_path / "a.csv", [*lines, *filter(None, [odd and '0,4;"9,5";10;11;0'])], header)
    (chunk,) = read(path)
    assert chunk.observations[:4, 0].tolist() == [20 - k / 3 for k in range(4)]
    assert chunk.observations[0].tolist() == [20, 10.5, 11]
    assert (chunk.dt, chunk.actions[0]) == (0.1, -0.5)
    bad = write(tmp_path / "b.csv", [*lines, "0,4;1.000,5;10;11;0"], header)
    assert "'gap': '1.000,5' is no number (points between thousands? leave them" in refusal(bad)


@pytest.mark.parametrize(
    ("row", "nobody"),
    [("p,0.3,1e30,10,11,0,0", "gap>1e6"), ("p,0.3,9,10,-151,0,0", "v_leader<-150")],
)
def test_what_no_car_can_do_is_refused_unless_it_stands_for_nobody(tmp_path, row, nobody):
    path = write(tmp_path / "a.csv", [*short([9, 8, 7]), row], SHORT)
    assert re.search("line 5, column .* cannot be right .* in SI it lies", refusal(path))
    assert together(path, no_leader=nobody)[0] == [9, 8, 7]


@pytest.mark.parametrize(
    ("encoding", "odd"), [("utf8", "\xff"), ("utf8", "\xc3"), ("cp1252", "\x81")]
)
def test_one_odd_byte_does_not_change_what_all_others_mean(tmp_path, pieces, encoding, odd):
    lines = [f"p,{k / 10},{9 - k},1,1,0,{'Störung' if k > 2 else 'läuft'}," for k in range(4)]
    text = "\n".join([f"{SHORT},note", *lines, ""]).encode(encoding)
    path, noted = tmp_path / "a.csv", Noted()
    path.write_bytes(text[:-1] + odd.encode("latin1") + b"\n")
    assert together(str(path), noted=noted, failed="crash==Störung")[2] == [3]
    assert "a.csv, line 5" in "".join(warnings_of(noted))


# -- Clocks of machines ---------------------------------------------------------------------------


def taken(tmp_path, rows, noted=None, **columns):
    """Of each episode times, values and actions, and where it failed; fields end at a space."""
    lines = [row.replace(" ", ";") for row in rows]
    path = write(tmp_path / "a.csv", lines, "time;x;u;Status")
    settings = {"observe": ObservationEncoder("x"), "action": "u", **columns}
    return [
        tuple(x.tolist() for x in (e.times, e.observations[:, 0], e.actions, e.fails.nonzero()[0]))
        for e in episodes_of(read(path, noted=noted, **settings))
    ]


@pytest.mark.parametrize(
    ("how", "seen", "did"),
    [
        ({}, [1.5, 5.0, 9.0], [1.0, 1.0, 1.0]),
        ({"x": "last", "u": "max"}, [2.0, 6.0, 9.0], [2.0, 1.0, 1.0]),
        ({"x": "min", "u": "min"}, [1.0, 4.0, 9.0], [0.0, 1.0, 1.0]),
    ],
)
def test_rows_of_a_whole_step_become_one_at_its_end_and_what_failed_stays(
    tmp_path, pieces, how, seen, did
):
    noted = Noted()
    rows = ["0 1 0 on", "4 2 2 on", "11 4 1 on", "19,5 6 1 on", "30 7 1 on", "38 9 1 off"]
    rows += ["41 3 1 off"] * 2  # still so
    step = Resample(10.0, how)
    ((*found, failed),) = taken(tmp_path, rows, noted, resample=step, failed="Status==off")
    did[1] = pytest.approx(np.nan, nan_ok=True)  # before a hole
    assert (found, failed) == ([[10.0, 20.0, 38.0], seen, did], [2])
    assert (noted.resampled, noted.crossed) == (6, 1)


def test_of_equal_times_and_rows_that_lack_a_number_nothing_is_lost_but_them(tmp_path, pieces):
    rows = "0 1 0 on", "0 3 0 on", "7  0 on", "11 4 0 on", "x 9 0 on", "12 ? 0 on", "19 6 0 on"
    noted = Noted()
    assert taken(tmp_path, rows, noted, resample=Resample(10.0)) == [([10, 20], [2, 5], [0, 0], [])]
    assert (noted.leaderless, noted.skipped["field"][0]) == (2, 2)


@pytest.mark.parametrize(("hole", "episodes"), [(None, [4, 2, 2]), (1.0, [6, 2]), (60.0, [8])])
def test_a_hole_costs_a_transition_and_a_longer_one_an_episode(tmp_path, pieces, hole, episodes):
    times = 0.0, 0.1, 0.2, 0.3, 1.3, 1.4, 9.0, 9.1
    rows, noted = [f"{time} {k} 1 on" for k, time in enumerate(times)], Noted()
    found = taken(tmp_path, rows, noted, hole=hole)
    assert [len(times) for times, *_ in found] == episodes
    unknown = [np.isnan(actions).sum() for _, _, actions, _ in found]
    assert sum(unknown) == noted.crossed == (3 - len(episodes) if hole else 0)


@pytest.mark.parametrize("columns", [{}, {"hole": 60.0}, {"resample": Resample(0.1)}])
def test_an_episode_begins_as_its_columns_say_though_its_first_rows_lack_a_number(
    tmp_path, pieces, columns
):
    gaps = {"p": ["", 1, 2, 3], "q": ["", "", 4, 5], "r": ["x"], "s": [6]}
    lines = [line for pair in gaps for line in short(gaps[pair], pair, crash="0000")]
    path = write(tmp_path / "a.csv", lines, SHORT)
    assert together(path, **columns)[:2] == ([1, 2, 3, 4, 5, 6], [0, 3, 5])


STOPS = ["0 1 1 on", "1 2 9 on", "2 3 9 on", "3 4 0 on", "4 5 0 off", "5 6 9 on", "6 7 9 off"]


@pytest.mark.parametrize("value", ["4", "", "Bad"])
@pytest.mark.parametrize(
    ("status", "failures"),
    [("on on on off off on on", [[1], []]), ("on on on on off on off", [[], [1]])],
)
def test_rows_that_are_not_chosen_end_an_episode_in_failure_if_it_begins_with_them(
    tmp_path, pieces, status, failures, value
):
    rows = [f"{row[:5]} {one}" for row, one in zip(STOPS, status.split(), strict=True)]
    rows[3:5] = (row.replace(row[2], value, 1) for row in rows[3:5])  # they need not be right
    found = taken(tmp_path, rows, noted := Noted(), where="u>5", failed="Status==off", skip_bad=0)
    assert [values for _, values, *_ in found] == [[2, 3], [6, 7]]
    assert [fails for *_, fails in found] == failures
    assert (noted.elsewhere, noted.unplaced) == (3, sum(not fails for fails in failures[:1]))


@pytest.mark.parametrize(
    ("condition", "fails"),
    [
        ("Status=='off'", [4]),
        ("Status=off", [4]),
        ('Status!="on"', [4]),
        ("x>2.5 and Status==on", [2]),
        ("x>3.5 or u<1", [3]),
        ("Status=='a or b' or x>=7", [6]),
        ("x==Bad or x>=7", [6]),
        ("Status==nothing", []),
        ("Status=='NA'", [1]),
    ],
)
def test_conditions_may_compare_texts_and_be_joined(tmp_path, condition, fails):
    rows, noted = [STOPS[0], "1 2 9 NA", *STOPS[2:]], Noted()
    ((_, values, *_, failed), *_) = taken(tmp_path, rows, noted, failed=condition)
    assert (failed, len(values)) == (fails, fails[0] + 1 if fails else 7)
    columns = LogColumns(failed=condition)
    said = [one for one in warnings_of(noted, columns) if "no row meets" in one]
    assert said == [] if fails else said[0].endswith("Status is 'NA', 'off', 'on'")


# -- Dates and units -------------------------------------------------------------------------------


def dated(texts):
    return [f"p,{text},{k},10,11,0,0" for k, text in enumerate(texts)]


ZONED = [f"2026-03-29T01:59:59.{k}+01:00" for k in range(8, 10)]
ZONED += [f"2026-03-29T03:00:00.{k}+02:00" for k in range(3)]  # summer time begins


@pytest.mark.parametrize("texts", [ZONED, [f"2026-03-14 09:26:53.{k}" for k in range(5)]])
@pytest.mark.parametrize("point", ".,")
def test_times_may_be_dates(tmp_path, texts, point):
    lines = dated(f'"{text.replace(".", point)}"' for text in texts)
    path = write(tmp_path / "a.csv", lines, SHORT)
    frame, time = polars.read_csv(path), polars.col("time")
    frame.write_parquet(tmp_path / "text.parquet")
    zoned = time.str.replace(",", ".").str.to_datetime(time_zone="UTC" if texts is ZONED else None)
    frame.with_columns(zoned.dt.cast_time_unit("ms")).write_parquet(tmp_path / "typed.parquet")
    for one in (path, str(tmp_path / "text.parquet"), str(tmp_path / "typed.parquet")):
        (chunk,) = read(one)
        assert chunk.times == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4], abs=1e-12)
        assert (chunk.dt, np.flatnonzero(chunk.begins).tolist()) == (0.1, [0])
    if texts is not ZONED:
        for day, form in (("", "%Y-%m-%d "), ("2026-03-14 ", "")):  # of a time of day alone, too
            path = write(tmp_path / "b.csv", [line.replace(day, "") for line in lines], SHORT)
            (chunk,) = read(path, units={"time": f"{form}%H:%M:%S{point}%f"})
            assert chunk.times[-1] == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("texts", "says"),
    [
        (["2026-03-14T09:26:53", "later"], "line 3, column 'time': 'later'.*ISO 8601"),
        (["2026-03-14T09:26:53", "2026-03-14T09:26:54Z"], "line 3.*have a zone, or none"),
        (["2026-03-14T09:26:53", "2026-03-14T09:26:52"], "must run forward"),
        (["09:26:53", "09:26:54"], "line 2, column 'time': '09:26:53' is no number"),
        (["03/10/2025 06:00:00"], "'03/10/2025 06:00:00' is no number.*--unit 'COLUMN=%m/%d/%Y"),
        (["10.03.2025 06:00:00", "32.03.2025 06:00:01"], "line 3, .*'32.03.2025 06:00:01' is not"),
        (["2026-03-14 09:26:53 CET"], "line 2.*'2026-03-14 09:26:53 CET' is not read as a date"),
    ],
)
def test_dates_that_are_none_are_refused(tmp_path, texts, says):
    lines = dated(f'"{text}"' for text in texts)
    assert re.search(says, refusal(write(tmp_path / "a.csv", lines, SHORT)))


@pytest.mark.parametrize("row", ["-,[s],m,km/h,kph,m/s^2,", ",ms,cm,m/s,mps,g,-"])
def test_a_row_of_units_below_the_names_is_none_of_the_log(tmp_path, row):
    lines = [f"p,{k},9,36,36,1,0" for k in range(4)]
    path, noted = write(tmp_path / "a.csv", [row, *lines], SHORT), Noted()
    (chunk,) = read(path, noted=noted)
    assert len(chunk.times) == 4
    in_si = row.startswith("-")
    assert chunk.observations[0] == pytest.approx([9, 10, 10] if in_si else [0.09, 36, 36])
    assert chunk.actions[0] == pytest.approx(1.0 if in_si else 9.80665)
    assert chunk.dt == pytest.approx(1.0 if in_si else 0.001)
    assert warnings_of(noted) == []
    (chunk,) = read(path, units={"v_follower": "mph"})  # who says otherwise is right
    assert chunk.observations[0, 1] == pytest.approx(36 * 0.44704)
    bad = write(tmp_path / "b.csv", [*lines, "p,9,9,36,fast,1,0"], SHORT)
    assert "line 6, column 'v_leader'" in refusal(bad)

"""Logs in CSV and Parquet: what is read, and what is refused with which words."""

import gzip
import re
import tracemalloc

import numpy as np
import pytest

from evofsm.fsm.observations import Category, ObservationEncoder
from evofsm.io import blocks, tables
from evofsm.io.traces import LogColumns, read_traces

HEADER = "run,pair,segment,time,gap,v_follower,v_leader,a_follower"


def log(rows=10, pair="v1-v2", start=0.0, step=0.1):
    """Lines of one episode; the gap counts the rows."""
    return [f"r,{pair},0,{start + step * k:.3f},{k}.5,10,11,-0.25" for k in range(rows)]


def write(path, lines, header=HEADER, end="\n"):
    text = end.join([header, *lines, ""])
    if path.suffix == ".gz":
        path.write_bytes(gzip.compress(text.encode()))
    else:
        path.write_bytes(text.encode())
    return str(path)


def read(*paths, **columns):
    return list(read_traces(paths, LogColumns(**columns)))


def refusal(*paths, **columns):
    with pytest.raises(ValueError, match=re.escape(paths[-1])) as caught:
        read(*paths, **columns)
    return str(caught.value)


# -- What is read ---------------------------------------------------------------------------------


def test_a_log_becomes_observations_actions_times_and_episodes(tmp_path):
    path = write(tmp_path / "a.csv", [*log(3, "v1-v2"), *log(4, "v2-v3")])
    (chunk,) = read(path)
    assert chunk.source == path
    assert chunk.observations.shape == (7, 3)
    assert chunk.observations[1].tolist() == [1.5, 10.0, 11.0]
    assert (chunk.actions == -0.25).all()
    assert chunk.times.tolist() == [0.0, 0.1, 0.2, 0.0, 0.1, 0.2, 0.3]
    assert chunk.starts.tolist() == [0, 3]
    assert chunk.dt == 0.1
    assert chunk.jumps == 0


@pytest.mark.parametrize("name", ["b.csv.gz", "no_ending", "wrong.parquet"])
def test_a_file_is_known_by_its_content_and_not_by_its_name(tmp_path, name):
    plain = write(tmp_path / "a.csv", log(5))
    other = tmp_path / name
    content = (tmp_path / "a.csv").read_bytes()
    other.write_bytes(gzip.compress(content) if name.endswith("gz") else content)
    assert np.array_equal(read(str(other))[0].observations, read(plain)[0].observations)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: "\ufeff" + text,
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace(",", ";"),
        lambda text: text.replace(",", "\t"),
        lambda text: text.replace("\n", "\n\n"),
        lambda text: text.replace("v1-v2", '"v1-v2"').replace("10,", '"10",'),
        lambda text: text.rstrip("\n"),
    ],
    ids=["byte order mark", "windows", "semicolon", "tab", "blank lines", "quotes", "no newline"],
)
def test_what_spreadsheets_do_to_a_csv_changes_nothing(tmp_path, change):
    write(tmp_path / "a.csv", log(5))
    text = (tmp_path / "a.csv").read_text()
    (tmp_path / "b.csv").write_bytes(change(text).encode())
    (plain,), (changed,) = read(str(tmp_path / "a.csv")), read(str(tmp_path / "b.csv"))
    for field in ("observations", "actions", "times", "starts"):
        assert np.array_equal(getattr(plain, field), getattr(changed, field))


def test_parquet_reads_as_csv_does(tmp_path):
    polars = pytest.importorskip("polars")
    path = write(tmp_path / "a.csv", [*log(30), *log(40, "v2-v3"), *log(5, "v3-v4")])
    polars.read_csv(path).write_parquet(tmp_path / "a.parquet", row_group_size=16)
    (csv,), (parquet,) = read(path), read(str(tmp_path / "a.parquet"))
    for field in ("observations", "actions", "times", "starts"):
        assert np.array_equal(getattr(csv, field), getattr(parquet, field))


def test_columns_may_have_other_names_and_an_order(tmp_path):
    path = write(tmp_path / "a.csv", ["1,0.0,7", "2,0.5,8"], "u,t,x")
    (chunk,) = read(path, observe=ObservationEncoder("x", "u"), action="u", time="t")
    assert chunk.observations.tolist() == [[7.0, 1.0], [8.0, 2.0]]
    assert chunk.actions.tolist() == [1.0, 2.0]
    assert chunk.dt == 0.5


def test_a_discrete_column_gets_a_coordinate_for_each_value(tmp_path):
    path = write(tmp_path / "a.csv", ["0,5,red,1", "1,6,green,1"], "time,gap,light,a")
    encoder = ObservationEncoder("gap", Category("light", ("red", "green"), distance=2.0))
    (chunk,) = read(path, observe=encoder, action="a")
    assert chunk.observations[0] == pytest.approx([5.0, np.sqrt(2.0), 0.0])
    assert np.array_equal(chunk.observations[1], encoder.encode({"gap": 6.0, "light": "green"}))


def test_every_file_begins_an_episode_and_all_columns_of_it_count(tmp_path):
    first = write(tmp_path / "a.csv", log(5))
    second = write(tmp_path / "b.csv", log(5, start=5.0))
    assert [chunk.starts.tolist() for chunk in read(first, second)] == [[0], [0]]
    both = write(tmp_path / "c.csv", [*log(3), *log(3, "other", start=0.3)])
    assert read(both)[0].starts.tolist() == [0, 3]
    assert read(both, episode=["run"])[0].starts.tolist() == [0]
    assert read(both, episode=[])[0].starts.tolist() == [0]


def test_a_hole_in_time_begins_an_episode_and_is_counted(tmp_path):
    path = write(tmp_path / "a.csv", [*log(5), *log(5, start=0.5), *log(5, start=1.2)])
    (chunk,) = read(path)
    assert chunk.starts.tolist() == [0, 10]
    assert chunk.jumps == 1


def test_without_a_clock_the_step_is_given(tmp_path):
    path = write(tmp_path / "a.csv", ["1,2"] * 4, "x,u")
    (chunk,) = read(path, observe=ObservationEncoder("x"), action="u", dt=0.25)
    assert chunk.times.tolist() == [0.0, 0.25, 0.5, 0.75]
    assert chunk.dt == 0.25


def test_chunks_go_on_where_the_one_before_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "_CSV_BYTES", 1 << 18)
    path = write(tmp_path / "a.csv", [*log(9000), *log(8000, "v2-v3"), *log(7000, "v3-v4")])
    chunks = read(path)
    assert len(chunks) > 2
    starts, before = [], 0
    for chunk in chunks:
        starts += (chunk.starts + before).tolist()
        before += len(chunk.times)
    assert before == 24000
    assert starts == [0, 9000, 17000]


def test_the_bytes_read_add_up_to_the_size_of_the_file(tmp_path):
    path = write(tmp_path / "a.csv.gz", log(20000))
    read_so_far = []
    list(read_traces([path], on_read=read_so_far.append))
    assert sum(read_so_far) == (tmp_path / "a.csv.gz").stat().st_size


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

    assert peak(100_000) < 1.1 * peak(20_000)


# -- What is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "cause"),
    [
        ("nan", "missing or failed measurement"),
        ("inf", "missing or failed measurement"),
        ("-Infinity", "missing or failed measurement"),
        ("1e200", "cannot be learnt"),
        ("", "empty"),
        ("fast", "a text"),
        ("3.5 m", "a unit behind the number"),
    ],
)
@pytest.mark.parametrize("column", ["time", "gap", "a_follower"])
def test_a_bad_value_is_named_with_its_line_and_column(tmp_path, value, cause, column):
    lines = log(9000)
    fields = lines[8500].split(",")
    fields[HEADER.split(",").index(column)] = value
    lines[8500] = ",".join(fields)
    message = refusal(write(tmp_path / "a.csv", lines))
    assert f"a.csv, line 8502, column '{column}'" in message
    assert cause in message


def test_the_line_is_the_editor_s_also_after_blank_lines(tmp_path):
    message = refusal(write(tmp_path / "a.csv", [*log(2), "", "", "r,v1-v2,0,x,1,1,1,1"]))
    assert "line 6" in message


def test_a_decimal_comma_is_recognised(tmp_path):
    path = write(tmp_path / "a.csv", ["0;1,5;1", "1;1,5;1"], "time;x;u")
    message = refusal(path, observe=ObservationEncoder("x"), action="u")
    assert "decimal comma" in message


@pytest.mark.parametrize("line", ["r,v1-v2,0,0.5,1,1,1", "r,v1-v2,0,0.5,1,1,1,1,1", "r"])
def test_a_row_of_another_length_is_refused(tmp_path, line):
    message = refusal(write(tmp_path / "a.csv", [*log(5), line]))
    assert "line 7" in message
    assert "fields, but the header names 8" in message


@pytest.mark.parametrize(
    ("columns", "missing", "option"),
    [
        ({"observe": ObservationEncoder("gap", "speed")}, "speed", "--observe"),
        ({"action": "accel"}, "accel", "--action"),
        ({"time": "t"}, "t", "--time"),
        ({"episode": ["run", "driver"]}, "driver", "--episode"),
    ],
)
def test_a_missing_column_names_those_there_are_and_the_option(tmp_path, columns, missing, option):
    message = refusal(write(tmp_path / "a.csv", log(3)), **columns)
    assert f"no column {missing!r}" in message
    assert HEADER.replace(",", ", ") in message
    assert option in message


def test_a_column_that_is_there_twice_is_refused(tmp_path):
    message = refusal(write(tmp_path / "a.csv", log(3), HEADER.replace("segment", "gap")))
    assert "two columns are called 'gap'" in message


def test_an_unknown_category_is_named(tmp_path):
    path = write(tmp_path / "a.csv", ["0,red,1", "1,amber,1"], "time,light,a")
    encoder = ObservationEncoder(Category("light", ("red", "green")))
    message = refusal(path, observe=encoder, action="a")
    assert "line 3, column 'light'" in message
    assert "'amber'" in message
    assert "red, green" in message


@pytest.mark.parametrize("second", ["0.0", "-1"])
def test_time_that_stands_or_runs_backwards_is_refused(tmp_path, second):
    lines = [*log(3), f"r,v1-v2,0,{second},1,1,1,1"]
    message = refusal(write(tmp_path / "a.csv", lines))
    assert "line 5" in message
    assert "time goes from 0.2 to" in message
    assert "--episode" in message


def test_time_that_runs_backwards_between_two_chunks_is_refused(tmp_path):
    first = next(read_traces([write(tmp_path / "a.csv", log(100_000))]))
    rows = len(first.times)
    message = refusal(write(tmp_path / "b.csv", [*log(rows), *log(10)]))
    assert f"line {rows + 2}" in message


def test_interleaved_episodes_are_refused_with_the_remedy(tmp_path):
    pairs = [log(50, f"v{k}") for k in range(3)]
    lines = [line for rows in zip(*pairs, strict=True) for line in rows]
    message = refusal(write(tmp_path / "a.csv", lines))
    assert "take turns" in message
    assert "sort the file by run, pair, segment and then by time" in message


def test_episodes_that_come_back_in_blocks_are_refused_with_their_number(tmp_path):
    """Each block would be an episode of its own, and no row would look wrong."""
    lines = [
        row
        for begin in range(0, 80, 10)
        for pair in ("v1", "v2")
        for row in log(10, pair, start=begin / 10)
    ]
    message = refusal(write(tmp_path / "a.csv", lines))
    assert "a.csv, line 22: the episode r, v1, 0 (run, pair, segment) comes back" in message
    assert "up to line 161, 2 episodes take turns in 16 blocks" in message
    assert "sort the file by run, pair, segment and then by time" in message
    key = [(one.split(",")[1], float(one.split(",")[3])) for one in lines]
    sorted_lines = [line for _, line in sorted(zip(key, lines, strict=True))]
    (chunk,) = read(write(tmp_path / "b.csv", sorted_lines))
    assert chunk.starts.tolist() == [0, 80]


def test_an_episode_that_comes_back_in_a_later_chunk_is_refused(tmp_path):
    long = log(100_000, "v2")
    message = refusal(write(tmp_path / "a.csv", [*log(5), *long, *log(5, start=9.0)]))
    assert "a.csv, line 100007: the episode r, v1-v2, 0" in message


def test_each_file_has_episodes_of_its_own(tmp_path):
    paths = [write(tmp_path / name, log(5)) for name in ("a.csv", "b.csv")]
    assert len(read(*paths)) == 2


def test_of_very_many_episodes_the_first_are_kept_in_mind(tmp_path, monkeypatch):
    monkeypatch.setattr(blocks, "_MOST_EPISODES", 2)
    lines = [row for pair in "abcdc" for row in log(3, pair)]
    assert read(write(tmp_path / "a.csv", lines))[0].starts.tolist() == [0, 3, 6, 9, 12]
    assert "comes back" in refusal(write(tmp_path / "b.csv", [*lines, *log(3, "b")]))


def test_of_a_file_that_grows_what_was_there_at_first_is_read(tmp_path, caplog):
    path = tmp_path / "a.csv"
    write(path, log(100))
    whole = path.read_bytes()
    path.write_bytes(whole[:-4])  # its last line is being written
    more = [whole[-4:], "\n".join([*log(50, start=10.0), ""]).encode()]

    def grow(count):
        with open(path, "ab") as file:
            file.write(more.pop(0) if len(more) > 1 else more[0])

    chunks = list(read_traces([str(path)], on_read=grow))
    assert sum(len(chunk.times) for chunk in chunks) == 100
    assert (chunks[-1].actions == -0.25).all()
    assert "a.csv grew by" in caplog.text


def test_files_with_different_steps_are_refused(tmp_path):
    slow = write(tmp_path / "slow.csv", log(9, step=1.0))
    message = refusal(write(tmp_path / "fast.csv", log(9)), slow)
    assert "slow.csv has a row every 1 s" in message
    assert "fast.csv has one every 0.1 s" in message


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("content", [b"", b"\n \n", b"\xef\xbb\xbf"])
def test_an_empty_file_is_refused(tmp_path, packed, content):
    path = tmp_path / "a.csv"
    path.write_bytes(gzip.compress(content) if packed else content)
    assert refusal(str(path)) == f"{path} is empty"


def test_a_header_without_rows_or_rows_without_a_header_are_refused(tmp_path):
    assert "no rows" in refusal(write(tmp_path / "a.csv", []))
    assert "no header" in refusal(write(tmp_path / "b.csv", ["1,2"], "0,1"))


@pytest.mark.parametrize("kept", [20, 0.5, -6])
def test_a_truncated_gzip_is_refused(tmp_path, kept):
    whole = gzip.compress("\n".join([HEADER, *log(20000)]).encode())
    path = tmp_path / "a.csv.gz"
    path.write_bytes(whole[: int(kept * len(whole)) if isinstance(kept, float) else kept])
    message = refusal(str(path))
    reached = re.search(r"a\.csv\.gz, after line (\d+): the gzip data ends early", message)
    share = path.stat().st_size / len(whole)
    assert int(reached[1]) == pytest.approx(20_001 * share, rel=0.2, abs=10)
    assert "interrupted" in message


def test_a_damaged_gzip_is_refused(tmp_path):
    whole = bytearray(gzip.compress("\n".join([HEADER, *log(20000)]).encode()))
    whole[len(whole) // 2 : len(whole) // 2 + 100] = bytes(100)
    (tmp_path / "a.csv.gz").write_bytes(whole)
    assert "damaged" in refusal(str(tmp_path / "a.csv.gz"))


@pytest.mark.parametrize(
    "content", [b"\x00\x01\x02\xff\xfe" * 50, "gap,größe\n1,2".encode("latin1")]
)
def test_a_file_that_is_no_text_is_refused(tmp_path, content):
    (tmp_path / "a.csv").write_bytes(content)
    assert "not text in UTF-8" in refusal(str(tmp_path / "a.csv"))


def test_an_unclosed_quote_is_refused(tmp_path):
    message = refusal(write(tmp_path / "a.csv", ['r,"v1' + log(1)[0], *log(9000)]))
    assert "unclosed quote" in message


def test_a_folder_is_no_file(tmp_path):
    with pytest.raises(IsADirectoryError, match="is a folder"):
        read(str(tmp_path))


def test_parquet_with_holes_texts_or_half_a_file_is_refused(tmp_path):
    polars = pytest.importorskip("polars")
    whole = polars.read_csv(write(tmp_path / "a.csv", log(100)))
    path = tmp_path / "a.parquet"

    hole = polars.when(polars.col("time") > 8.95).then(None).otherwise(polars.col("gap"))
    whole.with_columns(gap=hole).write_parquet(path)
    assert "a.parquet, row 91, column 'gap'" in refusal(str(path))

    whole.with_columns(gap=polars.col("gap").cast(polars.String)).write_parquet(path)
    assert "column 'gap' holds String, not numbers" in refusal(str(path))

    whole.drop("gap").write_parquet(path)
    assert "no column 'gap'" in refusal(str(path))

    whole.head(0).write_parquet(path)
    assert "no rows" in refusal(str(path))

    whole.write_parquet(path)
    path.write_bytes(path.read_bytes()[:-50])
    assert "cannot be read as Parquet" in refusal(str(path))


@pytest.mark.parametrize(
    "name", ["~x.parquet", "~/x.parquet", "http://host/x.parquet", "s3://bucket/x", "file://x"]
)
def test_a_name_that_looks_like_an_address_is_a_file_like_any_other(name, tmp_path, monkeypatch):
    polars = pytest.importorskip("polars")
    monkeypatch.chdir(tmp_path)
    table = polars.read_csv(write(tmp_path / "a.csv", log(10)))
    place = tmp_path / name
    place.parent.mkdir(parents=True, exist_ok=True)
    with place.open("wb") as file:
        table.write_parquet(file)
    (chunk,) = read(name)
    assert len(chunk.times) == 10


def test_parquet_without_polars_names_what_to_install(tmp_path, monkeypatch):
    path = tmp_path / "a.parquet"
    path.write_bytes(b"PAR1" + bytes(100))
    monkeypatch.setitem(__import__("sys").modules, "polars", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install '.\[tables\]'"):
        read(str(path))


def test_an_unclosed_quote_in_the_header_is_refused(tmp_path):
    message = refusal(write(tmp_path / "a.csv", log(20_000), header='"' + HEADER))
    assert "unclosed quote" in message


def test_a_line_that_no_table_would_hold_is_refused_before_it_is_read_whole(tmp_path):
    long = "x," * 600_000
    assert "line 1: longer than" in refusal(write(tmp_path / "a.csv", [], header=long))
    assert "line 3: longer than" in refusal(write(tmp_path / "b.csv", [*log(1), long]))


def test_many_columns_are_not_all_named(tmp_path):
    header = ",".join(f"column{k}" for k in range(500))
    message = refusal(write(tmp_path / "a.csv", [], header=header))
    assert "and 480 more" in message
    assert len(message) < 1000


def test_a_step_much_shorter_than_usual_begins_an_episode_too(tmp_path):
    lines = [*log(30), *log(30, start=3.0, step=0.01)]
    jumps = sum(chunk.jumps for chunk in read(write(tmp_path / "a.csv", lines)))
    assert jumps == 29


def test_files_whose_steps_differ_by_half_are_refused(tmp_path):
    first = write(tmp_path / "a.csv", log(30))
    other = write(tmp_path / "b.csv", log(30, step=0.149))
    assert "a machine knows only one step" in refusal(first, other)

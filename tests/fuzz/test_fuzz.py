"""What is in the corpus is read or refused as it should be; what fuzzing found stays found."""

import gzip
import importlib.util
import os
import re
import subprocess
import sys
import tracemalloc
from pathlib import Path

import pytest

from evofsm.io import fcd, tables
from evofsm.io.traces import LogColumns, read_traces

HERE = Path(__file__).parent
_spec = importlib.util.spec_from_file_location("fuzz", HERE / "fuzz.py")
fuzz = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(fuzz)

MEGABYTE = 1 << 20
LOG = "time,gap,v_follower,v_leader,a_follower\n"


@pytest.mark.slow
@pytest.mark.parametrize("name", fuzz.TARGETS)
def test_what_is_in_the_corpus_is_read_or_refused(name):
    if name == "parquet":
        pytest.importorskip("polars")
    for path in fuzz.seeds(name):
        fuzz.TARGETS[name](path.read_bytes())


@pytest.mark.parametrize("name", ["csv", "fcd", "gzipped", "osi"])
def test_a_little_fuzzing_finds_nothing(name, tmp_path):
    done, findings = fuzz.at_random(name, 0.5, tmp_path)
    assert done
    assert findings == 0


def test_the_corpus_stays_small():
    assert sum(path.stat().st_size for path in HERE.rglob("corpus/*/*")) < 200_000


def refusal(path, content, most=30 * MEGABYTE, **columns):
    """What is said against a file; to find out takes no more memory than that."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=re.escape(str(path))) as caught:
            for _ in read_traces([str(path)], LogColumns(**columns)):
                pass
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()
    assert len(str(caught.value)) < 2000
    return str(caught.value)


# -- What fuzzing and reading with an eye on it found ----------------------------------------------


@pytest.mark.slow
def test_no_row_is_written_beyond_the_arrays(tmp_path):
    # Empty fields once were. In a process of its own, whose kernels look where an array ends.
    code = (
        "from evofsm.io.plain import parse_plain\n"
        "rows = parse_plain(b',,\\n' * 700_000, ',', 3, [], [0, 1, 2])\n"
        "assert len(rows.lines) == 700_000\n"
        "assert parse_plain(b',,\\n' * 700_000, ',', 3, [0, 1, 2], []) is None\n"
        "few = b'1,2,3\\n' * 9 + b'1\\n' * 3 + b'a\\n'\n"
        "for n in range(1, 40):\n"
        "    parse_plain(few, ',', n, list(range(n)), list(range(n)))\n"
        "    parse_plain(b'a\\n', ',', n, list(range(n)), list(range(n)))\n"
    )
    checked = {**os.environ, "NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], check=True, env=checked)


@pytest.mark.parametrize("encoding", ["hex", "UTF-7", "rot13", "no-such", "utf-32"])
def test_an_encoding_that_the_parser_does_not_know_is_refused(tmp_path, encoding):
    text = f'<?xml version="1.0" encoding="{encoding}"?><fcd-export></fcd-export>'
    assert "the encoding is" in refusal(tmp_path / "a.xml", text)


def test_times_of_less_than_a_nanosecond_are_refused(tmp_path):
    rows = "".join(f"{k}e-12,1,1,1,0\n" for k in range(5))
    assert "less than a nanosecond" in refusal(tmp_path / "a.csv", LOG + rows)


def test_an_acceleration_beyond_any_number_is_none(tmp_path):
    steps = [
        f'<timestep time="{time}"><vehicle id="a" lane="e" pos="50" speed="1"/>'
        f'<vehicle id="b" lane="e" pos="20" speed="{speed}"/></timestep>'
        for time, speed in [(-3, 1), (-2, 1), (-1, 1), (0, 1), ("1e-250", "1e90"), (1, 1), (2, 1)]
    ]
    path = tmp_path / "a.xml"
    path.write_text(f"<fcd-export>{''.join(steps)}</fcd-export>")
    (chunk,) = read_traces([str(path)])
    assert str(chunk.actions[3]) == "nan"


# -- Files that would fill the memory -------------------------------------------------------------


def test_entities_are_not_expanded(tmp_path):
    laughs = "".join(
        f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' if k else '<!ENTITY l0 "ha">' for k in range(12)
    )
    text = f"<!DOCTYPE fcd [{laughs}]><fcd-export><timestep time='&l11;'/></fcd-export>"
    assert "<!DOCTYPE fcd>" in refusal(tmp_path / "a.xml", text, MEGABYTE)


def test_nothing_is_read_from_elsewhere(tmp_path):
    (tmp_path / "secret").write_text("12.0")
    text = (
        f'<!DOCTYPE fcd [<!ENTITY s SYSTEM "file://{tmp_path}/secret">]>'
        "<fcd-export><timestep time='0'>&s;</timestep></fcd-export>"
    )
    assert "entities are not read" in refusal(tmp_path / "a.xml", text, MEGABYTE)


def test_tags_within_tags_are_refused_before_they_fill_the_memory(tmp_path):
    text = "<fcd-export>" + "<a>" * 1_000_000
    assert "more than 16 tags within" in refusal(tmp_path / "a.xml", text, 5 * MEGABYTE)


@pytest.mark.parametrize(
    "begin", ["<fcd-export a='", "<fcd-export><!-- ", "<fcd-export><x>]]<![CDATA["]
)
def test_a_token_without_an_end_is_refused(tmp_path, begin):
    packed = gzip.compress(begin.encode() + b"a" * 50 * MEGABYTE + b"</x>", 1)
    path = tmp_path / "a.xml.gz"
    message = refusal(path, packed, 15 * MEGABYTE)
    assert "a tag or comment of more than 1,000,000 bytes" in message or "not whole XML" in message


def test_vehicles_at_one_time_and_their_names_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(fcd, "_MOST_VEHICLES", 1000)
    one = '<vehicle id="{}" lane="e" pos="1" speed="1"/>'
    many = "".join(one.format(k) for k in range(1001))
    text = '<fcd-export><timestep time="0">{}</timestep></fcd-export>'
    assert "more than 1,000 vehicles" in refusal(tmp_path / "a.xml", text.format(many))
    long = one.format("a" * 1000)
    assert "of 1,000 characters" in refusal(tmp_path / "a.xml", text.format(long))
    header = "timestep_time,vehicle_id,vehicle_lane,vehicle_pos,vehicle_speed\n"
    rows = "".join(f"0,{k},e,1,1\n" for k in range(1001))
    assert "more than 1,000 vehicles" in refusal(tmp_path / "a.csv", header + rows)


@pytest.mark.parametrize("fill", [b"\x00", b"<", b",", b'"', b"1", b"\n"])
def test_a_bomb_is_refused_in_little_memory(tmp_path, fill):
    packed = gzip.compress(fill * 60 * MEGABYTE, 1)
    assert len(packed) < MEGABYTE
    refusal(tmp_path / "a.gz", packed)


@pytest.mark.parametrize("fill", [b"\x00", b",", b'"', b"1", b"a\n"])
def test_a_bomb_behind_a_header_is_refused_in_little_memory(tmp_path, fill):
    packed = gzip.compress(LOG.encode() + fill * (60 * MEGABYTE // len(fill)), 1)
    refusal(tmp_path / "a.gz", packed, 200 * MEGABYTE)


@pytest.mark.slow
@pytest.mark.parametrize("header", ["", LOG])
def test_a_row_that_goes_on_over_lines_without_end_is_refused(tmp_path, header):
    # Each line opens a quote that the next one closes: one row, of any number of lines.
    packed = gzip.compress((header + '"a\n",' * 1_000_000).encode(), 1)
    message = refusal(tmp_path / "a.csv.gz", packed, 200 * MEGABYTE)
    assert "a row of more than 1,000,000 characters (an unclosed quote?)" in message


def test_rows_that_are_not_plain_are_read_a_few_at_a_time_where_they_are_long(tmp_path):
    note = '"a ""note"" ' + "x" * 100_000 + '"'
    rows = "".join(f"{k},1,1,1,0,{note}\n" for k in range(300))
    path = tmp_path / "a.csv.gz"
    path.write_bytes(gzip.compress((LOG.replace("\n", ",note\n") + rows).encode(), 1))
    tracemalloc.start()
    try:
        read = sum(len(chunk.times) for chunk in read_traces([str(path)]))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert read == 300
    assert peak < 2 * 2 * tables._CSV_CHARACTERS + 15 * MEGABYTE


@pytest.mark.parametrize(
    "text",
    [
        "a" * 2_000_000,
        LOG + "1," * 2_000_000,
        LOG + "0,1,2,3," + "4" * 3_000_000 + "\n",
        "<fcd-export>" + " " * 3_000_000,
        LOG.replace("gap", "g" * 900_000),
        LOG + "\x00" * 100 + "\n",
        "\x00" * 1000,
    ],
    ids=["name", "fields", "digits", "blanks", "column", "NUL", "only NUL"],
)
def test_long_lines_and_nul_bytes_are_refused_with_a_short_message(tmp_path, text):
    refusal(tmp_path / "a", text, 100 * MEGABYTE)

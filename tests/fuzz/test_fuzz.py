"""Hostile files are read or refused as they should be; what fuzzing found stays found."""

import gzip
import re
import tracemalloc

import pytest
from tests.fuzz import fuzz

from evofsm.io import read_traces

MEGABYTE = 1 << 20
LOG = "time,gap,v_follower,v_leader,a_follower\n"


@pytest.mark.parametrize("name", fuzz.TARGETS)
def test_neither_the_corpus_nor_a_little_fuzzing_finds_anything(name, tmp_path):
    for content in fuzz.seeds(name):
        fuzz.tried(name, content)
    if name != "parquet":  # whose reader prints its panics
        assert fuzz.search(name, 0.4, tmp_path)


def refusal(path, content, most=30 * MEGABYTE):
    """What is said against a file; to find out takes no more memory than that."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=re.escape(str(path))) as caught:
            for _ in read_traces([str(path)]):
                pass
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()
    assert len(str(caught.value)) < 2000
    return str(caught.value)


@pytest.mark.parametrize("encoding", ["hex", "no-such", "utf-32"])
def test_an_encoding_that_a_file_names_asks_no_codec(tmp_path, encoding):
    text = f'<?xml version="1.0" encoding="{encoding}"?><fcd-export></fcd-export>'
    assert "no vehicle on a lane" in refusal(tmp_path / "a.xml", text)


def test_times_of_less_than_a_nanosecond_are_refused(tmp_path):
    rows = "".join(f"{k}e-12,1,1,1,0\n" for k in range(5))
    assert "less than a nanosecond" in refusal(tmp_path / "a.csv", LOG + rows)


# -- Files that would fill the memory -------------------------------------------------------------


def test_entities_are_neither_expanded_nor_read_from_elsewhere_and_tags_not_nested(tmp_path):
    laughs = "".join(f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' for k in range(1, 12))
    text = f"<!DOCTYPE fcd [<!ENTITY l0 'ha'>{laughs}]><fcd-export><timestep time='&l11;'/>"
    assert "<!DOCTYPE fcd>" in refusal(tmp_path / "a.xml", text, MEGABYTE)
    (tmp_path / "secret").write_text("12.0")
    text = f'<!DOCTYPE fcd [<!ENTITY s SYSTEM "file://{tmp_path}/secret">]><fcd-export>&s;'
    assert "entities are not read" in refusal(tmp_path / "a.xml", text, MEGABYTE)

    text = "<fcd-export>" + "<a>" * 1_000_000
    assert "more than 16 tags within" in refusal(tmp_path / "a.xml", text, 5 * MEGABYTE)


@pytest.mark.parametrize("begin", ["<fcd-export a='", "<fcd-export><!-- "])
def test_a_token_without_an_end_is_refused(tmp_path, begin):
    packed = gzip.compress(begin.encode() + b"a" * 50 * MEGABYTE + b"</x>", 1)
    message = refusal(tmp_path / "a.xml.gz", packed, 15 * MEGABYTE)
    assert "a tag or comment of more than 1,000,000 bytes" in message


@pytest.mark.parametrize("header", ["", LOG])
@pytest.mark.parametrize("fill", [b"\x00", b"<", b",", b'"', b"\n", b'"%s\n",' % (b"a" * 60)])
def test_a_bomb_is_refused_in_little_memory(tmp_path, header, fill):
    packed = gzip.compress(header.encode() + fill * (60 * MEGABYTE // len(fill)), 1)
    assert len(packed) < MEGABYTE
    refusal(tmp_path / "a.gz", packed, 40 * MEGABYTE)


LONG = {
    "fields": LOG + "1," * 2_000_000,
    "digits": LOG + "0,1,2,3," + "4" * 3_000_000 + "\n",
    "blanks": "<fcd-export>" + " " * 3_000_000,
    "column": LOG.replace("gap", "g" * 900_000),
    "NUL": LOG + "\x00" * 100 + "\n",
}


@pytest.mark.parametrize("name", LONG)
def test_long_lines_and_nul_bytes_are_refused_with_a_short_message(tmp_path, name):
    refusal(tmp_path / "a", LONG[name], 100 * MEGABYTE)

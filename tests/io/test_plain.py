"""Compiled reading of plain CSV: the same as Python's own reader, digit by digit."""

import random

import numpy as np
import pytest

from evofsm.io import tables
from evofsm.io.plain import Texts, parse_plain
from evofsm.io.tables import CsvTable


def numbers(texts):
    """A column of them, read as plain CSV."""
    rows = parse_plain("".join(f"{text}\n" for text in texts).encode(), ",", 1, [0], [])
    assert rows is not None
    return rows.numbers[0]


def assert_as_float(texts):
    wanted = np.array([float(text) for text in texts])
    read = numbers(texts)
    wrong = np.flatnonzero(read.view(np.int64) != wanted.view(np.int64))
    assert not len(wrong), (texts[wrong[0]], read[wrong[0]], wanted[wrong[0]])


# -- Numbers --------------------------------------------------------------------------------------


def test_numbers_are_rounded_as_float_rounds_them():
    draw = random.Random(1)
    texts = []
    for _ in range(10_000):
        number = draw.uniform(-1, 1) * 10 ** draw.randint(-9, 9)
        places = draw.randint(0, 19)
        texts += [repr(number), f"{number:.{places}f}", f"{number:+.{places}e}"]
    assert_as_float(texts)


def test_numbers_in_the_middle_between_two_floats_are_rounded_as_float_rounds_them():
    draw = random.Random(2)
    texts = []
    for _ in range(10_000):
        # (2 k + 1) / 2^s lies in the middle; its neighbours in the last digit do not.
        decimals = draw.randint(1, 19)
        power = draw.randint(1, 3)
        exact = (2 * draw.randrange(1 << 52, 1 << 53) + 1) * 5**power
        near = round((2 * draw.randrange(1 << 52, 1 << 53) + 1) * 10**decimals / 2**decimals)
        for k in (-1, 0, 1):
            texts += [f"{exact + k}e-{power}", f"{(near + k) % 10**18}e-{decimals}"]
    assert_as_float(texts)


@pytest.mark.parametrize(
    "text",
    [
        *("0", "-0", "+1", ".5", "-5.", "007", "0.000000000000000000001", "1e5", "1E+05", "12e-3"),
        *("9007199254740993", "99999999999999999999", "0.1234567890123456789012", "1e22", "1e23"),
        *("5e-324", "1e-400", "2.2250738585072011e-308", "1e99", "1e00099", "1_000", " 1.5 "),
        *("\u0661", "\uff11.5"),
    ],
)
def test_odd_numbers_are_what_float_makes_of_them(tmp_path, text):
    (tmp_path / "a.csv").write_text(f"x\n{text}\n", encoding="utf-8")
    (piece,) = CsvTable(str(tmp_path / "a.csv")).pieces(["x"], [])
    read = piece.numbers["x"]
    assert read.view(np.int64) == np.array([float(text)]).view(np.int64)


@pytest.mark.parametrize("text", ["", ".", "-", "1e", "1e+", "--1", "1.2.3", "0x10", "1 2", "e5"])
def test_what_float_refuses_is_not_plain(text):
    assert parse_plain(f"1,{text}\n".encode(), ",", 2, [1], []) is None


# -- Rows -----------------------------------------------------------------------------------------


def test_texts_are_kept_once_for_as_long_as_they_repeat():
    rows = parse_plain(b"a,1\na,2\n\n\xc3\xa4,3\n\xc3\xa4,4\r\na,5\n", ",", 2, [1], [0])
    assert rows.n_lines == 6
    assert rows.lines.tolist() == [1, 2, 4, 5, 6]
    assert rows.numbers.tolist() == [[1.0, 2.0, 3.0, 4.0, 5.0]]
    (texts,) = rows.texts
    assert texts.values == ["a", "ä", "a"]
    assert list(texts) == ["a", "a", "ä", "ä", "a"]
    assert [texts.at(row) for row in range(5)] == list(texts)


def test_texts_of_fields_are_those_fields():
    for fields in ([], ["a"], ["a", "a", "b", "", "", "a"]):
        assert list(Texts.of(fields)) == fields


@pytest.mark.parametrize(
    "line",
    ["1,2", "1,2,3,4", '1,"2', '1,2",3', '1,"2""3",4', '1,"2"3,4', "1\r2,2,3", "1,\xff,3", "1"],
)
def test_odd_lines_are_not_plain(line):
    block = b"1,2,3\n" + line.encode("latin1") + b"\n"
    assert parse_plain(block, ",", 3, [0], []) is None


def read_table(path):
    """Its two columns, with lines, or what was said against it."""
    try:
        pieces = list(CsvTable(str(path)).pieces(["x"], ["t"]))
    except ValueError as error:
        return str(error)
    return [
        row
        for piece in pieces
        for row in zip(piece.places, piece.numbers["x"], piece.texts["t"], strict=True)
    ]


ODD = [
    *("1.5,a,b", '"2.5",a,"b"', '"1,5",a,b', '3,"a,b",c', '4,"a ""b"" c",d', '5,"two\nlines",e'),
    *("", "6,ä,b", "7,\x00,b", " 8 ,a,b", "9,a", "10,a,b,c", "x,a,b", ",a,b", "nan,a,b", '1,a"b,c'),
    *('1,"a', "1\r1,a,b", "1e-7,a,b", "\ufeff1,a,b", "1,a,\x85", " ", ",,", '1,"",b', '"",a,b'),
]


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("odd", ODD)
@pytest.mark.parametrize("size", [1, 40, 1 << 19])
def test_any_file_reads_as_with_python_s_own_reader(tmp_path, monkeypatch, odd, end, size):
    rows = [f"{k}.25,run {k // 5},c" for k in range(20)]
    path = tmp_path / "a.csv"
    path.write_bytes(end.join(["x,t,u", *rows[:12], odd, *rows[12:], "3,last,c"]).encode())
    monkeypatch.setattr(tables, "_CSV_BYTES", size)
    compiled = read_table(path)
    monkeypatch.setattr(tables, "parse_plain", lambda *given: None)
    assert compiled == read_table(path)


def test_a_file_with_line_ends_of_old_macs_is_read(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(b"x,t\r1,a\r2,b\r")
    assert read_table(path) == [(2, 1.0, "a"), (3, 2.0, "b")]


def test_a_plain_file_is_not_read_by_python_s_own_reader(tmp_path, monkeypatch):
    path = tmp_path / "a.csv"
    path.write_text("".join(["x,t\n", *(f'{k}.5,"run {k // 9}"\r\n\n' for k in range(500))]))
    monkeypatch.delattr(CsvTable, "_read_carefully")
    monkeypatch.setattr(tables, "_CSV_BYTES", 1000)
    assert len(read_table(path)) == 500

import errno
import io
import itertools
import json
import os
import shutil
import stat
import tempfile
import time
import tracemalloc

import numpy as np
import pytest

from evofsm import __version__, store
from evofsm.store import COUNT, SHARE, SIZE, Kind, Numbers
from one_machine import Interrupter

DRAWS = Kind(
    "draws",
    {
        "values": Numbers(("n", "m")),
        "ranks": Numbers(("n",), 0.0, 100.0, dtype=np.int64),
        "chosen": Numbers(("n",), dtype=np.bool_),
        "shares": SHARE.of("settings.n_kinds"),
        "note": Numbers(("note",), dtype=np.uint8),
    },
    {
        "n_kinds": COUNT,
        "scale": SIZE._replace(optional=True),
        "ends": Numbers(("m",), optional=True),
        "rule": {"width": SIZE._replace(optional=True)},
        "told": bool,
        "name": str | None,
    },
)
SETTINGS = {"n_kinds": 2, "scale": 0.5, "ends": [0.0, 1.0], "rule": {"width": 3}}
SETTINGS |= {"told": True, "name": "0" * 64}


def arrays(n=5):
    return {
        "values": np.arange(2.0 * n).reshape(n, 2) / 7.0,
        "ranks": np.arange(n),
        "chosen": np.arange(n) % 2 == 0,
        "shares": np.array([0.25, 0.75]),
        "note": np.frombuffer(b"once", np.uint8),
    }


def write(place, **others):
    store.write(place, DRAWS, {**SETTINGS, **others}, arrays())


@pytest.fixture
def whole():
    file = io.BytesIO()
    write(file)
    return file.getvalue()


# -- What is written is read ---------------------------------------------------------------------


def test_what_was_written_who_wrote_it_and_from_what_is_read_again_bit_for_bit(tmp_path):
    provenance = {"files": [{"name": "drive.csv", "bytes": 12}], "rows": 40}
    for place in (tmp_path / "file", str(tmp_path / "file"), io.BytesIO()):
        store.write(place, DRAWS, SETTINGS, arrays(), provenance)
        header = store.read_header(place)
        assert header == ("draws", 1, __version__, SETTINGS, provenance)
        settings, found = store.read(place, DRAWS)
        assert settings == SETTINGS
        for name, array in arrays().items():
            assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
            assert found[name].tobytes() == array.tobytes()


def test_the_libraries_of_safetensors_can_read_a_file(whole):
    length = int.from_bytes(whole[:8], "little")
    header, numbers = json.loads(whole[8 : 8 + length]), whole[8 + length :]
    assert all(isinstance(text, str) for text in header.pop("__metadata__").values())
    begin, end = header["values"]["data_offsets"]
    assert header["values"]["dtype"] == "F64"
    values = np.frombuffer(numbers[begin:end]).reshape(header["values"]["shape"])
    assert np.array_equal(values, arrays()["values"])
    assert sum(len(numbers[slice(*one["data_offsets"])]) for one in header.values()) == len(numbers)
    assert (8 + length) % 8 == 0


@pytest.mark.parametrize(
    ("settings", "wrong", "words"),
    [
        ({}, {"more": np.zeros(1)}, "it has more, which no draws has"),
        ({}, {"ranks": np.zeros(5)}, "ranks is of type F64, not I64"),
        ({}, {"ranks": np.arange(6)}, r"ranks has shape \(6,\), not \(5,\), as others say"),
        ({}, {"ranks": np.arange(5) - 1}, "ranks of -1 cannot be right"),
        ({}, {"values": np.zeros((5, 2), object)}, "values is of type object"),
        ({}, {"values": np.full((5, 2), np.nan)}, "values of nan"),
        ({"n_kinds": -2}, {}, "n_kinds of -2"),
        ({"scale": [0.5]}, {}, "scale has shape"),
    ],
)
def test_what_could_not_be_read_again_is_not_written(settings, wrong, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        store.write(tmp_path / "file", DRAWS, SETTINGS | settings, arrays() | wrong)
    assert not list(tmp_path.iterdir())


# -- Files that are damaged, or made to do harm ----------------------------------------------------


def test_a_file_cut_off_anywhere_is_refused(whole, tmp_path):
    path = tmp_path / "cut"
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=f"{path} cannot be loaded"):
            store.read(path, DRAWS)


def test_a_file_with_one_bit_flipped_anywhere_is_refused(whole):
    for place in range(len(whole)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << place % 8
        with pytest.raises(ValueError, match="what was given"):
            store.read(io.BytesIO(damaged), DRAWS)


@pytest.mark.parametrize(
    "content",
    [b"", b"evofsm", b"\x93NUMPY\x01\x00", b"PK\x03\x04" + bytes(200), bytes(1000), b"\xff" * 1000]
    + [len(one).to_bytes(8, "little") + one for one in (b"[]", b"{}", b"[" * 100_000, b"null")],
)
def test_any_other_file_is_refused_by_name(content, tmp_path):
    (tmp_path / "other").write_bytes(content)
    for attempt in (store.read_header, lambda path: store.read(path, DRAWS)):
        with pytest.raises(ValueError, match=f"{tmp_path / 'other'} .*another program's file"):
            attempt(tmp_path / "other")


def test_a_file_that_is_larger_than_any_is_refused_at_once(whole, tmp_path):
    (tmp_path / "bomb").write_bytes(whole)
    os.truncate(tmp_path / "bomb", 1 << 30)
    began = time.process_time()
    with pytest.raises(ValueError, match=r"1,073,741,824 bytes; no file .* than 536,870,912"):
        store.read(tmp_path / "bomb", DRAWS)
    assert time.process_time() - began < 0.1


def test_another_kind_a_missing_file_and_a_missing_folder_are_named(tmp_path):
    write(tmp_path / "file")
    with pytest.raises(ValueError, match=f"{tmp_path}/file .*: it holds a draws, not a machine"):
        store.read(tmp_path / "file", Kind("machine", {}))
    with pytest.raises(FileNotFoundError, match="missing"):
        store.read(tmp_path / "missing", DRAWS)
    with pytest.raises(FileNotFoundError, match=f"there is no folder {tmp_path / 'missing'}"):
        write(tmp_path / "missing" / "file")


def header_with(**others):
    return lambda told, entries, _: told.update(others)


def array_with(name, **others):
    return lambda told, entries, _: entries[name].update(others)


def claim_much(told, entries, _):
    """A consistent header of terabytes."""
    end, more = entries["values"]["data_offsets"][1], 1 << 44
    entries["values"]["shape"][0] += more // 16
    for entry in entries.values():
        entry["data_offsets"] = [at + more * (at >= end) for at in entry["data_offsets"]]


def chosen_2(told, entries, numbers):
    numbers[entries["chosen"]["data_offsets"][0]] = 2


HARMFUL = {
    "newer": (header_with(version=2), "version 2 is newer than this library's 1; a newer evofsm"),
    "settings of none": (header_with(settings=None), "does not say what it holds"),
    "more in the header": (header_with(pickle="cos"), "its header does not say what it"),
    "more of an array": (array_with("values", pickle="cos"), "writes .* not round to nearest"),
    "what no terminal is to see": (
        lambda told, entries, _: entries.update({"\x1b[2J": entries.pop("note")}),
        r"it has \\x1b\[2J, which no draws has",
    ),
    "null": ({"n_kinds": None}, "lacks n_kinds"),
    "negative": ({"n_kinds": -1}, "n_kinds of -1 cannot be right"),
    "a float": ({"n_kinds": 2.0}, "n_kinds holds a fraction; it must be an integer"),
    "none of two types": ({"name": []}, r"name is \[\]; it must be of type str | None"),
    "text": ({"scale": "wide"}, "scale is 'wide'; it must be a number"),
    "a lost array": (lambda told, entries, _: entries.pop("note"), "none that evofsm writes"),
    "an unknown type": (array_with("values", dtype="F32"), "none that evofsm writes"),
    "too large": (array_with("values", shape=[1 << 60, 2]), "none that evofsm writes"),
    "negative sizes": (array_with("values", shape=[-1, 2]), "none that evofsm writes"),
    "turned": (array_with("values", shape=[2, 5]), "shape"),
    "above the most": ({"ranks": 1 << 40}, r"ranks of 1\.09951e\+12 .* must lie between 0"),
    "a boolean of 2": (chosen_2, "neither true nor false"),
    "more than is there": (claim_much, "none that evofsm writes"),
}


@pytest.mark.parametrize(("change", "words"), HARMFUL.values(), ids=HARMFUL.keys())
def test_a_forged_file_is_refused_before_anything_is_allocated(change, words, forge, tmp_path):
    path = tmp_path / "forged"
    write(path)
    forge(path, change)
    tracemalloc.start()
    began = time.process_time()
    with pytest.raises(ValueError, match=words) as raised:
        store.read(path, DRAWS)
    seconds, peak = time.process_time() - began, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(path) in str(raised.value)
    assert seconds < 0.5
    assert peak < 1 << 23


# -- On the disk -----------------------------------------------------------------------------------


def test_a_full_disk_leaves_the_folder_as_it_was_and_names_the_file(full_at, tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"what was there before")
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt:  # who saves on Ctrl-C is told of the disk
        with full_at(100), pytest.raises(OSError, match="File too large") as raised:
            write(path)
    assert raised.value.filename == str(path)
    assert [one.read_bytes() for one in tmp_path.iterdir()] == [b"what was there before"]


def test_a_file_is_on_the_disk_before_it_takes_its_place(tmp_path, monkeypatch):
    flushed = []
    monkeypatch.setattr(os, "fsync", lambda _: flushed.append((tmp_path / "file").exists()))
    write(tmp_path / "file")
    assert flushed == [False, True]


def test_an_interrupt_anywhere_in_a_write_is_an_interrupt_and_leaves_a_whole_file(tmp_path):
    path = tmp_path / "file"
    write(path)
    for line in itertools.count(1, 5):
        try:
            with Interrupter(line):
                write(path)
            break
        except KeyboardInterrupt:
            assert [one.name for one in tmp_path.iterdir()] == ["file"]
            store.read(path, DRAWS)
    assert line > 100


def test_what_a_killed_process_left_behind_is_swept_and_what_is_being_written_is_not(tmp_path):
    path = tmp_path / "file"
    left = tmp_path / ".file.0123456789abcdef.part"
    others = [tmp_path / ".file.7.part", tmp_path / ".other.0123456789abcdef.part"]
    for one in (left, *others):
        one.touch()
        os.utime(one, (0.0, time.time() - 3600.0))
    with store.replacing(path) as file:
        write(path)
        assert sorted(tmp_path.iterdir()) == sorted([path, tmp_path / file.name, *others])
        file.write(b"whole")
    assert sorted(tmp_path.iterdir()) == sorted([path, *others])


def test_a_file_keeps_its_mode_and_owner_and_a_new_one_has_those_of_any_other(tmp_path):
    (tmp_path / "other").touch()
    write(tmp_path / "file")
    assert (tmp_path / "file").stat().st_mode == (tmp_path / "other").stat().st_mode
    for mode in (0o600, 0o640, 0o444):
        (tmp_path / "file").chmod(mode)
        if os.geteuid() == 0:  # no one else may give a file away
            os.chown(tmp_path / "file", 12, 34)
        before = (tmp_path / "file").stat()
        write(tmp_path / "file")
        after = (tmp_path / "file").stat()
        assert stat.S_IMODE(after.st_mode) == mode
        assert (after.st_mode, after.st_uid, after.st_gid) == before[:1] + before[4:6]


@pytest.mark.parametrize("letter", ["x", "ä", "\N{HAMMER AND WRENCH}"])
def test_a_name_may_be_as_long_as_the_system_has_it(tmp_path, letter):
    name = letter * (255 // len(letter.encode()))
    write(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path):
    (tmp_path / "far").mkdir()
    link, target = tmp_path / "link", tmp_path / "far" / "file"
    link.symlink_to(target)
    for _ in range(2):  # where there is nothing yet, and where there is
        write(link)
        assert link.is_symlink()
        assert store.read_header(target).kind == "draws"
    assert sorted(tmp_path.rglob("*")) == sorted([link, target, target.parent])


@pytest.mark.parametrize("may_write_the_folder", [True, False])
@pytest.mark.parametrize("before", [b"", b"x" * 100_000])
def test_what_no_file_can_take_the_place_of_is_written_over(
    tmp_path, monkeypatch, caplog, before, may_write_the_folder
):
    """As one file that is bound into a container, where renaming onto it fails."""
    path, elsewhere = tmp_path / "data" / "file", tmp_path / "elsewhere"
    path.parent.mkdir()
    elsewhere.mkdir()
    path.write_bytes(before)
    monkeypatch.setattr(tempfile, "tempdir", str(elsewhere))

    def busy(*_):
        raise OSError(errno.EBUSY if may_write_the_folder else errno.EXDEV, "busy")

    monkeypatch.setattr(os, "replace", busy)
    monkeypatch.setattr(os, "access", lambda *_: may_write_the_folder)
    with pytest.raises(OSError, match="busy"):
        write(path.with_name("new"))
    write(path)
    assert store.read(path, DRAWS)[0] == SETTINGS
    assert "bind its folder instead" in caplog.text
    whole = path.read_bytes()

    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(0, 0, -len(whole)))
    with pytest.raises(OSError, match="No space left"):
        write(path)
    assert path.read_bytes() == whole
    assert sorted(tmp_path.rglob("*")) == sorted([path, path.parent, elsewhere])
    monkeypatch.undo()
    monkeypatch.setattr(os, "replace", busy)
    monkeypatch.setattr(shutil, "copyfileobj", busy)
    with pytest.raises(OSError, match="busy") as raised:
        write(path)
    (note,) = raised.value.__notes__
    assert store.read(note.rpartition(" ")[2], DRAWS)[0] == SETTINGS  # nothing is lost


def test_what_is_no_file_is_left_alone(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "device").symlink_to("/dev/null")
    for name in ("pipe", "device"):
        with pytest.raises(OSError, match=f"{name} is a device, a pipe"):
            write(tmp_path / name)
    with pytest.raises(OSError, match="is a folder"):
        write(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["device", "pipe"]

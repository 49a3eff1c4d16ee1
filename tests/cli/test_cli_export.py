import json
from zipfile import is_zipfile

import pytest

from evofsm import EvolvingFSM


@pytest.fixture(scope="module")
def driven(evofsm, tmp_path_factory):
    """A folder that was driven to in shadow, and beside it a log of the same episodes."""
    out = tmp_path_factory.mktemp("export") / "driven"
    command = "drive", "emergency", "--mode", "shadow", "--episodes", 2
    result = evofsm(*command, "--out", out, "--mcap", f"{out}.mcap")
    assert result.exit_code == 0, result.stderr
    return out


@pytest.mark.parametrize(("to", "begins"), [("dot", "digraph"), ("prism", "// A machine of")])
def test_folder_and_guard_give_the_same_states(evofsm, driven, to, begins, tmp_path):
    files = driven, driven / "guard.evofsm"
    printed, again = (evofsm("export", file, "--to", to).stdout for file in files)
    assert printed.startswith(begins)
    assert "gap" in printed
    assert again == printed
    for _ in range(2):  # anew, too
        result = evofsm("export", driven, "--to", to, "--out", tmp_path / "graph")
        assert result.exit_code == 0, result.stderr
    assert (tmp_path / "graph").read_bytes().decode() == printed


def test_a_guard_is_written_in_c_and_for_cpp_to_a_folder(evofsm, refused, driven, tmp_path, caplog):
    for file in (driven, driven / "guard.evofsm"):
        assert evofsm("export", file, "--to", "c99", "--out", tmp_path / "c").exit_code == 0
    written = {path.name for path in (tmp_path / "c").iterdir()}
    assert written == {"evofsm.h", "evofsm.c", "evofsm.hpp"}
    header = (tmp_path / "c" / "evofsm.h").read_text()
    assert "gap" in header
    assert "#define EVOFSM_VARIABLES 3\n" in header
    assert "name a file, of c99 a folder, by --out" in refused("export", driven, "--to", "c99")
    unfit = "export", driven, "--to", "fmu", "--prefix", "cars", "--out", tmp_path / "cars.fmu"
    assert "--prefix is of other formats than --to fmu" in refused(*unfit)
    named = evofsm("export", driven, "--to", "c99", "--prefix", "cars", "--out", tmp_path / "c")
    assert "int cars_decide(" in (tmp_path / "c" / "cars.h").read_text(), named.stderr
    assert "\n#define ACTS 0\n" in (tmp_path / "c" / "cars.c").read_text()
    assert "in mode shadow it watches: executed is always the proposal" in caplog.text
    caplog.clear()  # it was driven in shadow
    act = "--mode", "act", "--out"
    assert evofsm("export", driven, "--to", "c99", *act, tmp_path / "c").exit_code == 0
    code, header = (tmp_path / "c" / f"evofsm.{end}" for end in "ch")
    assert "\n#define ACTS 1\n" in code.read_text()
    header.unlink()
    code.write_text("")
    assert evofsm("export", driven, "--to", "c99", *act, tmp_path / "c").exit_code == 0
    code.write_text("int main;")
    assert "left alone" in refused("export", driven, "--to", "c99", *act, tmp_path / "c")
    evofsm("export", driven, "--to", "fmu", *act, tmp_path / "cars.fmu")
    assert is_zipfile(tmp_path / "cars.fmu")
    assert "it watches" not in caplog.text


def test_options_choose_what_is_drawn(evofsm, driven):
    whole = evofsm("export", driven, "--to", "dot", "--least", 0, "--evidence", 0).stdout
    few = evofsm("export", driven, "--to", "dot", "--evidence", 2).stdout
    assert whole.count("->") > 10 * few.count("->") > 0
    process = evofsm("export", driven, "--to", "prism", "--evidence", 5).stdout
    assert "fewer than 5 decisions" in process


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("export nothing --to dot", "nothing"),
        ("export {out}/episodes.csv --to dot", "episodes.csv"),
        ("export {out}/.. --to dot", "neither guard.evofsm"),
        ("export {out} --to prism --evidence 0", "evidence"),
        ("export {out} --to dot --out /dev/null", "is a device"),
        ("drive emergency --mcap a --out {out} --mode shadow", "name another"),
        ("drive emergency --mcap no/folder/a.mcap", "no/folder"),
        ("drive emergency --mcap {out}.mcap", "driven.mcap exists; it was left alone"),
    ],
)
def test_what_cannot_be_exported_is_refused_in_one_line(refused, driven, words, said):
    assert said in refused(*words.format(out=driven).split())


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("guard.evofsm", "export {out} --to dot --out {path}"),
        ("my.csv", "export {out} --to fmu --out {path}"),
        ("my.csv", "export {out} --to prism --out {path}"),
        ("main.c", "export {out} --to c99 --prefix main --out {folder}"),
        ("index.html", "paper --out {folder}"),
        ("model.evofsm", "paper --out {folder}"),
        ("guard.evofsm", "drive emergency --out {folder}"),
        ("episodes.csv", "drive emergency --out {folder}"),
        ("guard.evofsm", "learn {path} --action= --out {path}"),
        ("my.csv", "learn {path} --out {path}"),
    ],
)
def test_what_something_else_wrote_is_left_alone(refused, driven, tmp_path, name, words):
    path, ours = tmp_path / name, driven / "guard.evofsm"
    page = "<title>Mine – evofsm</title>".encode()
    path.write_bytes(content := ours.read_bytes() if path.suffix == ours.suffix else page)
    (empty := tmp_path / "episodes.jsonl").touch()
    given = words.format(out=driven, folder=tmp_path, path=path).split()
    assert "it was left alone" in refused(*given)
    assert ({*tmp_path.iterdir()}, path.read_bytes()) == ({path, empty}, content)


def test_no_text_from_a_file_tells_the_terminal_what_to_do(evofsm, tmp_path):
    machine = EvolvingFSM(n_actions=1, radius=0.5)
    machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0], failures=[3])
    evil = "\x1b[2Jgap\x9b31m\r\u202e"
    model = machine.model(names=[evil], units=[evil], dt=0.1)
    model.save(tmp_path / "model", {evil: evil, "files": [{"name": evil, "bytes": 1}]})
    printed = [
        *(("inspect", tmp_path / "model"), ("inspect", tmp_path / "model", "--json")),
        ("explain", tmp_path / "model", "--state", "all"),
        ("explain", tmp_path / "model", "--state", 1, "--json"),
        *(("export", tmp_path / "model", "--to", to) for to in ("dot", "prism")),
        *(("inspect", tmp_path / evil), ("learn", tmp_path / "log.csv")),
    ]
    rows = [f"{k},{k % 7},{k % 5}" for k in range(40)]
    (tmp_path / "log.csv").write_text("\n".join([f"t,{evil.replace(chr(13), '')},c", *rows]))
    for arguments in printed:
        result = evofsm(*arguments)
        told = result.stdout + result.stderr
        assert "gap" in told
        assert not set(told) & set("\x1b\x9b\r\u202e"), arguments
    assert json.loads(evofsm("inspect", tmp_path / "model", "--json").stdout)["provenance"][evil]

"""A guard in C decides as in Python: the templates beside the kernels are held to them here."""

import math
import re
import shutil
import subprocess
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

import c99
from evofsm import Guard
from evofsm.driving import LatentRisk, guard_for_cars
from evofsm.guard import Fallback, Mode
from evofsm.guard.export import write_c99, write_fmu

pytestmark = pytest.mark.skipif(
    not (shutil.which("cc") and shutil.which("c++")), reason="there is nothing to compile with"
)


@pytest.fixture(scope="module")
def wall():
    return c99.learnt("wall")


def agrees(learnt, folder, *flags, decisions=600, seed=1):
    """How both decide, compiled with each of the flags; the same, or it fails."""
    asked = c99.ask(learnt, decisions, seed)
    for each in flags:
        found = c99.compare(learnt.guard, c99.build(learnt.guard, folder, *each), asked)
        assert found.agrees, found[:6]
    return found


def constant(folder, name, file="evofsm.c"):
    text = (folder / file).read_text()
    return float(re.search(rf"^#define {name} (\S+)$", text, flags=re.M)[1])


def run_cpp(folder, source, *prefixes, told=""):
    """What a program of C++ around exported C prints."""
    for prefix in prefixes:
        subprocess.run(["cc", *c99.FLAGS, "-c", f"{prefix}.c"], cwd=folder, check=True)
    flags = ("-std=c++17", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-I.", "-o", "main")
    command = ["c++", *flags, source, *(f"{prefix}.o" for prefix in prefixes), "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    run = {"input": told, "capture_output": True, "text": True, "check": True}
    return subprocess.run(["./main"], cwd=folder, **run).stdout.splitlines()


def test_a_guard_in_c_decides_as_in_python(wall, tmp_path):
    found = agrees(wall, tmp_path, ["-O1"])
    assert found.changed > 100
    assert found.refused > 5
    assert "-0.0," not in (tmp_path / "evofsm.c").read_text()  # no risk prints as -0


INEXACT = [
    *("-Ofast", "-ffast-math", "-O2 -ffinite-math-only", "-funsafe-math-optimizations"),
    *("-fassociative-math -fno-signed-zeros -fno-trapping-math", "-freciprocal-math"),
    *("-fno-signed-zeros", "-fsingle-precision-constant", "-D_M_FP_FAST", "-D__FP_FAST"),
    "-U__DBL_MANT_DIG__ -D__DBL_MANT_DIG__=24",  # a double as short as a float
    "-U__FLT_EVAL_METHOD__ -D__FLT_EVAL_METHOD__=2",  # computed as a long double
]
# As of compilers that do not say how they compute.
UNTOLD = "FAST_MATH", "FINITE_MATH_ONLY", "ASSOCIATIVE_MATH", "RECIPROCAL_MATH", "NO_SIGNED_ZEROS"


@pytest.mark.parametrize("flags", INEXACT)
def test_what_would_compute_otherwise_does_not_compile(wall, flags, tmp_path):
    write_c99(wall.guard, tmp_path)
    command = ["cc", "-std=c99", "-w", *flags.split(), "-c", "evofsm.c"]
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert built.returncode != 0
    assert "evofsm needs" in built.stderr.replace("_", " ")


ROUND = "#include <fenv.h>\n__attribute__((constructor)) void turn(void) { fesetround(FE_%s); }"


@pytest.mark.parametrize("flags", [*INEXACT[1:6], "DOWNWARD", "UPWARD", "TOWARDZERO"])
def test_where_no_macro_tells_of_that_it_decides_nothing(wall, flags, tmp_path):
    untold = [f"-U__{name}__" for name in UNTOLD]
    if flags.isalpha():
        (tmp_path / "round.c").write_text(ROUND % flags)
        flags = str(tmp_path / "round.c")
    program = c99.build(wall.guard, tmp_path, "-O2", *flags.split(), *untold, "-w")
    told = subprocess.run([program], input=bytes(8 * 5 * 3), capture_output=True, check=True)
    assert np.frombuffer(told.stdout).reshape(3, -1)[:, 0].tolist() == [2.0] * 3


@pytest.mark.parametrize(
    "prefix",
    [
        *("", "2nd", "_guard", "a-b", "a b", "a__b", "a_", "käfig", "wall\n", "size_t", "../wall"),
        *("int", "class", "constexpr", "restrict", "and", "std", "linux", "Math", "errno", "NAN"),
        *("Action", "Decision", "Guard", "Observation"),
    ],
)
def test_a_prefix_that_is_no_name_is_refused(wall, prefix, tmp_path):
    with pytest.raises(ValueError, match="begins no name in C"):
        write_c99(wall.guard, tmp_path / "out", prefix)
    assert not (tmp_path / "out").exists()


def test_files_of_two_exports_do_not_compile_together(wall, full_at, tmp_path):
    other, guard = tmp_path / "other", wall.guard.copy()
    write_c99(guard, other)
    guard.reviser.tolerance *= 2.0
    write_c99(guard, tmp_path)
    was = {file: file.read_bytes() for file in other.iterdir()}
    with full_at(len(was[other / "evofsm.h"]) + 5), pytest.raises(OSError, match="too large"):
        write_c99(guard, other)  # the disk is full after the first of them
    assert was == {file: file.read_bytes() for file in other.iterdir()}
    shutil.copy(other / "evofsm.h", tmp_path)
    for source in ("-xc", "evofsm.c"), ("-xc++", "evofsm.hpp"):
        command = ["cc", "-fsyntax-only", *source]
        built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert f"{source[1]} and evofsm.h are of different exports" in built.stderr


EVIL = "*/ #error \x1b[2J", "?" + "?/\n*/", "/*\\", "\u202e\u2066\u200f\ufffe\ud800", "a<&\"'\t"


@pytest.mark.parametrize("names", [EVIL[:2], EVIL[2:4], EVIL[3:], ("x", "x"), ("\x1b", "\\u001b")])
def test_no_name_gets_out_of_its_place(wall, names, tmp_path):
    guard = wall.guard.copy()
    guard.judge.labels = guard.judge.labels._replace(names=names, units=names)
    write_c99(guard, tmp_path)
    subprocess.run(["cc", *c99.FLAGS, "-c", "evofsm.c"], cwd=tmp_path, check=True)
    header = (tmp_path / "evofsm.h").read_text()
    assert all(sign.isprintable() or sign == "\n" for sign in header)
    write_fmu(guard, tmp_path / "unit.fmu")
    told = fmpy.read_model_description(tmp_path / "unit.fmu")
    variables = [one.name for one in told.modelVariables]
    assert len({*variables}) == 7
    assert all(map(str.isprintable, variables))
    guard.save(tmp_path / "guard")
    guard = Guard.load(tmp_path / "guard")
    with pytest.raises(ValueError, match="must lie between") as wrong:
        guard.decide([math.inf, 0.0], 0.0)
    guard.explaining = True
    told = [guard.decide([math.nan, 0.9][::way], 1.0) for way in (1, -1)]
    texts = *(one.reason + one.explanation for one in told), *str(guard).split("\n")
    assert all(map(str.isprintable, (str(wrong.value), *texts)))


class Own(LatentRisk):
    def judge(self, situation, accelerations):
        raise NotImplementedError


def test_what_cannot_be_exported_is_refused_and_nothing_is_written(tmp_path):
    for guard, why in (
        (Guard(n_actions=2, interval=0.1), "nothing to export yet: no failure is known"),
        (Guard(low=-2.0, high=2.0, interval=0.25, judge=Own(-2.0)), "but no Own"),
        (guard_for_cars(-2.0, 2.0, mode=Mode.OFF), "mode is not off"),
    ):
        with pytest.raises(ValueError, match=why):
            write_c99(guard, tmp_path / "out")
        assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", c99.SYSTEMS)
def test_decisions_are_the_same_and_sanitizers_silent(name, tmp_path):
    found = agrees(c99.learnt(name, episodes=15), tmp_path, ["-O2"], c99.SANITIZERS, decisions=1000)
    assert found.changed > 20


@pytest.mark.slow
@pytest.mark.parametrize(("setting", "value"), [("mode", Mode.SHADOW), ("tolerance", 0.6)])
@pytest.mark.parametrize("name", ["wall", "cars"])
def test_settings_of_a_guard_are_those_in_c(name, setting, value, tmp_path):
    learnt = c99.learnt(name)
    setattr(learnt.guard.reviser, setting, value)
    agrees(learnt, tmp_path, ["-O1"])


@pytest.mark.slow
def test_a_search_that_is_cut_short_is_so_in_c(wall, monkeypatch, tmp_path):
    risk = wall.guard.judge
    monkeypatch.setattr(risk, "parts", risk.parts._replace(n_asked=3, n_judged=1, most=1.0))
    asked = c99.ask(wall, 1500)
    assert sum("the search was cut short" in reason for reason, _ in asked.said) > 20
    assert c99.compare(wall.guard, c99.build(wall.guard, tmp_path), asked).agrees


@pytest.mark.slow
def test_brakes_that_are_not_known_are_tried_in_c_too(tmp_path):
    learnt = c99.learnt("cars", episodes=0)
    found = agrees(learnt, tmp_path, ["-O1"])
    assert constant(tmp_path, "KNOWN") == 0
    assert found.changed > 50


def test_cars_that_brake_hard_give_the_same_reasons_in_c(tmp_path):
    guard = guard_for_cars(-6.0, 2.5, judge=LatentRisk(-6.0, decel=6.0, leader_decel=9.0))
    guard.freeze()
    asked = c99.ask(c99.Learnt(c99.CutIn(), guard), 4000, 1)
    assert c99.compare(guard, c99.build(guard, tmp_path), asked).agrees
    said = {reason.rpartition("; ")[2] for reason, _ in asked.said}
    assert {c99._CHOSEN[code] for code in (1, 3, *range(7, 11))} <= said


@pytest.mark.slow
@pytest.mark.parametrize("name", ["disc", "cars"])
def test_it_asks_for_no_memory_and_little_of_the_stack(name, tmp_path):
    write_c99(c99.learnt(name, episodes=15).guard, tmp_path)
    for optimised in ("-O0", "-O2"):
        command = ["cc", *c99.FLAGS, optimised, "-fstack-usage", "-c", "evofsm.c"]
        subprocess.run(command, cwd=tmp_path, check=True)
        # All frames at once: more than any chain of calls, as nothing calls itself.
        frames = (tmp_path / "evofsm.su").read_text().splitlines()
        assert all(line.endswith("static") for line in frames)
        stack = sum(int(line.split()[-2]) for line in frames)
        assert stack <= constant(tmp_path, "EVOFSM_STACK", "evofsm.h")
    symbols = subprocess.run(["nm", "evofsm.o"], cwd=tmp_path, capture_output=True, text=True)
    used = {line.split()[-1] for line in symbols.stdout.splitlines() if " U " in line}
    known = ("exp", "sqrt", "floor", "fabs", "memcpy", "memmove", "memset", "__stack_chk_fail")
    assert used <= set(known)


@pytest.mark.slow
def test_the_node_for_ros_2_compiles_and_decides(wall, tmp_path):
    """Against a stand-in: ROS 2 itself was not at hand."""
    write_c99(wall.guard, tmp_path)
    here = Path(__file__).parent
    node = here.parents[1] / "examples" / "ros2" / "guard_node.cpp"
    for header in re.findall("#include <(.+)/(.+hpp)>", node.read_text()):
        (tmp_path / header[0]).mkdir(parents=True, exist_ok=True)
        (tmp_path / "/".join(header)).write_text(f'#include "{here / "ros2.hpp"}"')
    asked = [((0.9, 0.1), 1.0), ((0.95, 0.05), math.nan), ((0.0, 0.0), 0.5)]
    script = "".join(
        f"observation {place} {speed}\nproposal {wanted}\ntick\n"
        for (place, speed), wanted in asked
    )
    wrong = "observation 1.0\nobservation inf 0\ntick\n"
    said = [line.split() for line in run_cpp(tmp_path, node, "evofsm", told=script + wrong)]
    wall.guard.begin()
    expected = [wall.guard.decide(*each).executed for each in asked]
    assert [float(line[1]) for line in said if line[0] == "executed"] == expected
    assert [line[1] for line in said if line[0] == "error"] == ["1", "no"]


def test_tools_load_an_fmu_and_step_it(wall, monkeypatch, tmp_path, caplog, capsys):
    file, guard = tmp_path / "my wall-2.fmu", wall.guard.copy()
    guard.reviser.fallback = Fallback(0.25, "a quarter")
    monkeypatch.setenv("CC", "cc -O1")
    write_fmu(guard, file)
    assert validate_fmu(str(file)) == []
    told, place = fmpy.read_model_description(file), fmpy.extract(file, tmp_path / "unit")
    unit = fmpy.instantiate_fmu(place, told, "CoSimulation")
    begins = [float(told.modelVariables[k].start) for k in (2, 3)]
    assert unit.getReal([2, 3]) == begins == [0.25, 0.25]
    unit.setReal([0, 1, 2], [0.9, 0.1, 1.0])
    for _ in range(3):  # it decides at the first of them
        unit.doStep(0.0, wall.guard.interval / 3)
        assert unit.getBoolean([6]) == [True]
        unit.setReal([2], [0.0])
    for value, step, why in ((0.0, 0.07, "a step of 0.07 s"), (math.inf, 0.1, "is infinite")):
        unit.setReal([0], [value])
        with pytest.raises(FMICallException):
            unit.doStep(0.0, step)
        assert why in capsys.readouterr().out
    unit.setReal([0], [0.9])
    unit.doStep(0.0, wall.guard.interval / 3)
    with pytest.raises(FMICallException):  # beyond the next decision
        unit.doStep(0.0, wall.guard.interval)
    unit.doStep(0.0, wall.guard.interval / 3)
    unit.freeInstance()


@pytest.mark.parametrize(
    ("compiler", "why"),
    [
        ("no-such-compiler", "it cannot be started"),
        ("sh -c 'exit 3'", "it ended with status 3"),
        ("sh -c 'while [ $1 != -o ]; do shift; done; echo > $2' cc", "file too short"),
    ],
)
def test_what_a_compiler_does_not_build_for_here_is_no_part_of_an_fmu(
    wall, compiler, why, monkeypatch, tmp_path, caplog
):
    monkeypatch.setenv("CC", compiler)
    write_fmu(wall.guard, tmp_path / "wall.fmu")
    assert fmpy.supported_platforms(tmp_path / "wall.fmu") == ["c-code"]
    text = f"holds sources alone: {compiler} (CC, or cc) built no library that loads here: {why}"
    assert text in caplog.text
    monkeypatch.setenv("CC", "cc")
    no = OSError("x: failed to map segment from shared object")  # under noexec
    monkeypatch.setattr("ctypes.CDLL", lambda _: (_ for _ in ()).throw(no))
    write_fmu(wall.guard, tmp_path / "wall.fmu")
    assert len(fmpy.supported_platforms(tmp_path / "wall.fmu")) == 2


@pytest.mark.slow
@pytest.mark.parametrize(("name", "episodes"), [("cars", 20), ("cartpole", 1), ("disc", 2)])
def test_an_fmu_drives_as_python_does(name, episodes, tmp_path):
    driven = c99.drive_fmu(c99.learnt(name, episodes=15), tmp_path, episodes)
    assert driven.decisions > 100 * episodes
    assert driven.others == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["exit", "ACC", "my_evofsm_2", "K"])
def test_two_guards_are_linked_into_one_program_whatever_is_called_so_in_c(wall, name, tmp_path):
    write_c99(wall.guard, tmp_path, name)
    write_c99(c99.learnt("cars", episodes=0).guard, tmp_path, "cars")
    (tmp_path / "main.cpp").write_text(
        f'#include <cmath>\n#include <cstdio>\n#include <cstdlib>\n#include "{name}.hpp"\n'
        '#include "cars.hpp"\nint main() { std::printf("%d %d\\n", '
        f"{name}::Guard().decide({{NAN, 0.0}}, {{1.0}})->reason,"
        " cars::Guard().decide({9.0, 30.0, 1.0}, {1.0})->reason - CARS_TRIED); }"
    )
    assert run_cpp(tmp_path, "main.cpp", name, "cars") == ["4 0"]


@pytest.mark.slow
def test_the_program_of_the_page_runs(wall, tmp_path):
    write_c99(wall.guard, tmp_path)
    page = Path(__file__).parents[2] / "docs" / "on-your-target.md"
    program = re.search(r"```cpp\n(.*?)```", page.read_text(), flags=re.S)[1]
    (tmp_path / "main.cpp").write_text(program)
    said = run_cpp(tmp_path, "main.cpp", "evofsm")
    places = [float(line.split()[1]) for line in said]
    assert len(places) == 60
    assert max(places) < 1.0
    assert math.isclose(places[0], 0.02, abs_tol=0.01)

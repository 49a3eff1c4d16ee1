"""A guard in C decides as in Python: the templates beside the kernels are held to them here."""

import math
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import c99
from evofsm import Guard, Missing
from evofsm.driving import LatentRisk, guard_for_cars
from evofsm.guard import LearntRisk, Mode
from evofsm.guard.export import write_c99

PAGE = Path(__file__).parents[2] / "docs" / "on-your-target.md"


def compiler(name="cc"):
    """A compiler, or the test is skipped."""
    return shutil.which(name) or pytest.skip(f"there is no {name} to compile with")


@pytest.fixture(scope="module")
def wall():
    return c99.learnt("wall")


def agrees(learnt, folder, *flags, decisions=1500, seed=1):
    """How both decide; the same, or it fails."""
    asked = c99.ask(learnt, decisions, seed)
    found = c99.compare(learnt.guard, c99.build(learnt.guard, folder, *flags), asked)
    assert found.agrees, found[:6]
    return found


def constant(folder, name, file="evofsm.c"):
    text = (folder / file).read_text()
    return float(re.search(rf"^#define {name} (\S+)$", text, flags=re.M)[1])


def run_cpp(folder, source, *prefixes, told=""):
    """What a program of C++ around exported C prints."""
    for prefix in prefixes:
        subprocess.run([compiler(), *c99.FLAGS, "-c", f"{prefix}.c"], cwd=folder, check=True)
    flags = ("-std=c++17", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-I.", "-o", "main")
    command = [compiler("c++"), *flags, source, *(f"{prefix}.o" for prefix in prefixes), "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    run = {"input": told, "capture_output": True, "text": True, "check": True}
    return subprocess.run(["./main"], cwd=folder, **run).stdout.splitlines()


def test_a_guard_in_c_decides_as_in_python(wall, tmp_path):
    compiler()
    found = agrees(wall, tmp_path, "-O1", decisions=800)
    assert found.changed > 100
    assert found.refused > 5


class Own(LatentRisk):
    def judge(self, situation, accelerations):
        raise NotImplementedError


@pytest.mark.parametrize(
    ("guard", "why"),
    [
        (lambda: Guard(n_actions=2, interval=0.1), "nothing to export yet: no failure is known"),
        (lambda: Guard(low=-2.0, high=2.0, interval=0.25, judge=Own(-2.0)), "but no Own"),
        (lambda: guard_for_cars(-2.0, 2.0, mode=Mode.OFF), "mode is not off"),
    ],
)
def test_what_cannot_be_exported_is_refused_and_nothing_is_written(guard, why, tmp_path):
    with pytest.raises(ValueError, match=why):
        write_c99(guard(), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", c99.SYSTEMS)
def test_decisions_are_the_same_and_sanitizers_silent(name, tmp_path):
    compiler()
    learnt = c99.learnt(name)
    for flags in (("-O2",), c99.SANITIZERS):
        found = agrees(learnt, tmp_path / flags[0], *flags)
        assert found.changed > 50
    has = {"noisy": ("NOISY", 1), "noisy_cars": ("EXACT", 0), "cut_in": ("JUMPS", 1)}
    macro, is_on = (has | {"disc": ("REGIONS", 1)}).get(name, ("ACTS", 1))
    assert bool(constant(tmp_path / "-O2", macro)) == is_on


SETTINGS = {
    "mode": lambda guard: setattr(guard.reviser, "mode", Mode.SHADOW),
    "tolerance": lambda guard: setattr(guard.reviser, "tolerance", 0.6),
    "hold": lambda guard: setattr(guard, "missing", Missing.HOLD),
    "reject": lambda guard: setattr(guard, "missing", Missing.REJECT),
}


@pytest.mark.slow
@pytest.mark.parametrize("change", SETTINGS)
@pytest.mark.parametrize("name", ["wall", "cars"])
def test_settings_of_a_guard_are_those_in_c(name, change, tmp_path):
    compiler()
    learnt = c99.learnt(name)
    SETTINGS[change](learnt.guard)
    agrees(learnt, tmp_path, "-O1")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["disc", "cut_in"])
def test_whatever_may_be_learnt_is_replayed_alike(name, tmp_path):
    """Places, drifts, jumps, regions, dead ends: not each system teaches each of them."""
    compiler()
    learnt = c99.learnt(name)
    judge, chance = learnt.guard.judge, np.random.default_rng(0)
    model, found = judge.dynamics.model, judge.disturbances
    m, count = found.residuals.shape[1:]
    seen = judge.situations[:, :m]
    place = found.place.copy()
    for k in range(1, count, 2):
        j = int(chance.integers(m))
        place[k] = j, chance.choice([-1.0, 1.0]), np.median(seen[:, j]), k % 4, 6 + k
    jump_at = found.jump_at.copy()
    jump_at[2::3, 0] = 5.0
    slope = chance.normal(size=found.jump_slope.shape)
    ranges = np.sort(chance.normal(size=found.jump_from.shape), -1)
    landing = np.stack([np.tile(end, (count, 1)) for end in (seen.min(0), seen.max(0))], -1)
    judge.disturbances = found._replace(
        place=place, jump_at=jump_at, jump_slope=slope, jump_from=ranges, landing=landing
    )
    drifted = np.where(np.arange(m) == m - 1, 1.0, -1.0)
    unit, low = judge.dynamics.sums.unit, seen.min(0)
    region = [0, m - 1, low[0], low[m - 1], 1 / unit[0], 1 / unit[m - 1], 1, 0.1, 0.2, -1, 0.3, -2]
    centres = seen[chance.integers(len(seen), size=3)]
    ends = np.column_stack([centres, np.full(3, 0.4), np.full(3, 4.0)])
    judge.dynamics.model = model._replace(
        drifted=drifted, regions=np.array([region]), dead_ends=ends
    )
    counted = {name: np.arange(1.0, 4.0) for name in ("numbers", "counts")}
    judge.dynamics.dead_ends = judge.dynamics.dead_ends._replace(**counted)
    asked = c99.ask(learnt, 1500)
    near = sum("near dead end" in reason for reason, _ in asked.said)
    assert near > 20 or name == "cut_in"  # where nothing passes anyway
    found = c99.compare(learnt.guard, c99.build(learnt.guard, tmp_path, *c99.SANITIZERS), asked)
    assert found.agrees, found[:6]
    assert constant(tmp_path, "EVOFSM_PLACED", "evofsm.h") == 1
    assert found.changed > 20


@pytest.mark.slow
def test_a_search_that_is_cut_short_is_so_in_c(wall, monkeypatch, tmp_path):
    compiler()
    monkeypatch.setattr(LearntRisk, "effort", property(lambda self: (3, 1.0)))
    asked = c99.ask(wall, 1500)
    assert sum("the search was cut short" in reason for reason, _ in asked.said) > 20
    assert c99.compare(wall.guard, c99.build(wall.guard, tmp_path), asked).agrees


@pytest.mark.slow
def test_brakes_that_are_not_known_are_tried_in_c_too(tmp_path):
    compiler()
    learnt = c99.learnt("cars", episodes=0)
    found = agrees(learnt, tmp_path, "-O1")
    assert constant(tmp_path, "KNOWN") == 0
    assert found.changed > 50


@pytest.mark.slow
@pytest.mark.parametrize("name", ["disc", "cars"])
def test_it_asks_for_no_memory_and_little_of_the_stack(name, tmp_path):
    cc = compiler()
    write_c99(c99.learnt(name).guard, tmp_path)
    for optimised in ("-O0", "-O2"):
        command = [cc, *c99.FLAGS, optimised, "-fstack-usage", "-c", "evofsm.c"]
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


@pytest.mark.slow
def test_the_program_of_the_page_runs(wall, tmp_path):
    write_c99(wall.guard, tmp_path)
    program = re.search(r"```cpp\n(.*?)```", PAGE.read_text(), flags=re.S)[1]
    (tmp_path / "main.cpp").write_text(program)
    said = run_cpp(tmp_path, "main.cpp", "evofsm")
    places = [float(line.split()[1]) for line in said]
    assert len(places) == 60
    assert max(places) < 1.0
    assert math.isclose(places[0], 0.02, abs_tol=0.01)

"""The recipes of CONTRIBUTING.md, followed as they stand there."""

import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace

import pytest

from evofsm.driving.naming import DECISION_COLUMNS
from evofsm.guard.record import Column

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]


def chapter(title):
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    return text.split(f"\n## {title}\n")[1].split("\n## ")[0]


def write(title, folder):
    """Put the files of a recipe into a folder; returns the code that has no file."""
    found, loose = re.findall(r"^ *```python\n(.*?)^ *```", chapter(title), re.S | re.M), []
    for code in map(textwrap.dedent, found):
        if named := re.match(r"# (\w+\.py)\n", code):
            (folder / named[1]).write_text(code, encoding="utf-8")
        else:
            loose.append(code)
    return "\n".join(loose)


def python(folder, *arguments, **environment):
    """Run Python in a folder; returns what it printed."""
    command = [sys.executable, *map(str, arguments)]
    usual = {**os.environ, "PYTHONPATH": str(ROOT)}  # the studies are no part of the package
    told = {"cwd": folder, "env": usual | environment, "capture_output": True, "text": True}
    result = subprocess.run(command, **told)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_a_state_rule_and_a_judge(tmp_path):
    write("Add a state rule", tmp_path)
    said = python(tmp_path, "-m", "evofsm", "check", "my_rule:Coarse")
    assert "a_machine_takes_it" in said
    assert "0 failed" in said
    python(tmp_path, "-c", write("Add a judge", tmp_path))
    assert "0 failed" in python(tmp_path, "-m", "evofsm", "check", "my_judge:Kettle")


def test_a_column(tmp_path):
    line = write("Add a column to decisions.parquet", tmp_path)
    [(name, column)] = eval(f"{{{line}}}", {"Column": Column}).items()
    assert name not in DECISION_COLUMNS
    decision = SimpleNamespace(situation=SimpleNamespace(observation=(20.0, 15.0, 12.0)))
    assert column.kind is float
    assert column.in_table
    assert column.read(decision) == 3.0


def test_a_family(tmp_path):
    write("Add a family, or a world", tmp_path)
    said = python(tmp_path, "-m", "evofsm", "drive", "mine.py", "--episodes", 3)
    assert "mine, 3 training episodes" in said


# Run where the counter was added; prints nothing where all is well.
COUNTED = """
import sys
import numpy as np
from pathlib import Path
from evofsm import EvolvingFSM, FSMModel, Novelty

folder, rule = Path(sys.argv[1]), Novelty(radius=1.0)
one = EvolvingFSM(1, rule=rule)
one.learn_many([[0.0], [3.0], [3.1], [3.0], [0.0], [0.1]], [0] * 6, episode_starts=[0, 3])
assert one.begun.tolist() == [1.0, 1.0], one.begun  # it counts
assert one.model().begun.tolist() == [1.0, 1.0]
one.save(folder / "machine")
one.model().save(folder / "model")
assert EvolvingFSM.load(folder / "machine").begun.tolist() == [1.0, 1.0]
assert FSMModel.load(folder / "model").begun.tolist() == [1.0, 1.0]

full = EvolvingFSM(1, rule=rule, max_states=2)
full.learn_many([[0.0], [1.5], [9.0]], [0] * 3, episode_starts=[0, 1])
assert full.begun.tolist() == [2.0, 0.0], full.begun  # two were joined, and an index is free
"""


def test_a_counter_counts_and_is_kept_joined_and_cleared(tmp_path):
    recipe = re.search(r"```diff\n(.*?)```", chapter("Add a counter"), re.DOTALL)[1]
    shutil.copytree(ROOT / "src", tmp_path / "src", ignore=shutil.ignore_patterns("__pycache__"))
    subprocess.run(["git", "apply"], input=recipe, text=True, cwd=tmp_path, check=True)
    # Without a compiler, which would compile all kernels anew.
    there = {"PYTHONPATH": str(tmp_path / "src"), "NUMBA_DISABLE_JIT": "1"}
    python(tmp_path, "-Wignore", "-c", COUNTED, tmp_path, **there)

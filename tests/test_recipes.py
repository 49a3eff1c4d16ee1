"""The recipes of CONTRIBUTING.md, followed as they stand there."""

import os
import re
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

"""A counter that is added as CONTRIBUTING.md says works."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# Run where the counter was added; prints nothing where all is well.
SCRIPT = """
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


@pytest.mark.slow
def test_the_counter_of_the_recipe_counts_is_kept_joined_and_cleared(tmp_path):
    chapter = (ROOT / "CONTRIBUTING.md").read_text("utf-8").split("## Add a counter")[1]
    recipe = re.search(r"```diff\n(.*?)```", chapter, re.DOTALL)[1]
    shutil.copytree(ROOT / "src", tmp_path / "src", ignore=shutil.ignore_patterns("__pycache__"))
    subprocess.run(["git", "apply"], input=recipe, text=True, cwd=tmp_path, check=True)
    # Without a compiler, which would compile all kernels anew.
    there = os.environ | {"PYTHONPATH": str(tmp_path / "src"), "NUMBA_DISABLE_JIT": "1"}
    subprocess.run([sys.executable, "-Wignore", "-c", SCRIPT, tmp_path], env=there, check=True)

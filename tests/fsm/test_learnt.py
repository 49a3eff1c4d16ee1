"""The table of what is learnt: a counter is a line in it, and a line where it is counted."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from evofsm.fsm.learnt import MACHINE, MODEL, Counts, Learnt, arrays_of
from evofsm.fsm.memory import leaves

ROOT = Path(__file__).parents[2]
# Run where the counter was added; prints nothing where all is well.
SCRIPT = """
import sys
import numpy as np
from pathlib import Path
from evofsm import EvolvingFSM, FSMModel, Novelty
from evofsm import merge

folder = Path(sys.argv[1])


def machine(**settings):
    return EvolvingFSM(1, rule=Novelty(radius=1.0), **settings)


one = machine()
one.learn_many([[0.0], [3.0], [3.1], [3.0], [0.0], [0.1]], [0] * 6, episode_starts=[0, 3])
assert one.begun.tolist() == [1.0, 1.0], one.begun  # it counts
assert one.model().begun.tolist() == [1.0, 1.0]
one.save(folder / "machine")
one.model().save(folder / "model")
assert EvolvingFSM.load(folder / "machine").begun.tolist() == [1.0, 1.0]
assert FSMModel.load(folder / "model").begun.tolist() == [1.0, 1.0]
assert merge([one, one]).begun.tolist() == [2.0, 2.0]

full = machine(max_states=2)
full.learn_many([[0.0], [1.5], [9.0]], [0] * 3, episode_starts=[0, 1])
assert full.begun.tolist() == [2.0, 0.0], full.begun  # two were joined, and an index is free
"""


@pytest.fixture(scope="module")
def recipe():
    """The diff in CONTRIBUTING.md."""
    chapter = (ROOT / "CONTRIBUTING.md").read_text("utf-8").split("## Add a counter")[1]
    return re.search(r"```diff\n(.*?)```", chapter, re.DOTALL)[1]


def test_a_counter_is_at_most_three_edits_in_two_files(recipe):
    assert len(re.findall(r"^\+\+\+ ", recipe, re.MULTILINE)) <= 2
    assert len(re.findall(r"(?:^[+-](?![+-]).*\n)+", recipe, re.MULTILINE)) <= 3


def test_the_counter_of_the_recipe_counts_is_kept_joined_and_cleared(recipe, tmp_path):
    shutil.copytree(ROOT / "src", tmp_path / "src", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "diff").write_text(recipe, "utf-8")
    subprocess.run(["git", "apply", "diff"], cwd=tmp_path, check=True)
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(tmp_path / "src")}
    command = [sys.executable, "-W", "ignore", "-c", SCRIPT, str(tmp_path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_python_and_kernels_agree_where_nothing_is_compiled(grown, tmp_path):
    code = (
        "import sys, numpy as np; from evofsm import EvolvingFSM;"
        "machine = EvolvingFSM.load(sys.argv[1]);"
        "machine.learn_many(np.linspace(-2.0, 2.0, 40).reshape(20, 2), [0, 1] * 10);"
        "machine.save(sys.argv[2])"
    )
    grown.save(tmp_path / "before")
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT / "src")}
    command = [sys.executable, "-W", "ignore", "-c", code]
    command += [str(tmp_path / "before"), str(tmp_path / "after")]
    subprocess.run(command, env=environment, check=True)
    grown.learn_many(np.linspace(-2.0, 2.0, 40).reshape(20, 2), [0, 1] * 10)
    after = dict(leaves(type(grown).load(tmp_path / "after")._trimmed()))
    for name, array in leaves(grown._trimmed()):
        np.testing.assert_allclose(after[name], array, rtol=1e-9, atol=1e-12, err_msg=name)


def test_every_array_of_the_buffer_is_in_the_table_and_in_files(grown):
    names = [name for name, _ in leaves(grown._trimmed())]
    assert names == [array.name for array in arrays_of(Learnt)]
    assert names == list(MACHINE.arrays)


def test_a_machine_and_its_model_have_every_count(grown):
    model = grown.model()
    for array in arrays_of(Counts):
        np.testing.assert_array_equal(getattr(model, array.name), getattr(grown, array.name))
        with pytest.raises(AttributeError):
            setattr(grown, array.name, None)


def row_of(kind):
    page = (ROOT / "docs" / "files.md").read_text("utf-8")
    return re.search(rf"^\| {kind.name} \| (.*) \|$", page, re.MULTILINE)[1]


@pytest.mark.parametrize("kind", [MACHINE, MODEL], ids=lambda kind: kind.name)
def test_the_page_on_files_has_every_array_with_its_shape(kind):
    told = {}
    for group in row_of(kind).split(";"):
        names, shape = re.fullmatch(r"\s*(.*) \(([^()]*)\)\s*", group).groups()
        told |= dict.fromkeys(re.findall(r"`(\w+)`", names), shape)
    letters = {"places": "p", 1: "1", "settings.n_actions": "q"}
    assert told == {
        name: ", ".join(letters.get(size, size) for size in member.shape)
        for name, member in kind.arrays.items()
    }

import email
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib import import_module
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "src" / "evofsm"
HEAVY = {
    *("numba", "scipy", "libsumo", "matplotlib", "jinja2", "river", "sklearn", "mcap"),
    *("polars", "pyarrow", "pandas", "typer", "rich", "gymnasium", "highway_env"),
}


def run(*command, **options):
    finished = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, check=False, **options
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return finished.stdout


@pytest.mark.skipif(not shutil.which("make"), reason="there is no make")
def test_make_lets_python_read_a_path_with_an_umlaut():
    command = ("make", "--silent", "--eval", "told:; @echo $$LC_ALL", "told")
    assert run(*command, cwd=ROOT, env={**os.environ, "LC_ALL": "C"}) == "C.UTF-8\n"


# -- Importing ---------------------------------------------------------------------------------


def modules_after(code):
    program = f"{code}\nimport json, sys\nprint(json.dumps(list(sys.modules)))"
    return {name.split(".")[0] for name in json.loads(run(sys.executable, "-c", program))}


def test_importing_loads_nothing_heavy_and_learning_numba_alone():
    assert not modules_after("import evofsm") & HEAVY
    learning = "from evofsm import EvolvingFSM\nEvolvingFSM(2).observe([0.0])"
    # Numba itself loads SciPy where it finds it.
    assert modules_after(learning) & HEAVY <= {"numba", "scipy"}


def test_where_it_is_packed_without_its_faces_it_is_said_how_to_pack_it(tmp_path):
    module = shutil.copy(PACKAGE / "__init__.py", tmp_path)
    with pytest.raises(ImportError, match="pyinstaller --collect-all evofsm"):
        runpy.run_path(module, run_name="evofsm")


@pytest.mark.parametrize(
    "face", sorted(PACKAGE.rglob("__init__.pyi")), ids=lambda face: face.parent.name
)
def test_a_face_offers_each_name_once_in_order_and_no_module_hides_it(face):
    lines = [line for line in face.read_text("utf-8").splitlines() if line.startswith("from ")]
    names = [line.rpartition(" as ")[2] for line in lines]
    assert len(set(names)) == len(names)
    room = import_module(".".join(face.parent.relative_to(PACKAGE.parent).parts))
    for name in names:
        assert getattr(room, name) is not None
    modules = {path.stem for path in face.parent.iterdir()}
    offered = {line.rpartition(" as ")[2] for line in lines if not line.startswith("from . ")}
    assert not offered & modules
    assert room.__all__ == sorted(names)


# -- What is told of it ------------------------------------------------------------------------

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
TOLD = {
    "CITATION.cff": r"^version: (.+)$",
    "recipe/recipe.yaml": r'^  version: "(.+)"$',
    "src/evofsm/__init__.py": r'^__version__ = "(.+)"$',
}


@pytest.mark.parametrize("file", TOLD)
def test_the_version_is_told_alike(file):
    if not (ROOT / file).exists():
        pytest.skip("no part of the sdist")
    assert re.findall(TOLD[file], (ROOT / file).read_text("utf-8"), re.M) == [PROJECT["version"]]


def test_the_recipe_asks_for_what_the_wheel_asks_for():
    if not (ROOT / "recipe").exists():
        pytest.skip("no part of the sdist")
    [run] = re.findall(
        r"  run:\n((?:    - .+\n)+)", (ROOT / "recipe/recipe.yaml").read_text("utf-8")
    )
    asked = {line.strip("- ").replace(" ", "") for line in run.splitlines()}
    assert asked == {*PROJECT["dependencies"], "python>=${{python_min}}"}


def test_workflows_run_on_the_versions_claimed_and_a_linter_has_nothing_to_say():
    workflows = sorted((ROOT / ".github").rglob("*.yml"))
    if not workflows:
        pytest.skip("no part of the sdist")
    texts = "".join(workflow.read_text("utf-8") for workflow in workflows)
    claimed = [line.rpartition(" ")[2] for line in PROJECT["classifiers"] if " 3." in line]
    assert f"python: {json.dumps(claimed)}" in texts
    options = ("--offline", "--strict-collection", "--persona=pedantic", "--quiet")
    run(Path(sys.executable).with_name("zizmor"), *options, ROOT / ".github")


@pytest.mark.parametrize("home", [None, "https://example.org/evofsm"])
def test_on_an_index_the_readme_has_no_link_that_leads_nowhere(home, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools")
    from readme import as_on_an_index

    shown = as_on_an_index((ROOT / "README.md").read_text("utf-8"), home)
    targets = re.findall(r"\]\(([^)]+)\)", shown)
    assert all(target.startswith(("https://", "#")) for target in targets)
    assert f"{home}/raw/HEAD/docs/images/" in shown or home is None
    assert "Contributing" in shown


# -- The wheel ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from the sources as a release would be."""
    folder = tmp_path_factory.mktemp("dist")
    build = (sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", folder, ROOT)
    run(*build, cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


@pytest.mark.slow
def test_a_wheel_that_is_built_elsewhere_and_later_has_the_same_bytes(wheel, tmp_path):
    copy = tmp_path / "elsewhere"
    unlike = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "src", copy / "src", ignore=unlike, copy_function=shutil.copyfile)
    for name in ("pyproject.toml", "README.md", "LICENSE", "tools/readme.py"):
        (copy / name).parent.mkdir(exist_ok=True)
        (copy / name).write_bytes((ROOT / name).read_bytes())
    run(sys.executable, "-m", "build", "--no-isolation", "--wheel", copy, cwd=tmp_path)
    assert (copy / "dist" / wheel.name).read_bytes() == wheel.read_bytes()


def core_dependencies(wheel):
    """Distributions that the wheel needs without any extra, and those that they need."""
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
        waiting = email.message_from_bytes(archive.read(metadata)).get_all("Requires-Dist")
    found = {}
    while waiting:
        requirement = Requirement(waiting.pop())
        wanted = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        if wanted and requirement.name not in found:
            found[requirement.name] = distribution(requirement.name)
            waiting += found[requirement.name].requires or []
    return found


@pytest.fixture(scope="module")
def fresh(wheel, tmp_path_factory):
    """The `bin` of a new environment that holds the wheel and its core dependencies alone.

    The dependencies are links to those that are installed here, so no network is needed.
    """
    folder = tmp_path_factory.mktemp("fresh")
    run(sys.executable, "-m", "venv", "--without-pip", folder)
    program = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(run(folder / "bin" / "python", "-c", program).strip())
    for dependency in core_dependencies(wheel).values():
        for top in {path.parts[0] for path in dependency.files if path.parts[0] != ".."}:
            (site / top).symlink_to(dependency.locate_file(top))
    pip = next(
        python
        for python in (sys.executable, sys._base_executable)
        if subprocess.run([python, "-m", "pip", "--version"], capture_output=True).returncode == 0
    )
    into = ["--python", folder / "bin" / "python", "--disable-pip-version-check"]
    run(pip, "-m", "pip", *into, "install", "--quiet", "--no-deps", "--no-index", wheel)
    return folder / "bin"


@pytest.mark.slow
def test_the_wheel_holds_every_source_file_alone_and_needs_numpy_numba_and_the_loader(wheel):
    needed = {"numpy", "numba", "llvmlite", "lazy-loader", "packaging"}
    assert core_dependencies(wheel).keys() == needed
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
        assert any(name.endswith(".dist-info/licenses/LICENSE") for name in archive.namelist())
    sources = {
        str(path.relative_to(ROOT / "src"))
        for path in (ROOT / "src" / "evofsm").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert "evofsm/py.typed" in held
    assert held == sources


@pytest.mark.slow
def test_the_wheel_learns_saves_and_forecasts_with_its_core_dependencies_alone(fresh, tmp_path):
    program = """
import sys
from evofsm import EvolvingFSM, FSMModel, IntervalActions

actions = IntervalActions(-1.0, 1.0, 0.5)
machine = EvolvingFSM(actions.n_actions, radius=0.5)
for z, a in ((0.0, -1.0), (0.1, 0.0), (2.0, 0.2), (1.0, 0.9), (1.1, 1.0)):
    machine.learn_one([z], actions.encode(a))
machine.save("machine")
assert EvolvingFSM.load("machine").predict(0).tolist() == machine.predict(0).tolist()
machine.model(actions=actions).save("model")
forecast = FSMModel.load("model").propagate(machine.belief, 0)
assert forecast.tolist() == machine.predict(0).tolist()
print(machine.n_states, sys.modules["evofsm"].__file__)
"""
    n_states, origin = run(fresh / "python", "-I", "-c", program, cwd=tmp_path).split()
    assert int(n_states) == 2
    assert Path(origin).is_relative_to(fresh.parent)


@pytest.mark.slow
def test_an_editor_sees_through_the_faces_of_the_wheel(fresh, tmp_path):
    """Mypy stands for it: of names that load on first use it knows the types."""
    program = """
from evofsm import EvolvingFSM, Guard
from evofsm.driving import guard_for_cars
from evofsm import Gaurd
reveal_type(EvolvingFSM(2).observe([0.0]))
reveal_type(guard_for_cars(low=-1.0, high=1.0, interval=0.1))
Guard(low=-1.0, high=1.0, interval="often")
"""
    (tmp_path / "mine.py").write_text(program, "utf-8")
    environment = {name: value for name, value in os.environ.items() if "PYPATH" not in name}
    command = [sys.executable, "-m", "mypy", "--strict", "--python-executable", fresh / "python"]
    # Of what examples need beside the core, the new environment has nothing.
    options = ["--disable-error-code=import-not-found", "--allow-untyped-decorators"]
    examples = [ROOT / "examples" / name for name in ("car_following.py", "verify_with_storm.py")]
    finished = subprocess.run(
        [*command, *options, "--config-file=", "mine.py", *examples],
        **{"cwd": tmp_path, "env": environment, "capture_output": True, "text": True},
    )
    lines = [line for line in finished.stdout.splitlines() if line.startswith("mine.py")]
    told = [re.sub(r"^mine.py:\d+: ", "", line) for line in lines]
    assert 'attribute "Gaurd"' in told[0], finished.stdout
    assert "evofsm.fsm.step.Step]" in told[1]
    assert told[2].startswith('note: Revealed type is "evofsm.guard.')
    assert '"interval" to "Guard" has incompatible type "str"' in told[3]
    assert "Found 2 errors in 1 file" in finished.stdout, finished.stdout

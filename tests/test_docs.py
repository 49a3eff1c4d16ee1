"""The documentation: its pages are run, its links and its site hold.

Tutorials and how-to pages are run as a reader would, block after block in a folder of their own.
All others are doctests. A block that is not run says why, in a comment before it.
"""

import doctest
import inspect
import json
import os
import re
import shlex
import statistics
import subprocess
import sys
from enum import Enum
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import NamedTuple
from urllib.parse import unquote, urlsplit

import matplotlib
import pytest
import typer.testing

import evofsm
from evofsm.cli import application

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
RUN = sorted([*DOCS.glob("tutorials/*.md"), *DOCS.glob("how-to/*.md")])
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(DOCS.rglob("*.md"))]
FLAGS = doctest.NORMALIZE_WHITESPACE


def name_of(page):
    return str(page.relative_to(ROOT))


# -- Blocks of code -------------------------------------------------------------------------------


class Block(NamedTuple):
    kind: str  # its language
    text: str
    line: int
    file: str | None  # under which name it is kept, if it is the content of a file
    reason: str | None  # why it is not run, if it is not


FENCE = re.compile(
    r"(?:^<!-- not run: (?P<reason>(?:(?!-->).)+) -->\n+)?"
    r"^```(?P<kind>[^\n`]*)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)


def blocks(page):
    text = page.read_text()
    whole = re.search(r"^<!-- blocks that are not run: (.+?) -->$", text, re.M | re.S)
    for found in FENCE.finditer(text):
        kind, code, file = found["kind"].strip(), found["text"], None
        if kind.startswith("{code-block}"):
            kind = kind.split()[1]
            if caption := re.match(r":caption: (\S+)\n\n?", code):
                file, code = caption[1], code[caption.end() :]
        line = text.count("\n", 0, found.start("text"))
        reason = found["reason"] or (whole[1] if whole and ">>>" not in code else None)
        yield Block(kind, code, line, file, reason)


def commands(block):
    """Each command of a console block, with what is shown to come of it."""
    for part in re.split(r"^\$ ", block.text, flags=re.MULTILINE)[1:]:
        command, _, shown = part.replace("\\\n", "").partition("\n")
        yield re.sub(r"\s+# .*", "", command), shown


def forget_written_since(before):
    """Modules in the present folder; another process would import them anew."""
    for name in set(sys.modules) - before:
        file = getattr(sys.modules[name], "__file__", None)
        if file and Path(file).resolve().is_relative_to(Path.cwd()):
            del sys.modules[name]


def run_command(command):
    """What a command prints, and how it ends; ours without the start of another process."""
    words = shlex.split(command)
    if words[0] == "evofsm":
        before = set(sys.modules)
        done = typer.testing.CliRunner().invoke(application(), words[1:])
        forget_written_since(before)
        return done.output, done.exit_code
    if words[0] == "python":
        words[0] = sys.executable
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr, done.returncode


@pytest.fixture
def reader(tmp_path, monkeypatch):
    """Someone in an empty folder, with a terminal of 80 columns."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    before = set(sys.modules)
    yield
    forget_written_since(before)


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN, ids=name_of)
def test_a_page_does_what_it_shows(page, reader):
    names, parser = {}, doctest.DocTestParser()
    as_printed = partial(doctest.OutputChecker().check_output, optionflags=FLAGS | doctest.ELLIPSIS)
    for block in blocks(page):
        if block.reason is not None:
            continue
        if block.file is not None:
            Path(block.file).write_text(block.text)
        elif block.kind == "console":
            for command, shown in commands(block):
                got, status = run_command(command)
                where = f"{name_of(page)}, line {block.line}: {command}\n{got}"
                assert as_printed(shown, got) if shown else status == 0, where
        elif block.kind == "pycon":
            test = parser.get_doctest(block.text, names, page.name, str(page), block.line)
            written = []
            runner = doctest.DocTestRunner(optionflags=FLAGS)
            runner.run(test, out=written.append, clear_globs=False)
            names = test.globs
            assert not runner.failures, "".join(written)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_block_is_run_or_says_why_not(page):
    for block in blocks(page):
        runs = page in RUN and (block.kind in {"console", "pycon"} or block.file)
        runs = runs or (page not in RUN and ">>>" in block.text)
        is_code = block.kind in {"python", "pycon", "console", "toml", "sh", "bash"}
        where = f"{name_of(page)}, line {block.line}"
        assert bool(runs) or block.reason is not None or not is_code, where


@pytest.mark.slow
def test_the_notebook_prints_what_it_shows(capsys):
    matplotlib.use("agg")
    names = {}
    for cell in json.loads((ROOT / "examples" / "first-guard.ipynb").read_text("utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
            shown = [line for one in cell["outputs"] for line in one.get("text", ())]
            printed = capsys.readouterr().out
            if "rounding" in cell["metadata"].get("tags", ()):  # which of two equals is a machine's
                assert names["revision"].executed < 0.7
                assert printed.startswith("proposed 1.0, executed ")
            else:
                assert printed == "".join(shown)
    n_failures = names["failures"](names["learning"])
    gallery = (ROOT / "docs" / "gallery.md").read_text("utf-8")
    assert f"20 other flights, {n_failures} of which failed" in gallery


def test_who_is_to_type_a_command_is_told_to_install_the_command_line():
    for page in PAGES:
        text = page.read_text()
        for extras in re.findall(r"pip install\s+'\.\[([\w,]+)\]'", text):
            is_typed = re.search(r"^\$ evofsm|`evofsm (learn|watch|monitor|drive)\b", text, re.M)
            assert not is_typed or {"cli", "all"} & {*extras.split(",")}, (page, extras)


def test_commands_that_are_not_run_would_be_understood():
    """Every command and option that a page names is there."""
    group = typer.main.get_command(application())
    looked_at = 0
    for page in PAGES:
        for block in blocks(page):
            for command, _ in commands(block) if block.kind == "console" else ():
                words = shlex.split(command.split("|")[0])
                if words[0] != "evofsm":
                    continue
                known = group
                for word in words[1:]:
                    if not hasattr(known, "commands") or word.startswith("-"):
                        break
                    assert word in known.commands, f"{name_of(page)}: {command}"
                    known = known.commands[word]
                options = {o for p in known.params for o in (*p.opts, *p.secondary_opts)}
                given = {w.partition("=")[0] for w in words[1:] if re.match(r"--?[a-z]", w)}
                assert given <= options | {"--help"}, f"{name_of(page)}: {command}"
                looked_at += 1
    assert looked_at > 40


# -- Docstrings and the glossary -----------------------------------------------------------------


def methods(cls):
    """Public methods that our own classes define, by name: no property, nothing inherited."""
    for base in cls.__mro__:
        if base.__module__.partition(".")[0] == evofsm.__name__:
            for name in vars(base):
                method = getattr(cls, name)
                if not (name.startswith("_") or isinstance(method, Enum)) and callable(method):
                    yield name, method


PUBLIC = {name: getattr(evofsm, name) for name in evofsm.__all__}
DOCUMENTED = PUBLIC | {
    f"{owner}.{name}": method
    for owner, cls in PUBLIC.items()
    if inspect.isclass(cls)
    for name, method in methods(cls)
}


@pytest.mark.parametrize("thing", DOCUMENTED.values(), ids=DOCUMENTED)
def test_a_public_name_has_its_sections_and_an_example(thing):
    """What it returns stands in the first line of its docstring, with the shape.

    A method may leave its example to its class, and tell there of the one thing that it is given.
    """
    is_method = not inspect.isclass(thing) and "." in thing.__qualname__
    lacks = set() if is_method else {"Examples"}
    given = () if inspect.isclass(thing) else set(inspect.signature(thing).parameters) - {"self"}
    if len(given) > is_method:
        lacks.add("Parameters")
    text = inspect.cleandoc(thing.__doc__ or "")
    lacks -= set(re.findall(r"^([A-Z]\w+)\n-+$", text, re.MULTILINE))
    if not (is_method or doctest.DocTestParser().get_examples(text)):
        lacks.add("Examples")
    assert not lacks


WORDS = [row for row in (DOCS / "glossary.md").read_text().splitlines() if row.startswith("| **")]


@pytest.mark.parametrize("word", WORDS, ids=lambda word: word.split("**")[1])
def test_a_word_has_the_name_in_code_that_the_glossary_gives(word):
    name = re.search(r"`((?:evofsm|studies)[\w.]+)` \|$", word)[1]
    owner, _, last = name.rpartition(".")
    fields = getattr(resolve_name(owner), "__dataclass_fields__", {})
    assert last in fields or resolve_name(name) is not None


# -- The site -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def site(tmp_path_factory, read_page):
    """All pages of the site, built with warnings as errors, once for all processes of pytest."""
    fcntl = pytest.importorskip("fcntl")
    run = tmp_path_factory.getbasetemp()
    shared = run.parent if "PYTEST_XDIST_WORKER" in os.environ else run
    folder, built = shared / "site", shared / "site-is-built"
    build = (sys.executable, "-m", "sphinx", "-W", "--keep-going", "-n", "-q", DOCS, folder)
    environment = {**os.environ, "PYTHONPATH": ""}
    with (shared / "site-lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not built.exists():
            done = subprocess.run(
                build, capture_output=True, text=True, check=False, env=environment
            )
            assert done.returncode == 0, done.stdout + done.stderr
            built.touch()
    return folder, {path: read_page(path) for path in folder.rglob("*.html")}


def is_elsewhere(address):
    return urlsplit(address).scheme != "" or address.startswith("//")


@pytest.mark.slow
def test_every_link_of_the_site_leads_somewhere_and_nothing_is_loaded_from_elsewhere(site):
    folder, pages = site
    looked_at = 0
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if is_elsewhere(link):
                assert parts.scheme == "https", f"{path}: {link}"
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            assert target.exists(), f"{path}: {link}"
            if parts.fragment and target in pages:
                assert unquote(parts.fragment) in pages[target].ids, f"{path}: {link}"
            looked_at += 1
        assert not [one for one in page.loads if is_elsewhere(one)], path
    assert looked_at > 1000
    for style in folder.rglob("*.css"):
        assert not re.search(r"(url\(|@import )['\"]?(https?:)?//", style.read_text()), style


@pytest.mark.slow
def test_formulas_need_no_script_and_links_to_lines_of_code_lead_to_them(site):
    folder, pages = site
    text = (folder / "equations" / "states.html").read_text()
    assert len(re.findall(r'<math [^>]*display="block"', text)) == 3
    assert "\\frac" not in text
    links = pages[folder / "equations" / "states.html"].links
    found = {int(one.rpartition("L-")[2]) for one in links if "fsm/clusters.html#" in one}
    source = (ROOT / "src/evofsm/fsm/clusters.py").read_text().splitlines()
    there = [source[line - 1].strip().partition("(")[0] for line in sorted(found)]
    assert {"def _judge", "def exceeds", "return MOVED if exceeds"} <= set(there)


@pytest.mark.slow
def test_every_public_module_is_in_the_reference(site):
    folder, _ = site
    reference = "".join(path.read_text() for path in (folder / "reference").glob("*.html"))
    for file in (ROOT / "src" / "evofsm").rglob("*.py"):
        parts = file.relative_to(ROOT / "src").with_suffix("").parts
        if not any(part.startswith("_") for part in parts):
            listed = f"source/{'/'.join(parts)}.html#L-1"
            described = f'id="module-{".".join(parts)}"'
            assert described in reference or listed in reference, file


def slug(heading):
    """The anchor that GitHub gives a heading."""
    words = re.sub(r"[^\w\- ]", "", re.sub(r"[`*]|\]\(.*?\)", "", heading).lower())
    return words.strip().replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_between_files_lead_somewhere(page):
    text = FENCE.sub("", page.read_text())
    for target in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text):
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{name_of(page)} links to {target}"
        if anchor and file.suffix == ".md":
            headings = re.findall(r"^#+ (.*)$", FENCE.sub("", file.read_text()), re.MULTILINE)
            assert anchor in {slug(heading) for heading in headings}, target


# -- The closed loop -------------------------------------------------------------------------------

RESULTS = json.loads((ROOT / "docs" / "results" / "emergency.json").read_text())


def shown(rows, pick=lambda values: values[0]):
    """Collisions, mobility and jerk as the tables write them."""
    rate, mobility, jerk = (
        pick([row[name] for row in rows]) for name in ("collision_rate", "mobility", "jerk")
    )
    return [f"{100 * rate:.1f} %", f"{mobility:.3f}", f"{jerk:.2f}"]


def cells_of(page):
    text, *_ = (ROOT / page).read_text().split("\n## `shift`")  # other families have other tables
    lines = text.splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if "|" in line]


def test_the_closed_loop_table_is_what_the_study_printed():
    checked = 0
    for cells in cells_of("docs/closed-loop.md"):
        name = re.match(r"`([\w-]+)`", cells[0])
        rows = [row for row in RESULTS if name and row["policy"] == name[1]]
        if rows and len(cells) >= 5:
            numbers = shown(rows)
            assert all(number in cells for number in numbers), (name[1], numbers)
            checked += 1
    assert checked >= 7


def test_the_bold_row_is_rebuilt_in_ten_lines():
    from studies.closed_loop import OURS, ClosedLoop, _test_learner

    blocks = re.findall(r"```pycon\n(.*?)```", (DOCS / "closed-loop.md").read_text("utf-8"), re.S)
    (block,) = [block for block in blocks if "try_out(" in block]
    lines = [line[4:] for line in block.splitlines() if line.startswith(">>> ")]
    assert len(lines) <= 10
    few = "\n".join(lines).replace("episodes=20", "episodes=4")
    names = {}
    exec(few.replace("learning_seed=0", "learning_seed=1"), names)
    (row,) = _test_learner(ClosedLoop(train=4, test=4), OURS, 1)["rows"]
    ours = names["row"]
    assert ours.collisions == row["collisions"] == 0
    assert sum(drive.collided for drive in names["drives"]) == row["train_collisions"] == 0
    for name in ("mobility", "mobility_low", "intervention_rate", "mean_change", "jerk"):
        assert getattr(ours, name) == row[name]


def test_our_own_lines_and_the_evidence_are_the_median_and_the_worst_of_the_seeds():
    ours = [row for row in RESULTS if row["policy"] == "evofsm" and row["train_episodes"] == 100]
    assert len(ours) == 20
    worst = max(ours, key=lambda row: (row["collision_rate"], -row["mobility"]))
    median_line, worst_line = (
        cells for cells in cells_of("docs/closed-loop.md") if "100 episodes" in cells[0]
    )
    assert all(number in median_line for number in shown(ours, statistics.median))
    assert all(number in worst_line for number in shown([worst]))
    changed = statistics.median(row["intervention_rate"] for row in ours)
    names = ("unrevised", "rss-matched")
    alone, told = ([row for row in RESULTS if row["policy"] == name] for name in names)
    (line,) = [cells for cells in cells_of("README.md") if cells[0].startswith("weak brakes")]
    assert line[1].startswith("{}, mobility {}".format(*shown(alone)))
    assert f"changes {100 * told[0]['intervention_rate']:.0f} %" in line[2]
    for rows, cell in ((told, line[2]), ([worst], line[3])):
        assert all(number in cell for number in shown(rows)[:2])
    assert f"changes {100 * changed:.0f} %" in line[3]
    page = (ROOT / "docs" / "evidence.md").read_text()
    assert all(row["collision_rate"] == 0.0 for row in ours)
    assert f"each of {len(ours)} learning seeds" in page
    assert f"a mobility of {statistics.median(row['mobility'] for row in ours):.3f}" in page
    assert f"changes {100 * changed:.1f} % of the decisions" in page
    assert sum(row["train_collisions"] for row in RESULTS) == 0  # as the text says

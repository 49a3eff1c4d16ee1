"""The documentation: its pages are run, its links and its site hold.

Tutorials and how-to pages are run as a reader would, block after block in a folder of their own.
All others are doctests. A block that is not run says why, in a comment before it.
"""

import doctest
import os
import re
import shlex
import subprocess
import sys
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote, urlsplit

import pytest
import typer.testing

from evofsm import cli

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
        done = typer.testing.CliRunner().invoke(cli.application(), words[1:])
        forget_written_since(before)
        return done.output, done.exit_code
    if words[0] == "python":
        words[0] = sys.executable
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr, done.returncode


def as_printed(shown, got):
    return doctest.OutputChecker().check_output(shown, got, FLAGS | doctest.ELLIPSIS)


@pytest.fixture
def reader(tmp_path, monkeypatch):
    """Someone in an empty folder, with a terminal of 80 columns."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    before = set(sys.modules)
    yield
    forget_written_since(before)


@pytest.mark.parametrize("page", RUN, ids=name_of)
def test_a_page_does_what_it_shows(page, reader):
    names, parser = {}, doctest.DocTestParser()
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


def test_commands_that_are_not_run_would_be_understood():
    """Every command and option that a page names is there."""
    group = typer.main.get_command(cli.application())
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
    assert looked_at > 50

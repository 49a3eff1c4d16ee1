"""What the site needs beside Sphinx: formulas without scripts, and the source with its lines.

Nothing here is loaded from a network, when the site is built or when it is read.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from pygments import highlight
from pygments.formatters import HtmlFormatter
from pygments.lexers import PythonLexer
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.docutils import SphinxRole
from sphinx.util.inspect import stringify_signature

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src"
_log = logging.getLogger(__name__)


# -- Formulas ------------------------------------------------------------------------------------


def _inline_math(self: Any, node: nodes.math) -> None:
    self.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def _display_math(self: Any, node: nodes.math_block) -> None:
    self.body.append(self.starttag(node, "div", CLASS="formula"))
    if number := node.get("number"):
        self.body.append(f'<span class="eqno">({number})</span>')
    self.body.append(tex2mathml(node.astext(), as_block=True) + "</div>")
    raise nodes.SkipNode


# -- Lines of the source -------------------------------------------------------------------------


@cache
def text_of(module: str) -> str | None:
    """The source of a module of ours; None where there is none."""
    path = SOURCE.joinpath(*module.split("."))
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            return file.read_text("utf-8")
    return None


@cache
def lines_of(module: str) -> dict[str, tuple[int, int]]:
    """First and last line of everything that a module defines, by its name within the module."""
    found: dict[str, tuple[int, int]] = {"": (1, 1)}

    def note(owner: str, body: list[ast.stmt]) -> None:
        for node in body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                names = [node.name]
            elif isinstance(node, ast.AnnAssign | ast.Assign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names = [target.id for target in targets if isinstance(target, ast.Name)]
            else:
                continue
            for name in names:
                found.setdefault(f"{owner}{name}", (node.lineno, node.end_lineno or node.lineno))
            if isinstance(node, ast.ClassDef):
                note(f"{owner}{node.name}.", node.body)

    note("", ast.parse(text_of(module) or "").body)
    return found


def place_of(name: str) -> tuple[str, int, int]:
    """Module, first and last line of what a dotted name names.

    Raises
    ------
    LookupError
        If our source has nothing of this name.
    """
    parts = name.split(".")
    for split in range(len(parts), 0, -1):
        module, inside = ".".join(parts[:split]), ".".join(parts[split:])
        if text_of(module) is not None:
            if inside not in lines_of(module):
                break
            return module, *lines_of(module)[inside]
    raise LookupError(f"there is no {name} in src")


def line_with(fragment: str, name: str) -> tuple[str, int]:
    """Module and line of a piece of code within what a name names; it stands there once."""
    module, first, last = place_of(name)
    lines = (text_of(module) or "").splitlines()
    found = [row for row in range(first, last + 1) if fragment in lines[row - 1]]
    if len(found) != 1:
        raise LookupError(f"{fragment!r} stands {len(found)} times in {name}; it must be once")
    return module, found[0]


def page_of(module: str) -> str:
    """Name of the page with a module's source."""
    return f"source/{module.replace('.', '/')}"


class Line(SphinxRole):
    """``{line}`name``` or ``{line}`code in name```: a link to the line where it stands."""

    def run(self) -> tuple[list[nodes.Node], list[nodes.system_message]]:
        """One link, its text the name or the code and the place."""
        fragment, _, name = self.text.rpartition(" in ")
        try:
            if fragment:
                module, line = line_with(fragment, name)
            else:
                module, line, _ = place_of(name)
        except LookupError as error:
            _log.warning("%s", error, location=self.get_location())
            return [nodes.literal(text=self.text)], []
        shown = fragment or name.removeprefix(f"{module}.")
        here = nodes.inline(classes=["place"])
        here += nodes.Text(f" {module.rpartition('.')[2]}.py:{line}")
        link = _link_to(self.env.current_document.docname, self.env.app, module, line)
        link += [_breakable(shown), here]
        return [link], []


def _breakable(name: str) -> nodes.literal:
    """A name that may go on in the next line after an underscore."""
    literal = nodes.literal("", "")
    first, *others = name.split("_")
    literal += nodes.Text(first)
    for part in others:
        literal += [nodes.Text("_"), nodes.raw("", "<wbr>", format="html"), nodes.Text(part)]
    return literal


def _link_to(docname: str, app: Sphinx, module: str, line: int) -> nodes.reference:
    target = app.builder.get_relative_uri(docname, page_of(module))
    return nodes.reference(
        "", "", internal=True, refuri=f"{target}#L-{line}", classes=["source-line"]
    )


def _link_signatures(app: Sphinx, doctree: nodes.document, docname: str) -> None:
    """Put a link to the source beside each signature."""
    for signature in doctree.findall(addnodes.desc_signature):
        module, name = signature.get("module"), signature.get("fullname")
        if not module or text_of(module) is None or name not in lines_of(module):
            continue  # an attribute that is not ours, or a command
        link = _link_to(docname, app, module, lines_of(module)[name][0])
        link["classes"] = ["viewcode-link"]
        link += nodes.inline("", "source", classes=["viewcode-link"])
        signature += link


def _link_files(app: Sphinx, doctree: nodes.document) -> None:
    """Links of Markdown to files of ours lead to their source on the site.

    A page read where it lies, without the site, has the same links to the files themselves.
    """
    docname = app.env.current_document.docname
    folder = Path(app.srcdir, docname).parent
    for pending in list(doctree.findall(addnodes.pending_xref)):
        target = pending.get("reftarget", "")
        if pending.get("reftype") != "myst" or not target.startswith("."):
            continue
        path = (folder / target).resolve()
        if path.is_relative_to(SOURCE) and path.exists():
            module = ".".join(path.relative_to(SOURCE).with_suffix("").parts)
            if path.is_dir() and text_of(module) is None:
                raise LookupError(f"{docname} links to {target}, which is no package")
            link = _link_to(docname, app, module, 1)
            link += pending.children
            pending.replace_self(link)
        elif path.is_relative_to(ROOT / "examples") and path.exists():
            link = _link_to(docname, app, "examples", 1)
            name = path.name if path.is_file() else ""
            link["refuri"] = link["refuri"].partition("#")[0] + (f"#{name}" if name else "")
            link += pending.children
            pending.replace_self(link)


def _coloured(file: Path) -> str:
    """A file's source in HTML, each line with an anchor."""
    formatter = HtmlFormatter(lineanchors="L", linenos="inline", anchorlinenos=True)
    return highlight(file.read_text("utf-8"), PythonLexer(), formatter)


class Sources:
    """Writes a page for every file of the package, and one of the examples.

    Not by Sphinx's way for further pages, as each would carry the whole table of contents; and in
    another process, while Sphinx reads.
    """

    def __init__(self) -> None:
        self.files = sorted(SOURCE.rglob("*.py"))

    def begin(self, app: Sphinx) -> None:
        """Start to colour the files."""
        self.executor = ProcessPoolExecutor(1)
        self.coloured = self.executor.map(_coloured, self.files, chunksize=20)

    def write(self, app: Sphinx, error: Exception | None) -> None:
        """Write what is coloured."""
        with self.executor:
            if error is not None or app.builder.format != "html":
                self.executor.shutdown(cancel_futures=True)
                return
            for file, body in zip(self.files, self.coloured, strict=True):
                inside = file.relative_to(SOURCE)
                module = ".".join(inside.with_suffix("").parts).removesuffix(".__init__")
                _write_page(app, page_of(module), inside.as_posix(), body)
        folder = ROOT / "examples"
        examples = "".join(
            f'<h2 id="{file.name}">{file.name}</h2>'
            + highlight(_code_of(file), PythonLexer(), HtmlFormatter())
            for file in sorted([*folder.rglob("*.py"), *folder.glob("*.ipynb")])
        )
        _write_page(app, page_of("examples"), "Examples", examples)


def _code_of(file: Path) -> str:
    """The Python in a file, or in the cells of a notebook."""
    text = file.read_text("utf-8")
    if file.suffix == ".py":
        return text
    cells = json.loads(text)["cells"]
    return "\n\n".join("".join(one["source"]) for one in cells if one["cell_type"] == "code")


def _write_page(app: Sphinx, name: str, title: str, body: str) -> None:
    path = Path(app.outdir, f"{name}.html")
    path.parent.mkdir(parents=True, exist_ok=True)
    root = "../" * name.count("/")
    context = {"title": title, "body": body, "root": root, "release": app.config.release}
    path.write_text(app.builder.templates.render("source.html", context), "utf-8")


# -- The reference -------------------------------------------------------------------------------


def modules_in(room: str) -> list[str]:
    """A room and all public modules in it, in the order of the folder."""
    path = SOURCE.joinpath(*room.split("."))
    if not path.is_dir():
        return [room]
    names = [room]
    for entry in sorted(path.iterdir()):
        is_module = entry.suffix == ".py" or (entry / "__init__.py").is_file()
        if is_module and not entry.name.startswith("_"):
            names += modules_in(f"{room}.{entry.stem}")
    return names


def _listed(module: str) -> str:
    """A module in one line: what it is for, in the words of its docstring."""
    about = (ast.get_docstring(ast.parse(text_of(module) or "")) or "").partition("\n")[0]
    return f"- :line:`{module}` {about}"


def _chapter(module: str) -> str:
    title = f"``{module}``"
    directive = f".. automodule:: {module}\n   :members:\n   :ignore-module-all:"
    return f"{title}\n{'-' * len(title)}\n\n{directive}\n"


def _named(room: str) -> str:
    """All that a room offers, a line each: name, and what it is in the words of its docstring."""
    face = ast.parse(SOURCE.joinpath(*room.split("."), "__init__.pyi").read_text("utf-8"))
    names = [a.name for node in face.body if isinstance(node, ast.ImportFrom) for a in node.names]
    lines = "".join(f"\n   ~{meaning_of(name, room)}" for name in sorted(names, key=str.lower))
    return f".. autosummary::\n   :nosignatures:\n{lines}\n"


def _open_rooms(app: Sphinx, docname: str, source: list[str]) -> None:
    """Put a chapter for each module in the place of ``room::``, a line in that of ``list::``.

    In that of ``names::`` comes a table of what a room offers.
    """
    source[0] = re.sub(
        r"^\.\. names:: (.*)$", lambda line: _named(line[1]), source[0], flags=re.MULTILINE
    )
    for word, write in (("room", _chapter), ("list", _listed)):

        def modules(line: re.Match[str], write: Callable[[str], str] = write) -> str:
            return "\n".join(
                write(module) for room in line[1].split() for module in modules_in(room)
            )

        source[0] = re.sub(rf"^\.\. {word}:: (.*)$", modules, source[0], flags=re.MULTILINE)


def _list_methods(app: Sphinx, domain: str, kind: str, content: nodes.Element) -> None:
    """The contents of a page name its modules; those of the machine's, its methods as well.

    Every page carries the contents of all: with every method of every class they would be slow.
    """
    for signature in content.parent.findall(addnodes.desc_signature):
        if signature.get("module") not in {"evofsm.fsm.machine", "evofsm.fsm.model"}:
            signature["_toc_name"] = ""


def _skip_kernels(
    app: Sphinx, what: str, name: str, thing: Any, skip: bool, options: Any
) -> bool | None:
    """Kernels are read in the source: their arguments are a machine's own memory."""
    code = getattr(thing, "__code__", None)
    if callable(thing) and not str(getattr(thing, "__module__", None)).startswith("evofsm"):
        return True  # imported
    if code is None:
        return None
    try:
        module, first, _ = place_of(f"{thing.__module__}.{thing.__qualname__}")
    except LookupError:
        return None
    above = (text_of(module) or "").splitlines()[first - 2]
    return True if re.match(r"@(\w*kernel|register_jitable)\b", above) else None


def _as_written(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, shown: str, answer: str
) -> tuple[str, str | None] | None:
    """Signatures with the annotations as they stand in the source, not as they are evaluated."""
    if not shown or not callable(thing):
        return None
    signature = inspect.signature(thing)
    parameters = list(signature.parameters.values())
    if what == "method" and parameters and parameters[0].name == "self":
        signature = signature.replace(parameters=parameters[1:])
    written = stringify_signature(signature, show_return_annotation=False)
    written = re.sub(r"Annotated\[(\w+), [^\[\]]*\]", r"\1", written)  # what files hold of it
    if inspect.isclass(thing) or signature.return_annotation is signature.empty:
        return written, None
    return written, str(signature.return_annotation)


# -- Names in docstrings and annotations ---------------------------------------------------------


@cache
def imports_of(module: str) -> dict[str, str]:
    """Full names of what a module imports, or offers as the face of a room."""
    found = {}
    face = SOURCE.joinpath(*module.split("."), "__init__.pyi")
    offered = face.read_text("utf-8") if face.is_file() else ""
    for node in ast.walk(ast.parse((text_of(module) or "") + offered)):
        if isinstance(node, ast.ImportFrom) and node.level == 1:
            home = ".".join([module, *filter(None, [node.module])])
            found |= {a.name: f"{home}.{a.name}" for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {a.asname or a.name: f"{node.module}.{a.name}" for a in node.names}
        elif isinstance(node, ast.Import):
            found |= {a.asname or a.name: a.name for a in node.names}
    return found


def meaning_of(target: str, module: str, owner: str = "") -> str | None:
    """Full name of what a module calls so, or its class ``owner``; None if it knows no such name.

    Names that packages pass on are followed to where they are defined.
    """
    if text_of(module) is None:
        return None
    for name in (f"{owner}.{target}", target):
        if name in lines_of(module):
            return f"{module}.{name}"
    head, dot, rest = target.partition(".")
    if head in imports_of(module):
        full = imports_of(module)[head]
        home, _, name = full.rpartition(".")
        if full.startswith("evofsm") and text_of(full) is None:
            full = meaning_of(name, home) or full
        return f"{full}{dot}{rest}"
    if text_of(f"{module}.{head}") is not None:
        return f"{module}.{target}" if not rest else meaning_of(rest, f"{module}.{head}")
    return meaning_of(rest, head) if head == "evofsm" and rest and module != head else None


def _name_in_full(app: Sphinx, doctree: nodes.document) -> None:
    """Make every name in the reference mean what it means in its module; others stay text."""
    for pending in list(doctree.findall(addnodes.pending_xref)):
        if pending.get("refdomain") != "py":
            continue
        module = pending.get("py:module") or ""
        target = pending["reftarget"].lstrip("~.")
        meaning = meaning_of(target, module, pending.get("py:class") or "")
        if meaning is None and target.partition(".")[0] in imports_of("evofsm"):
            meaning = meaning_of(target, "evofsm")
        if meaning is not None and meaning.startswith("evofsm"):
            pending["reftarget"] = meaning
        elif not target.startswith("evofsm."):  # of another package, a parameter, a command
            pending.replace_self(pending.children)


def _trim(app: Sphinx, doctree: nodes.document) -> None:
    """Blocks end with their last line; doctests need an empty one, readers do not."""
    for block in doctree.findall(nodes.literal_block):
        text = block.astext().rstrip()
        block.rawsource, block.children = text, [nodes.Text(text)]


def _lead_to_source(
    app: Sphinx, env: Any, node: addnodes.pending_xref, content: nodes.Element
) -> nodes.Element | None:
    """What is ours, but not in the reference, is read in the source."""
    if node.get("refdomain") != "py":
        return None
    try:
        module, line, _ = place_of(node["reftarget"])
    except LookupError:
        return None
    link = _link_to(node["refdoc"], app, module, line)
    link += content
    return link


def setup(app: Sphinx) -> dict[str, bool]:
    """Register all of it."""
    sources = Sources()
    app.add_html_math_renderer("mathml", (_inline_math, None), (_display_math, None))
    app.add_role("line", Line())
    app.connect("source-read", _open_rooms)
    app.connect("doctree-read", _link_files)
    app.connect("doctree-resolved", _link_signatures)
    app.connect("builder-inited", sources.begin)
    app.connect("build-finished", sources.write)
    app.connect("object-description-transform", _list_methods)
    app.connect("autodoc-skip-member", _skip_kernels)
    app.connect("autodoc-process-signature", _as_written)
    app.connect("doctree-read", _name_in_full)
    app.connect("doctree-read", _trim)
    app.connect("missing-reference", _lead_to_source)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

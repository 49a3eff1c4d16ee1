"""Draws the house from its imports, counts its rooms, holds them to their budgets: `make house`.

Rooms are the folders and files at the top of the package; their order stands in `pyproject.toml`
under ``tool.importlinter``, their budgets under ``tool.house``. It fails where a room imports from
one above it or uses its private names, where modules import in a circle, where a class name stands
in three rooms or a private constant's in three modules, where a local is named by a pronoun or a
participle, where what a face offers takes three parameters or more and does not say what they are,
and where a room has more lines, files or public names than its budget. With ``--draw`` the picture
in CONTRIBUTING.md is drawn anew; with ``--lower`` budgets fall to what is there and 2 %, as at each
release.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "evofsm"
PAGE = ROOT / "CONTRIBUTING.md"
PROJECT = ROOT / "pyproject.toml"
BEGIN, END = "<!-- house: begin -->", "<!-- house: end -->"
SLACK = 1.02

# Parameters from which on a docstring says what each is.
_MANY = 3
# Of named tuples; with an underscore lest they hide a field.
_PUBLIC = {"_asdict", "_fields", "_make", "_replace"}
_PRONOUN = re.compile(
    "all|any|both|each|he|her|him|his|it|its|mine|none|one|others?|ours|own|same|she|some|something"
    "|such|that|theirs?|them|these|they|this|those|us|we|what|which|who|whom"
)
# By their last word, if that is no noun as well; a flag is or has something, and some are
# words of Gymnasium and of this project.
_PARTICIPLE = re.compile(
    r"(?!(n|is|has|was|are|may|can)_)(.*_)?"
    "(?!(leader_|wind_)?speed|seed|need|feed|string|ring|warning|heading|spacing|setting|encoding"
    "|braking|failed|terminated|truncated|guarded|executed|proposed)"
    r"([a-z]+(ed|ing)|known|shown|given|told|taken|seen|held|kept|left|found|made|gone|driven|begun"
    "|said|meant|spent|lost|sent|written|drawn|chosen|broken|hidden|passed|past|done|put|understood)"
)

Arrows = Mapping[str, set[str]]
Trees = Mapping[str, ast.Module]


# -- What there is ----------------------------------------------------------------------------


def room_of(module: str) -> str:
    """The room that a module is in; empty for the package itself."""
    return module.partition(".")[2].partition(".")[0]


def files_of(room: str) -> list[Path]:
    """All files of a room, also those that are no Python; without caches."""
    path = PACKAGE / room
    if not path.is_dir():
        return [path.with_suffix(".py")]
    return [
        file
        for file in sorted(path.rglob("*"))
        if file.is_file() and "__pycache__" not in file.parts
    ]


def lines_in(files: Iterable[Path]) -> int:
    """Lines of Python in some files."""
    return sum(len(file.read_text("utf-8").splitlines()) for file in files if file.suffix == ".py")


def public_names(room: str) -> set[str]:
    """Names that a room offers to users: those of its faces (`__init__.pyi`)."""
    return {
        alias.asname or alias.name
        for face in (PACKAGE / room).rglob("__init__.pyi")
        for node in ast.walk(ast.parse(face.read_text("utf-8")))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def words_in(folder: Path) -> int:
    """Words of the pages in a folder, and of the README."""
    pages = [page for kind in ("*.md", "*.rst") for page in folder.rglob(kind)]
    return sum(len(page.read_text("utf-8").split()) for page in [*pages, ROOT / "README.md"])


def commands() -> int:
    """Commands of ``evofsm``."""
    from evofsm.cli.app import application

    app = application()
    return len(app.registered_commands) + len(app.registered_groups)


def sources(package: Path = PACKAGE) -> dict[str, ast.Module]:
    """Every module of a package by its dotted name."""
    found = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package.parent).with_suffix("").parts
        found[".".join(parts).removesuffix(".__init__")] = ast.parse(path.read_text("utf-8"))
    return found


# -- How it hangs together --------------------------------------------------------------------


def floors() -> list[set[str]]:
    """The rooms of each floor, from the ground up."""
    settings = tomllib.loads(PROJECT.read_text("utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    return [{room.strip() for room in layer.split("|")} for layer in reversed(layers)]


def arrows_between() -> Arrows:
    """The modules that each module imports, imports for types included."""
    graph = grimp.build_graph(PACKAGE.name, exclude_type_checking_imports=False, cache_dir=None)
    return {
        module: set(graph.find_modules_directly_imported_by(module))
        for module in graph.modules
        if module != PACKAGE.name
    }


def rooms_between(modules: Arrows) -> Arrows:
    """The rooms that each room imports from."""
    rooms: dict[str, set[str]] = defaultdict(set)
    for module, others in modules.items():
        rooms[room_of(module)] |= {room_of(other) for other in others} - {room_of(module), ""}
    return rooms


def circles(arrows: Arrows) -> list[list[str]]:
    """Groups in which each can be reached from each other one."""
    reached = {node: set(others) for node, others in arrows.items()}
    grown = True
    while grown:
        grown = False
        for node, others in reached.items():
            further = set().union(others, *(reached.get(other, ()) for other in others))
            grown |= further != others
            reached[node] = further
    inside = [node for node in sorted(reached) if node in reached[node]]
    return [
        group
        for node in inside
        if (
            group := [
                other for other in inside if other in reached[node] and node in reached[other]
            ]
        )
        and group[0] == node
    ]


def arrows_up(rooms: Arrows) -> list[str]:
    """Imports from a room that is not on a lower floor."""
    floor = {room: number for number, each in enumerate(floors()) for room in each}
    return [
        f"{room} -> {other}"
        for room in sorted(rooms)
        for other in sorted(rooms[room])
        if floor[other] >= floor[room]
    ]


def private_names(trees: Trees) -> Iterator[str]:
    """Names with an underscore that only other rooms define."""
    defined: dict[str, set[str]] = defaultdict(set)
    for module, tree in trees.items():
        defined[room_of(module)] |= set(_names_defined(tree))
    ours = set().union(*defined.values())
    for module, tree in trees.items():
        for name, line in _names_used(tree):
            is_private = name.startswith("_") and not name.startswith("__")
            if is_private and name in ours - defined[room_of(module)] - _PUBLIC:
                yield f"{module}, line {line}: {name}"


def _names_defined(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.id if isinstance(node, ast.Name) else node.attr


def _names_used(tree: ast.Module) -> Iterator[tuple[str, int]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            if not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")):
                yield node.attr, node.lineno
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("evofsm"):
            yield from ((name.name, node.lineno) for name in node.names)


def repeated_classes(trees: Trees) -> list[str]:
    """Class names that stand in three rooms or more."""
    homes: dict[str, set[str]] = defaultdict(set)
    for module, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                homes[node.name].add(room_of(module))
    return [
        f"{name}: {', '.join(sorted(rooms))}" for name, rooms in homes.items() if len(rooms) > 2
    ]


def repeated_constants(trees: Trees) -> list[str]:
    """Names of private constants that stand in three modules or more."""
    homes: dict[str, set[str]] = defaultdict(set)
    for module, tree in trees.items():
        for node in tree.body:
            if isinstance(node, ast.Assign | ast.AnnAssign):
                for name in filter(re.compile(r"_[A-Z][A-Z\d_]+$").match, _names_defined(node)):
                    homes[name].add(module)
    return [
        f"{name}: {', '.join(sorted(modules))}"
        for name, modules in homes.items()
        if len(modules) > 2
    ]


def locals_named(pattern: re.Pattern[str], trees: Trees) -> Iterator[str]:
    """Locals whose names say nothing of what they hold; fields and parameters may."""
    for module, tree in trees.items():
        names = {
            (name.lineno, name.id)
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.comprehension)
            for name in ast.walk(node)
            if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store)
            if pattern.fullmatch(name.id)
        }
        yield from (f"{module}, line {line}: {name}" for line, name in sorted(names))


def offered(package: Path = PACKAGE) -> set[tuple[str, str]]:
    """Module and name of what the faces of a package offer; a whole module as that and ``*``."""
    pairs = set()
    for face in package.rglob("__init__.pyi"):
        room = ".".join(face.parent.relative_to(package.parent).parts)
        for node in ast.walk(ast.parse(face.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module is None:
                pairs |= {(f"{room}.{alias.name}", "*") for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                pairs |= {(f"{room}.{node.module}", alias.name) for alias in node.names}
    return pairs


def unexplained(faces: set[tuple[str, str]], trees: Trees) -> Iterator[str]:
    """Functions and methods that faces offer, of three parameters or more and no word of them.

    What takes the place of a base's method is explained where that is. Commands are offered by no
    face: their options have a help.
    """
    classes = {name: node for tree in trees.values() for name, node in _public(tree).items()}
    for module, tree in trees.items():
        for name, node in _public(tree).items():
            if not {(module, name), (module, "*")} & faces:
                continue
            parts = {name: node} if isinstance(node, ast.FunctionDef) else _public(node)
            for part, function in parts.items():
                places = [function, *_of_bases(node, part, classes)]
                if _n_parameters(function) >= _MANY and not any(map(_explains, places)):
                    full_name = name if function is node else f"{name}.{part}"
                    yield f"{module}, line {function.lineno}: {full_name}"


def _public(node: ast.AST) -> dict[str, ast.FunctionDef | ast.ClassDef]:
    """What a module or a class defines, by name; of overloads the last one, which is called."""
    parts = [p for p in getattr(node, "body", ()) if isinstance(p, ast.FunctionDef | ast.ClassDef)]
    return {part.name: part for part in parts if not part.name.startswith("_")}


def _of_bases(node: ast.AST, method: str, classes: Mapping[str, ast.AST]) -> Iterator[ast.AST]:
    """The methods of that name in all classes that one is derived from, near or far."""
    for base in getattr(node, "bases", ()):
        owner = classes.get(getattr(base, "id", ""))
        if owner is not None and owner is not node:
            yield from [part for name, part in _public(owner).items() if name == method]
            yield from _of_bases(owner, method, classes)


def _n_parameters(node: ast.AST) -> int:
    if not isinstance(node, ast.FunctionDef):
        return 0
    every = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
    return sum(parameter.arg not in ("self", "cls") for parameter in every)


def _explains(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef) and "Parameters\n---" in (
        ast.get_docstring(node) or ""
    )


def imports_past_a_face(trees: Trees) -> Iterator[str]:
    """Imports of studies from within a room: they see what users see."""
    for module, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and re.match(r"evofsm\.\w+\.", node.module or ""):
                yield f"{module}, line {node.lineno}: from {node.module} import ..."


# -- What is said -----------------------------------------------------------------------------


def about(room: str) -> str:
    """What a room is for, in the words of its docstring."""
    path = PACKAGE / room / "__init__.py"
    tree = ast.parse((path if path.exists() else PACKAGE / f"{room}.py").read_text("utf-8"))
    return (ast.get_docstring(tree) or "").partition("\n")[0]


def picture(rooms: Arrows) -> str:
    """The rooms floor by floor, and the arrows that no other arrows imply, for Mermaid."""
    reached: dict[str, set[str]] = {}
    for floor in floors():
        for room in floor:
            reached[room] = set().union(
                *({other} | reached.get(other, set()) for other in rooms.get(room, ()))
            )
    lines = ["```mermaid", "graph TD"]
    for floor in reversed(floors()):
        for room in sorted(floor):
            direct = rooms.get(room, set())
            needed = direct - set().union(*(reached[other] for other in direct))
            lines += [f"    {room} --> {other}" for other in sorted(needed)]
    lines += ["```", "", "| room | what happens there |", "|---|---|"]
    for floor in reversed(floors()):
        lines += [f"| `{room}` | {about(room)} |" for room in sorted(floor)]
    return "\n".join(lines)


def page_with(drawn: str) -> str:
    """CONTRIBUTING.md with a picture in its place."""
    text = PAGE.read_text("utf-8")
    head, rest = text.split(BEGIN)
    return f"{head}{BEGIN}\n{drawn}\n{END}{rest.split(END)[1]}"


def counted() -> dict[str, dict[str, int]]:
    """Lines, files and public names of each room, and what is counted outside of rooms."""
    rooms = [room for floor in reversed(floors()) for room in sorted(floor)]
    files = {room: files_of(room) for room in rooms}
    found = {
        "lines": {room: lines_in(files[room]) for room in rooms},
        "files": {room: len(files[room]) for room in rooms},
        "names": {room: len(public_names(room)) for room in rooms},
    }
    faces = [PACKAGE / name for name in ("__init__.py", "__init__.pyi", "py.typed")]
    found["all"] = {
        "src": sum(found["lines"].values()) + lines_in(faces),
        "files": sum(found["files"].values()) + len(faces),
        "names": sum(found["names"].values()),
        "commands": commands(),
        "studies": lines_in((ROOT / "studies").rglob("*.py")),
        "tests": lines_in((ROOT / "tests").rglob("*.py")),
        "words": words_in(ROOT / "docs"),
    }
    return found


def lower(found: Mapping[str, Mapping[str, int]], budgets: Mapping[str, Mapping[str, int]]) -> None:
    """Write budgets that fall to what is there and 2 %; none is raised."""
    text = PROJECT.read_text("utf-8")
    for table, entries in budgets.items():
        for name, budget in entries.items():
            needed = found[table].get(name, 0)
            least = (
                round(SLACK * needed)
                if table == "lines" or name in ("src", "tests", "studies", "words")
                else needed
            )
            head, rest = text.split(f"[tool.house.{table}]\n")
            rest = re.sub(
                rf"^{name} = \d+", f"{name} = {min(budget, least)}", rest, count=1, flags=re.M
            )
            text = f"{head}[tool.house.{table}]\n{rest}"
    PROJECT.write_text(text, "utf-8")


def report(name: str, found: Iterable[object], most: int = 0) -> bool:
    """Print how many there are of what should not be, and them if they are more than allowed."""
    all_found = list(found)
    print(f"{len(all_found):7,}  {name} (at most {most})")
    if len(all_found) <= most:
        return False
    for one in all_found:
        print(f"         {one}")
    return True


def main() -> int:
    """Print the house; 1 where something is not as it should be."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draw", action="store_true", help="draw the picture anew")
    parser.add_argument("--lower", action="store_true", help="lower budgets to what is there")
    arguments = parser.parse_args()
    modules, trees, found = arrows_between(), sources(), counted()
    rooms = rooms_between(modules)
    drawn = page_with(picture(rooms))
    budgets = tomllib.loads(PROJECT.read_text("utf-8"))["tool"]["house"]
    faults = budgets.pop("faults")
    if arguments.draw:
        PAGE.write_text(drawn, "utf-8")
    if arguments.lower:
        lower(found, budgets)
    print("  lines  files  names  room")
    for room, lines in found["lines"].items():
        others = ", ".join(sorted(rooms[room]))
        print(f"{lines:7,} {found['files'][room]:6} {found['names'][room]:6}  {room:<9} {others}")
    for what, count in found["all"].items():
        print(f"{count:7,}  {what} (at most {budgets['all'][what]:,})")
    over = [
        f"{name}: {found[table][name]:,} {table}, {budget:,} allowed"
        for table, entries in budgets.items()
        for name, budget in entries.items()
        if found[table].get(name, 0) > budget
    ]
    stale = [PAGE.name] if drawn != PAGE.read_text("utf-8") else []
    studies = sources(ROOT / "studies")
    wrong = [
        report("over budget", over),
        report("circles", [*circles(rooms), *circles(modules)]),
        report("arrows up", arrows_up(rooms)),
        report("private names across rooms", private_names(trees)),
        report("class names in three rooms", repeated_classes(trees), faults["classes"]),
        report("constants' names in three modules", repeated_constants(trees)),
        report("locals named by pronouns", locals_named(_PRONOUN, trees)),
        report("locals named by participles", locals_named(_PARTICIPLE, trees)),
        report("functions that do not say what they take", unexplained(offered(), trees)),
        report("imports of studies past a face", imports_past_a_face(studies), faults["past"]),
        report("pictures that are out of date", stale),
    ]
    return int(any(wrong))


if __name__ == "__main__":
    sys.exit(main())

"""Draws the house from its imports, and fails where it is not as it should be: `make house`.

Rooms are the folders and files at the top of the package. A room's face is its `__init__.pyi`; what
is not in it is private to the room. The order of the rooms stands in `pyproject.toml`, where
import-linter reads it too. With ``--write`` the picture in CONTRIBUTING.md is drawn anew.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import grimp

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "evofsm"
PAGE = ROOT / "CONTRIBUTING.md"
BEGIN, END = "<!-- house: begin -->", "<!-- house: end -->"

MOST_ROOMS = 14
MOST_PLACES = 8

# Of named tuples; with an underscore lest they hide a field.
_PUBLIC = {"_asdict", "_fields", "_make", "_replace"}
_IMPORT = re.compile(r"^(?:\s|>>> |\.\.\. )*(?:from|import) (evofsm[\w.]*)", re.MULTILINE)

Arrows = Mapping[str, set[str]]


class Use(NamedTuple):
    """Something of another room that is not in its face."""

    module: str
    line: int
    what: str

    def __str__(self) -> str:
        return f"{self.module}, line {self.line}: {self.what}"


def room_of(module: str) -> str:
    """The room that a module is in; empty for the package itself."""
    return module.partition(".")[2].partition(".")[0]


def arrows_between(graph: grimp.ImportGraph) -> Arrows:
    """The modules that each module imports, imports for types included."""
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
    """Groups in which each can be reached from each other one (Tarjan 1972)."""
    found: list[list[str]] = []
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(arrows.get(node, ())):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            group = stack[stack.index(node) :]
            del stack[stack.index(node) :]
            if len(group) > 1:
                found.append(sorted(group))

    sys.setrecursionlimit(10_000)
    for node in sorted(arrows):
        if node not in index:
            visit(node)
    return found


def floors() -> list[set[str]]:
    """The rooms of each floor, from the ground up."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    layers = settings["tool"]["importlinter"]["contracts"][0]["layers"]
    return [{room.strip() for room in layer.split("|")} for layer in reversed(layers)]


def arrows_up(rooms: Arrows) -> list[str]:
    """Imports from a room that is not on a lower floor."""
    floor = {room: number for number, each in enumerate(floors()) for room in each}
    return [
        f"{room} -> {other}"
        for room in sorted(rooms)
        for other in sorted(rooms[room])
        if floor[other] >= floor[room]
    ]


def sources() -> dict[str, ast.Module]:
    """Every module of the package by its dotted name."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        found[".".join(parts).removesuffix(".__init__")] = ast.parse(path.read_text("utf-8"))
    return found


def imports_past_a_face(trees: Mapping[str, ast.Module]) -> Iterator[Use]:
    """Imports from within another room."""
    for module, tree in trees.items():
        for node in ast.walk(tree):
            if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("evofsm"):
                continue
            home = node.module or ""
            if room_of(home) not in ("", room_of(module)) and home.count(".") > 1:
                yield Use(module, node.lineno, f"from {home} import ...")


def private_names(trees: Mapping[str, ast.Module]) -> Iterator[Use]:
    """Names with an underscore that only other rooms define."""
    defined: dict[str, set[str]] = defaultdict(set)
    for module, tree in trees.items():
        defined[room_of(module)] |= set(_names_defined(tree))
    ours = set().union(*defined.values())
    for module, tree in trees.items():
        for name, line in _names_used(tree):
            is_private = name.startswith("_") and not name.startswith("__")
            if is_private and name in ours - defined[room_of(module)] - _PUBLIC:
                yield Use(module, line, name)


def _names_defined(tree: ast.Module) -> Iterator[str]:
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


def places() -> Counter[str]:
    """How often README, docs and examples import from each place."""
    files = [ROOT / "README.md"]
    for folder, kinds in (("docs", ("*.md", "*.rst")), ("examples", ("*.py",))):
        files += [path for kind in kinds for path in sorted((ROOT / folder).rglob(kind))]
    return Counter(
        found for path in files for found in _IMPORT.findall(path.read_text(encoding="utf-8"))
    )


def lines_of(room: str) -> int:
    """Lines of Python in a room."""
    path = PACKAGE / room
    files = path.rglob("*.py") if path.is_dir() else [path.with_suffix(".py")]
    return sum(len(file.read_text("utf-8").splitlines()) for file in files)


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


def report(name: str, found: Iterable[object], most: int) -> bool:
    """Print how many there are of what, and those that are too many; whether there are."""
    all_found = list(found)
    print(f"{len(all_found):6,}  {name} (at most {most})")
    if len(all_found) <= most:
        return False
    for one in all_found:
        print(f"        {one}")
    return True


def main() -> int:
    """Print the house; 1 where something is not as it should be."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="draw the picture anew")
    arguments = parser.parse_args()
    graph = grimp.build_graph(PACKAGE.name, exclude_type_checking_imports=False, cache_dir=None)
    modules, trees = arrows_between(graph), sources()
    rooms = rooms_between(modules)
    drawn = page_with(picture(rooms))
    if arguments.write:
        PAGE.write_text(drawn, "utf-8")
    for floor in reversed(floors()):
        for room in sorted(floor):
            print(f"{lines_of(room):6,}  {room:<9} {', '.join(sorted(rooms[room]))}")
    print(f"{sum(lines_of(room) for floor in floors() for room in floor):6,}  lines of Python")
    past = [str(use) for use in imports_past_a_face(trees)]
    stale = [PAGE.name] if drawn != PAGE.read_text("utf-8") else []
    wrong = [
        report("rooms at the top", [room for floor in floors() for room in floor], MOST_ROOMS),
        report("circles of rooms", circles(rooms), 0),
        report("circles of modules", circles(modules), 0),
        report("arrows up", arrows_up(rooms), 0),
        report("imports past a face", past, 0),
        report("private names across rooms", private_names(trees), 0),
        report("places that README, docs and examples import from", places(), MOST_PLACES),
        report("pictures that are out of date", stale, 0),
    ]
    return int(any(wrong))


if __name__ == "__main__":
    sys.exit(main())

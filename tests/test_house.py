"""What `make house` looks for is found, and faces offer what they say."""

import ast
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "evofsm"
FACES = sorted(PACKAGE.rglob("__init__.pyi"))


def test_locals_that_are_no_nouns_and_constants_of_three_modules_are_found(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools")
    house = import_module("house")
    text = """_SAME, _OF_ALL = 1, 2
class Pair(NamedTuple):
    one: int
def count(own):
    rows = [each for each in own]
    for row, (k, what) in rows:
        one = row.one = k
        leader_speed = last_seen = is_seen = k"""
    trees = {name: ast.parse(text) for name in "abc"} | {"c": ast.parse("_SAME: int = 1")}
    assert house.repeated_constants(trees) == ["_SAME: a, b, c"]
    found = ["line 5: each", "line 6: what", "line 7: one"]
    pronouns = [*house.locals_named(house._PRONOUN, trees)]
    assert pronouns == [f"{module}, {name}" for module in "ab" for name in found]
    participles = [*house.locals_named(house._PARTICIPLE, trees)]
    assert participles == [f"{module}, line 8: last_seen" for module in "ab"]


@pytest.mark.parametrize("face", FACES, ids=lambda face: face.parent.name)
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

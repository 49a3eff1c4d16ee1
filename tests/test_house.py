"""Faces offer what they say; `make house` looks for the rest."""

from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "evofsm"
FACES = sorted(PACKAGE.rglob("__init__.pyi"))


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

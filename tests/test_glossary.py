"""The glossary names things that exist."""

import importlib
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "glossary.md"
NAMES = re.findall(r"`((?:evofsm|studies)[\w.]+)` \|$", PAGE.read_text("utf-8"), re.MULTILINE)


def look_up(name):
    """What a dotted name stands for: modules first, then attributes."""
    root, *parts = name.split(".")
    thing = importlib.import_module(root)
    for place, part in enumerate(parts):
        module = ".".join([root, *parts[: place + 1]])
        try:
            thing = getattr(thing, part)
        except AttributeError:
            if part in getattr(thing, "__dataclass_fields__", {}):
                return thing.__dataclass_fields__[part]
            thing = importlib.import_module(module)
    return thing


@pytest.mark.parametrize("name", NAMES)
def test_a_word_has_the_name_in_code_that_the_glossary_gives(name):
    pytest.importorskip("scipy")
    assert look_up(name) is not None


def test_every_word_has_a_name_in_code():
    words = [line for line in PAGE.read_text("utf-8").splitlines() if line.startswith("| **")]
    assert len(words) == len(NAMES)

"""The glossary names things that exist."""

import re
from pathlib import Path
from pkgutil import resolve_name

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "glossary.md"
NAMES = re.findall(r"`((?:evofsm|studies)[\w.]+)` \|$", PAGE.read_text("utf-8"), re.MULTILINE)


@pytest.mark.parametrize("name", NAMES)
def test_a_word_has_the_name_in_code_that_the_glossary_gives(name):
    pytest.importorskip("scipy")
    owner, _, last = name.rpartition(".")
    fields = getattr(resolve_name(owner), "__dataclass_fields__", {})
    assert last in fields or resolve_name(name) is not None


def test_every_word_has_a_name_in_code():
    words = [line for line in PAGE.read_text("utf-8").splitlines() if line.startswith("| **")]
    assert len(words) == len(NAMES)

"""What the package exports is documented, with an example that runs."""

import doctest
import inspect
import re
from enum import Enum

import pytest

import evofsm


def methods(cls):
    """Public methods that our own classes define, by name: no property, nothing inherited."""
    for base in cls.__mro__:
        if base.__module__.partition(".")[0] == evofsm.__name__:
            for name in vars(base):
                method = getattr(cls, name)
                if not (name.startswith("_") or isinstance(method, Enum)) and callable(method):
                    yield name, method


def sections(thing):
    return re.findall(r"^([A-Z]\w+)\n-+$", inspect.cleandoc(thing.__doc__ or ""), re.MULTILINE)


def missing(thing):
    """Sections that the docstring of a class, function or method lacks, or leaves empty.

    What it returns stands in its first line, with the shape. A method may leave its example to its
    class, and tell there of the one thing that it is given.
    """
    is_method = not inspect.isclass(thing) and "." in thing.__qualname__
    lacks = set() if is_method else {"Examples"}
    given = () if inspect.isclass(thing) else set(inspect.signature(thing).parameters) - {"self"}
    if len(given) > is_method:
        lacks.add("Parameters")
    lacks -= set(sections(thing))
    if not (is_method or doctest.DocTestParser().get_examples(thing.__doc__ or "")):
        lacks.add("Examples")
    return lacks


PUBLIC = {name: getattr(evofsm, name) for name in evofsm.__all__}
DOCUMENTED = PUBLIC | {
    f"{owner}.{name}": method
    for owner, cls in PUBLIC.items()
    if inspect.isclass(cls)
    for name, method in methods(cls)
}


@pytest.mark.parametrize("name", DOCUMENTED)
def test_a_public_name_has_its_sections_and_an_example(name):
    assert not missing(DOCUMENTED[name])

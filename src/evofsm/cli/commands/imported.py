"""What somebody else wrote, by the name ``module:Name``."""

from __future__ import annotations

import importlib
import sys
from typing import Any


def imported(name: str) -> Any:
    """A class, function or instance of a module, found in the present folder too.

    The module is run: name only code that you trust.

    Parameters
    ----------
    name : str
        ``module:Name``, or ``module:Name.of_something_in_it``.

    Raises
    ------
    ValueError
        If it is no such name, there is no such module, or nothing of that name in it.

    Examples
    --------
    >>> imported("math:pi"), imported("evofsm.fsm:Novelty").__name__
    (3.141592653589793, 'Novelty')
    >>> imported("math.pi")
    Traceback (most recent call last):
        ...
    ValueError: 'math.pi' names nothing; write module:Name
    """
    module_name, colon, path = name.partition(":")
    if not (module_name and colon and path):
        raise ValueError(f"{name!r} names nothing; write module:Name")
    if "" not in sys.path:
        sys.path.insert(0, "")  # as `python -m` does
    try:
        thing: Any = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise ValueError(f"{module_name}: {error} (is it in this folder, or installed?)") from error
    for part in path.split("."):
        if not hasattr(thing, part):
            raise ValueError(f"{module_name} has no {path!r}")
        thing = getattr(thing, part)
    return thing

"""Options that several commands share, and what commands do with what was typed."""

from __future__ import annotations

import importlib
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from evofsm.extras import install

if TYPE_CHECKING:
    from evofsm.driving import Family


#: Where to drive.
World = Literal["sumo", "kinematic"]
#: What a judge was given.
Judge = Literal["kinematic", "learnt"]
#: How far a guard goes, as `evofsm.guard.Mode`.
ModeName = Literal["off", "shadow", "advise", "act"]


def option(about: str, *names: str, **limits: Any) -> Any:
    """An option by its help; with names in place of the parameter's, and bounds of a number."""
    return typer.Option(*names, help=about, **limits)


def argument(about: str, **further: Any) -> Any:
    """An argument by its help."""
    return typer.Argument(help=about, **further)


Json = Annotated[
    bool, option("Print one JSON document; states and actions count from 0.", "--json")
]
Saved = Annotated[
    Path,
    argument(
        "A machine, a model or a guard that was saved, a folder of drive --out, or a log of drive "
        "--mcap."
    ),
]
Seed = Annotated[int, option("Seed of all random draws.", min=0)]
InWorld = Annotated[World, option("SUMO itself, or the same motion in closed form.")]
ByJudge = Annotated[
    Judge, option("Given how cars follow each other, or nothing but which episodes failed.")
]
Tolerance = Annotated[
    float, option("Share of hard brakes (learnt: of disturbances) that need not be survived.")
]
Switches = Annotated[str, option("noise, delay, actuator, jerk, third_car; with commas.", "--with")]


def require(**extras: str) -> None:
    """Refuse before the long work what lacks packages after it; all that lack at once."""
    if lacking := [package for package in extras if find_spec(package) is None]:
        command = install(*dict.fromkeys(["cli", *(extras[package] for package in lacking)]))
        raise ModuleNotFoundError(f"this needs {' and '.join(lacking)}: {command}")


def require_world(world: World, **extras: str) -> None:
    """The same for a drive: SciPy is for SUMO's distributions and exact intervals."""
    require(scipy="study", **({"libsumo": "sumo"} if world == "sumo" else {}), **extras)


def imported(name: str) -> Any:
    """A class, function or instance by its name ``module:Name``, found in the present folder too.

    >>> imported("math:pi"), imported("math.pi")
    Traceback (most recent call last):
        ...
    ValueError: 'math.pi' names nothing; write module:Name
    """
    module, _, path = name.partition(":")
    if not (module and path):
        raise ValueError(f"{name!r} names nothing; write module:Name")
    if "" not in sys.path:
        sys.path.insert(0, "")  # as `python -m` does
    try:
        thing: Any = importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ValueError(f"{module}: {error} (is it in this folder, or installed?)") from error
    for part in path.split("."):
        if not hasattr(thing, part):
            raise ValueError(f"{module} has no {path!r}")
        thing = getattr(thing, part)
    return thing


def split_names(text: str) -> list[str]:
    """Names that were given with commas between them."""
    return [name.strip() for name in text.split(",") if name.strip()]


def family_of(name: str, switches: str) -> Family:
    """The family of this name or file, with the switches."""
    from evofsm.driving import load_family

    return load_family(name).with_switches(split_names(switches))

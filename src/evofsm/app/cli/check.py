"""`evofsm check`."""

from __future__ import annotations

import importlib
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Any

from evofsm.app.cli.common import plain_errors, print_json

with suppress(ModuleNotFoundError):
    import typer

if TYPE_CHECKING:
    from evofsm.checks import Kind, Result


@plain_errors
def check(
    name: Annotated[
        str,
        typer.Argument(
            help="module:Class, module:instance, or module:function that makes one.",
            show_default=False,
        ),
    ],
    kind: Annotated[
        str | None,
        typer.Option(
            help="machine, fleet, model, rule, reviser, controller or measure; without it, "
            "what its methods tell.",
            show_default=False,
        ),
    ] = None,
    make: Annotated[
        str | None,
        typer.Option(
            help="How to make it, in Python with the module's names: 'MyRule(radius=2.0)'.",
            show_default=False,
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the results as one JSON document.")
    ] = False,
) -> None:
    """Hold a class of your own against the contract of its kind.

    It imports the module, from the present folder too, and makes the class: run it on code that
    you trust. Ends with 1 where a check failed.
    """
    from evofsm.checks import Outcome, kind_of
    from evofsm.checks import check as run_checks

    thing = _thing(name, make)
    chosen = kind_of(thing) if kind is None else _kind(kind)
    results = run_checks(thing, chosen)
    if as_json:
        print_json([{**result._asdict(), "outcome": result.outcome.value} for result in results])
    else:
        _print(name, chosen, results)
    if any(result.outcome is Outcome.FAILED for result in results):
        raise typer.Exit(1)


def _thing(name: str, make: str | None) -> Any:
    """What a name says, imported; or a function that makes it as told."""
    module_name, colon, path = name.partition(":")
    if not colon or not path:
        raise ValueError(f"{name!r} names nothing to check; write module:Class")
    sys.path.insert(0, "")  # as `python -m` does
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise ValueError(f"{module_name}: {error} (is it in this folder, or installed?)") from error
    thing: Any = module
    for part in path.split("."):
        if not hasattr(thing, part):
            raise ValueError(f"{module_name} has no {path!r}")
        thing = getattr(thing, part)
    if make is None:
        return thing
    code = compile(make, "--make", "eval")
    return lambda: eval(code, vars(module))


def _kind(name: str) -> Kind:
    from evofsm.checks import Kind

    if name not in (names := [kind.value for kind in Kind]):
        raise ValueError(f"--kind is {name!r}; it must be one of {', '.join(names)}")
    return Kind(name)


def _print(name: str, kind: Kind, results: list[Result]) -> None:
    """A line for each check; what is wrong below its name."""
    from rich.padding import Padding

    from evofsm.app.text.columns import console
    from evofsm.checks import Outcome

    screen = console()
    screen.print(f"{name}, held against the contract of a {kind.value}", soft_wrap=True)
    for result in results:
        screen.print(f"  {result.outcome.value:7}  {result.check}")
        if result.outcome is not Outcome.PASSED:
            screen.print(Padding(result.message, (0, 0, 0, 11)))
    counts = {outcome: sum(r.outcome is outcome for r in results) for outcome in Outcome}
    text = ", ".join(f"{count} {outcome.value}" for outcome, count in counts.items() if count)
    screen.print(f"{len(results)} checks: {text}")

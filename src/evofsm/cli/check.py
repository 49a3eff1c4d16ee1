"""`evofsm check`."""

from __future__ import annotations

from typing import Annotated

from evofsm.cli.options import Json, argument, imported
from evofsm.cli.show import print_json, say, show


def check(
    name: Annotated[str, argument("module:Class, module:instance, or a function that makes one.")],
    as_json: Json = False,
) -> int:
    """Check a class of your own against the contract of its kind.

    A state rule, a reviser, a controller or a judge; its methods tell which. The module is
    imported, from the present folder too, so that its code is run: check code that you trust. Ends
    with 1 if a check fails.
    """
    from rich.padding import Padding

    from evofsm.guard.check import check_results, kind_of

    part = imported(name)
    kind, results = kind_of(part), check_results(part)
    failed = sum(not result.passed for result in results)
    if as_json:
        print_json(results)
    else:
        say(f"{name}, checked against the contract of a {kind}")
        for result in results:
            say(f"  {'passed' if result.passed else 'failed'}  {result.check}")
            if result.message:
                show(Padding(result.message, (0, 0, 0, 10)))
        say(f"{len(results)} checks: {len(results) - failed} passed, {failed} failed")
    return int(failed > 0)

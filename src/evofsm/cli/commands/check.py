"""`evofsm check`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from evofsm.cli.commands.common import print_json
from evofsm.cli.commands.declared import argument, option
from evofsm.cli.commands.groups import WithJson
from evofsm.cli.commands.imported import imported

if TYPE_CHECKING:
    from evofsm.checks import Kind, Result


@dataclass(frozen=True, kw_only=True)
class Check(WithJson):
    """Hold a class of your own against the contract of its kind.

    It imports the module, from the present folder too, and makes the class: run it on code that
    you trust. Ends with 1 where a check failed.
    """

    name: str = argument("module:Class, module:instance, or module:function that makes one.")
    kind: str | None = option(
        None,
        "machine, fleet, model, rule, reviser, controller, judge or measure; without it, what its "
        "methods tell.",
    )
    make: str | None = option(
        None, "How to make it, in Python with the module's names: 'MyRule(radius=2.0)'."
    )

    def run(self) -> int:
        """Print a line for each check."""
        from evofsm.checks import Outcome, check, kind_of
        from evofsm.cli.text.documents import spelled_out

        thing = self._thing()
        kind = kind_of(thing) if self.kind is None else _kind(self.kind)
        results = check(thing, kind)
        if self.as_json:
            print_json(spelled_out(results))
        else:
            _print(self.name, kind, results)
        return int(any(one.outcome is Outcome.FAILED for one in results))

    def _thing(self) -> Any:
        """What the name says, imported; or a function that makes it as told."""
        thing = imported(self.name)
        if self.make is None:
            return thing
        code = compile(self.make, "--make", "eval")
        module = sys.modules[self.name.partition(":")[0]]
        return lambda: eval(code, vars(module))


def _kind(name: str) -> Kind:
    from evofsm.checks import Kind

    if name not in (names := [kind.value for kind in Kind]):
        raise ValueError(f"--kind is {name!r}; it must be one of {', '.join(names)}")
    return Kind(name)


def _print(name: str, kind: Kind, results: list[Result]) -> None:
    """A line for each check; what is wrong below its name."""
    from rich.padding import Padding

    from evofsm.checks import Outcome
    from evofsm.cli.text.columns import console

    screen = console()
    screen.print(f"{name}, held against the contract of a {kind.value}", soft_wrap=True)
    for result in results:
        screen.print(f"  {result.outcome.value:7}  {result.check}")
        if result.outcome is not Outcome.PASSED:
            screen.print(Padding(result.message, (0, 0, 0, 11)))
    counts = {outcome: sum(r.outcome is outcome for r in results) for outcome in Outcome}
    text = ", ".join(f"{count} {outcome.value}" for outcome, count in counts.items() if count)
    screen.print(f"{len(results)} checks: {text}")

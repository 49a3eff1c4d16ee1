"""A command is a frozen dataclass: its fields are the options, its docstring is the help.

A field is written once, with its type, default, help and bounds. Options that several commands
share are fields of a base class; a field whose type is a dataclass again, such as the plan of a
study, brings the options of that one. What was asked for is then one value, which checks itself,
can be made in a test without a command line, and says what a checkpoint goes by (`settings`).

Examples
--------
>>> @dataclass(frozen=True, kw_only=True)
... class Greet(Command):
...     '''Greet somebody.'''
...
...     name: str = argument("Who is greeted.")
...     times: int = option(1, "How often.", min=1)
...
...     def run(self) -> None:
...         print(*[f"Hello, {self.name}."] * self.times)
>>> Greet(name="Ada", times=2).run()
Hello, Ada. Hello, Ada.
>>> callback(Greet).__name__, [*settings(Greet(name="Ada"))]
('greet', ['name', 'times'])
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from inspect import Parameter, Signature
from types import MappingProxyType, NoneType
from typing import Annotated, Any, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

from studies.old.shim.common import require

T = TypeVar("T")
_KEY = "evofsm"
#: In place of a default: the option or argument has to be given.
REQUIRED: Any = MISSING


@dataclass(frozen=True, kw_only=True)
class Command(ABC):
    """What a command was asked for."""

    def packages(self) -> dict[str, str]:
        """The packages that it needs, and the extra that installs each."""
        return {}

    @abstractmethod
    def run(self) -> int | None:
        """Do it; returns the exit status, None for 0."""


class _Declared(NamedTuple):
    """What the metadata of a field holds."""

    about: str
    names: tuple[str, ...] = ()
    positional: bool = False
    parse: Callable[[str], Any] | None = None
    is_required: bool = False
    is_setting: bool = True
    further: Mapping[str, Any] = MappingProxyType({})


def option(
    default: T,
    about: str,
    *,
    name: str | None = None,
    parse: Callable[[str], Any] | None = None,
    required: bool = False,
    is_setting: bool = True,
    **limits: float,
) -> T:
    """Declare a field as an option.

    Parameters
    ----------
    default : object
        A truth value makes a flag: ``--flag`` for False, ``--flag/--no-flag`` for True. With
        `REQUIRED` the field has none.
    about : str
        What the help says; the default is added to it, unless it is None.
    name : str, optional
        On the command line, where it is not the field's: ``--json``.
    parse : callable, optional
        Makes the value from the text that was typed; the default is then shown as text.
    required : bool
        Whether the command insists on it although the field has a default.
    is_setting : bool
        Whether a checkpoint of other work is told by it; False for what does not change the result.
    **limits
        ``min`` and ``max`` of a number, both allowed.
    """
    names = () if name is None else (name,)
    declared = _Declared(about, names, False, parse, required, is_setting, limits)
    made: T = field(default=default, metadata={_KEY: declared})
    return made


def argument(
    about: str, default: Any = REQUIRED, *, metavar: str | None = None, is_setting: bool = True
) -> Any:
    """Declare a field as an argument, which is typed without a name; it may be required."""
    further = {} if metavar is None else {"metavar": metavar}
    declared = _Declared(about, (), True, None, False, is_setting, further)
    return field(default=default, metadata={_KEY: declared})


def is_required(one: Field[Any]) -> bool:
    """Whether a field is an option or argument that has to be given."""
    return _KEY in one.metadata and (one.default is MISSING or one.metadata[_KEY].is_required)


def settings(options: Any) -> dict[str, Any]:
    """What determines the result: all fields but those declared with ``is_setting=False``."""
    found: dict[str, Any] = {}
    for one in fields(options):
        value = getattr(options, one.name)
        if _KEY not in one.metadata:
            found |= settings(value) if is_dataclass(value) else {}
        elif one.metadata[_KEY].is_setting:
            found[one.name] = value
    return found


def callback(command: type[Command]) -> Callable[..., int | None]:
    """The function of which Typer makes the command."""

    def run(**given: Any) -> int | None:
        made = _made(command, given)
        require(**made.packages())
        return made.run()

    run.__name__ = re.sub(r"(?<!^)(?=[A-Z])", "-", command.__name__).lower()
    run.__doc__ = command.__doc__
    parameters = [_parameter(one, hint) for one, hint in _flat(command)]
    run.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    return run


def _flat(kind: type) -> Iterator[tuple[Field[Any], Any]]:
    """The declared fields with their types, those of dataclasses within it included."""
    hints = get_type_hints(kind)
    for one in fields(kind):
        if _KEY in one.metadata:
            yield one, hints[one.name]
        elif is_dataclass(hints[one.name]):
            yield from _flat(hints[one.name])


def _made(kind: type[T], given: dict[str, Any]) -> T:
    """The dataclass with what was typed; fields that are not declared have their defaults."""
    hints, values = get_type_hints(kind), {}
    for one in fields(kind):  # type: ignore[arg-type]
        if _KEY in one.metadata:
            value, parse = given[one.name], one.metadata[_KEY].parse
            if parse is not None and value is not None:
                value = parse(value)
            values[one.name] = tuple(value) if isinstance(value, list) else value
        elif is_dataclass(hints[one.name]):
            values[one.name] = _made(hints[one.name], given)
    return kind(**values)


def _parameter(one: Field[Any], hint: Any) -> Parameter:
    """A field as Typer reads it."""
    import typer

    declared: _Declared = one.metadata[_KEY]
    default = Parameter.empty if is_required(one) else one.default
    may_lack = NoneType in get_args(hint)
    if declared.parse is not None:
        hint = str | None if may_lack else str
        default = ",".join(default) if isinstance(default, tuple) else default
    elif tuple in (get_origin(part) for part in (hint, *get_args(hint))):
        hint = list[str] | None if may_lack else list[str]
    names = declared.names
    if default is False and not names:
        names = (f"--{one.name.replace('_', '-')}",)
    told = typer.Argument if declared.positional else typer.Option
    shown = default is not None and default is not Parameter.empty
    information = told(*names, help=declared.about, show_default=shown, **declared.further)
    kind: Any = Annotated[hint, information]
    return Parameter(one.name, Parameter.KEYWORD_ONLY, default=default, annotation=kind)

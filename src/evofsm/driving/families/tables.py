"""What may stand in a family's file, and how one table is put over another."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, TypeGuard

from evofsm.driving.drivers import IDM
from evofsm.driving.families.numbers import (
    check_fixed,
    check_number,
    check_unrelated,
    is_relation_or_choice,
)
from evofsm.driving.scenarios import Behind, Body, CutIn, Leader, Scenario, Sensors

Table = Mapping[str, Any]
Check = Callable[[Any, str], None]


def _numbers_of(made: type, *others: str) -> dict[str, Check]:
    """The parameters of what is made from a table, but for some that are no numbers."""
    return {part.name: check_number for part in fields(made) if part.name not in others}


def _check_text(value: Any, where: str) -> None:
    if not isinstance(value, str):
        raise ValueError(f"{where} is {value!r}; it must be a text")


def _check_flag(value: Any, where: str) -> None:
    if not isinstance(value, bool):
        raise ValueError(f"{where} is {value!r}; it must be true or false")


def _check_seed(value: Any, where: str) -> None:
    if type(value) is not int or not 0 <= value < 2**32:
        raise ValueError(f"{where} is {value!r}; it must be a whole number from 0 to 2**32 - 1")


def _check_pairs(second: Check) -> Check:
    """Pairs of a time, and something else."""

    def check(value: Any, where: str) -> None:
        pairs = value if isinstance(value, list) else [value]
        for pair in pairs:
            if not (isinstance(pair, list) and len(pair) == 2):
                raise ValueError(f"{where} is {value!r}; it must be a list of pairs [time, what]")
            check_number(pair[0], where)
            second(pair[1], where)

    return check


#: No family needs a longer file [bytes].
LONGEST = 1 << 20
_ANY = "*"  # stands for names that the file chooses

#: What may be put over another table: by a variant, a shift, a switch.
CHANGES: Table = {
    "limits": {"decel": check_fixed, "leader_decel": check_fixed},
    "values": {_ANY: check_unrelated},
    "scenario": _numbers_of(Scenario, "leader", "body", "sensors", "behind"),
    "leader": {
        "driver": _check_text,
        **_numbers_of(Leader, "driver", "waves", "cut_in"),
        "waves": _check_pairs(check_number),
        "traffic": dict.fromkeys(
            ("fast", "slow", "accel", "decel", "cruise", "pause"), check_number
        ),
        "cut_in": _numbers_of(CutIn),
    },
    "follower": {
        "driver": _check_text,
        "changes": _check_pairs(_check_text),
        "lapses": {
            "driver": _check_text,
            **dict.fromkeys(("count", "start", "duration"), check_number),
        },
    },
    "body": _numbers_of(Body),
    "sensors": {**_numbers_of(Sensors), "seed": _check_seed},
    "behind": {"driver": _check_text, **_numbers_of(Behind, "driver")},
    "drivers": {_ANY: _numbers_of(IDM)},
}
#: What else a family's file may hold.
LAYOUT: Table = {
    "about": _check_text,
    "interval": check_fixed,
    "actions": {
        **dict.fromkeys(("low", "high", "width"), check_fixed),
        "closed": _check_text,
    },
    **CHANGES,
    "in_turn": _check_flag,
    "variant": [{"name": _check_text, "about": _check_text, **CHANGES}],
    "shift": CHANGES,
}
#: What it must hold; the rest is asked for by what is made from it.
NEEDED = ("about", "interval", "actions", "limits", "scenario", "leader", "follower", "drivers")
SWITCH_LAYOUT: Table = {_ANY: CHANGES}


def is_json(source: str) -> bool:
    """Whether a file of this name is read as JSON, and not as TOML."""
    return source.lower().endswith(".json")


def parse(text: bytes, source: str, layout: Table) -> Table:
    """Read a file's text, and refuse what the layout does not know."""
    if len(text) > LONGEST:
        raise ValueError(f"{source} has more than {LONGEST:,} bytes; this is no family")
    form, read = ("JSON", json.loads) if is_json(source) else ("TOML", tomllib.loads)
    try:
        tables = read(text.decode("utf-8"))
    except (ValueError, RecursionError) as error:  # TOMLDecodeError and others are ValueErrors
        raise ValueError(f"{source} is not {form}: {error}") from error
    if not isinstance(tables, dict):
        raise ValueError(f"{source} holds no table, as a family's file does")
    _check(tables, layout, source, "")
    return tables


def _check(tables: Table, layout: Table, source: str, prefix: str) -> None:
    for name, value in tables.items():
        key = f"{prefix}{name}"
        known = layout.get(name, layout.get(_ANY))
        if known is None:
            raise ValueError(f"{source}: there is no {key!r}; known are {', '.join(layout)}")
        if _ANY in layout and name in ("of", "one_of"):
            raise ValueError(f"{source}: {key} has the name of a relation; choose another")
        match known, value:
            case [inner], list() if all(isinstance(item, dict) for item in value):
                for number, item in enumerate(value):
                    _check(item, inner, source, f"{key}[{number}].")
            case dict(), dict() if not ("of" in value and "of" not in known):
                _check(value, known, source, f"{key}.")
            case ((dict() | list()), _):
                raise ValueError(f"{source}: {key} is {value!r}; it must be a table")
            case _:
                known(value, f"{source}: {key}")


def merge_tables(tables: Table, changes: Table) -> dict[str, Any]:
    """Put changes over tables: tables are merged, all else is replaced."""
    merged = dict(tables)
    for name, value in changes.items():
        before = merged.get(name)
        if _is_table(before) and _is_table(value):
            merged[name] = merge_tables(before, value)
        else:
            merged[name] = value
    return merged


def _is_table(value: Any) -> TypeGuard[dict[str, Any]]:
    return isinstance(value, dict) and not is_relation_or_choice(value)

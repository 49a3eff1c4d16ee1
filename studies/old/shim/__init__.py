"""What the command line of before had, for studies that do not stand on `lib` yet."""

from __future__ import annotations

from evofsm.cli import imported, print_json
from studies.old.shim.columns import console, print_columns, print_table, print_words
from studies.old.shim.common import (
    ALL,
    FIRST,
    PAGE,
    command_line,
    counter,
    progress,
    require,
    split_names,
)
from studies.old.shim.declared import REQUIRED, Command, argument, is_required, option
from studies.old.shim.documents import spelled_out, to_json
from studies.old.shim.executors import in_order
from studies.old.shim.numbers import (
    NONE,
    bare_percent,
    count,
    decimals,
    interval,
    listed,
    number,
    part,
    percent,
    percents,
    seeds_text,
    span,
    within,
)
from studies.old.shim.table import Column, Table

__all__ = [
    "ALL",
    "FIRST",
    "NONE",
    "PAGE",
    "REQUIRED",
    "Column",
    "Command",
    "Table",
    "argument",
    "bare_percent",
    "command_line",
    "console",
    "count",
    "counter",
    "decimals",
    "imported",
    "in_order",
    "interval",
    "is_required",
    "listed",
    "number",
    "option",
    "part",
    "percent",
    "percents",
    "print_columns",
    "print_json",
    "print_table",
    "print_words",
    "progress",
    "require",
    "seeds_text",
    "span",
    "spelled_out",
    "split_names",
    "to_json",
    "within",
]

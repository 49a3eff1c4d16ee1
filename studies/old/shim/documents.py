"""Documents for programs: what JSON knows, and nothing else."""

from __future__ import annotations

import json
import math
from enum import Enum
from typing import Any

from evofsm.fsm.naming import visible


def to_json(document: Any) -> str:
    """A document as JSON, with null for NaN and the infinite, which JSON does not know.

    >>> print(to_json({"lead": [1.5, float("inf")]}))
    {
      "lead": [
        1.5,
        null
      ]
    }
    """
    return visible(json.dumps(_known(document), allow_nan=False, ensure_ascii=False, indent=2))


def to_json_line(document: Any) -> str:
    r"""The same on one line, without spaces.

    >>> to_json_line({"lead": [1.5, float("inf")], "name": "a\nb"})
    '{"lead":[1.5,null],"name":"a\\nb"}'
    """
    known = _known(document)
    return visible(json.dumps(known, allow_nan=False, ensure_ascii=False, separators=(",", ":")))


def spelled_out(value: Any) -> Any:
    """The same, with named tuples as dictionaries and members of enumerations as their values.

    >>> from evofsm.fsm.explanation import Tally
    >>> spelled_out({"here": [Tally(3, 12)]})
    {'here': [{'failed': 3, 'episodes': 12, 'is_exact': True, 'is_told': True}]}
    """
    if isinstance(value, Enum):
        return value.value
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, dict):
        return {key: spelled_out(one) for key, one in value.items()}
    return [spelled_out(one) for one in value] if isinstance(value, list | tuple) else value


def _known(document: Any) -> Any:
    if isinstance(document, dict):
        return {key: _known(value) for key, value in document.items()}
    if isinstance(document, list | tuple):
        return [_known(value) for value in document]
    return None if isinstance(document, float) and not math.isfinite(document) else document

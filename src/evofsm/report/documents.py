"""Numbers for programs: what JSON knows, and nothing else."""

from __future__ import annotations

import math
from typing import Any


def without_nan(document: dict[str, Any]) -> dict[str, Any]:
    """The same document with None for NaN and the infinite, which JSON does not know."""

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return without_nan(value)
        if isinstance(value, list | tuple):
            return [clean(entry) for entry in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return {key: clean(value) for key, value in document.items()}

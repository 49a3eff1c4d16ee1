"""Times that are written as dates: ISO 8601, with a zone or without."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

_BEGINNING = re.compile(r"\s*\d{4}-?\d\d-?\d\d[T ]")
_EPOCH, _TICK = datetime(1970, 1, 1, tzinfo=UTC), timedelta(microseconds=1)


def looks_like_a_date(text: str) -> bool:
    """Whether a field begins as a date and a time of ISO 8601 do.

    Examples
    --------
    >>> looks_like_a_date("2026-03-14T09:26:53.5+01:00"), looks_like_a_date("20260314")
    (True, False)
    """
    return _BEGINNING.match(text) is not None


def microseconds(texts: Iterable[str]) -> NDArray[np.float64]:
    """Microseconds since 1970, exactly; without a zone a date is taken as UTC.

    Raises
    ------
    ValueError
        If one is no date, or some have a zone and others do not.

    Examples
    --------
    >>> microseconds(["1970-01-01T01:00:00.25+01:00"])
    array([250000.])
    """
    dates = [datetime.fromisoformat(text.strip()) for text in texts]
    if len({date.tzinfo is None for date in dates}) > 1:
        raise ValueError("some have a zone and others have none")
    aware = (date if date.tzinfo else date.replace(tzinfo=UTC) for date in dates)
    return np.array([(date - _EPOCH) // _TICK for date in aware], np.float64)

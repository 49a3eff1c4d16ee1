"""What a log tells of failures: a column of truth values, or a comparison with a number."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from evofsm.io.tables import Piece

_SIGNS: Mapping[str, Callable[[NDArray[np.float64], float], Any]] = {
    "<=": np.less_equal,
    ">=": np.greater_equal,
    "==": np.equal,
    "!=": np.not_equal,
    "<": np.less,
    ">": np.greater,
    "=": np.equal,
}
_COMPARISON = re.compile(r"(?P<column>[^<>=!]+?)\s*(?P<sign><=|>=|==|!=|<|>|=)(?P<number>[^<>=!]+)")
_TRUTHS = {"true": True, "yes": True, "false": False, "no": False}


@dataclass(frozen=True)
class Condition:
    """A column that says yes or no in every row, or is compared with a number.

    Examples
    --------
    >>> Condition.parse("gap <= 0"), str(Condition.parse("collided"))
    (Condition(column='gap', sign='<=', number=0.0), 'collided')
    """

    column: str
    sign: str = ""  #: of the comparison; none for truth values
    number: float = np.nan  #: that the column is compared with

    @classmethod
    def parse(cls, text: str) -> Self:
        """From what --failed was given: ``collided`` or ``gap<=0``.

        Raises
        ------
        ValueError
            If it is neither a name nor a comparison of one with a number.
        """
        if text.strip() and not re.search("[<>=!]", text):
            return cls(text.strip())
        found = _COMPARISON.fullmatch(text.strip())
        try:
            number = float(found["number"]) if found else np.nan
        except ValueError:
            number = np.nan
        if found is None or not np.isfinite(number):
            raise ValueError(
                f"--failed is {text!r}; write a column of truth values, such as collided, or "
                "compare one with a number, such as 'gap<=0'"
            )
        return cls(found["column"], found["sign"], number)

    def __str__(self) -> str:
        return f"{self.column}{self.sign}{self.number:g}" if self.sign else self.column

    def compare(self, values: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Where numbers (T,) fulfil it; NaN never does."""
        return np.asarray(_SIGNS[self.sign](values, self.number) & ~np.isnan(values))

    def holds(self, piece: Piece) -> NDArray[np.bool_]:
        """In which rows of a piece it holds.

        Raises
        ------
        ValueError
            If a field is no truth value; the message names the row.
        """
        if self.sign:
            return self.compare(piece.numbers[self.column])
        texts = piece.texts[self.column]
        found = [
            _truth(piece.at(row), self.column, text)
            for row, text in zip(texts.firsts.tolist(), texts.values, strict=True)
        ]
        return np.repeat(np.array(found, np.bool_), texts.lengths)


def _truth(place: str, column: str, text: str) -> bool:
    word = text.strip().lower()
    if word in _TRUTHS:
        return _TRUTHS[word]
    try:
        number = float(word)
    except ValueError:
        number = np.nan
    if number in (0.0, 1.0):
        return bool(number)
    raise ValueError(
        f"{place}, column {column!r}: {text[:40]!r} is no truth value; --failed needs a column of "
        f"0 and 1, true and false or yes and no, or a comparison such as '{column}>0'"
    )

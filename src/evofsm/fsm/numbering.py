"""States and actions are counted from 0 in code and data, and from 1 in what people read."""

from __future__ import annotations


def state_name(index: int) -> str:
    """A state as people read it, counted from 1, by its index from 0.

    >>> state_name(3)
    '#4'
    """
    return f"#{index + 1}"


def action_name(index: int) -> str:
    """An action as people read it, counted from 1 as in the paper, by its index from 0.

    >>> action_name(16)
    'a(17)'
    """
    return f"a({index + 1})"

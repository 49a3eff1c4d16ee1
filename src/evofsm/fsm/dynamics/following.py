"""How dynamics follow a machine: what it observes and is told, they learn from as well.

A machine counts its observations, those that lacked something included. Dynamics note the count;
where it went on without them, what comes does not follow from what was.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.fsm.dynamics.dynamics import Dynamics
from evofsm.fsm.validation import check_action, is_within, real_array, refuse_unusable

#: Fourth powers of larger observations, summed over a long run, would lose all others.
LARGEST = 1e30

_Floats = NDArray[np.float64]


def encoded(dynamics: Dynamics, i: int, executed: ArrayLike | None) -> _Floats:
    """(a,) what was executed, as dynamics learn it; of choices, ``i`` if nothing else is said.

    Beyond the range it is taken for its end, which is all that there is to execute.

    Raises
    ------
    TypeError, ValueError
        If it is no action.
    """
    if dynamics.choices:
        if executed is None or type(executed) is int:
            index = i if executed is None else executed
            return dynamics.encode(check_action(index, dynamics.choices))
        number = real_array("executed", np.atleast_1d(i if executed is None else executed), 1)
        if len(number) != 1 or not float(number[0]).is_integer():
            raise ValueError(f"executed is {executed!r}; it must be the index of an action")
        return dynamics.encode(check_action(int(number[0]), dynamics.choices))
    if executed is None:
        raise ValueError(
            "executed is missing: dynamics with a range of actions have to be told the number, or "
            "numbers, that the action was"
        )
    if (
        dynamics.size == 1
        and type(executed) is float
        and dynamics.low[0] <= executed <= dynamics.high[0]
    ):
        return dynamics.encode(executed)
    action = real_array("executed", np.atleast_1d(executed), ndim=1)
    if len(action) != dynamics.size:
        raise ValueError(f"executed has {len(action)} numbers; an action has {dynamics.size}")
    refuse_unusable("executed", action)
    return dynamics.encode(np.clip(action, dynamics.low, dynamics.high))


def encoded_rows(
    dynamics: Dynamics, actions: NDArray[np.int64], executed: ArrayLike | None
) -> list[_Floats | None]:
    """`encoded` of each row; None where nothing was done."""
    if executed is None:
        rows: list[Any] = [None] * len(actions)
    else:
        rows = list(np.asarray(executed))
        if len(rows) != len(actions):
            raise ValueError(f"executed has {len(rows)} rows; {len(actions)} observations need one")
    found: list[_Floats | None] = []
    for row, (i, one) in enumerate(zip(actions.tolist(), rows, strict=True)):
        try:
            found.append(None if i < 0 else encoded(dynamics, i, one))
        except ValueError as error:
            raise ValueError(f"row {row}: {error}") from None
    return found


def refuse_too_large(z: _Floats) -> None:
    """Raise for an observation whose powers nobody can add up."""
    if is_within(z, LARGEST):
        return
    if z.size and np.abs(z).max() > LARGEST:
        raise ValueError(
            f"observation holds {np.abs(z).max():g}; a machine with dynamics takes numbers of at "
            f"most {LARGEST:g} in size"
        )


def follow(
    dynamics: Dynamics,
    z: _Floats,
    clock: float,
    *,
    chained: bool,
    failed: bool,
    action: _Floats | None,
) -> bool:
    """Learn from an observation, the ``clock``-th, and the action after it.

    ``chained`` says whether it follows from the one before. Returns whether something that was
    not expected began with the action before it.
    """
    with dynamics.whole:
        if not (chained and is_at(dynamics, clock - 1.0) and dynamics.has_acted):
            dynamics.break_off()
        dynamics.observe(z)
        began = dynamics.begins()
        dynamics.clock = clock
        if failed:
            dynamics.end(failed=True)
        elif action is not None:
            dynamics.act(action)
    return began and not failed  # of what ends in failure nothing is learnt


def follow_act(dynamics: Dynamics, clock: float, action: _Floats) -> None:
    """Learn what was done, unless the latest observation was not learnt from."""
    if is_at(dynamics, clock):
        dynamics.act(action)


def follow_end(dynamics: Dynamics, clock: float, *, failed: bool) -> None:
    """Learn that the episode is over."""
    with dynamics.whole:
        if failed and is_at(dynamics, clock):
            dynamics.end(failed=True)
        else:
            dynamics.break_off()


def is_at(dynamics: Dynamics, clock: float) -> bool:
    """Whether the latest observation of the episode was the ``clock``-th of the machine."""
    return dynamics.is_under_way and dynamics.clock == clock

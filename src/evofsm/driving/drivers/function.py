"""Any function as a controller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import SupportsFloat

import numpy as np
from numpy.typing import NDArray

from evofsm.guard import Proposal


@dataclass(frozen=True)
class FunctionController:
    """A controller that asks a function: a rule of one's own, or a trained policy.

    Parameters
    ----------
    function : callable
        From an observation, a (3,) ndarray of gap [m], v_follower [m/s] and v_leader [m/s], to an
        acceleration [m/s²] or a `Proposal`.

    Raises
    ------
    TypeError
        If ``function`` cannot be called.

    Examples
    --------
    >>> timid = FunctionController(lambda seen: -1.0 if seen[0] < 20.0 else 0.5)
    >>> timid.propose(np.array([12.0, 10.0, 10.0]))
    Proposal(action=-1.0, candidates=())
    """

    function: Callable[[NDArray[np.float64]], SupportsFloat | Proposal]

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise TypeError(f"function is {self.function!r}, which cannot be called")

    def propose(self, observation: NDArray[np.float64], time: float = 0.0) -> Proposal:
        """What the function returns for ``observation``; the time does not matter.

        Raises
        ------
        TypeError
            If that is neither a number nor a `Proposal`.
        """
        answer = self.function(observation)
        if isinstance(answer, Proposal):
            return answer
        if not isinstance(answer, SupportsFloat) or np.ndim(answer) != 0:  # type: ignore[arg-type]
            raise TypeError(
                f"the controller's function returned {answer!r}; it must return an acceleration "
                "as one number, or a Proposal (is a 'return' or an index missing?)"
            )
        return Proposal(float(answer))

"""The few shapes that rooms agree on."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Controller(Protocol):
    """Anything that drives the follower."""

    def propose(self, time: float, observation: NDArray[np.float64]) -> float:
        """Acceleration [m/s²] it wants at ``time`` [s], seeing ``observation``.

        The observation is ``[gap [m], v_follower [m/s], v_leader [m/s]]``, the gap from bumper
        to bumper.
        """
        ...

"""How well a share is known that was counted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evofsm._compile import compiled

# Two-sided 90 %.
_WIDTH = 1.645


@compiled
def wilson_interval(
    share: NDArray[np.float64], count: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """90 % interval of a share that was counted (Wilson 1927)."""
    spread = _WIDTH * _WIDTH / count
    centre = (share + 0.5 * spread) / (1.0 + spread)
    reach = np.sqrt(spread * (share * (1.0 - share) + 0.25 * spread)) / (1.0 + spread)
    return np.maximum(centre - reach, 0.0), np.minimum(centre + reach, 1.0)

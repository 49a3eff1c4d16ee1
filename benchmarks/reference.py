"""The machine in plain NumPy, vectorised over states: what others are timed against.

With the paper's rule it is `evofsm.core.reference`; this adds `Novelty`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.core import Reference


class NumpyFSM(Reference):
    """With a ``novelty_radius`` states are those of `Novelty` instead of the paper's."""

    def __init__(
        self, n_actions: int, *, novelty_radius: float | None = None, **settings: Any
    ) -> None:
        super().__init__(n_actions, **settings)
        self.novelty_radius = novelty_radius

    def judge(self, z: NDArray[np.float64], potential: float) -> None:
        if self.novelty_radius is None:
            super().judge(z, potential)
        elif ((self.centers - z) ** 2).sum(axis=1).min() > self.novelty_radius**2:
            self.create(z, potential)

    def width(self) -> float:
        if self.novelty_radius is None:
            return super().width()
        return self.spread * self.novelty_radius**2

"""How hard leaders braked in real drives, as a table to begin with in place of nothing.

Without it the first `Manoeuvres` are only assumed, and it takes 49 hard brakes of leaders until a
risk of 2 % can be told from that assumption. The table is statistics of public drives, not the
drives; ``python -m studies leaders --data FOLDER`` prints such a table of any folder of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from evofsm.fsm import positive

# Of a bin of the table [m/s²].
_WIDTH = 0.25


class LeaderBrakes(NamedTuple):
    """Hard brakes of leaders, counted by their deceleration.

    Examples
    --------
    >>> brakes = LeaderBrakes.counted([2.6, 3.1, 2.7], gentle=20, hours=0.5, source="our own cars")
    >>> brakes.counts, brakes.decels
    ((2, 0, 1), (2.75, 2.75, 3.25))
    >>> brakes.hours_until(tolerance=0.02)
    8.166666666666666
    """

    hard: float  #: from which deceleration on they count as hard [m/s²]
    counts: tuple[int, ...]  #: of hard ones, by bins of 0.25 m/s² from there on
    gentle: int  #: number of softer ones
    hours: float  #: of following a leader that they were seen in
    source: str  #: whose drives, for people

    @classmethod
    def counted(
        cls, decels: Sequence[float], gentle: int, hours: float, source: str, hard: float = 2.5
    ) -> Self:
        """Count decelerations of at least ``hard`` [m/s²]."""
        bins = [int((decel - hard) / _WIDTH) for decel in decels]
        counts = np.bincount(np.array(bins, dtype=np.int64)).tolist()
        return cls(hard, tuple(counts), gentle, positive("hours", hours), source)

    @property
    def decels(self) -> tuple[float, ...]:
        """Each as hard as its bin may hold, the softest first [m/s²]."""
        ends = self.hard + _WIDTH * np.arange(1, len(self.counts) + 1)
        return tuple(np.repeat(ends, self.counts).tolist())

    def hours_until(self, tolerance: float) -> float:
        """Hours of driving until so many are seen that a tolerance can be met without a table."""
        seen = sum(self.counts)
        return brakes_needed(tolerance) * self.hours / seen if seen else math.inf

    @property
    def at_most_harder(self) -> float:
        """Share of hard brakes that may be harder than all that were seen (95 %, one-sided).

        If each were drawn by itself; those of one platoon are not, so the share may be larger.
        """
        seen = sum(self.counts)
        return 1.0 - 0.05 ** (1.0 / seen) if seen else 1.0


def brakes_needed(tolerance: float) -> int:
    """Hard brakes to be seen until the assumed one weighs no more than the tolerance.

    Examples
    --------
    >>> brakes_needed(0.02)
    49
    """
    return max(math.ceil(1.0 / tolerance - 1e-9) - 1, 0)


#: Public drives: 46 waves of braking, the hardest 6.1 m/s². Hardly anyone brakes hard in them, and
#: no one in an emergency: how hard leaders brake then, they do not tell.
REAL_DRIVES = LeaderBrakes(
    hard=2.5,
    counts=(25, 15, 14, 14, 7, 7, 3, 2, 1, 1, 1, 0, 0, 0, 2),
    gentle=977,
    hours=16.1,
    source="OpenACC, ZalaZONE campaign (JRC; Makridis et al. 2021), NGSIM (FHWA; events of Zhu et "
    "al. 2020), one platoon of FHWA; 42 runs",
)

"""Numbers that stand where none is given; light to import."""

from __future__ import annotations

from typing import Final

#: The highest risk, a probability of failure, that a reviser lets pass.
TOLERANCE: Final = 0.02

#: Share of a belief that a machine may leave out (`EvolvingFSM.belief_tolerance`): it saves most of
#: the time.
BELIEF_TOLERANCE: Final = 1e-6

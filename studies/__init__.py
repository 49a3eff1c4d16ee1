"""The studies: what is claimed, what was measured, and the pages that say so.

They are not part of the package: run them from a checkout, ``python -m studies NAME``.
"""

from studies.rivals import Rival
from studies.systems import Box, Discrete, System

__all__ = ["Box", "Discrete", "Rival", "System"]

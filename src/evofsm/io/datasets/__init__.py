"""Readers of public car-following data in their own layouts, as leader-follower episodes.

Nothing is downloaded: users fetch the files themselves, under the licences of those who made
them, and may put a list of checksums beside them, which is then held against what is read.
"""

from evofsm.io.datasets.checksums import find_checksums, verify_checksums
from evofsm.io.datasets.episodes import Episode, as_chunks
from evofsm.io.datasets.layouts import Layout, read_episodes

__all__ = [
    "Episode",
    "Layout",
    "as_chunks",
    "find_checksums",
    "read_episodes",
    "verify_checksums",
]

"""Which layouts there are, and files read in one of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from enum import StrEnum
from pathlib import Path

from studies.datasets.checksums import find_checksums, verify_checksums
from studies.datasets.episodes import Episode
from studies.datasets.hundred_car import read_hundred_car
from studies.datasets.openacc import read_openacc
from studies.datasets.pairs import read_pairs
from studies.datasets.tracks import read_highd, read_ngsim


class Layout(StrEnum):
    """How the files of a data set are laid out."""

    PAIRS = "pairs"  #: gap and speeds of pairs, in SI units
    OPENACC = "openacc"
    NGSIM = "ngsim"
    HIGHD = "highd"
    HUNDRED_CAR = "100car"


# Each raises a ValueError that names the file, and the column it lacks or the line that is none.
_READERS: Mapping[Layout, Callable[[Path], Iterator[Episode]]] = {
    Layout.PAIRS: read_pairs,
    Layout.OPENACC: read_openacc,
    Layout.NGSIM: read_ngsim,
    Layout.HIGHD: read_highd,
    Layout.HUNDRED_CAR: read_hundred_car,
}


def read_episodes(paths: Iterable[Path], layout: Layout = Layout.PAIRS) -> Iterator[Episode]:
    """Read files of one layout, held against the checksums that lie beside them, if any.

    Parameters
    ----------
    paths : iterable of Path
        Files; of a folder that holds ``MANIFEST.csv`` or ``SHA256SUMS`` each is verified before
        it is read.
    layout : Layout

    Yields
    ------
    Episode
        A pair, for as long as the one follows the other.

    Raises
    ------
    ValueError
        If a file has another checksum than the list beside it says, is not laid out so, or in it
        nobody follows anybody; the message names the file.
    """
    lists: dict[Path, dict[str, str]] = {}
    for path in paths:
        if path.parent not in lists:
            lists[path.parent] = find_checksums(path.parent)
        verify_checksums([path], lists[path.parent])
        found = False
        for episode in _READERS[layout](path):
            found = True
            yield episode
        if not found:
            raise ValueError(f"{path}: nobody in it follows anybody for long enough")

"""Real drives: a folder of runs, as episodes of a follower and its leader.

Nothing is downloaded: users fetch the files themselves, under the licences of those who made them,
and may put a list of checksums beside them, which is then held against what is read.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Shorter episodes are left out [s].
SHORTEST = 2.0
# So many times the usual step of time, or one over that, is a hole.
_LONGEST_STEP = 1.5
_NUMBERS = ("time", "gap", "v_follower", "v_leader", "a_follower")
_LABELS = ("pair", "segment")
# Names under which a list of checksums is looked for in a folder, in this order.
_LISTS = ("MANIFEST.csv", "SHA256SUMS", "sha256sums.txt")


class Episode(NamedTuple):
    """T consecutive rows of one pair, evenly spaced in time."""

    run: str  #: recording it comes from: the file, without folder and ending
    pair: str  #: who follows whom, as the recording names them
    times: Floats  #: (T,) [s]
    observations: Floats  #: (T, 3) gap, bumper to bumper [m]; both speeds [m/s]
    accelerations: Floats  #: (T,) of the follower from each row on [m/s²]
    dt: float  #: time from a row to the next [s]


def runs_in(folder: Path) -> list[Path]:
    """The files of a folder that hold a run each, in the order of their names.

    Lists of checksums and of segments in capital letters are no runs.
    """
    if not folder.is_dir():
        raise NotADirectoryError(f"{folder}: there is no such folder")
    paths = sorted(
        path
        for path in folder.iterdir()
        if path.name.endswith((".csv", ".csv.gz")) and not name_of(path).isupper()
    )
    if not paths:
        raise ValueError(f"{folder} holds no runs (*.csv, *.csv.gz)")
    return paths


def name_of(path: Path) -> str:
    """Name of a run: the file's, without its endings.

    >>> name_of(Path("data/run_7.csv.gz"))
    'run_7'
    """
    return path.name.removesuffix(".gz").removesuffix(".csv")


def read_runs(paths: Iterable[Path]) -> Iterator[Episode]:
    """Episodes of runs, each file held against the list of checksums beside it, if any."""
    lists: dict[Path, dict[str, str]] = {}
    for path in paths:
        if path.parent not in lists:
            lists[path.parent] = checksums_in(path.parent)
        _verify(path, lists[path.parent].get(path.name))
        episodes = list(_read(path))
        if not episodes:
            raise ValueError(f"{path}: nobody in it follows anybody for long enough")
        yield from episodes


def _read(path: Path) -> Iterator[Episode]:
    """Rows of one segment stand together, in the order of time."""
    kinds = dict.fromkeys(_NUMBERS, pl.Float64) | dict.fromkeys(_LABELS, pl.String)
    try:
        table = pl.read_csv(path, schema_overrides=kinds)
    except pl.exceptions.PolarsError as error:
        raise ValueError(f"{path}: {str(error).partition(chr(10))[0]}") from error
    for name in (*_NUMBERS, *_LABELS):
        if name not in table.columns:
            raise ValueError(f"{path} has no column {name!r}; it has {', '.join(table.columns)}")
    for part in table.with_columns(place=pl.struct(_LABELS).rle_id()).partition_by("place"):
        yield from _cut(name_of(path), part["pair"][0], part.select(_NUMBERS).to_numpy())


def _cut(run: str, pair: str, rows: Floats) -> Iterator[Episode]:
    """Part where a value is missing, no gap is left, or time has a hole."""
    times, observations = rows[:, 0], rows[:, 1:4]
    steps = np.diff(times)
    if len(steps) == 0:
        return
    dt = round(float(np.median(steps)), 6)
    usable = np.isfinite(observations).all(axis=1) & (observations[:, 0] > 0.0)
    even = (steps < _LONGEST_STEP * dt) & (steps > dt / _LONGEST_STEP)
    starts = np.flatnonzero(np.append(True, ~(usable[1:] & usable[:-1] & even)))
    for first, end in zip(starts, [*starts[1:], len(times)], strict=True):
        if usable[first] and (end - first - 1) * dt >= SHORTEST - 1e-9:
            chosen = rows[first:end].copy()
            yield Episode(run, pair, chosen[:, 0], chosen[:, 1:4], chosen[:, 4], dt)


def checksums_in(folder: Path) -> dict[str, str]:
    """SHA-256 of files by their names, as a list in the folder has it; empty without a list.

    A list is CSV with the columns ``file`` and ``sha256``, or what ``sha256sum`` prints. Folders in
    the names it gives are left out.
    """
    path = next((folder / name for name in _LISTS if (folder / name).is_file()), None)
    if path is None:
        return {}
    if path.suffix == ".csv":
        table = pl.read_csv(path, infer_schema=False)
        if not {"file", "sha256"} <= set(table.columns):
            raise ValueError(f"{path}: a list of checksums needs the columns file and sha256")
        pairs = list(table.select("file", "sha256").iter_rows())
    else:  # a star before the name says that the file was read as bytes
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        split = [line.split(maxsplit=1) for line in lines if line.strip()]
        pairs = [(line[-1].lstrip("*"), line[0]) for line in split]
    for name, checksum in pairs:
        if not re.fullmatch("[0-9a-fA-F]{64}", checksum or ""):
            raise ValueError(f"{path}, {name}: {checksum!r} is no SHA-256 in hexadecimal")
    return {Path(name.replace("\\", "/")).name: checksum for name, checksum in pairs}


def _verify(path: Path, expected: str | None) -> None:
    if expected is None:
        return
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != expected.lower():
        raise ValueError(
            f"{path}: its SHA-256 is {found[:12]}…, but the list beside it says "
            f"{expected[:12].lower()}… (changed since, or a download that was interrupted?)"
        )

"""Checksums of data files: a list beside them, held against what is really there."""

from __future__ import annotations

import csv
import hashlib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

#: Names under which a list of checksums is looked for in a folder, in this order.
LISTS = ("MANIFEST.csv", "SHA256SUMS", "sha256sums.txt")

_SUM = re.compile(r"[0-9a-fA-F]{64}")


def find_checksums(folder: Path) -> dict[str, str]:
    """SHA-256 of files by their names, as a list in the folder has it; empty without a list.

    A list is either CSV with the columns ``file`` and ``sha256``, or what ``sha256sum`` prints.
    Folders in the names it gives are left out: a file is known by its own name.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    ValueError
        If a list is there but cannot be one.
    """
    for name in LISTS:
        if (folder / name).is_file():
            return _read(folder / name)
    return {}


def verify_checksums(paths: Iterable[Path], checksums: Mapping[str, str]) -> int:
    """Compare files with a list; returns how many of them it names.

    Parameters
    ----------
    paths : iterable of Path
    checksums : mapping
        SHA-256 in hexadecimal by file name, as `find_checksums` returns. Files that it does not
        name are skipped.

    Raises
    ------
    ValueError
        Naming the first file that is not what the list says.
    """
    verified = 0
    for path in paths:
        expected = checksums.get(path.name)
        if expected is None:
            continue
        found = _sha256(path)
        if found != expected.lower():
            raise ValueError(
                f"{path}: its SHA-256 is {found[:12]}…, but the list beside it says "
                f"{expected[:12].lower()}… (changed since, or a download that was interrupted?)"
            )
        verified += 1
    return verified


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read(path: Path) -> dict[str, str]:
    text = path.read_text(encoding="utf-8-sig")
    if path.suffix == ".csv":
        rows = list(csv.DictReader(text.splitlines()))
        if rows and not {"file", "sha256"} <= set(rows[0]):
            raise ValueError(f"{path}: a list of checksums needs the columns file and sha256")
        pairs = [(row["file"], row["sha256"]) for row in rows]
    else:  # a star before the name says that the file was read as bytes
        lines = [line.split(maxsplit=1) for line in text.splitlines() if line.strip()]
        pairs = [(line[-1].lstrip("*"), line[0]) for line in lines]
    for name, checksum in pairs:
        if not _SUM.fullmatch(checksum or ""):
            raise ValueError(f"{path}, {name}: {checksum!r} is no SHA-256 in hexadecimal")
    return {Path(name.replace("\\", "/")).name: checksum for name, checksum in pairs}

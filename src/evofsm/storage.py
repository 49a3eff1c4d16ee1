"""The file format of machines and models: named arrays and a JSON header, nothing that can run.

A file is a ZIP of ``.npy`` members (NumPy's ``.npz``), read with pickling refused. The member
``header`` is JSON: ``{"format", "version", "kind", "content"}``. A machine's file holds the
views of its buffer, with centres by variable (m, n); a model's its fields, centres by state (n, m).
Version 1 knew the paper's state rule only and did not count failures. Version 2 held a matrix for
every action, used or not.
"""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_FORMAT = "evofsm"
_VERSION = 3
# Arrays that version 1 had not, as zeros in the shape of one that it had.
_ADDED = {
    "machine": {
        "decisions": "origin_frequency",
        "failures": "origin_frequency",
        "endings": "visits",
        "latest": "first",
    },
    "model": {
        "decisions": "origin_frequency",
        "failures": "origin_frequency",
        "endings": "visits",
    },
}
# What reading a damaged archive may run into (OSError: a place before its beginning;
# RuntimeError: a flag that says it is encrypted).
_DAMAGE = (
    ValueError,
    KeyError,
    TypeError,
    EOFError,
    OSError,
    RuntimeError,
    zlib.error,
    zipfile.BadZipFile,
)


def write(
    path: str | os.PathLike[str],
    kind: str,
    content: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
) -> None:
    """Write a file whole or not at all: beside its place first, then renamed into it."""
    header = {"format": _FORMAT, "version": _VERSION, "kind": kind, "content": dict(content)}
    encoded = np.frombuffer(json.dumps(header).encode(), np.uint8)
    members: dict[str, Any] = {"header": encoded, **arrays}
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{target}: there is no folder {target.parent}")
    temporary = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        with open(temporary, "wb") as file:
            np.savez_compressed(file, **members)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def kind_of(path: str | os.PathLike[str]) -> str:
    """Say what a file holds: ``"machine"`` or ``"model"``."""
    return str(_read(path)[0]["kind"])


def read(path: str | os.PathLike[str], kind: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Read a file of the given kind: its content and its arrays."""
    header, arrays = _read(path)
    if header["kind"] != kind:
        raise ValueError(f"{os.fspath(path)} holds a {header['kind']}, not a {kind}")
    if header["version"] < _VERSION:
        with explained(path):
            _upgrade(header, arrays)
    return header["content"], arrays


def _read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    with explained(path):
        with open(path, "rb") as file:
            if file.read(4) != b"PK\x03\x04" or not zipfile.is_zipfile(file):
                raise ValueError("it is not a ZIP archive, or was cut off")
            file.seek(0)
            with np.load(file, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
        header = _header(arrays.pop("header", None))
    return header, arrays


def _header(encoded: Any) -> dict[str, Any]:
    if not isinstance(encoded, np.ndarray):
        raise ValueError("it has no header, so it is another program's file")
    header = json.loads(encoded.tobytes())
    if not isinstance(header, dict) or header.get("format") != _FORMAT:
        raise ValueError("its header is another program's")
    if header["version"] > _VERSION:
        raise ValueError(
            f"its version {header['version']} is newer than this library's {_VERSION}; "
            "a newer evofsm reads it"
        )
    if not {"kind", "content"} <= set(header):
        raise ValueError("its header lacks what it holds")
    return header


def _upgrade(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
    """Give a file of an earlier version what it lacks."""
    if header["version"] < 2:
        header["content"]["rule"] = {"name": "paper"}
        for name, like in _ADDED[header["kind"]].items():
            arrays[name] = np.zeros_like(arrays[like])
    if header["kind"] == "machine":
        arrays["places"] = np.arange(len(arrays["uses"]), dtype=np.float64)
        arrays["scales"] = np.ones_like(arrays["origin_frequency"])
        arrays["n_founded"] = arrays["n_states"]
        arrays["ids"] = np.arange(len(arrays["visits"]), dtype=np.float64)


@contextmanager
def explained(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn whatever reading a damaged file runs into into one error that names the file."""
    try:
        yield
    except _DAMAGE as error:
        if isinstance(error, OSError) and error.filename is not None:
            raise  # no such file, no permission: the system's own words say it best
        raise ValueError(f"{os.fspath(path)} cannot be read as an evofsm file: {error}") from error

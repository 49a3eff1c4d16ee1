"""The file format of machines and models: named arrays and a JSON header, nothing that can run.

A file is a ZIP of ``.npy`` members (NumPy's ``.npz``), read with pickling refused. The member
``header`` is JSON: ``{"format", "version", "kind", "content"}``.
"""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_FORMAT = "evofsm"
_VERSION = 1


def write(
    path: str | os.PathLike[str],
    kind: str,
    content: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
) -> None:
    """Write a file whole or not at all: beside its place first, then renamed into it."""
    header = {"format": _FORMAT, "version": _VERSION, "kind": kind, "content": dict(content)}
    encoded = np.frombuffer(json.dumps(header).encode(), np.uint8)
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{target}: there is no folder {target.parent}")
    with tempfile.NamedTemporaryFile(dir=target.parent, delete=False) as file:
        temporary = Path(file.name)
        try:
            np.savez_compressed(file, allow_pickle=False, header=encoded, **arrays)
            file.flush()
            os.fsync(file.fileno())
            temporary.chmod(0o644)
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
    return header["content"], arrays


def _read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    with explained(path):
        with open(path, "rb") as file:
            if not zipfile.is_zipfile(file):
                raise ValueError("it is not a ZIP archive, or was cut off")
            file.seek(0)
            with np.load(file, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
        header = json.loads(arrays.pop("header").tobytes())
        if header["format"] != _FORMAT:
            raise ValueError("it is another program's file")
        if header["version"] > _VERSION:
            raise ValueError(
                f"its version {header['version']} is newer than this library's {_VERSION}; "
                "a newer evofsm reads it"
            )
    return header, arrays


@contextmanager
def explained(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn whatever reading a damaged file runs into into one error that names the file."""
    try:
        yield
    except OSError:
        raise
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{os.fspath(path)} cannot be read as an evofsm file: {error}") from error

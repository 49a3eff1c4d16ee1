"""Checkpoints: what long work has come to, kept in a file, so that it goes on where it was stopped.

A checkpoint says what work it belongs to (its settings, and the files it reads). The same command
goes on from it, and the result is, bit for bit, what it would have been without the stop; another
command is refused. It is replaced as a whole or not at all: whenever the process is killed, there
is the one before or the new one. Where it cannot be written any more, the work goes on without.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from evofsm import __version__, store

_log = logging.getLogger(__name__)

KIND = store.Kind("checkpoint", None)
_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0}
# Of a file so much at its beginning and at its end tells it from others [bytes].
_END = 1 << 16
# So many files of a folder tell it from others.
_MOST_FILES = 1000
# So many settings that differ are named in an error.
_NAMED = 4


class Kept(NamedTuple):
    """How far work has come."""

    content: Mapping[str, Any]  #: counts and the like, for JSON
    arrays: Mapping[str, NDArray[Any]]
    finished: bool = False


class Checkpoint:
    """Keeps how far work has come in a file, at intervals of time.

    Parameters
    ----------
    path : path-like
        Of the file; it is made where there is none, and gone on from where there is.
    settings : mapping
        What determines the result, for JSON; `versions` is added to it.
    every : float
        Time between two checkpoints [s]; 0 keeps whatever is offered.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "sum.checkpoint"
    ...     kept = Checkpoint(path, {"up to": 10}).begin(Kept({"sum": 0}, {}))
    ...     Checkpoint(path, {"up to": 10}).keep(Kept({"sum": 55}, {}, finished=True))
    ...     Checkpoint(path, {"up to": 10}).begin(Kept({"sum": 0}, {}))
    Kept(content={'sum': 55}, arrays={}, finished=True)
    """

    def __init__(
        self, path: str | os.PathLike[str], settings: Mapping[str, Any], every: float = 60.0
    ) -> None:
        self.path = Path(path)
        self.every = every
        self.settings: dict[str, Any] = json.loads(json.dumps({**settings, **versions()}))
        #: Whether the latest one could not be written.
        self.failed = False
        #: What else is to be kept, by those who made it; what was, once it has begun.
        self.notes: dict[str, Any] = {}
        self._latest = time.monotonic()

    def begin(self, start: Kept) -> Kept:
        """Return what to go on from: the content of the file, or ``start``, which is then written.

        Raises
        ------
        OSError
            If the file cannot be read, or could not be written either.
        ValueError
            If it belongs to other work, is no checkpoint, or is damaged.
        """
        if self.path.parent.is_dir():
            store.sweep(self.path)
        if not self.path.exists():
            self._write(start)
            return start
        content, arrays = store.read(self.path, KIND)
        with store.explained(self.path):
            before, done = content["settings"], content["done"]
            kept = Kept(done, arrays, bool(content["finished"]))
            self.notes.update(content["notes"])
        if different := differences(before, self.settings):
            raise ValueError(
                f"{self.path} is the checkpoint of other work: {different}; run it with those, "
                "name another file, or delete this one to begin anew"
            )
        if not (kept.finished or os.access(self.path.parent, os.W_OK)):
            raise PermissionError(
                f"{self.path}: its folder may not be written, so that nothing more could be kept"
            )
        return kept

    @property
    def is_due(self) -> bool:
        """Whether the time between two checkpoints has passed."""
        return time.monotonic() - self._latest >= self.every

    def offer(self, take: Callable[[], Kept]) -> None:
        """Keep what ``take`` returns, if `is_due`."""
        if self.is_due:
            self.keep(take())

    def keep(self, kept: Kept) -> None:
        """Replace what the file holds; where that fails, the work goes on, with a warning."""
        try:
            self._write(kept)
        except OSError as error:
            self.failed = True
            _log.warning(
                "%s: no checkpoint could be written (%s); the one before is kept and the work "
                "goes on. Make room, or this much will have to be done again if it is stopped.",
                self.path,
                (error.strerror or str(error)).lower(),
            )
        self._latest = time.monotonic()

    def _write(self, kept: Kept) -> None:
        content = {
            "settings": self.settings,
            "done": kept.content,
            "finished": kept.finished,
            "notes": self.notes,
        }
        store.write(self.path, KIND, content, kept.arrays)
        self.failed = False


@contextmanager
def result_kept(checkpoint: Checkpoint | None) -> Iterator[None]:
    """Let an error in writing a result say where the result still is, and what to do."""
    try:
        yield
    except OSError as error:
        if checkpoint is None:
            text = "the result is lost with it; --checkpoint FILE would have kept it"
        else:
            kept = "as far as it came" if checkpoint.failed else "whole"
            text = (
                f"the result is kept, {kept}, in {checkpoint.path}: make room, and run the same "
                "command again"
            )
        error.add_note(text)
        raise


def versions() -> dict[str, str]:
    """Of everything that may change a digit."""
    return {"evofsm": __version__, "numpy": np.__version__, "numba": numba.__version__}


def duration(text: str) -> float:
    """Seconds from what --every was given: ``10s``, ``5m`` or ``1h``; a plain number is seconds.

    Raises
    ------
    ValueError
        If it is none of them.

    Examples
    --------
    >>> duration("90s"), duration("1.5m"), duration("0")
    (90.0, 90.0, 0.0)
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([smh]?)", text.strip())
    if found is None:
        raise ValueError(f"--every is {text!r}; write 10s, 5m or 1h")
    return float(found[1]) * _SECONDS[found[2] or "s"]


def fingerprints(files: Iterable[str | os.PathLike[str]]) -> list[dict[str, Any]]:
    """What tells each file from another one of its name: its size, its beginning and its end.

    The SHA-256 is taken over the first and the last 64 KiB, so that it costs nothing however
    large the file is: a log that grew or was replaced shows, one edited in its middle does not.
    """
    return [_fingerprint(os.fspath(file)) for file in files]


def _fingerprint(path: str) -> dict[str, Any]:
    if os.path.isdir(path):  # a bag of ROS 2; of another one, who reads it will say what is wrong
        within = sorted(entry.path for entry in os.scandir(path) if entry.is_file())
        files = [_fingerprint(file) for file in within[:_MOST_FILES]]
        return {"name": path, "bytes": sum(file["bytes"] for file in files), "files": files}
    if os.path.exists(path) and not os.path.isfile(path):
        return {"name": path}  # a pipe: who reads it will say what is wrong with it
    with open(path, "rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        digest = hashlib.sha256(file.read(_END))
        file.seek(max(size - _END, 0))
        digest.update(file.read(_END))
    return {"name": path, "bytes": size, "sha256_of_ends": digest.hexdigest()}


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """In which settings two pieces of work differ, in words; empty where in none.

    Examples
    --------
    >>> differences({"seed": 0, "family": {"name": "paper"}}, {"seed": 1, "family": {"name": "r"}})
    'seed was 0 and is now 1, family.name was "paper" and is now "r"'
    """
    flat_before, flat_now = _flat(before), _flat(now)
    found = [
        f"{name} was {_shown(flat_before.get(name))} and is now {_shown(flat_now.get(name))}"
        for name in flat_before | flat_now
        if json.dumps(flat_before.get(name)) != json.dumps(flat_now.get(name))  # NaN equals NaN
    ]
    more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    return ", ".join(found[:_NAMED]) + more


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    """Settings within settings, by names with dots."""
    if not isinstance(value, dict | list):
        return {name: value}
    items = value.items() if isinstance(value, dict) else enumerate(value)
    found: dict[str, Any] = {}
    for inner, one in items:
        found |= _flat(one, f"{name}.{inner}" if name else str(inner))
    return found


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 24 else f"{text[:20]} ..."

"""A journal of episodes: what is in it survives whatever happens to the process that writes it.

It is a file of JSON objects, one on each line. The first is the header: the settings that every
episode in it was driven with. Each other one is an episode, in the order in which they were done::

    {"settings":{"seed":0},"crc":"0a8b2dd9"}
    {"episode":3,"collided":false,"mobility":0.93,"crc":"1f0c4a66"}

``crc`` is the CRC-32 of the line up to the comma before it, in hexadecimal: a record that was half
written when the process was killed, or the disk full, does not have the right one. It is cut off
when the journal is opened again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Self
from zlib import crc32

from evofsm import store
from evofsm.fleet.checkpoint import differences

_SEAL = b',"crc":"'

Record = Mapping[str, Any]


class Journal:
    """Records of episodes in a file. Close it after use, or use it in a ``with`` statement.

    Parameters
    ----------
    path : Path
        Is made if it is not there.
    settings : mapping
        What determines the records; a journal of other settings is not gone on with.

    Raises
    ------
    ValueError
        If the file has other settings, is no journal, is damaged elsewhere than at its end, or is
        being written by another process.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "journal.jsonl"
    ...     with Journal(path, {"seed": 0}) as journal:
    ...         journal.append({7: {"collided": False}})
    ...     with Journal(path, {"seed": 0}) as journal:
    ...         journal.records
    {7: {'collided': False}}
    """

    def __init__(self, path: Path, settings: Mapping[str, Any]) -> None:
        self.path = path
        #: By episode.
        self.records: dict[int, Record] = {}
        self._file: BinaryIO = open(path, "a+b", buffering=0)  # noqa: SIM115
        try:
            store.only_writer(self._file, self.path, "name another folder")
            header = _line({"settings": settings})
            good = self._read(header)
            self._file.truncate(good)
            if good == 0:
                self._write(header)
        except BaseException:
            self.close()
            raise

    def append(self, records: Mapping[int, Record]) -> None:
        """Add episodes; when this returns, they are on the disk.

        Raises
        ------
        OSError
            If they cannot be written. What was there before is kept.
        """
        self._write(b"".join(_line({"episode": k, **record}) for k, record in records.items()))
        self.records.update(records)

    def close(self) -> None:
        """Let others have the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _write(self, data: bytes) -> None:
        with room_needed(self.path):
            while data:  # a disk that gets full takes a part of it first
                data = data[self._file.write(data) :]
            os.fsync(self._file.fileno())

    def _read(self, header: bytes) -> int:
        """Read what is there, and say up to where it is good; without an episode, nothing is."""
        good, damaged, begun_with = 0, 0, {}
        with open(self.path, "rb") as file:
            for number, line in enumerate(file, 1):
                record = _record(line)
                if record is None:
                    if number == 1 and not header.startswith(line):
                        raise ValueError(f"{self.path} is no journal of a campaign")
                    damaged = damaged or number
                    continue
                if damaged:
                    raise ValueError(
                        f"{self.path}, line {damaged} is damaged (was it edited?); delete that "
                        "line, and its episode is driven again"
                    )
                if number == 1:
                    begun_with = record
                else:
                    self.records[int(record.pop("episode"))] = record
                good += len(line)
        if not self.records:
            return 0
        self._check(begun_with, json.loads(header))
        return good

    def _check(self, begun_with: Record, header: Record) -> None:
        differing = differences(begun_with["settings"], header["settings"])
        if differing:
            raise ValueError(
                f"{self.path} was begun with other settings: {differing}; run it with those, or "
                "name another folder"
            )


def _line(record: Mapping[str, Any]) -> bytes:
    text = json.dumps(record, separators=(",", ":")).encode()[:-1]
    return text + _SEAL + f'{crc32(text):08x}"}}\n'.encode()


def _record(line: bytes) -> dict[str, Any] | None:
    """What a line holds; None where it is not whole."""
    text, _, seal = line.rpartition(_SEAL)
    if seal != f'{crc32(text):08x}"}}\n'.encode():
        return None
    record = json.loads(text + b"}")
    return record if isinstance(record, dict) else None


@contextmanager
def room_needed(path: Path) -> Iterator[None]:
    """Let a write that fails name the file, and what to do."""
    try:
        yield
    except OSError as error:
        raise OSError(
            error.errno,
            f"{error.strerror}; what came before is kept: make room, and run the same command "
            "again",
            str(path),
        ) from error

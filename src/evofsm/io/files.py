"""Open a file as what it is, whatever it is called."""

from __future__ import annotations

import csv
import gzip
import io
import logging
import os
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import BinaryIO, Literal, cast

Kind = Literal["csv", "parquet", "xml", "osi", "mcap", "bag", "run"]
#: Called with the number of bytes each time some were read from a file.
OnRead = Callable[[int], object]

BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_GZIP, _PARQUET = b"\x1f\x8b", b"PAR1"
_SQLITE, _MCAP = b"SQLite format 3\0", b"\x89MCAP0\r\n"
# Where an MCAP file says what it was written by, behind the mark, an opcode and two lengths.
_PROFILE = len(_MCAP) + 1 + 8 + 4
_ROS, _OURS = b"ros2", b"evofsm "
_NEWLINE = ord("\n")

_log = logging.getLogger(__name__)


def silent(count: int) -> None:
    """Nobody wants to know how much was read."""


class _WatchedFile(io.FileIO):
    """A file as it was when it was opened, to the end of what was its last line then."""

    def __init__(self, path: str, on_read: OnRead) -> None:
        super().__init__(path)
        self._on_read = on_read
        self._size = self._left = os.fstat(self.fileno()).st_size
        self._ends_line = True  # whether what was read last does
        self.has_lines = True

    def readinto(self, buffer: bytearray | memoryview, /) -> int:  # type: ignore[override]
        wanted = memoryview(buffer).cast("B")
        if self._left > 0:
            count = super().readinto(wanted[: self._left])
            self._left -= count
        else:
            count = self._rest_of_line(wanted)
        if count:
            self._ends_line = wanted[count - 1] == _NEWLINE
        self._on_read(count)
        return count

    def _rest_of_line(self, buffer: memoryview) -> int:
        """What came since to a line that was being written."""
        if self._ends_line or not self.has_lines:
            return 0
        count = super().readinto(buffer)
        end = bytes(buffer[:count]).find(b"\n") + 1
        return end or count

    @property
    def growth(self) -> int:
        """By how much it has grown since [byte]."""
        return max(os.fstat(self.fileno()).st_size - self._size, 0)


@contextmanager
def open_unpacked(path: str, on_read: OnRead = silent) -> Iterator[BinaryIO]:
    """Open a file for reading bytes; one that is gzipped is unpacked on the way.

    Of one that grows meanwhile no more is read than was there at first, and its last line; with
    ``on_read``, a warning is logged.
    """
    if os.path.isdir(path):
        raise IsADirectoryError(f"{path} is a folder; name the files in it")
    if os.path.exists(path) and not os.path.isfile(path):
        raise ValueError(f"{path} is a pipe or a device; write it to a file first")
    watched = _WatchedFile(path, on_read)
    with io.BufferedReader(watched) as file:
        if file.peek(2).startswith(_GZIP):
            watched.has_lines = False
            with gzip.GzipFile(fileobj=file) as unpacked:
                yield cast(BinaryIO, unpacked)
        else:
            yield file
        if on_read is not silent and watched.growth:
            _log.warning(
                "%s grew by %s bytes while it was read; rows that came meanwhile are left out",
                path,
                f"{watched.growth:,}",
            )


def file_kind(path: str) -> Kind:
    """What the file holds, judged by how it begins.

    A trace of OSI begins with nothing of its own and is known by its name, ``.osi``. The folder of
    a bag of ROS 2 is ``"bag"``, as its files are; ``"run"`` is a log that evofsm wrote.
    """
    if os.path.isfile(os.path.join(path, "metadata.yaml")):
        return "bag"
    if path.removesuffix(".gz").endswith(".osi"):
        return "osi"
    with open_unpacked(path) as file, damage_explained(path):
        beginning = file.read(64).removeprefix(BYTE_ORDER_MARK).lstrip()
    if not beginning:
        raise ValueError(f"{path} is empty")
    if beginning.startswith(_PARQUET):
        return "parquet"
    if beginning.startswith(_MCAP):
        if beginning[_PROFILE:].startswith(_ROS):
            return "bag"
        # Ours has no profile, so that the length of what it was written by comes first.
        return "run" if beginning[_PROFILE + 4 :].startswith(_OURS) else "mcap"
    if beginning.startswith(_SQLITE):
        return "bag"
    return "xml" if beginning.startswith(b"<") else "csv"


@contextmanager
def damage_explained(path: str, reached: Callable[[], int] = lambda: 0) -> Iterator[None]:
    """Turn whatever reading a damaged file runs into into one error that names file and line."""
    try:
        yield
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise ValueError(
            f"{path}, after line {reached()}: the gzip data ends early or is damaged "
            f"(was a copy or a download interrupted, or is it still being written?): {error}"
        ) from error
    except csv.Error as error:
        raise ValueError(f"{path}, line {reached()}: {error} (an unclosed quote?)") from error
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}, after line {reached()}: this is not text in UTF-8 "
            "(a file of another kind, or saved in another encoding?)"
        ) from error

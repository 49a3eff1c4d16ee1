"""Open a file as what it is, whatever it is called."""

from __future__ import annotations

import csv
import gzip
import io
import os
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import BinaryIO, Literal, cast

Kind = Literal["csv", "parquet", "xml"]
#: Is told the number of bytes each time some were read from a file.
OnRead = Callable[[int], object]

BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_GZIP, _PARQUET = b"\x1f\x8b", b"PAR1"


def ignore(count: int) -> None:
    """Nobody wants to know how much was read."""


class _WatchedFile(io.FileIO):
    def __init__(self, path: str, on_read: OnRead) -> None:
        super().__init__(path)
        self._on_read = on_read

    def readinto(self, buffer: bytearray | memoryview, /) -> int:  # type: ignore[override]
        count = super().readinto(buffer)
        self._on_read(count)
        return count


@contextmanager
def open_unpacked(path: str, on_read: OnRead = ignore) -> Iterator[BinaryIO]:
    """Open a file for reading bytes; one that is gzipped is unpacked on the way."""
    if os.path.isdir(path):
        raise IsADirectoryError(f"{path} is a folder; name the files in it")
    if os.path.exists(path) and not os.path.isfile(path):
        raise ValueError(f"{path} is a pipe or a device; write it to a file first")
    with io.BufferedReader(_WatchedFile(path, on_read)) as file:
        if file.peek(2).startswith(_GZIP):
            with gzip.GzipFile(fileobj=file) as unpacked:
                yield cast(BinaryIO, unpacked)
        else:
            yield file


def kind_of(path: str) -> Kind:
    """What the file holds, judged by how it begins."""
    with open_unpacked(path) as file, damage_explained(path):
        beginning = file.read(64).removeprefix(BYTE_ORDER_MARK).lstrip()
    if not beginning:
        raise ValueError(f"{path} is empty")
    if beginning.startswith(_PARQUET):
        return "parquet"
    return "xml" if beginning.startswith(b"<") else "csv"


@contextmanager
def damage_explained(path: str, reached: Callable[[], int] = lambda: 0) -> Iterator[None]:
    """Turn whatever reading a damaged file runs into into one error that names file and line."""
    try:
        yield
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise ValueError(
            f"{path}, after line {reached()}: the gzip data ends early or is damaged "
            f"(was a copy or a download interrupted?): {error}"
        ) from error
    except csv.Error as error:
        raise ValueError(f"{path}, line {reached()}: {error} (an unclosed quote?)") from error
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}, after line {reached()}: this is not text in UTF-8 "
            "(a file of another kind, or saved in another encoding?)"
        ) from error

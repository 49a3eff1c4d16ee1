"""A journal: what is in it survives whatever happens to the process that writes it.

It is a file of JSON objects, one on each line; the first is the header, with the settings that all
others belong to. A line that was half written when the process was killed, or the disk full, is cut
off when the journal is opened again.
"""

from __future__ import annotations

import io
import json
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import current_thread, main_thread
from typing import Any

import msgspec

from evofsm import store
from evofsm.guard.audit_log import lines

_LONGEST_RECORD = 1 << 20  # a record has at most so many bytes

Record = Mapping[str, Any]


@contextmanager
def asked_to_stop(handle: Callable[[int, Any], object]) -> Iterator[None]:
    """Have signals that ask to stop call ``handle``; what nohup lets it ignore, it ignores.

    Python calls such in the main thread alone: in another one nothing changes.
    """
    names = ("SIGTERM", "SIGINT", "SIGHUP") if current_thread() is main_thread() else ()
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    numbers = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Journal:
    """Records in a file that no other process writes; of another kind it is refused. Close it."""

    def __init__(
        self, path: Path, settings: Record, otherwise: str = "name another folder"
    ) -> None:
        self.path = path
        #: Those that it was begun with: of another journal where it has records.
        self.settings: Record = settings
        self.records: list[dict[str, Any]] = []
        self._file = _opened(path, otherwise)
        try:
            good = self._read()
            self._file.truncate(good)
            if good == 0:
                self._write(_line({"settings": settings}))
        except BaseException:
            self.close()
            raise

    def go_on(self, settings: Record, otherwise: str) -> None:
        """Refuse, saying what to do, where it has records of other settings."""
        changes = differences(self.settings, settings)
        if changes and self.records:
            raise ValueError(f"{self.path} was begun with other settings: {changes}; {otherwise}")
        if changes:
            self.begin_anew(settings)

    def append(self, *records: Record, sync: bool = True) -> None:
        """Add records, which then survive the process, with ``sync`` a power cut too."""
        self._write(b"".join(map(_line, records)), sync=sync)

    def begin_anew(self, settings: Record, *records: Record) -> None:
        """Replace all of it by a header and these records, at once or not at all."""
        fresh = self.path.with_name(f".{self.path.name}.new")
        fresh.unlink(missing_ok=True)
        journal = Journal(fresh, settings, "try again")
        journal.append(*records)
        os.replace(fresh, self.path)
        self.close()
        self._file = journal._file
        self.settings, self.records = settings, [dict(record) for record in records]

    def sync(self) -> None:
        """Force what was written onto the disk."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Let others have the file."""
        self._file.close()

    def _write(self, data: bytes, *, sync: bool = True) -> None:
        try:
            while data:  # a disk that gets full takes a part of it first
                data = data[self._file.write(data) :]
            if sync:
                self.sync()
        except OSError as error:
            hint = "what came before is kept: make room, and run the same command again"
            raise OSError(error.errno, f"{error.strerror}; {hint}", str(self.path)) from error

    def _read(self) -> int:
        """Read what is there, and say up to where it is good; without a record, nothing is."""
        good, bad_line = 0, 0
        for number, line in enumerate(lines(self.path, _LONGEST_RECORD), 1):
            record = _record(line)
            if record is None or (number == 1 and "settings" not in record):
                if number == 1 and not _line({"settings": self.settings}).startswith(line):
                    raise ValueError(f"{self.path} is no journal")
                bad_line = bad_line or number
                continue
            if bad_line:
                raise ValueError(
                    f"{self.path}, line {bad_line} is damaged (was it edited?); delete that line, "
                    "and what it said is done again"
                )
            if number == 1:
                self.settings = record["settings"]
            else:
                self.records.append(record)
            good += len(line)
        return good


def _opened(path: Path, otherwise: str) -> io.FileIO:
    """A file that no other process writes."""
    file = io.FileIO(path, "a+")
    try:
        store.only_writer(file, path, otherwise)
        if os.fstat(file.fileno()).st_ino != path.stat().st_ino:  # it has just been replaced
            raise ValueError(f"{path} is being written by another process; {otherwise}")
    except BaseException:
        file.close()
        raise
    return file


def _line(record: Record) -> bytes:
    return msgspec.json.encode(record) + b"\n"


def _record(line: bytes) -> dict[str, Any] | None:
    """What a line holds; None where it is not whole."""
    try:
        record = json.loads(line) if line.endswith(b"\n") else None
    except ValueError:
        return None
    return record if isinstance(record, dict) else None


def differences(before: Record, now: Record) -> str:
    """In which settings two pieces of work differ, in words; empty where in none."""
    now = json.loads(msgspec.json.encode(now))  # as the other was read
    return ", ".join(
        f"{name} was {_shown(before.get(name))} and is now {_shown(now.get(name))}"
        for name in {**before, **now}
        if before.get(name) != now.get(name)
    )


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 24 else f"{text[:20]} ..."

"""A journal: what is in it survives whatever happens to the process that writes it.

It is a chain of records, as an audit log is; the first is the header, with the settings that all
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

from evofsm import store
from evofsm.guard.audit_log import NOTHING, Chain, canonical, seal

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
        self._head = NOTHING  # of the chain
        self._file = _opened(path, otherwise)
        try:
            self._read()
            if self._head == NOTHING:
                self.append({"settings": settings})
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
        data = b""
        for record in records:
            line, self._head = seal(record, self._head)
            data += line
        try:
            while data:  # a disk that gets full takes a part of it first
                data = data[self._file.write(data) :]
            if sync:
                self.sync()
        except OSError as error:
            hint = "what came before is kept: make room, and run the same command again"
            raise OSError(error.errno, f"{error.strerror}; {hint}", str(self.path)) from error

    def begin_anew(self, settings: Record, *records: Record) -> None:
        """Replace all of it by a header and these records, at once or not at all."""
        fresh = self.path.with_name(f".{self.path.name}.new")
        fresh.unlink(missing_ok=True)
        journal = Journal(fresh, settings, "try again")
        journal.append(*records)
        os.replace(fresh, self.path)
        self.close()
        self._file, self._head = journal._file, journal._head
        self.settings, self.records = settings, [dict(record) for record in records]

    def sync(self) -> None:
        """Force what was written onto the disk."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Let others have the file."""
        self._file.close()

    def _read(self) -> None:
        """Read what is there, and cut off what is not whole."""
        chain = Chain(self.path)
        contents = [record.content for record in chain.records()]
        if chain.finding is not None:
            number, why, _ = chain.finding
            raise ValueError(
                f"{self.path}: {why} (was it edited?); put back what was there, or delete it from "
                f"line {number} on, and what that said is done again"
            )
        begins, _ = seal({"settings": self.settings}, NOTHING)
        if contents and "settings" in contents[0]:
            self.settings, self.records = contents[0]["settings"], contents[1:]
        elif contents or not begins.startswith(self.path.read_bytes()):
            raise ValueError(f"{self.path} is no journal")
        self._head = chain.head
        self._file.truncate(chain.size)


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


def differences(before: Record, now: Record) -> str:
    """In which settings two pieces of work differ, in words; empty where in none."""
    now = json.loads(canonical(now))  # as the other was read
    return ", ".join(
        f"{name} was {_shown(before.get(name))} and is now {_shown(now.get(name))}"
        for name in {**before, **now}
        if before.get(name) != now.get(name)
    )


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 24 else f"{text[:20]} ..."

"""A journal: what is in it survives whatever happens to the process that writes it.

It is a chain of records, as an audit log is; the first is the header, with the settings that all
others belong to. A line that was half written when the process was killed, or the disk full, is cut
off when the journal is opened again.
"""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import current_thread, main_thread
from typing import Any

from evofsm.guard.audit_log import NOTHING, Ledger, canonical

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


class Journal(Ledger):
    """A ledger that begins with a header, the settings that its records belong to."""

    _about = "evofsm journal"
    _remedy = "put back what was there, or delete that record and the rest: they are done again"

    def __init__(self, path: Path, otherwise: str) -> None:
        contents: list[dict[str, Any]] = []
        super().__init__(path, otherwise, contents.append)
        self.settings: Record = contents[0]["settings"] if contents else {}  #: of its header
        self.records = contents[1:]  #: those that were there

    def go_on(self, settings: Record, otherwise: str) -> None:
        """Begin it; refuse, saying what to do, where it has records of other settings."""
        changes = differences(self.settings, settings)
        if changes and self.records:
            raise ValueError(f"{self.path} was begun with other settings: {changes}; {otherwise}")
        if changes:
            self.head, self._size = NOTHING, 0  # in place of another header
            self.settings = settings
            self.append({"about": self._about, "settings": settings})

    def append(self, *records: Record, sync: bool = True) -> None:
        """Add records, which then survive the process, with ``sync`` a power cut too."""
        try:
            for record in records:
                self._append(record)
            if sync:
                self.force()
        except OSError as error:
            hint = "see to that, and run the same command again: it goes on from what is there"
            raise OSError(error.errno, f"{error.strerror}; {hint}", str(self.path)) from error

    def begin_anew(self, settings: Record, *records: Record) -> None:
        """Replace all of it by a header and these records, at once or not at all."""
        fresh = self.path.with_name(f".{self.path.name}.new")
        fresh.unlink(missing_ok=True)
        journal = Journal(fresh, "try again")
        journal.go_on(settings, "try again")
        journal.append(*records)
        os.replace(fresh, self.path)
        self.close()
        vars(self).update(vars(journal), path=self.path)


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

"""How a monitor goes on bit for bit after whatever ended it.

Two files: the guard as it was between two episodes, replaced whole, and beside it a journal of the
messages since then, each written before it is answered, which are taken in again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import copy
from pathlib import Path
from typing import Any

import msgspec

from evofsm import store
from evofsm.cli.journal import Journal, differences
from evofsm.cli.models import load_learning
from evofsm.cli.monitor.decider import Answer, Decider
from evofsm.cli.monitor.messages import MessageError, Taken
from evofsm.cli.show import warn
from evofsm.guard import AuditLog, Guard, Head

_log = logging.getLogger(__name__)

_EVERY = 600  # messages in the journal, from which on the guard is written as an episode ends
_PROVENANCE = "monitor"


class State:
    """Keeps a monitor in files. Close it after use."""

    def __init__(
        self, path: Path, settings: Mapping[str, Any], provenance: Mapping[str, Any] | None = None
    ) -> None:
        self.path = path.resolve()
        self.settings = dict(settings)
        self.failure = ""  #: why nothing is saved; empty as long as it is
        journal = self.path.with_name(f"{self.path.name}.journal")
        self._journal = Journal(journal, "name another file")
        self._provenance: dict[str, Any] = dict(provenance or {})
        self._saved: dict[str, Any] = {}  # what stands beside the guard
        self._mark = 0
        self._decider: Decider  # once it has begun
        self._count = 0  # messages in the journal
        self._files: list[str] = []  # digests of what was read of each
        self._place: int | None = None  # among these, of the file that is read

    def guard(self, fresh: Callable[[], Guard], failed: str | None = None) -> Guard:
        """The guard as it was saved; a fresh one where there is none."""
        journal, is_there = self._journal, self.path.exists()
        if is_there:
            self._provenance = dict(store.read_header(self.path).provenance)
        self._saved = self._provenance.pop(_PROVENANCE, {})
        if not self._saved and journal.records:
            fault = f"holds what came after a guard that is not in {self.path}"
            hint = "put that back, or delete the journal to begin anew"
            raise ValueError(f"{journal.path} {fault}; {hint}")
        if self._saved and (changes := differences(self._saved["settings"], self.settings)):
            fault = f"{self.path} was saved with other settings: {changes}"
            raise ValueError(f"{fault}; go on with those, or name another file")
        self._mark, self._files = self._saved.get("mark", 0), self._saved.get("files", [])
        if self._saved and journal.settings.get("mark") not in (self._mark, self._mark - 1):
            fault = f"is missing or empty: rows that came after {self.path} was saved are lost"
            hint = "put it back, or give the guard as --guard and name another --state"
            raise ValueError(f"{journal.path} {fault}; {hint}")
        for record in journal.records:
            self._have_read(*record.get("read", ()))
        return load_learning(self.path, failed) if is_there else fresh()

    def begin(self, decider: Decider, hear: Callable[[Answer], object] = bool) -> int:
        """Go on where it was, and hear it; returns how many messages were taken in again."""
        self._decider, decider.keep = decider, self._keep
        if self._saved:
            decider.remember(self._saved["memory"])
        else:
            self._journal.begin_anew({"mark": self._mark})
        if not self._saved or self._journal.settings["mark"] != self._mark:
            self._save()  # what is in a journal of the mark before, is in the guard
            return 0
        head = self._saved.get("audit")
        if head is not None and isinstance(log := decider.guard.audit, AuditLog):
            log.told_again(Head.parse(head))
        self._count = len(self._journal.records)
        for record in self._journal.records:
            try:
                hear(decider.act(msgspec.convert(record["told"], Taken)))
            except Exception as error:  # of another version: no reason not to begin
                _log.error("%s: a message is left out: %s", self._journal.path, error)
        self._journal.records.clear()  # of days they are large
        return self._count

    def pass_over(self, file: Path, decider: Decider) -> int:
        """Pass over the lines of a file that were taken in before; returns their length [byte]."""
        csv, size, behind, self._place = copy(decider.csv), 0, 0, len(self._files)
        with file.open("rb") as source:
            for line in source if self._files else ():
                size += len(line)
                with suppress(MessageError):
                    csv.read(line.removesuffix(b"\n").removesuffix(b"\r"))
                if csv.heard in self._files:  # with what it knows of names and units
                    decider.csv, behind = copy(csv), size
                    self._place = self._files.index(csv.heard)
        if behind:
            warn(f"{file} was read before, up to {decider.csv.place}it goes on behind that")
        return behind

    def close(self) -> None:
        """Write the guard, but within an episode; an OSError where not all could be saved."""
        if (self._count or self.failure) and self._decider.rows == 0:
            self._try(self._save)
        if not self.failure:
            self._try(self._journal.force)
        self._journal.close()
        if self.failure:
            raise OSError(f"{self.failure}; what came since then is lost")

    def _keep(self, told: Taken | None) -> None:
        """Write down what is to be acted on; and after that the guard, if an episode has ended."""
        if told is None:
            if self._decider.rows == 0 and (self.failure or self._count >= _EVERY):
                self._try(self._save)
            return
        record = {"told": msgspec.to_builtins(told)}
        if self._place is not None:
            record["read"] = self._place, self._decider.csv.heard
            self._have_read(*record["read"])
        if not self.failure:
            self._try(lambda: self._journal.append(record, sync=False))
            self._count += 1

    def _have_read(self, place: int = 0, *digests: str) -> None:
        """Know again what was read of a file, in place of what was known of it before."""
        self._files[place : place + len(digests)] = digests

    def _try(self, save: Callable[[], None]) -> None:
        """Decisions matter most: what fails is said, and gone on without until an episode ends."""
        failure = ""
        try:
            save()
        except Exception as error:
            failure = f"{self.path} is not saved: {error}"
        if bool(failure) != bool(self.failure):
            _log.error(failure or f"{self.path} is saved again")
        self.failure = failure

    def _save(self) -> None:
        """Write the guard, and begin a journal; the one before counts until it is written."""
        decider, mark = self._decider, self._mark + 1
        head = str(log.head) if isinstance(log := decider.guard.audit, AuditLog) else None
        entry = {"mark": mark, "settings": self.settings, "memory": decider.memory()}
        entry |= {"audit": head, "files": self._files}
        decider.guard.save(self.path, {**self._provenance, _PROVENANCE: entry})
        self._journal.begin_anew({"mark": mark})
        self._mark, self._count = mark, 0

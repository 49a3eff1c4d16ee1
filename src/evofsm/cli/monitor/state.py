"""How a monitor goes on bit for bit after whatever ended it.

Two files: the guard as it was between two episodes, replaced whole, and beside it a journal of the
messages since then, each written before it is answered, which are taken in again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from evofsm import store
from evofsm.cli.journal import Journal, differences
from evofsm.cli.monitor.decider import Decider
from evofsm.cli.monitor.messages import Taken
from evofsm.guard import AuditLog, Guard, Head
from evofsm.guard.audit_log import NOTHING, seal

_log = logging.getLogger(__name__)

_EVERY = 600  # messages in the journal, from which on the guard is written as an episode ends
_PROVENANCE = "monitor"
_NEW = -1  # the mark of a journal that was made just now


class State:
    """Keeps a monitor in files. Close it after use."""

    def __init__(self, path: Path, settings: Mapping[str, Any]) -> None:
        self.path = path.resolve()
        self.settings = dict(settings)
        self.failure = ""  #: why nothing is saved; empty as long as it is
        self._journal = Journal(
            self.path.with_name(f"{self.path.name}.journal"), {"mark": _NEW}, "name another file"
        )
        self._provenance: dict[str, Any] = {}
        self._mark = 0
        self._memory: Mapping[str, Any] | None = None
        self._logged: str | None = None  # head of the audit log, as the guard was saved
        self._count = 0  # messages in the journal
        self._head = NOTHING  # of the chain that they are

    def guard(
        self, fresh: Callable[[], Guard], failed: Callable[[Any], bool] | None = None
    ) -> Guard:
        """The guard as it was saved; a fresh one where there is none."""
        load = partial(Guard.load, self.path, failed=failed)
        journal, is_there = self._journal, self.path.exists()
        if is_there:
            self._provenance = dict(store.read_header(self.path).provenance)
        entry = self._provenance.pop(_PROVENANCE, None)
        if entry is None:
            if journal.records:
                raise ValueError(
                    f"{journal.path} holds what came after a guard that is not in {self.path}; put "
                    "that back, or delete the journal to begin anew"
                )
            return load() if is_there else fresh()
        if changes := differences(entry["settings"], self.settings):
            raise ValueError(
                f"{self.path} was saved with other settings: {changes}; go on with those, or name "
                "another file"
            )
        self._mark, self._memory = int(entry["mark"]), entry["memory"]
        self._logged = entry.get("audit")
        if journal.settings.get("mark") not in (self._mark, self._mark - 1):
            raise ValueError(
                f"{journal.path} is missing or empty: rows that came after {self.path} was saved "
                "are lost; put it back, or give the guard as --guard and name another --state"
            )
        self._head = Head(journal.settings["mark"], NOTHING.digest)
        for number, record in enumerate(journal.records, 2):
            digest = self._sealed(record.get("told"))["hash"]
            if record.get("hash", digest) != digest:  # those of before have none
                raise ValueError(
                    f"{journal.path}, line {number} was altered: its hash is not that of what it "
                    "says; put back what was there, or delete it from that line on, and send again "
                    "what came since"
                )
        return load()

    def begin(self, decider: Decider) -> int:
        """Go on where it was; returns the number of messages that were taken in again."""
        decider.keep = lambda told: self._keep(told, decider)
        if self._memory is None:
            self._journal.begin_anew({"mark": self._mark})
        else:
            decider.remember(self._memory)
        if self._memory is None or self._journal.settings["mark"] != self._mark:
            self._save(decider)  # what is in a journal of the mark before, is in the guard
            return 0
        if isinstance(log := decider.guard.audit, AuditLog) and self._logged:
            log.told_again(Head.parse(self._logged))
        self._count = len(self._journal.records)
        for record in self._journal.records:
            try:
                decider.act(msgspec.convert(record["told"], Taken))
            except Exception as error:  # of another version: no reason not to begin
                _log.error("%s: a message is left out: %s", self._journal.path, error)
        return self._count

    def rest(self, decider: Decider) -> None:
        """Write the guard as it is, unless it is within an episode."""
        if (self._count or self.failure) and not decider.rows:
            self._try(partial(self._save, decider))

    def close(self) -> None:
        """Force the journal onto the disk, and let others have the files; raise if all is not."""
        if not self.failure:
            self._try(self._journal.sync)
        self._journal.close()
        if self.failure:
            raise ValueError(f"{self.failure}; what came since then is lost")

    def _keep(self, told: Taken, decider: Decider) -> None:
        """Write down what was acted on, and the guard, if an episode has just ended."""
        if not self.failure:
            self._try(lambda: self._journal.append(self._sealed(told), sync=False))
            self._count += 1
        if decider.rows == 0 and (self.failure or self._count >= _EVERY):
            self._try(partial(self._save, decider))

    def _sealed(self, told: Any) -> dict[str, Any]:
        """The record of a message, with the hash of it and of all before it, as in an audit log."""
        told = msgspec.to_builtins(told)
        _, self._head = seal({"told": told}, self._head)
        return {"told": told, "hash": self._head.digest}

    def _try(self, save: Callable[[], None]) -> None:
        """Decisions matter most: what fails is said, and gone on without until an episode ends."""
        try:
            save()
        except Exception as error:
            if not self.failure:
                self.failure = f"{self.path} is not saved: {error}"
                _log.error(self.failure)

    def _save(self, decider: Decider) -> None:
        """Write the guard, and begin a journal; the one before counts until it is written."""
        mark = self._mark + 1
        head = str(log.head) if isinstance(log := decider.guard.audit, AuditLog) else None
        entry = {"mark": mark, "settings": self.settings, "memory": decider.memory(), "audit": head}
        decider.guard.save(self.path, {**self._provenance, _PROVENANCE: entry})
        self._journal.begin_anew({"mark": mark})
        self._mark, self._count, self._head = mark, 0, Head(mark, NOTHING.digest)
        if self.failure:
            _log.warning("%s is saved again", self.path)
            self.failure = ""

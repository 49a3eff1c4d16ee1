"""What a monitor keeps of itself, so that it goes on bit for bit after whatever ended it.

Two files: the guard as it was between two episodes, replaced whole, and beside it a journal of the
rows since then. A row is in the journal before it is decided on; a monitor that begins takes them
all in again, and is where it was. A process that is killed loses nothing, a power cut what the
system had not yet written.
"""

from __future__ import annotations

import logging
import secrets
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from evofsm import store
from evofsm.cli.monitor.decider import Decider, Told
from evofsm.cli.monitor.schema import End, Row
from evofsm.fleet.sealed import ChainedFile, number, records
from evofsm.guard import Guard

_log = logging.getLogger(__name__)

# The guard is written once so many rows are in the journal, as an episode ends.
_EVERY = 600
_PROVENANCE = "monitor"


class State:
    """Keeps a monitor in files; a `Keeper`. Close it after use.

    Parameters
    ----------
    path : Path
        Of the guard. The journal has the same name, with a mark and ``.journal``.
    settings : mapping
        Texts, numbers and truth values that decisions depend on beside the guard; those of other
        settings are not gone on with.

    Raises
    ------
    ValueError
        If another process keeps itself there.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any]) -> None:
        self.path = path
        self.settings = dict(settings)
        #: Why nothing is kept any more; empty as long as it is.
        self.failure = ""
        self._provenance: dict[str, Any] = {}
        self._mark = ""
        self._memory: Mapping[str, Any] | None = None
        self._journal: ChainedFile | None = None
        self._count = 0

    def guard(self, fresh: Callable[[], Guard]) -> Guard:
        """The guard as it was kept; a fresh one where there is none.

        Raises
        ------
        ValueError
            If it was kept with other settings, or is damaged.
        """
        if not self.path.exists():
            return fresh()
        store.sweep(self.path)
        self._provenance = dict(store.read_header(self.path).provenance)
        kept = self._provenance.pop(_PROVENANCE, None)
        if kept is not None:
            self._check(kept["settings"])
            self._mark, self._memory = str(kept["mark"]), kept["memory"]
        return Guard.load(self.path)

    def begin(self, decider: Decider) -> int:
        """Go on where it was, and keep it from now on; returns the number of rows taken in again.

        Raises
        ------
        OSError, ValueError
            If the files cannot be written, or the journal was changed.
        """
        if self._memory is None:
            self._keep(decider)
            return 0
        decider.remember(self._memory)
        self._journal = _opened(self._place)
        self._count = self._journal.head.number or 0
        for record in records(self._place, self._count):
            decider.act(_read(record.content))
        return self._count

    def before(self, told: Told) -> None:
        """Write down what is acted on next."""
        if self._journal is None:
            return
        try:
            self._journal.append(_written(told))
            self._count += 1
        except OSError as error:
            self._fail(error)

    def after(self, decider: Decider) -> None:
        """Write the guard, if an episode has just ended and the journal is long."""
        if decider.rows or self._count < _EVERY or self._journal is None:
            return
        try:
            self._keep(decider)
        except OSError as error:
            self._fail(error)

    def close(self) -> None:
        """Force the journal onto the disk, and let others have the files."""
        if self._journal is not None:
            self._journal.sync()
            self._journal.close()

    def _keep(self, decider: Decider) -> None:
        """Write the guard, and begin a journal; the one before counts until it is written."""
        before, was = self._journal, self._place
        mark = secrets.token_hex(4)
        kept = {"mark": mark, "settings": self.settings, "memory": decider.memory()}
        decider.guard.save(self.path, {**self._provenance, _PROVENANCE: kept})
        self._mark = mark
        self._journal, self._count = _opened(self._place), 0
        if before is not None:
            before.close()
            was.unlink(missing_ok=True)

    @property
    def _place(self) -> Path:
        return self.path.with_name(f"{self.path.name}.{self._mark}.journal")

    def _check(self, before: Mapping[str, Any]) -> None:
        differ = [
            f"{name} was {before.get(name)!r} and is {self.settings.get(name)!r}"
            for name in sorted(before.keys() | self.settings.keys())
            if before.get(name) != self.settings.get(name)
        ]
        if differ:
            raise ValueError(
                f"{self.path} was kept with other settings: {'; '.join(differ)}; go on with "
                "those, or name another file"
            )

    def _fail(self, error: OSError) -> None:
        """The decisions are what matters; it is said, and gone on without."""
        self.failure = f"{self.path} is not kept any more: {error}"
        _log.error(self.failure)
        if self._journal is not None:
            self._journal.close()
        self._journal = None


def _opened(path: Path) -> ChainedFile:
    """A journal; a first record that was half written is none."""
    if path.exists():
        with open(path, "r+b") as file:
            store.only_writer(file, path, "name another file")
            if b"\n" not in file.read():
                file.truncate(0)
    return ChainedFile(path)


def _written(told: Told) -> dict[str, Any]:
    return {"end" if isinstance(told, End) else "row": list(told)}


def _read(content: Mapping[str, Any]) -> Told:
    if "end" in content:
        failed, seen = content["end"]
        return End(failed, None if seen is None else tuple(seen))
    time, *rest = content["row"]
    return Row.kept([number(time), *rest])

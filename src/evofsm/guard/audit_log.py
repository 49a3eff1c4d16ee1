"""The audit log of a guard: what it decided, so that nobody can change it unnoticed.

docs/audit.md says what is in a record, a JSON object on a line of its own. ``hash``, its last, is
the SHA-256 of the line up to the comma before it, and ``previous`` that of the record before (zeros
for the first): a hash chain as in Haber and Stornetta (J. Cryptology 3, 1991).

What a guard is told and decides is one record each, made by a `Recorder`. An audit also decides
again, without a world: the guard that the log began with is told the same, and what a recorder
then makes of it must be what was recorded, to the last bit. So neither a decision that does not
follow nor a forged model hides behind a chain that was made anew.
"""

from __future__ import annotations

import base64
import errno
import json
import logging
import math
import os
import platform
import stat
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, suppress
from datetime import UTC, datetime
from hashlib import sha256
from io import BytesIO, FileIO
from operator import is_not
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numba
import numpy as np

import evofsm
from evofsm.fsm.sharing import Rollback, as_now
from evofsm.fsm.validation import Floats
from evofsm.guard.actions import written
from evofsm.guard.api import Proposal, Revision, Situation
from evofsm.guard.guard import DecisionLogger, Guard
from evofsm.guard.loop import Decision
from evofsm.guard.parts import can_be_made_again, set_again, settings_of
from evofsm.guard.record import RECORD
from evofsm.guard.reviser import is_spoken, proposed

_log = logging.getLogger(__name__)

LOG_VERSION = 1
#: What may be changed about a guard between episodes.
SETTINGS = ("explaining", "interval", "learn", "shadow")
# Most probable states of a belief that are written; records of which one is forced onto the disk,
# though nothing was to be said; and bytes of a line, which holds a machine at most.
_STATES, _MOST_QUIET, _LONGEST_LINE = 3, 240, 1 << 26
_SEEN, _PROPOSED = {"observation", "time"}, {"observation", "time", "mask", "proposed"}
# What is decided, as it is recorded elsewhere, too.
_DECIDED = RECORD.keys() - _PROPOSED
#: The names in a record of each kind, beside ``kind`` and ``clock``.
FIELDS: Mapping[str, set[str]] = {
    "start": {"about", "guard", "made_by", "reviser", "settings", "told_failures", "version"},
    "begin": set(),
    "seen": _SEEN,
    "quiet": _PROPOSED,
    "decision": {*_PROPOSED, *_DECIDED, "belief"},
    "settings": {"settings"},
    "end": {"failed", "learnt", "observation", "score", "terminated"},
}


def canonical(content: Any) -> str:
    """JSON that is the same for equal content, with words for numbers that are not finite."""
    try:
        return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except ValueError:
        return canonical(_finite(content))


def _finite(content: Any) -> Any:
    if isinstance(content, float) and not math.isfinite(content):
        return "NaN" if math.isnan(content) else "Infinity" if content > 0.0 else "-Infinity"
    if isinstance(content, Mapping):
        return {name: _finite(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return content


class Head(NamedTuple):
    """The last record of a log at some time: keep it where the log is not.

    Examples
    --------
    >>> head = Head(12, "ab" * 32)
    >>> Head.parse(str(head)) == head
    True
    """

    number: int
    digest: str

    def __str__(self) -> str:
        return f"{self.number}:{self.digest}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """From ``NUMBER:HASH``; a ValueError if it is something else."""
        number, _, digest = text.strip().lower().partition(":")
        if not (number.isascii() and number.isdigit()) or len(digest) != len(NOTHING.digest):
            raise ValueError(f"head is {text!r}; it must be NUMBER:HASH, as `evofsm audit` says it")
        return cls(int(number), digest)


#: What the first record follows.
NOTHING = Head(0, "0" * 64)


class Record(NamedTuple):
    """One line of a log that is a whole record."""

    number: int
    previous: str
    digest: str
    content: dict[str, Any]


def seal(content: Mapping[str, Any], after: Head) -> tuple[bytes, Head]:
    """The line of the record that follows ``after``, and the head that it makes."""
    number = after.number + 1
    text = canonical({**content, "number": number, "previous": after.digest})[:-1]
    digest = sha256(text.encode()).hexdigest()
    return f'{text},"hash":"{digest}"}}\n'.encode(), Head(number, digest)


def unseal(line: bytes) -> Record | None:
    """The record that a line holds; None where it is not as `seal` writes it."""
    try:
        content = json.loads(line)
        digest, number, previous = (content.pop(name) for name in ("hash", "number", "previous"))
        is_whole = type(number) is int and seal(content, Head(number - 1, previous))[0] == line
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    return Record(number, previous, digest, content) if is_whole else None


class Field(NamedTuple):
    """What differs, as JSON."""

    name: str
    recorded: str
    replayed: str


class Finding(NamedTuple):
    """The first record that is not what was written, or does not come out again."""

    record: int  #: its number, from 1
    explanation: str  #: with the likely cause
    fields: tuple[Field, ...] = ()  #: of a decision that comes out otherwise


class Chain:
    """Follows a log from its first record to its last, or to the first that was tampered with.

    A ``kept`` head must be one of the records; more may have come after it.
    """

    def __init__(self, path: Path, kept: Head | None = None) -> None:
        self.path = path
        self.head = NOTHING  #: the last record so far
        self.size = 0  #: up to there [byte]
        self.half_written = 0  #: what a last line without an end holds [byte]
        self.finding: Finding | None = None  #: None where nothing was tampered with
        self._kept = kept or NOTHING

    def records(self) -> Iterator[Record]:
        """The records, after which `finding` is known; a ValueError if there is none."""
        number, digest = self._kept
        file_lines = lines(self.path, _LONGEST_LINE)
        for line in file_lines:
            if not line.endswith(b"\n"):
                self.half_written = len(line)
                break
            record = unseal(line)
            if record is None or (record.number - 1, record.previous) != self.head:
                self.finding = self._broken(record, unseal(next(file_lines, b"")), file_lines)
                return
            if record.number == number and record.digest != digest:
                why = "is not the one that the head is of: records up to it were written anew"
                self.finding = Finding(number, f"record {number} {why}")
                return
            self.head, self.size = Head(record.number, record.digest), self.size + len(line)
            yield record
        if (last := self.head.number) < number:
            why = f"the log ends with {last}: its end was cut off"
            self.finding = Finding(last + 1, f"the head was record {number}, but {why}")

    def _broken(self, here: Record | None, after: Record | None, rest: Iterator[bytes]) -> Finding:
        """What is wrong with the line after the head, which holds ``here``."""
        at = self.head.number + 1
        if at == 1 and here is None and after is None and not any(map(unseal, rest)):
            raise ValueError(f"{self.path} is no audit log or journal: no line of it is a record")
        if here is None:
            why = "its hash is not that of what it says"
        elif here.number != at:
            first = at if here.previous == self.head.digest else min(at, here.number)
            why = "records were removed, moved, repeated, inserted or numbered anew"
            return Finding(first, f"record {first} is not there once: {why}")
        elif at > 1 and (after is None or after.previous == here.digest):
            # The next record says that this one is as it was; of the last one nothing does.
            at, why = at - 1, f"record {at} is chained to another hash than it has"
        else:
            why = f"it is not chained to record {at - 1}, or was inserted"
        return Finding(at, f"record {at} was altered: {why}")


def lines(path: Path, longest: int) -> Iterator[bytes]:
    """The lines of a file, the last perhaps without an end; of one that grows, those now there.

    None may be longer [byte], as in a file of another kind: it would take all memory.
    """
    with open(path, "rb") as file:
        status = os.fstat(file.fileno())
        remainder = status.st_size if stat.S_ISREG(status.st_mode) else sys.maxsize
        while line := file.readline(min(longest + 1, remainder)):
            if len(line) > longest:
                text = f"{path} has a line of more than {longest >> 20} MiB"
                raise ValueError(f"{text}: is it another kind of file?")
            remainder -= len(line)
            yield line


class Ledger:
    """A chain of records in a file that no other process writes. Close it.

    A half-written end is cut off. What the first record is ``about`` tells it from other files.
    """

    _about: ClassVar[str]
    _remedy: ClassVar[str]  # where it was tampered with

    def __init__(
        self, path: Path, otherwise: str, take: Callable[[dict[str, Any]], object] = lambda _: None
    ) -> None:
        """Let ``take`` have the records that are there; an error says what to do ``otherwise``."""
        self.path = path
        #: The last record. Keep it elsewhere: it shows what is cut off or written anew later.
        self.head = NOTHING
        self._size = 0  # up to there [byte]
        self._owner = os.getpid()
        self._file = FileIO(path, "a+")
        try:
            self._lock(is_ours=True)
            if os.fstat(self._file.fileno()).st_ino != os.stat(path).st_ino:  # just replaced
                raise BlockingIOError
            self._read(take)
        except BlockingIOError:
            self._file.close()
            why = "is being written by another process; wait for its end, or"
            raise ValueError(f"{path} {why} {otherwise}") from None
        except BaseException:
            self._file.close()
            raise

    def force(self) -> None:
        """Force what was written onto the disk; an OSError where the file was removed."""
        os.fsync(self._file.fileno())
        status, path = os.fstat(self._file.fileno()), self.path
        if not (status.st_nlink or (path.exists() and os.path.samestat(status, path.stat()))):
            raise FileNotFoundError(errno.ENOENT, "the file was removed", str(path))

    def close(self) -> None:
        """Let others have the file."""
        if self._is_owner():  # also where a child of this process still has the file open
            self._lock(is_ours=False)
        self._file.close()

    def _lock(self, *, is_ours: bool) -> None:
        """Lock it against other processes, or unlock it, where the system can."""
        with suppress(ModuleNotFoundError):  # Windows
            import fcntl

            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB if is_ours else fcntl.LOCK_UN)

    def _read(self, take: Callable[[dict[str, Any]], object]) -> None:
        """Find the last whole record; a part of one after it is cut off."""
        chain = Chain(self.path)
        for record in chain.records():
            take(record.content)
        if chain.finding is not None:
            fault = f"was tampered with, and is left as it is: {chain.finding.explanation}"
            raise ValueError(f"{self.path} {fault}; {self._remedy}")
        prefix = f'{{"about":"{self._about}",'.encode()
        self._file.seek(0)
        if not prefix.startswith(self._file.read(len(prefix))):
            raise ValueError(f"{self.path} is no {self._about}; it was left alone")
        self.head, self._size = chain.head, chain.size
        if chain.half_written:
            self._cut()
            _log.warning("%s: a half-written record was cut off", self.path)

    def _append(self, content: Mapping[str, Any]) -> None:
        """Add a record, or nothing of it."""
        if os.getpid() != self._owner:
            why = "the log belongs to the process that opened it; a child of that needs its own"
            raise PermissionError(errno.EPERM, why, str(self.path))
        self._cut()  # what could not be cut off then
        data, head = seal(content, self.head)
        size = self._size + len(data)
        try:
            while data:  # a disk that gets full takes a part of it first
                data = data[self._file.write(data) :]
        except OSError:
            with suppress(OSError):
                self._cut()
            raise
        self.head, self._size = head, size

    def _cut(self) -> None:
        """Cut off what was taken back, or is half of a record."""
        if self._is_owner() and os.fstat(self._file.fileno()).st_size > self._size:
            self._file.truncate(self._size)

    def _is_owner(self) -> bool:
        return os.getpid() == self._owner and not self._file.closed


class Recorder(DecisionLogger):
    """Makes one record of each thing that a guard is told or decides: its kind, and what it says.

    What was seen waits for what is decided on it, and is a record of its own where nothing is.
    """

    def __init__(self) -> None:
        self._guard: Guard | None = None  # of the episode under way
        self._learnt: dict[str, str] | None = None  # as the latest one ended
        self._settings: dict[str, Any] = {}  # as they were recorded last
        self._row: dict[str, Any] = {}  # what was seen, and not decided on yet

    def _record(self, kind: str, **content: Any) -> None:
        raise NotImplementedError

    def begin(self, guard: Guard) -> None:
        """An episode begins."""
        self._flush()  # of one that was broken off
        self._guard, self._learnt = guard, None
        self._note_settings(guard)
        self._record("begin")

    def seen(self, observation: Floats, time: float) -> None:
        """An observation came in, at ``time`` [s]."""
        if self._guard is None:
            raise ValueError("the log was given to a guard within an episode; give it before one")
        self._flush()
        self._row = {"observation": observation.tolist(), "time": float(time)}

    def decided(self, situation: Situation, proposal: Proposal, revision: Revision) -> None:
        """A decision was made. When this returns it is recorded."""
        if self._guard is None:
            return
        if not self._row:
            raise ValueError("a log holds one decision on an observation; recognise it once more")
        self._note_settings(self._guard)
        mask = None if proposal.mask is None else proposal.mask.tolist()
        row, self._row = self._row | {"mask": mask, "proposed": written(proposal.action)}, {}
        if is_spoken(self._guard.reviser, revision):
            self._record("decision", **row, **decision_of(situation, revision))
        else:
            self._record("quiet", **row)

    def ended(self, observation: Any, **how: Any) -> None:
        """The episode ended."""
        if self._guard is None:
            return
        self._flush()
        self._learnt, self._guard = digests_of(self._guard), None
        last = None if observation is None else observation.tolist()
        self._record("end", learnt=self._learnt, observation=last, **how)

    def _note_settings(self, guard: Guard) -> None:
        """Record the settings, if they were changed."""
        if (now := settings_now(guard)) != self._settings:
            self._settings = now
            self._record("settings", settings=now)

    def _flush(self) -> None:
        """Record what was seen and not decided on."""
        row, self._row = self._row, {}
        if row:
            self._record("seen", **row)


class AuditLog(Ledger, Recorder, AbstractContextManager["AuditLog"]):
    """Logs what a guard decides, so that nobody can change it unnoticed: ``Guard(..., audit=log)``.

    Where the disk fails while driving, the log is broken off there, which is logged, and raised as
    the episode ends, or the next one begins. Without the log, or with another, the same call works.

    Parameters
    ----------
    path : Path
        A file that is there is gone on with; a half-written end is cut off.
    sync : {"record", "episode"}
        When records are forced onto the disk: those that say something before their action is
        executed (of others a power cut may lose 240), or all of an episode at its end, which takes
        no time while driving.

    Raises
    ------
    OSError
        If the file cannot be written.
    ValueError
        If it was tampered with, is no log, or is being written by another process. It is then
        left as it is.

    Notes
    -----
    Between the episodes of a log anything may teach machine or judge, during one nothing else may.
    What a guard takes back is taken back here, too. Where a process forks, the log stays with the
    parent. The example of `audit` writes a log.
    """

    _about = "evofsm audit log"
    _remedy = "name another file"

    def __init__(self, path: Path, *, sync: Literal["record", "episode"] = "record") -> None:
        Ledger.__init__(self, path, "name another file")
        Recorder.__init__(self)
        self.sync = sync
        self._failure: OSError | None = None
        self._who: tuple[Any, ...] = ()  # what the guard of the latest episode was made of
        self._known: list[str] = []  # what it holds of what a guard is now told again

    def close(self) -> None:
        """Write what was held back; an OSError if that failed, now or before."""
        if not self._is_owner():  # it is closed, or what is held back is the parent's to write
            return super().close()
        try:
            self._flush()
            self._try(self.force)
        finally:
            super().close()
        self._raise()

    def __exit__(self, *error: object) -> None:
        self.close()

    def go_on(self) -> None:
        """Go on after a failure; a file that was removed or cut meanwhile is read anew."""
        if self._is_owner() and self.path.exists():
            status, now = os.fstat(self._file.fileno()), self.path.stat()
            if os.path.samestat(status, now) and now.st_size >= self._size:
                self._failure = None
                return Recorder.__init__(self)  # the guard is written down again
        super().close()
        AuditLog.__init__(self, self.path, sync=self.sync)

    def told_again(self, after: Head) -> None:
        """Write nothing twice of what followed a record, as a guard is told that once more."""
        records = Chain(self.path).records()
        if after == NOTHING or any(after.digest == record.digest for record in records):
            contents = (record.content for record in records)
            self._known = [_event(content) for content in contents if content["kind"] != "start"]

    def begin(self, guard: Guard) -> None:
        """An episode begins; an OSError if something could not be written since the one before."""
        self._flush()
        is_replayable = can_be_made_again(guard)
        parts = guard.reviser, guard.machine, guard.judge, guard.failed, is_replayable
        if self._learnt != digests_of(guard) or any(map(is_not, parts, self._who)):
            self._settings = settings_now(guard)
            self._record("start", settings=self._settings, **_start(guard))
        self._who = parts
        super().begin(guard)
        self._raise()

    def ended(self, observation: Any, **how: Any) -> None:
        """The episode ended; an OSError if something could not be written since it began."""
        super().ended(observation, **how)
        self._raise()

    def savepoint(self) -> Rollback:
        """What takes back all that is logged from now on, in the file, too."""
        take_back = as_now(self)

        def rollback() -> None:
            take_back()
            with suppress(OSError):  # else before more is written
                self._cut()

        return rollback

    def _record(self, kind: str, **content: Any) -> None:
        record = {"kind": kind, "clock": datetime.now(UTC).isoformat(), **content}
        if self._known:
            is_next = self._known[0] == _event(record)
            if is_next or kind == "start":
                self._known = self._known[is_next:]
                return
            self._known = []  # after what is not, all is new
        self._try(lambda: self._append(record))
        speaks = kind not in ("seen", "quiet") or self.head.number % _MOST_QUIET == 0
        if kind in ("begin", "end") or (self.sync == "record" and speaks):
            self._try(self.force)

    def _try(self, write: Callable[[], None]) -> None:
        """Write, unless that failed before; a failure is raised later."""
        if self._failure is None:
            try:
                write()
            except OSError as error:
                why = f"{error.strerror}; the audit log ends with record {self.head.number}"
                advice = "go on with another one, or with none (guard.audit = None)"
                self._failure = OSError(error.errno, f"{why}: {advice}", str(self.path))
                _log.error("%s", self._failure)

    def _raise(self) -> None:
        if self._failure is not None:
            raise self._failure


def _event(content: Mapping[str, Any]) -> str:
    """What a guard was told, whatever came of it."""
    return canonical([content["kind"], content.get("time"), content.get("observation")])


# -- What is written ------------------------------------------------------------------------------


#: What computes: floats are the same to the last bit only where this is.
MADE_BY: Mapping[str, str] = {
    "evofsm": evofsm.__version__,
    "numba": numba.__version__,
    "numpy": np.__version__,
    "processor": platform.machine(),
    "python": platform.python_version(),
}


def _start(guard: Guard) -> dict[str, Any]:
    file = BytesIO()
    if can_be_made_again(guard):
        guard.save(file)
    if is_too_large := file.tell() > _LONGEST_LINE // 2:
        _log.warning("the guard is too large for an audit log: it will not be replayed")
    data = b"" if is_too_large else file.getvalue()
    return {
        "about": AuditLog._about,
        "guard": base64.b64encode(data).decode() or None,
        "made_by": MADE_BY,
        "reviser": type(guard.reviser).__name__,
        "told_failures": guard.failed is not None,
        "version": LOG_VERSION,
    }


def settings_now(guard: Guard) -> dict[str, Any]:
    """What may be changed between episodes; and, of the reviser, while driving."""
    settings = {name: getattr(guard, name) for name in SETTINGS}
    return {**settings, "reviser": settings_of(guard.reviser)}


def digests_of(guard: Guard) -> dict[str, str]:
    """The SHA-256 of what machine and judge would save now."""
    digests = {}
    for name in ("machine", "judge"):
        if (part := getattr(guard, name)) is not None:
            part.save(file := BytesIO())
            digests[name] = sha256(file.getvalue()).hexdigest()
    return digests


def decision_of(situation: Situation, revision: Revision) -> dict[str, Any]:
    """What was decided, but for what came in."""
    likely = np.argsort(-situation.belief, kind="stable")[:_STATES].tolist()
    decision = Decision(situation, revision)
    return {
        **{name: _plain(RECORD[name].kind, RECORD[name].read(decision)) for name in _DECIDED},
        "belief": [[state, float(situation.belief[state])] for state in likely],
    }


def _plain(kind: type, value: Any) -> Any:
    return None if value is None else written(value) if kind is float else kind(value)


# -- Auditing -------------------------------------------------------------------------------------

# What a record that someone made up may run into.
_NONSENSE = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError)
_NO_FUNCTION = (
    "the guard was given a function that says where it fails, and no log holds code; give it as "
    "failed (--failed MODULE:FUNCTION, or the condition as the monitor was given it)"
)
# What is said of records that come out otherwise, but of decisions.
_OTHERWISE = dict.fromkeys(("start", "settings"), "there are no such settings")
_OTHERWISE["end"] = "something else was learnt until its end"
_Failed = Callable[[Floats], bool]


class Contents(NamedTuple):
    """What a log holds."""

    sessions: int  #: times that the guard was written down
    episodes: int
    decisions: int
    spoke: int  #: decisions that changed something or raised an alarm
    settings: int  #: times that settings were changed while driving


class Audit(NamedTuple):
    """All that is found out about a log."""

    head: Head  #: the last record up to which it is what was written
    half_written: int  #: what a last line without an end holds, as after a crash [byte]
    finding: Finding | None  #: None where nothing was tampered with
    contents: Contents  #: of the records up to there
    replayed: int  #: decisions that came out as they were recorded
    difference: Finding | None  #: the first record that does not come out again
    not_replayed: tuple[str, ...]  #: why not, of each session that could not be
    other_makers: tuple[Field, ...]  #: what computed then and what does now, where that differs

    @property
    def is_good(self) -> bool:
        """Whether nothing was tampered with, and nothing came out otherwise."""
        return self.finding is None and self.difference is None


def audit(path: Path, kept: Head | None = None, *, failed: _Failed | None = None) -> Audit:
    """Verify the chain of a log and the form of its records, and decide again.

    Parameters
    ----------
    path : Path
        A log that is being written is audited up to where it is now.
    kept : Head, optional
        A head that was kept elsewhere.
    failed : callable, optional
        As the guard had it: no log holds code. Without it such episodes are not replayed.

    Raises
    ------
    OSError, ValueError
        If the file cannot be read, or is no audit log.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from evofsm.driving import guard_for_cars
    >>> from evofsm.guard import AuditLog
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "audit.jsonl"
    ...     with AuditLog(path) as log:
    ...         guard = guard_for_cars(low=-2.5, high=2.5, audit=log)
    ...         revision = guard.decide([9.0, 20.0, 10.0], proposal=1.0)
    ...         guard.end(observation=[7.0, 19.0, 10.0])
    ...     found = audit(path, log.head)
    ...     forged = path.read_text().replace('"executed":-2.5', '"executed":2.5')
    ...     _ = path.write_text(forged)
    ...     audit(path).finding
    Finding(record=3, explanation='record 3 was altered: its hash is not that of what it says', \
fields=())
    >>> revision.executed, found.head.number, found.replayed, found.is_good
    (-2.5, 4, 1, True)
    """
    chain, counts, player = Chain(path, kept), Counter[str](), _Player(failed)
    fault = difference = None
    for record in chain.records():
        fault = _misfit(record, started=counts["start"] > 0)
        if fault is not None:
            break
        counts[record.content["kind"]] += 1
        difference = difference or player.play(record)
    fault = fault or chain.finding
    if chain.head == NOTHING and fault is None:
        raise ValueError(f"{path} is no audit log, or no record of it was finished")
    kinds = ("start", "begin", "quiet", "decision", "settings")
    sessions, episodes, quiet, spoke, changes = (counts[kind] for kind in kinds)
    return Audit(
        head=chain.head,
        half_written=chain.half_written,
        finding=fault,
        contents=Contents(sessions, episodes, quiet + spoke, spoke, changes),
        replayed=player.decisions,
        difference=difference,
        not_replayed=tuple(player.not_replayed),
        other_makers=tuple(player.other_makers.values()),
    )


def _misfit(record: Record, *, started: bool) -> Finding | None:
    """What no log holds: a chain says nothing about it, nor does replaying."""
    content = record.content
    kind, version = content.get("kind"), content.get("version", LOG_VERSION)
    why = ""
    if not isinstance(kind, str) or kind not in FIELDS:
        why = f"there is no kind {str(kind)[:40]!r}"
    elif repr(version) != repr(LOG_VERSION):
        why = f"its version is {version!r}, not {LOG_VERSION} (did a newer evofsm write it?)"
    elif kind != "start" and not started:
        why = "it comes before the guard that decides"
    elif names := sorted((FIELDS[kind] | {"kind", "clock"}) ^ content.keys()):
        has = "has" if names[0] in content else "lacks"
        why = f"a record of kind {kind!r} {has} {names[0][:40]!r}"
    return Finding(record.number, f"record {record.number} was forged: {why}") if why else None


class _Player(Recorder):
    """The guard that a log began with, told again what happened; and what it records of that."""

    def __init__(self, failed: _Failed | None) -> None:
        super().__init__()
        self.decisions = 0  #: that came out as they were recorded
        self.not_replayed: list[str] = []
        self.other_makers: dict[str, Field] = {}
        self._failed = failed
        self._told: Guard | None = None  # None while a session cannot be replayed
        self._outputs: list[dict[str, Any]] = []  # what it recorded of the latest record

    def _record(self, kind: str, **content: Any) -> None:
        self._outputs.append({"kind": kind, **content})

    def play(self, record: Record) -> Finding | None:
        """What differs; None where it comes out as it was recorded."""
        content, kind, self._outputs = record.content, record.content["kind"], []
        try:
            if kind == "start":
                self._start(content)
            elif self._told is not None:
                self._tell(self._told, content)
            if self._told is None:
                return None
            if len(self._outputs) != 1:
                raise ValueError("it does not follow from what came before")
            fields = self._differing(content, self._outputs[0])
        except _NONSENSE as error:
            text = f"there is no {error}" if isinstance(error, KeyError) else str(error)
            return Finding(record.number, f"it cannot be replayed: {text}")
        if fields:
            decision = f"the decision at {content.get('time')} s comes out otherwise"
            return Finding(record.number, _OTHERWISE.get(kind, decision), fields)
        self.decisions += kind in ("quiet", "decision")
        return None

    def _start(self, content: Mapping[str, Any]) -> None:
        for name, then in content["made_by"].items():
            if then != (now := MADE_BY.get(name, "")):
                self.other_makers[name] = Field(name, str(then), now)
        self._told, needs_code = None, content["told_failures"]
        if content["guard"] is None:
            self.not_replayed.append(
                f"{content['reviser']} or its judge is not known here, or was not told what "
                "happened, or the guard is too large, or learnt with model= or backup= (code)"
            )
        elif needs_code and self._failed is None:
            self.not_replayed.append(_NO_FUNCTION)
        else:
            file = BytesIO(base64.b64decode(content["guard"], validate=True))
            self._told = Guard.load(file, failed=self._failed if needs_code else None)
            self._told.audit = self
            self._settings = settings_now(self._told)
            self._record(**{**content, "settings": self._settings})

    def _tell(self, guard: Guard, content: Mapping[str, Any]) -> None:
        kind = content["kind"]
        if kind == "begin":
            guard.begin()
        elif kind == "settings":
            settings = content["settings"]
            for name in SETTINGS:
                if getattr(guard, name) != settings[name]:
                    setattr(guard, name, settings[name])
            set_again(guard.reviser, settings["reviser"])
            self._note_settings(guard)
        elif kind == "end":
            last = content["observation"]
            how = {name: content[name] for name in ("failed", "terminated", "score")}
            guard.end(observation=None if last is None else _numbers(last), **how)
        else:
            observation, time = _numbers(content["observation"]), _numbers(content["time"])
            situation = guard.recognise(observation, time)
            if kind == "seen":
                self._flush()
            else:
                proposal = Proposal(_numbers(content["proposed"]), content["mask"])
                guard.revise(situation, proposed(guard.actions, proposal))

    def _differing(self, *contents: Mapping[str, Any]) -> tuple[Field, ...]:
        """What a log and this say otherwise of one thing."""
        before, after = (
            {"executed": content.get("proposed"), **content, **content.get("settings", {})}
            for content in contents
        )
        if "evofsm" not in self.other_makers:  # whose version stands in what is saved
            before, after = before | before.get("learnt", {}), after | after.get("learnt", {})
        names = sorted((before.keys() | after.keys()) - {"clock", "learnt", "settings"})
        texts = [(name, canonical(before.get(name)), canonical(after.get(name))) for name in names]
        return tuple(Field(name, then, now) for name, then, now in texts if then != now)


def _numbers(value: Any) -> Any:
    """A number, or an array of a list of them, from what JSON holds of them."""
    if isinstance(value, list):
        return np.array([_numbers(number) for number in value])
    if value in ("NaN", "Infinity", "-Infinity"):
        return float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{value!r} stands where a number should")
    return float(value)

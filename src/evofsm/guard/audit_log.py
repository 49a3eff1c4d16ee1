"""The audit log of a guard: what it decided, so that nobody can change it unnoticed.

docs/audit.md says what is in a record, a JSON object on a line of its own. ``hash``, its last, is
the SHA-256 of the line up to the comma before it, and ``previous`` that of the record before (zeros
for the first): a hash chain as in Haber and Stornetta (J. Cryptology 3, 1991). A row of ``before``
is ``[time, observation]``, with the proposal after that if there was one, and with its mask if it
had one.

An audit also decides again, without a world: what was observed and proposed is told to the guard
that the log began with, and each decision must come out as it was recorded, to the last bit. So
neither a forged decision nor a forged model hides behind a chain that was made anew.
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
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from datetime import UTC, datetime
from hashlib import sha256
from io import BytesIO, FileIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numba
import numpy as np

import evofsm
from evofsm.fsm.sharing import Rollback
from evofsm.fsm.validation import Floats
from evofsm.guard.actions import checked_mask, written
from evofsm.guard.api import Proposal, Revision, Situation
from evofsm.guard.guard import DecisionLogger, Guard
from evofsm.guard.loop import Decision
from evofsm.guard.parts import can_be_made_again, set_again, settings_of
from evofsm.guard.record import RECORD
from evofsm.guard.reviser import is_spoken

_log = logging.getLogger(__name__)

LOG_VERSION = 1
#: What may be changed about a guard between episodes.
SETTINGS = ("explaining", "interval", "learn", "shadow")
# Most probable states of a belief that are written; decisions that are held back at most, which a
# kill loses; and bytes of a line, which holds a machine at most.
_STATES, _MOST_QUIET, _LONGEST_LINE = 3, 240, 1 << 26
_SEAL, _LINE_END = b',"hash":"', b'"}\n'
# What a decision tells as it is recorded elsewhere, too.
_TOLD = tuple(name for name in RECORD if name not in ("time", "n_states", "risk_low", "risk_high"))
#: The names in a record of each kind, beside ``kind`` and ``clock``.
FIELDS: Mapping[str, set[str]] = {
    "start": {"about", "guard", "made_by", "reviser", "told_failures", "version"},
    "begin": {"settings"},
    "decision": {"before", "belief", "interval", "mask", "observation", "time", *_TOLD},
    "quiet": {"before"},
    "settings": {"settings"},
    "end": {"before", "failed", "learnt", "observation", "score", "terminated"},
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
    text = canonical({**content, "number": number, "previous": after.digest}).encode()[:-1]
    digest = sha256(text).hexdigest()
    return text + _SEAL + digest.encode() + _LINE_END, Head(number, digest)


def unseal(line: bytes) -> Record | None:
    """The record that a line holds; None where it is not as `seal` writes it."""
    text, _, end = line.rpartition(_SEAL)
    digest = sha256(text).hexdigest()
    if end != digest.encode() + _LINE_END:
        return None
    try:
        content = json.loads(text + b"}")
        # Of the ways to write it, names given twice among them, only one is `seal`'s.
        if canonical(content).encode()[:-1] != text:
            return None
        number, previous = content.pop("number"), content.pop("previous")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    whole = type(number) is int and isinstance(previous, str)
    return Record(number, previous, digest, content) if whole else None


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
        self._kept = kept

    def records(self) -> Iterator[Record]:
        """The records, after which `finding` is known; a ValueError if there is none."""
        has_head = self._kept in (None, NOTHING)
        file_lines = lines(self.path, _LONGEST_LINE)
        for line in file_lines:
            if not line.endswith(b"\n"):
                self.half_written = len(line)
                break
            record = unseal(line)
            if record is None or (record.number - 1, record.previous) != self.head:
                self.finding = self._broken(record, unseal(next(file_lines, b"")), file_lines)
                return
            self.head, self.size = Head(record.number, record.digest), self.size + len(line)
            has_head = has_head or self._kept == self.head
            yield record
        if not has_head and self._kept is not None:
            self.finding = _against(self._kept, self.head)

    def _broken(self, here: Record | None, after: Record | None, rest: Iterator[bytes]) -> Finding:
        """What is wrong with the line after the head, which holds ``here``."""
        at = self.head.number + 1
        if at == 1 and here is None and after is None and not any(map(unseal, rest)):
            raise ValueError(f"{self.path} is no audit log or journal: no line of it is a record")
        if here is None:
            why = "its hash is not that of what it says"
        elif here.previous == self.head.digest:
            why = f"it says that it is record {here.number}"
        elif here.number != at:
            first = min(at, here.number)
            why = "records were removed, moved, repeated or inserted"
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


def _against(kept: Head, head: Head) -> Finding:
    """Why a whole chain has not the head that was kept."""
    last, number = head.number, kept.number
    if number > last:
        why = f"the head was record {number}, but the log ends with {last}: its end was cut off"
        return Finding(last + 1, why)
    why = f"record {number} is not the one that the head is of: records up to it were written anew"
    return Finding(number, why)


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
        """Force what was written onto the disk."""
        os.fsync(self._file.fileno())

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
            raise ValueError(
                f"{self.path} was tampered with, and is left as it is: "
                f"{chain.finding.explanation}; {self._remedy}"
            )
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


class AuditLog(Ledger, AbstractContextManager["AuditLog"], DecisionLogger):
    """Logs what a guard decides, so that nobody can change it unnoticed: ``Guard(..., audit=log)``.

    Where the disk fails while driving, the log is broken off there, which is logged, and raised as
    the episode ends, or the next one begins. Without the log, or with another, the same call works.

    Parameters
    ----------
    path : Path
        A file that is there is gone on with; a half-written end is cut off.
    sync : {"record", "episode"}
        When records are forced onto the disk: each, before its action is executed, or those of an
        episode at its end, which takes no time while driving.

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
        super().__init__(path, "name another file")
        self.sync = sync
        self._failure: OSError | None = None
        self._guard: Guard | None = None
        self._who: tuple[Any, ...] = ()  # what the guard of the latest episode was made of
        self._learnt: dict[str, str] | None = None  # as that episode ended
        self._settings: dict[str, Any] = {}
        self._before: list[list[Any]] = []
        self._known: list[str] = []  # what it holds of what a guard is now told again

    def close(self) -> None:
        """Write what was held back; an OSError if that failed, now or before."""
        if self._file.closed:
            return
        try:
            if self._is_owner():  # what is held back is the parent's to write
                self._flush()
                if self.sync == "episode":
                    self._try(self.force)
        finally:
            super().close()
        self._raise()

    def __exit__(self, *error: object) -> None:
        self.close()

    def told_again(self, after: Head) -> None:
        """Write nothing twice of what followed a record, as a guard is told that once more."""
        records = Chain(self.path).records()
        if after == NOTHING or any(after.digest == record.digest for record in records):
            for _, _, _, content in records:
                self._known += [canonical(row[:2]) for row in content.get("before", ())]
                if content["kind"] == "decision":
                    self._known.append(canonical([content["time"], content["observation"]]))
                elif content["kind"] in ("begin", "end"):
                    self._known.append(content["kind"])

    def _is_known(self, what: str) -> bool:
        """Whether it is next of what is told again; after what is not, all is new."""
        is_known = self._known[:1] == [what]
        self._known = self._known[1:] if is_known else []
        return is_known

    # -- As a guard's decision logger -------------------------------------------------------------

    def begin(self, guard: Guard) -> None:
        """An episode begins."""
        self._raise()
        self._flush()  # of an episode that was broken off
        parts = (guard.reviser, guard.machine, guard.judge, guard.failed, _asks_code(guard))
        if list(map(id, parts)) != list(map(id, self._who)) or self._learnt != digests_of(guard):
            self._write("start", **_start(guard))
        self._guard, self._who, self._learnt = guard, parts, None
        self._settings = settings_now(guard)
        self._write("begin", settings=self._settings)
        self._raise()

    def seen(self, observation: Floats, time: float) -> None:
        """An observation came in, at ``time`` [s]."""
        if self._guard is None:
            raise ValueError("the log was given to a guard within an episode; give it before one")
        self._before.append([float(time), observation.tolist()])

    def decided(self, situation: Situation, proposal: Proposal, revision: Revision) -> None:
        """A decision was made. When this returns it is written down, if it said something."""
        if self._guard is None:
            return
        time, observation = self._before.pop()
        if self._known and self._is_known(canonical([time, observation])):
            return
        now = settings_now(self._guard)
        if now != self._settings:
            self._flush()
            self._write("settings", settings=now)
            self._settings = now
        if is_spoken(self._guard.reviser, revision):
            decision = decision_of(situation, proposal, revision)
            self._write("decision", time=time, observation=observation, **decision)
        else:
            masks = [] if proposal.mask is None else [proposal.mask.tolist()]
            self._before.append([time, observation, written(proposal.action), *masks])
            if len(self._before) >= _MOST_QUIET:
                self._flush()

    def ended(
        self, observation: Any, *, failed: bool, terminated: bool, score: float | None
    ) -> None:
        """The episode ended; an OSError if something could not be written since it began."""
        if self._guard is None:
            return
        self._learnt = digests_of(self._guard)
        last = None if observation is None else observation.tolist()
        how = {"failed": bool(failed), "terminated": terminated, "score": score}
        self._write("end", learnt=self._learnt, observation=last, **how)
        self._guard = None
        self._raise()

    def savepoint(self) -> Rollback:
        """What takes back all that is logged from now on, in the file, too."""
        attributes = {**self.__dict__, "_before": [*self._before]}

        def rollback() -> None:
            self.__dict__.update(attributes)
            with suppress(OSError):  # else before more is written
                self._cut()

        return rollback

    def _flush(self) -> None:
        if self._before:
            self._write("quiet")

    def _write(self, kind: str, **content: Any) -> None:
        if self._known and (kind == "start" or self._is_known(kind)):
            return
        if "before" in FIELDS[kind]:
            content["before"], self._before = self._before, []
        record = {"kind": kind, "clock": datetime.now(UTC).isoformat(), **content}
        self._try(lambda: self._append(record))
        if self.sync == "record" or kind in ("begin", "end"):
            self._try(self.force)

    def _try(self, write: Callable[[], None]) -> None:
        """Write, unless that failed before; a failure is raised later."""
        if self._failure is None:
            try:
                write()
            except OSError as error:
                self._failure = error
                record = self.head.number
                _log.error("the audit log %s ends with record %s: %s", self.path, record, error)

    def _raise(self) -> None:
        if self._failure is not None:
            raise OSError(
                self._failure.errno,
                f"{self._failure.strerror}; the audit log ends with record {self.head.number}: go "
                "on with another one, or with none (guard.audit = None)",
                str(self.path),
            ) from self._failure


# -- What is written ------------------------------------------------------------------------------


def made_by() -> dict[str, str]:
    """What computes: floats are the same to the last bit only where this is."""
    return {
        "evofsm": evofsm.__version__,
        "numba": numba.__version__,
        "numpy": np.__version__,
        "processor": platform.machine(),
        "python": platform.python_version(),
    }


def _asks_code(guard: Guard) -> bool:
    """Whether what it learns hangs on a model or a backup that it was given: no log holds code."""
    functions = (getattr(guard.judge, "__dict__", {}).get(name) for name in ("model", "backup"))
    return guard.learn and any(map(callable, functions))


def _start(guard: Guard) -> dict[str, Any]:
    file = BytesIO()
    if is_replayable := can_be_made_again(guard) and not _asks_code(guard):
        guard.save(file)
        if not (is_replayable := file.tell() < _LONGEST_LINE // 2):
            _log.warning("the guard is too large for an audit log: it will not be replayed")
    return {
        "about": AuditLog._about,
        "guard": base64.b64encode(file.getvalue()).decode() if is_replayable else None,
        "made_by": made_by(),
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


def decision_of(situation: Situation, proposal: Proposal, revision: Revision) -> dict[str, Any]:
    """A decision, as it is written, but for what came in."""
    likely = np.argsort(-situation.belief, kind="stable")[:_STATES].tolist()
    decision = Decision(situation, revision._replace(proposed=proposal.action))
    return {
        **{name: _plain(RECORD[name].kind, RECORD[name].read(decision)) for name in _TOLD},
        "belief": [[state, float(situation.belief[state])] for state in likely],
        "interval": [float(bound) for bound in revision.interval],
        "mask": None if proposal.mask is None else proposal.mask.tolist(),
    }


def _plain(kind: type, value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return written(value)
    return None if value is None else kind(value)


# -- Auditing -------------------------------------------------------------------------------------

# What a record that someone made up may run into.
_NONSENSE = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError)
_NO_FUNCTION = (
    "the guard was given a function that says where it fails, and no log holds code; give it as "
    "failed (--failed MODULE:FUNCTION)"
)
# Where there is a decision logger, decisions that speak are explained.
_DEAF: Any = SimpleNamespace(
    **dict.fromkeys(("begin", "seen", "decided", "ended"), lambda *told, **rest: None)
)
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
        kind, before = record.content["kind"], record.content.get("before", ())
        counts[kind] += 1
        counts["all decisions"] += len(before) + (kind == "decision")
        if difference is None:
            difference = player.play(record)
    fault = fault or chain.finding
    if chain.head == NOTHING and fault is None:
        raise ValueError(f"{path} is no audit log, or no record of it was finished")
    names = "start", "begin", "all decisions", "decision", "settings"
    return Audit(
        head=chain.head,
        half_written=chain.half_written,
        finding=fault,
        contents=Contents(*(counts[name] for name in names)),
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
    elif type(version) is not int or version != LOG_VERSION:
        why = f"its version is {version!r}, not {LOG_VERSION} (did a newer evofsm write it?)"
    elif kind != "start" and not started:
        why = "it comes before the guard that decides"
    elif names := sorted((FIELDS[kind] | {"kind", "clock"}) ^ content.keys()):
        has = "has" if names[0] in content else "lacks"
        why = f"a record of kind {kind!r} {has} {names[0][:40]!r}"
    elif not isinstance(content.get("before", []), list):
        why = "what it holds before it is no list"
    return Finding(record.number, f"record {record.number} was forged: {why}") if why else None


class _DiffersError(Exception):
    """Something came out otherwise: an explanation, and the fields."""


class _Player:
    """The guard that a log began with, told again what happened."""

    def __init__(self, failed: _Failed | None) -> None:
        self.decisions = 0
        self.not_replayed: list[str] = []
        self.other_makers: dict[str, Field] = {}
        self._failed = failed
        self._guard: Guard | None = None  # None while a session cannot be replayed

    def play(self, record: Record) -> Finding | None:
        """What differs; None where it comes out as it was recorded."""
        try:
            self._play(record.content)
        except _DiffersError as differs:
            return Finding(record.number, *differs.args)
        except _NONSENSE as error:
            text = f"there is no {error}" if isinstance(error, KeyError) else str(error)
            return Finding(record.number, f"it cannot be replayed: {text}")
        return None

    def _play(self, content: Mapping[str, Any]) -> None:
        kind, before, guard = content["kind"], content.get("before", ()), self._guard
        if kind == "start":
            self._start(content)
        elif guard is not None:
            if not guard._under_way and (before or kind in ("decision", "end")):
                raise ValueError("it belongs to no episode")
            for row in before:
                self._row(guard, None, row)
            if kind in ("begin", "settings"):
                self._set(guard, content["settings"])
            if kind == "begin":
                guard.begin()
            elif kind == "decision":
                names = ("time", "observation", "proposed", "mask")
                self._row(guard, content, [content[name] for name in names])
            elif kind == "end":
                self._end(guard, content)

    def _start(self, content: Mapping[str, Any]) -> None:
        now = made_by()
        for name, then in content["made_by"].items():
            if then != now.get(name):
                self.other_makers[name] = Field(name, str(then), now.get(name, ""))
        self._guard, needs_code = None, content["told_failures"]
        if content["guard"] is None:
            self.not_replayed.append(
                f"{content['reviser']} or its judge is not known here, or was not told what "
                "happened, or the guard is too large, or learnt with model= or backup= (code)"
            )
        elif needs_code and self._failed is None:
            self.not_replayed.append(_NO_FUNCTION)
        else:
            file = BytesIO(base64.b64decode(content["guard"], validate=True))
            self._guard = Guard.load(file, failed=self._failed if needs_code else None)
            self._guard.audit = _DEAF

    @staticmethod
    def _set(guard: Guard, settings: Mapping[str, Any]) -> None:
        for name in SETTINGS:
            if getattr(guard, name) != settings[name]:
                setattr(guard, name, settings[name])
        set_again(guard.reviser, settings["reviser"])
        if fields := _differing(settings, settings_now(guard)):
            raise _DiffersError("there are no such settings", fields)

    def _row(self, guard: Guard, content: Mapping[str, Any] | None, row: Sequence[Any]) -> None:
        """A row that was decided on so, or of which nothing was to be said; or not decided on."""
        time, observation, *proposed = row
        situation = guard.recognise(_floats(observation), _number(time))
        if not proposed:
            return
        action, mask = proposed if len(proposed) > 1 else (*proposed, None)
        action = _floats(action) if isinstance(action, list) else _number(action)
        proposal = Proposal(action, checked_mask(guard.actions, mask))
        revision = guard.revise(situation, proposal)
        entry = decision_of(situation, proposal, revision)
        when, speaks = f"the decision at {situation.time:g} s", is_spoken(guard.reviser, revision)
        if content is None and speaks:
            raise _DiffersError(
                f"{when} was recorded as nothing to speak of, but {entry['reason']}",
                (Field("executed", canonical(entry["proposed"]), canonical(entry["executed"])),),
            )
        if content and (fields := _differing({name: content[name] for name in entry}, entry)):
            raise _DiffersError(f"{when} comes out otherwise", fields)
        if content and not speaks:
            raise _DiffersError(f"{when} changed nothing")
        self.decisions += 1

    def _end(self, guard: Guard, content: Mapping[str, Any]) -> None:
        last = content["observation"]
        how = {name: content[name] for name in ("failed", "terminated", "score")}
        guard.end(observation=None if last is None else _floats(last), **how)
        fields = _differing(content["learnt"], digests_of(guard))
        if fields and "evofsm" not in self.other_makers:  # whose version stands in what is saved
            raise _DiffersError("something else was learnt until its end", fields)


def _number(value: Any) -> float:
    if value in ("NaN", "Infinity", "-Infinity"):
        return float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{value!r} stands where a number should")
    return float(value)


def _floats(values: Sequence[Any]) -> Floats:
    return np.array([_number(value) for value in values])


def _differing(recorded: Mapping[str, Any], again: Mapping[str, Any]) -> tuple[Field, ...]:
    before, after = (
        {name: canonical(value) for name, value in of.items()} for of in (recorded, again)
    )
    names = sorted(before.keys() | after.keys())
    fields = [Field(name, before.get(name, ""), after.get(name, "")) for name in names]
    return tuple(field for field in fields if field.recorded != field.replayed)

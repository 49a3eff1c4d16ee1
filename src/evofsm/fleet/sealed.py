"""A file of chained records: what was written can be added to, not changed without a trace.

A record is a JSON object on a line of its own, and its number is that of the line::

    {"kind":"begin",...,"number":2,"previous":"9c1e...","hash":"51b0..."}

``hash`` is the SHA-256 of the line up to the comma before it, in hexadecimal, and ``previous`` that
of the record before (zeros for the first): a hash chain as in Haber and Stornetta (J. Cryptology
3, 1991). Whoever changes, removes, moves or inserts a record breaks the chain at that record,
unless everything after it is written anew, or cut off. That is shown by the *head*, the number and
hash of the last record, where someone has kept it elsewhere.
"""

from __future__ import annotations

import errno
import json
import logging
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from enum import Enum
from hashlib import sha256
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Self

from evofsm import store

_log = logging.getLogger(__name__)

_SEAL = b',"hash":"'
_END = b'"}\n'
_HEX = 64
#: How the first record of a log begins: so a half-written one is told from other people's files.
LOG_HEADER = {"about": "evofsm audit log"}
_OPENING = b'{"about":"evofsm audit log",'
#: What the first record has as the hash of the one before it.
NOTHING = "0" * _HEX
# A longer line is no record: it holds a machine at most.
_LONGEST = 1 << 29
_HEXADECIMAL = frozenset(b"0123456789abcdef")


# -- Records --------------------------------------------------------------------------------------


def canonical(content: Any) -> str:
    """JSON that is the same for equal content: sorted keys, no spaces, floats to the last bit.

    What JSON has no number for is written as ``"NaN"``, ``"Infinity"`` or ``"-Infinity"``.

    Examples
    --------
    >>> canonical({"b": 0.1, "a": [float("nan"), -0.0]})
    '{"a":["NaN",-0.0],"b":0.1}'
    """
    try:
        return _dumped(content)
    except ValueError:
        return _dumped(_finite(content))


def number(value: Any) -> float:
    """A number as `canonical` writes it.

    Raises
    ------
    ValueError
        If it is none.

    Examples
    --------
    >>> number("-Infinity"), number(2)
    (-inf, 2.0)
    """
    if value in ("NaN", "Infinity", "-Infinity"):
        return float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{value!r} stands where a number should")
    return float(value)


def _dumped(content: Any) -> str:
    return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _finite(content: Any) -> Any:
    """With words for numbers that are not finite."""
    if isinstance(content, float) and not math.isfinite(content):
        return "NaN" if math.isnan(content) else "Infinity" if content > 0.0 else "-Infinity"
    if isinstance(content, Mapping):
        return {name: _finite(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return content


class Head(NamedTuple):
    """The last record of a log, or of what it was once: keep it where the log is not.

    Examples
    --------
    >>> str(Head(0, NOTHING))[:12]
    '0:0000000000'
    """

    number: int | None  #: None where only the hash was kept
    digest: str

    def __str__(self) -> str:
        return self.digest if self.number is None else f"{self.number}:{self.digest}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """From ``NUMBER:HASH``, or the hash alone.

        Raises
        ------
        ValueError
            If it is neither.
        """
        count, colon, digest = text.strip().rpartition(":")
        digest = digest.lower()
        if len(digest) != _HEX or not _HEXADECIMAL.issuperset(digest.encode()):
            raise ValueError(f"head is {text!r}; it must be NUMBER:HASH, with {_HEX} digits")
        if colon and not (count.isascii() and count.isdigit()):
            raise ValueError(f"head is {text!r}; its number is none")
        return cls(int(count) if colon else None, digest)


class SealedRecord(NamedTuple):
    """One line of a log that is a whole record."""

    number: int
    previous: str
    digest: str
    content: dict[str, Any]


def seal(content: Mapping[str, Any], after: Head) -> tuple[bytes, Head]:
    """Write the record that follows ``after``: its line, and the head that it makes.

    Examples
    --------
    >>> line, head = seal({"kind": "note"}, Head(0, NOTHING))
    >>> line[:40], head.number
    (b'{"kind":"note","number":1,"previous":"00', 1)
    """
    place = (after.number or 0) + 1
    text = canonical({**content, "number": place, "previous": after.digest}).encode()[:-1]
    digest = sha256(text).hexdigest()
    return text + _SEAL + digest.encode() + _END, Head(place, digest)


def unseal(line: bytes) -> SealedRecord | None:
    """The record that a line holds; None where it is not as `seal` writes it."""
    text, digest = _sealed(line)
    if text is None:
        return None
    try:
        content = json.loads(text + b"}", parse_constant=_refuse)
        # Of the ways to write it, names given twice among them, only one is `seal`'s.
        if canonical(content).encode()[:-1] != text:
            return None
        place, previous = content.pop("number"), content.pop("previous")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    if type(place) is not int or not isinstance(previous, str):
        return None
    return SealedRecord(place, previous, digest, content)


def _sealed(line: bytes) -> tuple[bytes | None, str]:
    """What the hash of a line is of, and the hash; None where it is of something else."""
    text, _, end = line.rpartition(_SEAL)
    digest = sha256(text).hexdigest()
    return (text if end == digest.encode() + _END else None), digest


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is no JSON")


# -- Verifying ------------------------------------------------------------------------------------


class Fault(Enum):
    """What may have happened to a log."""

    ALTERED = "altered"
    MISSING = "missing"
    MOVED = "moved"
    REPEATED = "repeated"
    INSERTED = "inserted"
    CUT = "cut"  #: its end is missing
    REWRITTEN = "rewritten"  #: it is a chain, but not the one that the head was of


class Finding(NamedTuple):
    """The first record at which a log is not what was written."""

    fault: Fault
    record: int  #: its number, from 1
    line: int  #: where the log shows it, from 1
    explanation: str


class Chain(NamedTuple):
    """What the chain of a log says."""

    head: Head  #: the last record up to which it is unbroken
    size: int  #: up to there [byte]
    half_written: int  #: what a last line without an end holds [byte]
    finding: Finding | None  #: None where nothing was tampered with
    known: bool  #: whether the head that was kept is one of its records


def lines(path: Path) -> Iterator[bytes]:
    """The lines of a log, the last perhaps without an end; of one that grows, those there are now.

    Raises
    ------
    ValueError
        If one is longer than any record.
    """
    with open(path, "rb") as file:
        left = os.fstat(file.fileno()).st_size
        while line := file.readline(min(_LONGEST, left)):
            if len(line) == _LONGEST:
                raise ValueError(f"{path} has a line of more than {_LONGEST >> 20} MiB")
            left -= len(line)
            yield line


def records(path: Path, count: int) -> Iterator[SealedRecord]:
    """The first ``count`` records of a log that `verify` found unbroken up to there."""
    for line in islice(lines(path), count):
        record = unseal(line)
        if record is None:
            raise ValueError(f"{path} was changed while it was read")
        yield record


def verify(path: Path, kept: Head | None = None) -> Chain:
    """Follow the chain to its end, or to the first record that is not what was written.

    Parameters
    ----------
    path : Path
    kept : Head, optional
        A head that was kept elsewhere. It must be one of the records; more may have come after.

    Raises
    ------
    OSError
        If there is no such file, or it may not be read.
    ValueError
        If it holds no records at all.
    """
    head, size, half_written = Head(0, NOTHING), 0, 0
    known, finding = kept is None or kept == head, None
    for line in lines(path):
        if not line.endswith(b"\n"):
            half_written = len(line)
            break
        place = (head.number or 0) + 1
        record = unseal(line)
        if record is None or (record.number, record.previous) != (place, head.digest):
            finding = _diagnosis(path, place)
            break
        head, size = Head(place, record.digest), size + len(line)
        known = known or (kept is not None and kept.digest == head.digest)
    if finding is None and kept is not None and not known:
        finding = _against(kept, head)
    return Chain(head, size, half_written, finding, known)


def _against(kept: Head, head: Head) -> Finding:
    """Why a whole chain has not the head that was kept."""
    last = head.number or 0
    if kept.number is None:
        return Finding(
            Fault.CUT,
            last + 1,
            last + 1,
            f"none of the {last} records has the head's hash: records after {last} were cut off, "
            "or the log was written anew (keep NUMBER:HASH, and it is known which)",
        )
    if kept.number > last:
        return Finding(
            Fault.CUT,
            last + 1,
            last + 1,
            f"the head was record {kept.number}, but the log ends with {last}: records "
            f"{last + 1} to {kept.number} were cut off (those before may be written anew, too)",
        )
    return Finding(
        Fault.REWRITTEN,
        kept.number,
        kept.number,
        f"record {kept.number} is not the one that the head was taken of: it, or records before "
        "it and then all up to it, were written anew",
    )


class _Line(NamedTuple):
    """What the chain is about; None and empty where it is no record."""

    number: int | None
    previous: str
    digest: str
    is_sealed: bool = True  # whether it has the hash of what it says

    @classmethod
    def of(cls, line: bytes) -> Self:
        record = unseal(line)
        if record is None:
            return cls(None, "", "", _sealed(line)[0] is not None)
        return cls(*record[:3])


def _diagnosis(path: Path, at: int) -> Finding:
    """What happened, where line ``at`` is the first that does not follow the one before it."""
    seen = [_Line.of(line) for line in lines(path)]
    if all(line.number is None for line in seen):
        raise ValueError(f"{path} is no audit log: no line of it is a record")
    before = seen[at - 2] if at > 1 else _Line(0, "", NOTHING)
    here = seen[at - 1]
    following = seen[at] if at < len(seen) else _Line(None, "", "")
    if here.number is None:
        return _unreadable(at, before, here, following)
    if here.previous == before.digest:
        return _altered(at, f"it says that it is record {here.number}")
    if here.number == at:
        return _broken_link(at, before, here, following)
    if here.number < at:
        return _one_too_many(at, seen)
    found = next((k for k, line in enumerate(seen, 1) if line.previous == before.digest), None)
    if found is not None:
        text = f"line {at} holds record {here.number}, and record {at} stands in line {found}"
        return Finding(Fault.MOVED, at, at, text)
    last = here.number - 1
    text = f"record {at} is missing" if last == at else f"records {at} to {last} are missing"
    return Finding(Fault.MISSING, at, at, text)


def _unreadable(at: int, before: _Line, here: _Line, following: _Line) -> Finding:
    if (following.number, following.previous) == (at, before.digest):
        return _inserted(at)
    if here.is_sealed:
        return _altered(at, "it is not written as records are (a name given twice, perhaps)")
    return _altered(at, "it has not the hash of what it says")


def _altered(at: int, why: str) -> Finding:
    return Finding(Fault.ALTERED, at, at, f"record {at} was altered: {why}")


def _broken_link(at: int, before: _Line, here: _Line, following: _Line) -> Finding:
    """Of two records in their places, one has another hash than it had when they were chained.

    Where the next record still follows this one, this one is as it was. Of the last record that
    cannot be said; it is more likely that someone changed what a record says than its chain.
    """
    if (following.number, following.previous) == (at, before.digest):
        return _inserted(at)
    original = at > 1 and (following.number is None or following.previous == here.digest)
    if original:
        return _altered(at - 1, f"record {at} was chained to another hash than it has")
    return _altered(at, f"it is not chained to record {at - 1}")


def _one_too_many(at: int, seen: list[_Line]) -> Finding:
    """A record that claims an earlier place."""
    here, before = seen[at - 1], seen[at - 2]
    first = next((k for k, line in enumerate(seen[: at - 1], 1) if line.digest == here.digest), 0)
    if first:
        return Finding(Fault.REPEATED, here.number or 0, at, f"line {at} repeats line {first}")
    is_followed = any(line.previous == here.digest for line in seen)
    if here.previous == before.previous and is_followed:  # it was here before the other one
        return _inserted(at - 1)
    return _inserted(at)


def _inserted(at: int) -> Finding:
    return Finding(Fault.INSERTED, at, at, f"what line {at} holds was inserted")


# -- Writing --------------------------------------------------------------------------------------


class Sync(Enum):
    """When what was written is forced from the system's memory onto the disk."""

    RECORD = "record"  #: each record: it outlives a power cut
    EPISODE = "episode"  #: each episode: a record outlives the end of the process, no power cut


class ChainedFile:
    """Appends records to a log. Close it after use, or use it in a ``with`` statement.

    Parameters
    ----------
    path : Path
        Is made if it is not there; else its chain is verified and gone on with. A last line that
        was half written, as by a process that was killed, is cut off.

    Raises
    ------
    OSError
        If it cannot be written.
    ValueError
        If it was tampered with, is no log, or is being written by another process. It is then
        left as it is.

    Notes
    -----
    Only the process that opened it writes: in a child of it `append` is refused, and `close` lets
    the parent keep the file. What interrupts `append` leaves a record that is whole, a part of
    one, or none; the next `append` or `close` finds out which, and takes a part back.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "log.jsonl"
    ...     with ChainedFile(path) as file:
    ...         file.append({"kind": "note"})
    ...     verify(path).head == file.head
    True
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: BinaryIO = open(path, "a+b", buffering=0)  # noqa: SIM115
        self._owner = os.getpid()
        self._under_way: tuple[bytes, Head] | None = None  # what is being written: line, head
        try:
            store.only_writer(self._file, self.path, "name another file")
            chain = verify(path)
            if chain.finding is not None:
                raise ValueError(
                    f"{path} was tampered with, and is left as it is: {chain.finding.explanation}; "
                    "name another file"
                )
            #: What was cut off from a half-written end [byte].
            self.cut_off = chain.half_written
            if self.cut_off:
                self._refuse_others(chain)
                _log.warning("%s: %d bytes of a half-written record cut off", path, self.cut_off)
                self._file.truncate(chain.size)
                self.sync()
            self._written = chain.head, chain.size
        except BaseException:
            self._file.close()
            raise

    @property
    def head(self) -> Head:
        """The last record."""
        return self._written[0]

    @property
    def is_ours(self) -> bool:
        """Whether this process opened it, and no parent of it."""
        return os.getpid() == self._owner

    def append(self, content: Mapping[str, Any]) -> None:
        """Add a record; only `sync` forces it onto the disk.

        Raises
        ------
        OSError
            If it cannot be written, or another process opened it. The records before it are kept.
        """
        if not self.is_ours:
            raise PermissionError(
                errno.EPERM,
                "the log belongs to the process that opened it; a child of that needs its own",
                str(self.path),
            )
        self.settle()
        line, head = seal(content, self.head)
        self._under_way = line, head
        try:
            data = line
            while data:  # a disk that gets full takes a part of it first
                data = data[self._file.write(data) :]
        except OSError:
            with suppress(OSError):
                self.settle()
            raise
        self._written = head, self._written[1] + len(line)
        self._under_way = None

    def settle(self) -> None:
        """See to a record whose `append` was interrupted: one that is whole stays.

        A part of one is taken back, which no reader took for a record.

        Raises
        ------
        OSError
            If it cannot be.
        """
        if self._under_way is None:
            return
        (line, head), (_, size) = self._under_way, self._written
        self._file.seek(size)
        there = self._file.read()
        if there == line:
            self._written = head, size + len(line)
        elif there:
            self._file.truncate(size)
        self._under_way = None

    def sync(self) -> None:
        """Force what was appended onto the disk."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Let others have the file."""
        if self._file.closed:
            return
        try:
            if self.is_ours:
                self.settle()
                store.let_others_write(self._file)
        finally:
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _refuse_others(self, chain: Chain) -> None:
        """Raise where what would be cut off is no beginning of a log."""
        with open(self.path, "rb") as file:
            start = file.read(len(_OPENING))
        if not chain.size and not _OPENING.startswith(start):
            raise ValueError(f"{self.path} is no audit log; it was left alone")

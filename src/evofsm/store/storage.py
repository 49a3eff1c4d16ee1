"""The file format of all that is learnt: named arrays and a JSON header, nothing that can run.

A file is a ZIP of ``.npy`` members, which `numpy.load` opens as well. The member ``header`` is
JSON; ``docs/files.md`` says what stands in it, and how the SHA-256 over all of it is taken. A
machine's file holds the views of its buffer, with centres by variable (m, n); a model's its fields,
centres by state (n, m).

What a kind holds, and since which version, is registered by its owner (`ranges.Kind`). Version 3
had neither a checksum nor a provenance.

Whatever a file claims is looked at before anything is made room for: first how its archive is
built, then the headers of all arrays, and only then what they hold.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import secrets
import stat
import struct
import time
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import partial
from io import BufferedIOBase
from pathlib import Path
from typing import IO, Any, BinaryIO, NamedTuple, TypeAlias, cast

import numpy as np
from numpy.lib.format import write_array
from numpy.typing import NDArray

from evofsm import __version__
from evofsm.store import ranges

#: A file by its name, or one that is open.
Place: TypeAlias = str | os.PathLike[str] | BinaryIO

_FORMAT = "evofsm"
# Of a format whose arrays are all older; a newer array makes a newer version.
_BASE_VERSION = 5
_HEADER = "header"
#: No file holds more, unpacked [bytes].
LARGEST = 1 << 32
# A longer header is refused [bytes].
_LARGEST_HEADER = 1 << 24
# More arrays are refused.
_MOST_MEMBERS = 128
# A longer directory of an archive is refused [bytes].
_LARGEST_DIRECTORY = 1 << 16
# Deflate cannot do better than this; whoever claims more is lying.
_DENSEST = 1032
# So much of an array is unpacked at once [bytes].
_AT_ONCE = 1 << 20
_BEGINNING = b"PK\x03\x04"  # of a ZIP
# Where nothing can be locked, what is as old as this is no longer written [s].
_OLD = 86400.0
# Booleans, bytes, integers and numbers; no objects, which could run.
_TYPES = ("|b1", "|u1", "<i8", "<f8")

# Of an error that quotes a damaged file so many letters are told.
_MOST_SAID = 300
# What reading a damaged archive may run into (OSError: a place before its beginning;
# RuntimeError: a way of packing that is not known, or a header nested too deep).
_DAMAGE = (
    ValueError,
    KeyError,
    IndexError,
    TypeError,
    EOFError,
    OSError,
    OverflowError,
    RuntimeError,
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
)


class Header(NamedTuple):
    """What a file says of itself."""

    kind: str  #: ``"machine"``, ``"model"``, ``"risk"``, ``"guard"`` or ``"checkpoint"``
    version: int  #: of the format
    library: str | None  #: version of evofsm that wrote it; None before format 4
    content: dict[str, Any]  #: settings, by name
    provenance: dict[str, Any]  #: what it learnt from, as far as it was told


def format_version() -> int:
    """The newest version of the format, which files are written in."""
    members = [member for kind in ranges.KINDS.values() for member in (kind.members or {}).values()]
    return max([_BASE_VERSION, *(member.since for member in members)])


# -- Writing --------------------------------------------------------------------------------------


def write(
    place: Place,
    kind: str,
    content: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write a file whole or not at all: beside its place first, read again, then renamed into it.

    When this returns, file and name are on the disk.

    Parameters
    ----------
    place : path-like, or file open for writing bytes
    kind : str
        What it is: see `Header`.
    content : mapping
        Settings, for JSON.
    arrays : mapping
        Booleans, bytes, integers or floats of 64 bits.
    provenance : mapping, optional
        What it learnt from, for JSON.

    Raises
    ------
    OSError
        If it cannot be written. What was there before is then as it was.
    TypeError
        If ``provenance`` is no mapping, or JSON has no words for it.
    ValueError
        If it could not be read again.
    """
    if not isinstance(provenance, Mapping | None):
        raise TypeError(f"provenance is {provenance!r}; it must be a mapping of names to values")
    plain = {name: _plain(name, array) for name, array in arrays.items()}
    header = {
        "format": _FORMAT,
        "version": format_version(),
        "library": __version__,
        "kind": kind,
        "content": dict(content),
        "provenance": dict(provenance or {}),
    }
    header = json.loads(json.dumps(header))  # as it will be read: a tuple is a list there
    _refuse_unfit(kind, header["content"], format_version(), {n: a.shape for n, a in plain.items()})
    ranges.refuse_others(kind, header["content"], plain)
    header["sha256"] = _sha256(header, plain)
    encoded = np.frombuffer(json.dumps(header).encode(), np.uint8)
    if encoded.nbytes > _LARGEST_HEADER or sum(a.nbytes for a in plain.values()) > LARGEST:
        raise ValueError(f"{kind} is too large for a file: more than {LARGEST:,} bytes")
    members = {_HEADER: encoded, **plain}
    if not isinstance(place, str | os.PathLike):
        _pack(place, members)
        return
    with replacing(place) as file:
        _pack(file, members)
        try:
            read(file, kind)
        except ValueError as error:
            raise OSError(
                f"{os.fspath(place)} was left as it was: what was written cannot be read: {error}"
            ) from error


def _plain(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """The array as it stands in a file: row by row, the lowest byte first."""
    array = np.asarray(array)
    array = np.asarray(array, array.dtype.newbyteorder("<"), order="C")
    if array.dtype.str not in _TYPES or not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise ValueError(f"an array {name!r} of {array.dtype} cannot be kept in a file")
    return array


def _pack(file: BinaryIO, members: Mapping[str, NDArray[Any]]) -> None:
    # Numbers hardly get smaller by trying harder, and a checkpoint should cost little.
    archive = zipfile.ZipFile(file, "w", compresslevel=1)
    try:
        for name, array in members.items():
            # A file within a file is packed already.
            within = array.dtype == np.uint8 and array[:4].tobytes() == _BEGINNING
            archive.compression = zipfile.ZIP_STORED if within else zipfile.ZIP_DEFLATED
            # By its name, not as a file: those have a date, and the same should give the same.
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                write_array(member, array, version=(1, 0), allow_pickle=False)
        archive.close()
    finally:
        archive.fp = None  # closing half of one would raise an error in place of an interrupt


def only_writer(file: BinaryIO, path: str | os.PathLike[str], otherwise: str) -> None:
    """Lock a file against other processes, where the system can; it is unlocked as it is closed.

    Raises
    ------
    ValueError
        If another process has locked it; says what to do ``otherwise``.
    """
    with suppress(ModuleNotFoundError):  # Windows
        import fcntl

        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(
                f"{os.fspath(path)} is being written by another process; wait for its end, or "
                f"{otherwise}"
            ) from None


def let_others_write(file: BinaryIO) -> None:
    """Undo `only_writer`, also where a child of this process still has the file open."""
    with suppress(ModuleNotFoundError):  # Windows
        import fcntl

        fcntl.flock(file, fcntl.LOCK_UN)


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A file, open for writing and reading, that takes its place once it is whole and on the disk.

    Whoever else writes the same path has a file of its own until then: the last one to end stays. A
    link is followed, and the mode of a file that was there is kept.

    Raises
    ------
    OSError
        If it cannot be written, or something else than a file is there; it names the file. What was
        there before is then as it was.
    """
    begun: list[Path] = []
    try:
        target, mode = _place_of(path)
        with _begin(target, mode, begun) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            if mode is not None:
                os.chmod(begun[-1], mode)
            if os.name == "nt":  # where an open file cannot be renamed
                file.close()
            os.replace(begun[-1], target)
    except BaseException as error:
        if isinstance(error, OSError) and error.errno is not None:
            error.filename, error.filename2 = os.fspath(path), None
        for temporary in begun:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
        raise
    # Not all systems can flush a folder; the file is whole, if not under its name, without it.
    with suppress(OSError):
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _place_of(path: str | os.PathLike[str]) -> tuple[Path, int | None]:
    """Where a file is once links are followed, and its mode; None where there is none yet."""
    given = Path(path)
    if not given.parent.is_dir():
        raise FileNotFoundError(f"{given}: there is no folder {given.parent}")
    target = Path(os.path.realpath(given))
    try:
        mode = os.stat(given).st_mode
    except FileNotFoundError:
        return target, None
    if not stat.S_ISREG(mode):
        what = "a folder" if stat.S_ISDIR(mode) else "a device, a pipe or a socket"
        raise OSError(f"{given} is {what}, which no file may take the place of")
    return target, stat.S_IMODE(mode)


def _begin(target: Path, mode: int | None, begun: list[Path]) -> BinaryIO:
    """Open a file of a random name beside another one, and lock it as long as it is open.

    Its name is added to those ``begun`` first, so that whatever happens it is known.
    """
    opener = partial(os.open, mode=0o666 if mode is None else 0o600)
    while True:
        begun.append(target.with_name(f".{target.name}.{secrets.token_hex(8)}.part"))
        file = open(begun[-1], "x+b", opener=opener)  # noqa: SIM115
        with suppress(ModuleNotFoundError, OSError):  # Windows; places without locks
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        if begun[-1].exists():  # else it was swept before it was locked
            return file
        file.close()


def sweep(path: str | os.PathLike[str]) -> None:
    """Remove what processes that were killed while they wrote a file have left beside it."""
    target = Path(os.path.realpath(path))
    pattern = re.compile(rf"\.{re.escape(target.name)}\.[0-9a-f]{{16}}\.part")
    for beside in target.parent.iterdir():
        if pattern.fullmatch(beside.name):
            with suppress(OSError), open(beside, "r+b") as file:
                if _is_left(file):
                    beside.unlink()


def _is_left(file: BinaryIO) -> bool:
    """Whether nobody writes a file any more: it can be locked, or is old where nothing can."""
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except (ModuleNotFoundError, OSError):
        return time.time() - os.fstat(file.fileno()).st_mtime > _OLD
    return True


# -- Reading --------------------------------------------------------------------------------------


def kind_of(place: Place) -> str:
    """Say what a file holds: ``"machine"``, ``"model"``, ``"risk"`` or ``"checkpoint"``."""
    return read_header(place).kind


def read_header(place: Place) -> Header:
    """Read what a file says of itself; what it holds is neither read nor checked.

    Parameters
    ----------
    place : path-like, or file open for reading bytes

    Returns
    -------
    Header
        Its kind, versions and provenance.

    Raises
    ------
    OSError
        If there is no such file, or it may not be read.
    ValueError
        If it is no file of evofsm, or of a newer version.

    Examples
    --------
    >>> from io import BytesIO
    >>> from evofsm import EvolvingFSM
    >>> file = BytesIO()
    >>> EvolvingFSM(n_actions=2).save(file, provenance={"drive": "Monday"})
    >>> header = read_header(BytesIO(file.getvalue()))
    >>> header.kind, header.provenance
    ('machine', {'drive': 'Monday'})
    """
    with _opened(place) as file, explained(place):
        return _described(_Archive(file).header)


def read(place: Place, kind: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Read a file of the given kind: its content and its arrays, all of it checked.

    Raises
    ------
    OSError
        If there is no such file, or it may not be read.
    ValueError
        If the file holds something else, is damaged or of a newer version; the message says which.
    """
    with _opened(place) as file:
        with explained(place):
            archive = _Archive(file)
            header = archive.header
        if header["kind"] != kind:
            raise ValueError(f"{_named(place)} holds a {header['kind']}, not a {kind}")
        with explained(place):
            arrays = archive.arrays()
            ranges.refuse_others(kind, header["content"], arrays)
    return header["content"], arrays


class _Entry(NamedTuple):
    """An array in an archive, before it is read."""

    info: zipfile.ZipInfo
    begin: int  #: of the numbers, in the member [bytes]
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    by_columns: bool


class _Archive:
    """The arrays of an open file: the header is read at once, the others once they fit."""

    def __init__(self, file: BinaryIO) -> None:
        size = file.seek(0, os.SEEK_END)
        _refuse_other_archives(file, size)
        file.seek(0)
        self._zip = zipfile.ZipFile(file)
        self._infos = _by_name(self._zip.infolist(), size)
        if _HEADER not in self._infos:
            raise ValueError("it has no header, so it is another program's file")
        entry = self._entry(_HEADER)
        if entry.dtype != np.uint8 or math.prod(entry.shape) > _LARGEST_HEADER:
            raise ValueError("its header is no text, or far too long")
        self.header = _header(self._read(entry).tobytes())

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays, once their shapes and, from version 4 on, their checksum agree.

        What the version lacks is added.
        """
        version = self.header["version"]
        entries = {name: self._entry(name) for name in self._infos if name != _HEADER}
        shapes = {name: entry.shape for name, entry in entries.items()}
        kind, content = self.header["kind"], self.header["content"]
        sizes = _refuse_unfit(kind, content, version, shapes)
        arrays = {name: self._read(entry) for name, entry in entries.items()}
        if version >= 4:
            told = self.header["sha256"]
            header = {name: value for name, value in self.header.items() if name != "sha256"}
            if _sha256(header, arrays) != told:
                raise ValueError("its SHA-256 is another one: it was changed or damaged")
        for name, member in (ranges.KINDS[kind].members or {}).items():
            shape = [sizes.get(size, size) for size in member.shape]
            if member.since > version and all(isinstance(size, int) for size in shape):
                arrays[name] = np.zeros(cast(Any, shape))
        ranges.KINDS[kind].upgrade(version, content, arrays)
        return arrays

    def _entry(self, name: str) -> _Entry:
        """What the beginning of a member says, if it keeps to what the archive says of it."""
        info = self._infos[name]
        with self._zip.open(info) as member:
            begin, dtype, shape, by_columns = _array_header(name, member)
        if begin + math.prod(shape) * dtype.itemsize != info.file_size:
            raise ValueError(
                f"{name} claims shape {shape} of {dtype}, which does not fit its "
                f"{info.file_size:,} bytes"
            )
        return _Entry(info, begin, dtype, shape, by_columns)

    def _read(self, entry: _Entry) -> NDArray[Any]:
        with self._zip.open(entry.info) as member:
            member.read(entry.begin)
            array = np.empty(math.prod(entry.shape), entry.dtype)
            missing = array.view(np.uint8).data
            while missing:
                count = cast(BufferedIOBase, member).readinto(missing[:_AT_ONCE])
                if not count:
                    raise EOFError("an array ends early")
                missing = missing[count:]
            if member.read(1):  # which also has the ZIP's own checksum looked at
                raise ValueError("an array goes on beyond its end")
        return array.reshape(entry.shape, order="F" if entry.by_columns else "C")


def _refuse_other_archives(file: BinaryIO, size: int) -> None:
    """Raise unless a ZIP begins with the file, and ends with it: small, whole and without more."""
    end = struct.Struct("<4s4H2LH")
    file.seek(0)
    begins = file.read(4) == _BEGINNING
    file.seek(max(size - end.size, 0))
    last = file.read(end.size)
    if not begins or len(last) < end.size or not last.startswith(b"PK\x05\x06"):
        raise ValueError("it is not a ZIP archive, or was cut off")
    _, _, _, _, members, directory, where, _ = end.unpack(last)
    if members > _MOST_MEMBERS or directory > _LARGEST_DIRECTORY:
        raise ValueError(f"it claims {members} arrays; there are no more than {_MOST_MEMBERS}")
    if where + directory != size - end.size:
        raise ValueError("its directory does not stand where it should")


def _by_name(infos: Iterable[zipfile.ZipInfo], size: int) -> dict[str, zipfile.ZipInfo]:
    """Members by the names of their arrays, none of which is odd, hidden, twice or too large."""
    found: dict[str, zipfile.ZipInfo] = {}
    for info in infos:
        name = info.orig_filename.removesuffix(".npy")
        if not re.fullmatch(r"[a-z][a-z0-9_]*\.npy", info.orig_filename):
            raise ValueError(f"it has a member {info.orig_filename[:60]!r}, which is no array")
        if name in found:
            raise ValueError(f"it has two arrays called {name}")
        if info.flag_bits & 0x1 or info.compress_type not in (
            zipfile.ZIP_STORED,
            zipfile.ZIP_DEFLATED,
        ):
            raise ValueError(f"{name} is encrypted, or packed in a way that is not known")
        if info.file_size > _DENSEST * info.compress_size + _DENSEST:
            raise ValueError(f"{name} claims {info.file_size:,} bytes, too many to be packed in it")
        found[name] = info
    if sum(info.compress_size for info in found.values()) > size:
        raise ValueError("its members overlap")
    if (total := sum(info.file_size for info in found.values())) > LARGEST:
        raise ValueError(f"it claims {total:,} bytes; no file holds more than {LARGEST:,}")
    return found


_ARRAY_HEADER = re.compile(
    rb"\{'descr': '([^']{1,9})', 'fortran_order': (True|False), 'shape': \(([0-9, ]*)\), \} *\n"
)


def _array_header(name: str, member: IO[bytes]) -> tuple[int, np.dtype[Any], tuple[int, ...], bool]:
    """What stands before the numbers: how long that is, type, shape, and whether by columns.

    It is matched, not evaluated as NumPy would do.
    """
    start = member.read(10)
    length = int.from_bytes(start[8:10], "little")
    found = _ARRAY_HEADER.fullmatch(member.read(length))
    if start[:8] != b"\x93NUMPY\x01\x00" or found is None:
        raise ValueError(f"{name} does not begin as an array does")
    kind, by_columns, numbers = (text.decode() for text in found.groups())
    if kind not in _TYPES:
        raise ValueError(f"{name} is of type {kind!r}; only {', '.join(_TYPES)} are read")
    shape = tuple(int(number) for number in numbers.replace(" ", "").split(",") if number)
    return 10 + length, np.dtype(kind), shape, by_columns == "True"


def _header(encoded: bytes) -> dict[str, Any]:
    header = json.loads(encoded)
    if not isinstance(header, dict) or header.get("format") != _FORMAT:
        raise ValueError("its header is another program's")
    version = header["version"]
    if type(version) is not int or version < 1:
        raise ValueError(f"its version is {version!r}, which is none")
    if version > format_version():
        raise ValueError(
            f"its version {version} is newer than this library's {format_version()}; "
            "a newer evofsm reads it"
        )
    needed = {"kind", "content"} | ({"library", "provenance", "sha256"} if version >= 4 else set())
    if not needed <= set(header):
        raise ValueError("its header lacks what it holds")
    if not isinstance(header["kind"], str) or not re.fullmatch("[a-z]{1,20}", header["kind"]):
        raise ValueError(f"it holds a {header['kind']!r}, which is no kind of file")
    for name in {"content", "provenance"} & set(header):
        if not isinstance(header[name], dict):
            raise ValueError(f"the {name} in its header has no names")
    return header


def _described(header: Mapping[str, Any]) -> Header:
    return Header(
        header["kind"],
        header["version"],
        header.get("library"),
        header["content"],
        header.get("provenance", {}),
    )


# -- What must agree ------------------------------------------------------------------------------


def _refuse_unfit(
    kind: str,
    content: Mapping[str, Any],
    version: int,
    shapes: Mapping[str, tuple[int, ...]],
) -> dict[int | str, int]:
    """Raise where arrays lack or are too many for their kind, or their shapes disagree.

    Returns the size that each letter stands for.
    """
    members = ranges.KINDS[kind].members
    sizes: dict[int | str, int] = {"q": content["n_actions"]} if "n_actions" in content else {}
    if members is None:
        return sizes
    expected = {name for name, member in members.items() if member.since <= version}
    if lacking := expected - set(shapes):
        raise ValueError(f"it lacks {', '.join(sorted(lacking))}")
    if unknown := set(shapes) - expected:
        raise ValueError(f"it has {', '.join(sorted(unknown))}, which no {kind} has")
    for name in sorted(expected):
        told, shape = members[name].shape, shapes[name]
        fits = len(told) == len(shape)
        for one, have in zip(told, shape, strict=False):
            fits &= have == (one if isinstance(one, int) else sizes.setdefault(one, have))
        if not fits:
            wanted = tuple(sizes.get(one, one) for one in told)
            raise ValueError(f"{name} has shape {shape}, not {wanted}, as others say")
    return sizes


def _sha256(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> str:
    """Over the header as JSON in the order of names, then each array in the same order.

    Before the bytes of an array (row by row) stands a line of JSON: name, type, shape.
    """
    digest = hashlib.sha256(_canonical(header))
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(_canonical([name, array.dtype.str, array.shape]))
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _canonical(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode() + b"\n"


# -- Errors ---------------------------------------------------------------------------------------


@contextmanager
def explained(place: Place) -> Iterator[None]:
    """Turn whatever reading a damaged file runs into into one error that names the file."""
    try:
        yield
    except _DAMAGE as error:
        if isinstance(error, OSError) and error.filename is not None:
            raise  # no such file, no permission: the system's own words say it best
        why = str(error)
        why = why if len(why) <= _MOST_SAID else f"{why[:_MOST_SAID]} ..."
        raise ValueError(f"{_named(place)} cannot be read as an evofsm file: {why}") from error


def _opened(place: Place) -> AbstractContextManager[BinaryIO]:
    if isinstance(place, str | os.PathLike):
        return open(place, "rb")
    return nullcontext(place)


def _named(place: Place) -> str:
    return os.fspath(place) if isinstance(place, str | os.PathLike) else "what was given"

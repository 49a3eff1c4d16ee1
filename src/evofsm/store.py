"""One file format for all that is learnt: named arrays and a JSON header, nothing that can run.

A file is laid out as safetensors lays one out, so that its libraries open it, too: the length of
the header in eight bytes, lowest first; the header, JSON in UTF-8, with the type, the shape and the
place of each array; then the numbers of all arrays, row by row. Under ``__metadata__`` stand
``evofsm``, again JSON (kind, version, library, settings, provenance), and ``sha256``: over the
header, with 64 zeros in its place, and all numbers.

What a kind of file may hold is declared once, as a `Kind`, where it belongs. A file is held against
it before anything is allocated: a checksum shows damage, but whoever forges a file can take it
anew, and kernels take sizes and indices on trust.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import math
import os
import re
import secrets
import shutil
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from tempfile import gettempdir
from typing import Any, BinaryIO, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from evofsm import __version__

_log = logging.getLogger(__name__)

#: A file by its name, or one that is open.
Place: TypeAlias = str | os.PathLike[str] | BinaryIO

#: Squares of larger numbers, summed over a long run, would overflow.
LARGEST_OBSERVATION = 1e100
#: Counts that go up by 1 end here: above it, adding 1 changes nothing.
MOST_COUNTED = float(1 << 53)
#: The smallest number above 0, and the largest.
SMALLEST, LARGEST = math.ulp(0.0), float(np.finfo(np.float64).max)

_VERSION = 1
# In place of the checksum, as that is taken.
_UNSIGNED = "0" * 64
# No file holds more [bytes], nor a header.
_LARGEST_FILE, _LARGEST_HEADER = 1 << 29, 1 << 24
# The names of types in a file. No objects: those could run.
_TYPES = {"BOOL": np.bool_, "U8": np.uint8, "I64": np.int64, "F64": np.float64}
_TYPE_NAMES = {np.dtype(kind): name for name, kind in _TYPES.items()}
# Nobody writes a file any more that did not change for so long [s].
_OLD = 600.0
# Why no file can take the place of another one.
_IRREPLACEABLE = (errno.EBUSY, errno.EXDEV, errno.EACCES, errno.EPERM, errno.EROFS)
# What reading a damaged file may run into (RuntimeError: JSON that is nested too deep).
_DAMAGE = (ValueError, LookupError, TypeError, ArithmeticError, RuntimeError, EOFError)


class Numbers(NamedTuple):
    """What one array or setting of a file may hold."""

    #: Sizes of an array; a name stands for the same number throughout a file.
    shape: tuple[int | str, ...] = ()
    least: float = -LARGEST
    most: float = LARGEST
    whole: bool = False  #: whether fractions are refused
    dtype: Any = np.float64  #: of an array; settings are whatever JSON has
    optional: bool = False  #: whether a setting may be None, or missing

    def of(self, *shape: int | str) -> Numbers:
        """The same in an array of a shape."""
        return self._replace(shape=shape)

    def refuse_others(
        self, name: str, given: Any, sizes: dict[int | str, int] | None = None
    ) -> None:
        """Raise a ValueError for another shape, or a number that is not in the range (as NaN)."""
        numbers = np.asarray(given)
        if numbers.dtype.kind not in "iufb" or isinstance(given, bool):
            raise ValueError(f"{name} is {given!r}; it must be a number")
        self.refuse_shape(name, numbers.shape, {} if sizes is None else sizes)
        if not numbers.size or numbers.dtype.kind == "b":
            return
        for number in (float(numbers.min()), float(numbers.max())):
            if not self.least <= number <= self.most:
                ends = f"{self.least:g} and {self.most:g}"
                raise ValueError(
                    f"{name} of {number:g} cannot be right: it must lie between {ends}"
                )
        if self.whole and (isinstance(given, float) or (numbers != np.rint(numbers)).any()):
            raise ValueError(f"{name} holds a fraction; it must be an integer")

    def refuse_shape(self, name: str, shape: tuple[int, ...], sizes: dict[int | str, int]) -> None:
        """Raise unless a shape agrees with the ``sizes`` so far, to which it adds its own."""
        fits = len(shape) == len(self.shape)
        for size, have in zip(self.shape, shape, strict=False):
            fits &= have == (size if isinstance(size, int) else sizes.setdefault(size, have))
        if not fits:
            right_shape = tuple(sizes.get(size, size) for size in self.shape)
            raise ValueError(f"{name} has shape {shape}, not {right_shape}, as others say")


COUNT = Numbers(least=0.0, most=MOST_COUNTED, whole=True)
FROM_1 = COUNT._replace(least=1.0)
FLAG = COUNT._replace(most=1.0)
SHARE = Numbers(least=0.0, most=1.0 + 1e-6)  # with room for rounding
SIZE = Numbers(least=SMALLEST, most=LARGEST_OBSERVATION)


class Kind(NamedTuple):
    """What files of one kind hold.

    A setting is declared as `Numbers`, as a type that `isinstance` takes (`str | None`), as
    ``list[str]``, or as a mapping of such settings. One that is not declared has to be checked by
    whoever uses it. One integer may be a size in the shapes of arrays, as ``"settings.NAME"``.
    """

    name: str
    arrays: Mapping[str, Numbers]
    settings: Mapping[str, Any] = {}

    def refuse_others(self, settings: Mapping[str, Any]) -> None:
        """Raise a ValueError for settings that no file of this kind may hold, naming one."""
        _refuse_settings(settings, self.settings, {})


class Header(NamedTuple):
    """What a file says of itself."""

    kind: str  #: such as ``"machine"``, ``"model"`` or ``"guard"``
    version: int  #: of the format
    library: str  #: version of evofsm that wrote it
    settings: dict[str, Any]
    provenance: dict[str, Any]  #: what it learnt from, as far as it was told


# -- Writing --------------------------------------------------------------------------------------


def write(
    place: Place,
    kind: Kind,
    settings: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write a file as a whole or not at all; when this returns, it is on the disk.

    A ValueError or TypeError says what no file of this kind may hold.
    """
    if not isinstance(provenance, Mapping | None):
        raise TypeError(f"provenance is {provenance!r}; it must be a mapping of names to values")
    header = Header(kind.name, _VERSION, __version__, dict(settings), dict(provenance or {}))
    parts = _packed(kind, header, arrays)
    with replacing(place) if isinstance(place, str | os.PathLike) else nullcontext(place) as file:
        file.writelines(parts)


def _packed(kind: Kind, header: Header, arrays: Mapping[str, NDArray[Any]]) -> list[Any]:
    """The bytes of a file, one part after the other, if it may hold all of this."""
    entries: dict[str, _Entry] = {}
    begin = 0
    for name, array in arrays.items():
        dtype, end = _TYPE_NAMES.get(array.dtype, str(array.dtype)), begin + array.nbytes
        entries[name] = _Entry(dtype, list(array.shape), [begin, end])
        begin = end
    text = json.dumps(header._asdict())
    sizes = _refuse_unfit(kind, json.loads(text)["settings"], entries)
    for name, numbers in kind.arrays.items():
        numbers.refuse_others(name, arrays[name], sizes)
    index: dict[str, Any] = {name: entry._asdict() for name, entry in entries.items()}
    head = json.dumps({"__metadata__": {"sha256": _UNSIGNED, "evofsm": text}, **index}).encode()
    head += b" " * (-len(head) % 8)  # so that numbers begin at a multiple of eight
    if len(head) > _LARGEST_HEADER or begin > _LARGEST_FILE:
        raise ValueError(f"{kind.name} is too large for a file: more than {_LARGEST_FILE:,} bytes")
    content = [np.ascontiguousarray(array).data for array in arrays.values()]
    signed_head = head.replace(_UNSIGNED.encode(), _sha256(head, content).encode(), 1)
    return [len(signed_head).to_bytes(8, "little"), signed_head, *content]


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A file, open for writing and reading, that takes its place once it is whole and on the disk.

    The last one to end stays. A link is followed, and the mode of a file that was there is kept.
    What processes that were killed have left beside it is removed.
    Where it cannot be written, an OSError names the file, and what was there is as it was.

    No file can take the place of one that is mounted on its own, or whose folder may not be
    written: what is whole is then written over it, and a warning says so.
    """
    temporary = None
    try:
        target, mode = _place_of(path)
        beside = mode is None or os.access(target.parent, os.W_OK)
        folder = target.parent if beside else Path(gettempdir())
        temporary = folder / f".{target.name}.{secrets.token_hex(8)}.part"
        opener = partial(os.open, mode=0o666 if mode is None else 0o600)
        with open(temporary, "x+b", opener=opener) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            if mode is not None:
                os.chmod(temporary, mode)
            if os.name == "nt":  # where an open file cannot be renamed
                file.close()
            try:
                os.replace(temporary, target)
            except OSError as error:
                if mode is None or error.errno not in _IRREPLACEABLE:
                    raise
                _write_over(target, file)
                temporary.unlink()
                _log.warning(
                    "%s was written over, as no file can take its place (is it bound into a "
                    "container on its own?): a kill in that moment leaves it damaged; bind its "
                    "folder instead",
                    os.fspath(path),
                )
    except BaseException as error:
        if isinstance(error, OSError) and error.errno is not None:
            error.filename, error.filename2 = os.fspath(path), None
        if temporary is not None and not hasattr(error, "__notes__"):
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
        raise
    sweep(target)
    # Not all systems can flush a folder; the file is whole, if not under its name, without it.
    with suppress(OSError):
        descriptor = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _write_over(target: Path, whole: BinaryIO) -> None:
    whole.seek(0)
    with open(target, "r+b") as file:
        free = shutil.disk_usage(target).free + os.fstat(file.fileno()).st_size
        if free < os.fstat(whole.fileno()).st_size:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        try:
            shutil.copyfileobj(whole, file)
            file.truncate()
            file.flush()
            os.fsync(file.fileno())
        except BaseException as error:
            error.add_note(f"it is damaged, and what was to be written is whole in {whole.name}")
            raise


def _place_of(path: str | os.PathLike[str]) -> tuple[Path, int | None]:
    """Where a file is once links are followed, and its mode; None where there is none yet."""
    file_path = Path(path)
    if not file_path.parent.is_dir():
        raise FileNotFoundError(f"{file_path}: there is no folder {file_path.parent}")
    target = Path(os.path.realpath(file_path))
    try:
        mode = os.stat(file_path).st_mode
    except FileNotFoundError:
        return target, None
    if not stat.S_ISREG(mode):
        type_name = "a folder" if stat.S_ISDIR(mode) else "a device, a pipe or a socket"
        raise OSError(f"{file_path} is {type_name}, which no file may take the place of")
    return target, stat.S_IMODE(mode)


def sweep(path: str | os.PathLike[str]) -> None:
    """Remove what processes that were killed while they wrote a file have left beside it."""
    target = Path(os.path.realpath(path))
    pattern = re.compile(rf"\.{re.escape(target.name)}\.[0-9a-f]{{16}}\.part")
    with suppress(OSError):
        for beside in target.parent.iterdir():
            if pattern.fullmatch(beside.name) and time.time() - beside.stat().st_mtime > _OLD:
                beside.unlink()


# -- Reading --------------------------------------------------------------------------------------


def read_header(place: Place) -> Header:
    """Read the kind, versions, settings and provenance of a file; its numbers are not looked at.

    Parameters
    ----------
    place : path-like, or file open for reading bytes

    Raises
    ------
    OSError, ValueError
        If it may not be read; if it is no file of evofsm, or of a newer version.

    Examples
    --------
    >>> from io import BytesIO
    >>> from evofsm import EvolvingFSM
    >>> file = BytesIO()
    >>> EvolvingFSM(n_actions=2).save(file, provenance={"drive": "Monday"})
    >>> header = read_header(file)
    >>> header.kind, header.provenance
    ('machine', {'drive': 'Monday'})
    """
    with _opened(place) as file, explained(place):
        return _unpacked(file)[0]


def read(place: Place, kind: Kind) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Read a file of a kind: its settings and its arrays, all that the kind declares checked."""
    with _opened(place) as file:
        with explained(place):
            header, entries, head, sha256 = _unpacked(file)
        if header.kind != kind.name:
            raise ValueError(f"{_named(place)} holds a {header.kind}, not a {kind.name}")
        with explained(place):
            sizes = _refuse_unfit(kind, header.settings, entries)
            arrays = {name: _read_array(file, entry) for name, entry in entries.items()}
            unsigned_head = head.replace(sha256.encode(), _UNSIGNED.encode(), 1)
            if _sha256(unsigned_head, [array.data for array in arrays.values()]) != sha256:
                raise ValueError("its SHA-256 is another one: it was changed or damaged")
            for name, numbers in kind.arrays.items():
                numbers.refuse_others(name, arrays[name], sizes)
    return header.settings, arrays


class _Entry(NamedTuple):
    """An array in a file, by the names that safetensors gives."""

    dtype: str
    shape: list[int]
    data_offsets: list[int]  #: behind the header [bytes]


def _unpacked(file: BinaryIO) -> tuple[Header, dict[str, _Entry], bytes, str]:
    size = file.seek(0, os.SEEK_END)
    if size > _LARGEST_FILE + _LARGEST_HEADER:
        raise ValueError(f"it has {size:,} bytes; no file holds more than {_LARGEST_FILE:,}")
    file.seek(0)
    length = int.from_bytes(file.read(8), "little")
    if not 2 <= length <= min(size - 8, _LARGEST_HEADER):
        raise ValueError("it is another program's file, or cut off (a log? evofsm learn reads it)")
    head = file.read(length)
    try:
        index = json.loads(head)
        metadata = index.pop("__metadata__")
        header_fields, sha256 = json.loads(metadata["evofsm"]), str(metadata["sha256"])
        version = header_fields["version"]
        entries, begin = {name: _Entry(**fields) for name, fields in index.items()}, 0
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        raise ValueError("it is another program's file, or its header is damaged") from None
    if type(version) is int and version > _VERSION:
        versions = f"its version {version} is newer than this library's {_VERSION}"
        raise ValueError(f"{versions}; a newer evofsm reads it")
    types = dict(zip(Header._fields, (str, int, str, dict, dict), strict=True))
    has_all = {name: type(value) for name, value in header_fields.items()} == types
    if not has_all or not re.fullmatch("[a-z]{1,20}", header_fields["kind"]):
        raise ValueError("its header does not say what it holds")
    header = Header(**header_fields)
    for name, entry in entries.items():
        begin = _end_of(name, entry, begin)
    if begin != size - 8 - length:
        raise ValueError(f"its arrays claim {begin:,} bytes, but it has {size - 8 - length:,}")
    return header, entries, head, sha256


def _end_of(name: str, entry: _Entry, begin: int) -> int:
    """Where an array ends that begins where the one before it ended, if it is as it claims."""
    lengths = [*entry.shape, *entry.data_offsets]
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or entry.dtype not in _TYPES:
        raise ValueError(f"{name[:60]!r} of {entry.dtype} is no array that a file may hold")
    if any(type(length) is not int or length < 0 for length in lengths):
        raise ValueError(f"{name} claims to be of shape {entry.shape}")
    end = begin + math.prod(entry.shape) * np.dtype(_TYPES[entry.dtype]).itemsize
    if entry.data_offsets != [begin, end]:
        raise ValueError(f"{name} does not stand where it should")
    return end


def _read_array(file: BinaryIO, entry: _Entry) -> NDArray[Any]:
    array: NDArray[Any] = np.empty(entry.shape, _TYPES[entry.dtype])
    numbers: Any = array.reshape(-1).view(np.uint8)
    if file.readinto(numbers.data) != array.nbytes:  # type: ignore[attr-defined]
        raise EOFError("it ends early")
    if array.dtype == np.bool_ and (numbers > 1).any():
        raise ValueError("a boolean is neither true nor false")
    return array


def _sha256(header: bytes, numbers: Iterable[Any]) -> str:
    digest = hashlib.sha256(header)
    for array in numbers:
        digest.update(array)
    return digest.hexdigest()


# -- What must agree ------------------------------------------------------------------------------


def _refuse_unfit(
    kind: Kind, settings: Mapping[str, Any], entries: Mapping[str, _Entry]
) -> dict[int | str, int]:
    """Raise for what does not fit; returns the number that each name in a shape stands for."""
    sizes: dict[int | str, int] = {}
    _refuse_settings(settings, kind.settings, sizes)
    if omissions := set(kind.arrays) - set(entries):
        raise ValueError(f"it lacks {', '.join(sorted(omissions))}")
    if unknown := set(entries) - set(kind.arrays):
        raise ValueError(f"it has {', '.join(sorted(unknown))}, which no {kind.name} has")
    for name, numbers in kind.arrays.items():
        dtype = _TYPE_NAMES[np.dtype(numbers.dtype)]
        if entries[name].dtype != dtype:
            raise ValueError(f"{name} is of type {entries[name].dtype}, not {dtype}")
        numbers.refuse_shape(name, tuple(entries[name].shape), sizes)
    return sizes


def _refuse_settings(
    settings: Mapping[str, Any],
    declared: Mapping[str, Any],
    sizes: dict[int | str, int],
    within: str = "",
) -> None:
    for name, declaration in declared.items():
        value, full_name = settings.get(name), f"{within}{name}"
        if isinstance(declaration, Mapping):
            if not isinstance(value, Mapping | None):
                raise ValueError(f"{full_name} is {value!r}; it must be a mapping")
            _refuse_settings(value or {}, declaration, sizes, f"{full_name}.")
        elif not isinstance(declaration, Numbers):
            if not _is(value, declaration):
                kind = declaration.__name__ if isinstance(declaration, type) else declaration
                raise ValueError(f"{full_name} is {value!r}; it must be of type {kind}")
        elif value is not None:
            declaration.refuse_others(full_name, value, sizes)
            if declaration.whole and declaration.shape == ():
                sizes[f"settings.{full_name}"] = int(value)
        elif not declaration.optional:
            raise ValueError(f"it lacks {full_name}")


def _is(value: Any, kind: Any) -> bool:
    if kind == list[str]:
        return isinstance(value, list) and all(isinstance(item, str) for item in value)
    return isinstance(value, kind)


# -- Errors ---------------------------------------------------------------------------------------


@contextmanager
def explained(place: Place) -> Iterator[None]:
    """Turn whatever reading a damaged file runs into into one error that names the file."""
    try:
        yield  # an error may quote what the file has
    except _DAMAGE as error:
        why = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(error)[:300])
        raise ValueError(f"{_named(place)} cannot be loaded: {why}") from error


def _opened(place: Place) -> AbstractContextManager[BinaryIO]:
    if isinstance(place, str | os.PathLike):
        return open(place, "rb")
    return nullcontext(place)


def _named(place: Place) -> str:
    return os.fspath(place) if isinstance(place, str | os.PathLike) else "what was given"

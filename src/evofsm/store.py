"""One file format for all that is learnt: named arrays and a JSON header, nothing that can run.

A file is laid out as safetensors lays one out, so that its libraries open it, too: the length of
the header in eight bytes, lowest first; the header, JSON in UTF-8, with the type, the shape and the
place of each array; then the numbers of all arrays, row by row. Under ``__metadata__`` stand
``evofsm``, again JSON (kind, version, library, settings, provenance), and ``sha256``: over the
header, with 64 zeros in its place, and all numbers.

What a kind of file may hold is declared once, as a `Kind`, where it belongs. A file is held against
it, and takes no more memory than it has bytes: a checksum shows damage, but whoever forges a file
can take it anew, and kernels take sizes and indices on trust.
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
from collections.abc import Iterator, Mapping
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
# So much of a name stands in that of what is written beside it: of 255 bytes, at four a letter.
_NAMED = 56
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
        """Raise a ValueError for another shape, or a number that is not in the range (as NaN).

        A shape has to agree with the ``sizes`` so far, to which it adds its own.
        """
        numbers, sizes = np.asarray(given), {} if sizes is None else sizes
        if numbers.dtype.kind not in "iufb" or isinstance(given, bool):
            raise ValueError(f"{name} is {given!r}; it must be a number")
        fits = numbers.ndim == len(self.shape)
        for size, have in zip(self.shape, numbers.shape, strict=False):
            fits &= have == (size if isinstance(size, int) else sizes.setdefault(size, have))
        if not fits:
            right_shape = tuple(sizes.get(size, size) for size in self.shape)
            raise ValueError(f"{name} has shape {numbers.shape}, not {right_shape}, as others say")
        if not numbers.size or numbers.dtype.kind == "b":
            return
        for number in (float(numbers.min()), float(numbers.max())):
            if not self.least <= number <= self.most:
                span = f"it must lie between {self.least:g} and {self.most:g}"
                raise ValueError(f"{name} of {number:g} cannot be right: {span}")
        if self.whole and (isinstance(given, float) or (numbers != np.rint(numbers)).any()):
            raise ValueError(f"{name} holds a fraction; it must be an integer")


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
    header = Header(*json.loads(json.dumps(header)))  # as it is read
    _refuse_unfit(kind, header.settings, arrays)
    head = _head(header, arrays)
    numbers = b"".join(array.tobytes() for array in arrays.values())
    if len(head) > _LARGEST_HEADER or len(numbers) > _LARGEST_FILE:
        raise ValueError(f"{kind.name} is too large for a file: more than {_LARGEST_FILE:,} bytes")
    signed_head = _signed(head, _sha256(head, numbers))
    with replacing(place) if isinstance(place, str | os.PathLike) else nullcontext(place) as file:
        file.writelines((len(head).to_bytes(8, "little"), signed_head, numbers))


def _head(header: Header, arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """What stands before the numbers, but for the checksum; a KeyError for another type."""
    metadata = {"sha256": _UNSIGNED, "evofsm": json.dumps(header._asdict())}
    index: dict[str, Any] = {"__metadata__": metadata}
    end = 0
    for name, array in arrays.items():
        begin, end = end, end + array.nbytes
        place = {"shape": array.shape, "data_offsets": [begin, end]}
        index[name] = {"dtype": _TYPE_NAMES[array.dtype], **place}
    head = json.dumps(index).encode()
    return head + b" " * (-len(head) % 8)  # so that numbers begin at a multiple of eight


def _signed(head: bytes, sha256: str) -> bytes:
    return head.replace(_UNSIGNED.encode(), sha256.encode(), 1)


def _sha256(head: bytes, numbers: bytes) -> str:
    digest = hashlib.sha256(head)
    digest.update(numbers)
    return digest.hexdigest()


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A file, open for writing and reading, that takes its place once it is whole and on the disk.

    The last one to end stays. A link is followed, and the mode of a file that was there is kept, as
    are its owner and its group where whoever writes may give them.
    What processes that were killed have left beside it is removed.
    Where it cannot be written, an OSError names the file, and what was there is as it was.

    No file can take the place of one that is mounted on its own, or whose folder may not be
    written: what is whole is then written over it, and a warning says so.
    """
    target, before = _place_of(path)
    beside = before is None or os.access(target.parent, os.W_OK)
    folder = target.parent if beside else Path(gettempdir())
    temporary = folder / f".{target.name[:_NAMED]}.{secrets.token_hex(8)}.part"
    opener = partial(os.open, mode=0o666 if before is None else 0o600)
    try:
        with open(temporary, "x+b", opener=opener) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            if before is not None:
                os.chmod(temporary, stat.S_IMODE(before.st_mode))
                for owner, group in ((-1, before.st_gid), (before.st_uid, -1)):
                    with suppress(OSError, AttributeError):  # no system but POSIX has owners
                        os.chown(temporary, owner, group)
            if os.name == "nt":  # where an open file cannot be renamed
                file.close()
            try:
                os.replace(temporary, target)
            except OSError as error:
                if before is None or error.errno not in _IRREPLACEABLE:
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
        if not hasattr(error, "__notes__"):
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


def _place_of(path: str | os.PathLike[str]) -> tuple[Path, os.stat_result | None]:
    """Where a file is once links are followed, and of whom; None where there is none yet."""
    file_path = Path(path)
    if not file_path.parent.is_dir():
        raise FileNotFoundError(f"{file_path}: there is no folder {file_path.parent}")
    target = Path(os.path.realpath(file_path))
    try:
        before = os.stat(file_path)
    except FileNotFoundError:
        return target, None
    if not stat.S_ISREG(before.st_mode):
        type_name = "a folder" if stat.S_ISDIR(before.st_mode) else "a device, a pipe or a socket"
        raise OSError(f"{file_path} is {type_name}, which no file may take the place of")
    return target, before


def sweep(path: str | os.PathLike[str]) -> None:
    """Remove what processes that were killed while they wrote a file have left beside it."""
    target = Path(os.path.realpath(path))
    pattern = re.compile(rf"\.{re.escape(target.name[:_NAMED])}\.[0-9a-f]{{16}}\.part")
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
    with _opened(place) as file, explained(place):
        header, sha256, head, index = _unpacked(file)
        if header.kind != kind.name:
            raise ValueError(f"it holds a {header.kind}, not a {kind.name}")
        numbers = file.read()
        if _sha256(head.replace(sha256.encode(), _UNSIGNED.encode(), 1), numbers) != sha256:
            raise ValueError("its SHA-256 is another one: it was changed or damaged")
        try:
            arrays = {name: _array(numbers, entry) for name, entry in index.items()}
            is_ours = _signed(_head(header, arrays), sha256) == head
        except _DAMAGE:
            is_ours = False
        # Of the ways to write it, only one is `write`'s; the numbers fill it.
        if not is_ours or sum(array.nbytes for array in arrays.values()) != len(numbers):
            cause = "does this process not round to nearest?"
            raise ValueError(f"its header is none that evofsm writes ({cause})")
        _refuse_unfit(kind, header.settings, arrays)
    return header.settings, arrays


def _array(numbers: bytes, entry: Mapping[str, Any]) -> NDArray[Any]:
    """An array that stands where it says it does; copied, as the numbers cannot be changed."""
    part = numbers[slice(*entry["data_offsets"])]
    return np.frombuffer(part, _TYPES[entry["dtype"]]).reshape(entry["shape"]).copy()


def _unpacked(file: BinaryIO) -> tuple[Header, str, bytes, dict[str, Any]]:
    """What a file says of itself, its checksum, all of its header, and what it says of arrays."""
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
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        raise ValueError("it is another program's file, or its header is damaged") from None
    if type(version) is int and version > _VERSION:
        versions = f"its version {version} is newer than this library's {_VERSION}"
        raise ValueError(f"{versions}; a newer evofsm reads it")
    types = dict(zip(Header._fields, (str, int, str, dict, dict), strict=True))
    has_all = {name: type(value) for name, value in header_fields.items()} == types
    if not has_all or not re.fullmatch("[a-z]{1,20}", header_fields["kind"]):
        raise ValueError("its header does not say what it holds")
    return Header(**header_fields), sha256, head, index


# -- What must agree ------------------------------------------------------------------------------


def _refuse_unfit(
    kind: Kind, settings: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> None:
    sizes: dict[int | str, int] = {}
    _refuse_settings(settings, kind.settings, sizes)
    if unknown := arrays.keys() - kind.arrays:
        raise ValueError(f"it has {', '.join(sorted(unknown))}, which no {kind.name} has")
    if omissions := kind.arrays.keys() - arrays:
        raise ValueError(f"it lacks {', '.join(sorted(omissions))}")
    for name, numbers in kind.arrays.items():
        if (dtype := arrays[name].dtype) != (right := np.dtype(numbers.dtype)):
            names = _TYPE_NAMES.get(dtype, dtype), _TYPE_NAMES[right]
            raise ValueError("{} is of type {}, not {}".format(name, *names))
        if right == np.bool_ and (arrays[name].view(np.uint8) > 1).any():
            raise ValueError(f"{name} is neither true nor false somewhere")
        numbers.refuse_others(name, arrays[name], sizes)


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
        name = os.fspath(place) if isinstance(place, str | os.PathLike) else "what was given"
        raise ValueError(f"{name} cannot be loaded: {why}") from error


def _opened(place: Place) -> AbstractContextManager[BinaryIO]:
    if isinstance(place, str | os.PathLike):
        return open(place, "rb")
    return nullcontext(place)

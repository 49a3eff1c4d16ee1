"""Traces of ASAM OSI: ground truth, and ground truth within sensor views.

Read are ``.osi`` files, in which each message stands behind its length, and MCAP. Of a message
only the moving objects are decoded, in the wire format of Protocol Buffers, with the numbers of
fields of OSI 3 (``osi_groundtruth.proto``, ``osi_object.proto``, ``osi_common.proto``). So nothing
is imported that could not be imported beside libsumo.
"""

from __future__ import annotations

import math
import struct
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

from evofsm.extras import needs
from evofsm.io.files import OnRead, damage_explained, open_unpacked
from evofsm.io.objects import Object, Scene
from evofsm.store import LARGEST_OBSERVATION

_VARINT, _DOUBLE, _BYTES, _FLOAT = 0, 1, 2, 5
_LONGEST_VARINT = 10
_MOST_BYTES = 1 << 28  # of a message; one of a sensor with images has a few million
_LENGTH = struct.Struct("<I")
_NANO = 1e-9
# Numbers of fields, by message.
_TIMESTAMP = 2  # of ground truth and of sensor views
_GROUND_TRUTH = 7  # of a sensor view
_MOVING_OBJECT = 5
_ID, _BASE, _TYPE, _OLD_LANES, _CLASSIFICATION = 1, 2, 3, 4, 9  # of a moving object
_DIMENSION, _POSITION, _ORIENTATION, _VELOCITY = 1, 2, 3, 4  # of its base
_YAW = 3
# Types of moving objects that are no vehicles: pedestrians and animals.
_ON_FOOT = frozenset({3, 4})

_Value = int | float | memoryview
_Parts = defaultdict[int, list[_Value]]


def osi_scenes(path: str, on_read: OnRead) -> Iterator[Scene]:
    """Read a ``.osi`` file, gzipped or not, scene by scene.

    What its messages are, ground truth or sensor views, is known by the name (``_gt_``, ``_sv_``)
    and else by what is in them.

    Raises
    ------
    ValueError
        If the file ends within a message, or holds something else.
    """
    with open_unpacked(path, on_read) as file, damage_explained(path):
        for number, data in enumerate(_messages(path, file), 1):
            place = f"{path}, message {number}"
            with _explained(place):
                scene = _scene(place, data, _is_view(path, data))
            yield scene


def mcap_scenes(path: str, on_read: OnRead) -> Iterator[Scene]:
    """Read OSI in MCAP: the first channel of ground truth, or else of sensor views.

    Raises
    ------
    ValueError
        If there is no such channel, or the file is damaged.
    """
    with needs("mcap", "mcap", f"{path}: MCAP"):
        from mcap.records import Channel, Message, Schema

        from evofsm.io.mcap import records

    kinds, chosen, is_view = dict[int, str](), None, False
    number = 0
    channels = dict[int, str]()
    for record in records(path, _MOST_BYTES):
        if isinstance(record, Schema):
            kinds[record.id] = record.name.rpartition(".")[2]
        elif isinstance(record, Channel):
            channels[record.id] = kinds.get(record.schema_id, "")
        elif isinstance(record, Message):
            kind = channels.get(record.channel_id, "")
            if chosen is None and kind in ("GroundTruth", "SensorView"):
                chosen, is_view = record.channel_id, kind == "SensorView"
            if record.channel_id == chosen:
                number += 1
                place = f"{path}, message {number}"
                on_read(len(record.data))
                with _explained(place):
                    scene = _scene(place, memoryview(record.data), is_view)
                yield scene
    if chosen is None:
        names = ", ".join(sorted(set(kinds.values()))) or "none"
        raise ValueError(
            f"{path}: no channel of it holds GroundTruth or SensorView of OSI; its schemas are "
            f"{names} (a bag of ROS 2 says so at its beginning, and this one does not)"
        )


def _messages(path: str, file: BinaryIO) -> Iterator[memoryview]:
    """The messages of a file, each behind its length."""
    number = 0
    while head := file.read(_LENGTH.size):
        number += 1
        size = _LENGTH.unpack(head)[0] if len(head) == _LENGTH.size else 0
        if size > _MOST_BYTES:
            raise ValueError(
                f"{path}, message {number}: {size:,} bytes long by what stands before it; this is "
                "no trace of OSI, or it is damaged there"
            )
        data = file.read(size)
        if len(head) < _LENGTH.size or len(data) < size:
            raise ValueError(
                f"{path} ends within message {number} (was a copy or a simulation interrupted?)"
            )
        yield memoryview(data)


@contextmanager
def _explained(place: str) -> Iterator[None]:
    try:
        yield
    except _WireError as error:
        raise ValueError(
            f"{place} is not ground truth of OSI, nor a sensor view (damaged, or a trace of "
            f"another message?): {error}"
        ) from error


# -- OSI ------------------------------------------------------------------------------------------


def _is_view(path: str, data: memoryview) -> bool:
    """Whether messages are sensor views; in ground truth the seventh field is a traffic light."""
    name = path.rpartition("/")[2]
    if "_sv_" in name or "_gt_" in name:
        return "_sv_" in name
    try:
        within = _parts(data)[_GROUND_TRUTH]
        stamps = [_parts(one)[_TIMESTAMP] for one in within if isinstance(one, memoryview)]
        return any(
            isinstance(value, int)
            for stamp in stamps
            for one in stamp
            if isinstance(one, memoryview)
            for value in _parts(one)[1]
        )
    except _WireError:
        return False


def _scene(place: str, data: memoryview, is_view: bool) -> Scene:
    """The moving objects of a message."""
    message = _parts(data)
    truth = _within(message, _GROUND_TRUTH) if is_view else message
    stamp = _within(truth if truth[_TIMESTAMP] else message, _TIMESTAMP)
    time = _whole(stamp, 1) + _NANO * _whole(stamp, 2)
    found = []
    for one in truth[_MOVING_OBJECT]:
        moving = _parts(_nested(one))
        if _whole(moving, _TYPE) not in _ON_FOOT and moving[_BASE]:
            found.append(_object(place, moving))
    return Scene(time, place, found)


def _object(place: str, moving: _Parts) -> Object:
    base = _within(moving, _BASE)
    position, velocity = _within(base, _POSITION), _within(base, _VELOCITY)
    name = str(_whole(_within(moving, _ID), 1))
    length = _number(_within(base, _DIMENSION), 1)
    x, y, vx, vy = (_number(part, axis) for part in (position, velocity) for axis in (1, 2))
    heading = _number(_within(base, _ORIENTATION), _YAW) if base[_ORIENTATION] else math.nan
    usable = all(abs(number) <= LARGEST_OBSERVATION for number in (x, y, vx, vy, length))
    if not (usable and length > 0.0):
        raise ValueError(
            f"{place}: object {name} is {length:g} m long, at ({x:g}, {y:g}) m, with "
            f"({vx:g}, {vy:g}) m/s; it needs a length, and numbers"
        )
    lanes = _within(moving, _CLASSIFICATION)[1] or moving[_OLD_LANES]
    lane = str(_whole(_parts(_nested(lanes[0])), 1)) if lanes else ""
    return Object(name, lane, x, y, vx, vy, length, heading)


# -- The wire format ------------------------------------------------------------------------------


class _WireError(Exception):
    """Bytes that no message is written as."""


def _parts(data: memoryview) -> _Parts:
    """The fields of a message by their numbers, in the order in which they are written."""
    found: _Parts = defaultdict(list)
    place, end = 0, len(data)
    while place < end:
        key, place = _varint(data, place)
        kind = key & 7
        value: _Value
        if kind == _VARINT:
            value, place = _varint(data, place)
        elif kind == _BYTES:
            size, place = _varint(data, place)
            value, place = data[place : place + size], place + size
        elif kind == _DOUBLE and place + 8 <= end:
            value, place = struct.unpack_from("<d", data, place)[0], place + 8
        elif kind == _FLOAT and place + 4 <= end:
            value, place = struct.unpack_from("<f", data, place)[0], place + 4
        else:
            raise _WireError(f"a field of kind {kind}, byte {place:,} of {end:,}")
        if place > end:
            raise _WireError("a field is longer than what it is in")
        found[key >> 3].append(value)
    return found


def _varint(data: memoryview, place: int) -> tuple[int, int]:
    """A whole number, and the place after it."""
    number = 0
    for shift in range(_LONGEST_VARINT):
        if place >= len(data):
            raise _WireError("it ends within a number")
        byte = data[place]
        place += 1
        number |= (byte & 0x7F) << (7 * shift)
        if byte < 0x80:
            return number, place
    raise _WireError("a number of more than ten bytes")


def _nested(value: _Value) -> memoryview:
    if not isinstance(value, memoryview):
        raise _WireError("a number stands where a message has to")
    return value


def _within(message: _Parts, field: int) -> _Parts:
    """A message within a message; empty where there is none. The last one counts."""
    values = message[field]
    return _parts(_nested(values[-1])) if values else defaultdict(list)


def _whole(message: _Parts, field: int) -> int:
    """A whole number; 0 where there is none."""
    values = message[field]
    value = values[-1] if values else 0
    if not isinstance(value, int):
        raise _WireError("something else stands where a whole number has to")
    return value - (1 << 64) if value >> 63 else value


def _number(message: _Parts, field: int) -> float:
    """A number; 0 where there is none."""
    values = message[field]
    value = values[-1] if values else 0.0
    if not isinstance(value, float):
        raise _WireError("something else stands where a number has to")
    return value

"""The messages of a monitor (docs/monitor.md), checked before anything is done with one."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from operator import itemgetter
from typing import Annotated, Any, Literal, NotRequired, TypedDict

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType, structs

from evofsm.driving import Object, Scene, TrafficRisk
from evofsm.driving.naming import REVERSE, SPEEDS, VARIABLES
from evofsm.driving.traffic import PLACES, RATES, SIZES
from evofsm.fsm.naming import visible
from evofsm.guard import ActionReviser, BoxActions, Choices, Guard
from evofsm.io.logs import ZONE
from evofsm.io.tables import TIMES, explained, is_number, seconds_of_date
from evofsm.store import LARGEST_OBSERVATION

SCHEMA = 1  #: the version of the messages
LONGEST = 1 << 16  #: a longer line is refused unread [byte]
_MOST_OBJECTS = 64  # of a whole scene; of more the first of `Scene.objects` count
_LETTERS = 40  # so much of what is refused is shown, and so long may a name be [letters]
_LATEST = 1e11  # what is later than this is in another unit [s]
#: What is said of lines of another kind.
NO_ROW = "rows are JSON, one per line, or CSV below a line that names columns (tail -n +1 -f LOG)"
_USUAL_WIDTH = 1.8  # where a width is not given [m]

_Number = Annotated[float, Meta(ge=-LARGEST_OBSERVATION, le=LARGEST_OBSERVATION)]
_Place = Annotated[float, Meta(ge=PLACES[0], le=PLACES[1])]
_Speed = Annotated[float, Meta(ge=SPEEDS[0], le=SPEEDS[1])]
_Rate = Annotated[float, Meta(ge=RATES[0], le=RATES[1])]
_Size = Annotated[float, Meta(ge=SIZES[0], le=SIZES[1])]
_Seen = _Number | None
_Keys: Any = TypedDict  # of any letters, as columns have them
_Name = Annotated[str, Meta(max_length=_LETTERS)] | Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]


class MessageError(ValueError):
    """A line that is no message."""

    def __init__(self, about: str, what: str, time: float | None = None) -> None:
        super().__init__(what)
        self.about = about
        self.time = time


class Row(msgspec.Struct, frozen=True, tag="row"):
    """What was seen at a time, and what somebody wants to do."""

    time: float  #: [s]
    #: of each variable, None where it was not seen; None altogether where nothing is ahead
    observation: tuple[float | None, ...] | None
    proposal: float | int | tuple[float, ...] | None  #: None where nothing was proposed
    ahead: str | int | None = None  #: id of the object that is followed, in a scene
    objects: tuple[str, ...] = ()  #: ids of all objects, where all are judged: number 1 first
    told: dict[str, Any] = {}  #: what other keys say, None where they are not there
    #: By which a clock of dates without a zone was put back, and the time runs on; else None.
    hours: float | None = None

    @property
    def clock(self) -> float:
        """What its clock showed [s]."""
        return self.time - 3600.0 * (self.hours or 0.0)


class End(msgspec.Struct, frozen=True, tag="end"):
    """An episode is over."""

    failed: bool
    observation: tuple[float | None, ...] | None = None  #: the last one; nothing was decided on it
    time: float | None = None  #: [s]
    hours: float | None = None  #: as of a row


class Pause(msgspec.Struct, frozen=True, tag="pause"):
    """Nothing came for so long that what waits is decided on."""


Message = Row | End
Taken = Message | Pause


class _Vehicle(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Ego or an object of a scene, as it is sent."""

    x: _Place
    vx: _Speed
    length: _Size
    id: _Name | UnsetType = UNSET
    y: _Place | UnsetType = UNSET
    lane: _Number | _Name | UnsetType = UNSET
    vy: _Speed | UnsetType = UNSET
    width: _Size = _USUAL_WIDTH
    ax: _Rate | UnsetType = UNSET


class Form:
    """Reads lines, for one guard; ``others`` are keys that rows may have beside its variables.

    The time may stand in the column of a log, ``clock``, in this unit, or in dates of this form.
    """

    def __init__(
        self, guard: Guard, others: Sequence[str] = (), clock: str = "time", unit: str = "s"
    ) -> None:
        self._guard, reviser = guard, guard.reviser
        #: Whether variables of a row may be texts.
        self.spares: Callable[[Row], bool] = lambda row: False
        #: Names of what is observed; empty where they have none, and come as a list.
        self.variables: tuple[str, ...] = guard.variables
        #: Whether the guard observes whole scenes.
        self.scenes = isinstance(reviser, ActionReviser) and isinstance(reviser.risk, TrafficRisk)
        n_variables = 0 if guard.machine is None else guard.machine.n_variables
        #: Number of variables; 0 where any will do.
        self.count = len(self.variables) or n_variables
        length = Meta(min_length=self.count or 1, max_length=self.count or None)
        several: Any = Annotated[list[_Seen], length]
        variables = dict.fromkeys(self.variables, _Seen) or {"observation": several}
        self._observed, self._others = list(variables), others
        self._form, seconds = unit if "%" in unit else "", TIMES.get(unit, 1.0)
        #: Where the time may stand, and how many seconds 1 is there.
        self._clocks = {"time": seconds if clock == "time" else 1.0}
        columns = (name for name in (clock, *clock.split(",")) if name not in (*variables, *others))
        self._clocks |= {name: seconds for name in columns if name != "time"}
        action, self._is_box = _action(guard), isinstance(guard.actions, BoxActions)
        if isinstance(guard.actions, Choices) and guard.actions.n_actions == 1:  # nobody acts
            action = NotRequired[action]
        also = dict.fromkeys(others, NotRequired[float | bool | str | None])
        also["schema"] = NotRequired[Literal[1]]
        when = dict.fromkeys(self._clocks, NotRequired[_Number | str])
        self._row = _Keys("Row", {**when, "proposal": action, **variables, **also})
        scene = {"time": _Number, "proposal": action, "ego": _Vehicle, "objects": list[_Vehicle]}
        self._scene = _Keys("Scene", {**scene, "schema": also["schema"]})
        last = {name: NotRequired[kind] for name, kind in variables.items()}
        end = {"end": bool, "failed": NotRequired[bool], **when, "time": NotRequired[_Seen | str]}
        self._end = _Keys("End", {**end, **last, **also})
        # The very keys of each: others of letters beyond ASCII msgspec 0.22 does not find.
        kinds = self._row, self._scene, self._end
        self._keys = {kind: {name: name for name in kind.__annotations__} for kind in kinds}

    def read(self, line: bytes | dict[str, Any]) -> Message:
        """The message on a line, or with these keys, of which the time is in seconds."""
        body = line if isinstance(line, dict) else _parsed(line)
        try:
            message = self._message(body, in_si=body is line)
            observation = np.array(message.observation or (), np.float64)
            if (beyond := self._guard.beyond(observation)) is not None:
                raise MessageError(*beyond)
        except MessageError as error:
            with suppress(MessageError, TypeError, OverflowError):  # where it can be read
                error.time = self._when(body, in_si=body is line)[0]
            raise
        return message

    def _message(self, body: dict[str, Any], *, in_si: bool) -> Message:
        kind = self._scene if self.scenes or body.keys() & {"ego", "objects"} else self._row
        kind = self._end if "end" in body else kind
        keys, wish = self._keys[kind], body.get("proposal")
        if isinstance(wish, list) and len(wish) == 1 and not self._is_box:
            body["proposal"] = wish[0]  # as of Gymnasium's Box(1,)
        if unknown := [name for name in body if name not in keys]:
            raise _unknown(unknown[0], keys)
        try:
            fields = msgspec.convert({keys[name]: body[name] for name in body}, kind)
        except msgspec.ValidationError as error:
            texts = {name: body[name] for name in self.variables if isinstance(body.get(name), str)}
            if texts and kind is self._row:
                row = self._message({**body, **dict.fromkeys(texts)}, in_si=in_si)
                assert isinstance(row, Row)
                if self.spares(row := structs.replace(row, told=row.told | texts)):
                    return row
                if in_si:
                    name, text = texts.popitem()
                    raise MessageError(name, explained(text)) from None
            raise _refused(body, str(error)) from None
        time, hours = self._when(fields, in_si=in_si)
        if kind is self._end:
            return self._of_end(fields, time, hours)
        if time is None:
            clocks = "".join(f", or {name!r}" for name in self._clocks if name != "time")
            raise MessageError("time", f"is missing{clocks}; every message of its kind has it")
        proposal = fields.get("proposal", 0)
        if kind is self._scene:
            return self._of_scene(fields["ego"], fields["objects"], time, proposal)
        also = {name: fields.get(name) for name in self._others}
        return Row(time, self._seen(fields), proposal, told=also, hours=hours)

    def _when(self, told: dict[str, Any], *, in_si: bool) -> tuple[float | None, float | None]:
        """The time of a message [s], as it or a log has it; and 0 hours, if it has no zone."""
        times = {name: told[name] for name in self._clocks if told.get(name) is not None}
        name, time = next(iter(times.items()), ("time", None))
        if isinstance(time, str):
            text = " ".join(map(str, times.values())).strip()
            try:
                return seconds_of_date(text, self._form), None if ZONE.search(text) else 0.0
            except ValueError:
                fault = f"is {_shown(time)}; it must be float [s], or a date as logs have them"
                raise MessageError(name, fault) from None
        seconds = time if time is None or in_si else time * self._clocks[name]
        if seconds is not None and abs(seconds) >= _LATEST:
            raise MessageError(name, f"is {time:.15g}: milliseconds? It must be in seconds")
        return seconds, None

    def _seen(self, told: dict[str, Any]) -> tuple[float | None, ...]:
        return tuple(told[name] for name in self.variables) or tuple(told["observation"])

    def _of_end(self, told: dict[str, Any], *when: float | None) -> End:
        if not told["end"]:
            raise MessageError("end", "is false; it must be true")
        omissions = [name for name in self._observed if name not in told]
        if 0 < len(omissions) < len(self._observed):
            raise MessageError(omissions[0], "is missing; a variable that was not seen is null")
        return End(told.get("failed", False), None if omissions else self._seen(told), *when)

    def _of_scene(self, ego: _Vehicle, cars: list[_Vehicle], time: float, proposal: Any) -> Row:
        if not (self.scenes or self.variables == VARIABLES):
            fault = "are for guards of car following; send a row of this guard's variables"
            raise MessageError("objects", fault)
        if ego.vx < REVERSE:
            raise MessageError("ego.vx", f"is {ego.vx:g}; x counts along its direction of travel")
        _refuse_unplaced("ego", ego, ego)
        for k, car in enumerate(cars):
            _refuse_unplaced(f"objects[{k}]", car, ego)
        if self.scenes:
            objects = [_object(car, f"objects[{k}]") for k, car in enumerate(cars)]
            scene = Scene(_object(ego, "ego"), objects)
            names = tuple(obj.id for obj in scene.objects[1 : _MOST_OBJECTS + 1])
            rows = (None if math.isnan(z) else z for z in scene.rows(_MOST_OBJECTS).tolist())
            return Row(time, tuple(rows), proposal, objects=names)
        # The closest in the own lane whose middle is ahead.
        ahead = (car for car in cars if car.x > ego.x and _in_lane(ego, car))
        gaps = ((car.x - ego.x - 0.5 * (ego.length + car.length), car) for car in ahead)
        if (nearest := min(gaps, key=itemgetter(0), default=None)) is None:
            return Row(time, None, proposal)
        gap, car = nearest
        return Row(time, (gap, ego.vx, car.vx), proposal, None if car.id is UNSET else car.id)


def _action(guard: Guard) -> Any:
    """The type of a proposal."""
    actions = guard.actions
    if isinstance(actions, Choices):
        return Annotated[int, Meta(ge=0, le=actions.n_actions - 1)] | None
    if isinstance(actions, BoxActions):
        length = Meta(min_length=(n := int(np.size(actions.low))), max_length=n)
        return Annotated[tuple[_Number, ...], length] | None
    return _Number | None


# -- Scenes ---------------------------------------------------------------------------------------


def _refuse_unplaced(where: str, car: _Vehicle, ego: _Vehicle) -> None:
    """Raise where a vehicle has no name, or it cannot be told whether ego is in its lane."""
    if car.lane is UNSET and car.y is UNSET:
        raise MessageError(f"{where}.y", "is missing, and so is lane; one of them is needed")
    if car.id is UNSET and car is not ego:
        raise MessageError(f"{where}.id", "is missing; it must be an int or a text")
    if UNSET in (car.lane, ego.lane) and UNSET in (car.y, ego.y):
        fault = "is given for it or for ego, but not for both; nor is y"
        raise MessageError(f"{where}.lane", fault)


def _object(car: _Vehicle, where: str) -> Object:
    """An object whose sides are known, so that it is known who is in whose way."""
    if car.y is UNSET:
        raise MessageError(f"{where}.y", "is missing; it says who is in whose way")
    name = where if car.id is UNSET else str(car.id)
    vy, ax = (math.nan if rate is UNSET else rate for rate in (car.vy, car.ax))
    return Object(name, car.x, car.y, car.vx, vy, car.length, car.width, ax)


def _in_lane(ego: Any, car: Any) -> bool:
    """Whether it is in the own lane; by their widths where a lane is not given."""
    if ego.lane is not UNSET and car.lane is not UNSET:
        return len({str(x.lane).removesuffix(".0") for x in (ego, car)}) == 1  # 1, 1.0 and "1"
    return bool(abs(car.y - ego.y) < 0.5 * (ego.width + car.width))


# -- What was wrong with a line -------------------------------------------------------------------


def _parsed(line: bytes) -> dict[str, Any]:
    """Whatever JSON it is."""
    line = line.removeprefix(b"\xef\xbb\xbf")  # a byte order mark, before the first line
    if len(line) > LONGEST:
        raise MessageError("line", f"is longer than {LONGEST} bytes")
    try:
        body = msgspec.json.decode(line)
        json.loads(line, object_pairs_hook=_refuse_twice, parse_int=str)
    except RecursionError:
        raise MessageError("line", "is nested too deeply") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        if not line.strip():
            raise MessageError("line", "is empty") from None
        if match := re.search(rb"-?\b(NaN|Infinity)\b", line):
            name = match[0].decode()
            fault = f"holds {name}, which is no JSON; a number that was not seen is null"
            raise MessageError("line", fault) from None
        if str(error).startswith("Number out of range"):
            raise MessageError("line", "holds a number that is too large") from None
        kind = "not UTF-8" if isinstance(error, UnicodeDecodeError) else "no JSON"
        hint = "" if line.lstrip().startswith(b"{") else f"; {NO_ROW}"
        raise MessageError("line", f"is {kind}: {error}{hint}") from None
    if not isinstance(body, dict):
        raise MessageError("line", f"is {_shown(body)}; it must be a JSON object")
    return body


def _refused(body: dict[str, Any], error: str) -> MessageError:
    """What msgspec refused, with the key and the value, in a sentence."""
    text, _, place = error.partition(" - at `$")
    place = place.removesuffix("`").removeprefix(".")
    if text == "Number out of range":
        return MessageError(place, "is too large")
    if match := re.fullmatch(r"Object (missing|contains).* field `(.*)`", text):
        about = f"{place}.{match[2]}".removeprefix(".")
        if match[1] == "missing":
            return MessageError(about, f"is missing{_missing(about)}")
        return _unknown(about, _Vehicle.__struct_fields__)
    value = _shown(_at(body, place))
    if place == "schema":
        fault = f"is {value}; this monitor knows version {SCHEMA} alone"
    else:
        demand = re.sub("^Expected |, got .*|`", "", text).replace(" | ", " or ")
        fault = f"is {value}; it must be {demand}"
        if isinstance(word := _at(body, place), str) and is_number(word.replace(",", ".")):
            cause = "a decimal comma" if "," in word else "a number in quotes"
            fault += f" ({cause}? send {word.replace(',', '.')})"
    return MessageError(place or "line", fault)


def _unknown(about: str, names: Iterable[str]) -> MessageError:
    return MessageError(about[:_LETTERS], f"is not known; known are {', '.join(sorted(names))}")


def _refuse_twice(pairs: list[tuple[str, Any]]) -> None:
    """Raise where a key of an object is there twice: of its values one would be left out."""
    if len(dict(pairs)) < len(pairs):
        name, count = Counter(name for name, _ in pairs).most_common(1)[0]
        raise MessageError(name[:_LETTERS], f"is there {count} times; which of them counts?")


def _at(told: Any, place: str) -> Any:
    """The value at a place such as ``objects[3].vx``."""
    value, keys = told, [place] if place in told else re.findall(r"[^.\[\]]+", place)
    for key in keys:
        value = value[int(key)] if isinstance(value, list) else value.get(key)
    return value


def _missing(about: str) -> str:
    """What to do about a key that is missing."""
    if about == "proposal":
        return ": what the controller wants to do, or null if nothing"
    if about in ("time", "ego", "objects", "end") or "." in about:
        return "; every message of its kind has it"
    return "; a variable that was not seen is null"


def _shown(value: Any) -> str:
    """The beginning of what was sent."""
    try:
        text = json.dumps(value, ensure_ascii=False)
    except (ValueError, RecursionError):  # integers of thousands of digits
        return "something too large to show"
    return visible(text if len(text) <= _LETTERS else f"{text[: _LETTERS - 3]}...")

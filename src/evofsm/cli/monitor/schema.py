"""The messages of a monitor: what a line may hold, checked before anything is done with it.

A message is a JSON object on a line of its own; ``docs/monitor.md`` describes each key.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np

from evofsm.cli.monitor.objects import Ahead, nearest_ahead
from evofsm.driving import VARIABLES, Object, Scene, TrafficRisk
from evofsm.fsm import visible
from evofsm.guard import ActionReviser, BoxActions, Choices, Guard
from evofsm.store import LARGEST_OBSERVATION as _LARGEST

#: The version of the messages.
SCHEMA = 1
#: A longer line is refused unread [byte].
LONGEST = 1 << 16
# Objects that a guard of whole scenes has room for; of more the closest along the road count.
_MOST = 64
# So much of what is refused is shown [letters].
_SHOWN = 40
_LARGEST_ID = 1 << 63
_OBSERVATION = "observation"
_KEYS = frozenset({"id", "s", "x", "y", "lane", "vx", "vy", "length", "width"})
_REQUIRED = ("vx", "length")

Number = float | None
Action = float | tuple[float, ...] | None


class MessageError(ValueError):
    """A line that is no message.

    Parameters
    ----------
    about : str
        The key, such as ``objects[3].vx``; ``line`` where it is about all of it.
    what : str
        What is wrong with it.
    time : float, optional
        Of the message, where that could be read [s].
    """

    def __init__(self, about: str, what: str, time: float | None = None) -> None:
        super().__init__(what)
        self.about = about
        self.time = time


class Row(NamedTuple):
    """What was seen at a time, and what somebody wants to do."""

    time: float  #: [s]
    #: of each variable, None where it was not seen; None altogether where nothing is ahead
    observation: tuple[Number, ...] | None
    proposal: Action  #: None where nothing was proposed
    ahead: str | int | None = None  #: id of the object that is followed, in a scene
    #: ids of all objects, where all are judged: number 1 first
    objects: tuple[str, ...] = ()

    @classmethod
    def kept(cls, values: Sequence[Any]) -> Self:
        """The row that JSON has kept as a list."""
        time, observation, proposal, ahead, *others = values
        seen = None if observation is None else tuple(observation)
        wanted = tuple(proposal) if isinstance(proposal, list) else proposal
        return cls(time, seen, wanted, ahead, *map(tuple, others))


class End(NamedTuple):
    """An episode is over."""

    failed: bool
    observation: tuple[Number, ...] | None = None  #: the last one, on which nothing was decided


@dataclass(frozen=True)
class Form:
    """Reads lines, for one guard.

    Parameters
    ----------
    variables : tuple of str
        Names of what is observed; empty where they have none, and come as a list.
    count : int
        Number of variables; 0 where any will do.
    components : int
        Of an action that is a vector; 0 where it is a number.
    n_actions : int
        Where an action is an index; else 0.
    proposal : float, optional
        Taken where a row has none; without it such a row is refused.
    scenes : bool
        Whether the guard observes whole scenes.

    Examples
    --------
    >>> form = Form(("gap", "v_follower", "v_leader"), 3)
    >>> line = b'{"time": 1.5, "gap": 30, "v_follower": 20, "v_leader": null, "proposal": 0.5}'
    >>> form.read(line)
    Row(time=1.5, observation=(30.0, 20.0, None), proposal=0.5, ahead=None, objects=())
    >>> form.read(b'{"end": true, "failed": true}')
    End(failed=True, observation=None)
    >>> form.read(b'{"schema": 2}')
    Traceback (most recent call last):
    evofsm.cli.monitor.schema.MessageError: is 2; this monitor knows version 1 alone
    """

    variables: tuple[str, ...]
    count: int = 0
    components: int = 0
    n_actions: int = 0
    proposal: float | None = None
    scenes: bool = False

    @classmethod
    def of(cls, guard: Guard, proposal: float | None = None) -> Self:
        """The form of what a guard takes."""
        actions, known = guard.actions, 0 if guard.machine is None else guard.machine.n_variables
        return cls(
            guard.variables,
            len(guard.variables) or known,
            np.size(actions.low) if isinstance(actions, BoxActions) else 0,
            actions.n_actions if isinstance(actions, Choices) else 0,
            proposal,
            isinstance(guard.reviser, ActionReviser)
            and isinstance(guard.reviser.risk, TrafficRisk),
        )

    def read(self, line: bytes) -> Row | End:
        """The message on a line.

        Raises
        ------
        MessageError
            If it is none; the error names the key.
        """
        told = _parsed(line)
        time = told.get("time")
        try:
            return self._read(told)
        except MessageError as refused:
            if isinstance(time, int | float) and abs(time) <= _LARGEST:
                refused.time = float(time)
            raise

    def _read(self, told: Mapping[str, Any]) -> Row | End:
        schema = told.get("schema", SCHEMA)
        if type(schema) is not int or schema != SCHEMA:
            raise MessageError(
                "schema", f"is {_shown(schema)}; this monitor knows version {SCHEMA} alone"
            )
        if "end" in told:
            return self._end(told)
        if self.scenes or "objects" in told or "ego" in told:
            return self._scene(told)
        _refuse_unknown(told, "", {"schema", "time", "proposal", *self._keys})
        return Row(_number(told, "time"), self._observation(told), self._action(told))

    @property
    def _keys(self) -> tuple[str, ...]:
        return self.variables or (_OBSERVATION,)

    def _end(self, told: Mapping[str, Any]) -> End:
        _refuse_unknown(told, "", {"schema", "time", "end", "failed", *self._keys})
        if told["end"] is not True:
            raise MessageError("end", f"is {_shown(told['end'])}; it must be true")
        failed = told.get("failed", False)
        if type(failed) is not bool:
            raise MessageError("failed", f"is {_shown(failed)}; it must be true or false")
        seen = any(key in told for key in self._keys)
        return End(failed, self._observation(told) if seen else None)

    def _observation(self, told: Mapping[str, Any]) -> tuple[Number, ...]:
        if self.variables:
            return tuple(_seen(told, name, name) for name in self.variables)
        values = told.get(_OBSERVATION)
        if not isinstance(values, list) or not values or len(values) != (self.count or len(values)):
            of = f"{self.count} numbers" if self.count else "numbers"
            raise MessageError(_OBSERVATION, f"is {_shown(values)}; it must be a list of {of}")
        return tuple(_seen(values, k, f"{_OBSERVATION}[{k}]") for k in range(len(values)))

    def _action(self, told: Mapping[str, Any]) -> Action:
        if "proposal" not in told:
            if self.proposal is None:
                raise MessageError(
                    "proposal",
                    "is missing: what the controller wants to do, or null if nothing; with "
                    "--proposal NUMBER that is taken for it",
                )
            return self.proposal
        value = told["proposal"]
        if value is None:
            return None
        if self.components:
            if not isinstance(value, list) or len(value) != self.components:
                raise MessageError(
                    "proposal",
                    f"is {_shown(value)}; it must be a list of {self.components} numbers, or null",
                )
            return tuple(_number(value, k, f"proposal[{k}]") for k in range(self.components))
        if self.n_actions and not (type(value) is int and 0 <= value < self.n_actions):
            raise MessageError(
                "proposal",
                f"is {_shown(value)}; it must be a whole number from 0 to {self.n_actions - 1}",
            )
        return _number(told, "proposal")

    def _scene(self, told: Mapping[str, Any]) -> Row:
        _refuse_unknown(told, "", {"schema", "time", "proposal", "ego", "objects"})
        if self.variables != VARIABLES and not self.scenes:
            raise MessageError(
                "objects", "are for guards of car following; send a row of this guard's variables"
            )
        ego, objects = told.get("ego"), told.get("objects")
        if not isinstance(ego, dict):
            raise MessageError("ego", f"is {_shown(ego)}; it must be an object")
        if not isinstance(objects, list):
            raise MessageError("objects", f"is {_shown(objects)}; it must be a list of objects")
        along = "s" if "s" in ego else "x"
        mine = _placed(ego, "ego", along)
        others = [_named(one, f"objects[{k}]", along, mine) for k, one in enumerate(objects)]
        time, proposal = _number(told, "time"), self._action(told)
        if self.scenes:
            scene = Scene(
                _object(mine, "ego", along),
                [_object(one, f"objects[{k}]", along) for k, one in enumerate(others)],
            )
            names = tuple(each.id for each in scene.objects[1 : _MOST + 1])
            return Row(time, tuple(scene.rows(_MOST).tolist()), proposal, objects=names)
        ahead: Ahead | None = nearest_ahead(mine, others, along)
        if ahead is None:
            return Row(time, None, proposal)
        return Row(time, ahead[1:], proposal, ahead.name)


# -- What JSON may hold ---------------------------------------------------------------------------


def _parsed(line: bytes) -> dict[str, Any]:
    if len(line) > LONGEST:
        raise MessageError("line", f"is longer than {LONGEST} bytes")
    try:
        text = line.decode("utf-8")
    except UnicodeDecodeError as error:
        raise MessageError("line", f"is not UTF-8 at byte {error.start}") from None
    if not text.strip():
        raise MessageError("line", "is empty")
    try:
        told = json.loads(text, parse_constant=_no_constant, object_pairs_hook=_once)
    except MessageError:
        raise
    except RecursionError:
        raise MessageError("line", "is nested too deeply") from None
    except ValueError as error:
        raise MessageError("line", f"is no JSON: {error}") from None
    if not isinstance(told, dict):
        raise MessageError("line", f"is {_shown(told)}; it must be a JSON object")
    return told


def _no_constant(name: str) -> float:
    raise MessageError(
        "line", f"holds {name}, which is no JSON; a number that was not seen is null"
    )


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) != len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise MessageError(_shown(twice), "is there twice")
    return made


def _refuse_unknown(told: Mapping[str, Any], where: str, known: Iterable[str]) -> None:
    if unknown := told.keys() - known:
        name = min(unknown)
        raise MessageError(
            f"{where}{name}"[:_SHOWN], f"is not known; known are {', '.join(sorted(known))}"
        )


def _number(told: Any, key: str | int, about: str | None = None) -> float:
    where = str(key) if about is None else about
    value = told.get(key) if isinstance(told, dict) else told[key]
    if value is None:
        missing = "is null" if not isinstance(told, dict) or key in told else "is missing"
        raise MessageError(where, f"{missing}; it must be a finite number")
    return _finite(where, value, "it must be a finite number")


def _seen(told: Any, key: str | int, about: str) -> Number:
    if isinstance(told, dict) and key not in told:
        raise MessageError(about, "is missing; a variable that was not seen is null")
    value = told[key]
    rule = "it must be a finite number, or null if not seen"
    return None if value is None else _finite(about, value, rule)


def _finite(about: str, value: Any, rule: str) -> float:
    # A truth value is no number; NaN and what overflows fail the comparison.
    if type(value) not in (int, float) or not abs(value) <= _LARGEST:
        raise MessageError(about, f"is {_shown(value)}; {rule}")
    return float(value)


def _placed(one: Any, where: str, along: str) -> dict[str, Any]:
    """An object with its numbers checked."""
    if not isinstance(one, dict):
        raise MessageError(where, f"is {_shown(one)}; it must be an object")
    if not one.keys() <= _KEYS:
        _refuse_unknown(one, f"{where}.", _KEYS)
    for key, value in one.items():
        # Nearly all are plain numbers: they are not looked at for long.
        if type(value) is float and key != "id" and -_LARGEST <= value <= _LARGEST:
            continue
        if key == "id" or (key == "lane" and isinstance(value, str)):
            _refuse_unlabelled(value, f"{where}.{key}")
        else:
            _finite(f"{where}.{key}", value, "it must be a finite number")
    for key in (along, *_REQUIRED):
        if key not in one:
            raise MessageError(f"{where}.{key}", "is missing; it must be a finite number")
    if along == "s" and "lane" not in one:
        raise MessageError(
            f"{where}.lane", "is missing: without it s does not say who follows whom"
        )
    if "lane" not in one and "y" not in one:
        raise MessageError(f"{where}.y", "is missing, and so is lane; one of them is needed")
    return one


def _object(placed: Mapping[str, Any], where: str, along: str) -> Object:
    """An object whose sides are known, so that it can be told who is in whose way."""
    if "y" not in placed:
        raise MessageError(f"{where}.y", "is missing; who is in whose way is told from it")
    told = {key: placed[key] for key in ("vy", "width") if key in placed}
    name = str(placed.get("id", where))
    return Object(name, placed[along], placed["y"], placed["vx"], length=placed["length"], **told)


def _named(one: Any, where: str, along: str, ego: Mapping[str, Any]) -> dict[str, Any]:
    placed = _placed(one, where, along)
    if "id" not in placed:
        raise MessageError(f"{where}.id", "is missing; it must be a text or a whole number")
    if ("lane" in placed) != ("lane" in ego) and not ("y" in placed and "y" in ego):
        raise MessageError(f"{where}.lane", "is told of it or of ego, but not of both; nor is y")
    return placed


def _refuse_unlabelled(value: Any, about: str) -> None:
    if (type(value) is int and abs(value) < _LARGEST_ID) or (
        isinstance(value, str) and len(value) <= _SHOWN
    ):
        return
    raise MessageError(
        about, f"is {_shown(value)}; it must be a whole number, or a text of {_SHOWN} letters"
    )


def _shown(value: Any) -> str:
    """The beginning of what was sent."""
    try:
        text = json.dumps(value, ensure_ascii=False)
    except (ValueError, RecursionError):  # integers of thousands of digits
        return "something too large to show"
    return visible(text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}...")


def is_late(row: Row, latest: Row, window: float) -> bool:
    """Whether a row comes out of order: older than the latest one, but not by much [s].

    Examples
    --------
    >>> latest = Row(10.0, (1.0,), 0.0)
    >>> [is_late(latest._replace(time=time), latest, 1.0) for time in (9.5, 10.0, 10.5, 2.0)]
    [True, False, False, False]
    """
    return latest.time - window <= row.time < latest.time


def as_floats(observation: Sequence[Number]) -> list[float]:
    """With NaN where a variable was not seen."""
    return [math.nan if value is None else value for value in observation]

"""What the records of a log hold: the names in each kind of them, and since which version.

A chain says that nothing was changed since it was made, and replaying that decisions follow from
what was observed. Neither looks at the rest: a version that never was, a name that no log holds, a
number of an episode, the clock. Here all that is held against what `log.AuditLog` writes.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from typing import Any, NamedTuple

from evofsm.fleet.sealed import LOG_HEADER, SealedRecord
from evofsm.guard.record import RECORD

#: Of what is written now; every version from 1 on is read.
LOG_VERSION = 4
#: The version from which on a record holds what was not in it from the first.
SINCE = {"explanation": 2, "failure_told": 4}
# The version from which on actions may be vectors.
_VECTORS = 3
_ACTIONS = ("proposed", "executed", "advised")

_NOTHING = type(None)
_Types = tuple[type, ...]
# Numbers that are not finite are words.
_NUMBER: _Types = (float, str)
_AS_JSON: Mapping[type, _Types] = {int: (int,), float: _NUMBER, str: (str,)}
# What is told of a decision as it is recorded elsewhere; lists are told beside.
TOLD = tuple(name for name in RECORD if name not in ("time", "n_states", "risk_low", "risk_high"))
# What stands in every record, and what else in those of a kind.
_ALWAYS: Mapping[str, _Types] = {"kind": (str,), "clock": (str,)}
_KINDS: Mapping[str, Mapping[str, _Types]] = {
    "start": {
        "about": (str,),
        "actions": (dict,),
        "cut_off": (int,),
        "machine": (dict, _NOTHING),
        "made_by": (dict,),
        "reviser": (dict,),
        "risk": (dict, _NOTHING),
        "version": (int,),
    },
    "begin": {
        "episode": (int,),
        "failure_told": (bool,),
        "interval": (int, float, _NOTHING),
        "learn": (bool, int),
        "missing": (str,),
    },
    "decision": {
        **{name: _AS_JSON[RECORD[name].kind] for name in (*TOLD, "time")},
        **dict.fromkeys(("before", "belief", "candidates", "interval", "observation"), (list,)),
        "state": (int, _NOTHING),
    },
    "quiet": {"before": (list,)},
    "settings": {"settings": (dict,)},
    "end": {
        "before": (list,),
        "failed": (bool,),
        "learnt": (dict,),
        "observation": (list, _NOTHING),
    },
}
# What stands within, wherever it stands.
_FILE = ("file", "sha256")
_WITHIN: Mapping[str, Collection[str]] = {
    "machine": _FILE,
    "made_by": ("evofsm", "numba", "numpy", "processor", "python"),
    "risk": _FILE,
    "settings": ("mode", "overridden", "release", "tolerance", "way"),
}
_EPOCH = datetime.fromtimestamp(0, UTC)
# Clocks of two computers may differ by this.
_AHEAD = timedelta(days=1)


class Misfit(NamedTuple):
    """The first record that no log of its version holds."""

    record: int
    explanation: str


class Form:
    """Follows the records of a log from its first, and keeps what is odd about them."""

    def __init__(self) -> None:
        #: None as long as all are such as are written.
        self.misfit: Misfit | None = None
        self._version = 0  # of no session yet
        self._episodes = 0
        self._unexplained = 0  # decisions of a version that holds no explanations
        self._clock: datetime | None = None
        self._setback: tuple[int, timedelta] | None = None  # of the clock, at first
        self._setbacks = 0

    def check(self, record: SealedRecord) -> None:
        """Look at the next record."""
        if self.misfit is None:
            try:
                self._check(record)
            except ValueError as error:
                self.misfit = Misfit(record.number, str(error))

    def remarks(self) -> tuple[str, ...]:
        """What is no proof of anything, but neither was it compared with anything."""
        said = []
        if self._unexplained:
            before = f"versions before {SINCE['explanation']} hold no explanations"
            said.append(f"{before}: {self._unexplained:,} decisions are compared without")
        if self._setback is not None:
            number, by = self._setback
            more = f" and at {self._setbacks - 1:,} more" if self._setbacks > 1 else ""
            said.append(
                f"the clock goes back by {by.total_seconds():g} s at record {number}{more}: it was "
                "set meanwhile, or these records were not written when they say"
            )
        if self._clock is not None and self._clock > datetime.now(UTC) + _AHEAD:
            said.append(f"the clock, {self._clock.isoformat()}, is ahead of this computer's")
        return tuple(said)

    def _check(self, record: SealedRecord) -> None:
        content = record.content
        kind = content.get("kind")
        if not isinstance(kind, str) or kind not in _KINDS:
            raise ValueError(f"there is no kind {str(kind)[:40]!r}")
        if kind == "start":
            self._version = _version(content.get("version"))
        elif not self._version:
            raise ValueError("it comes before anyone takes part")
        held = {
            name: types
            for name, types in _KINDS[kind].items()
            if SINCE.get(name, 1) <= self._version
        }
        if kind == "decision" and self._version >= _VECTORS:
            held |= {name: (*held[name], list) for name in _ACTIONS}
        what = f"a record of kind {kind!r} in version {self._version}"
        _refuse_others(content, {**_ALWAYS, **held}, what)
        for name in _WITHIN.keys() & content.keys():
            if content[name] is not None:
                _refuse_other_names(content[name], _WITHIN[name], f"{name!r} in {what}")
        self._follow(kind, record)

    def _follow(self, kind: str, record: SealedRecord) -> None:
        """What must fit the records before."""
        content = record.content
        self._see(record.number, content["clock"])
        if kind == "start" and content["about"] != LOG_HEADER["about"]:
            raise ValueError(f"it is about {content['about']!r}")
        if kind == "begin":
            self._episodes += 1
            if content["episode"] != self._episodes:
                raise ValueError(
                    f"it says that it begins episode {content['episode']}, but it is episode "
                    f"{self._episodes} that begins here"
                )
        self._unexplained += kind == "decision" and self._version < SINCE["explanation"]

    def _see(self, number: int, text: str) -> None:
        clock = _clock(text)
        if self._clock is not None and clock < self._clock:
            self._setback = self._setback or (number, self._clock - clock)
            self._setbacks += 1
        self._clock = clock


def _version(version: Any) -> int:
    # A newer one is none of this library's business, and is said before.
    if type(version) is not int or version < 1:
        raise ValueError(
            f"it says that it is of version {version!r}; versions are whole numbers from 1"
        )
    return version


def _refuse_others(content: Mapping[str, Any], held: Mapping[str, _Types], what: str) -> None:
    _refuse_other_names(content, held, what)
    for name, types in held.items():
        if type(content[name]) not in types:
            raise ValueError(f"{name!r} in {what} is {str(content[name])[:40]!r}")


def _refuse_other_names(content: Mapping[str, Any], held: Collection[str], what: str) -> None:
    """Raise where a name is there that is not written, or one is not that is."""
    if unknown := sorted(content.keys() - set(held)):
        raise ValueError(f"{what} has no {unknown[0][:40]!r}, but here is one")
    if missing := sorted(set(held) - content.keys()):
        raise ValueError(f"{what} has {missing[0]!r}, but here is none")


def _clock(text: str) -> datetime:
    """The time that a clock shows, as `datetime.isoformat` writes it in UTC."""
    with suppress(ValueError):
        clock = datetime.fromisoformat(text)
        if clock.isoformat() == text and clock.utcoffset() == timedelta(0) and clock >= _EPOCH:
            return clock
    raise ValueError(f"its clock is {text[:40]!r}, which is no time since 1970 in UTC")

"""Audit a log: whether it is what was written, and whether those were the decisions.

It decides again, without a world: what was observed and proposed is told to the guard that the log
began with, and each decision must come out as it was recorded, to the last bit. So neither a forged
decision nor a forged model hides behind a chain that was made anew.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.guard.actions import checked_mask
from evofsm.guard.api import Proposal
from evofsm.guard.audit_log import (
    FIELDS,
    LOG_VERSION,
    NOTHING,
    SETTINGS,
    Chain,
    Field,
    Finding,
    Head,
    Record,
    canonical,
    decision_of,
    made_by,
    settings_now,
    sums_of,
)
from evofsm.guard.guard import Guard
from evofsm.guard.parts import set_again
from evofsm.guard.reviser import is_spoken

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
_Failed = Callable[[NDArray[np.float64]], bool]


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
        As the guard had it. No log holds code: without it episodes of a guard that was told by a
        function where it fails are not replayed, which is said.

    Raises
    ------
    OSError
        If there is no such file, or it may not be read.
    ValueError
        If it is no audit log.

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
    ...     forged = path.read_text().replace('"executed":-2.5', '"executed":2.5')
    ...     _ = path.write_text(forged)
    ...     audit(path).finding
    Finding(record=3, explanation='record 3 was altered: its hash is not that of what it says', \
fields=())
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
        self._is_under_way = False

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
        kind, before = content["kind"], content.get("before", ())
        if kind == "start":
            self._start(content)
            return
        if self._guard is None:
            return
        if not self._is_under_way and (before or kind in ("decision", "end")):
            raise ValueError("it belongs to no episode")
        for row in before:
            self._row(self._guard, None, row)
        if kind in ("begin", "settings"):
            self._set(self._guard, content["settings"])
        if kind == "begin":
            self._guard.begin()
            self._is_under_way = True
        elif kind == "decision":
            names = ("time", "observation", "proposed", "mask")
            self._row(self._guard, content, [content[name] for name in names])
        elif kind == "end":
            self._end(self._guard, content)

    def _start(self, content: Mapping[str, Any]) -> None:
        now = made_by()
        for name, then in content["made_by"].items():
            if then != now.get(name):
                self.other_makers[name] = Field(name, str(then), now.get(name, ""))
        self._guard, self._is_under_way = None, False
        needs_code = content["told_failures"]
        if content["guard"] is None:
            self.not_replayed.append(
                f"{content['reviser']} is no reviser that is known here, or asks a judge that is "
                "not, or that was not told what happened, or the guard was too large"
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
        self._is_under_way = False
        if fields := _differing(content["learnt"], sums_of(guard)):
            raise _DiffersError("something else was learnt until its end", fields)


def _number(value: Any) -> float:
    if value in ("NaN", "Infinity", "-Infinity"):
        return float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{value!r} stands where a number should")
    return float(value)


def _floats(values: Sequence[Any]) -> NDArray[np.float64]:
    return np.array([_number(value) for value in values])


def _differing(recorded: Mapping[str, Any], again: Mapping[str, Any]) -> tuple[Field, ...]:
    before, after = (
        {name: canonical(value) for name, value in of.items()} for of in (recorded, again)
    )
    names = sorted(before.keys() | after.keys())
    fields = [Field(name, before.get(name, ""), after.get(name, "")) for name in names]
    return tuple(field for field in fields if field.recorded != field.replayed)

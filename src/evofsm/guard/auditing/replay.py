"""Audit a log: whether it is what was written, and whether those were the decisions.

The second question is answered by driving again, without a world: what was observed and proposed
is told to the machine, the risk and the reviser that the log began with, and each decision must
come out as it was recorded, to the last bit. So neither a forged decision nor a forged model hides
behind a chain that was made anew.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fleet.sealed import (
    Chain,
    Head,
    SealedRecord,
    canonical,
    number,
    records,
    verify,
)
from evofsm.fsm import Missing
from evofsm.guard.actions import Action
from evofsm.guard.auditing.form import LOG_VERSION, SINCE, Form, Misfit
from evofsm.guard.auditing.log import told
from evofsm.guard.auditing.participants import (
    CannotBeReplayedError,
    learnt,
    made_by,
    restore,
    set_again,
)
from evofsm.guard.guard import Explain, Guard
from evofsm.guard.protocols import Participants, Proposal, Revision, Situation
from evofsm.guard.reviser import is_spoken

# What a record that someone made up may run into.
_NONSENSE = (
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    OverflowError,
    OSError,
    MemoryError,
)
# Why what follows is not replayed.
_NO_FUNCTION = (
    "a function told the guard where it fails, and no log holds code; give it as failed "
    "(--failed MODULE:FUNCTION)"
)


class Field(NamedTuple):
    """What differs, as JSON."""

    name: str
    recorded: str
    replayed: str


class Difference(NamedTuple):
    """The first record that replaying does not lead to."""

    record: int
    explanation: str
    fields: tuple[Field, ...] = ()


class Replay(NamedTuple):
    """What replaying says."""

    decisions: int  #: that came out as they were recorded
    not_replayed: tuple[str, ...]  #: why not, of each session that could not be
    other_makers: tuple[Field, ...]  #: what computed then and what does now, where that differs
    difference: Difference | None


class Contents(NamedTuple):
    """What a log is about."""

    sessions: int  #: times that machine and risk were written down
    episodes: int
    decisions: int
    spoke: int  #: decisions that changed something or raised an alarm
    settings: int  #: times that settings were changed while driving


class Audit(NamedTuple):
    """All that is found out about a log."""

    chain: Chain
    contents: Contents  #: of the records that are unbroken
    replay: Replay | None  #: None where it was not asked for, or the log was tampered with
    misfit: Misfit | None = None  #: the first of them that no log of its version holds
    remarks: tuple[str, ...] = ()  #: what nothing was compared with

    @property
    def is_good(self) -> bool:
        """Whether nothing was tampered with, and nothing came out otherwise."""
        replayed = self.replay is None or self.replay.difference is None
        return self.chain.finding is None and self.misfit is None and replayed


def audit(
    path: Path,
    kept: Head | None = None,
    *,
    replay: bool = True,
    failed: Callable[[NDArray[np.float64]], bool] | None = None,
) -> Audit:
    """Verify the chain of a log and the form of its records, and replay it where they are whole.

    Parameters
    ----------
    path : Path
        One that is being written is audited up to where it is now.
    kept : Head, optional
        A head that was kept elsewhere.
    replay : bool
    failed : callable, optional
        As the guard had it. No log holds code: without it episodes of a guard that was told by a
        function where it fails are not replayed, which is said.

    Returns
    -------
    Audit

    Raises
    ------
    OSError
        If there is no such file, or it may not be read.
    ValueError
        If it is no audit log, or one of a newer version.
    """
    chain = verify(path, kept)
    if chain.head.number == 0 and chain.finding is None:
        raise ValueError(f"{path} is no audit log, or no record of it was finished")
    count = chain.head.number or 0
    contents, form = _survey(path, count)
    is_whole = chain.finding is None and form.misfit is None
    again = _replay(path, count, failed) if replay and is_whole else None
    return Audit(chain, contents, again, form.misfit, form.remarks())


def _survey(path: Path, count: int) -> tuple[Contents, Form]:
    kinds: Counter[str] = Counter()
    form = Form()
    silent = 0
    for record in records(path, count):
        _refuse_newer(path, record)
        form.check(record)
        kinds[str(record.content.get("kind"))] += 1
        before = record.content.get("before", ())
        silent += len(before) if isinstance(before, list) else 0
    decisions = silent + kinds["decision"]
    spoke = kinds["decision"]
    held = Contents(kinds["start"], kinds["begin"], decisions, spoke, kinds["settings"])
    return held, form


def _refuse_newer(path: Path, record: SealedRecord) -> None:
    version = record.content.get("version", LOG_VERSION)
    if isinstance(version, int) and version > LOG_VERSION:
        raise ValueError(
            f"{path}: its version {version} is newer than this library's {LOG_VERSION}; "
            "a newer evofsm reads it"
        )


def _replay(path: Path, count: int, failed: Callable[[NDArray[np.float64]], bool] | None) -> Replay:
    player = _Player(failed)
    difference = None
    for record in records(path, count):
        difference = player.play(record)
        if difference is not None:
            break
    others = tuple(Field(name, *both) for name, both in player.other_makers.items())
    return Replay(player.decisions, tuple(player.not_replayed), others, difference)


class _DiffersError(Exception):
    """Something came out otherwise: an explanation, and the fields."""

    def __init__(self, explanation: str, fields: Sequence[Field] = ()) -> None:
        super().__init__(explanation)
        self.fields = tuple(fields)


@dataclass
class _Player:
    """Those who took part, told again what happened."""

    failed: Callable[[NDArray[np.float64]], bool] | None = None
    decisions: int = 0
    not_replayed: list[str] = field(default_factory=list)
    other_makers: dict[str, tuple[str, str]] = field(default_factory=dict)
    _who: Participants | None = None
    _guard: Guard | None = None
    _is_known: bool = True
    _version: int = LOG_VERSION

    def play(self, record: SealedRecord) -> Difference | None:
        """What differs; None where it comes out as it was recorded."""
        try:
            self._play(record.content)
        except _DiffersError as differs:
            return Difference(record.number, str(differs), differs.fields)
        except _NONSENSE as error:
            return Difference(record.number, f"it cannot be replayed: {_said(error)}")
        return None

    def _play(self, content: Mapping[str, Any]) -> None:
        kind = content["kind"]
        if kind == "start":
            self._start(content)
        elif self._is_known:
            for row in content.get("before", ()):
                self._silent(row)
            match kind:
                case "begin":
                    self._begin(content)
                case "settings":
                    set_again(self._present().reviser, content["settings"])
                case "decision":
                    self._decision(content)
                case "end":
                    self._end(content)
                case "quiet":
                    pass
                case _:
                    raise ValueError(f"there is no kind {kind!r}")

    def _start(self, content: Mapping[str, Any]) -> None:
        self._version = content["version"]
        now = made_by()
        for name, then in content["made_by"].items():
            if then != now.get(name):
                self.other_makers[name] = str(then), now.get(name, "")
        self._guard = None
        try:
            self._who, self._is_known = restore(content), True
        except CannotBeReplayedError as reason:
            self._who, self._is_known = None, False
            self.not_replayed.append(str(reason))

    def _present(self) -> Participants:
        if self._who is None:
            raise ValueError("it comes before anyone takes part")
        return self._who

    def _begin(self, content: Mapping[str, Any]) -> None:
        actions, reviser, machine, risk = self._present()
        if content.get("failure_told", False) and self.failed is None:
            self._who, self._is_known = None, False
            self.not_replayed.append(_NO_FUNCTION)
            return
        self._guard = Guard.of(
            reviser,
            actions=actions,
            machine=machine,
            judge=risk,
            learn=content["learn"],
            failed=self.failed,
            missing=Missing(content["missing"]),
            interval=content["interval"],
            explaining=Explain.SPOKEN,
        )
        self._guard.begin()

    def _present_guard(self) -> Guard:
        if self._guard is None:
            raise ValueError("it belongs to no episode")
        return self._guard

    def _silent(self, row: Sequence[Any]) -> None:
        time, observation, *proposed = row
        if not proposed:
            self._recognise(time, observation)
            return
        proposal = _proposal(*proposed)
        situation, revision = self._decide(time, observation, proposal)
        if is_spoken(self._present().reviser, revision):
            is_told = told(situation, proposal, revision)
            raise _DiffersError(
                f"the decision at {situation.time:g} s was recorded as nothing to speak of, but "
                f"{revision.reason}",
                [Field("executed", canonical(is_told["proposed"]), canonical(is_told["executed"]))],
            )
        self.decisions += 1

    def _decision(self, content: Mapping[str, Any]) -> None:
        proposal = _proposal(content["proposed"], content["candidates"])
        situation, revision = self._decide(content["time"], content["observation"], proposal)
        again = told(situation, proposal, revision)
        recorded = {name: again[name] for name in again if SINCE.get(name, 1) <= self._version}
        fields = _differing(content, recorded)
        if fields:
            raise _DiffersError(f"the decision at {situation.time:g} s comes out otherwise", fields)
        if not is_spoken(self._present().reviser, revision):
            raise _DiffersError(f"the decision at {situation.time:g} s changed nothing")
        self.decisions += 1

    def _decide(
        self, time: Any, observation: Sequence[Any], proposal: Proposal
    ) -> tuple[Situation, Revision]:
        situation = self._recognise(time, observation)
        return situation, self._present_guard().revise(situation, proposal)

    def _recognise(self, time: Any, observation: Sequence[Any]) -> Situation:
        return self._present_guard().recognise(_observation(observation), number(time))

    def _end(self, content: Mapping[str, Any]) -> None:
        guard, observation = self._present_guard(), content["observation"]
        seen = None if observation is None else _observation(observation)
        guard.end(content["failed"], seen)
        self._guard = None
        recorded, again = content["learnt"], learnt(guard.machine, guard.judge)
        if unknown := sorted(recorded.keys() - again.keys()):
            raise _DiffersError(f"nothing is learnt that is called {unknown[0]!r}")
        fields = _differing(recorded, again)
        if fields:
            raise _DiffersError("something else was learnt until its end", fields)


def _observation(values: Sequence[Any]) -> NDArray[np.float64]:
    return np.array([number(value) for value in values])


def _proposal(action: Any, candidates: Sequence[Any] = ()) -> Proposal:
    return Proposal(_action(action), tuple(_action(candidate) for candidate in candidates))


def _action(action: Any) -> Action:
    return _observation(action) if isinstance(action, list) else number(action)


def _differing(recorded: Mapping[str, Any], replayed: Mapping[str, Any]) -> list[Field]:
    """What is not the same to the last bit."""
    both = (Field(name, canonical(recorded[name]), canonical(replayed[name])) for name in replayed)
    return [one for one in both if one.recorded != one.replayed]


def _said(error: Exception) -> str:
    return f"there is no {error}" if isinstance(error, KeyError) else str(error)

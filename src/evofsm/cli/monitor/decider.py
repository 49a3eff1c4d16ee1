"""A guard that is asked by messages: a message in, a message out, and no input or output.

The same messages bring the same answers, whatever carried them; rows that are refused leave the
guard as it was.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from evofsm.cli.monitor.schema import SCHEMA, End, Form, MessageError, Row, as_floats, is_late
from evofsm.guard import (
    RECORD,
    ActionReviser,
    BoxActions,
    Guard,
    Mode,
    Pair,
    Revision,
    SearchingJudge,
    is_spoken,
)

_log = logging.getLogger(__name__)

#: What an answer says of a decision, beside its time; `evofsm.guard.RECORD` describes each.
SAID = (
    *("proposed", "executed", "advised"),
    *("risk_proposed", "risk_executed", "risk_low", "risk_high", "evidence", "reason"),
)
#: Rows after which an episode ends, as soon as no alarm is on; at twice as many it ends anyway.
EPISODE = 6000
# What is older by less is late; what is older by more comes from a sender that began anew [s].
_LATE = 1.0
# A gap in time, and rows that come too often, in intervals.
_HOLE, _OFTEN = 1.5, 0.5

Told = Row | End
Answer = dict[str, Any]


class Keeper(Protocol):
    """Whoever keeps what a monitor is told, so that it can go on after its end."""

    def before(self, told: Told) -> None:
        """It was accepted, and is acted on next."""
        ...

    def after(self, decider: Decider) -> None:
        """It was acted on."""
        ...


class Decider:
    """Answers messages by a guard's decisions.

    Parameters
    ----------
    guard : Guard
        Between two episodes. Its mode says whether what it decides is executed.
    proposal : float, optional
        Taken where a row has none; without it such a row is refused.
    episode : int
        Rows after which an episode ends, as soon as no alarm is on: the guard learns, and can be
        kept, between two of them only. At twice as many it ends anyway.

    Examples
    --------
    >>> from evofsm.driving import guard_for_cars
    >>> from evofsm.guard import Mode
    >>> decider = Decider(guard_for_cars(low=-6.0, high=2.5, mode=Mode.SHADOW))
    >>> row = b'{"time": 0, "gap": 9, "v_follower": 20, "v_leader": 20, "proposal": 1}'
    >>> answer = decider.answer(row)
    >>> answer["kind"], answer["n"], answer["alarm"], answer["executed"], answer["advised"]
    ('decision', 1, True, 1.0, -6.0)
    >>> decider.answer(b"nonsense")["error"]
    'is no JSON: Expecting value: line 1 column 1 (char 0)'
    """

    def __init__(
        self, guard: Guard, *, proposal: float | None = None, episode: int = EPISODE
    ) -> None:
        if episode < 1:
            raise ValueError(f"episode is {episode}; it must have a row at least")
        self.guard = guard
        self.episode = episode
        self.form = Form.of(guard, proposal)
        self.keeper: Keeper | None = None
        self.n = 0  #: decisions so far
        self.refused = 0  #: messages that were refused, since the process began
        self.rows = 0  #: of the episode under way; 0 where none is
        self._latest: tuple[Row, Answer] | None = None
        self._told_often = self._has_failed = False

    @property
    def mode(self) -> Mode:
        """How far the guard goes."""
        reviser = self.guard.reviser
        return reviser.mode if isinstance(reviser, ActionReviser) else Mode.ACT

    # -- Messages -------------------------------------------------------------------------------

    def answer(self, line: bytes) -> Answer:
        """What is answered to a line: a decision, an end, or an error that names the key.

        A row that is sent again, as after a connection was lost, gets the answer of before.
        """
        try:
            told = self.form.read(line)
            if isinstance(told, Row) and self._latest is not None:
                row, answer = self._latest
                if told == row:
                    return answer
                _refuse_stale(told, row)
        except MessageError as refused:
            return self.error(refused)
        if self.keeper is not None:
            self.keeper.before(told)
        answer = self.act(told)
        if self.keeper is not None:
            self.keeper.after(self)
        return answer

    def error(self, refused: MessageError) -> Answer:
        """What is answered where a message is refused."""
        self.refused += 1
        when = {} if refused.time is None else {"time": refused.time}
        return self._of("error", **when, about=refused.about, error=str(refused))

    def heartbeat(self, silent: float) -> Answer:
        """What is said where nothing came for so long [s]."""
        time = None if self._latest is None else self._latest[0].time
        return self._of(
            "heartbeat", time=time, silent=silent, refused=self.refused, mode=self.mode.value
        )

    def _of(self, kind: str, **said: Any) -> Answer:
        return {"schema": SCHEMA, "kind": kind, "n": self.n, **said}

    # -- What it does ---------------------------------------------------------------------------

    def act(self, told: Told) -> Answer:
        """Take in what was accepted, and answer it."""
        if isinstance(told, End):
            return self._ended(told)
        answer = self._decided(told)
        self._latest = told, answer
        if self.rows >= self.episode and (not answer.get("alarm") or self.rows >= 2 * self.episode):
            self.end()
        return answer

    def end(self, failed: bool = False, observation: Any = None) -> None:
        """End the episode under way."""
        self.rows, self._told_often = 0, False
        try:
            self.guard.end(failed, observation)
        except OSError as error:  # only the audit log writes
            self._lose_audit(error)

    def _ended(self, told: End) -> Answer:
        seen = None if told.observation is None else as_floats(told.observation)
        if self.rows or told.failed:
            self.end(told.failed, seen)
        self._latest = None  # whatever time comes next is that of a new episode
        return self._of("end", failed=told.failed)

    def _decided(self, row: Row) -> Answer:
        notes = self._notes(row)
        note = {"note": "; ".join(notes)} if notes else {}
        self.n += 1
        if row.observation is None:
            return self._kept(row, note)
        try:
            revision = self._revision(row)
        except Exception as error:  # whatever a judge of somebody's own raises
            if not self._has_failed:  # once, as it may fail at each row
                _log.exception("the guard failed at %s s", row.time)
            self._has_failed = True
            self.rows += 1
            self.refused += 1
            what = f"failed: {type(error).__name__}: {error}"
            return self._of("error", time=row.time, about="guard", error=what)
        self.rows += 1
        said = Pair(None, revision)  # type: ignore[arg-type]  # nothing of a situation is said
        return self._of(
            "decision",
            time=row.time,
            **({} if row.ahead is None else {"ahead": row.ahead}),
            **self._worst(row),
            **{name: _plain(RECORD[name].read(said)) for name in SAID},
            alarm=self._is_alarm(revision),
            mode=self.mode.value,
            **note,
        )

    def _worst(self, row: Row) -> Answer:
        """Who of a scene the proposal is most dangerous with."""
        if not self.form.scenes:
            return {}
        pair = self.guard.reviser.risk.worst  # type: ignore[attr-defined]
        if pair is None:
            return {"object": None, "role": None}
        return {"object": row.objects[pair.number - 1], "role": pair.role.value}

    def _kept(self, row: Row, note: Answer) -> Answer:
        """Nothing is ahead: whatever is wanted is done."""
        wanted = _plain(row.proposal)
        unknown = dict.fromkeys(SAID[3:-1])
        return self._of(
            "decision",
            time=row.time,
            ahead=None,
            **dict.fromkeys(SAID[:3], wanted),
            **unknown,
            reason="nothing is ahead in the lane",
            alarm=False,
            mode=self.mode.value,
            **note,
        )

    def _notes(self, row: Row) -> list[str]:
        """What is odd about when a row comes, and what it follows; may end the episode."""
        if self._latest is None or not self.rows:
            return []
        latest, interval = self._latest[0], self.guard.interval
        step = row.time - latest.time
        if step < 0.0:
            self.end()
            return [f"time went back from {latest.time:g} s: a new episode"]
        if row.ahead != latest.ahead:
            self.end()
            return ["another one is ahead: a new episode"] if row.observation else []
        if interval is None:
            return []
        if step > _HOLE * interval:
            return [f"{step:.3g} s without a row: nothing is learnt or carried across"]
        if step < _OFTEN * interval and not self._told_often:
            self._told_often = True
            return [f"rows come every {step:.3g} s, but the guard was made for {interval:g} s"]
        return []

    def _revision(self, row: Row) -> Revision:
        assert row.observation is not None
        proposal: Any = row.proposal
        if isinstance(self.guard.actions, BoxActions) and proposal is not None:
            proposal = np.array(proposal)
        try:
            return self.guard.decide(as_floats(row.observation), proposal, row.time)
        except OSError as error:
            if self.guard.audit is None:
                raise
            self._lose_audit(error)
            return self.guard.decide(as_floats(row.observation), proposal, row.time)

    def _lose_audit(self, error: OSError) -> None:
        """Somebody has to go on; the log says itself with which record it ends."""
        _log.error("without an audit log from here on: %s", error)
        self.guard.audit = None

    def _is_alarm(self, revision: Revision) -> bool:
        """Whether the proposal is too risky, or, where that alone does not decide, is not kept."""
        reviser = self.guard.reviser
        if isinstance(reviser, ActionReviser) and not isinstance(reviser.risk, SearchingJudge):
            return revision.risk_proposed > reviser.tolerance
        return is_spoken(reviser, revision)

    # -- Its end, and its beginning -------------------------------------------------------------

    def memory(self) -> dict[str, Any]:
        """What it knows between two episodes, beside the guard: for JSON."""
        return {"n": self.n, "latest": None if self._latest is None else list(self._latest)}

    def remember(self, memory: Mapping[str, Any]) -> None:
        """Go on from what `memory` returned."""
        self.n = int(memory["n"])
        latest = memory["latest"]
        self._latest = None if latest is None else (Row.kept(latest[0]), dict(latest[1]))


def _refuse_stale(row: Row, latest: Row) -> None:
    """Raise if it is no newer than the latest one, unless its sender began anew."""
    if row.time == latest.time:
        raise MessageError(
            "time", f"{row.time:g} s was decided on before, with other values", row.time
        )
    if is_late(row, latest, _LATE):
        raise MessageError(
            "time",
            f"{row.time:g} s comes after {latest.time:g} s: late rows are left out",
            row.time,
        )


def _plain(value: Any) -> Any:
    """As JSON has it: None for what is no finite number."""
    if isinstance(value, np.ndarray | np.generic | tuple):
        return [_plain(one) for one in value] if np.ndim(value) else _plain(value.item())  # type: ignore[union-attr]
    return None if isinstance(value, float) and not math.isfinite(value) else value

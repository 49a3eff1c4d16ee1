"""A guard that is asked by messages: the same ones bring the same answers, whoever carries."""

from __future__ import annotations

import logging
import math
import re
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from itertools import islice
from typing import Any, TypeVar

import msgspec
import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from evofsm.cli.foreseen import guard_of_alarms
from evofsm.cli.models import failure
from evofsm.cli.monitor import messages
from evofsm.cli.monitor.messages import End, Form, Message, MessageError, Pause, Row, Taken
from evofsm.cli.monitor.slots import CsvRows, Slots
from evofsm.cli.options import TOLERANCE, Alarms, ModeName, reading_of, refuse_other_limit
from evofsm.cli.show import plain
from evofsm.driving import Object, Scene
from evofsm.driving.judge import SLIGHT, LatentRisk
from evofsm.driving.naming import VARIABLES
from evofsm.driving.traffic import COLUMNS, RATES, TrafficRisk, lies_across
from evofsm.fsm import EvolvingFSM
from evofsm.fsm.validation import probability
from evofsm.guard import ActionReviser, BoxActions, Choices, Foresight, Guard, LearntRisk, Mode
from evofsm.guard.actions import limits
from evofsm.guard.api import Proposal, Revision
from evofsm.guard.audit_log import AuditLog
from evofsm.guard.foresight import DATES, span
from evofsm.guard.reviser import is_spoken, make_usable, passed
from evofsm.io.logs import STAND_INS, are_stand_ins, hours_unsaid
from evofsm.io.tables import IN_UTC, date

_log = logging.getLogger(__name__)

EPISODE = 6000  #: rows until an episode ends; with an alarm on, at most twice as many
_RECENT = 256  # so many of the latest messages are known again when they are sent again
_FAST = 60.0  # nothing on a road is faster [m/s]
_LATE = 1.0  # what is older by less is late, by more from a sender that began anew [s]
HOLE, _OFTEN = 1.5, 0.5  #: a gap in time, and rows that come too often, in intervals
_AX, _VX, _VY, _Y = map(COLUMNS.index, ("ax", "vx", "vy", "y"))
_SIDES = [COLUMNS.index(name) for name in ("length", "width")]
# A rate, of what it is, which less is noise, and more a leap, and over how long it is told [s]: a
# speed across from scene to scene would be noise.
_LATELY = 0.5
_CHANGES = (_AX, _VX, 0.0, RATES[1], 0.0), (_VY, _Y, 0.5, 20.0, _LATELY)
_NOBODY = "gap and v_leader are null: nobody is taken to be ahead"
_RISKS = ("risk_proposed", "risk_executed", "risk_low", "risk_high", "evidence")

Answer = dict[str, Any]
_T = TypeVar("_T")


class Decider:
    """Answers messages by a guard's decisions."""

    def __init__(self, guard: Guard, *, episode: int = EPISODE, slots: Slots | None = None) -> None:
        self.guard = guard
        self.episode = episode
        self.slots = slots or Slots()
        self.form = Form(guard, self.slots.keys, *self.slots.clock)
        self.form.spares = self.slots.spares
        self.keep: Callable[[Taken | None], None] = lambda taken: None
        self.n = 0  #: decisions so far
        self.rows = 0  #: decisions of the episode under way; 0 where none is
        self.decided_on: Row | None = None  #: latest
        self._alarm = False
        self._recent: deque[tuple[Message, Answer]] = deque(maxlen=_RECENT)
        self._next: int | None = None  # of the recent ones, where they are being sent again
        self._lost: AuditLog | None = None  # as it could not be written
        self._unlogged: OSError | None = None  # why decisions are missing in it
        self._said: set[str] = set()  # what is said once, some of it in each episode
        self._across: dict[str, None] = {}  # who moved across the lane when it moved last
        reviser = guard.reviser
        judge = reviser.risk if isinstance(reviser, ActionReviser) else None
        self._mode = reviser.mode if isinstance(reviser, ActionReviser) else Mode.ACT
        self._units = () if judge is None else judge.labels.units
        self._drives = isinstance(judge, LatentRisk | TrafficRisk)
        self._is_alone = isinstance(judge, Foresight)  # nobody acts
        self.csv = CsvRows(self.slots, self.form.variables, acts=not self._is_alone)
        if isinstance(judge, Foresight):
            judge.bridges = self.slots.hole or 0.0

    def warm(self) -> None:
        """Compile what decides, by a few decisions of a copy, which then is thrown away."""
        twin, most = self.guard.copy(), limits(self.guard.actions)[1]
        observation = np.resize([1.0, 20.0, 0.0], self.form.count or 1)  # a car is refused there
        if self.form.scenes:
            ego, car = Object("", 0.0, 0.0, 20.0), Object("", 30.0, 0.0, 10.0)
            observation = Scene(ego, [car, car._replace(x=-20.0)]).rows(2)
        for k in range(4):
            twin.decide(observation + 0.1 * k * (not self.form.scenes), most)
        twin.end(observation=observation)

    def answer(self, line: bytes, csv: CsvRows | None = None, *, is_cut: bool = False) -> Answer:
        """What is answered to a line: a decision, an end, or an error that names the key.

        Messages that are sent again, as after a connection was lost, get the answers of before. One
        of ``csv`` (what its stream named) that may be cut off, as it has no line end, is refused.
        """
        csv = csv or self.csv
        try:
            if (body := csv.read(line, is_cut=is_cut)) is None:
                return self._of("waiting", alarm=self._alarm, reason=messages.NO_ROW)
            message = self._running(self.form.read(body))
            self._next = self._sent_before(message)
            if self._next is not None:
                return self._recent[self._next][1]
            if isinstance(message, Row):
                self._refuse(message)
        except MessageError as error:
            place = csv.place if csv.in_csv or error.about == "line" else ""
            return self.error(error.about, f"{place}{error}", error.time)
        try:
            return self._accept(message)
        except Exception as error:  # an end that the guard cannot take
            return self.error("end", f"was refused: {type(error).__name__}: {error}")

    def lapse(self) -> Answer | None:
        """Decide on what waits, as nothing came for long; None where nothing waits."""
        return self._accept(Pause()) if self.slots.waiting else None

    def _accept(self, told: Taken) -> Answer:
        """Keep it, and act on it."""
        self.keep(told)  # before it: an audit log knows nothing that is not kept
        try:
            return self.act(told)
        finally:
            self.keep(None)

    def _running(self, told: Message) -> Message:
        """A message by a clock that runs on as in logs, where summer time ends or begins."""
        rows = [m for m, _ in self._recent if isinstance(m, Row) and m.hours is not None]
        if told.hours is None or told.time is None or not rows:
            return told
        times, hours = [row.clock for row in rows], [row.hours or 0.0 for row in rows]
        *_, before, unsaid = hours_unsaid(np.array([*times, time := told.time]), "")
        ways = [*dict.fromkeys(reversed(hours)), hours[-1] + float(unsaid - before)]
        messages = [structs.replace(told, time=time + 3600.0 * h, hours=h) for h in ways]
        place = len(self._recent) if self._next is None else self._next + 1
        successor = [m for m, _ in islice(self._recent, place, place + 1)]  # of one sent again
        step = time + 3600.0 * ways[-1] - rows[-1].time
        older = [] if 0.0 < step <= 1800.0 else rows  # where a gap is likelier
        copies = (m for rows_then in (successor, older) for m in messages if m in rows_then)
        return next(copies, messages[-1])  # sent again, as it was

    def _sent_before(self, told: Message) -> int | None:
        """Where among the recent messages one is that is sent again; None if it is a new one.

        Where a clock begins at 0 in each episode, rows of two may be alike: what came before a row
        that is as old as this one had another clock, and is no longer asked.
        """
        recent, when = self._recent, told.time
        next_place = len(recent) if self._next is None else self._next + 1
        if next_place < len(recent) and recent[next_place][0] == told:
            return next_place
        if when is None:  # it says of no episode in particular that it ended
            return len(recent) - 1 if told == self.latest else None
        for place, (message, _) in reversed([*enumerate(recent)]):
            if message == told:
                return None if isinstance(told, Row) and self._begins_anew(told, place) else place
            is_older = message.time is not None and message.time < when
            if is_older or (message.time == when and isinstance(message, Row)):
                return None
        return None

    def _begins_anew(self, told: Row, place: int) -> bool:
        """Whether a row is no repetition, as an episode began with it, and another begins.

        That is so after an end, and where time goes back to it as it did before: who plays a
        recording once more begins with its first row.
        """
        before = [message for message, _ in islice(self._recent, place)]
        times = [message.time for message in before if message.time is not None]
        is_back = not times or told.time <= times[-1]
        if isinstance(self.latest, Row):
            return is_back and told.time < self.latest.time - _LATE
        return is_back or isinstance(before[-1], End)

    def _refuse(self, row: Row) -> None:
        """Raise where a row is no newer than what was accepted before, or cannot be compared."""
        self.slots.refuse(row)
        latest = self.latest
        if self.slots.change(row, latest):
            return
        if isinstance(latest, Row) and (row.hours is None) != (latest.hours is None):
            text = f"is {'no ' * (row.hours is None)}local time, unlike that of the row before"
            text += "; all have a zone, or none (an end between begins anew)"
            raise MessageError("time", text, row.clock)
        if isinstance(latest, Row) and latest.time - _LATE <= row.time <= latest.time:
            text = f"comes after {date(latest.clock, ' s')}: late rows are left out"
            text = text if row.time < latest.time else "was decided on before, with other values"
            raise MessageError("time", f"{date(row.clock, ' s')} {text}", row.clock)
        if self.slots.is_over(row):
            text = f"comes after its {self.slots.step:g} s were decided on, as nothing came"
            raise MessageError("time", text, row.clock)

    def error(self, about: str, what: str, time: float | None = None) -> Answer:
        """What is answered where a message is refused."""
        return self._of("error", time=time, about=about, error=what)

    def _of(self, kind: str, row: Row | None = None, **said: Any) -> Answer:
        when = {} if row is None else {"time": row.clock}
        when |= {"hours": row.hours} if row and row.hours else {}
        return {"schema": messages.SCHEMA, "kind": kind, "n": self.n, **when, **said}

    def act(self, told: Taken) -> Answer:
        """Take in what was accepted, and answer it."""
        if isinstance(told, Pause):
            return dict(self._waited(early=True).get("last", {}))
        last, remark = Answer(), ""
        if why := self._ends_before(told):
            last, remark = self._waited(), f"{why}: a new episode"
            self._end_unasked()
        elif not (self.rows or self.slots.waiting):  # once
            remark = self.slots.lacking(told)
        answer = last | (self._ended(told) if isinstance(told, End) else self._taken(told))
        if note := "; ".join(filter(None, [remark, answer.get("note")])):
            answer["note"] = note
        self._recent.append((told, answer))
        if self.rows >= self.episode and (not answer.get("alarm") or self.rows >= 2 * self.episode):
            self._end_unasked()
        return answer

    def end(self, failed: bool = False, observation: Any = None) -> None:
        """End the episode under way."""
        self._without_lost_audit(lambda: self.guard.end(failed, observation))
        self.rows, self._alarm = 0, False
        self._said -= {"often", "fast"}
        if (log := self._lost) is not None:
            with suppress(OSError, ValueError):  # tried again as the next one ends
                log.go_on()
                self.guard.audit, self._lost = log, None

    def close(self) -> None:
        """Close the audit log; an OSError where decisions are missing in it."""
        if isinstance(log := self._lost or self.guard.audit, AuditLog):
            log.close()
        if self._unlogged is not None:
            raise self._unlogged

    def _end_unasked(self) -> None:
        """The same where nobody waits for an answer to it; what somebody's judge raises is said."""
        try:
            if self.rows:
                self.end()
        except Exception:
            _log.exception("an episode could not be ended")
            self.rows = 0

    @property
    def latest(self) -> Message | None:
        """What was accepted latest."""
        return self._recent[-1][0] if self._recent else None

    def _before(self, told: Message) -> Message | None:
        """What came latest; of several that take turns, what came of its own."""
        messages = (message for message, _ in reversed(self._recent))
        return next((m for m in messages if not self.slots.change(told, m)), None)

    def _ends_before(self, told: Message) -> str:
        """What tells that the episode under way was over before a row came; or nothing."""
        latest = self.latest
        if not (isinstance(told, Row) and isinstance(latest, Row)):
            return ""
        if change := self.slots.change(told, latest):
            if isinstance(self._before(told), Row) and self._is_first("turns"):
                _log.warning("%s; rows of several in turn need a monitor for each", change)
            return change
        step, hole = told.time - latest.time, self.slots.hole
        if not (self.rows or self.slots.waiting) or self._left_out(told):
            return ""
        if step < 0.0:
            return f"time went back from {date(latest.clock, ' s')}"
        if told.observation and told.ahead != latest.ahead:
            return "another one is ahead"
        if hole is not None and step > max(hole, HOLE * self.guard.interval):
            return f"{span(step)} without a row (--hole {hole:g}s)"
        return ""

    def _waited(self, *, early: bool = False) -> Answer:
        """What is decided on rows that waited, if there are some, as the entry of an answer."""
        row = self.slots.take(early=early)
        return {} if row is None else {"last": self._decided(row)}

    def _ended(self, told: End) -> Answer:
        last = self._waited()
        if self.rows or (told.failed and not isinstance(self.latest, End)):
            self.end(told.failed, _numbers(told.observation))
        return self._of("end", failed=told.failed, **last)

    def _taken(self, row: Row) -> Answer:
        """What a row brings, as it would in a log."""
        slots, why, fails = self.slots, self._left_out(row), self.slots.fails(row)
        if not (why or fails):
            whole = slots.add(row) if slots.step else row
            if whole is not None:
                return self._decided(whole)
            return self._of("waiting", row, alarm=self._alarm)
        is_new = fails and not slots.fails(self._before(row))
        if is_new:
            slots.leave_out(row)
        is_last = is_new and not why  # of an episode, which has rows or not
        last, is_end = self._waited(), bool(self.rows) or is_last
        if is_end:
            self.end(is_new, _numbers(row.observation) if is_last else None)
        why = f"--failed {slots.columns.failed}" if fails else why
        action = {"reason": why} if self._is_alone else self._unjudged(row, why)
        verdict = {"failed": is_new} if is_end else {"alarm": False}
        return self._of("end" if is_end else "waiting", row, **verdict, **action, **last)

    def _left_out(self, row: Row) -> str:
        """Why a row does not count: nobody is ahead, --no-leader or --where says so; or nothing."""
        columns, latest = self.slots.columns, self.latest
        unseen = [place for place, value in enumerate(row.observation or ()) if value is None]
        is_blind = self.form.variables == VARIABLES and unseen == [0, 2]
        if (is_blind and columns.no_leader == "end") or self.slots.holds("--no-leader", row):
            return f"--no-leader {columns.no_leader}"
        if is_blind:  # from the first row of a drive on
            is_first = not isinstance(latest, Row) or row.time < latest.time
            if is_first or _NOBODY in self._recent[-1][1].get("reason", ""):
                return _NOBODY
        return f"not --where {columns.where}" * (self.slots.holds("--where", row) is False)

    def _decided(self, row: Row) -> Answer:
        if row.observation is None:  # whoever was followed is gone
            self._end_unasked()
        notes, self.decided_on = [*self._notes(row)], row
        note = {"note": "; ".join(notes)} if notes else {}
        self.n += 1
        if row.observation is None:  # nothing is ahead: whatever is wanted is done
            body = {"ahead": None, **self._unjudged(row, "nothing is ahead in the lane")}
            body |= {**dict.fromkeys(_RISKS), "proposed": plain(row.proposal)}
            body["advised"] = body["executed"]
        else:
            try:
                revision = self._revision(row)
            except Exception as error:  # whatever a judge of somebody's own raises
                if self._is_first("failed"):  # as it may fail at each row
                    _log.exception("the guard failed at %s s", row.time)
                return self.error("guard", f"failed: {type(error).__name__}: {error}", row.clock)
            self.rows += 1
            self._alarm = self._is_alarm(revision)
            body = self._revised(row, revision)
        remark = body["reason"].partition(";")[0]
        if self._mode is Mode.ACT and remark[:8] == "proposal" and "is outside [" in remark:
            proposal: Any = row.proposal
            if self._is_first(f"below: {np.any(np.less(proposal, self.guard.actions.low))}"):
                text = "%s at %s s, and was put at its edge, as all such are in --mode act"
                _log.warning(f"{text} (--brakes, --low, --high)", remark, row.time)
        on = {"alarm": self._alarm, "mode": self._mode.value}
        return self._of("decision", row, **body, **on, **note)

    def _revised(self, row: Row, revision: Revision) -> Answer:
        """What was decided on a row, and in a scene whom about."""
        low, high = revision.interval
        parts = {**revision._asdict(), "risk_low": low, "risk_high": high}
        body = {name: plain(parts[name]) for name in ("proposed", "executed", "advised", *_RISKS)}
        names = ("", *row.objects)
        reason = re.sub(r"(?<=\bobject )\d+", lambda k: names[int(k[0])], revision.reason)
        ahead = {} if row.ahead is None else {"ahead": row.ahead}
        if self.form.scenes:
            worst = self.guard.reviser.risk.worst  # type: ignore[attr-defined]
            ahead |= {"object": worst and names[worst.number], "role": worst and worst.role.value}
        return {**ahead, **body, "reason": reason}

    def _unjudged(self, row: Row, why: str) -> Answer:
        """What is executed where nothing is judged, made usable as before a decision, and why."""
        proposal: Any = math.nan if row.proposal is None else row.proposal
        usable = make_usable(Proposal(proposal), self.guard.actions, self.guard.fallback)
        action, remark = passed(Proposal(proposal), usable, self.guard.reviser)
        executed = int(action) if isinstance(self.guard.actions, Choices) else plain(action)
        return {"executed": executed, "reason": "; ".join(filter(None, (remark, why)))}

    def _notes(self, row: Row) -> Iterator[str]:
        """What is odd about when a row comes, and its speeds; in an episode all but gaps once."""
        interval, before = self.guard.interval, self.decided_on
        step = row.time - before.time if before and self.rows else interval
        if step > HOLE * interval:
            yield f"{span(step)} without a row: nothing is learnt or carried across"
        if step < _OFTEN * interval and self._is_first("often"):
            text = f"the guard was made for {interval:g} s: --resample {interval:g}s"
            yield f"rows come every {span(step)}, but {text}"
        if row.hours is None and row.time >= DATES and self._is_first(IN_UTC):
            yield IN_UTC
        variables = zip(self.form.variables, self._units, row.observation or (), strict=False)
        fast = [name for name, unit, z in variables if unit == "m/s" and abs(z or 0.0) > _FAST]
        if fast and self._is_first("fast"):
            yield f"{fast[0]} is above {_FAST:g} m/s: is that km/h?"
        pairs = enumerate(zip(self.form.variables, row.observation or (), strict=False))
        odd = [(k, name, z) for k, (name, z) in pairs if z and abs(z) in STAND_INS]
        centers = machine.centers if odd and (machine := self.guard.machine) else np.empty((0, 0))
        for k, name, z in odd:
            far = are_stand_ins(np.append(centers[:, k : k + 1], z))[-1]
            if far and self._is_first(f"{name} is {z:g}"):
                yield f"{name} is {z:g}, far from all others: a missing value? That is null"

    def _is_first(self, remark: str) -> bool:
        """Whether it was not said yet; from now on it was."""
        is_new = remark not in self._said
        self._said.add(remark)
        return is_new

    def _revision(self, row: Row) -> Revision:
        proposal: Any = 0 if self._is_alone else row.proposal
        if isinstance(self.guard.actions, BoxActions) and proposal is not None:
            proposal = np.array(proposal)
        observation: Any = _numbers(row.observation)
        if self.form.scenes:
            observation = _moving(row, (message for message, _ in reversed(self._recent)))
            self._turn(row, observation.reshape(-1, len(COLUMNS)))
        return self._without_lost_audit(lambda: self.guard.decide(observation, proposal, row.time))

    def _turn(self, row: Row, table: NDArray[np.float64]) -> None:
        """Who came across the lane and stands there may lie either way: a leap looks alike."""
        if not (isinstance(self.latest, Row) and self.latest.time < row.time):
            self._across.clear()
        for name, values in zip(row.objects, table[1:], strict=False):
            across = lies_across(values[_VX], values[_VY])
            if across is None and name in self._across:
                values[_SIDES], across = values[_SIDES].max(), True
            self._across.pop(name, None)
            if across:
                self._across[name] = None  # the latest last
        for name in [*self._across][:-_RECENT]:
            del self._across[name]

    def _without_lost_audit(self, call: Callable[[], _T]) -> _T:
        """Somebody has to go on; the log says itself with which record it ends."""
        try:
            return call()
        except OSError as error:
            if not isinstance(log := self.guard.audit, AuditLog):
                raise
            _log.error("without an audit log until an episode ends: %s", error)
            self.guard.audit, self._lost, self._unlogged = None, log, error
            return call()

    def _is_alarm(self, revision: Revision) -> bool:
        """Whether the proposal is not kept, or too risky; refused, or as it was, if not known.

        Cars brake in proportion: an alarm begins where a proposal is not kept, but for a little,
        and lasts until its risk is tolerable.
        """
        reviser: Any = self.guard.reviser
        if not self._drives:
            stays = getattr(reviser, "refuses", False) or (self.rows > 1 and self._alarm)
            return is_spoken(reviser, revision) or (math.isnan(revision.risk_proposed) and stays)
        if self.rows > 1 and self._alarm:
            return not (revision.risk_proposed <= reviser.tolerance and not reviser.refuses)
        wish = make_usable(Proposal(revision.proposed), reviser.actions, reviser.fallback).action
        change = abs(float(revision.advised) - float(wish))
        return bool(reviser.refuses and not 0.0 < change <= SLIGHT)

    def memory(self) -> dict[str, Any]:
        """What it knows between two episodes, beside the guard: for JSON."""
        queues = {"recent": list(self._recent), "waiting": self.slots.waiting}
        return {"n": self.n, **msgspec.to_builtins(queues)}

    def remember(self, memory: Mapping[str, Any]) -> None:
        """Go on from what `memory` returned."""
        self.n = int(memory["n"])
        self.slots.waiting = msgspec.convert(memory["waiting"], list[Row])
        for message, answer in memory["recent"]:
            self._recent.append((msgspec.convert(message, Message), dict(answer)))


def _moving(row: Row, recent: Iterator[Message]) -> NDArray[np.float64]:
    """A scene with the rates that were not sent: since scenes before, latest first, else 0."""
    tracks = defaultdict[str, list[tuple[float, NDArray[np.float64]]]](list)
    for scene in recent:
        if not isinstance(scene, Row) or scene.time >= row.time or scene.observation is None:
            break
        for name, values in zip(("", *scene.objects), _table(scene), strict=False):
            tracks[name].append((row.time - scene.time, values))
        if row.time - scene.time >= _LATELY:
            break
    table = _table(row)
    for name, values in zip(("", *row.objects), table, strict=False):
        for rate, number, least, most, lasts in _CHANGES:
            if math.isnan(values[rate]):
                step, then = tracks[name][-1 if lasts else 0] if tracks[name] else (1.0, values)
                change = (values[number] - then[number]) / max(step, lasts)
                values[rate] = change if least <= abs(change) <= most else 0.0
    return table.ravel()


def _table(row: Row) -> NDArray[np.float64]:
    """Numbers of oneself and of the objects of a scene, a row each."""
    return np.array(_numbers(row.observation)).reshape(-1, len(COLUMNS))


def _numbers(observation: tuple[float | None, ...] | None) -> list[float] | None:
    """With NaN where a variable was not seen."""
    return None if observation is None else [math.nan if z is None else z for z in observation]


# -- Its guard ------------------------------------------------------------------------------------


def begun(
    told: Mapping[str, Any],
    reading: Mapping[str, Any],
    interval: float | None,
    tolerance: float | None,
    alarms: Alarms,
) -> Guard:
    """A guard that knows nothing yet, from what was told of a system."""
    if "observe" not in told:
        raise ValueError("say what is observed, the keys of rows: --observe temperature,load")
    columns = reading_of(**{**reading, "observe": told["observe"], "dt": None})
    acts = {name: part for name, part in told.items() if name != "observe"}
    names, scheme = columns.observe.names, columns.resample
    if (step := scheme.step if scheme else interval) is None:
        raise ValueError("say how often rows come [s]: --interval 1; or --resample 10s of jittered")
    if not columns.acts and acts:
        raise ValueError("--action '' says that nobody acts, and goes with no range of actions")
    if not columns.acts:
        judge = Foresight.from_zero(dt=step, names=names, horizon=alarms[0], hold=alarms[1])
        return guard_of_alarms(judge, alarms, EvolvingFSM(1, max_states=200), learn=True)
    if not acts:
        raise ValueError("say who acts: --low and --high, --n-actions; or --action '', if nobody")
    for name in {"low", "high"} & {*acts}:
        try:
            ends = [float(end) for end in acts[name].split(",")]
        except ValueError:
            raise ValueError(f"--{name} is {acts[name]!r}; write a number, or -1,-1") from None
        acts[name] = ends if len(ends) > 1 else ends[0]
    return Guard(
        **acts,
        interval=step,
        judge=LearntRisk(step, horizon=alarms[0], names=names, **acts),
        failed=failure(columns.failed, names),
        tolerance=TOLERANCE if tolerance is None else tolerance,
        mode=Mode.SHADOW,
    )


def prepare(guard: Guard, mode: ModeName, tolerance: float | None, alarms: Alarms) -> None:
    """Set how far it goes, and what it accepts."""
    refuse_other_limit(not isinstance(guard.judge, Foresight), alarms, tolerance)
    if isinstance(guard.judge, Foresight) and alarms[-1] is not None:
        guard.judge.stated = alarms[-1]
    if isinstance(guard.reviser, ActionReviser):
        guard.reviser.mode = Mode(mode)
        if tolerance is not None:
            guard.reviser.tolerance = probability("--tolerance", tolerance)
    elif mode != "act":
        name = type(guard.reviser).__name__
        raise ValueError(f"a {name} knows no --mode {mode}: what it says is executed")

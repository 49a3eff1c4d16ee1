"""What a monitor says of all that was recorded: alarms, how risky it was, and what was worst."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import RenderableType

from evofsm.cli.learning import refusing
from evofsm.cli.monitor.decider import HOLE, Answer, Decider
from evofsm.cli.monitor.messages import End, Row
from evofsm.cli.show import facts, table
from evofsm.fsm.naming import visible
from evofsm.fsm.validation import counted
from evofsm.guard.audit_log import lines
from evofsm.guard.foresight import span
from evofsm.io.logs import Chunk
from evofsm.io.tables import date

_LONGEST_MESSAGE = 1 << 20  # a line of more bytes is of another kind of file
_TOLERANCES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)  # beside the guard's own tolerance
# So many moments and variables are shown; without an alarm a moment lasts so long [s].
_WORST, _MOST_VARIABLES, _MOMENT = 10, 4, 5.0


class Text:
    """Answers in words: when an alarm begins, ends or goes blind, failures, and refusals."""

    def __init__(self) -> None:
        self._since: float | None = None  # when the alarm began that is on [s]
        self._lacks = False, ""  # is the risk unknown, and what an alarm lost, until all is seen
        self.standing = ""  #: the alarm that is on, or why the risk is not known; mostly nothing
        self._counts: dict[str, int] = {}  # of notes and refusals alike

    def line(self, answer: Answer) -> bytes:
        """What there is to say of one; mostly nothing."""
        parts = [part for part in (answer.get("last"), answer) if part]
        return "".join(f"{visible(text)}\n" for part in parts for text in self._said(part)).encode()

    def _said(self, part: Answer) -> Iterator[str]:
        kind, time, since, note = part["kind"], part.get("time"), self._since, part.get("note", "")
        when = "" if time is None else f"{date(time)}  "
        time = math.nan if time is None else time + 3600.0 * part.get("hours", 0.0)  # runs on
        if since is not None and ": a new episode" in note:  # after a hole, perhaps
            yield f"{when}over: {note}"
            since, self._since, note, self.standing = None, None, "", ""
        lasts = math.nan if since is None else time - since
        after = f" {span(lasts)}" if lasts >= 0.0 else ""
        over = f"over, after{after}" if after else "over"
        if note or kind == "error":
            text = f"note: {note}" if note else f"refused: {_refusal(part)}"
            letters = "".join(filter(str.isalpha, text))
            count = self._counts[letters] = self._counts.get(letters, 0) + 1
            if str(count).strip("0") == "1":  # the 1st, 10th, 100th ...
                yield f"{when}{text}{f' ({count:,} times by now)' * (count > 1)}"
        if kind == "end":
            self._since, self.standing = None, ""
            if part["failed"]:
                text = " no alarm was on" if since is None else f"{after} after the alarm"
                yield f"{when}failure,{text}"
            elif since is not None:
                yield f"{when}{over} ({part.get('reason', 'the episode ended')})"
        elif kind == "decision":
            reason, is_new = part["reason"], part["alarm"] and since is None
            if part["alarm"] == (since is None):
                self._since = time if is_new else None
                yield when + (f"alarm: {reason}" if is_new else over)
            is_blind = part["risk_proposed"] is None and part.get("ahead", "") is not None
            gaps = reason.partition("not seen: ")[2].partition("; ")[0]
            gaps = gaps if part["alarm"] else self._lacks[1] * bool(gaps)
            before, self._lacks = self._lacks, (is_blind, gaps)
            if before != self._lacks and not (is_new and any(self._lacks)):
                text = reason if any(self._lacks) else "all is seen again"
                if before[0] and not is_blind:
                    text = "the risk is known again" + f": {reason}" * bool(gaps)
                yield f"{when}{text}"
            alarm = f"alarm{after and f', for{after}'}: " * part["alarm"]
            self.standing = f"{when}{alarm}{reason}" if alarm or any(self._lacks) else ""


def _refusal(answer: Answer) -> str:
    return f"{answer['about']}: {answer['error']}".replace("line: line ", "line ", 1)


Answers = Iterable[tuple[Answer, Row | None]]


def decided_on_log(decider: Decider, episodes: Iterable[Chunk]) -> Answers:
    """The answers to the rows of a log; with the last row of an episode it ends."""
    for episode in episodes:
        values = episode.observations.astype(object)
        values[np.isnan(episode.observations)] = None
        *rows, last = map(tuple, values.tolist())
        for here, action, time in zip(rows, episode.actions.tolist(), episode.times, strict=False):
            row = Row(float(time), here, None if math.isnan(action) else action)
            yield decider.act(row), row
        yield decider.act(End(episode.failed, last)), None


def decided_on_lines(decider: Decider, file: Path) -> Answers:
    """The answers to messages; of those that are refused, the error."""
    for line in lines(file, _LONGEST_MESSAGE):
        message, before = line.rstrip(b"\r\n"), decider.n
        answer = decider.answer(message, is_cut=not line.endswith(b"\n"))
        row = decider.decided_on if decider.n > before else None  # sent again, it counts once
        if "last" in answer:
            yield answer["last"], row
        yield answer, row
    if (last := decider.lapse()) is not None:
        yield last, decider.decided_on


def summary_of(decider: Decider, answers: Answers, title: str) -> Iterator[RenderableType]:
    """Tables of what was decided; a ValueError if nothing was."""
    rows: list[Row] = []
    numbers, errors, failed, is_new = [], [], [], True
    for answer, row in answers:
        if answer["kind"] == "decision" and row is not None:
            rows.append(row)
            begins = decider.rows == 1 or len(rows) == 1
            numbers.append((row.time, answer["risk_proposed"], answer["alarm"], begins))
            is_new = False
        elif answer["kind"] == "end":
            failed += [-1 if is_new else len(rows) - 1] * answer["failed"]
            is_new = True
        elif answer["kind"] == "error":
            errors.append(_refusal(answer))
    if not rows:
        raise ValueError(f"{title}: nothing was decided ({'; '.join(errors[:1]) or 'no rows'})")
    times, risks, alarms, begins = np.array(numbers, np.float64).T
    steps, interval = np.diff(times, prepend=math.nan), decider.guard.interval
    follows = (begins == 0.0) & (steps > 0.0) & (steps <= HOLE * interval)
    durations = np.where(follows, steps, interval)

    def tally(above: NDArray[np.bool_], seconds: float) -> tuple[str, str, str]:
        count = (above & ~(np.roll(above, 1) & (begins == 0.0))).sum()
        hourly = count * 3600.0 / seconds
        return f"{count:,}", f"{hourly:,.1f}", f"{above @ durations / seconds:.2%}"

    seconds, is_known = durations.sum(), ~np.isnan(risks)
    count, hourly, share = tally(alarms > 0.0, seconds)
    usual = np.sort(steps)[(len(steps) - 1) // 2]
    text = f"{len(rows):,} in {counted(int(begins.sum()), 'episode')}, {seconds / 3600.0:.3g} h"
    if usual > HOLE * interval:
        text += f"; they come every {span(usual)}, and count as {interval:g} s each (--interval)"
    pairs = [("decisions", text), ("alarms", f"{count}, or {hourly} an hour, {share} of the time")]
    if useless := refusing(alarms @ durations / seconds):
        pairs.append(("beware", f"it {useless}"))
    if not is_known.all():
        text = f"its risk {tally(~is_known, seconds)[-1]} of the time"
        text += ", or nobody was ahead" * any(row.observation is None for row in rows)
        pairs.append(("not known", text))
    # A moment lasts while an alarm does; the highest risk within it stands for it.
    calm = (alarms == 0.0) & (np.diff(times // _MOMENT, prepend=0.0) != 0.0)
    first = (begins > 0.0) | calm | (np.diff(alarms, prepend=0.0) != 0.0)
    moments = np.cumsum(first)
    long = np.bincount(moments, durations * alarms)[moments]
    if failed:
        before = np.append(long, 0.0)[failed]  # where nothing was decided there was no alarm
        text = f"{len(failed):,}; {(before > 0.0).sum():,} in alarm by then"
        ahead = f", for {np.median(before[before > 0.0]):.1f} s (median)" if before.any() else ""
        pairs.append(("failures", text + ahead))
    if errors:
        pairs.append(
            ("refused", f"{counted(len(errors), 'message')}, the first because {errors[0]}")
        )
    yield facts(title, pairs)
    tolerance = getattr(decider.guard.reviser, "tolerance", None)
    tolerances = sorted({*_TOLERANCES, *([] if tolerance is None else [tolerance])})
    rest = max(durations @ is_known, interval)
    risk_rows = [(f"{risk:g}", *tally(risks > risk, rest)) for risk in tolerances]
    bold = [place for place, risk in enumerate(tolerances) if risk == tolerance]
    # Whether it would alarm with another tolerance, one pass does not say.
    header = ("above", "times", "an hour", "of the time")
    if is_known.any():
        title = "\nBy risk of what was proposed" + ", while it is known" * (not is_known.all())
        yield table(title, header, risk_rows, bold=bold)
    heights = np.nan_to_num(risks)
    parts = np.split(np.arange(len(rows)), np.flatnonzero(first)[1:])
    highest = [int(part[heights[part].argmax()]) for part in parts]
    names = decider.form.variables or [f"{k + 1}" for k in range(len(rows[0].observation or ()))]
    names = () if decider.form.scenes else names[:_MOST_VARIABLES]
    episodes, worst = np.cumsum(begins), []
    for at in sorted(highest, key=lambda at: (-heights[at], -long[at]))[:_WORST]:
        if heights[at] or alarms[at]:
            cells = [*(rows[at].observation or ())[: len(names)], rows[at].proposal]
            texts = [
                f"{v:.4g}" if isinstance(v, float) else str("" if v is None else v) for v in cells
            ]
            where = (f"{episodes[at]:.0f}", f"{times[at]:.10g}", *texts)
            star = "*" * bool(alarms[at] and risks[at] <= (tolerance or 0.0))
            text = f"{risks[at]:.1%}{star}" if is_known[at] else "not known"
            worst.append((*where, text, f"{long[at]:.1f}"))
    header = ("episode", "time", *names, "proposed", "risk", "alarm lasts [s]")
    why = " (*: alarmed for a margin)" * any("*" in x[-2] for x in worst)
    yield table(f"\nThe worst moments{why}", header, worst)

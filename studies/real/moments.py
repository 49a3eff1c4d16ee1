"""The most telling moments, chosen by a rule: where ours was earlier, and where it was wrong."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from studies.real.cases import INTERVAL, Case, Question

#: An alarm may come so long before an event and count as its warning [s].
LONGEST_LEAD = 10.0
#: Every measure may be on alarm for this share of the time in which nothing came.
ALARM_SHARE = 0.01
#: A moment is shown from so long before to so long after it [s].
BEFORE, AFTER = 10.0, 4.0


class Kind(StrEnum):
    """Why a moment is shown."""

    EARLIER = "ours was earlier"
    LATER = "ours was later, or missed it"
    FALSE_ALARM = "ours was on alarm, and nothing came"


class Moment(NamedTuple):
    """T decisions around a time, of one pair."""

    kind: Kind
    run: str
    pair: str
    time: float  #: at which the event begins, or the false alarm is highest [s]
    lead: float  #: of ours before the event [s]; 0 without a warning, NaN for a false alarm
    other_lead: float  #: of the other measure
    times: NDArray[np.float64]  #: (T,) [s] after ``time``
    observations: NDArray[np.float64]  #: (T, 3)
    ours: NDArray[np.float64]  #: (T,) score, 0 where its alarm begins
    other: NDArray[np.float64]  #: (T,) score, 0 where its alarm begins


class Warned(NamedTuple):
    """How early events were warned of, each measure on alarm for the same share of quiet time."""

    target: str
    measure: str
    events: int
    warned: int  #: of them on alarm when they began
    median: float  #: lead of those that were warned of [s]; NaN where none was
    leads: tuple[float, ...]  #: of every event [s], 0 where it was not warned of

    @property
    def share(self) -> tuple[int, int]:
        """So many of so many."""
        return self.warned, self.events


def alarm_threshold(
    scores: Sequence[NDArray[np.float64]], cases: Sequence[Case], target: str, horizon: float
) -> float:
    """Score that is exceeded in `ALARM_SHARE` of the decisions after which nothing came."""
    quiet = [
        score[answer.known & ~answer.came]
        for score, case in zip(scores, cases, strict=True)
        for answer in [case.answers[Question(target, horizon)]]
    ]
    every = np.sort(np.concatenate(quiet))
    if len(every) == 0:
        return float("inf")
    return float(every[min(int(np.ceil((1.0 - ALARM_SHARE) * len(every))), len(every) - 1)])


def lead_before(alarm: NDArray[np.bool_], times: NDArray[np.float64], event: float) -> float:
    """Time from the first alarm that stays on to the event [s]; 0 where it was off at the end.

    Parameters
    ----------
    alarm : (T,) ndarray of bool
        At each decision.
    times : (T,) ndarray
        [s].
    event : float
        When it begins [s].

    Examples
    --------
    >>> lead_before(np.array([True, False, True, True]), np.arange(4.0), 4.0)
    2.0
    """
    before = np.flatnonzero((times < event) & (times >= event - LONGEST_LEAD))
    if len(before) == 0 or not alarm[before[-1]]:
        return 0.0
    off = before[~alarm[before]]
    first = off[-1] + 1 if len(off) else before[0]
    return float(event - times[first])


def leads(
    scores: Sequence[NDArray[np.float64]], threshold: float, cases: Sequence[Case], target: str
) -> list[float]:
    """Lead before every event of a target, in the order of cases [s]."""
    return [
        lead_before(score > threshold, case.times, event)
        for score, case in zip(scores, cases, strict=True)
        for event in case.begins[target].tolist()
    ]


def telling_moments(
    cases: Sequence[Case],
    target: str,
    horizon: float,
    ours: Sequence[NDArray[np.float64]],
    other: Sequence[NDArray[np.float64]],
) -> list[Moment]:
    """Where ours was earlier, where it was later, and where it was wrong.

    The three events with the largest gain in lead time, the one with the largest loss (else one
    that both missed), and the longest false alarm. At most one of each kind of a run is taken, so
    that no single drive makes the picture; of equals the first.

    Parameters
    ----------
    cases : sequence of Case
    target, horizon
        The event, and how long after an alarm it may come [s].
    ours, other : sequence of (T,) ndarray
        Scores of both measures.
    """
    marks = [alarm_threshold(scores, cases, target, horizon) for scores in (ours, other)]
    events = [(k, event) for k, case in enumerate(cases) for event in case.begins[target].tolist()]
    both = list(
        zip(
            leads(ours, marks[0], cases, target), leads(other, marks[1], cases, target), strict=True
        )
    )
    order = sorted(range(len(events)), key=lambda e: both[e][1] - both[e][0])

    def moment(kind: Kind, k: int, time: float, lead: tuple[float, float]) -> Moment:
        case = cases[k]
        rows = (case.times >= time - BEFORE) & (case.times <= time + AFTER)
        return Moment(
            kind,
            case.run,
            case.pair,
            time,
            *lead,
            case.times[rows] - time,
            case.observations[rows],
            ours[k][rows] - marks[0],
            other[k][rows] - marks[1],
        )

    earlier = [e for e in order if both[e][0] > both[e][1]]
    later = [e for e in reversed(order) if both[e][0] < both[e][1]]
    missed = [e for e in order if both[e][0] == 0.0]
    found = [
        moment(Kind.EARLIER, *events[e], both[e])
        for e in _one_a_run(earlier, [cases[k].run for k, _ in events])[:3]
    ]
    found += [moment(Kind.LATER, *events[e], both[e]) for e in (later or missed)[:1]]
    false = _longest_false_alarm(cases, ours, marks[0])
    if false is not None:
        found.append(moment(Kind.FALSE_ALARM, *false, (np.nan, np.nan)))
    return found


def _one_a_run(chosen: Sequence[int], runs: Sequence[str]) -> list[int]:
    """The first of each run."""
    first: dict[str, int] = {}
    for event in chosen:
        first.setdefault(runs[event], event)
    return list(first.values())


def _longest_false_alarm(
    cases: Sequence[Case], scores: Sequence[NDArray[np.float64]], threshold: float
) -> tuple[int, float] | None:
    """Case and time of the longest alarm with no event of any kind near it."""
    longest, found = 0, None
    near = round(LONGEST_LEAD / INTERVAL)
    for k, (case, score) in enumerate(zip(cases, scores, strict=True)):
        answers = list(case.answers.values())
        quiet = np.logical_and.reduce([answer.known & ~answer.came for answer in answers])
        edges = np.flatnonzero(np.diff(np.concatenate([[False], score > threshold, [False]])))
        for first, end in edges.reshape(-1, 2).tolist():
            if end - first > longest and quiet[max(first - near, 0) : end].all():
                longest = end - first
                peak = first + int(np.argmax(score[first:end]))
                found = k, float(case.times[peak])
    return found

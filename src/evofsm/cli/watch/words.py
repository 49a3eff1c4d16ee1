"""The story of a run in plain sentences: when danger began, why, and what was done about it."""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from evofsm.cli.watch.shown import Danger, Frame, Start, Story

# Changes of speed that are smaller are "at the same speed" [m/s], and softer accelerations none.
_EQUAL, _HARDLY = 0.5, 0.3


class Told(NamedTuple):
    """A story as it is read."""

    #: ``unjudged``, ``safe``, ``averted``, ``danger``, ``dead end``, ``collision`` or ``ended``
    status: str
    headline: str
    when: str
    why: str
    done: str
    others: str  #: what time to collision and time headway would have said
    outcome: str
    alone: str  #: what the driver would have come to by itself


def tell(frame: Frame, start: Start) -> Told:
    """What has happened up to a frame."""
    story, danger = frame.story, frame.story.danger
    status = _status(frame, start)
    told = Told(
        status,
        _headline(status, start),
        "No danger so far." if danger is None else _when(story, danger, start),
        _no_danger(frame, start) if danger is None else _why(danger),
        _quiet(story, start) if danger is None else _done(danger, frame),
        _others(story, start),
        _outcome(story, frame),
        _alone(story, frame),
    )
    return Told(*(_UNIT.sub("\u00a0", text) for text in told))


# A number and its unit stay on one line.
_UNIT = re.compile(r"(?<=\d) (?=(?:s|m|m/s|m/s²)\b)")
_HEADLINES = {
    "unjudged": "Nothing is judged yet",
    "safe": "Safe",
    "danger": "Danger",
    "averted": "Danger, held off",
    "dead end": "Dead end, if the leader brakes hard now",
    "collision": "Collision",
    "ended": "No collision",
}


def _knows_leaders(start: Start) -> bool:
    """Whether the judge was told how cars follow each other."""
    return start.judge != "learnt"


def _headline(status: str, start: Start) -> str:
    if status == "dead end" and not _knows_leaders(start):
        return "Dead end, as far as it has learnt"
    return _HEADLINES[status]


def _quiet(story: Story, start: Start) -> str:
    """What was done where the judge saw no danger; classic measures may have."""
    if story.revised == 0 and not (story.judged or _knows_leaders(start)):
        return "Nothing: every wish of the driver was carried out."
    if story.revised == 0:
        return "Nothing had to be done: every wish of the driver was carried out."
    plural = "decision" if story.revised == 1 else "decisions"
    changed = f"The reviser changed {story.revised} {plural}"
    if not _knows_leaders(start):
        return f"{changed}, to survive all that it remembers by a margin."
    return f"{changed}, though latent risk saw no danger."


def _no_danger(frame: Frame, start: Start) -> str:
    if not _knows_leaders(start) and not frame.story.judged:
        return "Nothing was judged, for no failure was known yet."
    if math.isnan(frame.brakes_to):  # which recordings do not hold
        return "No wish of the driver was judged to be too risky."
    return (
        f"If the leader braked as hard as must be expected (up to {frame.brakes_to:.1f} m/s²), "
        "full braking would still avoid a collision."
    )


def _seconds(time: float) -> str:
    return f"{_tenths(time):.1f} s"


def _tenths(time: float) -> float:
    """A time, rounded as the page does it: 14.25 s becomes 14.3 s."""
    return math.nan if math.isnan(time) else math.floor(10.0 * time + 0.5) / 10.0


def _status(frame: Frame, start: Start) -> str:
    story = frame.story
    if frame.collided or frame.rear_ended:
        return "collision"
    if frame.over:
        return "ended"
    if not story.in_danger or story.danger is None:
        return "safe" if story.judged or _knows_leaders(start) else "unjudged"
    if not math.isnan(story.danger.dead_end):
        return "dead end"
    is_held_off = frame.executed_risk.risk <= start.tolerance
    return "averted" if frame.revising and is_held_off else "danger"


def _when(story: Story, danger: Danger, start: Start) -> str:
    text = f"Danger began at {_seconds(danger.since)}"
    if danger.since > story.first:
        text += f" (and before, at {_seconds(story.first)})"
    if not story.in_danger:
        return f"{text}; it was over at {_seconds(danger.last)}."
    if not math.isnan(danger.dead_end) and not _knows_leaders(start):
        return (
            f"{text}, in what the driver wanted. From {_seconds(danger.dead_end)} on it was a dead "
            "end: nothing that it knows to do would most likely have been enough."
        )
    if not math.isnan(danger.dead_end):
        return (
            f"{text}, in what the driver wanted. From {_seconds(danger.dead_end)} on it was a dead "
            "end: if the leader braked hard, even braking in full at once would come too late."
        )
    return f"{text}."


def _why(danger: Danger) -> str:
    """Where the cars were, and what could not be survived there."""
    where = f"{danger.gap:.1f} m behind the leader at {danger.speed:.0f} m/s"
    if danger.closing > _EQUAL:
        where += f", {danger.closing:.1f} m/s faster than it"
    elif danger.closing < -_EQUAL:
        where += f", {-danger.closing:.1f} m/s slower than it"
    else:
        where += ", as fast as it"
    wanted = f"{where[0].upper()}{where[1:]}, the driver wanted to {_wish(danger.proposed)}"
    if danger.why:
        return f"{wanted}: a risk of {danger.risk:.0%}. After that {danger.why}."
    if math.isnan(danger.critical):  # which recordings do not hold
        return f"{wanted}: a risk of {danger.risk:.0%}."
    return (
        f"{wanted}. After that, not even braking in full (by {danger.decel:.1f} m/s²) would avoid "
        f"a collision if the leader braked harder than {danger.critical:.1f} m/s² – and leaders "
        f"must be expected to brake by up to {danger.brakes_to:.1f} m/s²."
    )


def _done(danger: Danger, frame: Frame) -> str:
    share = f"{danger.revised} of {danger.decisions} decisions in danger"
    if danger.revised == 0:
        if frame.revising:
            return "The reviser has changed nothing yet."
        instead = _instead(danger.advised, danger.proposed)
        return f"Nothing: the reviser is off. It would have begun at once, {instead}."
    if not frame.revising:
        return f"The reviser changed {share}, but now it is off."
    hardest = ""
    if danger.hardest < -_HARDLY:
        hardest = f"; at its hardest it braked by {-danger.hardest:.1f} m/s²"
    instead = _instead(danger.instead, danger.wished)
    when = _seconds(danger.stepped_in)
    if danger.off < danger.stepped_in:
        when += ", as it was switched on"
    mean = danger.change / danger.revised
    others = frame.story.revised - danger.revised
    elsewhere = f" It changed {others} more outside of this danger." if others else ""
    return (
        f"The reviser stepped in at {when}, at first {instead}. It changed {share}, by "
        f"{mean:.1f} m/s² on average{hardest}.{elsewhere}"
    )


def _wish(
    acceleration: float, faster: str = "accelerate by", slower: str = "brake by", kept: str = "keep"
) -> str:
    if acceleration > _HARDLY:
        return f"{faster} {acceleration:.1f} m/s²"
    if acceleration < -_HARDLY:
        return f"{slower} {-acceleration:.1f} m/s²"
    return f"{kept} about its speed ({acceleration:+.1f} m/s²)"


def _instead(better: float, wished: float) -> str:
    wishing = _wish(wished, "accelerating by", "braking by only", "keeping")
    return f"to {_wish(better)} instead of {wishing}"


def _others(story: Story, start: Start) -> str:
    """When the classic measures noticed, against the first danger."""
    collision = _noticed(story.time_to_collision, story.first)
    headway = _noticed(story.time_headway, story.first)
    return (
        f"Time to collision (below {start.ttc_threshold:g} s) {collision}; "
        f"time headway (below {start.headway_threshold:g} s) {headway}."
    )


def _noticed(at: float, danger: float) -> str:
    if math.isnan(at):
        return "has not noticed anything"
    late = _tenths(at) - _tenths(danger)
    if math.isnan(late) or late == 0.0:
        return f"did at {_seconds(at)}"
    side = "after danger began" if late > 0.0 else "before"
    return f"did at {_seconds(at)}, {_seconds(abs(late))} {side}"


def _outcome(story: Story, frame: Frame) -> str:
    parts = []
    if not math.isnan(story.leader_brakes):
        when = _seconds(story.leader_brakes)
        parts.append(f"The leader braked from {when} on, by up to {story.leader_decel:.1f} m/s².")
    if not math.isnan(story.collision):
        parts.append(f"Collision at {_seconds(story.collision)}, {story.impact:.1f} m/s too fast.")
    elif frame.rear_ended:
        parts.append(f"The car behind ran into the follower at {_seconds(frame.time)}.")
    elif not math.isnan(story.ended):
        parts.append(f"No collision: {_rest(frame)}.")
    return " ".join(parts)


def _alone(story: Story, frame: Frame) -> str:
    if not math.isfinite(story.alone) or frame.collided or frame.time == 0.0:
        return ""
    verb = "would have hit" if frame.time >= story.alone else "would hit"
    return f"This driver {verb} the leader at {_seconds(story.alone)}."


def _rest(frame: Frame) -> str:
    if frame.v_follower == 0.0:
        return f"stopped {frame.gap:.1f} m behind the leader"
    return f"{frame.gap:.1f} m behind the leader at the end"

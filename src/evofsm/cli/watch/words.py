"""The story of a run in plain sentences: when danger began, why, and what was done about it."""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from evofsm.cli.watch.shown import Danger, Frame, Start, Story

# Changes of speed that are smaller are "at the same speed" [m/s], and softer accelerations none.
_EQUAL, _HARDLY = 0.5, 0.3
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


class Told(NamedTuple):
    """A story as it is read."""

    status: str  #: a key of the headlines above
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
    knows_leaders = start.judge != "learnt"
    status = _status(frame, start.tolerance, is_judged=story.judged or knows_leaders)
    headline = _HEADLINES[status]
    if status == "dead end" and not knows_leaders:
        headline = "Dead end, as far as it has learnt"
    if danger is None:
        when = "No danger so far."
        why, done = _no_danger(frame, knows_leaders), _quiet(story, knows_leaders)
    else:
        when = _when(story, danger, knows_leaders)
        why, done = _why(danger.began), _done(danger, frame, start)
    others = (
        f"Time to collision (below {start.ttc_threshold:g} s) "
        f"{_noticed(story.time_to_collision, story.first)}; "
        f"time headway (below {start.headway_threshold:g} s) "
        f"{_noticed(story.time_headway, story.first)}."
    )
    told = status, headline, when, why, done, others, _outcome(frame), _alone(frame)
    return Told(*(_UNIT.sub("\u00a0", text) for text in told))


def _status(frame: Frame, tolerance: float, *, is_judged: bool) -> str:
    story = frame.story
    if frame.collided or frame.rear_ended:
        return "collision"
    if frame.over:
        return "ended"
    if not story.in_danger or story.danger is None:
        return "safe" if is_judged else "unjudged"
    if not math.isnan(story.danger.dead_end):
        return "dead end"
    return "averted" if frame.revising and frame.executed_risk.risk <= tolerance else "danger"


def _no_danger(frame: Frame, knows_leaders: bool) -> str:
    if not (knows_leaders or frame.story.judged):
        return "Nothing was judged, for no failure was known yet."
    if math.isnan(frame.brakes_to):  # which recordings do not hold
        return "No wish of the driver was judged to be too risky."
    return (
        f"If the leader braked as hard as must be expected (up to {frame.brakes_to:.1f} m/s²), "
        "full braking would still avoid a collision."
    )


def _quiet(story: Story, knows_leaders: bool) -> str:
    """What was done where the judge saw no danger; classic measures may have."""
    if story.revised == 0:
        had = "Nothing had to be done" if story.judged or knows_leaders else "Nothing"
        return f"{had}: every wish of the driver was carried out."
    changed = f"The reviser changed {story.revised} decision{'s' * (story.revised != 1)}"
    if not knows_leaders:
        return f"{changed}, to survive all that it remembers by a margin."
    return f"{changed}, though latent risk saw no danger."


def _when(story: Story, danger: Danger, knows_leaders: bool) -> str:
    text = f"Danger began at {_seconds(danger.began.time)}"
    if not story.in_danger:
        return f"{text}; it was over at {_seconds(danger.last)}."
    if math.isnan(danger.dead_end):
        return f"{text}."
    what = "nothing that it knows to do would most likely have been enough"
    if knows_leaders:
        what = "if the leader braked hard, even braking in full at once would come too late"
    end = f"From {_seconds(danger.dead_end)} on it was a dead end: {what}."
    return f"{text}, in what the driver wanted. {end}"


def _why(began: Frame) -> str:
    """Where the cars were, and what could not be survived there."""
    gap, speed, leader_speed = began.observation
    closing = speed - leader_speed
    pace = f"{abs(closing):.1f} m/s {'faster' if closing > 0.0 else 'slower'} than it"
    if abs(closing) <= _EQUAL:
        pace = "as fast as it"
    wish = _wish(began.proposed)
    wanted = (
        f"{gap:.1f} m behind the leader at {speed:.0f} m/s, {pace}, the driver wanted to {wish}"
    )
    risk = began.proposed_risk.risk
    if began.why:
        return f"{wanted}: a risk of {risk:.0%}. After that {began.why}."
    if math.isnan(began.critical):  # which recordings do not hold
        return f"{wanted}: a risk of {risk:.0%}."
    return (
        f"{wanted}. After that, not even braking in full (by {began.decel:.1f} m/s²) would avoid "
        f"a collision if the leader braked harder than {began.critical:.1f} m/s² – and leaders "
        f"must be expected to brake by up to {began.brakes_to:.1f} m/s²."
    )


def _done(danger: Danger, frame: Frame, start: Start) -> str:
    first, share = danger.stepped_in, f"{danger.revised} of {danger.decisions} decisions in danger"
    if first is None:
        if frame.revising:
            return "The reviser has changed nothing yet."
        instead = _instead(danger.began.advised, danger.began.proposed)
        why = "it only watched, in shadow mode" if start.shadow else "the reviser is off"
        return f"Nothing: {why}. It would have begun at once, {instead}."
    if not frame.revising:
        return f"The reviser changed {share}, but now it is off."
    hardest = ""
    if danger.hardest < -_HARDLY:
        hardest = f"; at its hardest it braked by {-danger.hardest:.1f} m/s²"
    return (
        f"The reviser stepped in at {_seconds(first.time)}, at first "
        f"{_instead(first.executed, first.proposed)}. It changed {share}, by "
        f"{danger.change / danger.revised:.1f} m/s² on average{hardest}."
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


def _noticed(at: float, danger: float) -> str:
    """When a classic measure noticed, against the first danger."""
    if math.isnan(at):
        return "has not noticed anything"
    late = _tenths(at) - _tenths(danger)
    if math.isnan(late) or late == 0.0:
        return f"did at {_seconds(at)}"
    side = "after danger began" if late > 0.0 else "before"
    return f"did at {_seconds(at)}, {_seconds(abs(late))} {side}"


def _outcome(frame: Frame) -> str:
    story, parts = frame.story, []
    if not math.isnan(story.leader_brakes):
        when = _seconds(story.leader_brakes)
        parts.append(f"The leader braked from {when} on, by up to {story.leader_decel:.1f} m/s².")
    if frame.collided:
        impact = frame.v_follower - frame.v_leader
        parts.append(f"Collision at {_seconds(frame.time)}, {impact:.1f} m/s too fast.")
    elif frame.rear_ended:
        parts.append(f"The car behind ran into the follower at {_seconds(frame.time)}.")
    elif frame.over and frame.v_follower == 0.0:
        parts.append(f"No collision: stopped {frame.gap:.1f} m behind the leader.")
    elif frame.over:
        parts.append(f"No collision: {frame.gap:.1f} m behind the leader at the end.")
    return " ".join(parts)


def _alone(frame: Frame) -> str:
    alone = frame.story.alone
    if not math.isfinite(alone) or frame.collided or frame.time == 0.0:
        return ""
    verb = "would have hit" if frame.time >= alone else "would hit"
    return f"This driver {verb} the leader at {_seconds(alone)}."


def _seconds(time: float) -> str:
    return f"{_tenths(time):.1f} s"


def _tenths(time: float) -> float:
    """A time, rounded as the page does it: 14.25 s becomes 14.3 s."""
    return math.nan if math.isnan(time) else math.floor(10.0 * time + 0.5) / 10.0

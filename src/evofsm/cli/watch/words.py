"""The story of a run in plain sentences: when danger began, why, and what was done about it."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

from evofsm.cli.watch.shown import Cars, Danger, Frame, Start, Story
from evofsm.fsm.validation import action_name
from evofsm.guard.actions import action_text

# Changes of speed that are smaller are "at the same speed" [m/s], and softer accelerations none.
_EQUAL, _HARDLY = 0.5, 0.3
# Components of an action that are told.
_COMPONENTS = 3
# A number and its unit stay on one line.
_UNIT = re.compile(r"(?<=\d) (?=(?:s|m|m/s|m/s²)\b)")
_HEADLINES = {
    "unjudged": "Nothing is judged yet",
    "safe": "Safe",
    "danger": "Danger",
    "averted": "Danger, held off",
    "dead end": "Dead end, as far as it has learnt",
    "failure": "Failure",
    "ended": "No failure",
}
# Where there are cars, by whether the judge was told how leaders brake.
_OF_CARS = {"failure": "Collision", "ended": "No collision"}
_OF_LEADERS = {"dead end": "Dead end, if the leader brakes hard now"}


class Told(NamedTuple):
    """A story as it is read."""

    status: str  #: a key of the headlines above
    headline: str
    when: str
    why: str
    done: str
    outcome: str
    alone: str  #: what the controller would have come to by itself


def tell(frame: Frame, start: Start) -> Told:
    """What has happened up to a frame."""
    story, danger = frame.story, frame.story.danger
    knows_leaders = start.judge != "learnt"
    status = _status(frame, start.tolerance, is_judged=story.judged or knows_leaders)
    headlines = (
        _HEADLINES | (_OF_CARS if frame.cars else {}) | (_OF_LEADERS if knows_leaders else {})
    )
    if danger is None:
        when = "No danger so far."
        why, done = _no_danger(frame, knows_leaders), _quiet(story, knows_leaders)
    else:
        when = _when(story, danger, knows_leaders)
        why, done = _why(danger.began, start), _done(danger, frame, start)
    if frame.failed and frame.revising and story.alone > frame.time:
        done += " The controller alone would have lasted longer."
    told = status, headlines[status], when, why, done, _outcome(frame), _alone(frame)
    return Told(*(_UNIT.sub("\u00a0", text) for text in told))


def _status(frame: Frame, tolerance: float, *, is_judged: bool) -> str:
    story = frame.story
    if frame.failed or (frame.cars and frame.cars.rear_ended):
        return "failure"
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
    if math.isnan(frame.needed) or not knows_leaders:  # which recordings do not hold
        return "Nothing that was proposed was judged to be too risky."
    return (
        f"If the leader braked as hard as must be expected (up to {frame.needed:.1f} m/s²), "
        "full braking would still avoid a collision."
    )


def _quiet(story: Story, knows_leaders: bool) -> str:
    """What was done where the judge saw no danger; classic measures may have."""
    if story.revised == 0:
        had = "Nothing had to be done" if story.judged or knows_leaders else "Nothing"
        return f"{had}: all that was proposed was carried out."
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
    return f"{text}. From {_seconds(danger.dead_end)} on it was a dead end: {what}."


def _why(began: Frame, start: Start) -> str:
    """Where it was, and what could not be survived there."""
    risk, cars = began.proposed_risk, began.cars
    if cars is None:
        wanted = f"At {began.here}, the controller wanted {_action(began.proposed, start)}"
    else:
        gap, speed, leader_speed = began.observation
        closing = speed - leader_speed
        pace = f"{abs(closing):.1f} m/s {'faster' if closing > 0.0 else 'slower'} than it"
        if abs(closing) <= _EQUAL:
            pace = "as fast as it"
        wish = _wish(began.proposed[0])
        wanted = (
            f"{gap:.1f} m behind the leader at {speed:.0f} m/s, {pace}, the driver wanted to {wish}"
        )
    if began.why:
        return f"{wanted}: a risk of {risk.risk:.0%}. After that {began.why}."
    if cars is None or math.isnan(risk.critical):  # which recordings do not hold
        return f"{wanted}: a risk of {risk.risk:.0%}."
    return (
        f"{wanted}. After that, not even braking in full (by {cars.decel:.1f} m/s²) would avoid "
        f"a collision if the leader braked harder than {risk.critical:.1f} m/s² – and leaders "
        f"must be expected to brake by up to {began.needed:.1f} m/s²."
    )


def _done(danger: Danger, frame: Frame, start: Start) -> str:
    first, share = danger.stepped_in, f"{danger.revised} of {danger.decisions} decisions in danger"
    if first is None:
        if frame.revising:
            return "The reviser has changed nothing yet."
        began = danger.began
        instead = _instead(began.advised, began.proposed, start)
        why = "it only watched, in shadow mode" if start.shadow else "the reviser is off"
        return f"Nothing: {why}. It would have begun at once, {instead}."
    if not frame.revising:
        return f"The reviser changed {share}, but now it is off."
    hardest = ""
    if frame.cars and danger.hardest < -_HARDLY:
        hardest = f"; at its hardest it braked by {-danger.hardest:.1f} m/s²"
    return (
        f"The reviser stepped in at {_seconds(first.time)}, at first "
        f"{_instead(first.executed, first.proposed, start)}. It changed {share}{hardest}."
    )


def _wish(
    acceleration: float, faster: str = "accelerate by", slower: str = "brake by", kept: str = "keep"
) -> str:
    if acceleration > _HARDLY:
        return f"{faster} {acceleration:.1f} m/s²"
    if acceleration < -_HARDLY:
        return f"{slower} {-acceleration:.1f} m/s²"
    return f"{kept} about its speed ({acceleration:+.1f} m/s²)"


def _instead(better: Sequence[float], wished: Sequence[float], start: Start) -> str:
    if not start.cars:
        return f"{_action(better, start)} instead of {_action(wished, start)}"
    wishing = _wish(wished[0], "accelerating by", "braking by only", "keeping")
    return f"to {_wish(better[0])} instead of {wishing}"


def _action(action: Sequence[float], start: Start) -> str:
    """An action of any system, as people read it."""
    if start.discrete:
        return action_name(int(action[0])) if math.isfinite(action[0]) else "nothing"
    shown = [float(f"{value:.2g}") for value in action[:_COMPONENTS]]
    text = action_text(shown[0] if len(action) == 1 else shown)
    return text if len(action) <= _COMPONENTS else f"{text[:-1]}, ...)"


def _outcome(frame: Frame) -> str:
    when, cars = _seconds(frame.time), frame.cars
    if cars is not None:
        return _on_the_road(frame, cars)
    if frame.over:
        return f"Failed at {when}." if frame.failed else f"It ended at {when} without failure."
    return ""


def _on_the_road(frame: Frame, cars: Cars) -> str:
    story, parts = frame.story, []
    if not math.isnan(story.leader_brakes):
        when = _seconds(story.leader_brakes)
        parts.append(f"The leader braked from {when} on, by up to {story.leader_decel:.1f} m/s².")
    if frame.failed:
        impact = cars.v_follower - cars.v_leader
        parts.append(f"Collision at {_seconds(frame.time)}, {impact:.1f} m/s too fast.")
    elif cars.rear_ended:
        parts.append(f"The car behind ran into the follower at {_seconds(frame.time)}.")
    elif frame.over and cars.v_follower == 0.0:
        parts.append(f"No collision: stopped {cars.gap:.1f} m behind the leader.")
    elif frame.over:
        parts.append(f"No collision: {cars.gap:.1f} m behind the leader at the end.")
    return " ".join(parts)


def _alone(frame: Frame) -> str:
    alone = frame.story.alone
    as_alone = frame.failed and math.isclose(alone, frame.time)
    if not math.isfinite(alone) or as_alone or frame.time == 0.0:
        return ""
    who, fails, failed = "The controller alone", "would fail", "would have failed"
    if frame.cars:
        who, fails, failed = "This driver", "would hit the leader", "would have hit the leader"
    return f"{who} {failed if frame.time >= alone else fails} at {_seconds(alone)}."


def _seconds(time: float) -> str:
    return f"{time:.2g} s" if time < 1.0 else f"{_tenths(time):.1f} s"


def _tenths(time: float) -> float:
    """A time, rounded as the page does it: 14.25 s becomes 14.3 s."""
    return math.nan if math.isnan(time) else math.floor(10.0 * time + 0.5) / 10.0

"""The story of a run in plain sentences: when danger began, why, and what was done about it."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import NamedTuple

from evofsm.cli.watch.shown import Danger, Frame, Start, Story
from evofsm.fsm.validation import action_name, counted
from evofsm.guard.actions import action_text

# What the reviser does in a run, beside what a log says was done, and where nobody acts.
_LIVE = (
    "The reviser, a safety filter that learns on the way, replaces actions that it finds too "
    "risky; switched off, it only watches."
)
_BESIDE = (
    "This was recorded. The reviser, a safety filter, did not act; it says which actions it would "
    "have replaced."
)
_ALONE = "This was recorded, and nobody acts. A guard that learnt from the log alarms."
_COMPONENTS = 3  # components of an action that are told
_UNIT = re.compile(r"(?<=\d) (?=(?:s|m|m/s|m/s²)\b)")  # stays with its number
_HEADLINES = {
    "unjudged": "Nothing is judged",
    "safe": "No danger known",
    "danger": "Danger",
    "averted": "Danger, held off",
    "dead end": "Dead end, as far as it has learnt",
    "failure": "Failure",
    "ended": "No failure",
}
_OF_LEADERS = {"dead end": "Dead end, if the leader brakes hard now"}  # of a judge of these
_FIRST_FAILURE = "A guard cannot prevent the first failure of a kind; this one is learnt now"


class Told(NamedTuple):
    """A story as it is read."""

    status: str  #: a key of the headlines above
    headline: str
    when: str
    why: str
    done: str
    outcome: str
    alone: str  #: what the controller would have come to by itself


def introduce(start: Start) -> dict[str, str]:
    """What is said of a run before it begins: what the reviser does in it, and what was learnt."""
    if not start.live:
        note = "Recorded: the states as they were at its end."
        return {"intro": _BESIDE if start.acts else _ALONE, "learning": note}
    before = f"Learnt from {start.learnt} episodes before" if start.learnt else "Began from empty"
    return {"intro": _LIVE, "learning": f"{before}, and goes on learning."}


def tell(frame: Frame, start: Start) -> Told:
    """What has happened up to a frame."""
    story, danger = frame.story, frame.story.danger
    knows_leaders = start.judge != "learnt"
    status = _status(frame, start.tolerance)
    headlines = _HEADLINES | (_OF_LEADERS if knows_leaders else {})
    if frame.cars:
        headlines |= {"failure": start.fails or "Collision", "ended": "No collision"}
    if not start.acts:
        headlines |= {"danger": "Alarm", "safe": "No alarm"}
    headline = headlines[status]
    if danger is None:
        when = "No danger was seen." if frame.over else "No danger so far."
        when = "Some proposals came close." if story.advised else when
        why, response = _no_danger(frame, start), _quiet(frame, start)
    else:
        when, why = _when(start, story, danger, knows_leaders), _why(danger.began, start)
        response = _done(danger, frame, start)
    if not start.acts:
        when = when.replace("Danger began", "An alarm came").replace("No danger", "No alarm")
    if frame.over and danger and story.revised:
        response += f" In all it changed {story.revised} of {counted(frame.number, 'decision')}."
    if frame.failed and story.revised and story.alone > frame.time:
        response += " The controller alone would have lasted longer."
    if frame.novel:
        headline += ", the first of its kind"
        response += f" {_FIRST_FAILURE}: {frame.novel}."
    texts = status, headline, when, why, response, _outcome(frame, start), _alone(frame, start)
    return Told(*(_UNIT.sub("\u00a0", text) for text in texts))


def _status(frame: Frame, tolerance: float) -> str:
    story = frame.story
    if frame.failed or (frame.cars and frame.cars.rear_ended):
        return "failure"
    if frame.over:
        return "ended"
    if not story.in_danger or story.danger is None:
        return "safe" if story.judged else "unjudged"
    if not math.isnan(story.danger.dead_end):
        return "dead end"
    return "averted" if not frame.idle and frame.executed_risk.risk <= tolerance else "danger"


def _no_danger(frame: Frame, start: Start) -> str:
    if not start.acts:
        return "No limit of its alarm was passed."
    if not frame.story.judged:
        return "Nothing was judged, for no failure was known yet."
    return "Nothing that was proposed was judged to be too risky."


def _quiet(frame: Frame, start: Start) -> str:
    """What was done where the judge saw no danger."""
    if not start.acts:
        return "No alarm: nobody acts here."
    story = frame.story
    if not story.advised:
        had = "Nothing had to be done" if story.judged else "Nothing was done"
        return f"{had}: all that was proposed was carried out."
    why = ", though the risk was tolerable"
    if start.judge == "learnt":
        why = ", to survive all that it remembers by a margin"
    if story.revised:
        return f"The reviser changed {counted(story.revised, 'decision')}{why}."
    would = counted(story.advised, "decision")
    return f"Nothing: {frame.idle}. It would have changed {would}{why}."


def _when(start: Start, story: Story, danger: Danger, knows_leaders: bool) -> str:
    began, last = clock(danger.began.time, start), clock(danger.last, start)
    text = f"Danger began at {began}"
    if story.first < danger.began.time:
        text += f" (for the first time at {clock(story.first, start)})"
    if not story.in_danger:
        return f"{text}; it was over {'at once' if began == last else f'at {last}'}."
    if math.isnan(danger.dead_end):
        return f"{text}."
    reason = "nothing that it knows to do would most likely have been enough"
    if knows_leaders:
        reason = "if the leader braked hard, even braking in full at once would come too late"
    return f"{text}. From {clock(danger.dead_end, start)} on it was a dead end: {reason}."


def _why(began: Frame, start: Start) -> str:
    """Where it was, and what could not be survived there."""
    if not start.acts:
        return f"At {began.here}: {began.reason}."
    wish = _action(began.proposed, start)
    return f"Situation: {began.here}. The controller wanted {wish}: {began.why}."


def _done(danger: Danger, frame: Frame, start: Start) -> str:
    if not start.acts:
        return f"Alarm in {counted(danger.wishes, 'row')}: nobody acts here."
    first, call = danger.stepped_in, danger.called
    n = danger.wishes
    risky = f"of {n} wishes that were too risky" if n > 1 else "wish that was too risky"
    if first is not None:
        now = f". Now {frame.idle}" if frame.idle else ""
        return (
            f"The reviser stepped in at {clock(first.time, start)}, at first "
            f"{_instead(first.executed, first.proposed, start)}. "
            f"It changed {danger.revised} {risky}{now}."
        )
    if call is None:
        idle = f"{frame.idle}, and it" if frame.idle else "the reviser"
        return f"Nothing: {idle} knew nothing better."
    return (
        f"Nothing: {frame.idle}. From {clock(call.time, start)} on it would have changed "
        f"{danger.advised} {risky}, at first {_instead(call.advised, call.proposed, start)}."
    )


def _instead(better: Sequence[float], wished: Sequence[float], start: Start) -> str:
    return f"{_action(better, start)} instead of {_action(wished, start)}"


def _action(action: Sequence[float], start: Start) -> str:
    if not math.isfinite(action[0]):
        return "what is not known"
    if start.discrete:
        return action_name(int(action[0]))
    components = [float(f"{value:.2g}") for value in action[:_COMPONENTS]]
    text = action_text(components[0] if len(action) == 1 else components)
    text = text if len(action) <= _COMPONENTS else f"{text[:-1]}, ...)"
    return f"{text} m/s²" if start.cars else text


def _outcome(frame: Frame, start: Start) -> str:
    story, parts, when = frame.story, [], clock(frame.time, start)
    if not math.isnan(story.leader_brakes):
        since = clock(story.leader_brakes, start)
        parts.append(f"The leader braked from {since} on, by up to {story.leader_decel:.1f} m/s².")
    if frame.failed:
        parts.append(f"{start.fails or ('Collision' if start.cars else 'Failed')} at {when}.")
    elif frame.cars and frame.cars.rear_ended:
        parts.append(f"The car behind ran into the follower at {when}.")
    elif frame.over:
        parts.append(f"It ended at {when} without failure.")
    return " ".join(parts)


def _alone(frame: Frame, start: Start) -> str:
    alone = frame.story.alone
    as_alone = frame.failed and math.isclose(alone, frame.time)
    if not math.isfinite(alone) or as_alone or frame.time == 0.0:
        return ""
    fails = "would have failed" if frame.time >= alone else "would fail"
    return f"The controller alone {fails} at {clock(alone, start)}."


def clock(time: float, start: Start) -> str:
    """A time as the page writes it: 14.25 s becomes 14.3 s, or 04:03 by the clock."""
    if math.isfinite(start.began):
        then, now = (datetime.fromtimestamp(start.began + t, UTC) for t in (0.0, time))
        day = "%m-%d " if then.date() != now.date() else ""
        return f"{now:{day}%H:%M{':%S' if start.interval < 60.0 else ''}}"
    return f"{time:.2g} s" if time < 1.0 else f"{math.floor(10.0 * time + 0.5) / 10.0:.1f} s"

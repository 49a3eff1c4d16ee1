"""As numbers; ``live/words.py`` tells it in sentences: what has happened in a run so far.

When danger began, why, and what was done about it.
"""

from __future__ import annotations

import math

from evofsm.cli.watch.shown import Danger, Frame, Story

# Danger is over once the driver's wishes were tolerable for so long [s].
_CALM = 2.0
# A dead end: if the leader braked hard now, full braking would as likely as not be too late.
_DEAD_END = 0.5
# Actions that differ by less are the same, and softer braking is no full brake [m/s²].
_SAME, _LEADER_BRAKES = 0.05, -2.5


class Chronicle:
    """Writes the story of a run, frame by frame.

    Parameters
    ----------
    tolerance : float
        Highest risk that is accepted.
    thresholds : (float, float)
        Below which time to collision and time headway warn [s].
    alone : float
        When the driver collides if left alone [s]; infinite if it does not, NaN if not known.
    """

    def __init__(
        self, tolerance: float, thresholds: tuple[float, float], alone: float = math.nan
    ) -> None:
        self.tolerance = tolerance
        self.thresholds = thresholds
        self.story = Story(alone=alone)

    def tell(self, frame: Frame) -> Story:
        """The story with one more frame."""
        story = self._warnings(frame, self._leader(frame, self.story))
        story = story._replace(
            revised=story.revised + _is_revised(frame),
            judged=story.judged or not math.isnan(frame.proposed_risk.risk),
        )
        if frame.over:
            story = story._replace(ended=frame.time)
            if frame.collided:
                impact = frame.v_follower - frame.v_leader
                story = story._replace(collision=frame.time, impact=impact)
        else:
            story = self._danger(frame, story)
        self.story = story
        return story

    def _leader(self, frame: Frame, story: Story) -> Story:
        if not frame.a_leader <= _LEADER_BRAKES:
            return story
        if math.isnan(story.leader_brakes):
            story = story._replace(leader_brakes=frame.time, leader_decel=0.0)
        return story._replace(leader_decel=max(story.leader_decel, -frame.a_leader))

    def _warnings(self, frame: Frame, story: Story) -> Story:
        if frame.v_follower == 0.0:  # who stands hits nobody
            return story
        for_collision, for_headway = self.thresholds
        if math.isnan(story.time_to_collision) and frame.time_to_collision < for_collision:
            story = story._replace(time_to_collision=frame.time)
        if math.isnan(story.time_headway) and frame.time_headway < for_headway:
            story = story._replace(time_headway=frame.time)
        return story

    def _danger(self, frame: Frame, story: Story) -> Story:
        is_tolerable = not frame.proposed_risk.risk > self.tolerance
        danger = story.danger if story.in_danger else None
        if danger is None:
            if is_tolerable:
                return story
            danger = _began(frame)
            first = frame.time if math.isnan(story.first) else story.first
            story = story._replace(in_danger=True, first=first)
        elif is_tolerable and frame.time - danger.last >= _CALM:
            return story._replace(in_danger=False)
        return story._replace(danger=_went_on(danger, frame, is_tolerable))


def _began(frame: Frame) -> Danger:
    gap, speed, leader_speed = frame.observation
    return Danger(
        since=frame.time,
        gap=gap,
        speed=speed,
        closing=speed - leader_speed,
        risk=frame.proposed_risk.risk,
        critical=frame.critical,
        brakes_to=frame.brakes_to,
        decel=frame.decel,
        proposed=frame.proposed,
        advised=frame.advised,
        why=frame.why,
    )


def _is_revised(frame: Frame) -> bool:
    return abs(frame.executed - frame.proposed) > _SAME


def _went_on(danger: Danger, frame: Frame, is_tolerable: bool) -> Danger:
    revised = _is_revised(frame)
    if revised and danger.revised == 0:
        danger = danger._replace(
            stepped_in=frame.time, wished=frame.proposed, instead=frame.executed
        )
    dead_end = danger.dead_end
    if not frame.braking_risk > _DEAD_END:  # or it is not known
        dead_end = math.nan
    elif math.isnan(dead_end):
        dead_end = frame.time
    return danger._replace(
        decisions=danger.decisions + 1,
        revised=danger.revised + revised,
        change=danger.change + (abs(frame.executed - frame.proposed) if revised else 0.0),
        off=danger.off if frame.revising else frame.time,
        hardest=min(danger.hardest, frame.executed) if revised else danger.hardest,
        dead_end=dead_end,
        last=danger.last if is_tolerable else frame.time,
    )

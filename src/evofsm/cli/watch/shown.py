"""What is shown of a run: its start, a frame for every decision, its story, and the states."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import LatentRisk, assess_states
from evofsm.driving.measures import TimeHeadway, TimeToCollision
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.model import FSMModel
from evofsm.guard import LearningJudge

# The classic measures that are shown beside, with their thresholds.
_TTC, _HEADWAY = TimeToCollision(), TimeHeadway()

# So many states of a belief are shown, and none that is less probable.
_MOST_BELIEVED, _LEAST_BELIEF = 12, 0.002
# Of each state so many ways out are shown, and none that is rarer.
_MOST_WAYS, _LEAST_SHARE = 3, 0.02

# Danger is over once the driver's wishes were tolerable for so long [s].
_CALM = 2.0
# A dead end: if the leader braked hard now, full braking would as likely as not be too late.
_DEAD_END = 0.5
# Actions that differ by less are the same, and softer braking is no full brake [m/s²].
_SAME, _LEADER_BRAKES = 0.05, -2.5


class Danger(NamedTuple):
    """A stretch of time in which the driver's wishes were not tolerable."""

    began: Frame
    last: float  #: time of the latest decision that was not tolerable [s]
    stepped_in: Frame | None = None  #: in which the reviser first changed something
    revised: int = 0  #: decisions that the reviser changed
    change: float = 0.0  #: by how much, all of them together [m/s²]
    decisions: int = 0
    hardest: float = math.inf  #: lowest acceleration that the reviser put through [m/s²]
    dead_end: float = math.nan  #: since when full braking was too late as well [s]


class Story(NamedTuple):
    """What has happened so far; times are NaN where it has not."""

    danger: Danger | None = None  #: the present or the latest one
    in_danger: bool = False
    judged: bool = False  #: whether any wish of the driver was judged
    first: float = math.nan  #: when danger began for the first time [s]
    time_to_collision: float = math.nan  #: when it first fell below its threshold [s]
    time_headway: float = math.nan  #: the same of time headway [s]
    leader_brakes: float = math.nan  #: when the leader first braked hard [s]
    leader_decel: float = 0.0  #: how hard it has braked since, at most [m/s²]
    revised: int = 0  #: decisions that the reviser changed, in danger or not
    alone: float = math.nan  #: when the driver left alone collides [s]; infinite if it does not
    collision: float = math.nan  #: [s]


class Judged(NamedTuple):
    """Risk of an action, with its 90 % interval."""

    risk: float = math.nan
    low: float = math.nan
    high: float = math.nan


class Start(NamedTuple):
    """What is known as a run begins."""

    family: str
    about: str  #: what happens in the family, in a sentence
    cases: tuple[str, ...]  #: that can be chosen
    case: int  #: the one that is driven
    tolerance: float  #: highest risk that is accepted
    interval: float  #: time between decisions [s]
    actions: tuple[float, float]  #: lowest and highest acceleration [m/s²]
    learnt: int  #: episodes learnt from before
    judge: str  #: by what it was told, a name of `evofsm.driving.cars.TOLD`
    car_length: float = 5.0  #: as it is drawn; worlds need none [m]
    ttc_threshold: float = _TTC.threshold  #: time to collision below which it warns [s]
    headway_threshold: float = _HEADWAY.threshold  #: the same of time headway [s]
    shadow: bool = False  #: recorded by a guard that changed nothing
    begins: float = 0.0  #: what was before is shown at once [s]


class Frame(NamedTuple):
    """One decision: where the cars are, what was recognised, judged, proposed and executed.

    The last frame of a run shows how it ended: nothing is decided in it, and what was not is NaN.
    """

    number: int  #: in this run, from 0
    time: float  #: [s]
    gap: float  #: bumper to bumper, as it truly is [m]
    v_follower: float  #: [m/s]
    v_leader: float  #: [m/s]
    a_follower: float  #: what the body did until now [m/s²]; NaN at first
    a_leader: float  #: [m/s²]; NaN at first
    x_follower: float  #: front bumper, from where it started [m]
    observation: tuple[float, ...]  #: gap, v_follower, v_leader, as they were seen
    time_to_collision: float  #: [s]; infinite where the gap does not close
    time_headway: float  #: [s]
    revising: bool  #: whether the reviser may act
    gap_behind: float = math.inf  #: to the car behind [m]; infinite where there is none
    story: Story = Story()  #: what has happened so far
    decel: float = math.nan  #: of the follower if it brakes in full, as far as is known [m/s²]
    #: all but a tolerated share of leaders' hard brakes are softer [m/s²]
    brakes_to: float = math.nan
    #: the most probable states, and how probable they are
    belief: tuple[tuple[int, float], ...] = ()
    state: int | None = None  #: the most probable one
    event: str = ""  #: ``created``, ``moved``, or nothing
    proposed_risk: Judged = Judged()  #: of what the driver wants
    executed_risk: Judged = Judged()  #: of what is executed
    #: of full braking at once, or of the best that a learnt judge knows: high in a dead end
    braking_risk: float = math.nan
    #: hardest braking of the leader that is survived if the driver has its way [m/s²]
    critical: float = math.nan
    why: str = ""  #: why a learnt judge finds dangerous what the driver wants; empty of another
    proposed: float = math.nan  #: [m/s²]
    executed: float = math.nan  #: [m/s²]
    advised: float = math.nan  #: what the reviser would execute, on or off [m/s²]
    reason: str = ""  #: the reviser's
    explanation: str = ""  #: what the machine has seen of such situations
    collided: bool = False  #: with the leader
    rear_ended: bool = False  #: by the car behind
    over: bool = False  #: whether the run ended here

    @property
    def is_revised(self) -> bool:
        """Whether the reviser changed what the driver wanted."""
        return abs(self.executed - self.proposed) > _SAME


#: What a frame takes over from the record of a decision (`evofsm.guard.RECORD`), as it is.
RECORDED = ("state", "proposed", "executed", "advised", "reason", "explanation")


class StateShown(NamedTuple):
    """A state, as it is drawn."""

    state: int
    center: tuple[float, ...]  #: gap [m], v_follower [m/s], v_leader [m/s]
    visits: float
    is_dead_end: bool  #: or where that is not known, whether a collision ended in it


class Graph(NamedTuple):
    """The states found so far, and how one follows another."""

    number: int  #: of the frame from which on it holds
    states: tuple[StateShown, ...] = ()
    #: origin, target, and the share of all changes out of the origin
    transitions: tuple[tuple[int, int, float], ...] = ()


def graph_of(
    known: EvolvingFSM | FSMModel, judge: LearningJudge | None = None, number: int = 0
) -> Graph:
    """The states, and their usual ways out, from a frame on.

    Only a `LatentRisk` says which are dead ends; else those are marked in which a collision ended.
    """
    marked = [ended > 0.0 for ended in known.endings.tolist()]
    if isinstance(judge, LatentRisk):
        marked = [one.is_dead_end for one in assess_states(known, judge)]
    places = map(tuple, known.centers.tolist())
    states = map(StateShown, range(known.n_states), places, known.visits.tolist(), marked)
    changes = known.changes * ~np.eye(known.n_states, dtype=bool)
    shares = changes / np.maximum(changes.sum(axis=1, keepdims=True), 1.0)
    usual = np.argsort(-shares, axis=1, kind="stable")[:, :_MOST_WAYS]
    ways = ((i, j, float(shares[i, j])) for i, row in enumerate(usual.tolist()) for j in row)
    return Graph(number, tuple(states), tuple(way for way in ways if way[2] >= _LEAST_SHARE))


def most_believed(belief: NDArray[np.float64]) -> tuple[tuple[int, float], ...]:
    """The most probable states, and how probable they are."""
    most = np.argsort(-belief, kind="stable")[:_MOST_BELIEVED].tolist()
    return tuple((k, float(belief[k])) for k in most if belief[k] >= _LEAST_BELIEF)


# -- The story ------------------------------------------------------------------------------------


class Chronicle:
    """Writes the story of a run, frame by frame: when danger began, and what was done about it.

    ``alone`` is when the driver collides if left to itself [s].
    """

    def __init__(self, tolerance: float, alone: float = math.nan) -> None:
        self.tolerance = tolerance
        self.story = Story(alone=alone)

    def tell(self, frame: Frame) -> Story:
        """The story with one more frame."""
        story, moves = self.story, frame.v_follower > 0.0  # who stands hits nobody
        brakes = frame.a_leader <= _LEADER_BRAKES

        def first(at: float, holds: bool) -> float:
            return frame.time if math.isnan(at) and holds else at

        warns, near = frame.time_to_collision < _TTC.threshold, _HEADWAY.threshold
        story = story._replace(
            judged=story.judged or not math.isnan(frame.proposed_risk.risk),
            time_to_collision=first(story.time_to_collision, moves and warns),
            time_headway=first(story.time_headway, moves and frame.time_headway < near),
            leader_brakes=first(story.leader_brakes, brakes),
            leader_decel=max(story.leader_decel, -frame.a_leader if brakes else 0.0),
            revised=story.revised + frame.is_revised,
            collision=first(story.collision, frame.collided),
        )
        self.story = story if frame.over else self._danger(frame, story)
        return self.story

    def _danger(self, frame: Frame, story: Story) -> Story:
        is_tolerable = not frame.proposed_risk.risk > self.tolerance
        danger = story.danger if story.in_danger else None
        if danger is None:
            if is_tolerable:
                return story
            danger = Danger(frame, frame.time)
            first = frame.time if math.isnan(story.first) else story.first
            story = story._replace(in_danger=True, first=first)
        elif is_tolerable and frame.time - danger.last >= _CALM:
            return story._replace(in_danger=False)
        return story._replace(danger=_went_on(danger, frame, is_tolerable))


def _went_on(danger: Danger, frame: Frame, is_tolerable: bool) -> Danger:
    if frame.is_revised:
        danger = danger._replace(
            stepped_in=danger.stepped_in or frame,
            revised=danger.revised + 1,
            change=danger.change + abs(frame.executed - frame.proposed),
            hardest=min(danger.hardest, frame.executed),
        )
    dead_end = math.nan  # where it is over, or not known
    if frame.braking_risk > _DEAD_END:
        dead_end = frame.time if math.isnan(danger.dead_end) else danger.dead_end
    return danger._replace(
        last=danger.last if is_tolerable else frame.time,
        decisions=danger.decisions + 1,
        dead_end=dead_end,
    )

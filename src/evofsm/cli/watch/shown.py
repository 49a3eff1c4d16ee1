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

#: What is drawn of a car; worlds need no length [m].
CAR_LENGTH = 5.0
#: The classic measures that are shown beside, with their thresholds.
TTC, HEADWAY = TimeToCollision(), TimeHeadway()

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

    since: float  #: [s]
    gap: float  #: then [m]
    speed: float  #: the follower's, then [m/s]
    closing: float  #: the follower's speed less the leader's, then [m/s]
    risk: float  #: of what the driver then wanted
    #: hardest braking of the leader that was then survived [m/s²]; NaN, as the next two, where the
    #: judge knows no leaders
    critical: float
    brakes_to: float  #: how hard leaders were then known to brake [m/s²]
    decel: float  #: how hard the follower was then known to brake in full [m/s²]
    proposed: float  #: what the driver then wanted [m/s²]
    advised: float  #: what the reviser then found better [m/s²]
    why: str = ""  #: what a judge then said that knows no leaders
    stepped_in: float = math.nan  #: when the reviser first changed something in it [s]
    wished: float = math.nan  #: what the driver wanted then [m/s²]
    instead: float = math.nan  #: and what was executed [m/s²]
    revised: int = 0  #: decisions in it that the reviser changed
    change: float = 0.0  #: by how much, all of them together [m/s²]
    off: float = math.nan  #: time of the latest decision in it with the reviser off [s]
    decisions: int = 0  #: decisions in it
    hardest: float = math.inf  #: lowest acceleration that the reviser put through in it [m/s²]
    dead_end: float = math.nan  #: since when full braking was too late as well [s]
    last: float = math.nan  #: time of the latest decision that was not tolerable [s]


class Story(NamedTuple):
    """What has happened so far; times are NaN where it has not."""

    danger: Danger | None = None  #: the present or the latest one
    in_danger: bool = False
    judged: bool = False  #: whether any wish of the driver was judged
    first: float = math.nan  #: when danger began for the first time [s]
    time_to_collision: float = math.nan  #: when it first fell below its threshold [s]
    time_headway: float = math.nan  #: the same of time headway [s]
    leader_brakes: float = math.nan  #: when the leader first braked hard [s]
    leader_decel: float = math.nan  #: how hard it has braked since, at most [m/s²]
    revised: int = 0  #: decisions that the reviser changed, in danger or not
    alone: float = math.nan  #: when the driver left alone collides [s]; infinite if it does not
    collision: float = math.nan  #: [s]
    impact: float = math.nan  #: speed at which the cars met [m/s]
    ended: float = math.nan  #: [s]


class Judged(NamedTuple):
    """Risk of an action, with its 90 % interval."""

    risk: float
    low: float
    high: float


#: Where nothing is judged.
UNJUDGED = Judged(math.nan, math.nan, math.nan)


class Start(NamedTuple):
    """What is known as a run begins."""

    family: str
    about: str  #: what happens in the family, in a sentence
    cases: tuple[str, ...]  #: that can be chosen
    case: int  #: the one that is driven
    world: str
    controller: str
    reviser: str
    tolerance: float  #: highest risk that is accepted
    interval: float  #: time between decisions [s]
    duration: float  #: time that is driven at most [s]
    actions: tuple[float, float]  #: lowest and highest acceleration [m/s²]
    car_length: float  #: [m]
    ttc_threshold: float  #: time to collision below which it is said to warn [s]
    headway_threshold: float  #: the same of time headway [s]
    learnt: int  #: episodes learnt from before
    judge: str = "kinematic"  #: by what it was told, a name of `evofsm.driving.cars.TOLD`


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
    gap_behind: float  #: to the car behind [m]; infinite where there is none
    observation: tuple[float, ...]  #: gap, v_follower, v_leader, as they were seen
    n_states: int
    time_to_collision: float  #: [s]; infinite where the gap does not close
    time_headway: float  #: [s]
    revising: bool  #: whether the reviser may act
    story: Story  #: what has happened so far
    decel: float = math.nan  #: of the follower if it brakes in full, as far as is known [m/s²]
    #: all but a tolerated share of leaders' hard brakes are softer [m/s²]
    brakes_to: float = math.nan
    #: the most probable states, and how probable they are
    belief: tuple[tuple[int, float], ...] = ()
    state: int | None = None  #: the most probable one
    event: str = ""  #: ``created``, ``moved``, or nothing
    surprise: float = math.nan  #: [bit]
    proposed_risk: Judged = UNJUDGED  #: of what the driver wants
    executed_risk: Judged = UNJUDGED  #: of what is executed
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


#: What a frame takes over from the record of a decision (`evofsm.guard.RECORD`), as it is.
RECORDED = ("state", "surprise", "proposed", "executed", "advised", "reason", "explanation")


class StateShown(NamedTuple):
    """A state, as it is drawn."""

    state: int
    center: tuple[float, ...]  #: gap [m], v_follower [m/s], v_leader [m/s]
    visits: float
    risk: float  #: latent risk if one brakes in full at once; NaN where it is not known
    is_dead_end: bool  #: or where that is not known, whether a collision ended in it
    failures: float  #: collisions that ended in it


class Transition(NamedTuple):
    """From a state to another."""

    origin: int
    target: int
    share: float  #: of all changes out of the origin


class Graph(NamedTuple):
    """The states found so far, and how one follows another."""

    number: int  #: of the frame from which on it holds
    states: tuple[StateShown, ...]
    transitions: tuple[Transition, ...]


def graph_of(
    known: EvolvingFSM | FSMModel, judge: LearningJudge | None = None, number: int = 0
) -> Graph:
    """The states, and their usual ways out, from a frame on.

    Only a `LatentRisk` says which are dead ends; else those are marked in which a collision ended.
    """
    places, visits, ways = known.centers.tolist(), known.visits.tolist(), tuple(_usual_ways(known))
    if isinstance(judge, LatentRisk):
        found = [(one.risk, one.is_dead_end, one.failures) for one in assess_states(known, judge)]
    else:
        found = [(math.nan, ended > 0.0, ended) for ended in known.endings.tolist()]
    states = enumerate(zip(places, visits, found, strict=True))
    shown = (StateShown(k, tuple(place), seen, *how) for k, (place, seen, how) in states)
    return Graph(number, tuple(shown), ways)


def _usual_ways(known: EvolvingFSM | FSMModel) -> list[Transition]:
    """How one state follows another, of each state the most usual ways."""
    changes = known.changes * ~np.eye(known.n_states, dtype=bool)
    ways = []
    for origin, row in enumerate(changes):
        if not row.any():
            continue
        shares = row / row.sum()
        for target in np.argsort(-shares, kind="stable")[:_MOST_WAYS].tolist():
            if shares[target] >= _LEAST_SHARE:
                ways.append(Transition(origin, target, float(shares[target])))
    return ways


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
        if math.isnan(story.time_to_collision) and frame.time_to_collision < TTC.threshold:
            story = story._replace(time_to_collision=frame.time)
        if math.isnan(story.time_headway) and frame.time_headway < HEADWAY.threshold:
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

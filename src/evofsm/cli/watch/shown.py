"""What is shown of a run: its start, a frame for every decision, its story, and the states."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import LatentRisk, dead_ends_of
from evofsm.driving.measures import TimeHeadway, TimeToCollision, time_headway, time_to_collision
from evofsm.fsm.machine import EvolvingFSM
from evofsm.guard import Foresight, LearningJudge, LearntRisk
from evofsm.guard.learnt.failure import SAYS, SIZE, B, I, J, are_sides, inside, telling
from evofsm.guard.learnt.rollout import FAILS
from evofsm.guard.learnt.state import State
from evofsm.guard.learnt.words import harm

# The classic measures that are shown beside, with their thresholds.
_TTC, _HEADWAY = TimeToCollision(), TimeHeadway()

# Of each state so many ways out are shown, and none that is rarer.
_MOST_WAYS, _LEAST_SHARE = 3, 0.02

_MOST_SURVIVED = 500  # observations of what was survived that are shown

#: What is observed of cars.
OF_CARS = ("gap [m]", "follower's speed [m/s]", "leader's speed [m/s]")
CALM = 2.0  #: danger is over once wishes were tolerable for so long [s]
_DEAD_END = 0.5  # a dead end: the best that can be done would as likely as not be too late
_LEADER_BRAKES = -2.5  # softer braking is no full brake [m/s²]


class Danger(NamedTuple):
    """A stretch of time in which the controller's wishes were not tolerable."""

    began: Frame
    last: float  #: time of the latest wish that was not tolerable [s]
    wishes: int = 0  #: that were not tolerable
    revised: int = 0  #: of them, those that the reviser changed
    advised: int = 0  #: of them, those that it changed, or would have
    stepped_in: Frame | None = None  #: in which it first changed one
    called: Frame | None = None  #: in which it first did, or would have
    dead_end: float = math.nan  #: since when nothing would have been enough [s]


class Story(NamedTuple):
    """What has happened so far; times are NaN where it has not."""

    danger: Danger | None = None  #: the present or the latest one
    in_danger: bool = False
    judged: bool = False  #: whether any wish of the controller was judged
    first: float = math.nan  #: when danger began for the first time [s]
    time_to_collision: float = math.nan  #: when it first fell below its threshold [s]
    time_headway: float = math.nan  #: the same of time headway [s]
    leader_brakes: float = math.nan  #: when the leader first braked hard [s]
    leader_decel: float = 0.0  #: how hard it has braked since, at most [m/s²]
    revised: int = 0  #: decisions that the reviser changed, in danger or not
    advised: int = 0  #: decisions that it changed, or would have
    alone: float = math.nan  #: when the controller alone fails [s]; infinite if it does not
    failure: float = math.nan  #: [s]


class Judged(NamedTuple):
    """Risk of an action, with its 90 % interval."""

    risk: float = math.nan
    low: float = math.nan
    high: float = math.nan
    #: Hardest disturbance that is survived: braking of the leader [m/s²]; of a learnt judge what
    #: the best backup leaves of the distance to failure [typical steps].
    critical: float = math.nan


class Start(NamedTuple):
    """What is known as a run begins."""

    system: str
    about: str  #: what happens in it, in a sentence
    cases: tuple[str, ...]  #: that can be chosen
    case: int  #: the one that is driven
    tolerance: float  #: highest risk that is accepted
    interval: float  #: time between decisions [s]
    names: tuple[str, ...]  #: of the variables, with their units
    low: tuple[float, ...]  #: of the components of an action
    high: tuple[float, ...]
    judge: str  #: by what it was told, a name of `evofsm.driving.cars.TOLD`
    learnt: int = 0  #: episodes learnt from before
    live: bool = True  #: whether it is driven now; a log only is looked on at
    fails: str = ""  #: who says that it failed, where a record does
    discrete: bool = False  #: whether an action is an index
    cars: bool = True  #: whether they are cars
    car_length: float = 5.0  #: as it is drawn; worlds need none [m]
    ttc_threshold: float = _TTC.threshold  #: time to collision below which it warns [s]
    headway_threshold: float = _HEADWAY.threshold  #: the same of time headway [s]
    begins: float = 0.0  #: what was before is shown at once [s]
    began: float = math.nan  #: the clock at time 0; NaN where times are told in seconds [s]
    ranges: tuple[tuple[float, float], ...] = ()  #: of variables, without what is far from it all
    acts: bool = True  #: whether somebody acts; else risk is how often such alarms were right
    speeds: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  #: multiples of real time


class Cars(NamedTuple):
    """Where a car and its leader are."""

    gap: float  #: bumper to bumper, as it truly is [m]
    v_follower: float  #: [m/s]
    v_leader: float  #: [m/s]
    a_follower: float  #: since the time before, on average [m/s²]; NaN at first
    a_leader: float  #: [m/s²]; NaN at first
    x_follower: float  #: front bumper, from where it started [m]
    time_to_collision: float  #: [s]; infinite where the gap does not close
    time_headway: float  #: [s]
    gap_behind: float = math.inf  #: to the car behind [m]; infinite where there is none
    rear_ended: bool = False  #: by the car behind


def cars_of(times: NDArray[np.float64], observed: NDArray[np.float64]) -> Iterator[Cars]:
    """Where cars were at each time [s] of a record, and how they got there, by the variables."""
    durations, speeds = np.diff(times, prepend=math.nan), observed[:, 1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        accelerations = np.diff(speeds, axis=0, prepend=math.nan) / durations[:, None]
    distances = 0.5 * (speeds[1:, 0] + speeds[:-1, 0]) * durations[1:]
    positions = np.insert(np.cumsum(distances), 0, 0.0)
    rows = np.column_stack([observed, accelerations, positions]).tolist()
    for gap, follower, leader, a_follower, a_leader, x in rows:
        observation = np.array([gap, follower, leader])
        measures = float(time_to_collision(observation)), float(time_headway(observation))
        yield Cars(gap, follower, leader, a_follower, a_leader, x, *measures)


class Frame(NamedTuple):
    """One decision: what was seen, recognised, judged, proposed and executed.

    The last frame of a run shows how it ended: nothing is decided in it, and what was not is NaN.
    """

    number: int  #: in this run, from 0
    time: float  #: [s]
    observation: tuple[float, ...]
    here: str  #: the same in words
    idle: str = ""  #: why the reviser does not act; empty where it does
    cars: Cars | None = None  #: where they are, if it is cars
    story: Story = Story()  #: what has happened so far
    state: int | None = None  #: the most probable one
    proposed_risk: Judged = Judged()  #: of what the controller wants
    executed_risk: Judged = Judged()  #: of what is executed
    #: of full braking at once, or of the best that a learnt judge knows: high in a dead end
    least_risk: float = math.nan
    #: what `Judged.critical` has to be; of leaders' hard brakes but a tolerated share are softer
    needed: float = math.nan
    usual: float = math.nan  #: and half of them [m/s²]
    why: str = ""  #: why what is proposed is found dangerous; empty where it is not
    proposed: tuple[float, ...] = ()
    executed: tuple[float, ...] = ()
    advised: tuple[float, ...] = ()  #: what the reviser would execute, on or off
    revised: bool = False  #: whether the reviser changed what was proposed
    advises: bool = False  #: or would have
    reason: str = ""  #: the reviser's
    explanation: str = ""  #: what the machine has seen of such situations
    failed: bool = False  #: whether the run ended here in failure
    novel: str = ""  #: what was learnt, if no failure of this kind was known before
    over: bool = False  #: whether it ended here


class StateShown(NamedTuple):
    """A state, as it is drawn."""

    state: int
    center: tuple[float, ...]
    visits: float
    is_dead_end: bool  #: or where that is not known, whether a failure ended in it


class Graph(NamedTuple):
    """The states found so far, and how one follows another."""

    number: int  #: of the frame from which on it holds
    states: tuple[StateShown, ...] = ()
    #: origin, target, and the share of all changes out of the origin
    transitions: tuple[tuple[int, int, float], ...] = ()


def graph_of(known: EvolvingFSM, judge: LearningJudge | None = None, number: int = 0) -> Graph:
    """The states, and their usual ways out; dead ends are marked, or where failures ended."""
    marks = [count > 0.5 for count in known.endings.tolist()]
    if isinstance(judge, LatentRisk):
        dead_ends = dead_ends_of(known, judge)
        marks = [state in dead_ends for state in range(known.n_states)]
    columns = map(tuple, known.centers.tolist()), known.visits.tolist(), marks
    states = map(StateShown, range(known.n_states), *columns)
    changes = known.changes * ~np.eye(known.n_states, dtype=bool)
    shares = changes / np.maximum(changes.sum(axis=1, keepdims=True), 1.0)
    usual = np.argsort(-shares, axis=1, kind="stable")[:, :_MOST_WAYS]
    ways = ((i, j, float(shares[i, j])) for i, row in enumerate(usual.tolist()) for j in row)
    return Graph(number, tuple(states), tuple(way for way in ways if way[2] >= _LEAST_SHARE))


def numbers(action: Any) -> tuple[float, ...]:
    """An action's components; one where it is a number."""
    return tuple(np.atleast_1d(np.asarray(action, np.float64)).tolist())


# -- What is known of failure ---------------------------------------------------------------------


class Known(NamedTuple):
    """What a judge has learnt of failure, for a plane of two variables; rows of numbers."""

    plane: tuple[int, int] = (0, 1)  #: the two that matter
    survived: Any = ()  #: (n, m) observations, a few of them
    failed: Any = ()  #: (k, m)
    forms: Any = ()  #: (r, 14) where it fails, as in `evofsm.guard.learnt.failure`, or alarms
    dead_ends: Any = ()  #: (d, m) centres
    radii: Any = ()  #: (d, m) in each variable
    told: str = ""  #: in words
    harm: str = ""  #: whether it does harm, in words; empty where it does not
    limits: Any = ()  #: variables, and values at which they alarm


def known_of(judge: LearningJudge) -> Known:
    """What a judge knows that learns of failure; nothing of another."""
    if isinstance(judge, Foresight):
        knowledge, rate = Known(told=judge.told_by_experience), judge.alarm
        if rate is None:
            return knowledge
        table, m = judge.where(rate), len(judge.labels.names)
        first, second, *_ = [*dict.fromkeys([*telling(table), *range(m)]), 0]
        knowledge = knowledge._replace(forms=table.tolist(), limits=judge.thresholds(rate))
        return knowledge._replace(plane=(first, second))
    if not isinstance(judge, LearntRisk) or not judge.n_variables:
        return Known()
    learnt, survivals = judge.state, judge.state.survived
    text = harm(judge.harm, learning=judge.learning).removeprefix("; ")
    fails = learnt.forms[learnt.forms[:, SAYS] == FAILS]
    spread = survivals.std(0) if len(survivals) else np.zeros(judge.n_variables)
    return Known(
        _plane(learnt, fails),
        survivals[:: 1 + len(survivals) // _MOST_SURVIVED].tolist(),
        learnt.failures.tolist(),
        fails.tolist(),
        learnt.centres.tolist(),
        (learnt.radii[:, None] * spread).tolist(),
        judge.told_by_experience,
        text,
    )


def first_of_its_kind(seen: Sequence[float], before: Known, after: Known) -> str:
    """What was learnt of a failure there, if nothing told of such failures before; else nothing."""
    now, kinds = _kinds(after, seen), _kinds(before)
    return "" if not now or now & kinds or _kinds(before, seen) else after.told.partition(";")[0]


def _kinds(known: Known, seen: Sequence[float] | None = None) -> set[tuple[float, float]]:
    """Sides of variables, and pairs of them, that tell of failures; or of one that was seen."""
    forms = np.array(known.forms, np.float64).reshape(-1, SIZE)
    if seen is not None:
        forms = forms[inside(forms, np.array([seen]))[:, 0]]
    columns = np.where(are_sides(forms)[:, None], forms[:, [I, B]], forms[:, [I, J]])
    return {(i, j) for i, j in columns.tolist()}


def _plane(learnt: State, fails: Any) -> tuple[int, int]:
    """Variables by which it fails, then those that differ most where it failed."""
    order = telling(fails)
    if len(learnt.failures) and len(learnt.survived):
        apart = np.abs(learnt.failures.mean(0) - learnt.survived.mean(0))
        order += np.argsort(-apart / (learnt.survived.std(0) + 1e-9), kind="stable").tolist()
    first, second, *_ = [*dict.fromkeys([*order, *range(len(learnt.origin))]), 0]
    return first, second


# -- The story ------------------------------------------------------------------------------------


def go_on(story: Story, frame: Frame, tolerance: float, calm: float) -> Story:
    """The story with one more frame; danger ends once wishes were tolerable for a ``calm`` [s]."""
    if frame.cars is not None:
        story = _on_the_road(story, frame, frame.cars)
    story = story._replace(
        judged=story.judged or not math.isnan(frame.proposed_risk.risk),
        revised=story.revised + frame.revised,
        advised=story.advised + frame.advises,
        failure=frame.time if frame.failed else math.nan,
    )
    is_tolerable = not frame.proposed_risk.risk > tolerance
    danger = story.danger if story.in_danger else None
    if frame.over or (danger is None and is_tolerable):
        return story
    if danger is None:
        danger = Danger(frame, frame.time)
        first = frame.time if math.isnan(story.first) else story.first
        story = story._replace(in_danger=True, first=first)
    elif is_tolerable and frame.time - danger.last >= calm:
        return story._replace(in_danger=False)
    return story._replace(danger=_went_on(danger, frame, is_tolerable))


def _on_the_road(story: Story, frame: Frame, cars: Cars) -> Story:
    """What classic measures noticed, and what the leader did."""
    moves = cars.v_follower > 0.0  # who stands hits nobody
    brakes, near = cars.a_leader <= _LEADER_BRAKES, _HEADWAY.threshold

    def first(at: float, holds: bool) -> float:
        return frame.time if math.isnan(at) and holds else at

    warns = cars.time_to_collision < _TTC.threshold
    return story._replace(
        time_to_collision=first(story.time_to_collision, moves and warns),
        time_headway=first(story.time_headway, moves and cars.time_headway < near),
        leader_brakes=first(story.leader_brakes, brakes),
        leader_decel=max(story.leader_decel, -cars.a_leader if brakes else 0.0),
    )


def _went_on(danger: Danger, frame: Frame, is_tolerable: bool) -> Danger:
    dead_end = math.nan  # where it is over, or not known
    if frame.least_risk > _DEAD_END:
        dead_end = frame.time if math.isnan(danger.dead_end) else danger.dead_end
    danger = danger._replace(dead_end=dead_end)
    if is_tolerable:
        return danger
    if frame.revised:
        danger = danger._replace(stepped_in=danger.stepped_in or frame)
    return danger._replace(
        last=frame.time,
        wishes=danger.wishes + 1,
        revised=danger.revised + frame.revised,
        advised=danger.advised + frame.advises,
        called=danger.called or (frame if frame.advises else None),
    )

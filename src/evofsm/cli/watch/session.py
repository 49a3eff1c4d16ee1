"""Drives a family decision by decision and shows every one; what it learns is kept."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from evofsm.cli.driving import Setup, make_controller, make_guard
from evofsm.cli.watch.chronicle import Chronicle
from evofsm.cli.watch.shown import (
    CAR_LENGTH,
    HEADWAY,
    RECORDED,
    TTC,
    Frame,
    Graph,
    Judged,
    Start,
    graph_of,
    most_believed,
)
from evofsm.driving import (
    GAP,
    GAP_BEHIND,
    LEADER_ACCELERATION,
    LEADER_SPEED,
    SPEED,
    Draw,
    Family,
    LatentRisk,
    World,
    drive,
    guard_for_family,
    learners_of,
    teach,
    unrevised_guard,
)
from evofsm.driving.measures import time_headway, time_to_collision
from evofsm.fsm import IntervalActions, Novelty
from evofsm.guard import (
    RECORD,
    TOLERANCE,
    ActionJudge,
    Explain,
    Guard,
    Judgement,
    Pair,
    Proposal,
    Reviser,
    Revision,
    Situation,
    make_usable,
)

#: The state rule for looking on: coarse enough that each state can be told from the others.
WATCHED_RULE = Novelty(radius=2.0, scales=(4.0, 2.0, 2.0))

# So many draws can be chosen among where a family has no cases.
_DRAWS = 12
# After a leader's full brake there is nothing left to see once all have stood for so long [s].
_STANDING = 3.0


@dataclass(frozen=True)
class Watching:
    """What is to be watched.

    Parameters
    ----------
    family : Family
    world : str
        One of `evofsm.driving.WORLDS`.
    case : int
        Which one of the family's cases, or of its draws, from 0.
    controller, reviser : str
        By name, as `evofsm.cli.driving` knows them. Without a reviser (``none``) ours judges
        and is off.
    tolerance : float
        Highest risk that is accepted.
    seed : int
        Of the draws.
    judge : str
        A name of `evofsm.driving.TOLD`, which says what it was told.
    """

    family: Family
    world: str = "kinematic"
    case: int = 0
    controller: str = "family"
    reviser: str = "least-risk"
    tolerance: float = TOLERANCE
    seed: int = 0
    judge: str = "kinematic"

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of what can be driven."""
        if self.family.cases > 1:
            return self.family.variants
        return tuple(f"draw {number}" for number in range(1, _DRAWS + 1))

    @property
    def setup(self) -> Setup:
        """The same for `evofsm.cli.driving`."""
        reviser = "least-risk" if self.reviser == "none" else self.reviser
        return Setup(
            self.family,
            self.controller,
            reviser,
            self.judge,
            tolerance=self.tolerance,
            seed=self.seed,
        )


def watched_guard(family: Family, judge: str = "kinematic") -> Guard:
    """A guard that has seen nothing, with few enough states to look at; its judge by name."""
    return guard_for_family(family, rule=WATCHED_RULE, judge=judge)


def learn_first(
    watching: Watching,
    guard: Guard,
    episodes: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Drive the family for a while, in closed form and under our reviser, to learn from it.

    Parameters
    ----------
    watching : Watching
        Of whose family.
    guard : Guard
        What learns.
    episodes : int
    progress : callable
        Told how many episodes are done, of how many.
    """
    machine, judge = learners_of(guard)
    teacher = guard_for_family(
        watching.family, tolerance=watching.tolerance, machine=machine, judge=judge
    )
    for index in range(episodes):
        teach(teacher, [watching.family.draw(watching.seed + 1, index)])  # none that is watched
        progress(index + 1, episodes)


class Switchable:
    """A reviser that can be switched off and on while driving; off, it still says what it would do.

    Parameters
    ----------
    reviser : Reviser
    actions : IntervalActions
    judge : ActionJudge
        Judges what is wanted, what is executed, and full braking, whoever revises; one that knows
        no leaders, instead of full braking, what is advised.
    on : bool

    Examples
    --------
    >>> import numpy as np
    >>> from evofsm.driving import AlwaysBrake
    >>> actions = IntervalActions(low=-2.5, high=2.5, width=0.3)
    >>> reviser = Switchable(AlwaysBrake(actions), actions, LatentRisk(lowest=-2.5), on=False)
    >>> here = Situation(np.array([5.0, 20.0, 10.0]), np.ones(1), 0, 0.0, 0.0)
    >>> revision = reviser.revise(here, Proposal(1.0))
    >>> revision.executed, revision.advised, reviser.judged.risk
    (1.0, -2.5, array([1., 1., 1.]))
    """

    def __init__(
        self, reviser: Reviser, actions: IntervalActions, judge: ActionJudge, on: bool = True
    ) -> None:
        self.reviser = reviser
        self.actions = actions
        self.judge = judge
        self.on = on
        self.judged: Judgement | None = None  #: of the latest decision

    def start_episode(self) -> None:
        """Forget what was under way."""
        self.reviser.start_episode()

    def revise(self, situation: Situation, proposal: Proposal) -> Revision:
        """What the reviser decides; where it is off the proposal, if that can be executed."""
        revision = self.reviser.revise(situation, proposal)
        wanted = make_usable(proposal, self.actions).action
        if not self.on:
            revision = revision._replace(executed=wanted, advised=revision.executed)
        safest = self.actions.low if isinstance(self.judge, LatentRisk) else revision.advised
        options = np.array([wanted, revision.executed, safest])
        self.judged = self.judge.judge(situation, options)
        return revision


class Session:
    """One run after another, each driven decision by decision.

    Parameters
    ----------
    watching : Watching
    guard : Guard
        Its machine and its judge go on learning.
    world : World
    learnt : int
        Episodes that it has learnt from before.

    Examples
    --------
    >>> from evofsm.driving import KinematicWorld, load_family
    >>> watching = Watching(load_family("paper"), reviser="none")
    >>> with Session(watching, watched_guard(watching.family), KinematicWorld()) as session:
    ...     while not (frame := session.step()).over:
    ...         pass
    >>> frame.collided, frame.time
    (True, 31.4)
    """

    def __init__(self, watching: Watching, guard: Guard, world: World, learnt: int = 0) -> None:
        self.watching = watching
        self.machine, self.judge = learners_of(guard)
        self.world = world
        self.learnt = learnt
        self.case = watching.case
        family = watching.family
        ours = make_guard(watching.setup, self.machine, self.judge).reviser
        self._reviser = Switchable(ours, family.actions, self.judge, watching.reviser != "none")
        self._guard = Guard.of(
            self._reviser,
            interval=family.interval,
            machine=self.machine,
            judge=self.judge,
            explaining=Explain.ALL,
        )
        self._closing = ExitStack()
        self.start = self.restart()

    @property
    def revising(self) -> bool:
        """Whether the reviser may act; it can be set at any time."""
        return self._reviser.on

    @revising.setter
    def revising(self, on: bool) -> None:
        self._reviser.on = on

    def restart(self, case: int | None = None) -> Start:
        """Begin a run anew, or another one; one that is under way is broken off.

        Raises
        ------
        ValueError
            If there is no such case.
        """
        watching, family = self.watching, self.watching.family
        case = self.case if case is None else case
        if not 0 <= case < len(watching.cases):
            raise ValueError(f"case is {case + 1}; there are 1 to {len(watching.cases)}")
        self._closing.close()
        self.case = case
        draw = family.draw(watching.seed, case)
        self._controller = make_controller(watching.setup, draw, self.world)
        self._road = self._closing.enter_context(self.world.open(draw.scenario))
        self._steps = draw.scenario.steps(family.interval)
        self._guard.begin()
        self._chronicle = Chronicle(
            watching.tolerance, (TTC.threshold, HEADWAY.threshold), self._alone(draw)
        )
        self._number, self._row, self._position = 0, 0, 0.0
        self._state: int | None = None
        self._stood = 0.0
        self._over = False
        self.start = self._start(draw)
        return self.start

    def step(self) -> Frame:
        """One decision, and what came of the one before.

        Raises
        ------
        RuntimeError
            If the run is over.
        """
        if self._over:
            raise RuntimeError("the run is over; restart it")
        ends = self._road.over or self._stood >= _STANDING
        frame = self._end() if ends else self._decide()
        frame = frame._replace(story=self._chronicle.tell(frame))
        self._number += 1
        if not frame.over:
            stands = max(frame.v_follower, frame.v_leader) == 0.0 and frame.a_leader < 0.0
            self._stood = self._stood + self.watching.family.interval if stands else 0.0
            self._road.advance(frame.executed, self._steps)
        return frame

    def graph(self) -> Graph:
        """The states found so far."""
        return graph_of(self.machine, self.judge, self._number)

    def close(self) -> None:
        """Leave the road."""
        self._closing.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _start(self, draw: Draw) -> Start:
        watching, family = self.watching, self.watching.family
        return Start(
            family=family.name,
            about=family.about,
            cases=watching.cases,
            case=self.case,
            world=watching.world,
            controller=watching.controller,
            reviser=watching.setup.reviser,
            tolerance=watching.tolerance,
            interval=family.interval,
            duration=draw.scenario.duration,
            actions=(family.actions.low, family.actions.high),
            car_length=CAR_LENGTH,
            ttc_threshold=TTC.threshold,
            headway_threshold=HEADWAY.threshold,
            learnt=self.learnt,
            judge=watching.judge,
        )

    def _alone(self, draw: Draw) -> float:
        """When the driver collides if left to itself [s]; infinite if it does not."""
        if self.watching.controller == "sumo":  # which drives in SUMO only, where a run is open
            return math.nan
        controller = make_controller(self.watching.setup, draw, self.world)
        episode = drive(unrevised_guard(self.watching.family), draw, controller=controller)
        return float(episode.time[-1]) if episode.collided else math.inf

    def _decide(self) -> Frame:
        road, guard, known = self._road, self._guard, self.machine.n_states
        situation = guard.recognise(road.observation, road.time)
        revision = guard.revise(situation, self._controller.propose(guard.held, road.time))
        judged = self._reviser.judged
        assert judged is not None
        wanted, does, safest = range(3)
        frame = self._seen()._replace(
            **{name: RECORD[name].read(Pair(situation, revision)) for name in RECORDED},
            belief=most_believed(situation.belief),
            event=self._event(situation.state, self.machine.n_states > known),
            proposed_risk=_judged(judged, wanted),
            executed_risk=_judged(judged, does),
            braking_risk=float(judged.risk[safest]),
            **self._said(judged),
        )
        self._state = situation.state
        return frame

    def _said(self, judged: Judgement) -> dict[str, Any]:
        """What only one kind of judge says of what the driver wants."""
        if isinstance(self.judge, LatentRisk):
            return {"critical": float(judged.critical[0])}
        risky = judged.risk[0] > self.watching.tolerance
        return {"why": self.judge.why(judged) if risky else ""}

    def _leaders(self) -> dict[str, Any]:
        """What a judge of leaders knows of them and of the own brakes."""
        if not isinstance(self.judge, LatentRisk):
            return {}
        known = self.judge.manoeuvres.exceeded_by(self.watching.tolerance)
        return {"decel": self.judge.brakes.decel, "brakes_to": known}

    def _end(self) -> Frame:
        self._over = True
        self._guard.end(self._road.collided, self._road.observation)
        self.learnt += 1
        return self._seen()._replace(
            over=True, collided=self._road.collided, rear_ended=self._road.rear_ended
        )

    def _event(self, state: int | None, created: bool) -> str:
        if created:
            return "created"
        return "moved" if self._state is not None and state != self._state else ""

    def _seen(self) -> Frame:
        """Where the cars are; nothing is recognised or decided yet."""
        road = self._road
        record = road.episode(self._row).record
        dt, first = road.scenario.dt, self._number == 0
        speeds, now = record[:, SPEED], record[-1]
        self._position += float(0.5 * (speeds[1:] + speeds[:-1]).sum() * dt)
        self._row = road.row
        observation = road.observation
        return Frame(
            number=self._number,
            time=road.time,
            gap=float(now[GAP]),
            v_follower=float(speeds[-1]),
            v_leader=float(now[LEADER_SPEED]),
            a_follower=road.realised,
            a_leader=math.nan if first else float(record[-2, LEADER_ACCELERATION]),
            x_follower=self._position,
            gap_behind=float(now[GAP_BEHIND]),
            observation=tuple(observation.tolist()),
            n_states=self.machine.n_states,
            time_to_collision=float(time_to_collision(observation)),
            time_headway=float(time_headway(observation)),
            revising=self.revising,
            story=self._chronicle.story,
            **self._leaders(),
        )


def _judged(judged: Judgement, option: int) -> Judged:
    return Judged(float(judged.risk[option]), float(judged.low[option]), float(judged.high[option]))

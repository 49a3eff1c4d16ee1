"""Drives a family decision by decision and shows every one; the guard goes on learning."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Self

import numpy as np

from evofsm.cli.watch.shown import (
    RECORDED,
    Chronicle,
    Frame,
    Graph,
    Judged,
    Start,
    graph_of,
    most_believed,
)
from evofsm.driving import (
    Family,
    LatentRisk,
    drive,
    guard_for_family,
    learners_of,
    teach,
    unrevised_guard,
)
from evofsm.driving.cars import name_judge
from evofsm.driving.measures import time_headway, time_to_collision
from evofsm.driving.world import GAP, GAP_BEHIND, LEADER_ACCELERATION, LEADER_SPEED, SPEED, World
from evofsm.fsm.rules import Novelty
from evofsm.guard import Decision, Guard, Judgement, Mode
from evofsm.guard.record import RECORD

#: The state rule for looking on: coarse enough that each state can be told from the others.
WATCHED_RULE = Novelty(radius=2.0, scales=(4.0, 2.0, 2.0))

# So many draws can be chosen among where a family has no cases.
_DRAWS = 12
# After a leader's full brake there is nothing left to see once all have stood for so long [s].
_STANDING = 3.0


def watched_guard(family: Family, **settings: Any) -> Guard:
    """A guard that has seen nothing, with few enough states to look at."""
    return guard_for_family(family, rule=WATCHED_RULE, **settings)


def learn_first(
    guard: Guard,
    family: Family,
    episodes: int,
    seed: int = 0,
    show: Callable[[int], None] = lambda done: None,
) -> None:
    """Drive the family for a while, in closed form and draws that are not watched, to learn."""
    for index in range(episodes):
        teach(guard, [family.draw(seed + 1, index)])
        show(index + 1)


def cases_of(family: Family) -> tuple[str, ...]:
    """Names of what can be driven."""
    if family.cases > 1:
        return family.variants
    return tuple(f"draw {number}" for number in range(1, _DRAWS + 1))


class Session:
    """One run after another, each driven decision by decision."""

    def __init__(
        self,
        family: Family,
        guard: Guard,
        world: World,
        *,
        case: int = 0,
        seed: int = 0,
        on: bool = True,
        learnt: int = 0,
    ) -> None:
        self.family, self.world, self.case, self.learnt = family, world, case, learnt
        self.machine, self.judge = learners_of(guard)
        self._guard, self._reviser, self._seed = guard, guard.reviser, seed
        self._tolerance = float(self._reviser.tolerance)  # type: ignore[attr-defined]
        guard.explaining = True
        self.revising = on
        self._closing = ExitStack()
        self.start = self.restart()

    @property
    def revising(self) -> bool:
        """Whether the reviser may act; it can be set at any time. Off, it says what it would do."""
        return self._reviser.mode is Mode.ACT  # type: ignore[attr-defined]

    @revising.setter
    def revising(self, on: bool) -> None:
        self._reviser.mode = Mode.ACT if on else Mode.SHADOW  # type: ignore[attr-defined]

    def restart(self, case: int | None = None) -> Start:
        """Begin a run anew, or another one; one that is under way is broken off."""
        case, cases = self.case if case is None else case, cases_of(self.family)
        if not 0 <= case < len(cases):
            raise ValueError(f"case is {case + 1}; {self.family.name} has 1 to {len(cases)}")
        self._closing.close()
        self.case = case
        draw = self.family.draw(self._seed, case)
        self._controller = draw.controller
        self._road = self._closing.enter_context(self.world.open(draw.scenario))
        self._steps = draw.scenario.steps(self.family.interval)
        self._guard.begin()
        alone = drive(unrevised_guard(self.family), draw)
        hits = float(alone.time[-1]) if alone.collided else math.inf
        self._chronicle = Chronicle(self._tolerance, hits)
        self._number, self._row, self._position, self._stood = 0, 0, 0.0, 0.0
        self._state: int | None = None
        self._held = np.full(3, np.nan)
        self.start = self._begun()
        return self.start

    def step(self) -> Frame:
        """One decision, and what came of the one before."""
        ends = self._road.over or self._stood >= _STANDING
        frame = self._end() if ends else self._decide()
        frame = frame._replace(story=self._chronicle.tell(frame))
        self._number += 1
        if not frame.over:
            stands = max(frame.v_follower, frame.v_leader) == 0.0 and frame.a_leader < 0.0
            self._stood = self._stood + self.family.interval if stands else 0.0
            self._road.advance(frame.executed, self._steps)
        return frame

    def graph(self) -> Graph:
        """The states found so far."""
        return graph_of(self.machine, self.judge, self._number)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._closing.close()

    def _begun(self) -> Start:
        family = self.family
        return Start(
            family=family.name,
            about=family.about,
            cases=cases_of(family),
            case=self.case,
            tolerance=self._tolerance,
            interval=family.interval,
            actions=(family.actions.low, family.actions.high),
            learnt=self.learnt,
            judge=name_judge(self.judge),
        )

    def _decide(self) -> Frame:
        road, guard, known = self._road, self._guard, self.machine.n_states
        seen = road.observation
        self._held = np.where(np.isnan(seen), self._held, seen)
        revision = guard.decide(seen, self._controller.propose(self._held, road.time), road.time)
        situation = guard.situation
        by_leaders, actions = isinstance(self.judge, LatentRisk), self.family.actions
        wanted = np.clip(revision.proposed, actions.low, actions.high)
        safest = actions.low if by_leaders else revision.advised
        judged = self.judge.judge(situation, np.array([wanted, revision.executed, safest]))
        created = self.machine.n_states > known
        moved = self._state is not None and situation.state != self._state
        self._state = situation.state
        if by_leaders:
            said: dict[str, Any] = {"critical": float(judged.critical[0])}
        else:
            said = {"why": self.judge.why(judged) if judged.risk[0] > self._tolerance else ""}
        return self._seen()._replace(
            **{name: RECORD[name].read(Decision(situation, revision)) for name in RECORDED},
            belief=most_believed(situation.belief),
            event="created" if created else "moved" if moved else "",
            proposed_risk=_judged(judged, 0),
            executed_risk=_judged(judged, 1),
            braking_risk=float(judged.risk[2]),
            **said,
        )

    def _end(self) -> Frame:
        self._guard.end(self._road.collided, self._road.observation)
        self.learnt += 1
        return self._seen()._replace(
            over=True, collided=self._road.collided, rear_ended=self._road.rear_ended
        )

    def _seen(self) -> Frame:
        """Where the cars are; nothing is recognised or decided yet."""
        road = self._road
        record = road.episode(self._row).record
        dt, first = road.scenario.dt, self._number == 0
        speeds, now = record[:, SPEED], record[-1]
        self._position += float(0.5 * (speeds[1:] + speeds[:-1]).sum() * dt)
        self._row = road.row
        seen = road.observation
        leaders: dict[str, Any] = {}
        if isinstance(self.judge, LatentRisk):
            expected = self.judge.manoeuvres.exceeded_by(self._tolerance)
            leaders = {"decel": self.judge.brakes.decel, "brakes_to": expected}
        return Frame(
            number=self._number,
            time=road.time,
            gap=float(now[GAP]),
            v_follower=float(speeds[-1]),
            v_leader=float(now[LEADER_SPEED]),
            a_follower=float(road.episode(max(0, road.row - 1)).realised[0]),
            a_leader=math.nan if first else float(record[-2, LEADER_ACCELERATION]),
            x_follower=self._position,
            gap_behind=float(now[GAP_BEHIND]),
            observation=tuple(seen.tolist()),
            time_to_collision=float(time_to_collision(seen)),
            time_headway=float(time_headway(seen)),
            revising=self.revising,
            **leaders,
        )


def _judged(judged: Judgement, option: int) -> Judged:
    return Judged(float(judged.risk[option]), float(judged.low[option]), float(judged.high[option]))

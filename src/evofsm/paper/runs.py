"""The runs: each case driven as often as asked, every row shown to one machine."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import IDM, ChangingIDM, Episode, Leader, Scenario
from evofsm.driving.measures import is_dead_end
from evofsm.driving.naming import UNITS, VARIABLES
from evofsm.driving.world import World
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.model import FSMModel

CASES = (1, 2, 3, 4)


@dataclass(frozen=True)
class Settings:
    """All that the runs can be told; the defaults stand in ``settings.toml``."""

    scenario: Scenario
    safe_until: float
    drivers: Mapping[int, IDM | ChangingIDM]  #: by case
    switch_at: Mapping[int, float]  #: when the driver changes, by case
    brake_at: tuple[float, ...]
    decel: float  #: hardest braking of the follower [m/s²], positive
    machine: Mapping[str, Any]
    actions: IntervalActions

    @classmethod
    def load(cls, changes: Mapping[str, Mapping[str, Any]] | None = None) -> Settings:
        """The paper's settings, with others in the place of some.

        ``changes`` are tables of ``settings.toml``, with what is changed in them; a ValueError says
        which name is not known.

        Examples
        --------
        >>> settings = Settings.load({"leader": {"brake_decel": 6.0}})
        >>> settings.scenario.leader.brake_decel, settings.scenario.initial_gap
        (6.0, 5.0)
        """
        tables = tomllib.loads(files(__package__).joinpath("settings.toml").read_text("utf-8"))
        for table, values in (changes or {}).items():
            for name in values:
                if name not in tables.get(table, {}):
                    names = ", ".join(tables.get(table, tables))
                    raise ValueError(f"[{table}]: there is no {name!r}; known are {names}")
            tables[table] |= values
        scenario, leader, cases = dict(tables["scenario"]), dict(tables["leader"]), tables["cases"]
        safe_until = scenario.pop("safe_until")
        brake = {name: leader.pop(name) for name in ("brake_speed", "brake_decel")}
        aggressive, normal = IDM(**tables["aggressive"]), IDM(**tables["normal"])
        to_normal, to_aggressive = cases["to_normal_at"], cases["to_aggressive_at"]
        return cls(
            scenario=Scenario(Leader(IDM(**leader), **brake), **scenario),
            safe_until=safe_until,
            drivers={
                1: aggressive,
                2: normal,
                3: ChangingIDM(aggressive, ((to_normal, normal),)),
                4: ChangingIDM(normal, ((to_aggressive, aggressive),)),
            },
            switch_at={3: to_normal, 4: to_aggressive},
            brake_at=tuple(cases["brake_at"]),
            decel=-min(aggressive.lowest, normal.lowest),
            machine=tables["machine"],
            actions=IntervalActions(**tables["actions"], outside="clip"),
        )


@dataclass(frozen=True, eq=False)
class Run:
    """One run of a case, and what the machine made of each row."""

    name: str
    case: int
    episode: Episode
    action: NDArray[np.int64]  #: (T,) index of the action commanded after each row
    state: NDArray[np.int64]  #: (T,) index of the most probable state
    n_states: NDArray[np.int64]  #: (T,) number of states
    belief: NDArray[np.float64]  #: (T, n) in the last round; else without columns
    surprise: NDArray[np.float64]  #: (T,) [bit]


@dataclass(frozen=True, eq=False)
class PaperStudy:
    """The runs in the order in which they were learnt, and what follows from them."""

    world: str
    settings: Settings
    runs: tuple[Run, ...]
    extra_runs: tuple[Run, ...]
    is_safe_at_the_end: bool  #: whether the longer runs of cases 2 and 3 stay safe
    model: FSMModel
    dead_end: int  #: index of the state that stands at most collisions; -1 without collisions

    @property
    def dead_ends(self) -> tuple[int, ...]:
        """The dead end, if there is one, as the states to mark."""
        return (self.dead_end,) if self.dead_end >= 0 else ()

    @property
    def last_round(self) -> tuple[Run, ...]:
        """The last run of each case, in the order of the cases."""
        return tuple(sorted(self.runs[-len(CASES) :], key=lambda run: run.case))

    def in_dead_end(self, run: Run) -> NDArray[np.bool_]:
        """Whether, by the oracle, a full brake of the leader could not be survived, at each row."""
        leader = self.settings.scenario.leader
        return is_dead_end(run.episode.observations, self.settings.decel, leader.brake_decel)


def run_paper(
    world: World,
    name: str,
    settings: Settings,
    rounds: int = 20,
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    order: Sequence[int] = CASES,
    observe: Callable[[int, Episode], NDArray[np.float64]] | None = None,
) -> PaperStudy:
    """Drive and learn all runs.

    Parameters
    ----------
    world, name : World, str
        Where to drive, and what to call it.
    settings : Settings
        ``Settings.load()`` for the paper's.
    rounds : int
        How often the four cases are driven.
    progress : callable
        Told how many runs are done, of how many.
    order : sequence of int
        In which the cases are driven in each round, each of them once.
    observe : callable, optional
        What the machine observes of a run, (T, 3), told how many runs came before, and the run;
        without it what truly happened.
    """
    if rounds < 1:
        raise ValueError(f"rounds is {rounds}; the cases must be driven at least once")
    machine = EvolvingFSM(settings.actions.n_actions, **settings.machine)
    total = rounds * len(CASES) + len(settings.brake_at) + 2
    runs, extra_runs = list[Run](), list[Run]()

    def learn(
        machine: EvolvingFSM, name: str, case: int, scenario: Scenario, *, is_last: bool = False
    ) -> Run:
        """Drive a run and show it to the machine, row by row."""
        episode = world.run(scenario, settings.drivers[case])
        before = len(runs) + len(extra_runs)
        observations = observe(before, episode) if observe else episode.observations
        action = settings.actions.encode(episode.accelerations)
        ends = [len(observations) - 1] if episode.collided else []
        trace = machine.learn_many(observations, action, [0], ends, belief=is_last)
        belief = np.empty((len(action), 0)) if trace.belief is None else trace.belief
        progress(before + 1, total)
        columns = action, trace.state, trace.n_states, belief, trace.surprise
        return Run(name, case, episode, *columns)

    for n_left in reversed(range(rounds)):
        for case in order:
            is_last = n_left == 0
            runs.append(learn(machine, f"case {case}", case, settings.scenario, is_last=is_last))
    for time in settings.brake_at:
        leader = replace(settings.scenario.leader, brake_time=time)
        scenario = replace(settings.scenario, leader=leader)
        extra_runs.append(learn(machine.copy(), f"brake at {time:g} s", 1, scenario))
    longer = replace(settings.scenario, duration=settings.safe_until)
    is_safe = not any(world.run(longer, settings.drivers[case]).collided for case in (2, 3))
    progress(total, total)
    dt = settings.scenario.dt
    model = machine.model(actions=settings.actions, names=VARIABLES, units=UNITS, dt=dt)
    at_collisions = [run.state[-1] for run in runs if run.episode.collided]
    dead_end = int(np.bincount(at_collisions).argmax()) if at_collisions else -1
    return PaperStudy(name, settings, tuple(runs), tuple(extra_runs), is_safe, model, dead_end)

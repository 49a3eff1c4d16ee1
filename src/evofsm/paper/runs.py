"""The runs: drive each case as often as asked, and show every row to one machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import UNITS, VARIABLES, Episode, World
from evofsm.fsm import EvolvingFSM, FSMModel, jensen_shannon, widen
from evofsm.paper.settings import Settings

CASES = (1, 2, 3, 4)


@dataclass(frozen=True, eq=False)
class Run:
    """One run of a case, and what the machine made of each row."""

    name: str
    case: int
    round: int  #: from 1; 0 for an extra run
    episode: Episode
    action: NDArray[np.int64]  #: (T,) index of the action commanded after each row
    state: NDArray[np.int64]  #: (T,) index of the most probable state
    n_states: NDArray[np.int64]  #: (T,) number of states
    belief: NDArray[np.float64]  #: (T, n), 0 for states founded later
    surprise: NDArray[np.float64]  #: (T,) [bit]
    first_surprise: float  #: of the first row, against the uniform belief and marginal matrix [bit]


class Founding(NamedTuple):
    """When a state was founded."""

    state: int
    run: int  #: index of the run
    time: float  #: in that run [s]


@dataclass(frozen=True, eq=False)
class PaperStudy:
    """The runs in the order in which they were learnt, and what follows from them."""

    world: str
    settings: Settings
    runs: tuple[Run, ...]
    extra_runs: tuple[Run, ...]
    safe_at_the_end: Mapping[int, bool]  #: whether the longer runs of cases 2 and 3 stay safe
    model: FSMModel
    dead_end: int  #: index of the state that stands at most collisions; -1 without collisions

    @property
    def foundings(self) -> list[Founding]:
        """When each state was founded, in the order of time."""
        lengths = [len(run.state) for run in self.runs]
        first_rows = np.cumsum([0, *lengths])
        foundings = []
        for state, number in enumerate(self.model.founded):
            row = int(number) - 1
            run = int(np.searchsorted(first_rows, row, side="right")) - 1
            time = float(self.runs[run].episode.time[row - first_rows[run]])
            foundings.append(Founding(state, run, time))
        return foundings

    @property
    def dead_ends(self) -> tuple[int, ...]:
        """The dead end, if there is one, as the states to mark."""
        return (self.dead_end,) if self.dead_end >= 0 else ()

    @property
    def last_round(self) -> tuple[Run, ...]:
        """The last run of each case, in the order of the cases."""
        return tuple(sorted(self.runs[-len(CASES) :], key=lambda run: run.case))


def as_it_is(number: int, episode: Episode) -> NDArray[np.float64]:
    """What the paper's machine observes of a run: what truly happened."""
    return episode.observations


def run_paper(
    world: World,
    name: str,
    settings: Settings,
    rounds: int = 20,
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    order: Sequence[int] = CASES,
    observe: Callable[[int, Episode], NDArray[np.float64]] = as_it_is,
    beliefs: bool = True,
) -> PaperStudy:
    """Drive and learn all runs.

    Parameters
    ----------
    world : World
        Where to drive.
    name : str
        What to call it.
    settings : Settings
        ``Settings.load()`` for the paper's.
    rounds : int
        How often the four cases are driven.
    progress : callable
        Told how many runs are done, of how many.
    order : sequence of int
        In which the cases are driven in each round.
    observe : callable
        What the machine observes of a run, (T, 3): told how many runs came before, and the run.
    beliefs : bool
        Whether to keep every belief. The claims do without, and with hundreds of states they take
        gigabytes; `Run.belief` then has no columns, and `Run.first_surprise` is NaN.
    """
    if rounds < 1:
        raise ValueError(f"rounds is {rounds}; the cases must be driven at least once")
    if sorted(order) != list(CASES):
        raise ValueError(f"order is {list(order)}; it must hold each of the cases once")
    machine = EvolvingFSM(settings.actions.n_actions, **settings.machine)
    longer = replace(settings.scenario, duration=settings.safe_until)
    total = rounds * len(CASES) + len(settings.brake_at) + 2
    runs: list[Run] = []
    for round_ in range(1, rounds + 1):
        for case in order:
            episode = world.run(settings.scenario, settings.drivers[case])
            seen = observe(len(runs), episode)
            name_ = f"case {case}"
            runs.append(_learn(machine, settings, name_, case, round_, episode, seen, beliefs))
            progress(len(runs), total)
    extra_runs: list[Run] = []
    for time in settings.brake_at:
        leader = replace(settings.scenario.leader, brake_time=time)
        episode = world.run(replace(settings.scenario, leader=leader), settings.drivers[1])
        name_ = f"brake at {time:g} s"
        seen = observe(len(runs) + len(extra_runs), episode)
        extra_runs.append(_learn(machine.copy(), settings, name_, 1, 0, episode, seen, beliefs))
        progress(len(runs) + len(extra_runs), total)
    safe = {case: not world.run(longer, settings.drivers[case]).collided for case in (2, 3)}
    progress(total, total)
    at_collisions = [run.state[-1] for run in runs if run.episode.collided]
    return PaperStudy(
        world=name,
        settings=settings,
        runs=tuple(_widened(run, machine.n_states) for run in runs) if beliefs else tuple(runs),
        extra_runs=tuple(extra_runs),
        safe_at_the_end=safe,
        model=machine.model(
            actions=settings.actions, names=VARIABLES, units=UNITS, dt=settings.scenario.dt
        ),
        dead_end=int(np.bincount(at_collisions).argmax()) if at_collisions else -1,
    )


def _widened(run: Run, n: int) -> Run:
    """The same run with beliefs over all the states there are in the end."""
    return replace(run, belief=widen(run.belief, n))


def _learn(
    machine: EvolvingFSM,
    settings: Settings,
    name: str,
    case: int,
    round_: int,
    episode: Episode,
    seen: NDArray[np.float64],
    beliefs: bool,
) -> Run:
    """Show a run to the machine, row by row."""
    foreseen = _first_forecast(machine) if beliefs else np.empty(0)
    action = settings.actions.encode(episode.accelerations)
    ends = [len(seen) - 1] if episode.collided else []
    trace = machine.learn_many(seen, action, [0], ends, belief=beliefs)
    belief = np.empty((len(action), 0)) if trace.belief is None else trace.belief
    first = float("nan")
    if len(foreseen):
        first = float(jensen_shannon(widen(foreseen, machine.n_states), belief[0]))
    return Run(
        name=name,
        case=case,
        round=round_,
        episode=episode,
        action=action,
        state=trace.state,
        n_states=trace.n_states,
        belief=belief,
        surprise=trace.surprise,
        first_surprise=first,
    )


def _first_forecast(machine: EvolvingFSM) -> NDArray[np.float64]:
    """Of a run's first row: the uniform belief through the marginal matrix; (n,)."""
    n = machine.n_states
    return np.full(n, 1.0 / max(n, 1)) @ machine.marginal_matrix

"""Drives a system decision by decision, or plays a log row by row beside a guard, and shows it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm import driving
from evofsm.cli.driving import trace_configuration
from evofsm.cli.learning import episodes_read, learn_chunk
from evofsm.cli.options import BRAKES, refuse_other_limit, require_world
from evofsm.cli.show import progress, warn
from evofsm.cli.watch import shown
from evofsm.driving.cars import assumptions, guard_of_monitor, name_judge
from evofsm.driving.family import definitions_of
from evofsm.driving.naming import UNITS, VARIABLES
from evofsm.driving.sumo import open_world
from evofsm.driving.world import GAP_BEHIND, LEADER_ACCELERATION, LEADER_SPEED, SPEED, World
from evofsm.fsm import EvolvingFSM, Labels, Novelty
from evofsm.fsm.proportions import usual_range
from evofsm.guard import Foresight, Guard, LearntRisk, Mode
from evofsm.guard.actions import Action, Choices, change, is_usable, limits, put_into
from evofsm.guard.api import BELIEF_TOLERANCE, TOLERANCE, Judgement, Proposal, Revision, Situation
from evofsm.guard.foresight import DATES
from evofsm.io.logs import LONGEST_STEP, Chunk, LogColumns, Noted
from evofsm.io.tables import IN_UTC, date

#: The state rule for looking on: coarse enough that each state can be told from the others.
WATCHED_RULE = Novelty(radius=2.0, scales=(4.0, 2.0, 2.0))

_DRAWS = tuple(f"draw {number}" for number in range(1, 13))  # where there are no cases
_STOOD = 3.0  # so long after a leader's full brake nothing is left to see [s]
# Steps of an environment in a second, if it says none; tolerable wishes that end a danger.
_STEPS_PER_SECOND, _CALM = 10.0, 8
_SAME_ACTION = 0.02  # a change of an action by less is none [half ranges]
_LASTED = 10  # so many episodes in a row without a failure tell that a guard has learnt
_MOST_DECISIONS = 2000  # of an episode where nobody looks on
_APART = 1_000_000  # of seeds of episodes that are learnt from and those that are watched
# Episodes that tell spreads of variables; spreads between states, by the root of their number.
_LOOKED_AT, _STATES_APART, _MOST_STATES = 3, 0.6, 60
# Of a simulation of somebody else's that are watched [s], and positions of cars in them.
_SECONDS, _ENOUGH = 600.0, 100_000
# So many rows of a long episode are played one by one, and so many in a second.
_PLAYED, _A_SECOND = 400, 10.0
# Rows of an episode that shows something; what is one time [s]; by what share steps may differ.
_SHOWS, _TICK, _OTHER_STEP = 10, 5e-4, 0.1
_PARTS = ("controller", "failed", "variables")  # of a file, besides its environment
_FEW_VARIABLES = 4  # of more variables only those of the plane are named
# What Gymnasium's documentation calls the variables of its environments, with units.
_ENV_NAMES = {
    "CartPole": "cart position [m], cart velocity [m/s], pole angle [rad], "
    "pole angular velocity [rad/s]",
    "MountainCar": "position [m], velocity",
    "Pendulum": "cosine of the angle, sine of the angle, angular velocity [rad/s]",
    "LunarLander": "x, y, speed x, speed y, angle [rad], angular velocity, left contact, "
    "right contact",
}


def learn_first(
    system: System, episodes: int, show: Callable[[int], None] = lambda done: None
) -> None:
    """Drive a system for a while, in draws that are not watched, so that its guard learns.

    In the first half an environment's controller drives alone: it fails more often. Then the guard
    acts, until it prevented all of some in a row.
    """
    streak = 0
    for index in range(episodes):
        acts = 2 * index >= episodes
        if isinstance(system, Simulated):
            system.guard.reviser.mode = Mode.ACT if acts else Mode.SHADOW  # type: ignore[attr-defined]
        system.teach(index)
        show(index + 1)
        streak = streak + 1 if acts and isinstance(system, Simulated) and not system.failed else 0
        if streak == _LASTED:
            break


# -- Cars -----------------------------------------------------------------------------------------


class OnRoads:
    """A family of scenarios for cars in some world; what is learnt first is in closed form.

    Its guard has seen nothing, and few enough states to look at.
    """

    of_cars = True

    def __init__(
        self, family: driving.Family, world: World, seed: int = 0, **settings: Any
    ) -> None:
        self.family, self.world, self.seed = family, world, seed
        self.guard = driving.guard_for_family(family, rule=WATCHED_RULE, **settings)
        self.name, self.about, self.interval = family.name, family.about, family.interval
        self.labels = family.labels
        self.cases = family.variants if family.cases > 1 else _DRAWS
        self._closing = ExitStack()

    def teach(self, index: int) -> None:
        """Let the guard learn from a draw that nobody watches."""
        driving.teach(self.guard, [self.family.draw(self.seed + 1, index)])

    def begin(self, case: int) -> None:
        """Put the cars on the road."""
        self.close()
        draw = self.family.draw(self.seed, case)
        self._controller = draw.controller
        alone = driving.drive(driving.unrevised_guard(self.family), draw, self.world)
        self.alone = float(alone.time[-1]) if alone.collided else math.inf
        self._road = self._closing.enter_context(self.world.open(draw.scenario))
        self._steps = draw.scenario.steps(self.interval)
        self._stood = 0.0
        self._look()

    def _look(self) -> None:
        road, episode = self._road, self._road.episode()
        self.observation, self.time, self.failed = road.observation, road.time, road.collided
        self.over = road.over or self._stood >= _STOOD
        self.terminated = episode.collided or episode.rear_ended
        stands = not episode.record[-1, [SPEED, LEADER_SPEED]].any()
        brakes = episode.record[-2:, LEADER_ACCELERATION].min() < 0.0
        self._stood = self._stood + self.interval if stands and brakes else 0.0

    def propose(self) -> Action:
        """What the driver wants."""
        return self._controller.propose(self.observation, self.time).action

    def advance(self, revision: Revision) -> None:
        """Drive on."""
        self._road.advance(float(revision.executed), self._steps)
        self._look()

    def cars(self) -> shown.Cars:
        """Where they are, by what there was at each decision."""
        episode = self._road.episode()
        last = len(episode.time) - 1
        rows = [*range(0, last, self._steps), last]
        *_, now = shown.cars_of(episode.time[rows], episode.observations[rows])
        gap_behind = float(episode.record[-1, GAP_BEHIND])
        return now._replace(gap_behind=gap_behind, rear_ended=episode.rear_ended)

    def close(self) -> None:
        """Leave the road."""
        self._closing.close()


# -- Any environment ------------------------------------------------------------------------------


class Simulated:
    """An environment of Gymnasium and a controller, which acts at random where none is given."""

    of_cars = False

    def __init__(
        self,
        name: str,
        env: Any,
        controller: Callable[[Any, np.random.Generator], Any] | None = None,
        failed: Callable[[Any], bool] | None = None,
        variables: Sequence[str] = (),
        *,
        seed: int = 0,
        tolerance: float = TOLERANCE,
    ) -> None:
        from evofsm.guard import gym

        if not isinstance(env, gym.gymnasium.Env):  # type: ignore[attr-defined]
            raise TypeError(f"environment() returns {type(env).__name__}, not one gymnasium.Env")
        self.name, self.seed, self.cases = name, seed, _DRAWS
        self._gym, self._env, self._controller, self._failed = gym, env, controller, failed
        self.interval = 1.0 / float(env.metadata.get("render_fps") or _STEPS_PER_SECOND)
        acts = "Its own controller" if controller else "A controller that acts at random"
        fails = "what its file says" if failed else "an episode that is terminated"
        self.about = f"{acts} drives it; failure is {fails}."
        ends = _ends(name, env.action_space)
        titles = [text.partition(" [") for text in variables or _names_of(env)]
        names, units = [parts[0] for parts in titles], [parts[2].rstrip("]") for parts in titles]
        judge = LearntRisk(self.interval, **ends, names=names, units=units, seed=seed)
        guard = Guard(**ends, interval=self.interval, judge=judge, tolerance=tolerance)
        self._terms = gym.Terms(guard, env.observation_space, env.action_space, None, failed, 0.0)
        observations = np.array([z for k in range(_LOOKED_AT) for z in self._run(env, -1 - k)])
        spreads = [spread or 1.0 for spread in observations.std(0).tolist()]
        rule = Novelty(_STATES_APART * math.sqrt(len(spreads)), spreads)
        bounds: Any = {"max_states": _MOST_STATES, "belief_tolerance": BELIEF_TOLERANCE}
        machine = EvolvingFSM(guard.actions.n_actions, rule=rule, **bounds)
        self.guard = Guard.of(guard.reviser, interval=self.interval, machine=machine)
        names = names or [f"variable {k + 1}" for k in range(observations.shape[1])]
        self.labels = Labels(names=tuple(names), units=tuple(units), dt=self.interval)

    def _reset(self, env: Any, index: int) -> None:
        seed = (1000 * self.seed + index) % 2**31
        self._random = np.random.default_rng(seed)
        env.action_space.seed(seed)
        self._seen, _ = env.reset(seed=seed)
        self.time, self.over, self.failed, self.terminated = 0.0, False, False, False

    def _step(self, env: Any, action: Any) -> None:
        self._seen, reward, terminated, truncated, info = env.step(action)
        step = self._gym.StepResult(self._seen, reward, bool(terminated), bool(truncated), info)
        self.failed, self.terminated = self._terms.failed(step), step.terminated
        self.over = self.failed or step.terminated or step.truncated
        self.time += self.interval

    def _wish(self) -> Any:
        if self._controller is None:
            return self._env.action_space.sample()
        return self._controller(self._seen, self._random)

    def _run(self, env: Any, index: int) -> list[NDArray[np.float64]]:
        """An episode that nobody watches: what was observed."""
        self._reset(env, index)
        observations = [self.observation]
        while not self.over and len(observations) <= _MOST_DECISIONS:
            self._step(env, self._wish())
            observations.append(self.observation)
        return observations

    def teach(self, index: int) -> None:
        """Let the guard learn from an episode that nobody watches, by looking on."""
        env = self._gym.RevisedActions(self._env, self.guard, failed=self._failed or "terminated")
        self._run(env, _APART + index)
        env.reset()  # which ends what did not end by itself

    def begin(self, case: int) -> None:
        """Begin an episode of its own seed, which is first driven without a guard."""
        self._run(self._env, case)
        self.alone = self.time if self.failed else math.inf
        self._reset(self._env, case)

    @property
    def observation(self) -> NDArray[np.float64]:
        """The latest one, as a vector."""
        return np.asarray(self._terms.look(self._seen))

    def propose(self) -> Action:
        """What the controller wants."""
        self._wanted = self._wish()
        return self._terms.to_guard(self._wanted)

    def advance(self, revision: Revision) -> None:
        """Take a step."""
        self._step(self._env, self._terms.decided(self._wanted, revision).executed)

    def cars(self) -> None:
        """It is none that it knows of."""

    def close(self) -> None:
        """Leave it."""
        self._env.close()


def _names_of(env: Any) -> list[str]:
    """Of an environment's variables, with their units, where it is one that is known."""
    name = env.spec.id.partition("-v")[0].removesuffix("Continuous") if env.spec else ""
    names = _ENV_NAMES.get(name, "").split(", ")
    return names if (len(names),) == env.observation_space.shape else []


def _ends(name: str, space: Any) -> dict[str, Any]:
    """Of actions, as a guard takes them."""
    if hasattr(space, "n") or hasattr(space, "nvec"):  # where there are several all combinations
        sizes = getattr(space, "nvec", np.full(space.shape, 2 if space.shape else space.n))
        return {"n_actions": int(np.prod(sizes))}
    low, high = (np.ravel(getattr(space, end, math.nan)).astype(float) for end in ("low", "high"))
    if not np.isfinite([low, high]).all():
        text = f"{name}: its actions are {space}, neither discrete nor a Box with finite ends"
        raise ValueError(f"{text}; wrap it first (gymnasium.wrappers.TransformAction)")
    return {"low": low, "high": high} if len(low) > 1 else {"low": low[0], "high": high[0]}


def read_simulated(what: str, **settings: Any) -> Simulated | None:
    """An environment by its id, or as a file of Python defines it (docs/watch.md); None of none."""
    if what.endswith(".py"):
        with definitions_of(what) as definitions:
            if "environment" not in definitions:
                if "family" in definitions:
                    return None
                raise ValueError("it defines neither environment() nor a Family called family")
            parts = {name: definitions[name] for name in _PARTS if name in definitions}
            return Simulated(Path(what).stem, definitions["environment"](), **parts, **settings)
    if not re.search(r"-v\d+$", what):
        return None
    from evofsm.guard.gym import gymnasium  # type: ignore[attr-defined]

    try:
        return Simulated(what, gymnasium.make(what), **settings)
    except gymnasium.error.Error as error:
        raise ValueError(f"{what}: {error}") from error


# -- A log -----------------------------------------------------------------------------------------


class Played(NamedTuple):
    """An episode of a log, or a stretch of one."""

    name: str
    rows: Chunk
    fails: str  #: who says that it failed; empty where it did not
    alarms: bool = False  #: whether one comes in it

    @property
    def called(self) -> str:
        """Its name, with what is worst in it."""
        failure = self.fails.partition(" ")[0].lower()
        worst = ", ".join(filter(None, ["alarm" * self.alarms, failure]))
        return f"{self.name} ({worst})" if worst else self.name


class Logged:
    """What a log says happened, whoever asks."""

    alone, terminated = math.nan, True

    def __init__(
        self, path: str, played: Sequence[Played], guard: Guard, *, acts: bool, of_cars: bool
    ) -> None:
        self.name, self.interval, self.guard = Path(path).name, float(played[0].rows.dt), guard
        self.about = "row by row."
        units, self.of_cars = UNITS if of_cars else (), of_cars
        self.labels = Labels(names=guard.variables, units=units, dt=self.interval)
        shows = [(len(p.rows.times) >= _SHOWS, p.alarms, bool(p.fails)) for p in played]
        self.first = shows.index(max(shows))  #: that is worth a look
        self._played = played
        self.cases = tuple(part.called for part in played)
        self.told: dict[str, Any] = {"live": False, "acts": acts}
        if not of_cars:  # which move in real time
            pace = _A_SECOND * self.interval
            every = np.concatenate([part.rows.observations for part in played])
            fails = np.concatenate([part.rows.fails for part in played])
            self.told["ranges"] = tuple(usual_range(x, x[fails]) for x in every.T)
            self.told["speeds"] = tuple(pace * by for by in (0.25, 0.5, 1.0, 2.0, 4.0))

    def begin(self, case: int) -> None:
        """Go to the first row of an episode."""
        self._rows, fails = self._played[case].rows, self._played[case].fails
        times = self._rows.times - self._rows.times[0]
        self._times, self._fails = times.tolist(), fails
        self._cars = list(shown.cars_of(times, self._rows.observations)) if self.of_cars else None
        began = float(self._rows.times[0])
        clock = math.nan if self.of_cars or self.interval < 1.0 else 0.0
        clock = began if began >= DATES else clock
        self.told |= {"begins": self._times[-_PLAYED:][0], "fails": fails, "began": clock}
        self._go_to(0)

    def _go_to(self, row: int) -> None:
        self._row, self.over = row, row == len(self._times) - 1
        self.time, self.observation = self._times[row], self._rows.observations[row]
        self.failed = self.over and bool(self._fails)

    def propose(self) -> Action:
        """What was done."""
        return float(self._rows.actions[self._row]) if self.told["acts"] else 0.0

    def advance(self, revision: Revision) -> None:
        """Go to the next row."""
        self._go_to(self._row + 1)

    def cars(self) -> shown.Cars | None:
        """Where they are, if it is of cars."""
        return None if self._cars is None else self._cars[self._row]

    def close(self) -> None:
        """There is nothing to leave."""


def watched_log(
    path: str,
    columns: LogColumns,
    tolerance: float | None = None,
    case: int | None = None,
    guard: Guard | None = None,
    *,
    brakes: float = BRAKES,
    collisions: Mapping[str, Sequence[float]] = MappingProxyType({}),
) -> Session:
    """The episodes of a log, with a guard; of cars without one with what `evofsm monitor` has.

    Of cars one is over with a contact, or one of ``collisions`` [s] that a simulation counted, by
    the name of who follows whom. ``case`` is the number of the one to begin with, from 1.
    """
    names, variables = columns.observe.names, guard.variables if guard else VARIABLES
    if of_cars := columns.acts and variables == VARIABLES and len(names) == len(VARIABLES):
        names = VARIABLES  # which may be called otherwise in the log
    if guard is None and not of_cars:
        raise ValueError(f"{path} is of no cars: --guard names a guard (evofsm learn --guard)")
    notes = Noted()
    episodes = episodes_read(path, columns, notes, dated=not of_cars)
    stretches = list(_of_cars(episodes, collisions) if of_cars else _whole(episodes))
    if not stretches:
        why = f"nobody follows anybody for {_SHOWS}" if of_cars else "no episode has two"
        raise ValueError(f"{path}: {why} rows")
    rows = [stretch.rows for stretch in stretches]
    refuse_other_limit(columns.acts, (None, 0.0, None), tolerance)
    if guard is None:
        risk = TOLERANCE if tolerance is None else tolerance
        guard = guard_of_monitor(rows[0].dt, brakes, risk)
        assert guard.machine is not None
        for chunk in rows:
            learn_chunk(guard.machine, chunk, guard.actions)
        warn(assumptions(brakes, risk))
    else:
        if tuple(names) != guard.variables or abs(rows[0].dt / guard.interval - 1.0) > _OTHER_STEP:
            holds = f"{', '.join(names)} every {rows[0].dt:.4g} s"
            wants = f"{', '.join(guard.variables)} every {guard.interval:.4g} s"
            raise ValueError(f"{path} is read as {holds}; this guard decides on {wants}")
        if tolerance is not None:
            guard.reviser.tolerance = tolerance  # type: ignore[attr-defined]
    guard.learn = False
    if isinstance(guard.judge, Foresight):
        stretches = list(_alarmed(guard.judge, guard.judge.alarm, stretches))
    system = Logged(path, stretches, guard, acts=columns.acts, of_cars=of_cars)
    if notes.in_utc and rows[0].times[0] >= DATES:
        system.about = f"row by row; {IN_UTC}."
    return Session(system, case=system.first if case is None else case - 1, on=False)


def watched_simulation(path: str, columns: LogColumns, *choices: Any, brakes: float) -> Session:
    """What a configuration of SUMO drives, as a log."""
    with TemporaryDirectory() as folder:
        log = Path(folder) / Path(path).name
        duration, is_cut, crashes = trace_configuration(Path(path), log, _SECONDS, _ENOUGH)
        if is_cut:
            warn(f"watched are the first {duration:,.0f} s of the simulation")
        return watched_log(str(log), columns, *choices, brakes=brakes, collisions=crashes)


def _alarmed(judge: Foresight, rate: int | None, found: Sequence[Played]) -> Iterator[Played]:
    """With whether alarms come before the last row, with which nothing is decided."""
    runs = judge.runs([p.rows.observations for p in found], [bool(p.fails) for p in found])
    on = np.zeros(len(runs.rows), np.bool_) if rate is None else judge.tally(runs, rate)[1]
    for stretch, part in zip(found, np.split(on, runs.starts[1:]), strict=True):
        yield stretch._replace(alarms=bool((part[1:-1] & ~part[:-2]).any()))


def _whole(episodes: Iterable[Chunk]) -> Iterator[Played]:
    for number, episode in enumerate(episodes, 1):
        began = f", {date(episode.times[0])}" if episode.times[0] >= DATES else ""
        yield Played(f"episode {number}{began}", episode, "Failure (by the log)" * episode.failed)


def _of_cars(
    episodes: Iterable[Chunk], collisions: Mapping[str, Sequence[float]]
) -> Iterator[Played]:
    for number, whole in enumerate(episodes, 1):
        name = "".join(whole.names) or f"episode {number}"
        for rows, fails in _stretches(whole, collisions.get(name, ())):
            began = f", from {rows.times[0]:.1f} s" if whole.names else ""
            yield Played(name + began, rows, fails)


def _stretches(episode: Chunk, collisions: Sequence[float]) -> Iterator[tuple[Chunk, str]]:
    """Those of an episode that are long enough, and how each failed."""
    crashes = np.zeros(len(episode.times), np.bool_)
    for time in collisions:  # who collides may be taken off the road before it is written down
        row = int(np.searchsorted(episode.times, time + _TICK)) - 1
        crashes[row] |= row >= 0 and time - episode.times[row] < LONGEST_STEP * episode.dt
    contacts = crashes | (episode.observations[:, 0] <= 0.0)
    begins = np.flatnonzero(~contacts & np.append(True, contacts[:-1]))
    for first in begins.tolist():
        ends = np.flatnonzero(contacts[first:])
        last = first + int(ends[0]) if len(ends) else len(contacts) - 1
        if last + 1 - first < _SHOWS:
            continue
        fails = "Failure (by the log)" * bool(episode.fails[last])
        if contacts[last]:
            fails = "Collision (by SUMO)" if episode.observations[last, 0] > 0.0 else "Collision"
        rows = episode.rows(first, last + 1)
        rows.begins[0], rows.fails[-1] = True, bool(fails)
        yield rows._replace(tells=True), fails


# -- A run ----------------------------------------------------------------------------------------

System = OnRoads | Simulated


class Session(AbstractContextManager["Session"]):
    """One run of a system after another, each driven decision by decision."""

    def __init__(self, system: System | Logged, *, case: int = 0, on: bool = True) -> None:
        self.system, self.case, guard = system, case, system.guard
        self.machine, self.judge = driving.learners_of(guard)
        self._guard, self._reviser = guard, guard.reviser
        self._tolerance = float(self._reviser.tolerance)  # type: ignore[attr-defined]
        guard.explaining = True
        # As a decision logger it is told of each before anything is learnt from it.
        hooks = dict.fromkeys(("begin", "seen", "ended"), lambda *_, **__: None)
        logger: Any = SimpleNamespace(decided=self._ask, **hooks)
        guard.audit = logger
        self.revising = on
        self.restart()

    @property
    def revising(self) -> bool:
        """Whether the reviser may act; it can be set at any time. Off, it says what it would do."""
        return self._reviser.mode is Mode.ACT  # type: ignore[attr-defined]

    @revising.setter
    def revising(self, on: bool) -> None:
        self._reviser.mode = Mode.ACT if on else Mode.SHADOW  # type: ignore[attr-defined]

    def _idle(self) -> str:
        if not self.revising:
            text = "the reviser only watched, in shadow mode"
            return text if isinstance(self.system, Logged) else "the reviser is off"
        reason: str = self._reviser.passing  # type: ignore[attr-defined]
        why = "was not shown to help yet" if reason == "shadow" else reason
        return reason and f"the guard {why}, so what is proposed passes"

    def restart(self, case: int | None = None) -> None:
        """Begin a run anew, or another one; one that is under way is broken off."""
        case, system = self.case if case is None else case, self.system
        if not 0 <= case < len(system.cases):
            raise ValueError(f"case is {case + 1}; {system.name} has 1 to {len(system.cases)}")
        self.case = case
        system.begin(case)
        self._guard.begin()
        self._story = shown.Story(alone=system.alone)
        self._number = 0
        actions = self._guard.actions
        low, high = limits(actions)
        names = tuple(map(system.labels.variable, range(len(system.observation))))
        self.start = shown.Start(
            **(system.told if isinstance(system, Logged) else {}),
            system=system.name,
            about=system.about,
            cases=system.cases,
            case=case,
            tolerance=self._tolerance,
            interval=system.interval,
            names=shown.OF_CARS if system.of_cars else names,
            low=shown.numbers(low),
            high=shown.numbers(high),
            discrete=isinstance(actions, Choices),
            cars=system.of_cars,
            learnt=self._guard.n_episodes,
            judge="learnt" if isinstance(self.judge, Foresight) else name_judge(self.judge),
        )

    def step(self) -> shown.Frame:
        """One decision, and what came of the one before."""
        observation, cars = self.system.observation, self.system.cars()
        frame = shown.Frame(
            number=self._number,
            time=self.system.time,
            observation=tuple(observation.tolist()),
            here=self._place(observation),
            idle=self._idle(),
            cars=cars,
        )
        frame = self._end(frame) if self.system.over else self._decide(frame)
        self._number += 1
        calm = min(shown.CALM, _CALM * self.system.interval)
        self._story = shown.go_on(self._story, frame, self._tolerance, calm)
        return frame._replace(story=self._story)

    def graph(self) -> shown.Graph:
        """The states found so far."""
        return shown.graph_of(self.machine, self.judge, self._number)

    def known(self) -> shown.Known:
        """What is known of failure."""
        return shown.known_of(self.judge)

    def __exit__(self, *error: object) -> None:
        self.system.close()

    def _place(self, center: NDArray[np.float64]) -> str:
        """Where an observation lies, in words; of many variables by two."""
        labels = self.system.labels
        if len(center) > _FEW_VARIABLES:
            two = list(self.known().plane)
            names, units = (tuple(texts[k] for k in two if texts) for texts in labels[1:3])
            labels, center = Labels(names=names, units=units, dt=labels.dt), center[two]
        return labels.place(center)

    def _decide(self, frame: shown.Frame) -> shown.Frame:
        guard = self._guard
        revision = guard.decide(self.system.observation, self.system.propose(), frame.time)
        situation, judgement = guard.situation, self._judged
        self.system.advance(revision)
        executed = put_into(guard.actions, revision.executed)  # what passes may lie outside
        rows = zip(judgement.risk, judgement.low, judgement.high, judgement.critical, strict=True)
        wish, act, best = (shown.Judged(*map(float, values)) for values in rows)
        return frame._replace(
            state=situation.state,
            proposed_risk=wish,
            executed_risk=act,
            least_risk=math.nan if isinstance(self.judge, Foresight) else best.risk,
            proposed=shown.numbers(revision.proposed),
            executed=shown.numbers(revision.executed),
            advised=shown.numbers(revision.advised),
            revised=change(guard.actions, self._wanted, executed) > _SAME_ACTION,
            advises=change(guard.actions, self._wanted, revision.advised) > _SAME_ACTION,
            reason=revision.reason,
            explanation=revision.explanation,
            **self._needed(judgement),
        )

    def _ask(self, situation: Situation, proposal: Proposal, revision: Revision) -> None:
        """Ask the judge about what is proposed, what is executed, and the best that can be done."""
        actions, self._wanted = self._guard.actions, revision.executed
        if is_usable(actions, revision.proposed):
            self._wanted = put_into(actions, revision.proposed)
        safest = actions.low if isinstance(self.judge, driving.LatentRisk) else revision.advised
        candidates = np.array([self._wanted, revision.executed, safest], np.float64)
        self._judged = self.judge.judge(situation, candidates)

    def _needed(self, judged: Judgement) -> dict[str, Any]:
        judge = self.judge
        if isinstance(judge, Foresight):
            return {}
        why = judge.why(judged) if judged.risk[0] > self._tolerance else ""
        if isinstance(judge, driving.LatentRisk):
            quantile = judge.manoeuvres.exceeded_by
            return {"needed": quantile(self._tolerance), "usual": quantile(0.5), "why": why}
        assert isinstance(judge, LearntRisk)
        return {"needed": judge.state.margin, "why": why}

    def _end(self, frame: shown.Frame) -> shown.Frame:
        system, before = self.system, self.known()
        self._guard.end(system.failed, system.observation, terminated=system.terminated)
        now = self.known()
        novel = shown.first_of_its_kind(frame.observation, before, now) if system.failed else ""
        return frame._replace(over=True, failed=system.failed, novel=novel)


def watched_run(
    what: str, case: int, world: str, judge: str, *, tolerance: float, seed: int, learnt: int
) -> Session:
    """Cars in a world of their own, or an environment, after so many episodes to learn from."""
    system: System | None = read_simulated(what, seed=seed, tolerance=tolerance)
    if system is None:
        require_world(world)
        family, roads = driving.load_family(what), open_world(world)
        system = OnRoads(family, roads, seed, judge=judge, tolerance=tolerance)
    with progress("Learning first", learnt) as move:
        learn_first(system, learnt, move)
    return Session(system, case=case - 1)

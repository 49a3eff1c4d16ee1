"""The systems that are controlled: each starts by seed, its controllers propose, a step may fail.

A `System` is an environment with Gymnasium's interface, whose ``info`` says whether it ``failed``,
together with one of the controllers that it is tried under.
"""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.cli import imported
from evofsm.driving import (
    FAMILIES,
    Draw,
    Family,
    KinematicWorld,
    load_family,
    outcome_of,
    reference_of,
)
from evofsm.extras import install, needs
from studies.lib import ALL, FIRST, names_in

#: A float, or (d,) of them, or an index from 0.
Action = Any
Vector = NDArray[np.float64]
Controllers = Mapping[str, Callable[[Vector], Action]]


class Start(NamedTuple):
    """Which episode: the same is drawn for the same start, whoever controls the system.

    >>> Start.held_out(seed=0, episode=3) == Start.training(seed=0, learning_seed=0, episode=3)
    False
    """

    split: Literal["train", "test"]
    seed: int
    episode: int

    @classmethod
    def training(cls, seed: int, learning_seed: int, episode: int) -> Start:
        """One to learn from; other ones for every learning seed."""
        return cls("train", seed * 1000 + learning_seed, episode)

    @classmethod
    def held_out(cls, seed: int, episode: int) -> Start:
        """One that nothing learns from."""
        return cls("test", seed, episode)

    def rng(self, stream: int) -> np.random.Generator:
        """Random numbers of this episode; each stream has its own."""
        return np.random.default_rng([self.split == "test", self.seed, self.episode, stream])


@dataclass(frozen=True)
class Box:
    """Actions that are one number or several, each from ``low`` to ``high``."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    @property
    def settings(self) -> dict[str, Any]:
        """What a guard is given of them."""
        if len(self.low) == 1:
            return {"low": self.low[0], "high": self.high[0]}
        return {"low": np.array(self.low), "high": np.array(self.high)}

    def holds(self, action: Action) -> bool:
        """Whether it is one of them, but for rounding; NaN is none."""
        beyond = np.maximum(np.subtract(self.low, action), np.subtract(action, self.high))
        return np.size(action) == len(self.low) and bool((beyond < 1e-6).all())

    def change(self, executed: Action, proposed: Action) -> float:
        """Mean absolute difference, in halves of the range."""
        half = 0.5 * (np.array(self.high) - np.array(self.low))
        return float(np.mean(np.abs(np.subtract(executed, proposed)) / half))

    def drawn(self, chance: np.random.Generator) -> Action:
        """Any action, each alike."""
        found = chance.uniform(self.low, self.high)
        return float(found[0]) if len(self.low) == 1 else found


@dataclass(frozen=True)
class Discrete:
    """Actions that are an index from 0."""

    n_actions: int

    @property
    def settings(self) -> dict[str, Any]:
        """What a guard is given of them."""
        return {"n_actions": self.n_actions}

    def holds(self, action: Action) -> bool:
        """Whether it is one of them."""
        return action in range(self.n_actions)

    def change(self, executed: Action, proposed: Action) -> float:
        """1 where another action is executed."""
        return float(executed != proposed)

    def drawn(self, chance: np.random.Generator) -> Action:
        """Any action, each alike."""
        return int(chance.integers(self.n_actions))


def actions_of(space: Any) -> Box | Discrete:
    """The actions of a space of Gymnasium."""
    if hasattr(space, "n"):
        return Discrete(int(space.n))
    return Box(tuple(map(float, space.low)), tuple(map(float, space.high)))


class System(ABC):
    """A system with one of its `controllers`: the first, unless another one is named."""

    name: str
    variables: tuple[str, ...]  #: of an observation, with their units
    actions: Any  #: `Box` or `Discrete`
    interval: float  #: between two decisions [s]
    steps: int  #: decisions of an episode, at most
    train: int = 30  #: episodes that are learnt from, unless told otherwise
    horizon: float | None = None  #: that a guard is given [s]; None: it has to find it
    measure: ClassVar[str] = "return"  #: what `score` is
    learners: Sequence[str] = ("learnt", "counted")  #: judges that are told nothing but failures
    #: Judges by name that know this system; see `studies.rivals.rivals_of` for those of ours.
    rivals: Mapping[str, Callable[[], Any]] = {}
    #: Whether an observation is a failure; None where it does not show.
    has_failed: Any = None
    _seen: Any  #: by environments of others
    _wanted: Action | None = None  #: by who wanders

    def __init__(self, controller: str | None = None) -> None:
        self.controller = self.chosen(FIRST if controller is None else controller)[0]

    def chosen(self, wanted: str) -> list[str]:
        """Names of its controllers that are ``wanted``: some with commas, `ALL` or `FIRST`."""
        known = list(self.controllers)
        if known and wanted in (ALL, FIRST):
            return known if wanted == ALL else known[:1]
        named = list(dict.fromkeys(names_in(wanted))) or [wanted]
        for name in named:
            if name not in known:
                names = ", ".join(known) or "none: give it some in `controllers`"
                raise ValueError(f"{self.name} has no controller {name!r}; it has {names}")
        return named

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        """Begin the episode ``options["start"]``, or the training episode of a seed."""
        start = (options or {}).get("start", Start("train", 0, seed or 0))
        self.decisions, self.returned, self.arrived = 0, 0.0, False
        self.chance, self.whim = start.rng(0), start.rng(1)
        self._begin(start)
        return self._observation(), {}

    def redraw(self, chance: np.random.Generator) -> None:
        """Draw anew what is still to come; where the system is now stays."""
        self.chance = chance

    def propose(self, observation: Vector, time: float = 0.0) -> Action:
        """What the controller wants; it is kept as ``proposed``."""
        self.proposed = self.controllers[self.controller](observation)
        return self.proposed

    def step(self, action: Action) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Execute an action until the next decision."""
        self.decisions += 1
        reward, failed = self._advance(action)
        self.returned += reward
        self.arrived = not failed and self._has_arrived()
        ended = failed or self.arrived
        over = not ended and self._is_over()
        return self._observation(), reward, ended, over, {"failed": failed}

    @property
    def score(self) -> float:
        """Of the episode so far: the sum of its rewards, unless `measure` says otherwise."""
        return self.returned

    @property
    def speed(self) -> float:
        """Mean speed of the episode so far [m/s]; NaN where nothing drives."""
        return math.nan

    @property
    @abstractmethod
    def controllers(self) -> Controllers:
        """By name, each from an observation to an action; random ones draw from ``whim``."""

    @abstractmethod
    def _begin(self, start: Start) -> None:
        """Draw the first state from ``chance``."""

    def _observation(self) -> Vector:
        """What is seen now; of environments of others, as they said it."""
        return np.asarray(self._seen, dtype=np.float64).ravel()

    @abstractmethod
    def _advance(self, action: Action) -> tuple[float, bool]:
        """Reward, and whether it failed."""

    def _wander(self, often: float = 0.1) -> Action:
        """Any action, drawn anew so often and held meanwhile."""
        if self._wanted is None or self.whim.random() < often:
            self._wanted = self.actions.drawn(self.whim)
        return self._wanted

    def _has_arrived(self) -> bool:
        """Whether a goal was reached, which ends the episode."""
        return False

    def _is_over(self) -> bool:
        return self.decisions >= self.steps


# -- Adaptive cruise control ----------------------------------------------------------------------


class Acc(System):
    """The task of REVEL, SPICE and VELM, from its equations; it fails where x >= 0.

    x is minus the gap and v the speed at which it closes; x' = x + dt v, v' = v + dt (a + noise).
    Closer pays more, so that who learns for the reward alone drives into what cannot be left again.
    A failure ends the episode; the steps that are left are paid as unsafe ones. With ``hold`` so
    many steps lie between two decisions.
    """

    variables = ("x", "v")
    actions = Box((-2.0,), (2.0,))
    train = 50
    #: Of a step [s], and standard deviation of the acceleration.
    dt, noise = 0.02, 0.5
    _STEPS, _LARGEST, _UNSAFE = 300, 10.0, -10.0

    def __init__(self, controller: str | None = None, *, hold: int = 1) -> None:
        self.name = "acc" if hold == 1 else f"acc-{hold}"
        self.interval, self.steps, self.hold = hold * self.dt, self._STEPS // hold, hold
        super().__init__(controller)

    @property
    def controllers(self) -> Controllers:
        """Full throttle alone."""
        return {"full throttle": lambda z: 2.0}

    def _begin(self, start: Start) -> None:
        self._x = float(self.chance.uniform(-1.1, -0.9))
        self._v = float(self.chance.uniform(-0.1, 0.1))
        self.redraw(self.chance)
        self._step = 0

    def redraw(self, chance: np.random.Generator) -> None:
        """Draw the noise, which is drawn for all steps at once."""
        super().redraw(chance)
        self._noise = chance.normal(0.0, self.noise, self._STEPS)

    def _observation(self) -> Vector:
        return np.array([self._x, self._v])

    def _advance(self, action: Action) -> tuple[float, bool]:
        reward, most = 0.0, self._LARGEST
        for _ in range(self.hold):
            speed = self._v + self.dt * (float(action) + self._noise[self._step])
            self._x = float(min(max(self._x + self.dt * self._v, -most), most))
            self._v = float(min(max(speed, -most), most))
            self._step += 1
            if self._x >= 0.0:
                return reward + self._UNSAFE * (1 + self._STEPS - self._step), True
            reward += 2.0 + self._x
        return reward, False


# -- Gymnasium's poles ----------------------------------------------------------------------------


def gymnasium_of(name: str, **given: Any) -> Any:
    """An environment of Gymnasium, without what it is wrapped in."""
    with needs("gymnasium", "gym", name):
        import gymnasium
    with warnings.catch_warnings():  # that newer versions of a task exist
        warnings.simplefilter("ignore", DeprecationWarning)
        return gymnasium.make(name, **given).unwrapped


class CartPole(System):
    """CartPole-v1, of 500 steps; it fails where the pole tips or the cart leaves the rail.

    The return counts the steps. With ``gusts`` a hand pushes the cart now and then for a while,
    which no observation shows.
    """

    variables = ("x [m]", "speed [m/s]", "angle [rad]", "rate [rad/s]")
    actions = Discrete(2)
    interval = 0.02
    steps = 500
    # A push: how likely it begins in a step, for how many (the last is left out), how strong [N].
    _PUSH_BEGINS, _PUSH_STEPS, _PUSH_FORCE = 0.01, (5, 16), (2.0, 5.0)
    # The bad one: far too much for the angle's rate and the place.
    _BAD_GAIN = np.array([1.0, 1.0, 8.0, 0.5])

    def __init__(self, controller: str | None = None, *, gusts: bool = False) -> None:
        self.name, self.train = ("cartpole-gusts", 60) if gusts else ("cartpole", 30)
        self._gusts = gusts
        self._env = gymnasium_of("CartPole-v1")
        self._force: float = self._env.force_mag
        super().__init__(controller)

    @property
    def controllers(self) -> Controllers:
        """Each by itself lets the pole fall in all but every episode."""
        return {
            "random": lambda z: self.actions.drawn(self.whim),
            "hasty": lambda z: int(z[2] >= -0.1),
            "badgain": lambda z: int(z @ self._BAD_GAIN > 0.0),
        }

    def _begin(self, start: Start) -> None:
        self._seen, _ = self._env.reset(seed=int(self.chance.integers(2**31)))
        self._push, self._push_left = 0.0, 0

    def _advance(self, action: Action) -> tuple[float, bool]:
        push = self._pushed() if self._gusts else 0.0
        self._env.force_mag = self._force + (1.0 if action == 1 else -1.0) * push
        self._seen, _, failed, _, _ = self._env.step(int(action))
        return 1.0, bool(failed)

    def _pushed(self) -> float:
        """What the hand adds to the motor's force [N]."""
        if self._push_left == 0 and self.chance.random() < self._PUSH_BEGINS:
            self._push_left = int(self.chance.integers(*self._PUSH_STEPS))
            side = -1.0 if self.chance.random() < 0.5 else 1.0
            self._push = side * float(self.chance.uniform(*self._PUSH_FORCE))
        if self._push_left == 0:
            return 0.0
        self._push_left -= 1
        return self._push


class Pendulum(System):
    """Pendulum-v1, held upright for 200 steps; it fails where it leans more than 0.5 rad.

    The return counts the steps. ``circular``: the angle is seen as its cosine and sine.
    """

    actions = Box((-2.0,), (2.0,))
    interval = 0.05
    steps = 200
    #: Leaning further is a failure [rad].
    fails = 0.5
    # Where it starts: largest angle [rad] and rate [rad/s].
    _FIRST = np.array([0.1, 0.3])

    def __init__(self, controller: str | None = None, *, circular: bool = False) -> None:
        self.name = "pendulum-cos" if circular else "pendulum"
        self.variables = (*(("cos", "sin") if circular else ("angle [rad]",)), "rate [rad/s]")
        self.circular = circular
        self._env = gymnasium_of("Pendulum-v1")
        super().__init__(controller)

    @property
    def controllers(self) -> Controllers:
        """Each by itself lets it fall in all but every episode."""
        return {
            "random": lambda z: self.actions.drawn(self.whim),
            "wander": lambda z: self._wander(),
            "badpd": lambda z: self._bad_feedback(),
        }

    def _bad_feedback(self) -> float:
        """That of the rate has the wrong sign."""
        angle, rate = self._state
        return float(np.clip(-4.0 * math.sin(angle) + 0.6 * rate, -2.0, 2.0))

    @property
    def _state(self) -> tuple[float, float]:
        """Angle from upright, in [-pi, pi) [rad], and its rate [rad/s]."""
        angle, rate = self._env.state
        return (float(angle) + math.pi) % (2.0 * math.pi) - math.pi, float(rate)

    def _begin(self, start: Start) -> None:
        self._env.reset(seed=0)
        self._env.state = self.chance.uniform(-self._FIRST, self._FIRST)
        self._wanted = 0.0

    def _observation(self) -> Vector:
        angle, rate = self._state
        seen = (math.cos(angle), math.sin(angle)) if self.circular else (angle,)
        return np.array([*seen, rate])

    def _advance(self, action: Action) -> tuple[float, bool]:
        self._env.step(np.array([float(action)]))
        return 1.0, abs(self._state[0]) > self.fails


# -- Tanks and a reactor --------------------------------------------------------------------------


class Tanks(System):
    """Two coupled tanks with two pumps, for 300 steps; it fails where one overflows or runs dry.

    Water leaves each tank by the root of its level (Torricelli), and flows through a pipe between
    them by the root of the difference. A pump takes a while to follow what it is told, so that a
    tank may be lost some time before it overflows. Now and then someone opens a tap for a while. An
    action is the share of its largest flow that each pump is to give.
    """

    name = "tanks"
    variables = ("level 1 [m]", "level 2 [m]", "flow 1 [m/s]", "flow 2 [m/s]")
    actions = Box((0.0, 0.0), (1.0, 1.0))
    interval = 1.0
    steps = 300
    # Levels that fail, and about where an episode starts [m].
    _DRY, _FULL, _MIDDLE = 0.1, 2.0, 1.0
    # Outflow at a level of 1 m, flow through the pipe at a difference of 1 m, largest flow of a
    # pump [m/s of level], and a pump's time constant [s].
    _OUTLET, _PIPE, _PUMP, _LAG = 0.03, 0.02, 0.15, 25.0
    _SUBSTEPS = 4
    # A tap: how likely one is opened in a step, for how many steps (the last is left out), and how
    # much more leaves its tank, as a share of the outlet.
    _TAP_OPENS, _TAP_STEPS, _TAP_FLOW = 0.02, (20, 60), (0.3, 1.0)

    @property
    def controllers(self) -> Controllers:
        """Each by itself fails in all but every episode; the last has its sensors exchanged."""
        return {
            "full": lambda z: np.ones(2),
            "wander": lambda z: self._sets_pumps(),
            "exchanged": lambda z: np.clip(0.5 - 2.0 * (z[1::-1] - self._MIDDLE), 0.0, 1.0),
        }

    def _sets_pumps(self) -> Vector:
        for pump in range(2):
            if self.whim.random() < 0.05:
                self._set[pump] = self.whim.uniform()
        return np.array(self._set)

    def _begin(self, start: Start) -> None:
        self._levels = self._MIDDLE + self.chance.uniform(-0.2, 0.2, 2)
        self._flows = self._OUTLET * np.sqrt(self._levels)
        self._set = self.whim.uniform(size=2)
        self._taps, self._tap_left = np.zeros(2), 0

    def _observation(self) -> Vector:
        return np.concatenate([self._levels, self._flows])

    def _advance(self, action: Action) -> tuple[float, bool]:
        self._turn_taps()
        wanted = self._PUMP * np.clip(np.asarray(action, dtype=np.float64), 0.0, 1.0)
        dt = self.interval / self._SUBSTEPS
        for _ in range(self._SUBSTEPS):
            first, second = self._levels
            across = self._PIPE * math.copysign(math.sqrt(abs(first - second)), first - second)
            out = self._OUTLET * (1.0 + self._taps) * np.sqrt(np.maximum(self._levels, 0.0))
            self._levels = self._levels + dt * (self._flows - out + [-across, across])
            self._flows = self._flows + dt / self._LAG * (wanted - self._flows)
        return 1.0, bool(np.any((self._levels <= self._DRY) | (self._levels >= self._FULL)))

    def _turn_taps(self) -> None:
        """Open a tap, or close the one that is open."""
        if self._tap_left > 0:
            self._tap_left -= 1
            return
        self._taps = np.zeros(2)
        if self.chance.random() < self._TAP_OPENS:
            self._tap_left = int(self.chance.integers(*self._TAP_STEPS))
            self._taps[self.chance.integers(2)] = self.chance.uniform(*self._TAP_FLOW)


class Reactor(System):
    """A reactor that is fed for 300 steps, whose cooling fails for a while; it fails by runaway.

    What is fed reacts the faster the hotter it is, and heats the reactor as it does. What has not
    reacted yet is heat to come: fed too fast, nothing can stop it once the cooling fails. Whether
    it has failed is not observed, and shows in the temperature only some steps later. An action is
    0 to feed nothing, 1 slowly, 2 fast; the return is what was fed, in units.
    """

    name = "reactor"
    variables = ("temperature [°C]", "unreacted")
    actions = Discrete(3)
    interval = 1.0
    steps = 300
    _FEEDS = (0.0, 0.015, 0.04)  # units fed in a step
    _FAILS, _COOLANT = 100.0, 20.0  # temperature of the runaway, and of the coolant [°C]
    _COOLING, _BROKEN = 0.1, 0.01  # share of the difference to it that is lost in a step
    _HEAT = 80.0  # of a unit that reacts [K]
    # Share that reacts in a step at a temperature [°C], and which doubles with so much more [K].
    _RATE, _REFERENCE, _DOUBLES = 0.05, 60.0, 10.0
    _NOISE = 0.1  # of the temperature in a step [K]
    # How likely the cooling fails in a step, and for how many (the last is left out).
    _FAILURE_BEGINS, _FAILURE_STEPS = 0.02, (20, 61)

    @property
    def controllers(self) -> Controllers:
        """Each by itself fails in all but every episode."""
        return {
            "hurried": lambda z: 2,
            "thermostat": lambda z: 2 if z[0] < 70.0 else 0,
            "random": lambda z: self.actions.drawn(self.whim),
        }

    def _begin(self, start: Start) -> None:
        self._temperature = float(self.chance.uniform(35.0, 45.0))
        self._unreacted, self._fails_for = 0.0, 0

    def _observation(self) -> Vector:
        return np.array([self._temperature, self._unreacted])

    def _advance(self, action: Action) -> tuple[float, bool]:
        if self._fails_for > 0:
            self._fails_for -= 1
        elif self.chance.random() < self._FAILURE_BEGINS:
            self._fails_for = int(self.chance.integers(*self._FAILURE_STEPS))
        lost = self._BROKEN if self._fails_for > 0 else self._COOLING
        speed = self._RATE * 2.0 ** ((self._temperature - self._REFERENCE) / self._DOUBLES)
        reacted = self._unreacted * (1.0 - np.exp(-speed))
        fed = self._FEEDS[int(action)]
        self._temperature += float(
            self._HEAT * reacted
            - lost * (self._temperature - self._COOLANT)
            + self.chance.normal(0.0, self._NOISE)
        )
        self._unreacted += float(fed - reacted)
        return fed, self._temperature >= self._FAILS


# -- Cars -----------------------------------------------------------------------------------------


class Cars(System):
    """A family of car following, in closed form, by the drivers that it draws; a collision fails.

    The score is mobility: distance, in those of the driver alone in the same draw.
    """

    variables = ("gap [m]", "own speed [m/s]", "leader's speed [m/s]")
    train = 100
    measure = "mobility"

    def __init__(self, controller: str | None = None, *, family: str) -> None:
        self.name, self.family = family, _family(family)
        self.actions = Box((self.family.actions.low,), (self.family.actions.high,))
        self.interval = self.family.interval
        super().__init__(controller)

    @property
    def controllers(self) -> Controllers:
        """The driver of each draw."""
        return {"driver": self._driver}

    def _driver(self, observation: Vector) -> float:
        wanted = self._draw.controller.propose(observation, self.road.time).action
        return float(np.clip(wanted, self.family.actions.low, self.family.actions.high))

    def _begin(self, start: Start) -> None:
        self._start, self._draw = start, _draw(self.family, start)
        scenario = self._draw.scenario
        self._per_decision = scenario.steps(self.interval)
        self.steps = round(scenario.duration / self.interval)
        with KinematicWorld().open(scenario) as road:
            self.road = road

    def _observation(self) -> Vector:
        return np.asarray(self.road.observation, dtype=np.float64)

    def _advance(self, action: Action) -> tuple[float, bool]:
        self.road.advance(float(action), self._per_decision)
        return 0.0, self.road.collided

    def _is_over(self) -> bool:
        return self.road.over

    @property
    def score(self) -> float:
        """Mobility."""
        return outcome_of(self.road.episode(), _alone(self.name, self._start)).mobility


_family = lru_cache(load_family)


def _draw(family: Family, start: Start) -> Draw:
    return family.draw(start.seed, start.episode, split=start.split)


@lru_cache(maxsize=4096)
def _alone(name: str, start: Start) -> Any:
    """How far the driver comes by itself; the same draws are driven by every judge."""
    return reference_of(_family(name), _draw(_family(name), start))


# -- A labelled task of masa-safe-rl --------------------------------------------------------------

_MASA_INSTALL = "pip install --no-deps masa-safe-rl"


class Masa(System):
    """The obstacle of masa-safe-rl in 200 steps; it fails where the package's labels cost anything.

    The return is the sum of the package's rewards. It needs dozens of other packages, of which this
    task needs none.
    """

    name = "masa-obstacle"
    variables = ("x", "y", "speed x", "speed y")
    interval = 1.0
    steps = 200
    # Where the curious one goes: to and fro between places drawn from here, some in the obstacle.
    _PLACES = np.array([[-0.4, 2.0], [0.0, 3.4]])
    _goes_to: Vector

    def __init__(self, controller: str | None = None) -> None:
        try:
            found = import_module("masa.envs.continuous.obstacle")
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(f"{self.name} needs masa-safe-rl: {_MASA_INSTALL}") from error
        self._cost: Callable[[Any], float] = lambda seen: found.cost_fn(found.label_fn(seen))
        with warnings.catch_warnings():  # that its boxes are cast to 32 bits
            warnings.simplefilter("ignore", UserWarning)
            self._env: Any = found.Obstacle()
        self.actions = actions_of(self._env.action_space)
        super().__init__(controller)

    @property
    def controllers(self) -> Controllers:
        """Each by itself fails in most episodes."""
        return {"curious": self._curious, "wander": lambda z: self._wander()}

    def _curious(self, observation: Vector) -> Action:
        place, speed = observation[:2], observation[2:]
        if np.abs(self._goes_to - place).max() < 0.1:
            self._goes_to = self.whim.uniform(*self._PLACES.T)
        return np.clip(4.0 * (self._goes_to - place) - 40.0 * speed, -2.0, 2.0)

    def _begin(self, start: Start) -> None:
        # The package takes a seed of 0 for none.
        self._seen, _ = self._env.reset(seed=1 + int(self.chance.integers(2**31 - 1)))
        self._wanted = None
        self._goes_to = self.whim.uniform(*self._PLACES.T)
        self._seen_goal = False

    def _advance(self, action: Action) -> tuple[float, bool]:
        space = self._env.action_space
        given = np.clip(np.asarray(action, np.float32), space.low, space.high)
        self._seen, reward, self._seen_goal, _, _ = self._env.step(given)
        return float(reward), self._cost(self._seen) > 0.0

    def _has_arrived(self) -> bool:
        return bool(self._seen_goal)


# -- highway-env ----------------------------------------------------------------------------------


class Highway(System):
    """``highway-fast``, ``merge`` or ``intersection`` of highway-env as it comes; a crash fails.

    An observation is its Kinematics, flattened: a row for the car itself and one for each of the
    nearest others. The controller ``dqn`` is a deep Q-network that was trained on the task without
    any guard (``tools/train_dqn.py``).
    """

    interval = 1.0
    train = 200
    learners = ("scene",)
    # Decisions of an episode, at most; merge has no limit of its own, and is over long before.
    _STEPS: ClassVar[dict[str, int]] = {"highway-fast": 30, "merge": 60, "intersection": 13}

    def __init__(self, controller: str | None = None, *, task: str) -> None:
        self.name, self.steps = task, self._STEPS[task]
        _habits()
        self.env = gymnasium_of(f"{task}-v0")
        config = self.env.config["observation"]
        count, columns = self.env.observation_space.shape
        #: How a row is laid out: numbers in it, and whether others are relative to the car.
        self.columns, self.relative = columns, not config.get("absolute", False)
        features = config.get("features", ("presence", "x", "y", "vx", "vy"))
        self.variables = tuple(f"{name} {k}" for k in range(count) for name in features)
        self.actions = Discrete(int(self.env.action_space.n))
        #: What the actions are called, by index; a car of the intersection cannot leave its lane.
        self.names = ("left", "idle", "right", "faster", "slower")
        if self.actions.n_actions == 3:
            self.names = ("slower", "idle", "faster")  # type: ignore[assignment]
        super().__init__(controller)

    @property
    def controllers(self) -> Controllers:
        """Those that act without looking, and one that was trained."""
        idle, faster = self.names.index("idle"), self.names.index("faster")
        return {
            "random": lambda z: self.actions.drawn(self.whim),
            "idle": lambda z: idle,
            "faster": lambda z: faster,
            "dqn": self._trained,
        }

    @property
    def speed(self) -> float:
        """Mean speed of the episode so far [m/s]; NaN before the first decision."""
        return float(np.mean(self._speeds)) if self._speeds else math.nan

    def _trained(self, observation: Vector) -> int:
        """The action that the network values most."""
        value, layers = observation, read_weights(self.name)
        for k, (weight, bias) in enumerate(layers):
            value = weight @ value + bias
            if k < len(layers) - 1:
                value = np.maximum(value, 0.0)
        return int(value.argmax())

    def _begin(self, start: Start) -> None:
        _set_habits(_habits())
        self._seen, _ = self.env.reset(seed=int(self.chance.integers(2**31)))
        self._driven = _habits_now()
        self._ended = False
        self._speeds: list[float] = []

    def _advance(self, action: Action) -> tuple[float, bool]:
        _set_habits(self._driven)
        self._seen, reward, terminated, truncated, info = self.env.step(int(action))
        self._speeds.append(float(info["speed"]))
        self._ended = bool(terminated or truncated)
        return float(reward), bool(info["crashed"])

    def _is_over(self) -> bool:
        return self._ended or super()._is_over()


@lru_cache
def read_weights(task: str) -> list[tuple[Vector, Vector]]:
    """Weights and biases of each layer of the network that was trained on a task."""
    with np.load(Path(__file__).with_name("weights") / f"{task}.npz") as arrays:
        return [
            (arrays[f"weight{k}"].astype(np.float64), arrays[f"bias{k}"].astype(np.float64))
            for k in range(len(arrays.files) // 2)
        ]


def _idm_vehicle() -> Any:
    with needs("highway-env", "highway", "a task of highway-env"):
        from highway_env.vehicle.behavior import IDMVehicle  # registers environments, too
    return IDMVehicle


def _habits_now() -> dict[str, Any]:
    """How other cars drive; an environment may set it for all that the process has."""
    return {name: value for name, value in vars(_idm_vehicle()).items() if name.isupper()}


@lru_cache
def _habits() -> dict[str, Any]:
    """Those before any environment was made: what the intersection sets stays set afterwards."""
    return _habits_now()


def _set_habits(habits: Mapping[str, Any]) -> None:
    for name, value in habits.items():
        setattr(_idm_vehicle(), name, value)


# -- By name --------------------------------------------------------------------------------------

#: Makes the system with the controller of that name, or with its first one.
SYSTEMS: dict[str, Callable[[str | None], System]] = {
    "acc": Acc,
    "acc-5": partial(Acc, hold=5),
    "cartpole": CartPole,
    "cartpole-gusts": partial(CartPole, gusts=True),
    "pendulum": Pendulum,
    "pendulum-cos": partial(Pendulum, circular=True),
    "tanks": Tanks,
    "reactor": Reactor,
    "emergency": partial(Cars, family="emergency"),
    "cut_in": partial(Cars, family="cut_in"),
}
HIGHWAY: dict[str, Callable[[str | None], System]] = {
    task: partial(Highway, task=task) for task in ("highway-fast", "merge", "intersection")
}
#: Those that others set, which `python -m studies tasks` compares.
TASKS: dict[str, Callable[[str | None], System]] = {
    **{name: SYSTEMS[name] for name in ("acc", "acc-5", "cartpole", "pendulum", "pendulum-cos")},
    "masa-obstacle": Masa,
    **HIGHWAY,
}


def lacking(name: str) -> str:
    """What installs the package that a task lacks; empty where it lacks none.

    >>> lacking("acc")
    ''
    """
    if name.startswith("masa-") and not find_spec("masa"):
        return f"it needs masa-safe-rl ({_MASA_INSTALL})"
    if name in HIGHWAY and not find_spec("highway_env"):
        return f"it needs highway-env ({install('highway')})"
    from studies.shapes import NEEDS  # derives its systems from those here

    package, extra = NEEDS.get(name, ("", ""))
    if package and not find_spec(package):
        return f"it needs {package} (pip install 'gymnasium[{extra}]')"
    return ""


def make_system(name: str, controller: str | None = None) -> System:
    """A system by its name, with its first controller unless another one is named.

    It is one of `SYSTEMS`, `TASKS`, `SHAPES` or `PEERS`, a family of scenarios (``emergency+noise``
    with a switch), or ``module:Name`` of a class derived from `System`, which is looked for in the
    present folder too.

    >>> system = make_system("acc")
    >>> list(system.controllers), system.interval, system.steps
    (['full throttle'], 0.02, 300)
    """
    if ":" in name:
        made = imported(name)(controller)
        if not isinstance(made, System):
            raise TypeError(f"{name} makes a {type(made).__name__}, which is no System")
        return made
    from studies.shapes import PEERS, SHAPES  # derives its systems from those here

    known = SYSTEMS | TASKS | SHAPES | PEERS
    families = [*FAMILIES, name] if name.partition("+")[0] in FAMILIES else FAMILIES
    known |= {one: partial(Cars, family=one) for one in families if one not in known}
    if name not in known:
        raise ValueError(f"there is no system {name!r}; there are {', '.join(known)}")
    return known[name](controller)

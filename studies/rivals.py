"""Judges of others that ours are compared with; most of them are told how their system moves."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from copy import copy, deepcopy
from functools import partial
from itertools import product
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from evofsm.fsm import EvolvingFSM, Novelty
from evofsm.guard import Proposal
from studies.systems import (
    Acc,
    Action,
    Box,
    CartPole,
    Discrete,
    Highway,
    Masa,
    Pendulum,
    System,
    Vector,
)

#: (k, m) states, and (k, d) or (k,) actions.
States = NDArray[np.float64]


class Executed(NamedTuple):
    """What a rival decided."""

    executed: Action


class Rival(ABC):
    """A judge that is told what it knows; one that learns has ``end`` and ``freeze`` as well."""

    told: str  #: in a few words
    interval: float = math.nan  #: between decisions, and what else guards have
    situation: Any = None
    actions: Any = None

    def begin(self) -> None:  # noqa: B027
        """Begin an episode."""

    def decide(
        self, observation: Vector, proposal: Any, time: float = 0.0, *, episode: Any = None
    ) -> Executed:
        """What to execute instead of a proposal."""
        wanted = proposal.action if isinstance(proposal, Proposal) else proposal
        return Executed(self.action(observation, wanted))

    def end(  # noqa: B027
        self, failed: bool = False, observation: Vector | None = None, **how: Any
    ) -> None:
        """End the episode."""

    def freeze(self) -> None:  # noqa: B027
        """Learn nothing from now on."""

    @abstractmethod
    def action(self, observation: Vector, proposal: Action) -> Action:
        """The action to execute."""


class Unrevised(Rival):
    """Executes what is proposed."""

    told = "nothing"

    def action(self, observation: Vector, proposal: Action) -> Action:
        """The proposal."""
        return proposal


def tried(actions: Box | Discrete, each: int | None = None) -> States:
    """(k,) or (k, d) actions that stand for all; of a box so many of each number, ends included."""
    if isinstance(actions, Discrete):
        return np.arange(actions.n_actions, dtype=np.float64)
    each = each or {1: 41, 2: 9}[len(actions.low)]
    ends = zip(actions.low, actions.high, strict=True)
    axes = [np.linspace(low, high, each) for low, high in ends]
    return axes[0] if len(axes) == 1 else np.array(list(product(*axes)))


def as_action(value: States, actions: Box | Discrete) -> Action:
    """One of those that were tried, as it is executed."""
    if isinstance(actions, Discrete):
        return int(value)
    return float(value) if np.ndim(value) == 0 else value


# -- Keep what a backup policy, or a regulator, can save ------------------------------------------


class ObstacleShield(Rival):
    """Stops before masa-safe-rl's obstacle, whose corners are (0, 2) and (1, 3).

    It executes the closest action that is survived if full brakes follow. Where there is none, the
    action is taken after which the failure comes last. This is a predictive safety filter
    (Wabersich and Zeilinger 2021) with a single backup and no disturbance.
    """

    told = "dynamics and limits"
    _STEPS = 12  # that have to be survived
    # Of an action, of a speed, way of a step at speed 1; and the package counts in 32 bits.
    _GAIN, _FASTEST, _AHEAD, _ROUNDING = 0.005, 0.05, 2.0, 1e-6

    def __init__(self, actions: Box) -> None:
        self._actions, self._tried = actions, tried(actions)

    def action(self, observation: Vector, proposal: Action) -> Action:
        """The proposal, or the closest action after which braking lasts."""
        if self._lasts(observation, np.array([proposal], np.float64))[0] == self._STEPS:
            return proposal
        lasts = self._lasts(observation, self._tried)
        away = np.abs(self._tried - proposal).sum(axis=1)
        return as_action(self._tried[int(np.lexsort((away, -lasts))[0])], self._actions)

    def _lasts(self, state: Vector, first: States) -> NDArray[np.int64]:
        """(k,) steps that are survived after each action."""
        states = self._move(np.repeat(state[None], len(first), axis=0), first)
        lasts, alive = np.zeros(len(first), np.int64), ~self._fails(states)
        for _ in range(self._STEPS):
            lasts += alive
            brakes = np.clip(-states[:, 2:] / self._GAIN, self._actions.low, self._actions.high)
            states = self._move(states, brakes)
            alive &= ~self._fails(states)
        return lasts

    def _move(self, states: States, taken: States) -> States:
        speed = np.clip(states[:, 2:] + self._GAIN * taken, -self._FASTEST, self._FASTEST)
        return np.hstack([states[:, :2] + self._AHEAD * speed, speed])

    def _fails(self, states: States) -> NDArray[np.bool_]:
        low, high = np.array([0.0, 2.0]) - self._ROUNDING, np.array([1.0, 3.0]) + self._ROUNDING
        return np.asarray(np.all((states[:, :2] >= low) & (states[:, :2] <= high), axis=1))


class LevelSet(Rival):
    """Keeps a pole where the quadratic regulator can hold it, by the linear model about upright.

    The regulator's cost to go, V(z) = z' P z, falls under the regulator wherever that is not
    limited. The largest ellipsoid V(z) <= c in which nothing fails, and no action is limited, is
    never left: the closest action is taken after which one is within it, else the one after which V
    is smallest. The model is z' = system z + control u.

    Parameters
    ----------
    actions : Box or Discrete
    system : (m, m) ndarray
    control : (m,) ndarray
    edges : mapping of int to float
        Of variables, in both directions: beyond is a failure.
    limit : float
        Largest u.
    cost : (m,) array_like
        Of each squared variable.
    read : callable, optional
        From an observation to z.
    push : callable, optional
        From actions to u.
    """

    told = "linear model and limits"

    def __init__(
        self,
        actions: Box | Discrete,
        system: States,
        control: Vector,
        edges: Mapping[int, float],
        limit: float,
        cost: tuple[float, ...],
        *,
        read: Callable[[Vector], Vector] = lambda observation: observation,
        push: Callable[[States], States] = lambda taken: taken,
    ) -> None:
        self._actions, self._tried = actions, tried(actions)
        self._system, self._control = system, control
        self._read, self._push = read, push
        b = control[:, None]
        value = self._value = solve_discrete_are(system, b, np.diag(cost), np.eye(1))
        gain = np.linalg.solve(1.0 + b.T @ value @ b, b.T @ value @ system)
        spread = np.linalg.inv(value)
        levels = [edge**2 / spread[i, i] for i, edge in edges.items()]
        self._level = min(*levels, limit**2 / float((gain @ spread @ gain.T)[0, 0]))

    def action(self, observation: Vector, proposal: Action) -> Action:
        """The proposal, or the closest action after which the ellipsoid is not left."""
        state = self._system @ self._read(observation)
        if self._after(state, np.array([proposal], np.float64))[0] <= self._level:
            return proposal
        value = self._after(state, self._tried)
        away = np.where(value <= self._level, np.abs(self._tried - proposal), np.inf)
        best = int(np.argmin(away if np.isfinite(away).any() else value))
        return as_action(self._tried[best], self._actions)

    def _after(self, state: Vector, taken: States) -> States:
        """(k,) V after each action."""
        after = state + self._push(taken)[:, None] * self._control
        return np.asarray(np.einsum("ki,ij,kj->k", after, self._value, after))


def cart_shield(actions: Discrete) -> LevelSet:
    """Of CartPole, with its two forces."""
    # Gravity [m/s²], masses of the cart and of the pole [kg], half the pole [m], force [N], step.
    gravity, cart, pole, half, force, dt = 9.8, 1.0, 0.1, 0.5, 10.0, 0.02
    mass, inertia = cart + pole, half * (4.0 / 3.0 - pole / (cart + pole))
    of_angle, of_force = gravity / inertia, -1.0 / (mass * inertia)
    lever = pole * half / mass
    change = np.zeros((4, 4))
    change[0, 1] = change[2, 3] = 1.0
    change[1, 2], change[3, 2] = -lever * of_angle, of_angle
    control = dt * force * np.array([0.0, 1.0 / mass - lever * of_force, 0.0, of_force])
    edges, cost = {0: 2.4, 2: 0.2095}, (0.1, 0.1, 1.0, 0.1)
    push = lambda taken: 2.0 * taken - 1.0  # noqa: E731
    return LevelSet(actions, np.eye(4) + dt * change, control, edges, 1.0, cost, push=push)


def pendulum_shield(actions: Box, fails: float, circular: bool, dt: float = 0.05) -> LevelSet:
    """Of Pendulum with steps of ``dt`` [s]; it fails where the angle is beyond ``fails`` [rad]."""
    # Pull of gravity [1/s²] and of a torque [1/(kg m²)] on the rate.
    falls, torque = 15.0, 3.0
    # The rate changes first, and the angle by the new rate.
    system = np.array([[1.0 + dt * dt * falls, dt], [dt * falls, 1.0]])
    control = dt * torque * np.array([dt, 1.0])

    def read(observation: Vector) -> Vector:
        if not circular:
            return observation
        return np.array([np.arctan2(observation[1], observation[0]), observation[2]])

    limit = actions.high[0]
    return LevelSet(actions, system, control, {0: fails}, limit, (0.1, 0.1), read=read)


# -- Adaptive cruise control ----------------------------------------------------------------------


class ToldOfAcc(Rival):
    """What these know of `Acc`: its equations, the limits of the acceleration, and the noise."""

    told = "dynamics and noise"
    # Standard deviations of what the noise adds up to, that are kept away.
    _SURE = 4.0

    def __init__(self, system: Acc) -> None:
        self._dt, self._hold, self._noise = system.dt, system.hold, system.noise
        self._limit = system.actions.high[0]
        self._time = self._dt * self._hold
        self._to_place = 0.5 * self._dt**2 * self._hold * (self._hold - 1)  # in a decision

    def _margin(self, speed: float) -> float:
        """What the noise may add to the way of a decision, and of the stop after it."""
        faster = self._SURE * self._noise * self._dt * math.sqrt(self._hold)
        steps = self._hold + (max(speed, 0.0) + faster) / (self._limit * self._dt)
        drift = self._SURE * self._noise * self._dt**2 * math.sqrt(steps**3 / 3.0)
        return drift + faster * (0.5 * faster / self._limit + self._dt)


class StoppingDistance(ToldOfAcc):
    """The largest acceleration up to the proposal after which it can still stop short of 0."""

    def action(self, observation: Vector, proposal: Action) -> Action:
        """By bisection: what is left after the decision falls as the acceleration rises."""
        x, v = observation
        low, high = -self._limit, float(proposal)
        if self._left(x, v, high) >= 0.0:
            return high
        for _ in range(30):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._left(x, v, middle) >= 0.0 else (low, middle)
        return low

    def _left(self, x: float, v: float, action: float) -> float:
        """Of the way, after the decision and a stop with full brakes."""
        after = v + self._time * action
        x += self._time * v + self._to_place * action
        closing = max(after, 0.0)
        stopping = closing * (0.5 * closing / self._limit + self._dt)
        return -(x + stopping + self._margin(max(v, closing)))


class Barrier(ToldOfAcc):
    """A control barrier function in discrete time (Agrawal and Sreenath 2017), in closed form.

    h(x, v) = -x - v² / (2 limit) - margin for v > 0, and -x - margin else, must not fall by more
    than 5 % in a step: h(z') >= (1 - share) h(z). The closest such action is the root of a
    quadratic equation.
    """

    def action(self, observation: Vector, proposal: Action) -> Action:
        """The largest acceleration up to the proposal that the condition allows."""
        x, v = map(float, observation)
        kept = 0.95**self._hold
        margin = self._margin(max(v, 0.0) + self._time * self._limit)
        safe = -x - 0.5 * max(v, 0.0) ** 2 / self._limit - margin
        # h after the decision, less what it has to be: -(a u² + b u + c), where it still closes.
        a = 0.5 * self._time**2 / self._limit
        b = self._time * v / self._limit + self._to_place
        c = x + self._time * v + 0.5 * v**2 / self._limit + margin + kept * safe
        inside = b * b - 4.0 * a * c
        largest = (-b + math.sqrt(inside)) / (2.0 * a) if inside >= 0.0 else -self._limit
        if v + self._time * largest < 0.0 and self._to_place:  # it opens: no distance to stop
            largest = -(x + self._time * v + margin + kept * safe) / self._to_place
        return min(float(proposal), max(largest, -self._limit), self._limit)


# -- States and counted matrices alone ------------------------------------------------------------


class Counted(Rival):
    """Keeps the closest action under which failing soon is unlikely, by counts.

    The states are those of an `EvolvingFSM`, one of them the failure; its matrices say how likely
    it is to fail within 50 decisions if the action is taken now and the best ones afterwards
    (bounded reachability, as in shields of Markov decision processes: Jansen et al. 2020). The
    first episode sets the scales and is decided by nobody. Of the system it is told the actions.
    """

    told = "nothing but failures"
    # A state reaches so far, in standard deviations of the first episode, and so narrow that what
    # is counted in it is not spread over its neighbours, and forgotten there.
    _RULE: ClassVar[dict[str, float]] = {"radius": 0.5, "spread": 0.1}
    _MOST_STATES = 200
    # Failure is one more state, so far away that nothing else is taken for it.
    _AWAY = 1e3
    # How far ahead it looks, in decisions, and the highest probability that it accepts.
    _STEPS, _ACCEPTED = 50, 0.05
    # Actions of a box that are told apart, about: as many along each axis, two of them at least.
    _LEVELS = 9

    def __init__(self, system: System) -> None:
        self._discrete = isinstance(system.actions, Discrete)
        numbers = 1 if self._discrete else len(system.actions.low)
        levels = tried(system.actions, max(2, round(self._LEVELS ** (1.0 / numbers))))
        self._actions = levels.reshape(len(levels), -1)
        self._machine: EvolvingFSM | None = None
        self._failed_at: Vector = np.empty(0)
        self._risk: States = np.empty((0, 0))  # (actions, states)
        self._seen: list[Vector] = []
        self._done: list[int] = []
        self._learn = True

    def begin(self) -> None:
        """Begin an episode."""
        self._seen, self._done = [], []

    def action(self, observation: Vector, proposal: Action) -> Action:
        """The proposal, or the closest action that is accepted."""
        wanted = np.atleast_1d(np.asarray(proposal, np.float64))
        away = np.abs(self._actions - wanted).sum(axis=1)
        action, executed = int(np.argmin(away)), proposal
        if len(self._risk):
            risk = self._risk @ self._model.recognise(observation)
            if risk[action] > self._ACCEPTED:
                fine = risk <= max(self._ACCEPTED, float(risk.min()))
                action = int(np.argmin(np.where(fine, away, np.inf)))
                value = self._actions[action]
                one = float(value[0]) if len(value) == 1 else value.copy()
                executed = action if self._discrete else one
        self._seen.append(np.array(observation))
        self._done.append(action)
        return executed

    def end(self, failed: bool = False, observation: Vector | None = None, **how: Any) -> None:
        """Count the episode, and what it says of all others."""
        if not (self._learn and self._done):
            return
        machine = self._machine = self._machine or self._made()
        machine.start_episode()
        for seen, action in zip(self._seen, self._done, strict=True):
            machine.observe(seen)
            machine.act(action)
        if failed:
            machine.observe(self._failed_at)
        elif observation is not None:
            machine.observe(observation)
        self._plan(machine)

    def freeze(self) -> None:
        """Learn nothing from now on."""
        self._learn = False

    def _made(self) -> EvolvingFSM:
        seen = np.array(self._seen)
        scales = np.maximum(seen.std(axis=0), 1e-6)
        self._failed_at = seen.mean(axis=0) + self._AWAY * scales
        rule = Novelty(scales=tuple(scales.tolist()), **self._RULE)
        return EvolvingFSM(len(self._actions), rule=rule, max_states=self._MOST_STATES)

    def _plan(self, machine: EvolvingFSM) -> None:
        """Probability of failing within some decisions, of each action in each state."""
        self._model = machine.model()
        matrices = self._model.transition_matrices
        failure = int(self._model.recognise(self._failed_at).argmax())
        if not np.allclose(self._model.centers[failure], self._failed_at):
            return  # it has not failed yet
        soon = np.zeros(self._model.n_states)
        soon[failure] = 1.0
        for _ in range(self._STEPS):
            risk = matrices @ soon
            risk[:, failure] = 1.0
            soon = risk.min(axis=0)
        self._risk = risk


# -- highway-env ----------------------------------------------------------------------------------
# They read the environment itself, not its observation, so they also know what a guard is not
# shown: lanes, cars behind, target speeds.


class OnTheRoad(Rival):
    """A judge that reads the environment itself."""

    needs_lanes: ClassVar[bool] = True  #: whether it only fits where lanes can be chosen

    def __init__(self, system: Highway) -> None:
        self.system = system
        self.index = {name: k for k, name in enumerate(system.names)}

    def action(self, observation: Vector, proposal: Action) -> Action:
        """Index of the action to execute."""
        return int(self.chosen(int(proposal)))

    @abstractmethod
    def chosen(self, proposal: int) -> int:
        """Index of the action to execute instead of a proposal."""

    @property
    def car(self) -> Any:
        """The car itself."""
        return self.system.env.vehicle

    def lane_beside(self, to: int) -> Any | None:
        """Index of the lane by so many to the right of the car's target; None where none is."""
        car = self.car
        start, end, lane = car.target_lane_index
        beside = (start, end, lane + to)
        if not 0 <= lane + to < len(car.road.network.graph[start][end]):
            return None
        return beside if car.road.network.get_lane(beside).is_reachable_from(car.position) else None


class Slower(OnTheRoad):
    """Always slower: what can be had without looking."""

    told = "which action is slower"
    needs_lanes = False

    def chosen(self, proposal: int) -> int:
        """Slower."""
        return self.index["slower"]


class CarFollower(OnTheRoad):
    """The environment's own driver: IDM along the lane, MOBIL across; it heeds no proposal."""

    told = "road, all cars, how they drive"
    needs_lanes = False

    def chosen(self, proposal: int) -> int:
        """What is closest to what such a driver would do."""
        from highway_env.vehicle.behavior import IDMVehicle

        car = self.car
        driver = IDMVehicle.create_from(car)
        driver.target_speed = float(car.target_speeds[-1])
        driver.road = copy(car.road)  # where the car itself is not in its way
        driver.road.vehicles = [one for one in car.road.vehicles if one is not car]
        if "left" in self.index and car.lane_index == car.target_lane_index:
            for to, name in ((-1, "left"), (1, "right")):
                beside = self.lane_beside(to)
                if beside is not None and driver.mobil(beside):
                    return self.index[name]
        lanes = (car.lane_index, car.target_lane_index)
        ahead = [car.road.neighbour_vehicles(car, lane)[0] for lane in lanes]
        wanted = min(driver.acceleration(driver, front_vehicle=one) for one in ahead)
        wanted = float(np.clip(wanted, -driver.ACC_MAX, driver.ACC_MAX)) * self.system.interval
        # Half way to the next speed that the car can keep.
        half = 0.5 * float(car.target_speeds[1] - car.target_speeds[0])
        return self.index["slower" if wanted < -half else "faster" if wanted > half else "idle"]


class Rss(OnTheRoad):
    """Responsibility-sensitive safety (Shalev-Shwartz et al. 2017), on each lane concerned.

    A proposal whose gaps are long enough is kept; else it is slower.
    """

    told = "lanes, all cars, brakes"
    # What cars of highway-env keep to: brakes of both, and throttle while reacting [m/s²].
    _BRAKES, _THROTTLE = 5.0, 3.0

    def chosen(self, proposal: int) -> int:
        """The proposal, or slower."""
        name, car = self.system.names[proposal], self.car
        beside = self.lane_beside({"left": -1, "right": 1}.get(name, 0))
        lanes = {car.lane_index, car.target_lane_index} | ({beside} if beside else set())
        step = {"faster": 1, "slower": -1}.get(name, 0)
        most = len(car.target_speeds) - 1
        speed = car.index_to_speed(int(np.clip(car.speed_to_index(car.speed) + step, 0, most)))
        changes = beside is not None and beside != car.lane_index
        for lane in lanes:
            leader, follower = car.road.neighbour_vehicles(car, lane)
            if leader is not None and not self.is_enough(car, leader, speed):
                return self.index["slower"]
            cut_in = changes and lane == beside and follower is not None
            if cut_in and not self.is_enough(follower, car, follower.speed):
                return self.index["slower"]
        return proposal

    def gap(self, behind: Any, leader: Any) -> float:
        """From bumper to bumper [m]."""
        middle = float(behind.lane_distance_to(leader))
        return middle - 0.5 * float(behind.LENGTH + leader.LENGTH)

    def is_enough(self, behind: Any, leader: Any, speed: float) -> bool:
        """Whether who follows can stop behind a leader that brakes in full."""
        react = self.system.interval
        now = max(float(behind.speed), speed)
        then = now + (react * self._THROTTLE if speed > behind.speed else 0.0)
        least = now * react + then**2 / (2.0 * self._BRAKES)
        least -= max(float(leader.speed), 0.0) ** 2 / (2.0 * self._BRAKES)
        return bool(self.gap(behind, leader) >= max(least, 0.0))


class Simulated(OnTheRoad):
    """Tries on copies of the environment, which draw the same chances: the most that can be known.

    A proposal is kept where some action that follows for good is survived for four steps. Otherwise
    the first action is taken of which that is true: the same speed, slower, faster, a lane change.
    """

    told = "the future, by copies of the simulator"
    needs_lanes = False

    def chosen(self, proposal: int) -> int:
        """The proposal, or the first action that is survived."""
        order = [self.index[name] for name in ("idle", "slower", "faster")]
        order += sorted(set(self.index.values()) - set(order))
        for action in dict.fromkeys((proposal, *order)):
            if any(self._is_survived(action, then) for then in order):
                return action
        return proposal

    def _is_survived(self, action: int, then: int) -> bool:
        env = deepcopy(self.system.env)
        for each in (action, *[then] * 4):
            _, _, terminated, truncated, info = env.step(each)
            if info["crashed"]:
                return False
            if terminated or truncated:
                break
        return True


_ON_THE_ROAD: dict[str, type[OnTheRoad]] = {
    "slower": Slower,
    "idm-mobil": CarFollower,
    "rss": Rss,
    "simulated": Simulated,
}


def rivals_of(system: System) -> Mapping[str, Callable[[], Any]]:
    """Judges by name that know a system, each with what it is ``told``.

    Examples
    --------
    >>> from studies.systems import make_system
    >>> list(rivals_of(make_system("acc")))
    ['stopping-distance', 'barrier']
    """
    match system:
        case Acc():
            known = {"stopping-distance": StoppingDistance, "barrier": Barrier}
            return {name: partial(kind, system) for name, kind in known.items()}
        case CartPole():
            return {"lqr-shield": partial(cart_shield, system.actions)}
        case Pendulum():
            told = system.actions, system.fails, system.circular
            return {"lqr-shield": partial(pendulum_shield, *told)}
        case Masa():
            return {"brake-shield": partial(ObstacleShield, system.actions)}
        case Highway():
            lanes = "left" in system.names
            fit = {name: one for name, one in _ON_THE_ROAD.items() if lanes or not one.needs_lanes}
            return {name: partial(kind, system) for name, kind in fit.items()}
    return system.rivals

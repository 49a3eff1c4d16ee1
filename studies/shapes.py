"""Systems whose failure is no threshold of one variable, and environments of peers.

Each has two careless controllers. Where an observation shows whether it is a failure, the system
can say so (`System.has_failed`); that is asked by judges that are told of it, and by nobody else.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from studies.systems import (
    Action,
    Box,
    Controllers,
    Discrete,
    Start,
    System,
    Vector,
    actions_of,
    gymnasium_of,
)


class Careless(System):
    """One of whose controllers wanders, from the first action on."""

    train = 40

    def _begin(self, start: Start) -> None:
        self._wanted = self.actions.drawn(self.whim)

    def _within(self, wanted: Any) -> Vector:
        given: Vector = np.clip(np.asarray(wanted, np.float64), self.actions.low, self.actions.high)
        return given


# -- Shapes ---------------------------------------------------------------------------------------


class Shape(Careless):
    """Two actions from -1 to 1 and two noises in each step of 0.1 s.

    The return counts the steps until it fails; who arrives is paid for those that are left, too.
    """

    actions = Box((-1.0, -1.0), (1.0, 1.0))
    interval, steps = 0.1, 120
    _place: Vector
    _speed: Vector
    _to: Vector

    def _begin(self, start: Start) -> None:
        super()._begin(start)
        Shape.redraw(self, self.chance)
        self._first()

    def redraw(self, chance: np.random.Generator) -> None:
        """Draw the noise, which is drawn for all steps at once."""
        super().redraw(chance)
        self._noise = chance.normal(size=(self.steps, 2))

    def _advance(self, action: Action) -> tuple[float, bool]:
        self._move(self._within(action), self._noise[self.decisions - 1])
        failed = self.has_failed(self._observation())
        left = self.steps - self.decisions if not failed and self._has_arrived() else 0
        return 1.0 + left, failed

    def _observation(self) -> Vector:
        return np.concatenate([self._place, self._speed])

    def _towards(self, place: Vector, gain: float, damping: float, whim: float) -> Vector:
        """The acceleration to a place, with a whim."""
        wanted = gain * (place - self._place) - damping * self._speed
        return self._within(wanted + whim * self.whim.normal(size=2))

    @abstractmethod
    def _first(self) -> None:
        """Draw the first state."""

    @abstractmethod
    def _move(self, action: Vector, noise: Vector) -> None:
        """Go on by a step."""


class Disc(Shape):
    """A point in the plane that is accelerated; it fails within 0.8 of the middle.

    The careless controller heads straight for a goal on the other side, the curious one for places
    all around, one after the other.
    """

    name = "disc"
    variables: tuple[str, ...] = ("x", "y", "speed x", "speed y")
    has_failed = staticmethod(lambda z: math.hypot(z[0], z[1]) < 0.8)
    _ARRIVED = 0.4  # so near to the goal
    _PUSH, _NOISE = 1.0, 0.004  # largest acceleration, and what a step adds to the speed
    _EXTENT = 2.2  # of the places

    @property
    def controllers(self) -> Controllers:
        """Each by itself fails in many episodes."""
        return {
            "careless": lambda z: self._towards(self._goal, 0.7, 1.0, 0.2),
            "curious": lambda z: self._towards(self._errand(), 1.0, 1.2, 0.1),
        }

    def _errand(self) -> Vector:
        if np.abs(self._to - self._place).max() < 0.3 or self.whim.random() < 0.02:
            self._to = self.whim.uniform(-self._EXTENT, self._EXTENT, 2)
        return self._to

    def _first(self) -> None:
        self._place = self.chance.uniform((-3.4, -2.5), (-2.6, 2.5))
        self._speed = self.chance.uniform(-0.2, 0.2, 2)
        self._goal = np.array([3.0, self.chance.uniform(-2.2, 2.2)])
        self._to = self.whim.uniform(-self._EXTENT, self._EXTENT, 2)

    def _move(self, action: Vector, noise: Vector) -> None:
        dt, push = self.interval, self._PUSH * action
        self._place = self._place + dt * self._speed + 0.5 * dt * dt * push
        self._speed = self._speed + dt * push + self._NOISE * noise

    def _has_arrived(self) -> bool:
        away = self._place - self._goal
        return self.controller == "careless" and math.hypot(*away) < self._ARRIVED


class Diamond(Disc):
    """Four oblique walls about the point: it fails where abs(x) + abs(y) > 1."""

    name = "diamond"
    has_failed = staticmethod(lambda z: bool(np.abs(z[:2]).sum() > 1.0))
    _PUSH, _NOISE, _EXTENT = 0.6, 0.002, 0.85

    @property
    def controllers(self) -> Controllers:
        """Each by itself fails in most episodes: places lie beyond the walls, too."""
        return {
            "curious": lambda z: self._towards(self._errand(), 1.0, 1.2, 0.1),
            "wander": lambda z: self._wander(),
        }

    def _first(self) -> None:
        super()._first()
        self._place, self._speed = self.chance.uniform(-0.3, 0.3, 2), np.zeros(2)


class Oblique(Shape):
    """One wall that stands askew: it fails where x cos 30° + y sin 30° > 1."""

    name = "oblique"
    variables = Disc.variables
    steps = 80
    _ACROSS = np.array([math.cos(math.pi / 6), math.sin(math.pi / 6)])
    _ALONG = np.array([-_ACROSS[1], _ACROSS[0]])
    has_failed = staticmethod(lambda z: bool(z[:2] @ Oblique._ACROSS > 1.0))

    @property
    def controllers(self) -> Controllers:
        """Each by itself drifts into the wall in most episodes."""
        return {
            "careless": lambda z: self._pushes(-0.2, 1.0),
            "random": lambda z: self._pushes(-0.7, 1.3),
        }

    def _pushes(self, low: float, high: float) -> Vector:
        """Ahead as drawn in every step, and to a side as drawn now and then."""
        across = self.whim.uniform(low, high)
        along = float(self._wander()[0])
        return self._within(0.7 * (across * self._ACROSS + along * self._ALONG))

    def _first(self) -> None:
        across, along = self.chance.uniform((-0.3, -1.0), (0.1, 1.0))
        self._place, self._speed = across * self._ACROSS + along * self._ALONG, np.zeros(2)

    def _move(self, action: Vector, noise: Vector) -> None:
        self._place = self._place + self.interval * self._speed
        self._speed = 0.97 * self._speed + 0.5 * self.interval * action + 0.002 * noise


class Moving(Disc):
    """A disc that comes along and turns as it likes: seen is where it is from here, and its speed.

    It fails within 0.8 of the disc. Where the point itself is, and its goal, no observation shows.
    """

    name = "moving"
    variables = ("to the disc x", "to the disc y", "its speed x", "its speed y")
    _ARRIVED = 0.5

    @property
    def controllers(self) -> Controllers:
        """One heads for the goal, the other is drawn to the disc."""
        return {
            "careless": lambda z: self._towards(self._goal, 0.7, 1.0, 0.2),
            "drawn": lambda z: self._within(self._wander() + 0.4 * z[:2] + 0.6 * z[2:]),
        }

    def _first(self) -> None:
        super()._first()
        self._place, self._goal = np.array([-4.0, 0.0]), np.array([4.0, 0.0])
        self._disc = self.chance.uniform((-1.5, -3.0), (3.0, 3.0))
        while math.hypot(*(self._disc - self._place)) < 2.5:
            self._disc = self.chance.uniform((-1.5, -3.0), (3.0, 3.0))
        way = self.chance.normal((-1.0, 0.0), 0.5) - self._disc
        self._its = 0.6 * way / max(math.hypot(*way), 1e-9)
        self._turn = np.zeros(2)

    def _observation(self) -> Vector:
        return np.concatenate([self._disc - self._place, self._its - self._speed])

    def _move(self, action: Vector, noise: Vector) -> None:
        super()._move(action, np.zeros(2))
        dt, self._turn = self.interval, 0.9 * self._turn + 0.06 * noise
        self._disc = self._disc + dt * self._its
        self._its = np.clip(self._its + dt * self._turn, -0.8, 0.8)


class Unicycle(Disc):
    """A car that goes where it points, up to a speed of 2: it is accelerated, and turned."""

    name = "unicycle"
    variables = ("x", "y", "cos", "sin", "speed")

    @property
    def controllers(self) -> Controllers:
        """As of a disc; these steer."""
        return {
            "careless": lambda z: self._steers(self._goal, 1.4),
            "curious": lambda z: self._steers(self._errand(), 1.0),
        }

    def _steers(self, place: Vector, speed: float) -> Vector:
        x, y = place - self._place
        off = (math.atan2(y, x) - self._angle + math.pi) % (2.0 * math.pi) - math.pi
        wanted = np.array([speed - self._pace, 2.0 * off])
        return self._within(wanted + 0.1 * self.whim.normal(size=2))

    def _first(self) -> None:
        super()._first()
        self._angle, self._pace = self.chance.uniform((-0.4, 0.0), (0.4, 1.0)).tolist()

    def _observation(self) -> Vector:
        turned = math.cos(self._angle), math.sin(self._angle)
        return np.array([*self._place, *turned, self._pace])

    def _move(self, action: Vector, noise: Vector) -> None:
        way = np.array([math.cos(self._angle), math.sin(self._angle)])
        self._place = self._place + self.interval * self._pace * way
        self._angle += float(self.interval * action[1] + 0.01 * noise[0])
        self._pace = min(max(self._pace + self.interval * float(action[0]), 0.0), 2.0)


class Landing(Shape):
    """Thrust and torque bring it down; it fails if it lands faster than 1, or tilted beyond 0.2.

    Failure is a conjunction: of being down, and of how.
    """

    name = "landing"
    variables = ("height", "speed", "tilt", "rate")
    actions = Box((0.0, -1.0), (2.0, 1.0))
    steps = 150
    has_failed = staticmethod(lambda z: bool(z[0] <= 0.0 and (z[1] < -1.0 or abs(z[2]) > 0.2)))

    @property
    def controllers(self) -> Controllers:
        """One sinks at a pace of its own, often too fast; one thrusts as it likes."""
        return {
            "careless": lambda z: self._held(z, 1.0 - self._sinks - z[1], 0.3),
            "random": lambda z: self._held(z, self.whim.uniform(0.4, 1.4), 0.5),
        }

    def _held(self, z: Vector, thrust: float, whim: float) -> Vector:
        torque = whim * self._wander()[1] - 0.8 * z[2] - 0.5 * z[3]
        return self._within([thrust, torque])

    def _first(self) -> None:
        self._state = self.chance.uniform((4.0, -1.0, -0.3, -0.1), (6.0, 0.0, 0.3, 0.1))
        self._sinks = self.whim.uniform(0.4, 2.5)

    def _observation(self) -> Vector:
        return np.array(self._state)

    def _move(self, action: Vector, noise: Vector) -> None:
        speed, rate = self._state[1::2]
        lift = action[0] * math.cos(self._state[2]) - 1.0
        change = np.array([speed, lift, rate, action[1]])
        self._state = self._state + self.interval * change
        self._state[1::2] += 0.005 * noise

    def _has_arrived(self) -> bool:
        return bool(self._state[0] <= 0.0)


class Drift(Shape):
    """A car that slides: the more it slips, the less its tyres hold; it fails beyond 0.8 rad.

    Steering and throttle act; a gust that no observation shows pushes for one to three seconds.
    """

    name = "drift"
    variables = ("slip angle [rad]", "rate of turn [rad/s]")
    steps = 250
    has_failed = staticmethod(lambda z: bool(abs(z[0]) > 0.8))

    @property
    def controllers(self) -> Controllers:
        """One steers into the skid, the other as it likes."""
        return {
            "skid": lambda z: np.array([math.copysign(0.8, z[1]), 0.3]),
            "wander": lambda z: self._wander(0.05),
        }

    def _first(self) -> None:
        self._state = self.chance.uniform(-0.1, 0.1, 2)
        self._gust = self._blows(self.chance)

    def _blows(self, chance: np.random.Generator) -> Vector:
        gusts = chance.normal(0.0, 0.4, self.steps // 10 + 1)
        return np.repeat(gusts, chance.integers(10, 30, len(gusts)))

    def redraw(self, chance: np.random.Generator) -> None:
        """Draw for how long the gust of now goes on, and those that follow."""
        super().redraw(chance)
        past = self._gust[: max(self.decisions, 1)]
        goes_on = np.full(chance.integers(20), past[-1])
        self._gust = np.concatenate([past, goes_on, self._blows(chance)])

    def _observation(self) -> Vector:
        return np.array(self._state)

    def _move(self, action: Vector, noise: Vector) -> None:
        (slip, turn), (steer, throttle) = self._state, action
        grip = 1.0 / (1.0 + 6.0 * slip * slip)
        push = 2.0 * steer * grip + 1.5 * slip + 0.3 * self._gust[self.decisions - 1]
        turn += self.interval * (push - 1.2 * turn * (1.0 - 0.5 * throttle))
        slip += self.interval * (0.8 * turn - 2.2 * grip * slip)
        self._state = np.array([slip, turn])


# -- Environments of peers ------------------------------------------------------------------------


class Peer(Careless):
    """An environment of Gymnasium as it comes, for 300 steps at most; its end is a failure.

    The return is the sum of the environment's rewards. The lander alone can end without failing: it
    lies still. Crashed it has, or left the picture, which no observation shows.
    """

    steps = 300

    def __init__(self, controller: str | None = None, *, task: str, name: str) -> None:
        self.name, self._env = name, gymnasium_of(task)
        self.actions = actions_of(self._env.action_space)
        self.variables = tuple(f"z{k}" for k in range(self._env.observation_space.shape[0]))
        self.interval = float(getattr(self._env, "dt", 0.02))
        self._careless, self.has_failed = _CARELESS[task]
        super().__init__(controller)

    @property
    def controllers(self) -> Controllers:
        """One that knows a little, and one that wanders."""
        return {"careless": self._knows_little, "wander": lambda z: self._wander(0.05)}

    def _knows_little(self, observation: Vector) -> Action:
        wanted = self._careless(observation, self._whim)
        if isinstance(self.actions, Box):
            given = self._within(wanted)
            return float(given[0]) if len(given) == 1 else given
        main, side = wanted  # nothing, left, main engine, right
        return 2 if main > 0.0 else 1 if side < -0.5 else 3 if side > 0.5 else 0

    def _begin(self, start: Start) -> None:
        super()._begin(start)
        self._seen, _ = self._env.reset(seed=int(self.chance.integers(2**31)))
        self._whim = self.whim.uniform(-1.0, 1.0)
        self._ended = False

    def _advance(self, action: Action) -> tuple[float, bool]:
        given = int(action) if isinstance(self.actions, Discrete) else np.atleast_1d(action)
        self._seen, reward, self._ended, _, _ = self._env.step(given)
        return float(reward), bool(self._ended) and not self._has_arrived()

    def _has_arrived(self) -> bool:
        lander = getattr(self._env, "lander", None)
        return bool(self._ended) and lander is not None and not lander.awake


# By task: what the careless one wants, of an observation and a whim from -1 to 1 that it has in an
# episode, and whether an observation is a failure.
_CARELESS: dict[str, tuple[Callable[[Vector, float], Any], Callable[[Vector], Any] | None]] = {
    # It holds the pole, and lets the cart go to the end of its rail.
    "InvertedPendulum-v5": (
        lambda z, whim: [12.0 * z[1] + 2.0 * z[3] + 0.3 * whim],
        lambda z: abs(z[1]) > 0.2,
    ),
    # It holds the lower of two poles, as if there were no other.
    "InvertedDoublePendulum-v5": (lambda z, whim: [z[1] + 0.2 * z[6] + 0.02 * whim], None),
    # It stands with stiff joints, which is not enough.
    "Hopper-v5": (
        lambda z, whim: 0.2 * whim - z[2:5] - 0.1 * z[8:11],
        lambda z: z[0] <= 0.7 or abs(z[1]) >= 0.2,
    ),
    # Main engine and side: down at a pace of its own, often too fast, about upright.
    "LunarLander-v3": (
        lambda z, whim: [
            -0.5 - 0.3 * whim - z[3],
            10.0 * (z[4] + z[5] - np.clip(0.5 * z[0] + z[2], -0.4, 0.4)),
        ],
        None,
    ),
}

#: Makes the system with the controller of that name, or with its first one.
SHAPES: dict[str, Callable[[str | None], System]] = {
    one.name: one for one in (Disc, Moving, Oblique, Diamond, Unicycle, Landing, Drift)
}
PEERS: dict[str, Callable[[str | None], System]] = {
    "inverted-pendulum": partial(Peer, task="InvertedPendulum-v5", name="inverted-pendulum"),
    "double-pendulum": partial(Peer, task="InvertedDoublePendulum-v5", name="double-pendulum"),
    "hopper": partial(Peer, task="Hopper-v5", name="hopper"),
    "lander": partial(Peer, task="LunarLander-v3", name="lander"),
}
#: What each needs beside Gymnasium: a package, and the extra of Gymnasium that has it.
NEEDS = dict.fromkeys(PEERS, ("mujoco", "mujoco"))
NEEDS["lander"] = ("Box2D", "box2d")

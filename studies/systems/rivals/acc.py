"""Judges of the task `Acc` that are told its equations."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np

from evofsm.extras import needs
from studies.systems.rivals.rival import Rival
from studies.systems.system import Action, Vector

# Standard deviations of what the noise adds up to, that are kept away.
_SURE = 4.0
# Of cbfpy: how fast its barrier may fall [1/s]. Its program is relaxed, so that even what it does
# not change comes back a little smaller: within this it counts as kept.
_CBFPY_RATE, _SOLVED = 2.5, 0.02
# Its margin is that of this speed always: one that changes with the speed does not hold.
_FASTEST = 1.5


class _Told(Rival):
    """What both know: x' = x + dt v, v' = v + dt (a + noise), the limits of a, and the noise.

    Parameters
    ----------
    dt : float
        Of a step [s].
    hold : int
        Steps of a decision.
    limit : float
        Largest acceleration in both directions.
    noise : float
        Standard deviation of the acceleration of a step.
    """

    told = "dynamics and noise"

    def __init__(self, dt: float, hold: int, limit: float, noise: float) -> None:
        self._dt, self._hold, self._limit, self._noise = dt, hold, limit, noise
        self._time = dt * hold
        self._to_place = 0.5 * dt**2 * hold * (hold - 1)  # of an acceleration, in a decision

    def _margin(self, speed: float) -> float:
        """What the noise may add to the way of a decision, and of the stop after it."""
        faster = _SURE * self._noise * self._dt * math.sqrt(self._hold)
        steps = self._hold + (max(speed, 0.0) + faster) / (self._limit * self._dt)
        drift = _SURE * self._noise * self._dt**2 * math.sqrt(steps**3 / 3.0)
        return drift + faster * (0.5 * faster / self._limit + self._dt)

    def _clipped(self, action: float) -> float:
        return min(max(action, -self._limit), self._limit)


class StoppingDistance(_Told):
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
        fastest = max(v, after, 0.0)
        stopping = max(after, 0.0) * (0.5 * max(after, 0.0) / self._limit + self._dt)
        return -(x + stopping + self._margin(fastest))


class Barrier(_Told):
    """A control barrier function in discrete time (Agrawal and Sreenath 2017), in closed form.

    h(x, v) = -x - v² / (2 limit) - margin for v > 0, and -x - margin else, must not fall by more
    than a share in a decision: h(z') >= (1 - share) h(z). The closest such action is the root of a
    quadratic equation.

    Parameters
    ----------
    share : float
        Of h in a step.
    """

    def __init__(self, *system: Any, share: float = 0.05) -> None:
        super().__init__(*system)
        self._left = (1.0 - share) ** self._hold

    def action(self, observation: Vector, proposal: Action) -> Action:
        """The largest acceleration up to the proposal that the condition allows."""
        x, v = map(float, observation)
        margin = self._margin(max(v, 0.0) + self._time * self._limit)
        safe = -x - 0.5 * max(v, 0.0) ** 2 / self._limit - margin
        # h after the decision, less what it has to be: -(a u² + b u + c), where it still closes.
        a = 0.5 * self._time**2 / self._limit
        b = self._time * v / self._limit + self._to_place
        c = x + self._time * v + 0.5 * v**2 / self._limit + margin + self._left * safe
        inside = b * b - 4.0 * a * c
        largest = (-b + math.sqrt(inside)) / (2.0 * a) if inside >= 0.0 else -self._limit
        if v + self._time * largest < 0.0 and self._to_place:  # it opens: no distance to stop
            largest = -(x + self._time * v + margin + self._left * safe) / self._to_place
        return min(float(proposal), self._clipped(largest))


class CbfPy(_Told):
    """The barrier filter of the package ``cbfpy``, in continuous time, with the same margin.

    Raises
    ------
    ModuleNotFoundError
        If it is not installed.
    """

    def __init__(self, *system: Any) -> None:
        super().__init__(*system)
        self._filter = _cbfpy(self._limit, self._margin(_FASTEST))

    def action(self, observation: Vector, proposal: Action) -> Action:
        """The solution of its quadratic program."""
        found = self._filter.safety_filter(np.asarray(observation), np.array([proposal]))
        action = float(np.asarray(found)[0])
        return proposal if abs(action - proposal) < _SOLVED else self._clipped(action)


def _cbfpy(limit: float, margin: float) -> Any:
    with needs("cbfpy", "rivals", "its barrier filter"):
        import jax
        import jax.numpy as jnp

        with warnings.catch_warnings():  # that JAX could be set up to be faster
            warnings.simplefilter("ignore", UserWarning)
            from cbfpy import CBF, CBFConfig
    jax.config.update("jax_enable_x64", True)

    class Config(CBFConfig):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(n=2, m=1, u_min=np.array([-limit]), u_max=np.array([limit]))

        def f(self, z: Any) -> Any:
            return jnp.array([z[1], 0.0])

        def g(self, z: Any) -> Any:
            return jnp.array([[0.0], [1.0]])

        def h_1(self, z: Any) -> Any:
            closing = jnp.maximum(z[1], 0.0)
            return jnp.array([-z[0] - 0.5 * closing**2 / limit - margin])

        def alpha(self, h: Any) -> Any:
            return _CBFPY_RATE * h

    return CBF.from_config(Config())

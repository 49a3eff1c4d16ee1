"""Shields of poles: told the linear model about upright, and what its regulator can hold."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from evofsm.extras import needs
from studies.systems.rivals.rival import Rival, States, as_action, tried
from studies.systems.system import Action, Box, Discrete, Vector

with needs("scipy", "study", "the Riccati equation"):
    from scipy.linalg import solve_discrete_are

# CartPole: gravity [m/s²], masses of the cart and of the pole [kg], half the pole [m], force [N],
# step [s], and the place [m] and angle [rad] that fail.
_GRAVITY, _CART, _POLE, _HALF, _FORCE, _DT = 9.8, 1.0, 0.1, 0.5, 10.0, 0.02
_EDGES = {0: 2.4, 2: 0.2095}
# Pendulum: step [s], pull of gravity [1/s²] and of a torque [1/(kg m²)] on the rate.
_PENDULUM_DT, _FALLS, _TORQUE = 0.05, 15.0, 3.0


class Linear(NamedTuple):
    """The model z' = system z + control u, and what is not to be passed."""

    system: States  #: (m, m)
    control: States  #: (m,)
    edges: dict[int, float]  #: of variables, in both directions
    limit: float  #: largest u


class LevelSet(Rival):
    """Keeps the state where the quadratic regulator can hold it, by the linear model.

    The regulator's cost to go, V(z) = z' P z, falls under the regulator wherever that is not
    limited. The largest ellipsoid V(z) <= c in which nothing fails, and no action is limited, is
    never left: the closest action is taken after which one is within it, else the one after which V
    is smallest.

    Parameters
    ----------
    actions : Box or Discrete
    model : Linear
    cost : sequence of float
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
        model: Linear,
        cost: Vector,
        *,
        read: Callable[[Vector], Vector] = lambda observation: observation,
        push: Callable[[States], States] = lambda taken: taken,
    ) -> None:
        self._actions, self._tried = actions, tried(actions)
        self._model, self._read, self._push = model, read, push
        b = model.control[:, None]
        value = self._value = solve_discrete_are(model.system, b, np.diag(cost), np.eye(1))
        gain = np.linalg.solve(1.0 + b.T @ value @ b, b.T @ value @ model.system)
        spread = np.linalg.inv(value)
        levels = [edge**2 / spread[i, i] for i, edge in model.edges.items()]
        self._level = min(*levels, model.limit**2 / float((gain @ spread @ gain.T)[0, 0]))

    def action(self, observation: Vector, proposal: Action) -> Action:
        """The proposal, or the closest action after which the ellipsoid is not left."""
        state = self._model.system @ self._read(observation)
        if self._after(state, np.array([proposal], np.float64))[0] <= self._level:
            return proposal
        value = self._after(state, self._tried)
        away = np.where(value <= self._level, np.abs(self._tried - proposal), np.inf)
        best = int(np.argmin(away if np.isfinite(away).any() else value))
        return as_action(self._tried[best], self._actions)

    def _after(self, state: Vector, taken: States) -> States:
        """(k,) V after each action."""
        after = state + self._push(taken)[:, None] * self._model.control
        return np.asarray(np.einsum("ki,ij,kj->k", after, self._value, after))


def cart_shield(actions: Box | Discrete) -> LevelSet:
    """Of CartPole with two forces, or with any force from -1 to 1 of the largest."""
    mass, inertia = _CART + _POLE, _HALF * (4.0 / 3.0 - _POLE / (_CART + _POLE))
    of_angle, of_force = _GRAVITY / inertia, -1.0 / (mass * inertia)
    lever = _POLE * _HALF / mass
    change = np.zeros((4, 4))
    change[0, 1] = change[2, 3] = 1.0
    change[1, 2], change[3, 2] = -lever * of_angle, of_angle
    push = np.array([0.0, 1.0 / mass - lever * of_force, 0.0, of_force])
    model = Linear(np.eye(4) + _DT * change, _DT * _FORCE * push, _EDGES, 1.0)
    cost = np.array([0.1, 0.1, 1.0, 0.1])
    if isinstance(actions, Discrete):
        return LevelSet(actions, model, cost, push=lambda taken: 2.0 * taken - 1.0)
    return LevelSet(actions, model, cost)


def pendulum_shield(actions: Box, fails: float, circular: bool) -> LevelSet:
    """Of Pendulum; it fails where the angle is beyond ``fails`` [rad]."""
    dt = _PENDULUM_DT
    # The rate changes first, and the angle by the new rate.
    system = np.array([[1.0 + dt * dt * _FALLS, dt], [dt * _FALLS, 1.0]])
    control = dt * _TORQUE * np.array([dt, 1.0])
    model = Linear(system, control, {0: fails}, actions.high[0])

    def read(observation: Vector) -> Vector:
        if not circular:
            return observation
        return np.array([np.arctan2(observation[1], observation[0]), observation[2]])

    return LevelSet(actions, model, np.array([0.1, 0.1]), read=read)

"""Shields of masa-safe-rl's roads and obstacle: told the equations, saved by braking."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from studies.systems.rivals.rival import BackupShield, States
from studies.systems.system import Box, Discrete

_TOLD = "dynamics and limits"
# Speed that an action adds in a step, on the road of one dimension and in the plane.
_ROAD, _PLANE_ROAD, _PLANE = 0.001, 0.0005, 0.005
_SPEED_LIMIT = 0.01
# Of rounding: the package counts in 32 bits.
_ROUNDING = 1e-6
_FASTEST, _AHEAD = 0.05, 2.0  # in the plane: of a speed, and way of a step at a speed of 1
_OBSTACLE = np.array([[0.0, 2.0], [1.0, 3.0]])  # its corners
# A stop takes no longer than this.
_STEPS = 12


def road_shield(actions: Box | Discrete) -> BackupShield:
    """Keeps the speed limit, in one dimension or two."""
    assert isinstance(actions, Box)
    plane = len(actions.low) == 2
    gain = _PLANE_ROAD if plane else _ROAD

    def move(states: States, taken: States) -> States:
        half = states.shape[1] // 2
        return np.hstack([states[:, :half], states[:, half:] + gain * taken.reshape(-1, half)])

    def speeds(states: States) -> States:
        return states[:, states.shape[1] // 2 :]

    def brake(states: States) -> States:
        return np.asarray(np.clip(-speeds(states) / gain, actions.low, actions.high))

    def fails(states: States) -> NDArray[np.bool_]:
        fast: NDArray[np.bool_] = np.abs(speeds(states)) >= _SPEED_LIMIT - _ROUNDING
        return np.asarray(fast.any(axis=1))

    return BackupShield(actions, _TOLD, move=move, fails=fails, backup=brake, steps=1)


def obstacle_shield(actions: Box | Discrete) -> BackupShield:
    """Stops before the obstacle."""
    assert isinstance(actions, Box)

    def move(states: States, taken: States) -> States:
        speed = np.clip(states[:, 2:] + _PLANE * taken, -_FASTEST, _FASTEST)
        return np.hstack([states[:, :2] + _AHEAD * speed, speed])

    def brake(states: States) -> States:
        return np.asarray(np.clip(-states[:, 2:] / _PLANE, actions.low, actions.high))

    def fails(states: States) -> NDArray[np.bool_]:
        low, high = _OBSTACLE[0] - _ROUNDING, _OBSTACLE[1] + _ROUNDING
        inside: NDArray[np.bool_] = np.all((states[:, :2] >= low) & (states[:, :2] <= high), axis=1)
        return inside

    return BackupShield(actions, _TOLD, move=move, fails=fails, backup=brake, steps=_STEPS)

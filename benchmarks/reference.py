"""The step of the machine as a plain NumPy loop, vectorised over states: what it is timed against.

As quick as NumPy allows; the tests hold the compiled machine to it (tests/fsm/test_reference.py).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class NumpyFSM:
    """One object, one call a step, NumPy for everything; the paper's settings by default.

    With a ``novelty_radius`` states are those of `Novelty` instead of the paper's.
    """

    def __init__(
        self,
        n_actions: int,
        radius: float = 0.3,
        distance_weight: float = 0.85,
        learning_rate: float = 0.01,
        prior_frequency: float = 1e-3,
        spread: float = 3.0,
        novelty_radius: float | None = None,
    ) -> None:
        self.n_actions = n_actions
        self.radius = radius
        self.distance_weight = distance_weight
        self.learning_rate = learning_rate
        self.prior_frequency = prior_frequency
        self.spread = spread
        self.novelty_radius = novelty_radius
        self.count = 0
        self.previous: NDArray[np.float64] = np.empty(0)
        self.belief: NDArray[np.float64] | None = None
        self.action: int | None = None

    def start_episode(self) -> None:
        self.belief = self.action = None

    def act(self, action: int) -> None:
        self.action = action

    def observe(self, z: NDArray[np.float64]) -> tuple[int, NDArray[np.float64], float]:
        """One observation; answers state, belief and surprise."""
        distances = self._determine(z)
        if self.novelty_radius is None:
            width = self.spread * self.scatter / self.count
        else:
            width = self.spread * self.novelty_radius**2
        nearest = distances.min()
        if width > 0.0:
            belief = np.exp((nearest - distances) / width)
        else:
            belief = (distances == nearest).astype(float)
        belief /= belief.sum()

        surprise = float("nan")
        if self.belief is not None and self.action is not None:
            origin = np.zeros(len(belief))
            origin[: len(self.belief)] = self.belief
            matrix, frequency = self.matrices[self.action], self.frequencies[self.action]
            predicted = origin @ matrix
            middle = 0.5 * (predicted + belief)
            surprise = 0.5 * float(
                _relative_entropy(predicted, middle) + _relative_entropy(belief, middle)
            )
            gain = self.learning_rate * origin
            frequency *= 1.0 - self.learning_rate
            frequency += gain
            matrix += (gain / frequency)[:, None] * (belief - matrix)
        self.belief, self.action = belief, None
        return int(belief.argmax()), belief, surprise

    def _determine(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Move or found a state where the rule says so; answers squared distances to centres."""
        if self.count == 0:
            self.mean, self.scatter = np.zeros(len(z)), 0.0
            self.centers, self.potentials = z[None, :].copy(), np.ones(1)
            self.matrices = np.ones((self.n_actions, 1, 1))
            self.frequencies = np.full((self.n_actions, 1), self.prior_frequency)
            distances = np.zeros(1)
        else:
            t = self.count + 1
            offset = z - self.mean
            potential = 1.0 / (1.0 + float(offset @ offset) + self.scatter / self.count)
            far = ((self.centers - self.previous) ** 2).sum(axis=1)
            self.potentials = (
                (t - 1)
                * self.potentials
                / ((t - 2) + self.potentials * (1.0 + self.distance_weight * far))
            )
            distances = ((self.centers - z) ** 2).sum(axis=1)
            if self.novelty_radius is not None:
                if distances.min() > self.novelty_radius**2:
                    distances = self._found(z, potential, distances)
            elif potential > self.potentials.max():
                nearest = distances.argmin()
                if distances[nearest] < self.radius**2:
                    self.centers[nearest], self.potentials[nearest] = z, potential
                    distances[nearest] = 0.0
                else:
                    distances = self._found(z, potential, distances)
        self.count += 1
        before = z - self.mean
        self.mean = self.mean + before / self.count
        self.scatter += float(before @ (z - self.mean))
        self.previous = z
        return distances

    def _found(
        self, z: NDArray[np.float64], potential: float, distances: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        self.centers = np.vstack([self.centers, z])
        self.potentials = np.append(self.potentials, potential)
        n = len(self.centers)
        joint = np.full((self.n_actions, n, n), self.prior_frequency)
        joint[:, :-1, :-1] = self.matrices * self.frequencies[:, :, None]
        self.frequencies = joint.sum(axis=2)
        self.matrices = joint / self.frequencies[:, :, None]
        return np.append(distances, 0.0)


def _relative_entropy(p: NDArray[np.float64], q: NDArray[np.float64]) -> np.float64:
    some = p > 0.0
    return np.float64((p[some] * np.log2(p[some] / q[some])).sum())

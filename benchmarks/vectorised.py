"""A fleet in NumPy, as fast as we could make NumPy go: all vehicles at once, no loop over them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from reference import NumpyFSM

# Added to probabilities before their logarithm is taken, for those that are 0.
_TINY = 1e-300


class NumpyFleet:
    """V machines with the paper's rule that go on from one that has found all its states.

    Arrays of a fixed number of states are what lets NumPy work on all vehicles at once, so an
    observation that would found another state is refused. NumPy is fast along a last axis that
    is long, so vehicles come last where every vehicle does the same (V is some thousand, n is 7),
    and first where each picks the matrix of its own action.
    """

    def __init__(self, machine: NumpyFSM, n_vehicles: int) -> None:
        self.machine = machine
        self.first_matrix = np.arange(n_vehicles) * machine.n_actions
        self.count = machine.count

        def last(array: NDArray[np.float64] | float) -> NDArray[np.float64]:
            return np.repeat(np.asarray(array)[..., None], n_vehicles, axis=-1)

        self.centers = last(machine.centers.T)  # (m, n, V)
        self.potentials = last(machine.potentials)  # (n, V)
        far = ((machine.centers - machine.previous) ** 2).sum(axis=1)
        self.distances = last(far)  # (n, V) squared, from the latest observation
        self.mean = last(machine.mean)  # (m, V)
        self.scatter = last(machine.scatter)  # (V,)
        self.matrices = np.tile(machine.matrices, (n_vehicles, 1, 1))  # (V q, n, n)
        self.frequencies = np.tile(machine.frequencies, (n_vehicles, 1))  # (V q, n)
        self.belief: NDArray[np.float64] | None = None  # (V, n)
        self.actions = np.zeros(n_vehicles, np.int64)

    def observe(
        self, Z: NDArray[np.float64], A: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Observe (V, m), then act (V,); answers states and surprises (V,)."""
        self._determine(np.ascontiguousarray(Z.T))
        reached = self.distances.min(axis=0) - self.distances
        reached *= self.count / (self.machine.spread * self.scatter)
        np.exp(reached, out=reached)
        reached /= reached.sum(axis=0)
        belief = np.ascontiguousarray(reached.T)
        if self.belief is None:
            surprise = np.full(len(Z), np.nan)
        else:
            surprise = self._learn(self.belief, belief)
        self.belief, self.actions = belief, A
        return belief.argmax(axis=1), surprise

    def _determine(self, z: NDArray[np.float64]) -> None:
        t = self.count + 1
        before = z - self.mean
        potential = 1.0 / (1.0 + (before * before).sum(axis=0) + self.scatter / self.count)
        below = self.machine.distance_weight * self.distances
        below += 1.0
        below *= self.potentials
        below += t - 2
        self.potentials *= t - 1
        self.potentials /= below
        offsets = self.centers - z[:, None, :]
        offsets *= offsets
        self.distances = offsets.sum(axis=0)
        (dense,) = np.nonzero(potential > self.potentials.max(axis=0))
        if len(dense):
            nearest = self.distances[:, dense].argmin(axis=0)
            if (self.distances[nearest, dense] >= self.machine.radius**2).any():
                raise ValueError("an observation founds a state, but the number of states is fixed")
            self.centers[:, nearest, dense] = z[:, dense]
            self.potentials[nearest, dense] = potential[dense]
            self.distances[nearest, dense] = 0.0
        self.count = t
        self.mean += before / t
        self.scatter += (before * (z - self.mean)).sum(axis=0)

    def _learn(
        self, origin: NDArray[np.float64], reached: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Forecast, compare and identify, each vehicle with the matrix of its action."""
        used = self.first_matrix + self.actions
        matrices = self.matrices.take(used, axis=0)
        predicted = np.matmul(origin[:, None, :], matrices)[:, 0, :]
        middle = predicted + reached
        middle *= 0.5
        surprise = _relative_entropy(predicted, middle)
        surprise += _relative_entropy(reached, middle)
        surprise *= 0.5
        gain = self.machine.learning_rate * origin
        frequencies = self.frequencies.take(used, axis=0)
        frequencies *= 1.0 - self.machine.learning_rate
        frequencies += gain
        self.frequencies[used] = frequencies
        gain /= frequencies
        change = reached[:, None, :] - matrices
        change *= gain[:, :, None]
        matrices += change
        self.matrices[used] = matrices
        return surprise


def _relative_entropy(p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of each row [bit]."""
    entropy: NDArray[np.float64] = np.einsum("vn,vn->v", p, np.log2((p + _TINY) / (q + _TINY)))
    return entropy

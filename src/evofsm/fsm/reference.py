"""The machine of the paper's Section 2 in plain NumPy, to be read from top to bottom.

It is the twin that the compiled machine is held to (`tests/fsm/test_reference.py`), and what it is
timed against. Numbers in parentheses are the paper's equations, counted through its LaTeX source.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# What is greater by less than this part of itself is taken for equal: rounding.
_EQUAL = 1.0 + 1e-12


class Reference:
    """A machine with the paper's rule; settings as `EvolvingFSM` has them.

    Examples
    --------
    >>> machine = Reference(n_actions=2, radius=0.5)
    >>> for z in ([0.0], [0.1], [2.0], [1.0]):
    ...     state, belief, surprise = machine.observe(np.array(z))
    ...     machine.act(0)
    >>> machine.predict(0).round(3)
    array([0.602, 0.398])
    """

    def __init__(
        self,
        n_actions: int,
        radius: float = 0.3,
        distance_weight: float = 0.85,
        learning_rate: float = 0.01,
        prior_frequency: float = 1e-3,
        spread: float = 3.0,
    ) -> None:
        self.n_actions, self.radius, self.distance_weight = n_actions, radius, distance_weight
        self.learning_rate, self.prior_frequency = learning_rate, prior_frequency
        self.spread = spread
        self.count, self.previous = 0, np.empty(0)  # observations so far, and the latest one
        self.start_episode()

    def start_episode(self) -> None:
        """No transition leads from the latest observation to the next."""
        self.belief: NDArray[np.float64] | None = None
        self.action: int | None = None

    def act(self, action: int) -> None:
        """The action that was commanded after the latest observation."""
        self.action = action

    def observe(self, z: NDArray[np.float64]) -> tuple[int, NDArray[np.float64], float]:
        """Take in one observation (1); returns the state, the belief and the surprise [bit]."""
        distances = self.determine(z)
        belief = self.recognise(distances)
        surprise = np.nan
        if self.belief is not None and self.action is not None:
            origin = np.append(self.belief, np.zeros(len(belief) - len(self.belief)))
            surprise = divergence(origin @ self.matrices[self.action], belief)  # (18)
            self.identify(self.action, origin, belief)
        self.belief, self.action = belief, None
        return int(belief.argmax()), belief, surprise

    def determine(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Section 2.2.1: move or create a state; returns squared distances to the centres."""
        if self.count == 0:
            self.mean, self.scatter = np.zeros(len(z)), 0.0
            self.centers, self.potentials = z[None, :].copy(), np.ones(1)
            self.matrices = np.ones((self.n_actions, 1, 1))
            self.frequencies = np.full((self.n_actions, 1), self.prior_frequency)
        else:
            t, offset = self.count + 1, z - self.mean
            potential = 1.0 / (1.0 + float(offset @ offset) + self.scatter / self.count)  # (2)
            far = 1.0 + self.distance_weight * ((self.centers - self.previous) ** 2).sum(axis=1)
            self.potentials = (t - 1) * self.potentials / ((t - 2) + self.potentials * far)  # (6)
            self.judge(z, potential)
        self.count += 1
        before = z - self.mean
        self.mean = self.mean + before / self.count  # in place of the sums (3) to (5)
        self.scatter += float(before @ (z - self.mean))
        self.previous = z
        return np.asarray(((self.centers - z) ** 2).sum(axis=1))

    def judge(self, z: NDArray[np.float64], potential: float) -> None:
        """Conditions 1 and 2: where it is denser here than at every centre, one moves or is new."""
        squared = ((self.centers - z) ** 2).sum(axis=1)
        nearest = squared.argmin()
        if potential > _EQUAL * self.potentials.max():
            if _EQUAL * squared[nearest] < self.radius**2:
                self.centers[nearest], self.potentials[nearest] = z, potential
            else:
                self.create(z, potential)

    def create(self, z: NDArray[np.float64], potential: float) -> None:
        """Section 2.3.1: a state has a row and a column of prior frequencies in each matrix."""
        self.centers = np.vstack([self.centers, z])
        self.potentials = np.append(self.potentials, potential)
        n = len(self.centers)
        joint = np.full((self.n_actions, n, n), self.prior_frequency)
        joint[:, :-1, :-1] = self.matrices * self.frequencies[:, :, None]
        self.frequencies = joint.sum(axis=2)
        self.matrices = joint / self.frequencies[:, :, None]

    def width(self) -> float:
        """The paper's var(z*) of (7), which it leaves open."""
        return self.spread * self.scatter / self.count

    def recognise(self, distances: NDArray[np.float64]) -> NDArray[np.float64]:
        """Section 2.2.2, (7) to (9): a distribution over the states."""
        nearest, width = distances.min(), self.width()
        likeness = np.exp((nearest - distances) / width) if width > 0.0 else distances == nearest
        return np.asarray(likeness / likeness.sum())

    def identify(
        self, action: int, origin: NDArray[np.float64], reached: NDArray[np.float64]
    ) -> None:
        """Section 2.3.2, (15) to (17): rows of P move to what was reached, F_o is their weight."""
        gain = self.learning_rate * origin
        self.frequencies[action] = (1.0 - self.learning_rate) * self.frequencies[action] + gain
        rates = gain / self.frequencies[action]
        self.matrices[action] += rates[:, None] * (reached - self.matrices[action])

    def predict(self, action: int, horizon: int = 1) -> NDArray[np.float64]:
        """(18), (19): a forecast of the state, from the second step on by P* (20)."""
        belief = np.zeros(0) if self.belief is None else self.belief
        marginal = np.linalg.matrix_power(self.matrices.mean(axis=0), horizon - 1)
        return np.asarray(belief @ self.matrices[action] @ marginal)


def divergence(p: NDArray[np.float64], q: NDArray[np.float64]) -> float:
    """Jensen-Shannon divergence [bit] (Section 3.2.2)."""
    middle = 0.5 * (p + q)
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = [np.where(r > 0.0, r * np.log2(r / middle), 0.0) for r in (p, q)]
    return float(0.5 * np.sum(terms))

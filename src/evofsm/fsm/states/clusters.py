"""What every state rule remembers of the observations: centres and densities (Section 2.2.1).

Density is the *potential*, a Cauchy kernel summed over the whole past, kept by two recursions:
one for the present observation, one for the centres.

The paper keeps running sums of z and z'z (its a_t, b_t, c_t). Those lose all digits when the
observations lie far from zero, so this file uses the same quantity in its mean and variance
form, with the mean kept relative to the first observation::

    potential of z_t = 1 / (1 + |z_t - mean|^2 + variance),   both over z_1 .. z_{t-1}

Differences are multiplied by ``weights``, 1 / scale of each variable: 1 in the paper.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.elementary import fma, largest
from evofsm.fsm.kernels import inner_kernel, lanes
from evofsm.fsm.learnt import Clusters

# What may happen to the states: bits of an `Event`.
UNCHANGED = 0
MOVED = 1
CREATED = 2

# A share that no rounding comes to, and that no two observations tell apart either.
_ROUNDING = 1e-12


@inner_kernel
def total_variance(clusters: Clusters) -> float:
    """Population variance of all observations so far, summed over the variables."""
    return float(clusters.scatter[0] / clusters.n_observations[0])


@inner_kernel
def measure_distances(
    centers: NDArray[np.float64],
    weights: NDArray[np.float64],
    n: int,
    z: NDArray[np.float64],
    squared_distances: NDArray[np.float64],
) -> None:
    """Squared Euclidean distance from ``z`` to each of the first ``n`` centres, (m, capacity)."""
    for i in range(n):
        offset = (z[0] - centers[0, i]) * weights[0]
        squared_distances[i] = offset * offset
    for j in range(1, len(z)):
        value, weight = z[j], weights[j]
        for i in range(n):
            offset = (value - centers[j, i]) * weight
            squared_distances[i] = fma(offset, offset, squared_distances[i])


@inner_kernel
def exceeds(value: float, other: float) -> bool:
    """Whether a value of 0 or more is the greater one, and not by rounding alone.

    Observations from a grid are often exactly as dense as a centre, or exactly a radius away.
    """
    return value > other * (1.0 + _ROUNDING)


@inner_kernel
def nearest_center(squared_distances: NDArray[np.float64], n: int) -> int:
    """Index of the smallest of the first ``n`` distances; the oldest centre wins a tie."""
    nearest = 0
    for i in range(1, n):
        if squared_distances[i] < squared_distances[nearest]:
            nearest = i
    return nearest


@inner_kernel
def potential_of(clusters: Clusters, weights: NDArray[np.float64], z: NDArray[np.float64]) -> float:
    """Density at ``z`` of the observations so far, in its mean and variance form."""
    squared_distance = 0.0
    for j in range(len(z)):
        offset = (z[j] - clusters.first[j] - clusters.mean[j]) * weights[j]
        squared_distance += offset * offset
    return 1.0 / (1.0 + squared_distance + total_variance(clusters))


@inner_kernel
def update_potentials(clusters: Clusters, n: int, distance_weight: float, memory: float) -> float:
    """Recursion of the centres' potentials; returns the highest.

    It needs the distances to z_{t-1}, which are still at hand from the step before.
    """
    t = min(clusters.n_observations[0], memory) + 1.0
    for i in range(lanes(n)):
        potential = clusters.potentials[i]
        far = 1.0 + distance_weight * clusters.squared_distances[i]
        clusters.potentials[i] = (t - 1.0) * potential / ((t - 2.0) + potential * far)
    return largest(clusters.potentials, n)


@inner_kernel
def place_center(clusters: Clusters, i: int, z: NDArray[np.float64], potential: float) -> None:
    """Put centre ``i`` on the observation, which is then at no distance from it."""
    for j in range(len(z)):
        clusters.centers[j, i] = z[j]
    clusters.potentials[i] = potential
    clusters.squared_distances[i] = 0.0


@inner_kernel
def absorb(
    clusters: Clusters, weights: NDArray[np.float64], z: NDArray[np.float64], memory: float
) -> None:
    """Add the observation to the running mean and scatter (Welford 1962).

    Beyond ``memory`` observations both are exponentially weighted (West 1979): each new one takes
    the place of a share of all before it.
    """
    n_observations = clusters.n_observations[0] + 1.0
    share = 1.0 / min(n_observations, memory)
    added = 0.0
    for j in range(len(z)):
        clusters.latest[j] = z[j]
        offset = z[j] - clusters.first[j]
        before = offset - clusters.mean[j]
        mean = clusters.mean[j] + before * share
        clusters.mean[j] = mean
        added += (before * weights[j]) * ((offset - mean) * weights[j])
    if n_observations > memory:  # the scatter is always the variance times their number
        grown = n_observations / (n_observations - 1.0)
        clusters.scatter[0] *= (1.0 - share) * grown
        added *= share * n_observations
    clusters.n_observations[0] = n_observations
    clusters.scatter[0] += added

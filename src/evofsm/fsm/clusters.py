"""Determine and recognise states: the paper's Sections 2.2.1 and 2.2.2.

The density of observations at a place is its *potential*, a Cauchy kernel summed over the whole
past. The paper keeps running sums of z and z'z (its a_t, b_t, c_t), which lose all digits where
observations lie far from zero. So here is the same by mean and variance, the mean relative to the
first observation::

    potential of z_t = 1 / (1 + |z_t - mean|^2 + variance),   both over z_1 .. z_{t-1}

Differences are multiplied by ``weights``, 1 / scale of each variable: 1 in the paper.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from evofsm.fsm.arrays import Learnt, Records, Settings
from evofsm.fsm.kernels import exponential, inner_kernel, kernel, lanes, total
from evofsm.fsm.validation import Floats

# What may happen to the states: bits of an `Event`.
UNCHANGED: int = 0
MOVED: int = 1
CREATED: int = 2
MERGED: int = 4
#: Which rule judges an observation; all that `_judge` knows.
PAPER: int = 0
NOVELTY: int = 1
JUDGED = PAPER, NOVELTY

# A share that no rounding comes to, and that no two observations tell apart either.
_ROUNDING = 1e-12
# Below exp(-690) a belief is taken as 0: smaller numbers are denormal and slow every sum.
_LOWEST_EXPONENT = -690.0
# In place of 1 / width where that would overflow: only the nearest centres keep a belief.
_SHARPEST = 1e300


@inner_kernel
def determine(learnt: Learnt, settings: Settings, z: Floats) -> tuple[int, int, float]:
    """Judge one observation against the centres; the nearest may be moved onto it.

    Returns the event, the nearest centre, and the potential of the observation. Where the event is
    ``CREATED``, whoever asked has to place the new centre.
    """
    now, n, weights = learnt.now[0], learnt.now[0].n_states, settings.weights
    if now.n_observations == 0:
        for j in range(len(z)):
            learnt.variables[j].first = z[j]
        event, nearest, potential = CREATED, 0, 1.0
    else:
        potential = potential_of(now, learnt.variables, weights, z)
        highest = _update_potentials(learnt, settings, n)
        measure_distances(learnt.centers, weights, lanes(n), z, learnt.squared_distances)
        nearest = nearest_center(learnt.squared_distances, n)
        event = _judge(learnt, settings, potential, highest, nearest)
        if event == MOVED:
            for j in range(len(z)):
                learnt.centers[j, nearest] = z[j]
            learnt.potentials[nearest] = potential
            learnt.squared_distances[nearest] = 0.0
    _absorb(now, learnt.variables, weights, z)
    return event, nearest, potential


@inner_kernel
def _judge(
    learnt: Learnt, settings: Settings, potential: float, highest: float, nearest: int
) -> int:
    """Leave the states as they are, move the nearest, or create one."""
    squared_distance, limit = learnt.squared_distances[nearest], settings.radius**2
    if settings.rule == NOVELTY:
        return CREATED if exceeds(squared_distance, limit) else UNCHANGED
    if exceeds(potential, highest):
        return MOVED if exceeds(limit, squared_distance) else CREATED
    return UNCHANGED


@inner_kernel
def exceeds(value: float, other: float) -> bool:
    """Whether a value of 0 or more is greater, and not by rounding alone, as often on a grid."""
    return value > other * (1.0 + _ROUNDING)


@inner_kernel
def measure_distances(
    centers: Floats, weights: Floats, n: int, z: Floats, squared_distances: Floats
) -> None:
    """Squared Euclidean distance from ``z`` to each of the first ``n`` centres, (m, capacity)."""
    for i in range(n):
        offset = (z[0] - centers[0, i]) * weights[0]
        squared_distances[i] = offset * offset
    for j in range(1, len(z)):
        value, weight = z[j], weights[j]
        for i in range(n):
            offset = (value - centers[j, i]) * weight
            squared_distances[i] += offset * offset


@inner_kernel
def nearest_center(squared_distances: Floats, n: int) -> int:
    """Index of the smallest of the first ``n`` distances; the oldest centre wins a tie."""
    nearest = 0
    for i in range(1, n):
        if squared_distances[i] < squared_distances[nearest]:
            nearest = i
    return nearest


@inner_kernel
def potential_of(now: Any, variables: Records, weights: Floats, z: Floats) -> float:
    """Density at ``z`` of the observations so far, in its mean and variance form."""
    squared_distance = 0.0
    for j in range(len(z)):
        offset = (z[j] - variables[j].first - variables[j]["mean"]) * weights[j]
        squared_distance += offset * offset
    return float(1.0 / (1.0 + squared_distance + now.scatter / now.n_observations))


@inner_kernel
def _update_potentials(learnt: Learnt, settings: Settings, n: int) -> float:
    """Recursion of the centres' potentials, by the distances to z_{t-1}; returns the highest."""
    potentials, squared_distances = learnt.potentials, learnt.squared_distances
    t = learnt.now[0].n_observations + 1.0
    for i in range(lanes(n)):
        potential = potentials[i]
        far = 1.0 + settings.distance_weight * squared_distances[i]
        potentials[i] = (t - 1.0) * potential / ((t - 2.0) + potential * far)
    highest = 0.0
    for i in range(n):
        highest = max(highest, potentials[i])
    return highest


@inner_kernel
def _absorb(now: Any, variables: Records, weights: Floats, z: Floats) -> None:
    """Add the observation to the running mean and scatter (Welford 1962)."""
    share = 1.0 / (now.n_observations + 1.0)
    increment = 0.0
    for j in range(len(z)):
        variable = variables[j]
        variable.latest = z[j]
        offset = z[j] - variable.first
        before = offset - variable["mean"]
        mean = variable["mean"] + before * share
        variable["mean"] = mean
        increment += (before * weights[j]) * ((offset - mean) * weights[j])
    now.n_observations += 1
    now.scatter += increment


@inner_kernel
def width_of(settings: Settings, variance: float) -> float:
    """Width of recognition by the total variance of observations; the paper leaves it open."""
    if settings.rule == NOVELTY:
        return settings.spread * settings.radius * settings.radius
    return settings.spread * variance


@inner_kernel
def recognise(
    squared_distances: Floats, n: int, nearest: int, width: float, tolerance: float, belief: Floats
) -> None:
    """Write the belief over the first ``n`` states, of which ``nearest`` is the nearest.

    The similarity to a centre is ``exp(-distance^2 / width)``, normalised over the centres.
    Where the width is 0 the nearest centres share the belief.

    States too unlikely to matter get none: what is left out, missing in them and spread over the
    others, is at most ``tolerance`` in all.
    """
    smallest = squared_distances[nearest]
    scale = 1.0 / width if width * _SHARPEST > 1.0 else _SHARPEST
    for i in range(n):
        exponent = (smallest - squared_distances[i]) * scale
        similarity = exponential(max(exponent, _LOWEST_EXPONENT))
        belief[i] = similarity if exponent > _LOWEST_EXPONENT else 0.0
    if tolerance > 0.0:
        least = 0.5 * tolerance * total(belief, n) / n
        for i in range(n):
            belief[i] = belief[i] if belief[i] >= least else 0.0
    share = 1.0 / total(belief, n)
    for i in range(n):
        belief[i] *= share


@kernel
def recognise_rows(
    centers: Floats, weights: Floats, rows: Floats, width: float, n: int, belief: Floats
) -> None:
    """Write the belief (N, lanes of n) of each row, given centres (m, n) and 1 / scale of each."""
    for row in range(len(rows)):
        squared_distances = belief[row]  # which is written over
        measure_distances(centers, weights, n, rows[row], squared_distances)
        for i in range(n, len(squared_distances)):
            squared_distances[i] = np.inf
        nearest = nearest_center(squared_distances, n)
        recognise(squared_distances, len(squared_distances), nearest, width, 0.0, squared_distances)

"""Backups: constant actions, and linear feedback that evolves (`rollout`).

With the share v_q(s) of the horizon that backup q survives from situation s, over some
disturbances, and a little for the distance to failure, backups Q together are worth

    F(Q) = mean_s max_q v_q(s) + 0.01 sum_q mean_s v_q(s).

A mutant, or a linear-quadratic regulator of drawn costs, takes the place of the linear backup for
which F grows most, if it grows. They are asked in the order in which each adds most to F of those
before it, the greedy order for a submodular function (Nemhauser, Wolsey & Fisher 1978).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product

import numpy as np
from numpy.random import Generator

from evofsm.guard.learnt.model import ridge
from evofsm.guard.learnt.rollout import ROUNDING, SMALL, Floats, Ints, Model, features, rollout
from evofsm.guard.learnt.state import State

# Of mutants the share that are of the best, the share of numbers that differ, by a size of 10 to a
# power between these.
_OF_BEST, _CHANGED, _SIZES = 0.8, 0.6, (-1.5, 0.7)
# Of regulators the powers of 10 between which costs of variables and of actions are drawn, what
# counts of a cost a step later.
_COSTS, _EFFORTS, _LATER = (-1.0, 1.0), (-2.0, 1.0), 0.99
# What a backup is worth by itself counts so much beside what it adds to others; its decimals.
_BY_ITSELF, _DECIMALS = 0.01, 9
# Observations to which a given backup is fitted, or some more.
_FITTED = 200
# Boxes of more dimensions have an action along each axis, not one in each corner.
_MAX_CORNERS = 3


def first_backups(state: State, u: Floats) -> State:
    """Begin with constants, and linear ones of which nothing was learnt yet.

    By actions (T, a) of the first episode: it makes no difference in which order or direction they
    come.
    """
    a, choices, n_linear = u.shape[1], state.choices, state.settings.n_linear
    order, turns = basis(u, choices)
    if choices:
        ends = np.eye(a)
    else:
        ends = np.vstack([-np.eye(a), np.eye(a)])
        if a <= _MAX_CORNERS:
            ends = np.array(list(product((-1.0, 1.0), repeat=a)))
        ends = np.vstack([ends, np.zeros(a)])
    policies = np.zeros((len(ends) + n_linear, a, 1 + len(state.origin)))
    policies[: len(ends), order, 0] = ends
    policies *= turns[:, None]
    if choices:  # of equals the first in that order, whatever its index
        policies[:, order, 0] -= ROUNDING * np.arange(a)
    linear = np.append(np.zeros(len(ends)), np.ones(n_linear))
    return state._replace(policies=policies, linear=linear)


def fitted(state: State, model: Model, backup: Callable[[Floats], Floats]) -> State:
    """Fit linear feedback to a given backup, from an observation to an encoded action (a,)."""
    every = max(1, len(state.survived) // _FITTED)
    z = state.survived[::every]
    x = np.column_stack([np.ones(len(z)), (z - model.mean) * model.inverse])
    weights, *_ = np.linalg.lstsq(x, np.array([backup(row) for row in z]), rcond=None)
    rest = state.linear != 2.0
    return state._replace(
        policies=np.concatenate([weights.T[None], state.policies[rest]]),
        linear=np.append(2.0, state.linear[rest]),
    )


def basis(rows: Floats, choices: int = 0) -> tuple[Ints, Floats]:
    """(k,) an order of columns, and their directions, whatever their own ones are.

    By their mean size, of equals by the first rows in which they differ.
    """
    exact = (-rows if choices else np.abs(rows)).round(_DECIMALS)
    turns = np.ones(rows.shape[1]) if choices else np.where((rows**3).sum(0) < 0.0, -1.0, 1.0)
    return np.lexsort((*exact[::-1], exact.mean(0).round(_DECIMALS))), turns


def linearised(state: State, model: Model) -> tuple[Floats, Floats, Floats]:
    """Fit linear dynamics to what is expected in all situations, of all ends of actions.

    Of x = [1, (z - mean) / spread] the next one is A x + B u: A (1 + m, 1 + m), B (1 + m, a), and
    the situations (S, 1 + m) as such x.
    """
    a, m = state.policies.shape[1], len(model.origin)
    ends = np.vstack([-np.eye(a), np.zeros(a), np.eye(a)])
    rows = np.repeat(state.situations, len(ends), axis=0)
    z, u = rows[:, :m], np.tile(ends, (len(state.situations), 1))
    phi = features(model, z, rows[:, m : 2 * m], rows[:, 2 * m :], u)
    x = np.column_stack([np.ones(len(z)), (z - model.mean) * model.inverse])
    inputs, changes = np.hstack([x, u]), phi @ model.weights * model.inverse
    penalty = np.full(1 + m + a, SMALL * len(x))
    weights = ridge(inputs.T @ inputs, inputs.T @ changes, penalty).T
    A, B = np.eye(1 + m), np.zeros((1 + m, a))
    A[1:] += weights[:, : 1 + m]
    B[1:] = weights[:, 1 + m :]
    return A, B, x[:: len(ends)]


def regulator(A: Floats, B: Floats, cost: Floats, effort: float, steps: int) -> Floats:
    """(a, 1 + m) linear feedback u = -K x of the least sum of x'Qx + effort u'u over the steps.

    Of dynamics A x + B u (`linearised`), with Q the ``cost`` (1 + m, 1 + m), by Riccati's recursion
    (Kalman, "Contributions to the theory of optimal control", Boletin de la Sociedad Matematica
    Mexicana 5, 1960). It ends where what is to come costs too much to be told. Mutants alone rarely
    hit on feedback of many variables.
    """
    K: Floats = np.zeros(B.T.shape)
    P = cost
    for _ in range(steps):
        K = np.asarray(np.linalg.solve(effort * np.eye(B.shape[1]) + B.T @ P @ B, B.T @ P @ A))
        P = cost + _LATER * A.T @ P @ (A - B @ K)
        if ROUNDING * np.abs(P).max() > cost.max():
            break
    return -K


def evolved(state: State, model: Model, residuals: Floats, random: Generator) -> State:
    """Take backups that are worth more, in the order in which they are asked."""
    policies, situations, settings = state.policies.copy(), state.situations, state.settings
    scale = state.disturbance_scale

    def worth(policy: Floats) -> Floats:
        """(S,) how well it ends in each situation, in the mean of all disturbances."""
        worths = rollout(model, situations, policy, residuals, scale).worth
        return np.asarray(worths.reshape(len(situations), -1).mean(1))

    values = np.array([worth(policy) for policy in policies])
    parents = np.flatnonzero(state.linear == 1.0)
    shape, m = policies.shape[1:], len(model.origin)
    away = (situations[:, :m] - model.mean) * model.inverse
    variables, flips = basis(away)
    flips[(away**3).sum(0) == 0.0] = 0.0  # of what did not vary yet it knows no direction
    actions, turns = basis(situations[:, 2 * m :], model.choices)
    cells = np.ix_(np.argsort(actions), np.argsort(np.append(0, 1 + variables)))
    signs = np.append(1.0, flips) * turns[:, None]

    def mutant() -> Floats:
        """Change some numbers of the best backup, or of any."""
        parent = parents[values[parents].mean(1).round(_DECIMALS).argmax()]
        if random.random() >= _OF_BEST:
            parent = int(random.integers(len(policies)))
        size = 10.0 ** random.uniform(*_SIZES)
        mutation = (random.random(shape) < _CHANGED) * size * random.standard_normal(shape)
        return np.asarray(policies[parent] + mutation[cells] * signs)

    def drawn_regulators() -> Iterator[Floats]:
        """Lead to the middle of what was survived, or to a situation."""
        A, B, x = linearised(state, model)
        while True:
            costs = 10.0 ** random.uniform(*_COSTS, m)[np.argsort(variables)]
            place = x[random.integers(len(x))] if random.random() < 0.5 else np.eye(1 + m)[0]
            away = np.eye(1 + m)[1:] - np.outer(place[1:], np.eye(1 + m)[0])
            effort = 10.0 ** random.uniform(*_EFFORTS)
            yield regulator(A, B, (away.T * costs) @ away, effort, state.horizon)

    regulators = drawn_regulators()
    # Indices of actions are no input that a regulator could weigh.
    n_tried = settings.n_mutants + (0 if model.choices else settings.n_regulators)
    for k in range(n_tried if len(parents) else 0):
        child = mutant() if k < settings.n_mutants else next(regulators)
        child_values = worth(child)
        variants = np.repeat(values[None], 1 + len(parents), 0)  # as they are, and with the child
        variants[1 + np.arange(len(parents)), parents] = child_values
        together = variants.max(1).mean(1) + _BY_ITSELF * variants.mean(2).sum(1)
        best = int(together.round(_DECIMALS).argmax())  # of equals the first: nothing changes
        if best:
            policies[parents[best - 1]], values[parents[best - 1]] = child, child_values
    pool, most, order = list(range(len(values))), np.full(values.shape[1], -1.0), []
    while pool:  # first the one that is worth most, then whichever adds most
        adds = np.maximum(values[pool] - most, 0.0).mean(1)
        adds = (adds + _BY_ITSELF * values[pool].mean(1)).round(_DECIMALS)
        order.append(pool.pop(int(adds.argmax())))
        most = np.maximum(most, values[order[-1]])
    return state._replace(policies=policies[order], linear=state.linear[order])

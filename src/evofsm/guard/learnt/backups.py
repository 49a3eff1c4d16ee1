"""Backups: constant actions, and linear feedback u = clip(b + K'z) that evolves by mutation.

With the share v_q(s) of the horizon that backup q survives from situation s, over some
disturbances, and a little for the distance to failure, backups Q together are worth

    F(Q) = mean_s max_q v_q(s) + 0.01 sum_q mean_s v_q(s).

A mutant takes the place of the linear backup for which F grows most, if it grows. They are asked in
the order in which each adds most to F of those before it, the greedy order for a submodular
function (Nemhauser, Wolsey & Fisher 1978).
"""

from __future__ import annotations

from itertools import product

import numpy as np

from evofsm.guard.learnt.rollout import Floats, Ints, Model, rollout
from evofsm.guard.learnt.state import Settings, State

# Of mutants the share that are of the best, the share of numbers that differ, by a size of 10 to a
# power between these.
_OF_BEST, _CHANGED, _SIZES = 0.8, 0.6, (-1.5, 0.7)
# What a backup is worth by itself counts so much, compared with what it adds to the others.
_BY_ITSELF = 0.01
# Boxes of more dimensions have an action along each axis, not one in each corner.
_MAX_CORNERS = 3
# So much less is a choice preferred than the one before it in order, where both are worth the same.
_PREFERRED = 1e-9


def canonical(state: State) -> tuple[Ints, Floats, Ints, Floats]:
    """Order and signs of variables (m,), and of the numbers of an action (a,).

    Draws and ties follow them: so it makes no difference in which order and direction numbers come.
    Variables are ordered by their pace, actions by how they were used.
    """
    rows, m, a = state.survived, len(state.origin), len(state.used)
    spread = rows.std(0)
    pace = state.unit / np.where(spread > 0.0, spread, 1.0)
    flips = np.where(((rows - rows.mean(0)) ** 3).sum(0) < 0.0, -1.0, 1.0)
    mean = state.squares[0, 1 + 2 * m : 1 + 2 * m + a]
    turns = np.where((mean < 0.0) & (state.choices == 0), -1.0, 1.0)
    order = np.argsort(-np.abs(mean).round(9), kind="stable")
    return np.argsort(pace, kind="stable"), flips, order, turns


def first_backups(state: State, n_linear: int) -> tuple[Floats, Floats]:
    """(b, a, 1 + m) those that nothing was learnt of yet, and (b,) which evolve."""
    _, _, actions, turns = canonical(state)
    a, m = len(state.used), len(state.origin)
    if state.choices:
        corners = np.eye(a)
    else:
        corners = np.vstack([-np.eye(a), np.eye(a)])
        if a <= _MAX_CORNERS:
            corners = np.array(list(product((-1.0, 1.0), repeat=a)))
        corners = np.vstack([corners, np.zeros(a)])
    policies = np.zeros((len(corners) + n_linear, a, 1 + m))
    policies[: len(corners), actions, 0] = corners * turns[actions]
    if state.choices:  # of equals the first in that order, whatever its index
        policies[:, actions, 0] -= _PREFERRED * np.arange(a)
    return policies, np.append(np.zeros(len(corners)), np.ones(n_linear))


def evolved(
    state: State,
    model: Model,
    residuals: Floats,
    scale: float,
    settings: Settings,
    random: np.random.Generator,
) -> State:
    """Backups that are worth more, in the order in which they are asked.

    Parameters
    ----------
    state : State
    model : Model
    residuals : (H, m, K) ndarray
        Of disturbances, number 0 none, amid which they are tried in all situations.
    scale : float
        How much harder than they were these are taken to be.
    settings : Settings
    random : Generator

    Returns
    -------
    State
        With those backups.
    """
    situations, linear = state.situations, state.linear
    variables, flips, actions, turns = canonical(state)
    columns = np.append(0, 1 + variables)
    signs = turns[actions][:, None] * np.append(1.0, flips[variables])
    policies, each = state.policies.copy(), residuals.shape[2]

    def worth(policy: Floats) -> Floats:
        """(S,) how well it ends in each situation, in the mean of all disturbances."""
        found = rollout(model, situations, policy, residuals, scale).worth
        return np.asarray(found.reshape(-1, each).mean(1))

    values, those = np.array([worth(policy) for policy in policies]), np.flatnonzero(linear)
    shape = policies.shape[1:]
    for _ in range(settings.n_mutants if len(those) else 0):
        parent = those[values[those].mean(1).argmax()]
        if random.random() >= _OF_BEST:
            parent = int(random.integers(len(policies)))
        size = 10.0 ** random.uniform(*_SIZES)
        drawn = (random.random(shape) < _CHANGED) * size * random.standard_normal(shape)
        child = policies[parent].copy()
        child[actions[:, None], columns] += signs * drawn
        reached = worth(child)
        tried = np.repeat(values[None], 1 + len(those), 0)  # as they are, and with the child
        tried[1 + np.arange(len(those)), those] = reached
        together = tried.max(1).mean(1) + _BY_ITSELF * tried.mean(2).sum(1)
        best = int(together.round(9).argmax())  # of equals the first: nothing changes
        if best:
            policies[those[best - 1]], values[those[best - 1]] = child, reached
    left, most, order = list(range(len(values))), np.full(values.shape[1], -1.0), []
    while left:  # first the one that is worth most, then whichever adds most
        adds = np.maximum(values[left] - most, 0.0).mean(1)
        adds = (adds + _BY_ITSELF * values[left].mean(1)).round(9)
        order.append(left.pop(int(adds.argmax())))
        most = np.maximum(most, values[order[-1]])
    return state._replace(policies=policies[order], linear=linear[order])

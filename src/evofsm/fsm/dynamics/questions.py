"""What dynamics say when they are asked: what comes next, what may begin, what was never seen."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.fsm.dynamics.consequents import (
    Consequents,
    Disturbances,
    Here,
    advance,
    begin_at,
    futures,
)
from evofsm.fsm.dynamics.dynamics import Dynamics
from evofsm.fsm.dynamics.following import encoded
from evofsm.fsm.kernels import compiled
from evofsm.fsm.rates import Rate

_Floats = NDArray[np.float64]


class Ahead(NamedTuple):
    """What is expected in the steps ahead, in the units of the m variables."""

    mean: _Floats  #: (steps, m) observations if nothing unexpected begins
    #: (steps, m) standard deviation: of ordinary residuals, as if each were independent of the one
    #: before, and of all remembered stretches, as if one of them or none began now, each alike
    spread: _Floats


class Remembered(NamedTuple):
    """A stretch in which something happened that was not expected."""

    size: float  #: largest residual, in ordinary ones
    change: _Floats  #: (m,) sum of all residuals, in the units of the variables
    steps: int  #: number of steps that are remembered
    episode: int  #: in which it was seen, from 0


class MayBegin(NamedTuple):
    """What may begin, as far as it was seen, and how often such began."""

    stretches: tuple[Remembered, ...]  #: the newest last
    rate: Rate  #: of all onsets, of those that are no longer remembered too


def look_ahead(
    dynamics: Dynamics, action: ArrayLike, steps: int | None, z: ArrayLike | None = None
) -> Ahead:
    """What comes next, from the latest observation or from ``z`` at rest: see `Known.what_next`."""
    _refuse_too_early(dynamics)
    if z is not None:
        here = Here(
            np.asarray(z, np.float64), np.zeros(dynamics.n_variables), np.zeros(dynamics.size)
        )
    elif dynamics.is_under_way:
        here = dynamics.here
    else:
        raise ValueError("nothing was observed yet in this episode; give an observation")
    actions = _held(dynamics, action, steps)
    found = dynamics.disturbances()
    missing = max(0, len(actions) - dynamics.horizon)
    found = found._replace(residuals=np.pad(found.residuals, [(0, 0), (0, missing), (0, 0)]))
    path = np.empty((len(found.residuals), len(actions), dynamics.n_variables))
    _foresee(dynamics.consequents, here, actions, found, path)
    ordinary = dynamics.sums.scale * np.sqrt(np.arange(1.0, len(actions) + 1.0))[:, None]
    return Ahead(path[0], np.sqrt(ordinary**2 + ((path - path[0]) ** 2).mean(0)))


def remembered(dynamics: Dynamics) -> tuple[Remembered, ...]:
    """What may begin: see `Known.may_begin`."""
    if not dynamics.n_variables or not dynamics.stretches:
        return ()
    residuals = dynamics.disturbances().residuals[1:]
    sizes = np.abs(residuals / np.maximum(dynamics.sums.scale, 1e-300)).max(axis=(1, 2))
    steps = [min(len(one.actions) - 1, dynamics.horizon) for one in dynamics.stretches]
    episodes = [one.episode for one in dynamics.stretches]
    changes = residuals.sum(axis=1)
    return tuple(map(Remembered, sizes.tolist(), changes, steps, episodes))


def beyond(dynamics: Dynamics, z: _Floats) -> tuple[int, ...]:
    """The variables that are outside of all that was survived in the episodes that are over."""
    if not dynamics.n_variables:
        return tuple(range(len(z)))
    outside = (z < dynamics.lowest) | (z > dynamics.highest)
    return tuple(np.flatnonzero(outside).tolist())


def _refuse_too_early(dynamics: Dynamics) -> None:
    if not dynamics.n_variables or not dynamics.ready:
        raise ValueError("too little was observed to expect anything of what comes next")


def _held(dynamics: Dynamics, action: ArrayLike, steps: int | None) -> _Floats:
    """(steps, a) one action again and again, or those given."""
    given: Any = np.asarray(action)
    single = given.ndim == 0 or (not dynamics.choices and given.ndim == 1)
    rows = [given] * (steps or 1) if single else list(given)
    if not rows or (steps is not None and len(rows) != steps):
        raise ValueError(f"action holds {len(rows)} of them; {steps} steps need one each")
    return np.array([encoded(dynamics, 0, one) for one in rows])


@compiled
def _foresee(
    known: Consequents, here: Here, actions: _Floats, disturbances: Disturbances, path: _Floats
) -> None:
    """Replay actions under each disturbance, into ``path`` (K, steps, m)."""
    room = futures(known, actions.shape[1], np.arange(len(path)), disturbances)
    begin_at(room, here)
    for t in range(len(actions)):
        for i in range(actions.shape[1]):
            room.action[i] = actions[t, i]
        advance(known, disturbances, t, 1.0, room)
        path[:, t] = room.z[:, : len(path)].T

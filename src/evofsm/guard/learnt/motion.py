"""What an episode says of how a system moves: typical steps, ends of variables, and the model.

Sums of features and changes are added up (`model.solve`). Where a correction by the last episodes
foresees their changes better than the model for long (a CUSUM of gained log likelihood, Page 1954,
of a heavy-tailed residual), the system moves otherwise now, and the model is corrected.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from evofsm.guard.learnt import model
from evofsm.guard.learnt.rollout import ROUNDING, SMALL, Flags, Floats, Ints, Model, features, lags
from evofsm.guard.learnt.state import Move, State, model_of

# Changes of which the typical step is learnt; a larger one counts as so many times that.
_MOST_CHANGES, _LARGEST_STEP = 5000.0, 6.0
# An action is used at the end of its range from so far on.
_NEAR_END = 0.6
# Changes of an episode that tell how large residuals are; how much the latest of them counts.
_FEWEST_CHANGES, _LATEST = 5, 0.2
# A variable that rests in more of the steps, such as a contact, is not held at an end as long as
# nothing is known.
_MOSTLY = 0.5
# What rests in fewer of the steps, and is at one end or the other, is a flag.
_RARELY = 0.9
# What rests at an end, and was expected to go on by so many scales, is held there.
_STOPS = 4.0
# Episodes before it may move otherwise, and after it did, in which it is learnt how; transitions
# that a correction needs, and how it is held to 0.
_LEARNT, _FEWEST_ROWS, _HELD = 20, 15.0, 0.3
# Steps from which it is tried how much lags foresee, and what is missed counts at most [steps].
_STARTS, _FAR_OFF = 12, 1e9


def steps(state: State, z: Floats) -> State:
    """Learn typical steps, and ends of what was seen, of observations (T + 1, m)."""
    rows = z[np.isfinite(z).all(1)]
    if not len(rows):
        return state
    low, high = rows.min(0), rows.max(0)
    close = ROUNDING * (high - low)
    lowest, new_low = _extremes(state.lowest, low, close)
    highest, new_high = _extremes(-state.highest, -high, close)
    visits = np.where(np.array([new_low, new_high]).T, 0.0, state.reached)
    state = state._replace(lowest=lowest, highest=-highest, reached=visits)
    change = np.diff(z, axis=0)
    is_seen: Flags = np.asarray(np.isfinite(change).all(1))
    if not is_seen.any():
        return state
    latest = model.typical_step(z)
    unit = state.unit if state.n_moves else latest
    size = np.minimum(np.abs(change[is_seen]), _LARGEST_STEP * np.maximum(unit, latest))
    n = min(state.n_moves, _MOST_CHANGES)
    ordinary = np.where(model.jumps(change, unit) | ~is_seen[:, None], 0.0, change)
    is_moving = np.abs(change) > close  # it arrived there, and did not start there
    arrivals = [
        ((z[1:] <= lowest[0] + close) & is_moving).any(0),
        ((z[1:] >= -highest[0] - close) & is_moving).any(0),
    ]
    return state._replace(
        unit=(n * unit + size.sum(0)) / (n + len(size)),
        power=(n * state.power + (change[is_seen] ** 2).sum(0)) / (n + len(size)),
        n_moves=state.n_moves + len(size),
        least=np.minimum(state.least, ordinary.min(0)),
        most=np.maximum(state.most, ordinary.max(0)),
        reached=visits + np.array(arrivals).T,
    )


def _extremes(known: Floats, new: Floats, close: Floats) -> tuple[Floats, Flags]:
    """(2, m) the least of two episodes, and (m,) whether the first of them is new."""
    is_new = new < known[0] - close
    second = np.where(is_new, known[0], np.minimum(known[1], new))
    return np.array([np.where(is_new, new, known[0]), second]), is_new


def dynamics(state: State, known: Model, z: Floats, u: Floats) -> State:
    """Learn the model of observations (T + 1, m) and actions (T, a); NaN was not seen.

    Outliers of the model ``known`` weigh less, but for those that follow an action that was hardly
    used; jumps, and what is held at an end of a variable, are left out.
    """
    phi, change, is_seen = model.rows_of(known, z, u)
    settings, m = state.settings, len(state.unit)
    rest = model.disturbed(known, z, u, state.unit)[:, :m]
    after, rests = z[2:], z[2:] == z[1:-1]
    to, is_known = z[1:-1] + phi @ known.weights, bool(state.scale.any())
    is_beyond = np.abs(to - after) > state.scale if is_known else rests.mean(0) <= _MOSTLY
    at_ends = (after <= state.lowest[0]) | (after >= state.highest[0])
    is_flag = at_ends.all(0) & (rests.mean(0) < _RARELY)  # it is nowhere else, and comes and goes
    is_held = rests & _held(state, to, after).any(0) & is_beyond & ~is_flag
    weight = np.where(model.are_jumps(z, state.unit) | is_held.any(1), 0.0, 1.0)
    if is_known:
        off = np.abs(rest) / np.maximum(state.scale, model.FLOOR * state.unit + 1e-300)
        is_new = (used_at(u[1:], state.choices) & (state.used < settings.rare)).any((1, 2))
        usual = np.minimum(1.0, settings.outlier / np.maximum(off.max(1), 1e-12))
        weight *= np.where(is_new, 1.0, usual)
        free = ((after > known.lowest) & (after < known.highest)).all(1)
        ordinary = ((change >= state.least) & (change <= state.most)).all(1)
        rows = is_seen & free & ordinary
        state = _drifted(state, known, phi[rows], change[rows], np.diff(z, axis=0))
    x, row_weights = phi[is_seen], weight[is_seen, None]
    state = state._replace(
        squares=state.squares + x.T @ (row_weights * x),
        products=state.products + x.T @ (row_weights * change[is_seen]),
    )
    is_moving = is_seen[:, None] & ~rests
    if (here := is_moving.any(1)).sum() < _FEWEST_CHANGES:
        return state
    now = model_of(state)
    rest = np.abs(model.disturbed(now, z, u, state.unit)[:, :m])
    size = [
        1.4826 * np.median(r[h]) if h.sum() >= _FEWEST_CHANGES else 0.0
        for r, h in zip(rest.T, is_moving.T, strict=True)
    ]
    share = _LATEST if is_known else 1.0
    scale = (1.0 - share) * state.scale + share * np.array(size)
    noise = (1.0 - share) * state.noise + share * (rest[here] ** 2).mean(0)
    scale = np.maximum(scale, model.FLOOR * state.unit)
    to = z[1:-1] + phi @ now.weights
    stops = _held(state, to, after) & rests & is_seen[:, None] & (abs(to - after) > _STOPS * scale)
    visits = np.where(stops.any(1).T & is_known, np.maximum(state.reached, 2.0), state.reached)
    return state._replace(scale=scale, noise=noise, reached=visits)


def misled(state: State, z: Floats, u: Floats, starts: Ints, *, failed: bool) -> State:
    """Ask whether more had been foreseen without lags, where failure did not come as foreseen.

    A feature may help one step ahead, and mislead over many. From each step of ``starts`` an
    episode z (T + 1, m), u (T, a) went on for the whole horizon although nothing seemed to help. If
    it failed in the end, lags are not exonerated.
    """
    begins = starts[np.unique(np.linspace(0, len(starts) - 1, _STARTS).astype(int))]
    ahead = begins[:, None] + np.arange(-1, state.horizon + 1)
    if not np.isfinite(z[ahead]).all():
        return state
    errors = []
    for doubt in (0.0, state.settings.misled):
        motion_model = model_of(state._replace(misled=doubt))
        at, before, total = z[ahead[:, 1]], z[ahead[:, 0]], 0.0
        for now in ahead[:, 1:-1].T:
            phi = features(motion_model, at, at - before, u[now - 1], u[now])
            move = np.clip(phi @ motion_model.weights, motion_model.least, motion_model.most)
            at, before = np.clip(at + move, motion_model.lowest, motion_model.highest), at
            off = np.abs(at - z[now + 1]) / np.maximum(state.unit, 1e-300)
            total += np.log1p(np.minimum(off, _FAR_OFF) ** 2).sum(1).mean()
        errors.append(total / state.horizon)
    worse = np.clip(errors[0] - errors[1], 0.0 if failed else -1.0, 1.0)
    return state._replace(misled=max(0.0, state.misled + float(worse)))


def told(state: State, known: Model, z: Floats, move: Move, random: Generator) -> State:
    """Learn what a given model says of observations (T + 1, m), each under an action that is drawn.

    ``known`` says which features there are.
    """
    latest = np.diff(z, axis=0)
    rows = np.flatnonzero(np.isfinite(latest).all(1))
    shape = len(rows), len(state.used)

    def drawn() -> Floats:
        if state.choices:
            return np.asarray(np.eye(shape[1])[random.integers(shape[1], size=shape[0])])
        return random.uniform(-1.0, 1.0, shape)

    at, before, u = z[rows + 1], drawn(), drawn()
    phi = features(known, at, random.permutation(latest[rows]), before, u)
    after = at
    for _ in range(state.stride):
        after = np.array([move(*pair) for pair in zip(after, u, strict=True)]).reshape(at.shape)
    change = after - at
    return state._replace(
        squares=state.squares + phi.T @ (1.0 * phi), products=state.products + phi.T @ change
    )


def used_at(u: Floats, choices: int) -> Flags:
    """(T, a, 2) which numbers of actions (T, a) are near an end of their range."""
    lowest = -1.0 if choices else -_NEAR_END
    return np.stack([u < lowest, u > _NEAR_END], 2)


def _held(state: State, to: Floats, after: Floats) -> Flags:
    """(2, T, m) what came to the lowest or highest, and was expected to go on, or as far."""
    low, high = state.lowest[0], state.highest[0]
    return np.array([(after <= low) & (to <= after), (after >= high) & (to >= after)])


def _drifted(state: State, known: Model, phi: Floats, change: Floats, moves: Floats) -> State:
    """Correct the model, where it is otherwise now, by features and changes of an episode.

    ``moves`` (T, m) are all changes of the episode.
    """
    n, settings = state.n_episodes, state.settings
    size = np.maximum(np.maximum(state.scale, 0.5 * state.unit), 1e-100)
    errors = change - phi @ known.weights
    new_errors = errors - phi @ _correction(state, known)
    gains = np.log1p((errors / size) ** 2) - 2.0 * np.log1p((new_errors / size) ** 2)
    doubt = np.maximum(state.doubt + gains.sum(0), 0.0) * (n >= _LEARNT)
    young = n - state.drifts[:, 2] < _LEARNT
    fades = settings.drift_fade if young.any() or doubt.any() else 0.0
    state = state._replace(
        recent_squares=fades * state.recent_squares + phi.T @ (1.0 * phi),  # no threads for it
        recent_products=fades * state.recent_products + phi.T @ change,
        doubt=doubt,
        since=np.where(doubt > 0.0, state.since, float(n)),
    )
    is_new = doubt > settings.drift
    drifts = is_new.copy()
    drifts[state.drifts[young, 0].astype(int)] = True
    if not drifts.any():
        return state
    products = state.products.copy()
    weights = known.weights + _correction(state, known)
    products[:, drifts] = state.squares @ weights[:, drifts]
    moves = np.where(model.jumps(moves, state.unit) | ~np.isfinite(moves), 0.0, moves)
    state = state._replace(
        products=products,
        least=np.where(is_new, moves.min(0), state.least),
        most=np.where(is_new, moves.max(0), state.most),
        drifts=np.vstack([state.drifts, *[[j, state.since[j], n] for j in np.flatnonzero(is_new)]]),
        doubt=np.where(drifts, 0.0, doubt),
        since=np.where(drifts, float(n), state.since),
    )
    return _anew(state) if is_new.any() else state


def _anew(state: State) -> State:
    """Trust model and disturbances as little as at first: it may take longer to fail, too."""
    settings = state.settings
    longer = settings.ahead * max(state.time_to_failure, settings.horizon / settings.ahead)
    return state._replace(
        time_to_failure=min(longer, settings.horizon_max / settings.ahead),
        believed=float(settings.horizon_max),
        n_scanned=0,
        margin=max(state.margin, settings.margin),
    )


def _correction(state: State, known: Model) -> Floats:
    """(p, m) what is to be added to the weights, by ridge regression about 0."""
    if state.recent_squares[0, 0] < _FEWEST_ROWS:
        return np.zeros_like(known.weights)
    m, a, n = len(state.origin), len(state.used), max(1.0, float(state.squares[0, 0]))
    size = np.diag(state.squares) / n
    variance = np.maximum(size - (state.squares[0] / n) ** 2, SMALL * size)
    variance[0] = 1.0
    penalty, late = _HELD * variance, lags(m, a)
    penalty[1 + 2 * m + 2 * a :] *= 30.0
    penalty[late] = 1e12 * np.maximum(size[late], 1e-12)  # these stay as they are
    remainder = state.recent_products - state.recent_squares @ known.weights
    correction = model.ridge(state.recent_squares, remainder, penalty)
    return correction if np.isfinite(correction).all() else np.zeros_like(correction)

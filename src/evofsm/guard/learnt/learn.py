"""Algorithm 1: what a judge knows after an episode, of what it knew before.

`learn` is a pure function: nothing that it is given changes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from evofsm.guard.learnt import failure, model
from evofsm.guard.learnt.backups import evolved, first_backups
from evofsm.guard.learnt.failure import CRASHES, ENDS, FAILS, SAYS, SIZE
from evofsm.guard.learnt.rollout import Floats, Ints, Model, lags, value_of
from evofsm.guard.learnt.state import (
    Episode,
    Settings,
    State,
    model_of,
    residuals_of,
    sizes,
    weak,
)

# Episodes of fewer steps say nothing of how a system moves.
_SHORTEST = 3
# Of an episode that was cut off the last ones, of which it is not known that they were survived.
_UNPROVEN = 10
# What is lost in so few steps, whatever one does, is no argument; nor is what is survived by more.
_AT_ONCE, _BY_FAR = 3, 100.0
# Dead ends: how near an old one counts once more, how far new ones are apart and their first
# radius, each further episode doubles it; share of the way to what was survived.
_NEAR, _APART, _WAY, _MAX_ENDS = 0.6, 0.15, 0.9, 40


def learn(state: State, episode: Episode, settings: Settings, seed: int, parts=frozenset(), given_horizon=False, asked=None) -> State:
    """Learn from an episode."""
    random = np.random.default_rng([seed, state.n_episodes])
    if not state.n_seen:
        state = state._replace(origin=episode.observations[np.isfinite(episode.observations).all(1)][0])
    unit = state.unit if state.n_moves else model.typical_step(episode.observations)
    z = model.without_glitches(episode.observations, unit)
    u, failed = episode.actions, episode.failed
    state = state._replace(n_seen=state.n_seen + len(z))
    safe = z[:-1] if failed else z
    u = u[: len(safe) - 1]
    before = state
    state = moves(state, safe)
    known = model_of(state, settings)
    if len(u) >= _SHORTEST:
        state = dynamics(state, known, safe, u, settings)
    state = fails(state, z, safe, episode, settings, parts, asked)
    known = model_of(state, settings)
    state = used(state, u)
    if "dead-ends" not in parts and len(state.forms):
        state = dead_ends(state, known, safe, episode)
        known = model_of(state, settings)
    if not len(u) >= _SHORTEST:
        return state._replace(n_episodes=state.n_episodes + 1)
    if not state.policies.shape[0]:
        policies, linear = first_backups(len(state.origin), len(state.used), state.choices, settings.n_linear)
        state = state._replace(policies=policies, linear=linear)
    state = note(state, safe, u, episode, settings, random)
    state = doubted(state, episode, settings, parts)
    known = model_of(state, settings)
    understood = len(state.forms) > 0
    if understood and len(state.situations) > 3:
        state = state._replace(n_scanned=state.n_scanned + 1)
    if "stretches" not in parts:
        state = disturbances(state, known, safe, u, settings, random)
    rest = residuals_of(state, known, state.horizon)
    if understood and not given_horizon:
        state = look_ahead(state, known, rest, episode, settings)
    if understood and len(state.situations) >= 3 and "backups" not in parts:
        some = np.append(0, 1 + random.permutation(rest.shape[2] - 1)[:5]).astype(int)
        policies, linear = evolved(
            state.policies, state.linear, known, state.situations,
            np.ascontiguousarray(rest[:, :, some]), disturbance_scale(state, settings), settings, random,
        )
        state = state._replace(policies=policies, linear=linear)
    margin = 0.0 if "margin" in parts else max(settings.margin_step, settings.margin_fade * state.margin)
    return state._replace(n_episodes=state.n_episodes + 1, margin=margin)


def disturbance_scale(state: State, settings: Settings) -> float:
    """How much harder than they were disturbances are taken to be, while little was seen."""
    most = settings.caution_again if len(state.drifts) else settings.caution_max
    return 1.0 + min(most, settings.caution / max(1, state.n_scanned))


# -- How it moves ---------------------------------------------------------------------------------


def moves(state: State, z: Floats) -> State:
    """Typical steps, and ends of what was seen."""
    change = np.diff(z, axis=0)
    seen = np.isfinite(change).all(1)
    if not seen.any():
        return state
    unit = state.unit if state.n_moves else model.typical_step(z)
    size = np.minimum(np.abs(change[seen]), 6.0 * unit)
    n = min(state.n_moves, 5000)
    mean = (n * unit + size.sum(0)) / (n + len(size))
    ordinary = np.where(model.jumps(change, unit) | ~seen[:, None], 0.0, change)
    rows = z[np.isfinite(z).all(1)]
    low, high = rows.min(0), rows.max(0)
    close = 1e-9 * (high - low)
    lowest, new_low = extremes(state.lowest, low, close)
    highest, new_high = extremes(-state.highest, -high, close)
    highest = -highest
    moving = np.abs(change) > close
    to = z[1:]
    at_low = ((to <= lowest[0] + close) & moving).any(0)
    at_high = ((to >= highest[0] - close) & moving).any(0)
    reached = np.where(np.column_stack([new_low, new_high]), 0.0, state.reached)
    return state._replace(
        unit=mean,
        power=(n * state.power + (change[seen] ** 2).sum(0)) / (n + len(size)),
        n_moves=state.n_moves + len(size),
        least=np.minimum(state.least, ordinary.min(0)), most=np.maximum(state.most, ordinary.max(0)),
        lowest=lowest, highest=highest, reached=reached + np.column_stack([at_low, at_high]),
    )


def extremes(known: Floats, new: Floats, close: Floats) -> tuple[Floats, Floats]:
    """(2, m) the least of two episodes, and (m,) whether the first of them is new."""
    is_new = new < known[0] - close
    first = np.where(is_new, new, known[0])
    second = np.where(is_new, known[0], np.minimum(known[1], new))
    return np.array([first, second]), is_new


def dynamics(state: State, known: Model, z: Floats, u: Floats, settings: Settings) -> State:
    """The sums of the model, and whether it still holds."""
    phi, change, seen = model.rows_of(known, z, u)
    rest = model.residuals(known, z, u, state.unit)
    jumped = model.jumps(np.diff(z, axis=0), state.unit).any(1)
    weight = (seen & ~jumped[1:] & ~jumped[:-1]).astype(float)
    to = z[1:-1] + phi @ known.weights
    low, high = z[2:] <= state.lowest[0], z[2:] >= state.highest[0]
    at_end = ((z[2:] == z[1:-1]) & ((low & (to <= z[2:])) | (high & (to >= z[2:])))).any(1)
    weight[at_end] = 0.0
    if state.scale.any():
        off = np.abs(rest) / np.maximum(state.scale, 1e-3 * state.unit)
        weight *= np.minimum(1.0, settings.outlier / np.maximum(off.max(1), 1e-12)) ** 2
    phi, change = phi[seen], np.where(np.isfinite(change), change, 0.0)[seen]
    weight = weight[seen]
    if not len(phi):
        return state
    if state.scale.any():
        state = drifted(state, known, phi, change, z, settings, seen)
    state = state._replace(
        squares=state.squares + phi.T @ (weight[:, None] * phi),
        products=state.products + phi.T @ (weight[:, None] * change),
    )
    rest = model.residuals(model_of(state, settings), z, u, state.unit)
    size, moved = np.abs(rest), (z[2:] != z[1:-1])
    here = seen & moved.any(1)
    if here.sum() < 5:
        return state
    scale = np.array([1.4826 * np.median(s[h]) if h.sum() > 4 else 0.0
                      for s, h in zip(size.T, (here[:, None] & moved).T, strict=True)])
    new = 0.8 * state.scale + 0.2 * scale if state.scale.any() else scale
    square = (rest[here] ** 2).mean(0)
    noise = 0.8 * state.noise + 0.2 * square if state.scale.any() else square
    return state._replace(scale=np.maximum(new, 1e-3 * state.unit), noise=noise)


def drifted(state: State, known: Model, phi: Floats, change: Floats, z: Floats, settings: Settings, seen) -> State:
    """Whether the last episodes move otherwise."""
    ordinary = ((change >= state.least) & (change <= state.most)).all(1)
    after = z[2:][seen]
    free = ((after > known.lowest) & (after < known.highest)).all(1)
    rows = ordinary & free
    phi, change = phi[rows], change[rows]
    missed = change - phi @ known.weights
    size = np.maximum(np.maximum(state.scale, 0.5 * state.unit), 1e-300)
    n = state.n_episodes
    left = missed - phi @ correction(state, known)
    gained = np.log1p((missed / size) ** 2) - 2.0 * np.log1p((left / size) ** 2)
    doubt = np.maximum(state.doubt + gained.sum(0), 0.0) * (n >= 20)
    young = len(state.drifts) and n - state.drifts[-1, 2] < 20
    fades = settings.drift_fade if young or doubt.any() else 0.0
    since = np.where(doubt > 0.0, state.since, float(n))
    state = state._replace(
        recent_squares=fades * state.recent_squares + phi.T @ phi,
        recent_products=fades * state.recent_products + phi.T @ change,
        doubt=doubt, since=since,
    )
    begun = np.flatnonzero(doubt > settings.drift)
    moved = np.unique(np.append(begun, state.drifts[n - state.drifts[:, 2] < 20, 0])).astype(int)
    if not len(moved):
        return state
    drifts = np.vstack([state.drifts, *[[j, since[j], n] for j in begun]])
    weights = known.weights.copy()
    weights[:, moved] += correction(state, known)[:, moved]
    products = state.products.copy()
    products[:, moved] = state.squares @ weights[:, moved]
    least, most = state.least.copy(), state.most.copy()
    c = np.diff(z, axis=0)
    c = np.where(model.jumps(c, state.unit) | ~np.isfinite(c), 0.0, c)
    least[begun], most[begun] = c.min(0)[begun], c.max(0)[begun]
    doubt, since = doubt.copy(), since.copy()
    doubt[moved], since[moved] = 0.0, float(n)
    state = state._replace(drifts=drifts, products=products, doubt=doubt, since=since, least=least, most=most)
    if len(begun):
        state = anew(state, settings)
    return state


def anew(state: State, settings: Settings) -> State:
    longer = settings.ahead * max(state.time_to_failure, settings.horizon / settings.ahead)
    return state._replace(
        time_to_failure=min(longer, settings.horizon_max / settings.ahead),
        believed=float(settings.horizon_max), n_scanned=0, margin=max(state.margin, settings.margin),
    )


def correction(state: State, known: Model) -> Floats:
    """(p, m) what is to be added to the weights, by ridge regression about 0."""
    found, m, n = np.zeros_like(known.weights), len(state.origin), max(1.0, float(state.squares[0, 0]))
    if state.recent_squares[0, 0] < 15:
        return found
    size = np.diag(state.squares) / n
    variance = np.maximum(size - (state.squares[0] / n) ** 2, 1e-6 * size)
    variance[0] = 1.0
    held, a = 0.3 * variance, len(state.used)
    held[1 + 2 * m + 2 * a :] *= 30.0
    late = lags(m, a)
    held[late] = 1e12 * np.maximum(size[late], 1e-12)
    missed = state.recent_products - state.recent_squares @ known.weights
    found = model.ridge(state.recent_squares, missed, held)
    return found if np.isfinite(found).all() else np.zeros_like(found)


# -- Where it fails -------------------------------------------------------------------------------


def fails(state: State, z: Floats, safe: Floats, episode: Episode, settings: Settings, parts, asked) -> State:
    """Forms of failures and endings."""
    seen = np.isfinite(safe).all(1)
    rows = safe[seen]
    went_on = rows
    if episode.terminated and len(rows):
        unit = sizes(state).unit
        far = (np.abs(rows - rows[-1]) > 0.5 * unit).any(1)
        went_on = rows[: int(np.flatnonzero(far).max(initial=-1)) + 1]
        state = state._replace(ended=np.vstack([state.ended, rows[-1]])[-settings.max_failures :])
    if len(went_on):
        change = np.diff(went_on, axis=0)
        jumped = model.jumps(change, state.unit).any(1)
        new = np.concatenate([went_on, (went_on[:-1] + 0.5 * change)[~jumped]])
        if asked is not None:
            new = new[[not asked(one) for one in new]]
        survived = np.concatenate([state.survived, new])
        survived_in = np.append(state.survived_in, np.full(len(new), float(state.n_episodes)))
        while len(survived) > settings.max_survived:
            survived, survived_in = survived[::2], survived_in[::2]
        state = state._replace(survived=survived, survived_in=survived_in)
    failed = episode.failed and np.isfinite(z[-1]).all()
    if failed:
        most = settings.max_failures
        state = state._replace(failures=np.vstack([state.failures, z[-1]])[-most:])
        if len(rows):
            state = state._replace(brinks=np.vstack([state.brinks, rows[-1]])[-most:])
    return explained(state, parts, failed=failed)


def explained(state: State, parts=frozenset(), *, failed: bool) -> State:
    """Forms of all that failed or ended."""
    known, table = sizes(state), state.forms
    if len(state.ended) >= 2:
        table = endings(state, table, known)
    ends, crashes = table[table[:, SAYS] == ENDS], table[table[:, SAYS] == CRASHES]
    crashed = failure.inside(ends, state.failures).any(0) & failure.inside(crashes, state.failures, 0.0).any(0)
    failures = state.failures[~crashed]
    blur = np.where(state.reached < 2, state.scale[:, None], 0.0)
    outside = known._replace(rows=np.concatenate([known.rows, state.ended]))
    was = state.forms[state.forms[:, SAYS] == FAILS]
    bent = failure.without(was[~failure.are_sides(was)], outside.rows)
    now = failure.explain(FAILS, failures, outside, blur, bends=False)
    rows = np.concatenate([now, bent])
    count = len(bent)
    if count:
        kept = {(int(r[1]), r[failure.B]) for r in was[failure.are_sides(was)]}
        rows = np.concatenate([now[[(int(r[1]), r[failure.B]) in kept for r in now]], bent])
    is_known = not len(failures) or failure.inside(rows, failures).any(0).all()
    if (failed or not is_known) and "regions" not in parts:
        rows = failure.explain(FAILS, failures, outside, blur)
    rows[:, failure.HELD] = failure.inside(rows, failures).sum(1)
    sides = lambda t: [(int(r[1]), r[failure.B]) for r in t if r[1] == r[2] and r[failure.P] == 0.0]
    changed = failed or (sides(was), len(was)) != (sides(rows), len(rows))
    return state._replace(forms=np.concatenate([ends, crashes, rows]), held=0 if changed else state.held)


def endings(state: State, table: Floats, known) -> Floats:
    """Where it ends by itself: nowhere where it went on, nor where it failed like that."""
    rows, ended = table[table[:, SAYS] == ENDS], state.ended
    rows = failure.without(rows, known.rows)
    if len(known.rows) and not failure.inside(rows, ended).any(0).all():
        rows = failure.explain(ENDS, ended, known)
    rows = rows[failure.inside(rows, ended).sum(1) >= 2]
    failed = state.failures[failure.inside(rows, state.failures).any(0)]
    those = known._replace(
        rows=ended, lowest=np.array([ended.min(0)] * 2), highest=np.array([ended.max(0)] * 2)
    )
    crashes = failure.explain(CRASHES, failed, those, least=1.0)
    unlike = failed[~failure.inside(crashes, failed, 0.0).any(0)] if len(failed) else failed
    rows = failure.without(rows, unlike)
    others = table[table[:, SAYS] == FAILS]
    return np.concatenate([rows, crashes, others])


def doubted(state: State, episode: Episode, settings: Settings, parts) -> State:
    """Doubt what hardly any failure tells, if it refuses nearly all for long."""
    if "rivals" in parts or state.held < 0:
        return state
    table = state.forms
    bent = (~failure.are_sides(table) & (table[:, SAYS] == FAILS)).any()
    most, patience = (settings.less, settings.sooner) if bent else (settings.refused, settings.patience)
    little = episode.refused.sum() > most * len(episode.actions) and not episode.failed
    held = state.held + 1 if little else 0
    return state._replace(held=-1 if held >= patience else held)


# -- Dead ends ------------------------------------------------------------------------------------


def dead_ends(state: State, known: Model, z: Floats, episode: Episode) -> State:
    """Balls around what was observed between the last certificate and failure."""
    inverse = known.inverse
    centres, counts = state.centres, state.counts
    held = np.flatnonzero(episode.certified[: len(z) - 1]) if episode.failed else np.empty(0, int)
    if len(held):
        rows = z[held[-1] + 1 :]
        rows = rows[np.isfinite(rows).all(1)]
        if len(rows):
            near = distance(rows, centres, inverse).min(0)
            counts = counts + (near < _NEAR)
            n = len(centres)
            for one in rows:
                far = distance(one[None], centres, inverse)[0]
                if far.min(initial=np.inf) >= _APART:
                    about = counts[:n][far[:n] < _NEAR]
                    centres, counts = np.vstack([centres, one]), np.append(counts, about.max(initial=1.0))
    if not len(centres):
        return state
    radii = np.minimum(_NEAR, _APART * 2.0 ** (np.minimum(counts, 9.0) - 1.0))
    latest = state.survived_in == state.n_episodes
    rows = state.survived[~latest] if episode.failed else state.survived
    rows = rows[-4000:]
    far = distance(centres, rows, inverse)
    radii = np.minimum(radii, _WAY * far.min(1, initial=np.inf))
    ordinary = 1.25 * float(np.sqrt(np.mean((state.unit * inverse) ** 2)))
    left = np.flatnonzero(radii > 0.5 * ordinary)
    left = np.sort(left[np.argsort(-counts[left], kind="stable")[:_MAX_ENDS]])
    return state._replace(centres=centres[left], radii=radii[left], counts=counts[left])


def distance(some: Floats, others: Floats, inverse: Floats) -> Floats:
    """(k, n) of (k, m) and (n, m), in spreads."""
    return np.sqrt((((some[:, None] - others) * inverse) ** 2).sum(2))


# -- Disturbances ---------------------------------------------------------------------------------


def note(state: State, z: Floats, u: Floats, episode: Episode, settings: Settings, random) -> State:
    """Situations: some anywhere, a tight one, some before failure."""
    T = len(u)
    steps = [int(random.integers(1, T))]
    tight = np.flatnonzero(episode.refused[1:T]) + 1
    if len(tight):
        steps.append(int(random.choice(tight)))
    if episode.failed:
        back = random.integers(2, max(3, min(T, state.horizon)), 3)
        steps += list(np.maximum(1, T - 1 - back))
    rows = state.situations
    for t in steps:
        one = np.concatenate([z[t], z[t] - z[t - 1], u[t - 1]])
        if not np.isfinite(one).all():
            continue
        if len(rows) < settings.n_situations:
            rows = np.vstack([rows, one])
        else:
            rows = rows.copy()
            rows[int(random.integers(len(rows)))] = one
    return state._replace(situations=rows)


def disturbances(state: State, known: Model, z: Floats, u: Floats, settings: Settings, random) -> State:
    """Windows of residuals that are worst for the best backups somewhere."""
    H, longest = state.horizon, settings.horizon_max
    m, a = z.shape[1], u.shape[1]
    rest = model.residuals(known, z, u, state.unit)
    T = len(rest)
    starts = np.arange(0, max(1, T - 3), max(1, T // settings.n_starts))
    S = state.situations
    understood = len(state.forms) > 0 and len(S) > 3
    padded = np.vstack([rest, np.zeros((H, m))])
    new = padded[np.arange(H)[:, None] + starts].transpose(0, 2, 1)
    scale = disturbance_scale(state, settings)
    if understood:
        new = np.ascontiguousarray(np.concatenate([np.zeros((H, m, 1)), new], 2))
        ends = worst(known, S[random.permutation(len(S))[:8]], state.policies[:1], new, 1.0)
        starts = starts[np.unique(ends.argmin(1))] if len(ends) else starts[:0]
    else:
        size = np.abs(new / state.unit[:, None]).sum((0, 1))
        starts = starts[np.argsort(-size)[:3]]
    windows, lengths = list(state.windows), list(state.lengths)
    for t in starts:
        n = min(longest, T - t)
        row = np.zeros((longest + 2, m + a))
        row[: n + 2, :m], row[: n + 1, m:] = np.nan_to_num(z[t : t + n + 2], nan=0.0), u[t : t + n + 1]
        seen = np.isfinite(z[t : t + n + 2]).all(1)
        if not seen.all():
            n = int(seen.argmin()) - 2
            if n < 3:
                continue
        windows.append(row)
        lengths.append(n + 2)
    most = settings.n_disturbances
    if len(windows) > most:
        grown = state._replace(windows=np.array(windows), lengths=np.array(lengths, float))
        found = residuals_of(grown, known, H)
        if understood:
            ends = worst(known, S, state.policies[:2], found, scale)
            keep = chosen(ends, most)
        else:
            size = np.abs(found[:, :, 1:] / state.unit[:, None]).sum((0, 1))
            keep = np.argsort(-size)[:most]
        windows, lengths = [windows[k] for k in keep], [lengths[k] for k in keep]
    return state._replace(
        windows=np.array(windows).reshape(-1, longest + 2, m + a), lengths=np.array(lengths, float)
    )


def worst(known: Model, situations: Floats, policies: Floats, residuals: Floats, scale: float) -> Floats:
    """(S, K) how disturbances end in situations in which nothing else is lost."""
    ends = value_of(known, situations, policies, residuals, scale)
    ends = ends[ends[:, 0] >= 0.0, 1:]
    ends = np.where(ends < _AT_ONCE - 1.0 - len(residuals), 1e9, ends)
    return np.minimum(ends, _BY_FAR)


def chosen(ends: Floats, most: int) -> list[int]:
    """Which are worst somewhere, then those that are worst in the mean."""
    if not len(ends):
        return list(range(ends.shape[1]))[-most:]
    keep = np.arange(ends.shape[1])
    value = ends.mean(0)
    while len(keep) > most:  # what is worst nowhere goes first
        free = np.delete(keep, ends[:, keep].argmin(1))
        free = free if len(free) else keep
        keep = keep[keep != free[value[free].argmax()]]
    return keep.tolist()


def look_ahead(state: State, known: Model, rest: Floats, episode: Episode, settings: Settings) -> State:
    """As far as it takes to fail where nothing helps, and half as far again."""
    H, s = state.horizon, settings
    if len(state.situations) <= 3:
        return state
    ends = value_of(known, state.situations, state.policies[: s.n_asked], rest)
    after = float(ends[ends < 0.0].max(initial=-1.0 - H) + 1 + H)
    refuted = episode.lost[: -H].any() if len(episode.lost) > H else False
    failed, was_certified = episode.failed, episode.certified.any()
    T, believed = state.time_to_failure, state.believed
    if not failed and refuted:
        T *= s.refuted
        believed = max(T, s.horizon_min / s.ahead)
    else:
        believed = min(believed / s.latest, float(s.horizon_max))
        longest = max(s.latest * T, min(episode.fails_after, believed))
        if failed and was_certified:
            longest = min(s.ahead * longest, s.horizon_max / s.ahead)
            believed = max(believed, longest)
        T = max(min(after, believed), longest)
    each = known.weights.size * (1 + s.n_disturbances)
    farthest = min(s.horizon_max, s.work / each / s.n_asked)
    return state._replace(
        time_to_failure=T, believed=believed, horizon=int(max(min(s.ahead * T, farthest), s.horizon_min))
    )


def used(state: State, u: Floats) -> State:
    """How often each number of an action was near an end of its range."""
    lowest = -1.0 if state.choices else -0.6
    return state._replace(used=state.used + np.column_stack([(u < lowest).sum(0), (u > 0.6).sum(0)]))

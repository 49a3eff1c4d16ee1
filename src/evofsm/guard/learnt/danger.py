"""What an episode says of where a system fails, and where it ends: forms, and dead ends.

Forms (`failure`) hold observations in which it failed. A *dead end* is a ball of observations from
which a certified episode failed: the model was wrong there. It shrinks to what was survived, and
each further episode that failed near it doubles its radius.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from evofsm.guard.learnt import failure, model
from evofsm.guard.learnt.failure import HELD, B, I, Survived
from evofsm.guard.learnt.rollout import CRASHES, ENDS, FAILS, FATAL, Floats, Model
from evofsm.guard.learnt.state import Episode, Given, State, sizes

# Episodes of which the end tells where there are any, of which so small a share may be in no form
# before these are fitted anew; observations so near the last one [typical steps] cannot be told
# from it.
_ENDED, _STRAY, _SAME_PLACE = 2, 0.2, 0.5
# Dead ends: how near an old one counts once more, how far new ones are apart and their first
# radius [spreads]; share of the way to what was survived; how many at most.
_LARGEST_RADIUS, _APART, _WAY, _MAX_ENDS = 0.6, 0.15, 0.9, 40
# Survived rows that are compared, the latest, of which each so many-th; and of an episode that was
# cut off the last ones, of which it is not known that they were survived.
_MAX_ROWS, _EACH, _UNPROVEN = 6000, 4, 20
# Where failure is given as a function: directions in which it is looked for, how far [spreads],
# halvings to its edge, and how far beyond that it is asked once more.
_RAYS, _EDGE_HALVINGS, _DEEP = 64, 40, 0.05
_RADII = tuple(0.1 * 1.3**k for k in range(20))


def fails(state: State, z: Floats, episode: Episode, given: Given) -> State:
    """Learn where it fails, and where it ends, of observations ``z`` (T + 1, m) of an episode.

    Where it failed too early to see how it moves, a given function alone says where.
    """
    settings, function = state.settings, given.failed
    is_told = function is not None or not episode.early
    failed = episode.failed and is_told and bool(np.isfinite(z[-1]).all())
    rows = z[:-1] if episode.failed else z
    rows = rows[np.isfinite(rows).all(1)]
    most, went_on = settings.max_failures, rows
    if episode.terminated and len(rows):
        far = (np.abs(rows - rows[-1]) > _SAME_PLACE * sizes(state).unit).any(1)
        went_on = rows[: int(np.flatnonzero(far).max(initial=-1)) + 1]
        state = state._replace(ended=np.vstack([state.ended, rows[-1]])[-most:])
    if len(went_on):
        change = np.diff(went_on, axis=0)
        smooth = np.flatnonzero(~model.jumps(change, state.unit).any(1))
        new = np.concatenate([went_on, (went_on[:-1] + 0.5 * change)[smooth]])
        tail = 0 if episode.terminated else _UNPROVEN
        if episode.failed:
            tail = min(state.horizon, len(went_on) // 2)
        at = np.append(np.arange(len(went_on)), smooth)
        proven = np.append(state.proven, 1.0 * (at < len(went_on) - tail))
        safe_rows = np.concatenate([state.survived, new])
        if function is not None:
            fine = np.append(np.full(len(state.survived), True), [not function(row) for row in new])
            safe_rows, proven = safe_rows[fine], proven[fine]
        while len(safe_rows) > settings.max_survived:
            safe_rows, proven = safe_rows[::2], proven[::2]
        state = state._replace(survived=safe_rows, proven=proven)
    if failed:
        brinks = np.vstack([state.brinks, rows[-1:]])[-most:]
        state = state._replace(failures=np.vstack([state.failures, z[-1]])[-most:], brinks=brinks)
    if function is not None:
        return _asked(state, function)
    return _explained(state, failed=failed)


def _explained(state: State, *, failed: bool) -> State:
    """Explain all that failed or ended by forms, anew if it ``failed`` now."""
    survival, table = sizes(state), state.forms
    if len(state.ended) >= _ENDED:
        table = _endings(state, table, survival)
    failures = state.failures[~failure.crashed(table, state.failures)]
    survival = survival._replace(rows=np.concatenate([survival.rows, state.ended]))
    was = failure.saying(table, FAILS)
    are_sides = failure.are_sides(was)
    bent = failure.without(was[~are_sides], survival.rows)
    sides = failure.sides_of(FAILS, failures, survival)
    if len(bent):  # others come with other bent forms
        sides = sides[failure.among(sides, was[are_sides])]
    rows = np.concatenate([sides, bent])
    was_told, is_told = (failure.inside(forms, failures).any(0) for forms in (was, rows))
    # Where most came by chance that takes long, and finds nothing.
    is_many = len(failures) > state.settings.settled and 2 * was_told.sum() < len(failures)
    if failed or not (is_told.all() or is_many):
        rows = failure.explain(FAILS, failures, survival)
    rows = failure.counted(rows, failures, survival)
    ends, fatal = failure.saying(table, ENDS, CRASHES), failure.saying(table, FATAL)
    forms = np.concatenate([ends, rows, fatal])
    state = state._replace(dropped=_dropped(state, was, forms, survival))
    if state.is_doubted and failed and not _foreseen(state, table, survival):
        return state._replace(forms=forms, n_doubted=0, wrong=state.wrong + 1)
    has_changed = not state.is_doubted and (failed or _shape(was) != _shape(rows))
    return state._replace(forms=forms, n_doubted=0 if has_changed else state.n_doubted)


def _dropped(state: State, was: Floats, now: Floats, known: Survived) -> Floats:
    """(k, SIZE) thresholds that fewer forms took the place of, as long as nothing refutes them.

    One beyond which it ends is refuted: some episodes ended there without failing.
    """
    sides, older = was[failure.are_sides(was)].copy(), state.dropped.copy()
    sides[:, HELD] = state.settings.settled
    older[:, HELD] -= 1.0
    table = failure.without(np.concatenate([older[older[:, HELD] > 0.0], sides]), known.rows)
    holds = failure.inside(table, state.failures).any(1)
    return np.asarray(table[holds & ~failure.among(table, failure.saying(now, FAILS, ENDS))])


def _foreseen(state: State, table: Floats, known: Survived) -> bool:
    """Whether rivals of a table hold the latest failure, too."""
    rows, latest = failure.rivals(table, state.failures[:-1], known), state.failures[-1:]
    fails, ends, crashes = (
        failure.inside(failure.saying(rows, says), latest).any() for says in (FAILS, ENDS, CRASHES)
    )
    return bool(fails or (ends and crashes))


def _shape(table: Floats) -> tuple[list[list[float]], int]:
    """Which sides a table has, and how many rows."""
    return table[failure.are_sides(table)][:, [I, B]].tolist(), len(table)


def _endings(state: State, table: Floats, known: Survived) -> Floats:
    """Where it ends by itself: nowhere where it went on, nor where it failed like that."""
    rows, endings = failure.without(failure.saying(table, ENDS), known.rows), state.ended
    if len(known.rows) and (~failure.inside(rows, endings).any(0)).mean() > _STRAY:
        rows = failure.explain(ENDS, endings, failure.boxed(known, known.rows))
    rows = rows[(number := failure.inside(rows, endings).sum(1)) >= _ENDED].copy()
    rows[:, HELD] = number[number >= _ENDED]
    # What fails as others do elsewhere does not fail for how it ends.
    at_end = failure.inside(rows, state.failures).any(0)
    by = failure.inside(failure.saying(table, FAILS), state.failures)
    failed = state.failures[at_end & ~by[(by & ~at_end).any(1)].any(0)]
    crashes = failure.crashing(failed, endings, known, *set(rows[:, I].astype(int).tolist()))
    is_crash = failure.inside(crashes, state.failures, 0.0).any(0)
    rows = failure.without(rows, state.failures[at_end & ~is_crash])
    return np.concatenate([rows, crashes, failure.saying(table, FAILS, FATAL)])


def _asked(state: State, given: Callable[[Floats], bool]) -> State:
    """Explain what a function says around what was survived, unless that is explained.

    Looked for in drawn directions, farther along variables that change slowly.
    """
    survival, safe_rows = sizes(state), state.survived
    spread = survival.spread
    if not len(safe_rows) or not spread.any():
        return state
    pace = np.abs(np.diff(safe_rows, axis=0)).mean(0) / np.where(spread > 0.0, spread, np.inf)
    draws = np.random.default_rng(state.n_episodes).normal(size=(_RAYS, len(spread)))
    towards = np.empty_like(draws)
    towards[:, np.argsort(pace, kind="stable")] = draws
    towards *= np.where(((safe_rows - safe_rows.mean(0)) ** 3).sum(0) < 0.0, -1.0, 1.0) * spread
    starts = safe_rows[np.linspace(0, len(safe_rows) - 1, _RAYS).astype(int)]
    hits, misses = list[Floats](), [*safe_rows]
    for z, off in zip(starts, towards, strict=True):
        near = 0.0
        for far in _RADII:
            if given(z + far * off):
                for _ in range(_EDGE_HALVINGS):
                    half = 0.5 * (near + far)
                    near, far = (near, half) if given(z + half * off) else (half, far)
                deep = far + _DEEP
                hits.append(z + (deep if given(z + deep * off) else far) * off)
                misses.append(z + near * off)
                break
            misses.append(z + far * off)
            near = far
    failures, rows = np.array(hits).reshape(-1, len(spread)), np.array(misses)

    def differs(table: Floats) -> float:
        """The share of observations of which the function says otherwise."""
        outside = ~failure.inside(table, failures).any(0)
        within = (failure.distances(table, rows) < 0.0).any(0)
        return float(np.append(outside, within).mean()) if hits else 0.0

    table = state.forms
    if differs(table) > 0.0:
        table = failure.explain(FAILS, failures, failure.boxed(survival, rows))
    return state._replace(forms=table, differs=differs(table))


# -- Dead ends ------------------------------------------------------------------------------------


def dead_ends(state: State, known: Model, z: Floats, episode: Episode, before: Floats) -> State:
    """Learn balls around what was observed between the last certificate and failure.

    ``before`` is what was survived before the episode.
    """
    inverse, centres, counts = known.inverse, state.centres, state.counts
    steps = np.flatnonzero(episode.certified[: len(z) - 1]) if episode.failed else np.empty(0, int)
    rows = z[steps[-1] + 1 :] if len(steps) else z[:0]
    rows = rows[np.isfinite(rows).all(1)]
    counts = counts + (_between(rows, centres, inverse) < _LARGEST_RADIUS).any(0)
    n = len(centres)
    for row in rows:
        far = _between(row[None], centres, inverse)[0]
        if far.min(initial=np.inf) >= _APART:
            count = counts[:n][far[:n] < _LARGEST_RADIUS].max(initial=1.0)
            centres, counts = np.vstack([centres, row]), np.append(counts, count)
    radii = np.minimum(_LARGEST_RADIUS, _APART * 2.0 ** (np.minimum(counts, 9.0) - 1.0))
    went_on = before  # of a failed episode it is not known from where it went on
    if not episode.failed:
        went_on = state.survived[: None if episode.terminated else -_UNPROVEN]
    far = _between(centres, went_on[-_MAX_ROWS::_EACH], inverse)
    radii = np.minimum(radii, _WAY * far.min(1, initial=np.inf))
    typical = 1.25 * float(np.sqrt(np.mean((state.unit * inverse) ** 2)))
    index = np.flatnonzero(radii > _SAME_PLACE * typical)
    index = np.sort(index[np.argsort(-counts[index], kind="stable")[:_MAX_ENDS]])
    return state._replace(centres=centres[index], radii=radii[index], counts=counts[index])


def fatal_sides(state: State) -> State:
    """Learn beyond which ends of what was survived began what nothing survives (`State.fatal`)."""
    went_on = state.survived[state.proven > 0.0]
    if not len(state.fatal) or not len(went_on):
        return state
    ends = failure.sides_of(FATAL, state.fatal, failure.boxed(sizes(state), went_on))
    rest = failure.saying(state.forms, FAILS, ENDS, CRASHES)
    return state._replace(forms=np.concatenate([rest, failure.nearer(ends, state.fatal, 1.0)]))


def _between(a: Floats, b: Floats, inverse: Floats) -> Floats:
    """(k, n) distances of (k, m) and (n, m), in spreads."""
    return np.asarray(np.sqrt((((a[:, None] - b) * inverse) ** 2).sum(2)))

"""Algorithm 1 after an episode: what a judge knows, of what it knew before.

`learn` is a pure function: nothing that it is given changes. (`rollout.search` decides.) An episode
that failed although it was certified not to widens the margin (`LearntRisk.learn`), leaves a dead
end (`danger.dead_ends`), and where it failed late lengthens the horizon (`look_ahead`) or, where
that cannot be longer, the steps (`coarser`).
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from evofsm.guard.learnt import danger, failure, model, motion
from evofsm.guard.learnt.backups import evolved, first_backups, fitted
from evofsm.guard.learnt.rollout import FAILS, FATAL, Flags, Floats, Ints, Model, value_of
from evofsm.guard.learnt.state import Episode, Given, LearntSettings, State, model_of, residuals_of

# Actions of an episode that says how a system moves, and situations of which is learnt, at least;
# situations that are drawn to look for disturbances, and those that mutants are tried on.
_ENOUGH, _TRIED_IN, _TRIED_ON = 3, 8, 5
# What is lost in so few steps, whatever one does, is no argument; nor is what is survived by more
# [typical steps].
_AT_ONCE, _BY_FAR = 3, 100.0
# Windows of which all that is known is their size; situations that are kept of a failure, and so
# many steps before it at least.
_MOST_WINDOWS, _BEFORE, _EARLIER = 3, 3, 2
# Of the largest residual of a window, what is large enough to be where it began.
_ONSET = 0.5


def learn(state: State, episode: Episode, given: Given) -> State:
    """Learn from an episode, or from a part of a long one, and from what the user said."""
    decisions, before, settings = episode, state, state.settings
    rows = model.filled(episode.observations, failed=episode.failed)
    decisions = decisions._replace(observations=rows)
    # What a rival certified says nothing of the model.
    if state.is_doubted and not state.is_settled:
        decisions = decisions._replace(certified=np.zeros(len(decisions.certified)))
    episode = decisions.every(state.stride)
    random = np.random.default_rng([given.seed, state.n_episodes])
    is_seen = np.isfinite(episode.observations).all(1)
    if not state.n_seen:
        state = state._replace(origin=episode.observations[is_seen][0])
    unit = state.unit if state.n_moves else model.typical_step(episode.observations)
    z = model.without_glitches(episode.observations, unit)
    safe = z[:-1] if episode.failed else z
    u = episode.actions[: max(0, len(safe) - 1)]
    is_lost = episode.failed and 2.0 * episode.lost.sum() > len(episode.lost)
    state = state._replace(
        n_seen=state.n_seen + int(is_seen.sum()),
        margin=max(settings.margin_step, settings.margin_fade * state.margin),
        misled=(settings.drift_fade if is_lost else 1.0) * state.misled,  # so that lags come back
        used=state.used + motion.used_at(u, state.choices).sum(0),
    )
    # Model
    state = motion.steps(state, safe)
    whole: Flags = np.asarray(np.isfinite(safe).all(1))
    moves = len(u) >= _ENOUGH and bool((whole[:-2] & whole[1:-1] & whole[2:]).any())
    if moves:
        state = motion.dynamics(state, model_of(state), safe, u)
        if given.model is not None:
            state = motion.told(state, model_of(state), safe, given.model, random)
    # Failure
    state = danger.fails(state, z, episode, given)
    if len(state.forms):
        state = danger.dead_ends(state, model_of(state), safe, episode, before.survived)
    if not moves:
        return state._replace(n_episodes=state.n_episodes + 1)
    if not len(state.policies):
        state = first_backups(state, u)
    state = noted(state, safe, episode, random)
    if given.failed is None:
        was_tried = failure.inside(failure.saying(before.forms, FAILS), safe, 0.0).any()
        state = doubted(state, episode, tried=bool(was_tried))
    state = lost(state, episode)
    refutations = 1 + np.flatnonzero(episode.lost[1 : max(1, len(safe) - state.horizon)])
    if len(refutations):
        state = motion.misled(state, safe, u, refutations, failed=episode.failed)
    # Disturbances
    motion_model, looks, fails = model_of(state), looks_for_harm(state), state.knows_failure
    state = state._replace(n_scanned=state.n_scanned + looks)
    state = disturbances(state, motion_model, safe, u, random)
    rest = residuals_of(state, motion_model, state.horizon)
    if looks and given.horizon is None:
        # A certified episode failed later than it looks ahead, and it looks as far as it may.
        if late(episode) > state.horizon >= int(farthest(motion_model, settings)):
            # All of above is learnt anew of what was before, in steps twice as long.
            decisions = decisions._replace(fails_after=0.5 * decisions.fails_after)
            return learn(coarser(before), decisions, given)
        state = look_ahead(state, motion_model, rest, episode)
    # Backups
    if given.backup is not None:
        state = fitted(state, motion_model, given.backup)
    if fails and len(state.situations) >= _ENOUGH:
        numbers = np.append(0, 1 + random.permutation(rest.shape[2] - 1)[:_TRIED_ON])
        sample = np.ascontiguousarray(rest[:, :, numbers])
        state = evolved(state, motion_model, sample, random)
    return state._replace(n_episodes=state.n_episodes + 1)


def lost(state: State, episode: Episode) -> State:
    """Note how an episode ended in which nothing seemed to help.

    It failed within the horizon, or ended by itself, or went on for as long; of others it is not
    known.
    """
    soon, long_ago = episode.lost[-state.horizon :].any(), episode.lost[: -state.horizon].any()
    if not (long_ago or (soon and (episode.failed or episode.terminated))):
        return state
    outcomes = np.append(state.lost, float(episode.failed and soon))
    return state._replace(lost=outcomes[-state.settings.settled :])


def doubted(state: State, episode: Episode, *, tried: bool) -> State:
    """Doubt forms that refused for long without a failure: rivals are tried (`failure.rivals`).

    If there are any. An episode speaks for them only if it was where they allow what forms refuse
    (``tried``).
    """
    settings = state.settings
    much = episode.refused.sum() > settings.refused * len(episode.actions)
    count = state.n_doubted + bool(much and not episode.failed)
    if state.is_doubted:
        count = state.n_doubted - (tried and not episode.failed)
    elif count < settings.patience * settings.again**state.wrong:
        return state._replace(n_doubted=count)
    if {*map(tuple, state.rivals)} == {*map(tuple, state.forms)}:
        return state._replace(n_doubted=max(0, count))
    return state._replace(n_doubted=min(-1, count))


# -- Disturbances ---------------------------------------------------------------------------------


def noted(state: State, z: Floats, episode: Episode, random: Generator) -> State:
    """Note situations, on which disturbances and backups are tried: of all in their turn.

    One anywhere in an episode, one where a proposal was refused, and some before failure.
    """
    T, rows = len(z) - 1, [*state.situations]
    steps = [int(random.integers(1, T))]
    if len(tight := np.flatnonzero(episode.refused[1:T]) + 1):
        steps.append(int(random.choice(tight)))
    if episode.failed:
        back = random.integers(_EARLIER, max(_EARLIER + 1, min(T, state.horizon)), _BEFORE)
        steps += np.maximum(1, T - 1 - back).tolist()
    for t in steps:
        row = np.concatenate([z[t], z[t] - z[t - 1], episode.actions[t - 1]])
        if not np.isfinite(row).all():
            continue
        if len(rows) < state.settings.n_situations:
            rows.append(row)
        else:
            rows[int(random.integers(len(rows)))] = row
    return state._replace(situations=np.reshape(rows, (-1, state.situations.shape[1])))


def looks_for_harm(state: State) -> bool:
    """Whether it is known where it fails, and enough situations to find what harms there."""
    return state.knows_failure and len(state.situations) > _ENOUGH


def disturbances(state: State, known: Model, z: Floats, u: Floats, random: Generator) -> State:
    """Remember windows of an episode in which what was not expected harms most.

    Where it looks for harm, for the best backup in some situation; else, as long as no failure is
    known, the largest ones.
    """
    H, S, (T, a), m = state.horizon, state.situations, u.shape, z.shape[1]
    looks, longest, settings = looks_for_harm(state), state.windows.shape[1], state.settings
    starts = np.arange(0, max(1, T - 4), max(1, (T - 1) // settings.n_starts))
    rest = model.undisturbed(len(u) + H, m, 1)[..., 0]
    rest[: T - 1] = model.disturbed(known, z, u, state.unit)
    new = model.trimmed(rest[np.arange(H)[:, None] + starts].transpose(0, 2, 1))
    ends = np.empty((0, 0))
    if looks:
        calm = model.undisturbed(H, m, 1)[:, : new.shape[1]]
        with_none = np.concatenate([calm, new], 2)
        sample = S[random.permutation(len(S))[:_TRIED_IN]]
        ends = _worst(known, sample, state.policies[:1], with_none, 1.0)
    harmful = np.unique(ends.argmin(1)) if len(ends) else _sizes(new, state)[:_MOST_WINDOWS]
    windows, spans = [*state.windows], state.spans.tolist()
    for t in starts[harmful]:
        is_seen: Flags = np.asarray(np.isfinite(z[t : t + longest]).all(1))
        n = len(is_seen) if is_seen.all() else int(is_seen.argmin())
        if n > _AT_ONCE + 1:
            row = np.zeros((longest, m + a))
            row[:n, :m], row[: n - 1, m:] = z[t : t + n], u[t : t + n - 1]
            windows.append(row)
            spans.append((float(n), float(state.n_episodes)))
    table = np.reshape(windows, (-1, longest, m + a))
    state = state._replace(windows=table, spans=np.reshape(spans, (-1, 2)))
    residuals = residuals_of(state, known, H)
    if looks and len(windows):
        state, residuals = _fatal(state, known, residuals)
    if len(state.windows) <= settings.n_disturbances:
        return state
    if looks:
        ends = _worst(known, S, state.policies[:2], residuals, state.disturbance_scale)
        keep = _chosen(ends, settings.n_disturbances)
    else:
        keep = _sizes(residuals[:, :, 1:], state)[: settings.n_disturbances]
    return _kept(state, keep)


def _fatal(state: State, known: Model, found: Floats) -> tuple[State, Floats]:
    """Take what nothing survives, in whatever situation, for a dead end where it began.

    Such as the contact with the end of a rail: it is no disturbance that may begin anywhere. Where
    the place cannot be told from others it is remembered as it was. ``found`` are residuals of all
    that is remembered, (H, m, 1 + K), of which those of what is left are returned.
    """
    m = len(state.unit)
    ends = _worst(known, state.situations, state.policies[:2], found, 1.0)
    fatal = np.flatnonzero(ends.max(0, initial=-np.inf) < 0.0) if len(ends) else np.empty(0, int)
    size = np.abs(found[:, :m, 1 + fatal] / (state.unit[:, None] + 1e-300)).sum(1)
    rows = state.windows[fatal, (size >= _ONSET * size.max(0)).argmax(0), :m]
    is_new = ~(rows[:, None] == state.fatal).all(2).any(1)
    fatal_rows = np.concatenate([state.fatal, rows[is_new]])[-state.settings.max_failures :]
    state = danger.fatal_sides(state._replace(fatal=fatal_rows))
    within = failure.inside(failure.saying(state.forms, FATAL), rows).any(0)
    keep = np.setdiff1d(np.arange(len(state.windows)), fatal[within])
    return _kept(state, keep), found[:, :, np.append(0, 1 + keep)]


def _kept(state: State, keep: Ints) -> State:
    """Forget all disturbances but these, by their numbers from 0."""
    return state._replace(windows=state.windows[keep], spans=state.spans[keep])


def _sizes(rest: Floats, state: State) -> Ints:
    """Of residuals (H, m, K), and landings, the largest first."""
    m = len(state.unit)
    size = np.abs(rest[:, :m] / (state.unit[:, None] + 1e-300)).sum((0, 1))
    size += model.JUMP * np.isfinite(rest[:, m:]).sum((0, 1))
    return np.argsort(-size, kind="stable")


def _worst(
    known: Model, situations: Floats, policies: Floats, residuals: Floats, scale: float
) -> Floats:
    """(S, K) how disturbances end in situations in which nothing else is lost."""
    ends = value_of(known, situations, policies, np.ascontiguousarray(residuals), scale)
    ends = ends[ends[:, 0] >= 0.0, 1:]
    ends = np.where(ends < _AT_ONCE - 1.0 - len(residuals), np.inf, ends)
    return np.asarray(np.minimum(ends, _BY_FAR))


def _chosen(ends: Floats, most: int) -> Ints:
    """Which are worst in some situation (S, K), and of others those that are worst in the mean."""
    keep: Ints = np.arange(ends.shape[1])
    if not len(ends):
        return keep[-most:]
    mean = ends.mean(0)
    while len(keep) > most:  # what is worst nowhere goes first
        free = np.delete(keep, ends[:, keep].argmin(1))
        free = free if len(free) else keep
        keep = keep[keep != free[mean[free].argmax()]]
    return keep


def look_ahead(state: State, known: Model, rest: Floats, episode: Episode) -> State:
    """Look as far ahead as it takes to fail where nothing helps, and half as far again.

    Farther after an episode that failed as late after its last certificate as where nothing helps:
    what fails sooner was not foreseen for another reason. Less far after one that went on for the
    whole horizon from where nothing seemed to help, but not as far as was too short lately. What
    the model says of failure farther away than that is believed again little by little.
    """
    H, s, most = state.horizon, state.settings, farthest(known, state.settings)
    ends = value_of(known, state.situations, state.policies[: s.n_asked], rest)
    after = float(ends[ends < 0.0].max(initial=-1.0 - H) + 1 + H)
    is_refuted = len(episode.lost) > H and episode.lost[:-H].any()
    T, trust = state.time_to_failure, state.believed
    too_short = s.latest * state.too_short
    if is_refuted and not episode.failed:  # it sees less far than it looks
        T = max(s.refuted * T, s.horizon_min / s.ahead, state.too_short)
        trust = T
    else:
        trust = min(trust / s.latest, float(s.horizon_max))
        longest = max(s.latest * T, min(episode.fails_after, trust))
        if late(episode) > T:  # it did not look far enough
            too_short = max(too_short, min(s.ahead * T, s.horizon_max / s.ahead))
            longest = min(s.ahead * longest, s.horizon_max / s.ahead)
            trust = max(trust, longest)
        T = max(min(after, trust), longest)
    horizon = int(max(min(s.ahead * T, most), s.horizon_min))
    return state._replace(time_to_failure=T, believed=trust, horizon=horizon, too_short=too_short)


def late(episode: Episode) -> int:
    """How many steps after the last certificate it failed; 0 where it did not, or without any."""
    steps = np.flatnonzero(episode.certified)
    return len(episode.actions) - int(steps[-1]) if episode.failed and len(steps) else 0


def farthest(known: Model, settings: LearntSettings) -> float:
    """How far it looks ahead at most [steps]: less where a rollout costs more."""
    cost = known.weights.size * (1 + settings.n_disturbances)
    return min(settings.horizon_max, settings.work / cost / settings.n_asked)


def coarser(state: State) -> State:
    """Make each step last twice as many decisions: how it moves is to be learnt anew."""
    shape = len(state.origin), len(state.used), state.choices
    blank = State.none(state.settings, *shape, max(1, state.horizon // 2))
    learnt_anew = (
        *("squares", "products", "least", "most", "scale", "noise", "power"),
        *("recent_squares", "recent_products", "doubt", "since", "drifts", "misled"),
        *("n_scanned", "n_moves", "centres", "radii", "counts", "fatal"),
        *("windows", "spans", "situations", "margin"),
        *("time_to_failure", "believed", "too_short", "horizon"),
    )
    return state._replace(
        **{name: getattr(blank, name) for name in learnt_anew},
        n_seen=state.n_seen // 2,
        stride=2 * state.stride,
    )

"""Merge machines that learnt apart into one: what a fleet knows, or the shards of a log.

*Match*: the centres of all parts, strongest first, each join the nearest state within a radius or
create one. *Add up*: counts, and what potentials are made of, are sums over observations.
*Combine*: rows of matrices by the decisions that they rest on, without what is left of the prior::

    F_k = evidence_k + what its prior left       for each row of each part k (`transitions`)
    row = sum_k decisions_k * evidence_k / |evidence_k|        then the prior again, once

The parts are put in an order of their own first: in whatever order they are given, the answer is
the same bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.arrays import NO_ACTION, NOT_OPEN, OF_ACTIONS, SUMS, Settings, by_name
from evofsm.fsm.machine import EvolvingFSM, opened
from evofsm.fsm.model import FSMModel
from evofsm.fsm.validation import Floats, positive

# What a part has learnt, by name, and its snapshot.
_Part: TypeAlias = tuple[dict[str, NDArray[Any]], FSMModel]
# A row with a smaller share of evidence than this is all prior, and rounding.
_LEAST_EVIDENCE = 1e-9
# Frequencies that differ by less than this part of themselves are of the same prior.
_SAME_PRIOR = 0.01


def merge(machines: Sequence[EvolvingFSM], *, radius: float | None = None) -> EvolvingFSM:
    """Merge machines that learnt apart into one that can go on learning.

    The merged machine stands between two episodes; its states are numbered by the most visits that
    a part paid them.

    Parameters
    ----------
    machines : sequence of EvolvingFSM
        The parts, with the same settings. What two of them have in common, because both began as a
        copy of a machine that knew something, counts twice.
    radius : float, optional
        How far from a centre others are still of the same state, in the scales of the rule;
        without it the rule's own radius.

    Notes
    -----
    A merged centre is an observation that was made, and all are farther apart than ``radius``.
    Where ``max_states`` exist, the others join the nearest. `Paper` and `Edges` take centres for
    the same only within a small radius: give a larger one, or ``max_states``.

    Examples
    --------
    >>> from evofsm import Novelty
    >>> parts = [EvolvingFSM(n_actions=1, rule=Novelty(radius=1.0)) for _ in range(2)]
    >>> trace = parts[0].learn_many([[0.0], [0.1], [2.0], [0.0]], [0, 0, 0, 0])
    >>> trace = parts[1].learn_many([[0.5], [9.0], [9.1]], [0, 0, 0])
    >>> merged = merge(parts)
    >>> merged.centers.ravel(), merged.visits
    (array([0., 9., 2.]), array([4., 2., 1.]))
    """
    machines = _refuse_unlike(machines)
    known = [part.copy() for part in machines if part.n_states] or [machines[0].copy()]
    for part in known:
        part.start_episode()
    settings = opened(known[0])[1]
    within = settings.radius if radius is None else positive("radius", radius)
    if len(known) == 1:
        return known[0]
    parts = [(by_name(opened(part)[0]), part.model()) for part in known]
    parts.sort(key=lambda part: b"".join(array.tobytes() for array in part[0].values()))
    leaders, members = _match([model for _, model in parts], settings, within)
    n, counted = len(leaders), sum(int(arrays["n_observations"][0]) for arrays, _ in parts)
    merged = {
        **{name: np.zeros(1, np.int64) for name in ("chained", "state", "clock", "began")},
        **{name: np.array([n]) for name in ("n_states", "n_created")},
        "n_observations": np.array([counted]),
        "failures_told": np.min([arrays["failures_told"] for arrays, _ in parts], axis=0),
        "action": np.array([NO_ACTION]),
        "before": np.array([-1]),
        "id": np.arange(n, dtype=np.float64),
        "belief": np.full(n, 1.0 / n),
        "latest_visit": np.zeros(n),
        **_densities(parts, leaders, settings),
        **_counts(parts, members, settings),
    }
    return known[0]._with_arrays(merged)


def _refuse_unlike(machines: Iterable[EvolvingFSM]) -> list[EvolvingFSM]:
    """The parts, if they can be merged. A part that has seen nothing has no number of variables."""
    parts = list(machines)
    if not parts:
        raise ValueError("machines is empty; there must be at least one to merge")
    known: dict[str, tuple[int, Any]] = {}
    for number, part in enumerate(parts):
        if not isinstance(part, EvolvingFSM):
            raise TypeError(f"machine {number} is {part!r}; it must be an EvolvingFSM")
        names = ["n_actions", *Settings._fields[:-1], *["n_variables"][: part.n_states]]
        for name in names:
            given = getattr(part, name)
            first, expected = known.setdefault(name, (number, given))
            if given != expected:
                raise ValueError(
                    f"{name} of machine {number} is {given!r}, but {expected!r} of machine "
                    f"{first}; machines to merge must have the same settings and variables"
                )
    return parts


def _match(
    models: Sequence[FSMModel], settings: Settings, radius: float
) -> tuple[list[tuple[int, int]], list[Floats]]:
    """Which states of the parts are one: part and index of the state that leads each of n.

    With them come, for each part, (states, n) ones where a state of its own belongs.
    """
    places = np.concatenate([model.centers * settings.weights for model in models])
    names = [(part, i) for part, model in enumerate(models) for i in range(model.n_states)]
    of_part = np.array([part for part, _ in names])
    visits = np.concatenate([model.visits for model in models])
    leaders: list[int] = []
    group = np.full(len(places), -1)
    for i in np.lexsort((*places.T, -visits)).tolist():
        squared_distances = ((places[leaders] - places[i]) ** 2).sum(axis=1)
        is_full = len(leaders) >= settings.max_states
        if is_full or (leaders and squared_distances.min() <= radius**2):
            group[i] = squared_distances.argmin()
        else:
            group[i] = len(leaders)
            leaders.append(i)
    ones = np.eye(len(leaders))[group]
    members = [ones[of_part == part] for part in range(len(models))]
    return [names[i] for i in leaders], members


def _densities(
    parts: Sequence[_Part], leaders: Sequence[tuple[int, int]], settings: Settings
) -> dict[str, NDArray[Any]]:
    """Pool the data's mean and scatter (Chan, Golub & LeVeque 1979), and potentials.

    ``(t - 1) / potential`` is a sum over z_1 .. z_{t-1}, of ``1 + rho |z - centre|^2`` for each
    observation since the centre was created; see `clusters.determine`. That sum over another
    part's data is known from their mean and scatter.
    """
    rho, weights = settings.distance_weight, settings.weights
    counts = np.array([arrays["n_observations"][0] for arrays, _ in parts], np.float64)
    main = parts[int(counts.argmax())][0]
    means = np.array([arrays["first"] - main["first"] + arrays["mean"] for arrays, _ in parts])
    mean = counts @ means / counts.sum()
    between = counts @ (((means - mean) * weights) ** 2).sum(axis=1)
    centers = np.array([parts[k][1].centers[i] for k, i in leaders])
    sums = np.zeros(len(leaders))
    for k, (arrays, _) in enumerate(parts):
        from_mean = (((centers - main["first"] - means[k]) * weights) ** 2).sum(axis=1)
        total = counts[k] + rho * (counts[k] * from_mean + arrays["scatter"][0])
        for state, (part, i) in enumerate(leaders):
            if part == k:
                seen = (counts[k] - 1.0) / arrays["potentials"][i]
                total[state] = seen + 1.0 + rho * arrays["squared_distances"][i]
        sums += total
    from_latest = (((centers - main["latest"]) * weights) ** 2).sum(axis=1)
    earlier = counts.sum() - 1.0  # the latest one counts in the next step
    return {
        "first": main["first"],
        "latest": main["latest"],
        "mean": mean,
        "scatter": np.sum([arrays["scatter"] for arrays, _ in parts], axis=0) + between,
        "centers": centers.T,
        "potentials": earlier / np.maximum(sums - 1.0 - rho * from_latest, earlier),
        "squared_distances": from_latest,
    }


def _counts(
    parts: Sequence[_Part], members: Sequence[Floats], settings: Settings
) -> dict[str, NDArray[Any]]:
    """Add up what was counted, and combine rows by the decisions that they rest on."""
    q, n = parts[0][1].n_actions, members[0].shape[1]
    merged = {name: np.zeros(n) for name in (*SUMS, "joined")} | {"created": np.ones(n)}
    merged |= {name: np.zeros((q, n)) for name in OF_ACTIONS}
    changes, uses, joint = np.zeros((n, n)), np.zeros(q), np.zeros((q, n, n))
    frequencies = np.zeros((q, n))
    for (_, part), belongs in zip(parts, members, strict=True):
        for name in (*SUMS, *OF_ACTIONS):
            merged[name] += getattr(part, name) @ belongs
        twice = (part.joined @ belongs > 0.0) | (belongs.sum(axis=0) > 1.0)
        merged["joined"] = np.maximum(merged["joined"], twice)
        earliest = np.where(belongs > 0.0, part.created[:, None], np.inf).min(axis=0)
        merged["created"] += np.where(np.isfinite(earliest), earliest - 1.0, 0.0)
        changes += belongs.T @ part.changes @ belongs
        uses += part.uses
        shares, weight = _evidence(part, settings)
        joint += belongs.T @ (part.decisions[..., None] * shares) @ belongs
        frequencies += (part.decisions * weight) @ belongs
    known, decisions = joint.sum(axis=-1, keepdims=True), merged["decisions"]
    rows = np.divide(joint, known, out=np.full_like(joint, 1.0 / n), where=known > 0.0)
    evidence = np.where(known[..., 0] > 0.0, frequencies / np.maximum(decisions, 1e-300), 0.0)
    together = evidence + n * _aged_prior(settings, uses)[:, None]
    of_prior = np.where(together > 0.0, 1.0 - evidence / np.maximum(together, 1e-300), 0.0)
    used = np.flatnonzero(np.any([arrays["place"] != NOT_OPEN for arrays, _ in parts], axis=0))
    place = np.full(q, NOT_OPEN)
    place[used] = np.arange(len(used))
    return {
        **{name: array[used] if name in OF_ACTIONS else array for name, array in merged.items()},
        "changes": changes,
        "uses": uses,
        "place": place,
        "n_places": np.array([len(used)]),
        "matrices": (rows + of_prior[..., None] * (1.0 / n - rows))[used],
        "origin_frequency": together[used],
        "latest_try": np.zeros((len(used), n)),
    }


def _evidence(part: FSMModel, settings: Settings) -> tuple[Floats, Floats]:
    """Rows (q, n, n) of a part's matrices without the prior, and their frequencies (q, n)."""
    joint = part.joint_frequency
    joint -= _prior_left(joint, part.uses, settings)
    weight = joint.sum(axis=-1)
    is_known = (weight > _LEAST_EVIDENCE * part.origin_frequency)[..., None]
    matrices = part.transition_matrices.copy()
    return np.divide(joint, weight[..., None], out=matrices, where=is_known), weight


def _prior_left(joint: Floats, uses: Floats, settings: Settings) -> Floats:
    """What the prior has left in joint frequencies (q, n, n); no more than they are.

    A state's creation gives the prior frequency to all transitions between it and those before,
    which then age alike. Where the least of those into it and the least of those out of it agree,
    this is what is left; else it is as much as all uses would leave, which is less.
    """
    states = np.arange(joint.shape[-1])
    between = np.where(states[:, None] == states, np.inf, joint)
    into = np.minimum.accumulate(between, axis=1).diagonal(axis1=1, axis2=2)
    out_of = np.minimum.accumulate(between, axis=2).diagonal(axis1=1, axis2=2)
    least = np.minimum(into, out_of)
    agree = np.isfinite(least) & (np.maximum(into, out_of) <= (1.0 + _SAME_PRIOR) * least)
    oldest = _aged_prior(settings, uses)[:, None]
    left = np.where(agree, np.minimum(least, settings.prior_frequency), oldest)
    left = np.minimum.accumulate(left[:, ::-1], axis=1)[:, ::-1]
    return np.minimum(left[:, np.maximum.outer(states, states)], joint)


def _aged_prior(settings: Settings, uses: Floats) -> Floats:
    """The prior frequency, after so many uses."""
    return np.asarray(settings.prior_frequency * (1.0 - settings.learning_rate) ** uses)

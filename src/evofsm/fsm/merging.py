"""Merge machines that learnt apart into one: what a fleet knows, or the shards of a log.

Three steps. *Match*: the centres of all parts, strongest first, each join the nearest state within
a radius or create one. *Add up*: what was counted, and what potentials are made of, are sums over
observations. *Combine*: rows of matrices by the decisions that they rest on, after taking out of
each what is left in it of its prior::

    F_k = evidence_k + what its prior left       for each row of each part k (`transitions`)
    row = sum_k decisions_k * evidence_k / |evidence_k|        then the prior again, once

Every step is symmetric in the parts, which are put in an order of their own first: in whatever
order they are given, the answer is the same bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.arrays import NO_ACTION, NOT_OPEN, SUMS, Settings, by_name
from evofsm.fsm.machine import EvolvingFSM, opened
from evofsm.fsm.validation import positive

# All that a part has learnt, by name, without spare room.
_Part: TypeAlias = Mapping[str, NDArray[Any]]
# A row with a smaller share of evidence than this is all prior, and rounding.
_LEAST_EVIDENCE = 1e-9
# Frequencies that differ by less than this part of themselves are of the same prior.
_SAME = 0.01


def merge(machines: Sequence[EvolvingFSM], *, radius: float | None = None) -> EvolvingFSM:
    """Merge machines that learnt apart into one that can go on learning.

    The parts stay as they are. The merged machine stands between two episodes; its states are
    numbered by the most visits that a part paid them. Those that have observed nothing
    contribute nothing, and of a single other one the answer is a copy.

    Parameters
    ----------
    machines : sequence of EvolvingFSM
        The parts, with the same settings. They must have learnt apart: what two of them have in
        common, because both began as a copy of a machine that knew something, counts twice.
    radius : float, optional
        How far from a centre others are still of the same state, in the scales of the rule;
        without it the rule's own radius.

    Returns
    -------
    EvolvingFSM
        A new machine with the settings of the parts.

    Raises
    ------
    TypeError
        If ``machines`` holds something else.
    ValueError
        If ``machines`` is empty, two of them have different settings or numbers of variables, or
        ``radius`` is not positive and finite.

    Notes
    -----
    *States.* By visits, strongest first, a centre joins the nearest state within ``radius``, else
    it creates one: what the rule `Novelty` would have made of the centres. A merged centre is the
    strongest of its group, and not the mean. So it remains an observation that was made, no
    centre of that rule moves, and all remain farther apart than ``radius``, which the width of
    recognition is made for. Two states of one part may join the same third one, but not where
    they are closer than the rule's radius, for then it told them apart on purpose
    (`FailureSplit`). Where ``max_states`` exist, the others join the nearest. `Paper` and `Edges`
    take centres for the same only within a small radius: give a larger one, or ``max_states``.

    *Rows* count by decisions, which are belief-weighted and never forget. Their weight F_o says how
    recently a part was there; it becomes the mean of the parts', by decisions. *The prior* of new
    states is taken out of each part's rows and put in once: an average would keep it, however many
    parts agree. Mean and scatter are pooled exactly [1]_, and a centre's potential is what the
    recursion would have made of it, had it seen the data of all other parts since. An episode that
    came to two states of one part that are joined is counted twice.

    References
    ----------
    .. [1] T. F. Chan, G. H. Golub, R. J. LeVeque, "Updating formulae and a pairwise algorithm for
       computing sample variances", Stanford STAN-CS-79-773 (1979).

    Examples
    --------
    >>> from evofsm import Novelty
    >>> parts = [EvolvingFSM(n_actions=1, rule=Novelty(radius=1.0)) for _ in range(2)]
    >>> trace = parts[0].learn_many([[0.0], [0.1], [2.0], [0.0]], [0, 0, 0, 0])
    >>> trace = parts[1].learn_many([[0.5], [9.0], [9.1]], [0, 0, 0])
    >>> merged = merge(parts)
    >>> merged.centers.ravel(), merged.model().visits
    (array([0., 9., 2.]), array([4., 2., 1.]))
    """
    parts = _refuse_unlike(machines)
    experienced = [part for part in parts if part.n_states]
    if len(experienced) < 2:
        alone = (experienced or parts)[0].copy()
        alone.start_episode()
        return alone
    settings = opened(experienced[0])[1]
    within = settings.radius if radius is None else positive("radius", radius)
    learnt = sorted((by_name(opened(part)[0]) for part in experienced), key=_content)
    match = _match(learnt, settings, within)
    merged = {
        **_blank(match),
        **_counts(learnt, match),
        **_densities(learnt, match, settings),
        **_transitions(learnt, match, settings),
    }
    return experienced[0]._with_arrays(merged)


def _refuse_unlike(machines: Iterable[EvolvingFSM]) -> list[EvolvingFSM]:
    """The parts, if they can be merged."""
    parts = list(machines)
    if not parts:
        raise ValueError("machines is empty; there must be at least one to merge")
    for number, part in enumerate(parts):
        if not isinstance(part, EvolvingFSM):
            raise TypeError(f"machine {number} is {part!r}; it must be an EvolvingFSM")
    sized = {part.centers.shape[1]: number for number, part in enumerate(parts) if part.n_states}
    if len(sized) > 1:
        (m, one), (other_m, other), *_ = sized.items()
        raise ValueError(
            f"machine {one} has {m} variables, and machine {other} has {other_m}; "
            "machines to merge must have observed the same"
        )
    settings = [part.settings | {"rule": part.rule} for part in parts]
    for number, own in enumerate(settings):
        for name in sorted(own.keys() | settings[0].keys()):
            given, expected = getattr(parts[number], name), getattr(parts[0], name)
            if given != expected:
                raise ValueError(
                    f"{name} of machine {number} is {given!r}, but {expected!r} of machine 0; "
                    "machines to merge must have the same settings"
                )
    if np.isfinite(opened(parts[0])[1].memory):
        raise ValueError(
            f"machines with {parts[0].rule} cannot be merged: what each still remembers depends on "
            "when it saw it"
        )
    return parts


def _content(part: _Part) -> bytes:
    """What puts parts in an order that does not depend on how they were given."""
    return b"".join(array.tobytes() for array in part.values())


# -- Match ----------------------------------------------------------------------------------------


class _Match(NamedTuple):
    """Which states of the parts are one."""

    n: int  #: number of merged states
    groups: list[NDArray[np.int64]]  #: for each part: the merged state of each of its own
    leader_part: NDArray[np.int64]  #: (n,) the part whose state leads
    leader_state: NDArray[np.int64]  #: (n,) its index there


def _match(learnt: Sequence[_Part], settings: Settings, radius: float) -> _Match:
    weights = settings.weights
    places = [part["centers"].T * weights for part in learnt]
    sizes = np.array([len(place) for place in places])
    rivals = _rivals(places, settings.radius)
    points, visits = (
        np.concatenate(places),
        np.concatenate([part["visits"] for part in learnt]),
    )
    group = np.full(len(points), -1, np.int64)
    leaders: list[int] = []
    led = np.empty_like(points)
    for i in np.lexsort((*points.T, -visits)).tolist():
        squared_distances = ((led[: len(leaders)] - points[i]) ** 2).sum(axis=1)
        is_full = len(leaders) >= settings.max_states
        if not is_full:
            squared_distances[[group[k] for k in rivals.get(i, ()) if group[k] >= 0]] = np.inf
        if is_full or (leaders and squared_distances.min() <= radius * radius):
            group[i] = squared_distances.argmin()
        else:
            group[i] = len(leaders)
            led[len(leaders)] = points[i]
            leaders.append(i)
    begins = np.cumsum(sizes) - sizes
    leader_part = np.repeat(np.arange(len(learnt)), sizes)[leaders]
    leader_state = np.array(leaders) - begins[leader_part]
    return _Match(len(leaders), np.split(group, begins[1:]), leader_part, leader_state)


def _rivals(places: Sequence[NDArray[np.float64]], radius: float) -> dict[int, list[int]]:
    """By number in the pool: states of the same part that are closer than the radius."""
    found: dict[int, list[int]] = {}
    begin = 0
    for points in places:
        squared_distances = ((points[:, None] - points) ** 2).sum(axis=-1)
        for i, k in np.argwhere(squared_distances < radius * radius).tolist():
            if i != k:
                found.setdefault(begin + i, []).append(begin + k)
        begin += len(points)
    return found


# -- Add up ---------------------------------------------------------------------------------------


def _blank(match: _Match) -> dict[str, NDArray[Any]]:
    """All that stands for one episode, or for one machine, as a new one has it."""
    n = match.n
    none = ("chained", "state", "clock", "began")
    return {
        **{name: np.zeros(1, np.int64) for name in none},
        "n_states": np.array([n]),
        "n_created": np.array([n]),
        "action": np.array([NO_ACTION]),
        "before": np.array([-1]),
        "id": np.arange(n, dtype=np.float64),
        "belief": np.full(n, 1.0 / n),
        "latest_visit": np.zeros(n),
    }


def _counts(learnt: Sequence[_Part], match: _Match) -> dict[str, NDArray[Any]]:
    """What was counted."""
    n, is_open = match.n, _is_open(learnt)
    places = np.cumsum(is_open) - 1
    shapes: dict[str, tuple[int, ...]] = {
        **dict.fromkeys(SUMS, (n,)),
        "changes": (n, n),
        **dict.fromkeys(("failures", "tried", "failed_after"), (int(is_open.sum()), n)),
    }
    merged = {name: np.zeros(shape) for name, shape in shapes.items()}
    joined, created = np.zeros(n), np.ones(n)
    for part, group in zip(learnt, match.groups, strict=True):
        of_place = places[_actions_of(part)][:, None]
        for name, sums in merged.items():
            where: Any = group if sums.shape == (n,) and name in SUMS else (of_place, group)
            where = (group[:, None], group) if name == "changes" else where
            np.add.at(sums, where, part[name])
        of_part = np.bincount(group, minlength=n) > 1
        np.maximum.at(joined, group, np.maximum(part["joined"], of_part[group]))
        earliest = np.full(n, np.inf)
        np.minimum.at(earliest, group, part["created"])
        created += np.where(np.isfinite(earliest), earliest - 1.0, 0.0)
    told = min(int(part["failures_told"][0]) for part in learnt)
    return {
        **merged,
        "joined": joined,
        "created": created,
        "latest_try": np.zeros(shapes["tried"]),
        "failures_told": np.array([told]),
    }


def _densities(
    learnt: Sequence[_Part], match: _Match, settings: Settings
) -> dict[str, NDArray[Any]]:
    """Pool the data's mean, scatter and potentials.

    ``(t - 1) / potential`` is a sum over z_1 .. z_{t-1}, of ``1 + rho |z - centre|^2`` for each
    observation since the centre was created; see `clusters.determine`. That
    sum over another part's data is known from their mean and scatter.
    """
    rho, weights = settings.distance_weight, settings.weights
    counts = np.array([part["n_observations"][0] for part in learnt], np.float64)
    main = learnt[int(counts.argmax())]
    means = np.array([part["first"] - main["first"] + part["mean"] for part in learnt])
    mean = counts @ means / counts.sum()
    between = counts @ (((means - mean) * weights) ** 2).sum(axis=1)

    led = list(zip(match.leader_part.tolist(), match.leader_state.tolist(), strict=True))
    centers = np.array([learnt[k]["centers"][:, i] for k, i in led])
    sums = np.zeros(match.n)
    for k, part in enumerate(learnt):
        from_mean = (((centers - main["first"] - means[k]) * weights) ** 2).sum(axis=1)
        total = counts[k] + rho * (counts[k] * from_mean + part["scatter"][0])
        own = match.leader_part == k
        i = match.leader_state[own]
        total[own] = (
            (counts[k] - 1.0) / part["potentials"][i] + 1.0 + rho * part["squared_distances"][i]
        )
        sums += total
    from_latest = (((centers - main["latest"]) * weights) ** 2).sum(axis=1)
    others = counts.sum() - 1.0  # the latest one counts in the next step
    return {
        "n_observations": counts.sum(keepdims=True).astype(np.int64),
        "first": main["first"],
        "latest": main["latest"],
        "mean": mean,
        "scatter": np.sum([part["scatter"] for part in learnt], axis=0) + between,
        "centers": centers.T,
        "potentials": others / np.maximum(sums - 1.0 - rho * from_latest, others),
        "squared_distances": from_latest,
    }


# -- Combine --------------------------------------------------------------------------------------


def _transitions(
    learnt: Sequence[_Part], match: _Match, settings: Settings
) -> dict[str, NDArray[Any]]:
    n, is_open = match.n, _is_open(learnt)
    uses = np.sum([part["uses"] for part in learnt], axis=0)
    places = np.where(is_open, np.cumsum(is_open) - 1, NOT_OPEN)
    open_ = int(is_open.sum())
    joint = np.zeros((open_, n, n))
    decisions, frequencies = np.zeros((2, open_, n))
    for part, group in zip(learnt, match.groups, strict=True):
        shares, weight = _evidence(part, settings)
        counts = part["decisions"]
        place = places[_actions_of(part)]
        np.add.at(joint, (place[:, None, None], group[:, None], group), counts[..., None] * shares)
        np.add.at(decisions, (place[:, None], group), counts)
        np.add.at(frequencies, (place[:, None], group), counts * weight)

    known = joint.sum(axis=-1)
    seen = known > 0.0
    frequencies = np.divide(frequencies, decisions, out=np.zeros_like(known), where=seen)
    prior = n * _aged_prior(settings, uses[is_open])[:, None]
    together = frequencies + prior
    of_prior = np.divide(prior, together, out=np.zeros_like(known), where=together > 0.0)
    of_prior[~seen] = 1.0
    rows = np.divide(joint, known[..., None], out=np.zeros_like(joint), where=seen[..., None])
    return {
        "place": places,
        "n_places": np.array([open_]),
        "uses": uses,
        "matrices": rows + of_prior[..., None] * (1.0 / n - rows),
        "origin_frequency": together,
        "decisions": decisions,
    }


def _is_open(learnt: Sequence[_Part]) -> NDArray[np.bool_]:
    """(q,) whether any part has a matrix of an action."""
    opened: NDArray[np.bool_] = np.any([part["place"] != NOT_OPEN for part in learnt], axis=0)
    return opened


def _actions_of(part: _Part) -> NDArray[np.int64]:
    """The action of each of a part's matrices, in their order."""
    places = part["place"]
    used = np.flatnonzero(places != NOT_OPEN)
    return used[places[used].argsort()]


def _evidence(part: _Part, settings: Settings) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rows (s, n, n) of a part's matrices without the prior, and their frequencies (s, n)."""
    matrices, frequency = part["matrices"].copy(), part["origin_frequency"]
    joint = frequency[..., None] * matrices
    joint -= _prior_left(joint, part["uses"][_actions_of(part)], settings)
    weight = joint.sum(axis=-1)
    is_known = weight > _LEAST_EVIDENCE * frequency
    shares = np.divide(joint, weight[..., None], out=matrices, where=is_known[..., None])
    return shares, weight


def _prior_left(
    joint: NDArray[np.float64], uses: NDArray[np.float64], settings: Settings
) -> NDArray[np.float64]:
    """What the prior has left in joint frequencies (s, n, n); no more than they are.

    A state's creation gives the prior frequency to all transitions between it and those before,
    which then age alike. Where the least of those into it and the least of those out of it agree,
    this is what is left; else it is as much as all uses would leave, which is less. (Where an
    index was given to a newer state, less is found than there is.)
    """
    states = np.arange(joint.shape[-1])
    between = np.where(states[:, None] == states, np.inf, joint)
    into = np.minimum.accumulate(between, axis=1).diagonal(axis1=1, axis2=2)
    out_of = np.minimum.accumulate(between, axis=2).diagonal(axis1=1, axis2=2)
    least = np.minimum(into, out_of)
    agree = np.isfinite(least) & (np.maximum(into, out_of) <= (1.0 + _SAME) * least)
    oldest = _aged_prior(settings, uses)[:, None]
    left = np.where(agree, np.minimum(least, settings.prior_frequency), oldest)
    left = np.minimum.accumulate(left[:, ::-1], axis=1)[:, ::-1]
    return np.minimum(left[:, np.maximum.outer(states, states)], joint)


def _aged_prior(settings: Settings, uses: NDArray[np.float64]) -> NDArray[np.float64]:
    """The prior frequency, after so many uses."""
    aged: NDArray[np.float64] = settings.prior_frequency * (1.0 - settings.learning_rate) ** uses
    return aged

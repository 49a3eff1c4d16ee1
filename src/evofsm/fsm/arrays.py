"""All that a machine has learnt, as named arrays, and its settings, as numbers: what kernels see.

What is touched together stands in one array of records; `by_name` gives each field as an array of
its own, as in files. There is room for ``capacity`` states, of which the first n are in use, and
for the matrices of the actions that were used.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.kernels import lanes, records
from evofsm.fsm.validation import Floats
from evofsm.store import COUNT, FLAG, FROM_1, LARGEST_OBSERVATION, SHARE, SIZE, Kind, Numbers

Records: TypeAlias = NDArray[Any]

#: The action where there is none, and the place of an action without a matrix.
NO_ACTION = NOT_OPEN = -1

#: Where the machine is.
NOW = np.dtype(
    [
        ("n_states", np.int64),
        ("n_created", np.int64),  # states so far, with those given up
        ("n_places", np.int64),  # actions that have a matrix
        ("action", np.int64),  # after the latest observation, or NO_ACTION
        ("chained", np.int64),  # 1: `belief` is of the present episode
        ("state", np.int64),  # the most probable one at the latest observation
        ("clock", np.int64),  # observations so far, with those that lacked something
        ("began", np.int64),  # the clock at the present episode's first observation
        ("n_observations", np.int64),
        ("failures_told", np.int64),  # 1: of one, or that there was none
        ("scatter", np.float64),  # sum of squared distances of all observations to their mean
    ]
)
#: Counts of each state, which add up where two states become one; and their rows.
SUMS: tuple[str, ...] = ("visits", "endings", "episodes", "failed_soon")
VISITS, ENDINGS, EPISODES, FAILED_SOON = range(len(SUMS))
#: Counts of each state by action.
OF_ACTIONS = ("decisions", "failures", "tried", "failed_after")
#: Of a state: the number of its creation (from 0) and of the observation that created it (from 1),
#: whether two were joined in it, and the clock at the latest visit.
STATE = np.dtype([(name, np.float64) for name in ("id", "created", "joined", "latest_visit")])
#: Of a variable: its first and latest value, and the mean of all, less the first.
VARIABLE = np.dtype([(name, np.float64) for name in ("first", "latest", "mean")])
#: Of an action: the place of its matrix, and how many transitions were learnt with it.
ACTION = np.dtype([("place", np.int64), ("uses", np.float64)])
#: Of an action in a state: episodes that tried it, those of them that failed soon after, and the
#: clock of the visit in which it was tried latest.
TRY = np.dtype([(name, np.float64) for name in ("tried", "failed_after", "latest_try")])


class Learnt(NamedTuple):
    """What the next step needs, and what people ask of the states; s actions have a place."""

    now: Records  #: (1,) of `NOW`
    states: Records  #: (capacity,) of `STATE`
    variables: Records  #: (m,) of `VARIABLE`
    actions: Records  #: (q,) of `ACTION`
    sums: Floats  #: (len(SUMS), capacity)
    belief: Floats  #: (capacity,)
    potentials: Floats  #: (capacity,) density of all observations at each centre
    squared_distances: Floats  #: (capacity,) of each centre from the latest observation
    centers: Floats  #: (m, capacity)
    changes: Floats  #: (capacity, capacity) steps from the most probable state to the next one
    matrices: Floats  #: (s, capacity, capacity) of transitions, each row a distribution
    origin_frequency: Floats  #: (s, capacity) the paper's F_o, the weight of each row
    decisions: Floats  #: (s, capacity) transitions that began in each state, by belief
    failures: Floats  #: (s, capacity) those of `decisions` that led straight into failure
    tries: Records  #: (s, capacity) of `TRY`


class Settings(NamedTuple):
    """What a machine was told; the paper's symbols are epsilon, rho, phi, epsilon-bar."""

    radius: float
    distance_weight: float
    learning_rate: float
    prior_frequency: float
    spread: float
    belief_tolerance: float
    max_states: float  #: infinity for no limit
    failure_horizon: float  #: observations; infinity for all of an episode
    rule: int  #: which rule judges an observation, see `evofsm.fsm.rules`
    weights: Floats  #: (m,) 1 / scale of each variable


def blank(m: int, q: int, capacity: int, places: int) -> Learnt:
    """What a machine has learnt that has seen nothing, with room for so much."""
    learnt = Learnt(
        records(1, NOW),
        records(capacity, STATE),
        records(m, VARIABLE),
        records(q, ACTION),
        np.zeros((len(SUMS), capacity)),
        np.zeros(capacity),
        np.zeros(capacity),
        # A state that is not there is too far for any belief.
        np.full(capacity, np.inf),
        np.full((m, capacity), np.inf),
        np.zeros((capacity, capacity)),
        np.zeros((places, capacity, capacity)),
        np.zeros((places, capacity)),
        np.zeros((places, capacity)),
        np.zeros((places, capacity)),
        records((places, capacity), TRY),
    )
    learnt.now["action"] = NO_ACTION
    learnt.actions["place"] = NOT_OPEN
    return learnt


def resized(learnt: Learnt, capacity: int, places: int) -> Learnt:
    """A copy with room for another number of states and of matrices."""
    copy = blank(len(learnt.variables), len(learnt.actions), capacity, places)
    for old, new in zip(learnt, copy, strict=True):
        common = tuple(slice(min(pair)) for pair in zip(old.shape, new.shape, strict=True))
        new[common] = old[common]
    return copy


def by_name(learnt: Learnt) -> dict[str, NDArray[Any]]:
    """Every array and every field of records, without spare room, as a copy."""
    n, s = int(learnt.now["n_states"][0]), int(learnt.now["n_places"][0])
    return {name: np.ascontiguousarray(array) for name, array in _named(resized(learnt, n, s))}


def _named(learnt: Learnt) -> Iterator[tuple[str, NDArray[Any]]]:
    """Every array and every field of records, itself."""
    for name, array in learnt._asdict().items():
        if name == "sums":
            yield from zip(SUMS, array, strict=True)
        elif array.dtype.names is None:
            yield name, array
        else:
            yield from ((field, array[field]) for field in array.dtype.names)


def from_names(arrays: Mapping[str, NDArray[Any]], m: int, q: int) -> Learnt:
    """What `by_name` gave, if its sizes and indices are right: kernels take them on trust."""
    n, s = len(arrays["belief"]), len(arrays["matrices"])
    learnt = blank(m, q, n, s)
    for name, array in _named(learnt):
        array[...] = arrays[name]
    now, places = learnt.now[0], learnt.actions["place"]
    fits = (now["n_states"], now["n_places"]) == (n, s)
    if not (fits and now["action"] < q and now["state"] < max(n, 1)):
        raise ValueError(f"where it is does not fit {n} states, {q} actions and {s} matrices")
    if sorted(places[places != NOT_OPEN]) != list(range(s)):
        raise ValueError("place of an action is not that of a matrix")
    return resized(learnt, lanes(n), s)


# -- What files may hold --------------------------------------------------------------------------

_FARTHEST = SHARE.most * LARGEST_OBSERVATION
_OBSERVED = Numbers(least=-_FARTHEST, most=_FARTHEST)
_FREQUENCY = Numbers(least=0.0, most=LARGEST_OBSERVATION)
#: Of decisions, which are counted by belief.
_SUM = COUNT._replace(whole=False)


def _optional(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: form._replace(optional=True) if isinstance(form, Numbers) else form
        for name, form in settings.items()
    }


_SIZES = dict.fromkeys(("radius", "spread"), SIZE)
# Squares of observations over the scales, summed over a long run, must not overflow.
_RULE = _optional({**_SIZES, "scales": Numbers(("scales",), 1e-20, 1e20)})
_BELOW_1, _WEIGHT = math.nextafter(1.0, 0.0), SIZE._replace(most=1e50)
_LIMITS = dict.fromkeys(("max_states", "failure_horizon"), FROM_1)
#: Of a machine, with those of its rule.
_SETTINGS: dict[str, Any] = {
    "n_actions": FROM_1,
    **_SIZES,
    **dict.fromkeys(("distance_weight", "prior_frequency"), _WEIGHT),
    "learning_rate": _WEIGHT._replace(most=_BELOW_1),
    **_optional({**_LIMITS, "belief_tolerance": Numbers(least=0.0, most=_BELOW_1)}),
    "rule": _RULE,
}
_INDEX, _PRODUCT = COUNT._replace(least=-1.0, dtype=np.int64), Numbers(least=0.0, most=1e300)
_COUNTERS = ("n_states", "n_created", "n_places", "state", "clock", "began", "n_observations")
MACHINE = Kind(
    "machine",
    {
        **dict.fromkeys(_COUNTERS, COUNT._replace(dtype=np.int64).of(1)),
        "action": _INDEX.of(1),
        **dict.fromkeys(("chained", "failures_told"), FLAG._replace(dtype=np.int64).of(1)),
        "scatter": _PRODUCT.of(1),
        **dict.fromkeys(("first", "latest"), _OBSERVED.of("m")),
        "mean": Numbers(("m",), 2.0 * _OBSERVED.least, 2.0 * _OBSERVED.most),
        "centers": _OBSERVED.of("m", "n"),
        **dict.fromkeys((*SUMS, "id", "created", "latest_visit"), COUNT.of("n")),
        "joined": FLAG.of("n"),
        **dict.fromkeys(("belief", "potentials"), SHARE.of("n")),
        "squared_distances": _PRODUCT.of("n"),
        "changes": COUNT.of("n", "n"),
        "place": _INDEX.of("settings.n_actions"),
        "uses": COUNT.of("settings.n_actions"),
        "matrices": SHARE.of("s", "n", "n"),
        "origin_frequency": _FREQUENCY.of("s", "n"),
        **dict.fromkeys(("decisions", "failures"), _SUM.of("s", "n")),
        **dict.fromkeys(("tried", "failed_after", "latest_try"), COUNT.of("s", "n")),
    },
    _SETTINGS,
)
#: Of a model: those of its machine, with all actions.
OF_MODEL: dict[str, Numbers] = {
    "centers": _OBSERVED.of("n", "m"),
    "uses": COUNT.of("q"),
    "transition_matrices": SHARE.of("q", "n", "n"),
    "changes": COUNT.of("n", "n"),
    **{name: MACHINE.arrays[name] for name in (*SUMS, "potentials", "created", "joined")},
    **{name: MACHINE.arrays[name].of("q", "n") for name in ("origin_frequency", *OF_ACTIONS)},
}
MODEL = Kind(
    "model",
    OF_MODEL,
    {
        "width": Numbers(least=0.0),
        "failures_told": bool,
        **dict.fromkeys(("names", "units"), list[str]),
        **_optional({"dt": SIZE}),
        "rule": _RULE,
        "settings": _optional(_SETTINGS),
        "actions": _optional({"low": _OBSERVED, "high": _OBSERVED, "width": SIZE}),
    },
)

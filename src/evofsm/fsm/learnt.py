# ruff: noqa: RUF009  (an `Array` as a default never changes)
"""The one table of what a machine learns: each array stands here, once, with all there is to know.

The flat buffer (`layout`), the members of files and their ranges, what a merge adds up and a state
that is given up loses, the fields of a model and the properties of a machine are read from it.
Counts that people may ask for stand in `Counts`; a new one is a line there, and a line where it is
counted (CONTRIBUTING.md, *Add a counter*).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, cast, get_type_hints

from evofsm.fsm.layout import SHAPES, Array, Floats
from evofsm.store import (
    COUNT,
    FLAG,
    FROM_1,
    LARGEST_OBSERVATION,
    MOST_COUNTED,
    SHARE,
    SIZE,
    SMALLEST,
    Kind,
    Numbers,
)

# A row with a smaller scale is multiplied out, long before it underflows.
SMALLEST_SCALE = 1e-30
#: The place of an action without a matrix, and the action where there is none.
NOT_OPEN = -1.0
NO_ACTION = -1

_FARTHEST = SHARE.most * LARGEST_OBSERVATION
_OBSERVED = Numbers(least=-_FARTHEST, most=_FARTHEST)
_SUM = Numbers(least=0.0, most=MOST_COUNTED)
_STORED = Numbers(least=0.0, most=10.0 / SMALLEST_SCALE)
_INDEX = COUNT._replace(least=-1.0)
# Of all states together, where they were merged into one.
_FREQUENCY = Numbers(least=0.0, most=LARGEST_OBSERVATION)
_PRODUCT = Numbers(least=0.0, most=1e300)


def _array(kind: str, *arguments: Any, **options: Any) -> Any:
    """An `Array`; as a default of a field it has any type."""
    return Array(kind, *arguments, **options)


_counter = partial(_array, "counter", COUNT)
_per_state, _per_place = partial(_array, "state"), partial(_array, "place")
# Counts of states, and of states and actions, that never forget.
_of_states = partial(_per_state, COUNT, "sum")
_of_actions = partial(_per_place, COUNT, "sum")


@dataclass(frozen=True, eq=False, repr=False)
class Counts:
    """What was counted; machines and models have it under these names.

    n is the number of states, q of actions. Counts never forget: a rare failure must not fade, and
    they are the evidence that there is. An episode is counted once for each state it came to, and
    each action it took there, for observations of one episode are no independent evidence; the one
    that is going on is not shown yet. It failed *soon* after it was in a state if no more than
    ``failure_horizon`` observations lay between; where that is not set, if it failed at all.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 1, 0, 0], [0, 2], [3])
    >>> machine.visits, machine.endings, machine.episodes, machine.failed_soon
    (array([3., 1.]), array([0., 1.]), array([2., 1.]), array([1., 1.]))
    >>> machine.decisions, machine.failures
    (array([[2., 0.],
           [0., 0.]]), array([[1., 0.],
           [0., 0.]]))
    >>> machine.model().tried, machine.model().failed_after
    (array([[2., 0.],
           [0., 0.]]), array([[1., 0.],
           [0., 0.]]))
    >>> machine.onsets  # it was not asked to learn how its system moves
    array([0., 0.])
    """

    #: (n,) observations in which each state was the most probable
    visits: Floats = _of_states()
    #: (n,) number of the observation that created each state, from 1
    founded: Floats = _per_state(COUNT)
    #: (n, n) steps from the most probable state (row) to the next one (column)
    changes: Floats = _array("change", COUNT, "sum")
    #: (q, n) for each action, transitions that began in each state, by belief
    decisions: Floats = _per_place(_SUM, "sum")
    #: (q, n) those of `decisions` that led straight into failure
    failures: Floats = _per_place(_SUM, "sum")
    #: (n,) failures whose last observation was recognised as each state: maybe a dead end
    endings: Floats = _of_states()
    #: (n,) episodes that came to each state
    episodes: Floats = _of_states(latest="latest_visit")
    #: (n,) those of `episodes` that failed soon after they were there
    failed_soon: Floats = _of_states()
    #: (n,) 1 where two states were joined, so that an episode may count twice
    joined: Floats = _per_state(FLAG, "most")
    #: (q, n) episodes that took each action in each state
    tried: Floats = _of_actions(latest="latest_try")
    #: (q, n) those of `tried` that failed soon after they did
    failed_after: Floats = _of_actions()
    #: (n,) times that something unexpected began in each state, as somebody said (`onset`)
    onsets: Floats = _of_states()


@dataclass(frozen=True, eq=False, repr=False)
class Outcomes(Counts):
    """`Counts`, and what a machine needs to go on counting. Places are those of `Transitions`."""

    clock: Floats = _counter()  # observations so far, with those that lacked something
    began: Floats = _counter()  # the clock at the present episode's first observation
    latest_visit: Floats = _per_state(COUNT, "most")  # clock at the latest one
    latest_try: Floats = _per_place(COUNT, "most")  # clock one observation later


@dataclass(frozen=True, eq=False, repr=False)
class Clusters:
    """What state rules remember: m variables, ``capacity`` centres, the first ``n`` in use."""

    n_observations: Floats = _counter()
    first: Floats = _array("variable", _OBSERVED)  # z_1, the origin of `mean`
    latest: Floats = _array("variable", _OBSERVED)  # z_t
    #: of all observations, minus `first`
    mean: Floats = _array("variable", Numbers(least=-2.0 * _FARTHEST, most=2.0 * _FARTHEST))
    scatter: Floats = _array("counter", _PRODUCT)  # sum of squared distances to the mean
    centers: Floats = _array("center", _OBSERVED)
    potentials: Floats = _per_state(SHARE, "most")
    squared_distances: Floats = _per_state(_PRODUCT)  # from the latest observation


@dataclass(frozen=True, eq=False, repr=False)
class Transitions:
    """One row-stochastic matrix per action, the first n of ``capacity`` states in use.

    An action has a place among the s matrices from its first use on. One that was never used
    has none, and costs nothing: all its transitions are alike.

    A row is kept as a scale times what is stored of it. What decays as a whole then decays by
    its scale, without touching the row.
    """

    places: Floats = _array("action", _INDEX)  # of each action's matrix, or NOT_OPEN
    uses: Floats = _array("action", COUNT)  # transitions learnt with each action
    matrices: Floats = _array(
        "matrix", Numbers(least=0.0, most=10.0 / SMALLEST_SCALE)
    )  # over `scales`
    scales: Floats = _per_place(Numbers(least=0.1 * SMALLEST_SCALE, most=SHARE.most))
    origin_frequency: Floats = _per_place(_FREQUENCY)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Learnt:
    """What the next step needs, and what people ask of the states."""

    n_states: Floats = _counter()
    n_founded: Floats = _counter()  # states so far, with those given up
    action: Floats = _array("counter", _INDEX)  # after the latest observation, or NO_ACTION
    chained: Floats = _array("counter", FLAG)  # 1: `belief` is of the present episode
    state: Floats = _counter()  # the most probable state at the latest observation
    before: Floats = _array("counter", _INDEX)  # that at the one before it; -1 where none is left
    belief: Floats = _per_state(SHARE, "sum")
    ids: Floats = _per_state(COUNT)  # number of its creation, from 0
    outcomes: Outcomes
    clusters: Clusters
    transitions: Transitions


def arrays_of(part: type) -> Iterator[Array]:
    """The arrays of a part, and of the parts in it."""
    for name, told in get_type_hints(part).items():
        if isinstance(array := getattr(part, name, None), Array):
            yield array
        else:
            yield from arrays_of(told)


# -- In files -------------------------------------------------------------------------------------


def _member(array: Array, **sizes: str) -> Numbers:
    """An array as it is kept in a file, where ``sizes`` has other letters for some sizes."""
    letters: dict[str, int | str] = {"one": 1, "capacity": "n", "q": "settings.n_actions", **sizes}
    return array.range.of(*(letters.get(size, size) for size in SHAPES[array.kind]))


def _optional(numbers: Numbers) -> Numbers:
    return numbers._replace(optional=True)


_RULE: dict[str, Any] = {
    "memory": _optional(FROM_1._replace(least=2.0)),
    **dict.fromkeys(("radius", "spread", "distance"), _optional(SIZE)),
    "scales": Numbers(("scales",), 1e-20, 1e20, optional=True),
    "share": Numbers(least=SMALLEST, most=1.0, optional=True),
}
_RULE["base"] = dict(_RULE)
_BELOW_1 = math.nextafter(1.0, 0.0)
_WEIGHT = Numbers(least=SMALLEST, most=1e50)
_SETTINGS: dict[str, Any] = {
    "n_actions": FROM_1,
    **dict.fromkeys(("radius", "spread"), SIZE),
    **dict.fromkeys(("distance_weight", "prior_frequency"), _WEIGHT),
    "learning_rate": _WEIGHT._replace(most=_BELOW_1),
    "belief_tolerance": Numbers(least=0.0, most=_BELOW_1, optional=True),
    **dict.fromkeys(("max_states", "failure_horizon"), _optional(FROM_1)),
    "when_full": _optional(FLAG),
    "rule": _RULE,
}
MACHINE: Kind = Kind(
    "machine", {array.name: _member(array) for array in arrays_of(Learnt)}, _SETTINGS
)
# What a model has beside its `Counts`, centres by state.
_CENTRAL = cast(
    tuple[Array, ...], (Clusters.potentials, Transitions.uses, Transitions.origin_frequency)
)
#: The arrays of a model.
OF_MODEL = {
    "centers": _OBSERVED.of("n", "m"),
    "transition_matrices": SHARE.of("q", "n", "n"),
    **{array.name: _member(array, places="q", q="q") for array in (*_CENTRAL, *arrays_of(Counts))},
}
MODEL: Kind = Kind(
    "model",
    OF_MODEL,
    {
        "width": Numbers(least=0.0),
        "dt": _optional(SIZE),
        "rule": _RULE,
        "settings": {
            name: _optional(told) if isinstance(told, Numbers) else told
            for name, told in _SETTINGS.items()
        },
        "actions": {
            **dict.fromkeys(("low", "high"), _optional(_OBSERVED)),
            "width": _optional(SIZE),
        },
    },
)

"""Which rules there are: their names in files, and whose kernel judges an observation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.kernels import inner_kernel, kernel, lanes
from evofsm.fsm.learnt import Clusters
from evofsm.fsm.states import edges, novelty, paper
from evofsm.fsm.states.clusters import (
    CREATED,
    MOVED,
    absorb,
    measure_distances,
    nearest_center,
    place_center,
    potential_of,
    update_potentials,
)
from evofsm.fsm.states.edges import Edges
from evofsm.fsm.states.failure import FailureSplit
from evofsm.fsm.states.novelty import Novelty
from evofsm.fsm.states.paper import Paper
from evofsm.fsm.states.rule import RuleSettings, StateRule

# By name in files.
_RULES: dict[str, Any] = {}


def register_rule(name: str, rule: type) -> None:
    """Let machines take a state rule, and files name it.

    Parameters
    ----------
    name : str
        Its name in files.
    rule : type
        A frozen dataclass as `StateRule`, whose settings JSON has words for.

    Raises
    ------
    TypeError
        If ``rule`` is no frozen dataclass with a ``table``.
    ValueError
        If another rule has that name.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> from evofsm import EvolvingFSM, Novelty
    >>> @dataclass(frozen=True)
    ... class Fine(Novelty):
    ...     radius: float = 0.1
    >>> register_rule("fine", Fine)
    >>> EvolvingFSM(n_actions=1, rule=Fine()).radius
    0.1
    """
    is_frozen = is_dataclass(rule) and cast(Any, rule).__dataclass_params__.frozen
    if not (is_frozen and hasattr(rule, "table")):
        raise TypeError(f"{rule!r} is no state rule: a frozen dataclass with a `table`")
    known = _RULES.get(name, rule)
    if (known.__module__, known.__qualname__) != (rule.__module__, rule.__qualname__):
        raise ValueError(f"there is a state rule {name!r} already: {known.__name__}")
    _RULES[name] = rule  # anew where its module, or a cell of a notebook, was run again


register_rule("paper", Paper)
register_rule("edges", Edges)
register_rule("novelty", Novelty)
register_rule("failure", FailureSplit)

# Where a rule has no radius that says so, a state reaches so many roots of the width.
_WIDTHS = 2.0


@inner_kernel
def determine(
    settings: RuleSettings, clusters: Clusters, n: int, z: NDArray[np.float64]
) -> tuple[int, int, float]:
    """Judge one observation against ``n`` centres; the nearest may be moved onto it.

    Returns the event, the nearest centre, and the potential of the observation. Where the event
    is ``CREATED``, whoever asked has to place the new centre.
    """
    if clusters.n_observations[0] == 0.0:
        for j in range(len(z)):
            clusters.first[j] = z[j]
        event, nearest, potential = CREATED, 0, 1.0
    else:
        potential = potential_of(clusters, settings.weights, z)
        highest = update_potentials(clusters, n, settings.distance_weight, settings.memory)
        squared_distances = clusters.squared_distances
        measure_distances(clusters.centers, settings.weights, lanes(n), z, squared_distances)
        nearest = nearest_center(squared_distances, n)
        event = _judge(settings, clusters, n, potential, highest, squared_distances[nearest])
        if event == MOVED:
            place_center(clusters, nearest, z, potential)
    absorb(clusters, settings.weights, z, settings.memory)
    return event, nearest, potential


@inner_kernel
def _judge(
    settings: RuleSettings,
    clusters: Clusters,
    n: int,
    potential: float,
    highest: float,
    squared_distance: float,
) -> int:
    radius = settings.radius
    if settings.code == edges.CODE:
        return edges.judge(clusters, n, potential, highest, squared_distance, radius)
    if settings.code == novelty.CODE:
        return novelty.judge(squared_distance, radius)
    return paper.judge(potential, highest, squared_distance, radius)


@kernel
def width(settings: RuleSettings, variance: float) -> float:
    """Width of recognition, where observations so far have this total variance."""
    if settings.code == novelty.CODE:
        return novelty.width(settings.spread, settings.radius)
    return paper.width(settings.spread, variance)


def reach(rule: StateRule, width: float) -> float:
    """Distance from a centre, in scales, beyond which an observation is like no state.

    The radius of `Novelty`, beyond which it makes a new one. Other rules make no state of what is
    rare: twice the root of the width of recognition, where the similarity is 1/e⁴, or 2 %.
    """
    rule = rule.base if isinstance(rule, FailureSplit) else rule
    return rule.radius if isinstance(rule, Novelty) else _WIDTHS * math.sqrt(width)


def check_rule(name: str, rule: StateRule) -> StateRule:
    """One of the rules, as an object."""
    if type(rule) not in _RULES.values():
        known = ", ".join(f"{kind.__name__}(...)" for kind in _RULES.values())
        raise TypeError(f"{name} is {rule!r}; it must be an object: {known}")
    return rule


def weights(rule: StateRule, m: int) -> NDArray[np.float64]:
    """1 / scale of each of m variables."""
    scales = np.array(rule.scales or [1.0] * m)
    if len(scales) != m:
        raise ValueError(f"observation has {m} variables, but there are {len(scales)} in {rule}")
    return 1.0 / scales


def describe_rule(rule: StateRule) -> dict[str, Any]:
    """A rule in plain JSON: its name and its settings, but for those that are None."""
    name, kind = next(item for item in _RULES.items() if item[1] is type(rule))
    given = {entry.name: getattr(rule, entry.name) for entry in fields(kind)}
    settings = {name: value for name, value in given.items() if value is not None}
    if "base" in settings:
        settings["base"] = describe_rule(settings["base"])
    return {"name": name, **settings}


def restore_rule(description: Mapping[str, Any]) -> StateRule:
    """The rule that `describe_rule` put into words."""
    if not isinstance(description, Mapping) or "name" not in description:
        raise ValueError(f"rule is {description!r}; it must have the name of a state rule")
    settings = dict(description)
    name = settings.pop("name")
    if name not in _RULES:
        raise ValueError(f"there is no state rule {name!r}, only {', '.join(_RULES)}")
    if "base" in settings:
        settings["base"] = restore_rule(settings["base"])
    rule: StateRule = _RULES[name](**settings)
    return rule

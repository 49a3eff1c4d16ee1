"""State rules: by what numbers `evofsm.fsm.clusters.determine` judges an observation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from importlib.metadata import entry_points
from typing import Any, ClassVar, Protocol, cast

import numpy as np

from evofsm.fsm.arrays import Settings
from evofsm.fsm.clusters import JUDGED, NOVELTY, PAPER
from evofsm.fsm.validation import Floats, positive

# So many roots of the width a state reaches where no radius says so: the similarity is 1/e⁴ there.
_WIDTHS = 2.0


class StateRule(Protocol):
    """When an observation creates or moves a state, and how wide a state is recognised.

    A rule is a frozen dataclass of settings, made known with `register_rule`. All distances are
    those of observations divided by the rule's scales.
    """

    @property
    def scales(self) -> Sequence[float]:
        """Difference that counts as 1, for each of the m variables; empty: 1 for each."""

    @property
    def table(self) -> Mapping[str, float]:
        """What the kernel judges by: fields of `Settings`, in place of the machine's."""


@dataclass(frozen=True)
class Paper:
    """The paper's rule: evolving Takagi-Sugeno (eTS) clustering, Sections 2.2.1 and 2.2.2.

    An observation that is denser than every centre moves the nearest one if that is closer than the
    machine's ``radius``, else it creates a state. The width of recognition is ``spread`` times the
    total variance of all observations.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=1, radius=0.5, rule=Paper())
    >>> machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0]).n_states
    array([1, 1, 1, 2])
    """

    scales: ClassVar[Sequence[float]] = ()

    @property
    def table(self) -> Mapping[str, float]:
        """What the kernel judges by."""
        return {"rule": PAPER}


@dataclass(frozen=True)
class Novelty:
    """Create a state where every centre is farther than a radius; no centre ever moves.

    Beliefs stay local, however much was seen. ``radius`` and ``spread`` take the place of the
    machine's.

    Parameters
    ----------
    radius : float
        Distance, in scales, beyond which an observation creates a state.
    scales : sequence of float
        For each of the m variables, the difference that counts as 1; empty: 1 for each.
    spread : float
        Width of recognition in squared radii: the similarity to a centre is
        ``exp(-distance^2 / (spread * radius^2))``.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=1.0, scales=(2.0,)))
    >>> machine.learn_many([[0.0], [1.9], [2.1], [4.0]], [0, 0, 0, 0]).n_states
    array([1, 1, 2, 2])
    """

    radius: float = 1.0
    scales: Sequence[float] = ()
    spread: float = 1.0

    def __post_init__(self) -> None:
        scales = tuple(positive("a scale", scale) for scale in self.scales)
        object.__setattr__(self, "scales", scales)
        object.__setattr__(self, "radius", positive("radius", self.radius))
        object.__setattr__(self, "spread", positive("spread", self.spread))

    @property
    def table(self) -> Mapping[str, float]:
        """What the kernel judges by."""
        return {"rule": NOVELTY, "radius": self.radius, "spread": self.spread}


# By name in files.
_RULES: dict[str, Any] = {"paper": Paper, "novelty": Novelty}


def register_rule(name: str, rule: type) -> None:
    """Let machines take a state rule, and files name it.

    Parameters
    ----------
    name, rule : str, type
        A frozen dataclass as `StateRule`, whose settings JSON has words for.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> @dataclass(frozen=True)
    ... class Fine(Novelty):
    ...     radius: float = 0.1
    >>> register_rule("fine", Fine)
    >>> EvolvingFSM(n_actions=1, rule=Fine()).radius
    0.1
    """
    is_frozen = is_dataclass(rule) and cast(Any, rule).__dataclass_params__.frozen
    if not (is_frozen and {"table", "scales"} <= {*dir(rule), *vars(rule)["__dataclass_fields__"]}):
        raise TypeError(f"{rule!r} is no state rule: a frozen dataclass with `table` and `scales`")
    owner = _RULES.get(name, rule)
    if (owner.__module__, owner.__qualname__) != (rule.__module__, rule.__qualname__):
        raise ValueError(f"there is a state rule {name!r} already: {owner.__name__}")
    _RULES[name] = rule  # anew where its module, or a cell of a notebook, was run again


def rule_named(name: object) -> Any:
    """The class of a rule that was registered, or that an installed package declares."""
    if isinstance(name, str) and name not in _RULES:
        for point in entry_points(group="evofsm.rules", name=name):
            register_rule(name, point.load())
    if name not in _RULES:
        hint = "once its module has called register_rule, or by an entry point of evofsm.rules"
        names = f"{', '.join(_RULES)} (one of your own is known {hint})"
        raise ValueError(f"rule is {name!r}; it must be one of {names}")
    return _RULES[name]


def weights_of(rule: StateRule, m: int) -> Floats:
    """(m,) 1 / scale of each variable."""
    sizes = np.asarray(rule.scales).tolist() or [1.0] * m
    scales = np.array([positive("a scale", scale) for scale in sizes])
    if len(scales) != m:
        raise ValueError(f"observation has {m} variables, but there are {len(scales)} in {rule}")
    return 1.0 / scales


def table_of(rule: StateRule) -> dict[str, float]:
    """What the kernel judges by; refused where no kernel knows it."""
    table, names = dict(rule.table), Settings._fields[:-1]
    if "rule" not in table or table["rule"] not in JUDGED or not table.keys() <= {*names}:
        knows = f"its rule must be one of {JUDGED}, as in the table of Novelty"
        raise ValueError(f"table of {rule} is {table}; {knows}, and others of {', '.join(names)}")
    return {name: float(value) for name, value in table.items()}


def reach(rule: StateRule, settings: Mapping[str, Any], width: float) -> float:
    """Distance from a centre, in scales, beyond which an observation is like no state."""
    table = {"radius": 0.0, **settings, **rule.table}
    return float(table["radius"] if table["rule"] == NOVELTY else _WIDTHS * math.sqrt(width))


def describe_rule(rule: StateRule) -> dict[str, Any]:
    """A rule in plain JSON: its name and its settings; a TypeError where it is none."""
    for name, kind in _RULES.items():
        if kind is type(rule):
            settings = [part.name for part in fields(_RULES[name])]
            return {"name": name} | {part: getattr(rule, part) for part in settings}
    names = ", ".join(f"{kind.__name__}(...)" for kind in _RULES.values())
    raise TypeError(f"rule is {rule!r}; it must be an object: {names}, or of register_rule")


def restore_rule(description: Mapping[str, Any] | None) -> StateRule:
    """The rule that `describe_rule` put into words."""
    settings = dict(description or {})
    return cast(StateRule, rule_named(settings.pop("name", None))(**settings))

"""Which contract a thing is under, seen from the methods it has; and fresh copies of it."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable
from enum import Enum
from typing import Any

#: Makes the thing to be checked anew, so that no check sees what another one did to it.
Make = Callable[[], Any]


class Kind(Enum):
    """What there are contracts for."""

    MACHINE = "machine"  #: learns states and transitions, as `evofsm.EvolvingFSM`
    FLEET = "fleet"  #: many machines at once, as `evofsm.fleet.batch.Fleet`
    MODEL = "model"  #: a frozen snapshot, as `evofsm.FSMModel`
    RULE = "rule"  #: how states are determined, as `evofsm.fsm.states.rule.StateRule`
    REVISER = "reviser"  #: keeps a proposal or replaces it, as `evofsm.guard.protocols.Reviser`
    CONTROLLER = "controller"  #: proposes, as `evofsm.guard.protocols.Controller`
    JUDGE = "judge"  #: says how dangerous actions are, as `evofsm.guard.protocols.LearningJudge`
    MEASURE = "measure"  #: how dangerous a situation is, as `evofsm.guard.protocols.RiskMeasure`


# The first whose methods are all there is meant: what has more comes first.
_METHODS = {
    Kind.FLEET: ("observe", "start_episode", "n_states", "__getitem__"),
    Kind.MACHINE: ("observe", "act", "predict"),
    Kind.MODEL: ("recognise", "propagate"),
    Kind.RULE: ("table", "scales"),
    Kind.REVISER: ("revise", "start_episode"),
    Kind.CONTROLLER: ("propose",),
    Kind.JUDGE: ("judge", "learn", "sums"),
    Kind.MEASURE: ("score",),
}
# What a class of a kind is made with where it is given as a class and has no such defaults.
_ARGUMENTS: dict[Kind, dict[str, object]] = {
    Kind.MACHINE: {"n_actions": 3},
    Kind.JUDGE: {"lowest": -2.5, "dt": 0.25},
}


def kind_of(thing: object) -> Kind:
    """Which contract a class, an instance, or a function that makes one is under.

    Parameters
    ----------
    thing : object
        A class, an instance, or a function without arguments that returns an instance.

    Returns
    -------
    Kind

    Raises
    ------
    TypeError
        If it has the methods of no kind.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> kind_of(EvolvingFSM), kind_of(EvolvingFSM(n_actions=2).model)
    (<Kind.MACHINE: 'machine'>, <Kind.MODEL: 'model'>)
    """
    kind = _by_methods(thing)
    if kind is None and callable(thing) and not inspect.isclass(thing):
        kind = _by_methods(thing())
    if kind is None:
        known = "; ".join(
            f"a {kind.value} has {', '.join(names)}" for kind, names in _METHODS.items()
        )
        raise TypeError(f"{thing!r} has the methods of no kind: {known}")
    return kind


def _by_methods(thing: object) -> Kind | None:
    for kind, names in _METHODS.items():
        if all(hasattr(thing, name) for name in names):
            return kind
    return None


def maker(thing: object, kind: Kind) -> Make:
    """A function that makes the thing anew: of a class instances, of an instance copies.

    Raises
    ------
    TypeError
        If a class cannot be made without arguments.
    """
    if inspect.isclass(thing):
        return _of_class(thing, kind)
    if _by_methods(thing) is None and callable(thing):
        return thing
    if kind is Kind.MODEL:  # frozen: a copy could be another thing
        return lambda: thing
    return lambda: copy.deepcopy(thing)


def _of_class(cls: type, kind: Kind) -> Make:
    missing = [
        name
        for name, parameter in inspect.signature(cls).parameters.items()
        if parameter.default is parameter.empty
        and parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
    ]
    arguments = {n: value for n, value in _ARGUMENTS.get(kind, {}).items() if n in missing}
    if set(missing) - set(arguments):
        raise TypeError(
            f"{cls.__name__} needs arguments ({', '.join(missing)}); give an instance, or a "
            "function that makes one (--make on the command line)"
        )
    return lambda: cls(**arguments)

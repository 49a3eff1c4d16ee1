"""The systems that are controlled, by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from evofsm.evidence.systems.acc import Acc
from evofsm.evidence.systems.cars import Cars
from evofsm.evidence.systems.cartpole import CartPole
from evofsm.evidence.systems.pendulum import Pendulum
from evofsm.evidence.systems.reactor import Reactor
from evofsm.evidence.systems.system import System
from evofsm.evidence.systems.tanks import Tanks

#: By name: makes the system with the controller of that name, or with its first one.
SYSTEMS: dict[str, Callable[[str | None], System]] = {
    "acc": Acc,
    "acc-5": partial(Acc, hold=5),
    "cartpole": CartPole,
    "cartpole-gusts": partial(CartPole, gusts=True),
    "pendulum": Pendulum,
    "pendulum-cos": partial(Pendulum, circular=True),
    "tanks": Tanks,
    "reactor": Reactor,
    "emergency": partial(Cars, family="emergency"),
    "cut_in": partial(Cars, family="cut_in"),
}


def _highway(controller: str | None, *, task: str) -> System:
    """Imported where it is asked for: the package that it needs is an extra of its own."""
    from evofsm.evidence.systems.highway import Highway

    return Highway(controller, task=task)


#: The same for the tasks of highway-env, which need a package more, and take long.
HIGHWAY: dict[str, Callable[[str | None], System]] = {
    task: partial(_highway, task=task) for task in ("highway-fast", "merge", "intersection")
}


def make_system(name: str, controller: str | None = None) -> System:
    """A system by its name.

    Parameters
    ----------
    name : str
        One of `SYSTEMS` or `HIGHWAY`.
    controller : str, optional
        One of its controllers; without it the first.

    Raises
    ------
    ValueError
        If there is no such system, or it has no such controller.

    Examples
    --------
    >>> system = make_system("acc")
    >>> list(system.controllers), system.interval, system.steps
    (['full throttle'], 0.02, 300)
    """
    known = SYSTEMS | HIGHWAY
    if name not in known:
        raise ValueError(f"there is no system {name!r}; there are {', '.join(known)}")
    return known[name](controller)

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


def make_system(name: str, controller: str | None = None) -> System:
    """A system by its name.

    Parameters
    ----------
    name : str
        One of `SYSTEMS`.
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
    if name not in SYSTEMS:
        raise ValueError(f"there is no system {name!r}; there are {', '.join(SYSTEMS)}")
    return SYSTEMS[name](controller)

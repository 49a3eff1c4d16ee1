"""The systems that are controlled, by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec

from evofsm.cli import imported
from evofsm.driving import FAMILIES
from evofsm.extras import install
from studies.systems.acc import Acc
from studies.systems.cars import Cars
from studies.systems.cartpole import CartPole
from studies.systems.masa import INSTALL, MASA, PACKAGE
from studies.systems.pendulum import Pendulum
from studies.systems.reactor import Reactor
from studies.systems.system import System
from studies.systems.tanks import Tanks

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
    from studies.systems.highway import Highway

    return Highway(controller, task=task)


#: Tasks of highway-env; they take long.
HIGHWAY: dict[str, Callable[[str | None], System]] = {
    task: partial(_highway, task=task) for task in ("highway-fast", "merge", "intersection")
}


#: The same for those that others set, which `python -m studies tasks` puts side by side.
TASKS: dict[str, Callable[[str | None], System]] = {
    **{name: SYSTEMS[name] for name in ("acc", "acc-5", "cartpole", "pendulum", "pendulum-cos")},
    **MASA,
    **HIGHWAY,
}


# Packages that no extra brings, or a heavy one, by the tasks and rivals that need them.
_PACKAGES = {
    **dict.fromkeys(MASA, (PACKAGE, INSTALL)),
    **dict.fromkeys(HIGHWAY, ("highway_env", install("highway"))),
    "cbfpy": ("cbfpy", "pip install cbfpy"),
}


def lacking(name: str) -> str:
    """What installs the package that a task or a rival lacks; empty where it lacks none.

    Examples
    --------
    >>> lacking("acc")
    ''
    """
    package, command = _PACKAGES.get(name, ("", ""))
    return "" if not package or find_spec(package) else f"it needs {package} ({command})"


def make_system(name: str, controller: str | None = None) -> System:
    """A system by its name.

    Parameters
    ----------
    name : str
        One of `SYSTEMS` or `TASKS`, a family of scenarios (``emergency+noise`` with a switch), or
        ``module:Name`` of a class derived from `System`, which is looked for in the present
        folder too.
    controller : str, optional
        One of its controllers; without it the first.

    Raises
    ------
    ValueError
        If there is no such system, or it has no such controller.
    TypeError
        If what is named makes no system.

    Examples
    --------
    >>> system = make_system("acc")
    >>> list(system.controllers), system.interval, system.steps
    (['full throttle'], 0.02, 300)
    """
    if ":" in name:
        made = imported(name)(controller)
        if not isinstance(made, System):
            raise TypeError(f"{name} makes a {type(made).__name__}, which is no System")
        return made
    known = SYSTEMS | TASKS
    families = [*FAMILIES, name] if name.partition("+")[0] in FAMILIES else FAMILIES
    known |= {one: partial(Cars, family=one) for one in families if one not in known}
    if name not in known:
        raise ValueError(f"there is no system {name!r}; there are {', '.join(known)}")
    return known[name](controller)

"""Attach guards to a running SUMO simulation, or only watch: which cars, and what came of it."""

from __future__ import annotations

import itertools
import math
import time as clock
import warnings
import weakref
import zlib
from collections.abc import Callable, Iterable
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from evofsm.driving.guarding import GuardedStep, Guarding, Seeing
from evofsm.driving.measures import deceleration_to_avoid_collision, time_to_collision
from evofsm.guard import TOLERANCE, Guard

# What is done with the chosen cars.
_MODES = ("act", "shadow", "watch")
_TYPE = "type:"
# Clocks of SUMO count thousandths; two times that differ by less are one [s].
_TICK = 5e-4
_SKIPPED = (
    "SUMO went on by several steps at once (simulationStep with a time, or loadState), in which no "
    "guard looked or acted and no collision was counted; cars begin anew. Go on step by step"
)
_NUMBERS = itertools.count()
_ATTACHED: weakref.WeakSet[Attachment] = weakref.WeakSet()
# Two that touched within this time before still do [s].
_SAME_COLLISION = 5.0


def choose(vehicles: str | float | Iterable[str], seed: int = 0) -> Callable[[Any, str], bool]:
    """A test of whether a vehicle is one of those that are meant, as `attach` takes them.

    Of a share, id and seed alone decide: the same vehicles are meant in every run.
    """
    if vehicles == "all":
        return lambda sumo, car: True
    if isinstance(vehicles, str) and vehicles.startswith(_TYPE):
        kind = vehicles.removeprefix(_TYPE)
        return lambda sumo, car: sumo.vehicle.getTypeID(car) == kind
    if isinstance(vehicles, (str, int, float)):
        limit = _share(vehicles) * 2.0**32
        return lambda _, car: zlib.crc32(f"{seed}:{car}".encode()) < limit
    ids = frozenset(vehicles)
    return lambda _, car: car in ids


def _share(vehicles: str | float) -> float:
    text = str(vehicles)
    try:
        share = float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
    except ValueError:
        share = math.nan
    if not 0.0 < share <= 1.0:
        raise ValueError(
            f"vehicles is {vehicles!r}; it is 'all', 'type:NAME', a share above 0 up to 1, such as "
            "0.1 or '10%', or a list of ids"
        )
    return share


class Watching:
    """Measures each car against whoever is ahead of it."""

    def __init__(self, seeing: Seeing) -> None:
        self._seeing = seeing
        self.cars: dict[str, None] = {}  #: by id
        self.ids: list[str] = []  #: of cars with somebody ahead, now
        self.observations = np.empty((0, 3))  #: of each gap [m], its speed and the other's [m/s]
        self.ttc = np.empty(0)  #: time to collision of each [s]
        self.drac = np.empty(0)  #: deceleration to avoid it, of each [m/s²]
        self.lowest_ttc: dict[str, float] = {}  #: of each car that ever closed in
        self.highest_drac: dict[str, float] = {}

    def add(self, car: str) -> None:
        """Watch it from now on."""
        self.cars[car] = None

    def remove(self, car: str) -> None:
        """Watch it no longer; what was measured stays."""
        del self.cars[car]

    def step(self, time: float) -> None:
        """Look at every car."""
        pairs = {car: self._seeing.pair(car) for car in self.cars}
        met = {car: pair for car, pair in pairs.items() if pair is not None}
        self.ids = list(met)
        self.observations = np.array(list(met.values())).reshape(-1, 3)
        self.ttc = time_to_collision(self.observations)
        self.drac = deceleration_to_avoid_collision(self.observations)
        for k in np.flatnonzero(np.isfinite(self.ttc)).tolist():
            car, ttc, drac = self.ids[k], float(self.ttc[k]), float(self.drac[k])
            self.lowest_ttc[car] = min(ttc, self.lowest_ttc.get(car, ttc))
            self.highest_drac[car] = max(drac, self.highest_drac.get(car, drac))


class Collision(NamedTuple):
    """A collision, told once for the two."""

    time: float  #: [s]
    collider: str  #: of two in a lane the one behind
    victim: str
    kind: str  #: as SUMO calls it


class Attachment:
    """What `attach` returns: which cars it is, and what came of them."""

    def __init__(
        self,
        sumo: Any,
        chosen: Callable[[Any, str], bool],
        seeing: Seeing,
        cars: Guarding | Watching,
    ) -> None:
        self._sumo, self._chosen, self._seeing, self._cars = sumo, chosen, seeing, cars
        self.guarding = cars if isinstance(cars, Guarding) else None
        self.watching = cars if isinstance(cars, Watching) else None
        self._now: float | None = None
        self._key = f"evofsm.{next(_NUMBERS)}"  # of a parameter that no other simulation has
        self._known: set[str] = set()
        self._met: dict[tuple[str, str], float] = {}
        self._listener: int | None = None
        self.collisions: list[Collision] = []  #: of the whole simulation, other cars included
        self.ever: set[str] = set()  #: vehicles that were guarded, or watched, at any time
        self.looked = 0  #: cars that were looked at, summed over the steps
        self.seconds = 0.0  #: that the attachment took

    @property
    def cars(self) -> list[str]:
        """Vehicles that are guarded, or watched, now."""
        return list(self._cars.cars)

    def listen(self) -> None:
        """Have SUMO call `step` after each of its own."""
        base = getattr(self._sumo, "StepListener", None) or import_module("traci").StepListener

        def step(_: Any, __: float) -> bool:
            return self.step()

        if getattr(self._sumo, "__name__", "") == "libsumo":
            # It keeps listeners where a simulation is closed. Whoever attaches anew is not guarded
            # twice, once by what was attached to the one before.
            for other in [one for one in _ATTACHED if one._sumo is self._sumo and one._is_new()]:
                other._listen_no_more()
        listener = type("Listener", (base,), {"step": step})()
        self._listener = self._sumo.addStepListener(listener)
        self._sumo.simulation.setParameter("", self._key, "1")
        _ATTACHED.add(self)

    def detach(self) -> None:
        """Hand every car back to SUMO, and listen no longer."""
        self._listen_no_more()
        for car in self.cars:
            self._cars.remove(car)

    def _listen_no_more(self) -> None:
        if self._listener is not None:
            self._sumo.removeStepListener(self._listener)
            self._listener = None

    def step(self) -> bool:
        """Take in a step of the simulation that is over, and decide on the next.

        In another simulation, after ``load`` or ``close`` and ``start``, and wherever time moved by
        anything but one step, all that is known of cars is forgotten, and they begin anew.
        """
        begin = clock.perf_counter()
        now, before = float(self._sumo.simulation.getTime()), self._now
        if self._is_new():
            self._begin_anew()
            self._sumo.simulation.setParameter("", self._key, "1")
        elif before is not None and abs(now - before - self._seeing.dt) > _TICK:
            if now - before > self._seeing.dt:
                warnings.warn(_SKIPPED, RuntimeWarning, stacklevel=2)
            self._begin_anew()
        self._now = now
        self._count_cars()
        self._count_collisions(now)
        self.looked += len(self._cars.cars)
        self._cars.step(now)
        self.seconds += clock.perf_counter() - begin
        return True

    def _is_new(self) -> bool:
        return bool(self._sumo.simulation.getParameter("", self._key) != "1")

    def _begin_anew(self) -> None:
        """Forget the cars, which are other ones, or are elsewhere; who is here is handed back."""
        here = set(self._sumo.vehicle.getIDList())
        for car in here.intersection(self.cars):
            self._cars.remove(car)
        self._cars.cars.clear()
        self._known.clear()
        self._met.clear()
        self._seeing.look_up()
        if self.guarding is not None:
            self.guarding.begin_anew()

    def _count_cars(self) -> None:
        """Cars that are inserted, or come back from a teleport; and those that leave."""
        here = set(self._sumo.vehicle.getIDList())
        for car in sorted(here - self._known):
            if self._chosen(self._sumo, car):
                self._cars.add(car)
                self.ever.add(car)
        for car in self._known - here:
            self._cars.cars.pop(car, None)
            self._seeing.forget(car)
        self._known = here

    def _count_collisions(self, now: float) -> None:
        for each in self._sumo.simulation.getCollisions():
            pair = each.collider, each.victim
            if now - self._met.get(pair, -math.inf) > _SAME_COLLISION:
                self.collisions.append(Collision(now, *pair, each.type))
            self._met[pair] = now


def attach(
    sumo: Any,
    vehicles: str | float | Iterable[str] = "all",
    *,
    guard: Guard | None = None,
    mode: str = "act",
    tolerance: float = TOLERANCE,
    learn: bool = True,
    seed: int = 0,
    report: Callable[[GuardedStep], None] | None = None,
) -> Attachment:
    """Guard, or watch, cars of a SUMO simulation that runs.

    From then on each ``simulationStep`` does the rest. SUMO drives a guarded car as before, but no
    faster than its guard allows. The guard minds who is ahead and behind in its lane; right of way,
    red lights and lane changes stay SUMO's.

    Parameters
    ----------
    sumo : module or connection
        libsumo, or traci, with a simulation started.
    vehicles : str, float or iterable of str
        ``"all"``, ``"type:NAME"``, a share such as 0.1 or ``"10%"``, or ids; those to come as well.
    guard : Guard, optional
        Each car gets a copy, frozen. It observes scenes (`guard_for_traffic`) or gap and speeds
        (`guard_for_cars`). Without one, each knows the car's own limits: it counts on SUMO's
        ``decel`` and brakes up to ``emergencyDecel`` where it has to.
    mode : {"act", "shadow", "watch"}
        Whether guards act, only say what they would do, or there are none: then only time to
        collision and needed deceleration are measured.
    tolerance : float
        Highest risk that is accepted; a ``guard`` has its own.
    learn : bool
        Whether the guards learn how hard leaders brake, all of them from what each sees.
    seed : int
        Of the share.
    report : callable, optional
        Called with each `GuardedStep`: what a car's driver wanted, what it did, and why.

    Raises
    ------
    ValueError
        If there is no such mode or choice of vehicles, or the guard decides at other times than
        those of steps, or observes something else.
    TypeError
        If the guard has no judge.

    Notes
    -----
    Where a guard acts, the speed mode has "safe speed" and the limit of acceleration on and that of
    braking off. It is put back as it was, with ``setSpeed(-1)``, as soon as the guard allows all
    that the car can do. Where you set a car's speed yourself, ask a `Guard` before you do instead.
    After ``load``, or ``close`` and ``start``, an attachment goes on with the new cars, and what it
    counts goes on; whoever attaches anew ends those of earlier simulations.

    Examples
    --------
    >>> import libsumo
    >>> from evofsm.driving import SumoWorld, load_family
    >>> scenario = load_family("emergency").draw(seed=0, index=0).scenario
    >>> with SumoWorld() as world, world.open(scenario) as road:  # or your own simulation
    ...     watch = attach(libsumo, "all", mode="watch")
    ...     road.advance(0.0, steps=25)
    >>> watch.looked
    50
    """
    if mode not in _MODES:
        raise ValueError(f"there is no mode {mode!r}; there are {', '.join(_MODES)}")
    if mode == "watch" and guard is not None:
        raise ValueError("mode 'watch' asks no guard; use mode 'shadow'")
    chosen, seeing = choose(vehicles, seed), Seeing(sumo)
    cars: Guarding | Watching = Watching(seeing)
    if mode != "watch":
        cars = Guarding(sumo, seeing, guard, mode == "act", tolerance, learn, report)
    attachment = Attachment(sumo, chosen, seeing, cars)
    attachment.listen()
    return attachment

"""Drive a SUMO configuration of someone else's, with guards in some of its cars."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from evofsm.driving import attach
from evofsm.extras import needs


@dataclass(frozen=True)
class Attached:
    """What came of a simulation with guards in it."""

    configuration: str
    vehicles: str
    mode: str
    seconds: float  #: of the simulation
    guarded: int  #: cars that had a guard
    collisions: int  #: of all cars
    of_guarded: int  #: in which a guarded car ran into another one
    into_guarded: int  #: in which another one ran into a guarded car
    speed: float  #: mean of the guarded cars [m/s]
    decisions: int
    revised: int  #: in which a car drove slower than its driver wanted; in shadow, would have
    microseconds: float  #: for a decision, all that guarding takes

    def document(self) -> dict[str, Any]:
        """For programs."""
        return asdict(self)


def drive_configuration(
    file: Path,
    vehicles: str | Iterable[str],
    mode: str,
    tolerance: float,
    show: Callable[[float, int], None] = lambda time, collisions: None,
) -> Attached:
    """Run a configuration to its end, or until all cars have arrived.

    Parameters
    ----------
    file : path
    vehicles, mode, tolerance
        As in `evofsm.driving.attach`.
    show : callable
        Told the time [s] and the number of collisions after each step.

    Raises
    ------
    OSError
        If there is no such file.
    ValueError
        If SUMO refuses it.
    """
    sumo = _started(file)
    try:
        guards = attach(sumo, vehicles, mode=mode, tolerance=tolerance)
        end, distance, drives = sumo.simulation.getEndTime(), 0.0, 0
        while _goes_on(sumo, end):
            sumo.simulationStep()
            cars = guards.cars
            distance += sum(map(sumo.vehicle.getSpeed, cars))
            drives += len(cars)
            show(sumo.simulation.getTime(), len(guards.collisions))
        seconds = float(sumo.simulation.getTime())
    finally:
        sumo.close()
    met, guarded, guarding = guards.collisions, guards.ever, guards.guarding
    assert guarding is not None
    return Attached(
        str(file),
        vehicles if isinstance(vehicles, str) else ",".join(vehicles),
        mode,
        seconds,
        len(guarded),
        len(met),
        sum(each.collider in guarded for each in met),
        sum(each.victim in guarded and each.collider not in guarded for each in met),
        distance / drives if drives else 0.0,
        guarding.decisions,
        guarding.revised,
        1e6 * guards.seconds / max(1, guarding.decisions),
    )


def trace_configuration(file: Path, out: Path, *, seconds: float) -> None:
    """Run a configuration as it is, and write where its cars were as an FCD file.

    Parameters
    ----------
    file : path
    out : path
        Of the FCD file; it ends in ``.xml``.
    seconds : float
        Of the simulation that are enough [s].

    Raises
    ------
    OSError, ValueError
        As in `drive_configuration`.
    """
    sumo = _started(file, "--fcd-output", str(out))
    try:
        end, begin = sumo.simulation.getEndTime(), sumo.simulation.getTime()
        while _goes_on(sumo, end) and sumo.simulation.getTime() < begin + seconds:
            sumo.simulationStep()
    finally:
        sumo.close()


def _started(file: Path, *options: str) -> Any:
    if not file.is_file():
        raise FileNotFoundError(2, "no such file", str(file))
    with needs("libsumo", "sumo", "a SUMO configuration"):
        sumo: Any = import_module("libsumo")
    try:
        sumo.start(["sumo", "-c", str(file), "--no-step-log", "true", *options])
    except sumo.TraCIException as error:
        raise ValueError(f"{file}: SUMO refuses it: {str(error).strip()}") from error
    return sumo


def _goes_on(sumo: Any, end: float) -> bool:
    if 0.0 <= end <= sumo.simulation.getTime():
        return False
    return bool(sumo.simulation.getMinExpectedNumber() > 0)

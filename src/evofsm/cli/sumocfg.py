"""Drive a SUMO configuration of someone else's, with guards in some of its cars."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from evofsm.cli.options import split_names
from evofsm.cli.show import facts, print_json, progress, show
from evofsm.driving import attach
from evofsm.extras import needs


def run_configuration(
    file: Path, vehicles: str, mode: str, tolerance: float, *, as_json: bool
) -> None:
    """Run it to its end, or until all cars have arrived, and print what came of it."""
    if mode not in ("act", "shadow"):
        raise ValueError(f"--mode is {mode!r}; for a configuration it is act or shadow")
    with progress("Driving") as move:
        came = drive_configuration(file, vehicles, mode, tolerance, move)
    if as_json:
        print_json(came)
    else:
        show(facts("What came of the simulation", _facts(came)))


def drive_configuration(
    file: Path,
    vehicles: str,
    mode: str,
    tolerance: float,
    move: Callable[..., None] = lambda **_: None,
) -> dict[str, Any]:
    """What came of it: cars, collisions, speed, and what guarding did."""
    by_ids = not (vehicles == "all" or vehicles.startswith("type:") or vehicles.endswith("%"))
    with _running(file) as (sumo, steps):
        chosen = split_names(vehicles) if by_ids else vehicles
        guards = attach(sumo, chosen, mode=mode, tolerance=tolerance)
        distance, drives = 0.0, 0
        for seconds in steps:
            distance += sum(map(sumo.vehicle.getSpeed, guards.cars))
            drives += len(guards.cars)
            if seconds == int(seconds):
                move(description=f"Driving ({seconds:,.0f} s, {len(guards.collisions)} collisions)")
        seconds, kinds = float(sumo.simulation.getTime()), sumo.vehicletype.getIDList()
    if not guards.ever:
        own = ", ".join(kind for kind in kinds if not kind.startswith("DEFAULT_"))
        raise ValueError(
            f"--vehicles {vehicles}: in {seconds:,.0f} s there was no such car, so nothing was "
            f"guarded; types are {own or 'those of SUMO alone'}"
        )
    met, guarded, guarding = guards.collisions, guards.ever, guards.guarding
    assert guarding is not None
    return {
        "configuration": str(file),
        "vehicles": vehicles,
        "mode": mode,
        "seconds": seconds,
        "guarded": len(guarded),
        "collisions": len(met),  # of all cars
        "of_guarded": sum(one.collider in guarded for one in met),  # which ran into another one
        "into_guarded": sum(one.victim in guarded and one.collider not in guarded for one in met),
        "speed": distance / drives if drives else 0.0,  # mean of the guarded cars [m/s]
        "decisions": guarding.decisions,
        "revised": guarding.revised,
        "microseconds": 1e6 * guards.seconds / max(1, guarding.decisions),  # for a decision, in all
    }


def trace_configuration(
    file: Path, out: Path, seconds: float, enough: int
) -> tuple[float, bool, dict[str, list[float]]]:
    """Run a configuration as it is, and write where its cars were as an FCD file.

    So many seconds at most, and no more once so many positions were written. Returns how long [s],
    whether it would have gone on, and when there were collisions [s], by who was behind whom.
    """
    met: dict[str, list[float]] = {}
    with _running(file, "--fcd-output", str(out)) as (sumo, steps):
        begun, written, is_cut = float(sumo.simulation.getTime()), 0, False
        now, dt = begun, float(sumo.simulation.getDeltaT())
        for now in steps:
            for each in sumo.simulation.getCollisions():
                # A step is written with the time at which it began.
                met.setdefault(f"{each.collider} behind {each.victim}", []).append(now - dt)
            written += sumo.vehicle.getIDCount()
            if is_cut := now >= begun + seconds or written >= enough:
                break
        return now - begun, is_cut, met


@contextmanager
def _running(file: Path, *options: str) -> Iterator[tuple[Any, Iterator[float]]]:
    """SUMO, and the times after each of its steps [s]."""
    if not file.is_file():
        raise FileNotFoundError(2, "no such file", str(file))
    with needs("libsumo", "sumo", "a SUMO configuration"):
        sumo: Any = import_module("libsumo")
    try:
        sumo.start(["sumo", "-c", str(file), "--no-step-log", "true", *options])
    except sumo.TraCIException as error:
        raise ValueError(f"{file}: SUMO refuses it: {str(error).strip()}") from error

    def steps() -> Iterator[float]:
        end = sumo.simulation.getEndTime()
        while not 0.0 <= end <= sumo.simulation.getTime():
            if sumo.simulation.getMinExpectedNumber() <= 0:
                return
            sumo.simulationStep()
            yield sumo.simulation.getTime()

    try:
        yield sumo, steps()
    finally:
        sumo.close()


def _facts(came: dict[str, Any]) -> Iterator[tuple[str, str]]:
    acts = came["mode"] == "act"
    yield "simulation", f"{came['configuration']}, {came['seconds']:,.0f} s"
    yield "guarded", f"{came['guarded']:,} cars ({came['vehicles']}), {came['mode']}"
    by, into = f"{came['of_guarded']:,} by guarded cars", f"{came['into_guarded']:,} by others"
    yield "collisions", f"{came['collisions']:,}: {by}, {into} into them"
    yield "mean speed", f"{came['speed']:.2f} m/s of guarded cars"
    share = came["revised"] / max(1, came["decisions"])
    what = "held back" if acts else "would have held back"
    yield "guards", f"{what} {share:.1%} of {came['decisions']:,} decisions"
    yield "overhead", f"{came['microseconds']:.0f} µs a decision"

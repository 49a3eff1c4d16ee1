"""Drive a SUMO configuration of someone else's, with guards in some of its cars."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from evofsm.cli.options import split_names
from evofsm.cli.show import print_json, progress, show, table
from evofsm.driving import attach
from evofsm.extras import needs


def run_configuration(
    file: Path, vehicles: str, mode: str, tolerance: float, *, as_json: bool
) -> None:
    """Run it to its end, or until all cars have arrived, and print `Attachment.summary` of it."""
    if mode not in ("act", "shadow"):
        raise ValueError(f"--mode is {mode!r}; for a configuration it is act or shadow")
    by_ids = not (vehicles == "all" or vehicles.startswith("type:") or vehicles.endswith("%"))
    choice = split_names(vehicles) if by_ids else vehicles

    def driven(how: str) -> dict[str, Any]:
        with progress("Driving") as move, _running(file) as (sumo, steps):
            cars = attach(sumo, choice, mode=how, tolerance=tolerance)
            for seconds in steps:
                if seconds == int(seconds):
                    collisions = f"{len(cars.collisions)} collisions"
                    move(description=f"Driving, {how} ({seconds:,.0f} s, {collisions})")
            seconds, kinds = float(sumo.simulation.getTime()), sumo.vehicletype.getIDList()
        if not cars.ever:
            types = ", ".join(kind for kind in kinds if not kind.startswith("DEFAULT_"))
            raise ValueError(
                f"--vehicles {vehicles}: in {seconds:,.0f} s there was no such car, so nothing was "
                f"guarded; types are {types or 'those of SUMO alone'}"
            )
        return {"seconds": seconds, **cars.summary()}

    alone = driven("watch") if mode == "act" else None
    outcome = driven(mode)
    if as_json:
        settings = {"configuration": str(file), "vehicles": vehicles, "mode": mode}
        print_json({**settings, **outcome, "alone": alone})
        return
    title = f"What came of {outcome['seconds']:,.0f} s"
    runs = (outcome,) if alone is None else (alone, outcome)
    rows = [(name, *map(tell, runs)) for name, tell in _TOLD.items()]
    rows = [row for row in rows if any(row[1:])]
    header = ("", "in shadow") if alone is None else ("", "alone", "guarded")
    show(table(title, header, rows))


def _share(what: str) -> Callable[[Mapping[str, Any]], str]:
    """How many of the decisions; empty where nobody decided."""
    return lambda came: f"{came[what] / came['decisions']:.1%}" if "decisions" in came else ""


# What is told of a simulation, by what it is called.
_TOLD: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "cars chosen": lambda came: f"{came['cars']:,}",
    "collisions": lambda came: f"{came['collisions']:,}",
    "  by chosen cars": lambda came: f"{came['of_guarded']:,}",
    "  into chosen cars": lambda came: f"{came['into_guarded']:,}",
    "hard brakes": lambda came: f"{came['hard_brakes']:,}",
    "mean speed [m/s]": lambda came: f"{came['speed']:.2f}",
    "time lost [s]": lambda came: f"{came['time_lost']:,.0f}",
    "RMS jerk [m/s³]": lambda came: f"{came['jerk']:.2f}",
    "decisions": lambda came: f"{came['decisions']:,}" if "decisions" in came else "",
    "  speed limited": _share("limited"),
    "  driving changed": _share("revised"),
    "  µs each": lambda came: f"{came['microseconds']:.0f}" if "decisions" in came else "",
}


def trace_configuration(
    file: Path, out: Path, seconds: float, enough: int
) -> tuple[float, bool, dict[str, list[float]]]:
    """Run a configuration as it is, and write where its cars were as an FCD file.

    So many seconds at most, and no more once so many positions were written. Returns how long [s],
    whether it would have gone on, and when there were collisions [s], by who was behind whom.
    """
    crashes: dict[str, list[float]] = {}
    with _running(file, "--fcd-output", str(out)) as (sumo, steps):
        start, n_positions, is_cut = float(sumo.simulation.getTime()), 0, False
        now, dt = start, float(sumo.simulation.getDeltaT())
        for now in steps:
            for crash in sumo.simulation.getCollisions():
                # A step is written with the time at which it began.
                crashes.setdefault(f"{crash.collider} behind {crash.victim}", []).append(now - dt)
            n_positions += sumo.vehicle.getIDCount()
            if is_cut := now >= start + seconds or n_positions >= enough:
                break
        return now - start, is_cut, crashes


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

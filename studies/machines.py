"""Machines on which nobody acts: who foresees their trips, alarms that were learnt or two thresholds?

Each writes a log as plants export them: irregular clocks, holes, standstill, a status in words.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy.signal import lfilter

Floats = NDArray[np.float64]
Random = np.random.Generator

#: A row about every so long [s].
STEP = 5.0
_HOUR, _DAY = 3600.0, 86400.0
# Shares of rows after which some are missing, and that come late.
_HOLES, _LATE = 0.0005, 0.02


class Run(NamedTuple):
    """From a start to the trip, or to a stop that was planned; T rows."""

    values: Floats  #: (T, m)
    tripped: bool


class Machine(NamedTuple):
    """A machine, and what its log calls things."""

    columns: tuple[str, ...]  #: the last one is the speed, 0 where it stands
    run: Callable[[Random, float], Run]  #: a run that begins at a time of day [s]
    limits: str  #: what it trips at


def _wander(random: Random, n: int, spread: float, seconds: float) -> Floats:
    """Noise that forgets after so long."""
    keeps = np.exp(-STEP / seconds)
    start = random.normal(0.0, spread)
    drawn = random.normal(0.0, spread * np.sqrt(1.0 - keeps**2), n)
    return np.asarray(lfilter([1.0], [1.0, -keeps], drawn, zi=[keeps * start])[0])


def _follow(target: Floats, seconds: float, first: float) -> Floats:
    """What goes to a target, as slowly as a heat store."""
    keeps = np.exp(-STEP / seconds)
    return np.asarray(lfilter([1.0 - keeps], [1.0, -keeps], target, zi=[keeps * first])[0])


def _faults(random: Random, n: int, every: float, lasts: tuple[float, float]) -> Floats:
    """0 where all is well; a fault grows to 1 and beyond, or heals before."""
    level = np.zeros(n)
    at = random.exponential(every)
    while (first := int(at / STEP)) < n:
        grows = random.uniform(*lasts)
        heals = random.random() < 0.5
        peak = random.uniform(0.3, 0.85) if heals else 1.6
        rise = np.arange(0.0, peak, STEP / grows)
        shape = np.concatenate([rise, peak * np.exp(-np.arange(0.0, 4.0, STEP / (0.3 * grows)))])
        part = shape[: n - first]
        level[first : first + len(part)] = np.maximum(level[first : first + len(part)], part)
        at += len(shape) * STEP + random.exponential(every)
    return level


def _until(values: Floats, trips: NDArray[np.bool_]) -> Run:
    """The rows until it trips."""
    if not trips.any():
        return Run(values, False)
    return Run(values[: int(trips.argmax()) + 1], True)


def _planned(random: Random) -> int:
    """Rows until a stop that is planned."""
    return int(random.uniform(4.0, 30.0) * _HOUR / STEP)


def _pump(random: Random, clock: float) -> Run:
    n = _planned(random)
    day = np.sin(2.0 * np.pi * (clock + STEP * np.arange(n)) / _DAY)
    speed = 1480.0 + _wander(random, n, 12.0, 600.0)
    vibration = random.uniform(2.4, 3.4) + _wander(random, n, 0.25, 900.0)
    vibration += 4.4 * _faults(random, n, 30.0 * _HOUR, (900.0, 7200.0))
    bearing = 62.0 + 4.0 * day + random.normal(0.0, 2.0) + _wander(random, n, 1.5, 1800.0)
    bearing = bearing + 34.0 * _faults(random, n, 50.0 * _HOUR, (1200.0, 7200.0))
    bearing = _follow(bearing, 300.0, 40.0)
    shown = vibration + random.normal(0.0, 0.08, n), bearing + random.normal(0.0, 0.2, n)
    return _until(np.column_stack([*shown, speed]), (shown[0] > 7.1) | (shown[1] > 95.0))


def _compressor(random: Random, clock: float) -> Run:
    """At a high pressure it needs more flow: below the surge line it trips."""
    n = _planned(random)
    load = np.clip(0.7 + _wander(random, n, 0.22, 2.0 * _HOUR), 0.35, 1.0)
    fault = _faults(random, n, 14.0 * _HOUR, (900.0, 5400.0))
    pressure = 3.0 + 7.0 * load + _wander(random, n, 0.15, 300.0) + 0.9 * fault
    flow = 2.2 + 10.0 * load + _wander(random, n, 0.25, 300.0) - 1.6 * fault
    speed = 6000.0 + 5000.0 * load + _wander(random, n, 30.0, 120.0)
    shown = pressure + random.normal(0.0, 0.03, n), flow + random.normal(0.0, 0.06, n)
    surge = shown[1] < -3.9 + 10.0 / 7.0 * shown[0]
    return _until(np.column_stack([*shown, speed]), surge)


def _conveyor(random: Random, clock: float) -> Run:
    """Its motor grows hot long after the current rose."""
    n = _planned(random)
    day = np.sin(2.0 * np.pi * (clock + STEP * np.arange(n)) / _DAY)
    jam = _faults(random, n, 18.0 * _HOUR, (1200.0, 5400.0))
    speed = 1.6 + _wander(random, n, 0.02, 300.0)
    load = np.clip(0.62 + _wander(random, n, 0.14, 1500.0), 0.2, 1.0)
    current = 60.0 + 70.0 * load + 55.0 * jam + random.normal(0.0, 1.5, n)
    heat = 26.0 + 5.0 * day + 85.0 * (current / 130.0) ** 2
    motor = _follow(heat, 2400.0, 30.0) + random.normal(0.0, 0.3, n)
    return _until(np.column_stack([current, motor, speed]), motor > 130.0)


def _mill(random: Random, clock: float) -> Run:
    """A stone comes without a word."""
    n = _planned(random)
    power = 310.0 + _wander(random, n, 25.0, 1200.0)
    bearing = _follow(40.0 + 0.08 * power, 1800.0, 40.0) + random.normal(0.0, 0.3, n)
    speed = 15.0 + _wander(random, n, 0.2, 300.0)
    trips = random.random(n) < STEP / (32.0 * _HOUR)
    return _until(np.column_stack([power, bearing, speed]), trips)


MACHINES = {
    "pump": Machine(
        ("Schwingung, mm/s", "Lagertemperatur °C", "Drehzahl"),
        _pump,
        "vibration above 7.1 or bearing above 95",
    ),
    "compressor": Machine(
        ("Druck bar", "Durchfluss kg/s", "Drehzahl"),
        _compressor,
        "flow below the surge line, which rises with the pressure",
    ),
    "conveyor": Machine(
        ("Motorstrom A", "Motortemperatur °C", "Bandgeschwindigkeit"),
        _conveyor,
        "motor above 130 °C, which follows the current by 40 min",
    ),
    "mill": Machine(
        ("Leistung kW", "Lagertemperatur °C", "Drehzahl"),
        _mill,
        "nothing that is measured",
    ),
}


def log_of(name: str, days: float, seed: int) -> pl.DataFrame:
    """A log: ``Zeit``, what is measured, and ``Status``, in words."""
    machine, random = MACHINES[name], np.random.default_rng([seed, list(MACHINES).index(name)])
    parts: list[pl.DataFrame] = []
    clock, n = 6.0 * _HOUR, 0
    while n * STEP < days * _DAY:
        run = machine.run(random, clock)
        rests = int(random.uniform(0.3, 3.0) * _HOUR / STEP)
        last = run.values[-1]
        away = np.exp(-np.arange(rests) * STEP / 1800.0)[:, None]
        still = last * away + random.normal(0.0, 0.01, (rests, 1))
        still[:, -1] = 0.0
        told = int(min(rests, random.uniform(0.1, 0.5) * _HOUR / STEP)) if run.tripped else 0
        status = ["Betrieb"] * (len(run.values) - run.tripped)
        status += ["Störung"] * (told + run.tripped) + ["Stillstand"] * (rests - told)
        rows = np.vstack([run.values, still])
        parts.append(
            pl.DataFrame(rows, schema=list(machine.columns)).with_columns(Status=pl.Series(status))
        )
        n += len(rows)
        clock += len(rows) * STEP
    frame = pl.concat(parts)
    times = STEP * np.arange(n) + random.uniform(-1.0, 1.0, n)
    times += np.where(random.random(n) < _LATE, random.uniform(0.0, 3.0, n), 0.0)
    kept = np.ones(n, np.bool_)
    for at in np.flatnonzero(random.random(n) < _HOLES).tolist():
        kept[at : at + 1 + int(random.exponential(12.0))] = False
    first = datetime(2025, 3, 10, 6)
    stamp = pl.Series("Zeit", np.round(times * 1e3).astype(np.int64)).cast(pl.Duration("ms"))
    return frame.select(first + stamp, *frame.columns).filter(kept).head(int(days * _DAY / STEP))


def export(frame: pl.DataFrame, path: Path) -> None:
    """Write a log as a German plant does: semicolons, decimal commas, Windows-1252."""
    numbers = [name for name, kind in frame.schema.items() if kind == pl.Float64]
    text = frame.select(
        pl.col("Zeit").dt.strftime("%d.%m.%Y %H:%M:%S"),
        *(pl.col(name).round(3).cast(pl.String).str.replace(".", ",", literal=True) for name in numbers),
        "Status",
    ).write_csv(separator=";")
    path.write_bytes(text.encode("cp1252"))

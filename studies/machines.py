"""Alarms where nobody acts, beside plain thresholds.

A row for each machine, seed, rate of false alarms that was stated, and alarm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import chain, product
from typing import Annotated, Any, NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy.signal import lfilter
from typer import Option

from evofsm.fsm import EvolvingFSM, Novelty
from evofsm.guard import Foresight
from evofsm.paper import Page, Table
from studies import lib

Floats = NDArray[np.float64]
Random = np.random.Generator

#: A row every so long, and how long before a failure an alarm is right [s].
STEP, HORIZON = 30.0, 1800.0
OURS, THRESHOLDS, STATES = "learnt", "thresholds", "states alone"
# The share of a log that is learnt from.
_LEARNT = 0.6
_HOUR, _DAY = 3600.0, 86400.0
# States, and how far apart they lie [standard deviations].
_MOST_STATES, _APART = 250, 1.0


class Run(NamedTuple):
    """From a start to the trip, or to a stop that was planned; T rows."""

    values: Floats  #: (T, m)
    tripped: bool


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
    """Vibration [mm/s], bearing [°C] and speed; it trips above 7.1 or 95."""
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
    """Pressure, flow and speed; below the surge line, which rises with the pressure, it trips."""
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
    """Current, motor and speed; it trips above 130 °C, which follow the current by 40 min."""
    n = _planned(random)
    day = np.sin(2.0 * np.pi * (clock + STEP * np.arange(n)) / _DAY)
    jam = _faults(random, n, 18.0 * _HOUR, (1200.0, 5400.0))
    speed = 1.6 + _wander(random, n, 0.02, 300.0)
    load = np.clip(0.62 + _wander(random, n, 0.14, 1500.0), 0.2, 1.0)
    current = 60.0 + 70.0 * load + 55.0 * jam + random.normal(0.0, 1.5, n)
    heat = 26.0 + 5.0 * day + 85.0 * (current / 130.0) ** 2
    motor = _follow(heat, 2400.0, 30.0) + random.normal(0.0, 0.3, n)
    return _until(np.column_stack([current, motor, speed]), motor > 130.0)


def _turbine(random: Random, clock: float) -> Run:
    """Steam [°C], casing and load; it trips where the casing, which lags, is 50 K colder."""
    n = _planned(random)
    load = np.clip(0.6 + _wander(random, n, 0.2, 2.0 * _HOUR), 0.2, 1.0)
    fault = _faults(random, n, 16.0 * _HOUR, (900.0, 5400.0))
    steam = 380.0 + 130.0 * load + 80.0 * fault + _wander(random, n, 2.0, 300.0)
    casing = _follow(steam, 1800.0, steam[0]) + random.normal(0.0, 0.5, n)
    steam = steam + random.normal(0.0, 0.5, n)
    return _until(np.column_stack([steam, casing, load]), steam - casing > 50.0)


def _mill(random: Random, clock: float) -> Run:
    """Power, bearing and speed; a stone trips it without a word."""
    n = _planned(random)
    power = 310.0 + _wander(random, n, 25.0, 1200.0)
    bearing = _follow(40.0 + 0.08 * power, 1800.0, 40.0) + random.normal(0.0, 0.3, n)
    speed = 15.0 + _wander(random, n, 0.2, 300.0)
    trips = random.random(n) < STEP / (32.0 * _HOUR)
    return _until(np.column_stack([power, bearing, speed]), trips)


#: By name: a run that begins at a time of day [s].
MACHINES: dict[str, Callable[[Random, float], Run]] = {
    "pump": _pump,
    "compressor": _compressor,
    "conveyor": _conveyor,
    "mill": _mill,
    "turbine": _turbine,
}


def log_of(name: str, days: float, seed: int) -> list[Run]:
    """The runs of so many days; between them it stands for a while."""
    random = np.random.default_rng([seed, list(MACHINES).index(name)])
    runs, clock = list[Run](), 6.0 * _HOUR
    while clock < days * _DAY:
        runs.append(MACHINES[name](random, clock))
        clock += len(runs[-1].values) * STEP + random.uniform(0.3, 3.0) * _HOUR
    return runs


@dataclass(frozen=True, kw_only=True)
class Machines(lib.Study):
    """Alarms on five machines, beside plain thresholds that the same search found."""

    name = "machines"
    days: Annotated[float, Option(min=20.0, help="Days of each log.")] = 120.0
    seeds: int = 5

    def shortened(self) -> Machines:
        """One short log of each machine."""
        return self.smaller(days=40.0, seeds=1)

    def run(self, workers: int | None = None) -> dict[str, pl.DataFrame]:
        """Learn from the first part of each log, and judge the rest."""
        tasks = [
            partial(judged, name, self.days, self.seed + seed)
            for name, seed in product(MACHINES, range(self.seeds))
        ]
        return {"rows": lib.frame_of(chain(*lib.parallel(tasks, workers, "Learning alarms")))}

    def page(self, found: lib.Frames) -> Page:
        """Rows pooled over the seeds."""
        pooled = pooled_over_seeds(found["rows"])
        both = lib.compared(pooled, pl.col("alarm") == OURS, ["machine", "stated"])
        fewer = pl.col("ours_at_same") < pl.col("lead") - 0.5
        exceeding = pooled.filter(pl.col("rate") > pl.col("stated"), alarm=OURS)
        rivals = both.filter(pl.col("alarm") == THRESHOLDS)
        shown = {
            **{"machine": "{machine}", "stated": "{stated:g}", "foreseen": "{foreseen:%}"},
            **{"alarm": "{alarm}", "ahead [min]": "{lead:.1f}", "false a day": "{rate:.2f}"},
        }
        compared = {
            **{"machine": "{machine}", "stated": "{stated:g}", "false a day": "{rate:.2f}"},
            **{"thresholds foresee": "{foreseen:%}", "ahead [min]": "{lead:.1f}"},
            **{"learnt foresee": "{foreseen_ours:%}", "learnt ahead": "{lead_ours:.1f}"},
            **{"learnt false": "{rate_ours:.2f}", "at as many": "{ours_at_same:.1f}"},
        }
        worst = (pl.col("ours_at_same") - pl.col("lead")).min()
        return self.shown(
            _ABOUT,
            [
                Table("At the rates that were stated", rivals, compared, _AT_AS_MANY),
                Table("The states of an e-FSM alone", pooled.filter(alarm=STATES), shown),
            ],
            targets=[
                lib.at_least(f"{name}: minutes beyond thresholds", minutes, -0.5, "{:.1f}")
                for name in MACHINES
                for minutes in rivals.filter(machine=name).select(worst).to_series()
            ],
            lost=[
                Table("Rows in which thresholds warn longer", rivals.filter(fewer), compared),
                Table(
                    "Rows in which the states alone warn longer, with as many false alarms",
                    both.filter(pl.col("alarm") == STATES).filter(fewer),
                    shown | {"learnt, at as many": "{ours_at_same:.1f}"},
                ),
                Table("Rows in which the learnt alarm exceeds what was stated", exceeding, shown),
            ],
        )


_ABOUT = """Does an alarm that was learnt foresee more than plain thresholds?

Nobody acts. The first 60 % of each log are learnt from, the rest is judged. Both are searched for
in the same way, for a rate of false alarms that is stated: thresholds, of which any may be passed,
or also of what is to come at the present rate, and of the forms of failure. An alarm is right if a
failure comes within 30 min after it began; ahead counts from the first, 0 if there is none."""
_AT_AS_MANY = """At as many: how far ahead the learnt alarm is with as many false alarms a day as
thresholds really had, between the rates that were stated."""


def pooled_over_seeds(rows: pl.DataFrame) -> pl.DataFrame:
    """Sums over seeds, and how far ahead ours is with the false alarms of each row."""
    sums = rows.group_by("machine", "alarm", "stated", maintain_order=True).agg(
        pl.col("failures", "seen", "false", "days").sum(), warned=pl.col("warned").sum()
    )
    many = pl.max_horizontal("failures", 1)
    pooled = sums.with_columns(
        foreseen=pl.col("seen") / many,
        lead=pl.col("warned") / many / 60.0,
        rate=pl.col("false") / pl.col("days"),
    )
    found = []
    for row in pooled.to_dicts():
        mine = pooled.filter(machine=row["machine"], alarm=OURS).sort("rate")
        at = [0.0, *mine["rate"]], [0.0, *mine["lead"].cum_max()]
        found.append(float(np.interp(row["rate"], *at)))
    return pooled.with_columns(ours_at_same=pl.Series(found))


def judged(name: str, days: float, seed: int) -> list[dict[str, Any]]:
    """What came of all alarms in the later part of a log."""
    runs = log_of(name, days, seed)
    rows = np.cumsum([len(run.values) for run in runs])
    first = int((rows <= _LEARNT * rows[-1]).sum())
    values, failed = [run.values for run in runs], [run.tripped for run in runs]
    given: dict[str, Any] = {"dt": STEP, "horizon": HORIZON}
    known = Foresight.learn_log(values[:first], failed[:first], **given)
    then = Foresight.runs(values[first:], failed[first:])
    risks = risks_of(values, failed, first)
    counted = Foresight.learn_log(risks[:first], failed[:first], **given)
    alarms = {
        OURS: (known, then, None),
        THRESHOLDS: (known, then, True),
        STATES: (counted, Foresight.runs(risks[first:], failed[first:]), True),
    }
    told = []
    for alarm, (judge, log, plain) in alarms.items():
        for rate, stated in enumerate(Foresight.rates):
            found, _ = judge.tally(log, rate, plain=plain)
            who = {"machine": name, "seed": seed, "alarm": alarm, "stated": stated}
            came = {"failures": found.failures, "seen": found.foreseen, "false": found.false}
            warned = {"warned": found.lead * found.failures, "days": found.days}
            told.append({**who, **came, **warned, "limits": judge.words(rate, plain=plain)})
    return told


def risks_of(values: list[Floats], failed: list[bool], first: int) -> list[Floats]:
    """Of each row the share of episodes that failed soon after they came to its state."""
    log = Foresight.runs(values[:first], failed[:first])
    scales = _APART * log.rows.std(0)
    machine = EvolvingFSM(
        1,
        rule=Novelty(scales=scales.tolist()),
        max_states=_MOST_STATES,
        failure_horizon=round(HORIZON / STEP),
    )
    none = np.zeros(len(log.rows), np.int64)
    machine.learn_many(log.rows, none, log.starts, log.last[log.failed])
    model = machine.model()
    share = model.failed_soon / (model.episodes + 2.0)
    centers = model.centers / scales
    away = (((run / scales)[:, None] - centers) ** 2 for run in values)
    return [share[one.sum(2).argmin(1)] for one in away]

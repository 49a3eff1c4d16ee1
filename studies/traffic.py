"""Does a filter do harm in calm traffic, and what does it prevent in risky traffic? In SUMO.

Frame ``rows``: one simulation. ``collisions`` are those of all cars, ``of_guarded`` those in which
a chosen one ran into another; ``emergencies`` are emergency brakings that SUMO warns of; ``hard``
brakes are harder than 5 m/s², ``lost`` is the share of the time that is lost against a free road.
Frame ``curve``: the same by the time in which a safe gap is to be regained. Frame ``cut_in``:
held-out episodes of the family by the same.
"""

from __future__ import annotations

import importlib.util
import math
import os
import runpy
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy.stats import chi2
from typer import Option

from evofsm.driving import (
    EnvelopeReviser,
    attach,
    guard_for_family,
    held_out,
    load_family,
    measures,
    summarise,
    teach,
    training,
    try_out,
)
from evofsm.fsm import IntervalActions
from evofsm.guard import Guard
from evofsm.paper import Page, Table
from studies import lib
from studies.lib import Frames, Study, at_least, at_most, frame_of

ALONE, OURS = "alone", "evofsm"
#: They brake in full where they call for it; all cars are guarded by them.
FORMULAS = ("rss-r157", "aeb-ttc")
#: How many cars are guarded by ours.
SHARES = ("all", "10%")
#: Demos of SUMO; the wheel ``eclipse-sumo`` has them, ``libsumo`` has not.
DEMOS = ("A10KW", "ramp", "grid6", "cross", "square")
#: Networks of ours: three lanes become two; a limit falls from 25 to 8 m/s; a grid of streets.
OWN = ("drop", "road", "grid")
#: Who drives: as SUMO does by default; one of five, in the grid of ten, hasty; or hasty and late.
DRIVERS = ("default", "hasty", "late")
_HASTY = 'tau="0.2" minGap="0.5" accel="3.5" speedFactor="1.3"'
_LATE = ' actionStepLength="1.0"'
_ABOUT = """Does a filter do harm in calm traffic, and what does it prevent in risky traffic?

SUMO drives: calm traffic on its own demos and on roads of ours, and risky traffic, in which some
drivers are hasty and keep a fifth of a second. Late ones decide once a second only, as long as no
guard limits them: under a limit SUMO's own model decides at each step, so that a late driver reacts
at once, which helps every filter. All is told beside the same simulation without guards."""
_SKIPPED = (
    "SUMO's demos were not found, and are left out: pip install eclipse-sumo, or set SUMO_HOME."
)
_GRID = Path(__file__).parents[1] / "examples" / "your-own-sumo" / "make.py"
# The hardest braking and acceleration that a formula's guard may command [m/s²]: SUMO's usual ones.
_LOW, _HIGH, _WIDTH = -9.0, 2.6, 0.3


# -- Simulations ----------------------------------------------------------------------------------


def demos() -> Path | None:
    """The folder of SUMO's demos; None where there is none."""
    wheel = importlib.util.find_spec("sumo")
    homes = [os.environ.get("SUMO_HOME", ""), *((wheel and wheel.submodule_search_locations) or ())]
    folders = [Path(home) / "tools" / "game" for home in homes]
    return next((each for each in folders if each.is_dir()), None)


# Two roads, one after the other; of the first one as many lanes as are too many end.
_NET = """<net version="1.20"><location netOffset="0,0" convBoundary="0,-10,{end},0"
origBoundary="0,-10,{end},0" projParameter="!"/>
<edge id="f" from="a" to="b" priority="1">{first}</edge>
<edge id="s" from="b" to="c" priority="1">{second}</edge>
<junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,-9"/>
<junction id="b" type="priority" x="{middle}" y="0" incLanes="{into}" intLanes=""
shape="{middle},0 {middle},-9">{requests}</junction>
<junction id="c" type="dead_end" x="{end}" y="0" incLanes="{out}" intLanes=""
shape="{end},0 {end},-9"/>{ways}</net>"""
_LANE = (
    '<lane id="{id}_{k}" index="{k}" speed="{limit}" length="{metres}" shape="{x},{y} {to},{y}"/>'
)
_WAY = '<connection from="f" to="s" fromLane="{lane}" toLane="{k}" dir="s" state="M"/>'
_REQUEST = '<request index="{k}" response="{none}" foes="{none}" cont="0"/>'


def _net(limits: tuple[int, int], lanes: tuple[int, int], metres: int) -> str:
    """Their limits [m/s], lanes, and the length of each [m]."""
    edges, ids = [], []
    for name, x, limit, n in zip("fs", (0, metres), limits, lanes, strict=True):
        of = {"id": name, "limit": limit, "metres": metres, "x": x, "to": x + metres}
        edges.append("".join(_LANE.format(k=k, y=3 * (k - n), **of) for k in range(n)))
        ids.append(" ".join(f"{name}_{k}" for k in range(n)))
    gone, stay = lanes[0] - lanes[1], range(lanes[1])
    ways = "".join(_WAY.format(k=k, lane=k + gone) for k in stay)
    requests = "".join(_REQUEST.format(k=k, none="0" * lanes[1]) for k in stay)
    told = {"middle": metres, "end": 2 * metres, "ways": ways, "requests": requests}
    return _NET.format(first=edges[0], second=edges[1], into=ids[0], out=ids[1], **told)


# By network: limits, lanes, length, time between two cars and how long they come [s].
_ROADS = {"drop": ((30, 30), (3, 2), 1000, 0.9, 170), "road": ((25, 8), (1, 1), 1500, 3.0, 120)}
_CARS = """<routes><vTypeDistribution id="mix"><vType id="calm" probability="{calm}"/>
<vType id="hasty" probability="{hasty}" {kind}/></vTypeDistribution>
<flow id="car" type="mix" from="f" to="s" begin="0" end="{end}" period="{period}"
departLane="best" departSpeed="max"/></routes>"""


def write_simulation(world: str, drivers: str, seed: int, folder: Path, step: float) -> list[str]:
    """Write, or copy, its files; what SUMO is started with. Without a step it is the usual one."""
    kind = {"default": "", "hasty": _HASTY, "late": _HASTY + _LATE}[drivers]
    usual = ["--step-length", f"{step or 0.1}", "--collision.action", "warn"]
    if world in _ROADS:
        limits, lanes, metres, period, end = _ROADS[world]
        (folder / "road.net.xml").write_text(_net(limits, lanes, metres))
        hasty = 0.2 if kind else 0.0
        cars = _CARS.format(calm=1.0 - hasty, hasty=hasty, kind=kind, end=end, period=period)
        (folder / "cars.rou.xml").write_text(cars)
        return ["-n", f"{folder}/road.net.xml", "-r", f"{folder}/cars.rou.xml", *usual]
    if world == "grid":
        file = runpy.run_path(str(_GRID))["write_cars"](folder, seed)
        cars = (folder / "grid.rou.xml").read_text()
        cars = cars.replace(' actionStepLength="1.0"', _LATE if drivers == "late" else "")
        cars = cars if kind else cars.replace('type="hasty"', 'type="normal"')
        (folder / "grid.rou.xml").write_text(cars)
        return ["-c", str(file), *usual[: 2 * bool(step)]]
    game = demos()
    assert game is not None
    shutil.copytree(game / world, folder / world)
    for name in (f"{world}.sumocfg", "input_additional.add.xml"):
        shutil.copy(game / name, folder)  # what it writes is not written there
    return ["-c", f"{folder}/{world}.sumocfg", *usual[: 2 * bool(step)]]


def simulate(
    world: str,
    drivers: str,
    policy: str,
    seed: int,
    share: str = "all",
    seconds: float = 180.0,
    step: float = 0.0,
    **settings: Any,
) -> dict[str, Any]:
    """The row of one simulation, of which a share of the cars is looked at, or guarded.

    ``settings`` are those of `attach`.
    """
    import libsumo

    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "sumo.log"
        started = write_simulation(world, drivers, seed, Path(folder), step)
        quiet = ["--no-step-log", "true", "--no-warnings", "false", "--verbose", "false"]
        quiet += ["--duration-log.statistics", "false", "--seed", str(seed)]
        with _stderr_to(log):
            libsumo.start(["sumo", *started, *quiet])
            everyone = attach(libsumo, "all", mode="watch")
            mode = "watch" if policy == ALONE else "act"
            given = {**settings, "guard": _formula(policy, libsumo.simulation.getDeltaT())}
            chosen = attach(libsumo, share, mode=mode, **given)
            clock = libsumo.simulation
            until = clock.getTime() + seconds
            while clock.getTime() < until and clock.getMinExpectedNumber():
                libsumo.simulationStep()
            everyone.detach()  # else they go on in the next simulation
            chosen.detach()
            libsumo.close()
        emergencies = log.read_text().count("performs emergency braking")
    told, of_chosen = everyone.summary(), chosen.summary()
    asked = ("of_guarded", "into_guarded", "decisions", "limited", "revised")
    return {
        **{"world": world, "drivers": drivers, "policy": policy, "seed": seed, **settings},
        **{name: told[name] for name in ("cars", "collisions", "speed", "jerk")},
        "seconds": told["car_seconds"],
        "kilometres": told["speed"] * told["car_seconds"] / 1000.0,
        "hard": told["hard_brakes"],
        "lost": told["time_lost"] / told["car_seconds"],
        "emergencies": emergencies,
        "share": share,
        **{name: of_chosen.get(name) for name in asked},
    }


@contextmanager
def _stderr_to(file: Path) -> Iterator[None]:
    """What SUMO warns of, which it writes by itself."""
    before = os.dup(2)
    with file.open("wb") as taken:
        os.dup2(taken.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)


def _formula(policy: str, interval: float) -> Guard | None:
    """A guard that brakes in full where a formula calls for it; None if it is ours."""
    if policy in (ALONE, OURS):
        return None
    actions = IntervalActions(_LOW, _HIGH, _WIDTH, outside="clip")
    reviser = EnvelopeReviser(measures.FIXED_MEASURES[policy], actions, interval)
    return Guard.of(reviser, interval=interval, learn=False)


def cut_in(regain: float, seed: int, train: int, test: int) -> dict[str, Any]:
    """Held-out episodes of the family under what was learnt with a time to regain a safe gap."""
    family = load_family("cut_in")
    guard = guard_for_family(family)
    guard.reviser.risk.regain = regain  # type: ignore[attr-defined]
    teach(guard, training(family, seed=0, learning_seed=seed, episodes=train))
    guard.freeze()
    outcomes = try_out(guard, family, held_out(family, seed=0, episodes=test))
    row = summarise(family.name, OURS, outcomes, family.interval)
    told = {name: getattr(row, name) for name in ("episodes", "collisions", "mobility", "jerk")}
    return {"regain": regain, "seed": seed, **told}


# -- The study ------------------------------------------------------------------------------------

_KEY = ("world", "drivers", "share", "seed")
# Where the curve is measured: harm where drivers are calm, risk where they are late.
_HARM, _RISK = ("ramp", "drop"), ("road", "grid")


@dataclass(frozen=True, kw_only=True)
class Traffic(Study):
    """Guards in SUMO's traffic: harm where nothing is wrong, collisions where drivers are hasty."""

    name: ClassVar[str] = "traffic"
    needed: ClassVar = {"libsumo": "sumo"}

    seeds: Annotated[int, Option(min=1, help="Simulations of each kind.")] = 3
    worlds: Annotated[str, Option(help="Networks: drop, road, grid, and demos of SUMO.")] = (
        ",".join((*DEMOS, *OWN))
    )
    step: Annotated[float, Option(min=0.0, help="Of SUMO [s]; 0: as each world has it.")] = 0.0
    seconds: tuple[float, float] = (180.0, 450.0)  # of calm and of risky traffic [s]
    regains: tuple[float, ...] = (1.0, 2.0, 3.0, 5.0)
    episodes: tuple[int, int] = (60, 200)  # of cut_in: to learn from, and held out

    def shortened(self) -> Self:
        """One simulation of each kind, on two roads."""
        few: dict[str, Any] = {"regains": (2.0,), "seconds": (30.0, 70.0), "episodes": (10, 20)}
        return replace(self, seeds=1, worlds="drop,road", **few)

    def run(self, workers: int | None = None) -> dict[str, pl.DataFrame]:
        """Simulate all, then learn and drive the family."""
        there, game, (calm, risky) = lib.names_in(self.worlds), demos(), self.seconds
        for each in there:
            if each not in OWN and not (game and (game / f"{each}.sumocfg").exists()):
                fault = f"there is no network {each}; there are {', '.join(OWN)}"
                raise ValueError(f"{fault}, and demos, where SUMO is: pip install eclipse-sumo")
        kinds = [(world, DRIVERS[0], calm) for world in there]
        kinds += [(world, each, risky) for world in there if world in OWN for each in DRIVERS[1:]]
        tasks, curve = [], []
        for k, (world, drivers, seconds) in product(range(self.seeds), kinds):
            how: dict[str, Any] = {"seconds": seconds, "step": self.step}
            one = partial(simulate, world, drivers, seed=self.seed + k, **how)
            # As many look at it alone as guarded: in `ramp`, who merges first hangs on that.
            for policy, share in product((ALONE, OURS), SHARES):
                tasks.append(partial(one, policy, share=share))
            tasks += [partial(one, formula) for formula in FORMULAS]
            if k == 0 and world in {DRIVERS[0]: _HARM, DRIVERS[2]: _RISK}.get(drivers, ()):
                curve += [partial(one, OURS, regain=regain) for regain in self.regains]
        found = lib.parallel([*tasks, *curve], workers, "Simulating")
        families = [
            partial(cut_in, regain, self.seed + k, *self.episodes)
            for regain, k in product(self.regains, range(self.seeds))
        ]
        rows, points = frame_of(found[: len(tasks)]), frame_of(found[len(tasks) :])
        driven = frame_of(lib.parallel(families, workers, "Learning"))
        return {"rows": rows, "curve": points, "cut_in": driven}

    def page(self, found: Frames) -> Page:
        """What it costs, what it prevents, and what the default was chosen from."""
        all_of_it = beside_alone(found["rows"], found["rows"])
        calm, risky = (all_of_it.filter(is_calm) for is_calm in (_CALM, ~_CALM))
        curve = beside_alone(found["curve"], found["rows"], ("regain",))
        ours = pl.col("policy") == OURS
        mark = pl.when(ours).then(pl.lit("ours"))
        driven = (
            found["cut_in"]
            .group_by("regain", maintain_order=True)
            .agg(pl.col("episodes", "collisions").sum(), pl.col("mobility", "jerk").mean())
        )
        harm: Any = calm.filter(ours).select(pl.col("more").max(), pl.col("speed").min()).row(0)
        late: Any = risky.filter(ours & (pl.col("share") == "all"))["collisions"].sum()
        pairs = lib.compared(risky, ours, ["world", "drivers", "share"])
        fewer = pairs.filter(pl.col("collisions") < pl.col("collisions_ours"))
        return self.shown(
            _ABOUT if demos() else f"{_ABOUT}\n\n{_SKIPPED}",
            [
                Table("Calm traffic", calm, _COLUMNS, mark=mark),
                Table("Hasty drivers", risky, _COLUMNS, mark=mark),
                Table("By what is to be regained", curve, _CURVE_COLUMNS),
                Table("cut_in, held out", lib.with_share(driven, *_RATE), _CUT_IN_COLUMNS),
            ],
            targets=[
                at_most("emergency brakings more than alone in calm traffic", harm[0], 2),
                at_least("mean speed against alone in calm traffic", harm[1], 0.995, "{:.3f}"),
                at_most("collisions of hasty drivers, all guarded", late, 0),
            ],
            lost=[Table("Fewer collisions under a formula", fewer, _COLUMNS)],
            packages=("libsumo",),
        )


_CALM = pl.col("drivers") == DRIVERS[0]
_COLUMNS = {
    "network, drivers": "{world}, {drivers}",
    "guarded": "{share}",
    "by": "{policy}",
    "collisions (at most expected)": "{collisions} ({bound:.1f})",
    "alone": "{collisions_alone}",
    "by guarded (alone)": "{of_guarded} ({of_guarded_alone})",
    "emergency brakings": "{emergencies}",
    "more, worst seed": "{more}",
    "hard per 1,000 km": "{hard:.1f}",
    "alone ": "{hard_alone:.1f}",
    "speed against alone (95 %)": "{speed:.3f} ({speed_low:.3f}–{speed_high:.3f})",
    "more time lost": "{lost:%}",
    "RMS jerk": "{jerk:.2f}",
    "limited": "{limited:%}",
    "changed": "{revised:%}",
}
_CURVE_COLUMNS = {
    "regain [s]": "{regain:g}",
    **{name: text for name, text in _COLUMNS.items() if name not in ("guarded", "by")},
}
_RATE = "collisions", "episodes", "rate"
_CUT_IN_COLUMNS = {
    "regain [s]": "{regain:g}",
    "collisions (95 %)": "{collisions} of {episodes} ({rate_low:%}–{rate_high:%})",
    "mobility": "{mobility:.3f}",
    "RMS jerk": "{jerk:.2f}",
}


def _mean(values: NDArray[np.float64], chosen: NDArray[np.intp]) -> float:
    return float(values[chosen].mean())


def beside_alone(rows: pl.DataFrame, alone: pl.DataFrame, by: Sequence[str] = ()) -> pl.DataFrame:
    """Sums over the seeds of each kind of simulation beside those without guards.

    ``more`` are emergency brakings more than alone, in the worst seed; ``bound`` is how many
    collisions are to be expected at most in as many simulations (Poisson, 95 %, two-sided).
    """
    is_alone, found = pl.col("policy") == ALONE, []
    both = rows.filter(~is_alone).join(alone.filter(is_alone), on=list(_KEY), suffix="_alone")
    names = (*_KEY[:3], "policy", *by)
    for key, each in both.group_by(*names, maintain_order=True):
        ratio = (each["speed"] / each["speed_alone"]).to_numpy()
        low, high = lib.bootstrap(partial(_mean, ratio), len(ratio))
        of: dict[str, Any] = each.sum().row(0, named=True)
        squares: Any = (each["jerk"] ** 2).mean()
        found.append(
            of
            | dict(zip(names, key, strict=True))
            | {"bound": float(chi2.ppf(0.975, 2 * of["collisions"] + 2)) / 2.0}
            | {"more": (each["emergencies"] - each["emergencies_alone"]).max()}
            | {"hard": 1000.0 * of["hard"] / of["kilometres"]}
            | {"hard_alone": 1000.0 * of["hard_alone"] / of["kilometres_alone"]}
            | {"speed": float(ratio.mean()), "speed_low": low, "speed_high": high}
            | {"lost": (of["lost"] - of["lost_alone"]) / len(each), "jerk": math.sqrt(squares)}
            | {name: (of[name] or 0) / (of["decisions"] or 1) for name in ("limited", "revised")}
        )
    return frame_of(found)

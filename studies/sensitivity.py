"""Whether the paper's claims depend on the settings that it leaves open.

A setting drives the paper's 80 runs in the closed-form world and is judged by the checks of
`evofsm paper`. Sweeps move one parameter away from the recovered setting, edges look for the value
at which the first claim breaks. Latin hypercubes (M. McKay, R. Beckman, W. Conover, 1979) fill all
that the paper leaves open, everything, and the surroundings of the recovered setting.

Frame ``rows``: one setting; ``design`` says why it was tried, ``varied`` which parameter was moved
where it was one alone. Then what was varied, the verdict on each claim, ``n_states`` at the end,
``held``, how many claims hold, and ``holds``, whether all do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache, partial
from itertools import permutations
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy.stats import qmc
from typer import Option

from evofsm.driving import Episode, KinematicWorld, Scenario
from evofsm.paper import Page, Settings, Table, check_claims, run_paper
from studies import lib
from studies.lib import Frames, Study, Target, at_least

#: The claims in a few words; `evofsm.paper` has them in full.
CLAIMS = {
    "collisions_by_case": "collisions by case",
    "brake_at_11": "leader brakes at 11 s",
    "brake_at_15": "leader brakes at 15 s",
    "states_after_each_run": "no state is created after run 4",
    "states_final": "7 states",
    "dead_end_state": "one and the same state at all collisions",
    "dead_end_share": "all collisions in the dead end",
    "case3_leaves_dead_end": "case 3 leaves the dead end",
    "case4_enters_dead_end": "case 4 comes to the dead end",
    "jsd_max_by_case": "divergence below 0.15",
}
_ALL_OF_THEM = {**CLAIMS, "holds": "all of them"}

# -- What is varied -------------------------------------------------------------------------------

#: Standard deviations over the paper's 80 runs, rounded: gap [m], both speeds [m/s].
SCALES = (17.0, 7.5, 7.5)
#: Noise of the speeds [m/s] for each metre of noise of the gap, as in the families' switch.
SPEED_NOISE = 0.6
# A setting takes eight different runs; two settings that differ in the machine share them.
_EPISODES = 16
RAW, STANDARDISED = "raw", "standardised"


@dataclass(frozen=True, kw_only=True)
class Setting:
    """All that is varied; named as in the paper study's ``settings.toml`` where it stands there."""

    brake_speed: float  #: v_p^max, at which the leader begins its full brake [m/s]
    brake_decel: float  #: leader's full brake [m/s²], positive
    initial_gap: float  #: bumper to bumper [m]
    bound: float  #: hardest braking of the follower [m/s²], positive
    spread: float
    learning_rate: float
    prior_frequency: float
    radius: float  #: in the unit of what is observed
    distance_weight: float
    order: str = "1234"  #: of the cases in each round
    scaling: str = RAW  #: standardised: divided by `SCALES`, the radius keeps its number
    noise: float = 0.0  #: standard deviation of the gap [m]; speeds have `SPEED_NOISE` of it [m/s]
    noise_seed: int = 0

    def paper_settings(self) -> Settings:
        """The paper's settings with these in their place."""
        limits = {"lowest": -self.bound}
        machine = ("radius", "distance_weight", "learning_rate", "prior_frequency", "spread")
        return Settings.load(
            {
                "scenario": {"initial_gap": self.initial_gap},
                "leader": {"brake_speed": self.brake_speed, "brake_decel": self.brake_decel},
                "aggressive": limits,
                "normal": limits,
                "machine": {name: getattr(self, name) for name in machine},
            }
        )

    def observe(self, number: int, episode: Episode) -> NDArray[np.float64]:
        """What the machine observes of a run, (T, 3); the driver sees what truly happens.

        ``number`` runs came before: each has noise of its own.
        """
        seen = episode.observations
        if self.noise > 0.0:
            deviation = self.noise * np.array([1.0, SPEED_NOISE, SPEED_NOISE])
            rng = np.random.default_rng([self.noise_seed, number])
            seen += rng.normal(scale=deviation, size=seen.shape)
            seen[:, 1:] = np.maximum(seen[:, 1:], 0.0)
        return seen / np.array(SCALES) if self.scaling == STANDARDISED else seen


@cache
def recovered() -> Setting:
    """The setting with which all claims of the paper come out.

    >>> recovered().initial_gap, recovered().order, recovered().noise
    (5.0, '1234', 0.0)
    """
    settings = Settings.load()
    return Setting(
        brake_speed=settings.scenario.leader.brake_speed,
        brake_decel=settings.scenario.leader.brake_decel,
        initial_gap=settings.scenario.initial_gap,
        bound=settings.decel,
        **settings.machine,
    )


class Scale(NamedTuple):
    """Values are spaced evenly on it."""

    there: Callable[[float], float]
    back: Callable[[float], float]


LINEAR, LOG = Scale(float, float), Scale(math.log, math.exp)
#: Small values are closer together, and 0 is one of them.
SQUARE = Scale(math.sqrt, np.square)

#: What the paper says about a parameter.
OPEN, STATED, ADDED = "leaves it open", "states it", "does not mention it"


@dataclass(frozen=True)
class Parameter:
    """A parameter with its plausible range.

    Places run from 0, the lower end, to 1, the upper end; values are spaced by the scale.

    >>> radius = Parameter("radius", "radius ε", STATED, "a factor of ten", 0.1, 10.0, LOG)
    >>> round(radius.value_at(0.5), 6), round(radius.place_of(10.0), 6)
    (1.0, 1.0)
    """

    name: str  #: of `Setting`
    label: str  #: with the paper's letter and the unit
    paper: str  #: what the paper says about it
    why: str  #: where the range comes from
    low: float = 0.0
    high: float = 0.0
    scale: Scale = LINEAR
    choices: tuple[str, ...] = ()  #: all values, where they are no numbers

    @property
    def recovered(self) -> Any:
        """Its value in the recovered setting."""
        return getattr(recovered(), self.name)

    def value_at(self, place: float) -> Any:
        """Value at a place of the range, in [0, 1]."""
        if self.choices:
            return self.choices[min(int(place * len(self.choices)), len(self.choices) - 1)]
        if place in (0.0, 1.0):  # exactly, without rounding there and back
            return (self.low, self.high)[int(place)]
        low, high = self.scale.there(self.low), self.scale.there(self.high)
        return self.scale.back(low + place * (high - low))

    def place_of(self, value: Any) -> float:
        """Place of a value; the middle of its share of the range for a choice."""
        if self.choices:
            return (self.choices.index(value) + 0.5) / len(self.choices)
        low, high = self.scale.there(self.low), self.scale.there(self.high)
        return (self.scale.there(value) - low) / (high - low)

    def levels(self, number: int) -> list[Any]:
        """About so many values over the range, the recovered one exactly among them; all choices.

        >>> Parameter("initial_gap", "", OPEN, "", 3.0, 11.0).levels(5)
        [3.0, 5.0, 7.0, 9.0, 11.0]
        """
        if self.choices:
            return list(self.choices)
        here = self.place_of(self.recovered)
        below = round(here * (number - 1))
        left = np.linspace(0.0, here, below + 1)[:-1]
        right = np.linspace(here, 1.0, number - below)[1:]
        values = [[self.value_at(float(place)) for place in part] for part in (left, right)]
        return [*values[0], self.recovered, *values[1]]

    def moved(self, setting: Setting, value: Any) -> Setting:
        """The same setting with another value."""
        return replace(setting, **{self.name: value})


_TYRE = "firm braking to the best a tyre can do"
_QUEUE = "queueing bumper to bumper to five car lengths"
_BRAKES = "from the paper's range of actions to SUMO's emergencyDecel"
_SIX, _TEN = "a factor of six either way", "a factor of ten either way"
_SMALL = "a factor of a hundred either way; the paper wants it small"
_THREE, _AS_FAR = "a factor of three either way", "as far below the stated value as above it"
_DIVIDED = "as it is, or divided by its standard deviation"
_RADAR = "up to what an automotive radar leaves"
_ORDERS = tuple("".join(order) for order in permutations("1234"))
_ALL = (
    Parameter("brake_speed", "leader's top speed [m/s]", OPEN, "it wants 25 m/s", 20.0, 24.9),
    Parameter("brake_decel", "leader's brake [m/s²]", OPEN, _TYRE, 3.0, 10.0),
    Parameter("initial_gap", "initial gap [m]", OPEN, _QUEUE, 1.0, 20.0, LOG),
    Parameter("bound", "follower's hardest brake [m/s²]", OPEN, _BRAKES, 2.5, 9.0),
    Parameter("spread", "spread", OPEN, _SIX, 0.5, 20.0, LOG),
    Parameter("learning_rate", "learning rate φ", OPEN, _TEN, 1e-3, 1e-1, LOG),
    Parameter("prior_frequency", "prior frequency ε̄", OPEN, _SMALL, 1e-5, 1e-1, LOG),
    Parameter("order", "order of cases", OPEN, "all 24", choices=_ORDERS),
    Parameter("radius", "radius ε", STATED, _THREE, 0.1, 1.0, LOG),
    Parameter("distance_weight", "distance weight ρ", STATED, _AS_FAR, 0.7, 1.0),
    Parameter("scaling", "scaling", ADDED, _DIVIDED, choices=(RAW, STANDARDISED)),
    Parameter("noise", "noise of the gap [m]", ADDED, _RADAR, 0.0, 0.3, SQUARE),
)
PARAMETERS = {one.name: one for one in _ALL}

# -- Which settings are tried ---------------------------------------------------------------------

#: What "near the recovered setting" means.
NEAR = 0.05
#: Spaces that are filled, with what is varied in each, and a number that makes its draws its own.
_NUMBERS = [one for one in PARAMETERS.values() if not one.choices]
SPACES: dict[str, tuple[int, Sequence[Parameter]]] = {
    "left open": (4, [one for one in PARAMETERS.values() if one.paper == OPEN]),
    "everything": (5, list(PARAMETERS.values())),
    "near": (6, [one for one in _NUMBERS if one.name != "noise"]),
}


class Trial(NamedTuple):
    """A setting, and why it is tried."""

    design: str  #: ``recovered``, ``sweep``, ``edge``, or a space
    varied: str  #: the parameter, if it is one alone
    setting: Setting


def sweeps(levels: int, noise_seed: int) -> Iterator[Trial]:
    """One parameter at a time, over its whole range."""
    base = replace(recovered(), noise_seed=noise_seed)
    for one in PARAMETERS.values():
        for value in one.levels(levels):
            yield Trial("sweep", one.name, one.moved(base, value))


def filling(space: str, number: int, seed: int) -> Iterator[Trial]:
    """So many points of a Latin hypercube; each has noise of its own."""
    own, varied = SPACES[space]
    points = qmc.LatinHypercube(len(varied), rng=[seed, own]).random(number)
    for index, point in enumerate(points):
        setting = replace(recovered(), noise_seed=(seed * 7 + own) * 1_000_000 + index)
        for one, place in zip(varied, map(float, point), strict=True):
            value = one.value_at(place)
            if space == "near":
                value = one.recovered * (1.0 + NEAR * (2.0 * place - 1.0))
            setting = one.moved(setting, value)
        yield Trial(space, "", setting)


# -- What becomes of the claims -------------------------------------------------------------------


class Remembering(KinematicWorld):
    """A world in which a run that was driven before is not driven again.

    The paper drives four cases twenty times, and without noise in the driver's eyes every round is
    the same.
    """

    def __init__(self) -> None:
        # The drivers are frozen, and so can be looked up, which controllers do not promise.
        self._run: Callable[..., Any] = lru_cache(_EPISODES)(super().run)

    def run(self, scenario: Scenario, controller: Any, interval: float | None = None) -> Episode:
        """As the world itself; the same run is the same object."""
        episode: Episode = self._run(scenario, controller, interval)
        return episode


def evaluate(trial: Trial, world: KinematicWorld, rounds: int = 20) -> dict[str, Any]:
    """A row: the paper's own verdicts on one setting.

    >>> row = evaluate(Trial("recovered", "", recovered()), Remembering())
    >>> row["held"], row["n_states"]
    (10, 7)
    """
    study = run_paper(
        world,
        "sensitivity",
        trial.setting.paper_settings(),
        rounds,
        order=[int(case) for case in trial.setting.order],
        observe=trial.setting.observe,
    )
    verdicts = {claim.id: bool(claim.holds) for claim in check_claims(study)}
    return {
        "design": trial.design,
        "varied": trial.varied,
        **asdict(trial.setting),
        **verdicts,
        "n_states": study.model.n_states,
        "held": sum(verdicts.values()),
        "holds": all(verdicts.values()),
    }


def try_all(trials: Sequence[Trial], rounds: int) -> list[dict[str, Any]]:
    """Rows of some settings."""
    world = Remembering()
    return [evaluate(one, world, rounds) for one in trials]


def find_edges(
    one: Parameter, sweep: Sequence[Mapping[str, Any]], halvings: int, rounds: int
) -> list[dict[str, Any]]:
    """Halve the steps of a sweep between which the first claim breaks, below and above."""
    world, tried = Remembering(), []
    for outward, bad in _outward(sweep, one):
        if bad == 0:  # all hold to the end of the range, or not even here
            continue
        inner, outer = (one.place_of(outward[place][one.name]) for place in (bad - 1, bad))
        base = replace(recovered(), noise_seed=outward[0]["noise_seed"])
        for _ in range(halvings):
            middle = 0.5 * (inner + outer)
            setting = one.moved(base, one.value_at(middle))
            tried.append(evaluate(Trial("edge", one.name, setting), world, rounds))
            inner, outer = (middle, outer) if tried[-1]["holds"] else (inner, middle)
    return tried


# -- The study ------------------------------------------------------------------------------------

# Settings a worker tries in one go: worth crossing a process boundary.
_TOGETHER = 16


@dataclass(frozen=True, kw_only=True)
class Sensitivity(Study):
    """In what share of settings each claim of the paper holds."""

    name: ClassVar[str] = "sensitivity"

    settings: Annotated[
        int, Option(min=4, help="Drawn over everything; sweeps and other draws come on top.")
    ] = 2000
    levels: int = 33  #: of each parameter in its sweep
    halvings: int = 7  #: of the last step of a sweep, in search of where a claim breaks
    rounds: int = 20  #: in which the four cases are driven; fewer are not the paper's study

    def shortened(self) -> Self:
        """About a twentieth of everything: a look, not evidence."""
        return self.smaller(settings=80, levels=7, halvings=2)

    def run(self, workers: int | None = None) -> dict[str, pl.DataFrame]:
        """Try all settings."""
        trials = [
            Trial("recovered", "", recovered()),
            *sweeps(self.levels, self.seed),
            *filling("everything", self.settings, self.seed),
            *filling("left open", self.settings // 2, self.seed),
            *filling("near", self.settings // 4, self.seed),
        ]
        chunks = [trials[at : at + _TOGETHER] for at in range(0, len(trials), _TOGETHER)]
        found = lib.parallel([partial(try_all, one, self.rounds) for one in chunks], workers)
        rows = [row for some in found for row in some]
        tasks = [
            partial(find_edges, one, _sweep(rows, one), self.halvings, self.rounds)
            for one in _NUMBERS
        ]
        edges = lib.parallel(tasks, workers, "Looking for edges")
        return {"rows": lib.frame_of([*rows, *(row for some in edges for row in some)])}

    def page(self, found: Frames) -> Page:
        """Shares of settings, and how far each parameter may move."""
        rows = found["rows"]
        shares = shares_of(rows)
        cells = {
            space: f"{{{space}:%}} ({{{space}_low:p}}–{{{space}_high:p}})" for space in _COLUMNS
        }
        reaches = lib.frame_of(reach(rows, one) for one in PARAMETERS.values())
        return self.shown(
            _ABOUT,
            [
                Table(
                    "In what share of settings each claim holds",
                    shares,
                    {"claim": "{claim}", **cells},
                    "Left open: all that the paper leaves open is drawn. Same ends: those of them "
                    "in which the cases end as in the paper. Everything: also what the paper "
                    f"states, the scaling and noise. Near: numbers within ±{NEAR:.0%} of the "
                    "recovered ones. In brackets: 95 % intervals by Clopper and Pearson.",
                    pl.when(pl.col("claim") == "all of them").then(pl.lit("ours")),
                ),
                Table(
                    "How far each parameter alone may move",
                    reaches,
                    {"parameter": "{parameter}", "the paper": "{paper}"}
                    | {"recovered": "{recovered}", "tried": "{tried}", "all hold": "{all_hold}"},
                    "All hold: from where to where all claims hold, the others being as "
                    "recovered; ≤ and ≥: to the end of the range. Ranges: "
                    + "; ".join(f"{one.label}: {one.why}" for one in PARAMETERS.values())
                    + ".",
                ),
            ],
            lost=[
                Table(
                    "Claims that hold in less than half of what is left open",
                    shares.filter(pl.col("left open") < 0.5).sort("left open"),
                    {"claim": "{claim}", **cells},
                ),
            ],
            targets=_targets(shares),
            facts={"settings in all": f"{len(rows):,}"},
            packages=("scipy",),
        )


_ABOUT = f"""Do the paper's claims depend on what it leaves open?

All claims were checked with many settings, each time on all 80 runs and by the checks of evofsm
paper, in the closed-form world. A share is one of the space that is stated here: with other ranges
it is another.

Noise is white, new in every row and run, and seen by the machine alone; the speeds have
{SPEED_NOISE:g} m/s for each metre of the gap. Standardised observations are divided by
{SCALES[0]:g} m and {SCALES[1]:g} m/s, and the radius keeps its number. That all collisions happen
in one state, and that all happen in the dead end, is one claim in two wordings."""

_COLUMNS = ("left open", "same ends", "everything", "near")


def shares_of(rows: pl.DataFrame) -> pl.DataFrame:
    """Each claim, and all of them, with its share of each space; ``same ends`` is part of open."""
    frame = pl.DataFrame({"claim": list(_ALL_OF_THEM.values())})
    for space in _COLUMNS:
        some = rows.filter(design="left open" if space == "same ends" else space)
        if space == "same ends":
            some = some.filter("collisions_by_case")
        held = some.select(pl.col(*_ALL_OF_THEM).sum()).row(0)
        frame = frame.with_columns(pl.Series("held", held), pl.lit(len(some)).alias("tried"))
        frame = lib.with_share(frame, "held", "tried", space).drop("held", "tried")
    return frame


def _targets(shares: pl.DataFrame) -> Iterator[Target]:
    last = shares.row(-1, named=True)
    for space, where in (("left open", "over what is left open"), ("near", "near recovered")):
        yield at_least(f"all claims hold together {where}", last[space], 0.5, "{:.1%}")


def _sweep(rows: Sequence[Mapping[str, Any]], one: Parameter) -> list[Mapping[str, Any]]:
    """A parameter's sweep, in the order of its values."""
    found = [row for row in rows if row["design"] == "sweep" and row["varied"] == one.name]
    return sorted(found, key=lambda row: one.place_of(row[one.name]))


def reach(rows: pl.DataFrame, one: Parameter) -> dict[str, Any]:
    """How far one parameter alone may move before the first claim breaks."""
    alone = [*rows.filter(varied=one.name).iter_rows(named=True)]
    alone.sort(key=lambda row: one.place_of(row[one.name]))
    told = {
        "parameter": one.label,
        "paper": one.paper,
        "recovered": one.recovered if one.choices else f"{one.recovered:.3g}",
        "tried": f"all {len(one.choices)}" if one.choices else f"{one.low:.3g}–{one.high:.3g}",
    }
    if one.choices:
        held = [row[one.name] for row in alone if row["holds"]]
        only = f" ({held[0]})" if len(held) == 1 else ""
        return told | {"all_hold": f"{len(held)} of {len(alone)}{only}"}
    (down, lower), (up, upper) = _outward(alone, one)
    if not up[0]["holds"]:
        return told | {"all_hold": None}
    least, most = down[lower - 1][one.name], up[upper - 1][one.name]
    at_low, at_high = lower == 0 and least > 0.0, upper == 0
    return told | {"all_hold": f"{'≤' * at_low}{least:.4g} to {'≥' * at_high}{most:.4g}"}


def _outward(
    sweep: Sequence[Mapping[str, Any]], one: Parameter
) -> Iterator[tuple[Sequence[Mapping[str, Any]], int]]:
    """From the recovered value down, and up, each with the first place where not all hold, or 0."""
    here = [row[one.name] for row in sweep].index(one.recovered)
    for rows in (sweep[here::-1], sweep[here:]):
        yield rows, next((place for place, row in enumerate(rows) if not row["holds"]), 0)

"""How rare failures are found, and how likely they are.

Adaptive multilevel splitting searches the scenarios of a family, plain sampling checks it. A
scenario is made by random numbers, one for each place that asks for one; in the search they are
standard normal. A score says how close a case came to failing, infinite where it failed. Cases of
the lowest scores are given up for copies of the others, which are moved at random but never below
the level that was reached; the shares that were kept, multiplied, are the probability. A move is
a Metropolis step that turns some of the numbers towards fresh ones, by small shares or large ones.

Frame ``rows``: one family under one judge. ``probability`` is the mean over ``runs`` with its
interval (Student's t), ``worst`` the highest score without a failure [m/s² of braking needed; of
the toy standard deviations], ``reached`` the probability of the last level, at the least over runs.
Frame ``cases``: a number of a case that failed, the most ordinary case first: ``below`` is the
share of ordinary draws that have a smaller one, ``as_far`` the share of those that lie as far from
the middle of all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
import polars as pl
from scipy.stats import chi2
from scipy.stats import t as student
from typer import Argument, Option

from evofsm.driving import (
    IDM,
    Body,
    ChangingIDM,
    Draw,
    Episode,
    Family,
    KinematicWorld,
    Leader,
    Numbers,
    Scenario,
    drive,
    guard_for_family,
    load_family,
    teach,
    training,
    unrevised_guard,
)
from evofsm.guard import Guard
from evofsm.paper import Page, Table
from studies import lib
from studies.lib import Frames, Study, Target, frame_of

#: Beside the package's families: one whose answer is known, and one that both ways see.
TOY, SELDOM = "toy", "seldom"
#: Who may judge. Without one, the family's controller drives as it likes.
NOBODY = "none"
JUDGES = (NOBODY, "kinematic", "learnt")
#: How likely the toy fails.
KNOWN = 1e-5
#: So many failures let plain sampling see.
SEEN = 10

_FAMILIES, _JUDGES = f"{TOY},{SELDOM},emergency", ",".join(JUDGES)
# Two ways to estimate the same differ by more than this allows in one of 100 cases.
_SURE, _SURER = 0.975, 0.995
# Plain samples in a task: some seconds. Those under a guard take twenty times as long.
_PLAIN, _GUARDED = 5_000, 250
# What the seeds of splitting and of plain sampling differ in.
_SPLIT, _SAMPLE = 0, 1
# It decides which noise there is, if there is any; how it lies in its range says nothing.
_NOISE = "sensors.seed"
_NORMAL = NormalDist()
# Where evofsm drive --out puts what was learnt, and whose judge is of which class.
_GUARD = "guard.evofsm"
_BY_CLASS = {"LatentRisk": "kinematic", "LearntRisk": "learnt"}


# -- Splitting ------------------------------------------------------------------------------------

#: Says by what chance a number falls as it does, from 0 up to 1, by the place that asks for it.
Chance = Callable[[str], float]
#: How close a case came to failing, by the chances that make it; infinite where it failed.
Score = Callable[[Chance], float]

# Share of the cases that is given up at a level, and what a number is moved by.
_GIVEN_UP = 0.2
_SMALLEST_MOVE, _MOVED = 0.15, 0.8
_BELOW_ONE = math.nextafter(1.0, 0.0)


class Case(NamedTuple):
    """One case, and how close it came to failing."""

    score: float
    latent: Mapping[str, float]  #: the normal numbers that make it, by place

    @property
    def failed(self) -> bool:
        """Whether it failed."""
        return self.score == math.inf

    def chance(self, place: str) -> float:
        """The chances that make it."""
        return to_chance(self.latent[place])


class Split(NamedTuple):
    """What came of one run."""

    probability: float  #: of failing; 0 where no case did
    tried: int  #: cases that were played
    reached: float  #: probability of exceeding the last level, a score that all had to
    best: float  #: the highest score of those that did not fail
    failed: tuple[Case, ...]  #: cases that failed, each once


def to_chance(normal: float) -> float:
    """The chance, from 0 up to 1, that a standard normal number stands for."""
    return min(_NORMAL.cdf(normal), _BELOW_ONE)


def split(score: Score, seed: Sequence[int], cases: int, moves: int, least: float = 1e-9) -> Split:
    """One run of splitting, of so many ``cases`` side by side.

    Those of the same score are kept or given up together; each copy is moved so often, at each
    level. Below the ``least`` probability the run is given up, and counts as 0.

    >>> def score(chance):
    ...     return math.inf if chance("x") >= 0.999 else chance("x")
    >>> 0.0005 < split(score, seed=[0], cases=200, moves=5).probability < 0.002
    True
    """
    rng = np.random.default_rng(seed)
    alive = [_played(score, {}, rng) for _ in range(cases)]
    best = max(map(_unfailing, alive))
    probability, tried = 1.0, cases
    given_up = math.ceil(_GIVEN_UP * cases)
    while (level := sorted(case.score for case in alive)[given_up - 1]) < math.inf:
        kept = [case for case in alive if case.score > level]
        next_probability = probability * (len(kept) / cases)
        if next_probability < least and not any(case.failed for case in kept):
            return Split(0.0, tried, probability, best, ())
        probability = next_probability
        copies = []
        for parent in rng.integers(len(kept), size=cases - len(kept)).tolist():
            case = kept[parent]
            for _ in range(moves):
                # By shares from small to large.
                moved = _played(score, case.latent, rng, float(_SMALLEST_MOVE ** rng.random()))
                best = max(best, _unfailing(moved))
                case = moved if moved.score > level else case
            copies.append(case)
        tried += len(copies) * moves
        alive = kept + copies
    failed = [case for case in alive if case.failed]
    each = {tuple(sorted(case.latent.items())): case for case in failed}
    found = probability * len(failed) / cases
    return Split(found, tried, probability, best, tuple(each.values()))


def plain(score: Score, n: int, seed: Sequence[int]) -> int:
    """How many of so many ordinary cases fail."""
    rng = np.random.default_rng(seed)
    return sum(_played(score, {}, rng).failed for _ in range(n))


def _unfailing(case: Case) -> float:
    return -math.inf if case.failed else case.score


def _played(
    score: Score, start: Mapping[str, float], rng: np.random.Generator, move: float = 0.0
) -> Case:
    """Play a case near another, or a new one.

    A place that the start lacks gets a fresh number: the start's score does not depend on it, so it
    is distributed as ever. For the same reason what is asked for no more is forgotten.
    """
    latent: dict[str, float] = {}

    def chance(place: str) -> float:
        if place not in latent:
            old, fresh = start.get(place), rng.standard_normal()
            if old is None:
                latent[place] = fresh
            elif rng.random() < _MOVED:
                latent[place] = math.sqrt(1.0 - move * move) * old + move * fresh
            else:
                latent[place] = old
        return to_chance(latent[place])

    return Case(score(chance), latent)


# -- What may fail --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Toy:
    """Fails where some normal numbers add up to more than they do in one case of 100,000."""

    probability: float = KNOWN
    numbers: int = 6

    def score(self, chance: Chance) -> float:
        """The sum, in its standard deviations."""
        # A chance of 0 is none that a normal number has; the smallest is as good.
        drawn = (
            _NORMAL.inv_cdf(max(chance(f"number {k}"), 1e-300)) for k in range(1, self.numbers + 1)
        )
        total = sum(drawn) / math.sqrt(self.numbers)
        return math.inf if total >= _NORMAL.inv_cdf(1.0 - self.probability) else total


class Chosen(Numbers):
    """The numbers of a draw that given chances make; an even one is as a draw's own."""

    def __init__(self, chance: Chance) -> None:
        super().__init__(seed=0, index=0)
        self._chance = chance
        self.drawn: dict[str, float] = {}  #: by place: of a range the number, of several its index

    def between(self, place: str, low: float, high: float) -> float:
        """So far into a range."""
        self.drawn[place] = number = float(low + (high - low) * self._chance(place))
        return number

    def below(self, place: str, n: int) -> int:
        """So far into 0 to n - 1."""
        self.drawn[place] = number = int(n * self._chance(place))
        return number


@dataclass(frozen=True)
class Cars:
    """A family's own controller in the closed-form world, under a frozen guard or none."""

    family: str
    judge: str = NOBODY
    train: int = 0
    learnt: str | None = None
    seed: int = 0

    def score(self, chance: Chance) -> float:
        """The braking that was needed at the worst moment [m/s²]."""
        return needed_braking(self.play(load(self.family).draw_by(Chosen(chance))))

    def play(self, draw: Draw) -> Episode:
        """Drive one draw."""
        family = load(self.family)
        if self.judge != NOBODY:
            return drive(_guard(self), draw)
        limits = draw.controller.parameters[:, 7:9]
        if limits.min() >= family.actions.low and limits.max() <= family.actions.high:
            # Exactly what the framework makes of it, without its decisions.
            return KinematicWorld().run(draw.scenario, draw.controller, family.interval)
        return drive(unrevised_guard(family), draw)

    def check(self) -> None:
        """Refuse what cannot be loaded, or is of another judge."""
        load(self.family)
        if self.learnt is None or self.judge == NOBODY:
            return
        held = _BY_CLASS[type(Guard.load(Path(self.learnt) / _GUARD).judge).__name__]
        if held != self.judge:
            raise ValueError(
                f"{self.learnt} holds the judge {held!r}, not {self.judge!r}: --judge {held}"
            )


def needed_braking(episode: Episode) -> float:
    """How hard the follower had to brake at the worst moment not to collide [m/s²].

    As if the leader went on as it did, until it stands; infinite where they collided.
    """
    if episode.collided:
        return math.inf
    gap, speed, ahead = episode.observations.T
    accelerations = episode.leader_accelerations
    closing, slows = np.maximum(speed - ahead, 0.0), accelerations < 0.0
    stops = ahead[slows] ** 2 / (-2.0 * accelerations[slows])
    to_stop = speed[slows] ** 2 / (2.0 * (gap[slows] + stops))
    return float(max((closing**2 / (2.0 * gap)).max(), to_stop.max(initial=0.0)))


@lru_cache(maxsize=8)
def load(name: str) -> Family:
    """A family by its name or file, with its switches behind a ``+`` each."""
    base, *switches = name.split("+")
    return seldom().with_switches(switches) if base == SELDOM else load_family(name)


@lru_cache(maxsize=8)
def _guard(cars: Cars) -> Guard:
    """Taught, then frozen; the same in every process."""
    family = load(cars.family)
    if cars.learnt:
        guard = Guard.load(Path(cars.learnt) / _GUARD)
    else:
        guard = guard_for_family(family, judge=cars.judge, seed=cars.seed)
        teach(guard, training(family, cars.seed, 0, cars.train))
    guard.freeze()
    frozen = guard.copy(states=False)
    frozen.freeze()
    return frozen


_LEADER = IDM(1.2, 25.0, 1.0, 1.0, 2.5)
_CAREFUL = IDM(1.25, 25.0, 2.0, 1.5, 2.0, lowest=-4.0, highest=2.5)
_CARELESS = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-4.0, highest=2.5)


def seldom() -> Family:
    """A careful driver with one short lapse. Unrevised, some 5 of 10,000 draws collide."""
    about = "A careful driver under way lapses once, for a second or so, behind a braking leader."
    return Family(SELDOM, about, _seldom, -4.0, 2.5, decel=4.0, leader_decel=4.2)


def _seldom(numbers: Numbers) -> tuple[Scenario, ChangingIDM]:
    """Both cars under way; a step is a fifth of a decision, as a million episodes are driven."""
    speed = numbers.between("values.speed", 15.0, 20.0)
    leader = Leader(
        _LEADER,
        initial_speed=speed,
        brake_time=numbers.between("leader.brake_time", 2.0, 8.0),
        brake_decel=numbers.between("leader.brake_decel", 2.0, 4.2),
    )
    gap = numbers.between("scenario.initial_gap", 40.0, 60.0)
    body = Body(-4.0, 2.5)
    scenario = Scenario(leader, gap, duration=12.0, dt=0.05, initial_speed=speed, body=body)
    start = numbers.between("follower.lapses.0.start", 0.5, 7.5)
    end = start + numbers.between("follower.lapses.0.duration", 0.5, 1.5)
    return scenario, ChangingIDM(_CAREFUL, ((start, _CARELESS), (end, _CAREFUL)))


# -- The study ------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Falsification(Study):
    """Search scenarios in which the guard fails, and estimate how likely they are.

    Adaptive multilevel splitting draws scenarios closer and closer to a collision, from a family's
    own distribution; plain sampling is compared with it. The guard is frozen. What is found is
    written as a family (found-FAMILY-JUDGE.py) that evofsm drive and campaign take.
    """

    name = "falsification"

    family: Annotated[
        str,
        Argument(
            help="Families with commas: emergency, cut_in+noise+delay, a file of your own, seldom "
            "(collisions are rare without a guard) or toy (no car; its probability is 1e-5)."
        ),
    ] = _FAMILIES
    judge: Annotated[
        str, Option(help="Who judges, with commas: none (no guard), kinematic, learnt.")
    ] = _JUDGES
    learnt: Annotated[
        str | None,
        Option(help="Folder of evofsm drive --out; a guard learns first if not given."),
    ] = None
    runs: Annotated[
        int, Option(min=2, help="Independent runs of splitting; the interval rests on them.")
    ] = 10
    cases: Annotated[int, Option(min=5, help="Cases side by side in a run.")] = 100
    least: Annotated[
        float, Option(min=1e-300, max=0.5, help="A run is given up below this probability.")
    ] = 1e-8
    plain: Annotated[int, Option(min=0, help="Plain samples, without a guard.")] = 1_000_000
    guarded: Annotated[
        int, Option(min=0, help="Plain samples under a guard, which take longer.")
    ] = 20_000
    moves: int = 10  # of each copy at each level
    train: int = 60  # episodes that a guard learns from before it is frozen
    keep: int = 10  # cases that are kept of those found, the most ordinary first

    def shortened(self) -> Self:
        """Few cases, and rare only to 1 in 10,000."""
        few = self.smaller(train=20, runs=3, cases=30, moves=3, plain=3000, guarded=100)
        return replace(
            few,
            family=f"{TOY},{SELDOM}" if self.family == _FAMILIES else self.family,
            judge=f"{NOBODY},kinematic" if self.judge == _JUDGES else self.judge,
            least=max(self.least, 1e-4),
        )

    def asked(self) -> list[tuple[str, str]]:
        """Each family with each judge; it refuses what cannot be tried."""
        families, judges = (
            list(dict.fromkeys(lib.names_in(names))) for names in (self.family, self.judge)
        )
        for judge in judges:
            if judge not in JUDGES:
                raise ValueError(f"there is no judge {judge!r}; there are {', '.join(JUDGES)}")
        if not families:
            raise ValueError("no family is named")
        if not judges:
            raise ValueError(f"no judge is named; there are {', '.join(JUDGES)}")
        asked = [
            (family, judge)
            for family in families
            for judge in ((NOBODY,) if family == TOY else judges)
        ]
        for who in asked:
            if who[0] != TOY:
                Cars(*who, learnt=self.learnt).check()
        return asked

    def run(self, workers: int | None = None) -> dict[str, pl.DataFrame]:
        """Search all that is named."""
        asked = self.asked()
        work = [self._tasks(place, *who) for place, who in enumerate(asked)]
        every = iter(lib.parallel([task for tasks in work for task in tasks], workers, "Searching"))
        rows, cases = list[dict[str, Any]](), list[dict[str, Any]]()
        for (family, judge), tasks in zip(asked, work, strict=True):
            found = list(islice(every, len(tasks)))
            sampled = self.plain if judge == NOBODY else self.guarded
            splits, failed = found[: self.runs], sum(found[self.runs :])
            rows.append(row_of(family, judge, splits, sampled, failed))
            if family != TOY:
                ordinary = sorted((case for one in splits for case in one.failed), key=_distance)
                for number, case in enumerate(ordinary[: self.keep], 1):
                    cases += numbers_of(family, judge, number, case)
        frame = frame_of(rows).with_columns(
            pl.col("known").cast(pl.Float64), pl.col("agrees", "hits").cast(pl.Boolean)
        )
        return {"rows": frame} | ({"cases": frame_of(cases)} if cases else {})

    def _tasks(self, place: int, family: str, judge: str) -> list[partial[Any]]:
        """Runs of splitting, then batches of plain samples."""
        cars = Cars(family, judge, self.train, self.learnt, self.seed)
        score = Toy().score if family == TOY else cars.score
        searching = partial(split, score, cases=self.cases, moves=self.moves, least=self.least)
        size, n = (_PLAIN, self.plain) if judge == NOBODY else (_GUARDED, self.guarded)
        return [
            *(partial(searching, (self.seed, place, _SPLIT, k)) for k in range(self.runs)),
            *(
                partial(plain, score, min(size, n - first), (self.seed, place, _SAMPLE, first))
                for first in range(0, n, size)
            ),
        ]

    def write(self, found: Frames, folder: Path) -> None:
        """Write what was found of each family and judge as a family that drives it again."""
        if "cases" not in found:
            return
        for (name, judge), some in found["cases"].group_by("family", "judge", maintain_order=True):
            family = load(str(name))
            chances = {
                f"found {number}": dict(one.select("place", "below").rows())
                for (number,), one in some.group_by("case", maintain_order=True)
            }
            draws = {of: family.draw_by(Chosen(by.__getitem__)) for of, by in chances.items()}
            about = f"Collisions of {name} that were found (judge: {judge}): {lib.command_line()}"
            file = folder / f"found-{Path(str(name)).stem}-{judge}.py"
            file.write_text(kept(family, draws, about), encoding="utf-8")

    def page(self, found: Frames) -> Page:
        """What is found, how likely it is, and where it loses."""
        rows = found["rows"]
        guarded, some_blind = (
            pl.col("judge") != NOBODY,
            pl.col("blind").is_between(1, self.runs - 1),
        )
        wide = (pl.col("probability") > 0) & (pl.col("high") > 3.0 * pl.col("probability"))
        return self.shown(
            _ABOUT,
            [
                Table(
                    "How likely a failure is",
                    rows,
                    _COLUMNS,
                    "Cases: played by all runs of splitting. Worst: how close came what did not "
                    "fail, in m/s² of braking needed (of the toy: in standard deviations). Down "
                    "to: probability of the last level. Found: different cases that failed. "
                    "Blind: runs that found no failure, and count as 0. Agree: whether splitting "
                    "and plain samples differ by no more than chance (99 %), where plain sampling "
                    f"saw {SEEN} failures or more. Finding nothing is no proof: failures to which "
                    "no close case leads would be missed.",
                    pl.when(~pl.col("agrees") | ~pl.col("hits"))
                    .then(pl.lit("fails"))
                    .when(guarded)
                    .then(pl.lit("ours")),
                ),
                *_tables_of_cases(found.get("cases")),
            ],
            targets=_targets(rows),
            lost=[
                Table(
                    "The guard fails",
                    rows.filter(guarded & ((pl.col("found") > 0) | (pl.col("plain_failed") > 0))),
                    _COLUMNS,
                ),
                Table(
                    "Estimates that differ, are wide, or rest on some runs alone",
                    rows.filter(~pl.col("agrees").fill_null(value=True) | some_blind | wide),
                    _COLUMNS,
                    "More runs or cases narrow an interval.",
                ),
            ],
            packages=("scipy",),
            sources=_SOURCES,
        )


def row_of(family: str, judge: str, splits: Sequence[Split], n: int, failed: int) -> dict[str, Any]:
    """One family under one judge, by splitting and by plain sampling."""
    values = [one.probability for one in splits]
    mean = float(np.mean(values))
    error = float(np.std(values, ddof=1)) / math.sqrt(len(values))
    half = float(student.ppf(_SURE, len(values) - 1)) * error
    low, high = lib.exact_interval([failed], [n]) if n else ([0.0], [1.0])
    share = failed / n if n else math.nan

    def near(other: float, others: float = 0.0) -> bool:
        """Whether it differs from another estimate by no more than chance (99 %)."""
        times = float(student.ppf(_SURER, len(values) - 1))
        return abs(mean - other) <= times * math.hypot(error, others)

    seen = mean > 0.0 and failed >= SEEN
    return {
        "family": family,
        "judge": judge,
        "probability": mean,
        "low": max(0.0, mean - half),
        "high": min(1.0, mean + half),
        "runs": values,
        "blind": sum(value == 0.0 for value in values),
        "tried": sum(one.tried for one in splits),
        "worst": max(one.best for one in splits),
        "reached": min(one.reached for one in splits),
        "found": sum(len(one.failed) for one in splits),
        "plain": n,
        "plain_failed": failed,
        "plain_low": float(low[0]),
        "plain_high": float(high[0]),
        "known": KNOWN if family == TOY else None,
        "agrees": near(share, math.sqrt(share * (1.0 - share) / n)) if seen else None,
        "hits": near(KNOWN) if family == TOY else None,
    }


def numbers_of(family: str, judge: str, number: int, case: Case) -> Iterator[dict[str, Any]]:
    """What there is to say about a case that failed: a row for each number that was drawn."""
    numbers = Chosen(case.chance)
    load(family).draw_by(numbers)
    degrees = max(1, len(numbers.drawn.keys() - {_NOISE}))
    as_far = float(chi2.sf(_distance(case), degrees))
    for place, value in numbers.drawn.items():
        yield {
            "family": family,
            "judge": judge,
            "case": number,
            "place": place,
            "value": float(value),
            "below": to_chance(case.latent[place]),
            "as_far": as_far,
        }


def _distance(case: Case) -> float:
    """Squared, of its normal numbers from the middle of all."""
    return math.fsum(z * z for place, z in case.latent.items() if place != _NOISE)


def kept(family: Family, cases: Mapping[str, Draw], about: str) -> str:
    """Draws of a family as a file that defines them as one, in which nothing is left to chance."""
    names = ("low", "high", "decel", "leader_decel", "interval", "width")
    settings = "".join(f"    {name}={float(getattr(family, name))!r},\n" for name in names)
    draws = "".join(f"    {name!r}: {draw!r},\n" for name, draw in cases.items())
    return f"""# fmt: off
# ruff: noqa
from math import inf
from pathlib import Path

from evofsm.driving.drivers import IDM, ChangingIDM
from evofsm.driving.family import Draw, Family
from evofsm.driving.scenarios import Behind, Body, CutIn, Leader, Scenario, Sensors

cases = {{
{draws}}}
family = Family(
    Path(__file__).stem,
    {about!r},
    lambda numbers: [*cases.values()][numbers.variant][:2],
{settings}    variants=tuple(cases),
    in_turn=True,
    fixed=True,
)
"""


# -- The page -------------------------------------------------------------------------------------

_ABOUT = """In which scenarios does the guard fail, and how likely are they?

A family draws its scenarios by chance. Adaptive multilevel splitting keeps many of them side by
side, gives up those that came least close to a collision for moved copies of the others, and
multiplies the shares that it kept: the probability of a collision. Its interval is that of the mean
over independent runs (Student's t, 95 %). Plain samples are ordinary draws of the same family, with
an exact interval (Clopper and Pearson). How close: by the braking that was needed at the worst
moment. Guards are frozen; all is driven in closed form. Sensor noise is drawn anew as a whole and
cannot be searched bit by bit.

What is found is written as found-FAMILY-JUDGE.py, a family that evofsm drive and campaign take."""

_SOURCES = {
    "F. Cérou, A. Guyader, Adaptive multilevel splitting for rare event analysis, 2007": (
        "https://doi.org/10.1080/07362990601139628"
    ),
    "S.-K. Au, J. Beck, Estimation of small failure probabilities by subset simulation, 2001": (
        "https://doi.org/10.1016/S0266-8920(01)00019-4"
    ),
}
_COLUMNS = {
    "family": "{family}",
    "judge": "{judge}",
    "splitting": "{probability:.2g}",
    "95 %": "{low:.2g}–{high:.2g}",
    "blind": "{blind}",
    "cases": "{tried}",
    "worst": "{worst:.2f}",
    "down to": "{reached:.2g}",
    "found": "{found}",
    "plain": "{plain_failed} of {plain}",
    "plain 95 %": "{plain_low:.2g}–{plain_high:.2g}",
    "known": "{known:.2g}",
    "agree": "{agrees}",
}
#: Units of numbers by the last part of their place; others have none.
_UNITS = {
    **dict.fromkeys(("initial_gap", "gap"), "m"),
    **dict.fromkeys(("initial_speed", "speed", "brake_speed", "slower", "fast", "slow"), "m/s"),
    **dict.fromkeys(("brake_decel", "decel", "accel"), "m/s²"),
    **dict.fromkeys(("time", "brake_time", "start", "duration", "cruise", "pause"), "s"),
}


def _with_unit(place: str) -> str:
    parts = [part for part in place.split(".") if not part.isdigit()]
    last = parts[-2] if parts[-1] == "plus" else parts[-1]  # it adds to the number it stands in
    return f"{place} [{_UNITS[last]}]" if last in _UNITS else place


def _targets(rows: pl.DataFrame) -> Iterator[Target]:
    """What was asked for before the study was run, as far as its rows can answer it."""
    for row in rows.to_dicts():
        share = row["plain_failed"] / row["plain"] if row["plain"] else None
        for what, of, held in (
            ("the known probability", row["known"], row["hits"]),
            ("plain sampling", share, row["agrees"]),
        ):
            if held is not None:
                who, came = f"{row['family']}, {row['judge']}", f"{row['probability']:.3g}"
                asked = f"{of:.3g} within chance (99 %)"
                yield Target(f"{who}: splitting and {what}", asked, came, held)


def _tables_of_cases(cases: pl.DataFrame | None) -> Iterable[Table]:
    """A table for each family and judge in which something failed."""
    if cases is None:
        return
    for (family, judge), some in cases.group_by("family", "judge", maintain_order=True):
        shown = some.filter(pl.col("place") != _NOISE)
        yield Table(
            f"Cases that were found: {family}, judge {judge}",
            shown.pivot("place", index=["case", "as_far"], values=["value", "below"]),
            {"case": "{case}", "as far from ordinary": "{as_far:%}"}
            | {
                _with_unit(place): f"{{value_{place}:.4g}} ({{below_{place}:p}})"
                for place in shown["place"].unique(maintain_order=True)
            },
            "The most likely ones first: as far, the share of ordinary draws that lie as far from "
            "the middle of all. A number stands where the family's file has it; behind it the "
            "percentage of ordinary draws with a smaller one.",
        )

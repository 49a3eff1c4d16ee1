"""Who sees danger, and how early.

Nobody acts: every decision of unrevised held-out episodes is a case, which measures score from what
was seen until then. Ours has watched other episodes; thresholds are chosen on yet others.

Frame ``rows``: one measure, one danger, one world. ``lead`` is the median time [s] from the alarm
that stays on to the collision at one false alarm per hour, ``false_time`` the share of decisions
without the danger in alarm then; null where hours do not suffice. Frame ``seeds``: areas of the
other learning seeds, on fewer episodes. Frame ``grid``: brakes that nobody was told of; ``missed``
and ``called`` are shares of dead ends, and of other decisions, at the measure's own threshold.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from itertools import chain, count, islice, product
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
import polars as pl
from numba import njit
from numpy.typing import NDArray
from typer import Option

from evofsm.driving import (
    FAMILIES,
    IDM,
    ChangingIDM,
    Draw,
    Episode,
    Family,
    KinematicWorld,
    LatentRisk,
    Leader,
    Numbers,
    Scenario,
    Unrevised,
    drive,
    guard_for_family,
    learners_of,
    load_family,
    measures,
    training,
)
from evofsm.fsm import EvolvingFSM
from evofsm.guard import Guard, RiskMeasure
from evofsm.paper import Page, Table
from studies import lib
from studies.lib import ALL, Frames, Study, Target, at_least, frame_of
from studies.policies import TUNED_MEASURES

Floats = NDArray[np.float64]

#: What is judged if nothing else is asked for; see `world`.
WORLDS = (
    *("paper", "emergency", "stop_and_go", "cut_in", "ncap", "r157"),
    *("weak_brakes", "rare", "shift", "shift-at-once", "emergency+noise"),
)
#: A collision within so long counts as coming [s].
HORIZON = 5.0
#: False alarms per hour at which lead times are told [1/h].
RATE = 1.0
# The learning seed of draws on which thresholds are chosen: no learner's.
_CALIBRATION_SEED = 900


# -- Worlds ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class World:
    """Where something is judged, and what may be watched before."""

    family: Family  #: that is judged
    watched: Family  #: that is watched first; another one where the world shifts
    settled: Family  #: on which thresholds are chosen
    since: int = 0  #: episodes of ``family`` that are watched after the first ones

    def training(self, seed: int, learning_seed: int, train: int) -> Iterator[tuple[Family, Draw]]:
        """What one learner watches, with the family that each draw is of."""
        first = training(self.watched, seed, learning_seed, train)
        then = training(self.family, seed, learning_seed, self.since, first=train)
        return chain(((self.watched, one) for one in first), ((self.family, one) for one in then))


def world(name: str, since: int = 20) -> World:
    """A world by its name.

    ``emergency+noise`` is a family with a switch on. A family that shifts is judged after its
    shift, with ``since`` episodes watched of it; ``shift-at-once`` is the same with none, and with
    thresholds from before it. ``paper`` is the paper's four cases with what it leaves open drawn.

    >>> at_once = world("shift-at-once")
    >>> at_once.watched.decel, at_once.family.decel, at_once.since
    (4.5, 2.5, 0)
    """
    base, *switches = name.split("+")
    plain = base.removesuffix("-at-once")
    family = (drawn_paper() if plain == "paper" else load_family(plain)).with_switches(switches)
    at_once, shifted = plain != base, family.shifted
    if at_once and shifted is None:
        raise ValueError(f"family {family.name!r} has no shift, so there is no {name!r}")
    if shifted is None:
        return World(family, family, family)
    return World(shifted, family, family if at_once else shifted, 0 if at_once else since)


_LEADER = IDM(1.2, 25.0, 1.0, 1.0, 2.5)
_NORMAL = IDM(1.25, 25.0, 2.0, 1.5, 2.0, lowest=-4.0, highest=2.5)
_AGGRESSIVE = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-4.0, highest=2.5)


def drawn_paper() -> Family:
    """The paper's four cases in turn, with gap, top speed and the driver's change drawn.

    Four runs that are always the same can be neither held out nor counted by the hour.
    """
    cases = ("case 1", "case 2", "case 3", "case 4")
    about = "The paper's four cases in turn, with gap, top speed and the driver's change drawn."
    return Family("paper", about, _paper, -4.0, 2.5, 4.0, 9.0, variants=cases, in_turn=True)


def _paper(numbers: Numbers) -> tuple[Scenario, IDM | ChangingIDM]:
    brake_speed = numbers.between("leader.brake_speed", 23.9, 24.2)
    leader = Leader(_LEADER, brake_decel=9.0, brake_speed=brake_speed)
    gap = numbers.between("scenario.initial_gap", 3.0, 8.0)
    driver: IDM | ChangingIDM = _NORMAL if numbers.variant == 1 else _AGGRESSIVE
    if numbers.variant == 2:
        at = numbers.between("follower.changes.0", 12.0, 15.0)
        driver = ChangingIDM(_AGGRESSIVE, ((at, _NORMAL),))
    elif numbers.variant == 3:
        at = numbers.between("follower.changes.0", 8.0, 12.0)
        driver = ChangingIDM(_NORMAL, ((at, _AGGRESSIVE),))
    return Scenario(leader, gap, duration=60.0), driver


# -- What is watched, and what was true -----------------------------------------------------------


class Danger(StrEnum):
    """What is to be seen coming."""

    DEAD_END = "dead end"  #: even braking in full could not avoid a leader that brakes in full
    COLLISION = "collision within 5 s"  #: within `HORIZON`, going on as driven


class Watched(NamedTuple):
    """Decisions of one episode; n of them."""

    seen: Floats  #: (n, 3) gap [m], v_follower, v_leader [m/s], as sensors show them
    true: Floats  #: (n, 3) the same, as they were
    commands: Floats  #: (n,) commanded after each [m/s²]
    end: float  #: of the episode, since the first decision [s]
    collided: bool


class Cases(NamedTuple):
    """All decisions of some episodes whose truth is known, episode after episode."""

    rows: NDArray[np.intp]  #: (n,) where they are among all decisions
    truth: NDArray[np.bool_]  #: (n,)
    episode: NDArray[np.intp]  #: (n,) which they belong to
    first: NDArray[np.intp]  #: (episodes + 1,) case at which each begins, and where the last ends
    hours: float  #: that they cover


class Exposure(NamedTuple):
    """Unrevised episodes of a family."""

    family: Family
    watched: tuple[Watched, ...]

    @property
    def first(self) -> NDArray[np.intp]:
        """(episodes + 1,) ndarray: decision at which each episode begins, and the last ends."""
        return np.append(0, np.cumsum([len(one.commands) for one in self.watched]))

    def cases(self, danger: Danger) -> Cases:
        """Decisions of which it is known whether the danger is there.

        Whether a collision comes within the horizon is not known where the episode ends before
        that without one; such decisions are left out.
        """
        interval, family = self.family.interval, self.family
        knowns, truths = [], []
        for one in self.watched:
            n = len(one.commands)
            left = one.end - interval * np.arange(n)
            if danger is Danger.DEAD_END:
                knowns.append(np.ones(n, dtype=np.bool_))
                truths.append(measures.is_dead_end(one.true, family.decel, family.leader_decel))
            else:
                knowns.append((left >= HORIZON) | one.collided)
                truths.append((left <= HORIZON) & one.collided)
        known, lengths = np.concatenate(knowns), [int(one.sum()) for one in knowns]
        return Cases(
            np.flatnonzero(known),
            np.concatenate(truths)[known],
            np.repeat(np.arange(len(lengths)), lengths),
            np.append(0, np.cumsum(lengths)),
            sum(lengths) * interval / 3600.0,
        )


#: Scores every decision of an exposure; higher is more dangerous.
Score = Callable[[Exposure], Floats]
Scores = dict[str, Score]


def watch(family: Family, draw: Draw) -> Watched:
    """Drive a draw as its controller likes, deciding every ``family.interval``."""
    scenario, controller = draw.scenario, draw.controller
    steps = scenario.steps(family.interval)
    seen: list[Floats] = []
    commands: list[float] = []
    with KinematicWorld().open(scenario) as road:
        while not road.over:
            seen.append(road.observation)
            wanted = controller.propose(seen[-1], road.time).action
            commands.append(float(np.clip(wanted, family.actions.low, family.actions.high)))
            road.advance(commands[-1], steps)
        episode = road.episode()
    true = episode.observations[::steps][: len(commands)]
    end = float(episode.time[-1])
    return Watched(np.array(seen), true, np.array(commands), end, episode.collided)


def expose(family: Family, draws: Iterable[Draw], hours: float) -> Exposure:
    """Watch draws until, for each danger, so many hours of cases are there [h].

    Where nothing is drawn each case is driven once: again it would add hours, but no evidence.
    """
    watched: list[Watched] = []
    seconds = 0.0
    for draw in islice(draws, family.cases) if _is_fixed(family) else draws:
        if seconds >= 3600.0 * hours:
            break
        watched.append(watch(family, draw))
        left_out = 0.0 if watched[-1].collided else HORIZON
        seconds += family.interval * len(watched[-1].commands) - left_out
    return Exposure(family, tuple(watched))


def held_out_draws(family: Family, seed: int) -> Iterator[Draw]:
    """Draws that nothing learns from, without an end."""
    return (family.draw(seed, index, split="test") for index in count())


def calibration_draws(family: Family, seed: int) -> Iterator[Draw]:
    """Draws for thresholds, without an end; no learner sees them either."""
    return training(family, seed, _CALIBRATION_SEED, 10**9)


def _is_fixed(family: Family) -> bool:
    """Whether all seeds draw the same: of 20 draws, which is no chance."""

    def drawn(seed: int, index: int) -> Draw:
        draw = family.draw(seed, index)
        sensors = draw.scenario.sensors
        if sensors.gap_noise > 0.0 or sensors.speed_noise > 0.0:
            return draw
        return draw._replace(scenario=replace(draw.scenario, sensors=replace(sensors, seed=0)))

    return all(drawn(0, index) == drawn(1, index) for index in range(20))


# -- Measures -------------------------------------------------------------------------------------

#: Ours: latent risk of the situation, behind the filter of noise, and the same at the centres of
#: states; then failures counted in the states of the paper's rule.
OURS = "evofsm"
STATES, PAPER = READINGS = (f"{OURS}-states", f"{OURS}-paper")


class Chain:
    """A machine, and the failures that were counted in its states."""

    def __init__(self, machine: EvolvingFSM) -> None:
        self.machine = machine
        self._counts = np.zeros((2, 0))  # cases and failures of each state

    def count(self, driven: Episode, interval: float) -> None:
        """Count whether a failure came within the horizon after each decision of a drive.

        Of what an episode that ended well left open it is not known, and not counted.
        """
        beliefs = [decision.situation.belief for decision in driven.decisions]
        known, ahead = len(beliefs), round(HORIZON / interval)
        safe = max(0, known - ahead)
        for place, belief in enumerate(beliefs if driven.collided else beliefs[:safe]):
            if (more := len(belief) - self._counts.shape[1]) > 0:
                self._counts = np.pad(self._counts, ((0, 0), (0, more)))
            self._counts[0, : len(belief)] += belief
            self._counts[1, : len(belief)] += belief * (place >= safe)

    @property
    def probability(self) -> Floats:
        """(states,) of a failure within the horizon; few cases lean on the share among all."""
        cases, failures = np.pad(
            self._counts, ((0, 0), (0, self.machine.n_states - self._counts.shape[1]))
        )
        anywhere = (failures.sum() + 0.5) / (cases.sum() + 1.0)
        here = (failures + 2.0 * anywhere) / (cases + 2.0)
        return np.asarray((failures + 2.0 * here) / (cases + 2.0))

    def counted(self, exposure: Exposure) -> Floats:
        """(n,) that probability, weighed by the belief."""
        return self._weighed(self.probability, exposure)

    def latent(self, risk: LatentRisk, exposure: Exposure) -> Floats:
        """(n,) `LatentRisk.score` at the centres of the states, weighed by the belief [m/s²]."""
        return self._weighed(risk.score(self.machine.centers, exposure.family.interval), exposure)

    def _weighed(self, values: Floats, exposure: Exposure) -> Floats:
        model = self.machine.model()
        return np.concatenate([model.recognise(one.seen) @ values for one in exposure.watched])


# Of a standard normal variable: the middles of seven parts that are as likely each.
_QUANTILES = (-1.465, -0.792, -0.366, 0.0, 0.366, 0.792, 1.465)


class Watcher:
    """Ours, and the paper's preset, which watch the same episodes without acting.

    Without ``states`` the latent risk alone learns, which is much quicker.
    """

    def __init__(self, family: Family, *, states: bool = True) -> None:
        # What is learnt of leaders and brakes, and the machine beside it.
        self.risk = LatentRisk(family.low, family.interval)
        machine, _ = learners_of(guard_for_family(family, judge=self.risk))
        self.default = Chain(machine)
        self.paper = Chain(EvolvingFSM(family.actions.n_actions))
        self.states = states

    def watch(self, draws: Iterable[tuple[Family, Draw]]) -> Self:
        """Learn from unrevised episodes, each with the family it is of."""
        for family, draw in draws:
            _drive(family, draw, self.default.machine if self.states else None, self.risk)
            if self.states:
                driven = _drive(family, draw, self.paper.machine, None)
                self.paper.count(driven, family.interval)
        return self

    def scores(self) -> Scores:
        """All that are ours."""
        found: Scores = {OURS: self.latent_risk}
        if self.states:
            found[STATES] = partial(self.default.latent, self.risk)
            found[PAPER] = self.paper.counted
        return found

    def latent_risk(self, exposure: Exposure) -> Floats:
        """(n,) `LatentRisk.score` of where the follower most likely is [m/s²].

        Where sensors are noisy it is averaged over where the follower may be instead: gaps that
        are as likely each. Further than 1 m/s² on either side of the edge of a dead end all
        situations count alike, so that one that is nearly safe may not outweigh many that are not.
        """
        interval = exposure.family.interval
        if not any(self.risk.perception.noise):
            return _scores(self.risk, exposure)
        estimates = [_estimates(self.risk, one) for one in exposure.watched]
        mean, doubt = (np.concatenate(parts) for parts in zip(*estimates, strict=True))
        nearness = np.zeros(len(mean))
        for quantile in _QUANTILES:
            where = mean.copy()
            where[:, 0] += quantile * doubt
            nearness += np.tanh(self.risk.score(where, interval)) / len(_QUANTILES)
        return nearness


def _drive(
    family: Family, draw: Draw, machine: EvolvingFSM | None, risk: LatentRisk | None
) -> Episode:
    reviser = Unrevised(family.actions)
    return drive(Guard.of(reviser, interval=family.interval, machine=machine, judge=risk), draw)


def _estimates(risk: LatentRisk, one: Watched) -> tuple[Floats, Floats]:
    """(n, 3) where the follower most likely is, and (n,) how sure the gap is in that [m].

    From each row and those before it only: as the risk filters them before it judges an action.
    """
    perception = copy.deepcopy(risk.perception)
    perception.clear()
    brakes = risk.brakes
    before = last = 0.0
    where, doubt = [], []
    for row, command in zip(one.seen, one.commands.tolist(), strict=True):
        estimate = perception.see(
            tuple(row.tolist()), brakes.expected(before, last), sure=brakes.known, learn=False
        )
        _, speed, leader_speed = estimate.mean
        where.append(estimate.mean)
        # What is wrong about a speed adds up while both brake.
        doubt.append(estimate.deviation((1.0, -speed / brakes.decel, leader_speed / brakes.decel)))
        before, last = last, command
    return np.array(where), np.array(doubt)


# Classic measures that are shown, by their name here.
_UNCHANGED = ("mttc", "drac", "headway", "rss-r157", "r157-careful", "fuzzy")
_SHOWN = {"ttc": "aeb-ttc", **{name: name for name in _UNCHANGED}}
_RSS = measures.ResponsibilitySensitiveSafety


def _scores(measure: RiskMeasure, exposure: Exposure) -> Floats:
    interval = exposure.family.interval
    return np.concatenate([measure.score(one.seen, interval) for one in exposure.watched])


def classics(family: Family) -> Scores:
    """All that neither learn nor are tuned; the matched one is told the family's true limits."""
    matched = _RSS.matched(family.decel, family.leader_decel)
    found: Scores = {
        name: partial(_scores, measures.FIXED_MEASURES[key]) for name, key in _SHOWN.items()
    }
    return found | {"rss-matched": partial(_scores, matched)}


def tuned(training: Exposure, danger: Danger) -> Score:
    """The safe distance that tells a danger best in training, where it is told the truth."""
    cases = training.cases(danger)

    def area(measure: RiskMeasure) -> float:
        found = lib.Ranked(_scores(measure, training)[cases.rows], cases.truth).areas().auroc
        return -1.0 if math.isnan(found) else found

    return partial(_scores, max(TUNED_MEASURES["rss-tuned"], key=area))


# -- Alarms as events -----------------------------------------------------------------------------
# A score raises an alarm where it is above a threshold, and an alarm holds for one second after it
# was last raised: alarms no further apart are one. An alarm comes true if the danger is there when
# it comes on, or within five seconds from then while it is still on; if not, it is false. Without
# that limit an alarm that is always on would never be false where all episodes end badly.

_HOLD, _PATIENCE = 1.0, 5.0  # [s]
# Thresholds that are tried, evenly spread over the logarithm of how many decisions are above.
_TRIED = 400


def count_alarms(score: Floats, cases: Cases, threshold: float, interval: float) -> tuple[int, int]:
    """False alarms of the scores (n,) of some cases, and decisions in alarm without danger."""
    hold, patience = (round(seconds / interval) for seconds in (_HOLD, _PATIENCE))
    false, decisions, _ = _follow(score, cases.truth, cases.first, threshold, hold, patience)
    return false, decisions


def choose_threshold(score: Floats, cases: Cases, rate: float, interval: float) -> float:
    """The lowest threshold such that it and all above it keep the rate of false alarms [1/h].

    Long alarms merge with short ones, so that a very low threshold may have few false alarms again;
    it is not chosen if a higher one has too many. Minus infinity if the danger is always there.
    """
    safe = np.sort(score[~cases.truth])[::-1]
    if len(safe) == 0:
        return -math.inf
    places = np.unique(np.geomspace(1, len(safe), _TRIED).astype(np.intp)) - 1
    chosen = math.inf
    for threshold in np.unique(safe[places])[::-1].tolist():
        if count_alarms(score, cases, threshold, interval)[0] > rate * cases.hours:
            break
        chosen = threshold
    return chosen


def lead_times(score: Floats, exposure: Exposure, threshold: float) -> Floats:
    """(collisions,) from the first alarm that stays on to the collision [s]; 0 without one."""
    interval, nothing = exposure.family.interval, np.zeros(len(score), dtype=np.bool_)
    *_, since = _follow(score, nothing, exposure.first, threshold, round(_HOLD / interval), 0)
    ends = np.array([one.end for one in exposure.watched])
    lead = np.where(since >= 0, ends - interval * since, 0.0)
    return np.asarray(lead[[one.collided for one in exposure.watched]])


def _follow_each(
    score: Floats,
    truth: NDArray[np.bool_],
    first: NDArray[np.intp],
    threshold: float,
    hold: int,
    patience: int,
) -> tuple[int, int, NDArray[np.intp]]:
    """Alarms that were false, decisions in false alarm, and those still on at the end.

    The last are the decisions at which they came on, for each episode; -1 where none is on.
    """
    false = false_decisions = 0
    since = np.full(len(first) - 1, -1)
    for episode in range(len(first) - 1):
        left, came_true, came_on = 0, False, 0
        for row in range(first[episode], first[episode + 1]):
            if score[row] > threshold:
                if left == 0:
                    came_on = row
                left = hold
            elif left > 0:
                left -= 1
                if left == 0:  # it was raised too long ago
                    false += not came_true
                    came_true = False
            if left > 0:
                came_true = came_true or (truth[row] and row <= came_on + patience)
                false_decisions += not truth[row]
        if left > 0:
            false += not came_true
            since[episode] = came_on - first[episode]
    return false, false_decisions, since


_follow: Any = njit(cache=True)(_follow_each)


# -- The study ------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Detection(Study):
    """Who sees dead ends and collisions coming, and how early.

    Nobody acts. Ours has watched other episodes; thresholds are chosen on yet others.
    """

    name = "detection"

    family: Annotated[
        str,
        Option(
            help="Families with commas, emergency+noise for one with a switch, shift-at-once for "
            "one just shifted; all of the study if not given."
        ),
    ] = ALL
    train: int = 100  # episodes that are watched before anything is judged
    since: int = 20  # episodes that are watched after a shift
    seeds: int = 20  # learning seeds; the first one's are the rows, the others their spread
    hours: float = 3.0  # of held-out driving, and as many to choose thresholds on
    long_hours: float = 30.0  # the same in the worlds of `long`
    long: tuple[str, ...] = ("paper", "emergency")
    rounds: int = 200  # of the bootstrap
    seed_hours: float = 0.5  # of held-out driving for each of the other learning seeds
    grid: tuple[float, ...] = (2.0, 3.0, 4.0, 5.0, 6.0)  # own brakes in the grid [m/s²]
    grid_leader: tuple[float, ...] = (3.0, 4.5, 6.0, 7.5, 9.0)  # leaders' hardest [m/s²]
    grid_train: int = 20  # episodes that are watched in each world of the grid
    grid_hours: float = 0.5  # of held-out driving in each

    def shortened(self) -> Self:
        """Just enough for one false alarm per hour to be measurable."""
        few = self.smaller(train=40, seeds=2, hours=0.5, long_hours=3.0, rounds=40)
        few = few.smaller(seed_hours=0.2, grid_hours=0.2)
        return replace(few, grid=(2.0, 4.0, 6.0), grid_leader=(3.0, 6.0, 9.0))

    @property
    def worlds(self) -> tuple[str, ...]:
        """Those that are judged."""
        return WORLDS if self.family == ALL else tuple(dict.fromkeys(lib.names_in(self.family)))

    def run(self, workers: int | None = None) -> dict[str, pl.DataFrame]:
        """Judge every measure in every world."""
        for name in self.worlds:
            world(name)  # so that a wrong name shows at once
        others = product(self.worlds, range(1, self.seeds))
        cells = product(self.grid, self.grid_leader)
        tasks: dict[str, list[partial[list[Any]]]] = {
            "rows": [partial(_judge_world, self, name) for name in self.worlds],
            "seeds": [partial(_other_seed, self, *one) for one in others],
            "grid": [partial(_judge_cell, self, *one) for one in cells],
        }
        every = [task for some in tasks.values() for task in some]
        done = iter(lib.parallel(every, workers, "Watching and judging"))
        found = {name: [*chain(*islice(done, len(some)))] for name, some in tasks.items()}
        return {name: frame_of(rows) for name, rows in found.items() if rows}

    def page(self, found: Frames) -> Page:
        """Who sees danger, how early, and where ours loses."""
        return self.shown(
            _ABOUT,
            _parts(found),
            targets=_targets(found),
            lost=_lost(found),
            packages=("scipy",),
        )


def _judge_world(study: Detection, name: str) -> list[dict[str, Any]]:
    """All measures in one world."""
    here = world(name, study.since)
    hours = study.long_hours if name in study.long else study.hours
    watcher = Watcher(here.watched).watch(here.training(study.seed, 0, study.train))
    held_out = expose(here.family, held_out_draws(here.family, study.seed), hours)
    calibration = expose(here.settled, calibration_draws(here.settled, study.seed), hours)
    # Baselines are tuned on what is watched first, before any shift.
    draws = islice(here.training(study.seed, 0, study.train), study.train)
    training = Exposure(here.watched, tuple(watch(family, draw) for family, draw in draws))
    scores = watcher.scores() | classics(here.family)

    def scored(score: Score) -> tuple[Floats, Floats]:
        return score(held_out), score(calibration)

    known, rows = {name: scored(score) for name, score in scores.items()}, []
    for danger in Danger:
        cases, chosen_on = held_out.cases(danger), calibration.cases(danger)
        # Fewer than three events expected cannot be told from none.
        can_be_told = RATE * min(cases.hours, chosen_on.hours) >= 3.0
        known["rss-tuned"] = scored(tuned(training, danger))
        for measure, (now, before) in known.items():
            row: dict[str, Any] = {"family": name, "danger": str(danger)}
            row |= judge(measure, cases, now, study.rounds)
            row |= dict.fromkeys(("lead", "false_time"))
            if can_be_told:
                known_before = before[chosen_on.rows]
                threshold = choose_threshold(known_before, chosen_on, RATE, here.family.interval)
                row |= warnings(held_out, cases, now, threshold)
            rows.append(row)
    return rows


def judge(measure: str, cases: Cases, scores: Floats, rounds: int) -> dict[str, Any]:
    """How well the scores of all decisions tell the dangerous ones from the rest."""
    ranked = lib.Ranked(scores[cases.rows], cases.truth, cases.episode)
    low, high = ranked.interval(rounds)[0]
    return {
        "measure": measure,
        "auroc": ranked.areas().auroc,
        "auroc_low": low,
        "auroc_high": high,
        "share": float(cases.truth.mean()),
        "episodes": len(cases.first) - 1,
        "hours": cases.hours,
    }


def warnings(held_out: Exposure, cases: Cases, scores: Floats, threshold: float) -> dict[str, Any]:
    """What comes of alarms above a threshold that was chosen elsewhere."""
    _, alarmed = count_alarms(scores[cases.rows], cases, threshold, held_out.family.interval)
    lead = lead_times(scores, held_out, threshold)
    return {
        "lead": float(np.median(lead)) if len(lead) else None,
        "false_time": alarmed / max(1, int((~cases.truth).sum())),
    }


def _other_seed(study: Detection, name: str, seed: int) -> list[dict[str, Any]]:
    """How far what is learnt depends on what happened to be watched."""
    here = world(name, study.since)
    watcher = Watcher(here.watched).watch(here.training(study.seed, seed, study.train))
    held_out = expose(here.family, held_out_draws(here.family, study.seed), study.seed_hours)
    cases = held_out.cases(Danger.DEAD_END)
    return [
        {
            "danger": str(Danger.DEAD_END),
            "family": name,
            "measure": measure,
            "seed": seed,
            "auroc": lib.Ranked(score(held_out)[cases.rows], cases.truth).areas().auroc,
        }
        for measure, score in watcher.scores().items()
    ]


def _judge_cell(study: Detection, decel: float, leader_decel: float) -> list[dict[str, Any]]:
    """One world of the grid, by dead ends alone."""
    # As `emergency`, with brakes of anyone's choice; commands always reach further.
    family = FAMILIES["emergency"](-max(study.grid), decel, leader_decel)
    watcher = Watcher(family, states=False)
    watcher.watch((family, one) for one in training(family, study.seed, 0, study.grid_train))
    held_out = expose(family, held_out_draws(family, study.seed), study.grid_hours)
    cases, rows = held_out.cases(Danger.DEAD_END), []
    scores = watcher.scores() | classics(family)
    for measure in (OURS, "rss-r157", "rss-matched"):
        score = scores[measure](held_out)
        safe, danger = score[~cases.truth], score[cases.truth]
        row = {
            "decel": decel,
            "leader_decel": leader_decel,
            "missed": float(np.mean(danger <= 0.0)) if len(danger) else None,
            "called": float(np.mean(safe > 0.0)) if len(safe) else None,
        }
        rows.append(row | judge(measure, cases, score, study.rounds))
    return rows


# -- The page -------------------------------------------------------------------------------------

_ABOUT = """Who sees danger, and how early?

Nobody acts. Each decision of unrevised episodes is a case, and every measure scores it from what
was seen until then. Two things may come: a dead end (by an oracle: if both cars braked as hard as
they truly can from now on, they would collide), and a collision within 5 s, going on as driven.
Ours has watched other episodes without acting and was told nothing; on dead ends it is nearly
perfect because the oracle is kinematics with the true brakes, and ours the same kinematics with
brakes that it learnt: what is shown is that they can be learnt by watching.

An alarm holds for 1 s after it was raised, and is false if the danger does not come within 5 s."""

# Measures that stand in the columns of tables over worlds.
_AREAS = (OURS, STATES, PAPER, "rss-r157", "rss-tuned", "rss-matched", "ttc")
_LEADS = (OURS, STATES, PAPER, "rss-r157", "rss-matched", "headway", "ttc")
_IS_OURS = pl.col("measure") == OURS
# Other readings of ours are no rivals.
_RIVALS = ~pl.col("measure").is_in(READINGS)


def _over_worlds(
    frame: pl.DataFrame, shown: Sequence[str], template: str, values: Sequence[str]
) -> tuple[pl.DataFrame, dict[str, str]]:
    """Values of several measures, world by world; the template has ``@`` for a measure."""
    pivoted = frame.filter(pl.col("measure").is_in(shown)).pivot(
        "measure", index=["danger", "family"], values=values
    )
    columns = {one.removeprefix("evofsm-"): template.replace("@", one) for one in shown}
    return pivoted, {"danger": "{danger}", "world": "{family}"} | columns


def _parts(found: Frames) -> Iterator[Table]:
    rows = found["rows"]
    yield Table(
        "AUROC",
        *_over_worlds(rows, _AREAS, "{auroc_@:.3f}", ["auroc", "auroc_low"]),
        "Half is chance; below, danger is where the measure says safety. states, paper: ours read "
        "through the states of the default rule, and failures counted in those of the paper's. "
        "rss-tuned, rss-matched: told the truth in training, and told the true limits. "
        "Intervals, and all other measures, are in the rows.",
    )
    if "seeds" in found:
        spread = found["seeds"].group_by("danger", "family", "measure", maintain_order=True)
        area, shown = pl.col("auroc"), "{low_@:.3f}–{high_@:.3f}"
        ends = spread.agg(low=area.min(), high=area.max())
        yield Table(
            "AUROC over the other learning seeds",
            *_over_worlds(ends, [OURS, *READINGS], shown, ["low", "high"]),
            "From the lowest to the highest; on fewer held-out episodes than above.",
        )
    told, shown = rows.filter(pl.col("lead").is_not_null()), "{lead_@:.1f} ({false_time_@:p})"
    yield Table(
        "Median lead time at one false alarm per hour, in seconds",
        *_over_worlds(told, _LEADS, shown, ["lead", "false_time"]),
        "From the first alarm that stays on to the collision; 0 where there was none. In brackets "
        "the percentage of decisions without the danger that are in alarm. Worlds without enough "
        "hours for this rate are left out.",
    )
    if "grid" in found:
        yield Table(
            "Brakes that nobody was told of: own × leader's",
            found["grid"]
            .with_columns(pl.col("auroc").fill_nan(None))
            .group_by("measure", maintain_order=True)
            .agg(
                pl.col("auroc").min().alias("lowest"),
                pl.col("auroc").median().alias("median"),
                pl.col("missed").max().alias("most"),
                pl.col("missed", "called").mean(),
                worlds=pl.len(),
            ),
            {
                "measure": "{measure}",
                "worlds": "{worlds}",
                "lowest AUROC": "{lowest:.4f}",
                "median": "{median:.4f}",
                "most missed": "{most:%}",
                "missed": "{missed:%}",
                "called": "{called:%}",
            },
            "At the measure's own threshold: share of dead ends missed, of others called one.",
            pl.when(_IS_OURS).then(pl.lit("ours")),
        )


def _targets(found: Frames) -> Iterator[Target]:
    """What was asked for before the study was run, as far as its worlds were judged."""
    rows = {(one["family"], one["measure"], one["danger"]): one for one in found["rows"].to_dicts()}

    def area(family: str, measure: str = OURS) -> float:
        row = rows.get((family, measure, Danger.DEAD_END))
        return row["auroc"] if row else math.nan

    for family, least in {
        "emergency": 0.97,
        "rare": 0.9,
        "weak_brakes": None,
        "shift": None,
    }.items():
        if not math.isnan(area(family)):
            than = "" if least else ": at least rss-r157's"
            asked = least or area(family, "rss-r157")
            yield at_least(f"AUROC on {family}{than}", area(family), asked, "{:.4f}")
    for danger in Danger:
        ours, ttc = (rows.get(("paper", one, danger)) for one in (OURS, "ttc"))
        if ours and ttc and None not in (ours["lead"], ttc["lead"]):
            what = f"Lead time on paper beyond TTC's, {danger}"
            yield at_least(what, ours["lead"] - ttc["lead"], 5.0, "{:.1f} s")
    for measure in (OURS, STATES):
        if not math.isnan(area("rare", measure)):
            what = f"AUROC on rare, {measure}: {PAPER}'s + 0.2"
            yield at_least(what, area("rare", measure), area("rare", PAPER) + 0.2, "{:.4f}")


def _lost(found: Frames) -> Iterator[Table]:
    """Where another one does better than ours."""
    rows = found["rows"].filter(_RIVALS)
    both = lib.compared(rows, _IS_OURS, ["family", "danger"])
    who = {"world": "{family}", "danger": "{danger}", "measure": "{measure}"}
    areas = {"AUROC": "{auroc:.4f} ({auroc_low:.4f}–{auroc_high:.4f})"}
    areas["ours"] = "{auroc_ours:.4f} ({auroc_low_ours:.4f}–{auroc_high_ours:.4f})"
    leads = {"lead [s]": "{lead:.1f} ({false_time:p})"}
    leads["our lead"] = "{lead_ours:.1f} ({false_time_ours:p})"
    clearly = pl.col("auroc_low") > pl.col("auroc_high_ours")
    yield Table(
        "Measures that rank clearly better, or warn earlier by a quarter of a second",
        both.filter(clearly | (pl.col("lead") > pl.col("lead_ours") + 0.25)),
        who | areas | leads,
        "Leads at one false alarm per hour, with the percentage of decisions without the danger "
        "that are in alarm.",
    )
    alone = found["rows"].filter(pl.col("measure").is_in([STATES, "rss-r157"]))
    alone = alone.filter(danger=Danger.DEAD_END)
    both = lib.compared(alone, pl.col("measure") == STATES, ["family", "danger"])
    yield Table(
        "Read through its states alone, ours ranks clearly worse than RSS with R157's constants",
        both.filter(clearly),
        who | areas,
    )
    if "grid" in found:
        cells = lib.compared(found["grid"], _IS_OURS, ["decel", "leader_decel"])
        yield Table(
            "Brakes that nobody was told of: another one ranks better, or ours calls most",
            cells.filter(
                (pl.col("auroc") > pl.col("auroc_ours") + 0.001)
                | ((pl.col("called_ours") > 0.5) & (pl.col("called") < pl.col("called_ours")))
            ),
            {
                "own [m/s²]": "{decel:g}",
                "leader's": "{leader_decel:g}",
                "dead ends": "{share:%}",
                "measure": "{measure}",
                "AUROC": "{auroc:.4f}",
                "ours": "{auroc_ours:.4f}",
                "called": "{called:%}",
                "called by ours": "{called_ours:%}",
            },
        )

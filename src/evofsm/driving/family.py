"""Families of scenarios, each a Python function of numbers that are drawn by seed.

A `Family` has a function ``make(numbers)`` that returns a scenario and who drives the follower. It
asks `Numbers` for whatever is drawn, each number by the place that it is for, which has random
numbers of its own, whatever else is drawn. All are in SI units.

In those that come with the package drivers are those of the paper. What the unrevised driver comes
to was counted on 400 test draws of seed 1.
"""

from __future__ import annotations

import math
import operator
import runpy
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from os import PathLike
from pathlib import Path
from traceback import walk_tb
from typing import Any, NamedTuple, SupportsIndex
from zlib import crc32

import numpy as np

from evofsm.driving.drivers import IDM, ChangingIDM, refuse_others
from evofsm.driving.naming import UNITS, VARIABLES
from evofsm.driving.scenarios import Behind, Body, CutIn, Leader, Scenario
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.naming import Labels

#: Where draws come from. What is learnt on one is scored on the other; they never meet.
SPLITS = ("train", "test")

# Numbers that are equal but for rounding.
_ROUNDING = 1e-9


class Draw(NamedTuple):
    """One scenario of a family, and who drives the follower in it."""

    scenario: Scenario
    controller: IDM | ChangingIDM
    variant: str  #: name of the variant; that of the family where it has none


class Numbers:
    """The numbers of one draw, each by the place that it is for.

    Whoever searches among all draws there are derives from it, and says `between` and `below`.

    Examples
    --------
    >>> numbers = Numbers(seed=1, index=0)
    >>> gap = numbers.between("scenario.initial_gap", 2.0, 30.0)
    >>> 2.0 <= gap <= 30.0, gap == numbers.between("scenario.initial_gap", 2.0, 30.0)
    (True, True)
    """

    def __init__(self, seed: int, index: int, split: str = "train") -> None:
        if split not in SPLITS:
            raise ValueError(f"split is {split!r}; it must be one of {', '.join(SPLITS)}")
        for name, number in (("seed", seed), ("index", index)):
            if not 0 <= operator.index(number) < 2**32:
                raise ValueError(f"{name} is {number}; it must be from 0 to 2**32 - 1")
        #: Index of the variant; 0 where the family has none.
        self.variant = 0
        self._key = [SPLITS.index(split), int(seed), int(index)]

    def between(self, place: str, low: float, high: float) -> float:
        """A number from a range, evenly distributed.

        Parameters
        ----------
        place : str
            What it is for, such as ``"scenario.initial_gap"``.
        low, high : float
            Ends of the range.
        """
        if not low <= high:
            raise ValueError(f"{place} is drawn from {low} to {high}; the lower end comes first")
        return float(self._stream(place).uniform(low, high))

    def below(self, place: str, n: int) -> int:
        """An integer from 0 to n - 1, each as likely."""
        return int(self._stream(place).integers(n))

    def one_of(self, place: str, choices: Sequence[Any]) -> Any:
        """One of several, each as likely."""
        return choices[self.below(f"{place}.one_of", len(choices))]

    def _stream(self, place: str) -> np.random.Generator:
        return np.random.default_rng([*self._key, crc32(place.encode())])


#: What makes a draw: a scenario and who drives the follower.
Make = Callable[[Numbers], tuple[Scenario, IDM | ChangingIDM]]


@dataclass(frozen=True, eq=False)
class Family:
    """Scenarios that are drawn by seed.

    Examples
    --------
    >>> from evofsm.driving import Leader, load_family
    >>> def make(numbers):
    ...     calm = IDM(1.2, 25.0, 1.0, 1.0, 2.5, lowest=-4.0, highest=2.5)
    ...     decel = numbers.between("leader.brake_decel", 2.0, 6.0)
    ...     leader = Leader(calm, brake_decel=decel, brake_time=10.0)
    ...     return Scenario(leader, initial_gap=10.0), calm
    >>> family = Family("mine", "The leader stops.", make, -4.0, 2.5, decel=4.0, leader_decel=6.0)
    >>> family.draw(seed=0, index=1) == family.draw(seed=0, index=1)
    True
    >>> load_family("shift").shifted.decel, load_family("paper").draw(0, 6).variant
    (2.5, 'case 3')
    """

    name: str
    about: str  #: what happens, in a sentence
    make: Make  #: the seed of the sensors' noise is drawn besides
    low: float  #: range of the actions [m/s²]
    high: float
    #: The true hardest braking of the follower, and of any leader [m/s²], positive: for those who
    #: may know it.
    decel: float
    leader_decel: float
    interval: float = 0.25  #: time between decisions [s]
    width: float = 0.3  #: of an interval of actions [m/s²]
    variants: tuple[str, ...] = ()  #: ``numbers.variant`` is the index of the one that is drawn ...
    in_turn: bool = False  #: ... or that of the draw, modulo their number
    shifted: Family | None = None  #: the family after its shift
    switches: tuple[str, ...] = ()  #: those of `SWITCHES` that are on
    fixed: bool = False  #: whether nothing is drawn, the sensors' noise neither
    source: str = ""  #: the file that it is from

    def __post_init__(self) -> None:
        refuse_others(self, "family's", "decel leader_decel interval")
        for name in self.switches:
            if name not in SWITCHES:
                raise ValueError(f"there is no switch {name!r}; there are {', '.join(SWITCHES)}")
        _ = self.actions

    @cached_property
    def actions(self) -> IntervalActions:
        """The set of actions; made with ``outside="clip"``."""
        return IntervalActions(self.low, self.high, self.width, outside="clip")

    @property
    def labels(self) -> Labels:
        """What the numbers of a machine mean that drove it."""
        return Labels(self.actions, VARIABLES, UNITS, self.interval)

    @property
    def cases(self) -> int:
        """How many variants come in turn; 1 where none do."""
        return max(1, len(self.variants)) if self.in_turn else 1

    def with_switches(self, names: Sequence[str]) -> Family:
        """The family with some of `SWITCHES` on; what it draws is otherwise the same."""
        after = None if self.shifted is None else self.shifted.with_switches(names)
        return replace(self, switches=(*self.switches, *names), shifted=after)

    def draw(self, seed: int, index: int, split: str = "train") -> Draw:
        """One scenario: always the same for the same arguments.

        Parameters
        ----------
        seed, index : int
            From 0; each pair is another draw.
        split : {"train", "test"}
            Draws of one are never those of the other.
        """
        numbers = Numbers(seed, index, split)
        return self.draw_by(numbers, index % self.cases if self.cases > 1 else None)

    def draw_by(self, numbers: Numbers, variant: int | None = None) -> Draw:
        """The scenario that given numbers make; without a variant they say which."""
        if variant is None and self.variants:
            variant = numbers.below("variant", len(self.variants))
        numbers.variant = variant or 0
        noise = None if self.fixed else numbers.below("sensors.seed", 2**32)
        scenario, driver = self.make(numbers)
        if noise is not None:
            scenario = replace(scenario, sensors=replace(scenario.sensors, seed=noise))
        for name in self.switches:
            part, values, ranges = SWITCHES[name]
            draws = {of: numbers.between(f"{part}.{of}", *ends) for of, ends in ranges.items()}
            whole: Any = getattr(scenario, part) or _THIRD_CAR
            scenario = replace(scenario, **{part: replace(whole, **values, **draws)})
        self._check_limits(scenario, driver)
        return Draw(
            scenario, driver, self.variants[numbers.variant] if self.variants else self.name
        )

    def _check_limits(self, scenario: Scenario, driver: IDM | ChangingIDM) -> None:
        """Who is given the limits must be able to rely on them."""
        where, leader = self.source or f"family {self.name}", scenario.leader
        leader_brakes = max([leader.brake_decel, *(-wave for _, wave in leader.waves)])
        if leader_brakes > self.leader_decel + _ROUNDING:
            fault = f"a leader brakes by {leader_brakes:g} m/s²"
            raise ValueError(f"{where}: {fault}, but leader_decel is {self.leader_decel:g}")
        if not isinstance(driver, IDM | ChangingIDM):
            raise ValueError(f"{where}: who drives is {driver!r}; make gives an IDM or ChangingIDM")
        lowest_command = min(self.low, float(driver.parameters[:, 7].min()))
        brakes = -max(scenario.body.lowest, lowest_command)
        if brakes > self.decel + _ROUNDING:
            fault = f"the follower can brake by {brakes:g} m/s², but decel is {self.decel:g}"
            raise ValueError(f"{where}: {fault}; bound its body, or the driver and the actions")

    def __reduce_ex__(self, protocol: SupportsIndex) -> Any:
        """From a file it is read anew in other processes, which do not know its functions."""
        if self.source:
            return read_family, (self.source, self.switches)
        return super().__reduce_ex__(protocol)


def training(
    family: Family, seed: int, learning_seed: int, episodes: int, first: int = 0
) -> Iterator[Draw]:
    """Draws to learn from, other ones for every learning seed.

    Parameters
    ----------
    family : Family
    seed, learning_seed : int
        Of the draws; the second is from 0 to 999.
    episodes, first : int
        How many, and the index of the first.
    """
    for index in range(first, first + episodes):
        yield family.draw(seed * 1000 + learning_seed, index, split="train")


def held_out(family: Family, seed: int, episodes: int) -> list[Draw]:
    """Draws that nothing learns from.

    Parameters
    ----------
    family, seed, episodes
        As in `training`.
    """
    return [family.draw(seed, index, split="test") for index in range(episodes)]


# The sizes are our own: what a production radar and brake system roughly show.
#: What can be switched on in any family, by name: what of a part of its scenarios is changed, to
#: which values, and to values that are drawn from which ranges.
SWITCHES: Mapping[str, tuple[str, dict[str, float], dict[str, tuple[float, float]]]] = {
    "noise": ("sensors", {"gap_noise": 0.5, "speed_noise": 0.3}, {}),  # white, at every step
    "delay": ("sensors", {"delay": 0.2}, {}),  # of what is seen
    "actuator": ("body", {"delay": 0.2}, {}),  # from a command to its effect
    "jerk": ("body", {"jerk": 15.0}, {}),
    "third_car": ("behind", {}, {"gap": (10.0, 40.0)}),
}


# -- Those that come with the package -------------------------------------------------------------

MakeFamily = Callable[..., Family]
_CASES = ("case 1", "case 2", "case 3", "case 4")

_LEADER_MODEL = IDM(1.2, 25.0, 1.0, 1.0, 2.5)


def _told_by(function: Callable[..., Any]) -> tuple[str, str]:
    """Name of a family, and what happens in it: the first line that a function says of itself."""
    return function.__name__.removeprefix("_"), (function.__doc__ or "").partition("\n")[0]


def _aggressive(lowest: float, desired_speed: float = 28.0) -> IDM:
    return IDM(2.25, desired_speed, 0.8, 0.3, 2.0, lowest=lowest, highest=2.5)


def _normal(lowest: float) -> IDM:
    return IDM(1.25, 25.0, 2.0, 1.5, 2.0, lowest=lowest, highest=2.5)


def _at_speed(leader: Leader, gap: float, duration: float, speed: float) -> tuple[Scenario, IDM]:
    """An aggressive driver who wants no more than the speed at which it begins."""
    body = Body(-4.0, 2.5)
    scenario = Scenario(leader, gap, duration, initial_speed=speed, body=body)
    return scenario, _aggressive(-4.0, speed)


_THIRD_CAR = Behind(_normal(-6.0), gap=10.0)  # where that is switched on


def _paper(numbers: Numbers) -> tuple[Scenario, IDM | ChangingIDM]:
    """The paper's four cases in turn: a leader brakes in full on reaching its top speed.

    Section 3 of Han, Filev, Ozguner (arXiv:1908.10823), run on to 60 s, in which not all stand. The
    settings are those of `evofsm paper`, but for the set of actions, which begins at -2.5 m/s²
    in the study: there no one could command what its drivers brake by.
    """
    leader = Leader(_LEADER_MODEL, brake_decel=9.0, brake_speed=24.2)
    hasty, calm = _aggressive(-4.0), _normal(-4.0)
    changing_drivers = ChangingIDM(hasty, ((15.0, calm),)), ChangingIDM(calm, ((10.0, hasty),))
    driver = (hasty, calm, *changing_drivers)[numbers.variant]
    return Scenario(leader, initial_gap=5.0, duration=60.0), driver


def _emergency(
    low: float, decel: float, softest: float, hardest: float, numbers: Numbers
) -> tuple[Scenario, IDM]:
    leader = Leader(
        _LEADER_MODEL,
        brake_time=numbers.between("leader.brake_time", 5.0, 30.0),
        brake_decel=numbers.between("leader.brake_decel", softest, hardest),
    )
    gap = numbers.between("scenario.initial_gap", 2.0, 30.0)
    return Scenario(leader, gap, body=Body(-decel, 2.5)), _aggressive(low)


def emergency(low: float = -2.5, decel: float = 2.5, leader_decel: float = 4.5) -> Family:
    """From rest; the leader brakes to a standstill at a random time, brakes are weak.

    ``low`` is the hardest braking that can be commanded [m/s²], ``decel`` what the follower's
    brakes bring at most; a leader's full brake lies between 2.5 m/s² and ``leader_decel``.
    Unrevised, 97 % collide, 78 % of the time is a dead end.
    """
    return _emergency_as(emergency, low, decel, leader_decel)


def _emergency_as(
    told: Callable[..., Any], low: float, decel: float, leader_decel: float, softest: float = 2.5
) -> Family:
    make = partial(_emergency, low, decel, softest, leader_decel)
    return Family(*_told_by(told), make, low, 2.5, decel, leader_decel)


def _waves(numbers: Numbers, duration: float) -> tuple[tuple[float, float], ...]:
    """Accelerations of a leader who goes from a slow to a fast speed and back, from rest."""
    time, speed, waves = 0.0, 0.0, list[tuple[float, float]]()
    while time < duration:
        at = f"leader.traffic.{len(waves) // 4}"
        fast = numbers.between(f"{at}.fast", 8.0, 20.0)
        slow = numbers.one_of(f"{at}.slow", (0.0, None))
        slow = numbers.between(f"{at}.slow", 0.0, 6.0) if slow is None else slow
        accel = numbers.between(f"{at}.accel", 0.8, 2.0)
        decel = numbers.between(f"{at}.decel", 1.0, 3.5)
        cruise = numbers.between(f"{at}.cruise", 2.0, 8.0)
        pause = numbers.between(f"{at}.pause", 1.0, 5.0)
        for target, hold in ((fast, cruise), (slow, pause)):
            acceleration = accel if target > speed else -decel
            waves.append((time, acceleration))
            time += (target - speed) / acceleration
            waves.append((time, 0.0))
            time, speed = time + hold, target
    return tuple(waves)


def _stop_and_go(numbers: Numbers) -> tuple[Scenario, IDM]:
    """The leader goes in waves between slow and fast, and in some episodes stops hard.

    Unrevised, 61 % collide, 67 % of the time is a dead end.
    """
    stops = numbers.one_of("leader.brake_time", (False, True))
    leader = Leader(
        _LEADER_MODEL,  # only its waves are driven
        brake_time=numbers.between("leader.brake_time", 8.0, 30.0) if stops else math.inf,
        brake_decel=numbers.between("leader.brake_decel", 3.5, 4.5),
        waves=_waves(numbers, 35.0),
    )
    gap = numbers.between("scenario.initial_gap", 2.0, 20.0)
    return Scenario(leader, gap, body=Body(-2.5, 2.5)), _aggressive(-2.5)


def _cut_in(numbers: Numbers) -> tuple[Scenario, IDM]:
    """A slower car cuts in at a short gap, and may brake afterwards.

    Speeds are those of UN Regulation No. 157's first version, up to 60 km/h. Unrevised, 7 %
    collide, 3 % of the time is a dead end; 25 % are one at the cut-in, should that car brake by
    6 m/s² at once. Braking in full from the cut-in on avoids all but 0.25 %.
    """
    time = numbers.between("values.time", 2.0, 8.0)
    slower = numbers.between("values.slower", 0.0, 13.8889)  # at most to a standstill
    # A time to collision [s], and some.
    times = numbers.between("leader.cut_in.gap.times", 1.6, 3.0)
    gap = times * slower + numbers.between("leader.cut_in.gap.plus", 3.0, 8.0)
    speed = numbers.between("values.speed", 5.5556, 16.6667)  # 20 to 60 km/h
    brakes = numbers.one_of("leader.brake_time", (False, True))
    plus = numbers.between("leader.brake_time.plus", 0.5, 4.0) if brakes else math.inf
    leader = Leader(
        _LEADER_MODEL,
        initial_speed=speed,
        waves=((0.0, 0.0),),  # until then it keeps its speed
        brake_time=time + plus,
        brake_decel=numbers.between("leader.brake_decel", 3.0, 6.0),
        cut_in=CutIn(time, gap, max(0.0, speed - slower)),
    )
    return _at_speed(leader, 150.0, 25.0, speed)  # a free road at first


def _ncap(numbers: Numbers) -> tuple[Scenario, IDM]:
    """Euro NCAP's rear tests: a stationary, a slower and a braking car ahead.

    They are those of the AEB Car-to-Car protocol. The range of actions is what the paper's drivers
    brake by: by 2.5 m/s², 4 in 10 starts were dead ends; by 6, nobody would collide. Unrevised, 9 %
    collide, all in CCRb at 12 m and 6 m/s²; 2 % of the time is a dead end, no start is, and braking
    in full from the start avoids all.
    """
    # They keep their speeds, but for the leader of CCRb.
    keeps = partial(Leader, _LEADER_MODEL, waves=((0.0, 0.0),))
    if numbers.variant == 0:  # 10 to 80 km/h towards a standing car, 4 s before the impact
        speed = numbers.between("values.speed", 2.7778, 22.2222)
        leader, gap = keeps(brake_decel=6.0), 4.0 * speed
    elif numbers.variant == 1:  # 30 to 80 km/h towards one at 20 km/h, 4 s before
        speed = numbers.between("values.speed", 8.3333, 22.2222)
        leader, gap = keeps(brake_decel=6.0, initial_speed=5.5556), 4.0 * speed - 22.2222
    else:  # both at 50 km/h, it brakes by 2 or 6 m/s²
        speed = 13.8889
        decel = numbers.one_of("leader.brake_decel", (2.0, 6.0))
        leader = keeps(brake_decel=decel, brake_time=0.0, initial_speed=speed)
        gap = numbers.one_of("scenario.initial_gap", (12.0, 40.0))
    return _at_speed(leader, gap, 20.0, speed)


# Speeds of both cars [m/s], and the time headways [s] that the regulation allows at them.
_HEADWAYS = {7.2: 1.0, 10: 1.1, 20: 1.2, 30: 1.3, 40: 1.4, 50: 1.5, 60: 1.6}
_R157 = {f"{v:g} km/h": (round(v / 3.6, 4), headway) for v, headway in _HEADWAYS.items()}


def _r157(numbers: Numbers) -> tuple[Scenario, IDM]:
    """A leader at the shortest headway that UN R157 allows brakes by 6 m/s².

    By paragraph 5.2.3.3. Nothing is drawn: training and test are the same seven runs, but for what
    switches add. Unrevised, 60 km/h collides and the others do not; 3 % of the time is a dead end,
    no start is.
    """
    speed, headway = list(_R157.values())[numbers.variant]
    leader = Leader(_LEADER_MODEL, initial_speed=speed, brake_time=0.0, brake_decel=6.0)
    return _at_speed(leader, headway * speed, 15.0, speed)


def shift() -> Family:
    """The leader brakes to a standstill at a random time; the follower's brakes weaken unsaid.

    `emergency` with better brakes, and the same commands after the shift. Unrevised, 27 % collide
    before the shift and 99 % after it; 25 % and 80 % of the time is a dead end. Did leaders brake
    by 4.5 m/s² at most, no one would collide before.
    """
    before, after = (_emergency_as(shift, -4.5, decel, 6.0) for decel in (4.5, 2.5))
    return replace(before, shifted=after)


def shift_leader() -> Family:
    """The leader brakes to a standstill at a random time; from the shift on it brakes harder.

    Unrevised, 27 % collide before the shift and 99 % after it; 25 % and 60 % of the time is a dead
    end.
    """
    hardest = (6.0, 2.5), (9.0, 6.0)
    before, after = (_emergency_as(shift_leader, -4.5, 4.5, *leader) for leader in hardest)
    return replace(before, shifted=after)


def weak_brakes() -> Family:
    """The follower's brakes bring 3 m/s² whatever is commanded, the leader's up to 9.

    Else as `emergency`. Unrevised, 91 % collide, 74 % of the time is a dead end.
    """
    return _emergency_as(weak_brakes, -4.5, 3.0, 9.0)


def _rare(numbers: Numbers) -> tuple[Scenario, IDM | ChangingIDM]:
    """A careful driver, now and then careless for some seconds, behind leaders that may brake.

    Unrevised, 9 % collide, 1.5 % of the time is a dead end; without lapses none.
    """
    scenario, careless = _emergency(-4.0, 4.0, 2.5, 6.0, numbers)
    careful, lapses = _normal(-4.0), []
    for k in range(numbers.one_of("follower.lapses.count", (0, 1, 2))):
        start = numbers.between(f"follower.lapses.{k}.start", 8.0, 30.0)
        lapses.append((start, start + numbers.between(f"follower.lapses.{k}.duration", 2.0, 5.0)))
    changes: list[tuple[float, IDM]] = []
    for start, end in sorted(lapses):
        if changes and start <= changes[-1][0]:  # it goes on with the one before
            end = max(end, changes.pop()[0])
        else:
            changes.append((start, careless))
        changes.append((end, careful))
    return scenario, ChangingIDM(careful, tuple(changes)) if changes else careful


def _family(make: Make, decel: float, leader_decel: float, **how: Any) -> MakeFamily:
    """A family of which brakes bring what can be commanded."""
    return partial(Family, *_told_by(make), make, -decel, 2.5, decel, leader_decel, **how)


#: The families that come with the package, by name.
FAMILIES: Mapping[str, MakeFamily] = {
    "paper": _family(_paper, 4.0, 9.0, variants=_CASES, in_turn=True),
    "emergency": emergency,
    "stop_and_go": _family(_stop_and_go, 2.5, 4.5),
    "cut_in": _family(_cut_in, 4.0, 6.0),
    "ncap": _family(_ncap, 4.0, 6.0, variants=("CCRs", "CCRm", "CCRb")),
    "r157": _family(_r157, 4.0, 6.0, variants=tuple(_R157), in_turn=True),
    "shift": shift,
    "shift_leader": shift_leader,
    "weak_brakes": weak_brakes,
    "rare": _family(_rare, 4.0, 6.0),
}


def load_family(name: str | PathLike[str]) -> Family:
    """A family by its name, or from a file.

    Parameters
    ----------
    name : str or path
        One of `FAMILIES`, or a file of Python, which is run and defines a `Family` that is called
        ``family``; with some of `SWITCHES` behind a ``+`` each.

    Raises
    ------
    ValueError
        If there is no such family, switch or file, or the file defines no family.

    Examples
    --------
    >>> family = load_family("emergency")
    >>> family.decel, family.leader_decel, family.actions.n_actions
    (2.5, 4.5, 17)
    >>> scenario, controller, _ = family.draw(seed=1, index=0)
    >>> 2.0 <= scenario.initial_gap <= 30.0
    True
    >>> noisy = load_family("emergency+noise").draw(seed=1, index=0).scenario
    >>> noisy.sensors.gap_noise, noisy.initial_gap == scenario.initial_gap
    (0.5, True)
    """
    base, *switches = [str(name)] if Path(name).is_file() else str(name).split("+")
    if base in FAMILIES:
        return FAMILIES[base]().with_switches(switches)
    if not base.endswith(".py") or not Path(base).is_file():
        raise ValueError(f"no family or .py file is {base!r}; there are {', '.join(FAMILIES)}")
    return read_family(base, switches)


def read_family(path: str | Path, switches: Sequence[str] = ()) -> Family:
    """The ``family`` that a file of Python defines; a ValueError names the file."""
    with definitions_of(path) as definitions:
        definition = definitions.get("family")
        if not isinstance(definition, Family):
            raise ValueError("it defines no Family that is called family")
        family = replace(definition, source=str(path)).with_switches(switches)
        for version in filter(None, (family, family.shifted)):
            for variant in range(max(1, len(version.variants))):
                version.draw_by(Numbers(0, 0), variant)  # so that a mistake shows at once
    return family


@contextmanager
def definitions_of(path: str | Path) -> Iterator[dict[str, Any]]:
    """What a file of Python defines; it may import what is beside it, and errors name its line."""
    sys.path.insert(0, folder := str(Path(path).resolve().parent))
    try:
        yield runpy.run_path(str(path))
    except Exception as error:
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        text = str(error).removeprefix(f"{path}: ")
        raise ValueError(f"{line_of(error) or path}: {kind}{text}") from error
    finally:
        sys.path.remove(folder)


def line_of(error: BaseException) -> str:
    """Where in a file of one's own (`definitions_of`) an error came about; empty if elsewhere."""
    place = ""
    for step, line in walk_tb(error.__traceback__):
        if step.f_globals.get("__name__") == "<run_path>":
            place = f"{step.f_code.co_filename}, line {line}, in {step.f_code.co_name}"
    return place

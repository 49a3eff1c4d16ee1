"""A family of scenarios, read from a file and drawn by seed."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, MutableMapping
from dataclasses import MISSING, dataclass, fields, replace
from functools import cache, cached_property, partial
from importlib.resources import files
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from evofsm.driving.drivers import IDM, ChangingIDM
from evofsm.driving.families.numbers import Chance, GivenNumbers, Numbers
from evofsm.driving.families.tables import (
    LAYOUT,
    LONGEST,
    NEEDED,
    SWITCH_LAYOUT,
    Table,
    merge_tables,
    parse,
)
from evofsm.driving.naming import UNITS, VARIABLES
from evofsm.driving.scenarios import Behind, Body, CutIn, Leader, Scenario, Sensors
from evofsm.fsm import IntervalActions, Labels

#: The families that come with the package.
FAMILIES = (
    *("paper", "emergency", "stop_and_go", "cut_in", "ncap", "r157"),
    *("shift", "shift_leader", "weak_brakes", "rare"),
)

_SWITCHES = parse(
    files(__package__).joinpath("switches.toml").read_bytes(), "switches.toml", SWITCH_LAYOUT
)
#: What can be switched on in any family.
SWITCHES = tuple(_SWITCHES)

# More variants, lapses or waves of traffic are a mistake, and would never end.
_MOST = 10_000
# Numbers that are equal but for rounding.
_ROUNDING = 1e-9

Made = TypeVar("Made")


class Draw(NamedTuple):
    """One scenario of a family, and who drives the follower in it."""

    scenario: Scenario
    controller: IDM | ChangingIDM
    variant: str  #: name of the variant; that of the family where it has none


@dataclass(frozen=True, eq=False)
class Family:
    """Scenarios that are drawn by seed; `load_family` makes one.

    Parameters
    ----------
    name : str
    source : str
        The file, for error messages.
    tables : mapping
        What the file holds.
    added : tuple of mapping
        What a shift and switches put over it.
    is_shifted : bool
        Whether it is the family after its shift.

    Examples
    --------
    >>> family = load_family("shift")
    >>> family.shifted.decel, family.shifted.draw(0, 0).scenario.body.lowest
    (2.5, -2.5)
    >>> load_family("paper").cases, load_family("paper").draw(0, 6).variant
    (4, 'case 3')
    """

    name: str
    source: str
    tables: Table
    added: tuple[Table, ...] = ()
    is_shifted: bool = False

    @property
    def about(self) -> str:
        """What happens in it, in a sentence."""
        return str(self.tables["about"])

    @cached_property
    def actions(self) -> IntervalActions:
        """The set of actions; made with ``outside="clip"``."""
        return _make(
            IntervalActions, self.source, "actions", self.tables["actions"], outside="clip"
        )

    @property
    def interval(self) -> float:
        """Time between decisions [s]."""
        return float(self.tables["interval"])

    @property
    def labels(self) -> Labels:
        """What the numbers of a machine mean that drove it."""
        return Labels(self.actions, VARIABLES, UNITS, self.interval)

    @property
    def decel(self) -> float:
        """The follower's true hardest braking [m/s²], positive: for those who may know it."""
        return self._limit("decel")

    @property
    def leader_decel(self) -> float:
        """The hardest that any leader of the family brakes [m/s²], positive: likewise."""
        return self._limit("leader_decel")

    @property
    def variants(self) -> tuple[str, ...]:
        """Names of the variants; none where all draws are alike."""
        return tuple(
            variant.get("name", f"variant {number}")
            for number, variant in enumerate(self.tables.get("variant", ()), 1)
        )

    @property
    def cases(self) -> int:
        """How many variants come in turn, draw i being variant i % cases; 1 where none do."""
        return max(1, len(self.variants)) if self.tables.get("in_turn", False) else 1

    @property
    def shifted(self) -> Family | None:
        """The family after its shift, all else as before; None where nothing shifts."""
        if self.is_shifted or "shift" not in self.tables:
            return None
        return replace(self, added=(self.tables["shift"], *self.added), is_shifted=True)

    def with_switches(self, names: Iterable[str]) -> Family:
        """The family with some of `SWITCHES` on; what it draws is otherwise the same.

        Raises
        ------
        ValueError
            If there is no such switch.

        Examples
        --------
        >>> family = load_family("emergency").with_switches(["actuator", "jerk"])
        >>> family.draw(seed=0, index=0).scenario.body
        Body(lowest=-2.5, highest=2.5, delay=0.2, jerk=15.0)
        """
        switched = []
        for name in [names] if isinstance(names, str) else names:
            if name not in _SWITCHES:
                raise ValueError(f"there is no switch {name!r}; there are {', '.join(SWITCHES)}")
            switched.append(_SWITCHES[name])
        return replace(self, added=(*self.added, *switched))

    def draw(self, seed: int, index: int, split: str = "train") -> Draw:
        """One scenario: always the same for the same arguments.

        Parameters
        ----------
        seed, index : int
            From 0; each pair is another draw.
        split : {"train", "test"}
            Draws of one never are draws of the other.

        Returns
        -------
        Draw

        Raises
        ------
        ValueError
            If seed, index or split are none, or the file's numbers make no scenario.

        Examples
        --------
        >>> family = load_family("cut_in")
        >>> train, test = (family.draw(seed=1, index=0, split=s) for s in ("train", "test"))
        >>> train == family.draw(seed=1, index=0), train == test
        (True, False)
        """
        by_seed = partial(Numbers, seed=seed, index=index, split=split)
        if not self.variants:
            return self._draw(None, by_seed)
        if self.cases > 1:
            return self._draw(index % self.cases, by_seed)
        return self._draw(by_seed({}).below(len(self.variants), "variant"), by_seed)

    def draw_by(self, chance: Chance, drawn: MutableMapping[str, float] | None = None) -> Draw:
        """The scenario that given chances make, for whoever searches among all there are.

        Parameters
        ----------
        chance : callable
            Says for each place in the file that is drawn from, such as ``scenario.initial_gap``, a
            number from 0 up to 1: 0 is the lower end of a range, 0.5 its middle. Independent and
            evenly distributed ones make draws as `draw` does; which of the variants it is, is drawn
            from ``variant``.
        drawn : mapping, optional
            Where each number that was drawn is put, by its place: from a range the number itself,
            of several its index, from 0.

        Returns
        -------
        Draw

        Raises
        ------
        ValueError
            If a chance is out of its range, or the file's numbers make no scenario.

        Examples
        --------
        >>> draw = load_family("emergency").draw_by(lambda where: 0.5)
        >>> draw.scenario.initial_gap, draw.scenario.leader.brake_decel
        (16.0, 3.5)
        """
        given = partial(GivenNumbers, chance=chance, drawn=drawn)
        n = len(self.variants)
        return self._draw(given({}).below(n, "variant") if n else None, given)

    def _draw(self, variant: int | None, numbers_of: Callable[[Table], Numbers]) -> Draw:
        tables = self.tables
        own = () if variant is None else (tables["variant"][variant],)
        for changes in (*own, *self.added):
            tables = merge_tables(tables, changes)
        numbers = numbers_of(tables.get("values", {}))
        builder = _Builder(self.source, tables, numbers)
        try:
            draw = Draw(
                builder.scenario(),
                builder.controller(),
                self.name if variant is None else self.variants[variant],
            )
        except ValueError as error:
            raise _naming(self.source, error) from None
        self._check_limits(draw)
        return draw

    def _limit(self, name: str) -> float:
        limit = self.tables["limits"][name]
        for changes in self.added:
            limit = changes.get("limits", {}).get(name, limit)
        return float(limit)

    def _check_limits(self, draw: Draw) -> None:
        """Who is told the limits must be able to rely on them."""
        leader, body = draw.scenario.leader, draw.scenario.body
        leader_brakes = max([leader.brake_decel, *(-wave for _, wave in leader.waves)])
        if leader_brakes > self.leader_decel + _ROUNDING:
            raise ValueError(
                f"{self.source}: a leader brakes by {leader_brakes:g} m/s², but "
                f"limits.leader_decel is {self.leader_decel:g}"
            )
        proposed = float(draw.controller.parameters[:, 7].min())
        commanded = min(self.actions.low, proposed)
        brakes = -max(body.lowest, commanded)
        if brakes > self.decel + _ROUNDING:
            raise ValueError(
                f"{self.source}: the follower can brake by {brakes:g} m/s², but limits.decel is "
                f"{self.decel:g}; bound its body, or the driver and the actions"
            )


def load_family(name: str | PathLike[str]) -> Family:
    """A family by its name, or from a file.

    Parameters
    ----------
    name : str or path
        One of `FAMILIES`, with some of `SWITCHES` behind a ``+`` each; or the path of a TOML
        file, or of a JSON file that ends in ``.json``.

    Returns
    -------
    Family

    Raises
    ------
    ValueError
        If there is no such family, switch or file, or the file is not TOML or JSON, or holds a
        name or a kind of value that no family knows.

    Examples
    --------
    >>> family = load_family("emergency")
    >>> family.decel, family.leader_decel, family.actions.n_actions
    (2.5, 4.5, 17)
    >>> scenario, controller, _ = family.draw(seed=1, index=0)
    >>> 2.0 <= scenario.initial_gap <= 30.0
    True
    >>> family.draw(seed=1, index=0) == (scenario, controller, "emergency")
    True
    >>> noisy = load_family("emergency+noise").draw(seed=1, index=0).scenario
    >>> noisy.sensors.gap_noise, noisy.initial_gap == scenario.initial_gap
    (0.5, True)
    """
    base, *switches = str(name).split("+")
    if switches and base in FAMILIES:
        return load_family(base).with_switches(switches)
    if name in FAMILIES:
        source = f"{name}.toml"
        text = files(__package__).joinpath(source).read_bytes()
    else:
        path, source = Path(name), str(name)
        if not path.is_file():
            raise ValueError(
                f"there is no family {source!r}; there are {', '.join(FAMILIES)}, or name a TOML "
                "or JSON file that exists"
            )
        with path.open("rb") as file:
            text = file.read(LONGEST + 1)
    tables = parse(text, source, LAYOUT)
    for needed in NEEDED:
        if needed not in tables:
            raise ValueError(f"{source}: {needed} is missing")
    family = Family(Path(source).stem, source, tables)
    _try_out(family)
    return family


def _try_out(family: Family) -> None:
    """Draw every variant once, so that a mistake shows when the file is read."""
    for limit in ("decel", "leader_decel"):
        if not family.tables["limits"].get(limit, 0.0) > 0.0:
            raise ValueError(f"{family.source}: limits.{limit} is missing, or not positive")
    if not family.interval > 0.0:
        raise ValueError(f"{family.source}: interval is {family.interval}; it must be positive")
    if len(family.variants) > _MOST:
        raise ValueError(f"{family.source}: more than {_MOST:,} variants")
    variants = range(len(family.variants)) if family.variants else [None]
    for one, variant in itertools.product((family, family.shifted), variants):
        if one is not None:
            one._draw(variant, partial(Numbers, seed=0, index=0))


class _Builder:
    """Makes a scenario and its driver from tables, drawing numbers on the way."""

    def __init__(self, source: str, tables: Table, numbers: Numbers) -> None:
        self.source = source
        self.tables = tables
        self.numbers = numbers

    def scenario(self) -> Scenario:
        behind = None
        if "behind" in self.tables:
            behind = self._make(Behind, "behind", driver=self._driver("behind"))
        told = self.tables.get("sensors", {}).get("seed")
        seed = self.numbers.below(2**32, "sensors.seed") if told is None else int(told)
        return self._make(
            Scenario,
            "scenario",
            leader=self._leader(),
            body=self._make(Body, "body"),
            sensors=self._make(Sensors, "sensors", seed=seed),
            behind=behind,
        )

    def controller(self) -> IDM | ChangingIDM:
        """The follower's driver, with its changes and its lapses."""
        follower = self.tables["follower"]
        first = self._driver("follower")
        changes = [
            (self.numbers.draw(at, f"follower.changes.{k}"), self._idm(name, "follower.changes"))
            for k, (at, name) in enumerate(follower.get("changes", ()))
        ]
        if "lapses" in follower:
            changes = _with_lapses(
                first, changes, self._driver("follower.lapses"), self._lapses(follower["lapses"])
            )
        return ChangingIDM(first, tuple(changes)) if changes else first

    def _leader(self) -> Leader:
        leader = self.tables["leader"]
        cut_in = self._make(CutIn, "leader.cut_in") if "cut_in" in leader else None
        if "waves" in leader and "traffic" in leader:
            raise ValueError("leader has waves and traffic; it must have one of them")
        waves = tuple(
            (
                self.numbers.draw(at, f"leader.waves.{k}.at"),
                self.numbers.draw(acceleration, f"leader.waves.{k}"),
            )
            for k, (at, acceleration) in enumerate(leader.get("waves", ()))
        )
        made = self._make(
            Leader, "leader", driver=self._driver("leader"), waves=waves, cut_in=cut_in
        )
        if "traffic" not in leader:
            return made
        duration = self.numbers.draw(
            self.tables["scenario"].get("duration", Scenario.duration), "scenario.duration"
        )
        return replace(made, waves=self._traffic(made.initial_speed, duration))

    def _traffic(self, speed: float, duration: float) -> tuple[tuple[float, float], ...]:
        """Accelerations of a leader who goes from a slow to a fast speed, and so on."""
        time, waves = 0.0, []
        for k in itertools.count():
            wave = {
                name: self._one(f"leader.traffic.{name}", f"leader.traffic.{k}.{name}")
                for name in ("fast", "slow", "accel", "decel", "cruise", "pause")
            }
            for name, value in wave.items():
                if not value >= 0.0 or (value == 0.0 and name != "slow"):
                    raise ValueError(f"leader.traffic.{name} is {value:g}; it must be positive")
            for wanted, hold in ((wave["fast"], wave["cruise"]), (wave["slow"], wave["pause"])):
                acceleration = wave["accel"] if wanted > speed else -wave["decel"]
                waves.append((time, acceleration))
                time += (wanted - speed) / acceleration
                waves.append((time, 0.0))
                time, speed = time + hold, wanted
            if time >= duration:
                break
            if k == _MOST:
                raise ValueError(f"leader.traffic has more than {_MOST:,} waves in {duration:g} s")
        return tuple(waves)

    def _lapses(self, table: Table) -> list[tuple[float, float]]:
        """Begin and end of each lapse, in order; those that meet are one."""
        count = self._one("follower.lapses.count")
        if not 0 <= count <= _MOST or count != round(count):
            raise ValueError(
                f"follower.lapses.count is {count:g}; it must be whole numbers up to {_MOST:,}"
            )
        for name in ("start", "duration"):
            if name not in table:
                raise ValueError(f"follower.lapses.{name} is missing")
        lapses = []
        for k in range(int(count)):
            start, duration = (
                self.numbers.draw(table[name], f"follower.lapses.{k}.{name}")
                for name in ("start", "duration")
            )
            lapses.append((start, start + duration))
        apart: list[tuple[float, float]] = []
        for start, end in sorted(lapses):
            if apart and start <= apart[-1][1]:
                apart[-1] = (apart[-1][0], max(end, apart[-1][1]))
            else:
                apart.append((start, end))
        return apart

    def _driver(self, key: str) -> IDM:
        return self._idm(self._table(key).get("driver"), f"{key}.driver")

    def _idm(self, name: str | None, where: str) -> IDM:
        if name is None:
            raise ValueError(f"{where} is missing")
        if name not in self.tables["drivers"]:
            known = ", ".join(self.tables["drivers"])
            raise ValueError(f"{where} is {name!r}, but drivers are: {known}")
        return self._make(IDM, f"drivers.{name}")

    def _one(self, key: str, stream: str | None = None) -> float:
        table, _, name = key.rpartition(".")
        if name not in self._table(table):
            raise ValueError(f"{key} is missing")
        return self.numbers.draw(self._table(table)[name], stream or key)

    def _table(self, key: str) -> Table:
        table: Any = self.tables
        for name in key.split("."):
            table = table.get(name, {})
        return dict(table)

    def _make(self, made: type[Made], key: str, **others: Any) -> Made:
        known = _parts(made)  # type: ignore[arg-type]
        table = {
            name: value
            for name, value in self._table(key).items()
            if name in known and name not in others
        }
        drawn = {name: self.numbers.draw(value, f"{key}.{name}") for name, value in table.items()}
        return _make(made, self.source, key, drawn, **others)


def _make(made: type[Made], source: str, key: str, table: Table, **others: Any) -> Made:
    """Make something from a table; who gets it wrong is told where."""
    for name, is_needed in _parts(made).items():  # type: ignore[arg-type]
        if is_needed and name not in table and name not in others:
            raise ValueError(f"{source}: {key}.{name} is missing")
    try:
        return made(**table, **others)
    except ValueError as error:
        raise ValueError(f"{source}: {key}: {error}") from None


@cache
def _parts(made: type) -> dict[str, bool]:
    """The parts of what is made from a table, and whether each is needed."""
    return {
        part.name: part.default is MISSING and part.default_factory is MISSING
        for part in fields(made)
    }


def _naming(source: str, error: ValueError) -> ValueError:
    """The error, with the file's name in front."""
    text = str(error)
    return ValueError(text if text.startswith(f"{source}: ") else f"{source}: {text}")


def _with_lapses(
    first: IDM,
    changes: list[tuple[float, IDM]],
    lapsed: IDM,
    lapses: list[tuple[float, float]],
) -> list[tuple[float, IDM]]:
    """Changes of a driver who now and then drives like another, and then as is due."""

    def due(time: float) -> IDM:
        return [first, *(driver for at, driver in changes if at <= time)][-1]

    outside = [
        (at, driver)
        for at, driver in changes
        if not any(start <= at < end for start, end in lapses)
    ]
    inside = [change for start, end in lapses for change in ((start, lapsed), (end, due(end)))]
    return sorted(outside + inside, key=lambda change: change[0])

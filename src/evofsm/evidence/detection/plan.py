"""What is watched and judged: how much of it, and in which worlds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

from evofsm.driving import Draw, Family, load_family, merge, training

#: What is judged if nothing else is asked for; see `world`.
FAMILIES = (
    *("paper", "emergency", "stop_and_go", "cut_in", "ncap", "r157"),
    *("weak_brakes", "rare", "shift", "shift-at-once", "emergency+noise"),
)
#: Name of the worlds of the grid, in which nobody knows the limits: see `grid_world`.
GRID = "grid"

_AT_ONCE = "-at-once"
_PAPER = Path(__file__).with_name("paper_drawn.toml")


@dataclass(frozen=True)
class Plan:
    """How much is driven."""

    train: int = 100  #: episodes that are watched before anything is judged
    since: int = 20  #: episodes that are watched after a shift
    seeds: int = 20  #: learning seeds; the first one's are the rows, the others their spread
    seed: int = 0  #: of everything
    hours: float = 3.0  #: of held-out driving, and as many to choose thresholds on
    long_hours: float = 30.0  #: the same in the families of `long`
    long: tuple[str, ...] = ("paper", "emergency")
    rounds: int = 200  #: of the bootstrap
    seed_hours: float = 0.5  #: of held-out driving for each of the other learning seeds
    grid: tuple[float, ...] = (2.0, 3.0, 4.0, 5.0, 6.0)  #: own brakes in the grid [m/s²]
    grid_leader: tuple[float, ...] = (3.0, 4.5, 6.0, 7.5, 9.0)  #: leaders' hardest [m/s²]
    grid_train: int = 20  #: episodes that are watched in each world of the grid
    grid_hours: float = 0.5  #: of held-out driving in each

    def shortened(self) -> Plan:
        """A look, not evidence: just enough for one false alarm per hour to be measurable."""
        return replace(
            self,
            train=min(self.train, 40),
            seeds=min(self.seeds, 2),
            hours=min(self.hours, 0.5),
            long_hours=min(self.long_hours, 3.0),
            rounds=min(self.rounds, 40),
            seed_hours=0.2,
            grid=(2.0, 4.0, 6.0),
            grid_leader=(3.0, 6.0, 9.0),
            grid_hours=0.2,
        )

    def hours_of(self, name: str) -> float:
        """How long a family is driven [h]."""
        return self.long_hours if name in self.long else self.hours


@dataclass(frozen=True, eq=False)
class World:
    """Where something is judged, and what may be watched before."""

    name: str
    family: Family  #: that is judged
    watched: Family  #: that is watched first; another one where the world shifts
    since: int  #: episodes of ``family`` that are watched after that
    settled: Family  #: on which thresholds are chosen

    def training(self, plan: Plan, learning_seed: int) -> Iterator[tuple[Family, Draw]]:
        """What one learner watches, with the family that each draw is of."""
        train = plan.grid_train if self.name == GRID else plan.train
        first = training(self.watched, plan.seed, learning_seed, train)
        then = training(self.family, plan.seed, learning_seed, self.since, first=train)
        return chain(
            ((self.watched, draw) for draw in first), ((self.family, draw) for draw in then)
        )


def world(name: str, plan: Plan) -> World:
    """A world by its name.

    ``emergency+noise`` is a family with a switch on. A family that shifts is judged after its
    shift, with some episodes watched since; ``shift-at-once`` is the same with none, and with
    thresholds from before it. ``paper`` is the paper's four cases with what it leaves open drawn.

    Raises
    ------
    ValueError
        If there is no such family or switch.

    Examples
    --------
    >>> at_once = world("shift-at-once", Plan())
    >>> at_once.watched.decel, at_once.family.decel, at_once.since
    (4.5, 2.5, 0)
    """
    base, *switches = name.split("+")
    at_once = base.endswith(_AT_ONCE)
    family = _family(base.removesuffix(_AT_ONCE)).with_switches(switches)
    shifted = family.shifted
    if at_once and shifted is None:
        raise ValueError(f"family {family.name!r} has no shift, so there is no {name!r}")
    if shifted is None:
        return World(name, family, family, 0, family)
    return World(
        name, shifted, family, 0 if at_once else plan.since, family if at_once else shifted
    )


def _family(name: str) -> Family:
    return replace(load_family(_PAPER), name=name) if name == "paper" else load_family(name)


def grid_world(decel: float, leader_decel: float, plan: Plan) -> World:
    """As `emergency`, but with brakes of anyone's choice; commands always reach further.

    Parameters
    ----------
    decel, leader_decel : float
        Hardest braking of the follower, and of leaders, who draw theirs from 2.5 m/s² on [m/s²].
    plan : Plan

    Examples
    --------
    >>> cell = grid_world(3.0, 6.0, Plan()).family
    >>> cell.decel, cell.leader_decel, cell.actions.low
    (3.0, 6.0, -6.0)
    """
    emergency = load_family("emergency")
    lowest = -max(plan.grid)
    changes = {
        "actions": {"low": lowest},
        "limits": {"decel": decel, "leader_decel": leader_decel},
        "body": {"lowest": -decel},
        "leader": {"brake_decel": [2.5, leader_decel]},
        "drivers": {"aggressive": {"lowest": lowest}},
    }
    family = replace(emergency, name=GRID, tables=merge(emergency.tables, changes))
    return World(GRID, family, family, 0, family)

"""In which worlds something is watched and judged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

from evofsm.driving import FAMILIES, Draw, Family, load_family, training
from studies.detection import paper_drawn
from studies.detection.amounts import Amounts

#: Name of the worlds of the grid, in which nobody knows the limits: see `grid_world`.
GRID = "grid"

_AT_ONCE = "-at-once"


@dataclass(frozen=True, eq=False)
class World:
    """Where something is judged, and what may be watched before."""

    name: str
    family: Family  #: that is judged
    watched: Family  #: that is watched first; another one where the world shifts
    since: int  #: episodes of ``family`` that are watched after that
    settled: Family  #: on which thresholds are chosen

    def training(self, plan: Amounts, learning_seed: int) -> Iterator[tuple[Family, Draw]]:
        """What one learner watches, with the family that each draw is of."""
        train = plan.grid_train if self.name == GRID else plan.train
        first = training(self.watched, plan.seed, learning_seed, train)
        then = training(self.family, plan.seed, learning_seed, self.since, first=train)
        return chain(
            ((self.watched, draw) for draw in first), ((self.family, draw) for draw in then)
        )


def world(name: str, plan: Amounts) -> World:
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
    >>> at_once = world("shift-at-once", Amounts())
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
    return paper_drawn.family if name == "paper" else load_family(name)


def grid_world(decel: float, leader_decel: float, plan: Amounts) -> World:
    """As `emergency`, but with brakes of anyone's choice; commands always reach further.

    Parameters
    ----------
    decel, leader_decel : float
        Hardest braking of the follower, and of leaders, who draw theirs from 2.5 m/s² on [m/s²].
    plan : Amounts

    Examples
    --------
    >>> cell = grid_world(3.0, 6.0, Amounts()).family
    >>> cell.decel, cell.leader_decel, cell.actions.low
    (3.0, 6.0, -6.0)
    """
    made = FAMILIES["emergency"](-max(plan.grid), decel, leader_decel)
    family = replace(made, name=GRID)
    return World(GRID, family, family, 0, family)

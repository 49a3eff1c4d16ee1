"""The guard of cars where nobody gave one: what is assumed, on a log as beside a stack."""

from __future__ import annotations

from typing import Any

from evofsm.driving.cars import guard_for_cars
from evofsm.driving.judge import LatentRisk
from evofsm.driving.leaders import REAL_DRIVES
from evofsm.driving.traffic import TrafficRisk, guard_for_traffic
from evofsm.fsm.validation import positive
from evofsm.guard import TOLERANCE, Guard, Mode

#: The strongest acceleration that may be proposed where no guard is given [m/s²].
HIGHEST = 2.5
# As hard a leader brakes in full [m/s²].
_FULL = 10.0
#: Leaders' brakes where no guard is given. Nobody brakes in an emergency in public drives, which
#: does not say that nobody does: with the one that a judge assumes anyway one in 20 is in full.
LEADERS = REAL_DRIVES._replace(counts=(*REAL_DRIVES.counts, *(0,) * 14, 4))


def guard_of_monitor(interval: float, brakes: float, tolerance: float = TOLERANCE) -> Guard:
    """A guard of car following that is given how hard its car brakes, in shadow mode."""
    settings: dict[str, Any] = {"tolerance": tolerance, "mode": Mode.SHADOW}
    return guard_for_cars(-brakes, HIGHEST, interval, judge=_ahead(interval, brakes), **settings)


def guard_of_traffic(interval: float, brakes: float, tolerance: float = TOLERANCE) -> Guard:
    """The same among any number of objects, who is behind included; it learns nothing."""
    judge = TrafficRisk(_ahead(interval, brakes))
    settings: dict[str, Any] = {"tolerance": tolerance, "mode": Mode.SHADOW}
    return guard_for_traffic(-brakes, HIGHEST, brakes, interval, judge=judge, **settings)


def assumptions(brakes: float, tolerance: float) -> str:
    """What such a guard reckons with, in a line."""
    share = (1 + LEADERS.counts[-1]) / (1 + sum(LEADERS.counts))
    return (
        f"assumed: the own car brakes with {brakes:g} m/s² (--brakes), {share:.0%} of leaders' "
        f"hard brakes are in full ({_FULL:g} m/s²), the others as in public drives; "
        f"a risk of {tolerance:.3g} is accepted (--tolerance)"
    )


def _ahead(interval: float, brakes: float) -> LatentRisk:
    braking, step = positive("brakes", brakes), positive("interval", interval)
    return LatentRisk.given(-braking, braking, _FULL, step, leaders=LEADERS)

"""The guard of a monitor that is given none."""

from __future__ import annotations

from evofsm.driving import REAL_DRIVES, LatentRisk, TrafficRisk, guard_for_cars, guard_for_traffic
from evofsm.fsm import positive
from evofsm.guard import Guard, Mode

# The strongest acceleration that may be proposed [m/s²].
_HIGHEST = 2.5
# The weight of one brake so hard that is taken to have been seen beside those of the table [m/s²].
_HARDEST = 10.0
_QUIET = Mode.SHADOW


def guard_of_monitor(interval: float, brakes: float) -> Guard:
    """A guard of car following that is told how hard its car brakes, in shadow mode.

    How hard leaders brake it begins with from public drives (`evofsm.driving.REAL_DRIVES`).

    Parameters
    ----------
    interval : float
        Time between two rows [s].
    brakes : float
        Hardest braking of the own car [m/s²].

    Examples
    --------
    >>> guard = guard_of_monitor(interval=0.1, brakes=6.0)
    >>> guard.decide([60.0, 20.0, 20.0], proposal=0.0).reason
    'never seen before; risk is within the tolerance'
    """
    return guard_for_cars(-brakes, _HIGHEST, interval, judge=_ahead(interval, brakes), mode=_QUIET)


def guard_of_traffic(interval: float, brakes: float) -> Guard:
    """The same among any number of objects, who is behind included; it learns nothing.

    Parameters
    ----------
    interval : float
        Time between two scenes [s].
    brakes : float
        Hardest braking of the own car [m/s²].

    Examples
    --------
    >>> guard_of_traffic(interval=0.1, brakes=6.0).reviser.mode
    <Mode.SHADOW: 'shadow'>
    """
    judge = TrafficRisk(_ahead(interval, brakes), -brakes, _HIGHEST)
    return guard_for_traffic(-brakes, _HIGHEST, brakes, interval, judge=judge, mode=_QUIET)


def _ahead(interval: float, brakes: float) -> LatentRisk:
    return LatentRisk.told(
        -positive("brakes", brakes),
        brakes,
        _HARDEST,
        positive("interval", interval),
        leaders=REAL_DRIVES,
    )

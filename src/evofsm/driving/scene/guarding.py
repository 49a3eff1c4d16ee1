"""A guard for a car among others."""

from __future__ import annotations

from typing import Any

from evofsm.driving.scene.risk import TrafficRisk
from evofsm.fsm import IntervalActions
from evofsm.guard import TOLERANCE, ActionReviser, Guard, Mode

# Of an interval of accelerations [m/s²].
_WIDTH = 0.3


def guard_for_traffic(
    low: float,
    high: float,
    decel: float,
    interval: float,
    *,
    judge: TrafficRisk | None = None,
    tolerance: float = TOLERANCE,
    mode: Mode = Mode.ACT,
    **settings: Any,
) -> Guard:
    """A guard for a car among others; it observes `Scene.rows` and decides on the acceleration.

    Parameters
    ----------
    low, high : float
        The hardest braking that can be commanded, negative, and the hardest acceleration [m/s²].
    decel : float
        Braking that is counted on [m/s²], positive; softer than ``low``, it is begun earlier.
    interval : float
        Time between two decisions [s].
    judge : TrafficRisk, optional
        Without one it is told these limits.
    tolerance : float
        Highest risk that is accepted, in (0, 1).
    mode : Mode
    **settings
        As in `TrafficRisk.told`: ``leader_decel``, ``behind_decel``, ``reaction``.

    Returns
    -------
    Guard
        It recognises no states, and learns nothing.

    Examples
    --------
    >>> from evofsm.driving import Object, Scene
    >>> guard = guard_for_traffic(low=-9.0, high=2.6, decel=4.5, interval=0.1)
    >>> alone = Scene(Object("me", 0.0, 0.0, 14.0))
    >>> guard.decide(alone.rows(most=4), proposal=1.0).executed
    1.0
    """
    judge = judge or TrafficRisk.told(low, high, decel, interval, **settings)
    actions = IntervalActions(low, high, _WIDTH, outside="clip")
    reviser = ActionReviser(judge, actions, tolerance=tolerance, mode=mode)
    return Guard.of(reviser, interval=interval, learn=False)

"""The dynamics and the guard that a learnt judge needs, for any set of actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from evofsm.fsm import DYNAMICS_PARTS, Dynamics
from evofsm.guard.actions import ActionSet, Choices, limits

#: Steps of a stretch where nobody says how far ahead to look.
LONGEST_STRETCH = 144
# Stretches that are remembered.
_STRETCHES = 10


def dynamics_for(
    actions: ActionSet, horizon: int | None = None, without: Sequence[str] = ()
) -> Dynamics:
    """Dynamics that learn what such actions do.

    Parameters
    ----------
    actions : ActionSet
    horizon : int, optional
        Steps of what is remembered; without it as many as turn out to matter.
    without : sequence of str
        Parts that are left out.
    """
    told: dict[str, Any] = {"horizon": LONGEST_STRETCH if horizon is None else horizon}
    told |= {
        "stretches": _STRETCHES,
        "without": [part for part in without if part in DYNAMICS_PARTS],
    }
    if isinstance(actions, Choices):
        return Dynamics(n_actions=actions.n_actions, **told)
    low, high = limits(actions)
    return Dynamics(low, high, **told)

"""A car that SUMO itself would drive: what its car-following model wishes, before it is done.

The wish is asked for, not carried out, so that it can be revised like any other proposal.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.worlds.sumo import SumoWorld
from evofsm.guard import Proposal

#: What every model takes: attributes of SUMO's ``vType``.
COMMON = ("accel", "decel", "emergencyDecel", "tau", "minGap", "maxSpeed", "speedFactor")
#: The models there are, and what each takes besides.
MODELS: dict[str, tuple[str, ...]] = {
    "IDM": ("delta", "stepping"),
    "Krauss": (),
    "KraussOrig1": (),
    "ACC": (
        *("speedControlGain", "gapControlGainSpeed", "gapControlGainSpace"),
        *("gapClosingControlGainSpeed", "gapClosingControlGainSpace"),
        *("collisionAvoidanceGainSpeed", "collisionAvoidanceGainSpace"),
    ),
    "CACC": (
        *("speedControlGainCACC", "gapControlGainGap", "gapControlGainGapDot"),
        *("gapClosingControlGainGap", "gapClosingControlGainGapDot"),
        *("collisionAvoidanceGainGap", "collisionAvoidanceGainGapDot"),
    ),
}
_MAY_BE_ANYTHING = {name for names in MODELS.values() for name in names} - {"stepping"}
_MAY_BE_ZERO = {"tau", "minGap"}


class SumoDriver:
    """A follower with the car-following model of SUMO, for use in one `SumoWorld`.

    It proposes what SUMO would do in its next step: the wish of the model, within the ``accel``
    and ``emergencyDecel`` of the car and up to its speed limit. On its own it drives as SUMO does,
    to the last digit; under a reviser, what is executed is carried out exactly.

    Parameters
    ----------
    world : SumoWorld
        Where it drives. Make the driver before the road is opened.
    model : str
        One of `MODELS`.
    leader_decel : float
        How hard it takes the leader to be able to brake [m/s²]; SUMO's preset for a passenger car.
        Krauss' models rely on it, IDM does not.
    **attributes : float
        Of SUMO's ``vType``, such as ``accel``, ``decel``, ``tau``, ``minGap``, ``maxSpeed`` (the
        desired speed on a free road: the road itself allows 100 m/s), ``emergencyDecel``, each in
        SUMO's unit, which is SI. What is not given is SUMO's preset.

    Raises
    ------
    TypeError
        If ``world`` is another one than SUMO.
    ValueError
        If there is no such model or attribute, or a value is impossible.

    Notes
    -----
    The acceleration is that of one step of the simulation: ``(wished speed - speed) / dt``. Whoever
    decides more rarely holds it for longer than SUMO would. As SUMO wishes for no speed below 0,
    it never brakes harder than to a standstill within the step; and where the step is longer than
    ``stepping`` (0.25 s), SUMO's IDM takes several smaller ones in it.

    The models are those whose wish, read before the step, is what SUMO then does. It is not for
    EIDM, PWagner2009, SmartSK and Daniel1, which draw at random or remember being asked; nor for
    Wiedemann on a free road; W99 has an acceleration of its own. Dawdling (``sigma``) is no wish:
    SUMO adds it later.

    Examples
    --------
    >>> from evofsm.driving import IDM, Leader, Scenario
    >>> leader = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=5.0, brake_time=8.0)
    >>> with SumoWorld() as world:
    ...     driver = SumoDriver(world, "Krauss", accel=2.0, decel=4.0, tau=1.0, minGap=2.0)
    ...     episode = world.run(Scenario(leader, initial_gap=10.0, duration=20.0), driver)
    >>> episode.collided, float(round(episode.accelerations[0], 6))
    (False, 2.0)
    """

    def __init__(
        self,
        world: SumoWorld,
        model: str = "IDM",
        *,
        leader_decel: float = 4.5,
        **attributes: float,
    ) -> None:
        if not isinstance(world, SumoWorld):
            raise TypeError(f"world is {world!r}; a SUMO-driven car drives in a SumoWorld only")
        _refuse_impossible(model, leader_decel, attributes)
        self.world = world
        self.model = model
        self.leader_decel = leader_decel
        self.attributes = dict(attributes)
        given = {name: repr(float(value)) for name, value in attributes.items()}
        # What SUMO would draw at random is fixed.
        fixed = {"carFollowModel": model, "speedFactor": "1", "speedDev": "0", "sigma": "0"}
        self._kind = world.add_kind(fixed | given)

    def propose(self, observation: NDArray[np.float64], time: float = 0.0) -> Proposal:
        """What SUMO would do in its next step [m/s²], seeing ``[gap, v_follower, v_leader]``.

        Raises
        ------
        RuntimeError
            If this is not asked on the open road of the driver's own world, at its present time.
        """
        return Proposal(self.world.wish(self._kind, observation, time, self.leader_decel))


def _refuse_impossible(model: str, leader_decel: float, attributes: dict[str, float]) -> None:
    if model not in MODELS:
        raise ValueError(f"there is no model {model!r} here; there are {', '.join(MODELS)}")
    known = (*COMMON, *MODELS[model])
    for name, value in {"leader_decel": leader_decel, **attributes}.items():
        if name not in ("leader_decel", *known):
            raise ValueError(f"{model} takes no attribute {name!r}; it takes {', '.join(known)}")
        if not math.isfinite(value):
            raise ValueError(f"{name} is {value}; it must be finite")
        if name in _MAY_BE_ZERO and value < 0.0:
            raise ValueError(f"{name} is {value}; it must be 0 or more")
        if name not in _MAY_BE_ZERO | _MAY_BE_ANYTHING and value <= 0.0:
            raise ValueError(f"{name} is {value}; it must be positive")

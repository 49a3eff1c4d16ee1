"""A guard as a wrapper: any Gymnasium environment is driven under it.

Whoever acts, a policy that was trained or one that is being trained, keeps its environment. What
it does is revised before it is executed, and what comes of it is learnt.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from typing import Any, SupportsFloat

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.extras import needs
from evofsm.guard.guard import Guard
from evofsm.guard.protocols import Proposal, Revision
from evofsm.guard.record import info_of
from evofsm.guard.reviser import make_usable, unjudged_revision

with needs("gymnasium", "gym", "a wrapper for Gymnasium"):
    import gymnasium
    from gymnasium.spaces import Box, Discrete


class RevisedActions(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Executes what a guard makes of the actions, and forwards all else as it is.

    The guard learns while the environment is driven. In ``info`` stand
    ``reviser/proposed_action`` and ``reviser/executed_action``, both as the environment takes
    them, ``reviser/reason``, and ``reviser/risk``, the probability of failure under what is
    executed (``reviser/risk_proposed`` under what was proposed; NaN where none was judged).
    All else that is known of the latest decision is in `revision`.

    Parameters
    ----------
    env : gymnasium.Env
        A step of it is one decision, ``guard.interval`` long [s].
    guard : Guard
        What is executed lies in its set of actions always.
    observe : callable, optional
        From an observation of ``env`` to what the guard observes; to None where there is nothing
        to judge, such as no car ahead: then nothing is revised, and nothing learnt. Without it the
        observation is taken as it is.
    failed : callable, optional
        From the ``info`` of a step to whether it ended in failure. Without it the guard's own
        function says so, or nothing does.
    to_acceleration : callable, optional
        From an action of ``env`` to one of the guard. Where it is one number, or an index, it is
        taken for that.
    to_action : callable, optional
        From an action of the guard to one of ``env``.

    Raises
    ------
    ValueError
        If an action of ``env`` is not one number and it was not told how to convert it, or if only
        one of the two conversions is given.

    Notes
    -----
    A proposal that is kept is passed on untouched, without being converted back and forth. With a
    failure the episode is over for the guard, also where the environment would go on. A failure
    right after nothing was to be judged is no one's consequence: it is not counted.

    Examples
    --------
    >>> from evofsm.driving import CarFollowing, guard_for_family
    >>> env = CarFollowing()
    >>> guard = guard_for_family(env.family)
    >>> env = RevisedActions(env, guard, failed=lambda info: info["failed"])
    >>> observation, info = env.reset(seed=1)
    >>> full_throttle, over = env.action_space.high, False
    >>> while not over:
    ...     observation, reward, terminated, truncated, info = env.step(full_throttle)
    ...     over = terminated or truncated
    >>> info["failed"]
    False
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        guard: Guard,
        observe: Callable[[Any], ArrayLike | None] = lambda observation: observation,
        failed: Callable[[dict[str, Any]], bool] = lambda info: False,
        *,
        to_acceleration: Callable[[Any], float] | None = None,
        to_action: Callable[[float], Any] | None = None,
    ) -> None:
        super().__init__(env)
        self.guard = guard
        self.observe = observe
        self.failed = failed
        if to_acceleration is not None and to_action is not None:
            self.to_acceleration, self.to_action = to_acceleration, to_action
        elif to_acceleration is None and to_action is None:
            self.to_acceleration, self.to_action = _conversions(env.action_space)
        else:
            raise ValueError("of to_acceleration and to_action there is one; give both or neither")
        self.revision: Revision | None = None  #: the latest decision
        self._is_judged = False  # whether an episode of the guard is under way
        self._seen: NDArray[np.float64] | None = None
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; one that is under way ends as it is."""
        self._end(failed=False)
        observation, info = self.env.reset(seed=seed, options=options)
        self._seen, self._steps = self._look(observation), 0
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Execute what the reviser makes of ``action``."""
        revision = self._decide(Proposal(float(self.to_acceleration(action))))
        kept = revision.executed == revision.proposed
        executed = action if kept else self.to_action(revision.executed)
        observation, reward, terminated, truncated, info = self.env.step(executed)
        self.revision = revision
        self._seen, self._steps = self._look(observation), self._steps + 1
        failed = bool(self.failed(info))
        if failed or terminated or truncated or self._seen is None:
            self._end(failed=failed)
        actions = {
            "reviser/proposed_action": deepcopy(action),
            "reviser/executed_action": deepcopy(executed),
        }
        return observation, reward, terminated, truncated, {**info, **actions, **info_of(revision)}

    def _decide(self, proposal: Proposal) -> Revision:
        if self._seen is None:
            wanted, remark = make_usable(proposal, self.guard.actions, self.guard.fallback)
            return unjudged_revision(
                wanted, proposal, f"nothing is ahead; {remark or 'not revised'}"
            )
        if not self._is_judged:
            self.guard.begin()
            self._is_judged = True
        interval = self.guard.interval
        time = math.nan if interval is None else self._steps * interval
        return self.guard.decide(self._seen, proposal, time)

    def _end(self, *, failed: bool) -> None:
        if self._is_judged:
            self._is_judged = False
            self.guard.end(failed, self._seen)

    def _look(self, observation: Any) -> NDArray[np.float64] | None:
        given = self.observe(observation)
        if given is None:
            return None
        seen, names = np.array(given, dtype=np.float64), self.guard.variables
        if seen.ndim != 1 or len(seen) != (len(names) or len(seen)) or not np.isfinite(seen).all():
            what = f"{' and '.join(names)}, {len(names)} finite numbers" if names else "finite"
            raise ValueError(
                f"observe returned {given}; it must be {what}, or None where there is nothing to "
                "judge"
            )
        return seen


def _conversions(
    space: gymnasium.Space[Any],
) -> tuple[Callable[[Any], float], Callable[[float], Any]]:
    """To an action of the guard and back, where it is one number or an index."""
    if isinstance(space, Discrete):
        first = int(space.start)
        return lambda action: float(action) - first, lambda action: first + int(action)
    if not isinstance(space, Box) or space.shape not in ((), (1,)):
        raise ValueError(
            f"the environment's actions are {space}, not one acceleration; "
            "give to_acceleration and to_action"
        )

    def to_acceleration(action: Any) -> float:
        return float(np.asarray(action, dtype=np.float64).reshape(()))

    def to_action(acceleration: float) -> NDArray[Any]:
        action = np.full(space.shape, acceleration, dtype=space.dtype)
        return np.asarray(np.clip(action, space.low, space.high))

    return to_acceleration, to_action

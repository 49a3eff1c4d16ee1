"""The action reviser as a wrapper: any Gymnasium environment drives under it.

Whoever acts, a policy that was trained or one that is being trained, keeps its environment. What
it does is revised before it is executed, and what comes of it is learnt.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from typing import Any, Protocol, SupportsFloat

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.core import EvolvingFSM, IntervalActions
from evofsm.extras import needs
from evofsm.guard.oversight import Oversight, Witness, own_risk, refuse_mismatch
from evofsm.guard.protocols import Fallback, LearningJudge, Proposal, Reviser, Revision
from evofsm.guard.reviser import make_usable, unjudged

with needs("gymnasium", "gym", "a wrapper for Gymnasium"):
    import gymnasium
    from gymnasium.spaces import Box


class BoundedReviser(Reviser, Protocol):
    """A reviser that knows the set of actions, as all of `evofsm.guard.reviser` do."""

    @property
    def actions(self) -> IntervalActions:
        """The set of actions."""
        ...

    @property
    def fallback(self) -> Fallback:
        """What is done without a usable proposal."""
        ...


class RevisedActions(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Executes what a reviser makes of the actions, and forwards all else as it is.

    The reviser's risk, and the machine if there is one, learn while it drives. In ``info`` stand
    ``reviser/proposed_action`` and ``reviser/executed_action``, both as the environment takes
    them, ``reviser/reason``, and ``reviser/risk``, the probability of failure under what is
    executed (``reviser/risk_proposed`` under what was proposed; NaN where none was judged).
    All else that is known of the latest decision is in `revision`.

    Parameters
    ----------
    env : gymnasium.Env
        A step of it is one decision, ``risk.dt`` long [s].
    reviser : ActionReviser or another with a set of actions
        What is executed lies in its ``actions`` always.
    observe : callable
        From an observation of ``env`` to ``[gap [m], v_follower [m/s], v_leader [m/s]]``; to None
        where nothing is ahead: then nothing is revised, and nothing learnt.
    failed : callable
        From the ``info`` of a step to whether it ended in failure.
    machine : EvolvingFSM, optional
        Recognises and learns; without one nothing is recognised.
    risk : LearningJudge, optional
        Learns from what happens; without it the reviser's own, if that is one.
    learn : bool
        Whether machine and risk learn. It may be changed between episodes.
    to_acceleration : callable, optional
        From an action of ``env`` to an acceleration [m/s²]. Where the action is one number, it
        is taken for that.
    to_action : callable, optional
        From an acceleration [m/s²] to an action of ``env``.
    audit : Witness, optional
        Is told what is decided while something is ahead: an `AuditLog`.

    Raises
    ------
    ValueError
        If an action of ``env`` is not one number and it was not told how to convert it, if only
        one of the two conversions is given, or if ``machine`` is for another set of actions.

    Notes
    -----
    A proposal that is kept is passed on untouched, without being converted back and forth. With a
    failure the episode is over for machine and risk, also where the environment would go on. A
    collision with what was not seen before it is no one's consequence: it is not counted.

    Examples
    --------
    >>> from evofsm.driving import CarFollowing
    >>> from evofsm.guard import ActionReviser
    >>> env = CarFollowing()
    >>> risk = LatentRisk(env.family.actions.low, env.family.interval)
    >>> reviser = ActionReviser(risk, env.family.actions)
    >>> env = RevisedActions(env, reviser, observe=lambda seen: seen, failed=lambda i: i["failed"])
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
        reviser: BoundedReviser,
        observe: Callable[[Any], ArrayLike | None],
        failed: Callable[[dict[str, Any]], bool],
        *,
        machine: EvolvingFSM | None = None,
        risk: LearningJudge | None = None,
        learn: bool = True,
        to_acceleration: Callable[[Any], float] | None = None,
        to_action: Callable[[float], Any] | None = None,
        audit: Witness | None = None,
    ) -> None:
        super().__init__(env)
        refuse_mismatch(machine, reviser.actions)
        self.reviser = reviser
        self.observe = observe
        self.failed = failed
        self.machine = machine
        self.risk = own_risk(reviser) if risk is None else risk
        self.learn = learn
        self.audit = audit
        if to_acceleration is not None and to_action is not None:
            self.to_acceleration, self.to_action = to_acceleration, to_action
        elif to_acceleration is None and to_action is None:
            self.to_acceleration, self.to_action = _conversions(env.action_space)
        else:
            raise ValueError("of to_acceleration and to_action there is one; give both or neither")
        self.revision: Revision | None = None  #: the latest decision
        self._oversight: Oversight | None = None  # of what is ahead, for as long as it is
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
        told = {
            "reviser/proposed_action": deepcopy(action),
            "reviser/executed_action": deepcopy(executed),
            "reviser/reason": revision.reason,
            "reviser/risk": revision.risk_executed,
            "reviser/risk_proposed": revision.risk_proposed,
        }
        return observation, reward, terminated, truncated, {**info, **told}

    def _decide(self, proposal: Proposal) -> Revision:
        if self._seen is None:
            wanted, remark = make_usable(proposal, self.reviser.actions, self.reviser.fallback)
            return unjudged(wanted, proposal, f"nothing is ahead; {remark or 'not revised'}")
        if self._oversight is None:
            self._oversight = Oversight(
                self.reviser.actions,
                self.reviser,
                machine=self.machine,
                risk=self.risk,
                learn=self.learn,
                audit=self.audit,
            )
        time = math.nan if self.risk is None else self._steps * self.risk.dt
        situation = self._oversight.recognise(self._seen, time)
        return self._oversight.revise(situation, proposal)

    def _end(self, *, failed: bool) -> None:
        if self._oversight is not None:
            self._oversight.end(self._seen, failed=failed)
            self._oversight = None

    def _look(self, observation: Any) -> NDArray[np.float64] | None:
        answer = self.observe(observation)
        if answer is None:
            return None
        seen = np.array(answer, dtype=np.float64)
        if seen.shape != (3,) or not np.isfinite(seen).all():
            raise ValueError(
                f"observe answered {answer}; it must be gap, v_follower and v_leader, three finite "
                "numbers, or None where nothing is ahead"
            )
        return seen


def _conversions(
    space: gymnasium.Space[Any],
) -> tuple[Callable[[Any], float], Callable[[float], Any]]:
    """To an acceleration and back, where an action is one number."""
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

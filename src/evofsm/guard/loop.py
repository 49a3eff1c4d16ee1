"""The one loop of an episode: observe, propose, revise, execute, learn (the paper's 4.1)."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from time import perf_counter
from typing import Any, NamedTuple, Protocol, SupportsFloat

import numpy as np

from evofsm.fsm.validation import Floats
from evofsm.guard.actions import Action, ActionSet, Choices, no_action
from evofsm.guard.api import Controller, Proposal, Revision, Situation
from evofsm.guard.guard import Guard
from evofsm.guard.reviser import proposed

_log = logging.getLogger(__name__)


class Environment(Protocol):
    """What an episode happens in: an environment of Gymnasium, or anything with its two methods.

    Its ``info`` may hold ``failed``, whether the episode ended in failure (without it one that is
    terminated has failed), ``time`` [s] since the start (without it decisions are counted),
    ``realised``, what the action came to, and ``action_mask``, which of `Choices` are allowed now.
    """

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode: the first observation, and info."""
        ...

    def step(self, action: Any, /) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Execute until the next decision: observation, reward, terminated, truncated, info."""
        ...


class Decision(NamedTuple):
    """One decision, and what came of it until the next."""

    situation: Situation
    revision: Revision
    realised: float = math.nan  #: as the environment says; of a car its acceleration [m/s²]
    reward: float = 0.0
    failed: bool = False  #: whether the episode then ended in failure
    seconds: float = math.nan  #: that it took to decide


def run_episode(
    environment: Environment,
    guard: Guard,
    controller: Controller | Callable[[Floats], Action | Proposal],
    *,
    seed: int | None = None,
    options: dict[str, Any] | None = None,
) -> Iterator[Decision]:
    """Drive one episode under a guard, decision by decision; it learns unless it is frozen.

    Parameters
    ----------
    environment : Environment
    guard : Guard
    controller : Controller or callable
        What proposes. Where a variable was not observed, it is given the latest value. Where it
        raises or proposes no number, the guard falls back.
    seed, options
        Of ``environment.reset``.

    Yields
    ------
    Decision
        Once it was executed. Whoever stops before the last one breaks the episode off.

    Examples
    --------
    >>> from evofsm.driving import CarFollowing, guard_for_family
    >>> env = CarFollowing("emergency")
    >>> guard = guard_for_family(env.family)
    >>> decisions = list(run_episode(env, guard, lambda observation: 2.5, seed=1))
    >>> decisions[-1].failed, any(one.revision.executed < 2.5 for one in decisions)
    (False, True)
    """
    propose = getattr(controller, "propose", None) or (lambda seen, time: controller(seen))  # type: ignore[operator]
    observation, info = parts_of(environment.reset(seed=seed, options=options))
    number, mask_of = guard.begin(), action_masks(environment)
    latest_row, count, score, is_over, failed = _whole(observation, None), 0, 0.0, False, False
    while not is_over:
        time = info.get("time", count * guard.interval)
        proposal = _asked(guard.actions, propose, latest_row, time)
        if isinstance(guard.actions, Choices) and proposal.mask is None:
            proposal = proposal._replace(mask=mask_of(observation, info))
        begin = perf_counter()
        revision = guard.decide(np.ravel(observation), proposal, time, episode=number)
        seconds, situation = perf_counter() - begin, guard.situation
        parts = parts_of(environment.step(revision.executed), 5)
        observation, reward, terminated, truncated, info = parts
        reward = math.nan if reward is None else float(reward)
        latest_row, count, score = _whole(observation, latest_row), count + 1, score + reward
        is_over, failed = bool(terminated or truncated), bool(info.get("failed", terminated))
        if is_over:
            how: Any = {"terminated": bool(terminated), "episode": number}
            how["score"] = score if math.isfinite(score) else None
            guard.end(failed, np.ravel(observation), **how)
        effect = float(info.get("realised", math.nan))
        yield Decision(situation, revision, effect, reward, failed, seconds)


def parts_of(reply: Any, count: int = 2) -> Any:
    """What a reset, or a step (5), returned, an info of None as {}; other parts are refused."""
    is_parted = isinstance(reply, tuple | list)
    if not (is_parted and len(reply) == count):
        kind = f"{len(reply)} values" if is_parted else f"one {type(reply).__name__}"
        call = "reset" if count == 2 else "step"
        fault = f"the environment's {call} returned {kind}, not {count} values as Gymnasium's"
        hint = "a cost belongs in info['cost'] (SafetyGymnasium2Gymnasium), old Gym in a wrapper"
        raise ValueError(f"{fault}: {hint}")
    return *reply[:-1], {} if reply[-1] is None else reply[-1]


def action_masks(environment: Any) -> Callable[[Any, Mapping[str, Any]], Any]:
    """From an observation and ``info`` to which actions an environment allows now.

    It says so in an observation that is a dictionary or in ``info``, by the name that PettingZoo
    and Gymnasium use, or by a method, as MaskablePPO of Stable-Baselines3 asks it; else it is None.
    """
    find = getattr(environment, "get_wrapper_attr", None)  # of Gymnasium, whatever wraps it
    try:
        ask = find("action_masks") if find else environment.action_masks
    except AttributeError:
        ask = None
    return partial(_mask, ask)  # which a copy of the environment asks of itself


def _mask(ask: Callable[[], Any] | None, observation: Any, info: Mapping[str, Any]) -> Any:
    for source in (observation, info):
        if isinstance(source, Mapping) and source.get("action_mask") is not None:
            return source["action_mask"]
    return ask() if ask else None


def _whole(observation: Any, held: Floats | None) -> Floats:
    """The latest value of each variable; NaN of one that was never observed."""
    now = np.array(observation, dtype=np.float64).ravel()
    absent = np.isnan(now)
    return np.where(absent, held, now) if held is not None and absent.any() else now


def _asked(
    actions: ActionSet,
    propose: Callable[[Floats, float], Action | Proposal],
    seen: Floats,
    time: float,
) -> Proposal:
    """What the controller proposes; no action where it fails to: someone has to go on driving."""
    try:
        proposal = proposed(actions, propose(seen.copy(), time))
    except Exception as error:
        _log.warning("controller failed at %g s: %r", time, error)
        return Proposal(no_action(actions))
    if np.isfinite(proposal.action).all():
        return proposal
    _log.warning("controller proposed %s at %g s", proposal.action, time)
    return Proposal(no_action(actions))

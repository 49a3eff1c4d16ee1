"""A guard as a wrapper: any Gymnasium environment, or many at once, are driven under it.

Whoever acts, a policy that was trained or one that is being trained, keeps its environment. What
it does is revised before it is executed, and what comes of it is learnt.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any, SupportsFloat

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.extras import needs
from evofsm.guard.actions import (
    Action,
    ActionSet,
    BoxActions,
    Choices,
    change,
    is_usable,
    put_into,
    same_action,
)
from evofsm.guard.guard import Guard
from evofsm.guard.protocols import Proposal, Revision
from evofsm.guard.record import info_of
from evofsm.guard.reviser import make_usable, unjudged_revision

with needs("gymnasium", "gym", "a wrapper for Gymnasium"):
    import gymnasium
    from gymnasium.spaces import Box, Discrete
    from gymnasium.vector import VectorEnv, VectorWrapper
    from gymnasium.vector.utils import concatenate, create_empty_array, iterate

_Seen = NDArray[np.float64] | None
_Observe = Callable[[Any], ArrayLike | None]
_Failed = Callable[[dict[str, Any]], bool]
_To = Callable[[Any], Any]


class RevisedActions(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Executes what a guard makes of the actions, and forwards all else as it is.

    The guard learns while the environment is driven. In ``info`` stand
    ``reviser/proposed_action`` and ``reviser/executed_action``, both as the environment takes
    them, ``reviser/reason``, ``reviser/risk``, the probability of failure under what is
    executed (``reviser/risk_proposed`` under what was proposed; NaN where none was judged), and
    ``reviser/penalty``, the size of the change. All else that is known of the latest decision is
    in `revision`.

    Parameters
    ----------
    env : gymnasium.Env
        A step of it is one decision, ``guard.interval`` long [s].
    guard : Guard
        What is executed lies in its set of actions always.
    observe : callable, optional
        From an observation of ``env`` to what the guard observes; to None where there is nothing
        to judge, such as no car ahead: then nothing is revised, and nothing learnt. Without it a
        box is taken as it is, its axes flattened, and of ``Discrete`` each value is a variable
        that is 1 where it is that and 0 elsewhere.
    failed : callable, optional
        From the ``info`` of a step to whether it ended in failure. Without it the guard's own
        function says so; where it has none either, **an episode that is terminated has failed**,
        as in CartPole, and one that is truncated has not. An environment that also terminates on
        success (MountainCar, LunarLander) has to be told apart here; ``lambda info: False`` stands
        for never.
    to_acceleration : callable, optional
        From an action of ``env`` to one of the guard. Without it an action is taken for that: of
        a box with as many numbers as the guard's actions have, or an index where the guard has
        as many.
    to_action : callable, optional
        From an action of the guard to one of ``env``.
    penalty : float
        What is taken off the reward for a change: so much for each half range of the action, in a
        box the root of the sum of squares over its components, and so much for another index. A
        proposal beyond the set counts as its edge, one that is no action as a half range.

    Raises
    ------
    ValueError
        If actions or observations of ``env`` are none of these and it was not told how to convert
        them, only one of the two conversions is given, or the penalty is negative.

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
        observe: _Observe | None = None,
        failed: _Failed | None = None,
        *,
        to_acceleration: _To | None = None,
        to_action: _To | None = None,
        penalty: float = 0.0,
    ) -> None:
        super().__init__(env)
        self.guard = guard
        self._terms = Terms(
            guard,
            env.observation_space if observe is None else observe,
            failed,
            _both(to_acceleration, to_action) or conversions(env.action_space, guard.actions),
            penalty,
        )
        self.observe, self.failed = self._terms.observe, failed
        self.to_acceleration, self.to_action = self._terms.to_guard, self._terms.to_env
        self.revision: Revision | None = None  #: the latest decision
        self._stream = _Stream(guard)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; one that is under way ends as it is."""
        self._stream.end(failed=False)
        observation, info = self.env.reset(seed=seed, options=options)
        self._stream.begin(self._terms.look(observation))
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Execute what the reviser makes of ``action``."""
        revision = self._stream.decide(self._terms.proposal(action))
        executed = self._terms.executed(action, revision)
        observation, reward, terminated, truncated, info = self.env.step(executed)
        self.revision = revision
        failed = self._terms.failed(info, bool(terminated))
        over = failed or terminated or truncated
        self._stream.follow(self._terms.look(observation), over=over, failed=failed)
        size = size_of(self.guard.actions, revision)
        if self._terms.penalty:
            reward = float(reward) - self._terms.penalty * size
        said = told(action, executed, revision, size)
        return observation, reward, terminated, truncated, {**info, **said}


class RevisedVectorActions(VectorWrapper[Any, Any, Any, Any, Any]):
    """Many environments at once under one guard, as `RevisedActions` does it for one.

    What any of them meets, all profit from: the guard learns each environment's episode **as a
    whole when it ends**, one after another, those that end in the same step in the order of the
    environments. So no transition of one is ever taken for one of another, nor one across a
    reset. In an episode a twin of the guard (`Guard.copy`) decides, made as the episode begins: it
    knows all episodes that had ended by then and learns from its own, but knows nothing of those
    that run beside it. With one environment that comes to the same as `RevisedActions`, bit for
    bit. What is changed about the guard meanwhile, its mode for example, counts in each
    environment from its next episode on.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        With any autoreset mode.
    guard : Guard
        Shared by all; ask it nothing else while episodes run. It may be frozen.
    observe, failed, to_acceleration, to_action, penalty
        As in `RevisedActions`: of a single environment. ``failed`` gets its own part of
        ``infos``, without the masks.

    Raises
    ------
    ValueError
        As `RevisedActions`; also if the guard has an audit log, which follows one episode at a
        time.

    Notes
    -----
    In ``infos`` stand the same names as with one environment, as arrays over the environments. Each
    has a mask, as all that Gymnasium puts there: ``_reviser/reason`` and so on are False where
    nothing was decided, in a step that only resets (``AutoresetMode.NEXT_STEP``) or after an
    episode that was not reset (``DISABLED``). With ``SAME_STEP`` they are about the step that
    ended the episode. `revisions` holds the latest decisions.

    All that begin together know equally little: with nothing learnt yet, each of them may fail
    where one environment after another would have failed once.

    Examples
    --------
    >>> import gymnasium
    >>> from evofsm.driving import CarFollowing, guard_for_cars
    >>> envs = gymnasium.vector.SyncVectorEnv([CarFollowing] * 2)
    >>> guard = guard_for_cars(low=-2.5, high=2.5, interval=0.25)
    >>> envs = RevisedVectorActions(envs, guard, failed=lambda info: info["failed"])
    >>> observations, infos = envs.reset(seed=1)
    >>> for _ in range(300):
    ...     observations, _, ended, _, infos = envs.step(envs.action_space.high)
    >>> infos["reviser/executed_action"].shape, infos["_reviser/executed_action"].tolist()
    ((2, 1), [True, True])
    >>> envs.close()
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        guard: Guard,
        observe: _Observe | None = None,
        failed: _Failed | None = None,
        *,
        to_acceleration: _To | None = None,
        to_action: _To | None = None,
        penalty: float = 0.0,
    ) -> None:
        super().__init__(env)
        if guard.audit is not None:
            raise ValueError(
                "an audit log follows one episode at a time; give a guard without one, or wrap "
                "each environment by itself"
            )
        self.guard = guard
        self._terms = Terms(
            guard,
            env.single_observation_space if observe is None else observe,
            failed,
            _both(to_acceleration, to_action)
            or conversions(env.single_action_space, guard.actions),
            penalty,
        )
        # Gymnasium 1.0 has no other mode, and names none.
        mode = env.metadata.get("autoreset_mode", "NextStep")
        self._resets_at_once = getattr(mode, "value", mode) == "SameStep"
        self._resets_next = getattr(mode, "value", mode) == "NextStep"
        self._lanes = [Lane(guard) for _ in range(self.num_envs)]
        #: The latest decision in each environment.
        self.revisions: list[Revision | None] = [None] * self.num_envs

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes, in all or those of ``options["reset_mask"]``; those under way end."""
        mask = np.array((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        observations, infos = self.env.reset(seed=seed, options=options)
        for lane, observation, begins in zip(
            self._lanes, self._each(observations), mask, strict=True
        ):
            if begins:
                lane.end(failed=False)
                lane.begin(self._terms.look(observation))
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Execute what the guard makes of each environment's action."""
        proposed = list(iterate(self.action_space, actions))
        decided = [lane.is_open for lane in self._lanes]
        revisions = [
            lane.decide(self._terms.proposal(action))
            for lane, action in zip(self._lanes, proposed, strict=True)
        ]
        executed = [
            self._terms.executed(action, revision) if decides else action
            for action, revision, decides in zip(proposed, revisions, decided, strict=True)
        ]
        observations, rewards, terminated, truncated, infos = self.env.step(self._batch(executed))
        self._learn(observations, terminated, truncated, infos)
        sizes = np.array([size_of(self.guard.actions, revision) for revision in revisions])
        sizes[~np.array(decided)] = 0.0
        if self._terms.penalty:
            rewards = rewards - self._terms.penalty * sizes
        for k, revision in enumerate(revisions):
            said = told(proposed[k], executed[k], revision, sizes[k])
            infos = self._add_info(infos, said, k)
            if decided[k]:
                self.revisions[k] = revision
            else:
                for name in said:
                    infos[f"_{name}"][k] = False
        return observations, rewards, terminated, truncated, infos

    def _learn(self, observations: Any, terminated: Any, truncated: Any, infos: Any) -> None:
        """Tell each environment's stream what came of its step."""
        for k, (lane, observation) in enumerate(
            zip(self._lanes, self._each(observations), strict=True)
        ):
            over = bool(terminated[k] or truncated[k])
            if not lane.is_open:
                if self._resets_next and not over:  # this step was the reset
                    lane.begin(self._terms.look(observation))
                continue
            info, last = _of_one(infos, k), observation
            if over and self._resets_at_once:
                info, last = info["final_info"], infos["final_obs"][k]
            failed = self._terms.failed(info, bool(terminated[k]))
            lane.follow(self._terms.look(last), over=over or failed, failed=failed)
            if not over:
                continue
            lane.close()
            if self._resets_at_once:
                lane.begin(self._terms.look(observation))

    def _each(self, observations: Any) -> Sequence[Any]:
        return list(iterate(self.env.observation_space, observations))

    def _batch(self, actions: Sequence[Any]) -> Any:
        space = self.single_action_space
        into: Any = create_empty_array(space, len(actions))
        return concatenate(space, actions, into)


class _Stream:
    """One environment's episodes under a guard: one after the other."""

    def __init__(self, guard: Guard) -> None:
        self.guard = guard
        self.is_open = False  # whether the environment is in an episode
        self._is_judged = False  # whether the guard is
        self._seen: _Seen = None
        self._steps = 0

    def begin(self, seen: _Seen) -> None:
        """An episode of the environment begins."""
        self.is_open, self._seen, self._steps = True, seen, 0

    def close(self) -> None:
        """It is over, and nothing is to be decided until the next one begins."""
        self.is_open, self._seen = False, None

    def decide(self, proposal: Proposal) -> Revision:
        """What to execute; the proposal where there is nothing to judge."""
        if self._seen is None:
            wanted, remark = make_usable(proposal, self.guard.actions, self.guard.fallback)
            return unjudged_revision(
                wanted, proposal, f"nothing is ahead; {remark or 'not revised'}"
            )
        if not self._is_judged:
            self._begin()
            self._is_judged = True
        interval = self.guard.interval
        return self._decide(
            self._seen, proposal, math.nan if interval is None else self._steps * interval
        )

    def follow(self, seen: _Seen, *, over: bool, failed: bool) -> None:
        """What came of it."""
        self._seen, self._steps = seen, self._steps + 1
        if over or seen is None:
            self.end(failed=failed)

    def end(self, *, failed: bool) -> None:
        """The guard's episode ends, if one is under way."""
        if self._is_judged:
            self._is_judged = False
            self._end(self._seen, failed=failed)

    def _begin(self) -> None:
        self.guard.begin()

    def _decide(self, seen: NDArray[np.float64], proposal: Proposal, time: float) -> Revision:
        return self.guard.decide(seen, proposal, time)

    def _end(self, seen: _Seen, *, failed: bool) -> None:
        self.guard.end(failed, seen)


class Lane(_Stream):
    """A stream beside others: a twin decides, and the shared guard learns it all as it ends."""

    def __init__(self, shared: Guard) -> None:
        super().__init__(shared)
        self._shared = shared
        self._driven: list[tuple[NDArray[np.float64], float, Proposal, Action]] = []

    def _begin(self) -> None:
        self.guard, self._driven = self._shared.copy(), []
        self.guard.begin()

    def _decide(self, seen: NDArray[np.float64], proposal: Proposal, time: float) -> Revision:
        revision = self.guard.decide(seen, proposal, time)
        self._driven.append((seen, time, proposal, revision.executed))
        return revision

    def _end(self, seen: _Seen, *, failed: bool) -> None:
        if not self._shared.learn:
            return
        self._shared.begin()
        for observation, time, proposal, executed in self._driven:
            situation = self._shared.recognise(observation, time)
            self._shared.take_in(situation, proposal, executed)
        self._shared.end(failed, seen)


class Terms:
    """How actions and observations of an environment are told to a guard, and failures."""

    def __init__(
        self,
        guard: Guard,
        observe: _Observe | gymnasium.Space[Any],
        failed: _Failed | None,
        conversions: tuple[_To, _To],
        penalty: float,
    ) -> None:
        if not 0.0 <= penalty < math.inf:
            raise ValueError(f"penalty is {penalty}; it must be 0 or above, and finite")
        self.guard = guard
        self.observe = _flat(observe) if isinstance(observe, gymnasium.Space) else observe
        self._failed = failed
        self.to_guard, self.to_env = conversions
        self.penalty = penalty

    def proposal(self, action: Any) -> Proposal:
        """What was proposed, as the guard takes it."""
        wanted = self.to_guard(action)
        if isinstance(self.guard.actions, BoxActions):
            return Proposal(self.guard.actions.checked("proposal", wanted))
        return Proposal(float(wanted))

    def executed(self, action: Any, revision: Revision) -> Any:
        """What is executed, as the environment takes it: the very proposal where it is kept."""
        if same_action(revision.executed, revision.proposed):
            return action
        return self.to_env(revision.executed)

    def failed(self, info: dict[str, Any], terminated: bool) -> bool:
        """Whether a step ended in failure, but for what the guard finds itself."""
        if self._failed is not None:
            return bool(self._failed(info))
        return terminated and self.guard.failed is None

    def look(self, observation: Any) -> _Seen:
        """What the guard observes; None where there is nothing to judge."""
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


def told(action: Any, executed: Any, revision: Revision, size: float) -> dict[str, Any]:
    """What stands in ``info`` of a step."""
    return {
        "reviser/proposed_action": deepcopy(action),
        "reviser/executed_action": deepcopy(executed),
        "reviser/penalty": float(size),
        **info_of(revision),
    }


def size_of(actions: ActionSet, revision: Revision) -> float:
    """How much was changed, in half ranges of the action."""
    if not is_usable(actions, revision.proposed):
        return 1.0
    return change(actions, put_into(actions, revision.proposed), revision.executed)


def _of_one(infos: Mapping[str, Any], k: int) -> dict[str, Any]:
    """The part of ``infos`` that is of one environment."""
    return {
        name: _of_one(value, k) if isinstance(value, dict) else value[k]
        for name, value in infos.items()
        if f"_{name}" in infos and infos[f"_{name}"][k]
    }


# -- Spaces -----------------------------------------------------------------------------------


def _flat(space: gymnasium.Space[Any]) -> _Observe:
    """From an observation to a vector."""
    if isinstance(space, Box):
        if len(space.shape) == 1:
            return lambda observation: observation
        return lambda observation: None if observation is None else np.reshape(observation, -1)
    if isinstance(space, Discrete):
        first, each = int(space.start), np.eye(int(space.n))
        return lambda observation: None if observation is None else each[int(observation) - first]
    raise ValueError(
        f"the environment's observations are {space}, neither a Box nor Discrete; give observe, "
        "which makes a vector of them"
    )


def _both(to_acceleration: _To | None, to_action: _To | None) -> tuple[_To, _To] | None:
    if to_acceleration is not None and to_action is not None:
        return to_acceleration, to_action
    if to_acceleration is None and to_action is None:
        return None
    raise ValueError("of to_acceleration and to_action there is one; give both or neither")


def conversions(space: gymnasium.Space[Any], actions: ActionSet) -> tuple[_To, _To]:
    """To an action of the guard and back."""
    if isinstance(space, Discrete) and actions == Choices(int(space.n)):
        first = int(space.start)
        return lambda action: float(action) - first, lambda action: first + int(action)
    shape = actions.half.shape if isinstance(actions, BoxActions) else ()
    numbers = not isinstance(actions, Choices)
    if not (isinstance(space, Box) and numbers and math.prod(space.shape) == math.prod(shape)):
        raise ValueError(
            f"the environment's actions are {space}, but the guard's are {actions}: make a guard "
            "of such actions, n_actions of Discrete and arrays low and high of Box, or give "
            "to_acceleration and to_action"
        )

    def to_guard(action: Any) -> NDArray[np.float64]:
        return np.asarray(action, dtype=np.float64).reshape(shape)

    def to_env(action: Action) -> NDArray[Any]:
        again = np.asarray(action).reshape(space.shape).astype(space.dtype)
        return np.asarray(np.clip(again, space.low, space.high))

    return to_guard, to_env

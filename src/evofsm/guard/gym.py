"""A guard as a wrapper: any Gymnasium environment, or many at once, run under it."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from operator import attrgetter
from threading import RLock
from typing import Any, Literal, NamedTuple, SupportsFloat
from weakref import WeakKeyDictionary, WeakSet

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.extras import needs
from evofsm.fsm.sharing import alone
from evofsm.fsm.validation import Floats, function
from evofsm.guard.actions import (
    Action,
    ActionSet,
    Choices,
    Mask,
    change,
    checked_mask,
    is_usable,
    put_into,
    same_action,
)
from evofsm.guard.api import Proposal, Revision
from evofsm.guard.guard import Guard, answered
from evofsm.guard.loop import action_masks, parts_of
from evofsm.guard.reviser import make_usable, passed, unjudged_revision

with needs("gymnasium", "gym", "a wrapper for Gymnasium"):
    import gymnasium
    from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Space, Tuple
    from gymnasium.utils import RecordConstructorArgs
    from gymnasium.vector import VectorEnv, VectorWrapper
    from gymnasium.vector.utils import concatenate, create_empty_array, iterate

Observe = Callable[[Any], ArrayLike | None]
_Convert = Callable[[Any], Any]
# Each value of ``Discrete`` is a variable of its own; more of them would take too long.
_MOST_VALUES = 64
# Not in ``info`` where nothing was judged: NaN there is unlike itself.
_RISK_INFOS = "reviser/risk", "reviser/risk_proposed"
# So many steps on end without a decision are told of.
_SILENT = 200
# Where ``info`` holds the last observation of an episode, as the one returned is of the next.
_LAST = ("final_obs", "final_observation", "terminal_observation")
_BY_ITSELF = (
    "step() was called with no episode under way, and no reset(): it is taken that the environment "
    "begins the next one in that step, on which nothing is decided. If it had begun it in the step "
    "before, info['final_obs'] of that has to hold the last observation of the episode"
)


@dataclass(frozen=True, slots=True)
class StepResult:
    """What a step of an environment came to: what ``failed`` of a wrapper is called with."""

    observation: Any  #: None where an environment of many does not tell the last one
    reward: Any  #: before any penalty
    terminated: bool
    truncated: bool
    info: dict[str, Any]


Failed = Callable[[StepResult], bool] | Literal["terminated"]


# To replace either is an error, not ignored: for another guard wrap the environment anew.
class _Settled:
    guard = property(attrgetter("_guard"), doc="Who decides.")
    failed = property(attrgetter("_failed"), doc="Who says which episodes failed.")


class RevisedActions(_Settled, gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Executes a guard's revision of each action, and forwards all else as it is.

    The guard learns while the environment runs. ``info`` holds ``reviser/proposed_action`` and
    ``reviser/executed_action``, as the environment takes them, ``reviser/reason``,
    ``reviser/penalty``, the size of the change, and, where it was judged, ``reviser/risk``, the
    probability of failure under the executed action, and ``reviser/risk_proposed``, that under the
    proposed one.

    Parameters
    ----------
    env : gymnasium.Env
        One step of it is one decision, ``guard.interval`` long [s]. It may begin episodes by
        itself, as under ``Autoreset``. A warning names wrappers under which nothing can be learnt.
    guard : Guard
        What is executed always lies in its set of actions, and is allowed where the environment
        has an action mask: in ``info["action_mask"]``, in an observation that is a dictionary, or
        by a method ``action_masks``. Environments that take turns, or have a thread each, may share
        it; it then learns as `RevisedVectorActions` does.
    observe : callable, optional
        From an observation of ``env`` to the guard's; to None where there is nothing to judge,
        such as no car ahead: then nothing is revised or learnt. NaN is what was not observed.
        Without it a box is flattened, each value of ``Discrete`` is a variable that is 1 or 0, and
        parts of ``Dict`` and ``Tuple`` follow each other, but for an ``action_mask``. Of 1 and 0 a
        guard foresees little: give coordinates, on FrozenLake ``lambda s: (s // 4, s % 4)``.
    failed : callable or "terminated"
        From a step (``observation``, ``reward``, ``terminated``, ``truncated``, ``info``) to
        whether it ended in failure. ``"terminated"`` says that all that are terminated failed, as
        in CartPole. Where an environment also terminates on success that is wrong: ``lambda step:
        step.terminated and step.reward <= 0`` for FrozenLake, ``step.reward <= -100`` for
        LunarLander and BipedalWalker, ``lambda step: False`` for never, as in MountainCar and
        Acrobot. By default what the guard says itself, or else ``"terminated"``, with a warning.
    penalty : float
        Subtracted from the reward (of several from each) per unit of ``reviser/penalty``: half
        ranges of the action, in a box the root of the sum of squares over its components; 1 for
        another index. Of what
        ``studies peers`` tried 1 is best: at 0 a policy leans on the guard, and fails by itself.

    Raises
    ------
    TypeError
        If ``env`` is none of Gymnasium, or ``observe`` or ``failed`` no function.
    ValueError
        If actions of ``env`` are not the guard's or do not reach as far, its observations are
        neither boxes nor ``Discrete`` of at most 64 values and ``observe`` is missing, or the
        penalty is negative.

    Notes
    -----
    A proposal that is kept is passed on untouched. A failure ends the guard's episode; where the
    environment goes on, proposals pass until ``failed`` says no again, where the next one begins.
    One ends in any step that returns the next one's observation, another than the last, which
    ``info["final_obs"]`` holds. A failure right after nothing was judged is not counted.

    Examples
    --------
    >>> from evofsm.driving import CarFollowing, guard_for_family
    >>> env = CarFollowing()
    >>> guard = guard_for_family(env.family)
    >>> env = RevisedActions(env, guard, failed=lambda step: step.info["failed"])
    >>> observation, info = env.reset(seed=1)
    >>> over = False
    >>> while not over:  # at full throttle
    ...     _, _, terminated, truncated, info = env.step(env.action_space.high)
    ...     over = terminated or truncated
    >>> info["failed"]
    False
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        guard: Guard,
        observe: Observe | None = None,
        failed: Failed | None = None,
        *,
        penalty: float = 0.0,
    ) -> None:
        refuse_unless(isinstance(env, gymnasium.Env), env)
        arguments = {"guard": guard, "observe": observe, "failed": failed, "penalty": penalty}
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, **arguments)  # for `spec`
        gymnasium.Wrapper.__init__(self, env)
        self._guard, self._failed = guard, failed
        terms = Terms(guard, *_spaces(env), observe, failed, penalty)
        self._lane = Lane(terms, shared=False, env=env)
        self._resets_itself = any(type(layer).__name__ == "Autoreset" for layer in _layers(env))
        warn_of(env, guard, failed)

    @property
    def revision(self) -> Revision | None:
        """The latest decision."""
        return self._lane.revision

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; one that is under way ends without failure."""
        self._lane.end(failed=False)
        observation, info = parts_of(self.env.reset(seed=seed, options=options))
        self._lane.begin(observation, info)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Execute the guard's revision of ``action``."""
        was_open, decision = self._lane.is_open, self._lane.decide(action)
        parts = parts_of(self.env.step(decision.executed), 5)
        observation, reward, terminated, truncated, info = parts
        self._lane.follow(StepResult(observation, reward, bool(terminated), bool(truncated), info))
        if self._lane.is_open and not was_open and not self._resets_itself:
            self._resets_itself = True
            warnings.warn(_BY_ITSELF, stacklevel=2)
        return observation, decision.paid(reward), terminated, truncated, {**info, **decision.info}


class RevisedVectorActions(_Settled, VectorWrapper[Any, Any, Any, Any, Any]):
    """Many environments at once under one guard, as `RevisedActions` does it for one.

    The guard learns every environment's episode **as a whole when it ends**. Within an episode a
    twin of the guard (`Guard.copy`) decides, made as the episode begins: it learns from its own,
    but not from those that run alongside. What you change about the guard counts from the next
    episode on. With one environment it comes to the same as `RevisedActions`.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        With any autoreset mode.
    guard : Guard
        Shared by all; ask it nothing else while episodes run. It may be frozen.
    observe, failed, penalty
        As in `RevisedActions`: of a single environment. ``failed`` gets its own part of
        ``infos``, without the masks; what has neither a mask nor a value for each is for all.

    Raises
    ------
    ValueError
        As `RevisedActions`; also if the guard has an audit log, which follows one episode at a
        time.

    Notes
    -----
    ``infos`` has the names of a single environment, as arrays over the environments, each with a
    mask as Gymnasium has it: ``_reviser/reason`` and so on are False where nothing was decided, in
    a step that only resets (``AutoresetMode.NEXT_STEP``) or after an episode that was not reset
    (``DISABLED``). Where the metadata name no mode, it is ``SAME_STEP`` where ``infos`` hold
    ``final_obs``, or else ``NEXT_STEP``.

    Examples
    --------
    >>> import gymnasium
    >>> from evofsm.driving import CarFollowing, guard_for_cars
    >>> envs = gymnasium.vector.SyncVectorEnv([CarFollowing] * 2)
    >>> guard = guard_for_cars(low=-2.5, high=2.5, interval=0.25)
    >>> envs = RevisedVectorActions(envs, guard, failed=lambda step: step.info["failed"])
    >>> observations, infos = envs.reset(seed=1)
    >>> *_, infos = envs.step(envs.action_space.high)
    >>> infos["reviser/executed_action"].shape, infos["_reviser/executed_action"].tolist()
    ((2, 1), [True, True])
    >>> envs.close()
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        guard: Guard,
        observe: Observe | None = None,
        failed: Failed | None = None,
        *,
        penalty: float = 0.0,
    ) -> None:
        refuse_unless(isinstance(env, VectorEnv), env)
        super().__init__(env)
        self._guard, self._failed = guard, failed
        terms = Terms(guard, *_spaces(env), observe, failed, penalty)
        mode = env.metadata.get("autoreset_mode")  # which not everybody names
        self._same_step = getattr(mode, "value", mode) == "SameStep"
        envs = getattr(env.unwrapped, "envs", [None] * self.num_envs)
        self._lanes = [Lane(terms, shared=True, env=inner) for inner in envs]
        warn_of(env, guard, failed)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes, in all or those of ``options["reset_mask"]``; those under way end."""
        mask = np.array((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        observations, infos = parts_of(self.env.reset(seed=seed, options=options))
        rows = iterate(self.env.observation_space, observations)
        for k, (lane, observation) in enumerate(zip(self._lanes, rows, strict=True)):
            if mask[k]:
                lane.end(failed=False)
                lane.begin(observation, _of_one(infos, k, self.num_envs))
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Execute the guard's revision of each environment's action."""
        rows = iterate(self.action_space, actions)
        were_open = [lane.is_open for lane in self._lanes]
        decisions = [lane.decide(action) for lane, action in zip(self._lanes, rows, strict=True)]
        space = self.single_action_space
        buffer: Any = create_empty_array(space, self.num_envs)
        executed = concatenate(space, [decision.executed for decision in decisions], buffer)
        observations, rewards, terminated, truncated, infos = parts_of(self.env.step(executed), 5)
        rows = iterate(self.env.observation_space, observations)
        for k, (lane, observation) in enumerate(zip(self._lanes, rows, strict=True)):
            ends, info = (bool(terminated[k]), bool(truncated[k])), _of_one(infos, k, self.num_envs)
            lane.follow(StepResult(observation, rewards[k], *ends, info), resets=self._same_step)
        if any(decision.cost for decision in decisions):
            shape = (-1,) + (1,) * (np.ndim(rewards) - 1)
            rewards = rewards - np.reshape([decision.cost for decision in decisions], shape)
        for name in _RISK_INFOS:
            infos |= {name: np.zeros(self.num_envs), f"_{name}": np.zeros(self.num_envs, bool)}
        for k, (decision, was_open) in enumerate(zip(decisions, were_open, strict=True)):
            infos = self._add_info(infos, decision.info, k)
            for name in () if was_open else decision.info:
                infos[f"_{name}"][k] = False
        return observations, rewards, terminated, truncated, infos


def _of_one(infos: Mapping[str, Any], k: int, count: int) -> dict[str, Any]:
    info = {}
    for name, value in infos.items():
        is_mask = name[:1] == "_" and name[1:] in infos
        if is_mask or (f"_{name}" in infos and not infos[f"_{name}"][k]):
            continue
        if isinstance(value, dict):
            info[name] = _of_one(value, k, count)
        else:
            many = len(value) if isinstance(value, list | tuple) else (*np.shape(value), 0)[0]
            info[name] = value[k] if many == count else value
    return info


class Decided(NamedTuple):
    """What is executed for a proposed action, and what is said about it."""

    executed: Any  #: as the environment takes it
    info: dict[str, Any]
    cost: float  #: subtracted from the reward

    def paid(self, reward: Any) -> Any:
        """The reward less the cost; of several, each."""
        if not self.cost or reward is None:
            return reward
        return (float(reward) if np.ndim(reward) == 0 else np.asarray(reward)) - self.cost


class Lane:
    """The episodes of one environment, or of one agent, under a guard or a twin of a shared one."""

    def __init__(self, terms: Terms, *, shared: bool, env: Any = None) -> None:
        if shared and terms.guard.audit is not None:
            raise ValueError("an audit log follows one episode at a time; give a guard without one")
        self.terms = terms
        self.revision: Revision | None = None  #: the latest decision
        self.is_open = False  #: whether the environment is within an episode
        self._has_failed = False  # in that, and not come out of it
        self._shared, self._allowed = shared, action_masks(env)
        self._guard: Guard | None = None  # that decides, within an episode of the guard
        self._episode = 0  # the number of that
        self.seen: Floats | None = None  #: what the guard observes
        self._mask: Mask | None = None
        self._past: list[tuple[Floats, Proposal, Action]] = []

    @property
    def _lock(self) -> RLock:  # threads that share a guard, an environment each, take turns
        return _TURNS.setdefault(self.terms.guard, RLock())

    @alone
    def begin(self, observation: Any, info: Mapping[str, Any]) -> None:
        """An episode of the environment begins."""
        _LANES.setdefault(self.terms.guard, WeakSet()).add(self)
        self.is_open, self._has_failed, self._score = True, False, 0.0
        self._look(observation, info)

    def _look(self, observation: Any, info: Mapping[str, Any]) -> None:
        self.seen = self.terms.look(observation)
        if isinstance(self.terms.guard.actions, Choices):
            mask = _of_combinations(self.terms.space, self._allowed(observation, info))
            self._mask = checked_mask(self.terms.guard.actions, mask)

    @alone
    def decide(self, action: Any) -> Decided:
        """What to execute; the action itself where there is nothing to judge, or to decide."""
        terms, proposal = self.terms, Proposal(self.terms.to_guard(action), self._mask)
        if not self.is_open:
            terms.say_if_silent("no episode was under way: call reset()")
            decision = terms.decided(action, terms.unjudged(proposal, "no episode is under way"))
            return decision._replace(executed=action, cost=0.0)
        if self.seen is None or self._has_failed:
            why = "nothing to judge: observe returned None"
            why = "it failed, and failed= still says so" if self._has_failed else why
            terms.say_if_silent(why, ever=self._has_failed)
            self.revision = terms.unjudged(proposal, why)
            return terms.decided(action, self.revision)
        terms.say_if_silent()
        if self._guard is None:
            self._guard = self._begun()
        self.revision = self._guard.decide(self.seen, proposal, episode=self._episode)
        if self._guard is not terms.guard:
            self._past.append((self.seen, proposal, self.revision.executed))
        return terms.decided(action, self.revision)

    def _begun(self) -> Guard:
        """Who decides in an episode that begins: the guard, or a twin where others feed it too.

        Whom the guard itself decided for so far goes on with a twin of its own.
        """
        guard = self.terms.guard
        for lane in _LANES.get(guard, ()):
            if lane is not self and lane.is_open:
                if guard.audit is not None and lane._guard is guard:
                    raise ValueError(
                        "an audit log follows one episode at a time, and that of another "
                        "environment is under way: reset that, or give this one its own guard"
                    )
                lane._guard = None if lane._guard is guard else lane._guard
                _SHARED.add(guard)
        is_shared = guard.audit is None and (self._shared or guard in _SHARED)
        decider = guard.copy() if is_shared else guard
        self._episode = decider.begin()
        return decider

    @alone
    def follow(self, step: StepResult, *, resets: bool = False) -> None:
        """What followed in the environment; ``resets`` says that what ends begins anew with it."""
        is_over, now = step.terminated or step.truncated, step
        if not self.is_open:
            if not is_over:  # it began the next episode by itself
                self.begin(now.observation, now.info)
            return
        last = [step.info[name] for name in _LAST if step.info.get(name) is not None]
        if last and not is_over:  # put back at once; or it always tells what it returns
            there, here = (np.array(self.terms.look(z), float) for z in (last[0], now.observation))
            is_over = not np.array_equal(there, here, equal_nan=True)
            last = last if is_over else []
        if last or (is_over and resets):
            info = step.info.get("final_info", step.info)
            step = replace(step, observation=last[0] if last else None, info=info)
        failed = self.terms.failed(step)
        resets = is_over and (resets or bool(last))
        self._score += np.sum(np.array(step.reward, float))  # NaN of None
        self._look(step.observation, step.info)
        if failed or is_over or self.seen is None:
            score = float(self._score) if is_over and np.isfinite(self._score) else None
            self.end(failed=failed, terminated=step.terminated, score=score)
        self.is_open, self._has_failed = not is_over, failed and not is_over
        if resets:
            self.begin(now.observation, now.info)

    @alone
    def end(self, *, failed: bool, terminated: bool = False, score: float | None = None) -> None:
        """The guard's episode ends, if one is under way."""
        decider, guard = self._guard, self.terms.guard
        if decider is not None:
            if decider is not guard:
                self._episode = guard.begin(decider)
            rows = self._past if guard.learn else ()  # frozen, it only counts the episode
            for step, (observation, proposal, executed) in enumerate(rows):
                situation = guard.recognise(observation, step * guard.interval)
                guard.revise(situation, proposal, executed)
            how: dict[str, Any] = {"terminated": terminated, "score": score}
            guard.end(failed, self.seen, episode=self._episode, **how)
        self._guard, self._past = None, []


# Lanes of a guard that began an episode; a lock each; and guards that lanes were seen to share.
_LANES: WeakKeyDictionary[Guard, WeakSet[Lane]] = WeakKeyDictionary()
_TURNS: WeakKeyDictionary[Guard, RLock] = WeakKeyDictionary()
_SHARED: WeakSet[Guard] = WeakSet()

_FAILED = "lambda step: step.info['failed'], lambda step: step.reward <= -100 or 'terminated'"


class Terms:
    """How a guard and an environment understand each other's actions, observations, failures."""

    def __init__(
        self,
        guard: Guard,
        observations: Space[Any],
        actions: Space[Any],
        observe: Observe | None,
        failed: Failed | None,
        penalty: float,
    ) -> None:
        if not 0.0 <= penalty < math.inf:
            raise ValueError(f"penalty is {penalty}; it must be 0 or above, and finite")
        function("observe", observe, "lambda observation: observation['state']")
        if failed != "terminated":
            function("failed", failed, _FAILED)
        if not isinstance(guard, Guard):
            raise TypeError(f"guard is {guard!r}; it must be a Guard, as Guard.load(path) reads it")
        self._given = guard, observations, actions, observe, failed, penalty
        self.guard, self.space, self.penalty = guard, actions, penalty
        self._silent, self._has_decided = 0, False
        wrapper: Observe | None = None if observe is None else lambda seen: observe(_own(seen))
        self._observe, self._failed = wrapper or _flat(observations), failed
        keys = tuple(observations.keys()) if isinstance(observations, Dict) else ()
        if not observe and guard.variables != keys and {*guard.variables} == {*keys}:
            raise ValueError(f"names are {guard.variables}, but the Dict is taken in order: {keys}")
        self.to_guard, self._to_env = _conversions(actions, guard.actions)

    def __reduce__(self) -> Any:  # made anew where copied, as its functions are of no module
        return Terms, self._given

    def say_if_silent(self, why: str = "", *, ever: bool = True) -> None:
        """Count steps on end without a decision; warn, saying why, where they are many.

        With ``ever`` false only as long as nothing was ever decided.
        """
        self._has_decided |= not why
        is_silent = why and (ever or not self._has_decided)
        self._silent = self._silent + 1 if is_silent else 0
        if self._silent == _SILENT:
            warnings.warn(f"nothing was decided in {_SILENT} steps on end: {why}", stacklevel=5)

    def unjudged(self, proposal: Proposal, why: str) -> Revision:
        """The proposal, made usable, where nothing is judged."""
        usable = make_usable(proposal, self.guard.actions, self.guard.fallback)
        action, remark = passed(proposal, usable, self.guard.reviser)
        return unjudged_revision(action, proposal, f"{why}; {remark or 'not revised'}")

    def decided(self, action: Any, revision: Revision) -> Decided:
        """What is executed, as the environment takes it: the very action where it is kept."""
        is_kept = same_action(revision.executed, revision.proposed)
        executed = action if is_kept else self._to_env(revision.executed)
        actions, size = self.guard.actions, 0.0 if is_kept else 1.0
        if not is_kept and is_usable(actions, revision.proposed):
            request = self.to_guard(self._to_env(revision.proposed))  # as the environment takes it
            if not change(actions, request, put_into(actions, request)) > 1e-6:  # but for rounding
                request = put_into(actions, revision.proposed)
            size = change(actions, request, revision.executed)
        info = {
            "reviser/proposed_action": deepcopy(action),
            "reviser/executed_action": deepcopy(executed),
            "reviser/penalty": size,
            "reviser/reason": revision.reason,
        }
        risks = zip(_RISK_INFOS, (revision.risk_executed, revision.risk_proposed), strict=True)
        info |= {name: risk for name, risk in risks if not math.isnan(risk)}
        return Decided(executed, info, self.penalty * size)

    def failed(self, step: StepResult) -> bool:
        """Whether a step ended in failure, unless the guard finds that itself."""
        if self._failed is None or isinstance(self._failed, str):
            return step.terminated and (self._failed is not None or self.guard.failed is None)
        try:
            return answered(self._failed(replace(step, observation=_own(step.observation))))
        except (AttributeError, KeyError, TypeError) as error:
            error.add_note(f"failed gets a step {StepResult.__slots__}, such as failed={_FAILED}")
            raise

    def look(self, observation: Any) -> Floats | None:
        """What the guard observes; None where there is nothing to judge."""
        reply = None if observation is None else self._observe(observation)
        return None if reply is None else np.array(reply, dtype=np.float64)


def _own(observation: Any) -> Any:
    """A copy, which a function may work in; the very one where it cannot be copied."""
    try:
        return deepcopy(observation)
    except Exception:
        return observation


def _flat(space: Space[Any]) -> Observe:
    if isinstance(space, Box | MultiBinary):
        return lambda observation: np.reshape(observation, -1)
    if isinstance(space, Dict | Tuple):
        keys: Any = range(len(space)) if isinstance(space, Tuple) else space.keys()
        parts = {key: _flat(space[key]) for key in keys if key != "action_mask"}
        return lambda seen: np.concatenate([part(seen[key]) for key, part in parts.items()])
    if isinstance(space, Discrete):
        if space.n > _MOST_VALUES:
            fault = f"each of {space.n} values would be a variable, of at most {_MOST_VALUES}"
            hint = "give observe, which makes few (row, column)"
            raise ValueError(f"the environment's observations are {space}: {fault}; {hint}")
        first, unit = int(space.start), np.eye(int(space.n))
        return lambda observation: unit[int(observation) - first]
    fault = "neither Box, MultiBinary nor Discrete, nor a Dict or Tuple of these"
    hint = "give observe, which makes a vector of them"
    raise ValueError(f"the environment's observations are {space}, {fault}; {hint}")


def _sizes(space: Any) -> list[int]:
    """How many values each component of an action has, where that is what there is."""
    many = isinstance(space, MultiDiscrete | MultiBinary)
    return np.ravel(getattr(space, "nvec", np.full(space.shape, 2))).tolist() if many else []


def _of_combinations(space: Space[Any], mask: Any) -> Any:
    """A mask of all combinations; where it is one of each component, as MaskablePPO's, of them."""
    if mask is None or not (sizes := _sizes(space)):
        return mask
    count, is_parted = math.prod(sizes), isinstance(mask, tuple | list) and any(map(np.ndim, mask))
    if not is_parted and np.shape(mask) in {(count,)} - {(sum(sizes),)} | {tuple(sizes)}:
        return np.ravel(mask)
    parts = mask if is_parted else np.split(np.ravel(mask), np.cumsum(sizes)[:-1])
    if [*map(np.size, parts)] == sizes and (is_parted or count != sum(sizes)):
        return np.all(np.meshgrid(*parts, indexing="ij"), axis=0).ravel()
    wants = f"a tuple of arrays of {sizes} entries, or one of shape {tuple(sizes)}, of combinations"
    raise ValueError(f"the mask of allowed actions is {mask!r}, of {space}; it must be {wants}")


def _conversions(space: Space[Any], actions: ActionSet) -> tuple[_Convert, _Convert]:
    """From an action of the environment to one of the guard, and back."""
    sizes, start = _sizes(space), getattr(space, "start", 0)
    if isinstance(space, Discrete) and actions == Choices(int(space.n)):
        return lambda a: float(np.asarray(a).item()) - int(start), lambda a: int(start) + int(a)
    if sizes and actions == Choices(math.prod(sizes)):

        def index(action: Any) -> float:
            row = np.ravel(action - start)
            return float(np.ravel_multi_index(row, sizes)) if action in space else -1.0

        def combination(index: Action) -> NDArray[Any]:
            row = np.array(np.unravel_index(int(index), sizes), space.dtype)
            return np.asarray(row.reshape(space.shape) + start, space.dtype)

        return index, combination
    shape, is_range = np.shape(actions.low), not isinstance(actions, Choices)
    if not (isinstance(space, Box) and is_range and math.prod(space.shape) == math.prod(shape)):
        raise ValueError(
            f"the environment's actions are {space}, but the guard's are {actions}: make a guard "
            "of such actions, n_actions of Discrete (of MultiDiscrete and MultiBinary all their "
            "combinations) and arrays low and high of Box, or wrap the environment (RescaleAction)"
        )
    low, high = (np.reshape(end, space.shape) for end in (actions.low, actions.high))
    slack = 1e-6 * (high - low)  # what a float32 may round
    ends = f"the guard's actions go from {actions.low} to {actions.high}"
    if (low < space.low - slack).any() or (high > space.high + slack).any():
        hint = "make a guard of the environment's low and high"
        raise ValueError(f"{ends}, beyond those of the environment, {space}; {hint}")
    is_narrower = (low > space.low + slack) | (high < space.high - slack)
    if (is_narrower & np.isfinite(space.low) & np.isfinite(space.high)).any():
        fate = "where it acts, those beyond are put at its edge, safe or not"
        warnings.warn(f"{ends}, the environment's further, {space}: {fate}", stacklevel=4)

    def to_guard(action: Any) -> Action:
        array = np.array(action, dtype=np.float64)
        if array.size != math.prod(shape):
            raise ValueError(f"the action is {action!r}, but the environment's are {space}")
        return array.reshape(shape) if shape else array.item()

    def to_env(action: Action) -> NDArray[Any]:
        array = np.asarray(action).reshape(space.shape).astype(space.dtype)
        return np.asarray(np.clip(array, space.low, space.high))

    return to_guard, to_env


# -- Environments and wrappers that do not fit --------------------------------------------------


def refuse_unless(fits: bool, env: Any) -> None:
    """Raise for an environment of another kind than a wrapper takes."""
    if not fits:
        raise TypeError(
            f"this wrapper takes no {type(env).__name__}: RevisedActions takes a gymnasium.Env, "
            "RevisedVectorActions a gymnasium.vector.VectorEnv, RevisedAgents a ParallelEnv of "
            "PettingZoo, as parallel_env() makes it, or pettingzoo.utils.aec_to_parallel(env); "
            "wrap the single environments of a VecEnv of Stable-Baselines3"
        )


def _spaces(env: Any) -> tuple[Space[Any], Space[Any]]:
    """Of observations and of actions; where a wrapper clips those, what they are clipped to."""

    def of(one: Any, what: str) -> Any:
        return getattr(one, f"single_{what}", getattr(one, what, None))

    acts = of(env, "action_space")
    for layer in _layers(env):
        if of(layer, "action_space") != acts:
            break
        if type(layer).__name__ == "ClipAction":
            acts = of(layer.env, "action_space")
    return of(env, "observation_space"), acts


def _layers(env: Any) -> Iterator[Any]:
    """An environment and those that it wraps, from the outermost; of many the first."""
    while env is not None:
        yield env
        many = getattr(env, "envs", None) if isinstance(env, VectorEnv) else None
        env = many[0] if many else getattr(env, "env", None)


def warn_of(env: Any, guard: Guard, failed: Failed | None) -> None:
    """Name what stands below a guard and keeps it from learning, or others from what it learns."""
    if guard.learn and guard.process != os.getpid():
        how = "by deepcopy or pickle, as gym.make and other processes make them"
        fault = f"the guard is a copy ({how}): it learns for itself. If so meant, use guard.copy()"
        hint = "Run the environments in one process (DummyVecEnv, SyncVectorEnv), wrap those that "
        warnings.warn(f"{fault}. {hint}gym.make returns, or save this guard", stacklevel=3)
    if failed is None and guard.failed is None and guard.learn:
        warnings.warn(
            "nobody says which episodes failed: all that are terminated are taken to have. If so, "
            "say failed='terminated'; if an episode may also end well, say which failed, such as "
            "failed=lambda step: step.terminated and step.reward <= 0",
            stacklevel=3,
        )
    for layer in _layers(env):
        if isinstance(layer, _Settled) and layer.guard is guard:
            hint = "make it anew, or wrap what is below (was a cell of a notebook run again?)"
            raise ValueError(f"the environment is under this guard already, twice it errs: {hint}")
        attributes, why = getattr(layer, "__dict__", {}), ""
        # SuperSuit has one wrapper, for each agent's modifier or for the only one.
        kinds = attributes.get("modifier_class"), type(attributes.get("modifier"))
        names = [str(getattr(kind, "__name__", "")) for kind in kinds]
        name = next((n for n in names if n.endswith("Modifier")), type(layer).__name__)
        updates = getattr(layer, "update_running_mean", getattr(layer, "training", True))
        uses_reward = "reward" in getattr(getattr(failed, "__code__", None), "co_names", ())
        if "obs_rms" in attributes and updates:
            why = "rescales observations by statistics that change, so that no threshold stays"
        elif "return_rms" in attributes and updates and uses_reward:
            why = "rescales the reward, which failed looks at, by statistics that change"
        elif name.startswith("Sticky"):
            why = "executes other actions than the guard decides on"
        elif name.startswith("DelayObs") and attributes.get("delay", math.inf) > 1:
            why = "shows the guard where the system was, not where it is"
        elif name == "DictInfoToList":
            why = "makes a list of infos, in which a dictionary is read"
        elif name.startswith("black_death"):
            why = "hides which agents failed, and goes on with zeros, until all are done"
        if why:
            hint = f"Wrap the environment in the guard first, and that in {name}"
            fault = f"{name} below the guard {why}: it learns badly, or nothing"
            warnings.warn(f"{fault}. {hint}", stacklevel=3)

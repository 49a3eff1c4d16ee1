"""Learn a machine from a stream of traces, and score its forecasts before it learns from them.

Every forecast is made before the rows it is about are learnt, so the scores are of data the
machine had not seen. The rival is persistence: the belief stays as it is. A forecast's distance
from the belief that came is measured by the Jensen-Shannon divergence.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from evofsm.actions import IntervalActions
from evofsm.divergence import jensen_shannon
from evofsm.io import Chunk
from evofsm.machine import EvolvingFSM
from evofsm.memory import NO_ACTION
from evofsm.model import FSMModel
from evofsm.step import widen
from evofsm.transitions import Policy

#: How far ahead the longer forecast looks [s].
HORIZON = 1.0

# An action taken less often in a state than this says nothing about where it leads.
_LEAST_EVIDENCE = 10.0

_POLICIES: tuple[Policy, ...] = get_args(Policy)


@dataclass(frozen=True)
class Skill:
    """How well one kind of forecast did against persistence."""

    steps: int  #: looked ahead
    seconds: float  #: looked ahead [s]
    policy: Policy | None  #: actions after the first step; None where there is only one step
    forecasts: int  #: number scored
    divergence: float  #: mean, from the belief that came [bit]
    persistence: float  #: the same mean for the belief that stays as it is [bit]

    @property
    def skill(self) -> float:
        """1 for a perfect forecast, 0 for one as good as persistence, negative for a worse one.

        NaN where nothing was forecast or the belief never moved.
        """
        return 1.0 - self.divergence / self.persistence if self.persistence > 0.0 else np.nan


@dataclass(frozen=True)
class Learning:
    """What was learnt, and from what."""

    machine: EvolvingFSM  #: can go on learning
    model: FSMModel
    rows: int  #: observations
    episodes: int
    seconds: float  #: time between the first and the last row of the episodes, together [s]
    transitions: int  #: learnt
    clipped_below: int  #: actions below the range, put into its first interval
    clipped_above: int  #: actions above the range, put into its last interval
    jumps: int  #: episodes that began because of a hole in time
    cuts: int  #: episodes cut because too many pairs were on the road at once
    certainty: float  #: mean share of the belief that the most probable state has
    skills: tuple[Skill, ...]  #: of one step, then of `HORIZON` under each policy


def learn_traces(
    chunks: Iterable[Chunk],
    machine: EvolvingFSM,
    actions: IntervalActions,
    names: Sequence[str] = (),
    units: Sequence[str] = (),
) -> Learning:
    """Learn all chunks in their order, each row once.

    Parameters
    ----------
    chunks : iterable of Chunk
        As `evofsm.io.read_traces` gives them.
    machine : EvolvingFSM
        Is copied, and the copy is taught; needs as many actions as ``actions`` has intervals.
    actions : IntervalActions
        Turns actions into indices; made with ``outside="clip"`` it takes any action.
    names, units : sequence of str, optional
        Of the variables, for the model.

    Returns
    -------
    Learning

    Raises
    ------
    ValueError
        If no row follows another in any episode, so that there is no transition to learn.
    """
    if actions.n_actions != machine.n_actions:
        raise ValueError(
            f"the machine has {machine.n_actions} actions, but there are "
            f"{actions.n_actions} intervals"
        )
    machine = machine.copy()
    learner = _Learner(machine, actions)
    for chunk in chunks:
        learner.learn(chunk)
    if learner.transitions == 0:
        raise ValueError(
            "no transition could be learnt: no row with an action is followed by another row of "
            "its episode (is every row an episode? are the rows sorted by episode and time?)"
        )
    return Learning(
        machine=machine,
        model=machine.model(actions=actions, names=names, units=units, dt=learner.dt),
        rows=learner.rows,
        episodes=learner.episodes,
        seconds=learner.seconds,
        transitions=learner.transitions,
        clipped_below=learner.clipped_below,
        clipped_above=learner.clipped_above,
        jumps=learner.jumps,
        cuts=learner.cuts,
        certainty=learner.certainty / learner.rows,
        skills=learner.skills(),
    )


class Passage(NamedTuple):
    """A transition from one state to another."""

    origin: int  #: state
    target: int  #: state
    times: int  #: steps in which the recognised state went from the one to the other
    share: float  #: of the steps from the state of origin
    learnt: float  #: probability per step that the matrices give, actions as often as used
    action: int | None  #: under which that is highest, of those taken there often enough
    under_action: float  #: probability per step under that action
    taken: float  #: about how often that action was taken in the state of origin


def passages(model: FSMModel, most: int = 12) -> list[Passage]:
    """The transitions between states that matter: those that were recognised most often.

    How often an action was taken in a state is estimated from its use as a whole and the share
    of the state in its recent use.
    """
    counts = model.changes - np.diag(np.diag(model.changes))
    steps = model.changes.sum(axis=1)
    learnt = model.averaged_matrix("observed")
    recent = model.origin_frequency.sum(axis=1, keepdims=True)
    taken = model.uses[:, None] * model.origin_frequency / np.where(recent > 0.0, recent, 1.0)
    found = []
    for place in np.argsort(-counts, axis=None, kind="stable")[:most]:
        i, j = divmod(int(place), model.n_states)
        if counts[i, j] == 0.0:
            break
        tried = np.flatnonzero(taken[:, i] >= _LEAST_EVIDENCE)
        best = int(tried[model.transition_matrices[tried, i, j].argmax()]) if len(tried) else None
        under, often = (
            (np.nan, np.nan)
            if best is None
            else (float(model.transition_matrices[best, i, j]), float(taken[best, i]))
        )
        times, share = int(counts[i, j]), float(counts[i, j] / steps[i])
        found.append(Passage(i, j, times, share, float(learnt[i, j]), best, under, often))
    return found


class _Learner:
    """Learns chunk by chunk; holds counts and sums, and of the rows only the last belief."""

    def __init__(self, machine: EvolvingFSM, actions: IntervalActions) -> None:
        self.machine = machine
        self.actions = actions
        self.dt = np.nan
        self.rows = self.episodes = self.transitions = self.jumps = self.cuts = 0
        self.clipped_below = self.clipped_above = 0
        self.seconds = self.certainty = 0.0
        self._one_step = _Score(1)
        self._ahead = _Score(len(_POLICIES))
        self._forecast: NDArray[np.float64] | None = None  # persistence, then each policy's
        self._last_belief = np.zeros(0)
        self._last_time = np.nan
        self._age = 0  # of the present episode [rows]

    def learn(self, chunk: Chunk) -> None:
        """Learn a chunk and score the forecasts of it."""
        self.dt = chunk.dt
        known = ~np.isnan(chunk.actions)
        indices = np.full(len(known), NO_ACTION)
        indices[known] = self.actions.encode(chunk.actions[known])
        beliefs, surprise = self._learn_rows(chunk, indices)

        predicted = ~np.isnan(surprise)
        before = np.vstack([widen(self._last_belief, beliefs.shape[1]), beliefs[:-1]])
        stayed = np.asarray(jensen_shannon(before[predicted], beliefs[predicted]))
        self._one_step.add(surprise[predicted, None], stayed)
        self._last_belief = beliefs[-1]

        steps = np.diff(chunk.times, prepend=self._last_time)
        steps[chunk.starts] = 0.0
        self._last_time = chunk.times[-1]
        self.seconds += float(steps.sum())
        self.certainty += float(beliefs.max(axis=1).sum())
        self.rows += len(steps)
        self.episodes += len(chunk.starts)
        self.transitions += int(predicted.sum())
        self.jumps += chunk.jumps
        self.cuts += chunk.cuts
        self.clipped_below += int((chunk.actions < self.actions.low).sum())
        self.clipped_above += int((chunk.actions > self.actions.high).sum())

    def skills(self) -> tuple[Skill, ...]:
        """Of all forecasts so far."""
        steps = self._steps_ahead
        ahead = self._ahead.skills(steps, self.dt, _POLICIES) if steps else ()
        return (*self._one_step.skills(1, self.dt, [None]), *ahead)

    @property
    def _steps_ahead(self) -> int:
        """Steps of the longer forecast; 0 where one step is about as long, or longer."""
        steps = 0 if np.isnan(self.dt) else round(HORIZON / self.dt)
        return steps if steps > 1 else 0

    def _learn_rows(
        self, chunk: Chunk, indices: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Beliefs and surprises of all rows; halts on the way to score and to forecast."""
        ages = self._ages_of(chunk)
        steps = self._steps_ahead
        halts = np.flatnonzero(ages % steps == 0) if steps else np.empty(0, np.int64)
        learnt = []
        scored = []
        first = 0
        for halt in halts.tolist():
            learnt.append(self._learn_slice(chunk, indices, slice(first, halt + 1)))
            first = halt + 1
            if self._forecast is not None and ages[halt] > 0:
                scored.append((self._forecast, self.machine.belief))
            self._forecast = None
            if indices[halt] != NO_ACTION:
                self._forecast = self._look_ahead(int(indices[halt]), steps)
        learnt.append(self._learn_slice(chunk, indices, slice(first, len(ages))))

        n = self.machine.n_states
        if scored:
            forecasts = np.stack([widen(forecast, n) for forecast, _ in scored])
            came = np.stack([widen(belief, n) for _, belief in scored])
            divergence = np.asarray(jensen_shannon(forecasts, came[:, None]))
            self._ahead.add(divergence[:, 1:], divergence[:, 0])
        beliefs = np.vstack([widen(belief, n) for belief, _ in learnt])
        return beliefs, np.concatenate([surprise for _, surprise in learnt])

    def _ages_of(self, chunk: Chunk) -> NDArray[np.int64]:
        """Rows since the beginning of each row's episode."""
        rows = np.arange(len(chunk.times))
        begun = np.full(len(rows), -self._age)  # where the present episode would have its row 0
        begun[chunk.starts] = chunk.starts
        ages = rows - np.maximum.accumulate(begun)
        self._age = int(ages[-1]) + 1
        return ages

    def _learn_slice(
        self, chunk: Chunk, indices: NDArray[np.int64], rows: slice
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Beliefs and surprises of some rows."""
        starts = chunk.starts[(chunk.starts >= rows.start) & (chunk.starts < rows.stop)]
        trace = self.machine.learn_many(
            chunk.observations[rows], indices[rows], starts - rows.start, belief=True
        )
        assert trace.belief is not None  # asked for
        return trace.belief, trace.surprise

    def _look_ahead(self, action: int, steps: int) -> NDArray[np.float64]:
        """(1 + policies, n) the belief as it stands, and what it is forecast to become."""
        forecasts = (self.machine.predict(action, steps, policy) for policy in _POLICIES)
        return np.stack([self.machine.belief, *forecasts])


class _Score:
    """Sums of divergences of some forecasts and of persistence, over the same rows."""

    def __init__(self, kinds: int) -> None:
        self._rows = 0
        self._divergence = np.zeros(kinds)
        self._persistence = 0.0

    def add(self, divergence: NDArray[np.float64], persistence: NDArray[np.float64]) -> None:
        """Take in (N, kinds) divergences of forecasts and (N,) of persistence."""
        self._rows += len(persistence)
        self._divergence += divergence.sum(axis=0)
        self._persistence += float(persistence.sum())

    def skills(self, steps: int, dt: float, policies: Sequence[Policy | None]) -> tuple[Skill, ...]:
        """The means, for each kind of forecast."""
        rows = self._rows or np.nan
        return tuple(
            Skill(
                steps, steps * dt, policy, self._rows, float(total / rows), self._persistence / rows
            )
            for policy, total in zip(policies, self._divergence, strict=True)
        )

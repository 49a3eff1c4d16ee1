"""Learn a machine from a stream of traces, and score its forecasts before it learns from them.

Every forecast is made before the rows it is about are learnt, so the scores are of data the
machine had not seen. The rival is persistence: the belief stays as it is. A forecast's distance
from the belief that came is measured by the Jensen-Shannon divergence.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from evofsm import store
from evofsm.fleet.checkpoint import Checkpoint, Kept
from evofsm.fsm import (
    NO_ACTION,
    NOT_OPEN,
    EvolvingFSM,
    FSMModel,
    Inside,
    IntervalActions,
    Limit,
    Policy,
    Trace,
    Transitions,
    check_rows,
    compiled,
    jensen_shannon_kernel,
    kernel,
    learn_rows,
    open_memory,
    widen,
)
from evofsm.io.logs import Chunk

#: How far ahead the longer forecast looks [s].
HORIZON = 1.0

_POLICIES: tuple[Policy, ...] = get_args(Policy)
_HOLD, _OBSERVED = _POLICIES.index("hold"), _POLICIES.index("observed")
# What a learner counts.
_COUNTS = (
    *("chunks", "rows", "episodes", "jumps", "cuts", "failures"),
    *("clipped_below", "clipped_above"),
)
# Rows whose beliefs are kept at a time.
_ROWS_AT_ONCE = 1024


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
    failures: int | None  #: episodes that ended in failure; None where nothing told of failures
    certainty: float  #: mean share of the belief that the most probable state has
    skills: tuple[Skill, ...]  #: of one step, then of `HORIZON` under each policy


def learn_traces(
    chunks: Iterable[Chunk],
    machine: EvolvingFSM,
    actions: IntervalActions,
    names: Sequence[str] = (),
    units: Sequence[str] = (),
    checkpoint: Checkpoint | None = None,
    *,
    live: bool = False,
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
    checkpoint : Checkpoint, optional
        Keeps what was learnt between two chunks. Where its file exists, what was learnt before is
        gone on with: as many of the chunks, which must be the same, are passed over; none is read
        where all were learnt. The result is the same, bit for bit.
    live : bool
        Whether chunks come as things happen, so that none comes again. Then none is passed over:
        what was learnt before is gone on with, and what came after the latest checkpoint and
        before a stop is lost; `Learning.rows` counts what is not.

    Returns
    -------
    Learning

    Raises
    ------
    ValueError
        If no row follows another in any episode, so that there is no transition to learn, or the
        checkpoint is of other work, or the chunks are others than it knows.
    """
    if actions.n_actions != machine.n_actions:
        raise ValueError(
            f"the machine has {machine.n_actions} actions, but there are "
            f"{actions.n_actions} intervals"
        )
    learner = _Learner(machine.copy(), actions)
    _learn_all(chunks, learner, checkpoint, live)
    machine = learner.machine
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
        failures=learner.failures if learner.machine.failures_told else None,
        certainty=learner.certainty / learner.rows,
        skills=learner.skills(),
    )


def _learn_all(
    chunks: Iterable[Chunk], learner: _Learner, checkpoint: Checkpoint | None, live: bool
) -> None:
    """Learn what was not learnt before, and keep it."""
    if checkpoint is None:
        for chunk in _ahead(chunks):
            learner.learn(chunk)
        return
    kept = checkpoint.begin(learner.keep())
    with store.explained(checkpoint.path):
        learner.restore(kept)
    if kept.finished and not live:
        return
    coming = _ahead(chunks)
    if not live:
        _pass_over(coming, learner, checkpoint)
    for chunk in coming:
        learner.learn(chunk)
        checkpoint.offer(learner.keep)
    checkpoint.keep(learner.keep(finished=True))


def _pass_over(coming: Iterator[Chunk], learner: _Learner, checkpoint: Checkpoint) -> None:
    """Leave out the chunks that were learnt before."""
    rows = sum(len(chunk.times) for chunk in islice(coming, learner.chunks))
    if rows != learner.rows:
        raise ValueError(
            f"{checkpoint.path} has learnt {learner.rows:,} rows, where there are {rows:,} now; "
            "the files were changed, or are read in other pieces: delete it to begin anew"
        )


def _ahead(chunks: Iterable[Chunk]) -> Iterator[Chunk]:
    """The same chunks; another thread reads the next one while one is learnt."""
    waiting = iter(chunks)
    with ThreadPoolExecutor(1) as reader:
        coming = reader.submit(next, waiting, None)
        while (chunk := coming.result()) is not None:
            coming = reader.submit(next, waiting, None)
            yield chunk


class _Scores(NamedTuple):
    """Sums over all rows so far, and what the next row needs; the first axis of most is of 1."""

    #: number of forecasts, divergence of persistence, then of each kind of forecast [bit]
    one_step: NDArray[np.float64]
    ahead: NDArray[np.float64]
    certainty: NDArray[np.float64]
    age: NDArray[np.int64]  # of the present episode [rows]
    waiting: NDArray[np.bool_]  # whether the forecasts below are still to be scored
    belief: NDArray[np.float64]  # (capacity,) in the latest row
    forecasts: NDArray[np.float64]  # (1 + policies, capacity) persistence, then each policy's


class _Room(NamedTuple):
    """Room in which to learn R rows at a time; worth nothing after it."""

    beliefs: NDArray[np.float64]  # (R, capacity)
    state: NDArray[np.int64]  # (R,)
    n_states: NDArray[np.int64]  # (R,)
    event: NDArray[np.int8]  # (R,)
    surprise: NDArray[np.float64]  # (R,)
    vector: NDArray[np.float64]  # (capacity,)
    matrix: NDArray[np.float64]  # (capacity, capacity)
    square: NDArray[np.float64]  # (capacity, capacity)


class _Learner:
    """Learns chunk by chunk; holds counts and sums, and of the rows only the last belief."""

    def __init__(self, machine: EvolvingFSM, actions: IntervalActions) -> None:
        self.machine = machine
        self.actions = actions
        self.dt = np.nan
        self.rows = self.episodes = self.jumps = self.cuts = self.chunks = self.failures = 0
        self.clipped_below = self.clipped_above = 0
        self.seconds = 0.0
        self._last_time = np.nan
        kinds = len(_POLICIES)
        self._scores = _Scores(
            one_step=np.zeros(3),
            ahead=np.zeros(2 + kinds),
            certainty=np.zeros(1),
            age=np.zeros(1, np.int64),
            waiting=np.zeros(1, np.bool_),
            belief=np.zeros(0),
            forecasts=np.zeros((1 + kinds, 0)),
        )
        self._make_room()

    @property
    def transitions(self) -> int:
        """Number learnt."""
        return int(self._scores.one_step[0])

    @property
    def certainty(self) -> float:
        """Sum over all rows."""
        return float(self._scores.certainty[0])

    def learn(self, chunk: Chunk) -> None:
        """Learn a chunk and score the forecasts of it."""
        self.dt = chunk.dt
        self._learn_rows(chunk)
        steps = np.diff(chunk.times, prepend=self._last_time)
        steps[chunk.starts] = 0.0
        self._last_time = chunk.times[-1]
        self.seconds += float(steps.sum())
        self.chunks += 1
        self.rows += len(steps)
        self.episodes += len(chunk.starts)
        self.jumps += chunk.jumps
        self.cuts += chunk.cuts
        self.failures += 0 if chunk.failures is None else len(chunk.failures)
        self.clipped_below += int((chunk.actions < self.actions.low).sum())
        self.clipped_above += int((chunk.actions > self.actions.high).sum())

    def skills(self) -> tuple[Skill, ...]:
        """Of all forecasts so far."""
        steps = self._steps_ahead
        ahead = _skills(self._scores.ahead, steps, self.dt, _POLICIES) if steps else ()
        return (*_skills(self._scores.one_step, 1, self.dt, [None]), *ahead)

    def keep(self, finished: bool = False) -> Kept:
        """All of it, for a checkpoint."""
        machine = io.BytesIO()
        self.machine.save(machine)
        n = self.machine.n_states
        return Kept(
            {name: getattr(self, name) for name in _COUNTS},
            {
                "machine": np.frombuffer(machine.getvalue(), np.uint8),
                "clock": np.array([self.dt, self.seconds, self._last_time]),
                **self._scores._replace(
                    belief=self._scores.belief[:n], forecasts=self._scores.forecasts[:, :n]
                )._asdict(),
            },
            finished,
        )

    def restore(self, kept: Kept) -> None:
        """Take over what `keep` returned."""
        arrays = kept.arrays
        self.machine = type(self.machine).load(io.BytesIO(arrays["machine"].tobytes()))
        if self.machine.n_actions != self.actions.n_actions:
            raise ValueError(f"its machine has {self.machine.n_actions} actions")
        scores = _Scores(*(np.array(arrays[name]) for name in _Scores._fields))
        for name in _COUNTS:
            setattr(self, name, int(kept.content.get(name, 0)))
        self.dt, self.seconds, self._last_time = arrays["clock"].tolist()
        n, kinds = self.machine.n_states, len(_POLICIES)
        for name, shape in (
            ("one_step", (3,)),
            ("ahead", (2 + kinds,)),
            ("belief", (n,)),
            ("forecasts", (1 + kinds, n)),
            *((name, (1,)) for name in ("certainty", "age", "waiting")),
        ):
            now, old = getattr(scores, name), getattr(self._scores, name)
            if now.shape != shape or now.dtype != old.dtype:
                raise ValueError(f"{name} has shape {now.shape} of {now.dtype}, not {shape}")
        self._scores = scores
        self._make_room()

    @property
    def _steps_ahead(self) -> int:
        """Steps of the longer forecast; 0 where one step is about as long, or longer."""
        steps = 0 if np.isnan(self.dt) else round(HORIZON / self.dt)
        return steps if steps > 1 else 0

    def _learn_rows(self, chunk: Chunk) -> None:
        known = ~np.isnan(chunk.actions)
        indices = np.full(len(known), NO_ACTION)
        indices[known] = self.actions.encode(chunk.actions[known])
        inside = Inside(self.machine)
        observations = inside.check(chunk.observations)
        starts = check_rows("starts", chunk.starts, len(observations))
        failures = np.zeros(len(observations), np.bool_)
        if chunk.failures is not None:
            failures = check_rows("failures", chunk.failures, len(observations))
            self.machine.tell_of_failures()
        row = 0
        while row < len(observations):
            if len(self._scores.belief) < inside.capacity:
                self._make_room()
            row = _learn_and_score(
                inside.buffer,
                observations,
                indices,
                starts,
                failures,
                row,
                self._steps_ahead,
                self._scores,
                self._room,
                inside.limit,
            )
            if row < len(observations):
                inside.grow()

    def _make_room(self) -> None:
        """Make room for as many states as the machine has room for."""
        rows, capacity = _ROWS_AT_ONCE, Inside(self.machine).capacity
        self._scores = self._scores._replace(
            belief=widen(self._scores.belief, capacity),
            forecasts=widen(self._scores.forecasts, capacity),
        )
        self._room = _Room(
            beliefs=np.zeros((rows, capacity)),
            state=np.zeros(rows, np.int64),
            n_states=np.zeros(rows, np.int64),
            event=np.zeros(rows, np.int8),
            surprise=np.zeros(rows),
            vector=np.zeros(capacity),
            matrix=np.zeros((capacity, capacity)),
            square=np.zeros((capacity, capacity)),
        )


def _skills(
    sums: NDArray[np.float64], steps: int, dt: float, policies: Sequence[Policy | None]
) -> tuple[Skill, ...]:
    """The means, for each kind of forecast."""
    forecasts, persistence, *totals = sums.tolist()
    rows = forecasts or np.nan
    return tuple(
        Skill(steps, steps * dt, policy, int(forecasts), total / rows, persistence / rows)
        for policy, total in zip(policies, totals, strict=True)
    )


# -- Kernels --------------------------------------------------------------------------------------


def _learn_and_score_rows(
    buffer: NDArray[np.float64],
    observations: NDArray[np.float64],
    actions: NDArray[np.int64],
    starts: NDArray[np.bool_],
    failures: NDArray[np.bool_],
    row: int,
    steps_ahead: int,
    scores: _Scores,
    room: _Room,
    limit: Limit,
) -> int:
    """Learn and score rows from ``row`` on; returns the row for which the machine had no room.

    Every ``steps_ahead`` rows of an episode it halts, to score the longer forecasts made at the
    halt before, and to make others.
    """
    while row < len(observations):
        most = min(len(observations) - row, len(room.beliefs))
        rows, halts = _until_halt(starts[row : row + most], scores.age[0], steps_ahead)
        these = slice(row, row + rows)
        room.beliefs[:rows] = 0.0
        learnt = learn_rows(
            buffer,
            observations[these],
            actions[these],
            starts[these],
            failures[these],
            0,
            Trace(room.state, room.n_states, room.event, room.surprise),
            room.beliefs,
            limit,
        )
        _score_rows(starts[these], learnt, scores, room)
        row += learnt
        if learnt < rows:
            break
        if halts:
            _score_ahead(room.n_states[rows - 1], scores, room)
            if actions[row - 1] != NO_ACTION and not failures[row - 1]:
                _look_ahead(buffer, actions[row - 1], steps_ahead, scores, room)
    return row


@kernel
def _until_halt(starts: NDArray[np.bool_], age: int, steps_ahead: int) -> tuple[int, bool]:
    """Number of rows up to the next halt, that one included, and whether there is one."""
    since = age % max(steps_ahead, 1)
    for row in range(len(starts)):
        if starts[row]:
            since = 0
        if since == 0 and steps_ahead > 0:
            return row + 1, True
        since += 1
        if since == steps_ahead:
            since = 0
    return len(starts), False


@kernel
def _score_rows(starts: NDArray[np.bool_], rows: int, scores: _Scores, room: _Room) -> None:
    """Score the forecasts of one step of the rows just learnt."""
    before = scores.belief
    for row in range(rows):
        n, belief = room.n_states[row], room.beliefs[row]
        if starts[row]:
            scores.age[0] = 0
            scores.waiting[0] = False
        scores.age[0] += 1
        scores.certainty[0] += belief[room.state[row]]
        surprise = room.surprise[row]
        if surprise == surprise:  # a forecast was made
            scores.one_step[0] += 1.0
            scores.one_step[1] += jensen_shannon_kernel(before, belief, n, room.vector)
            scores.one_step[2] += surprise
        before = belief
    for i in range(len(before)):
        scores.belief[i] = before[i]


@kernel
def _score_ahead(n: int, scores: _Scores, room: _Room) -> None:
    """Score the longer forecasts that wait for the latest row."""
    if scores.waiting[0]:
        scores.ahead[0] += 1.0
        for kind in range(len(scores.forecasts)):
            scores.ahead[1 + kind] += jensen_shannon_kernel(
                scores.forecasts[kind], scores.belief, n, room.vector
            )
    scores.waiting[0] = False


@kernel
def _look_ahead(
    buffer: NDArray[np.float64], action: int, steps: int, scores: _Scores, room: _Room
) -> None:
    """Forecast as `FSMModel.propagate` does, under each policy."""
    now = open_memory(buffer).learnt
    n = int(now.n_states[0])
    scores.waiting[0] = True
    for forecast in scores.forecasts:
        for i in range(len(forecast)):
            forecast[i] = scores.belief[i]
    for policy in range(len(scores.forecasts) - 1):
        forecast = scores.forecasts[1 + policy]
        room.matrix[:n, :n] = 0.0
        _add(now.transitions, action, 1.0, n, room.matrix)
        _advance(forecast, 1, n, room)
        if policy != _HOLD:
            _average(now.transitions, policy == _OBSERVED, n, room.matrix)
        _advance(forecast, steps - 1, n, room)


@kernel
def _average(transitions: Transitions, observed: bool, n: int, matrix: NDArray[np.float64]) -> None:
    """Average the matrices of all actions: each alike, or as often as it was used."""
    total = transitions.uses.sum()
    matrix[:n, :n] = 0.0
    for action in range(len(transitions.uses)):
        if observed and total > 0.0:
            weight = transitions.uses[action] / total
        else:
            weight = 1.0 / len(transitions.uses)
        _add(transitions, action, weight, n, matrix)


@kernel
def _add(
    transitions: Transitions, action: int, weight: float, n: int, matrix: NDArray[np.float64]
) -> None:
    """Add an action's matrix, times a weight."""
    place = int(transitions.places[action])
    for i in range(n):
        for j in range(n):
            if place == NOT_OPEN:
                share = 1.0 / n
            else:
                share = transitions.scales[place, i] * transitions.matrices[place, i, j]
            matrix[i, j] += weight * share


@kernel
def _advance(belief: NDArray[np.float64], steps: int, n: int, room: _Room) -> None:
    """Multiply a belief by the matrix in ``room``, as often as there are steps.

    The matrix is squared where this saves more than it costs.
    """
    while steps > 0:
        if steps % 2 == 0 and steps > 2 * n:
            for i in range(n):
                _multiply(room.matrix[i], room.matrix, n, room.square[i])
            for i in range(n):
                for j in range(n):
                    room.matrix[i, j] = room.square[i, j]
            steps //= 2
        else:
            _multiply(belief, room.matrix, n, room.vector)
            for i in range(n):
                belief[i] = room.vector[i]
            steps -= 1


@kernel
def _multiply(
    vector: NDArray[np.float64], matrix: NDArray[np.float64], n: int, product: NDArray[np.float64]
) -> None:
    for j in range(n):
        product[j] = 0.0
    for i in range(n):
        for j in range(n):
            product[j] += vector[i] * matrix[i, j]


# Without the lock of the interpreter, so that the next rows can be read meanwhile.
_learn_and_score = compiled(_learn_and_score_rows, nogil=True, _nrt=False)

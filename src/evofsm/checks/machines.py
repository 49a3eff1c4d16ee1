"""The contract of a machine: it observes, is told what was done, learns and forecasts."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.checks.contracts import (
    Contract,
    insist,
    is_distribution,
    refusals,
    refuse_growth,
    same,
)
from evofsm.checks.kinds import Make

CONTRACT = Contract()

# What is looked at to see whether two machines hold the same.
_HELD = (
    *("n_states", "state", "belief", "centers", "potentials", "transition_matrices"),
    *("marginal_matrix", "origin_frequency", "decisions", "failures", "endings", "onsets"),
)
# The same of its dynamics, where it has some.
_MOVING = ("n_episodes", "used", "lowest", "highest", "reached", "weights", "clock")
_ROWS = 60
# With this exactness beliefs and rows of matrices sum to 1.
_EXACT = 1e-9

Rows = tuple[NDArray[np.float64], NDArray[np.int64]]


def stream(machine: Any, rows: int = _ROWS, seed: int = 0) -> Rows:
    """Observations that a machine takes, and actions that it has, drawn at random."""
    draw = np.random.default_rng(seed)
    scales = np.asarray(getattr(getattr(machine, "rule", None), "scales", ()) or np.ones(3))
    if getattr(machine, "n_states", 0):
        scales = np.ones(np.shape(machine.centers)[1])
    Z = np.cumsum(draw.normal(size=(rows, len(scales))), axis=0) * scales
    return Z, draw.integers(0, machine.n_actions, rows)


def teach(machine: Any, Z: NDArray[np.float64], actions: NDArray[np.int64]) -> list[Any]:
    """Observe and act row by row; returns the steps."""
    steps = []
    for z, i in zip(Z, actions.tolist(), strict=True):
        steps.append(machine.observe(z))
        machine.act(i, **executed(machine, i))
    return steps


def executed(machine: Any, actions: Any) -> dict[str, Any]:
    """What a machine has to be told of actions beside their indices: their numbers, if any."""
    moves = getattr(machine, "dynamics", None)
    if moves is None or moves.choices:
        return {}
    share = (np.asarray(actions)[..., None] + 0.5) / machine.n_actions
    return {"executed": moves.low + share * (moves.high - moves.low)}


def held(machine: Any) -> dict[str, Any]:
    """What a machine holds, as far as it can be looked at."""
    found = {name: np.copy(getattr(machine, name)) for name in _HELD if hasattr(machine, name)}
    moves = getattr(machine, "dynamics", None)
    if moves is not None and moves.n_variables:
        parts = {name: getattr(moves, name) for name in _MOVING} | moves.sums._asdict()
        parts["stretches"] = len(moves.stretches)
        found |= {f"dynamics.{name}": np.copy(part) for name, part in parts.items()}
    return found


def difference(one: dict[str, Any], other: dict[str, Any]) -> str:
    """Names of what differs."""
    return ", ".join(name for name in one if not same(one[name], other[name]))


def _answer(step: Any) -> tuple[Any, ...]:
    names = ("state", "belief", "event", "predicted", "surprise")
    return tuple(getattr(step, name) for name in names if hasattr(step, name))


def _future(machine: Any) -> list[tuple[Any, ...]]:
    """What it will return for observations that come next."""
    return [_answer(step) for step in teach(machine, *stream(machine, 20, seed=1))]


def _taught(make: Make) -> Any:
    machine = make()
    teach(machine, *stream(machine))
    return machine


@CONTRACT.clause()
def inputs_not_changed(make: Make) -> None:
    """Observations and actions that it is given stay as they are."""
    machine = make()
    Z, actions = stream(machine)
    given = Z.copy()
    for z, i in zip(given, actions.tolist(), strict=True):
        machine.observe(z)
        machine.act(i, **executed(machine, i))
    insist(same(given, Z), "observe changed the array it was given (work in place? copy it first)")
    if hasattr(machine, "learn_many"):
        rows, kept = Z.copy(), actions.copy()
        machine.learn_many(rows, kept, **executed(machine, kept))
        insist(same(rows, Z), "learn_many changed the observations it was given")
        insist(same(kept, actions), "learn_many changed the actions it was given")


@CONTRACT.clause()
def inputs_not_kept(make: Make) -> None:
    """An array may be used again by its owner once it was observed."""
    machine, other = make(), make()
    Z, actions = stream(machine)
    buffer = np.empty(Z.shape[1])
    for z, i in zip(Z, actions.tolist(), strict=True):
        buffer[:] = z
        machine.observe(buffer)
        machine.act(i, **executed(machine, i))
        buffer[:] = 1e6
    teach(other, Z, actions)
    wrong = difference(held(other), held(machine))
    insist(
        not wrong and same(_future(machine), _future(other)),
        f"{wrong or 'what it will answer'} changed with an array that was observed before "
        "(is the array kept instead of a copy?)",
    )


@CONTRACT.clause()
def answers_stay(make: Make) -> None:
    """What a step returned does not change with later steps."""
    machine = make()
    Z, actions = stream(machine)
    steps = teach(machine, Z[:-20], actions[:-20])
    before = [tuple(np.copy(part) for part in _answer(step)) for step in steps]
    teach(machine, Z[-20:], actions[-20:])
    after = [_answer(step) for step in steps]
    insist(
        all(
            same(np.asarray(a), b)
            for x, y in zip(after, before, strict=True)
            for a, b in zip(x, y, strict=True)
        ),
        "an earlier result changed when the machine went on (does it share an array with the "
        "machine? return a copy)",
    )


@CONTRACT.clause()
def asking_changes_nothing(make: Make) -> None:
    """A question (predict, model, any property) leaves the machine as it was."""
    asked, left_alone = _taught(make), _taught(make)
    taken = int(stream(make())[1][-1])
    before = held(asked)
    first = asked.predict(taken)
    insist(
        same(asked.predict(taken), first), "predict returns something else when it is asked again"
    )
    if hasattr(asked, "model"):
        asked.model()
    for i in range(1, asked.n_actions):  # the last question is about what was not done
        asked.predict((taken + i) % asked.n_actions, 3)
    wrong = difference(before, held(asked))
    insist(not wrong, f"predict changed {wrong} (does it work in the machine's own arrays?)")
    insist(
        same(_future(asked), _future(left_alone)),
        "after predict it learns and returns otherwise than a machine that was not asked (does "
        "predict store the action?)",
    )


@CONTRACT.clause()
def predicts_before_learning(make: Make) -> None:
    """It can be asked before it has learnt anything, and as an episode starts."""
    machine = make()
    fresh = np.asarray(machine.predict(0))
    if machine.n_states == 0:
        insist(
            fresh.shape == (0,),
            f"before any observation predict returns shape {fresh.shape}; there are no "
            "states, so it must be an empty array",
        )
    teach(machine, *stream(machine))
    if hasattr(machine, "start_episode"):
        machine.start_episode()
    at_start = np.asarray(machine.predict(0))
    insist(
        at_start.shape == (machine.n_states,) and is_distribution(at_start, _EXACT),
        f"as an episode starts predict returns {at_start}; it must be a distribution over the "
        "states (forecast from the uniform belief)",
    )


@CONTRACT.clause()
def rows_sum_to_1(make: Make) -> None:
    """Beliefs, forecasts and rows of matrices are distributions, to 1e-9."""
    machine = make()
    Z, actions = stream(machine, 200)
    for step in teach(machine, Z, actions):
        insist(
            is_distribution(step.belief, _EXACT),
            f"a belief sums to {np.sum(step.belief)!r} (not divided by its sum, or after a state "
            "was added?)",
        )
    for name in ("transition_matrices", "marginal_matrix", "belief"):
        if hasattr(machine, name):
            insist(
                is_distribution(getattr(machine, name), _EXACT),
                f"{name} holds a row that is no distribution (is a new state's row normalised? "
                "rounding that adds up?)",
            )
    for i in range(machine.n_actions):
        insist(
            is_distribution(machine.predict(i, 5), _EXACT),
            f"predict({i}, 5) is no distribution (rows from, columns to: belief @ P?)",
        )


@CONTRACT.clause()
def steps_are_sound(make: Make) -> None:
    """A step's state is the most probable one, and its surprise a number of bits or NaN."""
    machine = make()
    for step in teach(machine, *stream(machine, 100)):
        n = len(step.belief)
        insist(0 <= step.state < n, f"state is {step.state}, but the belief has {n} entries")
        insist(
            step.belief[step.state] == np.max(step.belief),
            f"state is {step.state}, but state {int(np.argmax(step.belief))} is more probable",
        )
        surprise = float(step.surprise)
        insist(
            np.isnan(surprise) or 0.0 <= surprise <= 1.0,
            f"surprise is {surprise}; a divergence in bits lies in [0, 1] (natural logarithm?)",
        )
    insist(machine.n_states == n, f"n_states is {machine.n_states}, but beliefs have {n} entries")


@CONTRACT.clause()
def is_deterministic(make: Make) -> None:
    """Two machines that see the same know the same, bit for bit."""
    one, other = _taught(make), _taught(make)
    wrong = difference(held(one), held(other))
    insist(
        not wrong,
        f"{wrong} differs between two machines that saw the same (a random number without a seed, "
        "or something shared by all machines of the class?)",
    )


@CONTRACT.clause("start_episode")
def an_episode_starts_anew(make: Make) -> None:
    """After start_episode nothing is foreseen, and no transition learnt, from what was before."""
    machine = _taught(make)
    matrices = np.copy(machine.transition_matrices)
    n = machine.n_states
    machine.start_episode()
    wrong = "start_episode changed the transition matrices; all that was learnt has to stay"
    insist(same(np.copy(machine.transition_matrices), matrices), wrong)
    step = machine.observe(stream(machine)[0][0])
    insist(
        np.isnan(step.surprise),
        f"the first observation of an episode has a surprise of {step.surprise}; nothing foresaw "
        "it (is the belief or the action of the last episode still there?)",
    )
    if machine.n_states == n:
        insist(
            same(np.copy(machine.transition_matrices), matrices),
            "the first observation of an episode taught a transition from the last one",
        )


@CONTRACT.clause("what_next")
def what_comes_next_is_told_in_numbers(make: Make) -> None:
    """What is expected next is finite, has a spread, and asking for it changes nothing."""
    machine = _taught(make)
    moves = getattr(machine, "dynamics", None)
    if moves is None:
        return  # nobody asked it to learn that
    before = held(machine)
    action = 0 if moves.choices else moves.high
    for steps in (1, 5):
        mean, spread = machine.what_next(action, steps)
        insist(
            np.shape(mean) == np.shape(spread) == (steps, stream(machine)[0].shape[1]),
            f"what_next of {steps} steps has a mean of shape {np.shape(mean)}; there must be a row "
            "for each step",
        )
        insist(
            np.isfinite(mean).all() and (spread >= 0.0).all() and np.isfinite(spread).all(),
            f"what_next expects {mean} with a spread of {spread}; both must be finite, and the "
            "spread not below 0 (does an expectation run away?)",
        )
    machine.may_begin()
    machine.onset_rates()
    machine.never_seen()
    wrong = difference(before, held(machine))
    insist(not wrong, f"asking what comes next changed {wrong}")


@CONTRACT.clause("start_episode")
def motion_is_not_learnt_across_episodes(make: Make) -> None:
    """How the system moves is not learnt from the end of one episode to the start of the next."""
    machine = _taught(make)
    moves = getattr(machine, "dynamics", None)
    if moves is None:
        return
    Z, _ = stream(machine)
    machine.start_episode()
    learnt = float(moves.sums.counts[1])
    machine.observe(Z[0] + 1e3)
    machine.act(0, **executed(machine, 0))
    machine.observe(Z[0] + 1e3)
    insist(
        float(moves.sums.counts[1]) == learnt,
        "the first observations of an episode taught how the system moves from the last ones of "
        "the episode before (is the stretch broken off in start_episode?)",
    )


@CONTRACT.clause("learn_many")
def a_batch_is_the_loop(make: Make) -> None:
    """learn_many is observe and act row by row, bit for bit."""
    batch, loop = make(), make()
    Z, actions = stream(batch)
    first, rest = slice(0, 25), slice(25, None)
    told = [(Z[part], actions[part]) for part in (first, rest)]
    traces = [batch.learn_many(rows, taken, **executed(batch, taken)) for rows, taken in told]
    steps = teach(loop, Z, actions)
    wrong = difference(held(batch), held(loop))
    insist(
        not wrong,
        f"{wrong} differs between learn_many and the loop of observe and act (another order of "
        "sums, or does the batch begin an episode that was not asked for?)",
    )
    surprise = np.concatenate([trace.surprise for trace in traces])
    insist(
        same(surprise, np.array([step.surprise for step in steps])),
        "the trace of learn_many has other surprises than the loop",
    )


@CONTRACT.clause("copy")
def a_copy_is_independent(make: Make) -> None:
    """A copy goes on like the machine, and neither changes the other."""
    machine = _taught(make)
    twin = machine.copy()
    wrong = difference(held(machine), held(twin))
    insist(not wrong, f"copy does not take over {wrong}")
    before = held(machine)
    future = _future(twin)
    wrong = difference(before, held(machine))
    insist(not wrong, f"teaching a copy changed {wrong} of the machine (a shallow copy?)")
    insist(
        same(_future(machine), future),
        "a copy goes on otherwise than the machine (is the action or the belief under way copied?)",
    )


@CONTRACT.clause("save", "load")
def a_file_keeps_it(make: Make) -> None:
    """What was saved and loaded goes on bit for bit as if never stopped."""
    machine = _taught(make)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "machine"
        machine.save(path)
        again = type(machine).load(path)
    wrong = difference(held(machine), held(again))
    insist(not wrong, f"{wrong} is lost or changed by save and load (is it rounded to text?)")
    insist(
        same(_future(machine), _future(again)),
        "after load it goes on otherwise (is what the next step needs stored: the latest "
        "observation, the belief, the action under way?)",
    )


@CONTRACT.clause()
def labels_of_actions_mean_nothing(make: Make) -> None:
    """Permuting the labels of actions permutes what is learnt, and changes nothing else."""
    machine, renamed = make(), make()
    q = machine.n_actions
    if machine.n_states:
        return  # what was learnt before, was under other labels
    Z, actions = stream(machine)
    label = np.roll(np.arange(q), 1)
    steps, others = teach(machine, Z, actions), teach(renamed, Z, label[actions])
    insist(
        all(same(a.belief, b.belief) for a, b in zip(steps, others, strict=True)),
        "beliefs depend on how actions are numbered",
    )
    matrices, permuted = machine.transition_matrices, renamed.transition_matrices[label]
    wrong = [i for i in range(q) if not np.allclose(matrices[i], permuted[i], rtol=0, atol=_EXACT)]
    insist(
        not wrong,
        f"the matrix of action {wrong} changes when actions are numbered otherwise (is an index "
        "fixed somewhere, or off by one?)",
    )
    insist(
        np.allclose(machine.predict(0, 3), renamed.predict(int(label[0]), 3), rtol=0, atol=_EXACT),
        "predict changes when actions are numbered otherwise",
    )


@CONTRACT.clause()
def memory_is_bounded(make: Make) -> None:
    """Seeing the same again and again takes no more memory, and creates no states without end."""
    machine = make()
    Z, actions = stream(machine, 25)

    def work(rounds: int) -> None:
        for _ in range(rounds):
            teach(machine, Z, actions)

    work(3)
    refuse_growth(work, 20, "the machine")
    most = getattr(machine, "max_states", None)
    insist(
        most is None or machine.n_states <= most,
        f"it has {machine.n_states} states; max_states is {most}",
    )


@CONTRACT.clause()
def errors_leave_no_trace(make: Make) -> None:
    """What cannot be right is refused, and the machine is then as it was."""
    machine, twin = _taught(make), _taught(make)
    before = held(machine)
    for what in refusals(_impossible(machine)):
        wrong = difference(before, held(machine))
        insist(
            not wrong,
            f"{what} was refused, but changed {wrong} before (look at the input first, then learn)",
        )
    insist(
        same(_future(machine), _future(twin)),
        "after inputs that were refused it goes on otherwise (is a refused action or observation "
        "still stored?)",
    )


def _impossible(machine: Any) -> Iterator[tuple[str, Callable[[], object]]]:
    """What no machine can learn from."""
    Z, actions = stream(machine, 5, seed=2)
    m = Z.shape[1]
    spoilt: dict[str, Any] = {
        "an observation with NaN": np.append(Z[0][1:], np.nan),
        "an infinite observation": np.append(np.inf, Z[0][1:]),
        "an observation of one variable too many": np.zeros(m + 1),
        "an observation with an axis too many": Z[:1],
        "an observation of texts": ["a"] * m,
        "None as an observation": None,
    }
    for what, z in spoilt.items():
        yield what, lambda z=z: machine.observe(z)  # type: ignore[misc]
    wrong_actions: tuple[Any, ...] = (machine.n_actions, -1, 0.5, None)
    for i in wrong_actions:
        yield f"{i!r} as an action", lambda i=i: machine.act(i)  # type: ignore[misc]
        yield f"a forecast for {i!r} as an action", lambda i=i: machine.predict(i)  # type: ignore[misc]
    if told := executed(machine, 0):
        many = np.zeros(len(told["executed"]) + 1)
        yield "an action without its number", lambda: machine.act(0)
        yield "NaN as what was executed", lambda: machine.act(0, told["executed"] * np.nan)
        yield "too many numbers as what was executed", lambda: machine.act(0, many)
    yield "a forecast of 0 steps", lambda: machine.predict(0, 0)
    if hasattr(machine, "learn_many"):
        last = Z.copy()
        last[-1, 0] = np.nan
        yield (
            "a batch whose last row has NaN",
            lambda: machine.learn_many(last, actions, **executed(machine, actions)),
        )
        high = actions.copy()
        high[-1] = machine.n_actions
        yield (
            "a batch whose last action there is not",
            lambda: machine.learn_many(Z, high, **executed(machine, high)),
        )
        yield (
            "a batch of fewer actions than rows",
            lambda: machine.learn_many(Z, actions[:-1], **executed(machine, actions[:-1])),
        )

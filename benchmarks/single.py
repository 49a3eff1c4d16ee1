"""One machine: whole arrays at once, and one call a step, against the NumPy loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from evofsm.fsm.machine import EvolvingFSM
from reference import NumpyFSM
from streams import (
    LATTICE_RADIUS,
    LATTICE_RULE,
    LATTICE_SPREAD,
    PAPER_ROUND,
    Stream,
    lattice_stream,
    paper_stream,
)
from turns import Result, Work, compare, timed

_BATCH_ROWS = 1_000_000
_CALL_ROWS = 50_000
_LOOP_ROWS = 20_000


def batch(n_states: int, repeats: int, short: bool) -> Result:
    """`learn_many` against the loop."""
    rows = _sized(_BATCH_ROWS, short)
    machine, reference, stream = pair(n_states, rows)
    return compare(
        f"{rows:,} rows by learn_many, {n_states} states",
        lambda: timed(lambda: machine.learn_many(*stream), rows),
        "NumPy loop",
        numpy_loop(reference, stream.part(0, _sized(_LOOP_ROWS, short))),
        repeats,
    )


def call(n_states: int, repeats: int, short: bool) -> Result:
    """`update` against the loop."""
    rows = _sized(_CALL_ROWS, short)
    machine, reference, stream = pair(n_states, rows)
    full = machine.copy()
    return compare(
        f"one call of update(z, i) a step, {n_states} states",
        one_call_each(machine.update, stream),
        "NumPy loop",
        numpy_loop(reference, stream.part(0, _sized(_LOOP_ROWS, short))),
        repeats,
        beside={"learn_one, which answers the whole Step": one_call_each(full.learn_one, stream)},
    )


def lock(repeats: int, short: bool) -> Result:
    """`learn_one` against itself without the lock that lets threads share a machine."""
    rows = _sized(_CALL_ROWS, short)
    machine, _, stream = pair(7, rows)
    bare = machine.copy()
    locked: Any = EvolvingFSM.learn_one
    unlocked = locked.__wrapped__

    def learn_one(z: Any, i: int) -> object:
        return unlocked(bare, z, i)

    return compare(
        "learn_one with its lock, 7 states; update takes none",
        one_call_each(machine.learn_one, stream),
        "learn_one without it",
        one_call_each(learn_one, stream),
        repeats,
    )


def pair(n_states: int, rows: int) -> tuple[EvolvingFSM, NumpyFSM, Stream]:
    """A machine and the reference, both taught all states, and ``rows`` rows to go on with.

    7 states are the paper's, by the paper's rule; others those of a lattice, one a point.
    """
    if n_states == 7:
        stream, taught = paper_stream(PAPER_ROUND + rows), PAPER_ROUND
        machine, reference = EvolvingFSM.paper(), NumpyFSM(17)
    else:
        taught = 20 * n_states
        stream = lattice_stream(n_states, taught + rows)
        machine = EvolvingFSM(17, rule=LATTICE_RULE)
        reference = NumpyFSM(17, spread=LATTICE_SPREAD, novelty_radius=LATTICE_RADIUS)
    lesson = stream.part(0, taught)
    machine.learn_many(*lesson)
    numpy_loop(reference, lesson)()
    assert machine.n_states == len(reference.centers) == n_states
    return machine, reference, stream.part(taught, taught + rows)


def one_call_each(learn: Callable[[Any, int], object], stream: Stream) -> Work:
    """A call for every row, as a controller would make it: an array, and an action."""
    rows, actions = list(stream.observations), stream.actions.tolist()

    def loop() -> None:
        for z, action in zip(rows, actions, strict=True):
            learn(z, action)

    return lambda: timed(loop, len(rows))


def numpy_loop(reference: NumpyFSM, stream: Stream) -> Work:
    """The reference, row by row."""

    def learn(z: Any, action: int) -> None:
        reference.observe(z)
        reference.act(action)

    return one_call_each(learn, stream)


def _sized(rows: int, short: bool) -> int:
    return rows // 100 if short else rows

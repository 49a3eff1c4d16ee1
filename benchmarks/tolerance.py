"""What hundreds of states cost: a step with and without a tolerance, and memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.machine import EvolvingFSM
from streams import LATTICE_RULE, LATTICES, Stream, lattice_stream
from turns import Result, Work, compare, timed

_TOLERANCE = 1e-6
# Rows a turn: about as many steps as take a second without a tolerance.
_ROWS = {7: 1_000_000, 32: 500_000, 64: 200_000, 256: 10_000, 1024: 500}


def many_states(repeats: int, short: bool) -> Result:
    """A step at 1,024 states with a tolerance, against one at 64 states without."""
    few, many = (7, 32) if short else (64, 1024)
    sparse, dense = walked(many, 17, _TOLERANCE), walked(many, 17)
    spread = perplexity(dense.copy(), walk(many, 17, 1_000, seed=1))
    return compare(
        f"learn_many, {many:,} states, belief within {_TOLERANCE:g}",
        learning(sparse, short),
        f"{few} states, exact",
        learning(walked(few, 17), short),
        repeats,
        beside={
            f"{many:,} states, exact": learning(dense, short),
            "another action in every row: no matrix in the cache": learning(sparse, short, held=1),
        },
        notes=[
            f"perplexity of the belief: median {np.median(spread):.1f}, largest {spread.max():.1f}"
        ],
    )


def cost_and_memory(repeats: int, short: bool) -> str:
    """For each number of states and actions: a step exact and with the tolerance, and memory."""
    lines = [
        f"{'states':>6}{'actions':>9}{'exact':>13}{f'within {_TOLERANCE:g}':>16}"
        f"{'all actions used':>19}{'one used':>12}"
    ]
    for n_actions in (17, 64):
        for n_states in (7, 32) if short else LATTICES:
            exact = walked(n_states, n_actions)
            tolerant = walked(n_states, n_actions, _TOLERANCE)
            result = compare(
                "a step", learning(tolerant, short), "exact", learning(exact, short), repeats
            )
            one_used = toured(n_states, n_actions)
            lines.append(
                f"{n_states:>6,}{n_actions:>9}{1e6 * result['reference_s']:>10,.2f} µs"
                f"{1e6 * result['ours_s']:>13,.2f} µs"
                f"{exact.nbytes / 1e3:>16,.0f} kB{one_used.nbytes / 1e3:>9,.0f} kB"
            )
    return "\n".join(lines)


def toured(n_states: int, n_actions: int, tolerance: float = 0.0) -> EvolvingFSM:
    """A machine that was at each point of a lattice once, always with the same action."""
    machine = EvolvingFSM(n_actions, rule=LATTICE_RULE, belief_tolerance=tolerance)
    tour = lattice_stream(n_states, n_states)
    machine.learn_many(tour.observations, np.zeros(n_states, np.int64))
    assert machine.n_states == n_states
    return machine


def walked(n_states: int, n_actions: int, tolerance: float = 0.0) -> EvolvingFSM:
    """The same after a walk on which every action was used."""
    machine = toured(n_states, n_actions, tolerance)
    stream = walk(n_states, n_actions, 2 * n_actions)
    every_action = np.arange(2 * n_actions) % n_actions
    machine.learn_many(stream.observations, every_action)
    return machine


def walk(n_states: int, n_actions: int, rows: int, **given: int) -> Stream:
    """A walk over a lattice, without the tour before it."""
    stream = lattice_stream(n_states, n_states + rows, n_actions, **given)
    return stream.part(n_states, n_states + rows)


def learning(machine: EvolvingFSM, short: bool, **given: int) -> Work:
    """A walk that the machine learns from, as a whole array."""
    rows = 100 if short else _ROWS[machine.n_states]
    stream = walk(machine.n_states, machine.n_actions, rows, seed=2, **given)
    return lambda: timed(lambda: machine.learn_many(*stream), rows)


def perplexity(machine: EvolvingFSM, stream: Stream) -> NDArray[np.float64]:
    """(T,) how many states would be as uncertain if the belief were uniform over them."""
    belief = machine.learn_many(*stream, belief=True).belief
    assert belief is not None
    logarithms = np.log2(belief, where=belief > 0.0, out=np.zeros_like(belief))
    perplexities: NDArray[np.float64] = 2.0 ** -(belief * logarithms).sum(axis=1)
    return perplexities

"""The contract of a fleet: every vehicle's machine is what it would be alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from evofsm.checks.contracts import Contract, insist, refusals, refuse_growth, same
from evofsm.checks.kinds import Make
from evofsm.checks.machines import difference, executed, held, stream

CONTRACT = Contract()


def _rounds(fleet: Any, rounds: int, seed: int = 0) -> list[tuple[Any, Any]]:
    """For each round observations and actions of all vehicles, each on a way of its own."""
    ways = [stream(fleet[v], rounds, seed + v) for v in range(len(fleet))]
    return [
        (np.array([Z[k] for Z, _ in ways]), np.array([actions[k] for _, actions in ways]))
        for k in range(rounds)
    ]


@CONTRACT.clause()
def inputs_not_changed(make: Make) -> None:
    """Observations and actions that it is given stay as they are."""
    fleet = make()
    for Z, actions in _rounds(fleet, 20):
        rows, kept = Z.copy(), actions.copy()
        fleet.observe(rows, kept, **executed(fleet[0], kept))
        insist(same(rows, Z), "observe changed the observations it was given")
        insist(same(kept, actions), "observe changed the actions it was given")


@CONTRACT.clause()
def equals_its_machines(make: Make) -> None:
    """Each vehicle's machine is, bit for bit, the one that learnt from that vehicle alone."""
    fleet = make()
    alone = [fleet[v] for v in range(len(fleet))]
    for Z, actions in _rounds(fleet, 60):
        fleet.observe(Z, actions, **executed(fleet[0], actions))
        for machine, z, i in zip(alone, Z, actions.tolist(), strict=True):
            machine.learn_one(z, i, **executed(machine, i))
    for v, machine in enumerate(alone):
        wrong = difference(held(machine), held(fleet[v]))
        insist(
            not wrong,
            f"{wrong} of vehicle {v} differs from a machine that learnt from it alone (are two "
            "vehicles mixed up, or sums in another order?)",
        )


@CONTRACT.clause()
def the_silent_stay(make: Make) -> None:
    """Vehicles that were not observed stay as they were."""
    fleet = make()
    rounds = _rounds(fleet, 21)
    for Z, actions in rounds[:-1]:
        fleet.observe(Z, actions, **executed(fleet[0], actions))
    before = [held(fleet[v]) for v in range(len(fleet))]
    Z, actions = rounds[-1]
    fleet.observe(Z[:1], actions[:1], vehicles=[0], **executed(fleet[0], actions[:1]))
    for v in range(1, len(fleet)):
        wrong = difference(before[v], held(fleet[v]))
        insist(not wrong, f"{wrong} of vehicle {v} changed though only vehicle 0 was observed")


@CONTRACT.clause()
def errors_leave_no_trace(make: Make) -> None:
    """What cannot be right is refused, and every machine is then as it was."""
    fleet = make()
    for Z, actions in _rounds(fleet, 20):
        fleet.observe(Z, actions, **executed(fleet[0], actions))
    before = [held(fleet[v]) for v in range(len(fleet))]
    for what in refusals(_impossible(fleet)):
        for v, was in enumerate(before):
            wrong = difference(was, held(fleet[v]))
            insist(not wrong, f"{what} was refused, but changed {wrong} of vehicle {v} before")


def _impossible(fleet: Any) -> Iterator[tuple[str, Callable[[], object]]]:
    Z, actions = _rounds(fleet, 1, seed=9)[0]
    last = Z.copy()
    last[-1, -1] = np.nan
    high = actions.copy()
    high[-1] = fleet[0].n_actions
    told, one, two = (executed(fleet[0], some) for some in (actions, actions[:1], actions[[0, 0]]))
    yield "NaN of the last vehicle", lambda: fleet.observe(last, actions, **told)
    yield "an action of the last vehicle that there is not", lambda: fleet.observe(Z, high, **told)
    yield (
        "a vehicle named twice",
        lambda: fleet.observe(Z[[0, 0]], actions[[0, 0]], vehicles=[0, 0], **two),
    )
    beyond = [len(fleet)]
    yield (
        "a vehicle beyond the last",
        lambda: fleet.observe(Z[:1], actions[:1], vehicles=beyond, **one),
    )
    yield (
        "an observation too few",
        lambda: fleet.observe(Z[:-1], actions[:-1], **executed(fleet[0], actions[:-1])),
    )


@CONTRACT.clause()
def memory_is_bounded(make: Make) -> None:
    """Seeing the same again and again takes no more memory."""
    fleet = make()
    if getattr(fleet[0], "dynamics", None) is not None:
        return  # of an episode that goes on they remember more and more, up to a bound
    rounds = _rounds(fleet, 10)

    def work(times: int) -> None:
        for _ in range(times):
            for Z, actions in rounds:
                fleet.observe(Z, actions)

    work(3)
    refuse_growth(work, 5, "the fleet")

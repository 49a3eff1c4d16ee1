"""The contract of a controller: it proposes an acceleration for what it observes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from evofsm.checks.contracts import Contract, drive, frozen, insist, refuse_growth, same
from evofsm.checks.kinds import Make
from evofsm.guard import Proposal

CONTRACT = Contract()
_DT = 0.25
_FREE_ROAD = np.array([np.inf, 20.0, 0.0])


def _proposals(controller: Any, seed: int = 0) -> list[Any]:
    """What it proposes in a drive."""
    rows = drive(seed=seed)
    return [controller.propose(row.copy(), k * _DT) for k, row in enumerate(rows)]


def _numbers(proposals: list[Any]) -> list[tuple[float, ...]]:
    return [(float(p.action), *map(float, p.candidates)) for p in proposals]


@CONTRACT.clause()
def proposes_numbers(make: Make) -> None:
    """It returns a `Proposal` of finite numbers, on a free road too."""
    controller = make()
    for row in [*drive(), _FREE_ROAD]:
        proposal = controller.propose(row, 0.0)
        insist(
            isinstance(proposal, Proposal),
            f"propose returns {proposal!r}; it must be an evofsm.guard.protocols.Proposal",
        )
        for action in (proposal.action, *proposal.candidates):
            insist(
                math.isfinite(action),
                f"it proposes {action} at gap {row[0]:.1f} m, {row[1]:.1f} and {row[2]:.1f} m/s "
                "(a division by the gap or the speed?)",
            )


@CONTRACT.clause()
def keeps_its_bounds(make: Make) -> None:
    """It stays within its `lowest` and `highest`, where it has them, however near the leader."""
    controller = make()
    lowest = getattr(controller, "lowest", -math.inf)
    highest = getattr(controller, "highest", math.inf)
    close = [[0.01, 30.0, 0.0], [0.0, 10.0, 0.0], [-1.0, 5.0, 0.0], [500.0, 0.0, 50.0]]
    for row in [*drive(), *map(np.array, close), _FREE_ROAD]:
        action = controller.propose(row, 0.0).action
        insist(
            lowest <= action <= highest,
            f"it proposes {action:g} m/s² at gap {row[0]:g} m, outside its own bounds "
            f"[{lowest:g}, {highest:g}]",
        )


@CONTRACT.clause()
def inputs_not_changed(make: Make) -> None:
    """The observation stays as it is."""
    controller = make()
    for k, row in enumerate(drive()):
        given = row.copy()
        controller.propose(given, k * _DT)
        insist(same(given, row), "propose changed the observation (work in place? copy it first)")
        controller.propose(frozen(row), k * _DT)


@CONTRACT.clause()
def inputs_not_kept(make: Make) -> None:
    """An array may be used again by its owner once it was seen."""
    controller, other = make(), make()
    buffer = np.empty(3)
    found = []
    for k, row in enumerate(drive()):
        buffer[:] = row
        found.append(controller.propose(buffer, k * _DT))
        buffer[:] = 1e6
    insist(
        same(_numbers(found), _numbers(_proposals(other))),
        "proposals change with an array that was seen before (is it kept instead of a copy?)",
    )


@CONTRACT.clause()
def is_deterministic(make: Make) -> None:
    """Two that see the same propose the same."""
    insist(
        same(_numbers(_proposals(make())), _numbers(_proposals(make()))),
        "two controllers that saw the same propose otherwise (a random number without a seed, or "
        "something shared by all of the class?)",
    )


@CONTRACT.clause()
def time_may_be_left_out(make: Make) -> None:
    """Without a time it is 0 s."""
    row = drive(1)[0]
    try:
        without = make().propose(row)
    except TypeError as error:
        insist(False, f"propose cannot be called without a time: {error} (time: float = 0.0)")
    insist(
        same(_numbers([without]), _numbers([make().propose(row, 0.0)])),
        "without a time it proposes otherwise than at 0 s",
    )


@CONTRACT.clause("kernel", "parameters")
def its_kernel_agrees(make: Make) -> None:
    """The compiled kernel gives what propose gives, bit for bit."""
    controller = make()
    for k, row in enumerate(drive()):
        time = k * _DT
        compiled = controller.kernel(controller.parameters, time, *row)
        insist(
            same(float(compiled), float(controller.propose(row, time).action)),
            f"at {time:g} s the kernel gives {compiled!r}, propose "
            f"{controller.propose(row, time).action!r} (are the parameters in another order?)",
        )


@CONTRACT.clause()
def memory_is_bounded(make: Make) -> None:
    """Proposing again and again takes no more memory."""
    controller = make()
    row = drive(1)[0]

    def work(rounds: int) -> None:
        for _ in range(rounds):
            controller.propose(row, 0.0)

    refuse_growth(work, 200, "the controller")

"""The contract of a state rule: frozen settings that a machine can be told of and a file can keep.

What a rule does shows in a machine, so the machine's own contract is checked with it as well.
"""

from __future__ import annotations

import json
from dataclasses import FrozenInstanceError, fields, is_dataclass
from typing import Any

import numpy as np

from evofsm.checks.contracts import Contract, insist
from evofsm.checks.kinds import Make
from evofsm.fsm import EvolvingFSM, RuleSettings, describe_rule, restore_rule

CONTRACT = Contract()


def machine_of(make: Make) -> Make:
    """A machine that determines its states by the rule."""
    return lambda: EvolvingFSM(n_actions=3, rule=make())


def _settings() -> RuleSettings:
    """What a machine tells a rule: numbers, each another one, and the weights."""
    numbers: dict[str, Any] = {
        name: 0.1 * k for k, name in enumerate(RuleSettings._fields, start=1)
    }
    return RuleSettings(**numbers)._replace(code=0.0, weights=np.array([1.0, 2.0]))


@CONTRACT.clause()
def is_frozen(make: Make) -> None:
    """It is a frozen dataclass: two of the same settings are equal, and none can be changed."""
    rule = make()
    insist(is_dataclass(rule), "it is no dataclass: files and messages could not tell its settings")
    insist(rule == make(), "two rules of the same settings are not equal")
    for entry in fields(rule):
        try:
            setattr(rule, entry.name, getattr(rule, entry.name))
        except FrozenInstanceError:
            continue
        insist(False, f"{entry.name} can be changed under a machine (@dataclass(frozen=True))")


@CONTRACT.clause()
def telling_changes_nothing(make: Make) -> None:
    """Its table is the same the second time."""
    rule = make()
    insist(dict(rule.table) == dict(rule.table), "its table is another one the second time")


@CONTRACT.clause()
def what_it_tells_is_usable(make: Make) -> None:
    """Radius, spread and scales are positive, finite numbers; the failure share is one."""
    rule = make()
    insist(set(rule.table) <= set(RuleSettings._fields), f"a kernel knows no {rule.table!r}")
    told = _settings()._replace(**rule.table)
    for name in ("radius", "spread", "distance_weight"):
        value = getattr(told, name)
        insist(0.0 < value < np.inf, f"it tells a {name} of {value}; it must be positive, finite")
    insist(
        0.0 <= told.failure_share <= 1.0,
        f"it tells a failure_share of {told.failure_share}; it must lie in [0, 1]",
    )
    for scale in rule.scales:
        insist(0.0 < scale < np.inf, f"a scale is {scale}; it must be a positive, finite number")


@CONTRACT.clause()
def a_machine_takes_it(make: Make) -> None:
    """A machine can be made with it, and learns."""
    try:
        machine = machine_of(make)()
    except TypeError as error:
        insist(False, f"{error} (was it registered with evofsm.fsm.register_rule?)")
    m = len(machine.rule.scales) or 2
    for k in range(10):
        machine.observe(np.arange(m) * k * 0.7)
    insist(machine.n_states > 0, "a machine with this rule creates no state at all")


@CONTRACT.clause()
def a_file_keeps_it(make: Make) -> None:
    """As plain JSON and back it is the same rule."""
    rule = make()
    try:
        text: Any = json.dumps(describe_rule(rule))
    except (TypeError, StopIteration) as error:
        insist(False, f"a file cannot hold its settings: {error!r} (numbers and tuples only?)")
    insist(
        restore_rule(json.loads(text)) == rule,
        f"from a file it comes back as {restore_rule(json.loads(text))}",
    )

"""The closed loop: how many collisions are prevented, and what that costs.

Every policy drives the same held-out draws. Ours learn first, from draws of its own, several
times with other seeds; tuned baselines are tuned on the same training draws. Work is split by
policy and learning seed over the cores, and put together in the order of the tasks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from importlib.util import find_spec
from itertools import repeat
from typing import Any, NamedTuple

from evofsm.driving import (
    TOLD,
    EnvelopeReviser,
    Family,
    Outcome,
    RiskByState,
    Row,
    drive,
    guard_for_family,
    learnt_by,
    score,
    teach,
    training,
)
from evofsm.fleet import in_order
from evofsm.fsm import Edges, FailureSplit, Novelty, StateRule
from evofsm.guard import ActionReviser, Guard
from evofsm.paper.frame import Frame
from studies.closed_loop.amounts import Amounts
from studies.closed_loop.beside import (
    CaseResult,
    Check,
    InWorld,
    Separation,
    Stream,
    run_cases,
    run_separation,
    run_shift,
    run_two_worlds,
)
from studies.closed_loop.calibration import Reliability, run_calibration
from studies.closed_loop.course import Course, mobility_of
from studies.closed_loop.machine import MACHINE, run_machine, run_machine_shift
from studies.closed_loop.stages import Point, until_safe
from studies.own_measure import own_measure
from studies.policies import TUNED_MEASURES, Group, Policy, envelope, fixed_policies

#: Held-out draws of the tests on the way.
SAFE_EPISODES = 200
#: After so many training episodes the learning curve has a point.
CHECKPOINTS = (0, 1, 2, 5, 10, 20, 50, 100, 200, 300)
#: Tolerances of the trade-off.
TOLERANCES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
# Training episodes in the comparison of state rules.
_RULE_TRAIN = 60
#: State rules that are compared, by name.
RULES: dict[str, StateRule | None] = {
    "paper": None,
    "edges": Edges(),
    "novelty": Novelty(radius=1.0, scales=(4.0, 2.0, 2.0)),
    "failure-split": FailureSplit(base=Novelty(radius=2.0, scales=(4.0, 2.0, 2.0))),
}


class TradeOff(NamedTuple):
    """What a policy reaches at one setting."""

    policy: str
    setting: str
    collision_rate: float
    mobility: float


@dataclass(frozen=True)
class ClosedLoop:
    """All that the study measured on one family."""

    family: Family
    plan: Amounts
    rows: list[Row]  #: baselines, then ours for each learning seed
    curve: list[Point] = field(default_factory=list)
    trade_offs: list[TradeOff] = field(default_factory=list)
    by_rule: list[Row] = field(default_factory=list)  #: risk read through the states alone
    separations: list[Separation] = field(default_factory=list)
    reliabilities: list[Reliability] = field(default_factory=list)
    cases: list[CaseResult] = field(default_factory=list)  #: of the family `paper`
    machine_cases: list[CaseResult] = field(default_factory=list)  #: the same of `evofsm-machine`
    worlds: list[InWorld] = field(default_factory=list)  #: empty without SUMO
    streams: list[Stream] = field(default_factory=list)  #: of families that shift
    checks: list[Check] = field(default_factory=list)

    @property
    def frame(self) -> Frame:
        """The rows of the table."""
        return Frame(self.rows)

    def as_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        lists = {name: _plain(one) for name, one in vars(self).items() if isinstance(one, list)}
        lists["rows"] = [row | {"told": told(row["policy"], row["group"])} for row in lists["rows"]]
        return {"family": self.family.name, "plan": asdict(self.plan), **lists}


def run_closed_loop(
    family: Family,
    plan: Amounts,
    progress: Callable[[int, int], None] = lambda done, total: None,
    workers: int | None = None,
) -> ClosedLoop:
    """Drive all policies.

    Parameters
    ----------
    family : Family
    plan : Plan
    progress : callable
        Told how many tasks are done, of how many.
    workers : int, optional
        Processes; as many as there are cores unless told.
    """
    names = [policy.name for policy in _fixed(family, plan)]
    machines = plan.seeds if plan.machine_train else 0
    tasks: list[partial[Any]] = [
        *(partial(_test_fixed, family, plan, name) for name in names),
        *(partial(_test_tuned, family, plan, name) for name in TUNED_MEASURES),
        *(partial(_test_learner, family, plan, seed) for seed in range(plan.seeds)),
        *(
            partial(_test_rule, family, plan, rule, seed)
            for rule in RULES
            for seed in range(min(plan.rule_seeds, plan.seeds))
        ),
        *(partial(run_machine, family, plan, seed) for seed in range(machines)),
        partial(run_separation, family, plan),
        partial(run_calibration, family, plan),
    ]
    if find_spec("libsumo") is not None:
        tasks.append(partial(run_two_worlds, family, plan))
    if family.name == "paper":
        tasks.append(partial(run_cases, family, plan))
    if family.shifted is not None:
        tasks += [partial(run_shift, family, plan, seed) for seed in range(plan.seeds)]
        shifted = range(min(machines, plan.shift.machine_seeds))
        tasks += [partial(run_machine_shift, family, plan, seed) for seed in shifted]
    study = ClosedLoop(family, plan, [])
    for result in in_order(tasks, workers, progress):
        for name, values in result.items():
            getattr(study, name).extend(values)
    return study


def told(policy: str, group: str) -> str:
    """What a policy was told."""
    if group != Group.LEARNT:
        return group
    return TOLD["learnt" if policy == MACHINE else "kinematic"]


def _plain(record: Any) -> Any:
    """Rows and tuples of names, with those inside them, for JSON."""
    if isinstance(record, Row):
        return record.as_dict()
    if hasattr(record, "_asdict"):
        return {name: _plain(value) for name, value in record._asdict().items()}
    return [_plain(one) for one in record] if isinstance(record, tuple | list) else record


# -- Policies -------------------------------------------------------------------------------------


def _trade_off(policy: str, setting: str, outcomes: Sequence[Outcome]) -> TradeOff:
    rate = sum(o.collided for o in outcomes) / len(outcomes)
    return TradeOff(policy, setting, rate, mobility_of(outcomes))


def _fixed(family: Family, plan: Amounts) -> list[Policy]:
    """All that learn nothing; a measure of one's own brakes in full where it calls for it."""
    own = [envelope(plan.measure, Group.FIXED, own_measure(plan.measure))] if plan.measure else []
    return [*fixed_policies(family), *own]


def _test_fixed(family: Family, plan: Amounts, name: str) -> dict[str, list[Any]]:
    policy = next(policy for policy in _fixed(family, plan) if policy.name == name)
    tests = Course.held_out(family, plan.seed, plan.test)
    outcomes = tests.under(policy.make(family, draw) for draw in tests.draws)
    return {"rows": [tests.row(name, policy.group, outcomes)]}


def _test_tuned(family: Family, plan: Amounts, name: str) -> dict[str, list[Any]]:
    """Of the settings without a collision in training the fastest, else the safest."""
    course = Course.of(family, training(family, plan.seed, 0, min(plan.train, 100)))
    revisers = [
        EnvelopeReviser(measure, family.actions, family.interval)
        for measure in TUNED_MEASURES[name]
    ]
    tried = [
        _trade_off(name, repr(reviser.measure), course.under(repeat(reviser)))
        for reviser in revisers
    ]
    best = min(range(len(tried)), key=lambda i: (tried[i].collision_rate, -tried[i].mobility))
    tests, driven = Course.held_out(family, plan.seed, plan.test), len(course.draws) * len(tried)
    outcomes = tests.under(repeat(revisers[best]))
    row = tests.row(name, Group.TUNED, outcomes, train_episodes=driven)
    return {"rows": [row], "trade_offs": tried}


def _test_learner(family: Family, plan: Amounts, seed: int) -> dict[str, list[Any]]:
    """Learn with one seed; test on the way and at the end."""
    guard = guard_for_family(family, tolerance=plan.tolerance)
    tests = Course.held_out(family, plan.seed, plan.test)
    curve: list[Point] = []
    rows: list[Row] = []
    collisions = 0
    draws = training(family, plan.seed, seed, plan.train)
    for episodes in range(plan.train + 1):
        if episodes > 0:
            collisions += drive(guard, next(draws)).collided
        if episodes in CHECKPOINTS:
            outcomes = tests.first(SAFE_EPISODES).by(guard)
            curve.append(
                Point(
                    seed,
                    episodes,
                    sum(o.collided for o in outcomes),
                    len(outcomes),
                    mobility_of(outcomes),
                    learnt_by(guard)[0].n_states,
                    collisions,
                )
            )
        if episodes in {min(100, plan.train), plan.train}:
            row = tests.row(
                "evofsm",
                Group.LEARNT,
                tests.by(guard),
                learning_seed=seed,
                train_episodes=episodes,
                episodes_until_safe=until_safe(curve),
                train_collisions=collisions,
            )
            rows.append(row)
    trade_offs = []
    for tolerance in TOLERANCES if seed == 0 else ():
        other = guard_for_family(family, tolerance=tolerance, judge=guard.judge)
        outcomes = tests.first(plan.rule_test).by(other)
        trade_offs.append(_trade_off("evofsm", f"{tolerance:g}", outcomes))
    return {"rows": rows, "curve": curve, "trade_offs": trade_offs}


def _test_rule(family: Family, plan: Amounts, rule: str, seed: int) -> dict[str, list[Any]]:
    """Steer by the states alone: what a rule's states are worth."""
    machine, risk = learnt_by(guard_for_family(family, rule=RULES[rule]))
    by_state = RiskByState(risk, machine)
    reviser = ActionReviser(by_state, family.actions, tolerance=plan.tolerance)
    guard = Guard.of(reviser, interval=family.interval, machine=machine, judge=risk)
    episodes = min(_RULE_TRAIN, plan.train)
    taught = teach(guard, training(family, plan.seed, seed, episodes))
    guard.freeze()
    tests = Course.held_out(family, plan.seed, min(plan.rule_test, plan.test))
    row = tests.row(
        f"states: {rule} ({machine.n_states})",
        Group.LEARNT,
        score(family, tests.alone, teach(guard, tests.draws)),
        learning_seed=seed,
        train_episodes=episodes,
        train_collisions=sum(driven.collided for driven in taught),
    )
    return {"by_rule": [row]}

"""Checks for what users write: a contract for controllers, revisers, judges and state rules.

A check gets a part made anew, and says what is wrong and what the likely cause is.
"""

from __future__ import annotations

import copy
import inspect
import math
import traceback
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import FrozenInstanceError, fields, is_dataclass
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np

from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.validation import Floats
from evofsm.guard.actions import ActionSet, BoxActions, Choices, limits
from evofsm.guard.api import Proposal, Revision, Situation
from evofsm.guard.guard import Guard, ends_of
from evofsm.guard.reviser import ActionReviser

Make = Callable[[], Any]
Rows = Sequence[Floats]
Answers = list[tuple[Any, ...]]
Clause = Callable[[Make], None]

_DT = 0.25  # between two rows [s]
_ACTIONS = np.array([-2.5, -0.7, 0.0, 1.3, 2.5])
# A judge is tried with the first that it takes.
_SETS: tuple[ActionSet, ...] = (
    *(IntervalActions(*ends, 0.1, "clip") for ends in ((-2.5, 2.5), (-1.0, 1.0), (0.0, 1.0))),
    *map(Choices, range(2, 10)),
    *(BoxActions((-1.0,) * d, (1.0,) * d) for d in (2, 1, 3)),
)


class Result(NamedTuple):
    """What one check found."""

    check: str  #: its name
    passed: bool
    message: str = ""  #: what is wrong, and the likely cause


def check_results(part: object) -> list[Result]:
    """What each check of its contract finds, in order.

    The part is a class that is made without arguments, an instance (copied before each check), or a
    function that makes one. A judge is tried with the first of several sets of actions that it
    takes, or its attribute ``actions``. A TypeError if it has the methods of no kind, or a class
    needs arguments.
    """
    make = _maker(part)
    return [_result(clause, make) for clause in _CONTRACTS[kind_of(part)][1]]


def kind_of(part: object) -> str:
    """Of which kind a class, an instance, or a function that makes one is."""
    instance = part if inspect.isclass(part) else _maker(part)()
    for kind, (names, _) in _CONTRACTS.items():
        if all(hasattr(instance, name) for name in names):
            return kind
    kinds = "; ".join(f"a {kind} has {', '.join(names)}" for kind, (names, _) in _CONTRACTS.items())
    raise TypeError(f"{part!r} has the methods of no kind: {kinds}")


def _maker(part: Any) -> Make:
    """A function that makes the part anew: of a class instances, of an instance copies."""
    if not inspect.isclass(part):
        return part if inspect.isroutine(part) else lambda: copy.deepcopy(part)
    by_name = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    parameters = inspect.signature(part).parameters.values()
    needed = [p.name for p in parameters if p.default is p.empty and p.kind in by_name]
    if needed:
        needs = f"{part.__name__} needs arguments ({', '.join(needed)})"
        raise TypeError(f"{needs}; give an instance, or a function that makes one")
    return part


def _result(clause: Clause, make: Make) -> Result:
    name = clause.__name__
    try:
        clause(make)
    except AssertionError as failure:
        return Result(name, False, str(failure))
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{place.filename}, line {place.lineno}"
        return Result(name, False, f"{type(error).__name__}: {error} ({where})")
    return Result(name, True)


def _insist(kept: object, message: str) -> None:
    if not kept:
        raise AssertionError(message)


def _same(one: object, other: object) -> bool:
    """Whether numbers, arrays or tuples of them are equal bit for bit, NaN to NaN."""
    if isinstance(one, tuple | list) and isinstance(other, tuple | list):
        return len(one) == len(other) and all(map(_same, one, other))
    if one is None or other is None or isinstance(one, str):
        return one == other
    a, b = np.asarray(one), np.asarray(other)
    return a.shape == b.shape and a.tobytes() == b.tobytes()


def _drive(rows: int = 40, seed: int = 0, judge: Any = None) -> Floats:
    """(rows, m) gap, speed, leader's speed as it brakes, by turns for what a judge names."""
    draw = np.random.default_rng(seed)
    leader = np.clip(15.0 + np.cumsum(draw.normal(0.0, 0.8, rows)), 5.0, 30.0)
    follower = np.clip(leader + draw.normal(0.0, 2.0, rows), 1.0, 35.0)
    gap = np.clip(25.0 + np.cumsum((leader - follower) * _DT), 3.0, 80.0)
    names = getattr(getattr(judge, "labels", None), "names", ())
    columns = np.resize([gap, follower, leader], (len(names) or 3, rows))
    return np.asarray(np.clip(columns.T, *ends_of(judge, len(columns))))


def _common(answers: Callable[[Any, Rows], Answers]) -> Clause:
    """What holds for all that answers rows, by what it answers to them."""

    def answers_hang_on_inputs_alone(make: Make) -> None:
        """It changes no input, keeps no array of its caller, and draws no random numbers."""
        part, twin, outputs = make(), make(), []
        buffer = np.empty_like((drive := _drive(judge=part))[0])
        for row in drive:
            buffer[:] = row
            outputs += answers(part, [buffer])
            message = "it changed an observation that it was given (work in place? copy it first)"
            _insist(_same(buffer, row), message)
            buffer[:] = 1e6
        reference = [answer for row in drive for answer in answers(twin, [row])]
        _insist(
            _same(outputs, reference),
            "two that saw the same answer otherwise (an array that is kept instead of copied, a "
            "random number without a seed, or something shared by all of the class?)",
        )

    return answers_hang_on_inputs_alone


def _proposals(controller: Any, rows: Rows) -> Answers:
    proposals = [controller.propose(row, k * _DT) for k, row in enumerate(rows)]
    return [(float(proposal.action),) for proposal in proposals]


def proposes_numbers(make: Make) -> None:
    """It returns a `Proposal` of finite numbers, on a free road too."""
    controller = make()
    rare = [[np.inf, 20.0, 0.0], [0.01, 30.0, 0.0], [0.0, 10.0, 0.0], [-1.0, 5.0, 0.0]]
    for row in [*_drive(), *map(np.array, rare), np.array([500.0, 0.0, 50.0])]:
        proposal = controller.propose(row.copy(), 0.0)
        where = f"at gap {row[0]:g} m, {row[1]:.1f} and {row[2]:.1f} m/s"
        _insist(isinstance(proposal, Proposal), f"propose returns {proposal!r}, not a Proposal")
        why = "(a division by the gap or the speed?)"
        _insist(math.isfinite(proposal.action), f"it proposes {proposal.action} {where} {why}")


def _situation(row: Floats, k: int) -> Situation:
    """As a machine of one state recognises it; of none at first."""
    return Situation(row, np.ones(1), None if k == 0 else 0, math.nan, k * _DT)


def _revisions(reviser: Any, rows: Rows) -> Answers:
    actions = np.resize(_ACTIONS, len(rows)).tolist()
    pairs = enumerate(zip(rows, actions, strict=True))
    revisions = [reviser.revise(_situation(row, k), Proposal(action)) for k, (row, action) in pairs]
    return [(r.executed, r.risk_executed, r.reason, r.advised) for r in revisions]


def revises_what_is_proposed(make: Make) -> None:
    """It executes a finite number, of its actions if it acts, even where none was proposed."""
    reviser = make()
    _insist(reviser.actions is not None, "its actions are None; it needs a set of them")
    proposals = (*_ACTIONS.tolist(), 5.0, -9.0, math.nan, math.inf, -math.inf, 1e9)
    for k, row in enumerate(_drive(40)):
        proposed = proposals[k % len(proposals)]
        of = f"for a proposal of {proposed}"
        try:
            answer = reviser.revise(_situation(row, k), Proposal(proposed))
        except Exception as error:
            why = "a controller that failed must not take the reviser down"
            raise AssertionError(f"{of} it raises {error!r}; {why}") from error
        _insist(isinstance(answer, Revision), f"revise returns {answer!r}, not a Revision")
        is_number = isinstance(answer.executed, float) and math.isfinite(answer.executed)
        _insist(is_number, f"{of} it executes {answer.executed!r}; it must be a finite float")
        within = reviser.actions.low <= answer.executed <= reviser.actions.high
        passes = not getattr(reviser, "acts", True) and answer.executed == proposed
        _insist(within or passes, f"{of} it executes {answer.executed}, outside its set of actions")
        _insist(_same(answer.proposed, proposed), f"{of} it reports {answer.proposed} as proposed")
        _insist(answer.reason, "it gives no reason, and a driver would not learn why")
        risks = (answer.risk_proposed, answer.risk_executed, *answer.interval)
        sound = all(math.isnan(risk) or 0.0 <= risk <= 1.0 for risk in risks)
        _insist(sound and not risks[2] > risks[3], f"risk and interval are {risks}")


def an_episode_starts_anew(make: Make) -> None:
    """After `start_episode` it decides as one that has just been made."""
    reviser, twin = make(), make()
    _revisions(reviser, [np.array([2.0, 25.0, 5.0])] * 3)
    reviser.start_episode()
    twin.start_episode()
    outputs, reference = (_revisions(part, list(_drive(seed=1))) for part in (reviser, twin))
    _insist(_same(outputs, reference), "after start_episode it still depends on the episode before")


def _actions(judge: Any) -> tuple[ActionSet, Floats]:
    """A set of actions that a judge takes, its own ``actions`` if it has such, and five of them."""
    first = getattr(judge, "actions", _SETS[0])
    for actions in (first, *_SETS, first):
        samples = np.linspace(*limits(actions), 5)
        samples = np.rint(samples) if isinstance(actions, Choices) else samples
        with suppress(Exception):
            (another := copy.deepcopy(judge)).refuse_unfit(actions)
            another.judge(_situation(_drive(1, judge=judge)[0], 1), samples.copy())
            break
    return actions, samples


def _taught(make: Make, *, ask: bool = False) -> tuple[Guard, Any]:
    """A guard with the judge, after episodes of which every other one failed."""
    judge = make()
    actions = _actions(judge)[0]
    reviser, machine = ActionReviser(judge, actions), EvolvingFSM(actions.n_actions)
    guard = Guard.of(reviser, interval=getattr(judge, "dt", _DT), machine=machine)
    _go_on(guard, judge, range(6), ask=ask)
    return guard, judge


def _go_on(guard: Guard, judge: Any, episodes: range, *, ask: bool = False) -> None:
    samples = _actions(judge)[1]
    for episode in episodes:
        rows, failed = _drive(seed=episode, judge=judge), episode % 2 == 0
        for k, row in enumerate(rows):
            if ask:
                judge.why(judge.judge(_situation(row, 0), samples.copy()))
            guard.decide(row, samples[k % len(samples)], k * _DT)
        guard.end(failed, rows[-1])


def _judgements(judge: Any, rows: Rows) -> Answers:
    samples, judgements = _actions(judge)[1], []
    for row in rows:
        judgements.append(judge.judge(_situation(row, 1), options := samples.copy())[:3])
        message = "it changed the actions that it was given (work in place? copy them first)"
        _insist(_same(options, samples), message)
    return judgements


def _asked(judge: Any) -> Answers:
    return _judgements(judge, list(_drive(8, 99, judge)))


def judges_each_action(make: Make) -> None:
    """It returns a probability for each action, within its interval, or NaN where it knows none."""
    for risk, low, high in _asked(_taught(make)[1]):
        shapes = {*map(np.shape, (risk, low, high))}
        _insist(shapes == {(5,)}, f"of 5 actions it returns {shapes}")
        low, risk, high = np.array([low, risk, high])[:, ~np.isnan(risk)]
        sound = ((low >= 0.0) & (low <= risk) & (risk <= high) & (high <= 1.0)).all()
        why = "probabilities lie in [0, 1], and in their interval"
        _insist(sound, f"its risks are {risk} within {low} to {high}; {why}")


def learns_only_from_what_happens(make: Make) -> None:
    """Neither questions nor, once it is frozen, episodes change what it has learnt."""
    guard, judge = _taught(make)
    before = _asked(judge)
    text = "it learns otherwise where somebody else asks it too (does judge note what it is asked?)"
    _insist(_same(before, _asked(_taught(make, ask=True)[1])), text)
    with warnings.catch_warnings(action="ignore"):  # of this guard, which is none of anybody's
        guard.freeze()
    _go_on(guard, judge, range(10, 12))
    _insist(_same(before, _asked(judge)), "a frozen guard's judge went on learning")


def a_file_keeps_it(make: Make) -> None:
    """Where it learns, a guard that is saved and loaded between two episodes judges as before."""
    guard, judge = _taught(make)
    if not hasattr(judge, "learn"):
        return
    guard.save(file := BytesIO())
    again = Guard.load(file, judge=type(judge))
    equal = _same(_asked(judge), _asked(again.judge))
    _insist(equal, "one that was saved and loaded judges otherwise (is all that it learns saved?)")


def is_frozen(make: Make) -> None:
    """It is a frozen dataclass of settings: equal where they are, and none can be changed."""
    rule = make()
    _insist(is_dataclass(rule), "it is no dataclass: files could not store its settings")
    _insist(rule == make(), "two rules of the same settings are not equal")
    _insist(dict(rule.table) == dict(rule.table), "its table is another one the second time")
    for field in fields(rule):
        try:
            setattr(rule, field.name, getattr(rule, field.name))
        except FrozenInstanceError:
            continue
        raise AssertionError(f"{field.name} can be changed under a machine (frozen=True)")


def a_machine_takes_it(make: Make) -> None:
    """A machine creates states by it, alike in a batch and one by one, and a file keeps it."""
    rule = make()
    Z = np.cumsum(np.random.default_rng(0).normal(size=(60, len(rule.scales) or 3)), axis=0)
    try:
        machine, batch = EvolvingFSM(2, rule=rule), EvolvingFSM(2, rule=make())
    except TypeError as error:
        raise AssertionError(f"{error} (was it registered with register_rule?)") from error
    for z in Z:
        machine.observe(z)
        machine.act(0)
    batch.learn_many(Z, np.zeros(len(Z), np.int64))
    _insist(machine.n_states, "a machine with this rule creates no state at all")
    _insist(_same(machine.centers, batch.centers), "learn_many finds other states than observe")
    machine.save(file := BytesIO())
    again = EvolvingFSM.load(file).rule
    _insist(again == rule, f"from a file it comes back as {again}")


# Of each kind its methods, and its contract; a part is of the first kind whose methods it has.
_CONTRACTS: dict[str, tuple[tuple[str, ...], tuple[Clause, ...]]] = {
    "rule": (("table", "scales"), (is_frozen, a_machine_takes_it)),
    "reviser": (
        ("revise", "start_episode"),
        (revises_what_is_proposed, an_episode_starts_anew, _common(_revisions)),
    ),
    "controller": (("propose",), (proposes_numbers, _common(_proposals))),
    "judge": (
        ("judge", "why"),
        (judges_each_action, learns_only_from_what_happens, a_file_keeps_it, _common(_judgements)),
    ),
}

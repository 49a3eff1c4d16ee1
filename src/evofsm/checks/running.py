"""Run checks: by hand, all at once, or as cases of a test."""

from __future__ import annotations

import traceback
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from evofsm.checks import controllers, fleets, judges, machines, measures, models, revisers, rules
from evofsm.checks.contracts import Broken, Check, Contract
from evofsm.checks.kinds import Kind, Make, kind_of, maker

_CONTRACTS: dict[Kind, Contract] = {
    Kind.MACHINE: machines.CONTRACT,
    Kind.FLEET: fleets.CONTRACT,
    Kind.MODEL: models.CONTRACT,
    Kind.RULE: rules.CONTRACT,
    Kind.REVISER: revisers.CONTRACT,
    Kind.CONTROLLER: controllers.CONTRACT,
    Kind.JUDGE: judges.CONTRACT,
    Kind.MEASURE: measures.CONTRACT,
}


class Outcome(Enum):
    """How a check ended."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"  #: the thing lacks a method that this check is about


class Result(NamedTuple):
    """What a check found."""

    check: str  #: its name
    outcome: Outcome
    message: str = ""  #: what is wrong and its likely cause, or why it was skipped


@dataclass(frozen=True)
class Case:
    """A check and a thing, to be called in a test."""

    check: Check
    make: Make
    name: str

    def __str__(self) -> str:
        return self.name

    def __call__(self) -> Result:
        """Check.

        Returns
        -------
        Result
            That it passed, or was skipped.

        Raises
        ------
        Broken
            If it failed.
        """
        result = self.result()
        if result.outcome is Outcome.FAILED:
            raise Broken(f"{result.check}: {result.message}")
        return result

    def result(self) -> Result:
        """Check, and say how it ended whatever happens."""
        try:
            thing = self.make()
            for name in self.check.needs:
                if not hasattr(thing, name):
                    return Result(self.name, Outcome.SKIPPED, f"it has no {name!r}")
            self.check.run(self.make)
        except Broken as broken:
            return Result(self.name, Outcome.FAILED, str(broken))
        except Exception as error:
            return Result(self.name, Outcome.FAILED, _unexpected(error))
        return Result(self.name, Outcome.PASSED)


def check(thing: object, kind: Kind | None = None) -> list[Result]:
    """Hold a thing against the contract of its kind.

    Parameters
    ----------
    thing : object
        A class that can be made without arguments, an instance, or a function that makes one.
        Instances are copied before each check.
    kind : Kind, optional
        Which contract; without it the methods tell.

    Returns
    -------
    list of Result
        One for each check.

    Raises
    ------
    TypeError
        If its kind cannot be told, or a class needs arguments.

    Examples
    --------
    >>> class Optimist:
    ...     def score(self, observations, dt):
    ...         return -observations[:, 0].min() * np.ones(len(observations))
    >>> import numpy as np
    >>> for result in check(Optimist()):
    ...     if result.outcome is Outcome.FAILED:
    ...         print(result.check)
    uses_only_earlier_rows
    having_met_is_worst
    calls_for_braking_when_it_must
    refuses_rows_of_another_width
    """
    return [case.result() for case in cases(thing, kind)]


def cases(thing: object, kind: Kind | None = None) -> list[Case]:
    """The same checks one by one, for `pytest.mark.parametrize`.

    Parameters
    ----------
    thing : object
        As in `check`.
    kind : Kind, optional
        As in `check`.

    Returns
    -------
    list of Case
        Each to be called; its text is the name of the check.

    Examples
    --------
    >>> from evofsm import Paper
    >>> print(cases(Paper())[0])
    is_frozen
    """
    kind = kind_of(thing) if kind is None else kind
    make = maker(thing, kind)
    found = [Case(one, make, one.name) for one in all_checks(kind)]
    if kind is Kind.RULE:  # what it does shows in a machine
        machine = rules.machine_of(make)
        found += [Case(one, machine, f"machine: {one.name}") for one in all_checks(Kind.MACHINE)]
    if kind is Kind.JUDGE and hasattr(make(), "score"):
        found += [Case(one, make, f"measure: {one.name}") for one in all_checks(Kind.MEASURE)]
    return found


def all_checks(kind: Kind) -> tuple[Check, ...]:
    """The checks of a kind, in the order in which they are run.

    Parameters
    ----------
    kind : Kind

    Returns
    -------
    tuple of Check

    Examples
    --------
    >>> [check.name for check in all_checks(Kind.FLEET)][:2]
    ['inputs_not_changed', 'equals_its_machines']
    """
    return tuple(_CONTRACTS[kind])


def _unexpected(error: Exception) -> str:
    """An error that nobody foresaw, and where it came from."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({place.filename}, line {place.lineno})"

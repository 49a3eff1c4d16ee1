"""Contracts that anything of your own has to keep to fit in, as checks that run without a network.

A check has a name, takes a fresh copy of the thing, and says what is wrong with it and why that
may be. The checks of this package's own classes are the same ones.

Examples
--------
>>> from evofsm.risk.ttc import TimeToCollision
>>> all(result.outcome is Outcome.PASSED for result in check(TimeToCollision()))
True

In a test of your own::

    @pytest.mark.parametrize("case", cases(MyMeasure()), ids=str)
    def test_it_keeps_the_contract(case):
        case()
"""

from evofsm.checks.contracts import Broken, Check
from evofsm.checks.kinds import Kind, kind_of
from evofsm.checks.running import (
    Case,
    Outcome,
    Result,
    all_checks,
    cases,
    check,
)

__all__ = [
    "Broken",
    "Case",
    "Check",
    "Kind",
    "Outcome",
    "Result",
    "all_checks",
    "cases",
    "check",
    "kind_of",
]

"""Contracts that anything of your own has to keep to fit in, as checks that run without a network.

A check has a name, takes a fresh copy of the thing, and says what is wrong with it and why that
may be. The checks of this package's own classes are the same ones.

Examples
--------
>>> from evofsm.driving import TimeToCollision
>>> all(result.outcome is Outcome.PASSED for result in check(TimeToCollision()))
True

In a test of your own::

    @pytest.mark.parametrize("case", cases(MyMeasure()), ids=str)
    def test_it_keeps_the_contract(case):
        case()
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

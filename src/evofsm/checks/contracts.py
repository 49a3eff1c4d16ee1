"""What a check is, and what checks of every kind share."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.checks.kinds import Make

# Bytes a round that may stay: the interpreter keeps some of what is freed for the next of its kind.
_NOISE = 32


class Broken(AssertionError):  # noqa: N818 - what it says, not that something went wrong here
    """A contract is broken; the text says how, and why that may be."""


@dataclass(frozen=True)
class Check:
    """One clause of a contract."""

    run: Callable[[Make], None]
    needs: tuple[str, ...] = ()  #: methods that it is about

    @property
    def name(self) -> str:
        """What it is called."""
        return self.run.__name__

    @property
    def about(self) -> str:
        """What it asks for, in a sentence."""
        return (self.run.__doc__ or "").partition("\n")[0]


class Contract:
    """Checks of a kind, in the order in which they were written."""

    def __init__(self) -> None:
        self._checks: list[Check] = []

    def __iter__(self) -> Iterator[Check]:
        return iter(self._checks)

    def clause(self, *needs: str) -> Callable[[Callable[[Make], None]], Callable[[Make], None]]:
        """Add a function as a check; it is skipped where a method that it needs is missing."""

        def add(run: Callable[[Make], None]) -> Callable[[Make], None]:
            self._checks.append(Check(run, needs))
            return run

        return add


def insist(kept: object, message: str) -> None:
    """Break the contract unless it was kept."""
    if not kept:
        raise Broken(message)


def same(one: object, other: object) -> bool:
    """Whether two numbers, arrays or tuples of them are equal bit for bit, NaN to NaN."""
    if isinstance(one, tuple | list) and isinstance(other, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    if one is None or other is None or isinstance(one, str):
        return one == other
    a, b = np.asarray(one), np.asarray(other)
    return a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes()


def is_distribution(rows: NDArray[np.float64], tolerance: float = 1e-9) -> bool:
    """Whether entries are 0 or more and each row sums to 1."""
    array = np.asarray(rows)
    return bool((array >= 0.0).all() and (np.abs(array.sum(axis=-1) - 1.0) <= tolerance).all())


def refuse_growth(work: Callable[[int], None], rounds: int, kept_by: str) -> None:
    """Break the contract where doing the same over and over takes more and more memory.

    ``work`` is done six times, ``rounds`` rounds each: what is kept once is no growth.
    """
    work(rounds)
    tracemalloc.start()
    try:
        kept = [_kept_by(work, rounds) for _ in range(5)]
    finally:
        tracemalloc.stop()
    grown = min(kept)
    insist(
        grown < _NOISE * rounds,
        f"{kept_by} keeps {grown / rounds:.0f} bytes more with each repetition (a list that only "
        "grows?)",
    )


def _kept_by(work: Callable[[int], None], rounds: int) -> int:
    """Bytes that are there after the work and were not before."""
    before = tracemalloc.get_traced_memory()[0]
    work(rounds)
    gc.collect()
    return tracemalloc.get_traced_memory()[0] - before


def drive(rows: int = 40, seed: int = 0) -> NDArray[np.float64]:
    """(rows, 3) ndarray: a drive behind a leader that brakes now and then, never at rest.

    Gap [m], speed of the follower and of the leader [m/s], a row every 0.25 s.
    """
    draw = np.random.default_rng(seed)
    leader = np.clip(15.0 + np.cumsum(draw.normal(0.0, 0.8, rows)), 5.0, 30.0)
    follower = np.clip(leader + draw.normal(0.0, 2.0, rows), 1.0, 35.0)
    gap = np.clip(25.0 + np.cumsum((leader - follower) * 0.25), 3.0, 80.0)
    return np.column_stack([gap, follower, leader])


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """A copy that may not be written to."""
    alike = array.copy()
    alike.setflags(write=False)
    return alike


def refusals(attempts: Iterable[tuple[str, Callable[[], object]]]) -> Iterator[str]:
    """Make attempts that have to be refused; after each, say what was attempted."""
    for what, attempt in attempts:
        try:
            attempt()
        except (ValueError, TypeError):
            pass
        except Exception as error:
            raise Broken(
                f"{what}: {type(error).__name__}: {error}; a ValueError or TypeError that says "
                "what is wrong would be clear (was the input looked at before it was used?)"
            ) from error
        else:
            raise Broken(f"{what} was accepted; it must be refused with a ValueError or TypeError")
        yield what

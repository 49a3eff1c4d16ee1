"""What is told alike of judges that were tried: columns, sentences, settings, and two axes.

Rows are summaries of runs of one judge, those of the study of judges or of that of tasks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from evofsm.cli import Column, bare_percent, count, decimals, listed, number, percent, within
from studies.old.html import Setting

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Fewer proposals kept than this are told among the losses.
_FEW = 0.25


# -- Columns --------------------------------------------------------------------------------------

#: Held-out episodes that failed, in all runs.
FAILED: tuple[Column[Any], ...] = (
    Column("failed", "failed.held failed.tried", lambda held, tried: f"{held} of {tried}"),
    Column(
        "[%]",
        lambda one: tuple(100.0 * x for x in (one.failed.value, one.failed.low, one.failed.high)),
        within(1, 1),
    ),
)
#: And in the worst one.
WORST: Column[Any] = Column("worst [%]", "worst", bare_percent)
#: What is left to the controller.
KEPT: tuple[Column[Any], ...] = (
    Column("kept [%]", "kept", bare_percent),
    Column("change", "change", decimals(2)),
)
#: How long a decision takes.
TIMES: tuple[Column[Any], ...] = (
    Column("p50 [ms]", "p50", decimals(2)),
    Column("p99 [ms]", "p99", decimals(2)),
)


def scores(n: int) -> Callable[[float], str]:
    """How a column writes scores: large ones without decimals, small ones with ``n``.

    >>> [scores(2)(value) for value in (559.8, 23.46, 0.125)]
    ['560', '23.5', '0.12']
    """
    return lambda value: number(value, 0 if abs(value) >= 100.0 else 1 if abs(value) >= 10.0 else n)


# -- Sentences ------------------------------------------------------------------------------------


def failing(ours: Iterable[Any]) -> Iterator[str]:
    """Where held-out episodes fail."""
    for one in ours:
        if one.failed.held:
            yield (
                f"{one.who}: {count(one.failed.held)} of {count(one.failed.tried)} held-out "
                f"episodes fail, {percent(one.worst)} in the worst run."
            )


def hardly_kept(ours: Iterable[Any]) -> Iterator[str]:
    """Where little is left to the controller."""
    if few := [f"{one.who} ({percent(one.kept)})" for one in ours if one.kept < _FEW]:
        yield f"Few proposals are executed exactly: {listed(few)}."


def settings(seed: int, learnt: str, trained: Mapping[str, int], test: int) -> Iterator[Setting]:
    """Lines of a plan: with which seeds, learning from how many episodes, tried on how many."""
    yield Setting("seed", str(seed))
    yield Setting("learnt", f"with {learnt}")
    yield Setting("training episodes", ", ".join(f"{one} {n}" for one, n in trained.items()))
    yield Setting("held-out episodes", count(test))


# -- Axes -----------------------------------------------------------------------------------------


def scale_failed(axes: Axes) -> None:
    """Percent of episodes along x, with room for what is rare, and for 0."""
    axes.set_xscale("symlog", linthresh=1.0, linscale=0.7)
    axes.set_xlim(-0.12, 130.0)
    axes.set_xticks([0.0, 1.0, 10.0, 100.0], ["0", "1", "10", "100"])
    axes.minorticks_off()


def scale_kept(axes: Axes) -> None:
    """Percent of proposals along x."""
    axes.set_xlim(-4.0, 104.0)

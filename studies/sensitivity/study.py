"""The study: try all settings of the plan, over the cores of this computer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from evofsm.driving import KinematicWorld
from evofsm.fleet import in_order
from evofsm.paper import check_claims
from studies.old.frame import Frame, Progress, silent
from studies.sensitivity.amounts import Amounts
from studies.sensitivity.designs import Design, Trial, filling, maps, sweeps
from studies.sensitivity.parameters import PARAMETERS, Parameter
from studies.sensitivity.setting import (
    Remembering,
    Row,
    evaluate,
    recovered,
    study_of,
)

# Settings a worker tries in one go: worth crossing a process boundary.
_TOGETHER = 16


class Reach(NamedTuple):
    """How far one parameter alone may move before the first claim breaks."""

    parameter: Parameter
    low: float
    high: float
    low_is_end: bool  #: of the range that was tried, with every claim still holding
    high_is_end: bool
    broken_below: tuple[str, ...]  #: claims that do not hold next to the lower edge
    broken_above: tuple[str, ...]


@dataclass(frozen=True)
class Sensitivity:
    """What became of the claims with every setting."""

    plan: Amounts
    claims: tuple[Any, ...]  #: with the recovered setting
    rows: tuple[Row, ...]
    reaches: tuple[Reach, ...]

    @property
    def ids(self) -> list[str]:
        """Of the claims."""
        return [claim.id for claim in self.claims]

    def of(self, design: Design, *varied: str) -> list[Row]:
        """Rows of a design; of one sweep or map, where what it varies is named."""
        return [row for row in self.rows if row.design == design and varied in ((), row.varied)]

    @property
    def frame(self) -> Frame:
        """A row for each setting."""
        return Frame(self.rows)


def run_sensitivity(
    plan: Amounts,
    progress: Progress = silent,
    workers: int | None = None,
) -> Sensitivity:
    """Try all settings of the plan; see `Study.run`.

    Returns
    -------
    Sensitivity
        Rows in the order of the designs.
    """
    trials = list(_trials(plan))
    searched = [one for one in PARAMETERS if one.is_number]
    total = len(trials) + 2 * plan.halvings * len(searched)

    chunks = [trials[at : at + _TOGETHER] for at in range(0, len(trials), _TOGETHER)]
    found = in_order(
        [partial(_try_all, chunk, plan.rounds) for chunk in chunks],
        workers,
        lambda done, _: progress(min(done * _TOGETHER, len(trials)), total),
    )
    rows: list[Row] = [row for chunk in found for row in chunk]
    by_sweep = {one.name: _sweep(rows, one) for one in searched}
    edges = in_order(
        [partial(_reach, one, by_sweep[one.name], plan) for one in searched],
        workers,
        lambda done, _: progress(len(trials) + done * 2 * plan.halvings, total),
    )
    for _, more in edges:
        rows += more
    claims = check_claims(study_of(recovered(), Remembering(KinematicWorld()), plan.rounds))
    return Sensitivity(plan, claims, tuple(rows), tuple(reach for reach, _ in edges))


def _trials(plan: Amounts) -> Iterator[Trial]:
    yield Trial(Design.RECOVERED, (), recovered())
    yield from sweeps(plan.levels, plan.seed)
    yield from maps(plan.side, plan.seed)
    for design, number in _sizes(plan).items():
        yield from filling(design, number, plan.seed)


def _sizes(plan: Amounts) -> dict[Design, int]:
    """How many points each design that fills a space has."""
    return {
        Design.ALL: plan.settings,
        Design.OPEN: plan.settings // 2,
        Design.NEAR: plan.settings // 4,
    }


def _try_all(trials: Sequence[Trial], rounds: int) -> list[Row]:
    world = Remembering(KinematicWorld())
    return [evaluate(one.setting, world, one.design, one.varied, rounds) for one in trials]


def _sweep(rows: Sequence[Row], one: Parameter) -> list[Row]:
    """A parameter's sweep, in the order of its values."""
    found = [row for row in rows if row.design == Design.SWEEP and row.varied == (one.name,)]
    return sorted(found, key=lambda row: _value(one, row))


# -- Where the first claim breaks -----------------------------------------------------------------


def _reach(one: Parameter, sweep: Sequence[Row], plan: Amounts) -> tuple[Reach, list[Row]]:
    """Halve the steps of the sweep between which a claim breaks, below and above."""
    here = [_value(one, row) for row in sweep].index(one.recovered)
    below, tried_below = _edge(one, sweep[here::-1], plan)
    above, tried_above = _edge(one, sweep[here:], plan)
    reach = Reach(
        one,
        *(below.last, above.last),
        *(not below.broken, not above.broken),
        *(below.broken, above.broken),
    )
    return reach, [*tried_below, *tried_above]


class _Edge(NamedTuple):
    last: float  #: value with which all claims hold
    broken: tuple[str, ...]  #: claims that do not with the next one; none at the end of the range


def _edge(one: Parameter, outward: Sequence[Row], plan: Amounts) -> tuple[_Edge, list[Row]]:
    """From the recovered setting outward, to where all claims hold for the last time."""
    if not outward[0].holds:  # not even there: nowhere to go from
        return _Edge(_value(one, outward[0]), outward[0].broken), []
    first_bad = next((k for k, row in enumerate(outward) if not row.holds), None)
    if first_bad is None:
        return _Edge(_value(one, outward[-1]), ()), []
    world = Remembering(KinematicWorld())
    good, bad = outward[first_bad - 1], outward[first_bad]
    tried: list[Row] = []
    for _ in range(plan.halvings):
        middle = 0.5 * (one.place_of(_value(one, good)) + one.place_of(_value(one, bad)))
        setting = one.moved(good.setting, one.value_at(middle))
        row = evaluate(setting, world, Design.EDGE, (one.name,), plan.rounds)
        tried.append(row)
        good, bad = (row, bad) if row.holds else (good, row)
    return _Edge(_value(one, good), bad.broken), tried


def _value(one: Parameter, row: Row) -> float:
    return float(getattr(row.setting, one.name))

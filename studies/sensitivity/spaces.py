"""Spaces of settings over which shares are taken, and what decides in them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from studies.old.scores import Share, share_of
from studies.sensitivity.designs import NEAR, Design
from studies.sensitivity.parameters import Parameter, parameter
from studies.sensitivity.setting import Row
from studies.sensitivity.shares import Index, first_order
from studies.sensitivity.study import Sensitivity

#: The claims in a few words; in full they stand in `evofsm.paper`.
_SHORT = {
    "collisions_by_case": "collisions by case",
    "brake_at_11": "brake at 11 s",
    "brake_at_15": "brake at 15 s",
    "states_after_each_run": "no state after run 4",
    "states_final": "7 states",
    "dead_end_state": "one collision state",
    "dead_end_share": "all in the dead end",
    "case3_leaves_dead_end": "case 3 leaves it",
    "case4_enters_dead_end": "case 4 comes to it",
    "jsd_max_by_case": "divergence < 0.15",
}


def short_name(claim: str | None) -> str:
    """A claim in a few words, by its id; None stands for all of them together."""
    return "all of them" if claim is None else _SHORT.get(claim, claim.replace("_", " "))


class Space(NamedTuple):
    """Settings over which shares are taken."""

    name: str
    column: str  #: its name in a table
    design: Design
    same_ends: bool = False  #: only those in which the cases end as in the paper

    def rows(self, study: Sensitivity) -> list[Row]:
        """Its settings."""
        rows = study.of(self.design)
        return [row for row in rows if row.verdicts["collisions_by_case"] or not self.same_ends]

    def share(self, study: Sensitivity, claim: str | None = None) -> Share:
        """Share of its settings with which a claim holds, or all of them."""
        rows = self.rows(study)
        return share_of([row.holds if claim is None else row.verdicts[claim] for row in rows])

    def varied(self, study: Sensitivity) -> list[Parameter]:
        """What is drawn in it."""
        return [parameter(name) for name in study.of(self.design)[0].varied]

    def ranked(self, study: Sensitivity, of: ArrayLike) -> list[tuple[Parameter, Index]]:
        """What is varied, with its share of the variance of a verdict or number, largest first."""
        rows = self.rows(study)
        found = [(one, first_order(rows, of, one)) for one in self.varied(study)]
        return sorted(found, key=lambda pair: -np.nan_to_num(pair[1].value, nan=-1.0))

    def decider(self, study: Sensitivity, claim: str) -> tuple[str | None, str | None]:
        """What explains most of a claim's verdict, and how much [%]; None for mere chance."""
        best, index = self.ranked(study, [row.verdicts[claim] for row in self.rows(study)])[0]
        return (best.label, index.percent) if index.counts else (None, None)


OPEN = Space("what the paper leaves open", "left open", Design.OPEN)
SAME = Space("the same, where cases end as in the paper", "same ends", Design.OPEN, same_ends=True)
ALL = Space("everything", "all", Design.ALL)
NEARBY = Space(f"within ±{100 * NEAR:g} % of recovered", "near", Design.NEAR)
SPACES = (OPEN, SAME, ALL, NEARBY)

"""Where ours loses in the closed-loop study, in words."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from evofsm.app import interval, number, part, percent, seeds_text
from evofsm.evidence.closed_loop.losses import Loss, What, losses
from evofsm.evidence.closed_loop.study import SAFE_RATE, ClosedLoop
from evofsm.evidence.report.beside import when


class InWords(NamedTuple):
    """A loss as people read it."""

    what: str
    who: str
    theirs: str
    ours: str
    apart: bool | None  #: whether 95 % intervals do not meet; None where there are none
    loud: bool  #: whether it breaks what was asked for


def losses_in_words(study: ClosedLoop) -> list[InWords]:
    """Every row and measure in which ours loses; empty where it is nowhere."""
    return [_in_words(loss) for loss in losses(study)]


def _in_words(loss: Loss) -> InWords:
    about, show = loss.about, _SHOWN[loss.what]
    what, who = str(loss.what), f"{loss.who} ({loss.group})"
    theirs, ours = (show(*values) if values else "" for values in (loss.theirs, loss.ours))
    match loss.what:
        case What.LEARNING:
            who, theirs, ours = "whatever does not learn", "0", f"{ours} episodes (median)"
        case What.BECOMING_SAFE:
            who, theirs = f"the mark of {SAFE_RATE:.0%}", "reached by every seed"
        case What.SHIFT:
            what, who, ours = f"collisions {when(int(about))}", loss.who, f"{ours} (median)"
        case What.BRIER:
            what, who = f"{what}, {about}", "always the base rate"
        case What.CASE_COLLIDES:
            what, who, theirs = f"the paper's {about}", "no collision", "the run's end"
        case What.CASE_CHANGED:
            what, who = f"the paper's {about}", "the driver alone, who does not collide"
            theirs = percent(loss.theirs[0])
        case What.WORLDS:
            ours = f"{theirs} in {loss.who}, {ours} in {about}"
            who, theirs = "the same model", "equal"
    return InWords(what, who, theirs, ours, loss.apart, loss.loud)


def _on_axes(rate: float, mobility: float) -> str:
    return f"{percent(rate)} at mobility {number(mobility, 3)}"


def _area(area: float, low: float, high: float) -> str:
    return f"{number(area, 3)} ({interval(low, high, lambda x: number(x, 3))})"


def _not_safe(never: float, seeds: float, episodes: float) -> str:
    return f"not reached by {never} of {seeds_text(int(seeds))} in {episodes:,} episodes"


_SHOWN: dict[What, Callable[..., str]] = {
    What.BOTH: _on_axes,
    What.COLLISIONS: _on_axes,
    What.WORST_SEED: _on_axes,
    What.INTERVENTIONS: percent,
    What.CHANGE: lambda x: f"{number(x, 2)} m/s²",
    What.JERK: lambda x: f"{number(x, 2)} m/s³",
    What.REAR_ENDS: part,
    What.LEARNING: part,
    What.BECOMING_SAFE: _not_safe,
    What.SHIFT: percent,
    What.AUROC: _area,
    What.BRIER: lambda x: number(x, 4),
    What.CASE_COLLIDES: lambda end: f"collides at {end:.1f} s",
    What.CASE_CHANGED: lambda share, late: (
        f"{percent(share)} of decisions changed ({percent(late)} late)"
    ),
    What.WORLDS: part,
}

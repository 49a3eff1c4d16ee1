"""Rows of several learning seeds and controllers as one, and what taking a part away changes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np

from evofsm.extras import needs
from studies.judges.study import Judges
from studies.old.scores import Share
from studies.systems.pooled import middle, pooled
from studies.systems.trial import Row

with needs("scipy", "study", "comparing runs"):
    from scipy.stats import t as student

# Of the interval of a mean difference over runs (Student's t); what it leaves out is clear.
_SURE = 0.99


class Summary(NamedTuple):
    """Runs of one judge that stand together: all learning seeds, of one controller or of all."""

    system: str
    controller: str  #: empty for all of them
    judge: str
    without: str
    runs: int
    failed: Share  #: held-out episodes of all runs, which share their draws
    worst: float  #: share that failed in the worst run
    learning: int  #: failures while learning in the worst run
    late: int  #: those from the 31st episode on, in the worst run
    kept: float  #: median over runs
    change: float  #: median over runs
    score: float  #: median over runs
    score_worst: float
    p50: float  #: median over runs [ms]
    p99: float  #: of the worst run [ms]

    @property
    def who(self) -> str:
        """The system, and its controller."""
        return f"{self.system}, {self.controller}" if self.controller else self.system

    @property
    def name(self) -> str:
        """The judge, and what it lacks."""
        return f"without {self.without}" if self.without else self.judge


def summary(rows: Sequence[Row]) -> Summary:
    """Rows of one system and one judge as one; of several controllers they are pooled."""
    first = rows[0]
    controllers = {row.controller for row in rows}
    return Summary(
        system=first.system,
        controller=first.controller if len(controllers) == 1 else "",
        judge=first.judge,
        without=first.without,
        score=middle(row.score for row in rows),
        **pooled(rows),
    )


# -- What a part is worth -------------------------------------------------------------------------


class Worth(Enum):
    """What taking a part away does to a system."""

    NEEDED = "needed"  #: it clearly does worse without
    UNCLEAR = "unclear"  #: more held-out episodes fail without, but not in so many runs as to tell
    NOTHING = "nothing"  #: nothing that is clear
    HARMS = "harms"  #: it clearly does better without


class Effect(NamedTuple):
    """What taking one part away from the learnt judge does to one system."""

    part: str
    system: str
    worth: Worth
    text: str  #: the difference that decides, in words


class _Scale(NamedTuple):
    """Something that is compared, run by run."""

    value: Callable[[Row], float]
    better: float  #: 1 where more is better, -1 where less is
    least: Callable[[Row], float]  #: a mean difference that matters
    text: Callable[[float], str]  #: of the mean difference, without less with


def _points(what: str) -> Callable[[float], str]:
    return lambda difference: f"{100.0 * difference:+.1f} % {what}"


#: What matters first stands first: the first of them that is clear decides.
_SCALES: tuple[_Scale, ...] = (
    _Scale(lambda r: r.failed / r.episodes, -1.0, lambda r: 0.01, _points("failed")),
    _Scale(
        lambda r: r.failed_while_learning,
        -1.0,
        lambda r: 1.0,
        lambda difference: f"{difference:+.1f} failures while learning",
    ),
    _Scale(
        lambda r: r.score,
        1.0,
        lambda r: 0.01 if r.measure == "mobility" else 0.02 * abs(r.score),
        lambda difference: f"{difference:+.3g} in score",
    ),
    _Scale(lambda r: r.kept, 1.0, lambda r: 0.02, _points("kept")),
    _Scale(lambda r: r.mean_change, -1.0, lambda r: 0.02, _points("change")),
)


def effect(found: Judges, system: str, part: str) -> Effect | None:
    """What taking a part away does; None where there are not two runs or more to compare."""
    whole = {(row.controller, row.seed): row for row in found.of(system)}
    runs = [
        (whole[row.controller, row.seed], row)
        for row in found.of(system, without=part)
        if (row.controller, row.seed) in whole
    ]
    if len(runs) < 2:
        return None
    certain = float(student.ppf(0.5 + 0.5 * _SURE, len(runs) - 1)) / math.sqrt(len(runs))
    worth, text = Worth.NOTHING, ""
    for scale in _SCALES:
        differences = [scale.value(less) - scale.value(own) for own, less in runs]
        mean = float(np.mean(differences))
        if abs(mean) < float(np.mean([scale.least(own) for own, _ in runs])):
            continue
        is_worse = mean * scale.better < 0.0
        if abs(mean) > certain * float(np.std(differences, ddof=1)):
            worth = Worth.NEEDED if is_worse else Worth.HARMS
            return Effect(part, system, worth, scale.text(mean))
        if scale is _SCALES[0] and is_worse:
            worth, text = Worth.UNCLEAR, scale.text(mean)
    return Effect(part, system, worth, text)


def effects(found: Judges) -> list[Effect]:
    """Of every part on every system, as far as it can be told."""
    every = (effect(found, system, part) for part in found.parts for system in found.systems)
    return [one for one in every if one is not None]

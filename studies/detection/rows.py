"""One line of the table: how well one measure sees one target coming in one world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from studies.detection.alarms import (
    choose_threshold,
    count_alarms,
    is_measurable,
    lead_times,
)
from studies.detection.calibration import Reliability, reliability
from studies.detection.measures import Detector
from studies.detection.watch import Cases, Exposure, Target
from studies.old.scores import Ranked, bootstrap, interval, isotonic, resampled

#: False alarms per hour at which lead times are told [1/h].
RATES = (1.0, 0.1)


@dataclass(frozen=True)
class Row:
    """One measure, one target, one world; None where a number does not apply."""

    family: str
    measure: str
    group: str
    target: str
    auroc: float
    auroc_low: float  #: 95 % interval (bootstrap over episodes), as all of them
    auroc_high: float
    auprc: float
    auprc_low: float
    auprc_high: float
    lead_median_1: float | None  #: before collisions, at one false alarm per hour [s]
    lead_median_1_low: float | None
    lead_median_1_high: float | None
    lead_p10_1: float | None  #: 10th percentile of lead times [s]
    lead_median_01: float | None  #: at one in ten hours [s]
    lead_p10_01: float | None
    false_alarms_1: float | None  #: false alarms on held-out draws [1/h]
    false_alarms_01: float | None
    false_time_1: float | None  #: share of decisions without the target that are in alarm
    warned_1: float | None  #: share of collisions with an alarm that stayed on
    warned_01: float | None
    brier: float | None  #: after isotonic calibration on other draws
    brier_own: float | None  #: of its own probability
    missed: float | None  #: miss rate at threshold 0
    called: float | None  #: false-alarm rate at threshold 0, of decisions without the target
    share: float  #: of decisions with the target
    collisions: int
    episodes: int
    hours: float
    decel: float  #: the true limits [m/s²]
    leader_decel: float
    auroc_seeds: tuple[float, ...] = ()  #: of the other learning seeds, on fewer episodes


class Reliable(NamedTuple):
    """How well the probabilities of a measure fit what came."""

    family: str
    measure: str
    target: str
    calibrated: bool  #: by isotonic regression on other draws; else it is the measure's own
    fit: Reliability


class AtRate(NamedTuple):
    """What a measure reaches at the threshold that was chosen for a rate of false alarms."""

    lead: NDArray[np.float64]  #: (collisions,) [s]
    false_alarms: float | None  #: [1/h]
    false_time: float | None

    @property
    def warned(self) -> float | None:
        """Share of collisions with an alarm that stayed on."""
        return _mean(self.lead > 0.0)

    def lead_in(self, share: float) -> float | None:
        """Quantile of the lead times [s]."""
        return float(np.quantile(self.lead, share)) if len(self.lead) else None

    def median_interval(self, rounds: int) -> tuple[float | None, float | None]:
        """95 % interval of the median lead time [s]."""
        lead = self.lead
        if len(lead) == 0:
            return None, None
        return bootstrap(lambda chosen: float(np.median(lead[chosen])), len(lead), rounds)


# Of a rate that cannot be measured.
_UNKNOWN = AtRate(np.empty(0), None, None)


class Scored(NamedTuple):
    """What a detector says of all decisions of an exposure."""

    exposure: Exposure
    scores: NDArray[np.float64]  #: (n,)


class Judged(NamedTuple):
    """A row, and what the reliability diagram is drawn from."""

    row: Row
    reliable: list[Reliable]


def judge(
    name: str,
    detector: Detector,
    target: Target,
    held_out: Scored,
    calibration: Scored | None,
    rounds: int,
) -> Judged:
    """Judge the scores of a measure by the truth.

    Parameters
    ----------
    name : str
        Of the world.
    detector : Detector
    target : Target
    held_out : Scored
        On which it is judged.
    calibration : Scored, optional
        On which thresholds are chosen and probabilities calibrated; without it neither is.
    rounds : int
        Of the bootstrap.
    """
    exposure = held_out.exposure
    family, cases = exposure.family, exposure.cases(target)
    score, truth = held_out.scores[cases.rows], cases.truth
    ranked, episodes = Ranked(score, truth, cases.episode), len(exposure.watched)
    areas = ranked.areas()
    drawn = np.array(
        [
            ranked.areas(np.bincount(chosen, minlength=episodes))
            for chosen in resampled(episodes, rounds)
        ]
    )
    roc, prc = interval(drawn[:, 0]), interval(drawn[:, 1])
    at = _at_rates(target, held_out, cases, calibration)
    often, seldom = (at.get(rate, _UNKNOWN) for rate in RATES)
    collisions = int(exposure.collided.sum())
    spread = often.median_interval(rounds)
    reliable = _reliable(name, detector, target, score, truth, calibration)
    briers = {one.calibrated: one.fit.brier for one in reliable}
    is_call = not detector.is_probability
    row = Row(
        family=name,
        measure=detector.name,
        group=detector.group,
        target=target,
        auroc=areas.auroc,
        auroc_low=roc.low,
        auroc_high=roc.high,
        auprc=areas.auprc,
        auprc_low=prc.low,
        auprc_high=prc.high,
        lead_median_1=often.lead_in(0.5),
        lead_median_1_low=spread[0],
        lead_median_1_high=spread[1],
        lead_p10_1=often.lead_in(0.1),
        lead_median_01=seldom.lead_in(0.5),
        lead_p10_01=seldom.lead_in(0.1),
        false_alarms_1=often.false_alarms,
        false_alarms_01=seldom.false_alarms,
        false_time_1=often.false_time,
        warned_1=often.warned,
        warned_01=seldom.warned,
        brier=briers.get(True),
        brier_own=briers.get(False),
        missed=_mean(score[truth] <= 0.0) if is_call else None,
        called=_mean(score[~truth] > 0.0) if is_call else None,
        share=float(truth.mean()),
        collisions=collisions,
        episodes=episodes,
        hours=cases.hours,
        decel=family.decel,
        leader_decel=family.leader_decel,
    )
    return Judged(row, reliable)


def _at_rates(
    target: Target, held_out: Scored, cases: Cases, calibration: Scored | None
) -> dict[float, AtRate]:
    """By rate; those that cannot be measured are not there."""
    if calibration is None:
        return {}
    chosen_on, interval = calibration.exposure.cases(target), held_out.exposure.family.interval
    before = calibration.scores[chosen_on.rows]
    found = {}
    for rate in RATES:
        if not is_measurable(rate, min(cases.hours, chosen_on.hours)):
            continue
        threshold = choose_threshold(before, chosen_on, rate, interval)
        alarms = count_alarms(held_out.scores[cases.rows], cases, threshold, interval)
        found[rate] = AtRate(
            lead_times(held_out.scores, held_out.exposure, threshold),
            alarms.false / cases.hours,
            alarms.false_decisions / max(1, int((~cases.truth).sum())),
        )
    return found


def _reliable(
    name: str,
    detector: Detector,
    target: Target,
    score: NDArray[np.float64],
    truth: NDArray[np.bool_],
    calibration: Scored | None,
) -> list[Reliable]:
    """Of the calibrated score, and of its own probability where it is one of this target."""
    found = []
    if detector.is_probability and target is Target.COLLISION:
        found.append((False, score))
    if calibration is not None:
        cases = calibration.exposure.cases(target)
        calibrate = isotonic(calibration.scores[cases.rows], cases.truth)
        found.append((True, calibrate(score)))
    return [
        Reliable(
            name,
            detector.name,
            target,
            calibrated,
            reliability(detector.name, probability.tolist(), truth.tolist()),
        )
        for calibrated, probability in found
    ]


def _mean(values: NDArray[np.bool_]) -> float | None:
    return float(values.mean()) if len(values) else None

"""How far forecasts are from the beliefs that came, and how much nearer than a reference's.

Two scores of a forecast q where the belief gamma came: the Jensen-Shannon divergence of the two,
and the log score -sum gamma log2 q [bit], which no forecast gets below the entropy of gamma. The
skill of either is 1 - (score - best) / (reference - best): 1 where the forecast is what came, 0
where it is as good as the reference (D. Wilks, "Statistical Methods in the Atmospheric Sciences").
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm import jensen_shannon
from studies.old.scores import Interval, bootstrap

# Share of every forecast, whoever makes it, that is spread evenly: a 0 would cost infinitely much.
_SPREAD_OUT = 1e-6

#: Makes forecasts: of (T, n) beliefs and (T,) actions, (T, n) of what comes.
Forecaster = Callable[[NDArray[np.float64], NDArray[np.int64]], NDArray[np.float64]]


class Sums(NamedTuple):
    """Of one forecaster at one horizon, over the forecasts of each test episode."""

    divergence: NDArray[np.float64]  #: (E,) [bit]
    excess: NDArray[np.float64]  #: (E,) log score above the best one that there could be [bit]
    log_score: NDArray[np.float64]  #: (E,) [bit]
    forecasts: NDArray[np.float64]  #: (E,) how many there were
    episodes: NDArray[np.int64]  #: (E,) numbers of the episodes
    states: int  #: that there were to choose from


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    source: str
    horizon: float  #: [s]
    method: str
    jsd: float  #: mean divergence [bit]
    log_score: float  #: mean [bit]
    skill_persistence: float  #: in divergence
    low: float  #: of its 95 % interval, by bootstrap over test episodes
    high: float
    skill_batch: float  #: in divergence
    log_skill_persistence: float  #: in log score
    log_low: float
    log_high: float
    log_skill_batch: float
    worst: float  #: lowest `skill_persistence` of a learning seed, or of a part of the runs
    forecasts: int
    episodes: int  #: test episodes
    states: int  #: in the median
    ablation: bool = False  #: one learning seed, or one part of the runs; the method is a `Variant`


def score(
    forecasters: dict[str, Forecaster],
    episodes: Iterable[tuple[NDArray[np.float64], NDArray[np.int64]]],
    steps: int,
    every: int,
    first: int,
) -> dict[str, Sums]:
    """Let forecasters say what comes ``steps`` later, from every so many rows on.

    Parameters
    ----------
    forecasters : dict of str to callable
    episodes : iterable of tuple
        (T, n) beliefs and (T,) actions of each.
    steps, every : int
        Rows from a forecast to what it is about, and to the next forecast.
    first : int
        Number of the first episode.
    """
    found: dict[str, list[tuple[float, float, float, float, int]]] = {
        name: [] for name in forecasters
    }
    states = 0
    for number, (beliefs, actions) in enumerate(episodes, first):
        origins = np.arange(0, len(beliefs) - steps, every)
        states = beliefs.shape[1]
        if len(origins) == 0:
            continue
        came = beliefs[origins + steps]
        best = _log_scores(came, came, spread_out=0.0)
        for name, forecaster in forecasters.items():
            predicted = forecaster(beliefs[origins], actions[origins])
            logs = _log_scores(predicted, came)
            divergence = np.asarray(jensen_shannon(predicted, came))
            found[name].append(
                (
                    float(divergence.sum()),
                    float((logs - best).sum()),
                    float(logs.sum()),
                    float(len(origins)),
                    number,
                )
            )
    return {name: _sums(rows, states) for name, rows in found.items()}


def _log_scores(
    predicted: NDArray[np.float64], came: NDArray[np.float64], spread_out: float = _SPREAD_OUT
) -> NDArray[np.float64]:
    everywhere = (1.0 - spread_out) * predicted + spread_out / predicted.shape[1]
    logs = np.log2(everywhere, where=everywhere > 0.0, out=np.zeros_like(everywhere))
    return np.asarray(-(came * logs).sum(axis=1))


def _sums(rows: Sequence[tuple[float, float, float, float, int]], states: int) -> Sums:
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    divergence, excess, log_score, forecasts, episodes = table.T
    return Sums(divergence, excess, log_score, forecasts, episodes.astype(np.int64), states)


def together(rounds: Sequence[Sums]) -> Sums:
    """Rounds in one: what the same test episode got in several is added up."""
    numbers = np.concatenate([one.episodes for one in rounds])
    episodes, places = np.unique(numbers, return_inverse=True)

    def added(name: str) -> NDArray[np.float64]:
        values = np.concatenate([getattr(one, name) for one in rounds])
        return np.bincount(places, values, minlength=len(episodes)).astype(np.float64)

    return Sums(
        divergence=added("divergence"),
        excess=added("excess"),
        log_score=added("log_score"),
        forecasts=added("forecasts"),
        episodes=episodes,
        states=int(np.median([one.states for one in rounds])),
    )


def skill(scores: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    """1 for a perfect forecast, 0 for one as good as the reference; NaN where that is perfect."""
    rival = float(reference.sum())
    return 1.0 - float(scores.sum()) / rival if rival > 0.0 else float("nan")


def row(
    source: str,
    horizon: float,
    method: str,
    ours: Sequence[Sums],
    persistence: Sequence[Sums],
    batch: Sequence[Sums],
    seed: int,
    rounds: int,
    *,
    ablation: bool,
) -> Row:
    """Judge a method against both references, all of them in the same rounds."""
    mine, still, rival = together(ours), together(persistence), together(batch)
    forecasts = mine.forecasts.sum()
    low, high = _interval(mine.divergence, still.divergence, seed, rounds)
    log_low, log_high = _interval(mine.excess, still.excess, seed, rounds)
    return Row(
        source=source,
        horizon=horizon,
        method=method,
        jsd=float(mine.divergence.sum() / forecasts),
        log_score=float(mine.log_score.sum() / forecasts),
        skill_persistence=skill(mine.divergence, still.divergence),
        low=low,
        high=high,
        skill_batch=skill(mine.divergence, rival.divergence),
        log_skill_persistence=skill(mine.excess, still.excess),
        log_low=log_low,
        log_high=log_high,
        log_skill_batch=skill(mine.excess, rival.excess),
        worst=min(
            skill(a.divergence, b.divergence) for a, b in zip(ours, persistence, strict=True)
        ),
        forecasts=int(forecasts),
        episodes=len(mine.episodes),
        states=mine.states,
        ablation=ablation,
    )


def _interval(
    scores: NDArray[np.float64], reference: NDArray[np.float64], seed: int, rounds: int
) -> Interval:
    """Of a skill, over test episodes."""
    return bootstrap(
        lambda chosen: skill(scores[chosen], reference[chosen]), len(scores), rounds, seed
    )

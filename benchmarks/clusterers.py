"""Others that cluster streams one sample at a time: river's, on the paper's runs."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from typing import Any

from single import one_call_each, pair
from streams import PAPER_ROUND
from turns import Result, Work, compare, timed

_NAMES = ("gap", "v_follower", "v_leader")
_OURS = "update: finds states, recognises one, forecasts by action, learns transitions"


def stream_k_means(repeats: int, short: bool) -> Result:
    """River's STREAMKMeans, told the number of clusters."""
    from river import cluster

    return _against_river(
        "STREAMKMeans",
        partial(cluster.STREAMKMeans, n_clusters=7, seed=0),
        {},
        repeats,
        short,
        "learn_one + predict_one: 7 clusters, as told; no transitions, no forecast",
    )


def db_stream(repeats: int, short: bool) -> Result:
    """River's DBSTREAM, with a memory that holds about as many clusters as there are states."""
    from river import cluster

    return _against_river(
        "DBSTREAM",
        # By default, 0.01, all is forgotten within seconds of a stream at 100 Hz, and with it all
        # clusters but one or two; with 3e-4 there are more in every round, and it grows slower.
        partial(cluster.DBSTREAM, fading_factor=5e-4),
        {"DBSTREAM as it is by default, holding 1 to 2 clusters": cluster.DBSTREAM},
        repeats,
        short,
        "learn_one + predict_one: finds 8 clusters; no transitions, no forecast",
    )


def _against_river(
    name: str,
    make: Callable[[], Any],
    others: dict[str, Callable[[], Any]],
    repeats: int,
    short: bool,
    does: str,
) -> Result:
    rows = 200 if short else PAPER_ROUND
    machine, _, stream = pair(7, rows)
    samples = [dict(zip(_NAMES, z, strict=True)) for z in stream.observations.tolist()]
    states = machine.copy().learn_many(*stream).state
    return compare(
        "one call a sample, 7 states, on the paper's runs",
        one_call_each(machine.update, stream),
        f"river {version('river')} {name}",
        learn_and_predict(make(), samples),
        repeats,
        beside={what: learn_and_predict(kind(), samples) for what, kind in others.items()}
        | {f"deeptime {version('deeptime')}, counting transitions in batch": counting(states)},
        notes=[
            f"ours: {_OURS}",
            f"river: {does}",
            "deeptime: counts transitions between states found before; needs all rows at once",
        ],
    )


def learn_and_predict(model: Any, samples: list[dict[str, float]]) -> Work:
    """A call of each for every sample, as river's users make them."""

    def loop() -> None:
        for sample in samples:
            model.learn_one(sample)
            model.predict_one(sample)

    return lambda: timed(loop, len(samples))


def counting(states: Any) -> Work:
    """How often each state follows each, in one pass over them all."""
    from deeptime.markov import TransitionCountEstimator

    estimator = TransitionCountEstimator(lagtime=1, count_mode="sliding")
    return lambda: timed(lambda: estimator.fit(states).fetch_model(), len(states))

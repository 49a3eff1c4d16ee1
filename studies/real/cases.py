"""Episodes as decisions: one every fifth of a second, with what came after each."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from studies.datasets.episodes import Episode
from studies.real.targets import CREEPING, TARGETS, Coming, coming, onsets

#: Time between decisions [s].
INTERVAL = 0.2
#: How far is looked ahead [s].
HORIZONS = (1.0, 2.0, 5.0)
# Accelerations are taken over so many decisions: 0.4 s.
_SPAN = 2


def runs_in(folder: Path) -> list[Path]:
    """The files of a folder that hold a run each, in the order of their names.

    Lists of checksums and of segments in capital letters are no runs.

    Raises
    ------
    NotADirectoryError
        If there is no such folder.
    ValueError
        If there is no run in it.
    """
    if not folder.is_dir():
        raise NotADirectoryError(f"{folder}: there is no such folder")
    paths = sorted(
        path
        for path in folder.iterdir()
        if path.name.endswith((".csv", ".csv.gz")) and not path.name.split(".")[0].isupper()
    )
    if not paths:
        raise ValueError(f"{folder} holds no runs (*.csv, *.csv.gz)")
    return paths


class Question(NamedTuple):
    """An event, and how far is looked ahead."""

    target: str
    horizon: float  #: [s]


#: All that is asked.
QUESTIONS = tuple(Question(target.name, horizon) for target in TARGETS for horizon in HORIZONS)


class Case(NamedTuple):
    """An episode of one pair as T decisions."""

    run: str
    pair: str
    times: NDArray[np.float64]  #: (T,) [s]
    observations: NDArray[np.float64]  #: (T, 3) gap [m], both speeds [m/s]
    accelerations: NDArray[np.float64]  #: (T,) of the follower, as recorded [m/s²]
    answers: dict[Question, Coming]  #: of T decisions each; known only above `CREEPING`
    begins: dict[str, NDArray[np.float64]]  #: by target: times at which events begin [s]


def case_of(episode: Episode) -> Case:
    """Decisions of an episode; what came is looked up in all its rows.

    Raises
    ------
    ValueError
        If its rows do not fall on decisions.
    """
    stride = round(INTERVAL / episode.dt)
    if stride < 1 or abs(stride * episode.dt - INTERVAL) > 0.02 * INTERVAL:
        raise ValueError(
            f"{episode.run}, {episode.pair}: a row every {episode.dt:g} s cannot be read every "
            f"{INTERVAL:g} s; resample it"
        )
    chosen = slice(0, None, stride)
    moves = episode.observations[chosen, 1] > CREEPING
    answers, begins = {}, {}
    for target in TARGETS:
        happens = target.happens(episode)
        begins[target.name] = episode.times[onsets(happens)]
        for horizon in HORIZONS:
            came, known = coming(happens, round(horizon / episode.dt))
            answers[Question(target.name, horizon)] = Coming(came[chosen], known[chosen] & moves)
    return Case(
        episode.run,
        episode.pair,
        episode.times[chosen],
        episode.observations[chosen],
        episode.accelerations[chosen],
        answers,
        begins,
    )


def recent_acceleration(speed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean acceleration over the latest 0.4 s, from what was seen until then.

    Parameters
    ----------
    speed : (T,) ndarray
        [m/s], one a decision.

    Returns
    -------
    (T,) ndarray
        [m/s²]; 0 where too little was seen.

    Examples
    --------
    >>> recent_acceleration(np.array([10.0, 10.0, 9.0, 8.0]))
    array([ 0. ,  0. , -2.5, -5. ])
    """
    found = np.zeros(len(speed))
    found[_SPAN:] = (speed[_SPAN:] - speed[:-_SPAN]) / (_SPAN * INTERVAL)
    return found

"""What is forecast: families of scenarios, and logs of real drives split by run."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars
from numpy.typing import NDArray

from evofsm.driving import Draw, Family, KinematicWorld, held_out, load_family, training
from evofsm.fsm import IntervalActions
from evofsm.fsm.arrays import NO_ACTION
from evofsm.io import episodes_of, read_traces

#: Families that are driven.
FAMILIES = ("emergency", "stop_and_go", "cut_in", "rare")
#: The actions of real drives [m/s²]: those of the paper.
LOG_ACTIONS = IntervalActions(low=-2.5, high=2.5, width=0.3, outside="clip")


_VARIABLES = ("gap", "v_follower", "v_leader")
_ACTION = "a_follower"


class Pace(Enum):
    """How often something is observed, how far it is forecast, and how often [s]."""

    STEPS = (0.01, (0.01, 0.1), 0.25)
    DECISIONS = (0.25, (0.5, 1.0, 2.0, 5.0), 0.25)
    LOGS = (0.1, (0.1, 0.5, 1.0, 2.0, 5.0), 0.5)

    def __init__(self, dt: float, horizons: tuple[float, ...], every: float) -> None:
        self.dt = dt  #: from an observation to the next [s]
        self.horizons = horizons  #: [s]
        self.every = every  #: from a forecast that is judged to the next [s]

    def steps(self, seconds: float) -> int:
        """How many observations later that is."""
        return round(seconds / self.dt)


class Episode(NamedTuple):
    """T observations of one drive, evenly spaced."""

    observations: NDArray[np.float64]  #: (T, 3) gap [m], v_follower [m/s], v_leader [m/s]
    actions: NDArray[np.int64]  #: (T,) taken after each; -1 for none


class Source(NamedTuple):
    """Drives to learn from, and drives that nothing is learnt from."""

    name: str
    pace: Pace
    n_actions: int
    train: Sequence[Episode]
    test: Sequence[Episode]
    first: int = 0  #: number of the first test episode among those of all rounds


class LogSource(NamedTuple):
    """Files of one origin, each a run."""

    name: str
    files: tuple[str, ...]


def drive(name: str, pace: Pace, seed: int, learning_seed: int, train: int, test: int) -> Source:
    """Drive a family, unrevised.

    Parameters
    ----------
    name : str
        Of the family.
    pace : Pace
        `Pace.STEPS` observes every step, `Pace.DECISIONS` every 0.25 s.
    seed, learning_seed : int
        Training draws depend on both, held-out ones on the first.
    train, test : int
        Episodes.
    """
    family = load_family(name)
    drawn = training(family, seed, learning_seed, train), held_out(family, seed, test)
    learnt, judged = ([_driven(family, pace, draw) for draw in draws] for draws in drawn)
    return Source(name, pace, family.actions.n_actions, learnt, judged)


def _driven(family: Family, pace: Pace, draw: Draw) -> Episode:
    episode = KinematicWorld().run(draw.scenario, draw.controller)
    rows = slice(None, None, draw.scenario.steps(pace.dt))
    return Episode(
        np.ascontiguousarray(episode.observations[rows]),
        _encode(family.actions, episode.accelerations[rows]),
    )


def _encode(actions: IntervalActions, taken: NDArray[np.float64]) -> NDArray[np.int64]:
    indices = np.full(len(taken), NO_ACTION)
    known = np.isfinite(taken)
    indices[known] = actions.encode(taken[known])
    return indices


def log_sources(folder: Path) -> list[LogSource]:
    """The logs in a folder, by what stands before the first ``_`` of their names.

    Every file is taken as one run. Those that have not the columns ``gap``, ``v_follower``,
    ``v_leader``, ``a_follower`` and ``time`` are no logs; a single run cannot be split.

    Raises
    ------
    ValueError
        If there is nothing that could be split by run.
    """
    found = defaultdict(list)
    for path in sorted(folder.glob("*")):
        if path.name.endswith((".csv", ".csv.gz", ".parquet")) and _is_log(str(path)):
            found[path.name.partition("_")[0].partition(".")[0]].append(str(path))
    sources = [LogSource(name, tuple(files)) for name, files in found.items() if len(files) > 1]
    if not sources:
        raise ValueError(
            f"{folder} has no two logs of one origin, with columns time, {', '.join(_VARIABLES)} "
            f"and {_ACTION} (files of one origin are named alike up to the first _)"
        )
    return sources


def _is_log(path: str) -> bool:
    scan = polars.scan_parquet if path.endswith(".parquet") else polars.scan_csv
    return {"time", _ACTION, *_VARIABLES} <= set(scan(path).collect_schema())


def split_logs(source: LogSource, seed: int, part: int, parts: int) -> tuple[list[str], list[str]]:
    """Files to learn from, and those held out in one of several parts; each is held out once."""
    order = np.random.default_rng(seed).permutation(len(source.files))
    out = {int(k) for k in order[part::parts]}
    files = source.files
    return (
        [name for k, name in enumerate(files) if k not in out],
        [name for k, name in enumerate(files) if k in out],
    )


def read(source: LogSource, train: Iterable[str], test: Iterable[str], first: int = 0) -> Source:
    """Read runs to learn from and runs that are held out."""
    pace = Pace.LOGS
    learnt, judged = (
        [episode for name in names for episode in _read(name, pace)] for names in (train, test)
    )
    return Source(source.name, pace, LOG_ACTIONS.n_actions, learnt, judged, first)


def _read(path: str, pace: Pace) -> list[Episode]:
    """The episodes of a file."""
    found = []
    for whole in episodes_of(read_traces([path])):
        if not np.isclose(whole.dt, pace.dt):
            raise ValueError(f"{path} has a row every {whole.dt:g} s; {pace.dt:g} s are needed")
        found.append(Episode(whole.observations, _encode(LOG_ACTIONS, whole.actions)))
    return found

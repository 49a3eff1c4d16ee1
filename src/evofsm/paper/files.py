"""The study as data: what the page shows, for whoever wants to compute with it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from evofsm.cli import Table
from evofsm.extras import needs
from evofsm.paper.claims import Claim
from evofsm.paper.runs import PaperStudy, Run


def write_data(
    study: PaperStudy, claims: Iterable[Claim], context: Iterable[Table], folder: Path
) -> None:
    """Write ``claims.json``, ``context.json``, ``traces.parquet`` and ``model.evofsm``."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, entries in (("claims", claims), ("context", context)):
        text = json.dumps([asdict(entry) for entry in entries], indent=2, ensure_ascii=False)
        (folder / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    study.model.save(folder / "model.evofsm")
    with needs("polars", "tables", "writing traces as Parquet"):
        import polars
    runs = [*study.runs, *study.extra_runs]
    frames = (polars.DataFrame(_columns(number, run)) for number, run in enumerate(runs, 1))
    # polars takes other paths for addresses on the network, or of somebody's home.
    polars.concat(frames).write_parquet(folder.absolute() / "traces.parquet")


def _columns(number: int, run: Run) -> dict[str, Any]:
    """A run's rows; states and actions are indices, from 0."""
    episode = run.episode
    rows = len(episode.time)
    gap, v_follower, v_leader = episode.observations.T
    return {
        "run": np.full(rows, number),
        "name": [run.name] * rows,
        "round": np.full(rows, run.round),
        "time": episode.time,
        "gap": gap,
        "v_follower": v_follower,
        "v_leader": v_leader,
        "a_follower": episode.accelerations,
        "a_follower_realised": episode.realised,
        "a_leader": episode.leader_accelerations,
        "action": run.action,
        "state": run.state,
        "n_states": run.n_states,
        "surprise": run.surprise,
    }

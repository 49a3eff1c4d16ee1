"""Numbers that stand beside the claims, without a verdict: what an expert would ask next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evofsm.divergence import jensen_shannon
from evofsm.risk.dead_end import is_dead_end
from evofsm.risk.ttc import time_to_collision
from evofsm.studies.paper.claims import LARGEST_DIVERGENCE
from evofsm.studies.paper.runs import CASES, PaperStudy, Run
from evofsm.worlds.episode import UNITS, VARIABLES


@dataclass(frozen=True)
class Table:
    """Numbers that stand beside the claims, without a verdict."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


def context_tables(study: PaperStudy) -> tuple[Table, ...]:
    """Forecasts against simple ones, states against an oracle, and how early they warn."""
    tables = [_table_of_forecasts(study), _table_of_states(study)]
    if study.dead_end >= 0:
        tables.append(_table_of_lead_times(study))
    return tuple(tables)


def _table_of_forecasts(study: PaperStudy) -> Table:
    """What simple forecasts reach in the paper's own test."""
    constant = np.concatenate([run.belief for run in study.last_round]).mean(axis=0)
    uniform = np.full(study.model.n_states, 1.0 / study.model.n_states)
    forecasts: dict[str, Callable[[Run], NDArray[np.float64]]] = {
        "e-FSM": lambda run: run.surprise[1:],
        "persistence: the state stays as it is": lambda run: np.asarray(
            jensen_shannon(run.belief[:-1], run.belief[1:])
        ),
        "constant: the mean belief of these runs": lambda run: np.asarray(
            jensen_shannon(constant, run.belief[1:])
        ),
        "uniform": lambda run: np.asarray(jensen_shannon(uniform, run.belief[1:])),
    }
    rows, passing = [], []
    for name, divergence in forecasts.items():
        by_run = [divergence(run) for run in study.last_round]
        rows.append((name, *(f"{values.max():.3f} ({values.mean():.1e})" for values in by_run)))
        if max(values.max() for values in by_run) < LARGEST_DIVERGENCE:
            passing.append(name.split(":")[0])
    everywhere = [
        max(float(np.nanmax(run.surprise)) for run in study.runs if run.case == case)
        for case in CASES
    ]
    rows.append(("e-FSM, all rounds", *(f"{value:.3f}" for value in everywhere)))
    first = [run.first_surprise for run in study.last_round]
    rows.append(("e-FSM, a run's first forecast", *(f"{value:.3f}" for value in first)))
    return Table(
        "Divergence of one-step forecasts [bit], largest (mean) in the last round",
        ("forecast", *(f"case {case}" for case in CASES)),
        tuple(rows),
        f"Below {LARGEST_DIVERGENCE} bit in all cases, as the paper asks: {', '.join(passing)}. "
        f"With {study.settings.scenario.dt:g} s from step to step so little changes that this "
        "test says little about the transitions.",
    )


def _table_of_states(study: PaperStudy) -> Table:
    """Where the states lie, and for how much of their time an oracle sees a dead end."""
    model, settings = study.model, study.settings
    state = np.concatenate([run.state for run in study.runs])
    observations = np.concatenate([run.episode.observations for run in study.runs])
    hopeless = is_dead_end(observations, settings.decel, settings.scenario.leader.brake_decel)
    ends = np.cumsum([len(run.state) for run in study.runs])
    rows = []
    for i, center in enumerate(model.centers):
        row = int(model.founded[i]) - 1
        run = int(np.searchsorted(ends, row, side="right"))
        time = study.runs[run].episode.time[row - (ends[run] - len(study.runs[run].state))]
        here = state == i
        rows.append(
            (
                f"#{i + 1}",
                *(f"{value:.1f}" for value in center),
                f"run {run + 1}, {time:.1f} s",
                f"{100 * here.mean():.1f} %",
                f"{100 * hopeless[here].mean():.0f} %" if here.any() else "-",
                str(sum(run.episode.collided and run.state[-1] == i for run in study.runs)),
            )
        )
    names = (f"{name} [{unit}]" for name, unit in zip(VARIABLES, UNITS, strict=True))
    return Table(
        "States",
        ("state", *names, "founded", "share of time", "dead end by oracle", "collisions"),
        tuple(rows),
        f"By the oracle a situation is a dead end if the leader brakes with "
        f"{settings.scenario.leader.brake_decel:g} m/s² now, the follower with "
        f"{settings.decel:g} m/s², and they still collide.",
    )


def _table_of_lead_times(study: PaperStudy) -> Table:
    """When the dead end was first recognised, and what time to collision said then."""
    rows = []
    for run in (*study.last_round, *study.extra_runs):
        recognised = np.flatnonzero(run.state == study.dead_end)
        if not run.episode.collided or not len(recognised):
            continue
        row = recognised[0]
        time, end = run.episode.time[row], run.episode.time[-1]
        ttc = time_to_collision(run.episode.observations)
        rows.append(
            (
                run.name,
                f"{end:.1f} s",
                f"{time:.1f} s",
                f"{end - time:.1f} s",
                "infinite" if np.isinf(ttc[row]) else f"{ttc[row]:.1f} s",
                f"{end - run.episode.time[_lasting(ttc < 1.5)]:.1f} s",
            )
        )
    return Table(
        f"How early #{study.dead_end + 1} is recognised, in the last round and the extra runs",
        ("run", "collision", "first recognised", "before it", "TTC then", "TTC < 1.5 s for"),
        tuple(rows),
        "First recognised is not yet an alarm: a run may leave the state and come back. "
        "Time to collision (TTC) below 1.5 s is a usual alarm; the last column is the time it "
        "leaves before the collision.",
    )


def _lasting(alarm: NDArray[np.bool_]) -> int:
    """First row of the alarm that is still on at the end."""
    off = np.flatnonzero(~alarm)
    return min(int(off[-1]) + 1, len(alarm) - 1) if len(off) else 0

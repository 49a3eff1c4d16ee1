"""Numbers that stand beside the claims, without a verdict: what an expert would ask next."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evofsm.app import Table
from evofsm.core import jensen_shannon
from evofsm.driving import UNITS, VARIABLES, is_dead_end, time_to_collision
from evofsm.evidence.paper.claims import LARGEST_DIVERGENCE
from evofsm.evidence.paper.runs import CASES, PaperStudy, Run


def context_tables(study: PaperStudy) -> tuple[Table, ...]:
    """Forecasts against simple ones, states against an oracle, and how early they warn."""
    tables = [_table_of_forecasts(study), _table_of_states(study)]
    if study.dead_end >= 0:
        tables.append(_table_of_lead_times(study))
    return tuple(tables)


#: Whose forecasts are judged beside the simple ones.
OURS = "e-FSM"


def divergences(study: PaperStudy) -> dict[str, list[NDArray[np.float64]]]:
    """Of every forecast of the last round [bit], by case: ours, and what simple ones reach."""
    beliefs = np.concatenate([run.belief for run in study.last_round])
    constant = beliefs.mean(axis=0)
    uniform = np.full_like(constant, 1.0 / len(constant))
    return {
        OURS: [run.surprise[1:] for run in study.last_round],
        "persistence": [_divergence(run, run.belief[:-1]) for run in study.last_round],
        "constant": [_divergence(run, constant) for run in study.last_round],
        "uniform": [_divergence(run, uniform) for run in study.last_round],
    }


def _table_of_forecasts(study: PaperStudy) -> Table:
    """What simple forecasts reach in the paper's own test."""
    beliefs = np.concatenate([run.belief for run in study.last_round])
    last_round = divergences(study)
    passing = [
        name
        for name, by_case in last_round.items()
        if max(values.max() for values in by_case) < LARGEST_DIVERGENCE
    ]
    of_first = [np.array([run.first_surprise]) for run in study.last_round]
    of_all = [
        np.concatenate([run.surprise[1:] for run in study.runs if run.case == case])
        for case in CASES
    ]
    rows = {**last_round, "e-FSM, a run's first": of_first, "e-FSM, all rounds": of_all}
    return Table(
        "Largest divergence of one-step forecasts [bit], by case, and the mean",
        ("forecast", *(f"case {case}" for case in CASES), "mean"),
        tuple(
            (
                name,
                *(f"{values.max():.3f}" for values in by_case),
                f"{np.concatenate(by_case).mean():.1e}",
            )
            for name, by_case in rows.items()
        ),
        "In the last round, save where the row says all. Persistence: the belief stays as it is. "
        "Constant: the mean belief of these runs. Below the paper's bound in all cases: "
        f"{', '.join(passing)}. With {study.settings.scenario.dt:g} s from step to step so "
        "little changes that this test says little about the transitions. Beliefs are wide: the "
        f"most probable state has {beliefs.max(axis=1).mean():.0%} on average, where a blind "
        f"guess has {1.0 / beliefs.shape[1]:.0%}, so the rows of a matrix come out much alike.",
    )


def _divergence(run: Run, forecast: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of a forecast of every belief but the first [bit]."""
    return np.asarray(jensen_shannon(forecast, run.belief[1:]))


def _table_of_states(study: PaperStudy) -> Table:
    """Where the states lie, and for how much of their time an oracle sees a dead end."""
    settings = study.settings
    leader_decel = settings.scenario.leader.brake_decel
    state = np.concatenate([run.state for run in study.runs])
    observations = np.concatenate([run.episode.observations for run in study.runs])
    hopeless = is_dead_end(observations, settings.decel, leader_decel)
    rows = []
    for founding in study.foundings:
        i = founding.state
        here = state == i
        rows.append(
            (
                f"#{i + 1}",
                *(f"{value:.1f}" for value in study.model.centers[i]),
                f"{founding.run + 1}: {founding.time:.1f} s",
                f"{100 * here.mean():.1f} %",
                f"{100 * hopeless[here].mean():.0f} %" if here.any() else "-",
                str(sum(run.episode.collided and run.state[-1] == i for run in study.runs)),
            )
        )
    names = (f"{name} [{unit}]" for name, unit in zip(VARIABLES, UNITS, strict=True))
    return Table(
        "States",
        ("state", *names, "founded", "time", "dead end", "collisions"),
        tuple(rows),
        "Founded: in which run, and when in it. Time: share of all. Collisions: of the "
        f"{len(study.runs)} runs. Dead end: share of the state's "
        f"time in which, by an oracle, the cars would collide if the leader braked with "
        f"{leader_decel:g} m/s² now and the follower with {settings.decel:g} m/s².",
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
        ("run", "collision", "recognised", "before it", "TTC then", "TTC < 1.5 s"),
        tuple(rows),
        "Recognised: for the first time, which is not yet an alarm: a run may leave the state and "
        "come back. TTC: time to collision, in seconds; below 1.5 s is a usual alarm, and the last "
        "column is the time that it leaves.",
    )


def _lasting(alarm: NDArray[np.bool_]) -> int:
    """First row of the alarm that is still on at the end."""
    off = np.flatnonzero(~alarm)
    return min(int(off[-1]) + 1, len(alarm) - 1) if len(off) else 0

"""The paper's study as a chapter: every claim beside what was measured, and all that was set."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.cli import Column, Table, decimals
from evofsm.driving import IDM, UNITS, VARIABLES, ChangingIDM
from evofsm.driving.measures import is_dead_end, time_to_collision
from evofsm.fsm import jensen_shannon
from evofsm.paper.claims import LARGEST_DIVERGENCE, Claim, check_claims
from evofsm.paper.figures import sketches
from evofsm.paper.report.chapter import Chapter, Section, Source
from evofsm.paper.report.html import Setting
from evofsm.paper.runs import CASES, Founding, PaperStudy, Run
from evofsm.paper.settings import Settings
from evofsm.plot import label_of

_WORLDS = {"sumo": "SUMO", "kinematic": "the kinematic world"}
_PAPER = Source(
    "T. Han, D. Filev, Ü. Özgüner: An online evolving framework for modeling the safe autonomous "
    "vehicle control system via online recognition of latent risks, 2019",
    "arXiv:1908.10823",
    "https://arxiv.org/abs/1908.10823",
)
# The machine's forecasts, beside the simple ones.
_OURS = "e-FSM"
_IN_WORDS = {
    "persistence": "Persistence",
    "constant": "A constant",
    "uniform": "The uniform distribution",
}
# Time to collision below which an alarm is usual [s].
_ALARM = 1.5


def paper_chapter(study: PaperStudy, claims: Sequence[Claim] | None = None) -> Chapter:
    """Hold every claim of the paper against the study.

    Parameters
    ----------
    study : PaperStudy
    claims : sequence of Claim, optional
        Where they were judged already.
    """
    claims = check_claims(study) if claims is None else claims
    fails = [claim for claim in claims if not claim.holds]
    world = _WORLDS.get(study.world, study.world)
    first, *others = sketches(study)
    return Chapter(
        id="paper",
        title="Does the paper's machine do what the paper says?",
        about="An evolving finite state machine (e-FSM) watches a system act and finds its states "
        "by itself: dense observations create states, each new observation is recognised as a "
        "distribution over them, and for every action a matrix of transition probabilities is "
        "learnt, step by step. Among the states there may be a dead end, the one in which "
        "collisions come if the leader brakes hard: recognised early, it is a warning. This is the "
        f"car-following experiment of the paper once more, {len(study.runs)} runs of four cases in "
        f"{world}, with each claim of its Section 3 beside what was measured. States are numbered "
        "from #1 in the order of creation, actions from a(1) by their intervals; a claim is tested "
        "on all runs unless it says otherwise.",
        headline=f"{len(claims) - len(fails)} of {len(claims)} claims of the paper hold in {world}",
        answer=(f"{study.model.n_states} states were created in {len(study.runs)} runs.",),
        fails=tuple(f"{one.claim}: {one.measured} (paper: {one.paper})" for one in fails),
        losses=tuple(losses(study)),
        tables=(_table_of_claims(claims), *context_tables(study)),
        sketches=(first,),
        sections=(
            Section("figures", "More figures", sketches=tuple(others)),
            Section(
                "settings",
                "Settings",
                "The paper leaves some settings open; those were recovered by search, and "
                "evofsm/paper/settings.toml marks which.",
                tuple(_tables_of_settings(study.settings)),
            ),
        ),
        plan=(
            Setting("runs", f"{len(study.runs)}, and {len(study.extra_runs)} extra ones"),
            Setting("world", world),
        ),
        packages=("libsumo",) if study.world == "sumo" else (),
        sources=(_PAPER,),
    )


def _table_of_claims(claims: Sequence[Claim]) -> Table:
    columns = (
        *(Column[Claim](name, name) for name in ("claim", "paper", "measured")),
        Column[Claim]("verdict", lambda one: "holds" if one.holds else "fails"),
    )
    return Table.of("Claims", columns, claims, in_words=True, failing=lambda one: not one.holds)


# -- Beside the claims, without a verdict: what an expert would ask next --------------------------


def context_tables(study: PaperStudy) -> tuple[Table, ...]:
    """Forecasts against simple ones, states against an oracle, and how early they warn."""
    late = (_table_of_lead_times(study),) if study.dead_ends else ()
    return _table_of_forecasts(study), _table_of_states(study), *late


def divergences(study: PaperStudy) -> dict[str, list[NDArray[np.float64]]]:
    """Of every forecast of the last round [bit], by case: ours, and what simple ones reach."""
    beliefs = np.concatenate([run.belief for run in study.last_round])
    constant = beliefs.mean(axis=0)
    uniform = np.full_like(constant, 1.0 / len(constant))
    forecasts = {
        "persistence": [run.belief[:-1] for run in study.last_round],
        "constant": [constant] * len(CASES),
        "uniform": [uniform] * len(CASES),
    }
    found = {_OURS: [run.surprise[1:] for run in study.last_round]}
    for who, said in forecasts.items():
        pairs = zip(said, study.last_round, strict=True)
        found[who] = [np.asarray(jensen_shannon(one, run.belief[1:])) for one, run in pairs]
    return found


def losses(study: PaperStudy) -> Iterator[str]:
    """Every simple forecast that comes closer than the machine's, with the numbers."""
    found = {
        who: {
            **{f"in case {k}": float(one.max()) for k, one in zip(CASES, by_case, strict=True)},
            "on average": float(np.concatenate(by_case).mean()),
        }
        for who, by_case in divergences(study).items()
    }
    mine = found.pop(_OURS)
    for who, theirs in found.items():
        better = [where for where, value in theirs.items() if value < mine[where]]
        if better:
            cases = "; ".join(f"{w} {theirs[w]:.1e} against {mine[w]:.1e} bit" for w in better)
            yield (
                f"{_IN_WORDS[who]} is the better forecast of the next belief (largest "
                f"divergence in a case of the last round, or mean of all): {cases}."
            )


def _table_of_forecasts(study: PaperStudy) -> Table:
    """What simple forecasts reach in the paper's own test."""
    beliefs = np.concatenate([run.belief for run in study.last_round])
    last_round = divergences(study)
    passing = [
        who
        for who, by_case in last_round.items()
        if max(values.max() for values in by_case) < LARGEST_DIVERGENCE
    ]
    of_all = [
        np.concatenate([run.surprise[1:] for run in study.runs if run.case == case])
        for case in CASES
    ]
    rows = {
        **last_round,
        f"{_OURS}, a run's first": [np.array([run.first_surprise]) for run in study.last_round],
        f"{_OURS}, all rounds": of_all,
    }
    return Table(
        "Largest divergence of one-step forecasts [bit], by case, and the mean",
        ("forecast", *(f"case {case}" for case in CASES), "mean"),
        tuple(
            (
                who,
                *(f"{values.max():.3f}" for values in by_case),
                f"{np.concatenate(by_case).mean():.1e}",
            )
            for who, by_case in rows.items()
        ),
        "In the last round, save where the row says all. Persistence: the belief stays as it is. "
        "Constant: the mean belief of these runs. Below the paper's bound in all cases: "
        f"{', '.join(passing)}. With {study.settings.scenario.dt:g} s from step to step so "
        "little changes that this test says little about the transitions. Beliefs are wide: the "
        f"most probable state has {beliefs.max(axis=1).mean():.0%} on average, where a blind "
        f"guess has {1.0 / beliefs.shape[1]:.0%}, so the rows of a matrix come out much alike.",
    )


def _table_of_states(study: PaperStudy) -> Table:
    """Where the states lie, and for how much of their time an oracle sees a dead end."""
    settings, centers = study.settings, study.model.centers
    leader_decel = settings.scenario.leader.brake_decel
    state = np.concatenate([run.state for run in study.runs])
    observations = np.concatenate([run.episode.observations for run in study.runs])
    hopeless = is_dead_end(observations, settings.decel, leader_decel)
    ends = [run.state[-1] for run in study.runs if run.episode.collided]

    def coordinate(j: int) -> Callable[[Founding], float]:
        return lambda one: float(centers[one.state, j])

    def dead_end_share(one: Founding) -> str:
        here = state == one.state
        return f"{100 * hopeless[here].mean():.0f} %" if here.any() else "-"

    columns: list[Column[Founding]] = [
        Column("state", "state", label_of),
        *(
            Column(name, coordinate(j), decimals(1), unit)
            for j, (name, unit) in enumerate(zip(VARIABLES, UNITS, strict=True))
        ),
        Column("created", lambda one: f"{one.run + 1}: {one.time:.1f} s"),
        Column("time", lambda one: f"{100 * (state == one.state).mean():.1f} %"),
        Column("dead end", dead_end_share),
        Column("collisions", lambda one: ends.count(one.state)),
    ]
    return Table.of(
        "States",
        columns,
        study.foundings,
        "Created: in which run, and when in it. Time: share of all. Collisions: of the "
        f"{len(study.runs)} runs. Dead end: share of the state's "
        f"time in which, by an oracle, the cars would collide if the leader braked with "
        f"{leader_decel:g} m/s² now and the follower with {settings.decel:g} m/s².",
    )


def _table_of_lead_times(study: PaperStudy) -> Table:
    """When the dead end was first recognised, and what time to collision said then."""

    def cells(run: Run) -> tuple[str, ...]:
        row = int(np.argmax(run.state == study.dead_end))
        time, end = run.episode.time[row], run.episode.time[-1]
        ttc = time_to_collision(run.episode.observations)
        off = np.flatnonzero(ttc >= _ALARM)
        lasting = min(int(off[-1]) + 1, len(ttc) - 1) if len(off) else 0
        then = "infinite" if np.isinf(ttc[row]) else f"{ttc[row]:.1f} s"
        spans = (end, time, end - time)
        warned = end - run.episode.time[lasting]
        return run.name, *(f"{span:.1f} s" for span in spans), then, f"{warned:.1f} s"

    runs = (*study.last_round, *study.extra_runs)
    found = [run for run in runs if run.episode.collided and study.dead_end in run.state]
    return Table(
        f"How early {label_of(study.dead_end)} is recognised, in the last round and the extra runs",
        ("run", "collision", "recognised", "before it", "TTC then", f"TTC < {_ALARM:g} s"),
        tuple(map(cells, found)),
        "Recognised: for the first time, which is not yet an alarm: a run may leave the state and "
        "come back. TTC: time to collision, in seconds; below 1.5 s is a usual alarm, and the last "
        "column is the time that it leaves.",
    )


# -- Settings -------------------------------------------------------------------------------------

# The paper's signs.
_SIGNS = {
    "radius": "ε",
    "distance_weight": "ρ",
    "learning_rate": "φ",
    "prior_frequency": "ε̄",
}


def _tables_of_settings(settings: Settings) -> Iterator[Table]:
    """What was set, in groups."""
    scenario, actions, machine = settings.scenario, settings.actions, settings.machine
    leader = scenario.leader
    brakes = ", ".join(f"{time:g} s" for time in settings.brake_at)
    groups = {
        "Scenario": {
            "initial gap, both at rest": f"{scenario.initial_gap:g} m",
            "duration": f"{scenario.duration:g} s in steps of {scenario.dt:g} s",
            "leader's full brake": f"{leader.brake_decel:g} m/s² on reaching "
            f"{leader.brake_speed:g} m/s",
            "extra runs of case 1: brake at": brakes or "none",
            "cases 2 and 3 run on to": f"{settings.safe_until:g} s",
        },
        "Machine": {
            **{
                f"{name.replace('_', ' ')} {_SIGNS.get(name, '')}".strip(): f"{value:g}"
                for name, value in machine.items()
            },
            "actions": f"{actions.n_actions} intervals of {actions.width:g} m/s² from "
            f"{actions.low:g} to {actions.high:g} m/s²".replace("-", "−"),
        },
    }
    for title, rows in groups.items():
        yield Table(title, ("setting", "value"), tuple(rows.items()), in_words=True)
    columns: list[Column[_Phase]] = [
        Column("driver", "name"),
        *(
            Column(name.replace("_", " "), f"driver.{name}", _plain, unit)
            for name, unit in _DRIVER.items()
        ),
        Column("bounds", "driver", _bounds, "m/s²"),
    ]
    drivers = [_Phase("leader", leader.driver)]
    for case, driver in settings.drivers.items():
        drivers += _phases(f"case {case}", driver)
    yield Table.of("Drivers (Intelligent Driver Model)", columns, drivers)


# What makes a driver, and its units.
_DRIVER = {
    "accel": "m/s²",
    "desired_speed": "m/s",
    "min_gap": "m",
    "time_headway": "s",
    "decel": "m/s²",
    "exponent": "",
}


def _plain(value: float) -> str:
    return f"{value:g}"


class _Phase(NamedTuple):
    """One way in which somebody drives."""

    name: str
    driver: IDM


def _phases(name: str, driver: IDM | ChangingIDM) -> list[_Phase]:
    if isinstance(driver, IDM):
        return [_Phase(name, driver)]
    changes = [_Phase(f"{name} from {at:g} s", phase) for at, phase in driver.changes]
    return [_Phase(f"{name} at first", driver.first), *changes]


def _bounds(driver: IDM) -> str:
    if math.isinf(driver.lowest) and math.isinf(driver.highest):
        return "none"
    return f"{driver.lowest:g} to {driver.highest:g}".replace("-", "−").replace("inf", "∞")

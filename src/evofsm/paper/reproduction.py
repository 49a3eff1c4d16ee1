"""The paper's study: drive its runs, hold every claim against them, and write what came out."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from evofsm.driving.measures import time_to_collision
from evofsm.driving.naming import UNITS, VARIABLES
from evofsm.driving.sumo import open_world
from evofsm.fsm.divergence import jensen_shannon
from evofsm.paper.claims import LARGEST_DIVERGENCE, Claim, check_claims
from evofsm.paper.figures import figures
from evofsm.paper.page import Page, Table, write_page
from evofsm.paper.runs import CASES, PaperStudy, Run, Settings, run_paper

_ABOUT = """Does the paper's machine do what the paper says?

An evolving finite state machine (e-FSM) watches a system act and finds its states by itself: dense
observations create states, each new observation is recognised as a distribution over them, and for
every action a matrix of transition probabilities is learnt, step by step. Among the states there
may be a dead end, the one in which collisions come if the leader brakes hard: recognised early, it
is a warning.

This is the car-following experiment of the paper once more, with each claim of its Section 3 beside
what was measured. States are numbered from #1 in the order of creation, actions from a(1) by their
intervals; a claim is tested on all runs unless it says otherwise."""
_WORLDS = {"sumo": "SUMO", "kinematic": "the kinematic world"}
_SOURCE = (
    "T. Han, D. Filev, Ü. Özgüner: An online evolving framework for modeling the safe autonomous "
    "vehicle control system via online recognition of latent risks, 2019, arXiv:1908.10823"
)
# The machine's forecasts, beside the simple ones.
_OURS = "e-FSM"
# Time to collision below which an alarm is usual [s].
_ALARM = 1.5


@dataclass(frozen=True)
class Reproduction:
    """The runs, and every claim held against them."""

    study: PaperStudy
    claims: tuple[Claim, ...]

    @property
    def holds(self) -> bool:
        """Whether all claims hold."""
        return all(claim.holds for claim in self.claims)

    def page(self, command: str = "evofsm paper") -> Page:
        """Every claim beside what was measured, and what an expert would ask next."""
        study = self.study
        world = _WORLDS.get(study.world, study.world)
        n_holds = sum(claim.holds for claim in self.claims)
        first, *rest = figures(study)
        return Page(
            name="paper",
            about=_ABOUT,
            parts=[first, *_tables(study), *rest, _table_of_settings(study.settings)],
            command=command,
            lost=[_table_of_losses(study)],
            targets=pl.DataFrame(self.claims).select("claim", "paper", "measured", "holds"),
            facts={
                "world": world,
                "runs": f"{len(study.runs)}: the four cases, round by round",
                "extra runs": f"{len(study.extra_runs)}: case 1, but the leader brakes in full at "
                f"{' or '.join(map('{:g} s'.format, study.settings.brake_at))}, where the dead end "
                "is recognised, to see whether a collision follows, as in the paper",
            },
            packages=("libsumo",) if study.world == "sumo" else (),
            sources={_SOURCE: "https://arxiv.org/abs/1908.10823"},
            verdict=f"{n_holds} of {len(self.claims)} claims of the paper hold in {world}",
        )

    def write(self, folder: Path, command: str = "evofsm paper") -> Path:
        """Write page, figures, ``claims.json``, ``traces.parquet`` and ``model.evofsm``."""
        folder.mkdir(parents=True, exist_ok=True)
        claims = [claim._asdict() for claim in self.claims]
        text = json.dumps(claims, indent=2, ensure_ascii=False)
        (folder / "claims.json").write_text(f"{text}\n", encoding="utf-8")
        self.study.model.save(folder / "model.evofsm")
        runs = enumerate([*self.study.runs, *self.study.extra_runs], 1)
        # polars takes relative paths for addresses on the network, or of somebody's home.
        pl.concat(_trace(number, run) for number, run in runs).write_parquet(
            folder.absolute() / "traces.parquet"
        )
        return write_page(folder / "index.html", [self.page(command)])


def reproduce(
    world: str = "sumo",
    rounds: int = 20,
    settings: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Reproduction:
    """Drive the four cases of the paper, round by round, and hold every claim against the runs."""
    run_settings = Settings.load(settings)
    with open_world(world) as place:
        study = run_paper(place, world, run_settings, rounds, progress)
    return Reproduction(study, check_claims(study))


def _trace(number: int, run: Run) -> pl.DataFrame:
    """A run's rows; states and actions are indices, from 0."""
    episode = run.episode
    return pl.DataFrame(
        {
            "run": np.full(len(episode.time), number),
            "name": [run.name] * len(episode.time),
            "round": np.full(len(episode.time), run.round),
            "time": episode.time,
            **dict(zip(VARIABLES, episode.observations.T, strict=True)),
            "a_follower": episode.accelerations,
            "a_follower_realised": episode.realised,
            "a_leader": episode.leader_accelerations,
            "action": run.action,
            "state": run.state,
            "n_states": run.n_states,
            "surprise": run.surprise,
        }
    )


# -- Beside the claims: what an expert would ask next ---------------------------------------------


def _tables(study: PaperStudy) -> Iterator[Table]:
    forecasts = divergences(study)
    yield Table(
        "Largest divergence of one-step forecasts [bit], by case, and the mean",
        forecasts,
        {
            "forecast": "{forecast}",
            **{f"case {case}": f"{{case {case}:.3f}}" for case in CASES},
            "mean": "{mean:.3f}",
        },
        "In the last round, save where the row says all. Persistence: the belief stays as it is. "
        f"Constant: the mean belief of these runs. The paper's bound is {LARGEST_DIVERGENCE:g} "
        "bit; in a step so little changes that this test says little about the transitions.",
    )
    yield _table_of_states(study)
    if study.dead_ends:
        yield _table_of_lead_times(study)


def divergences(study: PaperStudy) -> pl.DataFrame:
    """Largest divergence of forecasts by case, and the mean [bit]: ours, and simple ones."""
    beliefs = np.concatenate([run.belief for run in study.last_round])
    constant = beliefs.mean(axis=0)
    uniform = np.full_like(constant, 1.0 / len(constant))
    simple = {
        "persistence": [run.belief[:-1] for run in study.last_round],
        "constant": [constant] * len(CASES),
        "uniform": [uniform] * len(CASES),
    }
    series = {_OURS: [run.surprise[1:] for run in study.last_round]}
    for name, forecasts in simple.items():
        pairs = zip(forecasts, study.last_round, strict=True)
        series[name] = [np.asarray(jensen_shannon(row, run.belief[1:])) for row, run in pairs]
    series[f"{_OURS}, a run's first"] = [np.array([run.first_surprise]) for run in study.last_round]
    series[f"{_OURS}, all rounds"] = [
        np.concatenate([run.surprise[1:] for run in study.runs if run.case == case])
        for case in CASES
    ]
    return pl.DataFrame(
        {
            "forecast": name,
            **{f"case {case}": float(v.max()) for case, v in zip(CASES, by_case, strict=True)},
            "mean": float(np.concatenate(by_case).mean()),
        }
        for name, by_case in series.items()
    )


def _table_of_losses(study: PaperStudy) -> Table:
    frame = divergences(study).unpivot(index="forecast", variable_name="where")
    machine = frame.filter(forecast=_OURS).select("where", ours="value")
    better = frame.filter(~pl.col("forecast").str.starts_with(_OURS)).join(machine, on="where")
    return Table(
        "Simple forecasts of the next belief that are better than the machine's",
        better.filter(pl.col("value") < pl.col("ours")),
        {
            "forecast": "{forecast}",
            "where": "{where}",
            "divergence [bit]": "{value:.3f}",
            "e-FSM": "{ours:.3f}",
        },
        "The largest divergence in a case of the last round, or the mean of all.",
    )


def _table_of_states(study: PaperStudy) -> Table:
    states = np.concatenate([run.state for run in study.runs])
    hopeless = np.concatenate([study.in_dead_end(run) for run in study.runs])
    ends = [run.state[-1] for run in study.runs if run.episode.collided]
    rows = []
    for state, center in enumerate(study.model.centers.tolist()):
        here = states == state
        share = float(hopeless[here].mean()) if here.any() else None
        row = {"state": state + 1, **dict(zip(VARIABLES, center, strict=True))}
        row |= {"share": float(here.mean()), "dead end": share, "collisions": ends.count(state)}
        rows.append(row)
    centers = zip(VARIABLES, UNITS, strict=True)
    return Table(
        "States",
        pl.DataFrame(rows),
        {
            "state": "#{state}",
            **{f"{name} [{unit}]": f"{{{name}:.1f}}" for name, unit in centers},
            "time": "{share:%}",
            "dead end": "{dead end:%}",
            "collisions": "{collisions}",
        },
        "Time: share of all. Dead end: share of the state's time in which, by an oracle, the cars "
        "would collide if both braked as hard as they can.",
    )


def _table_of_lead_times(study: PaperStudy) -> Table:
    """When the dead end was first recognised, and what time to collision said then."""
    rows = []
    for run in (*study.last_round, *study.extra_runs):
        if not (run.episode.collided and study.dead_end in run.state):
            continue
        row = int(np.argmax(run.state == study.dead_end))
        time, end = run.episode.time[row], run.episode.time[-1]
        ttc = time_to_collision(run.episode.observations)
        off = np.flatnonzero(ttc >= _ALARM)
        alarm_row = min(int(off[-1]) + 1, len(ttc) - 1) if len(off) else 0
        alarm_lead_time = end - run.episode.time[alarm_row]
        name = run.name if run.round else f"extra: case {run.case}, {run.name}"
        rows.append((name, end, time, end - time, ttc[row], alarm_lead_time))
    names = ("run", "collision", "recognised", "before it", "TTC then", f"TTC < {_ALARM:g} s")
    return Table(
        f"How early #{study.dead_end + 1} is recognised, in the last round and the extra runs [s]",
        pl.DataFrame(rows, schema=list(names), orient="row"),
        {"run": "{run}", **{name: f"{{{name}:.1f}}" for name in names[1:]}},
        "Recognised: for the first time, which is not yet an alarm: a run may leave the state and "
        "come back. TTC: time to collision; the last column is the time that a usual alarm leaves.",
    )


def _table_of_settings(settings: Settings) -> Table:
    """What was set, as it stands in ``settings.toml``."""
    rows = [
        {"table": table, "settings": ", ".join(f"{name} {value}" for name, value in fields.items())}
        for table, fields in settings.tables.items()
    ]
    return Table(
        "Settings",
        pl.DataFrame(rows),
        note="The paper leaves some settings open; those were recovered by search, and "
        "evofsm/paper/settings.toml marks which, with units.",
    )

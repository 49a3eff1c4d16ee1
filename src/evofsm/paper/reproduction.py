"""The page on the paper's study: every claim held against the runs, and what came out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl

from evofsm.fsm.divergence import jensen_shannon
from evofsm.paper.claims import LARGEST_DIVERGENCE, check_claims
from evofsm.paper.figures import figures
from evofsm.paper.page import Page, Table, write_page
from evofsm.paper.runs import CASES, PaperStudy

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


def page_of(study: PaperStudy, command: str = "evofsm paper") -> Page:
    """Every claim beside what was measured, and what an expert would ask next."""
    claims, world = check_claims(study), _WORLDS[study.world]
    n_holds = sum(claim.holds for claim in claims)
    first, *rest = figures(study)
    forecasts = divergences(study)
    return Page(
        name="paper",
        about=_ABOUT,
        parts=[first, _table_of_forecasts(forecasts), *rest],
        command=command,
        lost=[_table_of_losses(forecasts)],
        targets=pl.DataFrame(claims).select("claim", "paper", "measured", "holds"),
        facts={
            "world": world,
            "runs": f"{len(study.runs)}: the four cases, round by round",
            "extra runs": f"{len(study.extra_runs)}: case 1, but the leader brakes in full at "
            f"{' or '.join(map('{:g} s'.format, study.settings.brake_at))}, where the dead end "
            "is recognised, to see whether a collision follows, as in the paper",
        },
        packages=("libsumo",) if study.world == "sumo" else (),
        sources={_SOURCE: "https://arxiv.org/abs/1908.10823"},
        verdict=f"{n_holds} of {len(claims)} claims of the paper hold in {world}",
    )


def write(study: PaperStudy, folder: Path, command: str) -> Path:
    """Write page, figures, ``claims.json`` and ``model.evofsm``."""
    page = write_page(folder / "index.html", [page_of(study, command)])
    claims = [claim._asdict() for claim in check_claims(study)]
    text = json.dumps(claims, indent=2, ensure_ascii=False)
    (folder / "claims.json").write_text(f"{text}\n", encoding="utf-8")
    study.model.save(folder / "model.evofsm", {"learnt by": "evofsm paper"})
    return page


def _table_of_forecasts(forecasts: pl.DataFrame) -> Table:
    return Table(
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


def divergences(study: PaperStudy) -> pl.DataFrame:
    """Largest divergence of forecasts by case, and the mean [bit]: ours, and simple ones."""
    n = study.model.n_states
    beliefs = [  # 0 for states created later
        np.pad(run.belief, [(0, 0), (0, n - run.belief.shape[1])]) for run in study.last_round
    ]
    constant = np.concatenate(beliefs).mean(axis=0)
    uniform = np.full_like(constant, 1.0 / len(constant))
    simple = {
        "persistence": [belief[:-1] for belief in beliefs],
        "constant": [constant] * len(CASES),
        "uniform": [uniform] * len(CASES),
    }
    series = {_OURS: [run.surprise[1:] for run in study.last_round]}
    for name, forecasts in simple.items():
        pairs = zip(forecasts, beliefs, strict=True)
        series[name] = [np.asarray(jensen_shannon(row, came[1:])) for row, came in pairs]
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


def _table_of_losses(forecasts: pl.DataFrame) -> Table:
    frame = forecasts.unpivot(index="forecast", variable_name="where")
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

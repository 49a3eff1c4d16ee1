"""The paper's study as a chapter: every claim beside what was measured, and all that was set."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from evofsm.app import Table
from evofsm.driving import IDM, ChangingIDM
from evofsm.evidence.paper.claims import Claim, check_claims
from evofsm.evidence.paper.context import OURS, context_tables, divergences
from evofsm.evidence.paper.runs import CASES, PaperStudy
from evofsm.evidence.paper.settings import Settings
from evofsm.evidence.report.chapter import Chapter, Section, Source
from evofsm.evidence.report.figures import paper_figures
from evofsm.evidence.report.html import Setting
from evofsm.guard import Controller

_WORLDS = {"sumo": "SUMO", "kinematic": "the kinematic world"}
_PAPER = Source(
    "T. Han, D. Filev, Ü. Özgüner: An online evolving framework for modeling the safe autonomous "
    "vehicle control system via online recognition of latent risks, 2019",
    "arXiv:1908.10823",
    "https://arxiv.org/abs/1908.10823",
)


def paper_chapter(
    study: PaperStudy,
    folder: Path,
    command: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    claims: Sequence[Claim] | None = None,
) -> Chapter:
    """Draw the figures of the study and hold every claim against it.

    Parameters
    ----------
    study : PaperStudy
    folder : Path
        Where the figures are put.
    command : str
        What was typed to get it.
    progress : callable
        Told how many figures are done, of how many.
    claims : sequence of Claim, optional
        Where they were judged already.
    """
    claims = check_claims(study) if claims is None else claims
    failing = tuple(place for place, claim in enumerate(claims) if not claim.holds)
    world = _WORLDS.get(study.world, study.world)
    first, *others = paper_figures(study, folder, progress)
    return Chapter(
        id="paper",
        title="Does the paper's machine do what the paper says?",
        about="An evolving finite state machine (e-FSM) watches a system act and finds its states "
        "by itself: dense observations found states, each new observation is recognised as a "
        "distribution over them, and for every action a matrix of transition probabilities is "
        "learnt, step by step. Among the states there may be a dead end, the one in which "
        "collisions come if the leader brakes hard: recognised early, it is a warning. This is the "
        f"car-following experiment of the paper once more, {len(study.runs)} runs of four cases in "
        f"{world}, with each claim of its Section 3 beside what was measured. States are numbered "
        "from #1 in the order of founding, actions from a(1) by their intervals; a claim is tested "
        "on all runs unless it says otherwise.",
        headline=f"{len(claims) - len(failing)} of {len(claims)} claims hold in {world}",
        answer=(f"{study.model.n_states} states were founded in {len(study.runs)} runs.",),
        fails=tuple(_failure(claims[place]) for place in failing),
        losses=tuple(losses(study)),
        tables=(_table_of_claims(claims, failing), *context_tables(study)),
        figures=(first,),
        sections=(
            Section("figures", "More figures", figures=tuple(others)),
            Section(
                "settings",
                "Settings",
                "The paper leaves some settings open; those were recovered by search, and "
                "evofsm/studies/paper/settings.toml marks which.",
                tuple(_tables_of_settings(study.settings)),
            ),
        ),
        plan=(
            Setting("runs", f"{len(study.runs)}, and {len(study.extra_runs)} extra ones"),
            Setting("world", world),
        ),
        command=command,
        packages=("libsumo",) if study.world == "sumo" else (),
        sources=(_PAPER,),
    )


def _failure(claim: Claim) -> str:
    return f"{claim.claim}: {claim.measured} (paper: {claim.paper})"


_IN_WORDS = {
    "persistence": "Persistence",
    "constant": "A constant",
    "uniform": "The uniform distribution",
}


def losses(study: PaperStudy) -> Iterator[str]:
    """Every simple forecast that comes closer than the machine's, with the numbers."""
    found = {
        who: {
            **{f"in case {k}": float(one.max()) for k, one in zip(CASES, by_case, strict=True)},
            "on average": float(np.concatenate(by_case).mean()),
        }
        for who, by_case in divergences(study).items()
    }
    mine = found.pop(OURS)
    for who, theirs in found.items():
        better = [where for where, value in theirs.items() if value < mine[where]]
        if better:
            cases = "; ".join(f"{w} {theirs[w]:.1e} against {mine[w]:.1e} bit" for w in better)
            yield (
                f"{_IN_WORDS.get(who, who)} is the better forecast of the next belief (largest "
                f"divergence in a case of the last round, or mean of all): {cases}."
            )


def _table_of_claims(claims: Sequence[Claim], failing: tuple[int, ...]) -> Table:
    rows = tuple(
        (claim.claim, claim.paper, claim.measured, "holds" if claim.holds else "fails")
        for claim in claims
    )
    header = ("claim", "paper", "measured", "verdict")
    return Table("Claims", header, rows, in_words=True, failing=failing)


# -- Settings -----------------------------------------------------------------------------------

_DRIVER_HEADER = (
    "driver",
    "accel [m/s²]",
    "desired speed [m/s]",
    "min gap [m]",
    "time headway [s]",
    "decel [m/s²]",
    "exponent",
    "bounds [m/s²]",
)


def _tables_of_settings(settings: Settings) -> Iterator[Table]:
    """What was set, in groups."""
    scenario, actions, machine = settings.scenario, settings.actions, settings.machine
    leader = scenario.leader
    groups = {
        "Scenario": [
            ("initial gap, both at rest", f"{scenario.initial_gap:g} m"),
            ("duration", f"{scenario.duration:g} s in steps of {scenario.dt:g} s"),
            (
                "leader's full brake",
                f"{leader.brake_decel:g} m/s² on reaching {leader.brake_speed:g} m/s",
            ),
            (
                "extra runs of case 1: brake at",
                ", ".join(f"{time:g} s" for time in settings.brake_at) or "none",
            ),
            ("cases 2 and 3 run on to", f"{settings.safe_until:g} s"),
        ],
        "Machine": [
            *((_read(name), f"{value:g}") for name, value in machine.items()),
            (
                "actions",
                f"{actions.n_actions} intervals of {actions.width:g} m/s² from "
                f"{actions.low:g} to {actions.high:g} m/s²".replace("-", "−"),
            ),
        ],
    }
    for title, rows in groups.items():
        yield Table(title, ("setting", "value"), tuple(rows), in_words=True)
    drivers = tuple(_drivers(settings))
    yield Table("Drivers (Intelligent Driver Model)", _DRIVER_HEADER, drivers)


def _read(name: str) -> str:
    """A name of the code as people read it, with the paper's sign for it."""
    signs = {
        "radius": "ε",
        "distance_weight": "ρ",
        "learning_rate": "φ",
        "prior_frequency": "ε̄",
    }
    words = name.replace("_", " ")
    return f"{words} {signs[name]}" if name in signs else words


def _drivers(settings: Settings) -> Iterator[tuple[str, ...]]:
    """A row for each way of driving."""
    yield ("leader", *_numbers(settings.scenario.leader.driver))
    for case, driver in settings.drivers.items():
        for name, phase in _phases(f"case {case}", driver):
            yield (name, *_numbers(phase))


def _phases(name: str, driver: Controller) -> Iterator[tuple[str, Controller]]:
    if isinstance(driver, ChangingIDM):
        yield f"{name} at first", driver.first
        for at, phase in driver.changes:
            yield f"{name} from {at:g} s", phase
    else:
        yield name, driver


def _numbers(driver: Controller) -> tuple[str, ...]:
    if not isinstance(driver, IDM):
        return (type(driver).__name__, *[""] * (len(_DRIVER_HEADER) - 2))
    return (
        f"{driver.accel:g}",
        f"{driver.desired_speed:g}",
        f"{driver.min_gap:g}",
        f"{driver.time_headway:g}",
        f"{driver.decel:g}",
        f"{driver.exponent:g}",
        _bounds(driver),
    )


def _bounds(driver: IDM) -> str:
    if math.isinf(driver.lowest) and math.isinf(driver.highest):
        return "none"
    return f"{driver.lowest:g} to {driver.highest:g}".replace("-", "−").replace("inf", "∞")

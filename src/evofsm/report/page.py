"""The paper's study on one page: a single file that needs nothing beside it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from evofsm.drivers.idm import IDM, ChangingIDM
from evofsm.protocols import Controller
from evofsm.report.html import Setting, inline, versions, write_html
from evofsm.studies.paper import Claim, PaperStudy, Settings
from evofsm.studies.table import Table

if TYPE_CHECKING:
    from evofsm.report.drawing import Drawing

_WORLDS = {"sumo": "SUMO", "kinematic": "the kinematic world"}


def write_page(
    study: PaperStudy,
    claims: Iterable[Claim],
    context: Iterable[Table],
    figures: Iterable[Drawing],
    folder: Path,
    command: str = "make paper",
) -> Path:
    """Write ``index.html``: claims, tables, figures, settings, versions, in one file.

    Parameters
    ----------
    study : PaperStudy
    claims : iterable of Claim
    context : iterable of Table
        The tables that stand beside the claims.
    figures : iterable of Drawing
        As `paper_figures` gives them.
    folder : Path
        Where the page is put; made if it is not there.
    command : str
        What was typed to get it.

    Returns
    -------
    Path
        The page.
    """
    claims = tuple(claims)
    failing = [claim for claim in claims if not claim.holds]
    return write_html(
        folder / "index.html",
        "paper.html.j2",
        verdict=f"{len(claims) - len(failing)} of {len(claims)} claims hold in "
        f"{_WORLDS.get(study.world, study.world)}",
        claims=claims,
        failing=failing,
        tables=tuple(context),
        figures=[(drawing, inline(drawing.paths["svg"])) for drawing in figures],
        settings=_settings(study.settings),
        driver_header=_DRIVER_HEADER,
        drivers=list(_drivers(study.settings)),
        versions=list(versions(sumo=study.world == "sumo")),
        world=_WORLDS.get(study.world, study.world),
        runs=len(study.runs),
        extra_runs=len(study.extra_runs),
        command=command,
    )


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


def _settings(settings: Settings) -> dict[str, list[Setting]]:
    """What was set, in groups."""
    scenario, actions, machine = settings.scenario, settings.actions, settings.machine
    leader = scenario.leader
    return {
        "Scenario": [
            Setting("initial gap, both at rest", f"{scenario.initial_gap:g} m"),
            Setting("duration", f"{scenario.duration:g} s in steps of {scenario.dt:g} s"),
            Setting(
                "leader's full brake",
                f"{leader.brake_decel:g} m/s² on reaching {leader.brake_speed:g} m/s",
            ),
            Setting(
                "extra runs of case 1: brake at",
                ", ".join(f"{time:g} s" for time in settings.brake_at) or "none",
            ),
            Setting("cases 2 and 3 run on to", f"{settings.safe_until:g} s"),
        ],
        "Machine": [
            *(Setting(_read(name), f"{value:g}") for name, value in machine.items()),
            Setting(
                "actions",
                f"{actions.n_actions} intervals of {actions.width:g} m/s² from "
                f"{actions.low:g} to {actions.high:g} m/s²".replace("-", "−"),
            ),
        ],
    }


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

"""A family of scenarios as they were drawn, every number fixed: for cases that are to be kept."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import astuple, fields
from typing import Any, NamedTuple

from evofsm.driving.drivers import IDM, ChangingIDM
from evofsm.driving.families.family import Draw, Family
from evofsm.fsm import IntervalActions


class NamedDraw(NamedTuple):
    """A draw that is kept."""

    name: str
    about: str  #: what is to be known of it, in a sentence
    draw: Draw


def fixed_family(family: Family, cases: Sequence[NamedDraw], about: str) -> str:
    """Draws of a family as a family of their own, in which nothing is left to chance.

    Parameters
    ----------
    family : Family
        That they are of; with its switches, and after its shift if they are.
    cases : sequence of Case
        They come in turn.
    about : str
        What they have in common, in a sentence.

    Returns
    -------
    str
        JSON, to be written to a file that ends in ``.json``. `load_family` reads it, and draw k is
        case k, counted from 0, with exactly its numbers.

    Raises
    ------
    ValueError
        If there are no cases.

    Examples
    --------
    >>> from evofsm.driving import load_family
    >>> family = load_family("emergency")
    >>> found = NamedDraw("near", "The smallest gap.", family.draw_by(lambda where: 0.0))
    >>> kept = json.loads(fixed_family(family, [found], "One case."))
    >>> kept["variant"][0]["scenario"]
    {'initial_gap': 2.0, 'duration': 35.0, 'dt': 0.01, 'initial_speed': 0.0}
    """
    if not cases:
        raise ValueError("there are no cases, but a family has one at least")
    tables = {
        "about": about,
        "interval": family.interval,
        "actions": _actions(family.actions),
        "limits": {"decel": family.decel, "leader_decel": family.leader_decel},
        "in_turn": True,
        # What every family has; all else stands with each case.
        **{"scenario": {}, "leader": {}, "follower": {}, "drivers": {}},
        "variant": [
            {"name": case.name, "about": case.about, **_tables(case.draw)} for case in cases
        ],
    }
    return json.dumps(tables, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _actions(actions: IntervalActions) -> dict[str, Any]:
    low, high, width, closed, _ = astuple(actions)
    return {"low": low, "high": high, "width": width, "closed": closed}


def _tables(draw: Draw) -> dict[str, Any]:
    """What makes exactly this scenario, and its driver."""
    scenario, leader, controller = draw.scenario, draw.scenario.leader, draw.controller
    drivers = {"leader": leader.driver}
    changes: tuple[tuple[float, IDM], ...] = ()
    if isinstance(controller, ChangingIDM):
        changes, controller = controller.changes, controller.first
    drivers["follower"] = controller
    named = []
    for number, (at, driver) in enumerate(changes, 1):
        name = next((n for n, known in drivers.items() if known == driver), f"follower {number}")
        drivers[name] = driver
        named.append([at, name])
    tables = {
        "scenario": _numbers(scenario),
        "leader": {
            "driver": "leader",
            **_numbers(leader),
            **({"waves": [list(wave) for wave in leader.waves]} if leader.waves else {}),
            **({"cut_in": _numbers(leader.cut_in)} if leader.cut_in else {}),
        },
        "follower": {"driver": "follower", **({"changes": named} if named else {})},
        "body": _numbers(scenario.body),
        "sensors": _numbers(scenario.sensors),
    }
    if scenario.behind is not None:
        tables["behind"] = {"driver": "behind", **_numbers(scenario.behind)}
        drivers["behind"] = scenario.behind.driver
    return {**tables, "drivers": {name: _numbers(driver) for name, driver in drivers.items()}}


def _numbers(made: Any) -> dict[str, Any]:
    """Its numbers by name. Infinite ones, which JSON has none of, are what they are untold."""
    numbers = {
        name: value
        for name, value in ((part.name, getattr(made, part.name)) for part in fields(made))
        if isinstance(value, (int, float))
    }
    return {name: value for name, value in numbers.items() if math.isfinite(value)}

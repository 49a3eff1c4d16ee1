"""What the study is told: the paper's settings, and how a file changes them."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from evofsm.driving import IDM, ChangingIDM, Leader, Scenario
from evofsm.fsm import IntervalActions


@dataclass(frozen=True)
class Settings:
    """All that the study can be told; the defaults stand, with comments, in ``settings.toml``."""

    scenario: Scenario
    safe_until: float
    drivers: Mapping[int, IDM | ChangingIDM]  #: by case
    switch_at: Mapping[int, float]  #: when the driver changes, by case
    brake_at: tuple[float, ...]
    decel: float  #: hardest braking of the follower [m/s²], positive
    machine: Mapping[str, Any]
    actions: IntervalActions

    @classmethod
    def load(cls, path: Path | None = None) -> Settings:
        """Read the paper's settings, with those of a TOML file in their place where it has any.

        Raises
        ------
        ValueError
            If the file is not TOML, or holds a name or a kind of value that the study does not
            know.
        """
        if path is None:
            return cls.with_changes({})
        try:
            changes = tomllib.loads(path.read_text("utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"{path} is not TOML: {error}") from error
        return cls.with_changes(changes, str(path))

    @classmethod
    def with_changes(cls, changes: Mapping[str, Any], where: str = "changes") -> Settings:
        """The paper's settings with others in the place of some.

        Parameters
        ----------
        changes : mapping
            Tables of ``settings.toml``, with what is changed in them.
        where : str
            What they are called in error messages.

        Raises
        ------
        ValueError
            If there is a name or a kind of value that the study does not know.

        Examples
        --------
        >>> settings = Settings.with_changes({"leader": {"brake_decel": 6.0}})
        >>> settings.scenario.leader.brake_decel, settings.scenario.initial_gap
        (6.0, 5.0)
        """
        tables = tomllib.loads(files(__package__).joinpath("settings.toml").read_text("utf-8"))
        _merge(tables, changes, where)
        scenario, leader, cases = tables["scenario"], tables["leader"], tables["cases"]
        safe_until = scenario.pop("safe_until")
        brake = {name: leader.pop(name) for name in ("brake_speed", "brake_decel")}
        aggressive, normal = IDM(**tables["aggressive"]), IDM(**tables["normal"])
        to_normal, to_aggressive = cases["to_normal_at"], cases["to_aggressive_at"]
        return cls(
            scenario=Scenario(Leader(IDM(**leader), **brake), **scenario),
            safe_until=safe_until,
            drivers={
                1: aggressive,
                2: normal,
                3: ChangingIDM(aggressive, ((to_normal, normal),)),
                4: ChangingIDM(normal, ((to_aggressive, aggressive),)),
            },
            switch_at={3: to_normal, 4: to_aggressive},
            brake_at=tuple(cases["brake_at"]),
            decel=-min(aggressive.lowest, normal.lowest),
            machine=tables["machine"],
            actions=IntervalActions(**tables["actions"], outside="clip"),
        )


def _merge(known: dict[str, Any], changes: Mapping[str, Any], where: str) -> None:
    """Put changes in the place of known values of the same kind."""
    for name, value in changes.items():
        if name not in known:
            raise ValueError(f"{where}: there is no {name!r}; known are {', '.join(known)}")
        if _kind(value) != _kind(known[name]):
            raise ValueError(f"{where}: {name} is {value!r}; it must be like {known[name]!r}")
        if isinstance(value, dict):
            _merge(known[name], value, f"{where}, [{name}]")
        else:
            known[name] = value


def _kind(value: Any) -> str:
    match value:
        case dict():
            return "table"
        case str():
            return "text"
        case list() if all(_kind(item) == "number" for item in value):
            return "numbers"
        case int() | float() if not isinstance(value, bool):
            return "number"
    return "other"

"""Units that columns of a log may have, and what turns them into those of the SI."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

#: What is measured, and the factor that gives s, m, m/s or m/s².
KNOWN: Mapping[str, tuple[str, float]] = {
    "s": ("time", 1.0),
    "ms": ("time", 1e-3),
    "us": ("time", 1e-6),
    "ns": ("time", 1e-9),
    "min": ("time", 60.0),
    "h": ("time", 3600.0),
    "m": ("length", 1.0),
    "mm": ("length", 1e-3),
    "cm": ("length", 0.01),
    "km": ("length", 1000.0),
    "ft": ("length", 0.3048),
    "m/s": ("speed", 1.0),
    "cm/s": ("speed", 0.01),
    "km/h": ("speed", 1.0 / 3.6),
    "mph": ("speed", 0.44704),
    "kn": ("speed", 1852.0 / 3600.0),
    "ft/s": ("speed", 0.3048),
    "m/s2": ("acceleration", 1.0),
    "cm/s2": ("acceleration", 0.01),
    "ft/s2": ("acceleration", 0.3048),
    "g": ("acceleration", 9.80665),
}


def parse_units(texts: Iterable[str]) -> dict[str, str]:
    """From what --unit was given: units by the column, or the beginning of columns.

    Raises
    ------
    ValueError
        If one is not NAME=UNIT with a unit that is known, or a name comes twice.

    Examples
    --------
    >>> parse_units(["v=km/h", "time=ms"])
    {'v': 'km/h', 'time': 'ms'}
    """
    found: dict[str, str] = {}
    for text in texts:
        name, is_unit, unit = (part.strip() for part in text.rpartition("="))
        if not (is_unit and name and unit in KNOWN):
            raise ValueError(f"--unit is {text!r}; write NAME=UNIT with one of {', '.join(KNOWN)}")
        if name in found:
            raise ValueError(f"--unit names {name!r} twice")
        found[name] = unit
    return found


def of_columns(
    units: Mapping[str, str], used: Sequence[str], existing: Iterable[str], time: str | None
) -> dict[str, str]:
    """The unit of each column in use that was given one, by name.

    A name that is no column's is the beginning of all that it fits; the longest one counts.

    Raises
    ------
    ValueError
        If a name fits no column that is in use, or the clock is not to be read in a unit of time.

    Examples
    --------
    >>> of_columns({"v": "km/h"}, ["gap", "v_follower", "time"], ["gap", "v_follower"], "time")
    {'v_follower': 'km/h'}
    """
    existing, found = set(existing), dict[str, str]()
    for name in sorted(units, key=len):
        fit = [
            one for one in used if one == name or (name not in existing and one.startswith(name))
        ]
        if not fit:
            raise ValueError(
                f"--unit {name}={units[name]}: no column that is read is called so, or begins so; "
                f"read are {', '.join(used)}"
            )
        found |= dict.fromkeys(fit, units[name])
    exact = {name: unit for name, unit in units.items() if name in existing}
    found |= exact
    for name, unit in found.items():
        if (KNOWN[unit][0] == "time") != (name == time):
            raise ValueError(
                f"--unit gives column {name!r} the unit {unit}; the column of the time needs a "
                "unit of time, and no other one may have it"
            )
    return found

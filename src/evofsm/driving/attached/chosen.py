"""Which vehicles of a simulation are meant."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterable
from typing import Any

_TYPE = "type:"


def choose(vehicles: str | float | Iterable[str], seed: int = 0) -> Callable[[Any, str], bool]:
    """A test of whether a vehicle is one of those that are meant.

    Parameters
    ----------
    vehicles : str, float or iterable of str
        ``"all"``, ``"type:NAME"``, a share in (0, 1], also as ``"10%"``, or their ids.
    seed : int
        Other vehicles make up the share for another one.

    Returns
    -------
    callable
        From libsumo or traci and an id to whether it is meant. Of a share, the id alone decides:
        the same vehicles are meant in every run.

    Raises
    ------
    ValueError
        If it is none of these.

    Examples
    --------
    >>> chosen = choose(0.5)
    >>> [chosen(None, car) for car in ("a", "b", "c", "d")]
    [False, True, True, False]
    """
    if isinstance(vehicles, str):
        return _named(vehicles, seed)
    if isinstance(vehicles, (int, float)):
        return _share(float(vehicles), seed)
    ids = frozenset(vehicles)
    return lambda _, car: car in ids


def _named(vehicles: str, seed: int) -> Callable[[Any, str], bool]:
    if vehicles == "all":
        return lambda sumo, car: True
    if vehicles.startswith(_TYPE):
        kind = vehicles.removeprefix(_TYPE)
        return lambda sumo, car: sumo.vehicle.getTypeID(car) == kind
    if vehicles.endswith("%"):
        try:
            return _share(float(vehicles[:-1]) / 100.0, seed)
        except ValueError:
            pass
    raise ValueError(
        f"vehicles is {vehicles!r}; it is 'all', 'type:NAME', a share such as 0.1 or '10%', or a "
        "list of ids"
    )


def _share(share: float, seed: int) -> Callable[[Any, str], bool]:
    if not 0.0 < share <= 1.0 or math.isnan(share):
        raise ValueError(f"vehicles is {share}; a share lies above 0, up to 1")
    limit = share * 2.0**32
    return lambda _, car: zlib.crc32(f"{seed}:{car}".encode()) < limit

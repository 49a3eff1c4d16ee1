"""A scene of objects, as the one of them that matters to a guard of car following.

The only place that knows this: a judge of whole scenes would replace `nearest_ahead`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

# Where a width is not told [m].
_WIDTH = 1.8


class Ahead(NamedTuple):
    """The object that is followed."""

    name: str | int  #: its id
    gap: float  #: from bumper to bumper [m]
    v_follower: float  #: own speed along the lane [m/s]
    v_leader: float  #: its speed [m/s]


def nearest_ahead(
    ego: Mapping[str, Any], objects: Sequence[Mapping[str, Any]], along: str
) -> Ahead | None:
    """The nearest object ahead in the own lane; None where there is none.

    Parameters
    ----------
    ego : mapping
        ``vx`` [m/s], ``length`` [m], and its place: ``s`` along the lane, or ``x`` and ``y`` on a
        road along x, of the middle of the car [m]; ``lane``, or ``y`` and ``width`` [m].
    objects : sequence of mapping
        The same of each, and its ``id``.
    along : {"s", "x"}
        Which of the two tells places along the lane.

    Returns
    -------
    Ahead or None
        Whatever its middle is ahead of; one that is beside in the lane has a gap below 0.

    Examples
    --------
    >>> ego = {"s": 0.0, "lane": 1, "vx": 20.0, "length": 4.5}
    >>> other = {"id": "truck", "s": 34.5, "lane": 1, "vx": 15.0, "length": 12.0}
    >>> nearest_ahead(ego, [other, other | {"id": 7, "s": 20.0, "lane": 2}], along="s")
    Ahead(name='truck', gap=26.25, v_follower=20.0, v_leader=15.0)
    """
    found, gap = None, 0.0
    for one in objects:
        away = one[along] - ego[along]
        if away <= 0.0 or not _in_lane(ego, one):
            continue
        between = away - 0.5 * (ego["length"] + one["length"])
        if found is None or between < gap:
            found, gap = one, between
    if found is None:
        return None
    return Ahead(found["id"], float(gap), float(ego["vx"]), float(found["vx"]))


def _in_lane(ego: Mapping[str, Any], one: Mapping[str, Any]) -> bool:
    """Whether it is in the own lane; by their widths where a lane is not told."""
    if "lane" in ego and "lane" in one:
        return bool(ego["lane"] == one["lane"])
    widths = ego.get("width", _WIDTH) + one.get("width", _WIDTH)
    return bool(abs(one["y"] - ego["y"]) < 0.5 * widths)

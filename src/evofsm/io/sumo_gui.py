"""A recorded episode for sumo-gui, with the risk as the follower's colour; files alone, no script.

SUMO's replay device (``--device.fcd-replay.file``) moves vehicles along recorded positions, but a
vehicle keeps the type, and so the colour, that it began with; nothing else in SUMO's files changes
a colour over time, only a program that steers the simulation can. So there is a car for each level
of risk, of that level's colour and name: the one whose level it is drives, and the others wait in a
row at the beginning of the road, where they serve as the legend. What is shown is exact, opens with
``sumo-gui replay.sumocfg`` alone, and never disturbs a world that drives.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import VARIABLES
from evofsm.io.mcap import RecordedEpisode
from evofsm.store import storage

#: Risks at which a level ends; the last ends at 1.
LEVELS = (0.001, 0.02, 0.1, 0.5)
# From Okabe and Ito's colours, for readers who see few; every car has its level as a name, too.
_COLORS = ("#0072B2", "#56B4E9", "#F0E442", "#E69F00", "#D55E00")
_NOT_JUDGED, _LEADER = "#999999", "#009E73"
_LENGTH = 5.0
# Time between two pictures [s], in whole milliseconds.
_STEP = 0.05
# Where the cars wait, each so far from the next, and where the episode begins [m].
_WAITING, _APART, _START = 10.0, 40.0, 400.0
_ROOM = 100.0  # of the road behind the end [m]

_NET = """<net version="1.20">
    <location netOffset="0,0" convBoundary="0,0,{length:.2f},0"
              origBoundary="0,0,{length:.2f},0" projParameter="!"/>
    <edge id="road" from="begin" to="end" priority="1">
        <lane id="road_0" index="0" speed="100" length="{length:.2f}" shape="0,0 {length:.2f},0"/>
    </edge>
    <junction id="begin" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,3.2"/>
    <junction id="end" type="dead_end" x="{length:.2f}" y="0" incLanes="road_0" intLanes=""
              shape="{length:.2f},0 {length:.2f},3.2"/>
</net>
"""

# Limits so wide that SUMO bends nothing that was recorded.
_TYPE = (
    '    <vType id={name} color={color} length="{length}" minGap="0" maxSpeed="100" '
    'accel="100" decel="100" emergencyDecel="100"/>'
)

_VIEW = """<viewsettings>
    <scheme name="evofsm">
        <background backgroundColor="white" showGrid="0"/>
        <edges laneEdgeMode="0" laneShowBorders="1">
            <colorScheme name="uniform">
                <entry color="215,215,215" name="road"/>
            </colorScheme>
        </edges>
        <vehicles vehicleMode="0" vehicleQuality="1" vehicle_minSize="0.00"
                  vehicle_exaggeration="1.00" vehicle_constantSize="0"
                  vehicleName_show="1" vehicleName_size="9.00" vehicleName_color="black"
                  vehicleName_bgColor="255,255,255,0" vehicleName_constantSize="0"/>
    </scheme>
    <delay value="{delay:.0f}"/>
    <viewport zoom="{zoom:.1f}" x="{center:.1f}" y="0"/>
</viewsettings>
"""

_CONFIGURATION = """<configuration>
    <input>
        <net-file value="road.net.xml"/>
        <additional-files value="cars.add.xml"/>
    </input>
    <fcd_replay_device>
        <device.fcd-replay.file value="positions.fcd.xml"/>
    </fcd_replay_device>
    <time>
        <begin value="0"/>
        <end value="{end:.3f}"/>
        <step-length value="{step}"/>
    </time>
    <processing>
        <insertion-checks value="none"/>
        <collision.action value="none"/>
        <time-to-teleport value="-1"/>
    </processing>
    <report>
        <no-warnings value="true"/>
        <no-step-log value="true"/>
    </report>
    <gui_only>
        <gui-settings-file value="view.xml"/>
    </gui_only>
</configuration>
"""


class _Motion(NamedTuple):
    """Where both cars are, a row for each picture."""

    follower: NDArray[np.float64]  # front bumper [m]
    leader: NDArray[np.float64]
    speed: NDArray[np.float64]  # of the follower [m/s]
    leader_speed: NDArray[np.float64]
    car: NDArray[np.int64]  # which of the cars drives as the follower


def write_replay(
    folder: str | os.PathLike[str], episode: RecordedEpisode, risk: str = "risk_proposed"
) -> Path:
    """Write what sumo-gui needs to play an episode: network, cars, positions, view.

    Parameters
    ----------
    folder : str or path-like
        Made where it does not exist; files of the same names in it are replaced.
    episode : RecordedEpisode
        As `evofsm.io.mcap.read_run` gives it.
    risk : str
        The column that gives the colour: ``"risk_proposed"``, how dangerous is what the driver
        wants, or ``"risk_executed"``, what was left of that.

    Returns
    -------
    Path
        The configuration, to be opened by ``sumo-gui``.

    Raises
    ------
    ValueError
        If the episode has no such column, or fewer than two whole observations.
    OSError
        If a file cannot be written.

    Notes
    -----
    Positions follow from the observations at the decisions, and are interpolated between them; a
    picture shows the moment one step before SUMO's clock, whose first step puts the cars in place.
    The camera follows a car on *Start Tracking* in its menu (right button).

    Examples
    --------
    >>> import tempfile
    >>> rows = {"time": [0.0, 0.25, 0.5], "gap": [9.0, 8.0, 7.0], "v_follower": [8.0, 8.0, 8.0]}
    >>> rows |= {"v_leader": [4.0, 4.0, 4.0], "risk_proposed": [0.01, 0.3, np.nan]}
    >>> columns = {name: np.array(values) for name, values in rows.items()}
    >>> end = np.array([6.0, 8.0, 4.0])
    >>> episode = RecordedEpisode(columns, False, False, end_time=0.75, end=end)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     configuration = write_replay(folder, episode)
    ...     sorted(path.name for path in configuration.parent.iterdir())
    ['cars.add.xml', 'positions.fcd.xml', 'replay.sumocfg', 'road.net.xml', 'view.xml']
    """
    if risk not in episode.columns:
        raise ValueError(f"the episode has no column {risk!r}, to be a colour")
    motion = _motion(episode, risk)
    last = float(max(motion.leader.max(), motion.follower.max()))
    length = last + _ROOM
    shown = last - _START + 2 * _ROOM
    texts = {
        "road.net.xml": [_NET.format(length=length)],
        "cars.add.xml": _types(),
        "positions.fcd.xml": _positions(motion),
        "view.xml": [
            _VIEW.format(delay=1000 * _STEP, zoom=100 * length / shown, center=(_START + last) / 2)
        ],
        "replay.sumocfg": [_CONFIGURATION.format(end=len(motion.car) * _STEP + 1.0, step=_STEP)],
    }
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    for name, lines in texts.items():
        with storage.replacing(place / name) as file:
            file.writelines(f"{line}\n".encode() for line in lines)
    return place / "replay.sumocfg"


def car_names() -> list[str]:
    """Names of the cars that drive as the follower: not judged, then by level of risk.

    Examples
    --------
    >>> car_names()[:3]
    ['not_judged', 'risk_0_to_0.001', 'risk_0.001_to_0.02']
    """
    edges = [0.0, *LEVELS, 1.0]
    levels = [f"risk_{low:g}_to_{high:g}" for low, high in pairwise(edges)]
    return ["not_judged", *levels]


def _motion(episode: RecordedEpisode, risk: str) -> _Motion:
    """Positions from speeds and gaps, interpolated between decisions."""
    columns = episode.columns
    times = np.append(columns["time"], episode.end_time)
    seen = np.column_stack(
        [np.append(columns[name], x) for name, x in zip(VARIABLES, episode.end, strict=True)]
    )
    whole = np.isfinite(seen).all(axis=1) & np.append(True, np.diff(times) > 0.0)
    if whole.sum() < 2:
        raise ValueError("the episode has fewer than two whole observations: nothing to play")
    kept = times[whole]
    gap, speed, leader_speed = seen[whole].T
    driven = np.append(0.0, np.cumsum(np.diff(kept) * (speed[:-1] + speed[1:]) / 2))
    at = kept[0] + _STEP * np.arange(round((kept[-1] - kept[0]) / _STEP) + 1)
    follower = _START + np.interp(at, kept, driven)
    decided = np.searchsorted(columns["time"], at + 1e-9, side="right") - 1
    risks = columns[risk][np.clip(decided, 0, None)]
    return _Motion(
        follower=follower,
        leader=follower + np.interp(at, kept, gap) + _LENGTH,
        speed=np.interp(at, kept, speed),
        leader_speed=np.interp(at, kept, leader_speed),
        car=np.where(np.isnan(risks), 0, 1 + np.searchsorted(LEVELS, risks)),
    )


def _types() -> Iterator[str]:
    """A type for each car, of its colour."""
    yield "<additional>"
    names = [*car_names(), "leader"]
    for name, color in zip(names, (_NOT_JUDGED, *_COLORS, _LEADER), strict=True):
        yield _TYPE.format(name=quoteattr(name), color=quoteattr(color), length=_LENGTH)
    yield "</additional>"


def _positions(motion: _Motion) -> Iterator[str]:
    """Every car at every step, as SUMO's FCD: first all of them wait, then one drives."""
    names = car_names()
    waiting = [(name, _WAITING + _APART * place, 0.0) for place, name in enumerate(names)]
    yield "<fcd-export>"
    yield _timestep(0.0, [*waiting, ("leader", _WAITING + _APART * len(names), 0.0)])
    for step in range(len(motion.car)):
        cars = waiting.copy()
        car = int(motion.car[step])
        cars[car] = (names[car], float(motion.follower[step]), float(motion.speed[step]))
        cars.append(("leader", float(motion.leader[step]), float(motion.leader_speed[step])))
        yield _timestep((step + 1) * _STEP, cars)
    yield "</fcd-export>"


def _timestep(time: float, cars: list[tuple[str, float, float]]) -> str:
    vehicles = "".join(
        f'<vehicle id="{name}" type="{name}" lane="road_0" pos="{place:.3f}" x="{place:.3f}" '
        f'y="0" angle="90" speed="{speed:.3f}"/>'
        for name, place, speed in cars
    )
    return f'<timestep time="{time:.3f}">{vehicles}</timestep>'

"""How hard leaders brake: every braking manoeuvre seen is remembered, pooled over situations.

What a leader does next hardly depends on the follower, so each hard manoeuvre seen anywhere counts
everywhere. The chance that the next one is harder than some deceleration is read from a kernel
density over those remembered (Epanechnikov's kernel, Silverman's bandwidth), together with one
manoeuvre that was only assumed: with N remembered it weighs 1 / (N + 1), which is also the chance
that the next one is harder than all before it. So it takes 49 hard brakes until a risk of 2 % can
be told from the assumption, unless one begins with a table of them (`LeaderBrakes`).
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from evofsm.driving.rehearsal import HARDEST, Three
from evofsm.fsm.validation import Floats, positive

# Of a manoeuvre the hardest second counts; it shows in the latest half, and takes at least three
# quarters: less may be noise [s].
_WINDOW, _RECENT, _SHORTEST_BRAKING = 1.0, 0.5, 0.75
# A leader brakes from the first of these decelerations on, until below the second [m/s²].
_BEGINS, _ENDS = 1.0, 0.4
# Where speeds are noisy both are looked at for longer: until noise is no more than this [m/s²]; and
# a speed must have fallen by so many standard deviations of the noise more.
_BLUR, _BLUR_HARDEST, _DOUBT = 0.4, 0.15, 3.0
# A gap that changes by so much more than the speeds explain belongs to another leader [m], and
# so does a speed that changes by so much more than a car can [m/s].
_ANOTHER_GAP, _ANOTHER_SPEED = 3.0, 1.0
# Between two points of the table of `Manoeuvres.harder` [m/s²], and its narrowest kernel.
_GRID, _NARROWEST = 0.05, 0.1
# So many of the latest manoeuvres are remembered.
_MOST_REMEMBERED = 500
# Manoeuvres from which on it is learnt how hard leaders brake, and the width of a bin of
# `LeaderBrakes` [m/s²]. Softer ones, of which everyday traffic is full, must not water those down.
_HARD, _BIN_WIDTH = 2.5, 0.25


class LeaderBrakes(NamedTuple):
    """Hard brakes of leaders in some drives, counted by their deceleration.

    ``python -m studies leaders --data FOLDER`` prints such a table of any folder of drives.

    Examples
    --------
    >>> LeaderBrakes((2, 0, 1), gentle=20, hours=0.5, source="our own cars").decels
    (2.75, 2.75, 3.25)
    """

    counts: tuple[int, ...]  #: of hard ones, by bins of 0.25 m/s² from 2.5 m/s² on
    gentle: int  #: number of softer ones
    hours: float  #: of following a leader that they were seen in
    source: str  #: whose drives, for people

    @property
    def decels(self) -> tuple[float, ...]:
        """Each as hard as its bin may hold, the softest first [m/s²]."""
        ends = _HARD + _BIN_WIDTH * np.arange(1, len(self.counts) + 1)
        return tuple(np.repeat(ends, self.counts).tolist())


#: Public drives: 40 waves of braking, the hardest 6.1 m/s². Hardly anyone brakes hard in them, and
#: no one in an emergency: how hard leaders brake then, they do not tell.
REAL_DRIVES = LeaderBrakes(
    counts=(22, 12, 14, 12, 7, 6, 3, 2, 1, 1, 1, 0, 0, 0, 2),
    gentle=927,
    hours=16.1,
    source="OpenACC, ZalaZONE campaign (JRC; Makridis et al. 2021), NGSIM (FHWA; events of Zhu et "
    "al. 2020), one platoon of FHWA; 42 runs",
)


class Manoeuvres:
    """The decelerations of the latest manoeuvres, and how likely harder ones are.

    ``width`` is that of the kernel [m/s²], which then ends at what was seen; else Silverman's.
    """

    def __init__(self, assumed: float, width: float | None = None) -> None:
        self.assumed = positive("assumed", assumed)
        self.width = width
        self.gentle = 0
        self.decels: deque[float] = deque(maxlen=_MOST_REMEMBERED)
        self._tabulate()

    def __len__(self) -> int:
        return len(self.decels)

    def remember(self, *decels: float | None) -> None:
        """Take in manoeuvres [m/s²], the oldest first; None for none."""
        samples = [min(positive("decel", decel), HARDEST) for decel in decels if decel is not None]
        hard = [decel for decel in samples if decel >= _HARD]
        self.gentle += len(samples) - len(hard)
        if hard:
            self.decels = deque([*self.decels, *hard], self.decels.maxlen)
            self._tabulate()

    def harder(self, decel: ArrayLike) -> Floats:
        """Probability that the next hard manoeuvre is harder than these decelerations [m/s²]."""
        grid, harder = self.table
        return np.asarray(np.interp(np.asarray(decel, dtype=np.float64), grid, harder))

    def exceeded_by(self, share: float) -> float:
        """What a share of hard manoeuvres exceeds [m/s²]: the inverse of `harder`."""
        grid, harder = self.table
        return float(grid[np.argmax(harder <= share)])

    def _tabulate(self) -> None:
        grid = np.arange(0.0, HARDEST + _GRID, _GRID)
        harder = (self.assumed > grid).astype(np.float64)
        if self.decels:
            samples = np.array(self.decels) - (self.width or 0.0)
            # Silverman's rule; where few were seen their spread says little.
            width = self.width or max(_NARROWEST, 2.34 * samples.std() * len(samples) ** -0.2)
            offset = np.clip((samples - grid[:, None]) / width, -1.0, 1.0)
            harder += (0.5 + offset * (0.75 - 0.25 * offset * offset)).sum(axis=1)
        harder[grid >= HARDEST] = 0.0
        #: Decelerations [m/s²], and the chance that the next hard manoeuvre is harder.
        self.table: Floats = np.array([grid, harder / (len(self.decels) + 1)])


class BrakeWatch:
    """Watches a leader's speed every ``dt`` [s], and tells a manoeuvre when it has ended."""

    def __init__(self, dt: float) -> None:
        self.dt = positive("dt", dt)
        self._recently = max(1, round(_RECENT / dt))
        least = self._recently + (dt < _SHORTEST_BRAKING)  # of long steps one says it
        self._shortest = max(least, round(_SHORTEST_BRAKING / dt))
        self._window = max(self._shortest, round(_WINDOW / dt))
        self.clear()

    def clear(self) -> None:
        """Forget the leader: another comes, or an episode begins."""
        # Gap, own speed and leader's speed.
        self._recent: deque[tuple[float, float, float]] = deque(maxlen=4 * self._recently + 1)
        self._braking: list[float] = []
        self._noise = 0.0

    def see(
        self, gap: float, speed: float, leader_speed: float, noise: float = 0.0
    ) -> float | None:
        """Take in an observation; returns the deceleration of a manoeuvre that ended [m/s²].

        ``noise`` is the standard deviation of that on the difference of two speeds [m/s].
        """
        now = gap, speed, leader_speed
        if self._recent and is_another(self._recent[-1], now, self.dt):
            decel = self.end()
            self.clear()
            self._recent.append(now)
            return decel
        self._recent.append(now)
        self._noise = noise
        span = min(self._long_enough(self._recently, _BLUR), 4 * self._recently)
        if len(self._recent) <= span:
            return None
        loss = self._recent[-1 - span][2] - leader_speed
        seconds = span * self.dt
        if self._braking:
            self._braking.append(leader_speed)
            if leader_speed <= 0.0:
                self._recent.clear()  # who stands does not brake, though noise may move it
            if loss < _ENDS * seconds or leader_speed <= 0.0:
                return self.end()
        elif loss >= _BEGINS * seconds + _DOUBT * noise:
            self._braking = [speed for _, _, speed in self._recent][-1 - span :]
        return None

    def end(self) -> float | None:
        """Close the manoeuvre under way, as an episode ends; returns its deceleration [m/s²]."""
        speeds, self._braking = self._braking, []
        while len(speeds) > 1 and speeds[-1] <= 0.0:
            speeds.pop()  # in the interval in which it came to a standstill it did not only brake
        if len(speeds) <= self._shortest:
            return None
        span = min(self._long_enough(self._window, _BLUR_HARDEST), len(speeds) - 1)
        losses = np.array(speeds[:-span]) - np.array(speeds[span:])
        # Less than a gentle second's worth may be noise, however short.
        least = _BEGINS * _WINDOW + _DOUBT * self._noise
        return float(losses.max()) / (span * self.dt) if losses.max() >= least else None

    def _long_enough(self, span: int, blur: float) -> int:
        """So many decisions, or more if noise blurs a deceleration over them."""
        return max(span, round(self._noise / (blur * self.dt)))


def is_another(before: Three, now: Three, dt: float) -> bool:
    """Whether another leader is ahead: its speed or the gap changed by more than driving does.

    Gap [m] and both speeds [m/s], ``dt`` [s] apart.
    """
    gap, speed, leader_speed = before
    expected_gap = gap + 0.5 * dt * (leader_speed + now[2] - speed - now[1])
    if abs(now[2] - leader_speed) > HARDEST * dt + _ANOTHER_SPEED:
        return True
    return abs(now[0] - expected_gap) > _ANOTHER_GAP

"""How well one brakes oneself: learnt from what was commanded and what came of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import fsum, sqrt

# Full braking is judged by so many of the latest decisions, and by the few latest alone, so that
# brakes that weaken show within seconds.
_MEMORY, _LATEST = 40, 6
# One-sided 95 % bound.
_BOUND = 1.645
# Below this share of the command nothing brakes that is called a brake.
_WEAKEST = 0.2
# Braking harder than this tells whether it brings what was commanded, and whether it falls short
# of what it brought before [m/s²].
_GENTLE, _SHORTFALL = 1.0, 0.1
# Commands that differ by less are the same [m/s²].
_SAME = 0.05
# Slower than this one may stand still, and only noise moves [m/s].
_STANDING = 1.0


class OwnBrakes:
    """What full braking really brings, and how late commands take effect.

    Parameters
    ----------
    lowest : float
        The hardest braking that can be commanded [m/s²], negative.
    assumed : float
        Share of it that is believed in until braking was seen.
    dt : float
        Time between decisions [s].

    Examples
    --------
    >>> brakes = OwnBrakes(lowest=-4.0, assumed=0.5, dt=0.25)
    >>> brakes.decel
    2.0
    >>> speed = 20.0
    >>> for _ in range(10):
    ...     brakes.see(speed, -4.0)
    ...     speed -= 0.25 * 3.0  # they are weaker than commanded
    >>> brakes.decel, brakes.lag
    (3.0, 0.0)
    """

    def __init__(self, lowest: float, assumed: float, dt: float) -> None:
        self.lowest = lowest
        self.assumed = assumed
        self.dt = dt
        self.samples: deque[float] = deque(maxlen=_MEMORY)
        self._shortfalls: deque[tuple[float, float]] = deque(maxlen=_LATEST)
        self.lagged = [0.0, 0.0]  # sums of products and of squares: the lag by least squares
        self.clear()

    @property
    def known(self) -> bool:
        """Whether full braking was seen often enough to count on what was seen."""
        return len(self.samples) >= _LATEST

    @property
    def decel(self) -> float:
        """Full braking that can be counted on [m/s²], positive."""
        if not self.known:
            counted_on = -self.assumed * self.lowest
        else:
            samples = list(self.samples)
            counted_on = min(_lower_bound(samples), _lower_bound(samples[-_LATEST:]))
        return max(counted_on, -_WEAKEST * self.lowest)

    @property
    def lag(self) -> float:
        """Share of an interval in which the command before still rules, in [0, 1]."""
        products, squares = self.lagged
        return float(min(max(products / squares, 0.0), 1.0)) if squares > 0.0 else 0.0

    def trust(self, decel: float) -> None:
        """Take full braking as known [m/s²], positive."""
        self.samples.extend([decel] * _LATEST)

    def clear(self) -> None:
        """An episode begins: what comes is not a consequence of what was."""
        self._speed: float | None = None
        self._commands: list[float] = []

    def see(self, speed: float, command: float) -> None:
        """Take in a speed [m/s] and what is commanded after it [m/s²]."""
        # Nothing is learnt from standing still.
        if self._speed is not None and min(speed, self._speed) > _STANDING:
            self._learn((speed - self._speed) / self.dt)
        self._speed = speed
        self._commands = [*self._commands[-2:], max(command, self.lowest)]

    def _learn(self, realised: float) -> None:
        commands = self._commands
        if len(commands) == 3 and max(commands) - min(commands) < _SAME:
            self._learn_steady(commands[-1], realised)
        elif len(commands) >= 2 and self.known:
            last, asked = (max(command, -self.decel) for command in commands[-2:])
            self.lagged[0] += (realised - asked) * (last - asked)
            self.lagged[1] += (last - asked) ** 2

    def _learn_steady(self, command: float, realised: float) -> None:
        """A command that ruled for long enough shows what comes of it."""
        if command < self.lowest + _SAME:
            self.samples.append(-realised)
        if command < -_GENTLE and self.known:
            self._shortfalls.append((realised - max(command, -self.decel), -realised))
        if len(self._shortfalls) == _LATEST:
            shortfalls, brought = zip(*self._shortfalls, strict=True)
            if _lower_bound(shortfalls) > _SHORTFALL:  # weaker than they were: begin anew
                self.samples.clear()
                self.samples.extend(brought)
                self._shortfalls.clear()


def _lower_bound(samples: Sequence[float]) -> float:
    mean = fsum(samples) / len(samples)
    variance = fsum([(sample - mean) ** 2 for sample in samples]) / (len(samples) - 1)
    return mean - _BOUND * sqrt(variance / len(samples))

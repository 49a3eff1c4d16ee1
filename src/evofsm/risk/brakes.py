"""How well one brakes oneself: learnt from what was commanded and what came of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable
from math import fsum, sqrt
from typing import NamedTuple

# Full braking is judged by so many of the latest decisions, and by no fewer than the second number;
# that it is weaker than before shows in as few, and in no more than the third number.
_MEMORY, _FEWEST, _SUSPECT = 80, 6, 12
# One-sided bounds, in standard errors: of 95 %, and one that may be asked at every decision.
_BOUND, _SURE = 1.645, 4.0
# Full braking is known where its bound comes so close to its mean.
_CLEAR = 0.9
# Below this share of the command nothing brakes that is called a brake.
_WEAKEST = 0.2
# Braking harder than this tells whether it brings what was commanded, and whether it falls short
# of what it brought before [m/s²].
_GENTLE, _SHORTFALL = 1.0, 0.1
# Commands that differ by less are the same [m/s²].
_SAME = 0.05
# Slower than this one may stand still, and only noise moves [m/s].
_STANDING = 1.0


class Sample(NamedTuple):
    """What came of a steady command within one decision."""

    value: float  #: [m/s²]
    begins: bool  #: whether a stretch of steady decisions begins with it


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
        self.samples: deque[Sample] = deque(maxlen=_MEMORY)
        self._shortfalls: deque[tuple[Sample, Sample]] = deque(maxlen=_SUSPECT)
        self.lagged = [0.0, 0.0]  # sums of products and of squares: the lag by least squares
        self.clear()

    @property
    def known(self) -> bool:
        """Whether full braking was seen often and clearly enough to count on what was seen."""
        if not _FEWEST <= len(self.samples) < _MEMORY:
            return len(self.samples) >= _FEWEST
        return self._bound >= _CLEAR * self._mean

    @property
    def decel(self) -> float:
        """Full braking that can be counted on [m/s²], positive."""
        counted_on = -self.assumed * self.lowest
        if len(self.samples) >= _FEWEST:
            counted_on = self._bound if self.known else min(self._bound, counted_on)
        return max(counted_on, -_WEAKEST * self.lowest)

    @property
    def lag(self) -> float:
        """Share of an interval in which the command before still rules, in [0, 1]."""
        products, squares = self.lagged
        return float(min(max(products / squares, 0.0), 1.0)) if squares > 0.0 else 0.0

    def trust(self, decel: float) -> None:
        """Take full braking as known [m/s²], positive."""
        self.remember([Sample(decel, begins=True)] * _FEWEST)

    def remember(self, samples: Iterable[Sample]) -> None:
        """Take in what full braking brought, the oldest first."""
        self.samples.extend(samples)
        if len(self.samples) >= _FEWEST:
            self._mean, self._bound = _mean(self.samples), _lower_bound(self.samples, _BOUND)

    def expected(self, before: float, command: float) -> float:
        """Acceleration that a command most likely brings, after the one before it [m/s²]."""
        hardest = -self._likely
        last, asked = max(before, hardest), max(command, hardest)
        return self.lag * last + (1.0 - self.lag) * asked

    @property
    def _likely(self) -> float:
        """Full braking as it most likely is [m/s²], positive."""
        return self._mean if self.known else self.decel

    def clear(self) -> None:
        """An episode begins: what comes is not a consequence of what was."""
        self._speed: float | None = None
        self._estimate = 0.0
        self._commands: list[float] = []
        self._was_full = self._was_braking = False

    def see(self, speed: float, command: float, estimate: float | None = None) -> None:
        """Take in a speed, and what is commanded after it.

        Parameters
        ----------
        speed : float
            As it was observed [m/s].
        command : float
            [m/s²].
        estimate : float, optional
            The speed as it most likely is [m/s], if it was observed with noise. Commands answer
            to noise, so that the lag must not be told from it.
        """
        asked = max(command, self.lowest)
        # Nothing is learnt from standing still.
        if self._speed is not None and min(speed, self._speed) > _STANDING:
            self._learn((speed - self._speed) / self.dt, (speed - self._estimate) / self.dt, asked)
        self._speed = speed
        self._estimate = speed if estimate is None else estimate
        self._commands = [*self._commands[-2:], asked]

    def _learn(self, realised: float, estimated: float, now: float) -> None:
        if self.known and len(self._commands) >= 2:
            last, asked = (max(command, -self._likely) for command in self._commands[-2:])
            self.lagged[0] += (estimated - asked) * (last - asked)
            self.lagged[1] += (last - asked) ** 2
        # However late commands take effect, it was one of the latest three that ruled.
        ruled = max(self._commands) if len(self._commands) == 3 else 0.0
        self._learn_full(max(ruled, now), realised)
        self._learn_shortfall(ruled, realised)

    def _learn_full(self, ruled: float, realised: float) -> None:
        """Braking in full shows what it brings.

        What is commanded now must be it, too: commands answer to noise, and of braking that noise
        has ended the brakes would seem better than they are.
        """
        is_full = ruled < self.lowest + _SAME
        if is_full:
            self.remember([Sample(-realised, begins=not self._was_full)])
        self._was_full = is_full

    def _learn_shortfall(self, ruled: float, realised: float) -> None:
        """Any braking shows whether the brakes are weaker than they were."""
        is_braking = ruled < -_GENTLE and len(self.samples) >= _FEWEST
        if is_braking:
            brought = Sample(-realised, begins=not self._was_braking)
            shortfall = min(-ruled, self.decel) - brought.value
            self._shortfalls.append((brought._replace(value=shortfall), brought))
        self._was_braking = is_braking
        if len(self._shortfalls) >= _FEWEST:
            shortfalls, seen = zip(*self._shortfalls, strict=True)
            # Without noise the latest few tell; in noise it takes more.
            sure = max(_lower_bound(some, _SURE) for some in (shortfalls[-_FEWEST:], shortfalls))
            if sure > _SHORTFALL:  # begin anew
                self.samples.clear()
                self.remember(seen[-_FEWEST:])
                self._shortfalls.clear()


def _mean(samples: Collection[Sample]) -> float:
    return fsum(sample.value for sample in samples) / len(samples)


def _lower_bound(samples: Collection[Sample], errors: float) -> float:
    """So many standard errors below the mean.

    A decision's acceleration is a difference of two speeds, and what noise does to one it undoes
    in the next: the mean of a stretch has the noise of its two ends only.
    """
    mean, count = _mean(samples), len(samples)
    variance = fsum((sample.value - mean) ** 2 for sample in samples) / (count - 1)
    stretches = max(1, sum(sample.begins for sample in samples))
    few = 1.0 + 1.2 / (count - 1)  # roughly what Student's t adds: few say little of their variance
    return mean - few * errors * sqrt(variance * stretches) / count

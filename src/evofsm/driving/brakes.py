"""How well one brakes oneself: learnt from what was commanded and what came of it.

Full braking shows what it brings, as a lower bound on its mean. Ordinary braking shows whether the
brakes have weakened since, and how late commands take effect is told by least squares.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from math import fsum, sqrt

# Full braking is judged by so many of the latest decisions, and by no fewer than the second number;
# that it is weaker than before shows in as few, and in no more than the third number.
_MOST_BRAKINGS, _FEWEST, _SUSPECT = 80, 6, 12
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
_SAME_COMMAND = 0.05
# Slower than this one may stand still, and only noise moves [m/s].
_STANDING = 1.0
# No car brakes harder than this [m/s²], nor does its speed jump by more in a decision [m/s].
_HARDEST, _JUMP = 15.0, 5.0


def hardest_seen(dt: float) -> float:
    """Braking beyond which a change of one's speed is a sensor's jump [m/s²]."""
    return _HARDEST + _JUMP / dt


#: The latest samples, the oldest first: of each its value, and 1 where a run begins.
Samples = deque[tuple[float, float]]


class OwnBrakes:
    """What full braking really brings, and how late commands take effect."""

    def __init__(self, lowest: float, assumed: float, dt: float) -> None:
        self.lowest, self.assumed, self.dt = lowest, assumed, dt
        self._most_change = hardest_seen(dt) * dt  # of a speed within a decision [m/s]
        self.full = Samples(maxlen=_MOST_BRAKINGS)  #: by full braking
        self.shortfalls = Samples(maxlen=_SUSPECT)  #: of any braking, against what was expected
        self.brought = Samples(maxlen=_FEWEST)  #: by the latest of that
        #: Whether full braking was seen often and clearly enough to count on what was seen.
        self.known = False
        #: Full braking that can be counted on [m/s²], positive; and as it most likely is.
        self.decel = self._likely = max(assumed, _WEAKEST) * -lowest
        self.set_lagged(0.0, 0.0)
        self.clear()

    def set_lagged(self, products: float, squares: float) -> None:
        """Tell the lag by least squares, from sums of products and of squares."""
        self.lagged = products, squares
        #: Share of an interval in which the command before still rules, in [0, 1].
        self.lag = min(max(products / squares, 0.0), 1.0) if squares > 0.0 else 0.0

    def trust(self, decel: float) -> None:
        """Take full braking as known [m/s²], positive; slow to come it is better given as less."""
        self.remember([(decel, True)] * _FEWEST)

    def remember(self, samples: Iterable[tuple[float, float]]) -> None:
        """Take in what full braking brought, the oldest first, and where a run begins."""
        self.full.extend(samples)
        if len(self.full) < _FEWEST:
            return
        mean, bound = _mean_and_bound(self.full, _BOUND)
        self.known = len(self.full) == _MOST_BRAKINGS or bound >= _CLEAR * mean
        counted_on = bound if self.known else min(bound, -self.assumed * self.lowest)
        self.decel = max(counted_on, -_WEAKEST * self.lowest)
        self._likely = mean if self.known else self.decel

    def show(self, decel: float | None) -> None:
        """Take in that the car braked so hard [m/s²], whatever was commanded; None for not at all.

        So hard it can brake, which is believed in until full braking is known; that it can brake
        no harder is not shown by it.
        """
        share = min((decel or 0.0) / -self.lowest, 1.0)
        if share > self.assumed and len(self.full) < _FEWEST:
            self.assumed = share
            self.decel = self._likely = max(share, _WEAKEST) * -self.lowest

    def expected(self, before: float, command: float) -> float:
        """Acceleration that a command most likely brings, after the one before it [m/s²]."""
        hardest = -self._likely
        last, demand, lag = max(before, hardest), max(command, hardest), self.lag
        return lag * last + (1.0 - lag) * demand

    def clear(self) -> None:
        """An episode begins: what comes is not a consequence of what was."""
        self._speed: float | None = None
        self._estimate = 0.0
        self._commands: list[float] = []
        self._was_full = self._was_braking = False

    def see(
        self, speed: float, command: float, estimate: float | None = None, *, watched: bool = False
    ) -> None:
        """Take in a speed as observed [m/s], and what is commanded after it [m/s²].

        ``estimate`` is the speed as it most likely is: commands answer to noise, so that the lag
        must not be told from it. ``watched`` says that someone else drives, whose proposal may be
        no command to the brakes; then ordinary braking does not show that they weakened.
        """
        demand = max(command, self.lowest)
        # Nothing is learnt from standing still, nor from a sensor's jump.
        if (
            self._speed is not None
            and min(speed, self._speed) > _STANDING
            and abs(speed - self._speed) <= self._most_change
        ):
            change, likely_change = (speed - self._speed), (speed - self._estimate)
            self._learn(change / self.dt, likely_change / self.dt, demand, watched=watched)
        self._speed = speed
        self._estimate = speed if estimate is None else estimate
        self._commands = [*self._commands[-2:], demand]
        if command < self.lowest - _SAME_COMMAND:  # harder than they can be asked to brake
            self.clear()

    def _learn(self, realised: float, estimated: float, now: float, *, watched: bool) -> None:
        if self.known and len(self._commands) >= 2:
            last, demand = (max(command, -self._likely) for command in self._commands[-2:])
            products, squares = self.lagged
            change = last - demand
            self.set_lagged(products + (estimated - demand) * change, squares + change * change)
        # However late commands take effect, it was one of the latest three that ruled.
        softest_command = max(self._commands) if len(self._commands) == 3 else 0.0
        # What is commanded now must be full braking, too: commands answer to noise, and of braking
        # that noise has ended the brakes would seem better than they are.
        is_full = max(softest_command, now) < self.lowest + _SAME_COMMAND
        if is_full:
            self.remember([(-realised, not self._was_full)])
        self._was_full = is_full
        # Any braking shows whether the brakes are weaker than they were.
        is_braking = softest_command < -_GENTLE and len(self.full) >= _FEWEST and not watched
        if is_braking:
            begins = not self._was_braking
            self.brought.append((-realised, begins))
            self.shortfalls.append((min(-softest_command, self.decel) + realised, begins))
            if self._is_sure_to_fall_short():  # begin anew
                self.full.clear()
                self.remember(self.brought)
                self.shortfalls.clear()
        self._was_braking = is_braking

    def _is_sure_to_fall_short(self) -> bool:
        """Without noise the latest few tell; in noise it takes more."""
        shortfalls = [*self.shortfalls]
        bounds = (_mean_and_bound(part, _SURE)[1] for part in (shortfalls[-_FEWEST:], shortfalls))
        return len(shortfalls) >= _FEWEST and any(bound > _SHORTFALL for bound in bounds)


def _mean_and_bound(samples: Iterable[tuple[float, float]], errors: float) -> tuple[float, float]:
    """Mean of samples, and so many standard errors below it."""
    values, begins = zip(*samples, strict=True)
    count = len(values)
    mean = fsum(values) / count  # exact, so that equal samples have no variance
    variance = fsum([(value - mean) ** 2 for value in values]) / (count - 1)
    few = 1.0 + 1.2 / (count - 1)  # roughly what Student's t adds: few say little of their variance
    return mean, mean - few * errors * sqrt(variance * max(1.0, sum(begins))) / count

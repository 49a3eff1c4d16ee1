"""What a system is here: it starts by seed, its controller proposes, and a step may fail."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from evofsm.cli import ALL, FIRST, split_names

#: A float, or (d,) of them, or an index from 0.
Action = Any
Vector = NDArray[np.float64]


class Start(NamedTuple):
    """Which episode: the same is drawn for the same start, whoever controls the system.

    Examples
    --------
    >>> Start.held_out(seed=0, episode=3) == Start.training(seed=0, learning_seed=0, episode=3)
    False
    """

    split: Literal["train", "test"]
    seed: int
    episode: int

    @classmethod
    def training(cls, seed: int, learning_seed: int, episode: int) -> Start:
        """One to learn from; other ones for every learning seed."""
        return cls("train", seed * 1000 + learning_seed, episode)

    @classmethod
    def held_out(cls, seed: int, episode: int) -> Start:
        """One that nothing learns from."""
        return cls("test", seed, episode)

    def rng(self, stream: int) -> np.random.Generator:
        """Random numbers of this episode; each stream has its own."""
        return np.random.default_rng([self.split == "test", self.seed, self.episode, stream])


class Step(NamedTuple):
    """What came of an action."""

    observation: Vector
    reward: float
    failed: bool
    over: bool  #: the episode is over, by failure or because time is up


@dataclass(frozen=True)
class Box:
    """Actions that are one number or several, each from ``low`` to ``high``."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    @property
    def settings(self) -> dict[str, Any]:
        """What a guard is told of them."""
        if len(self.low) == 1:
            return {"low": self.low[0], "high": self.high[0]}
        return {"low": np.array(self.low), "high": np.array(self.high)}

    def change(self, executed: Action, proposed: Action) -> float:
        """Mean absolute difference, in halves of the range."""
        half = 0.5 * (np.array(self.high) - np.array(self.low))
        return float(np.mean(np.abs(np.subtract(executed, proposed)) / half))


@dataclass(frozen=True)
class Discrete:
    """Actions that are an index from 0."""

    n_actions: int

    @property
    def settings(self) -> dict[str, Any]:
        """What a guard is told of them."""
        return {"n_actions": self.n_actions}

    def change(self, executed: Action, proposed: Action) -> float:
        """1 where another action is executed."""
        return float(executed != proposed)


class Decided(Protocol):
    """What a judge decided."""

    @property
    def executed(self) -> Action:
        """What is to be done."""


class Judge(Protocol):
    """What is tried: a `Guard`, or anything with these methods of it."""

    def begin(self) -> None:
        """Begin an episode."""

    def decide(self, observation: Vector, proposal: Action) -> Decided:
        """What to execute instead of a proposal."""

    def end(self, failed: bool = False, observation: Vector | None = None) -> None:
        """End the episode, and learn from it unless frozen."""

    def freeze(self) -> None:
        """Learn nothing from now on."""


class System(ABC):
    """A system with one of its controllers.

    Parameters
    ----------
    controller : str, optional
        Without it the first of `controllers`.

    Raises
    ------
    ValueError
        If it has no such controller.
    """

    name: str
    variables: tuple[str, ...]  #: of an observation, with their units
    actions: Box | Discrete
    interval: float  #: between two decisions [s]
    steps: int  #: decisions of an episode, at most
    train: int = 30  #: episodes that are learnt from, unless told otherwise
    horizon: float | None = None  #: that a guard is told [s]; None: it has to find it
    measure: ClassVar[str] = "return"  #: what `score` is

    def __init__(self, controller: str | None = None) -> None:
        self.controller = self.chosen(FIRST if controller is None else controller)[0]

    def chosen(self, wanted: str) -> list[str]:
        """Names of its controllers that are ``wanted``: some with commas, `ALL` or `FIRST`."""
        known = list(self.controllers)
        if wanted in (ALL, FIRST):
            return known if wanted == ALL else known[:1]
        named = list(dict.fromkeys(split_names(wanted))) or [wanted]
        for name in named:
            if name not in known:
                raise ValueError(
                    f"{self.name} has no controller {name!r}; it has {', '.join(known)}"
                )
        return named

    def reset(self, start: Start) -> Vector:
        """Begin an episode; returns the first observation."""
        self.decisions = 0
        self.chance, self.whim = start.rng(0), start.rng(1)
        self._returned = 0.0
        self._begin(start)
        return self._observation()

    def propose(self, observation: Vector) -> Action:
        """What the controller wants."""
        return self.controllers[self.controller](observation)

    def step(self, action: Action) -> Step:
        """Execute an action until the next decision."""
        self.decisions += 1
        reward, failed = self._advance(action)
        self._returned += reward
        return Step(self._observation(), reward, failed, failed or self._is_over())

    @property
    def score(self) -> float:
        """Of the episode so far: the sum of its rewards, unless `measure` says otherwise."""
        return self._returned

    @property
    def speed(self) -> float:
        """Mean speed of the episode so far [m/s]; NaN where nothing drives."""
        return math.nan

    @property
    @abstractmethod
    def controllers(self) -> Mapping[str, Callable[[Vector], Action]]:
        """By name, each from an observation to an action; random ones draw from ``whim``."""

    @property
    def learners(self) -> Sequence[str]:
        """Judges that are told nothing but failures, and fit what is observed."""
        return ("learnt", "counted")

    @property
    def rivals(self) -> Mapping[str, Callable[[], Judge]]:
        """Judges by name that know this system, each with what it is ``told``."""
        return {}

    @abstractmethod
    def _begin(self, start: Start) -> None:
        """Draw the first state from ``chance``."""

    @abstractmethod
    def _observation(self) -> Vector:
        """What is seen now."""

    @abstractmethod
    def _advance(self, action: Action) -> tuple[float, bool]:
        """Reward, and whether it failed."""

    def _is_over(self) -> bool:
        return self.decisions >= self.steps

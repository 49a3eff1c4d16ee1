"""What can be executed: a number in an interval, a vector in a box, or one of a few things.

An action is a float, or a (d,) array where the set is a `BoxActions`. The functions here are all
that has to know which of them it is.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.validation import Floats, real_array, whole

# Cells that a box is divided into for the machine, at most: 9 x 9.
_CELLS = 81
# Levels of a box of one dimension, as many as an interval has.
_LEVELS = 17

#: One action: a float, or a (d,) array where the set is a `BoxActions`.
Action: TypeAlias = Any
#: Which actions of `Choices` are allowed.
Mask: TypeAlias = NDArray[np.bool_]


@dataclass(frozen=True)
class Choices:
    """A set of actions that are told apart by their index alone: none is nearer than another.

    Examples
    --------
    >>> actions = Choices(3)
    >>> actions.encode(2.0), 1.0 in actions, 0.5 in actions, 3.0 in actions
    (2, True, False, False)
    """

    n_actions: int
    low: ClassVar[float] = 0.0  #: the first index

    def __post_init__(self) -> None:
        object.__setattr__(self, "n_actions", whole("n_actions", self.n_actions))

    @cached_property
    def high(self) -> float:
        """The last index."""
        return self.n_actions - 1.0

    def __contains__(self, action: float) -> bool:
        return self.low <= action <= self.high and action == int(action)

    def encode(self, action: float) -> int:
        """The action itself, as an index."""
        return int(action)


@dataclass(frozen=True)
class BoxActions:
    """A set of actions that are vectors; the machine tells them apart by the cells of a grid.

    Each component is divided into as many levels as make 81 cells at most in all (17 where there
    is one component, 9 by 9 where there are two); of more than six components the first six are
    divided in two.

    Parameters
    ----------
    low, high : tuple of d floats
        Range of each component of the action, in its own unit.

    Raises
    ------
    TypeError, ValueError
        If a number is not finite, ``low`` is not below ``high``, or the lengths differ.

    Examples
    --------
    >>> actions = BoxActions((-1.0, 0.0), (1.0, 4.0))
    >>> actions.n_actions, actions.encode([-1.0, 0.0]), actions.encode([1.0, 4.0])
    (81, 0, 80)
    >>> actions.clip([0.0, 5.0])
    array([0., 4.])
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            array = real_array(name, getattr(self, name), 1)
            if not np.isfinite(array).all():
                raise ValueError(f"{name} is {tuple(array.tolist())}; it must be finite")
            object.__setattr__(self, name, tuple(array.tolist()))
        if len(self.low) != len(self.high):
            counts = f"low has {len(self.low)} components and high has {len(self.high)}"
            raise ValueError(f"{counts}; an action has as many of both")
        for k, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            if not low < high:
                ends = f"low is {low:g} and high is {high:g} in component {k}"
                raise ValueError(f"{ends}; low must be below high")

    @cached_property
    def levels(self) -> tuple[int, ...]:
        """Cells along each component, which make few enough in all."""
        d = len(self.low)
        if d == 1:
            return (_LEVELS,)
        count = max(2, int(_CELLS ** (1.0 / d) + 1e-9))
        n_components = min(d, int(math.log2(_CELLS)))
        return (count,) * n_components + (1,) * (d - n_components)

    @cached_property
    def n_actions(self) -> int:
        """Number of cells."""
        return math.prod(self.levels)

    @cached_property
    def bounds(self) -> Floats:
        """(2, d) the lowest and the highest value of each component."""
        return np.array([self.low, self.high])

    @cached_property
    def half(self) -> Floats:
        """(d,) ndarray: half the range of each component."""
        return np.asarray(0.5 * (self.bounds[1] - self.bounds[0]))

    @cached_property
    def cells(self) -> Floats:
        """(2, n, d) ndarray: the lowest and the highest corner of each cell, in their order.

        After them stand the corners of the whole box, cells of no width.
        """
        components = zip(self.low, self.high, self.levels, strict=True)
        edges = [np.linspace(low, high, count + 1).tolist() for low, high, count in components]
        sides = [list(itertools.pairwise(axis)) for axis in edges]
        ends = [
            [(axis[0], axis[0]), (axis[-1], axis[-1])] if len(axis) > 2 else [(axis[0], axis[-1])]
            for axis in edges
        ]
        boxes = [*itertools.product(*sides), *itertools.product(*ends)]
        return np.ascontiguousarray(np.moveaxis(np.array(boxes), 2, 0))

    def clip(self, action: ArrayLike) -> Floats:
        """(..., d) ndarray: the actions of the set that are closest; NaN stays."""
        return np.asarray(np.minimum(np.maximum(action, self.bounds[0]), self.bounds[1]))

    def encode(self, action: ArrayLike) -> int:
        """Index of the cell in which an action (d,) lies; beyond the box, of the cell at its edge.

        The last component counts fastest.
        """
        share = (self.clip(self.checked("action", action)) - self.bounds[0]) / (2.0 * self.half)
        index = 0
        for part, count in zip(share.tolist(), self.levels, strict=True):
            index = index * count + min(int(part * count), count - 1)
        return index

    def checked(self, name: str, action: ArrayLike) -> Floats:
        """A new (d,) array of an action, whatever its values; another length is refused."""
        values = real_array(name, np.atleast_1d(action), 1)
        if len(values) != len(self.low):
            raise ValueError(f"{name} has {len(values)} components; it must have {len(self.low)}")
        return values


#: What can be executed: an interval of numbers, one of a few things, or a box of vectors.
ActionSet: TypeAlias = IntervalActions | Choices | BoxActions


def fixed(action: Action) -> Action:
    """An action that nobody can change any more: a float, or an array that is read only."""
    if isinstance(action, float | int) or np.ndim(action) == 0:
        return float(action)
    values = np.array(action, dtype=np.float64)
    values.setflags(write=False)
    return values


def same_action(one: Action, other: Action) -> bool:
    """Whether two actions are the same; NaN is no action, and the same as none."""
    equal = one == other
    return all(equal.tolist()) if isinstance(equal, np.ndarray) else bool(equal)


def no_action(actions: ActionSet) -> Action:
    """What stands where nothing is proposed: NaN, in a box a vector of it."""
    return np.full(len(actions.low), math.nan) if isinstance(actions, BoxActions) else math.nan


def put_into(actions: ActionSet, action: Action) -> Action:
    """The action of a set that is closest to one; a number stands for every component of a box."""
    if isinstance(actions, BoxActions):
        return actions.clip(action)
    return min(max(float(action), actions.low), actions.high)


def is_usable(actions: ActionSet, action: Action, mask: Mask | None = None) -> bool:
    """Whether an action is finite, and one of those allowed where there are only a few."""
    if isinstance(actions, BoxActions):
        return np.shape(action) == actions.half.shape and all(np.isfinite(action).tolist())
    if not math.isfinite(action) or (isinstance(actions, Choices) and action not in actions):
        return False
    return mask is None or bool(mask[int(action)])


def checked_mask(actions: ActionSet, mask: ArrayLike | None) -> Mask | None:
    """Which of a few actions are allowed; None where all are, or none, which tells nothing."""
    if mask is None:
        return None
    entries = np.asarray(mask)
    flags = entries == 1
    if not isinstance(actions, Choices) or flags.shape != (actions.n_actions,):
        fault = f"has shape {flags.shape}, but the guard has {actions}"
        hint = "it must have an entry for each of Choices"
        raise ValueError(f"the mask of allowed actions {fault}; {hint}")
    if not (flags | (entries == 0)).all():
        hint = "each entry must be True or False (a list of indices, or of texts?)"
        raise ValueError(f"the mask of allowed actions is {mask!r}; {hint}")
    return flags if 0 < flags.sum() < len(flags) else None


def limits(actions: ActionSet) -> tuple[Action, Action]:
    """Lowest and highest action: floats, or (d,) arrays."""
    return put_into(actions, -math.inf), put_into(actions, math.inf)


def written(action: Action) -> Any:
    """An action as JSON holds it: a number, or a list of them."""
    return float(action) if np.ndim(action) == 0 else np.asarray(action, np.float64).tolist()


def action_text(action: Action) -> str:
    """An action as people read it."""
    if np.ndim(action) == 0:
        return f"{action:g}"
    return f"({', '.join(f'{number:g}' for number in action)})"


def distances(actions: ActionSet, options: Floats, action: Action) -> Floats:
    """(k,) how far options are from an action, in its unit; in a box, as vectors of half ranges."""
    if isinstance(actions, BoxActions):
        return np.asarray(np.sqrt((((options - action) / actions.half) ** 2).sum(axis=-1)))
    return np.asarray(np.abs(options - action))


def change(actions: ActionSet, one: Action, other: Action) -> float:
    """How far apart two actions are, in half ranges of the set; of `Choices` 1 if they differ."""
    if same_action(one, other):
        return 0.0
    if isinstance(actions, Choices):
        return 1.0
    half = 1.0 if isinstance(actions, BoxActions) else 0.5 * (actions.high - actions.low)
    return float(distances(actions, np.asarray(one, np.float64), other)) / half


def nearest_bounds(actions: ActionSet) -> tuple[Floats, Floats]:
    """Between which values the nearest ones to a proposal are options: first the whole set.

    Then each interval or cell, and last the limits alone: where the nearest is not enough.
    """
    low, high = limits(actions)
    if isinstance(actions, BoxActions):
        lowest, highest = actions.cells
    elif isinstance(actions, Choices):
        lowest = highest = np.arange(actions.n_actions, dtype=np.float64)
    else:
        edges = actions.edges
        lowest = np.array([*edges[:-1], low, high])
        highest = np.array([*np.nextafter(edges[1:-1], -math.inf), high, low, high])
    return np.concatenate([[low], lowest]), np.concatenate([[high], highest])

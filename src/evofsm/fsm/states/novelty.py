"""A state wherever nothing like it was seen: centres cover the data, and stay where they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from evofsm.fsm.kernels import inner_kernel
from evofsm.fsm.states.clusters import CREATED, UNCHANGED, exceeds
from evofsm.fsm.validation import positive

CODE = 2

# Squares of observations over the scales, summed over a long run, must not overflow.
_SMALLEST_SCALE = 1e-20
_LARGEST_SCALE = 1e20


@dataclass(frozen=True)
class Novelty:
    """Create a state where every centre is farther than a radius; no centre ever moves.

    Distances are those of observations divided by ``scales``, so that a metre and a metre per
    second may count differently; observations and centres themselves stay in their units. The
    width of recognition is ``spread * radius**2``: beliefs stay local, however much was seen.

    Parameters
    ----------
    radius : float
        Distance, in scales, beyond which an observation creates a state. It takes the place of
        the machine's.
    scales : sequence of float
        For each of the m variables, the difference that counts as 1, in the variable's unit;
        empty: 1 for each.
    spread : float
        Width of recognition in squared radii: the similarity to a centre is
        ``exp(-distance^2 / (spread * radius^2))``. It takes the place of the machine's.

    Raises
    ------
    ValueError
        If a number is not positive and finite, or a scale lies outside 1e-20 to 1e20.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=1.0, scales=(2.0,)))
    >>> machine.learn_many([[0.0], [1.9], [2.1], [4.0]], [0, 0, 0, 0]).n_states
    array([1, 1, 2, 2])
    """

    radius: float = 1.0
    scales: Sequence[float] = ()
    spread: float = 1.0

    def __post_init__(self) -> None:
        scales = tuple(positive("a scale", scale) for scale in self.scales)
        for scale in scales:
            if not _SMALLEST_SCALE <= scale <= _LARGEST_SCALE:
                raise ValueError(f"a scale is {scale}; it must lie between 1e-20 and 1e20")
        object.__setattr__(self, "scales", scales)
        object.__setattr__(self, "radius", positive("radius", self.radius))
        object.__setattr__(self, "spread", positive("spread", self.spread))

    @property
    def table(self) -> Mapping[str, float]:
        """What the kernel judges by, in place of the machine's settings."""
        return {"code": CODE, "radius": self.radius, "spread": self.spread}


@inner_kernel
def judge(squared_distance: float, radius: float) -> int:
    """Create a state where the nearest centre is farther than the radius."""
    return CREATED if exceeds(squared_distance, radius * radius) else UNCHANGED


@inner_kernel
def width(spread: float, radius: float) -> float:
    """Width of recognition, whatever was seen."""
    return spread * radius * radius

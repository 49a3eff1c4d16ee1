"""CartPole-v1 of Gymnasium; it fails where the pole tips or the cart leaves the rail."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from evofsm.extras import needs
from studies.systems.rivals.pole import cart_shield
from studies.systems.system import Action, Discrete, Judge, Start, System, Vector

with needs("gymnasium", "gym", "CartPole-v1"):
    import gymnasium

# Further to the left than this the pole tips, for the hasty one [rad].
_TIPS_LEFT = -0.1
# Gains of the bad one: far too much for the angle's rate and the place.
_BAD_GAIN = np.array([1.0, 1.0, 8.0, 0.5])
# A push: how likely it begins in a step, for how many (the last is left out), and how strong [N].
_PUSH_BEGINS = 0.01
_PUSH_STEPS = (5, 16)
_PUSH_FORCE = (2.0, 5.0)


class CartPole(System):
    """500 steps; an action is 0 for left and 1 for right. The return counts the steps.

    Parameters
    ----------
    controller : str, optional
    gusts : bool
        Whether a hand pushes the cart now and then for a while, which no observation shows.
    """

    variables = ("x [m]", "speed [m/s]", "angle [rad]", "rate [rad/s]")
    actions = Discrete(2)
    interval = 0.02
    steps = 500

    def __init__(self, controller: str | None = None, *, gusts: bool = False) -> None:
        self.name = "cartpole-gusts" if gusts else "cartpole"
        self.train = 60 if gusts else 30
        self._gusts = gusts
        self._env = gymnasium.make("CartPole-v1").unwrapped
        self._force: float = self._env.force_mag  # type: ignore[attr-defined]
        super().__init__(controller)

    @property
    def controllers(self) -> Mapping[str, Callable[[Vector], Action]]:
        """Each by itself lets the pole fall in all but every episode."""
        return {
            "random": lambda z: int(self.whim.integers(2)),
            "hasty": lambda z: int(z[2] >= _TIPS_LEFT),
            "badgain": lambda z: int(z @ _BAD_GAIN > 0.0),
        }

    @property
    def rivals(self) -> Mapping[str, Callable[[], Judge]]:
        """Told the linear model."""
        return {"lqr-shield": lambda: cart_shield(self.actions)}

    def _begin(self, start: Start) -> None:
        self._seen, _ = self._env.reset(seed=int(self.chance.integers(2**31)))
        self._push, self._push_left = 0.0, 0

    def _observation(self) -> Vector:
        return np.asarray(self._seen, dtype=np.float64)

    def _advance(self, action: Action) -> tuple[float, bool]:
        push = self._pushed() if self._gusts else 0.0
        sign = 1.0 if action == 1 else -1.0
        self._env.force_mag = self._force + sign * push  # type: ignore[attr-defined]
        self._seen, _, failed, _, _ = self._env.step(int(action))
        return 1.0, bool(failed)

    def _pushed(self) -> float:
        """What the hand adds to the motor's force [N]."""
        if self._push_left == 0 and self.chance.random() < _PUSH_BEGINS:
            self._push_left = int(self.chance.integers(*_PUSH_STEPS))
            side = -1.0 if self.chance.random() < 0.5 else 1.0
            self._push = side * float(self.chance.uniform(*_PUSH_FORCE))
        if self._push_left == 0:
            return 0.0
        self._push_left -= 1
        return self._push

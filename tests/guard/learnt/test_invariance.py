"""It makes no difference in which order, unit, direction or from which zero numbers come.

Two guards learn side by side: one sees a system as it is, one sees it written otherwise. What they
decide is the same but for rounding.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest


@dataclass(frozen=True)
class Otherwise:
    """Variables in another order, unit and direction and from another zero; actions too."""

    variables: Any  #: (m,) order
    scale: Any  #: (m,)
    shift: Any  #: (m,)
    actions: Any  #: order of the numbers of an action, or indices of choices
    unit: Any = 1.0  #: of actions, negative where they point the other way
    zero: Any = 0.0

    @classmethod
    def drawn(cls, told, m, rng):
        """At random."""
        scale = rng.choice([-1.0, 1.0], m) * 10.0 ** rng.uniform(-6.0, 6.0, m)
        shift = np.abs(scale) * rng.uniform(-3.0, 3.0, m)
        if "n_actions" in told:
            return cls(rng.permutation(m), scale, shift, rng.permutation(told["n_actions"]))
        a = np.shape(told["low"])
        unit = rng.choice([-1.0, 1.0], a) * 10.0 ** rng.uniform(-2.0, 2.0, a)
        order = rng.permutation(a[0]) if a else ()
        return cls(rng.permutation(m), scale, shift, order, unit, rng.uniform(-5.0, 5.0, a))

    def told(self, told):
        """What a guard is told of the actions."""
        if "n_actions" in told:
            return told
        ends = np.sort([self.act(told, told["low"]), self.act(told, told["high"])], axis=0)
        low, high = ends if np.ndim(told["low"]) else ends.tolist()
        return {"low": low, "high": high}

    def see(self, z):
        """An observation."""
        return (z * self.scale + self.shift)[self.variables]

    def act(self, told, action):
        """An action."""
        if "n_actions" in told:
            return int(self.actions[action])
        written = np.multiply(action, self.unit) + self.zero
        return written[self.actions] if np.ndim(written) else float(written)

    def back(self, told, action):
        """The action that is written so."""
        if "n_actions" in told:
            return int(np.argsort(self.actions)[action])
        straight = action[np.argsort(self.actions)] if np.ndim(action) else action
        return (straight - self.zero) / self.unit


SEEDS = [*range(2), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))]


@pytest.mark.parametrize("seed", SEEDS)
def test_points_are_kept_from_the_wall_however_they_are_written(point, seed):
    told, changed, rng = point.told, [], np.random.default_rng(seed)
    otherwise = Otherwise.drawn(told, 2 * point.places + 1, rng)
    pair = [type(point)(one, point.places).guard(seed=seed) for one in (told, otherwise.told(told))]
    for episode in range(4):
        steps = point.walk(1000 * seed + episode, steps=40)
        z, proposal, failed = next(steps)
        load = rng.normal()  # which differs from episode to episode alone
        while proposal is not None:
            z = np.append(z, load)
            said = pair[0].decide(z, proposal)
            again = pair[1].decide(otherwise.see(z), otherwise.act(told, proposal))
            back = otherwise.back(told, again.executed)
            np.testing.assert_allclose(back, said.executed, rtol=0, atol=1e-5, err_msg=said.reason)
            changed.append(not np.array_equal(said.executed, said.proposed))
            z, proposal, failed = steps.send(said.executed)
        pair[0].end(failed, z := np.append(z, load))
        pair[1].end(failed, otherwise.see(z))
    assert np.mean(changed) > 0.05

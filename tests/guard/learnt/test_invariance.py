"""It makes no difference in which order, unit, direction or from which zero numbers come.

Two guards learn side by side: one sees a system as it is, one sees it written otherwise. What they
decide is the same but for rounding.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

DT = 0.1


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
    def drawn(cls, told, m, rng, exact=False):
        """At random; ``exact``: so that no number is rounded."""
        sign = rng.choice([-1.0, 1.0], m)
        if exact:
            everywhere = np.arange(m), np.arange(told.get("n_actions", np.size(told.get("low"))))
            scale = sign * 2.0 ** rng.integers(-30, 30, m)
            return cls(everywhere[0], scale, np.zeros(m), everywhere[1])
        scale = sign * 10.0 ** rng.uniform(-6.0, 6.0, m)
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


def side_by_side(told, walk, pair, otherwise, episodes):
    """Pairs of revisions of two guards that learn from the same episodes.

    ``walk`` begins an episode: a generator of observation, proposal (None at its end) and failure.
    """
    one, other = pair
    for episode in range(episodes):
        steps = walk(episode)
        z, proposal, failed = next(steps)
        while proposal is not None:
            said = one.decide(z, proposal)
            again = other.decide(otherwise.see(z), otherwise.act(told, proposal))
            yield said, again
            z, proposal, failed = steps.send(said.executed)
        one.end(failed, z)
        other.end(failed, otherwise.see(z))


def compare(told, walk, make, otherwise, episodes, exact=False):
    """The share of proposals that were not kept; fails where two decide otherwise."""
    pair = make(told), make(otherwise.told(told))
    changed = []
    for said, again in side_by_side(told, walk, pair, otherwise, episodes):
        back = otherwise.back(told, again.executed)
        if exact:
            np.testing.assert_array_equal(back, said.executed)
            np.testing.assert_array_equal(again.risk_executed, said.risk_executed)
        else:
            np.testing.assert_allclose(back, said.executed, rtol=0, atol=1e-5, err_msg=said.reason)
        changed.append(not np.array_equal(said.executed, said.proposed))
    return np.mean(changed)


SEEDS = [*range(2), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 10))]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("exact", [False, True], ids=["rounded", "exact"])
def test_points_are_kept_from_the_wall_however_they_are_written(point, seed, exact):
    told = point.told
    otherwise = Otherwise.drawn(told, 2 * point.places, np.random.default_rng(seed), exact)

    def make(told):
        return type(point)(told, point.places).guard(seed=seed)

    def walk(episode):
        return point.walk(1000 * seed + episode, steps=40)

    assert compare(told, walk, make, otherwise, 4, exact) > 0.05


@pytest.mark.parametrize("seed", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_noise_is_the_same_however_it_is_written(noisy, seed):
    otherwise, made = Otherwise.drawn(noisy.told, 2, np.random.default_rng(seed)), []

    def make(told):
        made.append(type(noisy)(told).guard(seed=seed))
        return made[-1]

    def walk(episode):
        return noisy.walk(1000 * seed + episode, steps=40)

    assert compare(noisy.told, walk, make, otherwise, 20) > 0.05
    assert all(guard.judge.dynamics.is_noisy for guard in made)


# Where two backups are all but equal, rounding may decide, and parts the two ways of writing for
# good: that happens in the pendulum's fourth episode with seed 0, which is left out.
@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("name", ["acc", "cartpole", "pendulum", "tanks", "reactor", "emergency"])
def test_systems_are_learnt_however_they_are_written(name, seed):
    pytest.importorskip("gymnasium")
    from studies.systems import Start, make_system

    from evofsm.guard import Guard

    # Pumps that always do the same, or actions that are never taken, as under the first controllers
    # of these, cannot be told apart but by their order.
    system = make_system(name, {"tanks": "wander", "reactor": "random"}.get(name))
    told, m = system.actions.settings, len(system.variables)
    otherwise = Otherwise.drawn(told, m, np.random.default_rng(seed))

    def make(told):
        return Guard(**told, interval=system.interval, seed=seed)

    def walk(episode):
        z, _ = system.reset(options={"start": Start.training(1, seed, episode)})
        over = failed = False
        while not over:
            executed = yield z, system.propose(z), False
            z, _, failed, truncated, _ = system.step(executed)
            over = failed or truncated
        yield z, None, failed

    assert compare(told, walk, make, otherwise, 4) > 0.0

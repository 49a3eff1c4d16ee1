"""It makes no difference in which order, unit, direction or from which zero numbers come.

Two guards learn side by side: one sees a system as it is, one sees it written otherwise. What they
decide is the same but for rounding.
"""

import numpy as np
import pytest


def write_otherwise(told, m, rng):
    """Variables in another order, unit and direction and from another zero; actions too.

    How an observation is seen, what a guard is told, how an action is written, and read back.
    """
    scale = rng.choice([-1.0, 1.0], m) * 10.0 ** rng.uniform(-6.0, 6.0, m)
    shift, variables = np.abs(scale) * rng.uniform(-3.0, 3.0, m), rng.permutation(m)

    def see(z):
        return (z * scale + shift)[variables]

    if "n_actions" in told:
        choices = rng.permutation(told["n_actions"])
        return see, told, choices.item, np.argsort(choices).item
    a = np.shape(told["low"])
    unit = rng.choice([-1.0, 1.0], a) * 10.0 ** rng.uniform(-2.0, 2.0, a)
    order, zero = rng.permutation(a[0]) if a else (), rng.uniform(-5.0, 5.0, a)

    def write(action):
        return (np.multiply(action, unit) + zero)[order].tolist()

    def read(action):
        return (np.asarray(action)[np.argsort(order) if a else ()] - zero) / unit

    low, high = np.sort([write(told["low"]), write(told["high"])], axis=0).tolist()
    return see, {"low": low, "high": high}, write, read


SEEDS = [*range(2), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))]


@pytest.mark.parametrize("seed", SEEDS)
def test_points_are_kept_from_the_wall_however_they_are_written(point, seed):
    told, changed, rng = point.told, [], np.random.default_rng(seed)
    see, told_otherwise, write, read = write_otherwise(told, 2 * point.places + 1, rng)
    pair = [type(point)(one, point.places).guard(seed=seed) for one in (told, told_otherwise)]
    for episode in range(4):
        steps = point.walk(1000 * seed + episode, steps=40)
        z, proposal, failed = next(steps)
        load = rng.normal()  # which differs from episode to episode alone
        while proposal is not None:
            z = np.append(z, load)
            said = pair[0].decide(z, proposal)
            back = read(pair[1].decide(see(z), write(proposal)).executed)
            np.testing.assert_allclose(back, said.executed, rtol=0, atol=1e-5, err_msg=said.reason)
            changed.append(not np.array_equal(said.executed, said.proposed))
            z, proposal, failed = steps.send(said.executed)
        pair[0].end(failed, z := np.append(z, load))
        pair[1].end(failed, see(z))
    assert np.mean(changed) > 0.05

"""A scene made up for these tests: things come towards one on a road of a few lanes."""

import numpy as np
import pytest

from evofsm.guard import Guard, SceneRisk

LEFT, STAY, RIGHT = range(3)
THINGS, STEPS = 3, 25
HALF = np.array([2.0, 0.6])  # of the box around each other that fails


class Rain:
    """Rows of presence, place (2) and speed; things come from ahead and never change lanes."""

    columns = 4

    def __init__(self, *, relative=True, shuffled=False, scale=(1.0, 1.0), steps=STEPS, **rest):
        self.relative, self.shuffled, self.scale = relative, shuffled, np.array(scale)
        self.steps = steps
        self.moves, self.lanes = rest.get("moves", 1.0), rest.get("lanes", 5)

    def judge(self, **told):
        return SceneRisk(1.0, 3, columns=self.columns, relative=self.relative, **told)

    def guard(self, **told):
        return Guard(n_actions=3, interval=1.0, judge=self.judge(), **told)

    def play(self, guard, seed):
        """Revisions of an episode under a policy that moves now and then, and whether it failed."""
        random, whim = np.random.default_rng(seed), np.random.default_rng([seed, 1])
        lane, said = self.lanes // 2, []
        place = np.column_stack(
            [random.uniform(20, 60, THINGS), random.integers(self.lanes, size=THINGS)]
        )
        speed = random.uniform(4.0, 8.0, THINGS)
        failed = False
        for _ in range(self.steps):
            row = self.seen(lane, place, speed, random)
            wanted = int(random.integers(3)) if whim.random() < self.moves else STAY
            said.append(guard.decide(row, wanted))
            then = int(np.clip(lane + said[-1].executed - 1, 0, self.lanes - 1))
            start, end = place - [0.0, lane], place - [0.0, then]
            end[:, 0] -= speed
            place[:, 0] -= speed
            lane = then
            way = np.linspace(0.0, 1.0, 50)[:, None, None]
            failed = bool((np.abs(start + way * (end - start)) < HALF).all(-1).any())
            if failed:
                break
            gone = place[:, 0] < -10.0
            place[gone] = np.column_stack(
                [random.uniform(40, 70, gone.sum()), random.integers(self.lanes, size=gone.sum())]
            )
            speed[gone] = random.uniform(4.0, 8.0, gone.sum())
        guard.end(failed, self.seen(lane, place, speed, random))
        return said, failed

    def seen(self, lane, place, speed, random):
        """The observation, flattened."""
        own = np.array([1.0, 0.0, lane, 0.0])
        rows = np.column_stack([np.ones(THINGS), place, -speed])
        if self.relative:
            rows[:, 1:] -= own[1:]
        if self.shuffled:
            random.shuffle(rows)
        seen = np.vstack([own, rows])
        seen[:, 1:3] *= self.scale
        return seen.ravel()


@pytest.fixture
def rain():
    return Rain


@pytest.fixture(scope="session")
def taught():
    """A guard that has learnt from some episodes, and is frozen."""
    world = Rain()
    guard = world.guard()
    for seed in range(12):
        world.play(guard, seed)
    guard.freeze()
    return guard

"""Points that a wind drives towards a wall: small systems that are learnt in a few episodes."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from evofsm import Guard

DT = 0.1
_WALL = 1.0
_PUSHES = np.array([-1.0, 0.0, 1.0])


@dataclass(frozen=True)
class Point:
    """Fails where its first place reaches the wall; its controller pushes it there.

    An observation is all places, then all speeds.
    """

    told: dict[str, Any] = field(default_factory=lambda: {"low": -1.0, "high": 1.0})
    places: int = 1

    def guard(self, **others):
        """One that knows nothing yet."""
        return Guard(**self.told, interval=DT, **({"horizon": 1.2} | others))

    def propose(self, rng):
        """What the controller wants, at random."""
        match self.told:
            case {"n_actions": count}:
                return int(rng.choice(count, p=[0.1, 0.3, 0.6]))
            case {"low": float()}:
                return float(rng.uniform(-0.2, 1.0))
        return rng.uniform([-0.2, -1.0], 1.0)

    def walk(self, episode, steps=60):
        """Observations of an episode; the executed action has to be sent, None at its end."""
        rng = np.random.default_rng(episode)
        place, speed = rng.uniform(-0.3, 0.3, self.places), np.zeros(self.places)
        wind = 0.0
        for _ in range(steps):
            executed = yield np.concatenate([place, speed]), self.propose(rng), False
            push = _PUSHES[executed] if "n_actions" in self.told else np.atleast_1d(executed)
            wind = 0.9 * wind + 0.01 * rng.normal()
            speed = 0.9 * speed + 0.02 * push + 0.01 * wind
            place = place + speed
            if place[0] >= _WALL:
                break
        yield np.concatenate([place, speed]), None, bool(place[0] >= _WALL)

    def play(self, guard, episode, steps=60, seen=lambda k, z: z):
        """Revisions of an episode, and whether it failed."""
        said, walk = [], self.walk(episode, steps)
        z, proposal, failed = next(walk)
        while proposal is not None:
            said.append(guard.decide(seen(len(said), z), proposal))
            z, proposal, failed = walk.send(said[-1].executed)
        guard.end(failed, seen(len(said), z))
        return said, failed

    def taught(self, count=3, **others):
        """A guard that learnt from so many episodes; each seed has its own."""
        guard = self.guard(**others)
        for episode in range(count):
            self.play(guard, 1000 * guard.judge.seed + episode)
        return guard


POINTS = {
    "box": Point(),
    "plane": Point({"low": -np.ones(2), "high": np.ones(2)}, places=2),
    "choices": Point({"n_actions": 3}),
}


@pytest.fixture(
    params=["box", *(pytest.param(name, marks=pytest.mark.slow) for name in ("plane", "choices"))]
)
def point(request):
    """Each of them; of the quick tests one is enough."""
    return POINTS[request.param]


@pytest.fixture(scope="session")
def points():
    """All of them, by name."""
    return POINTS

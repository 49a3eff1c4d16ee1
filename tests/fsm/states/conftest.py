import numpy as np
import pytest

from evofsm.fsm.states.edges import Edges
from evofsm.fsm.states.failure import FailureSplit
from evofsm.fsm.states.novelty import Novelty
from evofsm.fsm.states.paper import Paper

RULES = {
    "paper": Paper(),
    "edges": Edges(),
    "novelty": Novelty(radius=1.5, scales=(2.0, 0.5), spread=0.7),
    "failure": FailureSplit(Novelty(radius=3.0), share=0.8, distance=0.3),
    "failure on edges": FailureSplit(Edges(), distance=0.1),
}


@pytest.fixture(params=RULES.values(), ids=RULES.keys())
def rule(request):
    return request.param


@pytest.fixture(scope="session")
def walk():
    """Observations of a random walk, actions with gaps, starts and failures of episodes."""

    def make(rows, seed=0):
        rng = np.random.default_rng(seed)
        Z = np.cumsum(rng.normal(size=(rows, 2)), axis=0)
        failures = np.flatnonzero(rng.random(rows) < 0.1)
        return Z, rng.integers(-1, 3, rows), [rows // 3], failures

    return make

import hypothesis
import numpy as np
import pytest

from evofsm import EvolvingFSM

# The same examples in every run, so that a red build is red again on the next machine.
hypothesis.settings.register_profile("evofsm", deadline=None, derandomize=True, database=None)
hypothesis.settings.load_profile("evofsm")


@pytest.fixture(scope="session")
def spiral():
    """Observations that close in on their mean, so that every second one founds a state."""

    def make(rows):
        t = np.arange(rows)
        radius = 8.0 * (1.0 - t / rows) * (-1.0) ** t
        return np.column_stack([radius, 0.5 * radius])

    return make


@pytest.fixture(scope="session")
def compiled():
    """All that a watched run needs is compiled, for tests that wait for some seconds only."""
    from evofsm.studies.watching import Session, Watching, learn_first, watched_learner
    from evofsm.worlds.families import load_family
    from evofsm.worlds.kinematic import KinematicWorld

    watching = Watching(load_family("paper"))
    learner = watched_learner(watching.family)
    learn_first(watching, learner, 2)
    with Session(watching, learner, KinematicWorld()) as session:
        while not session.step().over:
            session.graph()


@pytest.fixture
def snapshot(tmp_path):
    """Everything a machine holds, byte for byte: what it would write to a file."""

    def take(machine):
        path = tmp_path / "snapshot"
        machine.save(path)
        with np.load(path) as archive:
            return {name: (archive[name].shape, archive[name].tobytes()) for name in archive.files}

    return take


@pytest.fixture
def grown(spiral):
    """A machine in mid-episode, with an action pending and every array in use."""
    machine = EvolvingFSM(n_actions=3, radius=0.01)
    Z = spiral(40)
    machine.learn_many(Z, np.arange(40) % 3, [0, 25])
    assert machine.n_states > 8
    return machine

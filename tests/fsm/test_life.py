"""The whole public life of a machine, in any order."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.model import FSMModel
from evofsm.fsm.rules import Novelty, Paper
from one_machine import saved as everything

M, Q = 2, 3
ROUNDING = 1e-9
# A coarse grid, so that many observations are equal, and now and then any number.
NUMBERS = st.one_of(
    st.integers(-24, 24).map(lambda k: k / 8),
    st.floats(-1e100, 1e100),
    st.sampled_from([0.0, -0.0, 5e-324, 1e-200, -1e100, 1e100]),
)
OBSERVATIONS = st.tuples(NUMBERS, NUMBERS)
ACTIONS = st.integers(0, Q - 1)
RULES = st.sampled_from([Paper(), Novelty(2.0)])
QUESTIONS = (
    *("belief", "state", "n_states", "state_ids", "centers", "potentials", "transition_matrices"),
    *("marginal_matrix", "joint_frequency", "origin_frequency", "decisions", "failures"),
    *("endings", "nbytes"),
)


def assert_distributions(rows):
    assert (rows >= 0.0).all()
    np.testing.assert_allclose(rows.sum(axis=-1), 1.0, rtol=0, atol=ROUNDING)


class Life(RuleBasedStateMachine):
    """A machine that grows, and a twin that is asked nothing."""

    @initialize(
        state_rule=RULES,
        most=st.sampled_from([None, 1, 2, 4]),
        tolerance=st.sampled_from([0.0, 1e-6]),
    )
    def begin(self, state_rule, most, tolerance):
        self.machine = EvolvingFSM(
            Q, rule=state_rule, learning_rate=0.3, max_states=most, belief_tolerance=tolerance
        )
        self.twin = self.machine.copy()
        self.most = most

    def both(self, do):
        """Do the same to the machine and to its twin, which answer the same."""
        mine, other = do(self.machine), do(self.twin)
        told = (tuple(one) if isinstance(one, tuple) else one for one in (mine, other))
        assert len(set(map(repr, told))) == 1
        return mine

    # -- What may be done ----------------------------------------------------------------------

    @rule(z=OBSERVATIONS, failed=st.booleans())
    def observe(self, z, failed):
        step = self.both(lambda machine: machine.observe(z, failed=failed))
        assert_distributions(step.belief)
        assert step.belief[step.state] == step.belief.max()
        assert np.isnan(step.surprise) or 0.0 <= step.surprise <= 1.0
        assert len(step.predicted) == 0 or len(step.predicted) <= len(step.belief)

    @rule(i=ACTIONS)
    def act(self, i):
        assume(self.machine.state is not None)
        self.both(lambda machine: machine.act(i))

    @rule(z=OBSERVATIONS, i=ACTIONS)
    def learn_one(self, z, i):
        self.both(lambda machine: machine.learn_one(z, i))

    @rule(
        data=st.data(), rows=st.lists(st.tuples(OBSERVATIONS, st.integers(-1, Q - 1)), max_size=8)
    )
    def learn_many(self, data, rows):
        Z = np.array([z for z, _ in rows]).reshape(-1, M)
        I = np.array([i for _, i in rows], dtype=int)
        some = st.sets(st.integers(0, max(len(rows) - 1, 0)), max_size=2 if rows else 0)
        starts, failures = sorted(data.draw(some)), sorted(data.draw(some))
        self.both(lambda machine: machine.learn_many(Z, I, starts, failures, belief=True))

    @rule()
    def start_episode(self):
        self.both(lambda machine: machine.start_episode())

    @rule()
    def fail(self):
        assume(self.machine.state is not None)
        self.both(lambda machine: machine.fail())

    # -- What changes nothing ------------------------------------------------------------------

    @rule(
        i=ACTIONS,
        horizon=st.sampled_from([1, 2, 50]),
        policy=st.sampled_from(["marginal", "hold", "observed"]),
    )
    def predict(self, i, horizon, policy):
        before = everything(self.machine)
        forecast = self.machine.predict(i, horizon, policy)
        assert forecast.shape == (self.machine.n_states,)
        if len(forecast):
            assert_distributions(forecast)
        assert everything(self.machine) == before

    @rule(name=st.sampled_from(QUESTIONS))
    def ask(self, name):
        before = everything(self.machine)
        answer = getattr(self.machine, name)
        if isinstance(answer, np.ndarray) and answer.size:  # it is the asker's own
            answer[...] = 7
        assert everything(self.machine) == before

    @precondition(lambda self: self.machine.n_states)
    @rule(z=OBSERVATIONS)
    def snapshot(self, z):
        before = everything(self.machine)
        model = self.machine.model()
        assert_distributions(model.recognise(z))
        assert_distributions(model.propagate(self.machine.belief, 0, 3))
        assert everything(self.machine) == before

    # -- Going away and coming back ------------------------------------------------------------

    @rule()
    def save_and_load(self):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "machine"
            self.machine.save(path)
            self.machine = EvolvingFSM.load(path)
            self.machine.model().save(path)
            FSMModel.load(path)
            with pytest.raises(ValueError, match="model"):
                EvolvingFSM.load(path)

    @rule()
    def copy(self):
        copy = self.machine.copy()
        copy.learn_many(np.ones((4, M)), [0] * 4)  # what becomes of a copy is its own
        self.machine = self.machine.copy()

    # -- What holds always ---------------------------------------------------------------------

    @invariant()
    def rows_are_distributions(self):
        machine = self.machine
        assert self.most is None or machine.n_states <= self.most
        if machine.n_states:
            assert_distributions(machine.belief)
            assert_distributions(machine.transition_matrices)
            assert_distributions(machine.marginal_matrix)

    @invariant()
    def all_is_finite(self):
        for name in ("centers", "potentials", "origin_frequency", "decisions", "failures"):
            assert np.isfinite(getattr(self.machine, name)).all()
        assert (self.machine.failures <= self.machine.decisions + ROUNDING).all()

    @invariant()
    def the_twin_is_the_same(self):
        assert everything(self.machine) == everything(self.twin)


@pytest.mark.slow
def test_whatever_happens_in_its_life_a_machine_stays_sound():
    run_state_machine_as_test(
        Life,
        settings=settings(
            max_examples=25,
            stateful_step_count=15,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
        ),
    )

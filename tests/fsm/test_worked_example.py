"""The paper's worked example (Sections 2.1.4 and 2.3.2): states created at t = 1, 3 and 12."""

import numpy as np
import pytest

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.step import Event

PHI, EPS = 0.1, 1e-3
OBSERVATIONS = np.array([-3, 0, -1, -2, -0.5, -0.5, 3.5, -0.5, 3.5, 1, 4, 0])[:, None]
# a(1) is 0 and a(2) is 1: the action taken after t = 1, 2, ..., 11.
ACTIONS = [0, 1, 0, 0, 1, 1, 0, 1, 0, 1, 0]


def new_machine():
    return EvolvingFSM(n_actions=2, radius=0.5, learning_rate=PHI, prior_frequency=EPS)


def bordered(F):
    """The paper's first step of the expansion: a row and a column of the prior frequency."""
    return np.pad(F, (0, 1), constant_values=EPS)


def by_hand(beliefs, events, actions):
    """F and F_o of both actions by the paper's equations, from the beliefs at t = 1, 2, ..."""
    F = [np.array([[EPS]]), np.array([[EPS]])]
    F_o = [np.array([EPS]), np.array([EPS])]
    for t in range(1, len(beliefs)):
        tau, gamma = beliefs[t - 1], beliefs[t]
        if events[t] == Event.CREATED:
            n = len(gamma)
            F = [bordered(f) for f in F]
            F_o = [np.append(f_o + EPS, n * EPS) for f_o in F_o]
            tau = np.append(tau, 0.0)
        r = actions[t - 1]
        F[r] = F[r] + PHI * (np.outer(tau, gamma) - F[r])
        F_o[r] = F_o[r] + PHI * (np.outer(tau, gamma) @ np.ones(len(gamma)) - F_o[r])
    return np.array(F), np.array(F_o)


def assert_same_to_rounding(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=1e-14, atol=0)


@pytest.fixture
def eleven():
    """The machine at t = 11, before any action there, and its eleven steps."""
    machine = new_machine()
    steps = [machine.learn_one(z, r) for z, r in zip(OBSERVATIONS[:10], ACTIONS, strict=False)]
    steps.append(machine.observe(OBSERVATIONS[10]))
    return machine, steps


def test_states_are_created_at_1_3_and_12():
    trace = new_machine().learn_many(OBSERVATIONS, [*ACTIONS, 0])
    assert (np.flatnonzero(trace.event == Event.CREATED) + 1).tolist() == [1, 3, 12]
    assert trace.n_states.tolist() == [1, 1, 2, 2, 2, 2, 2, 2, 2, 2, 2, 3]


def test_frequencies_at_11_are_those_of_the_papers_recursion(eleven):
    machine, steps = eleven
    F, F_o = by_hand([s.belief for s in steps], [s.event for s in steps], ACTIONS)
    assert_same_to_rounding(machine.joint_frequency, F)
    assert_same_to_rounding(machine.origin_frequency, F_o)
    assert_same_to_rounding(machine.transition_matrices, F / F_o[:, :, None])


def test_a_new_state_borders_every_matrix_with_the_prior_frequency(eleven):
    machine, _ = eleven
    F, F_o = machine.joint_frequency, machine.origin_frequency
    assert machine.observe(OBSERVATIONS[11]).event == Event.CREATED  # no action: expansion only
    assert_same_to_rounding(machine.joint_frequency, [bordered(F[0]), bordered(F[1])])
    assert_same_to_rounding(
        machine.origin_frequency,
        [[F_o[r, 0] + EPS, F_o[r, 1] + EPS, 3 * EPS] for r in (0, 1)],
    )


@pytest.mark.parametrize("taken", [0, 1])
def test_only_the_action_that_was_taken_also_learns_the_way_into_the_new_state(eleven, taken):
    machine, steps = eleven
    F, F_o = machine.joint_frequency, machine.origin_frequency
    machine.act(taken)
    gamma = machine.observe(OBSERVATIONS[11]).belief
    other = 1 - taken
    assert_same_to_rounding(machine.joint_frequency[other], bordered(F[other]))
    assert_same_to_rounding(machine.origin_frequency[other], [*(F_o[other] + EPS), 3 * EPS])
    tau = np.append(steps[-1].belief, 0.0)
    assert_same_to_rounding(
        machine.joint_frequency[taken],
        (1 - PHI) * bordered(F[taken]) + PHI * np.outer(tau, gamma),
    )
    assert_same_to_rounding(
        machine.origin_frequency[taken],
        (1 - PHI) * np.array([*(F_o[taken] + EPS), 3 * EPS]) + PHI * tau,
    )

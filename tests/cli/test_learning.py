"""Learning from chunks: the same in any size."""

import math

import numpy as np
import pytest

from evofsm import EvolvingFSM, IntervalActions, Novelty
from evofsm.cli.inspect import passages
from evofsm.cli.learning import learn_traces
from evofsm.io import Chunk

ACTIONS = IntervalActions(-1.0, 1.0, 0.5, outside="clip")
STARTS = [0, 37, 38, 150]


@pytest.fixture
def trace():
    """Two hundred rows in four episodes, with unknown actions in some."""
    random = np.random.default_rng(7)
    Z = np.cumsum(random.normal(size=(200, 2)), axis=0)
    actions = np.clip(random.normal(scale=0.7, size=200), -1.5, 1.5)
    actions[[36, 77, 149, 199]] = np.nan
    return Z, actions


def machine(**settings):
    return EvolvingFSM(ACTIONS.n_actions, **{"radius": 0.2, "spread": 0.2, **settings})


def chunks(Z, actions, starts=STARTS, size=1000):
    """The trace in chunks of a size."""
    starts = np.array(starts)
    for first in range(0, len(Z), size):
        inside = starts[(starts >= first) & (starts < first + size)] - first
        rows = slice(first, first + size)
        times = 0.1 * np.arange(len(Z))[rows]
        yield Chunk("made up", Z[rows], actions[rows], times, inside, 0.1)


@pytest.mark.parametrize("size", [1, 7, 64])
def test_chunks_of_any_size_learn_what_one_does(trace, snapshot, size):
    learnt, whole = (
        learn_traces(chunks(*trace, size=rows), machine(), ACTIONS) for rows in (size, 200)
    )
    assert whole.model.n_states > 3
    assert snapshot(learnt.machine) == snapshot(whole.machine)


def test_a_transition_goes_from_where_one_was_to_where_one_came():
    Z = np.tile([[0.0], [10.0], [30.0]], (40, 1))
    fsm = EvolvingFSM(ACTIONS.n_actions, rule=Novelty(1.0, [2.0]))
    learnt = learn_traces(chunks(Z, np.zeros(120), [0]), fsm, ACTIONS)
    found = {(one.origin, one.target): one.times for one in passages(learnt.model)}
    assert found == {(0, 1): 40, (1, 2): 40, (2, 0): 39}
    assert len(passages(learnt.model, 2)) == 2  # the most frequent ones, not their mirror images


def test_one_state_has_no_transitions():
    learnt = learn_traces(chunks(np.zeros((200, 2)), np.zeros(200), [0]), machine(), ACTIONS)
    assert learnt.model.n_states == 1
    assert passages(learnt.model) == []


def test_what_cannot_be_learnt_is_refused(trace):
    Z, actions = trace
    with pytest.raises(ValueError, match="no transition could be learnt"):
        learn_traces(chunks(Z, actions, range(200)), machine(), ACTIONS)
    Z[130, 1] = math.nan
    with pytest.raises(ValueError, match="variable 1: nan"):
        learn_traces(chunks(Z, actions, size=100), machine(), ACTIONS)

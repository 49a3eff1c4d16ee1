"""What holds for every rule."""

import copy
import json
import pickle
from dataclasses import FrozenInstanceError, fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.model import FSMModel
from evofsm.fsm.states.dispatch import describe_rule, register_rule, restore_rule
from evofsm.fsm.states.edges import Edges
from evofsm.fsm.states.failure import FailureSplit
from evofsm.fsm.states.novelty import Novelty
from evofsm.fsm.states.paper import Paper
from evofsm.fsm.step import Event

LEARNT = (
    *("centers", "potentials", "transition_matrices", "origin_frequency", "belief"),
    *("decisions", "failures", "endings"),
)


def learn_in_a_loop(machine, Z, I, starts, failures):
    steps = []
    for row, (z, i) in enumerate(zip(Z, I, strict=True)):
        if row in starts:
            machine.start_episode()
        steps.append(machine.observe(z, failed=row in failures))
        if i >= 0 and row not in failures:
            machine.act(i)
    return steps


def assert_same_trace(trace, steps):
    assert trace.state.tolist() == [s.state for s in steps]
    assert trace.n_states.tolist() == [len(s.belief) for s in steps]
    assert trace.event.tolist() == [s.event for s in steps]
    assert trace.surprise.tobytes() == np.array([s.surprise for s in steps]).tobytes()


def test_a_batch_is_the_loop_bit_for_bit(rule, walk, snapshot):
    batch, loop = EvolvingFSM(3, rule=rule), EvolvingFSM(3, rule=rule)
    stream = walk(400)
    trace = batch.learn_many(*stream)
    assert_same_trace(trace, learn_in_a_loop(loop, *stream))
    assert snapshot(batch) == snapshot(loop)


bases = st.one_of(
    st.just(Paper()),
    st.just(Edges()),
    st.builds(
        Novelty,
        radius=st.sampled_from([0.3, 1.0, 3.0]),
        scales=st.sampled_from([(), (1.0, 1.0), (0.5, 3.0)]),
        spread=st.sampled_from([0.1, 1.0]),
    ),
)
rules = bases | st.builds(
    FailureSplit,
    base=bases,
    share=st.sampled_from([0.1, 0.5, 1.0]),
    distance=st.sampled_from([0.01, 0.5]),
)


@st.composite
def streams(draw):
    """Observations on a coarse grid (so that many are equal), actions, starts and failures."""
    number = st.integers(-32, 32).map(lambda k: k / 8)
    rows = draw(st.lists(st.tuples(number, number), min_size=1, max_size=50))
    I = draw(st.lists(st.integers(-1, 2), min_size=len(rows), max_size=len(rows)))
    some = st.lists(st.integers(0, len(rows) - 1), max_size=5)
    return np.array(rows), np.array(I), draw(some), draw(some)


@given(rules, streams())
def test_that_holds_for_every_stream_and_what_is_learnt_is_sound(rule, stream):
    batch, loop = EvolvingFSM(3, rule=rule), EvolvingFSM(3, rule=rule)
    trace = batch.learn_many(*stream, belief=True)
    assert_same_trace(trace, learn_in_a_loop(loop, *stream))
    for name in LEARNT:
        assert getattr(batch, name).tobytes() == getattr(loop, name).tobytes()
    assert (np.diff(trace.n_states, prepend=0) == (trace.event == Event.CREATED)).all()
    for rows in (batch.transition_matrices, batch.belief, trace.belief):
        np.testing.assert_allclose(rows.sum(axis=-1), 1.0, rtol=0, atol=1e-9)
    assert ((batch.potentials > 0.0) & (batch.potentials <= 1.0)).all()
    assert batch.decisions.sum() == pytest.approx((~np.isnan(trace.surprise)).sum())
    assert (batch.failures <= batch.decisions).all()
    assert batch.endings.sum() == len(set(stream[3]))


@given(rules, streams(), st.permutations(range(3)))
def test_other_labels_for_the_actions_permute_what_is_learnt(rule, stream, labels):
    Z, I, starts, failures = stream
    machine, relabelled = EvolvingFSM(3, rule=rule), EvolvingFSM(3, rule=rule)
    a = machine.learn_many(Z, I, starts, failures)
    b = relabelled.learn_many(Z, np.array([*labels, -1])[I], starts, failures)
    for one, other in zip(a[:4], b[:4], strict=True):
        assert one.tobytes() == other.tobytes()
    for name in ("transition_matrices", "origin_frequency", "decisions", "failures"):
        assert getattr(relabelled, name)[list(labels)].tobytes() == getattr(machine, name).tobytes()
    assert relabelled.endings.tobytes() == machine.endings.tobytes()


def saved(machine, path):
    machine.save(path)
    return EvolvingFSM.load(path)


def pickled(machine, path):
    return pickle.loads(pickle.dumps(machine))


def copied(machine, path):
    return copy.deepcopy(machine)


@pytest.mark.slow
@pytest.mark.parametrize("rows", [0, 1, 300])
@pytest.mark.parametrize("again", [saved, pickled, copied])
def test_a_machine_that_was_kept_goes_on_bit_for_bit(again, rows, rule, walk, snapshot, tmp_path):
    machine = EvolvingFSM(3, rule=rule)
    Z, I, _, failures = walk(600)
    machine.learn_many(Z[:rows], I[:rows], [], [r for r in failures if r < rows - 1])
    kept = again(machine, tmp_path / "machine")
    assert (repr(kept), kept.rule) == (repr(machine), rule)
    assert snapshot(kept) == snapshot(machine)
    for twin in (machine, kept):
        twin.learn_many(Z[rows:-1], I[rows:-1], [], [r - rows for r in failures if r >= rows][:-1])
        twin.observe(Z[-1])
        twin.fail()
    assert snapshot(kept) == snapshot(machine)


def test_a_model_keeps_the_rule_and_recognises_by_it(rule, walk, tmp_path):
    machine = EvolvingFSM(3, rule=rule)
    Z, I, starts, failures = walk(300)
    machine.learn_many(Z, I, starts, failures)
    machine.model().save(tmp_path / "model")
    model = FSMModel.load(tmp_path / "model")
    assert model.rule == rule
    assert model.recognise(Z[-1]).tobytes() == machine.model().recognise(Z[-1]).tobytes()
    z = machine.centers[0] + 0.1
    belief = machine.observe(z).belief
    assert machine.model().recognise(z).tobytes() == belief.tobytes()
    for name in ("decisions", "failures", "endings"):
        assert getattr(model, name).any()
    assert repr(EvolvingFSM(**model.settings, rule=model.rule)) == repr(machine)


def test_a_machine_shows_its_rule_and_can_be_made_again_from_that(rule):
    machine = EvolvingFSM(3, rule=rule)
    assert repr(eval(repr(machine))) == repr(machine)
    assert (f", rule={rule}" in repr(machine)) == (rule != Paper())


def test_rules_are_frozen(rule):
    for field in fields(rule):
        with pytest.raises(FrozenInstanceError):
            setattr(rule, field.name, 1.0)


def test_a_rule_is_plain_json_in_a_file(rule):
    assert restore_rule(json.loads(json.dumps(describe_rule(rule)))) == rule


def test_the_names_and_settings_in_a_file_are_these():
    rule = FailureSplit(Novelty(2.0, (1.0, 4.0)), share=0.25, distance=0.5)
    base = {"name": "novelty", "radius": 2.0, "scales": (1.0, 4.0), "spread": 1.0}
    assert describe_rule(rule) == {"name": "failure", "base": base, "share": 0.25, "distance": 0.5}
    assert describe_rule(Paper()) == {"name": "paper"}
    assert describe_rule(Edges()) == {"name": "edges"}


@pytest.mark.parametrize("rule", [Novelty, "novelty", 1, object()])
def test_what_is_no_rule_is_refused(rule):
    with pytest.raises(TypeError, match=r"rule is .*; it must be an object: Paper\(...\), Edges"):
        EvolvingFSM(1, rule=rule)


@pytest.mark.parametrize("name", ["radius", "spread"])
def test_no_setting_is_ignored_beside_a_rule_that_has_its_own(name):
    with pytest.raises(ValueError, match=f"{name} is .*, but the rule has its own: Novelty"):
        EvolvingFSM(1, rule=Novelty(radius=1.0), **{name: {"radius": 0.3, "spread": 3.0}[name]})


def test_a_rule_is_registered_once_under_its_name():
    register_rule("novelty", Novelty)
    with pytest.raises(ValueError, match="a state rule 'novelty' already: Novelty"):
        register_rule("novelty", Edges)
    with pytest.raises(TypeError, match="is no state rule"):
        register_rule("something", int)

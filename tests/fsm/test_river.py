"""What River expects of a clusterer holds, and the clusters are the machine's states."""

import math
import pickle
import sys
from importlib import import_module

import numpy as np
import pytest
from river import checks, datasets, evaluate, metrics, stream
from river.checks import common

from evofsm import EvolvingFSM, Novelty
from evofsm.fsm.river import RiverClusterer

# River's own list runs these only on models it has a data set for, and has none for clusterers.
_ON_DATA = [
    *("learn_one", "pickling", "clone_is_independent", "no_state_aliasing_with_input"),
    *("emerging_features", "disappearing_features", "radically_disappearing_features"),
    *("shuffle_features_no_impact", "bounded_memory_growth"),
]

Z = np.random.default_rng(5).normal(size=(120, 3)).cumsum(axis=0)
FEATURES = [x for x, _ in stream.iter_array(Z, feature_names=["a", "b", "c"])]


def test_rivers_checks_pass():
    checks.check_estimator(RiverClusterer())
    checks.check_estimator(RiverClusterer(("a", "b"), rule=Novelty(1.0), max_states=6))


@pytest.mark.parametrize("name", _ON_DATA)
def test_rivers_checks_on_data_pass_as_well(name):
    check = getattr(common, f"check_{name}")
    check(RiverClusterer(), list(datasets.Phishing().take(150)))


@pytest.mark.parametrize("settings", [{"radius": 0.5}, {"rule": Novelty(1.5)}])
def test_it_learns_what_the_machine_learns(settings):
    machine = EvolvingFSM(1, **settings)
    trace = machine.learn_many(Z, np.zeros(len(Z), np.int64), belief=True)
    clusterer = RiverClusterer(**settings)
    learnt = []
    for x in FEATURES:
        clusterer.learn_one(x)
        learnt.append(clusterer.predict_one(x))
    assert trace.n_states[-1] > 2
    assert learnt == trace.state.tolist()
    assert np.array_equal(clusterer.machine.transition_matrices, machine.transition_matrices)
    of_last = list(clusterer.predict_proba_one(FEATURES[-1]).values())
    assert np.allclose(of_last, trace.belief[-1], atol=1e-12)


@pytest.mark.parametrize("absent", [{}, {"b": None}, {"b": math.nan}])
def test_what_is_absent_was_not_observed(absent):
    machine = EvolvingFSM(1)
    machine.learn_many(Z, np.zeros(len(Z), np.int64))
    clusterer = RiverClusterer()
    for x in FEATURES:
        clusterer.learn_one(x)
    step = machine.observe([0.5, np.nan, -1.0], partial=True)
    x = {"a": 0.5, "c": -1.0, **absent}
    before = pickle.dumps(clusterer)
    assert np.array_equal(list(clusterer.predict_proba_one(x).values()), step.belief)
    assert clusterer.predict_one(x) == step.state
    assert pickle.dumps(clusterer) == before
    clusterer.learn_one(x)
    assert np.array_equal(clusterer.machine.centers, machine.centers)
    # A transition from it is learnt again, under the one action there is.
    machine.act(0)
    machine.observe(Z[0])
    clusterer.learn_one(FEATURES[0])
    assert np.array_equal(clusterer.machine.transition_matrices, machine.transition_matrices)


def test_features_that_are_named_wait_for_a_whole_observation_and_others_are_left_out():
    clusterer = RiverClusterer(features=("speed", "gap"))
    clusterer.learn_one({})
    clusterer.learn_one({"gap": 2.0})
    assert clusterer.predict_one({"gap": 2.0}) == 0
    assert clusterer.predict_proba_one({"gap": 2.0}) == {}
    clusterer.learn_one({"noise": 1.0, "gap": 2.0, "speed": 3.0})
    assert clusterer.machine.centers.tolist() == [[3.0, 2.0]]


def test_rivers_metrics_of_clusterers_score_it():
    clusterer = RiverClusterer(rule=Novelty(1.5))
    rows = [(x, None) for x in FEATURES]
    score = evaluate.progressive_val_score(rows, clusterer, metrics.Silhouette())
    assert 0.0 < score.get() < 1.0
    centers = [list(one.values()) for one in clusterer.centers.values()]
    assert centers == clusterer.machine.centers.tolist()
    assert RiverClusterer().centers == {}


def test_what_is_no_number_is_named():
    clusterer = RiverClusterer(features=("a",))
    with pytest.raises(TypeError, match=r"feature 'a' is 'red'.*OneHotEncoder"):
        clusterer.learn_one({"a": "red"})
    with pytest.raises(ValueError, match=r"feature 'a' is inf.*finite"):
        clusterer.learn_one({"a": math.inf})
    assert clusterer.machine.n_states == 0


def test_a_missing_library_is_named(monkeypatch):
    for name in ("river", "river.base"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "evofsm.fsm.river", raising=False)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'evofsm\[river\]'"):
        import_module("evofsm.fsm.river")

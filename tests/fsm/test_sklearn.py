"""What scikit-learn expects of a clusterer holds, and the clusters are the machine's states."""

import numpy as np
import polars
import pytest
from sklearn.utils.estimator_checks import parametrize_with_checks

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.rules import Edges, Novelty
from evofsm.fsm.sklearn import EvolvingClusterer

# docs/river-and-scikit-learn.md lists it as well.
_EXCEPTIONS = {
    "check_clustering": "the paper's rule founds states towards the mean of all data: clusters "
    "around it get none of their own",
}


def _exceptions(estimator):
    return _EXCEPTIONS if estimator.rule is None else {}


def walk(rows=120, variables=3):
    return np.random.default_rng(5).normal(size=(rows, variables)).cumsum(axis=0)


@parametrize_with_checks(
    [EvolvingClusterer(), EvolvingClusterer(rule=Edges()), EvolvingClusterer(rule=Novelty(1.0))],
    expected_failed_checks=_exceptions,
)
def test_scikit_learns_checks_pass(estimator, check):
    check(estimator)


@pytest.mark.parametrize("settings", [{"radius": 0.5}, {"rule": Novelty(1.5)}])
def test_labels_are_the_states_that_the_machine_recognised(settings):
    Z = walk()
    machine = EvolvingFSM(1, **settings)
    trace = machine.learn_many(Z, np.zeros(len(Z), np.int64))
    clusterer = EvolvingClusterer(**settings)
    assert trace.n_states[-1] > 2
    assert np.array_equal(clusterer.fit_predict(Z), trace.state)
    assert np.array_equal(clusterer.cluster_centers_, machine.centers)
    assert np.array_equal(clusterer.predict_proba(Z), machine.model().recognise(Z))
    assert np.array_equal(clusterer.machine_.transition_matrices, machine.transition_matrices)


def test_batches_learn_what_the_whole_does_and_fit_starts_anew():
    Z = walk()
    whole = EvolvingClusterer().fit(Z)
    parts = EvolvingClusterer()
    labels = [parts.partial_fit(batch).labels_ for batch in np.array_split(Z, 7)]
    assert np.array_equal(np.concatenate(labels), whole.labels_)
    assert np.array_equal(parts.machine_.transition_matrices, whole.machine_.transition_matrices)
    assert np.array_equal(parts.fit(Z).cluster_centers_, whole.cluster_centers_)


def test_names_of_columns_are_kept_and_held_to():
    frame = polars.DataFrame(walk(), schema=["gap", "speed", "leader"])
    clusterer = EvolvingClusterer().fit(frame)
    assert clusterer.feature_names_in_.tolist() == ["gap", "speed", "leader"]
    with pytest.raises(ValueError, match="feature names should match"):
        clusterer.predict(frame.rename({"gap": "distance"}))

"""Where a disturbance begins: only where it was seen to, if that is no chance."""

from io import BytesIO

import numpy as np
import pytest

from evofsm.guard import merge_judges
from evofsm.guard.learnt.dynamics import Dynamics
from evofsm.guard.learnt.places import ANYWHERE, after, onsets, places_of
from evofsm.guard.learnt.replay import Model, features, n_features

ONE, STOP = np.ones(2), np.array([0.0, 3.0])
#: Two variables that stay as they are, as far as is known.
RAIL = Model(
    weights=np.zeros((n_features(2, 1, box=True), 2)),
    **dict.fromkeys(("origin", "drifted", "mean"), 0.0 * ONE),
    **dict.fromkeys(("reach", "inverse", "most"), ONE),
    least=-ONE,
    lowest=-np.inf * ONE,
    highest=np.inf * ONE,
    thresholds=np.empty((0, 4)),
    **dict.fromkeys(("regions", "endings", "crashes"), np.empty((0, 12))),
    dead_ends=np.empty((0, 4)),
    choices=0,
)


def seen(ends, everywhere=False, count=8):
    """After episodes in which something begins beyond an end, or also elsewhere; where one was."""
    events, draw, survived = np.empty((0, 9)), np.random.default_rng(0), []
    for episode in range(count):
        z = np.column_stack([draw.uniform(-1.0, 1.0, 300), draw.uniform(-1.0, 1.0, 300)])
        z[100, 0] = 0.0 if everywhere and episode == 5 else ends[episode % len(ends)]
        found = np.zeros((299 - 1, 2))
        found[99:101] = STOP, 2.0 * STOP
        z[101:103] = z[100] + found[99:101].cumsum(0)
        events = after(events, z, np.zeros((299, 1)), found, ONE, episode, RAIL)
        survived.append(z)
    return events, np.concatenate(survived)


def where(seen, end):
    rest = np.array([[0.1 * STOP, STOP, 2.0 * STOP]])
    return places_of(rest, np.full((1, 3, 2), end), *seen, ONE, RAIL, 1)[0]


def test_what_began_in_one_place_alone_begins_there():
    assert where(seen([0.98, 1.0]), 0.99)[:2] == (0, 1.0)
    assert where(seen([0.98, 1.0]), 0.99)[2] == pytest.approx(0.98)
    assert where(seen([-0.98, -1.0]), -0.99)[:2] == (0, -1.0)


@pytest.mark.parametrize(
    "places", [seen([1.0], everywhere=True), seen([1.0], count=1), seen([-1.0, 1.0])]
)
def test_what_began_elsewhere_too_or_once_may_begin_anywhere(places):
    assert where(places, 0.99) == ANYWHERE


def test_an_event_begins_where_residuals_rise_not_where_they_are_largest():
    found = np.zeros((40, 2))
    found[10:14, 0], found[30, 1] = (2.0, 3.0, 4.0, 2.0), -1.0
    assert onsets(found, 8, 0.25, back=True) == [10, 30]
    assert onsets(found, 1, 0.25) == [12]


@pytest.fixture
def placed(points):
    """A guard whose disturbances begin somewhere alone."""
    guard = points["box"].taught(3)
    dynamics = guard.judge.dynamics
    dynamics.sequences = [one._replace(place=(0, 1.0, 0.25)) for one in dynamics.sequences]
    guard.judge.disturbances = dynamics.disturbances(guard.judge.horizon)
    return guard


def test_it_is_said_and_kept_where_disturbances_begin(placed, points, exactly, content):
    n = len(placed.judge.dynamics.sequences)
    says = f"{n} of them were seen to begin only where variable 1 is above 0.25"
    assert says in placed.judge.told_by_experience
    placed.save(file := BytesIO())
    again = type(placed).load(BytesIO(file.getvalue()))
    assert content(again) == content(placed)
    assert exactly(points["box"].play(again, 7)[0]) == exactly(points["box"].play(placed, 7)[0])
    both = placed.judge, points["box"].taught(2).judge
    assert len(merge_judges(both).dynamics.events) == sum(len(one.dynamics.events) for one in both)


def test_an_episode_that_is_over_at_once_teaches_what_the_action_did_in_it():
    dynamics, draw = Dynamics(-1.0, 1.0), np.random.default_rng(0)

    def episode(pushes, failed):
        z = np.zeros(2)
        for push in pushes:
            dynamics.observe(z)
            dynamics.act(np.array([push]))
            z = np.array([z[0] + z[1], 0.9 * z[1] + 0.1 * push * (1.0 + 4.0 * (abs(push) > 0.5))])
        dynamics.observe(z)
        dynamics.end(failed=failed)

    episode(0.02 * draw.normal(size=200), failed=False)
    for _ in range(3):
        episode(np.ones(4), failed=True)
    model = dynamics.model
    row = features(model, np.zeros((1, 2)), np.zeros((1, 2)), np.ones((1, 1)), np.ones((1, 1)))
    assert 0.25 < (row @ model.weights)[0, 1] < 0.6
    assert dynamics.latest is not None
    assert len(dynamics.latest.actions) == 3

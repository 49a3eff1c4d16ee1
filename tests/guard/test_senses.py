"""Observations that are late, come twice, after a hole in time, or with a sensor missing."""

import math
from contextlib import contextmanager

import numpy as np
import pytest

from evofsm.driving.drivers import IDM
from evofsm.driving.episodes import drive
from evofsm.driving.judge import LatentRisk
from evofsm.driving.measures import TimeToCollision
from evofsm.driving.revisers import EnvelopeReviser
from evofsm.driving.scenarios import Leader, Scenario
from evofsm.driving.world import KinematicWorld
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.observations import Missing
from evofsm.fsm.rules import Novelty
from evofsm.guard.api import Intake, Proposal, Situation
from evofsm.guard.guard import Guard, InputMonitor
from evofsm.guard.reviser import ActionReviser

NAN = math.nan
ACTIONS = IntervalActions(low=-4.0, high=2.5, width=0.5, outside="clip")


class FlickeringRoad:
    """A road on which the gap is not seen half of the time."""

    def __init__(self, road):
        self._road, self._rng = road, np.random.default_rng(2)

    def __getattr__(self, name):
        return getattr(self._road, name)

    @property
    def observation(self):
        seen = self._road.observation.copy()
        if self._rng.random() < 0.5:
            seen[0] = NAN
        return seen


class FlickeringWorld:
    @contextmanager
    def open(self, scenario):
        with KinematicWorld().open(scenario) as road:
            yield FlickeringRoad(road)


def machine():
    taught = EvolvingFSM(ACTIONS.n_actions, rule=Novelty(radius=1.0, scales=(4.0, 2.0, 2.0)))
    rng = np.random.default_rng(0)
    Z = np.array([40.0, 15.0, 15.0]) + np.cumsum(rng.normal(size=(300, 3)), axis=0)
    taught.learn_many(Z, rng.integers(0, ACTIONS.n_actions, 300))
    return taught


def guard(learn=True, **options):
    risk = LatentRisk.given(-4.0, 4.0, 8.0)
    reviser = ActionReviser(risk, ACTIONS)
    return Guard.of(reviser, machine=machine(), learn=learn, interval=0.25, **options)


# -- The machine --------------------------------------------------------------------------------


def test_an_incomplete_observation_is_rejected_unless_asked_for(snapshot):
    taught = machine()
    before = snapshot(taught)
    with pytest.raises(ValueError, match="observation"):
        taught.observe([NAN, 15.0, 15.0])
    assert snapshot(taught) == before


@pytest.mark.parametrize("missing", [Missing.PARTIAL, Missing.HOLD])
def test_an_incomplete_observation_teaches_nothing(missing):
    taught = machine()
    centers, matrices, visits = taught.centers, taught.transition_matrices, taught.model().visits
    taught.act(1)
    step = taught.observe([NAN, 15.0, 15.0], missing=missing)
    assert step.missing == (0,)
    assert step.belief.sum() == pytest.approx(1.0, abs=1e-12)
    assert step.surprise == step.surprise  # it was foreseen, or not
    np.testing.assert_array_equal(taught.centers, centers)
    np.testing.assert_array_equal(taught.transition_matrices, matrices)
    np.testing.assert_array_equal(taught.model().visits, visits)
    np.testing.assert_array_equal(taught.belief, step.belief)


def test_it_is_recognised_by_the_variables_that_are_there():
    taught = EvolvingFSM(1, rule=Novelty(radius=1.0))
    taught.learn_many([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]], [0, 0, 0])
    assert taught.n_states == 3
    belief = taught.observe([NAN, 10.0], missing=Missing.PARTIAL).belief
    assert belief[2] > 0.99
    belief = taught.observe([10.0, NAN], missing=Missing.PARTIAL).belief
    assert belief[1] == pytest.approx(belief[2])
    assert belief[0] < 0.01


def test_held_is_as_if_the_value_of_before_had_come_again():
    taught, twin = machine(), machine()
    latest = np.array([40.0, 15.0, 14.0])
    taught.observe(latest)
    twin.observe(latest)
    held = taught.observe([NAN, 16.0, 14.5], missing=Missing.HOLD).belief
    np.testing.assert_allclose(held, twin.model().recognise([40.0, 16.0, 14.5]), rtol=1e-12)


def test_with_nothing_there_the_forecast_is_all_that_is_known():
    taught = machine()
    taught.act(2)
    expected = taught.predict(2)
    step = taught.observe([NAN, NAN, NAN], missing=Missing.PARTIAL)
    np.testing.assert_array_equal(step.belief, expected)
    assert step.surprise == 0.0


@pytest.mark.parametrize("missing", [Missing.PARTIAL, Missing.HOLD])
def test_a_first_observation_must_be_whole(missing):
    with pytest.raises(ValueError, match="first observation"):
        EvolvingFSM(1).observe([NAN, 1.0], missing=missing)


def test_nothing_is_held_over_from_another_episode():
    taught = machine()
    taught.start_episode()
    with pytest.raises(ValueError, match="nothing to hold"):
        taught.observe([NAN, 1.0, 1.0], missing=Missing.HOLD)


def test_a_failure_that_was_seen_in_part_is_counted():
    taught = machine()
    before = taught.endings.sum()
    taught.observe([NAN, 15.0, 15.0], missing=Missing.PARTIAL, failed=True)
    assert taught.endings.sum() == before + 1
    assert taught.state is None


# -- Driving on less ----------------------------------------------------------------------------


def test_the_less_is_seen_the_more_careful_it_gets():
    watch, risks = guard(), []
    for k in range(4):
        situation = watch.recognise(np.array([30.0, 10.0, 10.0]), 0.25 * k)
        watch.revise(situation, Proposal(0.0))
    for k in range(4, 24):
        situation = watch.recognise(np.array([NAN, 10.0, NAN]), 0.25 * k)
        assert situation.intake is Intake.PARTIAL
        revision = watch.revise(situation, Proposal(0.0))
        risks.append(revision.risk_proposed)
    assert risks[0] < 0.02
    assert risks[-1] > 0.5
    assert revision.executed < 0.0
    assert "not seen: gap, v_leader" in revision.reason


def test_blind_from_the_start_it_brakes():
    watch = guard()
    situation = watch.recognise(np.array([NAN, 10.0, 10.0]), 0.0)
    revision = watch.revise(situation, Proposal(1.0))
    assert revision.risk_proposed == 1.0
    assert revision.executed == ACTIONS.low


def test_a_classic_measure_that_sees_nothing_brakes_and_says_so():
    reviser = EnvelopeReviser(TimeToCollision(), ACTIONS)
    here = Situation(np.array([NAN, 10.0, 5.0]), np.ones(1), None, NAN, 0.0, Intake.PARTIAL)
    revision = reviser.revise(here, Proposal(1.0))
    assert revision.executed == ACTIONS.low
    assert "gap" in revision.reason


@pytest.mark.parametrize("learn", [True, False])
@pytest.mark.parametrize("policy", [Missing.PARTIAL, Missing.HOLD])
def test_it_drives_on_when_sensors_fail_now_and_then(learn, policy):
    watch, rng = guard(learn=learn, missing=policy), np.random.default_rng(1)
    for k in range(200):
        observation = np.array([40.0, 12.0, 12.0 + np.sin(0.1 * k)])
        observation[rng.random(3) < 0.3] = NAN
        situation = watch.recognise(observation, 0.25 * k)
        revision = watch.revise(situation, Proposal(0.1))
        assert ACTIONS.low <= revision.executed <= ACTIONS.high
        assert situation.belief.sum() == pytest.approx(1.0)


def test_rejecting_is_an_error_that_names_the_variables():
    watch = guard(missing=Missing.REJECT)
    with pytest.raises(ValueError, match=r"variables \[0, 2\] of the observation at 0 s"):
        watch.recognise(np.array([NAN, 10.0, NAN]), 0.0)


def test_the_reviser_keeps_its_promise_with_a_gap_sensor_that_fails_half_the_time():
    hasty = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-4.0, highest=2.5)
    leader = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=8.0, brake_time=12.0)
    risk = LatentRisk.given(-4.0, 4.0, 8.0)
    guard = Guard.of(ActionReviser(risk, ACTIONS), learn=False, interval=0.25)
    driven = drive(guard, Scenario(leader, initial_gap=5.0), FlickeringWorld(), hasty)
    assert any(decision.situation.intake for decision in driven.decisions)
    assert not driven.collided


def test_an_episode_may_end_unseen():
    watch = guard()
    watch.recognise(np.array([5.0, 10.0, 0.0]), 0.0)
    before = watch.machine.endings.sum()
    watch.end(failed=True, observation=np.array([NAN, 10.0, 0.0]))
    assert watch.machine.endings.sum() == before + 1


# -- Time ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("time", "flag"), [(1.0, Intake.REPEATED), (0.4, Intake.LATE)])
def test_what_is_not_new_changes_nothing(time, flag, snapshot):
    watch = guard()
    for k in range(5):
        first = watch.recognise(np.array([30.0, 10.0, 10.0]), 0.25 * k)
        watch.revise(first, Proposal(0.0))
    before = snapshot(watch.machine)
    again = watch.recognise(np.array([1.0, 30.0, 0.0]), time)
    assert again.intake is flag
    np.testing.assert_array_equal(again.observation, first.observation)
    assert "nothing new was seen" in watch.revise(again, Proposal(0.0)).reason
    assert snapshot(watch.machine) == before


def test_after_a_hole_in_time_no_transition_is_learnt():
    watch = guard()
    for time in (0.0, 0.25):
        watch.revise(watch.recognise(np.array([30.0, 10.0, 10.0]), time), Proposal(0.0))
    before = watch.machine.model().uses.sum()
    situation = watch.recognise(np.array([30.0, 10.0, 10.0]), 2.0)
    assert situation.intake is Intake.GAP
    assert situation.surprise != situation.surprise
    assert watch.machine.model().uses.sum() == before


def test_a_hole_is_told_only_where_the_interval_is_known():
    monitor = InputMonitor()
    assert [monitor.take(np.zeros(1), time) for time in (0.0, 100.0)] == 2 * [Intake.WHOLE]

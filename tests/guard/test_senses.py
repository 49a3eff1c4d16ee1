"""Observations that are late, come twice, after a gap in time, or with a sensor missing."""

import math
from contextlib import nullcontext
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evofsm.driving import Object, Scene, guard_for_cars, guard_for_traffic
from evofsm.driving.drivers import IDM
from evofsm.driving.judge import LatentRisk
from evofsm.driving.scenarios import Leader, Scenario
from evofsm.driving.trials import drive
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.rules import Novelty
from evofsm.guard.api import Intake, Proposal
from evofsm.guard.guard import Guard
from evofsm.guard.scene import SceneRisk

NAN = math.nan


def guard():
    return guard_for_cars(-4.0, 2.5, judge=LatentRisk(-4.0, decel=4.0, leader_decel=8.0))


def test_an_incomplete_observation_teaches_nothing_but_that_it_failed(grown):
    centers, matrices, visits = grown.centers, grown.transition_matrices, grown.model().visits
    step = grown.observe([NAN, 0.5], partial=True)
    assert step.belief.sum() == pytest.approx(1.0, abs=1e-12)
    assert not np.isnan(step.surprise)  # it was foreseen, or not
    np.testing.assert_array_equal(grown.centers, centers)
    np.testing.assert_array_equal(grown.transition_matrices, matrices)
    np.testing.assert_array_equal(grown.model().visits, visits)
    np.testing.assert_array_equal(grown.belief, step.belief)
    failures = grown.endings.sum()
    grown.observe([NAN, 0.5], partial=True, failed=True)
    assert grown.endings.sum() == failures + 1
    assert grown.state is None


def test_it_is_recognised_by_the_variables_that_are_there_and_else_by_the_forecast():
    taught = EvolvingFSM(1, rule=Novelty(radius=1.0))
    with pytest.raises(ValueError, match="first observation"):
        taught.observe([NAN, 1.0], partial=True)
    taught.learn_many([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]], [0, 0, 0])
    belief = taught.observe([NAN, 10.0], partial=True).belief
    assert belief[2] > 0.99
    belief = taught.observe([10.0, NAN], partial=True).belief
    assert belief[1] == pytest.approx(belief[2])
    assert belief[0] < 0.01
    taught.act(0)
    expected = taught.predict(0)
    step = taught.observe([NAN, NAN], partial=True)
    np.testing.assert_array_equal(step.belief, expected)
    assert np.isnan(step.surprise)  # what was not looked at is no success of the forecast


def test_the_less_is_seen_the_more_careful_it_gets():
    watch, risks = guard(), []
    for k in range(24):
        revision = watch.decide([30.0, 10.0, 10.0] if k < 4 else [NAN, 10.0, NAN], 0.0)
        assert watch.situation.intake is (Intake.WHOLE if k < 4 else Intake.PARTIAL)
        risks.append(revision.risk_proposed)
    assert risks[4] < 0.02
    assert np.isnan(risks).tolist() == [False] * 8 + [True] * 16  # from the fifth on
    assert (np.isnan(revision.interval).all(), revision.evidence) == (True, 0.0)
    assert revision.executed < 0.0
    unseen, why, _ = revision.reason.split("; ")
    assert unseen == "not seen: gap, v_leader"
    assert why.startswith("by an estimate alone, so its risk is not known: could not survive")
    assert "(risk" not in why
    blind = guard().decide([NAN, 10.0, 10.0], 1.0)  # from the start
    assert (blind.risk_proposed, blind.executed) == (1.0, -4.0)


LARGE = (5e-324, 1e-300, 1e-160, 150.0, 1e3, 1e6, 1e15, 1e18, 1e29, 1e30)
ODD = st.sampled_from([*LARGE, *np.negative(LARGE), -0.0]) | st.floats(-200.0, 200.0) | st.floats()


@cache
def odd(kind):
    """A guard that knows of failures, and what it might observe."""
    if kind == "cars":
        return guard_for_cars(-4.0, 2.5), [30.0, 20.0, 18.0]
    if kind == "traffic":
        seen = Scene(Object("", 0.0, 0.0, 20.0), [Object("", 30.0, 0.5, 10.0)]).rows(1)
        return guard_for_traffic(-9.0, 2.6, 4.5, 0.1), seen.tolist()
    judge, m = (SceneRisk(1.0, 3, columns=4), 12) if kind == "scene" else (None, 2)
    actions = {"low": 0.0, "high": 2.0} if judge is None else {"n_actions": 3}
    taught, random = Guard(**actions, interval=1.0, judge=judge), np.random.default_rng(0)
    for _ in range(5):
        for step in np.linspace(0.0, 1.0, 30):
            taught.decide(random.normal(step, 0.1, m), 0)
        taught.end(failed=True, observation=np.ones(m))
    return taught, [1.0] * m


@pytest.mark.parametrize("kind", ["cars", "traffic", "learnt", "scene"])
@settings(max_examples=25)
@given(data=st.data())
def test_whatever_is_seen_is_decided_in_time_or_refused_by_name(kind, data, ends_in_time):
    taught, usual = odd(kind)
    changed = st.dictionaries(st.integers(0, len(usual) - 1), ODD, max_size=4)
    rows = data.draw(st.lists(st.tuples(changed, st.none() | st.integers(0, 2)), max_size=5))
    twin = taught.copy()
    with ends_in_time():
        for row, proposal in rows:
            seen = [row.get(k, value) for k, value in enumerate(usual)]
            try:
                executed, said = twin.decide(seen, proposal).executed, "must lie between"
            except ValueError as error:
                executed, said = twin.decide(usual, proposal).executed, str(error)
            assert "must lie between" in said
            assert twin.actions.low <= executed <= twin.actions.high
        twin.end(failed=True)


def test_the_reviser_keeps_its_promise_with_a_gap_sensor_that_fails_half_the_time():
    hasty = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-4.0, highest=2.5)
    leader = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=8.0, brake_time=12.0)
    watch, chance = guard(), np.random.default_rng(0)
    watch.learn, see = False, watch.recognise
    watch.recognise = lambda z, time: see([z[0] if chance.random() < 0.5 else NAN, *z[1:]], time)
    driven = drive(watch, Scenario(leader, initial_gap=5.0), controller=hasty)
    seen = [decision.situation.intake is Intake.WHOLE for decision in driven.decisions]
    assert 0.3 < np.mean(seen) < 0.7
    assert not driven.collided


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


@pytest.mark.parametrize("kind", ["learnt", "cars"])
@pytest.mark.parametrize("shift", [-3600.0, 0.0])
def test_a_clock_that_goes_back_is_followed_and_one_that_stands_still_sees_nothing(kind, shift):
    taught, usual = odd(kind)
    twin, dt = taught.copy(), taught.interval
    for k in range(3):
        twin.decide(usual, 0.0, 3600.0 + k * dt)
    others = [3600.0 + 2 * dt + (shift + k * dt if shift else 0.0) for k in range(12)]
    stale = [twin.decide(usual, 0.0, time).reason for time in others[:5]]
    assert all("nothing new was seen" in reason for reason in stale)
    with pytest.warns(UserWarning, match="was set back" if shift else "stands still"):
        then = [twin.recognise(usual, time) for time in others[5:6]]
    for time in others[6:]:
        revision = twin.decide(usual, 0.0, time)
        then.append(twin.situation)
    if shift:
        assert [one.intake for one in then] == [Intake.GAP, *[Intake.WHOLE] * 6]
        assert not math.isnan(revision.risk_proposed)
    else:
        assert all(one.intake is Intake.PARTIAL and np.isnan(one.observation).all() for one in then)
        assert math.isnan(revision.risk_proposed)
        assert twin.recognise(usual, others[-1] + 2 * dt).intake is Intake.GAP


@pytest.mark.parametrize("steps", [(0.16, 0.16, 0.14), (100.0,), (0.1, 0.1, 8.0)])
def test_times_that_are_mostly_too_far_apart_are_told_of(steps):
    watch, time = Guard(-1.0, 1.0, interval=0.1), 0.0
    said = pytest.warns(UserWarning, match=rf"latest {steps[0]:g} s, where interval is 0.1 s: noth")
    with nullcontext() if steps[0] == 0.1 else said:
        for k in range(400):
            watch.decide([k % 7, k % 5], 0.0, time)
            time += steps[k % len(steps)]
            if k % 20 == 19:  # so short are episodes
                watch.end(failed=k < 20)
    assert "three in a row without NaN or a gap of over 1.5 intervals" in str(watch)


def test_sensors_that_take_turns_are_put_together():
    taught, usual = odd("learnt")
    twin = taught.copy()
    twin.learn = False
    first, second = [usual[0], NAN], [NAN, usual[1]]
    assert "not each variable was observed yet" in twin.decide(first, 0.0).reason
    risks = [twin.decide(z, 0.0).risk_proposed for z in (second, first, second, first, second)]
    assert np.isnan(risks).tolist() == [False] * 3 + [True] * 2  # none was whole for long
    assert "lasts longest" in twin.decide(first, 0.0).reason

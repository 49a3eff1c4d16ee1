"""The loop: who is told what, what is recorded, what is learnt, and what comes of episodes."""

import logging
import math
from dataclasses import replace

import numpy as np
import pytest

from evofsm.driving.cars import guard_for_cars, guard_for_family
from evofsm.driving.family import held_out, load_family
from evofsm.driving.judge import LatentRisk
from evofsm.driving.revisers import Unrevised
from evofsm.driving.trials import drive, outcome_of, reference_of, summarise, unrevised_guard
from evofsm.driving.world import COMMANDED, SPEED
from evofsm.fsm.actions import IntervalActions
from evofsm.guard.api import Proposal
from evofsm.guard.guard import Guard
from evofsm.guard.reviser import ActionReviser, Mode

ACTIONS = IntervalActions(low=-2.5, high=2.5, width=0.3, outside="clip")
EMERGENCY = load_family("emergency")


# -- What came of episodes ------------------------------------------------------------------------


def test_outcomes_compare_with_the_controller_alone():
    draws = held_out(EMERGENCY, 0, 3)
    alone = [reference_of(EMERGENCY, draw) for draw in draws]
    same = [drive(unrevised_guard(EMERGENCY), draw) for draw in draws]
    for one, base in zip(same, alone, strict=True):  # up to the leader's brake
        until = one.time <= one.time[base.until]
        way = np.trapezoid(one.observations[until, 1], one.time[until])
        assert base.distance == pytest.approx(way, rel=0.01)
    found = [outcome_of(*pair) for pair in zip(same, alone, strict=True)]
    assert [one.mobility for one in found] == [1.0, 1.0, 1.0]
    assert [one.changed for one in found] == [0, 0, 0]
    row = summarise("emergency", "unrevised", found, EMERGENCY.interval)
    assert row.collisions == sum(one.collided for one in same) == 3
    assert (row.collision_rate, row.mobility, row.mean_change) == (1.0, 1.0, 0.0)
    assert row.collision_low == pytest.approx(0.025 ** (1.0 / 3.0))  # Clopper and Pearson
    seconds = sum(len(one.decisions) for one in same) * EMERGENCY.interval
    assert row.hours == pytest.approx(seconds / 3600.0)


def test_what_cannot_be_driven_is_refused():
    with pytest.raises(ValueError, match="no judge 'wise'; there are kinematic, learnt"):
        guard_for_family(EMERGENCY, judge="wise")
    with pytest.raises(ValueError, match="nobody drives"):
        drive(unrevised_guard(EMERGENCY), EMERGENCY.draw(0, 0).scenario)
    with pytest.raises(ValueError, match="no multiple of the simulation's step"):
        drive(guard_for_cars(-2.5, 2.5, interval=0.123), EMERGENCY.draw(0, 0))


# -- The loop --------------------------------------------------------------------------------------


def test_decisions_are_those_of_the_record():
    told = drive(guard_for_family(EMERGENCY), EMERGENCY.draw(0, 0))
    record, time = told.record, told.time
    starts = [round(d.situation.time / 0.01) for d in told.decisions]
    assert starts == list(range(0, starts[-1] + 1, 25))
    assert (told.executed != told.proposed).any()
    for decision, row in zip(told.decisions, starts, strict=True):
        end = min(row + 25, len(time) - 1)
        assert decision.situation.observation.tolist() == record[row, :3].tolist()
        assert set(record[row:end, COMMANDED]) == {decision.revision.executed}
        did = (record[end, SPEED] - record[row, SPEED]) / (time[end] - time[row])
        assert decision.realised == pytest.approx(did)


NO_NUMBERS = [math.nan, math.inf, "1.0", [], (1.0,), [1.0, 2.0], b"1", Proposal(None)]


@pytest.mark.parametrize("line", [RuntimeError("lost"), *NO_NUMBERS, Proposal(1.0, [True])])
def test_a_controller_that_fails_once_is_driven_on_without(line, caplog):
    lines, scenario = iter([1.0, 1.0, line]), EMERGENCY.draw(0, 0).scenario

    def propose(observation):
        if isinstance(said := next(lines, 1.0), Exception):
            raise said
        return said

    with caplog.at_level(logging.WARNING, logger="evofsm"):
        short = replace(scenario, duration=3.0)
        told = drive(unrevised_guard(EMERGENCY), short, controller=propose)
    assert len(caplog.records) == 1
    assert "controller" in caplog.text
    assert "0.5 s" in caplog.text
    assert told.executed.tolist() == [1.0, 1.0, -1.0] + [1.0] * 9
    assert not math.isfinite(told.proposed[2])
    assert "no usable proposal" in told.decisions[2].revision.reason


def test_a_driver_who_brakes_hard_shows_what_the_brakes_can_do(reloaded):
    risk = LatentRisk(-8.0, dt=0.1)
    reviser = ActionReviser(risk, IntervalActions(-8.0, 2.0, 0.5), mode=Mode.SHADOW)

    def braked(*decels):
        guard, speed, time = Guard.of(reviser, judge=risk, interval=0.1), 25.0, 0.0
        for decel in np.repeat((0.0, *decels, 0.0), 20):
            guard.decide([60.0, speed, speed], -decel, time)
            speed, time = max(speed - 0.1 * decel, 0.0), time + 0.1
        guard.end(failed=False)
        return risk.brakes.decel

    assert braked(3.0) == pytest.approx(4.8)  # what was never shown stays as assumed
    assert braked(6.0) == pytest.approx(6.0)
    assert braked(2.0) == pytest.approx(6.0)
    assert reloaded(risk).brakes.decel == pytest.approx(6.0)
    reviser.mode = Mode.ACT
    assert braked(7.0) == pytest.approx(6.0)  # its own braking is told from what it commands


@pytest.mark.parametrize("executed", [math.nan, 99.0, None, "x"])
def test_what_is_no_action_is_not_executed_whoever_says_so(executed):
    class Odd(Unrevised):
        def revise(self, situation, proposal):
            return super().revise(situation, proposal)._replace(executed=executed)

    with pytest.raises(ValueError, match=r"Odd would execute .* none of IntervalActions"):
        Guard.of(Odd(ACTIONS), interval=0.25).decide([9.0, 20.0, 20.0], 1.0)

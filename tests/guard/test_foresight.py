"""Where nobody acts, alarms are no worse than plain thresholds, and say what they rest on."""

import copy
import re

import numpy as np
import pytest

from evofsm.guard import ActionReviser, AuditLog, Choices, Foresight, Guard
from evofsm.guard.foresight import RATES, Runs

DT, HORIZON = 60.0, 1200.0
NAMES = ("pressure", "flow")


def surging(rng):
    """At a high pressure it needs more flow; a fault brings it nearer, or heals."""
    n = rng.integers(200, 600)
    load = np.clip(0.6 + 0.2 * np.cumsum(rng.normal(0.0, 0.1, n)), 0.2, 1.0)
    fault = np.zeros(n)
    at, peak = rng.integers(100, n), rng.choice([0.6, 1.5])
    grown = np.arange(n - at) / rng.uniform(20.0, 60.0)
    fault[at:] = np.where(grown < peak, grown, np.maximum(2.0 * peak - grown, 0.0))
    z = np.column_stack([load - 0.1 * fault, load + 0.1 * fault]) + rng.normal(0.0, 0.005, (n, 2))
    fails = np.append(z[:, 1] - z[:, 0] > 0.2, True)
    return z[: fails.argmax() + 1], fails.argmax() < n


def shaking(rng):
    """It shakes more and more in the last 40 min."""
    z = rng.normal(3.0, 0.15, (rng.integers(300, 1500), 2))
    z[-40:, 1] += 0.1 * np.arange(40)
    return z, True


def random(rng):
    """Nothing foresees it."""
    z = rng.normal(0.5, 0.1, (rng.integers(200, 600), 2))
    return z, rng.random() < 0.5


def log_of(machine, seed, count):
    rng = np.random.default_rng(seed)
    return tuple(zip(*(machine(rng) for _ in range(count)), strict=True))


def learnt(machine, count):
    return Foresight.learn_log(*log_of(machine, 0, count), dt=DT, horizon=HORIZON, names=NAMES)


@pytest.fixture(scope="module")
def surge():
    judge = learnt(surging, 40)
    judge.stated = 1.0
    return judge


def test_where_one_limit_depends_on_another_it_foresees_more_than_thresholds(surge):
    then = Runs.of(*log_of(surging, 1, 60))
    rate = RATES.index(1.0)
    ours, thresholds = (surge.tally(then, rate, plain=plain)[0] for plain in (None, True))
    assert ours.foreseen == ours.failures > 10
    assert ours.lead > thresholds.lead + DT
    assert ours.false / ours.days < 3.0
    assert re.search(r"0\.\d+ flow above 0\.\d+", surge.told_by_experience)


def test_it_finds_which_two_of_many_variables_limit_each_other():
    rng, (runs, failed) = np.random.default_rng(5), log_of(surging, 0, 40)
    wide = [np.column_stack([rng.normal(size=(len(z), 7)).cumsum(0), z]) for z in runs]
    names = *map(str, range(7)), *NAMES
    judge = Foresight.learn_log(wide, failed, dt=DT, horizon=HORIZON, names=names)
    assert {*NAMES, "above"} <= {*re.findall("[a-z]+", judge.words(2))}
    assert judge.held_out[2, 0] >= 0.95 * sum(failed)


@pytest.mark.parametrize("machine", [surging, shaking])
def test_as_few_are_false_as_stated_held_out_and_where_it_learnt(machine):
    judge, log = learnt(machine, 40), Runs.of(*log_of(machine, 0, 40))
    right, false, failures, _ = judge.held_out.T
    assert (false <= np.multiply(RATES, len(log.rows) * DT / 86400.0)).all()
    assert sorted(false) == list(false)
    assert (failures == sum(log.failed)).all()
    for rate in np.flatnonzero(judge.shares):
        came, _ = judge.tally(log, rate)  # of the alarm that it tells of, not another
        assert min(came.foreseen - right[rate], false[rate] - came.false) >= 0
        of = judge.of_rate(rate)[:, 2:5].tolist()
        assert len({*map(tuple, of)}) == len(of)  # no part of it implies another one


def test_a_warning_of_one_row_is_found_where_the_horizon_is_long():
    rng = np.random.default_rng(0)
    runs = [np.append(rng.normal(5.0, 0.1, 150), rng.normal(9.0, 1.0, 2)) for _ in range(12)]
    judge = Foresight.learn_log(runs, [True] * 12, dt=DT, horizon=60 * DT)
    told, _ = judge.tally(Runs.of(runs, [True] * 12), 0, plain=True)
    assert told.foreseen > 8
    assert told.false == 0
    assert re.search(r"as well: variable 1 above (6\.[5-9]|7\.[0-5])", judge.told_by_experience)


def test_an_alarm_that_is_false_less_often_than_stated_stands_where_there_is_no_other():
    rng = np.random.default_rng(31)
    runs = [np.append(rng.normal(size=572), rng.normal(4.0, 1.0, 4)) for _ in range(5)]
    judge = Foresight.learn_log(runs, [True] * 5, dt=1800.0, horizon=12 * 3600.0)
    assert {*judge.alarms} == {"0.1, 0.3, 1, 3"}
    assert judge.of_rate(3)[:, 1:].tolist() == judge.of_rate(0)[:, 1:].tolist() != []


def test_one_failure_is_learnt_from_and_of_alarms_the_closest_that_there_is_counts(surge):
    rising = np.linspace(0.0, 1.0, 60)[:, None]
    for runs in ([rising], [rising * 0.5, rising]):
        one = Foresight.learn_log(runs, [run.max() == 1.0 for run in runs], dt=DT)
        assert one.alarm is None  # cross-validated it was never right
        for words in (one.alarm_in_words, one.of(0), one.told_by_experience):
            assert "with one failure nothing can be cross-validated" in words
    judge = copy.deepcopy(surge)
    judge.held_out = np.array([[0, 0, 4, 2], [3, 1, 4, 0], [2, 2, 4, 1], [4, 4, 4, 0]])
    for judge.stated, alarm in ((0.05, 1), (0.1, 1), (0.3, 1), (1.0, 2), (2.0, 2), (9.0, 3)):
        assert judge.alarm == alarm


def test_where_nothing_foresees_a_failure_there_is_no_alarm_and_without_failures_no_judge():
    with pytest.raises(ValueError, match="no episode failed"):
        Foresight.learn_log([[1.0, 2.0]], [False], dt=DT, horizon=HORIZON)
    judge = learnt(random, 40)
    assert judge.alarm is None
    for_all = "for 0.1, 0.3, 1, 3 false alarms a day none for so few surely beats chance"
    assert judge.told_by_experience == for_all  # nor does anything hold where it fails


@pytest.mark.parametrize(
    ("changed", "fault"),
    [
        ({"failed": ["False", "True"]}, "of each of 2 episodes: 2 labels, 'False'"),
        ({"failed": [1.0, np.nan]}, "2 labels, nan"),
        ({"failed": [True]}, "of each of 2 episodes: 1 labels"),
        ({"episodes": [[[1.0]], []]}, "and one has no rows"),
        ({"episodes": [], "failed": []}, "of each of 0 episodes"),
        ({"dt": 0.0}, "dt is 0.0; it must be a positive"),
        ({"names": ["heat", "load"]}, "names are 2, of 1 variables"),
        ({"units": ["°C", "kW"]}, "units are 2, of 1 variables"),
    ],
)
def test_what_it_cannot_learn_from_is_named(changed, fault):
    usual = {"episodes": [np.zeros(9), np.arange(9.0)], "failed": [False, True], "dt": 1.0}
    with pytest.raises(ValueError, match=fault):
        Foresight.learn_log(**usual | changed)


def test_a_guard_alarms_row_by_row_as_the_log_was_judged_also_from_its_file(surge, reloaded):
    reviser = ActionReviser(surge, Choices(1), tolerance=1e-6)
    guard = reloaded(Guard.of(reviser, interval=DT, learn=False))
    episodes, failed = log_of(surging, 2, 8)
    tally, on = surge.tally(Runs.of(episodes, failed), surge.alarm)
    said = []
    for episode, is_failed in zip(episodes, failed, strict=True):
        said += [guard.decide(z, 0) for z in episode]
        guard.end(is_failed)
    assert [one.risk_proposed > reviser.tolerance for one in said] == on.tolist()
    assert tally.foreseen > 0
    first = said[int(on.argmax())]
    assert first.interval[0] < first.risk_proposed < first.interval[1]
    assert "such alarms it failed within 20 min" in first.reason
    assert first.executed == 0


def test_what_is_repeated_or_missing_changes_no_alarm(surge):
    guard = Guard.of(ActionReviser(surge, Choices(1), tolerance=0.3), interval=DT, learn=False)
    near = [0.4, 0.62]
    assert guard.decide(near, 0, 0.0).risk_proposed > 0.3
    assert guard.decide([0.6, 0.6], 0, 0.0).risk_proposed > 0.3  # as old as before: nothing new
    assert guard.decide([np.nan, np.nan], 0, DT).reason.startswith("not seen: pressure, flow")
    blind = [guard.decide([np.nan, np.nan], 0, (2 + k) * DT) for k in range(40)]
    assert min(one.risk_proposed for one in blind) > 0.3  # whoever loses sight clears no alarm
    assert "stays on until all is seen again; after" in blind[-1].reason
    guard.end()
    first = guard.decide([np.nan, np.nan], 0, 0.0)
    assert np.isnan(first.risk_proposed)
    assert "whether an alarm would be on is not known" in first.reason


@pytest.mark.parametrize(
    ("heat", "failed", "hold", "told"),
    [
        ([0, 0, 9, 9, 9], True, 1, (1, 2.0, 0)),
        ([0, 0, 9, 9, 9], True, 3, (0, 0.0, 0)),  # it would have come with the failure
        ([0, 0, 9, 9, 0, 0, 0, 0, 0, 0], False, 1, (0, 0.0, 1)),
        ([9] * 41, False, 1, (0, 0.0, 3)),  # once for each horizon
        ([9] * 41, True, 1, (1, 20.0, 1)),  # the horizon before the failure is right
        ([9, 0, 9, 0, 9], True, 1, (1, 4.0, 0)),  # it stays on for a while
        ([0, 0, 0, 0, 9], True, 1, (0, 0.0, 0)),  # no warning
        ([0, 0, 9] + [0] * 12, True, 1, (1, 12.0, 0)),  # it is over long before, and right
        ([9] + [0] * 30, True, 1, (0, 0.0, 1)),  # it came too early
        ([9] + [0] * 14 + [9] + [0] * 14, True, 1, (1, 14.0, 1)),  # each by itself
        ([9] * 25 + [0] * 9, True, 1, (1, 20.0, 1)),  # it said so again within the horizon
    ],
)
def test_what_counts_as_foreseen_and_as_false(heat, failed, hold, told):
    limits = np.array([[0, 1, 0, 0, 1, 5.0]])
    judge = Foresight(DT, 20, hold, np.empty((0, 14)), limits, np.zeros((1, 4)), ("heat",))
    found, _ = judge.tally(Runs.of([heat], [failed]), 0, plain=True)
    foreseen, minutes, false = told
    assert (found.foreseen, found.lead, found.false) == (foreseen, minutes * DT, false)


def test_an_end_teaches_what_was_seen_and_once_if_the_audit_log_refused_it(tmp_path, full_at):
    judge = Foresight.from_zero(dt=DT, names=NAMES)
    guard = Guard.of(ActionReviser(judge, Choices(1)), interval=DT, judge=judge)
    guard.end()
    assert not len(judge.log.starts)
    for k in range(4):
        with AuditLog(tmp_path / "log") as guard.audit:
            for heat in range(20):
                guard.decide([heat, 0.0], 0)
            with full_at(0), pytest.raises(OSError, match="ends with record"):
                guard.end(failed=True, observation=[20.0, 0.0])
        guard.audit = None
        guard.end(failed=True, observation=[20.0, 0.0])
        assert judge.log.lengths.tolist() == [21] * (k + 1)

"""The learnt judge in a guard: told nothing but which episodes failed, it keeps from failing."""

import copy
import math
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest

from evofsm import Guard
from evofsm.guard import AuditLog, Intake, Mode, Proposal, Situation, audit
from evofsm.guard.actions import same_action
from evofsm.guard.learnt import judge as judging
from evofsm.guard.learnt.rollout import action_of, search


def kept(said):
    return [same_action(one.executed, one.proposed) for one in said]


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_after_a_failure_or_two_it_keeps_a_bad_controller_from_failing(point, seed):
    guard = point.guard(seed=seed)
    assert 1 <= sum(point.play(guard, 1000 * seed + k)[1] for k in range(6)) <= 2
    guard.freeze()
    held_out = [point.play(guard, 90_000 + k) for k in range(10)]
    as_it_was = next(one for one in held_out[0][0] if same_action(one.executed, one.proposed))
    assert 0.0 <= as_it_was.interval[0] <= as_it_was.risk_executed <= as_it_was.interval[1] <= 1.0
    assert as_it_was.evidence > 0.0  # of what is remembered
    assert not any(failed for _, failed in held_out)
    assert 0.25 < np.mean([one for said, _ in held_out for one in kept(said)]) < 0.95
    alone = point.guard(mode=Mode.OFF)
    assert all(point.play(alone, 90_000 + k)[1] for k in range(10))


@pytest.mark.parametrize(("tries", "least", "most"), [(8, 1, 6), (0, 14, 14)])
def test_what_a_constant_proposal_never_showed_is_tried(tries, least, most):
    """A pot that is always half on: what less of it does is known only once it was tried."""
    guard = Guard(low=0.0, high=1.0, interval=1.0)
    numbers = replace(guard.judge.settings, tries=tries)
    guard.judge.state = guard.judge.state._replace(settings=numbers)
    failures = 0
    for episode in range(14):
        random = np.random.default_rng(episode)
        heat = random.uniform(20.0, 40.0)
        for _ in range(40):
            on = guard.decide([heat], 0.5).executed
            heat += 12.0 * on - 0.02 * (heat - 20.0) + random.normal(0.0, 0.1)
            if heat > 100.0:
                break
        guard.end(failed=heat > 100.0, observation=[heat])
        failures += heat > 100.0
    assert least <= failures <= most


def test_it_looks_far_ahead_in_steps_of_several_decisions(point):
    guard = point.guard(horizon=30.0, shadow=False)
    assert sum(point.play(guard, k)[1] for k in range(12)) <= 4
    assert sum(point.play(guard, 100 + k)[1] for k in range(5)) <= 1
    assert guard.judge.state.horizon * guard.judge.state.stride >= 300
    assert "in steps of 4 decisions" in guard.judge.told_by_experience


@pytest.mark.slow
def test_a_pendulum_that_is_decided_every_5_ms_is_held_by_looking_ahead_in_longer_steps():
    rng, dt, failed = np.random.default_rng(0), 0.005, []
    guard = Guard(low=-2.0, high=2.0, interval=dt)
    for _ in range(24):
        angle, rate = rng.uniform([-0.1, -0.3], [0.1, 0.3])
        for _ in range(800):
            torque = guard.decide([angle, rate], rng.uniform(-2.0, 2.0)).executed
            rate += dt * (15.0 * math.sin(angle) + 3.0 * torque)
            angle += dt * rate
            if abs(angle) > 0.5:
                break
        failed.append(abs(angle) > 0.5)
        guard.end(failed=failed[-1], observation=[angle, rate])
    assert sum(failed) <= 12
    assert sum(failed[-8:]) <= 1
    assert guard.judge.state.horizon * guard.judge.state.stride * dt > 0.8


def test_it_learns_beside_a_variable_that_rests_at_an_end(point):
    def seen(k, z):
        return [*z, 0.0, float(z[0] > 0.9)]  # a constant, and a contact

    guard = point.guard(shadow=False)
    failures = [point.play(guard, k, seen=seen)[1] for k in range(7)]  # then it doubts the wall
    assert np.abs(guard.judge.parts.model.weights).max() > 0.0
    assert sum(failures) <= 2
    assert not any(failures[-4:])


def test_of_what_never_changed_backups_learn_nothing(points):
    point = points["box"]
    guard = point.guard(shadow=False, backup=lambda z: -3.0 * z[1])
    for episode in range(4):  # the mean of 101.3 is rounded
        point.play(guard, episode, seen=lambda k, z: np.append(z, 101.3))
    model, policies = guard.judge.parts.model, guard.judge.state.policies
    done = [
        [action_of(model, policy, np.array([0.2, 0.1, seen])) for policy in policies]
        for seen in (101.3, 101.4, 150.0)
    ]
    np.testing.assert_array_equal(done[1:], [done[0]] * 2)


def test_nothing_is_revised_before_the_first_failure_and_it_says_why(point):
    guard = point.guard()
    said = [one for k in range(3) for one in point.play(guard, k, steps=10)[0]]
    assert not guard.machine.endings.any()
    assert all(kept(said))
    assert "nothing was learnt yet" in said[0].reason
    assert "no failure is known yet" in said[-1].reason
    assert all(math.isnan(one.risk_proposed) for one in said)


def test_where_only_good_endings_are_known_nothing_is_judged_and_all_are_counted():
    guard = Guard(-1.0, 1.0, interval=0.1)
    for start in range(5):
        for k in range(20):
            guard.decide([20.0 + start - k], 0.0)
        guard.end(observation=[0.0], terminated=True)
    said = guard.decide([1.0], 1.0)
    assert math.isnan(said.risk_proposed)
    assert "no failure is known yet" in said.reason
    assert "(5 endings)" in str(guard)


def test_what_failed_where_something_was_survived_is_said_to_fail_there():
    guard = Guard(n_actions=2, interval=1.0)
    for episode in range(12):
        path = [0, 1, 2, 3, 2, 1, 0] if episode == 5 else [0, 1, 2, 1, 2]
        for z in path:
            guard.decide([z, episode % 2], episode % 2)
        guard.end(observation=[3 * (episode % 2), episode % 2], failed=episode % 2 > 0)
    assert "fails where variable 1 is at or above 3" in str(guard)


def test_who_decides_once_an_episode_is_told_that_nothing_is_learnt():
    guard = Guard(n_actions=3, interval=1.0)
    for x in np.linspace(-1.0, 1.0, 20):
        reason = guard.decide([x, 0.0], 2).reason
        guard.end(bool(x > 0.0), [x, 10.0 * (x > 0.0)], terminated=True)
    for text in (reason, str(guard)):
        assert "nothing was learnt: no episode had four observations before it failed" in text


def test_of_failures_before_anything_was_seen_to_move_nothing_is_learnt():
    guard, seen = Guard(low=-1, high=1, interval=0.1), 0.1 * np.sin(np.arange(40))
    for number in range(12):
        for z in [9.0] if number < 10 else seen:
            reason = guard.decide([z], 0.1 * z).reason
        guard.end(number < 10)
    assert reason.startswith("10 failures, before four observations or")


def test_told_what_failure_is_it_keeps_from_the_first_one(point):
    guard = point.guard(failed=lambda z: z[0] >= 1.0, shadow=False)
    assert sum(point.play(guard, k)[1] for k in range(6)) <= 1
    assert not any(point.play(guard, 100 + k)[1] for k in range(5))


@pytest.mark.parametrize(
    ("failed", "says"),
    [
        (lambda z: z[0] >= 0.4, "fails where variable 1 is above 0.4;"),
        (lambda z: abs(z[0]) >= 0.4, "above 0.4 or variable 1 is below -0.4;"),
        (lambda z: z[0] + z[1] >= 0.4, "variable 1 + 0.707 variable 2 is above 0.283"),
        (lambda z: bool(np.hypot(*(z - [0.8, 0.0])) < 0.4), "inside an ellipse of variable 1 and"),
        (lambda z: bool((z <= -1e9).all()), "true nowhere around"),
        (lambda z: bool((z > -1e9).all()), "true of all that was observed"),
    ],
)
def test_a_function_of_failures_is_asked_around_what_was_survived(points, failed, says):
    point = points["box"]
    guard = point.guard(failed=failed)
    for k in range(4):
        point.play(guard, k, steps=20)
    told = guard.judge.told_by_experience
    assert says in told
    assert "otherwise" not in told


def test_what_was_seen_twice_before_a_decision_is_learnt_of_at_once(points):
    guard = points["box"].guard(failed=lambda z: z[0] >= 0.4)
    for k, proposal in enumerate(np.random.default_rng(0).uniform(-1.0, 1.0, 20)):
        guard.decide([0.02 * k, 0.02], proposal, 0.1 * k)
    guard.recognise([0.4, 0.02], 2.0)
    one = guard.revise(guard.recognise([0.42, 0.02], 2.1), Proposal(1.0))
    assert "after the proposal no backup prevents failure" in one.reason
    assert "how that ends was not seen yet" in one.reason
    assert one.evidence == 0.0  # though something is remembered
    assert guard.judge.remembered.number


@pytest.mark.parametrize("stride", [1, 2])
def test_of_a_long_episode_every_change_is_learnt_once(stride):
    guard = Guard(-1.0, 1.0, interval=0.1, horizon=10.0 * stride, mode=Mode.OFF)
    proposals, z = np.random.default_rng(0).uniform(-1.0, 1.0, 2100 * stride), 0.0
    for proposal in proposals:
        guard.decide([z], proposal)
        z = 0.9 * z + 0.1 * proposal
    guard.end(False, [z])
    assert guard.judge.state.stride == stride
    assert guard.judge.state.squares[0, 0] == 2100 - 1


def test_failures_that_no_threshold_explains_are_not_denied():
    guard = Guard(-1.0, 1.0, interval=0.1)
    rng = np.random.default_rng(0)
    for k in range(30):
        for z in np.vstack([rng.uniform(-1.0, 1.0, (12, 2)), -np.ones(2), np.ones(2), np.zeros(2)]):
            reason = guard.decide(z, proposal=0.5).reason
        guard.end(failed=k > 12)
    assert guard.judge.state.n_failed == 17
    assert reason.startswith("16 failures seen, but beyond no value that was survived")
    assert guard.judge.told_by_experience.startswith("17 failures seen")


@pytest.mark.parametrize("places", [7, pytest.param(32, marks=pytest.mark.slow)])
def test_many_variables_are_learnt_of_in_a_few_episodes_too(points, places, reloaded):
    many = replace(points["box"], places=places)
    guard = many.guard(shadow=False)
    assert sum(many.play(guard, k)[1] for k in range(4)) <= 2
    assert reloaded(guard).judge.n_variables == 2 * places


@pytest.mark.parametrize("m", [65, 500, 21_168])
def test_too_many_variables_are_refused_before_anything_is_allocated(point, snapshot, m):
    guard = point.guard()
    before = snapshot(guard)
    for act in (lambda z: guard.decide(z, None), lambda z: guard.end(observation=z)):
        with pytest.raises(ValueError, match=rf"has {m} variables; .* at most 64: .* observe="):
            act(np.zeros(m))
        assert snapshot(guard) == before
    point.play(guard, 0)
    (frozen := point.guard()).freeze()
    with pytest.raises(ValueError, match=rf"has {m} variables; .* at most 64"):
        frozen.decide(np.zeros(m), None)


@pytest.mark.parametrize("how", ["a file", lambda one: one.copy(), copy.deepcopy, pickle.dumps])
def test_a_copy_goes_on_the_same_by_itself_until_it_is_frozen(point, snapshot, reloaded, how):
    def said(guard, *episodes):
        return [pickle.dumps(point.play(guard, episode)[0]) for episode in episodes]

    guard = point.taught(3)
    before = snapshot(guard)
    twin = reloaded(guard) if how == "a file" else how(guard)
    twin = pickle.loads(twin) if isinstance(twin, bytes) else twin
    assert snapshot(twin) == before
    ahead = said(twin, 60, 61)
    assert snapshot(guard) == before
    assert said(guard, 60, 61) == ahead
    assert snapshot(guard) == snapshot(twin)
    guard.freeze()
    first, _, again = said(guard, 50, 51, 50)
    assert first == again
    assert snapshot(guard.judge) == snapshot(twin.judge)


@pytest.mark.parametrize(
    ("name", "most"),  # as it is, or cut short after so many steps
    [("box", math.inf), ("plane", math.inf), ("choices", math.inf), ("box", 2)],
)
def test_a_log_is_replayed_learning_and_frozen(points, tmp_path, monkeypatch, name, most):
    monkeypatch.setattr(judging, "search", lambda *given, **told: search(*given[:9], most, **told))
    point = points[name]
    with AuditLog(tmp_path / "log") as log:
        guard = point.guard(audit=log)
        for episode in range(4):
            point.play(guard, episode)
        guard.freeze()
        for episode in range(2):
            point.play(guard, 70 + episode)
    found = audit(tmp_path / "log", log.head)
    assert found.is_good, found
    assert found.replayed == found.contents.decisions > 150
    assert not found.not_replayed
    assert found.contents.spoke > 20
    assert (b"cut short" in (tmp_path / "log").read_bytes()) == (most < math.inf)


def test_only_what_a_mask_allows_is_executed_and_a_log_replays_it(points, tmp_path):
    random, said, point = np.random.default_rng(0), [], points["choices"]
    with AuditLog(tmp_path / "log") as log:
        guard = point.guard(audit=log)
        decide = guard.decide

        def masked(z, proposal):
            mask = random.permutation([True, True, guard.n_episodes == 0 or random.random() < 0.5])
            said.append(decide(z, Proposal(proposal, mask)))
            assert mask[said[-1].executed]
            assert (f"a({proposal + 1:.0f}), not all" in said[-1].reason) == (not mask[proposal])
            return said[-1]

        guard.decide = masked
        for episode in range(6):
            point.play(guard, episode)
    assert sum("no backup" in one.reason for one in said) > 9
    found = audit(tmp_path / "log", log.head)
    assert found.is_good, found
    assert found.replayed == found.contents.decisions == len(said)


NO_FLAGS = ["1", "0", "0"], [0, 1, 2], [math.nan, 1.0, 0.0]


@pytest.mark.parametrize("mask", [[True, False], [[True] * 3], True, *NO_FLAGS])
def test_a_mask_of_other_actions_or_of_texts_or_indices_is_refused(points, mask):
    why = "is .* must be True or False" if mask in NO_FLAGS else ".* an entry for each"
    for name in ("choices", "box")[: 1 if mask in NO_FLAGS else 2]:
        guard = points[name].guard()
        with pytest.raises(ValueError, match=f"mask of allowed actions {why}"):
            guard.decide([0.0, 0.0], Proposal(1, mask))
        assert guard.machine.n_states == 0


def test_what_is_not_seen_now_and_then_does_not_keep_it_from_deciding(point):
    def seen(k, z):
        return np.where([k % 7 == 3, *[False] * (len(z) - 1)], math.nan, z)

    guard = point.taught(4)
    said, failed = point.play(guard, 30, seen=seen)
    assert not failed
    assert not all(kept(said))
    assert all(np.isfinite(one.executed).all() for one in said)
    guard.freeze()
    proposal = point.propose(np.random.default_rng(0))
    nothing = guard.decide(np.full(2 * point.places, math.nan), proposal)
    assert same_action(nothing.executed, nothing.proposed)
    assert math.isnan(nothing.risk_proposed)
    assert "was observed" in nothing.reason
    risks = [guard.decide(np.zeros(2 * point.places), proposal).risk_executed]
    for _ in range(5):  # of what was not seen for long nothing is certain
        blind = guard.decide(np.append(math.nan, np.zeros(2 * point.places - 1)), proposal)
        assert blind.reason.startswith("not seen: variable 1; ")
        risks.append(blind.risk_executed)
    assert np.isnan(risks).tolist() == [*[False] * 5, True]


@pytest.mark.parametrize("how", ["every third row", "until it fails"])
def test_what_sensors_do_not_tell_of_a_failure_is_learnt_of(point, how):
    def seen(k, z):
        if how == "until it fails":
            return z * math.nan if z[0] >= 1.0 else z
        return np.where([*[False] * point.places, *[k % 3 > 0] * point.places], math.nan, z)

    def failures(guard, episodes):
        return sum(point.play(guard, episode, seen=seen)[1] for episode in episodes)

    guard = point.guard()
    alone = failures(point.guard(mode=Mode.OFF), range(100, 110))
    failures(guard, range(20))
    guard.freeze()
    assert failures(guard, range(100, 110)) == 0 < 8 <= alone


@pytest.mark.slow
def test_actions_that_act_late_are_learnt_of_where_the_latest_are_observed():
    """The pole falls soon: an action that comes three decisions late has to be known of."""

    def failures(guard, episodes):
        failed = []
        for rng in map(np.random.default_rng, episodes):
            (angle, rate), to_come = rng.normal(0.0, 0.05, 2), [0.0] * 3
            for _ in range(150):
                action = guard.decide([angle, rate, *to_come], rng.uniform(-1.0, 1.0)).executed
                rate += 0.05 * (5.0 * np.sin(angle) + 6.0 * to_come[0]) + 0.001 * rng.normal()
                angle += 0.05 * rate
                to_come = [*to_come[1:], float(action)]
                if abs(angle) > 0.5:
                    break
            failed.append(abs(angle) > 0.5)
            guard.end(failed[-1], [angle, rate, *to_come])
        return sum(failed)

    guard = Guard(-1.0, 1.0, interval=0.05)
    assert failures(Guard(-1.0, 1.0, interval=0.05, mode=Mode.OFF), range(100, 110)) == 10
    failures(guard, range(40))
    guard.freeze()
    assert failures(guard, range(100, 110)) == 0


def test_after_a_gap_in_time_nothing_follows_from_what_was(points):
    frozen, learning = points["box"].taught(3), points["box"].taught(3)
    frozen.freeze()
    fresh = frozen.decide([0.5, 0.05], 1.0, time=0.0)
    frozen.begin()
    frozen.decide([-0.5, 0.0], 1.0, time=0.0)
    after = frozen.decide([0.5, 0.05], 1.0, time=9.0)
    assert (after.executed, after.risk_proposed) == (fresh.executed, fresh.risk_proposed)
    for k in range(20):
        learning.decide([0.01 * k, 0.01], 0.1, time=0.1 * k)
    uses = learning.machine.model().uses.sum()
    learning.decide([0.9, 0.01], 0.1, time=60.0)
    assert learning.situation.intake is Intake.GAP
    assert math.isnan(learning.situation.surprise)
    assert learning.machine.model().uses.sum() == uses  # no transition either
    assert learning.judge.state.n_episodes == 4
    assert learning.judge.state.most[0] < 0.3  # the leap was not learnt


def test_a_question_changes_nothing_of_what_is_learnt(point, snapshot):
    asked, unasked = point.guard(horizon=None), point.guard(horizon=None)

    def ask(k, z):
        elsewhere = np.concatenate([z[: len(z) // 2] + 0.5, z[len(z) // 2 :]])
        there = Situation(elsewhere, np.ones(1), None, math.nan, 0.0)
        asked.judge.judge(there, [asked.judge.fallback.action])
        return z

    for episode in range(4):
        point.play(asked, episode, seen=ask)
        point.play(unasked, episode)
    assert snapshot(asked) == snapshot(unasked)


def test_weaker_brakes_are_noticed_said_and_followed():
    guard, random = Guard(low=-1.0, high=1.0, interval=0.1), np.random.default_rng(0)

    def drive(push):
        z = np.zeros(2)
        for _ in range(60):
            done = guard.decide(z, random.uniform(-1.0, 1.0)).executed
            speed = 0.9 * z[1] + push * done + 0.002 * random.normal()
            z = np.array([z[0] + speed, speed])
        guard.end(False, z)

    for _ in range(30):
        drive(0.02)
    assert "otherwise" not in guard.judge.told_by_experience
    margin = guard.judge.state.margin
    for _ in range(8):
        drive(0.01)
    since = re.search(r"since episode (\d+) variable 2 moves", guard.judge.told_by_experience)
    assert 30 <= int(since[1]) <= 34
    assert guard.judge.state.margin > margin  # it is not known how far the model is to be trusted
    effect = guard.judge.parts.model.weights[[5], 1]  # of the action on the speed
    assert effect == pytest.approx(0.01, abs=0.003)


def test_it_says_which_backup_survives_why_a_proposal_is_refused_and_what_fails(point):
    guard = point.taught(4)
    learnt = guard.judge.told_by_experience
    assert re.match(r"fails where variable 1 is above [01]\.\d*(;| or )", learnt)
    said, _ = point.play(guard, 9)
    assert len(set(kept(said))) == 2
    survives = re.compile(r".*then (always .+|feedback \d) survives .+, by [\d.]+ typical steps?")
    for one, as_proposed in zip(said, kept(said), strict=True):
        assert bool(survives.fullmatch(one.reason)) == as_proposed
        assert ("no backup " in one.reason) == (not as_proposed)
        instead = "the closest action after which|no action passes by the margin; "
        assert bool(re.search(instead, one.reason)) == (not as_proposed)


def test_where_there_is_but_one_action_reasons_name_no_backup():
    rng, guard, said = np.random.default_rng(0), Guard(n_actions=1, interval=1.0), []
    for episode in range(6):
        rises = float(episode % 2)
        z = np.cumsum(rng.normal(0.2 * rises, 0.05, 60))
        z = z[: np.append(z > 8.0, True).argmax() + 1]
        said += [guard.decide([one, rises], 0).reason for one in z[:-1]]
        guard.end(failed=bool(z[-1] > 8.0), observation=[z[-1], rises])
    refused = [reason for reason in said if reason.endswith("; nobody acts")]
    record = "it fails, even if nothing disturbs it; so it seemed in 1 episode of late: 1 failed;"
    assert any(reason.startswith(record) for reason in refused)
    assert not any("no backup" in reason for reason in said)

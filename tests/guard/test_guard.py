"""One object for any system: it decides, learns, is frozen, and is kept in a file."""

import math
import sys
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import one_guard
from evofsm import EvolvingFSM, Guard, IntervalActions, Labels, store
from evofsm.driving.cars import guard_for_cars
from evofsm.driving.judge import LatentRisk
from evofsm.driving.measures import ModifiedTimeToCollision
from evofsm.driving.revisers import EnvelopeReviser, Unrevised
from evofsm.guard.actions import Choices, put_into, same_action
from evofsm.guard.api import ActionJudge, Fallback, Judgement, Proposal, Search
from evofsm.guard.reviser import ActionReviser, Mode
from evofsm.guard.scene import SceneRisk

DT = 0.1
PUSHES = (-4.0, -1.0, 0.0, 1.0, 4.0)


class Balance(ActionJudge):
    """A judge of an inverted pendulum, no car: it fails where it cannot be brought back any more.

    It learns one number, the hardest gust so far, by which it is careful; `index` says that
    actions are told apart by index.
    """

    labels = Labels(names=("angle", "rate"), units=("rad", "rad/s"))

    def __init__(self, dt=DT, index=False, gust=0.05):
        self.dt = dt
        self.index = index
        self.gust = gust
        self._before = None

    @property
    def fallback(self):
        return Fallback(2.0 if self.index else 0.0, "doing nothing")

    def push(self, actions):
        return np.take(PUSHES, np.asarray(actions, int)) if self.index else np.asarray(actions)

    def judge(self, situation, actions):
        angle, rate = np.nan_to_num(situation.observation)
        after = rate + (5.0 * np.sin(angle) + self.push(actions)) * self.dt
        where = np.abs(angle + after * self.dt + 0.4 * after) + self.gust
        risk = 1.0 / (1.0 + np.exp(-20.0 * (where - 0.5)))
        return Judgement(risk, risk, risk, where, evidence=1.0, seen=math.nan)

    def why(self, judged):
        return "it would fall"

    def refuse_unfit(self, actions):
        if self.index and actions.high != len(PUSHES) - 1:
            raise ValueError(f"there are {len(PUSHES)} pushes")

    def learn(self, observation, action, *, watched):
        self.follow(observation, action, learn=True)

    def follow(self, observation, action, learn=False):
        if self._before is not None and learn and not np.isnan(observation).any():
            self.gust = max(self.gust, min(abs(observation[1] - self._before), 0.2))
        self._before = None if np.isnan(observation).any() else float(observation[1])

    def start_episode(self):
        self._before = None

    def end(self, observation, *, failed, terminated):
        self.start_episode()

    def save(self, path, provenance=None):
        path.write(f"{self.dt} {self.index:d} {self.gust!r}".encode())

    @classmethod
    def load(cls, path):
        dt, index, gust = path.read().decode().split()
        return cls(float(dt), bool(int(index)), float(gust))


class Shares(Balance):
    """Whose actions are vectors, of which the first component is a fourth of the push."""

    def push(self, actions):
        return 4.0 * np.asarray(actions)[..., 0]


class Searching(Shares):
    """Looks for an action itself, in small steps towards the other side."""

    def search(self, situation, wanted, /, *, tolerance, mask):
        away = np.stack([np.linspace(wanted[0], side, 41) for side in (-1.0, 1.0)], axis=1).ravel()
        options = np.column_stack([away, np.full(82, wanted[1])])
        judged = self.judge(situation, options)
        best = int(np.argmax(judged.risk <= tolerance))
        if judged.risk[best] > tolerance:
            best = int(judged.risk.argmin())
        return Search(options, judged, best, "kept" if best == 0 else "it would fall")


def continuous(**others):
    return Guard(low=-4.0, high=4.0, interval=DT, **({"judge": Balance()} | others))


def discrete(**others):
    judge = Balance(index=True)
    return Guard(n_actions=len(PUSHES), interval=DT, **({"judge": judge} | others))


def of_vectors(**others):
    """Actions are a share of the push and something that has no effect."""
    return Guard(low=[-1.0, 0.0], high=[1.0, 9.0], interval=DT, **({"judge": Shares()} | others))


def searching(**others):
    return of_vectors(**({"judge": Searching()} | others))


def balance(guard, proposals, gusts=(), missing=()):
    """One episode from a small lean; revisions, and whether it fell."""
    angle, rate, said = 0.1, 0.0, []
    for k, proposal in enumerate(proposals):
        seen = np.array([angle, rate])
        seen[[k in missing, False]] = math.nan
        revision = guard.decide(seen, proposal)
        said.append(revision)
        push = float(guard.judge.push(put_into(guard.actions, revision.executed)))
        rate += (5.0 * math.sin(angle) + push) * DT + (gusts[k] if k < len(gusts) else 0.0)
        angle += rate * DT
        if abs(angle) > 0.8:
            break
    guard.end(failed=abs(angle) > 0.8, observation=[angle, rate])
    return said, abs(angle) > 0.8


@pytest.fixture(params=[continuous, discrete, of_vectors, searching])
def make(request):
    return request.param


def pushes(make, count, seed=0):
    rng = np.random.default_rng(seed)
    if make in (of_vectors, searching):
        return list(rng.uniform([0.4, 2.0], [1.0, 3.0], (count, 2)))
    high = len(PUSHES) - 1 if make is discrete else 4.0
    return [int(p) if make is discrete else float(p) for p in rng.uniform(0.4 * high, high, count)]


SMALL = {continuous: 1, discrete: 1, of_vectors: [0.25, 1.0], searching: [0.25, 1.0]}

# -- What it decides ----------------------------------------------------------------------------


def test_it_holds_off_what_would_fall_without_it(make):
    wishes = pushes(make, 40)
    assert balance(make(mode=Mode.OFF), wishes)[1]
    said, fell = balance(make(), wishes)
    assert not fell
    assert any(not same_action(one.executed, one.proposed) for one in said)
    assert any("it would fall" in one.reason for one in said)


@settings(max_examples=60)
@given(
    make=st.sampled_from([continuous, discrete, of_vectors, searching]),
    mode=st.sampled_from(list(Mode)),
    proposals=st.lists(
        st.none()
        | st.tuples(st.floats() | st.sampled_from([0.0, 1.0, 4.0, 7.0, -1.0, 0.5]), st.floats()),
        min_size=1,
        max_size=12,
    ),
    gusts=st.lists(st.floats(-0.3, 0.3), max_size=12),
    missing=st.sets(st.integers(0, 11)),
)
def test_whatever_is_proposed_what_is_executed_can_be(make, mode, proposals, gusts, missing):
    guard, vectors = make(mode=mode), make in (of_vectors, searching)
    wishes = [one if one is None or vectors else one[0] for one in proposals]
    for revision in balance(guard, wishes, gusts, missing)[0]:
        passes = mode is not Mode.ACT and "no usable proposal" not in revision.reason
        if passes:
            assert same_action(revision.executed, revision.proposed)
        for action in (revision.advised, *[revision.executed] * (not passes)):
            assert same_action(put_into(guard.actions, action), action)
        if not vectors:
            assert type(revision.executed) is (int if make is discrete else float)
        assert revision.reason
        low, high = revision.interval
        assert math.isnan(low) or 0.0 <= low <= revision.risk_executed <= high <= 1.0
    assert guard.machine.n_states >= (0 if 0 in missing else 1)


def test_what_follows_on_an_action_beyond_the_range_teaches_nothing():
    """Watched, somebody brakes harder than the guard could."""
    guard, speed = guard_for_cars(-6.0, 2.0, interval=0.1, mode="shadow"), 30.0
    for k in range(60):
        wish = -9.0 if 10 <= k < 30 else 0.0
        speed += 0.1 * guard.decide([80.0, speed, 30.0], wish).executed
    assert guard.judge.brakes.decel <= 6.0
    assert guard.machine.uses.sum() == 59 - 20


def test_of_things_that_are_only_told_apart_a_kept_proposal_is_the_least_change():
    class Fixed(Balance):
        def judge(self, situation, actions):
            risk = np.take((0.5, 0.01, 0.3, 0.001, 0.3), np.asarray(actions, int))
            return Judgement(risk, risk, risk, risk, 1.0)

    guard = discrete(judge=Fixed(index=True))
    assert guard.decide([0.0, 0.0], 1).executed == 1
    assert guard.decide([0.0, 0.0], 4).executed == 3  # the least risky, however far its index
    for unusable in (7, -1, 1.5, None):
        revision = guard.decide([0.0, 0.0], unusable)
        assert (revision.executed, "no usable proposal" in revision.reason) == (3, True)


def test_time_is_counted_where_it_is_not_told():
    counted, told = (continuous(explaining=True) for _ in range(2))
    for episode in range(2):
        one = [counted.decide([0.1 * k, episode], 0.0) for k in range(5)]
        assert one == [told.decide([0.1 * k, episode], 0.0, DT * k) for k in range(5)]
        counted.end()
        told.end()
    assert one[-1].explanation


# -- What it learns -----------------------------------------------------------------------------


def test_proposals_that_are_all_outside_the_range_are_told_of_once():
    guard = Guard(low=0.0, high=1.0, interval=1.0)
    for k in range(300):  # in percent
        told = pytest.warns(UserWarning, match=r"is outside \[0, 1\] by far, as 100")
        with told if k == 99 else nullcontext():
            guard.decide([0.1 * k], 50.0 + k % 50)


@pytest.mark.parametrize("frozen", [False, True])
def test_what_lies_beyond_all_states_was_never_seen_however_often_the_nearest_was(frozen):
    guard = guard_for_cars(-2.5, 2.5)
    for k in range(60):
        guard.decide([60.0 + 5.0 * math.sin(k), 20.0, 20.0], 0.0)
    guard.end()
    guard.learn = not frozen
    asked = ([61.0, 20, 20], 1), ([200, 20, 20], 0), ([math.nan, 20, 20], 0), ([61, 20, 20], 1)
    for z, is_seen in asked:  # of the third 200 is held
        decided = guard.decide(z, 0.0)
        assert (decided.seen > 0.5, "never seen before" in decided.reason) == (is_seen, not is_seen)


def test_a_failure_is_told_or_found_by_the_function():
    guard = continuous(failed=lambda z: abs(z[0]) > 0.8)
    for last, end, failures in (
        (0.1, {"observation": [0.9, 0.0]}, 1),
        (0.1, {}, 1),
        (0.1, {"failed": np.bool_(True)}, 2),
        (0.9, {}, 3),  # the last observation decided on was one
    ):
        guard.decide([last, 0.0], 0.0)
        guard.end(**end)
        assert guard.machine.endings.sum() == failures


def test_frozen_it_learns_nothing_and_decides_the_same_again(make, snapshot):
    guard = make()
    balance(guard, pushes(make, 30), gusts=[0.1, -0.1])
    guard.decide([0.1, 0.0], SMALL[make])
    guard.freeze()  # in the middle of an episode, which is broken off
    before = snapshot(guard)
    one, other = (balance(guard, pushes(make, 30, 1), gusts=[0.15] * 9)[0] for _ in range(2))
    assert repr(one) == repr(other)
    assert snapshot(guard) == before


def test_a_copy_goes_its_own_way_and_a_judge_of_which_there_is_none_is_told(make, snapshot):
    guard = make()
    guard.valve = guard.machine.valve = threading.Lock()  # as a class of one's own adds
    balance(guard, pushes(make, 20))
    twin, bare = guard.copy(), guard.copy(states=False)
    assert twin.valve is twin.machine.valve is bare.valve is guard.valve
    before = snapshot(guard)
    first = balance(twin, pushes(make, 20, 2), gusts=[0.19])[0]
    assert snapshot(guard) == before
    again = balance(bare, pushes(make, 20, 2), gusts=[0.19])[0]
    assert repr([one.executed for one in first]) == repr([one.executed for one in again])
    assert bare.machine is None
    guard.judge.lock = threading.Lock()
    with pytest.raises(TypeError) as told:
        guard.copy()
    assert "the judge or reviser cannot be copied" in told.value.__notes__[0]


# -- What is kept -------------------------------------------------------------------------------


def test_what_was_saved_goes_on_bit_for_bit(make, snapshot, tmp_path):
    guard, path = make(tolerance=0.05, mode=Mode.SHADOW), tmp_path / "guard"
    balance(guard, pushes(make, 20))
    guard.decide([0.1, 0.0], SMALL[make])  # what is under way is not kept
    guard.save(path, {"roads": 3})
    assert store.read_header(path).provenance == {"roads": 3}
    again = Guard.load(path, judge=type(guard.judge))
    guard.begin()
    assert (again.reviser.tolerance, again.reviser.mode) == (0.05, Mode.SHADOW)
    assert (again.interval, again.actions) == (guard.interval, guard.actions)
    future = [repr(balance(one, pushes(make, 30, 3), gusts=[0.1])) for one in (guard, again)]
    assert future[0] == future[1]
    assert snapshot(guard) == snapshot(again)


def test_what_a_file_cannot_hold_has_to_be_given_again(tmp_path):
    path = tmp_path / "guard.evofsm"
    continuous(failed=lambda z: z[0] > 1.0).save(path)
    with pytest.raises(ValueError, match="failed="):
        Guard.load(path, judge=Balance)
    with pytest.raises(ValueError, match="give the judge's class"):
        Guard.load(path, failed=lambda z: False)
    assert Guard.load(path, judge=Balance, failed=lambda z: z[0] > 1.0).failed is not None
    own = type("Own", (Choices,), {})(5)
    unrevised = type("Own", (Unrevised,), {})(Choices(2))
    for part in (unrevised, ActionReviser(Balance(index=True), own)):
        with pytest.raises(ValueError, match=r"no file can hold .* of (Choices|Own)"):
            Guard.of(part, interval=DT).save(path)
    for name, does in (("save", "wrote nothing"), ("load", "gave None")):
        forgetful = type("Half", (Balance,), {name: lambda *_: None})()
        with pytest.raises(ValueError, match=f"^Half.{name} {does}: what it learnt"):
            continuous(judge=forgetful).save(BytesIO())
    with pytest.raises(ValueError, match="holds a guard, not a machine"):
        EvolvingFSM.load(path)


# -- Vectors ------------------------------------------------------------------------------------


def test_an_array_of_length_one_is_a_vector_but_for_a_number_as_policies_predict_it():
    guard = Guard(low=[-1.0], high=1.0, interval=DT, judge=Shares())
    revision = guard.decide([0.1, 0.0], [0.1])
    assert revision.executed.shape == revision.proposed.shape == revision.advised.shape == (1,)
    guard = Guard(low=np.float32(-1.0), high=1.0, interval=DT)
    assert guard.decide([0.1, 0.0], np.array([0.5])).executed == 0.5
    with pytest.raises(ValueError, match="proposal has 2 numbers; it must be a single one"):
        guard.decide([0.1, 0.0], [0.5, 0.5])


def test_of_a_vector_what_need_not_change_does_not_and_nobody_can_change_what_was_decided():
    wanted = np.array([0.9, 2.5])
    guard = of_vectors()
    revision = guard.decide([0.2, 0.3], wanted)
    wanted[:] = 9.0
    assert revision.proposed.tolist() == [0.9, 2.5]
    assert revision.executed[0] < 0.9
    assert revision.executed[1] == 2.5  # has no effect
    assert revision.risk_executed <= 0.02 < revision.risk_proposed
    for one in (
        revision.proposed,
        revision.executed,
        revision.advised,
        guard.situation.observation,
    ):
        with pytest.raises(ValueError, match="read-only"):
            one[0] = 0.0


def test_who_revises_without_a_revision_is_named_and_ranges_may_be_lists():
    own = type("Own", (Unrevised,), {"revise": lambda *_: 0.5})(IntervalActions(-2.5, 2.5, 0.3))
    with pytest.raises(TypeError, match=r"^Own.revise gave 0\.5; it has to give a Revision"):
        Guard.of(own, interval=DT).decide([0.0, 0.0], 1.0)
    listed = type("Own", (Balance,), {"ranges": [[-1.0, 1.0]], "why": lambda *_: None})()
    with pytest.raises(ValueError, match="angle is 2; it must lie between -1 and 1"):
        continuous(judge=listed).decide([2.0, 0.0], 1.0)
    reason = continuous(judge=listed).decide([0.5, 0.5], 4.0).reason
    assert "risk is above the tolerance; " in reason


# -- A judge's own search -----------------------------------------------------------------------


def test_what_a_search_finds_outside_is_put_into_the_set():
    class Bold(Searching):
        def search(self, situation, wanted, /, **how):
            options = np.array([wanted, [-5.0, 20.0]])
            return Search(options, self.judge(situation, options), 1, "bold")

    guard = searching(judge=Bold())
    assert guard.decide([0.0, 0.0], [0.0, 2.0]).executed.tolist() == [-1.0, 9.0]


def test_a_search_keeps_to_what_is_allowed():
    class Bold(Balance):
        def search(self, situation, wanted, *, mask, **_):
            np.ravel(True if mask is None else mask)[:] = True  # which changes what it is asked
            return Search(np.array([wanted, 2.0]), self.judge(situation, [0, 2]), 1, "bold")

    guard = discrete(judge=Bold(index=True))
    assert guard.decide([0.0, 0.0], Proposal(0)).executed == 2
    with pytest.raises(ValueError, match=r"^Bold.search gave .* allowed"):
        guard.decide([0.0, 0.0], Proposal(0, np.arange(5) != 2))


# -- What is refused ----------------------------------------------------------------------------


#: A single number.
ONE = {"low": -1.0, "high": 1.0}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "give low and high of the action, or n_actions"),
        (ONE | {"n_actions": 3}, "not both"),
        ({"low": [-1.0], "high": [1.0], "judge": LatentRisk(-1.0, DT)}, "a vector of 1"),
        ({"low": 1.0, "high": -1.0}, "low must be below high"),
        ({"n_actions": 4, "judge": Balance(index=True)}, "5 pushes"),
        (ONE | {"judge": Balance(dt=0.2)}, r"every 0\.2 s"),
        (ONE | {"horizon": -1.0}, "horizon"),
        ({"low": -2.5, "high": 1.0, "judge": LatentRisk(-4.5, DT)}, "set of actions ends at -2.5"),
        (ONE | {"judge": type("Half", (Balance,), {"end": None})()}, "that learns .* no end "),
        *((ONE | {"tolerance": p}, "tolerance") for p in (0.0, math.nan)),
        *((ONE | {"interval": dt}, "interval") for dt in (0.0, -1.0, math.nan)),
        (ONE | {"failed": True}, r"failed is .*; it must be a function"),
        (ONE | {"mode": "on"}, "mode is 'on'; it is one of off, shadow, act"),
        (
            ONE | {"judge": type("No", (Balance,), {"fallback": None})()},
            r"judge is .*No object.* has no fallback \(is it a subclass of evofsm.guard.ActionJ",
        ),
        (ONE | {"judge": Balance}, "must be an object with a method judge"),
        (ONE | {"audit": "log.jsonl"}, r"audit is .* has no begin, seen, decided, ended \(is it"),
        (ONE | {"judge": None, "names": "ab"}, "names is 'ab'; it must be"),
        (ONE | {"names": np.array(["a", "b"])}, "no names: leave them out"),
        ({"low": [0.0, 0.0], "high": [1.0], "judge": None}, "low has 2 components and high has 1"),
        ({"low": [0.0, 2.0], "high": [1.0, 2.0]}, "in component 1; low must be below high"),
        ({"low": [-math.inf], "high": [1.0]}, "low is .* must be finite"),
        ({"low": [], "high": []}, "not empty"),
        ({"low": [[0.0]], "high": [[1.0]]}, "low has shape"),
        ({"low": ["a"], "high": [1.0]}, "low"),
        ({"n_actions": 0, "judge": None}, "n_actions"),
        ({"n_actions": 10**9, "judge": None}, "takes at most 126 actions, not 1000000000: group"),
        (
            {"n_actions": 2, "judge": None, "horizon": 1e9},
            "10,000,000,000 decisions of 0.1 s; .* at most 10,000",
        ),
    ],
)
def test_what_makes_no_guard_is_refused(settings, message):
    with pytest.raises((TypeError, ValueError), match=message):
        Guard(**({"interval": DT, "judge": Balance()} | settings))


def test_settings_are_looked_at_where_they_are_set():
    guard = continuous()
    guard.mode, guard.reviser.tolerance = "shadow", 0.5
    assert (guard.reviser.mode, guard.tolerance) == (Mode.SHADOW, 0.5)
    for one in (guard, guard.reviser):
        for name, value in (("mode", "on"), ("tolerance", 5.0), ("tolerance", math.nan)):
            with pytest.raises(ValueError, match=f"^{name} is"):
                setattr(one, name, value)
    unrevised = Guard.of(Unrevised(IntervalActions(-2.5, 2.5, 0.3)), interval=DT)
    with pytest.raises(AttributeError, match="Unrevised has no mode"):
        unrevised.mode = "shadow"
    guard = Guard(-1.0, 1.0, interval=DT)
    for name, value in (("failed", "terminated"), ("shadow", 0), ("explaining", "no")):
        with pytest.raises(TypeError, match=f"^{name} is"):
            setattr(guard, name, value)
    with pytest.raises(AttributeError, match="interval"):
        guard.interval = 0.5  # judge and machine would go on by the other
    guard.failed = lambda z: z[0] > 1.0
    assert guard.judge.failed(np.array([2.0]))  # which asks it around what was survived


def test_a_reviser_for_another_interval_and_a_machine_of_other_actions_are_refused():
    reviser = EnvelopeReviser(ModifiedTimeToCollision(), IntervalActions(-2.5, 2.5, 0.3), 0.25)
    with pytest.raises(ValueError, match=r"is 0\.1 s, but the reviser was made for .* 0\.25 s"):
        Guard.of(reviser, interval=0.1)
    with pytest.raises(ValueError, match="the machine has 4 actions, but the set has 17"):
        guard_for_cars(-2.5, 2.5, machine=EvolvingFSM(4))


@pytest.mark.parametrize(
    ("call", "name", "value"),
    [
        *(("decide", "observation", z) for z in ([0.1], [0.1, 0.0, 0.0], [[0.1, 0.0]], None)),
        *(("decide", "observation", z) for z in ([0.1, math.inf], [0.1, 1e200], ["a", "b"])),
        *(("decide", "proposal", p) for p in ("much", Proposal("much"))),
        *(("decide", "time", t) for t in (math.inf, -math.inf, math.nan, 1e300, "1.0", [0.2])),
        ("end", "observation", [0.0]),
        *(("end", "failed", v) for v in (np.array([True]), [True], 1, 0.0, None, "no")),
        *(("end", "terminated", v) for v in (np.array([True]), 1)),
        *(("end", "score", v) for v in (math.nan, "much")),
    ],
)
def test_what_is_refused_leaves_it_as_it_was(make, call, name, value, snapshot):
    guard, twin = make(), make()
    for one in (guard, twin):
        balance(one, pushes(make, 10))
        one.decide([0.1, 0.0], SMALL[make])
    usual = {"observation": [0.2, 0.1]} | ({"proposal": SMALL[make]} if call == "decide" else {})
    with pytest.raises((TypeError, ValueError), match=f"{name}|rate|action"):
        getattr(guard, call)(**usual | {name: value})
    said = [repr(getattr(one, call)(**usual)) for one in (guard, twin)]
    assert said[0] == said[1]
    assert snapshot(guard) == snapshot(twin)


def test_functions_that_work_in_place_change_nothing_of_the_guard(snapshot):
    def failed(z):
        z -= 0.5
        return abs(z[0]) > 1.0

    def model(z, u):
        z[0] += DT * u
        return z

    def backup(z):
        return z.fill(0.0) or 1.0

    told = {"failed": failed, "model": model, "backup": backup}
    apart = {name: partial(lambda f, z, *u: f(z.copy(), *u), f) for name, f in told.items()}
    guards = [Guard(-1.0, 1.0, interval=DT, **functions) for functions in (told, apart)]
    for guard in guards:
        for _ in range(2):
            for k in range(20):
                guard.decide([0.1 * k, 1.0], 1.0)
            guard.end(observation=[2.0, 1.0])
    assert snapshot(guards[0]) == snapshot(guards[1])


def test_where_nothing_moves_before_it_fails_it_learns_all_the_same():
    for rows, last in ((40, 0.0), (40, 1.0), (3, 0.0), (1, 0.0)):
        guard = Guard(low=-1.0, high=1.0, interval=DT)
        for _ in range(4):
            for _ in range(rows):
                guard.decide([1.0, 2.0], 0.1)
            guard.end(True, [1.0, 2.0 + last])
        assert guard.n_failed == guard.judge.state.n_failed == 4


# -- What is broken off -------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "error"),
    [*((kind, KeyboardInterrupt) for kind in one_guard.MAKES), ("learnt", one_guard.BrokenError)],
)
def test_wherever_a_call_is_broken_off_nothing_is_done_and_it_works_again(kind, error):
    """At lines of all of the package, in each of its calls; ``make torture`` tries every line."""
    found = Counter(one_guard.harms(kind, 257, error))
    assert found.pop("") > 20
    assert not found


# -- Who feeds it -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("guard", "row", "says"),
    [
        (Guard(low=-1.0, high=1.0, interval=DT), [0.1, 0.2], "failure: nothing was learnt"),
        (
            Guard(n_actions=3, interval=DT, judge=SceneRisk(DT, 3)),
            [1.0] * 5,
            "failure: no failure with an object in sight is known",
        ),
        (guard_for_cars(-2.5, 2.5, DT), [9.0, 5.0, 5.0], "own brakes: not known yet"),
        (continuous(), [0.1, 0.2], "judge: Balance (ActionReviser, tolerance 0.02, mode act)"),
    ],
)
def test_a_guard_in_print_says_what_it_learnt_from(reloaded, guard, row, says):
    guard = guard.copy()
    for failed in (False, True, True):
        guard.decide(row, 0)
        guard.end(failed=failed)
    again = reloaded(guard, judge=type(guard.judge))
    assert str(guard) == str(again) == str(guard.copy())
    assert says in str(guard)
    assert "episodes: 3, failures: 2, states: 1, frozen: no" in str(guard)
    guard.freeze()
    for failed in (False, True):
        guard.end(failed=failed)
        guard.freeze()
    assert "failures: 2, states: 1, frozen: yes (1 of 2 episodes failed since)" in str(guard)
    guard.learn = True
    assert "frozen: no\n" in f"{guard}\n"


def test_threads_share_a_guard_and_what_is_saved_meanwhile_loads(tmp_path):
    guard, over = Guard(low=-1.0, high=1.0, interval=0.1), threading.Event()

    def work(seed):
        draw = np.random.default_rng(seed)
        while not over.is_set():
            guard.decide(draw.normal(size=2), draw.uniform(-1.0, 1.0))
            if draw.random() < 0.05:
                guard.end(failed=draw.random() < 0.5)

    usual = sys.getswitchinterval()
    with ThreadPoolExecutor(3) as threads:
        sys.setswitchinterval(1e-5)
        try:
            done = [threads.submit(work, seed) for seed in range(3)]
            for _ in range(20):
                guard.save(tmp_path / "guard.evofsm")
                Guard.load(tmp_path / "guard.evofsm")
        finally:
            over.set()
            sys.setswitchinterval(usual)
    assert [one.result() for one in done] == [None] * 3

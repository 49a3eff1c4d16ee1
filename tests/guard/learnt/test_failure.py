"""Where a system fails."""

import re
from dataclasses import replace

import numpy as np
import pytest
from studies.judges import run
from studies.systems import Start, make_system

from evofsm import Guard
from evofsm.guard.learnt import failure
from evofsm.guard.learnt.failure import AT, HELD, SAYS, TO, B, C, I, J, Survived, inside
from evofsm.guard.learnt.rollout import CRASHES, ENDS, FAILS

SHAPES = {
    "disc": lambda z: np.hypot(z[..., 0], z[..., 2]) < 0.8,
    "oblique": lambda z: 0.8 * z[..., 1] + 0.6 * z[..., 2] > 1.2,
    "ring": lambda z: np.hypot(z[..., 0], z[..., 1]) > 1.7,
    "hyperbola": lambda z: z[..., 0] * z[..., 1] > 0.8,
    "two discs": lambda z: np.hypot(np.abs(z[..., 1]) - 1.0, z[..., 2]) < 0.4,
    "corner": lambda z: (z[..., 0] > 0.5) & (z[..., 1] > 0.5),
}
UNIT = np.full(3, 0.1)


def survived_as(rows, unit, ended=()):
    """What was survived, as it is asked of."""
    ends, m = [np.array([end] * 2) for end in (rows.min(0), rows.max(0))], len(unit)
    return Survived(rows, *ends, unit, rows.std(0), np.reshape(ended, (-1, m)), np.zeros((m, 2)))


def test_a_single_failure_amid_what_was_survived_says_nothing_of_where_it_fails():
    random, at = np.random.default_rng(0), np.array([0.1, 0.2])
    seen = random.uniform(-1.0, 1.0, (2000, 2))
    known = survived_as(seen[np.hypot(*(seen - at).T) > 0.05], np.full(2, 0.1))
    beyond = np.column_stack([random.uniform(1.0, 1.2, 15), random.uniform(-1.0, 1.0, 15)])
    told = failure.explain(FAILS, np.vstack([beyond, at]), known)
    assert failure.are_sides(told).all()
    assert inside(told, beyond).any(0).all()
    again = np.vstack([beyond, at + random.uniform(-0.02, 0.02, (9, 2))])
    assert inside(failure.explain(FAILS, again, known), again).any(0).all()


def test_of_failures_by_chance_a_form_of_one_says_nothing():
    """Without it a single failure at the rim of what was seen is explained."""
    random = np.random.default_rng(1)
    seen, rim = random.uniform(-1.0, 1.0, (2000, 2)), np.array([[0.97, 0.97]])
    known = survived_as(seen[(seen < 0.9).any(1)], np.full(2, 0.1))
    assert len(failure.explain(FAILS, rim, known)) == 1
    by_chance = np.vstack([rim, random.uniform(-0.8, 0.8, (10, 2))])
    assert (failure.explain(FAILS, by_chance, known)[:, HELD] > 1).all()


def test_among_failures_by_chance_a_threshold_at_which_many_failed_stays():
    """One episode alone survived there, so that none was beyond."""
    random, rows = np.random.default_rng(0), np.arange(600.0).reshape(300, 2) % 3
    known = survived_as(np.vstack([rows, [3.0, 0.0]]), np.ones(2))
    known = known._replace(highest=np.array([[3.0, 2.0], [2.0, 2.0]]))
    at_end = np.column_stack([np.full(12, 3.0), random.uniform(0.0, 2.0, 12)])
    told = failure.explain(FAILS, np.vstack([at_end, random.integers(0, 3, (14, 2))]), known)
    assert inside(told, at_end).all()


@pytest.mark.parametrize("shape", SHAPES)
def test_forms_explain_failures_and_nothing_that_was_survived_is_inside(shape):
    seen = np.random.default_rng(0).uniform(-2.0, 2.0, (2000, 3))
    fails = SHAPES[shape](seen)
    failures, survived = seen[fails][:40], seen[~fails]
    forms = failure.explain(FAILS, failures, survived_as(survived, UNIT))
    assert len(forms) <= 3
    assert not failure.are_sides(forms).any()
    assert inside(forms, failures).any(0).mean() >= 0.95
    assert (failure.distances(forms, survived) > 0.0).all()
    elsewhere = np.random.default_rng(1).uniform(-2.0, 2.0, (2000, 3))
    said = (failure.distances(forms, elsewhere) < 0.0).any(0)
    assert (said != SHAPES[shape](elsewhere)).mean() < 0.06


def test_the_walls_of_a_room_stay_thresholds_of_which_each_explains_a_few():
    rng = np.random.default_rng(0)
    survived, failures = rng.uniform(-1.0, 1.0, (3000, 9)), rng.uniform(-0.9, 0.9, (33, 9))
    walls = np.arange(32) % 8
    failures[:32][np.arange(32), walls // 2] = np.where(walls % 2, 1.01, -1.01)  # one has none
    forms = failure.explain(FAILS, failures, survived_as(survived, np.full(9, 0.02)))
    held = {(int(row[I]), row[B]) for row in forms[failure.are_sides(forms)]}
    assert held >= {(k, sign) for k in range(4) for sign in (-1.0, 1.0)}


EXACT = np.zeros((2, 2))
AMID = [[-0.1, 13.0], [0.1, 4.0], [0.2, 5.0], [0.3, 6.0]]
ABOVE_ALONE = np.array([[0.0, 0.2], [0.2, 0.2]])  # who stands, does not fail for it


@pytest.mark.parametrize(
    ("failures", "blur", "ends"),
    [
        ([[-1.0, 11.0], [-2.0, 5.0]], EXACT, {(0, -1.0, 0.0)}),  # that explains all of them
        ([[-1.0, 11.0]], EXACT, {(0, -1.0, 0.0), (1, 1.0, 10.0)}),  # of one it may be either
        ([[5.0, 5.0]], EXACT, set()),  # amid what was survived
        ([[0.5, 5.0]], EXACT, set()),
        ([[0.6, 5.0], [0.2, 4.0]], EXACT + 0.2, {(0, -1.0, 0.6)}),  # the innermost says where
        ([[9.4, 5.0]], EXACT + 0.2, {(0, 1.0, 9.4)}),
        ([[9.4, 5.0], [9.8, 4.0]], EXACT + 0.2, {(0, 1.0, 9.4)}),
        ([[2.0, 5.0]], EXACT + 0.2, set()),  # farther in than any noise
        ([[5.0, 5.0]], EXACT + 3.0, set()),  # nothing but noise
        ([[0.0, 5.0]], ABOVE_ALONE, set()),  # where a variable saturates nothing is blurred
        (AMID, EXACT + 0.2, {(0, -1.0, 0.3)}),  # the one that may explain most
    ],
)
def test_failures_are_explained_by_ends_of_what_was_survived(failures, blur, ends):
    known = survived_as(np.linspace([0.0, 0.0], [10.0, 10.0], 40), np.ones(2))
    found = failure.sides_of(FAILS, np.array(failures), known._replace(noise=blur))
    assert (found[:, C] == 0.0).all()
    assert {(int(i), sign, at) for i, sign, at in found[:, [I, B, AT]].tolist()} == ends


def test_of_flags_those_failures_count_in_which_they_were_set():
    failures = np.repeat(np.eye(3), [5, 2, 1], axis=0)
    found = failure.sides_of(FAILS, failures, survived_as(np.zeros((40, 3)), np.ones(3)))
    assert found[:, HELD].tolist() == [5.0, 2.0, 1.0]


# -- As guards learn them -----------------------------------------------------------------------


def test_a_disc_is_learnt_said_and_no_threshold(snapshot, reloaded):
    system = make_system("disc")
    taught = Guard(-np.ones(2), np.ones(2), interval=system.interval, horizon=2.0)
    for episode in range(12):
        run(system, taught, Start.training(0, 0, episode))
    state = taught.judge.state
    assert (state.forms[:, SAYS] == FAILS).any()
    survived = np.concatenate([state.survived, state.brinks])
    assert (failure.distances(state.forms, survived) > 0.0).all()
    assert "ellipse of variable 1 and variable 2 around (" in taught.judge.told_by_experience
    assert taught.told_here([0.0, 0.0, 0.0, 0.0]).startswith("This is where it fails: inside")
    assert "typical steps from where it fails" in taught.told_here([-0.9, 0.0, 0.0, 0.0])
    assert taught.told_here([-2.0, 1.5, 0.0, 0.0]) == ""
    again = reloaded(taught)
    assert snapshot(again) == snapshot(taught)
    held = [run(system, again, Start.held_out(0, episode)) for episode in range(5)]
    assert sum(one.failed for one in held) <= 1


def test_a_rival_reaches_inwards_where_failures_lie_on_a_rim_that_was_skimmed():
    angle = np.linspace(2.0, 4.3, 6)
    failures = 0.78 * np.array([np.cos(angle), np.sin(angle)]).T
    rows = np.random.default_rng(1).uniform(-3.0, 3.0, (3000, 2))
    rows = rows[np.hypot(*rows.T) > 0.8]
    rows = rows[rows[:, 0] < 0.5]  # nobody came to the other side yet
    known = survived_as(rows, np.full(2, 0.02))
    table = failure.explain(FAILS, failures, known)
    tried = failure.rivals(table, failures, known)
    assert inside(tried, failures).any(0).all()
    assert not inside(tried, rows, blur=0.0).any()
    far = np.array([[2.0, 0.0], [2.0, 2.0], [2.0, -2.0]])
    assert not inside(tried, far).any()


@pytest.mark.parametrize("ended", [(), [-0.1, -0.1, 0.0]])
def test_a_rival_of_a_threshold_fails_only_as_failures_did(ended):
    """A craft fails where it touches fast or tilted, whether or not it touched softly once."""
    rng = np.random.default_rng(2)
    rows = np.column_stack([rng.uniform(0.0, 5.0, 500), rng.normal(0.0, [0.6, 0.3], (500, 2))])
    failures = np.array([[-0.1, -1.4, 0.6], [-0.1, -1.2, -0.7], [-0.1, -1.1, 0.5]])
    known = survived_as(rows, np.full(3, 0.02), ended)
    tried = failure.rivals(failure.sides_of(FAILS, failures, known), failures, known)
    says, touches = tried[:, SAYS], np.array([[-0.1, -0.1, 0.0], *failures])
    assert inside(tried[says == ENDS], touches).any(0).all()
    assert inside(tried[says == CRASHES], touches).any(0).tolist() == [False, True, True, True]


def test_a_rival_of_a_crash_asks_how_far_out_failures_were():
    """Two soft touches with a tilt tell nothing of upright ones."""
    rows = np.random.default_rng(2).uniform([0.0, -2.0, -1.0], [5.0, 2.0, 1.0], (500, 3))
    failures = np.array([[-0.1, -1.4, 0.1], [-0.1, -1.2, -0.2], [-0.1, -0.5, -0.9]])
    known = survived_as(rows, np.full(3, 0.02), [[-0.1, -0.3, 0.2], [-0.1, -0.4, 0.3]])
    ends = failure.explain(ENDS, known.ended, failure.boxed(known, rows))
    table = np.vstack([ends, failure.crashing(failures, known.ended, known, 0)])
    table[1:] = table[1]
    table[1:, [I, J]], table[1:, [AT, TO]], table[1:, B] = 2, 0.19, -1.0  # tilted less
    touches = np.array([[-0.1, -0.3, 0.0], [-0.1, -1.3, 0.25], *failures])
    tried = failure.rivals(table, failures, known)
    for forms, crash in ((table, [1, 0, 1, 1, 1]), (tried, [0, 1, 1, 1, 1])):
        says = forms[:, SAYS]
        assert inside(forms[says == CRASHES], touches, 0.0).any(0).tolist() == crash


@pytest.mark.slow
def test_what_refused_for_long_without_a_failure_is_tried_by_its_smallest_rival():
    """A craft that sinks fails if it touches fast, and ends if slowly, which it did never yet."""
    guard = Guard(0.0, 1.0, interval=0.1)

    def fly(throttle):
        z = np.array([3.0, 0.0])
        for _ in range(150):
            u = float(np.squeeze(guard.decide(z, throttle(z)).executed))
            v = z[1] + 0.1 * (2.0 * u - 1.0)
            z = np.array([z[0] + 0.1 * v, v])
            if z[0] <= 0.0:
                break
        touched, fast = bool(z[0] <= 0.0), bool(z[1] < -0.6)
        guard.end(touched and fast, z, terminated=touched and not fast)
        return touched and not fast

    def softly(z):
        return np.clip(0.5 + 2.0 * (-0.25 - 0.15 * z[0] - z[1]), 0.0, 1.0)

    rng = np.random.default_rng(0)
    ended = sum(fly(lambda z: rng.uniform(0.0, 0.9)) for _ in range(30))
    words = "tried while it learns, .*: it only fails if it ends|ends by itself where"
    assert re.search(words, str(guard))
    assert sum(map(int, re.findall(r"\((\d+) ending", str(guard)))) <= ended  # others failed
    assert sum(fly(softly) for _ in range(9)) >= 7
    assert (guard.judge.state.forms[:, SAYS] == ENDS).any()  # it is known now
    guard.freeze()
    assert "tried while it learns" not in str(guard)
    assert sum(fly(softly) for _ in range(9)) == 9


@pytest.mark.parametrize("ends", [[], [(0.5, 1.3), (0.6, 1.3)]])
def test_frozen_a_threshold_counts_on_for_a_while_that_fewer_took_the_place_of(ends):
    guard = Guard(-1.0, 1.0, interval=0.1)
    nothing_tried = replace(guard.judge.settings, tries=0)
    guard.judge.state = guard.judge.state._replace(settings=nothing_tried)

    def drive(to, last, **how):
        assert all(guard.decide(z, 0.0).executed == 0.0 for z in np.linspace(0.0, to, 30))
        guard.end(observation=last, **how)

    drive((1.0, 1.0), (1.2, 2.4), failed=True)
    assert "variable 1 is above 1 or variable 2 is above 1" in str(guard)
    drive((1.0, 0.2), (1.2, 0.24), failed=True)
    assert "frozen it refuses, too, where variable 2 is above 1, as what" in str(guard)
    for last in ends:
        drive((0.5, 1.0), last, terminated=True)
    if not ends:
        drive((0.9, 3.0), None)
    assert "frozen it refuses" not in str(guard)  # that refuted it
    if not ends:
        drive((1.0, 0.5), (0.5, 0.25), failed=True)  # amid what was survived
        assert "(and elsewhere: 1 of the 3 failures are in none of these)" in str(guard)


def test_where_there_is_no_rival_nothing_is_doubted():
    guard, rng = Guard(-1.0, 1.0, interval=0.1, shadow=False), np.random.default_rng(0)
    for _ in range(14):
        place = 0.0
        for _ in range(60):
            place += 0.1 * guard.decide([place], rng.uniform(-0.4, 1.0)).executed
            if place >= 1.0:
                break
        guard.end(failed=place >= 1.0, observation=[place])
    assert guard.judge.state.n_doubted > guard.judge.settings.patience
    assert "it only fails" not in str(guard)
    forms = np.repeat(guard.judge.state.forms, 2, axis=0)  # of rivals all count the same failures
    guard.judge.state = guard.judge.state._replace(forms=forms, n_doubted=-1)
    (only,) = re.findall("it only fails ([^;]*)", str(guard))
    assert re.fullmatch(r"where variable 1 is above [\d.]+", only)

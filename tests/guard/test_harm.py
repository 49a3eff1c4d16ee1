"""A guard that makes things worse notices, steps back and says so."""

import math
from io import BytesIO
from itertools import combinations

import numpy as np
import pytest

from evofsm.guard import AuditLog, Guard, LearntRisk, Mode, audit, merge_judges
from evofsm.guard.api import Search
from evofsm.guard.export import write_c99
from evofsm.guard.harm import Harm, Outcome, chance_of, earlier
from evofsm.guard.learnt.judge import _unjudged

_ALONE = 0.05  # what the controller wants: so it fails after 20 steps


@pytest.fixture
def wrong(monkeypatch):
    """Learnt judges replace each proposal by what is written here, once they saw a failure."""
    instead = [1.0]

    def search(judge, situation, wanted, **_):
        if not judge.state.n_failed:
            return Search(np.array([wanted]), _unjudged(1), 0, "nothing was learnt yet")
        return Search(np.array([wanted, instead[0]]), _unjudged(2), 1, "it must")

    monkeypatch.setattr(LearntRisk, "search", search)
    return instead


def drive(guard, n=1, most=60):
    """How many steps each of ``n`` episodes took, and why proposals passed in it."""
    rows = []
    for _ in range(n):
        x, step = 0.0, 0
        while abs(x) < 1.0 and step < most:
            revision = guard.decide([x], _ALONE + 1e-3 * math.sin(7 * step))
            x, step = x + float(revision.executed), step + 1
        guard.end(failed=abs(x) >= 1.0, observation=[x])
        passes = revision.executed != revision.advised
        rows.append((step, revision.reason.split(":")[0] if passes else ""))
    return rows


def make(**settings):
    return Guard(-1.0, 1.0, interval=0.1, **settings)


def test_it_steps_back_within_fifteen_episodes_and_says_so(wrong):
    guard = make()
    rows = drive(guard, 15)
    assert {why for _, why in rows[:8]} == {"", "shadow"}
    since = guard.judge.harm.since
    assert 0 < since < 15
    assert f"steps back since episode {since}" in {why for steps, why in rows if steps > 15}
    said = f"steps back since episode {since}: guarded episodes failed after 1 steps in the median"
    assert said in guard.judge.told_by_experience
    assert said in str(guard)
    assert "it must" in guard.decide([0.0], _ALONE).reason


def test_frozen_it_stays_back_and_warns(wrong, tmp_path):
    guard = make()
    drive(guard, 15)
    with pytest.warns(UserWarning, match="steps back since episode"):
        guard.freeze()
    assert {why.split(" since")[0] for _, why in drive(guard, 12)} == {"steps back"}
    file = BytesIO()
    guard.save(file)
    again = Guard.load(BytesIO(file.getvalue()))
    assert drive(again, 3) == drive(guard, 3)
    with (
        pytest.warns(UserWarning, match="steps back"),
        pytest.raises(ValueError, match="would let all proposals pass"),
    ):
        write_c99(guard, tmp_path)
    guard.shadow = False
    assert drive(guard)[0] == (1, "")


def test_frozen_early_it_does_not_act_where_it_failed_sooner_so_far(wrong):
    guard = make()
    drive(guard, 3)  # once alone, twice guarded
    with pytest.warns(UserWarning, match="this guard may do harm: frozen so, proposals pass"):
        guard.freeze()
    assert {why for _, why in drive(guard, 3)} == {"may do harm"}
    assert "it may do harm: guarded episodes failed after 1 steps in the median (2 of 2)" in str(
        guard
    )


def test_it_is_tried_again_and_acts_once_that_lasts(wrong):
    guard = make()
    drive(guard, 12)
    wrong[0] = 0.0
    rows = drive(guard, 20)
    assert not guard.judge.harm.since
    assert rows[-1] == (60, "")
    assert "steps back" not in str(guard)


def test_what_goes_on_failing_is_tried_ever_more_rarely(wrong):
    guard = make()
    rows = drive(guard, 45)
    tried = [n for n, (steps, _) in enumerate(rows, 1) if steps == 1][-4:]
    assert np.diff([guard.judge.harm.since - 1, *tried]).tolist() == [3, 5, 9, 11]


def test_without_shadow_it_is_never_told_to_pass_which_is_said(wrong):
    guard = make(shadow=False)
    assert {why for _, why in drive(guard, 30)} == {""}
    assert "mode act, harm is not noticed)" in str(guard)
    assert not guard.copy().shadow


def test_a_guard_that_saves_is_never_driven_in_shadow(wrong):
    wrong[0] = 0.0
    guard = make()
    rows = drive(guard, 12)
    assert rows[1:] == [(60, "")] * 11
    assert "in shadow where in doubt" in str(guard)
    assert "it replaces the controller: 0% of proposals are kept; that is no filter" in str(guard)


def test_saved_copied_and_replayed_from_a_log_it_goes_on_the_same(wrong, tmp_path):
    with AuditLog(tmp_path / "log") as log:
        guard = make(audit=log)
        drive(guard, 7)
        file = BytesIO()
        guard.save(file)
        twins = guard.copy(), Guard.load(BytesIO(file.getvalue()))
        rows = drive(guard, 8)
        guard.shadow = False
        drive(guard, 2)
    assert "shadow" in {why for _, why in rows}
    assert all(drive(twin, 8) == rows for twin in twins)
    found = audit(tmp_path / "log", log.head)
    assert found.is_good
    assert found.replayed == found.contents.decisions > 100


def test_where_someone_else_acts_the_controller_is_alone(wrong):
    guard = make(mode=Mode.SHADOW)
    drive(guard, 5)
    assert [one.guarded for one in guard.judge.harm.outcomes] == [False] * 5
    guard.reviser.mode = Mode.ACT
    assert drive(guard, 2) == [(1, ""), (20, "shadow")]
    assert guard.judge.harm.chance == 1.0 / 7.0  # one of seven ways to choose one


def test_merged_it_is_said_of_all_episodes(wrong):
    guards = make(), make(seed=1)
    for guard in guards:
        drive(guard, 7)
        assert not guard.judge.harm.since
    assert merge_judges([guard.judge for guard in guards]).harm.since == 15


# -- The test ------------------------------------------------------------------------------------


def outcomes(*steps, guarded=False):
    """Of steps, negative where an episode did not fail."""
    return [Outcome(n, abs(k), k > 0, guarded) for n, k in enumerate(steps, 1)]


def test_its_chance_is_that_of_all_ways_to_deal_the_episodes_out():
    guarded, alone = outcomes(5, 9, -9, 40, 7), outcomes(9, 30, -60, 12)
    pooled, found = [*guarded, *alone], earlier(guarded, alone)
    dealt = [
        earlier([pooled[i] for i in some], [pooled[i] for i in range(9) if i not in some])
        for some in combinations(range(9), 5)
    ]
    assert found > 0
    assert chance_of(guarded, alone) == pytest.approx(np.mean(np.array(dealt) >= found))


@pytest.mark.parametrize(
    ("guarded", "alone"),
    [
        ((-5, -4, -6, -5), (20, 30, 25)),  # goals that were reached sooner
        ((50, 60, 70, 80), (20, 30, 25)),
        ((), (20,)),
    ],
)
def test_what_fails_later_or_not_at_all_is_no_harm(guarded, alone):
    assert chance_of(outcomes(*guarded), outcomes(*alone)) == 1.0


@pytest.mark.parametrize(("better", "most"), [(1.0, 4), (3.0, 0)])
def test_it_seldom_steps_back_without_harm(better, most):
    chance, stepped = np.random.default_rng(0), 0
    for _ in range(40):
        harm = Harm().after((30, 0, 30), failed=True)
        for _ in range(30):
            passes = bool(harm.passing(learning=True))
            after = chance.exponential(100.0 if passes else 100.0 * better)
            steps = 1 + int(min(after, 299.0))
            driven = (0, steps, 0) if passes else (steps, 0, 0)
            harm = harm.after(driven, failed=after < 299.0)
            stepped += bool(harm.since)
            if harm.since:
                break
    assert stepped <= most

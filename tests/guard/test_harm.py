"""A guard drives where guarded episodes end better than those alone, and says so."""

import math

import numpy as np
import pytest

from evofsm import Guard, Labels
from evofsm.guard import AuditLog, Fallback, Judgement, LearntRisk, Mode, Search, audit
from evofsm.guard.api import ObservingJudge
from evofsm.guard.export import write_c99
from evofsm.guard.harm import Harm, Outcome
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


def test_a_guard_under_which_it_fails_sooner_hardly_drives_and_says_so(wrong):
    guard = make()
    rows = drive(guard, 40)
    assert {why for _, why in rows} == {"", "shadow"}
    assert sum(steps == 1 for steps, _ in rows) <= 16
    said = "it was not shown to help: guarded episodes failed after 1 steps in the median"
    assert said in str(guard)
    assert "the controller alone failed after 20 steps" in guard.judge.told_by_experience
    assert "it must" in guard.decide([0.0], _ALONE).reason


@pytest.mark.parametrize("n", [3, 15])
def test_frozen_so_it_does_not_act_and_warns(wrong, reloaded, tmp_path, n):
    guard = make()
    drive(guard, n)
    with pytest.warns(UserWarning, match="was not shown to help: frozen so, proposals pass"):
        guard.freeze()
    assert {why for _, why in drive(guard, 12)} == {"was not shown to help"}
    assert drive(reloaded(guard), 3) == drive(guard, 3)
    with (
        pytest.warns(UserWarning, match="was not shown to help"),
        pytest.raises(ValueError, match="would let all proposals pass"),
    ):
        write_c99(guard, tmp_path)
    guard.shadow = False
    assert drive(guard)[0] == (1, "")


def test_it_is_tried_again_and_acts_once_that_lasts(wrong):
    guard = make()
    drive(guard, 8)
    wrong[0] = 0.0
    rows = drive(guard, 60)
    assert sum(row == (60, "") for row in rows[-20:]) >= 16
    assert "not shown to help" not in str(guard)


def test_without_shadow_it_is_never_told_to_pass_which_is_said(wrong):
    guard = make(shadow=False)
    assert {why for _, why in drive(guard, 30)} == {""}
    assert "mode act, harm is not noticed)" in str(guard)
    assert not guard.copy().shadow


def test_a_guard_that_saves_drives_nearly_always(wrong):
    wrong[0] = 0.0
    guard = make()
    rows = drive(guard, 40)
    assert sum(row == (60, "") for row in rows[1:]) >= 37
    assert "in shadow where in doubt" in str(guard)
    assert " (0 of the latest 20 guarded), states" in str(guard)
    nearly_all = "it refuses nearly everything: where it drives 0% of proposals pass, others are"
    assert nearly_all in str(guard)
    assert "; that is no filter" in str(guard)
    with pytest.warns(UserWarning, match=nearly_all.removeprefix("it ")):
        guard.freeze()


def test_saved_copied_and_replayed_from_a_log_it_goes_on_the_same(wrong, reloaded, tmp_path):
    with AuditLog(tmp_path / "log") as log:
        guard = make(audit=log)
        drive(guard, 7)
        twins = guard.copy(), reloaded(guard)
        rows = drive(guard, 8)
        guard.shadow = False
        drive(guard, 2)
        guard.decide([0.0], 0.0)
        guard.end(score=-3.5)
    assert "shadow" in {why for _, why in rows}
    assert all(drive(twin, 8) == rows for twin in twins)
    found = audit(tmp_path / "log", log.head)
    assert found.is_good
    assert found.replayed == found.contents.decisions > 100


def test_where_someone_else_acts_the_controller_is_alone(wrong):
    guard = make(mode=Mode.SHADOW)
    drive(guard, 5)
    assert [one.guarded for one in guard.judge.harm.outcomes] == [False] * 5
    guard.freeze()  # it was never tried
    guard.reviser.mode = Mode.ACT
    assert drive(guard, 2) == [(1, "")] * 2


class Cautious(ObservingJudge):
    """Of someone's own: it lets nothing of one end of the range pass, so that it always fails."""

    dt, fallback, labels = 0.1, Fallback(0.0, "nothing"), Labels()

    def __init__(self):
        self.harm, self.seen, self.done, self.ends = Harm(), [], [], []

    def judge(self, situation, actions):
        risk = np.where(np.asarray(actions) < 1.0, 1.0, 0.0)
        return Judgement(risk, risk, risk, risk, 1.0)

    def why(self, judged):
        return "it must"

    def refuse_unfit(self, actions):
        assert (actions.low, actions.high) == (-1.0, 1.0)

    def observe(self, observation):
        self.seen.append(float(observation[0]))

    def act(self, action):
        self.done.append(float(action))

    def end(self, observation, *, failed, terminated):
        self.ends.append((failed, terminated))

    def save(self, path, provenance=None):
        path.write(b"all but harm")

    @classmethod
    def load(cls, path):
        return cls()


def test_a_judge_of_ones_own_sees_all_and_is_found_to_do_harm(tmp_path):
    judge = Cautious()
    guard = make(judge=judge)
    rows = drive(guard, 12)
    assert rows[0] == (1, "")
    assert {why for _, why in rows} == {"", "shadow"}
    assert max(steps for steps, _ in rows) == 20
    assert len(judge.done) == sum(steps for steps, _ in rows) == len(judge.seen) - 12
    assert judge.ends == [(True, False)] * 12
    with pytest.warns(UserWarning, match="was not shown to help: frozen so, proposals pass"):
        guard.freeze()
    with pytest.raises(ValueError, match=r"^Cautious.save does not keep harm"):
        guard.save(tmp_path / "guard")


# -- Which is better -----------------------------------------------------------------------------


def arms(guarded, alone):
    """A record of episodes: steps, ``f`` if it failed, ``e`` if it ended by itself, and a score."""
    known = Harm().after((5, 0, 4), failed=False)._replace(outcomes=())
    for number, (steps, how, score) in enumerate([*guarded, *alone]):
        driven = (steps, 0, 0) if number < len(guarded) else (0, steps, 0)
        known = known.after(driven, failed=how == "f", ended=how == "e", score=score)
    return known


@pytest.mark.parametrize(
    ("guarded", "alone", "helps"),
    [
        ((90, "f", None), (30, "f", None), False),  # it fails later, but always
        ((30, "f", None), (90, "f", None), False),
        ((60, "", None), (90, "f", None), True),  # cut off before the other failed: nobody knows
        ((90, "", None), (60, "f", None), True),
        ((40, "e", None), (60, "f", None), True),  # reached its goal sooner
        ((60, "", None), (40, "e", None), False),  # hovers where the other lands
        ((60, "", None), (60, "", None), True),  # nothing went wrong
        ((60, "", -200.0), (40, "", 200.0), False),  # costs what the other earns
        ((60, "", 199.0), (40, "e", 200.0), False),
        ((60, "", 250.0), (40, "e", 200.0), True),
        ((60, "f", 900.0), (90, "", 1.0), False),  # failure counts before all scores
    ],
)
def test_frozen_it_acts_where_episodes_ended_better(guarded, alone, helps):
    assert arms([guarded] * 3, [alone] * 3).helps(learning=False) == helps


@pytest.mark.parametrize(
    ("failed", "kept", "alone", "helps"),
    [(18, 400, 0, 0), (8, 400, 0, 1), (8, 30, 0, 0), (8, 0, 0, 0), (4, 0, 0, 1), (2, 0, 12, 1)],
)
def test_frozen_it_acts_where_it_prevents_most_failures(failed, kept, alone, helps):
    """Later crashes count for little; who flies by itself has to do more, but few are no matter."""
    guarded = [(150, "f", None) if failed * k % 20 < failed else (300, "", None) for k in range(20)]
    survived = [(110, "", None)] * alone
    harm = arms(guarded, [(110, "f", None)] * 6 + survived)._replace(decided=500.0, kept=kept)
    assert harm.helps(learning=False) == helps


def test_frozen_scores_count_only_where_the_controller_alone_never_failed():
    """Who survives alone had an easier start: so a slow guard that arrives helps."""
    arrived, sooner, failed = (60, "e", -102.0), (50, "e", -90.0), (30, "f", -130.0)
    assert arms([arrived] * 7, [*[sooner] * 18, *[failed] * 2]).helps(learning=False)
    assert not arms([(60, "", -102.0)] * 7, [*[sooner] * 18, *[failed] * 2]).helps(learning=False)
    assert not arms([arrived] * 7, [sooner] * 20).helps(learning=False)


def test_a_guard_that_keeps_from_the_goal_or_refuses_nothing_that_fails_is_told_of():
    alone = [*[(50, "e", None)] * 4, *[(30, "f", None)] * 5]
    assert arms([(60, "", None)] * 19 + [(60, "e", None)], alone).spoiling == (
        "keeps what it guards from ending by itself: 1 of 20 guarded episodes, alone 4 of 9"
    )
    assert "itself" not in arms([(60, "", None)] * 15 + [(60, "e", None)] * 5, alone).spoiling
    harm = Harm()
    for driven in ((30, 0, 30), (0, 30, 30), (30, 0, 30), (30, 0, 30)):
        assert not harm.spoiling
        harm = harm.after(driven, failed=True)
    assert harm.spoiling == "refused nothing yet, though 3 episodes failed in which it could"
    assert not harm.after((30, 0, 29), failed=True).spoiling


def test_a_controller_of_which_much_more_is_kept_is_another_one_until_it_fails():
    harm = arms([(100, "", None)] * 9, [(30, "f", None)] * 3)  # of which nothing was kept
    assert not any(harm._replace(n_episodes=n).passing(learning=True) for n in (12, 13, 14))
    other = harm.after((100, 0, 60), failed=False)
    assert (other.passing(learning=True), other.passing(learning=False)) == ("shadow", "")
    same = other.after((0, 30, 0), failed=True)
    assert not same.is_on_trial
    assert len(same.alone()) == 4
    good = other.after((0, 80, 0), failed=False, ended=True)
    assert len(good.alone()) == 1
    assert good.passing(learning=True)


def test_frozen_it_does_not_forget_why_it_was_there():
    """While it learned a careless controller had luck of late: it may have been another one."""
    luck = [(45, "e", None)] * 3
    harm = arms([(60, "e", None)] * 19 + [(28, "f", None)], luck)
    first = [Outcome(1, 20, failed=True, guarded=False)] * 2
    harm = harm._replace(outcomes=(*first, *harm.outcomes), kept=400.0)
    assert not harm.helps(learning=True)
    assert harm.helps(learning=False)
    assert not harm._replace(moved=2).helps(learning=False)  # nor of a system that moves otherwise


def test_a_controller_that_became_good_drives_on_alone_under_a_guard_that_always_fails():
    harm, failed = Harm().after((30, 0, 29), failed=True), []
    for episode in range(40):
        drives = not harm.passing(learning=True)
        driven = (30, 0, 0) if drives else (0, 5 if episode < 20 else 60, 0)
        failed.append(drives or episode < 20)
        harm = harm.after(driven, failed=failed[-1])
    assert sum(failed[20:]) <= 3
    assert not any(failed[24:])
    assert not harm.helps(learning=False)


def test_where_the_guard_fails_now_and_then_it_is_soon_asked_whether_another_controller_came():
    harm, alone = arms([(60, "", None)] * 22, [(30, "f", None)] * 13), 0
    for episode in range(60):
        drives = not harm.passing(learning=True)
        driven = (60, 0, 0) if drives else (0, 60, 0)
        harm, alone = harm.after(driven, failed=drives and episode % 8 == 7), alone + (not drives)
    assert alone >= 20


@pytest.mark.parametrize(("kept", "least", "most"), [(3, 1, 8), (57, 30, 30)])
def test_a_controller_that_failed_by_bad_luck_is_soon_alone_if_most_is_replaced(kept, least, most):
    """One failure is all that is known of it; the guard keeps so many of 60 proposals."""
    taken = []
    for n in range(1, 21):
        harm = Harm((Outcome(n, 20, failed=True, guarded=False),), n, refuses=True)
        while not harm.passing(learning=True) and harm.n_episodes < n + 30:
            harm = harm.after((60, 0, kept), failed=False)
        taken.append(harm.n_episodes - n)
    assert least <= np.median(taken) <= most


@pytest.mark.parametrize(("how", "least", "most"), [("e", 20, 60), ("", 0, 8)])
def test_a_good_controller_that_is_kept_from_its_goal_is_tried(how, least, most):
    """It was careless for 40 episodes; under the guard it hovers. Nobody hopes for the unseen."""
    for seed in range(5):
        harm, alone = arms([(40, how, None)], [(30, "f", None)] * (3 + seed)), 0
        for episode in range(100):
            drives = not harm.passing(learning=True)
            driven = (60, 0, 30) if drives else (0, 40, 0)
            fails = not drives and episode < 40
            ends = not drives and not fails and how == "e"
            harm = harm.after(driven, failed=fails, ended=ends)
            alone += not drives and episode >= 40
        assert least <= alone <= most

"""What is begun with in place of nothing, and what cars tell each other of their leaders."""

import numpy as np
import pytest

from evofsm.driving.risk.latent import LatentRisk
from evofsm.driving.risk.leaders import REAL_DRIVES, LeaderBrakes, brakes_needed
from evofsm.guard.protocols import Situation

DT = 0.25
# Survived only up to some 9 m/s² of the leader.
HERE = Situation(np.array([10.0, 20.0, 20.0]), np.ones(1), 0, np.nan, 0.0)


def follow(risk, *decels, seed=0, speed=25.0, belief=(1.0,)):
    """Drives behind leaders who brake so hard, one after another, seen with noise."""
    rng = np.random.default_rng(seed)
    for decel in decels:
        gap = 40.0
        leader = np.concatenate([np.full(8, speed), speed - decel * DT * np.arange(1, 9)])
        leader = np.concatenate([leader, np.full(4, leader[-1])])
        for v in leader:
            seen = np.array([gap, speed, v]) + rng.normal(0.0, 0.1, 3)
            risk.learn(seen, 0.0, belief)
            gap += DT * (v - speed)
        risk.start_episode()
    return risk


def learnt(risk):
    """What others may be told of, in no order."""
    noise = [np.sort(sizes) for sizes in risk.perception.spreads.sizes()]
    return (
        sorted(risk.manoeuvres.decels),
        risk.manoeuvres.gentle,
        [sizes.tolist() for sizes in noise],
        risk.perception.noise,
        risk.onset_rate(),
    )


# -- A table to begin with ----------------------------------------------------------------------


def test_by_assumption_alone_49_are_needed_for_two_percent():
    table, risk = LatentRisk(-8.0).manoeuvres, 1.0
    for seen in range(1, brakes_needed(0.02) + 1):
        assert risk > 0.02
        table.remember(3.0)
        risk = float(table.harder(9.0))
        assert risk == pytest.approx(1.0 / (seen + 1))
    assert risk <= 0.02


def test_with_a_table_of_real_drives_a_tolerance_can_be_met_at_once():
    cautious, begun = (
        LatentRisk.told(-8.0, decel=7.0, leader_decel=10.0, leaders=leaders)
        for leaders in (None, REAL_DRIVES)
    )
    assert cautious.judge(HERE, [0.0]).risk[0] == 1.0
    judged = begun.judge(HERE, [0.0])
    assert 0.0 < judged.risk[0] <= 0.02
    assert judged.high[0] > 0.02  # it is not sure
    assert judged.evidence == sum(REAL_DRIVES.counts)


def test_the_shipped_table_says_no_more_than_was_seen():
    seen, hardest = sum(REAL_DRIVES.counts), max(REAL_DRIVES.decels)
    assert 6.1 <= hardest < 6.1 + 0.25
    assert len(REAL_DRIVES.decels) == seen == 92
    assert REAL_DRIVES.at_most_harder > 0.03
    assert 8.0 < REAL_DRIVES.hours_until(0.02) < 9.0
    assert float(LatentRisk(-8.0, leaders=REAL_DRIVES).manoeuvres.harder(9.9)) > 0.0


def test_a_table_counts_each_as_at_least_as_hard_as_it_was():
    decels = np.random.default_rng(1).uniform(2.5, 9.0, 200)
    counted = LeaderBrakes.counted(decels, gentle=7, hours=2.0, source="made up")
    np.testing.assert_array_less(np.sort(decels), np.array(counted.decels) + 1e-12)
    assert np.max(np.array(counted.decels) - np.sort(decels)) <= 0.25 + 1e-9


def test_none_seen_is_a_table_too():
    none = LeaderBrakes.counted([], gentle=3, hours=2.0, source="made up")
    assert none.decels == ()
    assert (none.hours_until(0.02), none.at_most_harder) == (float("inf"), 1.0)
    assert LatentRisk(-8.0, leaders=none).manoeuvres.gentle == 3


def test_it_is_remembered_and_forgotten_as_what_was_seen(tmp_path):
    risk = LatentRisk(-8.0, leaders=REAL_DRIVES)
    risk.save(tmp_path / "risk.evofsm")
    loaded = LatentRisk.load(tmp_path / "risk.evofsm")
    assert list(loaded.manoeuvres.decels) == list(REAL_DRIVES.decels)
    assert loaded.manoeuvres.gentle == REAL_DRIVES.gentle
    loaded.manoeuvres.remember(*[3.0] * 500)
    assert set(loaded.manoeuvres.decels) == {3.0}


def test_a_table_that_lacks_what_is_hard_here_is_refused():
    with pytest.raises(ValueError, match=r"from 2\.5 m/s² on, but hard is 2"):
        LatentRisk(-8.0, hard=2.0, leaders=REAL_DRIVES)
    higher = LatentRisk(-8.0, hard=3.5, leaders=REAL_DRIVES).manoeuvres
    assert len(higher) + higher.gentle == sum(REAL_DRIVES.counts) + REAL_DRIVES.gentle


# -- Sharing ------------------------------------------------------------------------------------

DRIVES = [(3.0, 1.5), (4.0, 5.0, 2.0), (6.0,)]


def test_merged_they_know_what_one_car_would_that_saw_all():
    cars = [follow(LatentRisk(-8.0, DT), *drive, seed=k) for k, drive in enumerate(DRIVES)]
    one = LatentRisk(-8.0, DT)
    for k, drive in enumerate(DRIVES):
        follow(one, *drive, seed=k)
    before = learnt(cars[1])
    first, *others = cars
    first.merge(others)
    assert learnt(first) == learnt(one)
    np.testing.assert_allclose(first.manoeuvres.table, one.manoeuvres.table)
    assert first.judge(HERE, [0.0]).risk == pytest.approx(one.judge(HERE, [0.0]).risk)
    assert learnt(cars[1]) == before


def test_merged_and_saved_it_is_the_same(tmp_path):
    risk = follow(LatentRisk(-8.0, DT), 3.0, seed=1)
    risk.merge([follow(LatentRisk(-8.0, DT), 4.0, seed=2)])
    risk.save(tmp_path / "risk.evofsm")
    assert learnt(LatentRisk.load(tmp_path / "risk.evofsm")) == learnt(risk)


def test_of_more_than_are_remembered_the_latest_of_each_stay():
    cars = [LatentRisk(-8.0) for _ in range(3)]
    for k, car in enumerate(cars):
        car.manoeuvres.remember(*(3.0 + k + 0.001 * np.arange(400)))
    cars[0].merge(cars[1:])
    kept = np.array(cars[0].manoeuvres.decels)
    assert len(kept) == 500
    for k in range(3):
        mine = kept[(kept >= 3.0 + k) & (kept < 4.0 + k)]
        assert 166 <= len(mine) <= 167
        assert mine.max() == pytest.approx(3.399 + k)


def test_onsets_add_up_by_state_only_where_states_are_the_same():
    def car(seed, belief):
        return follow(LatentRisk(-8.0, DT), 4.0, 3.0, seed=seed, belief=belief)

    mine, yours = car(1, (0.0, 1.0)), car(2, (0.5, 0.5))
    alone = mine.onset_rate((0.0, 1.0)), mine.seconds_seen((1.0, 0.0))
    mine.merge([yours])
    assert (mine.onset_rate((0.0, 1.0)), mine.seconds_seen((1.0, 0.0))) == alone
    again = car(1, (0.0, 1.0))
    again.merge([yours], same_states=True)
    seconds = 2 * 20 * DT
    assert again.seconds_seen((1.0, 0.0)) == pytest.approx(0.5 * seconds)
    assert again.seconds_seen((0.0, 1.0)) == pytest.approx(1.5 * seconds)


def test_own_brakes_are_ones_own_unless_told_otherwise():
    mine, yours = LatentRisk(-8.0), LatentRisk(-8.0)
    yours.brakes.trust(6.5)
    mine.merge([yours])
    assert not mine.brakes.known
    mine.merge([yours], brakes=True)
    assert mine.brakes.known
    assert mine.brakes.decel == pytest.approx(6.5)


@pytest.mark.parametrize(
    ("other", "how", "says"),
    [
        (LatentRisk(-8.0, dt=0.1), {}, "dt is 0.25 here and 0.1 there"),
        (LatentRisk(-8.0, hard=3.0), {}, "hard is 2.5 here and 3 there"),
        (LatentRisk(-4.0), {"brakes": True}, "lowest is -8 here and -4 there"),
        ("a file", {}, "only a LatentRisk can be merged, not str"),
    ],
)
def test_what_cannot_be_merged_is_refused_and_nothing_is_changed(other, how, says):
    risk, fine = LatentRisk(-8.0), LatentRisk(-8.0)
    fine.manoeuvres.remember(4.0)
    with pytest.raises((TypeError, ValueError), match=says):
        risk.merge([fine, other], **how)
    assert len(risk.manoeuvres) == 0
    with pytest.raises(ValueError, match="itself"):
        risk.merge([fine, risk])
    assert len(risk.manoeuvres) == 0

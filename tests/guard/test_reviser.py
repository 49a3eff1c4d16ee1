"""What the action reviser may do to a proposal, and what it never does."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evofsm import IntervalActions
from evofsm.driving import LatentRisk
from evofsm.guard import ActionReviser, Fallback, Judgement, Mode, Proposal, Situation
from evofsm.guard.actions import BoxActions, nearest_bounds
from evofsm.guard.api import Search, Trial

LOW, HIGH, TOLERANCE = -2.5, 2.5, 0.02
ACTIONS = IntervalActions(low=LOW, high=HIGH, width=0.3)
HERE = Situation(np.array([30.0, 20.0, 20.0]), np.ones(1), 0, 0.0, 0.0)
CLOSE = Situation(np.array([5.0, 20.0, 20.0]), np.ones(1), 0, 0.0, 0.0)
PROPOSALS = st.floats(LOW, HIGH)


class Told(LatentRisk):
    """Judges actions by a function; the brakes are known unless it is said otherwise."""

    def __init__(self, risk, *, known=True, lowest=LOW):
        super().__init__(lowest)
        self.risk = risk
        if known:
            self.brakes.trust(2.5)

    def judge(self, situation, accelerations):
        risk = np.array([self.risk(a) for a in accelerations])
        return Judgement(risk, 0.5 * risk, np.sqrt(risk), 10.0 * (1.0 - risk), 7.0)

    def choose(self, *_):
        """Leave it to the reviser."""


def test_where_all_is_as_risky_a_car_brakes_and_else_the_proposal_stays():
    judge = Told(lambda a: 1.0)
    for judge.lowest_first, executed in ((True, LOW), (False, 1.0)):
        assert ActionReviser(judge, ACTIONS).revise(HERE, Proposal(1.0)).executed == executed


@pytest.mark.parametrize("risk", [None, [0.1, 0.2], [1.1]])
def test_who_gives_no_judgement_is_named(risk):
    judge = Told(None)
    judge.judge = lambda *_: risk and Judgement(risk, *[[0.0]] * 3, 1.0)
    with pytest.raises(ValueError, match=r"^Told.judge gave .* of 1 actions; .* in \[0, 1\]"):
        ActionReviser(judge, ACTIONS).revise(HERE, Proposal(1.0))


@pytest.mark.parametrize("mode", [Mode.ACT, Mode.SHADOW])
def test_what_a_judge_does_to_its_arrays_is_not_executed(mode):
    class InPlace(Told):
        def judge(self, situation, accelerations):
            judged = super().judge(situation, accelerations)
            accelerations *= 10.0
            return judged

        def choose(self, situation, options, *_):
            options += 9.0

    revisers = [ActionReviser(of(lambda a: a > 1.0), ACTIONS, mode=mode) for of in (Told, InPlace)]
    for proposal in (Proposal(0.7), Proposal(2.0)):
        one, other = (reviser.revise(HERE, proposal) for reviser in revisers)
        assert one == other
    revisers[1].risk.effective = lambda situation, actions: 10.0 * actions
    assert revisers[1].revise(HERE, Proposal(-0.7)).advised in (LOW, -0.7)


FOUND = Search(np.array([1.0, 2.0]), Judgement(*[np.zeros(2)] * 4, 1.0), 1, "found")


@pytest.mark.parametrize("mode", [Mode.ACT, Mode.SHADOW])
@pytest.mark.parametrize(
    ("name", "answer"),
    [
        ("choose", (-1, "the last")),
        ("fallback", Fallback(math.nan, "what was done")),
        ("search", None),
        ("search", FOUND._replace(best=2)),
        ("search", FOUND._replace(options=np.array([2.0, 1.0]))),
        ("search", FOUND._replace(options=np.array([1.0, math.nan]))),
        ("search", FOUND._replace(judged=FOUND.judged._replace(risk=np.full(2, 5.0)))),
        ("trial", Trial(math.nan, "", "", "", "")),
    ],
)
def test_what_a_judge_names_itself_is_looked_at(mode, name, answer):
    judge = Told(lambda a: 1.0)
    setattr(judge, name, answer if name == "fallback" else lambda *_, **how: answer)
    if (name, mode) != ("trial", Mode.SHADOW):
        with pytest.raises(ValueError, match=rf"^Told.{name}\b"):
            ActionReviser(judge, ACTIONS, mode=mode).revise(HERE, Proposal(1.0))


@st.composite
def risks(draw):
    """Any risk at all: waves on a slope, around the tolerance."""
    slope, waves, phase = (draw(st.floats(-3.0, 3.0)) for _ in range(3))
    level = draw(st.floats(-8.0, 0.0))
    return lambda a: (
        1.0 / (1.0 + math.exp(-(level + slope * a + waves * math.sin(3.0 * a + phase))))
    )


@given(risks(), PROPOSALS)
def test_the_proposal_else_the_closest_that_is_tolerable_else_the_least_risky_is_executed(
    risk, wanted
):
    revision = ActionReviser(Told(risk), ACTIONS).revise(HERE, Proposal(wanted))
    lowest, highest = nearest_bounds(ACTIONS)  # of each interval, and both limits
    could = np.array([wanted, *np.minimum(np.maximum(wanted, lowest), highest)[1:]])
    danger = np.array([risk(a) for a in could])
    assert revision.executed in could
    tolerable = could[danger <= TOLERANCE]
    if len(tolerable):
        assert revision.risk_executed <= TOLERANCE
        assert abs(revision.executed - wanted) == np.abs(tolerable - wanted).min()
    else:
        assert revision.risk_executed == danger.min()
    assert revision.risk_executed <= max(revision.risk_proposed, TOLERANCE)


class Changing(Told):
    """Whose brakes are not known; accelerating is dangerous as long as it is said so."""

    def __init__(self):
        super().__init__(lambda a: 0.5 if self.danger and a > -1.0 else 0.0, known=False)
        self.danger = True


def test_while_the_own_brakes_are_unknown_it_brakes_in_full_for_a_second():
    judge = Changing()
    reviser = ActionReviser(judge, ACTIONS)
    first = reviser.revise(HERE, Proposal(1.0))
    assert first.executed == LOW
    assert "brakes not known" in first.reason
    judge.danger = False
    held = [reviser.revise(HERE, Proposal(1.0)).executed for _ in range(6)]
    assert held == [LOW] * 4 + [1.0] * 2
    judge.danger = True
    judge.brakes.trust(2.5)
    assert LOW < reviser.revise(HERE, Proposal(1.0)).executed <= -1.0


def test_brakes_are_not_tested_where_nothing_is_executed_nor_on_where_the_driver_takes_over():
    reviser = ActionReviser(Changing(), ACTIONS, mode=Mode.SHADOW)
    first = reviser.revise(HERE, Proposal(1.0))
    assert LOW < first.advised <= -1.0  # the least change, and no test in full
    assert "in full" not in first.reason
    assert "1.5 m/s² assumed" in first.reason
    reviser.mode = Mode.ACT
    assert "in full" in reviser.revise(HERE, Proposal(1.0)).reason
    reviser.risk.danger = False
    reviser.mode = Mode.SHADOW
    assert reviser.revise(HERE, Proposal(1.0)).advised == 1.0
    reviser.mode = Mode.ACT
    assert reviser.revise(HERE, Proposal(1.0)).executed == 1.0


@pytest.mark.parametrize("wanted", [-0.3, 0.0, 0.02, 1.0])
def test_where_nothing_is_executed_no_braking_is_asked_of_a_car_that_stands(wanted):
    standing = Situation(np.array([0.4, 0.02, 0.0]), np.ones(1), 0, 0.0, 0.0)
    judge = Told(lambda a: 1.0 if a > -9.0 else 0.0)
    reviser = ActionReviser(judge, ACTIONS, mode=Mode.SHADOW)
    assert reviser.revise(standing, Proposal(wanted)).advised >= min(wanted, 0.0)
    moving = standing._replace(observation=np.array([0.4, 0.5, 0.0]))
    assert reviser.revise(moving, Proposal(wanted)).advised == LOW


def test_once_revising_it_goes_on_until_the_proposal_is_safe_by_a_margin():
    level = 0.0
    judge = Told(lambda a: level if a > -1.0 else 0.001)
    reviser = ActionReviser(judge, ACTIONS)
    kept = []
    for level in (1.0, 0.95, 1.1, 0.95, 0.91, 1.1, 0.89, 0.95):  # the judge reads it
        level *= TOLERANCE
        kept.append(reviser.revise(HERE, Proposal(1.0)).executed == 1.0)
    assert kept == [True, True, False, False, False, False, True, True]
    reviser.start_episode()
    assert reviser.revise(HERE, Proposal(1.0)).executed == 1.0


def test_where_no_margin_can_be_had_what_is_tolerable_will_do_and_it_does_not_change_its_mind():
    levels = Told(lambda a: (2.0 if a > 0.0 else 0.95) * TOLERANCE)
    reviser = ActionReviser(levels, ACTIONS)
    first, *others = (reviser.revise(HERE, Proposal(1.0)).executed for _ in range(6))
    assert LOW < first <= 0.0
    assert others == [first] * 5


def test_what_was_never_seen_is_said_to_be_so_and_what_is_known_is_not():
    risk = LatentRisk(lowest=LOW)
    reviser = ActionReviser(risk, ACTIONS)
    unseen = reviser.revise(CLOSE, Proposal(1.0))  # it counts on what is assumed
    assert (unseen.executed, unseen.evidence) == (LOW, 0.0)
    assert unseen.interval[1] - unseen.interval[0] > 0.5
    reviser.start_episode()
    far = Situation(np.array([200.0, 10.0, 10.0]), np.array([0.0, 1.0]), 1, math.nan, 0.0)
    new = "never seen before, as far as the states tell; "
    for seen, remark in ((0.25, new), (0.5, ""), (math.nan, "")):
        revision = reviser.revise(far._replace(seen=seen), Proposal(0.0))
        assert revision.reason == f"{remark}risk is within the tolerance"
        np.testing.assert_equal(revision.seen, seen)


# -- Boxes of actions and their cells --------------------------------------------------------------

BOX = BoxActions((-1.0, 0.0), (1.0, 4.0))


@pytest.mark.parametrize(
    ("dimensions", "levels"),
    [(1, (17,)), (2, (9, 9)), (3, (4,) * 3), (4, (3,) * 4), (5, (2,) * 5), (8, (2,) * 6 + (1, 1))],
)
def test_a_grid_has_as_many_levels_as_make_81_cells_at_most(dimensions, levels):
    box = BoxActions((0.0,) * dimensions, (1.0,) * dimensions)
    assert box.levels == levels
    assert box.n_actions == math.prod(levels) <= 81


def test_every_cell_is_encoded_by_its_middle_and_beyond_lies_the_edge():
    middles = BOX.cells[:, : BOX.n_actions].mean(axis=0)
    assert [BOX.encode(middle) for middle in middles] == list(range(81))
    assert BOX.encode([-9.0, -9.0]) == 0
    assert BOX.encode([9.0, math.inf]) == 80
    for action, why in (([0.0, math.nan], "NaN"), ([0.0], "it must have 2")):
        with pytest.raises(ValueError, match=why):
            BOX.encode(action)


def test_options_are_the_nearest_of_each_cell_and_the_corners():
    lowest, highest = nearest_bounds(BOX)
    nearest = np.minimum(np.maximum([0.3, 1.0], lowest), highest)
    assert len(nearest) == 1 + 81 + 4
    assert nearest[0].tolist() == [0.3, 1.0]
    assert nearest[-4:].tolist() == [[-1.0, 0.0], [-1.0, 4.0], [1.0, 0.0], [1.0, 4.0]]
    assert (nearest == BOX.clip(nearest)).all()

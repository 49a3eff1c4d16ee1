"""What a learnt judge says: what may begin, how often it did, which backup survives it."""

import io
import re

import pytest

from evofsm.driving.naming import UNITS, VARIABLES
from evofsm.guard.actions import same_action
from evofsm.guard.learnt import words
from evofsm.guard.learnt.judge import LearntRisk
from evofsm.guard.learnt.words import Remembered

NONE, ONE, MANY = Remembered(0, 5.0), Remembered(1, 61.0), Remembered(10, 3050.0)
_BACKUP = r"(always (-?[\d.]+|\([-\d., ]+\)|a\(\d\))|feedback \d)"
_REMEMBERED = (
    r"(all \d+ disturbances|the 1 disturbance) remembered from [\d,.]+ s|what [\d.]+ s brought"
)
_KEPT = re.compile(rf"(.*; )?then {_BACKUP} survives ({_REMEMBERED}), by [\d.]+ ordinary changes?")


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        (
            words.refused(1, ONE, 1.0, 1.0),
            "no backup survives the 1 disturbance remembered from 61 s",
        ),
        (
            words.refused(0, MANY, 1.0, 1.5),
            "no backup survives all 10 disturbances remembered from 3,050 s by the margin of 1 "
            "ordinary change, were they 1.5 times as hard",
        ),
        (
            words.refused(0, NONE, 2.0, 1.01),
            "no backup survives what 5.0 s brought by the margin of 2 ordinary changes",
        ),
        (
            words.changed("always 1", ONE, 3.0),
            "the closest action after which always 1 survives it, by 3 ordinary changes or more",
        ),
        (
            words.kept("always 1", MANY, 3.0, spared=2),
            "then always 1 survives all but at most 2 of the 10 disturbances remembered from "
            "3,050 s, by 3 ordinary changes",
        ),
        (
            words.experience([("gap", True, 0.5), ("variable 2", False, 12.0)], ONE, 1.0),
            "fails where gap is below 0.5 or variable 2 is above 12; 1 disturbance remembered from "
            "61 s, to be survived by 1 ordinary change",
        ),
    ],
)
def test_numbers_and_nouns_agree(said, expected):
    assert said == expected


def test_a_kept_proposal_says_which_backup_survives_and_a_refused_one_why(point):
    said, _ = point.play(point.taught(4), 9)
    reasons = {kept: [] for kept in (True, False)}
    for one in said:
        reasons[same_action(one.executed, one.proposed)].append(one.reason)
    assert reasons[True]
    assert reasons[False]
    assert all(_KEPT.fullmatch(one) for one in reasons[True])
    assert all("no backup " in one for one in reasons[False])
    for one in reasons[False]:
        assert "the closest action after which" in one or "no action passes; " in one


def test_names_are_for_words_alone_and_are_kept():
    named = LearntRisk(0.1, n_actions=2, names=VARIABLES, units=UNITS)
    named.save(file := io.BytesIO())
    labels = LearntRisk.load(io.BytesIO(file.getvalue())).labels
    assert (labels.names, labels.units) == (VARIABLES, UNITS)


def test_what_was_learnt_names_the_variable_that_fails(point):
    assert point.guard().judge.told_by_experience == words.NO_FAILURE
    learnt = point.taught(4).judge.told_by_experience
    assert re.match(r"fails where variable 1 is above [01]\.\d*(;| or )", learnt)

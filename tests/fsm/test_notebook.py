"""What a notebook shows of a machine, a model and a step: escaped, and true."""

import re
from html import unescape

import numpy as np
import pytest

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.rules import Novelty


def shown(thing):
    """The text of a page, and the cells of its table by the heads of columns."""
    html = thing._repr_html_()
    rows = [re.findall("<t[dh]>(.*?)</t[dh]>", row) for row in re.findall("<tr>(.*?)</tr>", html)]
    columns = {unescape(head): list(cells) for head, *cells in zip(*rows, strict=True)}
    return unescape(re.sub("<.*?>", "", html.partition("<table>")[0])), columns


def percents(shares):
    return [f"{100 * share:.1f} %" for share in shares]


@pytest.fixture
def machine():
    machine = EvolvingFSM(n_actions=2, radius=0.5)
    machine.learn_many([[0.0, -7.5], [0.1, -7.5], [2.0, -7.5], [1.0, -7.5]], [0, 0, 0, 0])
    return machine


def test_a_machine_shows_its_states_and_where_it_is(machine):
    text, columns = shown(machine)
    assert text.startswith("EvolvingFSM: 2 states, 2 actions, radius 0.5")
    assert "rule Paper(), now in #2" in text
    assert columns == {
        "state": ["#1", "#2"],
        "variable 0": ["0", "1"],
        "variable 1": ["−7.5", "−7.5"],
        "visits": ["3", "1"],
        "belief": percents(machine.belief),
    }
    machine.observe([1.1, -7.5], failed=True)
    text, columns = shown(machine)
    assert columns["endings"] == ["0", "1"]
    assert "no episode has begun" in text
    assert "belief" not in columns


def test_a_machine_that_has_seen_nothing_has_no_table():
    for thing in (EvolvingFSM(n_actions=1), EvolvingFSM(n_actions=1).model()):
        assert shown(thing)[1] == {}


def test_many_states_are_the_most_visited_and_a_row_for_all_others():
    machine = EvolvingFSM(n_actions=1, rule=Novelty(0.5))
    Z = np.concatenate([np.arange(52.0), np.arange(40.0, 52.0)])[:, None]  # the last twelve twice
    machine.learn_many(Z, np.zeros(len(Z), np.int64))
    assert shown(machine)[1]["state"] == [*(f"#{i}" for i in range(41, 53)), "… and 40 more"]
    machine.observe([3.0])
    states = shown(machine)[1]["state"]
    assert states[:2] == ["#4", "#41"]  # the present one is always there
    assert len(states) == 13


def test_a_model_shows_names_and_units_which_are_escaped(machine):
    model = machine.model(names=["<script>alert(1)</script>", "a & 'b'"], units=["m", ""], dt=0.25)
    text, columns = shown(model)
    assert "an observation every 0.25 s" in text
    assert list(columns)[1:3] == ["<script>alert(1)</script> [m]", "a & 'b'"]
    assert "<script>" not in model._repr_html_()


def test_a_step_shows_belief_forecast_and_surprise(machine):
    step = machine.learn_one([1.1, -7.5], 0)
    text, columns = shown(step)
    assert text.startswith(f"Step: #{step.state + 1}, event NONE, surprise {step.surprise:.3f} bit")
    assert columns["belief"] == percents(step.belief)
    assert columns["forecast"] == percents(step.predicted)

"""What a notebook shows of a machine, a model and a step: well-formed, escaped, and true."""

from html.parser import HTMLParser

import numpy as np
import pytest

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.notebook import machine_html, model_html, step_html
from evofsm.fsm.rules import Novelty

_VOID = {"br"}


class Reader(HTMLParser):
    """Reads rows of cells, and insists that every tag is closed where it should be."""

    def __init__(self, html):
        super().__init__()
        self.rows, self.text, self.tags = [], "", set()
        self._open = []
        self.feed(html)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in _VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text += data
        if {"td", "th"} & set(self._open):
            self.rows[-1][-1] += data


def column(rows, head):
    place = rows[0].index(head)
    return [row[place] for row in rows[1:]]


@pytest.fixture
def machine():
    machine = EvolvingFSM(n_actions=2, radius=0.5)
    machine.learn_many([[0.0, -7.5], [0.1, -7.5], [2.0, -7.5], [1.0, -7.5]], [0, 0, 0, 0])
    return machine


@pytest.fixture
def crowd():
    """A machine of 52 states; the last twelve were seen twice."""
    machine = EvolvingFSM(n_actions=1, rule=Novelty(0.5))
    Z = np.concatenate([np.arange(52.0), np.arange(40.0, 52.0)])[:, None]
    machine.learn_many(Z, np.zeros(len(Z), np.int64))
    return machine


def test_a_machine_shows_its_states_and_where_it_is(machine):
    page = Reader(machine_html(machine))
    assert page.text.startswith("EvolvingFSM: 2 states, 2 actions, radius 0.5")
    assert "rule Paper(), now in #2" in page.text
    assert column(page.rows, "state") == ["#1", "#2"]
    assert column(page.rows, "variable 0") == ["0", "1"]
    assert column(page.rows, "variable 1") == ["−7.5", "−7.5"]
    assert column(page.rows, "visits") == ["3", "1"]
    assert column(page.rows, "belief") == [f"{100 * share:.1f} %" for share in machine.belief]
    assert "endings" not in page.rows[0]
    machine.observe([1.1, -7.5], failed=True)
    page = Reader(machine_html(machine))
    assert column(page.rows, "endings") == ["0", "1"]
    assert "no episode has begun" in page.text
    assert "belief" not in page.rows[0]


def test_a_machine_that_has_seen_nothing_has_no_table():
    page = Reader(machine_html(EvolvingFSM(n_actions=1)))
    assert page.text.endswith("no episode has begun")
    assert page.rows == []
    assert Reader(model_html(EvolvingFSM(n_actions=1).model())).rows == []


def test_many_states_are_the_most_visited_and_a_row_for_all_others(crowd):
    page = Reader(machine_html(crowd))
    assert column(page.rows, "state") == [*(f"#{i}" for i in range(41, 53)), "… and 40 more"]
    assert all(len(row) == len(page.rows[0]) for row in page.rows)
    crowd.observe([3.0])
    page = Reader(machine_html(crowd))
    assert column(page.rows, "state")[:2] == ["#4", "#41"]  # the present one is always there
    assert len(page.rows) == 14


def test_a_model_shows_names_and_units(machine):
    model = machine.model(names=["gap", "speed"], units=["m", ""], dt=0.25)
    page = Reader(model_html(model))
    assert "an observation every 0.25 s" in page.text
    assert page.rows[0][1:3] == ["gap [m]", "speed"]


def test_what_users_name_is_escaped(machine):
    html = model_html(machine.model(names=["<script>alert(1)</script>", "a & 'b'"]))
    page = Reader(html)
    assert "script" not in page.tags
    assert page.rows[0][1:3] == ["<script>alert(1)</script>", "a & 'b'"]


def test_a_step_shows_belief_forecast_and_surprise(machine):
    step = machine.learn_one([1.1, -7.5], 0)
    page = Reader(step_html(step))
    assert page.text.startswith(f"Step: #{step.state + 1}, ")
    assert f"event NONE, surprise {step.surprise:.3f} bit" in page.text
    assert column(page.rows, "belief") == [f"{100 * share:.1f} %" for share in step.belief]
    assert column(page.rows, "forecast") == [f"{100 * share:.1f} %" for share in step.predicted]

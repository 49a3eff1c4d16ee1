"""Properties of a learnt process: our own computation, a reader of what is exported, and Storm."""

import re
from functools import cache

import numpy as np
import pytest

from evofsm.fsm.machine import EvolvingFSM
from evofsm.io.graphs import to_prism
from evofsm.io.process import process_of
from evofsm.io.verifying import Property, solve, solve_by_storm

KNOWN = (
    'Pmax=? [F<=20 "failed"]',
    'Pmin=? [F<=20 "failed"]',
    'Pmax=? [ F < 3 "failed" ]',
    'Pmin=?[F<=0 "failed"]',
    'Pmax=? [F<=7 "unknown"]',
    'Pmin=? [!"state_2" U<=9 "failed"]',
    'Pmax=? ["state_1" U<=4 "state_3"]',
    'Pmax=? [F<=5 !"state_1"]',
    "Pmin=? [F<=5 true]",
)


def walked(n_actions=3, rows=400, seed=3):
    """Of a walk between places that fails at its end, where one action leads more often."""
    rng = np.random.default_rng(seed)
    machine = EvolvingFSM(n_actions=n_actions, radius=0.05)
    place, Z, failures, starts = 0.0, [], [], [0]
    actions = rng.integers(0, n_actions, rows)
    for row, action in enumerate(actions):
        place = float(np.clip(place + 0.6 * (action - 0.8) + 0.1 * rng.normal(), 0.0, 6.0))
        Z.append([place])
        if place > 5.0:
            failures.append(row)
            starts.append(row + 1)
            place = 0.0
    starts = [start for start in starts if start < rows]
    machine.learn_many(Z, actions, starts, failures=failures)
    return machine.model()


@pytest.fixture(scope="module")
def model():
    found = walked()
    assert found.n_states >= 4
    assert found.failures.sum() >= 4.0
    return found


def counted(model, asked, evidence):
    """From each state, by walking down the exported text step by step; nothing is shared."""
    text = re.sub(r"//[^\n]*", "", to_prism(model, evidence))
    commands = {}
    for state, updates in re.findall(r"\] s=(\d+) ->([^;]*);", text):
        each = re.findall(r"([0-9.]+)\s*:\s*\(s'=(\d+)\)", updates)
        commands.setdefault(int(state), []).append([(float(p), int(j)) for p, j in each])
    unknown = re.search(r'label "unknown" = ([^;]+);', text)[1]
    labels = {"failed": {0}, "unknown": {int(s) for s in re.findall(r"s=(\d+)", unknown)}}
    labels |= {f"state_{i}": {i} for i in commands if i}

    def among(where, state):
        inside = where.label is None or state in labels[where.label]
        return inside != where.negated

    choose = min if asked.best == "min" else max

    @cache
    def likely(state, steps):
        if among(asked.target, state):
            return 1.0
        if steps == 0 or not among(asked.way, state):
            return 0.0
        return choose(
            sum(p * likely(j, steps - 1) for p, j in command) for command in commands[state]
        )

    return [likely(state, asked.steps) for state in range(model.n_states + 1)]


@pytest.mark.parametrize("text", KNOWN)
@pytest.mark.parametrize("evidence", [1.0, 12.0])
def test_our_own_computation_is_that_of_the_exported_process(model, text, evidence):
    asked = Property.parse(text)
    own = solve(process_of(model, evidence), asked)
    np.testing.assert_allclose(own, counted(model, asked, evidence), atol=1e-13)
    assert own.shape == (model.n_states + 1,)


def test_best_and_worst_actions_differ_and_more_steps_are_no_safer(model):
    process = process_of(model)
    most, least = (solve(process, Property.parse(text))[1:] for text in KNOWN[:2])
    assert (most >= least).all()
    assert (most > least + 0.01).any()
    soon = solve(process, Property.parse('Pmax=? [F<=5 "failed"]'))[1:]
    assert (soon <= most).all()


@pytest.mark.parametrize("first", [None, 3])
@pytest.mark.parametrize("text", KNOWN)
def test_storm_gives_the_same(model, text, first):
    pytest.importorskip("stormpy")
    for evidence in (1.0, 12.0):
        process = process_of(model, evidence)
        own = solve(process, Property.parse(text))[process.checked(first)]
        by_storm = solve_by_storm(model, text, process.checked(first), evidence)
        assert by_storm == pytest.approx(own, abs=1e-10)


def test_storm_knows_what_we_do_not_and_refuses_what_nobody_knows(model):
    pytest.importorskip("stormpy")
    for_ever = solve_by_storm(model, 'Pmax=? [F "failed"]', 1)
    assert for_ever >= solve_by_storm(model, 'Pmax=? [F<=50 "failed"]', 1) - 1e-6
    for text in ('P=? [F<=3 "failed"]', "nonsense", 'Pmax=? [F<=3 "nowhere"]'):
        with pytest.raises(ValueError, match="Storm refuses"):
            solve_by_storm(model, text, 1)
    with pytest.raises(ValueError, match="name the state"):
        solve_by_storm(model, 'filter(max, Pmin=? [F<=20 "failed"], "state_2")', 1)
    with pytest.raises(ValueError, match="whether, not how likely"):
        solve_by_storm(model, 'Pmax>0.5 [F<=3 "failed"]', 1)


def test_without_a_choice_none_has_to_be_named(model):
    text = 'P=? [F<=20 "failed"]'
    with pytest.raises(ValueError, match=r"up to 3 actions .* Pmax=. or Pmin=."):
        solve(process_of(model), Property.parse(text))
    chain = process_of(walked(n_actions=1))
    most, least, alone = (
        solve(chain, Property.parse(f'{which}=? [F<=20 "failed"]'))
        for which in ("Pmax", "Pmin", "P")
    )
    assert most.tolist() == least.tolist() == alone.tolist()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "failed",
        'Pmax=? [F "failed"]',
        'Pmax=? [G<=3 "failed"]',
        'Pmax>=0.5 [F<=3 "failed"]',
        "Pmax=? [F<=3 failed]",
        'Pmax=? [F<=-3 "failed"]',
        'Pmax=? [F<=3 "failed"',
        'Rmax=? [F<=3 "failed"]',
        'filter(max, Pmin=? [F<=20 "failed"], "state_2")',
    ],
)
def test_what_we_do_not_know_is_refused_with_the_extra_that_does(text):
    with pytest.raises(ValueError, match=r"does not know the property .*'.\[verify\]'"):
        Property.parse(text)


def test_bad_bounds_labels_and_states_are_named(model):
    with pytest.raises(ValueError, match="the bound must leave from 0 to 1,000,000 steps"):
        Property.parse('Pmax=? [F<0 "failed"]')
    with pytest.raises(ValueError, match="the bound must leave"):
        Property.parse('Pmax=? [F<=1000001 "failed"]')
    with pytest.raises(ValueError, match=f'no label "crash"; .*"state_{model.n_states}"'):
        solve(process_of(model), Property.parse('Pmax=? [F<=3 "crash"]'))
    with pytest.raises(ValueError, match="there is no state #99"):
        process_of(model).checked(99)


def test_without_stormpy_its_extra_is_named(model, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "stormpy", None)
    with pytest.raises(ModuleNotFoundError, match=r"needs stormpy: pip install '.\[verify\]'"):
        solve_by_storm(model, KNOWN[0], 1)

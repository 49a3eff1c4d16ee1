"""Graphs and processes, read back by others' tools, or by a reader written from PRISM's manual."""

import re
from itertools import product

import numpy as np
import pytest

from evofsm import EvolvingFSM, IntervalActions, Novelty
from evofsm.io import to_dot, to_prism

ODD = 'v "\\#1;<b>&`x`{|}'


@pytest.fixture(scope="module")
def model():
    """Of a walk between places that fails at its end, where one action leads more often."""
    rng = np.random.default_rng(3)
    machine = EvolvingFSM(n_actions=3, radius=0.05)
    actions = rng.integers(0, 3, 400)
    place, rows, failures = 0.0, [], []
    for row, action in enumerate(actions):
        place = float(np.clip(place + 0.6 * (action - 0.8) + 0.1 * rng.normal(), 0.0, 6.0))
        rows.append([place, 2.0 * place])
        if place > 5.0:
            failures.append(row)
            place = 0.0
    machine.learn_many(rows, actions, failures=failures)
    assert machine.n_states >= 4
    assert len(failures) >= 4
    named = IntervalActions(-1.5, 1.5, 1.0)
    return machine.model(actions=named, names=["gap", ODD], units=["m", "m/s"], dt=0.25)


# -- Graphs ---------------------------------------------------------------------------------------


def read_back(model, **how):
    # In a slim image it is there, and GLib, which it needs, is not.
    pygraphviz = pytest.importorskip("pygraphviz", exc_type=ImportError)
    return pygraphviz.AGraph(string=to_dot(model, **how))


def test_graphviz_draws_every_state_and_every_edge_that_was_asked_for(model):
    drawn = (model.averaged_matrix > 0.0) & (model.changes >= 1.0)
    assert len(read_back(model, least=0.0, evidence=1.0).edges()) == drawn.sum()
    graph = read_back(model, least=0.0, evidence=0.0)
    assert len(graph.edges()) == model.n_states**2
    for edge in graph.edges():
        seen = model.changes[int(edge[0][1:]) - 1, int(edge[1][1:]) - 1]
        assert (edge.attr["style"] == "dashed") == (seen == 0)
        assert edge.attr["label"].endswith(f"({seen:,.0f})")
    picture = graph.draw(format="svg", prog="dot").decode()
    assert picture.count('class="node"') == model.n_states
    shown = ODD.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    assert shown.replace('"', "&quot;") in picture.replace("&#45;", "-")


def test_a_dead_end_is_marked_by_its_shape_and_in_words(model):
    graph = read_back(model)
    marked = {n for n in graph.nodes() if n.attr["shape"] == "hexagon"}
    assert marked == {f"s{i + 1}" for i in np.flatnonzero(model.endings)}
    assert all("of all" in graph.get_node(name).attr["label"] for name in marked)
    told = read_back(model, dead_ends=[1])
    assert [n for n in told.nodes() if "dead end" in n.attr["label"]] == ["s2"]
    assert [n for n in told.nodes() if n.attr["shape"] == "hexagon"] == ["s2"]


def test_what_cannot_be_drawn_or_is_no_process_is_refused(model):
    with pytest.raises(ValueError, match=r"state is 99; there are states 0 to 6"):
        to_dot(model, dead_ends=[0, 99])
    empty = EvolvingFSM(n_actions=1, radius=0.5)
    assert "s1" not in to_dot(empty.model())
    with pytest.raises(ValueError, match="counted no decisions"):
        to_prism(empty.model())
    empty.learn_many([[0.0], [1.0]], [0, 0])
    assert "is an estimate, no bound" in to_prism(model)
    assert "NO DECISION FAILED" in to_prism(empty.model())
    for write, least in product((to_dot, to_prism), (-0.1, 1.5, 30.0, np.nan)):
        with pytest.raises(ValueError, match=r"least of .* must lie between 0 and 1"):
            write(model, least=least)


# -- PRISM ----------------------------------------------------------------------------------------

NAME = r"[A-Za-z_][A-Za-z0-9_]*"


def parsed(text):
    """An MDP of one module and one variable, as the manual has it: initial state, commands, labels.

    Comments end at the end of a line; a command is ``[action] guard -> p:(s'=j) + ...;``.
    """
    text = re.sub(r"//[^\n]*", "", text)
    kind, module = re.match(rf"\s*(mdp)\s+module\s+({NAME})\s", text).groups()
    assert (kind, module) == ("mdp", "evofsm")
    low, high, first = re.search(r"s\s*:\s*\[(\d+)\.\.(\d+)\]\s*init\s+(\d+);", text).groups()
    body = text[text.index(";") + 1 : text.index("endmodule")]
    commands = {}
    for command in body.split(";")[:-1]:
        found = re.fullmatch(rf"\s*\[({NAME})\]\s*s=(\d+)\s*->(.*)", command, re.DOTALL)
        action, state, updates = found.groups()
        row = np.zeros(int(high) + 1)
        for update in updates.split("+"):
            found = re.fullmatch(r"\s*([0-9.]+)\s*:\s*\(s'=(\d+)\)\s*", update)
            probability, target = found.groups()
            assert int(low) <= int(target) <= int(high)
            assert row[int(target)] == 0.0
            row[int(target)] = float(probability)
        assert (int(state), action) not in commands
        commands[int(state), action] = row
    rest = text[text.index("endmodule") + len("endmodule") :]
    labels = dict(re.findall(rf'label "({NAME})" = ([^;]+);', rest))
    assert not re.sub(rf'label "{NAME}" = [^;]+;', "", rest).strip()
    return int(first), commands, labels


@pytest.mark.parametrize("least", [0.0, 0.5])
def test_commands_are_distributions_and_stand_for_what_was_tried(model, least):
    """Rare transitions can be left out, but failure never is."""
    first, commands, labels = parsed(to_prism(model, evidence=2.0, least=least))
    assert first == 1 + np.argmin(model.created)
    share = model.failures / np.maximum(model.decisions, 1e-300)
    ends = np.clip(model.visits - model.decisions.sum(axis=0), 0.0, model.endings)
    for (state, action), row in commands.items():
        assert row.sum() == pytest.approx(1.0, abs=1e-14)
        if action[1:].isdigit():
            a, s = int(action[1:]) - 1, state - 1
            moves = model.transition_matrices[a, s] * (1.0 - ends / model.visits)
            moves /= moves.sum()
            moves = np.where(moves >= min(least, moves.max()), moves, 0.0)
            moves *= (1.0 - share[a, s]) / moves.sum()
            assert row == pytest.approx([share[a, s], *moves], abs=1e-11)
    tried = {(s + 1, f"a{a + 1}") for a, s in np.argwhere(model.decisions >= 2.0).tolist()}
    assert {key for key in commands if key[1][1:].isdigit()} == tried
    assert (labels["failed"], labels["state_2"]) == ("s=0", "s=2")
    for state in range(model.n_states + 1):  # PRISM refuses a state without a command
        assert any(s == state for s, _ in commands)


def test_a_failure_is_no_move_to_the_state_in_which_it_was_seen_as_well():
    machine = EvolvingFSM(1, rule=Novelty(radius=1.0))
    for _ in range(20):
        machine.learn_many([[0.0], [10.0]] * 2 + [[20.0]], [0] * 5, [0], failures=[4])
    first, commands, labels = parsed(to_prism(machine.model()))
    assert commands[first + 1, "a1"] == pytest.approx([0.5, 0.5, 0.0, 0.0], abs=0.02)
    assert commands[first + 1, "a1"][3] == 0.0
    assert (commands[3, "failed"][0], labels["unknown"]) == (1.0, "false")


@pytest.mark.parametrize("least", [0.0, 0.01])
def test_what_is_new_takes_nothing_from_what_was_seen_long_ago(least):
    """The paper's equations make it nearly certain to follow where it was not for long."""
    machine = EvolvingFSM(2, rule=Novelty(radius=1.0))
    for _ in range(20):
        machine.learn_many([[0.0], [10.0]], [0, 0], [0])
        machine.fail()
    machine.learn_many([[20.0], [30.0]] * 1000 + [[60.0]] * 9, [0] * 2009, [0])
    model = machine.model()
    assert model.transition_matrices[0, 0, -1] > 0.9
    _, commands, _ = parsed(to_prism(model, least=least))
    assert commands[1, "a1"][2] > 0.94


def test_an_edge_is_of_the_actions_that_were_taken_there():
    machine = EvolvingFSM(2, rule=Novelty(radius=1.0))
    machine.learn_many([[0.0], [10.0]] * 200 + [[20.0]] * 400, [0] * 400 + [1] * 400)
    (edge,) = re.findall("s1 ->.*", to_dot(machine.model()))
    assert "0.998 (200)" in edge


def test_states_without_evidence_are_absorbing_and_say_so(model):
    few = float(np.sort(model.decisions.max(axis=0))[1])
    text = to_prism(model, evidence=few)
    _, commands, labels = parsed(text)
    lost = int(np.argmin(model.decisions.max(axis=0))) + 1
    assert labels["unknown"] == f"s={lost}"
    assert commands[lost, "unknown"][lost] == 1.0
    assert "labelled unknown: 1." in text
    assert "//   a1: [-1.5, -0.5)" in text
    assert "NO DECISION FAILED" not in text

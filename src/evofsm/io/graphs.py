"""A learnt machine as a graph or a Markov decision process, in the formats of others' tools.

DOT is Graphviz's language, Mermaid is what GitHub draws within a page, GraphML is read by yEd,
Gephi and networkx, and PRISM's language by the model checkers PRISM and Storm. All count states and
actions from 1, as people read them.

Every number that was learnt stands beside the evidence for it: a probability may come from one
observation, or from the prior alone.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple
from xml.etree import ElementTree as ET

import numpy as np

from evofsm.fsm import FSMModel, Policy
from evofsm.io.process import Command, process_of, refuse_no_probability

# Vermillion of Okabe and Ito's colours; what is marked by it has another shape and words as well.
_DEAD_END = "#D55E00"
_DOT_MARK = (
    f',\n      shape=hexagon, style=filled, fillcolor="{_DEAD_END}", fontcolor=white, penwidth=2'
)
# Width of the largest node beyond the smallest [inch], and of the line of a certain edge [point].
_LARGEST_NODE, _WIDEST_LINE = 1.2, 3.0
_GRAPHML = "http://graphml.graphdrawing.org/xmlns"


class _Graph(NamedTuple):
    """What all graphs show."""

    lines: list[list[str]]  # what stands in each state
    marked: frozenset[int]  # states that are drawn as dead ends
    edges: list[tuple[int, int, float, float]]  # from, to, probability and how often it was seen


def _label(probability: float, seen: float) -> str:
    return f"{probability:.3f} ({seen:,.0f})"


def to_dot(
    model: FSMModel,
    policy: Policy = "observed",
    least: float = 0.001,
    evidence: float = 1.0,
    *,
    self_loops: bool = True,
    dead_ends: Collection[int] | None = None,
) -> str:
    r"""The states and transitions in Graphviz's DOT language.

    Parameters
    ----------
    model : FSMModel
    policy : {"observed", "marginal"}
        How actions are weighed in the probabilities on the edges: each as often as it was used, or
        all alike.
    least : float
        Edges below this probability are left out ...
    evidence : float
        ... and those whose change was seen less often than this.
    self_loops : bool
        Whether edges from a state to itself are drawn.
    dead_ends : collection of int, optional
        Indices of the states to be called dead ends, from 0, as `by_state` finds them.
        Without it, those in which failures ended are marked.

    Returns
    -------
    str
        The graph. A state holds its centre, its visits and the failures that ended in it, is the
        larger the more it was visited, and a hexagon where it is marked. An edge holds its
        probability and, in brackets, how often the change was seen, after whatever action. One that
        never was is dashed, if it is drawn: there is only the prior, or what states share.

    Raises
    ------
    ValueError
        If there is no such policy, ``least`` is no probability, or a dead end no state.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0], failures=[3])
    >>> print(to_dot(machine.model(names=["gap"], units=["m"]), least=0.3, evidence=0))
    digraph evofsm {
      graph [rankdir=LR, fontname="Helvetica", fontsize=10, labelloc=b,
             label="An edge: probability (times seen); dashed: never seen"];
      node [shape=ellipse, fontname="Helvetica", fontsize=10];
      edge [fontname="Helvetica", fontsize=9];
      s1 [label="#1\ngap 0 m\n3 visits", width=1.95];
      s2 [label="#2\ngap 1 m\n1 visit\n1 failure, 100% of all", width=1.44,
          shape=hexagon, style=filled, fillcolor="#D55E00", fontcolor=white, penwidth=2];
      s1 -> s1 [label="0.771 (2)", penwidth=2.31];
      s2 -> s1 [label="0.500 (0)", penwidth=1.50, style=dashed];
      s2 -> s2 [label="0.500 (0)", penwidth=1.50, style=dashed];
    }
    <BLANKLINE>
    """
    graph = _graph(model, policy, least, evidence, self_loops, dead_ends)
    lines = [
        "digraph evofsm {",
        '  graph [rankdir=LR, fontname="Helvetica", fontsize=10, labelloc=b,',
        '         label="An edge: probability (times seen); dashed: never seen"];',
        '  node [shape=ellipse, fontname="Helvetica", fontsize=10];',
        '  edge [fontname="Helvetica", fontsize=9];',
    ]
    most = model.visits.max(initial=0.0) or 1.0
    for state, texts in enumerate(graph.lines):
        label = r"\n".join(_dot_text(text) for text in texts)
        width = 0.75 + _LARGEST_NODE * (model.visits[state] / most) ** 0.5
        marked = _DOT_MARK if state in graph.marked else ""
        lines.append(f'  s{state + 1} [label="{label}", width={width:.2f}{marked}];')
    for i, j, probability, seen in graph.edges:
        width = max(_WIDEST_LINE * probability, 0.3)
        told = f'label="{_label(probability, seen)}", penwidth={width:.2f}'
        lines.append(f"  s{i + 1} -> s{j + 1} [{told}{'' if seen else ', style=dashed'}];")
    return "\n".join([*lines, "}", ""])


def to_mermaid(
    model: FSMModel,
    policy: Policy = "observed",
    least: float = 0.001,
    evidence: float = 1.0,
    *,
    self_loops: bool = True,
    dead_ends: Collection[int] | None = None,
) -> str:
    """The states and transitions as a Mermaid flowchart, which GitHub draws in Markdown.

    Parameters
    ----------
    model, policy, least, evidence, self_loops, dead_ends
        As in `to_dot`.

    Returns
    -------
    str
        The flowchart, to stand in a block of code marked ``mermaid``. Hexagons are the states that
        are marked; dotted edges, if drawn, were never seen.

    Raises
    ------
    ValueError
        As `to_dot`.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0], failures=[3])
    >>> print(to_mermaid(machine.model(names=["gap"], units=["m"]), least=0.6))
    flowchart LR
      s1(["#35;1<br/>gap 0 m<br/>3 visits"])
      s2{{"#35;2<br/>gap 1 m<br/>1 visit<br/>1 failure, 100% of all"}}:::marked
      s1 -->|"0.771 (2)"| s1
      classDef marked fill:#D55E00,color:#fff,stroke:#222,stroke-width:2px
    <BLANKLINE>
    """
    graph = _graph(model, policy, least, evidence, self_loops, dead_ends)
    lines = ["flowchart LR"]
    for state, texts in enumerate(graph.lines):
        label = "<br/>".join(_mermaid_text(text) for text in texts)
        shape = f'{{{{"{label}"}}}}:::marked' if state in graph.marked else f'(["{label}"])'
        lines.append(f"  s{state + 1}{shape}")
    for i, j, probability, seen in graph.edges:
        arrow = "-->" if seen else "-.->"
        lines.append(f'  s{i + 1} {arrow}|"{_label(probability, seen)}"| s{j + 1}')
    lines.append(f"  classDef marked fill:{_DEAD_END},color:#fff,stroke:#222,stroke-width:2px")
    return "\n".join([*lines, ""])


def to_graphml(
    model: FSMModel,
    policy: Policy = "observed",
    least: float = 0.0,
    evidence: float = 0.0,
    *,
    self_loops: bool = True,
    dead_ends: Collection[int] | None = None,
) -> str:
    """The states and transitions as GraphML, for yEd, Gephi, networkx and others.

    Parameters
    ----------
    model, policy, least, evidence, self_loops, dead_ends
        As in `to_dot`; here all edges above probability 0 are the default, seen or not.

    Returns
    -------
    str
        An XML document. Nodes have ``label``, ``visits``, ``founded``, ``failures``, ``dead_end``
        and a ``center.NAME`` for each variable, whose unit stands in the key's description; edges
        have ``probability`` and ``changes``, how often the change was seen.

    Raises
    ------
    ValueError
        As `to_dot`.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
    >>> document = to_graphml(machine.model(names=["gap"], units=["m"]))
    >>> [line.strip() for line in document.splitlines() if "center" in line][0]
    '<key id="center1" for="node" attr.name="center.gap" attr.type="double">'
    """
    graph = _graph(model, policy, least, evidence, self_loops, dead_ends)
    root = ET.Element("graphml", xmlns=_GRAPHML)
    of_nodes = {"label": "string", "visits": "double", "founded": "double", "failures": "double"}
    for name, kind in {**of_nodes, "dead_end": "boolean"}.items():
        _key(root, name, "node", name, kind)
    for place, (name, unit) in enumerate(zip(*_variables(model), strict=True), 1):
        key = _key(root, f"center{place}", "node", f"center.{name or place}", "double")
        ET.SubElement(key, "desc").text = _xml_text(unit) or "no unit"
    for name in ("probability", "changes"):
        _key(root, name, "edge", name, "double")
    parent = ET.SubElement(root, "graph", id="evofsm", edgedefault="directed")
    for i, center in enumerate(model.centers.tolist()):
        data = {
            "label": f"#{i + 1}",
            "visits": float(model.visits[i]),
            "founded": float(model.founded[i]),
            "failures": float(model.endings[i]),
            "dead_end": str(i in graph.marked).lower(),
            **{f"center{place}": value for place, value in enumerate(center, 1)},
        }
        _data(ET.SubElement(parent, "node", id=f"s{i + 1}"), data)
    for i, j, probability, seen in graph.edges:
        edge = ET.SubElement(parent, "edge", source=f"s{i + 1}", target=f"s{j + 1}")
        _data(edge, {"probability": probability, "changes": seen})
    ET.indent(root)
    return "<?xml version='1.0' encoding='UTF-8'?>\n" + ET.tostring(root, "unicode") + "\n"


def _graph(
    model: FSMModel,
    policy: Policy,
    least: float,
    evidence: float,
    self_loops: bool,
    dead_ends: Collection[int] | None,
) -> _Graph:
    refuse_no_probability(least)
    ended = np.flatnonzero(model.endings) if dead_ends is None else dead_ends
    marked = frozenset(int(state) for state in ended)
    if beyond := sorted(state for state in marked if not 0 <= state < model.n_states):
        raise ValueError(f"dead_ends names {beyond}; the model has {model.n_states} states, from 0")
    lines = []
    for state in range(model.n_states):
        texts = [f"#{state + 1}", *_where(model, state), _counted(model.visits[state], "visit")]
        if ends := model.endings[state]:
            share = ends / model.endings.sum()
            texts.append(f"{_counted(ends, 'failure')}, {share:.0%} of all")
        if dead_ends is not None and state in marked:
            texts.append("dead end")
        lines.append(texts)
    matrix = model.averaged_matrix(policy)
    drawn = (matrix >= least) & (model.changes >= evidence) & (matrix > 0.0)
    edges = [
        (i, j, float(matrix[i, j]), float(model.changes[i, j]))
        for i, j in np.argwhere(drawn).tolist()
        if self_loops or i != j
    ]
    return _Graph(lines, marked, edges)


def _where(model: FSMModel, state: int) -> list[str]:
    """Name, value and unit of each variable at the centre of a state."""
    return [
        " ".join(part for part in (_one_line(name), f"{value:.4g}", _one_line(unit)) if part)
        for name, unit, value in zip(*_variables(model), model.centers[state], strict=True)
    ]


def _variables(model: FSMModel) -> tuple[Sequence[str], Sequence[str]]:
    """Names and units of the variables, empty where the model has none."""
    nothing = ("",) * model.n_variables
    return model.names or nothing, model.units or nothing


def _counted(number: float, what: str) -> str:
    return f"{number:,.0f} {what}{'' if round(number) == 1 else 's'}"


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _dot_text(text: str) -> str:
    return _one_line(text).replace("\\", r"\\").replace('"', r"\"")


def _mermaid_text(text: str) -> str:
    """With Mermaid's own codes for what it would take for its syntax."""
    return re.sub(r"[#\"&<>`]", lambda sign: f"#{ord(sign[0])};", _one_line(text))


def _xml_text(text: str) -> str:
    """Without the control characters that no XML may hold."""
    return re.sub(r"[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "", text)


def _key(root: ET.Element, key: str, of: str, name: str, kind: str) -> ET.Element:
    told = {"id": key, "for": of, "attr.name": _xml_text(name), "attr.type": kind}
    return ET.SubElement(root, "key", told)


def _data(element: ET.Element, values: Mapping[str, str | float]) -> None:
    for key, value in values.items():
        ET.SubElement(element, "data", key=key).text = str(value)


# -- PRISM ----------------------------------------------------------------------------------------


def to_prism(
    model: FSMModel, evidence: float = 1.0, least: float = 0.0, first: int | None = None
) -> str:
    """The model as a Markov decision process in the language of PRISM, which Storm reads as well.

    In state ``s=i``, which people call #i, every action that was tried there is a command. It ends
    in failure, ``s=0``, as often as the action failed in this state, and else moves as was learnt.

    Parameters
    ----------
    model : FSMModel
        Of a machine that counted its decisions.
    evidence : float
        How many decisions a command must rest on, at least; others are left out. A belief over
        several states divides a decision between them.
    least : float
        Transitions to states below this probability are left out, and the others made to add up
        to 1; failure is never left out.
    first : int, optional
        The state that it begins in, from 1 as people count; the one that was founded first if not
        given.

    Returns
    -------
    str
        The process. ``"failed"`` labels the failure, ``"unknown"`` states without any command,
        from which nothing leads on (do not take them for safe), ``"state_i"`` each state.
        ``filter`` asks of other states than the first. Comments say how many decisions and failures
        a command rests on, and what was left out.

    Raises
    ------
    ValueError
        If the model has no states or counted no decisions, ``evidence`` is not positive, ``least``
        no probability, or ``first`` no state.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0], failures=[3])
    >>> text = to_prism(machine.model(), evidence=2.0)
    >>> print(text.partition("mdp")[2])
    <BLANKLINE>
    <BLANKLINE>
    module evofsm
      s : [0..2] init 1;
    <BLANKLINE>
      // #1, 3 visits
      [a1] s=1 -> // 3 decisions; a1 was used 3 times
        0.333333333333:(s'=0) + // failed 1
        0.514194120112:(s'=1) + // seen 2
        0.152472546555:(s'=2); // seen 1
    <BLANKLINE>
      // #2, 1 visit: no action has the evidence
      [unknown] s=2 -> 1:(s'=2);
    <BLANKLINE>
      [failed] s=0 -> 1:(s'=0);
    endmodule
    <BLANKLINE>
    label "failed" = s=0;
    label "unknown" = s=2;
    label "state_1" = s=1;
    label "state_2" = s=2;
    <BLANKLINE>
    """
    process = process_of(model, evidence, least)
    n = model.n_states
    begin = process.checked(first)
    body: list[str] = []
    for state, commands in enumerate(process.commands):
        remark = "" if commands else ": no action has the evidence"
        body += ["", f"  // {_described(model, state)}{remark}"]
        for command in commands:
            body += _written(model, state, command)
        if not commands:
            body.append(f"  [unknown] s={state + 1} -> 1:(s'={state + 1});")
    unknown = process.unknown
    labels = [f'label "state_{i}" = s={i};' for i in range(1, n + 1)]
    nowhere = " | ".join(f"s={i}" for i in unknown) or "false"
    lines = [
        *_header(model, evidence, least, len(unknown)),
        *("mdp", "", "module evofsm", f"  s : [0..{n}] init {begin};"),
        *body,
        *("", "  [failed] s=0 -> 1:(s'=0);", "endmodule", ""),
        *('label "failed" = s=0;', f'label "unknown" = {nowhere};', *labels, ""),
    ]
    return "\n".join(lines)


def _header(model: FSMModel, evidence: float, least: float, unknown: int) -> list[str]:
    """What the process is, what its actions are, and what it lacks."""
    tried = model.decisions > 0.0
    few = tried & (model.decisions < evidence)
    lost = model.decisions[few].sum() / model.decisions.sum()
    told = [
        f"A machine of {model.n_states} states and {model.n_actions} actions, learnt by evofsm.",
        "s=0 is failure, s=i the state #i. Comments say how many decisions a command rests on, how",
        "many of them failed, and how often a change was seen after whatever action: seen 0 is the",
        "prior alone, or what states share. A belief over several states divides a decision.",
        "",
        f"Left out: {(~tried).sum():,} pairs of state and action that were never tried, and",
        f"{few.sum():,} that rest on fewer than {evidence:g} decisions ({lost:.2%} of all).",
        f"States left without any action, absorbing and labelled unknown: {unknown}.",
    ]
    if least > 0.0:
        told.append(f"Transitions below {least:g} are left out as well.")
    if model.dt is not None:
        told.append(f"A step is {model.dt:g} s.")
    if model.actions is not None:
        told += ["", "Actions:"]
        told += [f"  a{a + 1}: {model.actions.label(a)}" for a in range(model.n_actions)]
    return [f"// {line}".rstrip() for line in told] + [""]


def _described(model: FSMModel, state: int) -> str:
    where = _where(model, state) if model.names else []
    return ", ".join([f"#{state + 1}", *where, _counted(model.visits[state], "visit")])


def _written(model: FSMModel, state: int, command: Command) -> Iterator[str]:
    """A command in PRISM's language, with what it rests on."""
    action, decided, failed, _ = command
    seen = [f"failed {failed:.4g}", *(f"seen {count:g}" for count in model.changes[state])]
    rests = f"{decided:.4g} decisions; a{action + 1} was used {model.uses[action]:,.0f} times"
    updates = command.decimals
    yield f"  [a{action + 1}] s={state + 1} -> // {rests}"
    for target, probability in updates:
        end = ";" if target == updates[-1][0] else " +"
        yield f"    {probability}:(s'={target}){end} // {seen[target]}"

"""A learnt machine as a graph or a Markov decision process, in the formats of others' tools.

All count states and actions from 1, as people read them. Every number that was learnt comes with
the evidence for it: a probability may come from one observation, or from the prior alone.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.model import FSMModel
from evofsm.fsm.naming import in_a_line
from evofsm.fsm.validation import check_index, counted
from evofsm.store import Numbers

# Vermillion of Okabe and Ito's colours; what is marked by it has another shape and words as well.
_DOT_MARK = ',\n      shape=hexagon, style=filled, fillcolor="#D55E00", fontcolor=white, penwidth=2'
_DOT_HEAD = """digraph evofsm {
  graph [rankdir=LR, fontname="Helvetica", fontsize=10, labelloc=b,
         label="An edge: probability (times seen); dashed: never seen"];
  node [shape=ellipse, fontname="Helvetica", fontsize=10];
  edge [fontname="Helvetica", fontsize=9];"""
# Width of the largest node beyond the smallest [inch], and of the line of a certain edge [point].
_LARGEST_NODE, _WIDEST_LINE = 1.2, 3.0
# Probabilities of a process have so many decimals; those of a command add up to 1 exactly.
_DECIMALS = 12
# A smaller share of what followed a state is not taken for seen.
_STRAY = 1e-3
_PROBABILITY = Numbers(least=0.0, most=1.0)


def to_dot(
    model: FSMModel,
    least: float = 0.001,
    evidence: float = 1.0,
    dead_ends: Collection[int] | None = None,
) -> str:
    r"""The states and transitions in Graphviz's DOT language.

    Parameters
    ----------
    model : FSMModel
    least, evidence : float
        Edges below this probability are left out, and those whose change was seen less often.
    dead_ends : collection of int, optional
        Indices of the states to be called dead ends, from 0. Without it, those in which failures
        ended are marked.

    Returns
    -------
    str
        The graph. A state holds its centre, its visits and the failures that ended in it, is the
        larger the more it was visited, and a hexagon where it is marked. An edge holds its
        probability, actions weighed by how often they were used, and in brackets how often the
        change was seen. One that never was is dashed, if it is drawn: there is only the prior, or
        what states share.

    Raises
    ------
    ValueError
        If ``least`` is no probability, or a dead end is no state.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0], failures=[3])
    >>> print(to_dot(machine.model(names=["gap"], units=["m"])).partition("fontsize=9];\n")[2])
      s1 [label="#1\ngap 0 m\n3 visits", width=1.95];
      s2 [label="#2\ngap 1 m\n1 visit\n1 failure, 100% of all", width=1.44,
          shape=hexagon, style=filled, fillcolor="#D55E00", fontcolor=white, penwidth=2];
      s1 -> s1 [label="0.771 (2)", penwidth=2.31];
      s1 -> s2 [label="0.229 (1)", penwidth=0.69];
    }
    <BLANKLINE>
    """
    _PROBABILITY.refuse_others("least", least)
    end_states = np.flatnonzero(model.endings) if dead_ends is None else dead_ends
    marked_states = {check_index("state", state, model.n_states) for state in end_states}
    lines = [_DOT_HEAD]
    most = model.visits.max(initial=0.0) or 1.0
    for state in range(model.n_states):
        visits = counted(round(model.visits[state]), "visit")
        texts = [f"#{state + 1}", *_where(model, state), visits]
        if ends := model.endings[state]:
            share = ends / model.endings.sum()
            texts.append(f"{counted(round(ends), 'failure')}, {share:.0%} of all")
        if dead_ends is not None and state in marked_states:
            texts.append("dead end")
        label = r"\n".join(text.replace("\\", r"\\").replace('"', r"\"") for text in texts)
        width = 0.75 + _LARGEST_NODE * (model.visits[state] / most) ** 0.5
        mark = _DOT_MARK if state in marked_states else ""
        lines.append(f'  s{state + 1} [label="{label}", width={width:.2f}{mark}];')
    matrix = model.averaged_matrix
    is_drawn = (matrix >= least) & (model.changes >= evidence) & (matrix > 0.0)
    for i, j in np.argwhere(is_drawn).tolist():
        chance, count = matrix[i, j], model.changes[i, j]
        width, dashes = max(_WIDEST_LINE * chance, 0.3), "" if count else ", style=dashed"
        label = f'label="{chance:.3f} ({count:,.0f})", penwidth={width:.2f}'
        lines.append(f"  s{i + 1} -> s{j + 1} [{label}{dashes}];")
    return "\n".join([*lines, "}", ""])


def _where(model: FSMModel, state: int) -> list[str]:
    blanks = ("",) * model.n_variables
    variables = zip(model.names or blanks, model.units or blanks, strict=True)
    return [
        " ".join(part for part in (in_a_line(name), f"{value:.4g}", in_a_line(unit)) if part)
        for (name, unit), value in zip(variables, model.centers[state], strict=True)
    ]


def to_prism(model: FSMModel, evidence: float = 1.0, least: float = 0.0) -> str:
    """The model as a Markov decision process in the language of PRISM, which Storm reads as well.

    In state ``s=i``, which people call #i, every action that was tried there is a command. It ends
    in failure, ``s=0``, as often as the action failed in this state, and else moves as was learnt
    of what came without failing. A state in which each episode was seen to fail leads to ``s=0``.

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

    Returns
    -------
    str
        The process; it begins in the state that was created first. ``"failed"`` labels the failure,
        ``"unknown"`` states without any command (do not take them for safe), ``"state_i"`` each
        state. Comments say what a command rests on, and what was left out.

    Raises
    ------
    ValueError
        If the model counted no decisions, or ``evidence`` or ``least`` cannot be right.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0], failures=[3])
    >>> text = to_prism(machine.model(), evidence=2.0)
    >>> print(text.partition("init 1;")[2].partition(" // #2")[0].strip())
    // #1, 3 visits
      [a1] s=1 -> // 3 decisions; a1 was used 3 times
        0.333333333333:(s'=0) + // failed 1
        0.666666666667:(s'=1); // seen 2
    """
    n = model.n_states
    _PROBABILITY.refuse_others("least", least)
    if not evidence > 0.0:
        raise ValueError(f"evidence is {evidence}; it must be positive")
    if not model.decisions.any():
        fault = "the model counted no decisions, so there is no action to choose"
        raise ValueError(f"{fault} (has its machine been told its actions?)")
    body, unknown = list[str](), list[int]()
    arrivals = model.changes @ model.recognise(model.centers)  # and what is believed beside it
    was_seen = arrivals > _STRAY * model.changes.sum(axis=1, keepdims=True)
    # Whoever failed as it came is no arrival; where a decision followed, that failed.
    ends = np.clip(model.visits - model.decisions.sum(axis=0), 0.0, model.endings)
    going_on = 1.0 - ends / np.maximum(model.visits, 1.0)
    going_on[going_on < _STRAY] = 0.0
    for state in range(n):
        about = [f"#{state + 1}", *(_where(model, state) if model.names else [])]
        body += ["", f"  // {', '.join([*about, counted(round(model.visits[state]), 'visit')])}"]
        actions = np.flatnonzero(model.decisions[:, state] >= evidence).tolist()
        where = model, state, was_seen[state], going_on
        body += [line for action in actions for line in _command(*where, action, least)]
        if not actions and going_on[state] == 0.0:
            body.append(f"  [failed] s={state + 1} -> 1:(s'=0);")
        elif not actions:
            unknown.append(state + 1)
            body[-1] += ": no action has the evidence"
            body.append(f"  [unknown] s={state + 1} -> 1:(s'={state + 1});")
    nowhere = " | ".join(f"s={i}" for i in unknown) or "false"
    lines = [
        *_header(model, evidence, least, len(unknown)),
        *("mdp", "", "module evofsm", f"  s : [0..{n}] init {np.argmin(model.created) + 1};"),
        *body,
        *("", "  [failed] s=0 -> 1:(s'=0);", "endmodule", ""),
        *('label "failed" = s=0;', f'label "unknown" = {nowhere};'),
        *(f'label "state_{i}" = s={i};' for i in range(1, n + 1)),
    ]
    return "\n".join([*lines, ""])


def _header(model: FSMModel, evidence: float, least: float, unknown: int) -> Iterator[str]:
    is_tried = model.decisions > 0.0
    few = is_tried & (model.decisions < evidence)
    share = model.decisions[few].sum() / model.decisions.sum()
    yield f"// A machine of {model.n_states} states and {model.n_actions} actions, by evofsm."
    yield "// s=0 is failure, s=i the state #i. 'seen' is by any action; 0: prior, or shared."
    yield f"// Left out: {(~is_tried).sum():,} pairs of state and action that were never tried, and"
    yield f"// {few.sum():,} that rest on fewer than {evidence:g} decisions ({share:.2%} of all);"
    yield f"// transitions below {least:g}. States without any action, labelled unknown: {unknown}."
    yield "// Where beliefs are wide (evofsm inspect) it moves on, and fails, at other times than"
    yield "// what was seen, mostly sooner: a probability that it gives is an estimate, no bound."
    if not model.failures.any():
        yield "// NO DECISION FAILED, or which did is not known: a probability of failure that is"
        yield "// computed from this process is 0 for want of knowledge."
    if model.dt is not None:
        yield f"// A step is {model.dt:g} s."
    if model.actions is not None:
        yield from (f"//   a{a + 1}: {model.actions.label(a)}" for a in range(model.n_actions))
    yield ""


def _command(
    model: FSMModel,
    state: int,
    was_seen: NDArray[np.bool_],
    going_on: NDArray[np.float64],
    action: int,
    least: float,
) -> Iterator[str]:
    decisions, failures = model.decisions[action, state], model.failures[action, state]
    row = model.transition_matrices[action, state] * going_on
    row /= row.sum() or 1.0
    if 0.0 < (support := row[was_seen].sum()) < (most := decisions / (1.0 + decisions)):
        # Where it was not for long, what is new is nearly certain to follow, by the prior alone.
        row = row * np.where(was_seen, most / support, (1.0 - most) / (1.0 - support))
    row = np.where(row >= min(least, row.max()), row, 0.0)
    share = failures / decisions
    chances = np.concatenate([[share], (1.0 - share) * row / (row.sum() or 1.0)])
    parts: list[int] = np.rint(chances * 10**_DECIMALS).astype(np.int64).tolist()
    parts[int(np.argmax(parts))] += 10**_DECIMALS - sum(parts)  # to the last digit
    comments = [f"failed {failures:.4g}", *(f"seen {count:g}" for count in model.changes[state])]
    usage = f"a{action + 1} was used {model.uses[action]:,.0f} times"
    yield f"  [a{action + 1}] s={state + 1} -> // {decisions:.4g} decisions; {usage}"
    targets = np.flatnonzero(parts).tolist()
    for target in targets:
        chance = "1" if parts[target] == 10**_DECIMALS else f"0.{parts[target]:0{_DECIMALS}d}"
        end = ";" if target == targets[-1] else " +"
        yield f"    {chance}:(s'={target}){end} // {comments[target]}"

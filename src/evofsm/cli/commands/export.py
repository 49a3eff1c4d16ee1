"""`evofsm export`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

from evofsm.cli.commands.common import load_model
from evofsm.cli.commands.declared import REQUIRED, Command, argument, option

if TYPE_CHECKING:
    from evofsm.fsm import FSMModel

# Beside the machine, in folders of results.
_RISK = "risk.evofsm"
# How files of evofsm and logs of runs begin.
_LEARNT = (b"PK\x03\x04", b"\x89MCAP")
_LONGEST_MARK = 5
# Whoever draws a picture wants no more edges than were seen.
_PICTURE_LEAST, _PICTURE_EVIDENCE = 0.001, 1.0


class Format(StrEnum):
    """What it is written as."""

    DOT = "dot"
    GRAPHML = "graphml"
    PRISM = "prism"


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write what was learnt, or driven, in the formats of other tools."""

    file: Path = argument(
        "A machine or a model that was saved, a folder of evofsm drive --out or make paper, or a "
        "log of evofsm drive --mcap."
    )
    to: Format = option(
        REQUIRED,
        "Graph for Graphviz (dot) or for graph tools (graphml); process for PRISM and Storm.",
    )
    out: Path | None = option(None, "File to write; else it is printed.")
    policy: str = option(
        "observed", "Weights of actions in a graph: observed, as used, or marginal, alike."
    )
    least: float | None = option(
        None, "Leave out what is less probable; 0.001 in a picture, else 0.", min=0.0, max=1.0
    )
    evidence: float | None = option(
        None,
        "Leave out edges, for prism actions, that were seen less often; 1, graphml 0.",
        min=0.0,
    )
    loops: bool = option(True, "Whether a graph shows that states lead to themselves.")

    def run(self) -> None:
        """Write it, or print it."""
        if self.policy not in ("observed", "marginal"):
            raise ValueError(f"--policy is {self.policy!r}; it must be observed or marginal")
        _refuse_learnt(self.out)
        from evofsm.fsm import visible

        text = visible(self._written())
        if self.out is None:
            sys.stdout.write(text)
            return
        from evofsm.store import storage

        with storage.replacing(self.out) as place:
            place.write(text.encode())

    def _written(self) -> str:
        from evofsm.io import graphs

        model, dead_ends = _learnt(self.file)
        if self.to is Format.PRISM:
            evidence = 1.0 if self.evidence is None else self.evidence
            return graphs.to_prism(model, evidence, self.least or 0.0)
        write = graphs.to_dot if self.to is Format.DOT else graphs.to_networkx
        is_picture = self.to is Format.DOT
        graph = write(
            model,
            "marginal" if self.policy == "marginal" else "observed",
            _PICTURE_LEAST * is_picture if self.least is None else self.least,
            _PICTURE_EVIDENCE * is_picture if self.evidence is None else self.evidence,
            self_loops=self.loops,
            dead_ends=dead_ends,
        )
        if isinstance(graph, str):
            return graph
        from networkx import generate_graphml

        return "\n".join([*generate_graphml(graph), ""])


def _refuse_learnt(out: Path | None) -> None:
    """Raise where a graph would take the place of what cannot be had again."""
    if out is not None and out.is_file():
        with out.open("rb") as file:
            if file.read(_LONGEST_MARK).startswith(_LEARNT):
                raise ValueError(
                    f"--out {out}: what was learnt or driven is kept there; it was left alone"
                )


def _learnt(file: Path) -> tuple[FSMModel, list[int] | None]:
    """The model, and its dead ends where the risk that was learnt with it is known."""
    from evofsm.driving import LatentRisk, assess_states
    from evofsm.store import storage

    model, _ = load_model(file)
    if not (file / _RISK).exists() or storage.read_header(file / _RISK).kind != "risk":
        return model, None
    assessed = assess_states(model, LatentRisk.load(file / _RISK))
    return model, [one.state for one in assessed if one.is_dead_end]

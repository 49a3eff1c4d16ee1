"""`evofsm export`."""

from __future__ import annotations

import sys
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from evofsm.app.cli.common import load_model, plain_errors, require, say
from evofsm.core import visible

with suppress(ModuleNotFoundError):
    import typer

if TYPE_CHECKING:
    from evofsm.core import FSMModel

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
    MERMAID = "mermaid"
    GRAPHML = "graphml"
    PRISM = "prism"
    SUMO = "sumo"


@plain_errors
def export(
    file: Annotated[
        Path,
        typer.Argument(
            help="A machine or a model that was saved, a folder of evofsm drive --out or make "
            "paper, or a log of evofsm drive --mcap.",
            show_default=False,
        ),
    ],
    to: Annotated[
        Format,
        typer.Option(
            help="Graph for Graphviz, for a page in Markdown, or for graph tools; process for "
            "PRISM and Storm; episode of a log for sumo-gui.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="File to write (sumo: folder); else it is printed.", show_default=False),
    ] = None,
    policy: Annotated[
        str,
        typer.Option(help="Weights of actions in a graph: observed, as used, or marginal, alike."),
    ] = "observed",
    least: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1.0,
            help="Leave out what is less probable; 0.001 in a picture, else 0.",
            show_default=False,
        ),
    ] = None,
    evidence: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Leave out edges, for prism actions, that were seen less often; 1, graphml 0.",
            show_default=False,
        ),
    ] = None,
    loops: Annotated[
        bool, typer.Option(help="Whether a graph shows that states lead to themselves.")
    ] = True,
    episode: Annotated[
        int, typer.Option(min=1, help="Which episode of a log, from 1, for sumo.")
    ] = 1,
) -> None:
    """Write what was learnt, or driven, in the formats of other tools."""
    if to is Format.SUMO:
        _export_replay(file, out, episode)
        return
    if policy not in ("observed", "marginal"):
        raise ValueError(f"--policy is {policy!r}; it must be observed or marginal")
    _refuse_learnt(out)
    text = _written(file, to, policy, least, evidence, loops)
    if out is None:
        sys.stdout.write(visible(text))
        return
    from evofsm.files import storage

    with storage.replacing(out) as place:
        place.write(visible(text).encode())


def _refuse_learnt(out: Path | None) -> None:
    """Raise where a graph would take the place of what cannot be had again."""
    if out is not None and out.is_file():
        with out.open("rb") as file:
            if file.read(_LONGEST_MARK).startswith(_LEARNT):
                raise ValueError(
                    f"--out {out}: what was learnt or driven is kept there; it was left alone"
                )


def _written(
    file: Path, to: Format, policy: str, least: float | None, evidence: float | None, loops: bool
) -> str:
    from evofsm.io import graphs

    model, dead_ends = _learnt(file)
    if to is Format.PRISM:
        return graphs.to_prism(model, 1.0 if evidence is None else evidence, least or 0.0)
    is_picture = to is not Format.GRAPHML
    write = {
        Format.DOT: graphs.to_dot,
        Format.MERMAID: graphs.to_mermaid,
        Format.GRAPHML: graphs.to_graphml,
    }[to]
    return write(
        model,
        "marginal" if policy == "marginal" else "observed",
        _PICTURE_LEAST * is_picture if least is None else least,
        _PICTURE_EVIDENCE * is_picture if evidence is None else evidence,
        self_loops=loops,
        dead_ends=dead_ends,
    )


def _learnt(file: Path) -> tuple[FSMModel, list[int] | None]:
    """The model, and its dead ends where the risk that was learnt with it is known."""
    from evofsm.driving import LatentRisk, assess_states

    model, _ = load_model(file)
    if not (file / _RISK).exists():
        return model, None
    assessed = assess_states(model, LatentRisk.load(file / _RISK))
    return model, [one.state for one in assessed if one.is_dead_end]


def _export_replay(file: Path, out: Path | None, episode: int) -> None:
    """An episode of a log, for sumo-gui."""
    require(mcap="mcap")
    from evofsm.io import read_run, write_replay

    if out is None:
        raise ValueError("--to sumo writes several files; --out names a folder for them")
    episodes = read_run(file).episodes
    if episode > len(episodes):
        raise ValueError(f"--episode is {episode}; {file} holds {len(episodes)}")
    say(f"Open it: sumo-gui {write_replay(out, episodes[episode - 1])}")

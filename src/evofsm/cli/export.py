"""`evofsm export`."""

from __future__ import annotations

import sys
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from evofsm.cli.common import plain_errors, require

with suppress(ModuleNotFoundError):
    import typer

if TYPE_CHECKING:
    from evofsm.model import FSMModel

# What folders of results hold, in the order in which it is looked for.
_MODELS, _RISK = ("machine.evofsm", "model.evofsm"), "risk.evofsm"
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
    text = _written(file, to, policy, least, evidence, loops)
    if out is None:
        sys.stdout.write(text)
        return
    from evofsm import storage

    with storage.replacing(out) as place:
        place.write(text.encode())


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
    from evofsm.risk.by_state import assess_states
    from evofsm.risk.outcome import LatentRisk

    if not file.is_dir():
        return _model(file), None
    within = next((file / name for name in _MODELS if (file / name).exists()), None)
    if within is None:
        raise FileNotFoundError(f"{file}: there is neither {' nor '.join(_MODELS)} in it")
    model = _model(within)
    if not (file / _RISK).exists():
        return model, None
    assessed = assess_states(model, LatentRisk.load(file / _RISK))
    return model, [one.state for one in assessed if one.is_dead_end]


def _model(file: Path) -> FSMModel:
    """A model from a file of any kind that holds one."""
    from evofsm import storage
    from evofsm.machine import EvolvingFSM
    from evofsm.model import FSMModel

    if file.suffix == ".mcap":
        require(mcap="mcap")
        from evofsm.io.mcap import read_run

        model = read_run(file).model
        if model is None:
            raise ValueError(f"{file}: no model is attached to this log")
        return model
    header = storage.describe(file)
    if header.kind != "machine":
        return FSMModel.load(file)
    machine = EvolvingFSM.load(file)
    if "family" not in header.provenance:
        return machine.model()
    from evofsm.worlds.road import UNITS, VARIABLES

    return machine.model(names=VARIABLES, units=UNITS)  # it was driven


def _export_replay(file: Path, out: Path | None, episode: int) -> None:
    """An episode of a log, for sumo-gui."""
    require(mcap="mcap")
    from evofsm.io.mcap import read_run
    from evofsm.io.sumo_gui import write_replay

    if out is None:
        raise ValueError("--to sumo writes several files; --out names a folder for them")
    episodes = read_run(file).episodes
    if episode > len(episodes):
        raise ValueError(f"--episode is {episode}; {file} holds {len(episodes)}")
    print(f"Open it: sumo-gui {write_replay(out, episodes[episode - 1])}")

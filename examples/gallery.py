"""Draw the pictures of docs/gallery.md: ``python examples/gallery.py docs/images``."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt

from evofsm import EvolvingFSM, IntervalActions, plot
from evofsm.driving import (
    IDM,
    KinematicWorld,
    LatentRisk,
    Leader,
    Scenario,
    dead_ends_of,
)

VARIABLES = {"names": ["gap", "v_follower", "v_leader"], "units": ["m", "m/s", "m/s"]}


def of_a_machine() -> Iterator[str]:
    """The machine that the first tutorial grows: case 1 of the paper, in closed form."""
    leader = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=9.0, brake_speed=24.2)
    hasty = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-4.0, highest=2.5)
    episode = KinematicWorld().run(Scenario(leader, initial_gap=5.0), hasty)
    actions = IntervalActions(low=-2.5, high=2.5, width=0.3, outside="clip")
    machine = EvolvingFSM.paper()
    learnt = actions.encode(episode.accelerations)
    machine.learn_many(episode.observations, learnt)
    model = machine.model(actions=actions, **VARIABLES)
    dead_ends = dead_ends_of(model, LatentRisk(-4.0, decel=4.0, leader_decel=9.0))

    _, ax = plt.subplots(figsize=(5.0, 3.2))
    ax.plot(*episode.observations[:, :2].T, color=plot.COLORS["follower"])
    plot.states(model, ax, dead_ends=dead_ends)
    yield "states"
    _, ax = plt.subplots(figsize=(4.0, 3.2))
    plot.graph(model, ax, dead_ends=dead_ends)
    yield "graph"


def of_the_notebook() -> Iterator[str]:
    """Flights of a drone, alone and under a guard."""
    notebook = Path(__file__).with_name("first-guard.ipynb").read_text("utf-8")
    names: dict[str, object] = {}
    for cell in json.loads(notebook)["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
            if "figure" in names:
                yield "hover"
                return


def main(folder: Path) -> None:
    """Write all pictures."""
    plt.style.use("evofsm.paper.house")
    for name in chain(of_a_machine(), of_the_notebook()):
        plt.savefig(folder / f"{name}.png", dpi=110, bbox_inches="tight")
        plt.close()


if __name__ == "__main__":
    main(Path(*sys.argv[1:]))

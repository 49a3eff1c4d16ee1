"""A figure before and after it is in files, with the words that belong to it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import evofsm.paper
from evofsm.extras import needs
from studies.old.frame import Progress, silent

with needs("matplotlib", "plot", "drawing figures"):
    import matplotlib.style
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Drawing:
    """A figure in its files, and what a reader is told about it."""

    name: str  #: of the files, without their ending
    title: str
    caption: str
    alt: str  #: what it shows, for those who cannot see it
    paths: Mapping[str, Path]  #: by format, ``"png"`` and ``"svg"``


@dataclass(frozen=True)
class Sketch:
    """A figure that is still to be drawn, by `figure`."""

    name: str
    title: str
    caption: str
    alt: str
    figure: Callable[[], Figure]


def draw_all(
    sketches: Sequence[Sketch], folder: Path, progress: Progress = silent
) -> list[Drawing]:
    """Draw figures one by one in the house's style, each as PNG and SVG.

    Parameters
    ----------
    sketches : sequence of Sketch
    folder : Path
        Where the files are put; made if it is not there.
    progress : callable
        Called with the number of figures drawn, and of all figures.
    """
    folder.mkdir(parents=True, exist_ok=True)
    drawings = []
    style = Path(evofsm.paper.__file__).with_name("house.mplstyle")
    with matplotlib.style.context(["default", style]):
        for sketch in sketches:
            figure = sketch.figure()
            paths = {kind: folder / f"{sketch.name}.{kind}" for kind in ("png", "svg")}
            figure.savefig(paths["png"], dpi=160)
            figure.savefig(paths["svg"], metadata={"Date": None})
            drawings.append(Drawing(sketch.name, sketch.title, sketch.caption, sketch.alt, paths))
            progress(len(drawings), len(sketches))
    return drawings

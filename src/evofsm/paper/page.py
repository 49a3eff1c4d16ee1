"""Pages of results, of the paper and of all studies: one HTML file that loads nothing."""

from __future__ import annotations

import math
import platform
import re
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from string import Formatter
from typing import TYPE_CHECKING, Any

import evofsm
from evofsm.extras import needs

with needs("polars", "tables", "tables of results"):
    import polars as pl

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawn

#: What a cell says where there is no number.
NONE = "–"
_PACKAGES = ("numpy", "numba", "polars", "matplotlib")
# A table with a longer cell is one of words, which are folded.
_WORDS = 36
# What a cell begins with that holds a number.
_NUMBER = re.compile(r"[−–∞≤≥<>+\d]").match


class _Cell(Formatter):
    """``str.format`` for cells, in which what is small, but not 0, is not shown as 0."""

    def get_field(self, name: str, args: Any, row: Any) -> Any:
        return row[name], name  # names may hold dots and brackets

    def format_field(self, value: Any, spec: str) -> str:
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return NONE
        if isinstance(value, bool):
            return "yes" if value else "no"
        if isinstance(value, list | tuple):
            return ", ".join(self.format_field(item, spec) for item in value) or NONE
        if not isinstance(value, int | float):
            return str(value)
        if math.isinf(value):
            return "∞" if value > 0 else "−∞"
        if spec in ("%", "p"):
            text = f"{100 * value:.{2 if 0 < abs(value) < 5e-4 else 1}f}"
            return _minus(text) + (" %" if spec == "%" else "")
        text = format(value, spec or ("," if isinstance(value, int) else "g"))
        if value and not text.strip("-0."):
            text = f"{'<' if value > 0 else '>'} {text[:-1]}1"
        return _minus(text)


def _minus(number: str) -> str:
    return number.replace("-", "−") if "e" not in number else number


def cell(template: str, row: Mapping[str, Any]) -> str:
    """The text of one cell.

    The template is as ``str.format`` takes it, with names of the row. Two formats are added: ``%``
    for a share in percent, and ``p`` for the same without the sign.

    Examples
    --------
    >>> cell("{rate:%} ({low:p}–{high:p})", {"rate": 0.0, "low": 0.0, "high": 0.0037})
    '0.0 % (0.0–0.4)'
    >>> [cell("{skill:.2f}", {"skill": skill}) for skill in (-0.5, 0.001, None)]
    ['−0.50', '< 0.01', '–']
    """
    names = [name for _, name, _, _ in Formatter().parse(template) if name]
    if names and all(_Cell().format_field(row[name], "") == NONE for name in names):
        return NONE
    return _Cell().vformat(template, (), row)


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of a frame under headers.

    Examples
    --------
    >>> import polars as pl
    >>> frame = pl.DataFrame({"policy": ["ttc"], "failed": [3], "episodes": [10]})
    >>> Table("Failures", frame, {"who": "{policy}", "failed": "{failed} of {episodes}"}).cells
    [('ttc', '3 of 10')]
    """

    title: str
    frame: pl.DataFrame
    #: by header, a template of each cell (see `cell`); without it all columns as they are
    columns: Mapping[str, str] | None = None
    note: str = ""  #: stands below
    mark: pl.Expr | None = None  #: of each row ``"ours"``, ``"holds"``, ``"fails"``, or null

    @property
    def header(self) -> list[str]:
        """The name of each column."""
        return list(self.columns or self.frame.columns)

    @property
    def cells(self) -> list[tuple[str, ...]]:
        """The text of each row."""
        templates = (self.columns or {name: f"{{{name}}}" for name in self.frame.columns}).values()
        rows = self.frame.iter_rows(named=True)
        return [tuple(cell(template, row) for template in templates) for row in rows]

    @property
    def marks(self) -> list[str | None]:
        """The mark of each row."""
        if self.mark is None or self.frame.is_empty():
            return [None] * len(self.frame)
        return self.frame.select(mark=self.mark)["mark"].to_list()

    @property
    def numeric(self) -> list[bool]:
        """Whether a column, never the first, holds numbers."""
        columns = list(zip(self.header, *self.cells, strict=True))[1:]
        return [False, *(all(map(_NUMBER, column[1:])) for column in columns)]

    @property
    def is_wordy(self) -> bool:
        """Whether cells hold words, which may be folded."""
        return any(len(text) > _WORDS for row in self.cells for text in row)


@dataclass(frozen=True, eq=False)
class Figure:
    """A figure that `write_page` draws."""

    name: str  #: of its files, without their ending
    title: str
    caption: str
    draw: Callable[[], Drawn]


@dataclass(frozen=True, eq=False)
class Page:
    """What was asked, the tables and figures that say what came out, and where it loses."""

    name: str  #: in addresses, such as ``"closed-loop"``
    about: str  #: the question, an empty line, and what was done; a docstring
    parts: Sequence[Table | Figure]  #: of a page by itself a figure that is the first is on top
    command: str  #: that makes it
    lost: Sequence[Table] = ()  #: rows that go against us
    #: what was asked and measured, and last whether it is met; empty where nothing was asked for
    targets: pl.DataFrame = field(default_factory=pl.DataFrame)
    facts: Mapping[str, str] = field(default_factory=dict)  #: seeds and sizes, by name
    packages: tuple[str, ...] = ()  #: whose versions matter beside the usual ones
    sources: Mapping[str, str] = field(default_factory=dict)  #: addresses by text
    verdict: str = ""  #: in a line; without it how many targets are met

    @property
    def title(self) -> str:
        """The question."""
        return " ".join(self.about.strip().partition("\n\n")[0].split())

    @property
    def text(self) -> list[str]:
        """The paragraphs below it."""
        return [" ".join(part.split()) for part in self.about.strip().split("\n\n")[1:]]

    @property
    def holds(self) -> bool | None:
        """Whether all targets are met; None where there is none."""
        return None if self.targets.is_empty() else bool(self.targets[:, -1].all())

    @property
    def answer(self) -> str:
        """The verdict."""
        if self.verdict or self.targets.is_empty():
            return self.verdict
        return f"{self.targets[:, -1].sum()} of {len(self.targets)} targets are met"

    @property
    def tables(self) -> list[Table]:
        """All tables but those of what is lost, the targets first."""
        mark = pl.when(pl.nth(-1)).then(pl.lit("holds")).otherwise(pl.lit("fails"))
        name = "" if self.targets.is_empty() else f"{self.targets.columns[0].capitalize()}s"
        targets = [Table(name, self.targets, mark=mark)] if name else []
        return [*targets, *(part for part in self.parts if isinstance(part, Table))]

    @property
    def losses(self) -> list[Table]:
        """Tables of what is lost that have a row."""
        return [table for table in self.lost if len(table.frame)]


def write_page(path: Path, pages: Sequence[Page], title: str = "", about: str = "") -> Path:
    """Draw all figures and write one file that holds all it shows.

    Figures are put into ``figures`` beside it as well, as PNG and SVG; those of each of many pages
    into a folder of its name.

    Parameters
    ----------
    path : Path
    pages : sequence of Page
    title, about : str
        Of many pages together; of one its own are taken.
    """
    with needs("jinja2", "plot", "writing the page"):
        from jinja2 import Environment, PackageLoader, StrictUndefined
    look: dict[str, Any] = {"autoescape": True, "trim_blocks": True, "lstrip_blocks": True}
    loader = PackageLoader("evofsm.paper", "")
    environment = Environment(loader=loader, undefined=StrictUndefined, **look)
    folders = [(page, page.name if len(pages) > 1 else "figures") for page in pages]
    text = environment.get_template("page.html.j2").render(
        title=title or pages[0].title,
        about=[about] if about else pages[0].text,
        pages=pages,
        images={page.name: _drawn(page, path.parent / folder) for page, folder in folders},
        summary=summary(pages),
        versions=_versions([package for page in pages for package in page.packages]),
        date=datetime.now(UTC).date().isoformat(),
    )
    path.write_text(text, encoding="utf-8")
    return path


def _drawn(page: Page, folder: Path) -> dict[str, str]:
    """Each figure as the address of an image that holds it, by name."""
    import matplotlib.style

    folder.mkdir(parents=True, exist_ok=True)
    images = {}
    with matplotlib.style.context(["default", "evofsm.paper.house"]):
        for item in (part for part in page.parts if isinstance(part, Figure)):
            figure, svg = item.draw(), folder / f"{item.name}.svg"
            figure.savefig(svg.with_suffix(".png"))
            figure.savefig(svg, metadata={"Date": None})
            text = b64encode(svg.read_bytes()).decode("ascii")
            images[item.name] = f"data:image/svg+xml;base64,{text}"
    return images


def summary(pages: Sequence[Page]) -> Table:
    """What many pages ask and answer, a line each."""
    rows = {
        "question": [page.title for page in pages],
        "answer": [page.answer for page in pages],
        "rows lost": [sum(len(table.frame) for table in page.losses) for page in pages],
    }
    holds = pl.Series([page.holds for page in pages], dtype=pl.Boolean)
    mark = pl.when(holds).then(pl.lit("holds")).when(~holds).then(pl.lit("fails"))
    return Table("In short", pl.DataFrame(rows), mark=mark)


def _versions(more: Sequence[str]) -> dict[str, str]:
    versions = {"evofsm": evofsm.__version__, "Python": platform.python_version()}
    names = {"libsumo": "SUMO (libsumo)"}
    versions |= {names.get(name, name): version(name) for name in (*_PACKAGES, *more)}
    return {**versions, "system": f"{platform.system()} on {platform.machine()}"}

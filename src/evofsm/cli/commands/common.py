"""What all commands share: errors in one line, bars, JSON."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from evofsm.extras import install

# What folders of results hold, in the order in which it is looked for.
_MODELS = ("machine.evofsm", "model.evofsm")


if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn, Task

    from evofsm.fsm import FSMModel
    from evofsm.guard import Mode
    from evofsm.store import Header


def chosen_mode(name: str) -> Mode:
    """How far the reviser goes, by its name."""
    from evofsm.guard import Mode

    if name not in (names := [one.value for one in Mode]):
        raise ValueError(f"--mode is {name!r}; it must be one of {', '.join(names)}")
    return Mode(name)


def load_model(place: Path) -> tuple[FSMModel, Header | None]:
    """A model from wherever one was left, and what its file says of itself, if there is one.

    From the file of a machine, a model or a guard, from a folder of results, or from a log of runs.
    A machine that drove a family of scenarios is labelled as that family is.
    """
    from evofsm.fsm import FSMModel
    from evofsm.store import storage

    if place.is_dir():
        within = next((place / name for name in _MODELS if (place / name).exists()), None)
        if within is None:
            raise FileNotFoundError(f"{place}: there is neither {' nor '.join(_MODELS)} in it")
        return load_model(within)
    if place.suffix == ".mcap":
        return _model_of_log(place), None
    header = storage.read_header(place)
    if header.kind == "guard":
        return _model_of_guard(place), header
    return (_labelled(place, header) if header.kind == "machine" else FSMModel.load(place)), header


def _labelled(place: Path, header: Header) -> FSMModel:
    """The model of a machine, with the words of the family that it drove."""
    from evofsm.driving import FAMILIES, load_family
    from evofsm.fsm import EvolvingFSM

    machine = EvolvingFSM.load(place)
    if (name := header.provenance.get("family")) not in FAMILIES:
        return machine.model()
    return machine.model(**load_family(name).labels._asdict())


def _model_of_guard(place: Path) -> FSMModel:
    """Its machine's, whatever its judge is."""
    from evofsm.fsm import EvolvingFSM
    from evofsm.store import storage

    _, files = storage.read(place, "guard")
    machine = files["machine"].tobytes()
    if not machine:
        raise ValueError(f"{place}: this guard has no machine")
    return EvolvingFSM.load(BytesIO(machine)).model()


def _model_of_log(place: Path) -> FSMModel:
    require(mcap="mcap")
    from evofsm.io import read_run

    model = read_run(place).model
    if model is None:
        raise ValueError(f"{place}: no model is attached to this log")
    return model


#: What a page with figures needs, and the extra that brings it.
PAGE = {"matplotlib": "plot", "jinja2": "plot"}


def require(**extras: str) -> None:
    """Refuse before the long work what lacks a package after it: all at once."""
    if lacking := [package for package in extras if find_spec(package) is None]:
        all_extras = install(*dict.fromkeys(["cli", *extras.values()]))
        raise ModuleNotFoundError(f"this needs {' and '.join(lacking)}: {all_extras}")


def message(error: Exception) -> str:
    """What an error says, in one line, and what it happened in."""
    text = str(error)
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        text = f"{error.filename}: {error.strerror.lower()}"
    return ", ".join([text, *getattr(error, "__notes__", ())])


@contextmanager
def progress(unit: str | None = None) -> Iterator[Progress]:
    """Bars on standard error; none where nobody watches. With a unit, with the rate as well."""
    from rich.console import Console
    from rich.progress import Progress

    columns = _columns_with_rate(unit) if unit else Progress.get_default_columns()
    console = Console(stderr=True)
    with Progress(
        *columns, console=console, transient=True, disable=not sys.stderr.isatty()
    ) as bars:
        yield bars


def _columns_with_rate(unit: str) -> tuple[ProgressColumn, ...]:
    """How much of it is done, how many a second, and how long it will take: in 80 columns."""
    from rich.progress import BarColumn, ProgressColumn, TextColumn, TimeRemainingColumn
    from rich.text import Text

    class Rate(ProgressColumn):
        """Of what is done since the bar was made."""

        def render(self, task: Task) -> Text:
            return Text("" if task.speed is None else f"{task.speed:,.1f} {unit}/s")

    done = TextColumn("{task.completed:,} of {task.total:,}")
    return TextColumn("{task.description}"), BarColumn(20), done, Rate(), TimeRemainingColumn()


def counter(bars: Progress, text: str) -> Callable[[int, int], None]:
    """Add a bar; returns a function of how much is done, and of how much."""
    if bars.disable:
        print(f"{text} ...", file=sys.stderr)
    task = bars.add_task(text, total=None)
    return lambda done, total: bars.update(task, completed=done, total=total)


def say(text: object) -> None:
    """Print what may hold texts from files."""
    from evofsm.fsm import visible

    print(visible(str(text)))


def print_json(document: object) -> None:
    """Print for programs."""
    from evofsm.cli.text.documents import to_json

    print(to_json(document))


def command_line() -> str:
    """What was typed."""
    return shlex.join(["evofsm", *sys.argv[1:]])


#: What an option may take in place of names with commas: all there are, or the first one.
ALL, FIRST = "all", "first"


def split_names(text: str) -> list[str]:
    """Names that were given with commas between them."""
    return [name.strip() for name in text.split(",") if name.strip()]

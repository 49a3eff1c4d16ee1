"""The command line: reads what was asked for, calls a study, prints what it found."""

from __future__ import annotations

import functools
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ParamSpec

# Needed once the annotations below are read; `main` says what to install where it is missing.
with suppress(ModuleNotFoundError):
    import typer

if TYPE_CHECKING:
    from rich.progress import Progress

    from evofsm.actions import IntervalActions
    from evofsm.io import LogColumns
    from evofsm.observations import Category

P = ParamSpec("P")

_UNITS = {"gap": "m", "v_follower": "m/s", "v_leader": "m/s"}
_MOST_ACTIONS = 1000


def main() -> None:
    """Run the command line."""
    if find_spec("typer") is None or find_spec("rich") is None:
        print("evofsm: the command line needs: pip install 'evofsm[cli]'", file=sys.stderr)
        sys.exit(2)
    application()()


def application() -> typer.Typer:
    """All commands."""
    app = typer.Typer(
        name="evofsm",
        help="Online recognition of latent risk with an evolving finite state machine.",
        add_completion=False,
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback()(options)
    app.command()(paper)
    app.command()(learn)
    app.command()(inspect)
    return app


def _print_version(asked: bool) -> None:
    if asked:
        from evofsm import __version__

        print(f"evofsm {__version__}")
        raise typer.Exit


def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_print_version, help="Print the version and stop."
        ),
    ] = False,
) -> None:
    """Online recognition of latent risk with an evolving finite state machine."""


def plain_errors(command: Callable[P, None]) -> Callable[P, None]:
    """Let a command end with one clear line instead of a traceback."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except KeyboardInterrupt:
            print("\nevofsm: stopped before the end", file=sys.stderr)
            raise typer.Exit(130) from None
        except BrokenPipeError:  # whoever read the output had enough
            raise
        except (ValueError, TypeError, OSError, ModuleNotFoundError) as error:
            print(f"evofsm: {_message(error)}", file=sys.stderr)
            raise typer.Exit(2) from None

    return run


def _require(**extras: str) -> None:
    """Refuse before the long work what lacks a package after it."""
    for package, extra in extras.items():
        if find_spec(package) is None:
            raise ModuleNotFoundError(f"this needs {package}: pip install 'evofsm[{extra}]'")


def _message(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror.lower()}"
    return str(error)


class WorldName(StrEnum):
    """Where to drive."""

    SUMO = "sumo"
    KINEMATIC = "kinematic"


@plain_errors
def paper(
    world: Annotated[
        WorldName, typer.Option(help="SUMO itself, or the same motion in closed form.")
    ] = WorldName.SUMO,
    rounds: Annotated[int, typer.Option(min=1, help="How often the four cases are driven.")] = 20,
    out: Annotated[
        Path, typer.Option(help="Folder for the page, figures, traces and the model.")
    ] = Path("evofsm-paper"),
    settings: Annotated[
        Path | None,
        typer.Option(
            help="TOML file with settings to use in place of the paper's.", show_default=False
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the claims as JSON instead of tables.")
    ] = False,
) -> None:
    """Reproduce the paper: drive its 80 runs, and hold every claim against them.

    Ends with 0 if all claims hold, with 1 if any does not.
    """
    _require(matplotlib="plot", jinja2="plot", polars="tables")
    from evofsm.report import terminal
    from evofsm.report.figures import paper_figures
    from evofsm.report.page import write_page
    from evofsm.studies.paper import (
        Settings,
        check_claims,
        context_tables,
        run_paper,
        write_data,
    )
    from evofsm.worlds import open_world

    chosen = Settings.load(settings)
    out.mkdir(parents=True, exist_ok=True)
    with _progress() as bars, open_world(world.value) as place:
        study = run_paper(
            place, world.value, chosen, rounds, _counter(bars, f"Driving and learning ({world})")
        )
        claims, context = check_claims(study), context_tables(study)
        write_data(study, claims, context, out)
        drawings = paper_figures(study, out / "figures", _counter(bars, "Drawing figures"))
        page = write_page(
            study, claims, context, drawings, out, " ".join(["evofsm", *sys.argv[1:]])
        )
    if as_json:
        print((out / "claims.json").read_text(encoding="utf-8"), end="")
    else:
        terminal.print_claims(terminal.console(), claims, context)
        terminal.console().print(f"Page with all figures: {page}", soft_wrap=True)
    if not all(claim.holds for claim in claims):
        raise typer.Exit(1)


@plain_errors
def learn(
    files: Annotated[
        list[str],
        typer.Argument(
            help="Logs (CSV, Parquet) or FCD output of SUMO (XML, CSV, Parquet); gzipped or not.",
            show_default=False,
        ),
    ],
    observe: Annotated[
        str,
        typer.Option(
            help="Columns to observe. A discrete one is written with its values: light=red/green."
        ),
    ] = "gap,v_follower,v_leader",
    action: Annotated[
        str, typer.Option(help="Column of the action taken from a row to the next.")
    ] = "a_follower",
    action_range: Annotated[
        str,
        typer.Option(
            help="Intervals of the action, LOW:HIGH:WIDTH. What lies beyond goes into the end "
            "intervals and is counted."
        ),
    ] = "-2.5:2.5:0.3",
    time: Annotated[str, typer.Option(help="Column of the time, in seconds.")] = "time",
    episode: Annotated[
        str | None,
        typer.Option(
            help="An episode begins where one of these columns changes, and in each file; none "
            "of them: ''. [default: those of run,pair,segment that exist]",
            show_default=False,
        ),
    ] = None,
    dt: Annotated[
        float | None,
        typer.Option(
            help="Seconds from a row to the next, for a log without a clock.", show_default=False
        ),
    ] = None,
    vehicle_length: Annotated[
        list[str] | None,
        typer.Option(
            help="FCD: length of vehicles in metres, or of a type: truck=12. May be repeated. "
            "[default: 5.0]",
            show_default=False,
        ),
    ] = None,
    category_distance: Annotated[
        float, typer.Option(help="How far apart the values of a discrete column count.")
    ] = 1.0,
    radius: Annotated[float, typer.Option(help="The paper's ε, which parts states.")] = 0.3,
    distance_weight: Annotated[
        float, typer.Option(help="The paper's ρ, how fast distance lowers potential.")
    ] = 0.85,
    learning_rate: Annotated[
        float, typer.Option(help="The paper's φ, the weight of the newest transition.")
    ] = 0.01,
    prior_frequency: Annotated[
        float, typer.Option(help="The paper's ε̄, the frequency of transitions never seen.")
    ] = 1e-3,
    spread: Annotated[float, typer.Option(help="Width of recognition; smaller is sharper.")] = 3.0,
    out: Annotated[
        Path | None, typer.Option(help="File to save the model to.", show_default=False)
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document; counts from 0.")
    ] = False,
) -> None:
    """Learn a machine from logs of your own, of any size, row by row.

    A log holds a row per time step. A step longer than 1.5 times the usual one (the median in the
    first rows of a file) is a hole in time: it begins a new episode.

    In FCD output of SUMO, a vehicle and the next one ahead of it on the same lane are a pair (a
    leader beyond the end of the lane is not seen). A pair is observed by gap (bumper to bumper),
    v_follower and v_leader; its action a_follower is what the follower did until the next time
    step. SUMO rounds to 2 decimals unless told --precision 6.
    """
    from evofsm.io import VehicleLengths, read_traces
    from evofsm.machine import EvolvingFSM
    from evofsm.studies.learning import learn_traces

    _check_out(out)
    actions = _actions(action_range)
    columns = _columns(observe, action, time, episode, dt, category_distance)
    lengths = VehicleLengths.parse(vehicle_length or [])
    machine = EvolvingFSM(
        actions.n_actions, radius, distance_weight, learning_rate, prior_frequency, spread
    )
    names = columns.observe.names
    with _progress() as bars:
        learning = learn_traces(
            read_traces(files, columns, lengths, _bytes_read(bars, files)),
            machine,
            actions,
            names,
            [_UNITS.get(name, "") for name in names],
        )
    if out is not None:
        learning.model.save(out)

    from evofsm.report import terminal

    if as_json:
        document = terminal.learning_document(learning)
        _print_json({"files": files, "saved": out and str(out), **document})
        return
    console = terminal.console()
    terminal.print_learning(
        console, learning, action=action, lengths=str(lengths) if lengths.seen else None
    )
    console.print()
    if out is None:
        console.print("Nothing was saved; --out MODEL keeps the model.", soft_wrap=True)
    else:
        console.print(f"Saved to {out}. Look at it again: evofsm inspect {out}", soft_wrap=True)


@plain_errors
def inspect(
    file: Annotated[
        str, typer.Argument(help="A model or a machine that was saved.", show_default=False)
    ],
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document; counts from 0.")
    ] = False,
) -> None:
    """Print a saved model: its states, the transitions that matter, the actions."""
    from evofsm import storage
    from evofsm.machine import EvolvingFSM
    from evofsm.model import FSMModel
    from evofsm.report import terminal

    if storage.kind_of(file) == "machine":
        model = EvolvingFSM.load(file).model()
        facts = [("file", f"{file}, a machine that can go on learning")]
    else:
        model = FSMModel.load(file)
        facts = [("file", file)]
    if as_json:
        _print_json({"file": file, **terminal.model_document(model)})
    else:
        terminal.print_model(terminal.console(), model, facts)


# -- What was asked for ---------------------------------------------------------------------------


def _check_out(out: Path | None) -> None:
    """Refuse before the long work what could not be saved after it."""
    from evofsm import storage

    if out is None:
        return
    if not out.parent.is_dir():
        raise FileNotFoundError(f"--out {out}: there is no folder {out.parent}")
    if not os.access(out.parent, os.W_OK):
        raise PermissionError(f"--out {out}: the folder {out.parent} may not be written")
    if out.is_dir():
        raise IsADirectoryError(f"--out {out} is a folder; name a file in it")
    if out.exists():
        try:
            storage.kind_of(out)
        except (ValueError, OSError):
            raise ValueError(
                f"--out {out}: exists and is no file of evofsm; it was left alone"
            ) from None


def _actions(text: str) -> IntervalActions:
    from evofsm.actions import IntervalActions

    try:
        low, high, width = (float(number) for number in text.split(":"))
    except ValueError:
        raise ValueError(
            f"--action-range is {text!r}; write LOW:HIGH:WIDTH, such as -2.5:2.5:0.3"
        ) from None
    try:
        if width > 0.0 and (high - low) / width > _MOST_ACTIONS:
            raise ValueError(f"more than {_MOST_ACTIONS} intervals; make them wider")
        return IntervalActions(low, high, width, outside="clip")
    except ValueError as error:
        raise ValueError(f"--action-range {text}: {error}") from None


def _columns(
    observe: str,
    action: str,
    time: str,
    episode: str | None,
    dt: float | None,
    category_distance: float,
) -> LogColumns:
    from evofsm.io import LogColumns
    from evofsm.observations import ObservationEncoder
    from evofsm.validation import positive

    try:
        variables = [_variable(name, category_distance) for name in _names(observe)]
        encoder = ObservationEncoder(*variables)
    except ValueError as error:
        raise ValueError(f"--observe {observe}: {error}") from None
    return LogColumns(
        observe=encoder,
        action=action,
        time=time,
        episode=None if episode is None else _names(episode),
        dt=None if dt is None else positive("--dt", dt),
    )


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _variable(text: str, distance: float) -> str | Category:
    from evofsm.observations import Category

    name, discrete, values = text.partition("=")
    return Category(name, values.split("/"), distance) if discrete else text


# -- In the terminal ------------------------------------------------------------------------------


@contextmanager
def _progress() -> Iterator[Progress]:
    """Bars on standard error; none where nobody watches."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not sys.stderr.isatty()) as bars:
        yield bars


def _counter(bars: Progress, text: str) -> Callable[[int, int], None]:
    """A bar that is told how much is done, of how much."""
    if bars.disable:
        print(f"{text} ...", file=sys.stderr)
    task = bars.add_task(text, total=None)
    return lambda done, total: bars.update(task, completed=done, total=total)


def _bytes_read(bars: Progress, files: list[str]) -> Callable[[int], None]:
    """A bar that grows with the bytes read of some files."""
    task = bars.add_task("Learning", total=sum(os.path.getsize(file) for file in files))
    return lambda count: bars.advance(task, count)


def _print_json(document: dict[str, object]) -> None:
    print(json.dumps(document, indent=2, allow_nan=False))


if __name__ == "__main__":
    main()

"""`evofsm learn` and `evofsm inspect`."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from evofsm.cli.common import plain_errors, print_json, progress, split_names

with suppress(ModuleNotFoundError):
    import typer

if TYPE_CHECKING:
    from rich.progress import Progress

    from evofsm.actions import IntervalActions
    from evofsm.io import LogColumns
    from evofsm.observations import Category

_UNITS = {"gap": "m", "v_follower": "m/s", "v_leader": "m/s"}
_MOST_ACTIONS = 1000


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
    with progress() as bars:
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
        print_json({"files": files, "saved": out and str(out), **document})
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
        print_json({"file": file, **terminal.model_document(model)})
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
        variables = [_variable(name, category_distance) for name in split_names(observe)]
        encoder = ObservationEncoder(*variables)
    except ValueError as error:
        raise ValueError(f"--observe {observe}: {error}") from None
    return LogColumns(
        observe=encoder,
        action=action,
        time=time,
        episode=None if episode is None else split_names(episode),
        dt=None if dt is None else positive("--dt", dt),
    )


def _variable(text: str, distance: float) -> str | Category:
    from evofsm.observations import Category

    name, discrete, values = text.partition("=")
    return Category(name, values.split("/"), distance) if discrete else text


def _bytes_read(bars: Progress, files: list[str]) -> Callable[[int], None]:
    """A bar that grows with the bytes read of some files."""
    task = bars.add_task("Learning", total=sum(os.path.getsize(file) for file in files))
    return lambda count: bars.advance(task, count)

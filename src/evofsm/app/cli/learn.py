"""`evofsm learn` and `evofsm inspect`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

from evofsm.app.cli.common import load_model, plain_errors, print_json, progress, split_names

with suppress(ModuleNotFoundError):
    import typer

if TYPE_CHECKING:
    from rich.progress import Progress

    from evofsm.app.learning import Learning
    from evofsm.core import Category, IntervalActions
    from evofsm.files import Checkpoint, Header
    from evofsm.io import Chunk, LogColumns, Noted, VehicleLengths


class RuleName(StrEnum):
    """How states are made."""

    PAPER = "paper"
    EDGES = "edges"
    NOVELTY = "novelty"
    FAILURE = "failure"


class NoLeader(StrEnum):
    """What to do where there is no leader."""

    REFUSE = "refuse"
    END = "end"


_MOST_ACTIONS = 1000
# For novelty, of a gap [m] and of speeds [m/s]: as the closed loop has them.
_SCALES = (4.0, 2.0, 2.0)
# What does not change what is learnt; files are told apart by what is in them.
_NO_SETTINGS = ("files", "out", "checkpoint", "every", "as_json")
# What there may be of in a provenance, and how many files of it are named.
_AMOUNTS = ("files", "rows", "episodes", "transitions")
_MOST_FILES = 3


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
    failed: Annotated[
        str | None,
        typer.Option(
            help="What tells of failures: a column of truth values (0 and 1, true and false), or a "
            "comparison such as 'gap<=0'. The row with which it becomes true ends the episode in "
            "failure; rows in which it stays so are left out. Compared after --unit.",
            show_default=False,
        ),
    ] = None,
    unit: Annotated[
        list[str] | None,
        typer.Option(
            help="Unit of a column, or of all read that begin so: v=km/h, time=ms. May be "
            "repeated. Learnt are s, m, m/s, m/s².",
            show_default=False,
        ),
    ] = None,
    no_leader: Annotated[
        NoLeader,
        typer.Option(
            help="A row in which an observed number is missing (empty, NaN, infinite), as where "
            "there is no leader: refuse the log, or end the episode there and leave the row out."
        ),
    ] = NoLeader.REFUSE,
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
    rule: Annotated[
        RuleName,
        typer.Option(
            help="How states are made. The paper's is the default, for the paper specifies it and "
            "earlier results were learnt with it; edges: with states at edges too; novelty: one "
            "wherever nothing like it was seen, recommended for logs (docs/logs.md says why); "
            "failure: as novelty, and at failures (--failed)."
        ),
    ] = RuleName.PAPER,
    radius: Annotated[
        float | None,
        typer.Option(
            help="The paper's ε, which parts states; of novelty, in --scale. [default: 0.3; of "
            "novelty and failure 1.0]",
            show_default=False,
        ),
    ] = None,
    scale: Annotated[
        list[str] | None,
        typer.Option(
            help="Novelty and failure: the difference that counts as 1, by the column, such as "
            "gap=4. May be repeated. [default: gap=4, v_follower=2, v_leader=2; of a discrete "
            "column 1]",
            show_default=False,
        ),
    ] = None,
    max_states: Annotated[
        int | None,
        typer.Option(
            help="Where there are so many states, two are merged for each new one. [default: no "
            "limit]",
            show_default=False,
        ),
    ] = None,
    distance_weight: Annotated[
        float, typer.Option(help="The paper's ρ, how fast distance lowers potential.")
    ] = 0.85,
    learning_rate: Annotated[
        float, typer.Option(help="The paper's φ, the weight of the newest transition.")
    ] = 0.01,
    prior_frequency: Annotated[
        float, typer.Option(help="The paper's ε̄, the frequency of transitions never seen.")
    ] = 1e-3,
    spread: Annotated[
        float | None,
        typer.Option(
            help="Width of recognition; smaller is sharper. [default: 3.0; of novelty and failure "
            "1.0]",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="File to save the model to.", show_default=False)
    ] = None,
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            help="Keep what was learnt so far in this file; where it exists, go on from it.",
            show_default=False,
        ),
    ] = None,
    every: Annotated[
        str, typer.Option(help="Time between two checkpoints: 10s, 5m; 0s for as often as it can.")
    ] = "60s",
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

    The time may be seconds, or dates of ISO 8601. Without --failed a log tells nothing of failures,
    and evofsm explain says so.

    With --checkpoint, the same command goes on where it was stopped, whatever stopped it, and comes
    to the same result. The file is kept at the end: run again, the command prints it at once.
    """
    radius = _or_usual(radius, rule, 0.3, of_novelty=1.0)
    spread = _or_usual(spread, rule, 3.0, of_novelty=1.0)
    # Whatever it is told, a new option too, is a setting that a checkpoint goes by.
    settings = {name: value for name, value in locals().items() if name not in _NO_SETTINGS}
    from evofsm.app.learning import learn_traces
    from evofsm.core import EvolvingFSM
    from evofsm.driving import UNITS, VARIABLES
    from evofsm.files import Checkpoint, duration, fingerprints, result_kept
    from evofsm.io import Condition, Noted, VehicleLengths, parse_units, read_traces

    _check_out(out)
    interval = duration(every)
    actions = _actions(action_range)
    columns = replace(
        _columns(observe, action, time, episode, dt, category_distance),
        failed=None if failed is None else Condition.parse(failed),
        units=parse_units(unit or []),
        leader_may_lack=no_leader is NoLeader.END,
    )
    lengths, noted = VehicleLengths.parse(vehicle_length or []), Noted()
    if rule is RuleName.FAILURE and failed is None:
        raise ValueError("--rule failure makes states at failures; --failed has to tell of them")
    machine = EvolvingFSM(
        actions.n_actions,
        distance_weight=distance_weight,
        learning_rate=learning_rate,
        prior_frequency=prior_frequency,
        max_states=max_states,
        **_rule(rule, radius, spread, scale, columns),
    )
    names = columns.observe.names
    known = fingerprints(files)
    keeper = None
    if checkpoint is not None:
        _check_apart(checkpoint, out, files)
        keeper = Checkpoint(checkpoint, {**settings, "files": known}, interval)
    with progress() as bars:
        learning = learn_traces(
            _noting(
                read_traces(files, columns, lengths, _bytes_read(bars, files), noted),
                lengths,
                noted,
                keeper,
            ),
            machine,
            actions,
            names,
            [dict(zip(VARIABLES, UNITS, strict=True)).get(name, "") for name in names],
            keeper,
        )
    provenance = {
        "files": known,
        "rows": learning.rows,
        "episodes": learning.episodes,
        "transitions": learning.transitions,
        "action": action,
        **({} if failed is None else {"failed": failed, "failures": learning.failures}),
        **({} if unit is None else {"units converted": ", ".join(unit)}),
    }
    if keeper is not None and "noted" in keeper.notes:  # in the run that read the files
        noted = Noted(**keeper.notes["noted"])
    warnings = noted.warnings(time)
    for warning in warnings:
        print(f"evofsm: warning: {warning}", file=sys.stderr)
    if out is not None:
        with result_kept(keeper):
            learning.model.save(out, provenance)

    from evofsm.app.text import terminal

    if as_json:
        document = terminal.learning_document(learning)
        document["model"]["provenance"] = provenance
        apart = {"noted": asdict(noted), "warnings": warnings}
        print_json({"files": files, "saved": out and str(out), **document, **apart})
        return
    console = terminal.console()
    terminal.print_learning(
        console,
        learning,
        action=action,
        lengths=_assumed(lengths, keeper),
        further=_read_otherwise(noted, failed, learning),
    )
    console.print()
    if out is None:
        console.print("Nothing was saved; --out MODEL keeps the model.", soft_wrap=True)
    else:
        console.print(f"Saved to {out}. Look at it again: evofsm inspect {out}", soft_wrap=True)


@plain_errors
def inspect(
    file: Annotated[
        Path,
        typer.Argument(
            help="A machine or a model that was saved, or a folder of evofsm drive --out.",
            show_default=False,
        ),
    ],
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document; counts from 0.")
    ] = False,
) -> None:
    """Print a saved model: its states, the transitions that matter, the actions."""
    from evofsm.app.text import terminal

    model, header = load_model(file)
    provenance = {} if header is None else header.provenance
    if as_json:
        document = terminal.model_document(model)
        print_json({"file": str(file), **document, "provenance": provenance})
        return
    facts = [("file", str(file))]
    if header is not None:
        goes_on = ", a machine that can go on learning" if header.kind == "machine" else ""
        facts = [("file", f"{file}{goes_on}"), ("written by", _writer(header))]
    terminal.print_model(terminal.console(), model, [*facts, *_learnt_from(provenance)])


def _writer(header: Header) -> str:
    library = "an evofsm" if header.library is None else f"evofsm {header.library}"
    checked = "its SHA-256 is right" if header.version >= 4 else "without a SHA-256 yet"
    return f"{library}, file format {header.version}; {checked}"


def _learnt_from(provenance: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What a file says of where it comes from, line by line."""
    facts = []
    for name, value in provenance.items():
        if name == "files":
            shown = [f"{file['name']} ({file['bytes']:,} bytes)" for file in value[:_MOST_FILES]]
            more = len(value) - _MOST_FILES
            text = ", ".join(shown) + (f" and {more:,} more" if more > 0 else "")
        else:
            text = f"{value:,}" if isinstance(value, int) else str(value)
        facts.append((f"learnt from {name}" if name in _AMOUNTS else name, text))
    return facts


# -- What was asked for ---------------------------------------------------------------------------


def _check_out(out: Path | None) -> None:
    """Refuse before the long work what could not be saved after it."""
    from evofsm.files import storage

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


def _check_apart(checkpoint: Path, out: Path | None, files: list[str]) -> None:
    """Refuse a checkpoint that would take the place of something else."""
    others = [*files, *([str(out)] if out is not None else [])]
    if str(checkpoint.resolve()) in {str(Path(other).resolve()) for other in others}:
        raise ValueError(f"--checkpoint {checkpoint} is named twice; give it a file of its own")


def _noting(
    chunks: Iterator[Chunk], lengths: VehicleLengths, noted: Noted, keeper: Checkpoint | None
) -> Iterator[Chunk]:
    """The same chunks; at their end, what was assumed and noticed in reading them is noted."""
    yield from chunks
    if keeper is not None:
        keeper.notes["lengths"] = _assumed(lengths, None)
        keeper.notes["noted"] = asdict(noted)


def _read_otherwise(
    noted: Noted, failed: str | None, learning: Learning
) -> Iterator[tuple[str, str]]:
    """What was not learnt as it stands in the files, line by line."""
    if failed is None:
        yield "failures", "not told; --failed COLUMN or --failed 'gap<=0' tells of them"
    else:
        left_out = f"; {noted.after_failure:,} rows after them, still so, were left out"
        yield (
            "failures",
            f"{learning.failures:,} episodes ended with {failed}"
            + (left_out if noted.after_failure else ""),
        )
    if noted.leaderless:
        yield "no leader", f"in {noted.leaderless:,} rows, left out; there an episode ends"
    if noted.units:
        given = (f"{name} from {one}" for name, one in noted.units.items())
        yield "converted", f"{', '.join(given)} to units of the SI"


def _assumed(lengths: VehicleLengths, keeper: Checkpoint | None) -> str | None:
    """Lengths of vehicles that mattered, in this run or in the one that read the files."""
    if keeper is not None and "lengths" in keeper.notes:
        return cast("str | None", keeper.notes["lengths"])
    return str(lengths) if lengths.seen else None


def _actions(text: str) -> IntervalActions:
    from evofsm.core import IntervalActions

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
    from evofsm.core import ObservationEncoder, positive
    from evofsm.io import LogColumns

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


def _or_usual(given: float | None, rule: RuleName, usual: float, *, of_novelty: float) -> float:
    """A setting, or what holds where it was not given."""
    if given is not None:
        return given
    return of_novelty if rule in (RuleName.NOVELTY, RuleName.FAILURE) else usual


def _rule(
    name: RuleName,
    radius: float,
    spread: float,
    scale: list[str] | None,
    columns: LogColumns,
) -> dict[str, Any]:
    """What a machine is told of its rule, and the settings that it shares with it."""
    from evofsm.core import Edges, FailureSplit, Novelty

    given: dict[str, Any] = {"radius": radius, "spread": spread}
    if name in (RuleName.PAPER, RuleName.EDGES):
        if scale:
            raise ValueError(f"--scale is for --rule novelty or failure, not {name.value}")
        return given | ({"rule": Edges()} if name is RuleName.EDGES else {})
    rule = Novelty(scales=_scales(scale or [], columns, name), **given)
    return {"rule": FailureSplit(rule) if name is RuleName.FAILURE else rule}


def _scales(texts: list[str], columns: LogColumns, rule: RuleName) -> list[float]:
    """The difference that counts as 1, for each number that is observed."""
    from evofsm.core import positive
    from evofsm.driving import VARIABLES

    told = {}
    for text in texts:
        column, _, number = text.rpartition("=")
        try:
            told[column] = positive("it", float(number))
        except ValueError:
            raise ValueError(f"--scale is {text!r}; write COLUMN=NUMBER, such as gap=4") from None
    single = [one for one in columns.observe.variables if isinstance(one, str)]
    if unknown := [column for column in told if column not in single]:
        raise ValueError(f"--scale names {unknown[0]!r}; observed are {', '.join(single)}")
    told = dict(zip(VARIABLES, _SCALES, strict=True)) | told
    if lacking := [column for column in single if column not in told]:
        raise ValueError(
            f"--rule {rule.value} has to know the difference that counts as 1 in {lacking[0]!r}: "
            f"--scale {lacking[0]}=2 (4 m of a gap and 2 m/s of a speed are usual)"
        )
    return [told.get(name, 1.0) for name in columns.observe.names]


def _variable(text: str, distance: float) -> str | Category:
    from evofsm.core import Category

    name, discrete, values = text.partition("=")
    return Category(name, values.split("/"), distance) if discrete else text


def _bytes_read(bars: Progress, files: list[str]) -> Callable[[int], None]:
    """A bar that grows with the bytes read of some files."""
    task = bars.add_task("Learning", total=sum(os.path.getsize(file) for file in files))
    return lambda count: bars.advance(task, count)

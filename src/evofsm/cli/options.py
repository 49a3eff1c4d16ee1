"""Options that several commands share, and what commands do with what was typed."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import wraps
from importlib.util import find_spec
from inspect import Parameter, Signature, signature
from pathlib import Path
from pkgutil import resolve_name
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from evofsm.extras import install

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evofsm.fsm.observations import ObservationEncoder
    from evofsm.io import LogColumns, VehicleLengths
    from evofsm.io.logs import Resample

Judge = Literal["kinematic", "learnt"]  #: what a judge was given
ModeName = Literal["off", "shadow", "act"]  #: how far a guard goes, as `evofsm.guard.Mode`


def option(about: str, *names: str, **limits: Any) -> Any:
    """An option by its help; with names in place of the parameter's, and bounds of a number."""
    return typer.Option(*names, help=about, **limits)


def argument(about: str, **further: Any) -> Any:
    """An argument by its help."""
    return typer.Argument(help=about, **further)


Json = Annotated[
    bool, option("Print one JSON document; states and actions count from 0.", "--json")
]
Saved = Annotated[
    Path, argument("A saved machine, model or guard, or a folder that evofsm drive wrote.")
]
Seed = Annotated[int, option("Seed of all random draws.", min=0)]
InWorld = Annotated[
    Literal["sumo", "kinematic"], option("SUMO itself, or the same motion in closed form.")
]
ByJudge = Annotated[
    Judge, option("Given how cars follow each other, or nothing but which episodes failed.")
]
Tolerance = Annotated[
    float, option("Share of hard brakes (learnt: of disturbances) that need not be survived.")
]
TOLERANCE = 0.02  #: as `evofsm.guard.TOLERANCE`, without what that loads.
BRAKES = 6.0  #: what a car's brakes are reckoned with where nobody said [m/s²]
SUMO = (".sumocfg", ".sumo.cfg")  #: how names of configurations of SUMO end
Brakes = Annotated[
    float,
    option(
        "Hardest braking of the own car; a guard executes none harder [m/s²].", min=0.5, max=20.0
    ),
]


def require(**extras: str) -> None:
    """Refuse before the long work what lacks packages after it; all that lack at once."""
    if packages := [package for package in extras if find_spec(package) is None]:
        command = install(*dict.fromkeys(["cli", *(extras[package] for package in packages)]))
        raise ModuleNotFoundError(f"this needs {' and '.join(packages)}: {command}")


def refuse_unnamed(out: Path) -> None:
    """Raise where a picture would be written to another file than was named."""
    if out.is_dir():
        raise IsADirectoryError(f"--plot {out} is a folder; name a file in it")
    if not out.suffix:
        raise ValueError(f"--plot {out}: what kind of picture says an ending, such as {out}.png")


@contextmanager
def picture(out: Path, width: float, height: float) -> Iterator[Figure]:
    """A figure [inch] in the house's style, which then is written to a file."""
    refuse_unnamed(out)
    from matplotlib.figure import Figure
    from matplotlib.style import context

    with context(["default", "evofsm.paper.house"]):
        yield (figure := Figure((width, height), layout="constrained"))
        figure.savefig(out)


def refuse_foreign(marks: Mapping[Path, str | None]) -> None:
    """Raise where a file that is not empty would be written over, and begins without its mark."""
    for path in filter(Path.is_file, marks):
        with path.open("rb") as file:
            begin, mark = file.read(1000), marks[path]
        if begin and (mark is None or mark.encode() not in begin):
            text = "is not what would be written there anew; it was left alone: name another one"
            raise FileExistsError(f"{path} {text}")


def require_world(world: str, **extras: str) -> None:
    """The same for a drive: SciPy is for SUMO's distributions and exact intervals."""
    require(scipy="study", **({"libsumo": "sumo"} if world == "sumo" else {}), **extras)


def imported(name: str) -> Any:
    """A class, function or instance by its name ``module:Name``; found in this folder, too."""
    if not re.fullmatch("[^:]+:[^:]+", name):
        raise ValueError(f"{name!r} names nothing; write module:Name")
    if "" not in sys.path:
        sys.path.insert(0, "")  # as `python -m` does
    try:
        return resolve_name(name)
    except ModuleNotFoundError as error:
        raise ValueError(f"{name}: {error} (is it in this folder, or installed?)") from error
    except AttributeError as error:
        raise ValueError(f"{name}: {error}") from error


def in_quotes(text: str) -> str:
    """A text as a shell takes it, to be read as well.

    >>> print(in_quotes("Status=='off'"), in_quotes("gap<=0"))
    "Status=='off'" 'gap<=0'
    """
    return f'"{text}"' if "'" in text and not {*text} & {*'"$`\\!'} else quote(text)


def split_names(text: str) -> list[str]:
    """Names that were given with commas between them; one with a comma stands in double quotes."""
    return ["".join(parts) for parts in _named(text)]


def quoted(names: Iterable[str]) -> str:
    """Names as `split_names` takes them, whatever is in them.

    >>> split_names(quoted(['v, "fast"', "gap"]))
    ['v, "fast"', 'gap']
    """
    return ",".join('"' + name.replace('"', '""') + '"' for name in names)


def _named(text: str) -> list[tuple[str, str]]:
    """What stands between commas: a name in quotes, if there is one, and the rest."""
    from evofsm.io.tables import quoted_name

    parts = re.findall(r'(?:"(?:[^"]|"")*"(?=\s*(?:[,=]|$))|[^,])+', text)
    return [quoted_name(part.strip()) for part in parts if part.strip()]


def reading_of(
    observe: Annotated[
        str, option("Columns to observe; a discrete one with its values: light=red/green.")
    ] = "gap,v_follower,v_leader",
    action: Annotated[
        str, option("Column of the action taken from a row to the next; '': nobody acts.")
    ] = "a_follower",
    time: Annotated[
        str, option("Column of the time: seconds or dates; of date and time of day: Datum,Uhrzeit.")
    ] = "time",
    episode: Annotated[
        str | None,
        option("Columns that tell episodes apart; '': none. [default: run,pair,segment,episode]"),
    ] = None,
    dt: Annotated[float | None, option("From a row to the next [s], without a clock.")] = None,
    failed: Annotated[
        str | None,
        option("What failed: a column of truth values, 'gap<=0', \"Status=='off'\"; with and, or."),
    ] = None,
    unit: Annotated[
        list[str] | None,
        option("Of a column, or all that begin so: v=km/h; of dates 'time=%m/%d/%Y %H:%M'."),
    ] = None,
    topics: Annotated[
        Path | None, option("TOML: which field of which topic of a bag is which variable.")
    ] = None,
    no_leader: Annotated[
        str | None,
        option("Rows left out, which end episodes: 'end', where a number is missing; 'leader==0'."),
    ] = None,
    hold: Annotated[
        float | None,
        option("Signals of several clocks: an empty field keeps its value so long [s].", min=0.0),
    ] = None,
    skip_bad: Annotated[
        int, option("Bad rows of a file that are left out, and said; more are refused.", min=0)
    ] = 10,  # as `evofsm.io.logs.SKIPPED`, without what that loads
    vehicle_length: Annotated[
        list[str] | None,
        option("FCD: length [m] of vehicles or of a type, and width: truck=12, bike=1.6x0.65."),
    ] = None,
    where: Annotated[
        str | None,
        option("Rows that count, such as 'Speed>100'; others are left out, and end episodes."),
    ] = None,
    resample: Annotated[
        str | None,
        option("Rows of so long become their mean, or another: 30s,Speed=last,Vibration=max."),
    ] = None,
    hole: Annotated[
        str | None,
        option("Up to so long a hole in time costs one transition, and no episode: 10min."),
    ] = None,
) -> LogColumns:
    """How a log is read, from the options of those names."""
    from evofsm.driving.naming import VARIABLES
    from evofsm.fsm.observations import Category, ObservationEncoder
    from evofsm.fsm.validation import positive
    from evofsm.io import LogColumns, Topics
    from evofsm.io.tables import quoted_name

    for name, value in {"--hold": hold, "--resample": resample, "--hole": hole}.items():
        if value is not None and dt is not None:
            raise ValueError(f"{name} goes by a clock, and --dt stands in for one; give one")

    def variable(told: str, rest: str) -> str | Category:
        name, discrete, values = rest.partition("=")
        name = told or name
        return Category(name, values.split("/")) if discrete else name

    try:
        variables = [variable(*parts) for parts in _named(observe)]
        if sorted(split_names(observe)) == sorted(VARIABLES):  # in whatever order they are named
            variables = [*VARIABLES]
        encoder = ObservationEncoder(*variables)
    except ValueError as error:
        about = f"--observe {observe}" if observe else "neither --observe nor names= of a guard"
        raise ValueError(f"{about}: {error}") from None
    return LogColumns(
        observe=encoder,
        action="".join(quoted_name(action)) or encoder.names[0],
        time=",".join(split_names(time)),
        episode=None if episode is None else split_names(episode),
        dt=None if dt is None else positive("--dt", dt),
        failed=failed,
        units=units_given(unit or ()),
        no_leader=no_leader,
        hold=hold,
        skip_bad=skip_bad,
        where=where,
        resample=None if resample is None else _resampled(resample, encoder, action),
        hole=None if hole is None else seconds("--hole", hole),
        lengths=lengths_given(vehicle_length or ()),
        topics=None if topics is None else Topics.load(topics),
        acts=action != "",
    )


def read_with(learnt: Path | None) -> tuple[dict[str, Any], dict[str, str]]:
    """The options with which the log was read that a file is learnt from, and units in it."""
    from evofsm.store import read_header

    if learnt is None or not learnt.is_file():
        return {}, {}
    provenance = read_header(learnt).provenance
    return dict(provenance.get("read with", {})), dict(provenance.get("units", {}))


def typed(given: Mapping[str, Any]) -> str:
    """The same, as they are typed."""
    several = ((k, v if isinstance(v, list) else [v]) for k, v in given.items())
    return " ".join(f"--{k.replace('_', '-')} {quote(str(v))}" for k, vs in several for v in vs)


def duration(text: str) -> float:
    """How long an option says it is [s], or 0."""
    try:
        return 0.0 if text in (0.0, "0") else seconds("it", str(text))
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None


Horizon = Annotated[
    float | None,
    option(
        "Where nobody acts: an alarm is right if a failure comes within this [s], or 4h. "
        "[default: 5 % of an episode]",
        parser=duration,
    ),
]
Persist = Annotated[
    float, option("Where nobody acts: how long a limit is passed [s], or 5min.", parser=duration)
]

FalseADay = Annotated[
    float | None,
    option("Where nobody acts: false alarms a day that are stated. [default: 0.3]", min=0.0),
]

#: What is said of alarms: --horizon, --persist and --false-a-day.
Alarms = tuple[float | None, float, float | None]


def refuse_other_limit(acts: bool, alarms: Alarms, tolerance: float | None) -> None:
    """Raise if what is said of alarms is said of somebody's actions, or the other way round."""
    for name, value in zip(("horizon", "persist", "false-a-day"), alarms, strict=True):
        if acts and value != {"persist": 0.0}.get(name):
            raise ValueError(f"--{name} is of alarms where nobody acts: --action ''")
    if not acts and tolerance is not None:
        raise ValueError("--tolerance is of actions; where nobody acts, --false-a-day counts")


def seconds(name: str, text: str) -> float:
    """How long a text says it is [s]: ``10min``, or ``0.5``."""
    from evofsm.fsm.validation import positive
    from evofsm.io.tables import TIMES

    match = re.fullmatch(r"\s*([0-9.]+)\s*([a-z]*)\s*", text)
    number, unit = match.groups() if match else ("", "")
    with suppress(ValueError, KeyError):
        return positive(name, float(number)) * TIMES[unit or "s"]
    raise ValueError(f"{name} is {text!r}; write how long, such as 30s, 10min or 1h")


def _resampled(text: str, encoder: ObservationEncoder, action: str) -> Resample:
    from evofsm.io.logs import BECOME, Resample

    step, *ways = _named(text) or [("", "")]
    how = {}
    for parts in ways:
        name, _, become = "".join(parts).rpartition("=")
        if name not in (*encoder.variables, action) or become not in BECOME:
            may = f"NAME=HOW with one of {', '.join(BECOME)}, of a number that is read"
            raise ValueError(f"--resample is {text!r}; write 30s, or 30s and behind commas {may}")
        how[name] = become
    return Resample(seconds("--resample", "".join(step)), how)


def reads_logs(command: Callable[..., Any]) -> Callable[..., Any]:
    """A command that has the options of `reading_of`, but for its own, in place of ``reading``.

    It is given those that were typed, by the names of these parameters.
    """
    parameters = signature(command, eval_str=True).parameters
    later = {"LogColumns": Any}  # which takes long to load
    options = signature(reading_of, eval_str=True, locals=later).parameters
    log_options = {name: parameter for name, parameter in options.items() if name not in parameters}

    @wraps(command)
    def run(**given: Any) -> Any:
        pairs = ((name, given.pop(name)) for name in log_options)
        choices = {name: v for name, v in pairs if v not in (log_options[name].default, [])}
        return command(**given, reading=choices)

    all_parameters = list[Parameter]()
    for parameter in parameters.values():
        all_parameters += log_options.values() if parameter.name == "reading" else [parameter]
    all_parameters = [p.replace(kind=Parameter.KEYWORD_ONLY) for p in all_parameters]
    run.__dict__["__signature__"] = Signature(all_parameters)
    run.__annotations__ = {p.name: p.annotation for p in all_parameters}
    return run


def refuse_typed(context: typer.Context, names: Iterable[str], kind: str) -> None:
    """Raise if options were typed that hold for something of another kind only."""
    sources = {f"--{name.replace('_', '-')}": context.get_parameter_source(name) for name in names}
    if excess := [name for name, source in sources.items() if "COMMANDLINE" in str(source)]:
        raise ValueError(f"{', '.join(excess)}: only for {kind}")


def units_given(texts: Iterable[str]) -> dict[str, str]:
    """Units by the column, or the beginning of columns, from what --unit was given."""
    from evofsm.io.tables import UNITS, quoted_name, unit_of

    units: dict[str, str] = {}
    for text in texts:
        name, _, unit = ("".join(quoted_name(part.strip())) for part in text.rpartition("="))
        unit = unit if "%" in unit else unit_of(unit)
        if not (name and (unit in UNITS or "%" in unit)):
            raise ValueError(f"--unit is {text!r}; write NAME=UNIT with one of {', '.join(UNITS)}")
        units[name] = unit
    return units


def lengths_given(texts: Iterable[str]) -> VehicleLengths:
    """Lengths of vehicles, and widths, from texts such as ``5.0``, ``truck=12`` and ``5x1.8``."""
    from evofsm.fsm.validation import positive
    from evofsm.io import VehicleLengths

    lengths = VehicleLengths()
    for text in texts:
        kind, _, size = text.rpartition("=")
        try:
            length, *width = (positive("it", float(number)) for number in size.split("x", 1))
        except ValueError:
            raise ValueError(
                f"--vehicle-length is {text!r}; write a positive length such as 5.0, or "
                "truck=12 for one type, or 5.0x1.8 with a width"
            ) from None
        lengths.lengths[kind] = length
        if width:
            lengths.widths[kind] = width[0]
    return lengths

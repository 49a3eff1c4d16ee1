"""`evofsm learn` and `evofsm inspect`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from evofsm.cli.commands.common import progress, split_names
from evofsm.cli.commands.declared import argument, option, settings
from evofsm.cli.commands.groups import WithJson
from evofsm.cli.show import print_json, say

if TYPE_CHECKING:
    from rich.progress import Progress

    from evofsm.cli.learning import Learning
    from evofsm.fleet.checkpoint import Checkpoint
    from evofsm.fsm import Category, EvolvingFSM, IntervalActions
    from evofsm.io.logs import Chunk, LogColumns, Noted
    from evofsm.io.vehicles import VehicleLengths


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


@dataclass(frozen=True, kw_only=True)
class Learn(WithJson):
    """Learn a machine from logs of your own, of any size, row by row.

    A log holds a row per time step. A step longer than 1.5 times the usual one (the median in the
    first rows of a file) is a hole in time: it begins a new episode.

    In FCD output of SUMO, a vehicle and the next one ahead of it on the same lane are a pair (a
    leader beyond the end of the lane is not seen). A pair is observed by gap (bumper to bumper),
    v_follower and v_leader; its action a_follower is what the follower did until the next time
    step. SUMO rounds to 2 decimals unless told --precision 6. So are tables of objects (id, t, x,
    y, vx, vy, length, lane) and traces of ASAM OSI read.

    Of a bag of ROS 2, --topics says which field of which topic is which variable.

    The time may be seconds, or dates of ISO 8601. Without --failed a log tells nothing of failures,
    and evofsm inspect --at says so.

    With --checkpoint, the same command goes on where it was stopped, whatever stopped it, and comes
    to the same result. The file is kept at the end: run again, the command prints it at once.
    """

    files: tuple[str, ...] = argument(
        "Logs or tables of objects (CSV, Parquet), FCD output of SUMO (XML, CSV, Parquet), traces "
        "of ASAM OSI (.osi, MCAP), bags of ROS 2 (folder, MCAP, db3).",
        is_setting=False,  # a checkpoint tells files apart by what is in them
    )
    observe: str = option(
        "gap,v_follower,v_leader",
        "Columns to observe. A discrete one is written with its values: light=red/green.",
    )
    action: str = option("a_follower", "Column of the action taken from a row to the next.")
    action_range: str = option(
        "-2.5:2.5:0.3",
        "Intervals of the action, LOW:HIGH:WIDTH. What lies beyond goes into the end intervals and "
        "is counted.",
    )
    time: str = option("time", "Column of the time, in seconds.")
    episode: str | None = option(
        None,
        "An episode begins where one of these columns changes, and in each file; none of them: ''. "
        "[default: those of run,pair,segment that exist]",
    )
    dt: float | None = option(None, "Seconds from a row to the next, for a log without a clock.")
    failed: str | None = option(
        None,
        "What tells of failures: a column of truth values (0 and 1, true and false), or a "
        "comparison such as 'gap<=0'. The row with which it becomes true ends the episode in "
        "failure; rows in which it stays so are left out. Compared after --unit.",
    )
    unit: tuple[str, ...] | None = option(
        None,
        "Unit of a column, or of all read that begin so: v=km/h, time=ms. May be repeated. Learnt "
        "are s, m, m/s, m/s².",
    )
    topics: Path | None = option(
        None,
        "File in TOML that says which field of which topic of a bag is which variable.",
        is_setting=False,  # what is in it is one
    )
    no_leader: NoLeader = option(
        NoLeader.REFUSE,
        "A row in which an observed number is missing (empty, NaN, infinite), as where there is no "
        "leader: refuse the log, or end the episode there and leave the row out.",
    )
    vehicle_length: tuple[str, ...] | None = option(
        None,
        "FCD: length of vehicles in metres, or of a type: truck=12. May be repeated. "
        "[default: 5.0]",
    )
    category_distance: float = option(1.0, "How far apart the values of a discrete column count.")
    rule: RuleName = option(
        RuleName.PAPER,
        "How states are made. The paper's is the default, for the paper specifies it and earlier "
        "results were learnt with it; edges: with states at edges too; novelty: one wherever "
        "nothing like it was seen, recommended for logs (docs/logs.md says why); failure: as "
        "novelty, and at failures (--failed).",
    )
    radius: float | None = option(
        None,
        "The paper's ε, which parts states; of novelty, in --scale. [default: 0.3; of novelty and "
        "failure 1.0]",
    )
    scale: tuple[str, ...] | None = option(
        None,
        "Novelty and failure: the difference that counts as 1, by the column, such as gap=4. May "
        "be repeated. [default: gap=4, v_follower=2, v_leader=2; of a discrete column 1]",
    )
    max_states: int | None = option(
        None,
        "Where there are so many states, two are merged for each new one. [default: no limit]",
    )
    distance_weight: float = option(0.85, "The paper's ρ, how fast distance lowers potential.")
    learning_rate: float = option(0.01, "The paper's φ, the weight of the newest transition.")
    prior_frequency: float = option(1e-3, "The paper's ε̄, the frequency of transitions never seen.")
    spread: float | None = option(
        None,
        "Width of recognition; smaller is sharper. [default: 3.0; of novelty and failure 1.0]",
    )
    out: Path | None = option(None, "File to save the model to.", is_setting=False)
    checkpoint: Path | None = option(
        None,
        "Keep what was learnt so far in this file; where it exists, go on from it.",
        is_setting=False,
    )
    every: str = option(
        "60s",
        "Time between two checkpoints: 10s, 5m; 0s for as often as it can.",
        is_setting=False,
    )

    def run(self) -> None:
        """Learn, save and print."""
        from evofsm.cli.learning import learn_traces
        from evofsm.cli.text.learning import learning_document, print_learning
        from evofsm.driving import UNITS, VARIABLES
        from evofsm.fleet.checkpoint import Checkpoint, duration, fingerprints, result_kept
        from evofsm.io.logs import Noted, read_traces
        from evofsm.io.rosbag import Topics
        from evofsm.io.vehicles import VehicleLengths

        _check_out(self.out)
        interval = duration(self.every)
        actions, columns = self._actions(), self._columns()
        lengths, noted = VehicleLengths.parse(self.vehicle_length or ()), Noted()
        machine = self._machine(actions.n_actions, columns)
        names = columns.observe.names
        topics = None if self.topics is None else Topics.load(self.topics)
        known = fingerprints(self.files)
        keeper = None
        if self.checkpoint is not None:
            _check_apart(self.checkpoint, self.out, self.files)
            resolved = {"radius": self._radius, "spread": self._spread, "files": known}
            resolved |= {} if topics is None else {"topics": repr(topics)}
            keeper = Checkpoint(self.checkpoint, settings(self) | resolved, interval)
        with progress() as bars:
            on_read = _bytes_read(bars, self.files)
            chunks = read_traces(self.files, columns, lengths, on_read, noted, topics)
            learning = learn_traces(
                _noting(chunks, lengths, noted, keeper),
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
            "action": self.action,
            **(
                {"failed": self.failed, "failures": learning.failures}
                if self.failed is not None
                else {}
            ),
            **({"units converted": ", ".join(self.unit)} if self.unit is not None else {}),
        }
        if keeper is not None and "noted" in keeper.notes:  # in the run that read the files
            noted = Noted(**keeper.notes["noted"])
        warnings = noted.warnings(self.time)
        for warning in warnings:
            print(f"evofsm: warning: {warning}", file=sys.stderr)
        if self.out is not None:
            with result_kept(keeper):
                learning.model.save(self.out, provenance)
        if self.as_json:
            document = learning_document(learning)
            document["model"]["provenance"] = provenance
            apart = {"noted": asdict(noted), "warnings": warnings}
            saved = self.out and str(self.out)
            print_json({"files": self.files, "saved": saved, **document, **apart})
            return
        print_learning(
            learning,
            action=self.action,
            lengths=_assumed(lengths, keeper),
            further=_read_otherwise(noted, self.failed, learning),
        )
        say("")
        if self.out is None:
            say("Nothing was saved; --out MODEL keeps the model.")
        else:
            say(f"Saved to {self.out}. Look at it again: evofsm inspect {self.out}")

    @property
    def _has_novelty(self) -> bool:
        return self.rule in (RuleName.NOVELTY, RuleName.FAILURE)

    @property
    def _radius(self) -> float:
        usual = 1.0 if self._has_novelty else 0.3
        return usual if self.radius is None else self.radius

    @property
    def _spread(self) -> float:
        usual = 1.0 if self._has_novelty else 3.0
        return usual if self.spread is None else self.spread

    def _actions(self) -> IntervalActions:
        from evofsm.fsm import IntervalActions

        text = self.action_range
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

    def _columns(self) -> LogColumns:
        from evofsm.fsm import ObservationEncoder, positive
        from evofsm.io.logs import LogColumns, parse_units

        try:
            names = split_names(self.observe)
            encoder = ObservationEncoder(*(_variable(one, self.category_distance) for one in names))
        except ValueError as error:
            raise ValueError(f"--observe {self.observe}: {error}") from None
        return LogColumns(
            observe=encoder,
            action=self.action,
            time=self.time,
            episode=None if self.episode is None else split_names(self.episode),
            dt=None if self.dt is None else positive("--dt", self.dt),
            failed=self.failed,
            units=parse_units(self.unit or ()),
            leader_may_lack=self.no_leader is NoLeader.END,
        )

    def _machine(self, n_actions: int, columns: LogColumns) -> EvolvingFSM:
        from evofsm.fsm import Edges, EvolvingFSM, FailureSplit, Novelty

        if self.rule is RuleName.FAILURE and self.failed is None:
            raise ValueError(
                "--rule failure makes states at failures; --failed has to tell of them"
            )
        if self.scale and not self._has_novelty:
            raise ValueError(f"--scale is for --rule novelty or failure, not {self.rule.value}")
        given: dict[str, Any] = {
            "distance_weight": self.distance_weight,
            "learning_rate": self.learning_rate,
            "prior_frequency": self.prior_frequency,
            "max_states": self.max_states,
        }
        if self._has_novelty:
            novelty = Novelty(self._radius, self._scales(columns), self._spread)
            has_failures = self.rule is RuleName.FAILURE
            given["rule"] = FailureSplit(novelty) if has_failures else novelty
        else:
            given |= {"radius": self._radius, "spread": self._spread}
            if self.rule is RuleName.EDGES:
                given["rule"] = Edges()
        return EvolvingFSM(n_actions, **given)

    def _scales(self, columns: LogColumns) -> list[float]:
        """The difference that counts as 1, for each number that is observed."""
        from evofsm.driving import VARIABLES
        from evofsm.fsm import positive

        told = {}
        for text in self.scale or ():
            column, _, number = text.rpartition("=")
            try:
                told[column] = positive("it", float(number))
            except ValueError:
                raise ValueError(
                    f"--scale is {text!r}; write COLUMN=NUMBER, such as gap=4"
                ) from None
        single = [one for one in columns.observe.variables if isinstance(one, str)]
        if unknown := [column for column in told if column not in single]:
            raise ValueError(f"--scale names {unknown[0]!r}; observed are {', '.join(single)}")
        told = dict(zip(VARIABLES, _SCALES, strict=True)) | told
        if lacking := [column for column in single if column not in told]:
            raise ValueError(
                f"--rule {self.rule.value} has to know the difference that counts as 1 in "
                f"{lacking[0]!r}: --scale {lacking[0]}=2 (4 m of a gap and 2 m/s of a speed are "
                "usual)"
            )
        return [told.get(name, 1.0) for name in columns.observe.names]


# -- What was asked for ---------------------------------------------------------------------------


def _check_out(out: Path | None) -> None:
    """Refuse before the long work what could not be saved after it."""
    from evofsm import store

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
            store.read_header(out)
        except (ValueError, OSError):
            raise ValueError(
                f"--out {out}: exists and is no file of evofsm; it was left alone"
            ) from None


def _check_apart(checkpoint: Path, out: Path | None, files: Sequence[str]) -> None:
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


def _variable(text: str, distance: float) -> str | Category:
    from evofsm.fsm import Category

    name, discrete, values = text.partition("=")
    return Category(name, values.split("/"), distance) if discrete else text


def _bytes_read(bars: Progress, files: Sequence[str]) -> Callable[[int], None]:
    """A bar that grows with the bytes read of some files."""
    within = (
        entry.path for file in files for entry in (os.scandir(file) if os.path.isdir(file) else ())
    )
    task = bars.add_task("Learning", total=sum(map(os.path.getsize, [*files, *within])))
    return lambda count: bars.advance(task, count)

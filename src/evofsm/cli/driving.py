"""Drive a family of scenarios, in turn or many episodes at once; or a configuration of SUMO."""

from __future__ import annotations

import csv
import io
import math
import os
import re
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from multiprocessing import get_context, parent_process
from pathlib import Path
from threading import Thread
from typing import Any

from evofsm import driving, store
from evofsm.cli.journal import Journal, asked_to_stop
from evofsm.cli.options import refuse_foreign, split_names
from evofsm.cli.show import Advance, plain, print_json, progress, show, table, warn
from evofsm.driving.cars import TOLD, name_judge
from evofsm.driving.naming import DECISION_COLUMNS
from evofsm.driving.sumo import open_world
from evofsm.driving.trials import Row
from evofsm.driving.world import World
from evofsm.extras import needs
from evofsm.fsm.validation import counted
from evofsm.guard import TOLERANCE, AuditLog, DecisionLogger, Guard, Mode

#: The columns of ``decisions.parquet`` after ``episode``; `driving/naming.py` says which they are.
DECISION_TABLE = tuple(name for name, column in DECISION_COLUMNS.items() if column.in_table)
GUARD = "guard.evofsm"  #: the guard in a folder of results

_JOURNAL, _DECISIONS, _EPISODES = "episodes.jsonl", "decisions.parquet", "episodes.csv"
_EVERY = 60.0  # the guard is saved so often while it learns [s]
_BATCH = 20  # so many episodes are one task of a worker: some 500 ms

Outcomes = dict[str, Any]


@dataclass(frozen=True)
class Setup:
    """What is asked for."""

    family: driving.Family
    reviser: str = "least-risk"
    judge: str = "kinematic"
    mode: Mode = Mode.ACT
    tolerance: float = TOLERANCE
    seed: int = 0
    world: str = "kinematic"
    learn: bool = True
    digest: str = ""  #: of the guard that learnt before

    @property
    def settings(self) -> dict[str, Any]:
        """All that an episode depends on, for JSON."""
        family, source = self.family, self.family.source
        settings = {**vars(self), "family": family.name, "switches": family.switches}
        file = source and Path(source).read_text("utf-8")
        return {**settings, "mode": self.mode.value, "file": file}

    def drive(self, guard: Guard, world: World, number: int) -> tuple[driving.Episode, Outcomes]:
        """An episode, of a training draw while it learns, of a held-out one else; and its row."""
        draw = self.family.draw(self.seed, number, "train" if self.learn else "test")
        alone = driving.reference_of(self.family, draw, world)
        episode = driving.drive(guard, draw, world)
        outcome = driving.outcome_of(episode, alone)
        return episode, {"episode": number, "variant": draw.variant, **outcome._asdict()}


def load_guard(folder: Path) -> tuple[Guard, int]:
    """What a folder of results holds, and from how many episodes it has learnt."""
    n_learnt = store.read_header(folder / GUARD).provenance.get("episodes", 0)
    return Guard.load(folder / GUARD), int(n_learnt)


def make_guard(setup: Setup, before: Guard | None = None) -> Guard:
    """A guard whose reviser and judge have the setup's names, with what was learnt before."""
    family = setup.family
    machine, judge = (None, None) if before is None else driving.learners_of(before)
    if judge is not None and (kind := name_judge(judge)) != setup.judge:
        raise ValueError(f"what was learnt is of the judge {kind!r}, not of {setup.judge!r}")
    guard = driving.guard_for_family(
        family,
        tolerance=setup.tolerance,
        mode=setup.mode,
        machine=machine,
        judge=judge or setup.judge,
        seed=setup.seed,
        learn=setup.learn,
    )
    if setup.reviser == "least-risk":
        return guard
    learners: dict[str, Any] = {"machine": guard.machine, "judge": guard.judge}
    reviser = driving.Unrevised(family.actions)
    return Guard.of(reviser, interval=family.interval, learn=setup.learn, **learners)


# -- What has been driven so far ------------------------------------------------------------------


class Results:
    """Rows of episodes, in a folder if there is one. Close it after use."""

    def __init__(self, setup: Setup, guard: Guard, folder: Path | None = None) -> None:
        self.setup = setup
        self.folder = folder
        self.guard = guard  #: as the guard is after all `rows`, where it learns
        self.rows: dict[int, Outcomes] = {}
        self._journal: Journal | None = None
        self._saved = time.monotonic()
        if folder is not None:
            self._begin(folder)

    def _begin(self, folder: Path) -> None:
        setup = self.setup
        journal = folder / _JOURNAL  # a foreign one says so itself
        if not (journal.is_file() and journal.stat().st_size):
            refuse_foreign({folder / name: None for name in (GUARD, _EPISODES, _DECISIONS)})
        folder.mkdir(parents=True, exist_ok=True)
        self._journal = Journal(journal, "name another folder")
        try:
            self._journal.go_on(setup.settings, "run it with those, or name another folder")
            self.rows = {int(row["episode"]): row for row in self._journal.records}
            if setup.learn and self.rows:
                n_learnt = 0
                if (folder / GUARD).exists():
                    guard, n_learnt = load_guard(folder)
                    self.guard = make_guard(setup, guard)
                if later := self.rows.keys() - range(n_learnt):  # came after what was learnt
                    self.rows = {n: row for n, row in self.rows.items() if n not in later}
                    self._journal.begin_anew(setup.settings, *self.rows.values())
        except BaseException:
            self._journal.close()
            raise

    def add(self, row: Outcomes) -> None:
        """Take in what came of an episode."""
        self.rows[row["episode"]] = row
        if self._journal is not None:
            self._journal.append(row)

    def save_guard(self, *, now: bool = False) -> None:
        """Write what was learnt from all rows, if it was not for a while."""
        if self.folder is None or not (now or time.monotonic() - self._saved >= _EVERY):
            return
        setup = self.setup
        provenance = {"family": setup.family.name, "seed": setup.seed, "reviser": setup.reviser}
        learnt_from = {"episodes": len(self.rows)} if setup.learn else {}
        try:
            self.guard.save(self.folder / GUARD, {**provenance, **learnt_from})
        except OSError as error:
            error.add_note("what was saved is kept: make room, and run the same command again")
            raise
        self._saved = time.monotonic()

    def summed_up(self, episodes: int) -> Row:
        """What came of so many episodes; written to the folder, if there is one."""
        setup, rows = self.setup, [self.rows[number] for number in range(episodes)]
        outcomes = [
            driving.Outcome(*(row[name] for name in driving.Outcome._fields)) for row in rows
        ]
        row = driving.summarise(setup.family.name, setup.reviser, outcomes, setup.family.interval)
        if self.folder is not None:
            self._write(self.folder, rows)
        return row

    def _write(self, folder: Path, rows: Sequence[Outcomes]) -> None:
        self.save_guard(now=True)
        names = ["episode", "variant", *driving.Outcome._fields]
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerows([names, *([row[name] for name in names] for row in rows)])
        with store.replacing(folder / _EPISODES) as file:
            file.write(text.getvalue().encode())
        if all("decided" in row for row in rows):
            _write_decisions(folder / _DECISIONS, rows)
        else:  # workers send none
            (folder / _DECISIONS).unlink(missing_ok=True)

    def close(self) -> None:
        """Let others drive into the folder."""
        if self._journal is not None:
            self._journal.close()


def _write_decisions(path: Path, rows: Sequence[Outcomes]) -> None:
    with needs("polars", "tables", "writing decisions as Parquet"):
        import polars
    kinds = {name: polars.List(DECISION_COLUMNS[name].kind) for name in DECISION_TABLE}
    records = [{"episode": row["episode"], **row["decided"]} for row in rows]
    table = polars.DataFrame(records, {"episode": polars.Int64, **kinds}).explode(*kinds)
    table = table.with_columns(polars.selectors.float().fill_null(math.nan))  # as JSON has none
    with store.replacing(path) as file:
        table.write_parquet(file)


def _decided(driven: driving.Episode) -> dict[str, list[Any]]:
    columns = {name: DECISION_COLUMNS[name].read for name in DECISION_TABLE}
    return {name: [read(d) for d in driven.decisions] for name, read in columns.items()}


def log_of(audit: Path | None, mcap: Path | None) -> AbstractContextManager[Any]:
    """What records the decisions; None where nobody wants them."""
    if mcap is not None:
        from evofsm.io import FoxgloveSink

        return FoxgloveSink(None, mcap)
    return AuditLog(audit) if audit else nullcontext()


def drive_in_turn(
    results: Results,
    episodes: int,
    move: Advance = lambda *_, **__: None,
    audit: DecisionLogger | None = None,
) -> Row:
    """Drive those episodes that the results lack, one after the other.

    Who asks it to stop waits for an episode's end, where the guard is saved; for a log after each.
    """
    setup, guard, n_episodes = results.setup, results.guard, len(results.rows)
    if setup.learn and n_episodes > episodes:
        raise ValueError(f"{results.folder} has driven {n_episodes} episodes, more than {episodes}")
    guard.audit, world, signals = audit, open_world(setup.world), list[int]()

    def note(number: int, _: object) -> None:
        signals.append(number)
        if len(signals) > 1:  # a second one stops it at once
            raise SystemExit(128 + number)

    with asked_to_stop(note):
        for number in range(episodes):
            if number in results.rows:
                continue
            episode, row = setup.drive(guard, world, number)
            results.add({**row, "decided": plain(_decided(episode))})
            is_over = bool(signals)
            if setup.learn:
                results.save_guard(now=is_over or audit is not None)
            move(len(results.rows))
            if is_over:
                raise KeyboardInterrupt
        return results.summed_up(episodes)


def drive_at_once(
    results: Results, episodes: int, workers: int, move: Advance = lambda *_, **__: None
) -> Row:
    """Drive those held-out episodes that the results lack; who drives them makes no odds."""
    guard = results.guard.copy(states=False)  # what is decided does not depend on them
    guard.freeze()
    numbers = [number for number in range(episodes) if number not in results.rows]
    size = max(1, min(_BATCH, len(numbers) // (8 * workers)))
    move(len(results.rows))
    # Forking a process that has started threads may hang; a fresh one costs a second.
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _begin_work)
    try:
        row_of = partial(_row, results.setup, guard)
        for row in pool.map(row_of, numbers, chunksize=size):
            results.add(row)
            move(len(results.rows))
        return results.summed_up(episodes)
    except BrokenExecutor:
        fault = "a worker died (out of memory? fewer --workers need less)"
        hint = "with --out what was driven is kept, and the same command goes on from there"
        raise ChildProcessError(f"{fault}; {hint}") from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _row(setup: Setup, guard: Guard, number: int) -> Outcomes:
    return setup.drive(guard, open_world(setup.world), number)[1]


def _begin_work() -> None:
    """In a worker: Ctrl-C is left to the parent, and no worker outlives it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    Thread(target=end_with_parent, daemon=True).start()


def told_of(row: Row, results: Results) -> Iterator[tuple[str, str]]:
    """Collisions and their price, and what was learnt."""
    setup = results.setup
    kind = "training" if setup.learn else "held-out"
    yield "family", f"{row.family}, {counted(row.episodes, f'{kind} episode')}"
    yield "reviser", f"{setup.reviser}, {setup.mode.value}"
    yield "judge", f"{setup.judge}, given {TOLD[setup.judge]}"
    interval = f"(95 %, two-sided: {row.collision_low:.1%} to {row.collision_high:.1%})"
    share = f"{row.collisions:,} of {row.episodes:,}: {row.collision_rate:.1%}"
    yield "collisions", f"{share} {interval}"
    yield "rate", str(row.failures)
    if row.rear_ends:
        yield "rear-ended", f"{row.rear_ends}"
    yield "mobility", f"{row.mobility:.2f} of the way that the controller makes by itself"
    interventions = f"{row.intervention_rate:.1%} of decisions"
    yield "interventions", f"{interventions}; mean change {row.mean_change:.2f} m/s²"
    yield "comfort", f"RMS jerk {row.jerk:.2f} m/s³"
    machine, judge = driving.learners_of(results.guard)
    states = f"{machine.n_states} states"
    if isinstance(judge, driving.LatentRisk):
        states += f", {len(driving.dead_ends_of(machine, judge))} of them dead ends"
    experience = getattr(judge, "told_by_experience", "")
    yield "learnt", f"{states}; {experience}" if experience else states


# -- A configuration of somebody else's ----------------------------------------------------------


def run_configuration(
    file: Path, vehicles: str, mode: str, tolerance: float, *, as_json: bool
) -> None:
    """Run it to its end, or until all cars have arrived, and print `Attachment.summary` of it."""
    if mode not in ("act", "shadow"):
        raise ValueError(f"--mode is {mode!r}; for a configuration it is act or shadow")
    by_ids = not re.match(r"all$|type:|[0-9]*\.[0-9]*$|.*%$", vehicles)
    choice = split_names(vehicles) if by_ids else vehicles

    def driven(how: str) -> dict[str, Any]:
        prefix = ("--output-prefix", "alone.") if how == "watch" else ()
        with progress("Driving") as move, _running(file, *prefix) as (sumo, steps):
            if prefix and str(sumo.simulation.getOption("random")).lower() in ("true", "1"):
                warn("--random: alone and guarded draw other numbers; name a seed to compare them")
            cars = driving.attach(sumo, choice, mode=how, tolerance=tolerance)
            begin, kinds = float(sumo.simulation.getTime()), dict[str, str]()
            for seconds in steps:
                for car in sorted({*sumo.vehicle.getIDList()}.difference(kinds)):
                    kinds[car] = sumo.vehicle.getTypeID(car).partition("@")[0]
                if seconds == int(seconds):
                    move(description=f"{how}: {seconds:,.0f} s, {len(cars.collisions)} collisions")
            seconds = sumo.simulation.getTime() - begin
            cars.detach()  # else they guard what is simulated next
        if not cars.ever:
            types, ids = (", ".join(names[:9]) for names in (sorted({*kinds.values()}), [*kinds]))
            fault = f"it takes none of {len(kinds):,} cars in {seconds:,.0f} s"
            hint = f"a larger share takes more, types are {types}, ids {ids}"
            raise ValueError(f"--vehicles {vehicles}: {fault}, so nothing was guarded; {hint}")
        if how == mode and by_ids and (absent := sorted({*choice} - cars.ever)):
            warn(f"--vehicles: never came: {', '.join(absent)}")
        return {"seconds": seconds, **cars.summary()}

    alone = driven("watch") if mode == "act" else None
    outcome = driven(mode)
    if as_json:
        settings = {"configuration": str(file), "vehicles": vehicles, "mode": mode}
        print_json({**settings, **outcome, "alone": alone})
        return
    runs = (outcome,) if alone is None else (alone, outcome)
    rows = [(name, *(_told(came, *how) for came in runs)) for name, how in _TOLD.items()]
    rows = [row for row in rows if any(row[1:])]
    header = ("", "in shadow") if alone is None else ("", "alone", "guarded")
    show(table(f"What came of {outcome['seconds']:,.0f} s", header, rows))


# What is told of a simulation, by what it is called, and how; a share is one of the decisions.
_TOLD = {
    "cars chosen": ("cars", ","),
    "collisions": ("collisions", ","),
    "  by chosen cars": ("of_guarded", ","),
    "  into chosen cars": ("into_guarded", ","),
    "hard brakes": ("hard_brakes", ","),
    "mean speed [m/s]": ("speed", ".2f"),
    "time lost [s]": ("time_lost", ",.0f"),
    "RMS jerk [m/s³]": ("jerk", ".2f"),
    "decisions": ("decisions", ","),
    "  speed limited": ("limited", ".1%"),
    "  driving changed": ("revised", ".1%"),
    "  µs each": ("microseconds", ".0f"),
}


def _told(came: Mapping[str, Any], name: str, form: str) -> str:
    """A number as it is told; empty where it was not counted, or nobody decided."""
    number = came.get(name, math.nan)
    number = number / came.get("decisions", math.nan) if "%" in form else number
    return "" if math.isnan(number) else f"{number:{form}}"


def trace_configuration(
    file: Path, out: Path, seconds: float, enough: int
) -> tuple[float, bool, dict[str, list[float]]]:
    """Run a configuration as it is, and write where its cars were as an FCD file.

    So many seconds at most, and no more once so many positions were written. Returns how long [s],
    whether it would have gone on, and when there were collisions [s], by who was behind whom.
    """
    crashes: dict[str, list[float]] = {}
    with _running(file, "--fcd-output", str(out)) as (sumo, steps):
        start, n_positions, is_cut = float(sumo.simulation.getTime()), 0, False
        now, dt = start, float(sumo.simulation.getDeltaT())
        if str(sumo.simulation.getOption("collision.action")) == "none":
            warn(f"{file}: with --collision.action none SUMO looks for no collisions")
        for now in steps:
            for crash in sumo.simulation.getCollisions():
                # A step is written with the time at which it began.
                crashes.setdefault(f"{crash.collider} behind {crash.victim}", []).append(now - dt)
            n_positions += sumo.vehicle.getIDCount()
            if is_cut := now >= start + seconds or n_positions >= enough:
                break
        return now - start, is_cut, crashes


@contextmanager
def _running(file: Path, *options: str) -> Iterator[tuple[Any, Iterator[float]]]:
    """SUMO, and the times after each of its steps [s]."""
    if not file.is_file():
        raise FileNotFoundError(2, "no such file", str(file))
    with needs("libsumo", "sumo", "a SUMO configuration"):
        sumo: Any = import_module("libsumo")
    try:
        # With a port it would wait for a client, for ever.
        mute = "--no-step-log", "true", "--remote-port", "0"
        sumo.start(["sumo", "-c", str(file), *mute, *options])
    except sumo.TraCIException as error:
        raise ValueError(f"{file}: SUMO refuses it: {str(error).strip()}") from error

    def steps() -> Iterator[float]:
        end, calibrators = sumo.simulation.getEndTime(), sumo.calibrator.getIDList()
        while not 0.0 <= end <= sumo.simulation.getTime():
            if sumo.simulation.getMinExpectedNumber() <= 0 and not calibrators:
                return
            sumo.simulationStep()
            yield sumo.simulation.getTime()

    try:
        yield sumo, steps()
    finally:
        sumo.close()

"""Forecasts of the coming state, on drives that nothing was learnt from.

A machine learns the training episodes one after another, each row once, and ours learn beside it;
then all is frozen, and every method forecasts the same rows of the held-out episodes. Scenarios
are driven unrevised; each learning seed has its own training draws, all have the same held-out
ones. Logs are split by run into parts, and each part is held out once.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from studies.old.frame import Frame, Progress, silent
from studies.old.shim import in_order
from studies.prediction.amounts import Amounts
from studies.prediction.forecasters import (
    REFERENCES,
    Method,
    Taught,
    Together,
    Variant,
    ablate,
    compare,
)
from studies.prediction.scoring import Row, Sums, row, score
from studies.prediction.sources import (
    FAMILIES,
    LogSource,
    Pace,
    Source,
    drive,
    read,
    split_logs,
)

# More than there are test episodes in one part of the logs.
_APART = 1_000_000


@dataclass(frozen=True)
class Prediction:
    """All that was found."""

    plan: Amounts
    rows: list[Row]
    ablation: list[Row]  #: one learning seed, or one part of the runs; methods are `Variant`s
    logs: tuple[LogSource, ...] = ()

    def of(self, source: str, method: Method) -> list[Row]:
        """Rows of a method, by horizon."""
        return [one for one in self.rows if (one.source, one.method) == (source, method)]

    @property
    def sources(self) -> list[str]:
        """Names of families and of origins of logs, in their order."""
        return list(dict.fromkeys(one.source for one in self.rows))

    @property
    def frame(self) -> Frame:
        """Every row; those of the ablation say so."""
        return Frame([*self.rows, *self.ablation])


class _Scored(NamedTuple):
    """What one method got in one round; persistence and batch are those of the same states."""

    source: str
    horizon: float
    method: str
    ours: Sums
    persistence: Sums
    batch: Sums


def run_prediction(
    plan: Amounts,
    logs: Sequence[LogSource] = (),
    progress: Progress = silent,
    workers: int | None = None,
    families: Sequence[str] = FAMILIES,
) -> Prediction:
    """Let all methods forecast all sources.

    Parameters
    ----------
    plan : Amounts
    logs : sequence of LogSource
        Real drives; none if empty.
    progress, workers
        As `Study.run` takes them.
    families : sequence of str
        That are driven.
    """
    logs = tuple(_at_most(one, plan.runs) for one in logs)
    real = [
        partial(_log_task, plan, one, part)
        for one in logs
        for part in range(min(plan.parts, len(one.files)))
    ]
    driven = [
        partial(_family_task, plan, name, pace, seed)
        for pace, seeds in ((Pace.DECISIONS, plan.seeds), (Pace.STEPS, plan.fine_seeds))
        for name in families
        for seed in range(seeds)
    ]
    ablated = [partial(_ablated_family, plan, name) for name in plan.ablation if name in families]
    if plan.ablation_runs > 1:
        few = (_at_most(one, plan.ablation_runs) for one in logs)
        ablated += [partial(_ablated_logs, plan, one) for one in few]
    # The longest first, so that no core is left waiting for them at the end.
    tasks = [*real, *ablated, *driven]
    found = in_order(tasks, workers, progress)
    of_ablation = found[len(real) : len(real) + len(ablated)]
    of_rows = found[len(real) + len(ablated) :] + found[: len(real)]
    return Prediction(
        plan, list(_rows(plan, of_rows)), list(_rows(plan, of_ablation, ablation=True)), logs
    )


def _at_most(source: LogSource, most: int | None) -> LogSource:
    """At most so many runs, evenly chosen."""
    if most is None or len(source.files) <= most:
        return source
    chosen = tuple(source.files[k * len(source.files) // most] for k in range(most))
    return source._replace(files=chosen)


def _rows(
    plan: Amounts, found: Sequence[Sequence[_Scored]], *, ablation: bool = False
) -> Iterator[Row]:
    """A row for each method at each horizon of each source, in the order in which they came."""
    rounds: dict[tuple[str, float, str], list[_Scored]] = defaultdict(list)
    for one in (scored for task in found for scored in task):
        rounds[one.source, one.horizon, one.method].append(one)
    for (source, horizon, method), of_one in rounds.items():
        yield row(
            source,
            horizon,
            method,
            [one.ours for one in of_one],
            [one.persistence for one in of_one],
            [one.batch for one in of_one],
            plan.seed,
            plan.rounds,
            ablation=ablation,
        )


# -- Tasks ----------------------------------------------------------------------------------------


def _family_task(plan: Amounts, name: str, pace: Pace, learning_seed: int) -> list[_Scored]:
    return _scored(_drawn(plan, name, pace, learning_seed))


def _log_task(plan: Amounts, logs: LogSource, part: int) -> list[_Scored]:
    return _scored(_part_of(plan, logs, part))


def _ablated_family(plan: Amounts, name: str) -> list[_Scored]:
    return _scored_ablation(_drawn(plan, name, Pace.DECISIONS, 0))


def _ablated_logs(plan: Amounts, logs: LogSource) -> list[_Scored]:
    return _scored_ablation(_part_of(plan, logs, 0))


def _drawn(plan: Amounts, name: str, pace: Pace, learning_seed: int) -> Source:
    fine = pace is Pace.STEPS
    train, test = (plan.fine_train, plan.fine_test) if fine else (plan.train, plan.test)
    return drive(name, pace, plan.seed, learning_seed, train, test)


def _part_of(plan: Amounts, logs: LogSource, part: int) -> Source:
    parts = min(plan.parts, len(logs.files))
    train, test = split_logs(logs, plan.seed, part, parts)
    return read(logs, train, test, first=part * _APART)


def _scored(source: Source) -> list[_Scored]:
    """Every method beside the references in its states."""
    found = []
    for seconds, sets in compare(source).items():
        got: dict[str, Sums] = {}
        for taught, forecasters in sets:
            got |= _judge(source, taught, forecasters, seconds)
        for method in Method:
            persistence, batch = REFERENCES[method]
            found.append(
                _Scored(source.name, seconds, method, got[method], got[persistence], got[batch])
            )
    return found


def _scored_ablation(source: Source) -> list[_Scored]:
    """Every variant, in the order in which they build on each other."""
    found = []
    for seconds, sets in ablate(source).items():
        of_variant: dict[str, _Scored] = {}
        for taught, forecasters in sets:
            got = _judge(source, taught, forecasters, seconds)
            references = got.pop(Method.PERSISTENCE), got.pop(Method.BATCH)
            of_variant |= {
                name: _Scored(source.name, seconds, name, sums, *references)
                for name, sums in got.items()
            }
        found += [of_variant[name] for name in Variant]
    return found


def _judge(
    source: Source, taught: Taught, forecasters: Together, seconds: float
) -> dict[str, Sums]:
    pace = source.pace
    return score(
        forecasters,
        taught.judged(source.test),
        pace.steps(seconds),
        pace.steps(pace.every),
        source.first,
    )

"""The study: every task with every controller, judge and learning seed.

Times of decisions depend on the machine; nothing else does, nor on the number of processes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from evofsm.cli import ALL, split_names
from evofsm.fleet import in_order
from studies.old.frame import Frame, Progress, silent
from studies.systems import TASKS, lacking, make_system
from studies.systems.trial import make_judge, try_judge
from studies.tasks.amounts import Amounts
from studies.tasks.policies import trained_policies
from studies.tasks.rows import OURS, Row, row


@dataclass(frozen=True)
class Tasks:
    """All that was found."""

    plan: Amounts
    rows: list[Row]  #: of judges
    policies: list[Row]  #: of policies that were trained; see `studies.tasks.policies`
    left_out: tuple[str, ...] = ()  #: what could not be run, a sentence each

    @property
    def frame(self) -> Frame:
        """Every row, those of policies last."""
        return Frame([*self.rows, *self.policies])

    def of(self, task: str, controller: str | None = None, judge: str = "") -> list[Row]:
        """Rows of a judge on a task, of ours if none is named; of one controller, or of all."""
        judges = (judge,) if judge else OURS
        return [
            row
            for row in self.rows
            if row.task == task and row.judge in judges and controller in (None, row.controller)
        ]

    @property
    def groups(self) -> list[tuple[str, str]]:
        """Tasks with their controllers, in their order."""
        return list(dict.fromkeys((row.task, row.controller) for row in self.rows))

    def judges(self, task: str, controller: str) -> list[str]:
        """That were tried on a task with a controller, in their order."""
        mine = (task, controller)
        return list(dict.fromkeys(r.judge for r in self.rows if (r.task, r.controller) == mine))


def run_tasks(plan: Amounts, progress: Progress = silent, workers: int | None = None) -> Tasks:
    """Try all that the plan names; see `Study.run`.

    Raises
    ------
    ValueError
        If there is no such task or judge.
    TypeError
        If a class of one's own makes none.
    """
    names, left_out = _named(plan)
    if not names:
        raise ValueError(f"nothing to run: {' '.join(left_out)}")
    trials = list(_trials(plan, names, left_out))
    policies = list(trained_policies(plan)) if plan.policies and "cartpole" in names else []
    found = in_order([*trials, *policies], workers, progress)
    judged, of_policies = (
        [row for rows in some for row in rows]
        for some in (found[: len(trials)], found[len(trials) :])
    )
    return Tasks(plan, judged, of_policies, tuple(left_out))


def _named(plan: Amounts) -> tuple[list[str], list[str]]:
    """Tasks to run, and a sentence on those whose package is missing."""
    default = "" if plan.task else ALL
    wanted = plan.tasks or default
    names = list(TASKS) if wanted == ALL else split_names(wanted)
    lack = {name: lacking(name) for name in names}
    without = [name for name in names if lack[name]]
    left_out = [f"{name} is left out: {lack[name]}." for name in without]
    own = [plan.task] if plan.task else []
    named = [*own, *(name for name in names if name not in without)]
    return list(dict.fromkeys(named)), left_out


def _trials(
    plan: Amounts, names: Sequence[str], left_out: list[str]
) -> Iterator[partial[list[Row]]]:
    """A trial each, task by task, so that what is told can be drawn in their order."""
    for name in names:
        task = make_system(name)
        rivals = list(task.rivals)
        for rival in [one for one in rivals if lacking(one)]:
            rivals.remove(rival)
            left_out.append(f"{name}: the rival {rival} is left out: {lacking(rival)}.")
        own = [plan.judge] if plan.judge and plan.judge not in ("unrevised", *rivals) else []
        for judge in own:
            make_judge(judge, task)  # so that a wrong one shows at once
        train = plan.train_of(name) or task.train
        for controller in task.chosen(plan.controllers):
            one = partial(_trial, plan, name, controller)
            for judge in ("unrevised", *rivals):
                yield partial(one, judge, 0, 0)
            for seed in range(plan.seeds_of(name)):
                for judge in dict.fromkeys([*own, *task.learners]):
                    yield partial(one, judge, seed, train)


def _trial(
    plan: Amounts, name: str, controller: str, judge: str, seed: int, train: int
) -> list[Row]:
    task = make_system(name, controller)
    tried = try_judge(task, make_judge(judge, task, (), seed), seed, train, plan.test, plan.seed)
    who = (name, controller, judge, tried.told, seed)
    return [row(plan, *who, tried.learnt, tried.held_out)]

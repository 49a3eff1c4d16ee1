"""A log of any machine, played row by row beside a guard that has learnt from it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evofsm.cli.foreseen import guard_where_nobody_acts
from evofsm.cli.learning import guard_of_log, teach, warnings_of
from evofsm.cli.options import BRAKES, TOLERANCE, Reading
from evofsm.cli.show import warn
from evofsm.cli.watch.session import Logged, Session, is_failed, system_machine
from evofsm.driving.naming import VARIABLES
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.naming import Labels
from evofsm.guard import Guard
from evofsm.io.logs import Chunk, Noted, episodes_of

# Intervals of an action.
_INTERVALS = 17


def is_of_cars(reading: Reading, judge: str) -> bool:
    """Whether a log is one of a car and its leader."""
    names = reading.columns.observe.names
    is_named = names == VARIABLES or (judge == "kinematic" and len(names) == len(VARIABLES))
    return reading.acts and is_named


def watched_log(
    path: str, reading: Reading, tolerance: float | None, case: int | None = None
) -> Session:
    """The episodes of a log, those that failed first, with a guard that learnt from all of them.

    ``case`` is the number of the episode to begin with, in the log and from 1.
    """
    noted = Noted()
    every = [e for e in episodes_of(reading.traces([path], noted)) if len(e.times) > 1]
    for warning in warnings_of(noted, reading.columns):
        warn(f"warning: {warning}")
    if case is not None and not 1 <= case <= len(every):
        raise ValueError(f"episode is {case}; there are 1 to {len(every)}")
    if not any(is_failed(episode) for episode in every):
        raise ValueError(
            f"{path}: no episode failed, so there is nothing to foresee; --failed says what did"
        )
    system = Logged(path, every, reading.columns.observe.names, acts=reading.acts)
    guard = _guard_of(every, system.labels, tolerance, acts=reading.acts)
    guard.learn = False
    return Session(system, guard, case=system.places.get(case or 0, 0), on=False)


def _guard_of(
    episodes: Sequence[Chunk], labels: Labels, tolerance: float | None, *, acts: bool
) -> Guard:
    rows, dt = np.concatenate([e.observations for e in episodes]), episodes[0].dt
    starts = np.cumsum([0, *(len(e.times) for e in episodes[:-1])])
    did = np.concatenate([e.actions for e in episodes])
    known = did[np.isfinite(did)]
    low, high = (float(known.min()), float(known.max())) if acts and len(known) else (0.0, 1.0)
    high = high if high > low else low + 1.0
    actions = IntervalActions(low, high, (high - low) / (_INTERVALS if acts else 1), outside="clip")
    machine = system_machine(actions.n_actions, rows)
    if acts:
        risk = TOLERANCE if tolerance is None else tolerance
        of = actions, machine, labels.names, labels.units
        guard = guard_of_log("learnt", dt, BRAKES, risk, *of)
        teach(guard, episodes, lambda done: None)
        return guard
    ends = starts + [len(e.times) - 1 for e in episodes]
    failures = ends[[is_failed(episode) for episode in episodes]]
    machine.learn_many(rows, np.zeros(len(rows), np.int64), starts, failures)
    return guard_where_nobody_acts(episodes, labels, None, 0.0, tolerance, machine)

"""The contract of a model: a snapshot that answers, and never changes."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evofsm.checks.contracts import Contract, insist, is_distribution, refusals, same
from evofsm.checks.kinds import Make

CONTRACT = Contract()
_ARRAYS = ("centers", "potentials", "transition_matrices", "origin_frequency")


def _rows(model: Any) -> Any:
    """Observations around the centres."""
    draw = np.random.default_rng(0)
    centers = np.asarray(model.centers)
    return np.concatenate([centers, centers + draw.normal(size=centers.shape)])


def _held(model: Any) -> tuple[Any, ...]:
    return tuple(np.copy(getattr(model, name)) for name in _ARRAYS if hasattr(model, name))


def _uniform(model: Any) -> Any:
    return np.full(model.n_states, 1.0 / model.n_states)


@CONTRACT.clause()
def is_frozen(make: Make) -> None:
    """Its arrays cannot be written to."""
    model = make()
    for name in _ARRAYS:
        array = getattr(model, name, None)
        insist(
            not isinstance(array, np.ndarray) or not array.flags.writeable,
            f"{name} can be written to: whoever holds the model could change it "
            "(array.setflags(write=False))",
        )


@CONTRACT.clause()
def rows_sum_to_1(make: Make) -> None:
    """What it recognises and foresees are distributions."""
    model = make()
    insist(
        is_distribution(model.transition_matrices),
        "transition_matrices holds a row that is no distribution",
    )
    insist(
        is_distribution(model.recognise(_rows(model))),
        "recognise returns what is no distribution",
    )
    for horizon in (1, 5):
        insist(
            is_distribution(model.propagate(_uniform(model), 0, horizon)),
            f"propagate over {horizon} steps returns what is no distribution "
            "(rows from, columns to: belief @ P?)",
        )


@CONTRACT.clause()
def asking_changes_nothing(make: Make) -> None:
    """Questions leave the model and what they were asked with as they were."""
    model = make()
    rows, belief, before = _rows(model), _uniform(model), _held(model)
    given, asked = rows.copy(), belief.copy()
    first = model.recognise(given), model.propagate(asked, 0, 3)
    second = model.recognise(given), model.propagate(asked, 0, 3)
    insist(same(given, rows), "recognise changed the observations it was given")
    insist(same(asked, belief), "propagate changed the belief it was given")
    insist(same(_held(model), before), "a question changed the model")
    insist(same(first, second), "the same question is answered differently the second time")


@CONTRACT.clause()
def many_are_one_by_one(make: Make) -> None:
    """Recognising many rows is recognising each of them."""
    model = make()
    rows = _rows(model)
    together = model.recognise(rows)
    insist(
        all(same(together[k], model.recognise(row)) for k, row in enumerate(rows)),
        "recognise returns something else for a row alone than for the same row among others",
    )


@CONTRACT.clause("save", "load")
def a_file_keeps_it(make: Make) -> None:
    """What was saved and loaded returns the same."""
    model = make()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model"
        model.save(path)
        again = type(model).load(path)
    insist(same(_held(model), _held(again)), "an array is lost or changed by save and load")
    rows = _rows(model)
    insist(
        same(model.recognise(rows), again.recognise(rows)),
        "after load it recognises otherwise (is the width of recognition or the rule stored?)",
    )


@CONTRACT.clause()
def refuses_what_cannot_be(make: Make) -> None:
    """Questions that make no sense are refused, not answered."""
    for _ in refusals(_impossible(make())):
        pass


def _impossible(model: Any) -> Iterator[tuple[str, Callable[[], object]]]:
    n, m = np.shape(model.centers)
    uniform = _uniform(model)
    yield "an observation with NaN", lambda: model.recognise(np.full(m, np.nan))
    yield "an observation of one variable too many", lambda: model.recognise(np.zeros(m + 1))
    yield "a belief that sums to 2", lambda: model.propagate(2.0 * uniform, 0)
    yield "a belief of one state too many", lambda: model.propagate(np.ones(n + 1) / (n + 1), 0)
    yield "an action that there is not", lambda: model.propagate(uniform, model.n_actions)
    yield "a forecast of 0 steps", lambda: model.propagate(uniform, 0, 0)

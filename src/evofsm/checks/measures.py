"""The contract of a risk measure: a danger for each row, from it and the rows before it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.checks.contracts import Contract, drive, insist, refuse_growth, same
from evofsm.checks.kinds import Make

CONTRACT = Contract()
_DT = 0.25
# Scores may fall short of the order by so much: an estimate in steps.
_ROUNDING = 1e-6


def _score(measure: Any, rows: NDArray[np.float64], dt: float = _DT) -> NDArray[np.float64]:
    return np.asarray(measure.score(rows.copy(), dt))


@CONTRACT.clause()
def one_score_a_row(make: Make) -> None:
    """It returns an array with a number for each row, of one row too."""
    measure = make()
    for rows in (1, 2, 7):
        scores = measure.score(drive(rows), _DT)
        insist(
            isinstance(scores, np.ndarray) and scores.shape == (rows,),
            f"{rows} rows give {_shape(scores)}, not with an array of shape ({rows},)",
        )
        insist(scores.dtype.kind == "f", f"scores have dtype {scores.dtype}, not float")


def _shape(answer: object) -> str:
    return f"shape {answer.shape}" if isinstance(answer, np.ndarray) else repr(answer)[:40]


@CONTRACT.clause()
def inputs_not_changed(make: Make) -> None:
    """The observations stay as they are."""
    measure = make()
    rows = drive()
    given = rows.copy()
    measure.score(given, _DT)
    insist(same(given, rows), "score changed the observations (work in place? copy them first)")


@CONTRACT.clause()
def asking_changes_nothing(make: Make) -> None:
    """The same episode scores the same again, whatever was scored in between."""
    measure = make()
    first = _score(measure, drive())
    _score(measure, drive(seed=1))
    insist(
        same(_score(measure, drive()), first),
        "an episode scores otherwise the second time (is something kept from one to the next?)",
    )


@CONTRACT.clause()
def uses_only_earlier_rows(make: Make) -> None:
    """A row's score does not depend on rows that come after it."""
    measure = make()
    rows = drive()
    whole = _score(measure, rows)
    for k in (1, 2, 3, 10, len(rows) - 1):
        insist(
            same(whole[:k], _score(measure, rows[:k])),
            f"the first {k} rows score otherwise when rows follow them (a difference taken "
            "forward, a mean or a minimum over the whole episode?)",
        )


@CONTRACT.clause()
def no_score_is_missing(make: Make) -> None:
    """No score is NaN, however wild the numbers; infinity is allowed."""
    measure = make()
    big = 1e100
    wild = [[10.0, 0.0, 0.0], [np.inf, 20.0, 20.0], [0.0, 20.0, 20.0], [-5.0, 0.0, 0.0]]
    wild += [[big, big, big], [1e-300, big, 0.0], [-big, big, -big], [5.0, -1.0, -1.0]]
    for row in [*wild, *drive().tolist()]:
        given = np.nan_to_num(np.array([row]), posinf=big)
        with np.errstate(all="ignore"):
            score = _score(measure, given)[0]
        insist(
            not np.isnan(score),
            f"the score of gap {row[0]:g} m, speeds {row[1]:g} and {row[2]:g} m/s is NaN (0 / 0, "
            "or infinity minus infinity?)",
        )


@CONTRACT.clause()
def having_met_is_worst(make: Make) -> None:
    """Nothing scores higher than a row in which the cars have met, and that is above 0."""
    measure = make()
    rows = drive()
    for met in ([0.0, 10.0, 10.0], [-0.5, 20.0, 5.0], [-3.0, 0.0, 0.0]):
        scores = _score(measure, np.vstack([rows, [met]]))
        insist(
            scores[-1] > 0.0 and scores[-1] == scores.max(),
            f"a gap of {met[0]:g} m at {met[1]:g} and {met[2]:g} m/s scores {scores[-1]:g}, a row "
            f"before it {scores.max():g} (is a gap of 0 or less looked at apart?)",
        )


@CONTRACT.clause()
def danger_is_in_order(make: Make) -> None:
    """A smaller gap, a faster follower or a slower leader is never safer."""
    measure = make()
    changes = {"a smaller gap": (0, -1.0), "a faster follower": (1, 1.0)}
    changes["a slower leader"] = (2, -1.0)
    for what, (column, sign) in changes.items():
        for row in drive(12, seed=3):
            steps = [row.copy() for _ in range(4)]
            for k, changed in enumerate(steps):
                changed[column] += 0.7 * k * sign
            scores = np.array([_score(measure, changed[None])[0] for changed in steps])
            lower = np.flatnonzero(scores[1:] < scores[:-1] - _ROUNDING)
            insist(
                not len(lower),
                f"{what} lowers the score from {scores[lower[:1]]} to {scores[lower[:1] + 1]} at "
                f"gap {row[0]:.1f} m, {row[1]:.1f} and {row[2]:.1f} m/s (higher must be more "
                "dangerous: is it a time or a distance?)",
            )


@CONTRACT.clause()
def calls_for_braking_when_it_must(make: Make) -> None:
    """A car just behind a standing one scores above 0, one far behind a faster one does not."""
    measure = make()
    close = _score(measure, np.array([[2.0, 20.0, 0.0]]))[0]
    insist(close > 0.0, f"2 m behind a standing car at 20 m/s scores {close:g}, not above 0")
    far = _score(measure, np.array([[300.0, 10.0, 25.0]]))[0]
    insist(
        far <= 0.0,
        f"300 m behind a car that is 15 m/s faster scores {far:g}, above 0 (subtract a threshold)",
    )


@CONTRACT.clause()
def takes_a_number_as_dt(make: Make) -> None:
    """The step is one number, whatever its type."""
    measure = make()
    rows = drive()
    insist(
        same(_score(measure, rows, 1), _score(measure, rows, np.float64(1.0))),
        "dt of 1 and of 1.0 give other scores",
    )


@CONTRACT.clause()
def refuses_rows_of_another_width(make: Make) -> None:
    """Rows that have not three columns are an error."""
    measure = make()
    for width in (2, 4):
        try:
            measure.score(np.ones((5, width)), _DT)
        except Exception:
            continue
        insist(
            False, f"rows of {width} columns were accepted; they are gap, speed and leader's speed"
        )


@CONTRACT.clause()
def memory_is_bounded(make: Make) -> None:
    """Scoring the same again and again takes no more memory."""
    measure = make()
    rows = drive(3)

    def work(rounds: int) -> None:
        for _ in range(rounds):
            measure.score(rows, _DT)

    refuse_growth(work, 100, "the measure")

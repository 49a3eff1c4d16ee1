"""Does a monitor lose a decision in a day? 24 hours at 10 Hz, with junk, gaps and restarts.

Usage: python benchmarks/monitor_soak.py [--hours 24] [--seed 0] [--learn]

The time is that of the rows; it goes as fast as it runs. Between rows comes what is no message, and
rows that are late, that come twice, or that are from another schema. Rows are missing for seconds
and for minutes. Every eight minutes or so the monitor is abandoned, as by the death of its process:
between two rows, after a row was taken in and before it was decided on, or with the last record of
its journal half written; another one goes on from its files. A plain `Guard` is fed the rows that
are good, and told where an episode ends; every decision has to be its decision, to the last bit,
and have its number. Ends with 1 where one is not.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from evofsm.cli.monitor.decider import EPISODE, Answer, Decider
from evofsm.cli.monitor.messages import Row
from evofsm.cli.monitor.state import State
from evofsm.driving.cars import guard_of_monitor
from evofsm.guard import Guard
from monitor_rows import JUNK, line, traffic

_DT = 0.1
#: Chances of each, at a row.
_JUNK, _TWICE, _LATE, _GAP, _LOSS, _END, _RESTART = 0.02, 0.01, 0.01, 5e-4, 5e-3, 2e-4, 2e-4

# So often it says how far it is [rows].
_SAID = 36_000


class Found(NamedTuple):
    """What came of it."""

    rows: int
    junk: int
    restarts: int
    again: int  #: rows taken in again after restarts
    wrong: int  #: decisions that are lost, or not the plain guard's
    alarms: int
    hours: float  #: of the rows
    seconds: float  #: that it took


class Place:
    """Where a monitor keeps itself, and the one that is there now."""

    def __init__(self, folder: Path, learn: bool, episode: int) -> None:
        self._path = folder / "state.evofsm"
        self._learn, self._episode = learn, episode
        self.restarts = self.again = 0
        self._begin()

    def _begin(self) -> None:
        self._state = State(self._path, {"learn": self._learn})
        guard = self._state.guard(lambda: guard_of_monitor(_DT, 6.0))
        guard.learn = self._learn
        self.decider = Decider(guard, episode=self._episode)
        self.again += self._state.begin(self.decider)

    def die(self, row: bytes, how: int) -> None:
        """Nothing is saved any more; another one begins."""
        journal = self._state._journal
        if how == 1:  # the row was taken in, but nobody hears the answer
            self.decider.answer(row)
        journal._file.close()
        if how == 2:  # a part of the next record
            with open(journal.path, "ab") as file:
                file.write(b'{"told":{"type":"row","time":0.')
        self.restarts += 1
        self._begin()

    def close(self) -> None:
        """Let go of the files."""
        self._state.close()


def plain_answer(guard: Guard, row: dict[str, float]) -> tuple[object, ...]:
    """What the guard itself decides."""
    revision = guard.decide([row[k] for k in guard.variables], row["proposal"], row["time"])
    return (
        *(revision.executed, revision.advised, revision.risk_proposed, revision.risk_executed),
        *(*revision.interval, revision.evidence, revision.reason),
    )


def answered(answer: Answer) -> tuple[object, ...]:
    """The same, as a monitor says it."""
    names = ("executed", "advised", "risk_proposed", "risk_executed", "risk_low", "risk_high")
    return (
        *(answer[name] for name in names),
        answer["evidence"],
        answer["reason"],
    )


def good_rows(hours: float, rng: random.Random) -> Iterator[dict[str, float]]:
    """Rows of following, some of them missing for a while."""
    missing = 0
    for row in traffic(round(hours * 3600.0 / _DT), _DT):
        if missing == 0 and rng.random() < _GAP:
            missing = rng.choice([2, 10, 100, 3000])
        if missing or rng.random() < _LOSS:
            missing = max(0, missing - 1)
        else:
            yield row


def soak(hours: float, seed: int = 0, learn: bool = False, episode: int = EPISODE) -> Found:
    """Feed both, and compare."""
    rng, begun = random.Random(seed), time.perf_counter()
    guard = guard_of_monitor(_DT, 6.0)
    guard.learn = learn
    count = junk = wrong = alarms = length = 0
    last: tuple[bytes, Answer] | None = None
    with tempfile.TemporaryDirectory() as folder:
        place = Place(Path(folder), learn, episode)
        for row in good_rows(hours, rng):
            message = line(row)
            if rng.random() < _RESTART:
                place.die(message, rng.randrange(3))
            if rng.random() < _JUNK:
                junk += 1
                wrong += place.decider.answer(rng.choice(JUNK))["kind"] != "error"
            if last is not None and rng.random() < _TWICE:
                junk += 1
                wrong += place.decider.answer(last[0]) != last[1] and not is_next(place, row)
            answer = place.decider.answer(message)
            if rng.random() < _LATE:
                junk += 1
                late = line(row | {"time": row["time"] - rng.uniform(0.01, 0.9)})
                wrong += place.decider.answer(late)["kind"] != "error"
            count, length = count + 1, length + 1
            expected = plain_answer(guard, row)
            if answer["kind"] != "decision" or (answer["n"], answered(answer)) != (count, expected):
                wrong += 1
            alarms += bool(answer.get("alarm"))
            last = message, answer
            if count % _SAID == 0:
                print(
                    f"{row['time'] / 3600.0:.0f} h: {count:,} rows, {wrong} wrong", file=sys.stderr
                )
            if rng.random() < _END:
                place.decider.answer(b'{"end": true}')
                guard.end()
                last, length = None, 0
            elif length >= episode and (not answer.get("alarm") or length >= 2 * episode):
                guard.end()
                length = 0
        place.close()
    took = time.perf_counter() - begun
    return Found(count, junk, place.restarts, place.again, wrong, alarms, hours, took)


def is_next(place: Place, row: dict[str, float]) -> bool:
    """Whether the row was taken in already, before a restart: the one before it is late then."""
    latest = place.decider.latest
    return isinstance(latest, Row) and latest.time == row["time"]


def main() -> int:
    """Soak, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--learn", action="store_true")
    arguments = parser.parse_args()
    found = soak(arguments.hours, arguments.seed, arguments.learn)
    print(
        f"{found.hours:g} h of rows in {found.seconds:.0f} s: {found.rows:,} decisions "
        f"({found.alarms:,} alarms), {found.junk:,} messages of junk, {found.restarts:,} restarts "
        f"({found.again:,} rows taken in again); lost or wrong: {found.wrong}"
    )
    return 1 if found.wrong else 0


if __name__ == "__main__":
    sys.exit(main())

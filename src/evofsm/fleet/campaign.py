"""Drive thousands of episodes over any executor, and write down each one as it comes.

Whole batches of episodes cross from process to process, never steps. Episodes do not depend on
each other, so what comes out does not depend on how they are split, on who drives them, or on how
often that was interrupted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import AbstractContextManager, closing
from functools import partial
from itertools import islice

from evofsm.fleet.executors import Task, as_they_come
from evofsm.fleet.journal import Journal, Record

# Most episodes in a batch, some 100 to 500 ms; and batches for each worker, so that all of them
# end at about the same time.
_MOST, _ROUNDS = 20, 8

Batch = tuple[int, ...]


def run_campaign(
    drive: Callable[[Batch], list[Record]],
    episodes: int,
    journal: Journal,
    open_executor: Callable[[], AbstractContextManager[Executor]],
    workers: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Record]:
    """Drive those episodes that the journal does not hold yet.

    Parameters
    ----------
    drive : callable
        Makes a record for each episode it is told. Must be picklable where workers are processes,
        and a record must depend on nothing but its episode and the journal's settings.
    episodes : int
        How many there shall be.
    journal : Journal
    open_executor : callable
        As in `as_they_come`.
    workers : int
        How many tasks the executor runs at once. Nothing but time depends on it.
    progress : callable
        Told how many episodes are done, those of the journal included, and how many there are.

    Returns
    -------
    list of Record
        Of each episode in turn.

    Examples
    --------
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> def drive(batch):
    ...     return [{"square": episode**2} for episode in batch]
    >>> with TemporaryDirectory() as folder, Journal(Path(folder) / "journal.jsonl", {}) as journal:
    ...     run_campaign(drive, 4, journal, ThreadPoolExecutor, workers=2)
    [{'square': 0}, {'square': 1}, {'square': 4}, {'square': 9}]
    """
    done = sum(k < episodes for k in journal.records)
    progress(done, episodes)
    size = max(1, min(_MOST, (episodes - done) // (_ROUNDS * workers)))
    missing = (k for k in range(episodes) if k not in journal.records)
    tasks = (
        Task(f"episodes {batch[0]} to {batch[-1]}", partial(_drive, drive, batch))
        for batch in _batches(missing, size)
    )
    with closing(as_they_come(tasks, open_executor, 2 * workers)) as arriving:
        for results in arriving:
            records = {k: record for batch in results.values() for k, record in batch.items()}
            journal.append(records)
            done += len(records)
            progress(done, episodes)
    return [journal.records[k] for k in range(episodes)]


def _batches(episodes: Iterator[int], size: int) -> Iterator[Batch]:
    while batch := tuple(islice(episodes, size)):
        yield batch


def _drive(drive: Callable[[Batch], list[Record]], batch: Batch) -> dict[int, Record]:
    return dict(zip(batch, drive(batch), strict=True))

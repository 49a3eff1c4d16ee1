"""Run tasks over any executor, on this computer or on many, and lose none of them.

A worker that is killed takes with it what it was doing; that is done again by another one. What
comes back does not depend on how many workers there are, or on what happened to them.
"""

from __future__ import annotations

import os
import signal
import sys
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from functools import partial
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.connection import Connection
from threading import Thread
from types import TracebackType
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar

from evofsm.extras import needs

# So often may a task lose its worker before it is to blame. It is run alone once it has lost two:
# a broken pool does not say which of its tasks broke it.
_LIVES, _LIVES_IN_COMPANY = 5, 2
# How long a scheduler may take to answer, and its workers to join it [s].
_PATIENCE = 15
# Python before 3.11.5 tries for ever to hand tasks to workers that are no more
# (python/cpython#94777).
_WAITS_FOR_THE_DEAD = sys.version_info < (3, 11, 5)

P = ParamSpec("P")
R = TypeVar("R")


class Task(NamedTuple, Generic[R]):
    """What a worker does in one go: worth some 100 ms, for it crosses a process boundary."""

    name: str  #: for error messages
    run: Callable[[], R]  #: must be picklable where workers are processes


def as_they_come(
    tasks: Iterable[Task[R]],
    open_executor: Callable[[], AbstractContextManager[Executor]],
    ahead: int,
) -> Generator[dict[int, R], None, None]:
    """Results of tasks, as they come.

    Parameters
    ----------
    tasks : iterable of Task
        Taken as they are needed, so they may be many.
    open_executor : callable
        Makes an executor, and another one after a worker's death has broken it.
    ahead : int
        Tasks that are handed out at once; twice as many as there are workers keep them busy.

    Yields
    ------
    dict of int to result
        What has come since the last time, by the task's place in ``tasks``.

    Raises
    ------
    ChildProcessError
        If a task kills its workers again and again.
    Exception
        Whatever a task raises, with a note that names it.

    Examples
    --------
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> from functools import partial
    >>> tasks = [Task(f"square of {x}", partial(pow, x, 2)) for x in range(4)]
    >>> found = {}
    >>> for results in as_they_come(tasks, partial(ThreadPoolExecutor, 2), ahead=4):
    ...     found |= results
    >>> [found[k] for k in range(4)]
    [0, 1, 4, 9]
    """
    waiting = _Waiting(tasks)
    running: dict[Future[R], tuple[int, Task[R]]] = {}
    while True:
        with open_executor() as executor, _cancelled_at_the_end(running):
            broken = False
            while not broken:
                room = 1 if waiting.suspects else ahead
                while len(running) < room and (one := waiting.take()) is not None:
                    running[_submit(executor, one[1])] = one
                if not running:
                    return
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                broken = any(map(_has_lost_its_worker, done))
                if broken:  # then no other will come back either
                    done, _ = wait(running)
                results = {}
                for future in done:
                    index, task = running.pop(future)
                    if _has_lost_its_worker(future):
                        waiting.take_back(index, task)
                    else:
                        results[index] = _result(future, task)
                        waiting.suspects.discard(index)
                if results:
                    yield results


def in_order(
    tasks: Sequence[partial[R]],
    workers: int | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[R]:
    """Results of all tasks, in the order of the tasks.

    Parameters
    ----------
    tasks : sequence of functools.partial
    workers : int, optional
        Processes of this computer, one per core if not told; with 1 the tasks are run in this
        very process.
    progress : callable
        Told how many are done, of how many.

    Examples
    --------
    >>> from functools import partial
    >>> in_order([partial(pow, x, 2) for x in range(4)], workers=1)
    [0, 1, 4, 9]
    """
    workers = workers or os.cpu_count() or 1
    named = (Task(f"{task.func.__name__}, task {k}", task) for k, task in enumerate(tasks))
    open_executor = partial(Processes, workers) if workers > 1 else Here
    found: dict[int, R] = {}
    with closing(as_they_come(named, open_executor, 2 * workers)) as arriving:
        for results in arriving:
            found |= results
            progress(len(found), len(tasks))
    return [found[k] for k in range(len(tasks))]


class _Waiting(Generic[R]):
    """Tasks that nobody works at: those that lost their worker, and then those not begun yet."""

    def __init__(self, tasks: Iterable[Task[R]]) -> None:
        self._fresh = enumerate(tasks)
        self._lost: dict[int, Task[R]] = {}
        self._losses: Counter[int] = Counter()
        #: Those that may have killed their workers, and must be run alone.
        self.suspects: set[int] = set()

    def take(self) -> tuple[int, Task[R]] | None:
        """The next one, with its place; None where none is left."""
        if not self._lost:
            return next(self._fresh, None)
        first = min(self._lost)
        return first, self._lost.pop(first)

    def take_back(self, index: int, task: Task[R]) -> None:
        """One has lost its worker."""
        self._lost[index] = task
        self._losses[index] += 1
        if self._losses[index] >= _LIVES_IN_COMPANY:
            self.suspects.add(index)
        if self._losses[index] == _LIVES:
            raise ChildProcessError(f"{task.name}: {_LIVES} workers died over it (out of memory?)")


def _submit(executor: Executor, task: Task[R]) -> Future[R]:
    """Hand a task out; an executor that is found broken shows in the future, as later on."""
    try:
        return executor.submit(task.run)
    except BrokenExecutor as error:
        future: Future[R] = Future()
        future.set_exception(error)
        return future


def _has_lost_its_worker(future: Future[R]) -> bool:
    return future.cancelled() or isinstance(future.exception(), BrokenExecutor | CancelledError)


def _result(future: Future[R], task: Task[R]) -> R:
    error = future.exception()
    if error is not None:
        error.add_note(f"in {task.name}")
    return future.result()


@contextmanager
def _cancelled_at_the_end(running: dict[Future[R], tuple[int, Task[R]]]) -> Iterator[None]:
    """Call off what nobody waits for any more."""
    try:
        yield
    finally:
        for future in running:
            future.cancel()


# -- On this computer -----------------------------------------------------------------------------


class Here(Executor):
    """Runs each task at once, in this very process."""

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:  # noqa: D102
        future: Future[R] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Processes(ProcessPoolExecutor):
    """Processes of this computer, which never outlive the one that started them.

    Each holds the end of a pipe to its parent, and ends when the other end is closed: by the
    parent when it has no use for it any more, or by the system when the parent is killed. An
    interruption from the keyboard is left to the parent.

    Parameters
    ----------
    workers : int
    """

    def __init__(self, workers: int) -> None:
        # Forking a process that has started threads may hang; a fresh one costs a second.
        context = get_context("spawn")
        self._lifeline = context.Pipe(duplex=False)
        super().__init__(workers, context, _begin_work, (self._lifeline[0],))

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:  # noqa: D102
        with _interruption_held_back():  # which a process that is started here inherits
            return super().submit(fn, *args, **kwargs)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is not None:
            self._lifeline[1].close()
        if _WAITS_FOR_THE_DEAD and (error is not None or self._broken):
            # A pipe that nobody can read from tells it so; later Pythons close it themselves.
            inside: Any = self
            inside._call_queue._reader.close()
        self.shutdown(cancel_futures=True)
        for end in self._lifeline:
            end.close()


def _begin_work(lifeline: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with, args=(lifeline,), daemon=True).start()


def _end_with(lifeline: Connection) -> None:
    with suppress(EOFError, OSError):
        lifeline.recv_bytes()
    os._exit(1)


@contextmanager
def _interruption_held_back() -> Iterator[None]:
    """Let Ctrl-C wait, where the system can."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# -- On many computers ----------------------------------------------------------------------------


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """The workers of a Dask scheduler, as an executor.

    Dask itself gives the task of a worker that died to another one, a few times.

    Parameters
    ----------
    address : str
        Of the scheduler, such as ``"tcp://10.0.0.1:8786"``.

    Raises
    ------
    ModuleNotFoundError
        If Dask's ``distributed`` is not installed.
    ConnectionError
        If no scheduler answers.
    ChildProcessError
        If a task has killed more workers than Dask allows.
    """
    with _client(address) as client:
        try:
            yield client.get_executor(pure=False)
        except _distributed().KilledWorker as error:
            where = "; ".join(getattr(error, "__notes__", ["a task"])).removeprefix("in ")
            raise ChildProcessError(
                f"{where}: {error.allowed_failures + 1} workers died over it (out of memory?)"
            ) from error


def cluster_threads(address: str, workers: int = 1) -> int:
    """How many tasks the workers of a Dask scheduler run at once.

    Parameters
    ----------
    address : str
    workers : int
        Waits until there are so many.

    Raises
    ------
    ConnectionError
        If no scheduler answers, or there are not as many workers after a while.
    """
    with _client(address) as client:
        with suppress(TimeoutError):
            client.wait_for_workers(workers, timeout=_PATIENCE)
        threads = client.nthreads()
    if len(threads) < workers:
        raise ConnectionError(
            f"only {len(threads)} of {workers} workers have joined {address}; start them with: "
            f"dask worker {address} --nthreads 1"
        )
    return sum(threads.values())


@contextmanager
def _client(address: str) -> Iterator[Any]:
    try:
        client = _distributed().Client(address, timeout=_PATIENCE)
    except (OSError, ValueError) as error:
        raise ConnectionError(f"no Dask scheduler answers at {address}: {error}") from error
    with client:
        yield client


def _distributed() -> Any:
    with needs("distributed", "cluster", "the executor 'dask'"):
        return import_module("distributed")

"""The audit log: what a reviser changed or warned of, and all that it takes to replay it.

Records of a log, by their ``kind``:

``start``
    Who takes part, with the machine and the risk as they were: `participants.describe`. Anew
    wherever something else has taught them since the last episode.
``begin``, ``end``
    An episode, from 1; at its end the last observation, whether it failed, and sums over what was
    learnt.
``decision``
    One that changed a proposal or raised an alarm, with what was seen, proposed and known.
``quiet``
    Nothing was said for a while.
``settings``
    The reviser's were changed, or the driver took over or handed back.

An action is a number, or a list of them where the set of actions is a box.

``before`` holds what happened since the last record, where the proposal was executed as it was:
``[time, observation, proposal]``, with the candidates after that if there were any, and without a
proposal where none was made. Times and observations are those that came in, whatever was made of
them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Self

import numpy as np
from numpy.typing import NDArray

from evofsm.fleet.sealed import LOG_HEADER, ChainedFile, Head, Sync, records
from evofsm.guard.actions import written
from evofsm.guard.auditing.form import LOG_VERSION, TOLD
from evofsm.guard.auditing.participants import describe, learnt, settings
from evofsm.guard.guard import Guard
from evofsm.guard.protocols import Participants, Proposal, Reviser, Revision, Situation
from evofsm.guard.record import RECORD, Pair
from evofsm.guard.reviser import is_spoken

_log = logging.getLogger(__name__)

# So many states of a belief are written, the most probable first.
_STATES = 3

_P = ParamSpec("_P")


def _whole(
    method: Callable[Concatenate[AuditLog, _P], None],
) -> Callable[Concatenate[AuditLog, _P], None]:
    """What is interrupted half-way leaves a hole; what follows in the episode is not written then.

    Replayed without what is missing it would come out otherwise, as if someone had forged it.
    """

    @wraps(method)
    def told(log: AuditLog, /, *args: _P.args, **kwargs: _P.kwargs) -> None:
        if log._broken_off:
            return
        try:
            method(log, *args, **kwargs)
        except BaseException:
            if log._failure is None:  # else it ends there anyway, which was said
                log._broken_off = True
                _log.error(
                    "the audit log %s was interrupted at record %s: nothing more is written of "
                    "this episode; it goes on with the next",
                    log.path,
                    log.head.number,
                )
            raise

    return told


class AuditLog:
    """Writes down what a reviser decides, so that nobody can change it unnoticed.

    Give it to a `Guard`. Where the disk fails while driving, someone has to go on driving: the
    log is broken off there, which is logged, and raised as the episode ends.

    Parameters
    ----------
    path : Path
        The file, `chain.ChainedFile`; one that is there is gone on with.
    sync : Sync
        When records are forced onto the disk: each, before its action is executed, or those of an
        episode at its end, which takes no time while driving.
    most_quiet : int
        Decisions of which nothing is to be said that are held back at most; a process that is
        killed loses no more than these.

    Raises
    ------
    OSError
        If the file cannot be written.
    ValueError
        If it was tampered with, is no log, or is being written by another process.

    Notes
    -----
    Between the episodes of a log anything may teach machine or risk: they are written anew then.
    During one nothing else may. An interrupt (Ctrl-C) while something is written breaks the
    episode off in the log, which goes on with the next one. Where a process forks, the log stays
    with the parent: a child that has something to write fails as if the disk did.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from evofsm.driving import guard_for_cars
    >>> from evofsm.guard import audit
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "audit.jsonl"
    ...     with AuditLog(path) as log:
    ...         guard = guard_for_cars(low=-2.5, high=2.5, audit=log)
    ...         revision = guard.decide([9.0, 20.0, 10.0], proposal=1.0)
    ...         guard.end(observation=[7.0, 19.0, 10.0])
    ...     found = audit(path, log.head)
    >>> revision.executed, found.chain.head.number, found.replay.decisions, found.is_good
    (-2.5, 4, 1, True)
    """

    def __init__(self, path: Path, *, sync: Sync = Sync.RECORD, most_quiet: int = 240) -> None:
        self.sync = sync
        self.most_quiet = most_quiet
        self._file = ChainedFile(path)
        #: What was cut off from a half-written end as it was opened [byte].
        self.cut_off = self._file.cut_off
        self._episodes = _count_episodes(path, self._file.head)
        self._who: Participants | None = None
        self._learnt: dict[str, float] | None = None  # as the latest episode ended
        self._settings: dict[str, Any] = {}
        self._before: list[list[Any]] = []
        self._seen: list[Any] = []  # what a proposal is waited for
        self._failure: OSError | None = None
        self._broken_off = False  # the present episode, by an interrupt

    @property
    def path(self) -> Path:
        """The file."""
        return self._file.path

    @property
    def head(self) -> Head:
        """The last record. Keep it elsewhere: it shows what is cut off or written anew later."""
        return self._file.head

    def close(self) -> None:
        """Write what was held back, and let others have the file.

        Raises
        ------
        OSError
            If something could not be written, now or before.
        """
        try:
            if self._file.is_ours:  # what is held back is the parent's to write
                self._flush()
                self._force()
        finally:
            self._file.close()
        self._raise()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # -- What it is told by whoever oversees an episode -------------------------------------------

    def begin(self, guard: Guard) -> None:
        """An episode begins."""
        self._raise()
        who = guard.participants
        was_broken_off, self._broken_off = self._broken_off, True  # until it has begun
        self._flush()  # of one that was broken off
        self._seen = []
        if was_broken_off:
            self._begin_anew()
        if not self._know(who):
            self._write(
                {**LOG_HEADER, "kind": "start", "version": LOG_VERSION, "cut_off": self.cut_off}
                | describe(who)
            )
            self._settings = settings(who.reviser)
        self._who, self._learnt = who, None
        self._episodes += 1
        self._follow(who.reviser)
        self._write(
            {
                "kind": "begin",
                "episode": self._episodes,
                "failure_told": guard.failed is not None,
                "interval": guard.interval,
                "learn": guard.learn,
                "missing": guard.missing.value,
            }
        )
        self._force()
        self._broken_off = False
        self._raise()

    @_whole
    def seen(self, observation: NDArray[np.float64], time: float) -> None:
        """An observation came in, at ``time`` [s]."""
        self._keep_seen()
        self._seen = [float(time), _floats(observation)]

    @_whole
    def decided(self, situation: Situation, proposal: Proposal, revision: Revision) -> None:
        """A decision was made. When this returns it is written down, if it said something."""
        if self._who is None:
            raise ValueError("decided before begin: no episode is overseen")
        self._follow(self._who.reviser)
        (time, observation), self._seen = self._seen, []
        if is_spoken(self._who.reviser, revision):
            came_in = {"time": time, "observation": observation}
            decision = told(situation, proposal, revision)
            self._write({"kind": "decision", **self._take_before(), **came_in, **decision})
            return
        candidates = _candidates(proposal)
        row = [time, observation, written(proposal.action)]
        self._before.append([*row, candidates] if candidates else row)
        if len(self._before) >= self.most_quiet:
            self._flush()

    @_whole
    def ended(self, observation: NDArray[np.float64] | None, *, failed: bool) -> None:
        """The episode ended.

        Raises
        ------
        OSError
            If something could not be written since it began.
        """
        if self._who is None:
            raise ValueError("ended before begin: no episode is overseen")
        self._keep_seen()
        self._learnt = learnt(self._who.machine, self._who.risk)
        self._write(
            {
                "kind": "end",
                **self._take_before(),
                "failed": bool(failed),
                "learnt": self._learnt,
                "observation": None if observation is None else _floats(observation),
            }
        )
        self._force()
        self._raise()

    # -- Writing ----------------------------------------------------------------------------------

    def _begin_anew(self) -> None:
        """After an interrupt the file alone knows what was written."""
        self._who = None
        try:
            self._file.settle()
            self._episodes = _count_episodes(self.path, self._file.head)
        except OSError as error:
            self._fail(error)

    def _know(self, who: Participants) -> bool:
        """Whether they are those of the latest episode, and as it left them."""
        return (
            self._who is not None
            and all(now is before for now, before in zip(who, self._who, strict=True))
            and self._learnt == learnt(who.machine, who.risk)
        )

    def _follow(self, reviser: Reviser) -> None:
        """Write down that settings were changed."""
        now = settings(reviser)
        if now != self._settings:
            self._flush()
            self._write({"kind": "settings", "settings": now})
            self._settings = now

    def _keep_seen(self) -> None:
        """Nothing was proposed to what came in last."""
        if self._seen:
            self._before.append(self._seen)
            self._seen = []

    def _flush(self) -> None:
        if self._before:
            self._write({"kind": "quiet", **self._take_before()})

    def _take_before(self) -> dict[str, Any]:
        rows, self._before = self._before, []
        return {"before": rows}

    def _write(self, content: Mapping[str, Any]) -> None:
        if self._failure is not None:
            return
        try:
            self._file.append({"clock": datetime.now(UTC).isoformat(), **content})
            if self.sync is Sync.RECORD:
                self._file.sync()
        except OSError as error:
            self._fail(error)

    def _force(self) -> None:
        if self._failure is None and self.sync is Sync.EPISODE:
            try:
                self._file.sync()
            except OSError as error:
                self._fail(error)

    def _fail(self, error: OSError) -> None:
        self._failure = error
        _log.error("the audit log %s ends with record %s: %s", self.path, self.head.number, error)

    def _raise(self) -> None:
        if self._failure is not None:
            raise OSError(
                self._failure.errno,
                f"{self._failure.strerror}; the audit log ends with record {self.head.number}",
                str(self.path),
            ) from self._failure


# -- What is written ------------------------------------------------------------------------------


def told(situation: Situation, proposal: Proposal, revision: Revision) -> dict[str, Any]:
    """A decision, as it is written, but for what came in."""
    likely = np.argsort(-situation.belief, kind="stable")[:_STATES].tolist()
    decided = Pair(situation, revision._replace(proposed=proposal.action))
    return {
        **{name: _plain(RECORD[name].kind, RECORD[name].read(decided)) for name in TOLD},
        "belief": [[state, float(situation.belief[state])] for state in likely],
        "candidates": _candidates(proposal),
        "interval": [float(bound) for bound in revision.interval],
    }


def _plain(kind: type, value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return written(value)
    return None if value is None else kind(value)


def _candidates(proposal: Proposal) -> list[Any]:
    return [written(candidate) for candidate in proposal.candidates]


def _floats(observation: NDArray[np.float64]) -> list[float]:
    floats: list[float] = np.asarray(observation, dtype=np.float64).tolist()
    return floats


def _count_episodes(path: Path, head: Head) -> int:
    return sum(record.content.get("kind") == "begin" for record in records(path, head.number or 0))

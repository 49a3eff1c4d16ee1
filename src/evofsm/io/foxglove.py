"""Decisions written as MCAP, or shown live in Foxglove or Lichtblick, by Foxglove's own library.

`evofsm.io.runs` says what the channels hold; `FOXGLOVE_LAYOUT` shows files and what is live alike.
Nothing leaves this computer unless another host is told.
"""

from __future__ import annotations

import io
import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from os import PathLike, fspath
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from evofsm import __version__, store
from evofsm.driving import Episode
from evofsm.driving.naming import VARIABLES
from evofsm.extras import needs
from evofsm.fsm.model import FSMModel
from evofsm.guard import Decision, DecisionLogger, Guard, Proposal, Revision, Situation
from evofsm.guard.actions import same_action
from evofsm.io.runs import (
    FORMAT,
    MODEL,
    PROFILE,
    columns_by_topic,
    columns_of,
    field_of,
    schemas_of,
)

with needs("foxglove-sdk", "mcap", "writing MCAP, and a live view in Foxglove"):
    import foxglove
    from foxglove.channels import LogChannel
    from foxglove.mcap import MCAPWriteOptions
    from foxglove.messages import Log, LogLevel, Timestamp

#: A layout of cars, to be imported: *Layouts, Import from file*.
FOXGLOVE_LAYOUT = Path(__file__).with_name("foxglove_layout.json")

_SECOND = 1_000_000_000  # [ns]
_PAUSE = _SECOND  # from the end of an episode to the start of the next


class _Channels:
    """Sends what happens in episodes that follow each other on one axis of time."""

    def __init__(self, names: Sequence[str], units: Sequence[str]) -> None:
        self.names = tuple(names)
        self.is_of_cars = self.names == VARIABLES
        self.context = foxglove.Context()  # its channels close with it
        self.episode = 0
        self.begin = 0  # of the episode [ns]
        self.file: _File | None = None
        self._columns = columns_of(names, units)
        self._topics = columns_by_topic(names)
        self._channels = {
            topic: foxglove.Channel(topic, schema=schema, context=self.context)
            for topic, schema in schemas_of(names, units).items()
        }
        self._log = LogChannel("/log", context=self.context)

    def event(self, kind: str, at: float, observation: NDArray[np.float64]) -> None:
        where = dict(zip(self.names, observation.tolist(), strict=False))
        self._send("/event", at, {"kind": kind, "episode": self.episode, "time": at, **where})

    def decision(self, decision: Decision) -> None:
        """A decision, and a line where it was changed, or would have been."""
        situation, revision = decision.situation, decision.revision
        belief = situation.belief.tolist() if situation.state is not None else []
        for topic, names in self._topics.items():
            read = {name: self._columns[name].read for name in names if name != "belief"}
            message = {field_of(topic, name): get(decision) for name, get in read.items()}
            message |= {"belief": belief} if topic == "/belief" else {}
            self._send(topic, situation.time, message)
        is_changed = not same_action(revision.executed, revision.proposed)
        if is_changed or not same_action(revision.advised, revision.executed):
            verb = "executed" if is_changed else "would advise"
            instead = revision.executed if is_changed else revision.advised
            unit = " m/s²" if self.is_of_cars else ""
            text = f"proposed {_shown(revision.proposed)}, {verb} {_shown(instead)}{unit}"
            level = LogLevel.Warning if is_changed else LogLevel.Info
            self.note(level, situation.time, f"{text}: {revision.reason}")

    def note(self, level: LogLevel, at: float, text: str) -> None:
        now = self.begin + round(at * _SECOND)
        stamp = Timestamp(*divmod(now, _SECOND))
        self._log.log(Log(timestamp=stamp, level=level, message=text, name="evofsm"), log_time=now)

    def end(self, at: float, observation: NDArray[np.float64], happened: Sequence[str]) -> None:
        """The episode ended, so long after it began [s], with what happened then."""
        for kind in happened:
            self.event(kind, at, observation)
            self.note(LogLevel.Error, at, kind)
        self.event("episode ended", at, observation)
        self.begin += round(at * _SECOND) + _PAUSE
        self.episode += 1

    def _send(self, topic: str, at: float, message: Mapping[str, Any]) -> None:
        fields = {name: value for name, value in message.items() if _is_known(value)}
        data = json.dumps(fields, ensure_ascii=False, allow_nan=False).encode()
        self._channels[topic].log(data, log_time=self.begin + round(at * _SECOND))
        if self.file is not None and self.file.error is not None:
            raise self.file.error


def _shown(action: Any) -> str:
    return f"{action:+.2f}" if isinstance(action, float) else str(action)


def _is_known(value: Any) -> bool:
    """Whether it is a number, a text or a list; actions that are vectors are left to the log."""
    if isinstance(value, float):
        return math.isfinite(value)
    return value is not None and not isinstance(value, np.ndarray)


class _File:
    """A file that remembers why it could not be written: Foxglove's library goes on then."""

    def __init__(self, file: BinaryIO, channels: _Channels, profile: str = "") -> None:
        self._file = file
        self.error: OSError | None = None
        channels.file = self
        options = MCAPWriteOptions(profile=profile, compression_threads=0)
        with self.explained():
            self.mcap = foxglove.open_mcap(self, context=channels.context, writer_options=options)

    @contextmanager
    def explained(self) -> Iterator[None]:
        """Raise the error of writing in place of what the library makes of it."""
        try:
            yield
        except RuntimeError as error:
            raise self.error or error from None

    def write(self, data: bytes | bytearray) -> int:
        try:
            return self._file.write(data)
        except OSError as error:
            self.error = error
            raise

    def __getattr__(self, name: str) -> Any:  # seek, flush
        return getattr(self._file, name)

    def close(self) -> None:
        with self.explained():
            self.mcap.close()


# -- Runs -----------------------------------------------------------------------------------------


@contextmanager
def recording(
    path: str | PathLike[str], about: Mapping[str, Any] | None = None
) -> Iterator[RunWriter]:
    """A log that grows episode by episode; the file appears at the end, if all went well.

    Parameters
    ----------
    path : str or path-like
        A file of that name is replaced.
    about : mapping, optional
        What is driven: family, controller, reviser and so on. What is no text becomes JSON.

    Yields
    ------
    RunWriter
        ``add(episode)`` writes an episode, ``attach(model)`` what was learnt.

    Raises
    ------
    OSError
        If it cannot be written; what was there before is then as it was.

    Examples
    --------
    >>> import tempfile
    >>> from evofsm.driving import drive, load_family, unrevised_guard
    >>> from evofsm.io import read_run
    >>> family = load_family("emergency")
    >>> driven = drive(unrevised_guard(family), family.draw(seed=0, index=0))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with recording(Path(folder) / "run.mcap", {"controller": "hasty"}) as log:
    ...         log.add(driven)
    ...     run = read_run(Path(folder) / "run.mcap")
    >>> run.about["controller"], run.episodes[0].collided
    ('hasty', True)
    >>> bool((run.episodes[0].columns["executed"] == driven.executed).all())
    True
    """
    with store.replacing(path) as file:
        writer = RunWriter(file, about or {})
        yield writer
        writer.finish()


class RunWriter:
    """Writes episode after episode of cars; `recording` opens one."""

    def __init__(self, file: BinaryIO, about: Mapping[str, Any]) -> None:
        self._channels = _Channels(VARIABLES, ())
        self._file = _File(file, self._channels, PROFILE)
        facts = {"library": f"evofsm {__version__}", **about, "format": FORMAT}
        texts = {name: x if isinstance(x, str) else json.dumps(x) for name, x in facts.items()}
        with self._file.explained():
            self._file.mcap.write_metadata(PROFILE, texts)

    def add(self, episode: Episode) -> None:
        """Write the next episode, with its decisions."""
        channels, observations = self._channels, episode.observations
        channels.event("episode started", float(episode.time[0]), observations[0])
        for decision in episode.decisions:
            channels.decision(decision)
        outcomes = {"collision": episode.collided, "rear-end collision": episode.rear_ended}
        kinds = [kind for kind, it_did in outcomes.items() if it_did]
        channels.end(float(episode.time[-1]), observations[-1], kinds)

    def attach(self, model: FSMModel) -> None:
        """Attach what was learnt."""
        file, at = io.BytesIO(), self._channels.begin
        model.save(file)
        media = "application/octet-stream"
        with self._file.explained():
            self._file.mcap.attach(
                log_time=at, create_time=at, name=MODEL, media_type=media, data=file.getvalue()
            )

    def finish(self) -> None:
        """Write the index, which ends the log."""
        self._file.close()


# -- Live -----------------------------------------------------------------------------------------


class FoxgloveSink(AbstractContextManager["FoxgloveSink"], DecisionLogger):
    """Shows what a guard sees and decides: ``guard.audit = FoxgloveSink()``.

    Every decision is a message on ``/observation``, ``/belief``, ``/risk`` and ``/decision``; what
    was changed, and why, stands in ``/log``. Use it in a ``with`` statement, or `close` it.

    Parameters
    ----------
    port : int, optional
        Serve live at this port, 0 for any that is free; None for no server.
    file : path-like, optional
        Write an MCAP file as well, or instead.
    names, units : sequence of str
        Of the variables of an observation; without them those of a car that follows another.
    host : str
        Who may look on; only this computer, unless told otherwise.

    Raises
    ------
    ValueError
        If there is neither a port nor a file.
    RuntimeError
        If the port is taken.
    FileExistsError
        If there is such a file.

    Notes
    -----
    A message holds numbers: actions that are vectors are left out of it, and stand in ``/log``. As
    an audit log does, it may make a guard look up its experience (``explaining``).

    Examples
    --------
    >>> import tempfile
    >>> from evofsm.driving import guard_for_cars
    >>> guard = guard_for_cars(low=-4.0, high=2.5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with FoxgloveSink(None, Path(folder) / "run.mcap") as guard.audit:
    ...         revision = guard.decide([9.0, 20.0, 20.0], proposal=0.5)
    ...         guard.end()
    ...     (Path(folder) / "run.mcap").read_bytes()[1:5]
    b'MCAP'
    """

    def __init__(
        self,
        port: int | None = 8765,
        file: str | PathLike[str] | None = None,
        *,
        names: Sequence[str] = VARIABLES,
        units: Sequence[str] = (),
        host: str = "127.0.0.1",
    ) -> None:
        if port is None and file is None:
            raise ValueError("a sink needs a port, a file, or both")
        self._channels = _Channels(names, units)
        self._open = ExitStack()
        if file is not None:
            try:
                writer = self._open.enter_context(io.BufferedWriter(io.FileIO(file, "x")))
            except FileExistsError:
                raise FileExistsError(f"{fspath(file)} exists; it was left alone") from None
            self._open.callback(_File(writer, self._channels).close)
        #: Where it is served; None without a port.
        self.address: str | None = None
        if port is not None:
            server = foxglove.start_server(
                name="evofsm", host=host, port=port, context=self._channels.context
            )
            self._open.callback(server.stop)
            self.address = f"ws://{host}:{server.port}"
            self._channels.begin = time.time_ns()  # live, a message is now; in a file time is 0
        self._time = 0.0  # of the latest decision, in its episode [s]
        self._observation: NDArray[np.float64] = np.full(len(names), math.nan)
        self._begun = False

    def close(self) -> None:
        """Stop serving, and end the file."""
        self._open.close()

    def __exit__(self, *error: object) -> None:
        self.close()

    # -- As the decision logger of a guard --------------------------------------------------------

    def begin(self, guard: Guard) -> None:
        """An episode begins."""
        self._time, self._begun = 0.0, False

    def seen(self, observation: NDArray[np.float64], time: float) -> None:
        """An observation came in."""
        self._time, self._observation = time, observation
        if not self._begun:
            self._begun = True
            self._channels.event("episode started", time, observation)

    def decided(self, situation: Situation, proposal: Proposal, revision: Revision) -> None:
        """A decision was made."""
        self._channels.decision(Decision(situation, revision))

    def ended(
        self, observation: Any, *, failed: bool, terminated: bool, score: float | None
    ) -> None:
        """The episode ended."""
        if observation is not None:
            self._observation = observation
        kind = "collision" if self._channels.is_of_cars else "failure"
        self._channels.end(self._time, self._observation, [kind] if failed else [])

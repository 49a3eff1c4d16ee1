"""Decisions written as MCAP, or shown live in Foxglove or Lichtblick, by Foxglove's own library.

The messages are JSON with schemas that name every unit. What is not known is left out of one: JSON
has no NaN, and the schemas have one type for each field. `FOXGLOVE_LAYOUT` shows them.
"""

from __future__ import annotations

import io
import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from operator import itemgetter
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.naming import DECISION_COLUMNS, VARIABLES, observed
from evofsm.extras import needs
from evofsm.guard import Decision, DecisionLogger, Guard, Proposal, Revision, Situation
from evofsm.guard.actions import action_text, same_action
from evofsm.guard.record import RECORD, Column

with needs("foxglove-sdk", "mcap", "writing MCAP, and a live view in Foxglove"):
    import foxglove
    from foxglove.channels import LogChannel
    from foxglove.mcap import MCAPWriteOptions
    from foxglove.messages import Log, LogLevel, Timestamp

#: A layout of cars, to be imported: *Layouts, Import from file*.
FOXGLOVE_LAYOUT = Path(__file__).with_name("foxglove_layout.json")

_SECOND = 1_000_000_000  # [ns]
_PAUSE = _SECOND  # from the end of an episode to the start of the next


def _belief(decision: Decision) -> list[float]:
    situation = decision.situation
    return [] if situation.state is None else situation.belief.tolist()


def columns_by_topic(
    names: Sequence[str] = VARIABLES, units: Sequence[str] = ()
) -> dict[str, dict[str, Column]]:
    """The columns of decisions by channel, for cars or for variables of these names and units.

    The channel of risks has them without ``risk_``.
    """
    of_cars = tuple(names) == VARIABLES
    suffixes = [f" [{unit}]" if unit else "" for unit in units] + [""] * len(names)
    columns = DECISION_COLUMNS if of_cars else dict(RECORD)
    columns = {**columns, "belief": Column(list, "probability of each state, from 0", _belief)}
    variables = {  # whose names may be those of other columns
        name: observed(f"as observed{suffixes[k]}; left out where missing", itemgetter(k))
        for k, name in enumerate(() if of_cars else names)
    }
    risks = "risk_proposed", "risk_executed", "risk_low", "risk_high", "evidence", "seen"
    topics = {
        "/observation": ("time", *names, "intake"),
        "/belief": ("state", "belief", "surprise", "n_states"),
        "/risk": (*risks, *(("time_to_collision", "time_headway") if of_cars else ())),
        "/decision": ("proposed", "executed", "advised", "reason", "explanation"),
    }
    of_topic = dict.fromkeys(topics, columns) | {"/observation": {**columns, **variables}}
    by_topic = {topic: {n: of_topic[topic][n] for n in topics[topic]} for topic in topics}
    by_topic["/risk"] = {n.removeprefix("risk_"): c for n, c in by_topic["/risk"].items()}
    return by_topic


def schemas_of(
    names: Sequence[str] = VARIABLES, units: Sequence[str] = ()
) -> dict[str, dict[str, Any]]:
    """The JSON schema of each channel, by its topic."""
    columns = columns_by_topic(names, units)
    fields = {topic: {n: _schema(c) for n, c in columns[topic].items()} for topic in columns}
    fields["/event"] = {
        "kind": _of("string", "episode started, collision or failure, episode ended"),
        "episode": _of("integer", "number of the episode, from 0"),
        "time": _of("number", "since the start of the episode [s]"),
        **{name: fields["/observation"][name] for name in names},
    }
    return {
        topic: {"title": f"evofsm.{topic[1:].capitalize()}", "type": "object", "properties": of_it}
        for topic, of_it in fields.items()
    }


def _of(kind: str, about: str) -> dict[str, Any]:
    return {"type": kind, "description": about}


def _schema(column: Column) -> dict[str, Any]:
    kinds: dict[type, str] = {float: "number", int: "integer", str: "string", list: "array"}
    items = {"items": _of("number", "probability")} if column.kind is list else {}
    return {**_of(kinds[column.kind], column.about), **items}


class _File(io.BufferedWriter):
    """A file that remembers why it could not be written: Foxglove's library goes on then."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            self.error = error
            raise

    @contextmanager
    def explaining(self) -> Iterator[None]:
        """Raise that error in place of what the library makes of it."""
        try:
            yield
        except RuntimeError as error:
            raise self.error or error from None


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
        If there is neither a port nor a file, or two fields of a message had one name.
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
        fields = ["time", "intake", "kind", "episode", *names]  # of a message
        if twice := [name for name in names if fields.count(name) > 1]:
            raise ValueError(f"a message would have two fields {twice[0]!r}; name others in names=")
        self._names = tuple(names)
        self._columns = columns_by_topic(names, units)
        context = self._context = foxglove.Context()  # its channels close with it
        self._channels = {
            topic: foxglove.Channel(topic, schema=schema, context=context)
            for topic, schema in schemas_of(names, units).items()
        }
        self._log = LogChannel("/log", context=context)
        self._open, self._file = ExitStack(), None
        if file is not None:
            try:
                self._file = self._open.enter_context(_File(io.FileIO(file, "x")))
            except FileExistsError:
                raise FileExistsError(f"{fspath(file)} exists; it was left alone") from None
            self._open.enter_context(self._file.explaining())
            options = MCAPWriteOptions(compression_threads=0)
            mcap = foxglove.open_mcap(self._file, context=context, writer_options=options)
            self._open.callback(mcap.close)
        self.address: str | None = None  #: where it is served; None without a port
        self._episode = self._start = 0  # its number, and when it began [ns]
        if port is not None:
            server = foxglove.start_server(name="evofsm", host=host, port=port, context=context)
            self._open.callback(server.stop)
            place = f"[{host}]" if ":" in host else host
            self.address = f"ws://{place}:{server.port}"
            self._start = time.time_ns()  # live, a message is now; in a file time is 0
        self._time = 0.0  # of the latest decision, in its episode [s]
        self._observation: NDArray[np.float64] = np.full(len(names), math.nan)
        self._begun = False

    def close(self) -> None:
        """Stop serving, and end the file."""
        self._open.close()

    def __exit__(self, *error: object) -> None:
        self.close()

    def begin(self, guard: Guard) -> None:
        """An episode begins."""
        self._time, self._begun = 0.0, False

    def seen(self, observation: NDArray[np.float64], time: float) -> None:
        """An observation came in."""
        if len(observation) != len(self._names):
            names = f"{len(self._names)} variables ({', '.join(self._names)})"
            fault = f"the sink is for {names}, and an observation has {len(observation)}"
            raise ValueError(f"{fault}; give FoxgloveSink their names=")
        self._time, self._observation = time, observation
        if not self._begun:
            self._begun = True
            self._event("episode started")

    def decided(self, situation: Situation, proposal: Proposal, revision: Revision) -> None:
        """A decision was made."""
        decision = Decision(situation, revision)
        for topic, columns in self._columns.items():
            self._send(topic, {name: column.read(decision) for name, column in columns.items()})
        is_changed = not same_action(revision.executed, revision.proposed)
        if is_changed or not same_action(revision.advised, revision.executed):
            verb = "executed" if is_changed else "would advise"
            instead = revision.executed if is_changed else revision.advised
            unit = " m/s²" if self._names == VARIABLES else ""
            text = f"proposed {action_text(revision.proposed)}, {verb} {action_text(instead)}{unit}"
            level = LogLevel.Warning if is_changed else LogLevel.Info
            self._note(level, f"{text}: {revision.reason}")

    def ended(
        self, observation: Any, *, failed: bool, terminated: bool, score: float | None
    ) -> None:
        """The episode ended."""
        if observation is not None:
            self._observation = observation
        if failed:
            kind = "collision" if self._names == VARIABLES else "failure"
            self._event(kind)
            self._note(LogLevel.Error, kind)
        self._event("episode ended")
        self._start = self._now() + _PAUSE
        self._episode += 1

    def _now(self) -> int:
        return self._start + round(self._time * _SECOND)

    def _event(self, kind: str) -> None:
        where = dict(zip(self._names, self._observation.tolist(), strict=False))
        event = {"kind": kind, "episode": self._episode, "time": self._time, **where}
        self._send("/event", event)

    def _note(self, level: LogLevel, text: str) -> None:
        stamp = Timestamp(*divmod(self._now(), _SECOND))
        entry = Log(timestamp=stamp, level=level, message=text, name="evofsm")
        self._log.log(entry, log_time=self._now())

    def _send(self, topic: str, message: Mapping[str, Any]) -> None:
        fields = {
            name: value
            for name, value in message.items()  # actions that are vectors are left to the log
            if isinstance(value, str | int | list)
            or (isinstance(value, float) and math.isfinite(value))
        }
        data = json.dumps(fields, ensure_ascii=False, allow_nan=False).encode()
        self._channels[topic].log(data, log_time=self._now())
        if self._file is not None and self._file.error is not None:
            raise self._file.error

"""Decisions of any guard live in Foxglove or Lichtblick, or as a file for it.

The channels are those of logs in MCAP (`evofsm.io.write_run`), and `FOXGLOVE_LAYOUT` shows both.
Foxglove's own library serves and writes; nothing leaves this computer unless another host is told.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import UNITS, VARIABLES
from evofsm.extras import needs
from evofsm.fsm import positive
from evofsm.guard import Decision, Guard, Proposal, Revision, Situation
from evofsm.io.channels import (
    ERROR,
    INFO,
    WARNING,
    encoded,
    is_same,
    log_message,
    messages_of,
    said,
    schemas_of,
)

with needs("foxglove-sdk", "foxglove", "a live view in Foxglove"):
    import foxglove
    from foxglove.websocket import ServerListener

#: A layout of cars, to be imported: *Layouts, Import from file*.
FOXGLOVE_LAYOUT = Path(__file__).with_name("foxglove_layout.json")

_SECOND = 1_000_000_000  # [ns]
# Between two episodes [s].
_PAUSE = 1.0


class _Arrivals(ServerListener):
    """Knows whether anybody has subscribed to anything."""

    def __init__(self) -> None:
        self.someone = threading.Event()

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Somebody looks on."""
        self.someone.set()


class FoxgloveSink:
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
    speed : float, optional
        Hold the run back to so many times real time, as a simulation would be over before anyone
        looks. Without it nothing waits.
    host : str
        Who may look on; only this computer, unless told otherwise.

    Raises
    ------
    ValueError
        If there is neither a port nor a file, or ``speed`` is not positive.
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
    >>> from pathlib import Path
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
        units: Sequence[str] = UNITS,
        speed: float | None = None,
        host: str = "127.0.0.1",
    ) -> None:
        if port is None and file is None:
            raise ValueError("a sink needs a port, a file, or both")
        self.names = tuple(names)
        self._unit = "m/s²" if self.names == VARIABLES else ""
        self._speed = None if speed is None else positive("speed", speed)
        self._arrivals = _Arrivals()
        self._open = ExitStack()
        context = self._context = foxglove.Context()  # its channels close with it
        self._channels = {
            topic: foxglove.Channel(topic, schema=schema, context=context)
            for topic, schema in schemas_of(self.names, units if self._unit else ()).items()
        }
        if file is not None:
            if Path(file).exists():
                raise FileExistsError(f"{fspath(file)} exists; it was left alone")
            self._open.enter_context(foxglove.open_mcap(fspath(file), context=context))
        #: Where it is served; None without a port.
        self.address: str | None = None
        if port is not None:
            server = foxglove.start_server(
                name="evofsm",
                host=host,
                port=port,
                context=context,
                server_listener=self._arrivals,
            )
            self._open.callback(server.stop)
            self.address = f"ws://{host}:{server.port}"
        # Live, a message is now; in a file time begins with 0.
        self._begin = 0 if port is None else time.time_ns()
        self._episodes = -1
        self._time = 0.0  # of the latest decision, in its episode [s]
        self._observation: NDArray[np.float64] = np.full(len(self.names), math.nan)
        self._due = math.nan  # when time 0 of the episode was, on the clock of this computer [s]

    def await_someone(self, timeout: float | None = None) -> bool:
        """Wait until somebody looks on.

        Parameters
        ----------
        timeout : float, optional
            At most so long [s].

        Returns
        -------
        bool
            Whether somebody does.
        """
        return self._arrivals.someone.wait(timeout)

    # -- As the decision logger of a guard --------------------------------------------------------

    def begin(self, guard: Guard) -> None:
        """An episode begins."""
        if self._episodes >= 0:
            self._begin += round((self._time + _PAUSE) * _SECOND)
        self._episodes += 1
        self._time, self._due = 0.0, math.nan

    def seen(self, observation: NDArray[np.float64], time: float) -> None:
        """An observation came in."""
        first = math.isnan(self._due)
        self._time, self._observation = time, observation
        self._keep_pace()
        if first:
            self._event("episode started")

    def decided(self, situation: Situation, proposal: Proposal, revision: Revision) -> None:
        """A decision was made."""
        decision = Decision(situation, revision)
        for topic, message in messages_of(decision, self.names):
            self._send(topic, message)
        changed = not is_same(revision.executed, revision.proposed)
        if changed or not is_same(revision.advised, revision.executed):
            self._log(WARNING if changed else INFO, said(revision, self._unit))

    def ended(self, observation: NDArray[np.float64] | None, *, failed: bool) -> None:
        """The episode ended."""
        if observation is not None:
            self._observation = observation
        if failed:
            kind = "collision" if self._unit else "failure"
            self._event(kind)
            self._log(ERROR, kind)
        self._event("episode ended")

    def close(self) -> None:
        """Stop serving, and end the file."""
        self._open.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # -- Sending ----------------------------------------------------------------------------------

    def _keep_pace(self) -> None:
        """Wait for what is to be shown now."""
        if self._speed is None:
            self._due = 0.0
            return
        now = time.monotonic()
        if math.isnan(self._due):
            self._due = now - self._time / self._speed
        time.sleep(max(0.0, self._due + self._time / self._speed - now))

    def _event(self, kind: str) -> None:
        where = dict(zip(self.names, self._observation.tolist(), strict=False))
        about = {"kind": kind, "episode": max(self._episodes, 0), "time": self._time}
        self._send("/event", {**about, **where})

    def _log(self, level: int, message: str) -> None:
        self._send("/log", log_message(level, self._now, message))

    @property
    def _now(self) -> int:
        return self._begin + round(self._time * _SECOND)

    def _send(self, topic: str, message: dict[str, Any]) -> None:
        numbers = {
            name: value for name, value in message.items() if not isinstance(value, np.ndarray)
        }
        self._channels[topic].log(encoded(numbers), log_time=self._now)

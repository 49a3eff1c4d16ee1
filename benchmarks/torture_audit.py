"""What interrupts, forgers and readers meanwhile do to an audit log; part of ``make torture``."""

from __future__ import annotations

import inspect
import logging
import math
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from evofsm.driving.judge import LatentRisk
from evofsm.fleet.sealed import NOTHING, ChainedFile, Head, Sync, records, seal, verify
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.machine import EvolvingFSM
from evofsm.guard.auditing.log import AuditLog
from evofsm.guard.auditing.replay import audit
from evofsm.guard.guard import Guard
from evofsm.guard.reviser import ActionReviser

#: What must not happen.
WRONG = ("broken logs", "forgeries that pass")

_ACTIONS = IntervalActions(-2.5, 2.5, 0.5, outside="clip")
# Functions in each line of which an interrupt comes.
_WRITING: tuple[Callable[..., Any], ...] = (
    AuditLog.begin,
    AuditLog.seen,
    AuditLog.decided,
    AuditLog.ended,
    AuditLog._write,
    AuditLog._flush,
    AuditLog._begin_anew,
    ChainedFile.append,
    ChainedFile.settle,
)


class _Interrupt(KeyboardInterrupt):
    pass


def _drive(log: AuditLog, decisions: int, machine: EvolvingFSM | None = None) -> None:
    """Approach a leader, so that the first decisions say nothing, and the others do."""
    risk = LatentRisk(_ACTIONS.low)
    reviser = ActionReviser(risk, _ACTIONS)
    guard = Guard.of(reviser, machine=machine, audit=log)
    for gap, when in zip(np.linspace(60.0, 5.0, decisions), np.arange(decisions), strict=True):
        guard.decide([gap, 15.0, 8.0], 0.0, 0.25 * when)
    guard.end(observation=[4.0, 15.0, 8.0])


# -- Interrupts -----------------------------------------------------------------------------------


@contextmanager
def _interrupt(at: int) -> Iterator[None]:
    """Ctrl-C before a line of what writes, or as one of its functions returns."""
    codes = {inspect.unwrap(function).__code__ for function in _WRITING}
    left = at

    def trace(frame: FrameType, event: str, argument: Any) -> Any:
        nonlocal left
        if frame.f_code not in codes:
            return None
        if event in ("line", "return"):
            left -= 1
            if left == -1:
                raise _Interrupt
        return trace

    sys.settrace(trace)
    try:
        yield
    finally:
        sys.settrace(None)


def interrupt(folder: Path, random: np.random.Generator, every: int = 1) -> Counter[str]:
    """Ctrl-C at a line of what writes a log, perhaps another soon after; then drive on into it.

    All lines in turn, or one of so many.
    """
    found: Counter[str] = Counter()
    logging.disable()  # each interrupt is an error that is logged
    for at in range(0, 100_000, every):
        path = folder / f"interrupted{at}.jsonl"
        with AuditLog(path, sync=Sync.EPISODE, most_quiet=2) as log:
            try:
                with _interrupt(at):
                    _drive(log, 6)
            except _Interrupt:
                found["interrupts"] += 1
            else:
                break
            with suppress(_Interrupt), _interrupt(int(random.integers(200))):
                _drive(log, 2)
            _drive(log, 6)
        found["broken logs"] += not audit(path, log.head).is_good
    logging.disable(logging.NOTSET)
    return found


# -- Forgers --------------------------------------------------------------------------------------


def forge(folder: Path, random: np.random.Generator) -> Counter[str]:
    """Forge a log and chain it anew, under each version that might switch a comparison off."""
    found: Counter[str] = Counter()
    whole, forged = folder / "whole.jsonl", folder / "forged.jsonl"
    with AuditLog(whole, sync=Sync.EPISODE) as log:
        machine = EvolvingFSM(_ACTIONS.n_actions, radius=4.0)
        for _ in range(3):
            _drive(log, 60, machine)
    found["broken logs"] += not audit(whole, log.head).is_good
    found["decisions"] = audit(whole).contents.spoke
    for version in (0, -7, 0.5, False, 1, None):
        for change in _CHANGES:
            _write_anew(whole, forged, version, change)
            found["forged logs"] += 1
            found["forgeries that pass"] += audit(forged).is_good
    return found


def _write_anew(
    whole: Path, forged: Path, version: object, change: Callable[[dict[str, Any]], None]
) -> None:
    head, lines = Head(0, NOTHING), []
    for record in records(whole, verify(whole).head.number or 0):
        content = dict(record.content)
        if content["kind"] == "start" and version is not None:
            content["version"] = version
        elif content["kind"] == "decision":
            change(content)
        line, head = seal(content, head)
        lines.append(line)
    forged.write_bytes(b"".join(lines))


def _other_action(content: dict[str, Any]) -> None:
    content["executed"] = -content["executed"]


def _one_bit(content: dict[str, Any]) -> None:
    content["executed"] = math.nextafter(content["executed"], math.inf)


def _other_reason(content: dict[str, Any]) -> None:
    content["reason"] = "the driver wished it"


def _other_explanation(content: dict[str, Any]) -> None:
    content["explanation"] = "all was well here"


def _without_explanation(content: dict[str, Any]) -> None:
    del content["explanation"]
    _one_bit(content)


def _more(content: dict[str, Any]) -> None:
    content["comment"] = "all was well here"


_CHANGES = (
    _other_action,
    _one_bit,
    _other_reason,
    _other_explanation,
    _without_explanation,
    _more,
)


# -- Readers meanwhile ----------------------------------------------------------------------------


def read_meanwhile(folder: Path, random: np.random.Generator, seconds: float) -> Counter[str]:
    """Audit a log again and again while another process writes it."""
    found: Counter[str] = Counter()
    path = folder / "growing.jsonl"
    with ChainedFile(path) as file:
        file.append({"kind": "note"})
    child = os.fork()
    if child == 0:
        _write_for_ever(path)
    until = time.monotonic() + seconds
    try:
        while time.monotonic() < until:
            found["audits meanwhile"] += 1
            found["broken logs"] += verify(path).finding is not None
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    found["broken logs"] += verify(path).finding is not None
    return found


def _write_for_ever(path: Path) -> None:
    """Notes of all lengths, until it is killed."""
    try:
        with ChainedFile(path) as file:
            for length in iter(lambda: (file.head.number or 0) * 7919 % 20_000, None):
                file.append({"kind": "note", "text": "x" * length})
                time.sleep(0.001)
    finally:
        os._exit(1)

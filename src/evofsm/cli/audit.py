"""`evofsm audit`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evofsm.cli.options import Json, imported
from evofsm.cli.show import facts, print_json, show

if TYPE_CHECKING:
    from evofsm.fleet.sealed import Chain
    from evofsm.guard import Audit as Audited
    from evofsm.guard import Contents, Replay

_KEEP = (
    "Keep the head where the log is not. Without it (--head) neither an end that is cut off nor a "
    "log that is written anew can be detected."
)
# So many fields that differ are shown, and so much of each.
_FIELDS, _LETTERS = 5, 40


def audit(
    file: Annotated[Path, typer.Argument(help="An audit log.")],
    head: Annotated[
        str | None,
        typer.Option(
            help="NUMBER:HASH of the last record at some time, kept elsewhere: shows an end that "
            "was cut off, and a log that was written anew."
        ),
    ] = None,
    replay: Annotated[
        bool, typer.Option(help="Whether to drive again, and compare every decision.")
    ] = True,
    failed: Annotated[
        str | None,
        typer.Option(
            help="MODULE:FUNCTION that told the guard where it fails, if one did: no log holds "
            "code."
        ),
    ] = None,
    as_json: Json = False,
) -> int:
    """Verify an audit log, and replay it.

    Finds the first record that was altered, removed, moved, repeated or inserted; then gives the
    machine and the risk that the log began with what was observed and proposed, and compares each
    decision to the last bit. Ends with 0 if all is well, 1 if the log was tampered with or a
    decision comes out otherwise, and 2 if it cannot be read.
    """
    from evofsm.fleet.sealed import Head
    from evofsm.guard import audit as examine

    found = examine(
        file,
        None if head is None else Head.parse(head),
        replay=replay,
        failed=None if failed is None else imported(failed),
    )
    if as_json:
        chain = found.chain
        parts = {name: getattr(found, name) for name in ("misfit", "remarks", "contents", "replay")}
        known = {"is_good": found.is_good, "head": str(chain.head), "finding": chain.finding}
        print_json({"file": file, **known, "half_written": chain.half_written, **parts})
    else:
        show(facts(str(file), list(_facts(found))))
        if found.is_good and head is None:
            show(f"\n{_KEEP}")
    return 0 if found.is_good else 1


def _facts(found: Audited) -> Iterator[tuple[str, str]]:
    """What was found, line by line."""
    chain, contents = found.chain, found.contents
    yield "chain", _of_chain(chain)
    if chain.half_written:
        cause = "as by a crash, or it is being written now"
        yield "", f"its last line is half written ({chain.half_written} bytes): {cause}"
    if found.misfit is not None:
        yield "form", f"FORGED at record {found.misfit.record}: {found.misfit.explanation}"
    yield "holds", _of_contents(contents) + ("" if chain.finding is None else ", so far")
    if found.replay is not None:
        yield from _of_replay(found.replay, contents.decisions)
    elif chain.finding is None and found.misfit is None:
        yield "replay", "not done"
    else:
        yield "replay", "not done, since the log was tampered with"
    yield from (("note", remark) for remark in found.remarks)
    if chain.finding is None:
        yield "head", str(chain.head)


def _of_chain(chain: Chain) -> str:
    if chain.finding is None:
        return f"unbroken: {_count(chain.head.number or 0, 'record')}"
    _, record, line, explanation = chain.finding
    return f"TAMPERED WITH at record {record} (line {line}): {explanation}"


def _of_contents(contents: Contents) -> str:
    decisions = _count(contents.decisions, "decision")
    parts = [
        _count(contents.sessions, "session"),
        _count(contents.episodes, "episode"),
        f"{decisions} ({contents.spoke:,} changed something or warned)",
    ]
    if contents.settings:
        parts.append(_count(contents.settings, "change of settings", "changes of settings"))
    return ", ".join(parts)


def _of_replay(replay: Replay, decisions: int) -> Iterator[tuple[str, str]]:
    difference = replay.difference
    good = f"{_count(replay.decisions, 'decision')} as recorded, to the last bit"
    if difference is None:
        yield "replay", good
    else:
        yield "replay", f"DIFFERS at record {difference.record}: {difference.explanation}"
        for name, recorded, replayed in difference.fields[:_FIELDS]:
            yield "", f"{name}: recorded {_short(recorded)}, replayed {_short(replayed)}"
        yield "", f"before it {good}"
    for why in dict.fromkeys(replay.not_replayed):
        yield "", f"{_count(replay.not_replayed.count(why), 'session')} not replayed: {why}"
    if difference is None and replay.decisions < decisions:
        yield "", f"{_count(decisions - replay.decisions, 'decision')} compared with nothing"
    if difference is not None and replay.other_makers:
        then = ", ".join(f"{one.name} {one.recorded}" for one in replay.other_makers)
        yield "", f"it was recorded with {then}: floats may differ there"


def _short(text: str) -> str:
    return text if len(text) <= _LETTERS else f"{text[: _LETTERS - 3]}..."


def _count(count: int, one: str, many: str = "") -> str:
    return f"{count:,} {one if count == 1 else many or one + 's'}"

"""`evofsm audit`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from evofsm.cli.options import Json, argument, imported, option
from evofsm.cli.show import facts, print_json, show

if TYPE_CHECKING:
    from evofsm.guard.replay import Audit

_KEEP = (
    "Keep the head where the log is not. Without it (--head) neither an end that is cut off nor a "
    "log that is written anew can be detected."
)
# So many fields that differ are shown, and so much of each.
_FIELDS, _LETTERS = 5, 40


def audit(
    file: Annotated[Path, argument("An audit log.")],
    head: Annotated[str | None, option("NUMBER:HASH of a record, kept elsewhere.")] = None,
    failed: Annotated[
        str | None, option("MODULE:FUNCTION, if the guard was given it as failed=.")
    ] = None,
    as_json: Json = False,
) -> int:
    """Verify an audit log, and replay it.

    Finds the first record that was altered, removed, repeated or inserted; then gives the guard
    that the log began with what was observed and proposed, and compares each decision to the last
    bit. Ends with 0 if all is well, 1 if the log was tampered with or a decision comes out
    otherwise, and 2 if it cannot be read.
    """
    from evofsm.guard import Head
    from evofsm.guard import audit as examine

    found = examine(
        file,
        None if head is None else Head.parse(head),
        failed=None if failed is None else imported(failed),
    )
    if as_json:
        told = {**found._asdict(), "head": str(found.head), "is_good": found.is_good}
        print_json({"file": file, **told})
    else:
        show(facts(str(file), list(_facts(found))))
        if found.is_good and head is None:
            show(f"\n{_KEEP}")
    return 0 if found.is_good else 1


def _facts(found: Audit) -> Iterator[tuple[str, str]]:
    from evofsm.fsm.validation import counted

    finding, contents = found.finding, found.contents
    if finding is None:
        yield "chain", f"unbroken: {counted(found.head.number, 'record')}"
    else:
        yield "chain", f"TAMPERED WITH at record {finding.record}: {finding.explanation}"
    if found.half_written:
        cause = "as by a crash, or it is being written now"
        yield "", f"its last line is half written ({found.half_written} bytes): {cause}"
    held = f"{counted(contents.sessions, 'session')}, {counted(contents.episodes, 'episode')}, "
    held += counted(contents.decisions, "decision")
    held += f" ({contents.spoke:,} changed something or warned)"
    if contents.settings:
        held += f", {counted(contents.settings, 'setting change')}"
    yield "holds", held + ("" if finding is None else ", so far")
    yield from _of_replay(found)
    if finding is None:
        yield "head", str(found.head)


def _of_replay(found: Audit) -> Iterator[tuple[str, str]]:
    from evofsm.fsm.validation import counted

    difference, replayed = found.difference, found.replayed
    decisions = found.contents.decisions
    good = f"{counted(replayed, 'decision')} as recorded, to the last bit"
    if difference is None:
        yield "replay", good
    else:
        yield "replay", f"DIFFERS at record {difference.record}: {difference.explanation}"
        for name, recorded, again in difference.fields[:_FIELDS]:
            yield "", f"{name}: recorded {_short(recorded)}, replayed {_short(again)}"
        yield "", f"before it {good}"
    for why in dict.fromkeys(found.not_replayed):
        yield "", f"{counted(found.not_replayed.count(why), 'session')} not replayed: {why}"
    if difference is None and replayed < decisions:
        yield "", f"{counted(decisions - replayed, 'decision')} compared with nothing"
    if difference is not None and found.other_makers:
        then = ", ".join(f"{field.name} {field.recorded}" for field in found.other_makers)
        yield "", f"it was recorded with {then}: floats may differ there"


def _short(text: str) -> str:
    return text if len(text) <= _LETTERS else f"{text[: _LETTERS - 3]}..."

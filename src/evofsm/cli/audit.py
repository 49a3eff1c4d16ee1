"""`evofsm audit` and `evofsm check`: whether a log, or a class, is as it should be."""

from __future__ import annotations

import re
from base64 import b64decode
from collections import deque
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from evofsm.cli.options import Json, argument, imported, option

if TYPE_CHECKING:
    from evofsm.guard.audit_log import Audit

_KEEP = (
    "Keep the head where the log is not. Without it (--head) neither an end that is cut off nor a "
    "log that is written anew can be detected."
)
_FIELDS = 5  # so many fields that differ are shown


def audit(
    file: Annotated[Path, argument("An audit log.")],
    head: Annotated[str | None, option("NUMBER:HASH of a record, kept elsewhere.")] = None,
    failed: Annotated[
        str | None, option("MODULE:FUNCTION, or a condition, that the guard was given.")
    ] = None,
    as_json: Json = False,
) -> int:
    """Verify an audit log, and replay it.

    Finds the first record that was altered, removed, repeated or inserted; then gives the guard
    that the log began with what was observed and proposed, and compares each decision to the last
    bit. Ends with 0 if all is well, 1 if the log was tampered with or a decision comes out
    otherwise, and 2 if it cannot be read.
    """
    from evofsm.cli.show import facts, print_json, show
    from evofsm.guard import Head
    from evofsm.guard import audit as examine

    report = examine(
        file,
        None if head is None else Head.parse(head),
        failed=None if failed is None else _failure(file, failed),
    )
    if as_json:
        document = {**report._asdict(), "head": str(report.head), "is_good": report.is_good}
        print_json({"file": file, **document})
    else:
        show(facts(str(file), list(_facts(report))))
        if report.is_good and head is None:
            show(f"\n{_KEEP}")
    return 0 if report.is_good else 1


def _failure(file: Path, text: str) -> Any:
    """What a name stands for, or a condition of what the guard that the log began with observes."""
    from evofsm.cli.models import failure, load_guard
    from evofsm.guard.audit_log import Chain

    if re.fullmatch(r"[\w.]+:[\w.]+", text):
        return imported(text)
    records = (chain := Chain(file)).records()
    first, *_ = next(records, None), deque(records, maxlen=0)
    if chain.finding or not (data := first and first.content.get("guard")):
        return None  # the examination says it
    names = load_guard(BytesIO(b64decode(data))).variables
    if (condition := failure(text, names)) is None:
        fault = f"the guard in {file} observes {', '.join(names) or 'what has no names'}"
        raise ValueError(f"--failed {text} is of other columns: {fault}")
    return condition


def _facts(found: Audit) -> Iterator[tuple[str, str]]:
    from evofsm.fsm.validation import counted

    breach, contents = found.finding, found.contents
    if breach is None:
        yield "chain", f"unbroken: {counted(found.head.number, 'record')}"
    else:
        yield "chain", f"TAMPERED WITH at record {breach.record}: {breach.explanation}"
    if found.half_written:
        cause = "as by a crash, or it is being written now"
        yield "", f"its last line is half written ({found.half_written} bytes): {cause}"
    text = f"{counted(contents.sessions, 'session')}, {counted(contents.episodes, 'episode')}, "
    text += counted(contents.decisions, "decision")
    text += f" ({contents.spoke:,} changed something or warned)"
    if contents.settings:
        text += f", {counted(contents.settings, 'setting change')}"
    yield "holds", text if breach is None else f"{text}, so far"
    difference, n_matches = found.difference, found.replayed
    text = f"{counted(n_matches, 'decision')} as recorded, to the last bit"
    if difference is None:
        yield "replay", text
    else:
        yield "replay", f"DIFFERS at record {difference.record}: {difference.explanation}"
        for name, original, replay in difference.fields[:_FIELDS]:
            yield "", f"{name}: recorded {original}, replayed {replay}"
        yield "", f"before it {text}"
    for why in dict.fromkeys(found.not_replayed):
        yield "", f"{counted(found.not_replayed.count(why), 'session')} not replayed: {why}"
    if difference is None and n_matches < contents.decisions:
        yield "", f"{counted(contents.decisions - n_matches, 'decision')} compared with nothing"
    if difference is not None and found.other_makers:
        makers = ", ".join(f"{field.name} {field.recorded}" for field in found.other_makers)
        yield "", f"it was recorded with {makers}: floats may differ there"
    if breach is None:
        yield "head", str(found.head)


def check(
    name: Annotated[str, argument("module:Class, module:instance, or a function that makes one.")],
    as_json: Json = False,
) -> int:
    """Check a class of your own against the contract of its kind.

    A state rule, a reviser, a controller or a judge; its methods tell which. The module is
    imported, from the present folder too, so that its code is run: check code that you trust. Ends
    with 1 if a check fails.
    """
    from rich.padding import Padding

    from evofsm.cli.show import print_json, say, show
    from evofsm.guard.check import check_results, kind_of

    part = imported(name)
    kind, results = kind_of(part), check_results(part)
    failed = sum(not result.passed for result in results)
    if as_json:
        print_json(results)
    else:
        say(f"{name}, checked against the contract of a {kind}")
        for result in results:
            say(f"  {'passed' if result.passed else 'failed'}  {result.check}")
            if result.message:
                show(Padding(result.message, (0, 0, 0, 10)))
        say(f"{len(results)} checks: {len(results) - failed} passed, {failed} failed")
    return int(failed > 0)

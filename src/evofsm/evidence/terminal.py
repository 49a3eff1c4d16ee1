"""Say in the terminal what studies found."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Console
from rich.padding import Padding

from evofsm.app import (
    NONE,
    count,
    interval,
    number,
    percent,
    percents,
    print_columns,
    print_table,
)
from evofsm.evidence.closed_loop.comparison import Line, has_third_car, table_groups
from evofsm.evidence.closed_loop.study import ClosedLoop
from evofsm.evidence.report.asked import tables_of_asked
from evofsm.evidence.report.beside import side_tables
from evofsm.evidence.report.chapter import Chapter
from evofsm.evidence.report.comparison import answer, note_on_the_table, what_was_asked
from evofsm.evidence.report.losses import InWords, losses_in_words

# Of the tables beside, those that are short enough.
_IN_THE_TERMINAL = ("shift", "separation", "cases", "worlds")


def print_closed_loop(out: Console, study: ClosedLoop) -> None:
    """Print the table of the closed-loop study, where ours loses, and short tables beside it."""
    out.print(f"Closed loop on {study.family.name}", style="bold")
    for sentence in answer(study):
        out.print(sentence)
    out.print()
    columns = len(_POLICY_HEADER) - (not has_third_car(study))
    cells: list[tuple[str, ...]] = []
    styles, headings = {}, {}
    for group, lines in table_groups(study):
        headings[len(cells)] = group
        for line in lines:
            if line.is_ours:
                styles[len(cells)] = "bold"
            cells.append(_policy_cells(line)[:columns])
    print_columns(out, _POLICY_HEADER[:columns], cells, styles=styles, headings=headings)
    out.print(
        "\n> is ours. Change in m/s², RMS jerk in m/s³; learning: collisions while learning. "
        f"{note_on_the_table(study)}\n"
    )
    for table in tables_of_asked(what_was_asked(study)):
        print_table(out, table)
    _print_losses(out, losses_in_words(study))
    for name, table in side_tables(study).items():
        if name in _IN_THE_TERMINAL:
            print_table(out, table)


_POLICY_HEADER = (
    "policy",
    "collisions\n[%] (95 %)",
    "mobility\n(95 %)",
    "inter-\nvened",
    "mean\nchange",
    "RMS\njerk",
    "until\nsafe",
    "learn-\ning",
    "rear\nends",
)


def _policy_cells(line: Line) -> tuple[str, ...]:
    """A line of the table, shorter than on the page."""
    which = {"median": "median", "worst seed": "worst"}.get(line.which)
    rates = percents(line.collision_low, line.collision_high)
    ends = interval(line.mobility_low, line.mobility_high, lambda x: number(x, 2).lstrip("0"))
    return (
        f"> {line.train_episodes} ep. {which}" if line.is_ours else line.policy,
        f"{percent(line.collision_rate, '')} {rates}".replace("100.0", "100"),
        f"{number(line.mobility, 3)} {ends}",
        percent(line.intervention_rate, "%").replace("100.0", "100"),
        number(line.mean_change, 2),
        number(line.jerk, 2),
        "never" if math.isinf(line.until_safe) else count(line.until_safe),
        NONE if math.isnan(line.train_collisions) else count(line.train_collisions),
        count(line.rear_ends),
    )


def print_chapter(out: Console, chapter: Chapter) -> None:
    """Print what a study found, its tables, and where it loses."""
    out.print(chapter.title, style="bold")
    out.print(chapter.headline)
    for sentence in chapter.answer:
        out.print(sentence)
    out.print()
    for one in chapter.tables:
        print_table(out, one)
    out.print("Where it loses", style="bold")
    for loss in chapter.losses or ("nowhere in these tables",):
        _print_indented(out, loss)
    out.print()


def print_headlines(out: Console, chapters: Sequence[Chapter]) -> None:
    """Print of each study what it asks, and the answer in a line."""
    for chapter in chapters:
        out.print(chapter.title, style="bold")
        text = f"{chapter.mark} {chapter.headline}".strip()
        _print_indented(out, text, "bold red" if chapter.fails else "")
    out.print()


def _print_indented(out: Console, text: str, style: str = "") -> None:
    out.print(Padding(text, (0, 0, 0, 2)), style=style)


def _print_losses(out: Console, lost: Sequence[InWords]) -> None:
    """Print where ours loses: loud things one by one, the others by their number."""
    out.print("Where it loses", style="bold")
    loud = [loss for loss in lost if loss.loud]
    for loss in loud:
        text = f"! {loss.what}: {loss.who}, {loss.theirs}, against {loss.ours} of ours"
        out.print(text, style="bold red")
    quiet: dict[str, list[str]] = {}
    for loss in lost:
        if not loss.loud:
            quiet.setdefault(loss.what, []).append(loss.who.partition(" (")[0])
    for what, who in quiet.items():
        _print_indented(out, f"{what}: {', '.join(who)}")
    if not lost:
        out.print("  nowhere in these tables")
    out.print()

"""Say what came of driving, in the terminal and to programs."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Any

from rich.console import Console

from evofsm.cli.driving import Driving, Setup
from evofsm.cli.text.columns import print_columns, print_facts
from evofsm.driving import TOLD, LatentRisk, Row, learners_of
from evofsm.guard import Guard, LearntRisk

# More states than these are not listed.
_MOST = 8
_DEAD_END_HEADER = (
    *("state", "gap [m]", "follower [m/s]", "leader [m/s]", "survives [m/s²]"),
    *("risk if\nbraking", "escape\nmargin", "seen [s]", "ended\nhere"),
)


def print_driving(out: Console, driving: Driving, setup: Setup) -> None:
    """Print collisions and their price, what was learnt, and the dead ends that were found."""
    print_outcome(out, driving.row, driving.lead_times, driving.guard, setup)
    _print_dead_ends(out, driving)


def print_outcome(
    out: Console, row: Row, lead_times: Sequence[float], guard: Guard, setup: Setup
) -> None:
    """Print collisions and their price, and what was learnt."""
    facts = [
        ("family", f"{row.family}, {row.episodes:,} {_kind(setup)} episodes"),
        ("controller", setup.controller),
        ("reviser", f"{setup.reviser}, {setup.mode.value}"),
        ("judge", f"{setup.judge}, told {TOLD[setup.judge]}"),
        (
            "collisions",
            f"{row.collisions:,} of {row.episodes:,}: {row.collision_rate:.1%} "
            f"(95 %: {row.collision_low:.1%} to {row.collision_high:.1%})",
        ),
        ("rate", str(row.failures)),
        *([("rear-ended", f"{row.rear_ends}")] if row.rear_ends else []),
        ("mobility", f"{row.mobility:.2f} of the way that the controller makes by itself"),
        (
            "interventions",
            f"{row.intervention_rate:.1%} of decisions; mean change {row.mean_change:.2f} m/s²",
        ),
        ("comfort", f"RMS jerk {row.jerk:.2f} m/s³"),
        *_lead_times(lead_times),
        ("learnt", _learnt(guard)),
    ]
    print_facts(out, "What came of driving", facts)


def _kind(setup: Setup) -> str:
    return "training" if setup.learn else "held-out"


def _lead_times(times: Sequence[float]) -> list[tuple[str, str]]:
    if not times:
        return []
    warned = sum(time > 0.0 for time in times)
    text = f"{warned} of {len(times)} collisions had an alarm that stayed on"
    return [("lead time", f"{text}; median {median(times):.1f} s before")]


def _learnt(guard: Guard) -> str:
    machine, judge = learners_of(guard)
    states = f"{machine.n_states} states"
    if isinstance(judge, LearntRisk):
        return f"{states}; {judge.told_by_experience}"
    if not isinstance(judge, LatentRisk):
        return states
    brakes = judge.brakes
    own = f"{brakes.decel:.1f} m/s²" if brakes.known else "not known yet"
    return (
        f"{states}; {len(judge.manoeuvres)} manoeuvres of leaders, "
        f"1 % brake harder than {judge.manoeuvres.exceeded_by(0.01):.1f} m/s²; own brakes: {own}"
    )


def _print_dead_ends(out: Console, driving: Driving) -> None:
    """Those that were seen longest, and what could still be survived in them."""
    machine, judge = learners_of(driving.guard)
    if not isinstance(judge, LatentRisk):
        _print_failures(out, driving)
        return
    dead_ends = sorted(
        (state for state in driving.states if state.is_dead_end), key=lambda state: -state.seconds
    )
    if not dead_ends:
        out.print(f"No dead ends among the {len(driving.states)} states.")
        return
    out.print(f"Dead ends: {len(dead_ends)} of {len(driving.states)} states; seen longest:")
    centers = machine.centers
    rows = [
        (
            f"#{state.state + 1}",
            *(f"{value:.1f}" for value in centers[state.state]),
            f"{state.critical:.1f}",
            f"{state.risk:.0%}",
            f"{state.margin:.0%}",
            f"{state.seconds:.1f}",
            f"{state.failures:g}",
        )
        for state in dead_ends[:_MOST]
    ]
    print_columns(out, _DEAD_END_HEADER, rows)
    out.print(
        "\nDead end: if the leader braked hard now, braking in full would most likely be too late. "
        "survives: the hardest braking of a leader that braking in full now still survives; "
        "escape margin: how much lower the risk then is than if speed is kept; ended here: "
        "collisions.",
        style="dim",
    )


def _print_failures(out: Console, driving: Driving) -> None:
    """States in which episodes failed, where no judge says which are dead ends."""
    machine, _ = learners_of(driving.guard)
    failed = [state for state in driving.states if state.failures]
    if not failed:
        out.print(f"No episode ended in failure in any of the {len(driving.states)} states.")
        return
    header = (*_DEAD_END_HEADER[:4], "seen [s]", "began\nhere", "ended\nhere")
    rows = [
        (
            f"#{one.state + 1}",
            *(f"{value:.1f}" for value in machine.centers[one.state]),
            f"{one.seconds:.1f}",
            f"{machine.onsets[one.state]:g}",
            f"{one.failures:g}",
        )
        for one in sorted(failed, key=lambda one: -one.failures)[:_MOST]
    ]
    out.print(f"Collisions ended in {len(failed)} of {len(driving.states)} states:")
    print_columns(out, header, rows)
    out.print(
        "\nbegan here: disturbances, that is, what was not expected and went on for a while; "
        "ended here: collisions.",
        style="dim",
    )


def driving_document(driving: Driving) -> dict[str, Any]:
    """All that `print_driving` prints, for JSON; states from 0."""
    states = [{**state._asdict(), "is_dead_end": state.is_dead_end} for state in driving.states]
    return {**driving.row.as_dict(), "lead_times": list(driving.lead_times), "states": states}

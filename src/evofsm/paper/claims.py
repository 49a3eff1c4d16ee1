"""The paper's claims, held against the runs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.validation import state_name
from evofsm.paper.runs import PaperStudy, Run

#: In which cases the paper saw a collision.
_COLLIDES = {1: True, 2: False, 3: False, 4: True}
_STATES = 7
#: The paper's bound on the divergence of forecast and recognised state [bit].
LARGEST_DIVERGENCE = 0.15


class Claim(NamedTuple):
    """One claim of the paper, and what was measured."""

    id: str
    claim: str
    paper: str
    measured: str
    holds: bool


def check_claims(study: PaperStudy) -> tuple[Claim, ...]:
    """Every claim of the paper's Section 3, with a verdict each."""
    parts = _of_collisions, _of_states, _of_the_dead_end, _of_divergence
    return tuple(claim for part in parts for claim in part(study))


def _of_collisions(study: PaperStudy) -> Iterator[Claim]:
    as_in_paper = sum(run.episode.collided == _COLLIDES[run.case] for run in study.runs)
    yield Claim(
        "collisions_by_case",
        "Collision in cases 1 and 4, none in cases 2 and 3",
        "yes, no, no, yes",
        f"{', '.join(_outcome(run) for run in study.last_round)}; so in {as_in_paper} of "
        f"{len(study.runs)} runs; cases 2 and 3 "
        f"{'are safe' if study.is_safe_at_the_end else 'have collided'} at "
        f"{study.settings.safe_until:g} s",
        as_in_paper == len(study.runs) and study.is_safe_at_the_end,
    )
    for time, run in zip(study.settings.brake_at, study.extra_runs, strict=True):
        at_brake = run.state[_brakes(study, run)][:1].tolist()
        outcome = "the leader did not brake"
        if at_brake:
            end = f"collision at {run.episode.time[-1]:.1f} s, in {state_name(run.state[-1])}"
            fate = end if run.episode.collided else "no collision"
            outcome = f"{state_name(at_brake[0])} at the brake; {fate}"
        yield Claim(
            f"brake_at_{time:g}",
            f"Leader brakes at {time:g} s, in the dead end: collision",
            "collision",
            outcome,
            run.episode.collided and at_brake == [study.dead_end],
        )


def _of_states(study: PaperStudy) -> Iterator[Claim]:
    counts = [int(run.n_states[-1]) for run in study.runs]
    yield Claim(
        "states_after_each_run",
        "States are created in the first four runs, then none",
        "0 to 7 in 4 runs, 7 after 80",
        f"{', '.join(map(str, counts[:4]))} after runs 1 to 4, {counts[-1]} after {len(counts)}",
        len(set(counts[3:])) == 1 and counts == sorted(counts),
    )
    text, is_met = "Number of states at the end", counts[-1] == _STATES
    yield Claim("states_final", text, str(_STATES), str(counts[-1]), is_met)


def _of_the_dead_end(study: PaperStudy) -> Iterator[Claim]:
    collisions = [run for run in study.runs if run.episode.collided]
    at_collisions = sorted({int(run.state[-1]) for run in collisions})
    yield Claim(
        "dead_end_state",
        f"One and the same state at every collision of the {len(study.runs)} runs, the dead end "
        "(numbers: order of creation)",
        "#3",
        ", ".join(map(state_name, at_collisions)) or "no collision",
        len(at_collisions) == 1,
    )
    inside = sum(int(run.state[-1]) == study.dead_end for run in collisions)
    yield Claim(
        "dead_end_share",
        "Share of collisions recognised as the dead end",
        "all",
        f"{inside} of {len(collisions)}",
        0 < inside == len(collisions),
    )
    text = "Case 3 leaves the dead end when its driver turns normal"
    yield Claim("case3_leaves_dead_end", text, "yes", *_change(study, 3, leaves=True))
    text = "Case 4 comes to the dead end when its driver turns aggressive"
    yield Claim("case4_enters_dead_end", text, "yes", *_change(study, 4, leaves=False))


def _of_divergence(study: PaperStudy) -> Iterator[Claim]:
    largest = [float(np.nanmax(run.surprise)) for run in study.last_round]
    yield Claim(
        "jsd_max_by_case",
        "Largest divergence of forecast and recognised state, but for a run's first, "
        "in the last round",
        f"< {LARGEST_DIVERGENCE} in all cases",
        ", ".join(f"{value:.3f}" for value in largest) + " bit",
        max(largest) < LARGEST_DIVERGENCE,
    )


def _change(study: PaperStudy, case: int, *, leaves: bool) -> tuple[str, bool]:
    """What the driver's change did in the last round, and whether it did so in every round."""
    runs = [run for run in study.runs if run.case == case]
    switch = study.settings.switch_at[case]
    as_in_paper = 0
    for run in runs:
        inside = run.state == study.dead_end
        row = min(int(np.searchsorted(run.episode.time, switch)), len(inside) - 1)
        change_row = row + int(np.argmax(inside[row:] != inside[row]))  # `row` where it never does
        as_in_paper += bool(inside[row] == leaves and inside[change_row] != leaves != inside[-1])
    text = f"{state_name(run.state[row])} at {switch:g} s"
    if change_row > row:
        text += f", {state_name(run.state[change_row])} from {run.episode.time[change_row]:.1f} s"
        if len(rows := _brakes(study, run, change_row)):
            text += f", after the leader's full brake at {run.episode.time[rows[0]]:.1f} s"
    return f"{text}; so in {as_in_paper} of {len(runs)} rounds", as_in_paper == len(runs)


def _brakes(study: PaperStudy, run: Run, end: int | None = None) -> NDArray[np.intp]:
    """Rows before an end at which the leader brakes in full."""
    decel = study.settings.scenario.leader.brake_decel
    return np.flatnonzero(run.episode.leader_accelerations[:end] == -decel)


def _outcome(run: Run) -> str:
    return f"yes ({run.episode.time[-1]:.1f} s)" if run.episode.collided else "no"

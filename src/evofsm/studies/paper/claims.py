"""The paper's claims, held against the runs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from evofsm.studies.paper.runs import PaperStudy, Run

#: In which cases the paper saw a collision.
_COLLIDES = {1: True, 2: False, 3: False, 4: True}
_STATES = 7
#: The paper's bound on the divergence of forecast and recognised state [bit].
LARGEST_DIVERGENCE = 0.15


@dataclass(frozen=True)
class Claim:
    """One claim of the paper, and what was measured."""

    id: str
    claim: str
    paper: str
    measured: str
    holds: bool


def check_claims(study: PaperStudy) -> tuple[Claim, ...]:
    """Every claim of the paper's Section 3, with a verdict each."""
    return tuple(_claims(study))


def _claims(study: PaperStudy) -> Iterator[Claim]:
    dead_end = f"#{study.dead_end + 1}" if study.dead_end >= 0 else "none"
    counts = [int(run.n_states[-1]) for run in study.runs]

    pattern = all(run.episode.collided == _COLLIDES[run.case] for run in study.runs)
    yield Claim(
        "collisions_by_case",
        "The follower collides in cases 1 and 4, and not in cases 2 and 3",
        "yes, no, no, yes",
        ", ".join(_outcome(run) for run in study.last_round)
        + f" (in every round: {_yes(pattern)}); at {study.settings.safe_until:g} s cases 2 and 3 "
        + ("are still safe" if all(study.safe_at_the_end.values()) else "have collided"),
        pattern and all(study.safe_at_the_end.values()),
    )
    for time, run in zip(study.settings.brake_at, study.extra_runs, strict=True):
        state = int(run.state[_brake_row(run)])
        yield Claim(
            f"brake_at_{time:g}",
            f"Case 1 with the leader's full brake at {time:g} s: recognised as the dead end, "
            "and a collision",
            "dead end, collision",
            f"#{state + 1} at the brake, {_outcome(run)}",
            run.episode.collided and state == study.dead_end,
        )
    yield Claim(
        "states_after_each_run",
        "States are founded in the first four runs and then no more",
        "0 to 7 in four runs, then none in 80",
        f"{', '.join(map(str, counts[:4]))} after runs 1 to 4, {counts[-1]} after {len(counts)}",
        len(set(counts[3:])) == 1 and counts == sorted(counts),
    )
    yield Claim(
        "states_final",
        "Number of states at the end",
        str(_STATES),
        str(counts[-1]),
        counts[-1] == _STATES,
    )
    collisions = [run for run in study.runs if run.episode.collided]
    at_collisions = sorted({int(run.state[-1]) for run in collisions})
    yield Claim(
        "dead_end_state",
        "One and the same state stands at every collision (its number tells only the order of "
        "founding)",
        "#3",
        ", ".join(f"#{state + 1}" for state in at_collisions) or "no collision",
        len(at_collisions) == 1,
    )
    inside = sum(int(run.state[-1]) == study.dead_end for run in collisions)
    yield Claim(
        "dead_end_share",
        "Share of collisions that are recognised as it",
        "all",
        f"{inside} of {len(collisions)} in {dead_end}",
        0 < inside == len(collisions),
    )
    yield _claim_of_change(
        study,
        3,
        "case3_leaves_dead_end",
        "Case 3 leaves the dead end after its driver turns normal",
        leaves=True,
    )
    yield _claim_of_change(
        study,
        4,
        "case4_enters_dead_end",
        "Case 4 comes to the dead end after its driver turns aggressive",
        leaves=False,
    )
    largest = [float(np.nanmax(run.surprise)) for run in study.last_round]
    yield Claim(
        "jsd_max_by_case",
        "Divergence of forecast and recognised state, but for a run's first, largest by case in "
        "the last round",
        f"below {LARGEST_DIVERGENCE} in all cases",
        ", ".join(f"{value:.3f}" for value in largest) + " bit",
        max(largest) < LARGEST_DIVERGENCE,
    )


def _claim_of_change(study: PaperStudy, case: int, id_: str, text: str, leaves: bool) -> Claim:
    """Whether the state is the dead end on one side of the driver's change, not on the other.

    The verdict is on all runs of the case, but for the first round, in which states are founded.
    """
    switch = study.settings.switch_at[case]
    trained = [run for run in study.runs if run.case == case and run.round > 1]
    trained = trained or [study.last_round[case - 1]]
    holds = True
    for run in trained:
        in_dead_end = run.state == study.dead_end
        row = int(np.searchsorted(run.episode.time, switch))
        at_switch = bool(in_dead_end[row])
        changed = row + np.flatnonzero(in_dead_end[row:] != at_switch)
        holds &= at_switch == leaves and len(changed) > 0 and in_dead_end[-1] != leaves
        after = run.state[changed[0]] if len(changed) else run.state[-1]
        when = run.episode.time[changed[0]] if len(changed) else float("nan")
        measured = f"#{run.state[row] + 1} at {switch:g} s, #{after + 1} from {when:.1f} s"
    return Claim(
        id_, text, "yes", f"{measured} (in {len(trained)} rounds: {_yes(bool(holds))})", bool(holds)
    )


def _outcome(run: Run) -> str:
    return f"yes ({run.episode.time[-1]:.1f} s)" if run.episode.collided else "no"


def _yes(fact: bool) -> str:
    return "yes" if fact else "no"


def _brake_row(run: Run) -> int:
    """First row at which the leader brakes."""
    return int(np.argmin(run.episode.leader_accelerations >= 0.0))

"""The contract of a reviser: whatever is proposed, what is executed can be."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from evofsm.checks.contracts import Broken, Contract, drive, frozen, insist, refuse_growth, same
from evofsm.checks.kinds import Make
from evofsm.guard import Proposal, Revision, Situation

CONTRACT = Contract()
_DT = 0.25
_PROPOSED = (0.0, 1.0, -1.0, 2.0, -2.5, 0.31)
_IMPOSSIBLE = (math.nan, math.inf, -math.inf, 1e9, -1e9)


def _situation(observation: Any, k: int) -> Situation:
    """As a machine of one state recognises it, which every machine has; of none at first."""
    return Situation(observation, np.ones(1), None if k == 0 else 0, math.nan, k * _DT)


def _revisions(reviser: Any, seed: int = 0, rows: int = 30) -> list[Revision]:
    """What it makes of proposals in a drive."""
    return [
        reviser.revise(_situation(row.copy(), k), Proposal(_PROPOSED[k % len(_PROPOSED)]))
        for k, row in enumerate(drive(rows, seed))
    ]


def _judge(revisions: list[Revision]) -> list[tuple[Any, ...]]:
    return [
        (r.executed, r.proposed, r.risk_proposed, r.risk_executed, r.reason, r.advised)
        for r in revisions
    ]


def _insist_executable(reviser: Any, executed: object, proposed: float) -> None:
    insist(
        isinstance(executed, float) and math.isfinite(executed),
        f"for a proposal of {proposed} it executes {executed!r}; it must be a finite float",
    )
    actions = getattr(reviser, "actions", None)
    if actions is not None:
        insist(
            actions.low <= executed <= actions.high,
            f"for a proposal of {proposed} it executes {executed}, outside its set of actions "
            f"[{actions.low:g}, {actions.high:g}]",
        )


@CONTRACT.clause()
def executes_what_can_be(make: Make) -> None:
    """What it executes is a finite number within its `actions`, where it has them."""
    reviser = make()
    for row, proposed in zip(drive(30), (*_PROPOSED, 5.0, -9.0) * 4, strict=False):
        candidates = (0.5, -40.0, 40.0)
        revision = reviser.revise(_situation(row, 5), Proposal(proposed, candidates))
        insist(isinstance(revision, Revision), f"revise returns {revision!r}, not a Revision")
        _insist_executable(reviser, revision.executed, proposed)


@CONTRACT.clause()
def copes_with_no_number(make: Make) -> None:
    """NaN, infinity or something huge as a proposal is no reason to fail: somebody has to drive."""
    for proposed in _IMPOSSIBLE:
        reviser = make()
        try:
            revision = reviser.revise(_situation(drive(1)[0], 1), Proposal(proposed, (math.nan,)))
        except Exception as error:
            raise Broken(
                f"a proposal of {proposed} raises {error!r}; a controller that failed must not "
                "take the reviser down"
            ) from error
        _insist_executable(reviser, revision.executed, proposed)


@CONTRACT.clause()
def reports_what_it_did(make: Make) -> None:
    """A revision holds the proposal as it was made, a reason, and probabilities in order."""
    reviser = make()
    for k, row in enumerate(drive(20)):
        proposed = (*_PROPOSED, 7.0, math.nan)[k % 8]
        revision = reviser.revise(_situation(row, k), Proposal(proposed))
        insist(
            same(revision.proposed, proposed),
            f"it reports {revision.proposed} as proposed; the controller proposed {proposed} "
            "(what was asked for, not what it was made into)",
        )
        insist(
            isinstance(revision.reason, str) and revision.reason,
            "it gives no reason, and a driver would not learn why",
        )
        risks = (revision.risk_proposed, revision.risk_executed, *revision.interval)
        insist(
            all(math.isnan(risk) or 0.0 <= risk <= 1.0 for risk in risks),
            f"its risks and their interval are {risks}; probabilities lie in [0, 1], or are NaN",
        )
        low, high = revision.interval
        insist(not low > high, f"its interval goes from {low} to {high}")


@CONTRACT.clause()
def inputs_not_changed(make: Make) -> None:
    """Observation and belief stay as they are."""
    reviser = make()
    for k, row in enumerate(drive(20)):
        given = _situation(row.copy(), k)
        belief = given.belief.copy()
        reviser.revise(given, Proposal(1.0))
        insist(same(given.observation, row), "revise changed the observation")
        insist(same(given.belief, belief), "revise changed the belief")
        fixed = given._replace(observation=frozen(row), belief=frozen(belief))
        reviser.revise(fixed, Proposal(1.0))


@CONTRACT.clause()
def inputs_not_kept(make: Make) -> None:
    """An array may be used again by its owner once it was seen."""
    reviser, other = make(), make()
    buffer = np.empty(3)
    found = []
    for k, row in enumerate(drive(30)):
        buffer[:] = row
        proposal = Proposal(_PROPOSED[k % len(_PROPOSED)])
        found.append(reviser.revise(_situation(buffer, k), proposal))
        buffer[:] = [2.0, 30.0, 1.0]
    insist(
        same(_judge(found), _judge(_revisions(other))),
        "decisions change with an array that was seen before (is it kept instead of a copy?)",
    )


@CONTRACT.clause()
def an_episode_starts_anew(make: Make) -> None:
    """After start_episode it decides as one that has just been made."""
    used, fresh = make(), make()
    danger = np.array([2.0, 25.0, 5.0])
    for k in range(3):
        used.revise(_situation(danger, k), Proposal(1.0))
    used.start_episode()
    fresh.start_episode()
    insist(
        same(_judge(_revisions(used, seed=1)), _judge(_revisions(fresh, seed=1))),
        "after start_episode decisions still depend on the episode before (what is under way is "
        "not forgotten)",
    )


@CONTRACT.clause()
def is_deterministic(make: Make) -> None:
    """Two that see the same decide the same."""
    insist(
        same(_judge(_revisions(make())), _judge(_revisions(make()))),
        "two revisers that saw the same decide otherwise (a random number without a seed, or "
        "something shared by all of the class?)",
    )


@CONTRACT.clause()
def memory_is_bounded(make: Make) -> None:
    """Deciding again and again takes no more memory, in an episode however long."""
    reviser = make()
    situation = _situation(drive(1)[0], 5)

    def work(rounds: int) -> None:
        for _ in range(rounds):
            reviser.revise(situation, Proposal(0.5))

    refuse_growth(work, 200, "the reviser")

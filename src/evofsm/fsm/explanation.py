"""What a machine's experience says of a situation, in a sentence with its numbers.

All of it was counted, once for each episode that came to a state, or took an action there; that
one action ended better than another does not say that it was the reason.

A belief belongs to the nearest state, however far that is. So an observation that is farther from
its centre than a state reaches (`rules.reach`) is *never seen*, and no count is told of it. With
the paper's rule states may have passed over something rare, hence "as far as the states tell".
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from evofsm.fsm.naming import Labels
from evofsm.fsm.proportions import binomial_bounds, bounds_text
from evofsm.fsm.validation import Floats, counted, state_name

# A belief above this is not worth a word.
_SURE = 0.995


class Nearest(NamedTuple):
    """The state that an observation is nearest to, in the scales of the rule."""

    state: int
    distance: float  #: from its centre
    reach: float  #: how far from a centre an observation still belongs to the state


class Tally(NamedTuple):
    """How many episodes failed, of how many."""

    failed: int
    episodes: int
    is_exact: bool = True  #: False where an episode may count twice
    is_told: bool = True  #: False where nobody told of failures, so that `failed` is 0

    @property
    def share(self) -> float:
        """Of the episodes, those that failed; NaN without any, or where it is not known."""
        return self.failed / self.episodes if self.episodes and self.is_told else np.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Of the share, 90 %; from 0 to 1 without any, or where it is not known."""
        is_known = self.episodes and self.is_told
        return binomial_bounds(self.failed, self.episodes) if is_known else (0.0, 1.0)

    def __str__(self) -> str:
        if not self.is_told:
            return f"an unknown number of {self.episodes:,}"
        if not (self.episodes and self.is_exact):
            return f"{self.failed:,} of {self.episodes:,}"
        return f"{self.failed:,} of {self.episodes:,} ({bounds_text(*self.interval)})"


class Explanation(NamedTuple):
    """What is known of a situation; as text, its sentence."""

    text: str  #: the sentence
    state: int | None = None  #: index of the most probable state; None where there is none
    belief: float = 0.0  #: that it is this one
    visits: int = 0  #: observations in which it was the most probable
    here: Tally = Tally(0, 0)  #: of the episodes that came to it
    reached_from: int | None = None  #: index of the state that most changes to it came from
    action: Tally | None = None  #: of those that took the action there; None where none was given
    #: index of the action after which a smaller share failed and whose interval ends lowest
    better: int | None = None
    after_better: Tally | None = None  #: of those that took it
    #: whether no state reaches as far: then `state` is the nearest, and nothing is told of it
    never_seen: bool = False

    def __str__(self) -> str:
        return self.text


def explain(
    known: Any, belief: Floats, action: int | None, labels: Labels, nearest: Nearest | None = None
) -> Explanation:
    """What a model ``known`` says of a ``belief`` (n,) and, if known, of its observation."""
    if not len(belief):
        return Explanation("Nothing was learnt yet.")
    if nearest is not None and nearest.distance > nearest.reach:
        return _never_seen(known, belief, nearest, labels)
    state = int(belief.argmax())
    is_exact, is_told = not known.joined[state], known.failures_told
    here = Tally(int(known.failed_soon[state]), int(known.episodes[state]), is_exact, is_told)
    visits = int(known.visits[state])
    outcomes = zip(known.failed_after[:, state], known.tried[:, state], strict=True)
    after = [Tally(int(failed), int(episodes), is_exact, is_told) for failed, episodes in outcomes]
    tally = None if action is None else after[action]
    better = _best(after, here if tally is None or not tally.episodes else tally)
    after_better = None if better is None else after[better]
    arrivals = np.where(np.arange(len(belief)) == state, 0.0, known.changes[:, state])
    origin = int(arrivals.argmax()) if arrivals.any() else None

    horizon = known.settings.get("failure_horizon")
    soon = "later on" if horizon is None else f"within {labels.duration(horizon)}"
    sentences = [
        _of_place(known, belief, state, labels),
        _of_episodes(here, visits, soon, tally, "" if action is None else labels.action(action)),
    ]
    if better is not None:
        sentences.append(f"Better after {labels.action(better)}: {after_better}")
    if not is_exact:
        sentences.append("States were joined: an episode may count twice, and have been elsewhere")
    if origin is not None:
        share = f"{arrivals[origin]:,.0f} of {arrivals.sum():,.0f} times"
        sentences.append(f"Most often reached from {state_name(origin)}: {share}")
    contents = visits, here, origin, tally, better, after_better
    return Explanation(". ".join(sentences) + ".", state, float(belief[state]), *contents)


def _never_seen(known: Any, belief: Floats, nearest: Nearest, labels: Labels) -> Explanation:
    state, no_tally = nearest.state, Tally(0, 0, is_told=known.failures_told)
    place = labels.place(known.centers[state])
    place = place if place.startswith("(") else f"({place})"
    ways = "Never seen, as far as the states tell", "Perhaps seen before states were joined"
    text = f"{ways[int(known.joined.any())]}: {nearest.distance:.3g} from the nearest, "
    text += f"{state_name(state)} {place}, where a state reaches {nearest.reach:.3g}."
    return Explanation(text, state, float(belief[state]), 0, no_tally, never_seen=True)


def _best(after: Sequence[Tally], than: Tally) -> int | None:
    """Of several the action whose interval ends lowest, if lower, and a smaller share failed."""
    better = [
        (tally.interval[1], action)
        for action, tally in enumerate(after)
        if tally.share < than.share and tally.interval[1] < than.interval[1]
    ]
    return min(better)[1] if better and len(after) > 1 else None


def _of_place(known: Any, belief: Floats, state: int, labels: Labels) -> str:
    place = f"{state_name(state)}: {labels.place(known.centers[state])}"
    if belief[state] > _SURE or len(belief) == 1:
        return place
    second = int(np.argsort(-belief, kind="stable")[1])
    sure, next_ = 100.0 * belief[state], 100.0 * belief[second]
    return f"{place} (belief {sure:.0f} %, next {state_name(second)} {next_:.0f} %)"


def _of_episodes(here: Tally, visits: int, soon: str, asked: Tally | None, action: str) -> str:
    if visits <= 1 and not here.episodes:
        return "Never seen but in one observation"
    observations = f" ({counted(visits, 'observation')})" if visits else ""
    if not here.episodes:
        return f"No earlier episode that was counted came here{observations}"
    came = f"{counted(here.episodes, 'episode')} came here{observations}"
    if not here.is_told:
        took = "" if asked is None else f", {asked.episodes:,} of which took {action}"
        return f"{came}{took}; how many failed is not known"
    text = f"{came}; {here} failed {soon}"
    if asked is None:
        return text
    if not asked.episodes:
        return f"{text}; none of them is known to have tried {action} here"
    return f"{text}, and {asked} after {action}"

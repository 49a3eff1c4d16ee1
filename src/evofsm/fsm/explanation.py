"""What a machine's experience says of a situation, in a sentence with its numbers.

Nothing is estimated here: all of it was counted, once for each episode that came to a state, or
took an action there. So an explanation is true of what was seen, whatever comes next; that one
action ended better than another does not say that it was the reason. Where nobody ever told of
failures, none can be counted, and that is said instead of a share.

Beliefs are normalised: one that lies far from every state still belongs to the nearest of them. So
an observation that is farther from the nearest centre than a state reaches (`rules.reach`) is
*never seen*, and nothing that was counted is told of it. With the paper's rule the states may have
passed over something rare that was seen, hence "as far as the states tell".
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from evofsm.fsm.naming import Labels
from evofsm.fsm.proportions import bounds_text, wilson_bounds
from evofsm.fsm.validation import Floats, state_name

# A belief above this is not worth a word.
_SURE = 0.995


class Nearest(NamedTuple):
    """The state that an observation is nearest to, in the scales of the rule."""

    state: int  #: its index
    distance: float  #: from its centre
    reach: float  #: how far from a centre an observation still belongs to the state

    @property
    def is_beyond(self) -> bool:
        """Whether no state reaches as far as the observation."""
        return self.distance > self.reach


class Tally(NamedTuple):
    """How many episodes failed, of how many.

    Examples
    --------
    >>> print(Tally(3, 12), "|", Tally(0, 40), "|", Tally(7, 7), "|", Tally(7, 7, is_exact=False))
    3 of 12 (10 to 49 %) | 0 of 40 (at most 7 %) | 7 of 7 (at least 72 %) | 7 of 7
    >>> Tally(0, 40, is_told=False).share
    nan
    """

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
        """Of the share, 90 % (Wilson 1927); from 0 to 1 without any, or where it is not known."""
        if not (self.episodes and self.is_told):
            return 0.0, 1.0
        interval: tuple[float, float] = wilson_bounds(self.share, float(self.episodes))
        return interval

    def __str__(self) -> str:
        if not self.is_told:
            return f"an unknown number of {self.episodes:,}"
        if not (self.episodes and self.is_exact):
            return f"{self.failed:,} of {self.episodes:,}"
        low, high = self.interval
        low = low if self.failed else 0.0
        high = high if self.failed < self.episodes else 1.0
        return f"{self.failed:,} of {self.episodes:,} ({bounds_text(low, high)})"


class Explanation(NamedTuple):
    """What is known of a situation; as text, its sentence.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 1, 0, 0], [0, 2], [3])
    >>> found = machine.model(names=["gap"], units=["m"]).explain(0, action=0)
    >>> found.here.share, round(found.action.interval[0], 2)
    (0.5, 0.12)
    >>> print(found)
    #1: gap 0 m. 2 episodes came here (3 observations); 1 of 2 (12 to 88 %) failed later on, and
    1 of 2 (12 to 88 %) after a(1).
    """

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
    """What experience says of a situation that is recognised as ``belief`` (n,).

    Where the observation is known, ``nearest`` says how far it is from what was learnt.
    """
    if not len(belief):
        return Explanation("Nothing was learnt yet.")
    if nearest is not None and nearest.is_beyond:
        return _never_seen(known, belief, nearest, labels)
    state = int(belief.argmax())
    is_exact, is_told = not known.joined[state], known.failures_told
    here = Tally(int(known.failed_soon[state]), int(known.episodes[state]), is_exact, is_told)
    visits = int(known.visits[state])
    outcomes = zip(known.failed_after[:, state], known.tried[:, state], strict=True)
    after = [Tally(int(failed), int(tried), is_exact, is_told) for failed, tried in outcomes]
    asked = None if action is None else after[action]
    better = _best(after, here if asked is None or not asked.episodes else asked)
    after_better = None if better is None else after[better]
    arrivals = np.where(np.arange(len(belief)) == state, 0.0, known.changes[:, state])
    came_from = int(arrivals.argmax()) if arrivals.any() else None

    horizon = known.settings.get("failure_horizon")
    soon = "later on" if horizon is None else f"within {labels.duration(horizon)}"
    sentences = [
        _of_place(known, belief, state, labels),
        _of_episodes(here, visits, soon, asked, "" if action is None else labels.action(action)),
        "" if better is None else f"Better after {labels.action(better)}: {after_better}",
        _of_onsets(known, state, labels),
        "" if is_exact else "States were joined here, so an episode may count twice",
        "" if came_from is None else _of_origin(arrivals, came_from),
    ]
    text = " ".join(f"{sentence}." for sentence in sentences if sentence)
    sure = float(belief[state])
    return Explanation(
        text, state, sure, visits, here, came_from, asked, better, after_better, False
    )


def _never_seen(known: Any, belief: Floats, nearest: Nearest, labels: Labels) -> Explanation:
    state, none = nearest.state, Tally(0, 0, is_told=known.failures_told)
    place = labels.place(known.centers[state])
    place = place if place.startswith("(") else f"({place})"
    text = (
        f"Never seen, as far as the states tell: {nearest.distance:.3g} from the nearest, "
        f"{state_name(state)} {place}, where a state reaches {nearest.reach:.3g}."
    )
    return Explanation(text, state, float(belief[state]), 0, none, never_seen=True)


def _best(after: Sequence[Tally], than: Tally) -> int | None:
    """The action whose interval ends lowest, if that is lower and a smaller share failed."""
    better = [
        (tally.interval[1], action)
        for action, tally in enumerate(after)
        if tally.share < than.share and tally.interval[1] < than.interval[1]
    ]
    return min(better)[1] if better else None


# -- In words -------------------------------------------------------------------------------------


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
    observations = f" ({_count(visits, 'observation')})" if visits else ""
    if not here.episodes:
        return f"No earlier episode that was counted came here{observations}"
    came = f"{_count(here.episodes, 'episode')} came here{observations}"
    if not here.is_told:
        took = "" if asked is None else f", {asked.episodes:,} of which took {action}"
        return f"{came}{took}; how many failed is not known, for no failure was ever told"
    text = f"{came}; {here} failed {soon}"
    if asked is None:
        return text
    if not asked.episodes:
        return f"{text}; none of them is known to have tried {action} here"
    return f"{text}, and {asked} after {action}"


def _of_onsets(known: Any, state: int, labels: Labels) -> str:
    if not known.visits[state] or not known.onsets.any():  # or nobody tells of them
        return ""
    number, while_there = int(known.onsets[state]), labels.duration(int(known.visits[state]))
    if not number:
        return f"No disturbance was noticed to begin here, in {while_there}"
    times = "once" if number == 1 else f"{number:,} times"
    return f"A disturbance began here {times} in {while_there}"


def _of_origin(arrivals: Floats, came_from: int) -> str:
    most, all_ = arrivals[came_from], arrivals.sum()
    return f"Most often reached from {state_name(came_from)}: {most:,.0f} of {all_:,.0f} times"


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'s' * (number != 1)}"

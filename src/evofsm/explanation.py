"""What a machine's experience says of a situation, in a sentence with its numbers.

Nothing is estimated here: all of it was counted, once for each episode that came to a state, or
took an action there. So an explanation is true of what was seen, whatever comes next; that one
action ended better than another does not say that it was the reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from evofsm.naming import Labels
from evofsm.proportions import wilson_interval

# A belief above this is not worth a word.
_SURE = 0.995


class Experience(Protocol):
    """The graph that was learnt, as a machine and its model hold it."""

    @property
    def n_states(self) -> int: ...  # noqa: D102
    @property
    def failure_horizon(self) -> int | None: ...  # noqa: D102
    @property
    def centers(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def visits(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def changes(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def episodes(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def failed_soon(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def joined(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def tried(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def failed_after(self) -> NDArray[np.float64]: ...  # noqa: D102


class Tally(NamedTuple):
    """How many episodes failed, of how many.

    Examples
    --------
    >>> print(Tally(3, 12))
    3 of 12 (10 to 49 %)
    >>> print(Tally(0, 40), "|", Tally(7, 7), "|", Tally(7, 7, is_exact=False))
    0 of 40 (at most 6 %) | 7 of 7 (at least 72 %) | 7 of 7
    """

    failed: int
    episodes: int
    is_exact: bool = True  #: False where an episode may count twice

    @property
    def share(self) -> float:
        """Of the episodes, those that failed; NaN without any."""
        return self.failed / self.episodes if self.episodes else np.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Of the share, 90 % (Wilson 1927); from 0 to 1 without any."""
        if not self.episodes:
            return 0.0, 1.0
        low, high = wilson_interval(np.array([self.share]), float(self.episodes))
        return float(low[0]), float(high[0])

    def __str__(self) -> str:
        if not (self.episodes and self.is_exact):
            return f"{self.failed:,} of {self.episodes:,}"
        low, high = (f"{100.0 * bound:.0f}" for bound in self.interval)
        within = f"{low} to {high} %"
        if self.failed == 0:
            within = f"at most {high} %"
        elif self.failed == self.episodes:
            within = f"at least {low} %"
        return f"{self.failed:,} of {self.episodes:,} ({within})"


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
    state: int | None  #: index of the most probable state; None where there is none
    belief: float  #: that it is this one
    visits: int  #: observations in which it was the most probable
    here: Tally  #: of the episodes that came to it
    reached_from: int | None  #: index of the state that most changes to it came from
    action: Tally | None  #: of those that took the action there; None where none was asked for
    #: index of the action after which a smaller share failed and whose interval ends lowest
    better: int | None
    after_better: Tally | None  #: of those that took it

    def __str__(self) -> str:
        return self.text


def explain(
    known: Experience, belief: NDArray[np.float64], action: int | None, labels: Labels
) -> Explanation:
    """What experience says of a situation that is recognised as ``belief`` (n,)."""
    if not len(belief):
        return nothing_known("Nothing was learnt yet.")
    state = int(belief.argmax())
    is_exact = not known.joined[state]
    here = Tally(int(known.failed_soon[state]), int(known.episodes[state]), is_exact)
    visits = int(known.visits[state])
    after = [
        Tally(int(failed), int(tried), is_exact)
        for failed, tried in zip(known.failed_after[:, state], known.tried[:, state], strict=True)
    ]
    asked = None if action is None else after[action]
    better = _best(after, here if asked is None or not asked.episodes else asked)
    after_better = None if better is None else after[better]
    arrivals = known.changes[:, state]
    arrivals = np.where(np.arange(len(arrivals)) == state, 0.0, arrivals)
    came_from = int(arrivals.argmax()) if arrivals.any() else None

    horizon = known.failure_horizon
    soon = "later on" if horizon is None else f"within {labels.duration(horizon)}"
    sentences = [
        _of_place(known, belief, state, labels),
        _of_episodes(here, visits, soon, asked, "" if action is None else labels.action(action)),
        "" if better is None else f"Better after {labels.action(better)}: {after_better}",
        "" if is_exact else "States were joined here, so an episode may count twice",
        _of_origin(arrivals, came_from),
    ]
    return Explanation(
        " ".join(f"{sentence}." for sentence in sentences if sentence),
        state,
        float(belief[state]),
        visits,
        here,
        came_from,
        asked,
        better,
        after_better,
    )


def nothing_known(text: str) -> Explanation:
    """An explanation that there is nothing to explain."""
    return Explanation(text, None, 0.0, 0, Tally(0, 0), None, None, None, None)


def _best(after: Sequence[Tally], than: Tally) -> int | None:
    """The action whose interval ends lowest, if that is lower and a smaller share failed."""
    better = [
        (tally.interval[1], action)
        for action, tally in enumerate(after)
        if tally.share < than.share and tally.interval[1] < than.interval[1]
    ]
    return min(better)[1] if better else None


# -- In words -------------------------------------------------------------------------------------


def _of_place(known: Experience, belief: NDArray[np.float64], state: int, labels: Labels) -> str:
    place = f"#{state + 1}: {labels.place(known.centers[state])}"
    if belief[state] > _SURE or len(belief) == 1:
        return place
    second = int(np.argsort(-belief, kind="stable")[1])
    return (
        f"{place} (belief {100.0 * belief[state]:.0f} %, next #{second + 1} "
        f"{100.0 * belief[second]:.0f} %)"
    )


def _of_episodes(here: Tally, visits: int, soon: str, asked: Tally | None, action: str) -> str:
    if visits <= 1 and not here.episodes:
        return "Never seen but in one observation"
    observations = f" ({_count(visits, 'observation')})" if visits else ""
    if not here.episodes:
        return f"No earlier episode that was counted came here{observations}"
    text = f"{_count(here.episodes, 'episode')} came here{observations}; {here} failed {soon}"
    if asked is None:
        return text
    if not asked.episodes:
        return f"{text}; none of them is known to have tried {action} here"
    return f"{text}, and {asked} after {action}"


def _of_origin(arrivals: NDArray[np.float64], came_from: int | None) -> str:
    if came_from is None:
        return ""
    most, all_ = arrivals[came_from], arrivals.sum()
    return f"Most often reached from #{came_from + 1}: {most:,.0f} of {all_:,.0f} times"


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'s' * (number != 1)}"

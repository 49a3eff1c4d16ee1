"""What the learnt judge says of a decision: the one place of its words.

A *disturbance* is what began unexpectedly and is remembered. A *backup* is what would be done from
the next decision on. Distances to failure are counted in *ordinary changes*: how much the variable
that fails usually changes from one decision to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

#: Said as long as there is nothing to judge by.
NOTHING_LEARNT = "nothing was learnt yet"
NOTHING_SEEN = "nothing of this episode was observed yet"
NO_FAILURE = "no failure is known yet, so nothing is refused"

# Disturbances that are taken to be harder by a smaller factor are taken as they were.
_HARDER = 1.05


class Remembered(NamedTuple):
    """Disturbances that may begin at any time, as they once did.

    Examples
    --------
    >>> print(Remembered(10, 305.0), "|", Remembered(1, 12.3), "|", Remembered(0, 4.25))
    10 disturbances remembered from 305 s | 1 disturbance remembered from 12 s | what 4.2 s brought
    """

    number: int
    seconds: float  #: of observation that they come from

    def __str__(self) -> str:
        time = f"{self.seconds:,.0f} s" if self.seconds >= 10.0 else f"{self.seconds:.1f} s"
        if not self.number:
            return f"what {time} brought"
        return f"{self.number} disturbance{'s' * (self.number != 1)} remembered from {time}"

    def but(self, spared: int) -> str:
        """All of them, but those that need not be survived."""
        if self.number == 0:
            return str(self)
        if spared:
            return f"all but at most {spared} of the {self}"
        return f"{'all' if self.number > 1 else 'the'} {self}"


def kept(backup: str, remembered: Remembered, left: float, spared: int = 0) -> str:
    """Why a proposal is kept.

    Examples
    --------
    >>> kept("always -2.5", Remembered(10, 305.0), left=0.4)
    'then always -2.5 survives all 10 disturbances remembered from 305 s, by 0.4 ordinary changes'
    """
    return f"then {backup} survives {remembered.but(spared)}, by {changes(left)}"


def refused(
    lost: int, remembered: Remembered, margin: float, harder: float, spared: int = 0
) -> str:
    """Why an action is dangerous.

    Parameters
    ----------
    lost : int
        Disturbances that no backup survives after it; negative where none survives even without a
        disturbance, 0 where what is lacking is the margin alone.
    remembered : Remembered
    margin : float
        What has to be left of the distance to failure [ordinary changes].
    harder : float
        How much harder than they were disturbances are taken to be.
    spared : int
        Disturbances that need not be survived.

    Examples
    --------
    >>> refused(2, Remembered(10, 305.0), 0.4, 1.0)
    'no backup survives 2 of the 10 disturbances remembered from 305 s'
    >>> refused(-1, Remembered(10, 305.0), 0.4, 1.0)
    'no backup prevents failure, even if nothing disturbs it'
    >>> refused(0, Remembered(10, 305.0), 0.4, 1.0)
    'no backup survives all 10 disturbances remembered from 305 s by the margin of 0.4 ordinary \
changes'
    """
    if lost < 0:
        return "no backup prevents failure, even if nothing disturbs it"
    if lost == 0:
        what = f"no backup survives {remembered.but(spared)} by the margin of {changes(margin)}"
        return what if harder < _HARDER else f"{what}, were they {harder:.2g} times as hard"
    if lost < remembered.number:
        return f"no backup survives {lost} of the {remembered}"
    return f"no backup survives {'any of ' if lost > 1 else ''}the {remembered}"


def changed(backup: str, remembered: Remembered, margin: float, spared: int = 0) -> str:
    """What is done instead, where another action passes.

    Examples
    --------
    >>> changed("feedback 2", Remembered(10, 305.0), margin=0.4)
    'the closest action after which feedback 2 survives all of them, by 0.4 ordinary changes or \
more'
    """
    them = "all of them" if remembered.number > 1 else "it"
    if spared and remembered.number > 1:
        them = f"all but at most {spared} of them"
    return f"the closest action after which {backup} survives {them}, by {changes(margin)} or more"


def lasting(backup: str) -> str:
    """What is done instead, where no action passes.

    Examples
    --------
    >>> lasting("always -2.5")
    'no action passes; always -2.5 lasts longest'
    """
    return f"no action passes; {backup} lasts longest"


def tried() -> str:
    """What is done instead, where all backups look alike and another action was hardly used."""
    return "no action passes; what this one does is hardly known, so it is tried"


def experience(
    fails: Sequence[tuple[str, bool, float]],
    remembered: Remembered,
    margin: float,
    drifts: Sequence[tuple[str, int]] = (),
    worse: int = 0,
    noisy: Sequence[str] = (),
) -> str:
    """What was learnt so far.

    Parameters
    ----------
    fails : sequence of (str, bool, float)
        Variables that lead to failure, whether below a threshold, and which.
    remembered : Remembered
    margin : float
    drifts : sequence of (str, int)
        Variables that do not move any more as they did, and since which episode, from 1.
    worse : int
        Since which episode, from 1, disturbances are worse than those of before; 0: since none.
    noisy : sequence of str
        Variables whose sensors are noisy.

    Examples
    --------
    >>> experience([], Remembered(0, 12.0), 3.0, noisy=["gap", "speed"])
    'no failure is known yet, so nothing is refused; sensors are noisy: gap, speed'
    >>> experience([], Remembered(0, 12.0), 3.0, [("speed", 101)])
    'no failure is known yet, so nothing is refused; since episode 101 speed moves otherwise'
    >>> experience([("gap", True, 0.05)], Remembered(10, 305.0), 0.4)
    'fails where gap is below 0.05; 10 disturbances remembered from 305 s, to be survived by 0.4 \
ordinary changes'
    """
    since = "".join(f"; since episode {first} {name} moves otherwise" for name, first in drifts)
    if worse:
        since += f"; since episode {worse} disturbances are worse than those of before"
    if noisy:
        since += f"; sensors are noisy: {', '.join(noisy)}"
    if not fails:
        return NO_FAILURE + since
    where = " or ".join(
        f"{name} is {'below' if low else 'above'} {at:.3g}" for name, low, at in fails
    )
    return f"fails where {where}; {remembered}, to be survived by {changes(margin)}{since}"


def constant(values: Sequence[float]) -> str:
    """A backup that does the same all the time.

    Examples
    --------
    >>> constant([-2.5]), constant([1.0, 0.0])
    ('always -2.5', 'always (1, 0)')
    """
    shown = ", ".join(f"{value:.4g}" for value in values)
    return f"always {shown if len(values) == 1 else f'({shown})'}"


def choice(name: str) -> str:
    """A backup that chooses the same action all the time.

    Examples
    --------
    >>> choice("a(2)")
    'always a(2)'
    """
    return f"always {name}"


def feedback(index: int) -> str:
    """A backup that answers to what it observes, by its index from 0.

    Examples
    --------
    >>> feedback(1)
    'feedback 2'
    """
    return f"feedback {index + 1}"


def changes(size: float) -> str:
    """A distance to failure, in ordinary changes.

    Examples
    --------
    >>> changes(1.0), changes(0.382), changes(25.3)
    ('1 ordinary change', '0.38 ordinary changes', '25 ordinary changes')
    """
    shown = f"{size:.2g}" if abs(size) < 100.0 else f"{size:,.0f}"
    return f"{shown} ordinary change{'s' * (shown != '1')}"

"""What the learnt judge says of a decision: the one place of its words.

A *disturbance* is what began unexpectedly and is remembered. A *backup* is what would be done from
the next decision on. Distances to failure are counted in *typical steps*: how much the variable
that fails usually changes from one decision to the next. Disturbances that need not be survived
are *spared*.

Examples
--------
>>> ten = Remembered(10, 305.0)
>>> kept("always -2.5", ten, 0.4)
'then always -2.5 survives all 10 disturbances remembered from 305 s, by 0.4 typical steps'
>>> refused(2, ten, 0.4, 1.0)
'no backup survives 2 of the 10 disturbances remembered from 305 s'
>>> refused(0, Remembered(1, 12.3), 1.0, 1.3)
'no backup survives the 1 disturbance remembered from 12 s by the margin of 1 typical step, \
were they 1.3 times as hard'
>>> dead_ends([1, 3])
'; 2 dead ends: 3 and 1 episodes that had been certified failed from there'
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evofsm.fsm.naming import in_a_line
from evofsm.fsm.validation import counted
from evofsm.guard.harm import Harm
from evofsm.guard.learnt import failure
from evofsm.guard.learnt.failure import HELD, SAYS, I
from evofsm.guard.learnt.rollout import CRASHES, ENDS, FAILS, FATAL, Floats, Model
from evofsm.guard.learnt.state import State

#: Said as long as there is nothing to judge by.
NOTHING_LEARNT = "nothing was learnt yet"
NEVER_WHOLE = (
    "nothing was learnt: no episode had four observations before it failed, three in a row without "
    "NaN or a gap of over 1.5 intervals, with actions of the guard's range between them"
)
NOTHING_SEEN = "not each variable was observed yet in this episode"
#: Said where it is far from all that was seen, or was not seen whole for long.
BY_MODEL = "by the model alone, so its risk is not known: "
NO_FAILURE = "no failure is known yet, so nothing is refused"
_NONE = "no action passes by the margin"
_NO_BACKUP = "after the proposal no backup prevents failure"
#: What is done where all backups look alike and another action was hardly used.
TRIED = f"{_NONE}; what this one does is hardly known, so it is tried"
#: What is done where no backup lasts longer than the proposal.
NO_LONGER = f"{_NONE}, and by the model no backup lasts longer than the proposal, so that is kept"
#: The condition where not all actions are allowed.
IF_NO_MORE = ", if no more than now is ever allowed"
#: The same where there is but one action.
NOBODY = "nobody acts"

# Farther nobody needs to know how far it is; so it is where something hardly ever moved [steps].
_FARTHEST = 1_000_000
# Disturbances that are taken to be harder by a smaller factor are taken as they were.
_HARDER = 1.05
# Of more dead ends, those from where most failed are counted.
_ENDS_SHOWN = 3
# How often something was seen in a form, and what that is by what the form says.
_NOTE = r" \([\d,]+ (?:failure|ending)s?\)"
_WHAT = {FAILS: "failure", CRASHES: "failure", ENDS: "ending", FATAL: "time"}


class Remembered(NamedTuple):
    """Disturbances that may begin at any time, as they once did."""

    number: int
    seconds: float  #: of observation that they come from
    spared: int = 0  #: so many of them need not be survived
    #: episodes that failed, of the latest in which nothing seemed to help
    lost: tuple[int, int] = (0, 0)

    def __str__(self) -> str:
        time = f"{self.seconds:,.0f} s" if self.seconds >= 10.0 else f"{self.seconds:.1f} s"
        if not self.number:
            return f"what {time} brought"
        return f"{counted(self.number, 'disturbance')} remembered from {time}"

    @property
    def most(self) -> str:
        """All of them, but those that need not be survived."""
        if self.number == 0:
            return str(self)
        if self.spared:
            return f"all but at most {self.spared} of the {self}"
        return f"{'all' if self.number > 1 else 'the'} {self}"


def kept(backup: str, remembered: Remembered, left: float) -> str:
    """Why a proposal is kept."""
    return f"then {backup} survives {remembered.most}, by {changes(left)}"


def refused(unsurvived: int, remembered: Remembered, margin: float, scale: float) -> str:
    """Why an action is dangerous; ``unsurvived`` is -1 without a disturbance, 0 by the margin."""
    if unsurvived < 0:
        n_failed, n = remembered.lost
        record = f"so it seemed in {counted(n, 'episode')} of late: {n_failed} failed"
        record = record if n else "how that ends was not seen yet"
        return f"{_NO_BACKUP}, even if nothing disturbs it; {record}"
    if unsurvived == 0:
        text = f"no backup survives {remembered.most} by the margin of {changes(margin)}"
        return text if scale < _HARDER else f"{text}, were they {scale:.2g} times as hard"
    if unsurvived < remembered.number:
        return f"no backup survives {unsurvived} of the {remembered}"
    return f"no backup survives {'any of ' if unsurvived > 1 else ''}the {remembered}"


def alone(why: str) -> str:
    """Why it is dangerous where there is but one action, and so no backup."""
    why = why.replace("no backup survives", "it does not survive")
    return why.replace(_NO_BACKUP, "it fails")


def dead_ends(counts: Sequence[int]) -> str:
    """How many there are, those first from where most failed; empty without any."""
    if not counts:
        return ""
    most_first = failed(sorted(counts, reverse=True))
    return f"; {counted(len(counts), 'dead end')}: {most_first} from there"


def failed(counts: Sequence[int]) -> str:
    """How many episodes failed from each of some dead ends."""
    texts = [f"{count:,}" for count in counts[:_ENDS_SHOWN]] + ["..."] * (len(counts) > _ENDS_SHOWN)
    comma = ", " if len(counts) > _ENDS_SHOWN else " and "
    several = comma.join([", ".join(texts[:-1]), texts[-1]]) if len(texts) > 1 else texts[0]
    return f"{several} episode{'s' * (texts != ['1'])} that had been certified failed"


def changed(backup: str, remembered: Remembered, margin: float) -> str:
    """What is done instead, where another action passes."""
    cases = "all of them" if remembered.number > 1 else "it"
    if remembered.spared and remembered.number > 1:
        cases = f"all but at most {remembered.spared} of them"
    return f"the closest action after which {backup} survives {cases}, by {changes(margin)} or more"


def lasting(backup: str, *, cut: bool) -> str:
    """What is done instead, where no action passes."""
    if cut:
        return f"the search was cut short, as it took too many steps; {backup} passed last"
    return f"{_NONE}; by the model {backup} lasts longest"


def no_threshold(n_failed: int, n_seen: int, n_survived: int, *, is_given: bool) -> str:
    """Why nothing is refused where no threshold is known."""
    if is_given:
        if not n_survived:
            return "failed= is true of all that was observed (reversed?), so nothing is refused"
        return "failed= is true nowhere around what was survived, so nothing is refused"
    if not n_failed:
        return NO_FAILURE
    failures = counted(n_failed, "failure")
    where = " seen, but beyond no value that was survived"
    where = where if n_seen else ", before four observations or with NaN in the last"
    return f"{failures}{where}, so nothing is refused"


def experience(
    state: State, remembered: Remembered, names: Sequence[str], nothing: str, *, learning: bool
) -> str:
    """What was learnt so far; what is said of failure where that is not known is ``nothing``."""
    there, ends, fatal_places = _where(state.forms, names)
    latest = {int(j): int(since) + 1 for j, since, _ in state.drifts}
    more = "".join(
        f"; since episode {k} {in_a_line(names[j])} moves otherwise" for j, k in latest.items()
    )
    if state.stride > 1:
        more += f"; it looks ahead in steps of {state.stride} decisions"
    if ends:
        more += f"; ends by itself {' or '.join(ends)}"
    if fatal_places:
        more += f"; nothing survives what begins {' or '.join(fatal_places)}"
    if not there or nothing == NEVER_WHOLE:
        return nothing + more
    if state.differs:
        more += f"; failed= says otherwise in {state.differs:.1%} of the states around, where this "
        more += "decides"
    if state.is_doubted and (learning or state.is_settled):  # frozen, others count for nothing
        fails, exits, _ = _where(state.rivals, names)
        only = f"{fails}{', and ends by itself ' * bool(exits)}{' or '.join(exits)}"
        more += f"; {'tried while it learns, ' * learning}as much was refused without a failure: it"
        # They take the same failures, so that no count is one's own.
        more += f" only fails {re.sub(_NOTE, '', only)}"
    if len(state.dropped):
        until, *_ = _where(state.dropped, names)
        more += f"; frozen it refuses, too, {until}, as what took its place is new"
    elsewhere = ~failure.crashed(state.forms, state.failures)
    elsewhere &= ~failure.inside(failure.saying(state.forms, FAILS), state.failures).any(0)
    if elsewhere.any():
        n_failures = counted(len(elsewhere), "failure")
        there += f" (and elsewhere: {elsewhere.sum():,} of the {n_failures} are in none of these)"
    test = f"{remembered}, to be survived by {changes(state.margin)}"
    return f"fails {there}; {test}{more}{dead_ends(state.counts.astype(int).tolist())}"


def _where(table: Floats, names: Sequence[str]) -> tuple[str, list[str], list[str]]:
    """Where it fails, where it ends by itself, and where nothing survives what begins."""
    places: dict[int, list[str]] = {FAILS: [], ENDS: [], CRASHES: [], FATAL: []}
    sides = []
    for row, is_side in zip(table, failure.are_sides(table), strict=True):
        place, count, kind = row[I:HELD].tolist(), int(row[HELD]), _WHAT[int(row[SAYS])]
        text = region(names, place, count, kind)
        if is_side and row[SAYS] == FAILS:
            sides.append(text.removeprefix("where ").removesuffix(f" ({counted(count, kind)})"))
        else:
            places[int(row[SAYS])].append(text)
    places = {says: [*dict.fromkeys(texts)] for says, texts in places.items()}
    beyond = " or ".join(dict.fromkeys(sides))
    there = [" or ".join([f"where {beyond}"] * bool(sides) + places[FAILS])]
    there += [f"if it ends {' or '.join(places[CRASHES])}"] * bool(places[CRASHES])
    return ", or ".join(filter(None, there)), places[ENDS], places[FATAL]


def here(
    state: State, model: Model, names: Sequence[str], z: Floats, near: float
) -> tuple[str, Floats | None]:
    """What is said of an observation (m,), and the centre of the dead end it is in or near.

    Empty, and None, where failures and dead ends are farther than ``near``.
    """
    text, forms = "", failure.saying(state.forms, FAILS)
    away = failure.distances(forms, z[None])[:, 0]
    if away.min(initial=math.inf) <= near:
        row, distance = forms[int(away.argmin())], float(away.min())
        where = "" if distance <= 0.0 else f"{changes(distance)} from "
        place = region(names, row[I:HELD].tolist(), int(row[HELD]))
        text = f"This is {where}where it fails: {place.removeprefix('where ')}."
    off = np.sqrt((((state.centres - z) * model.inverse) ** 2).sum(1)) - state.radii
    off = off * model.dead_ends[:, -1]
    if off.min(initial=math.inf) > near:
        return text, None
    k, distance = int(off.argmin()), float(off.min())
    where = "in" if distance < 0.0 else f"{changes(distance)} from"
    from_there = f"This is {where} a dead end, from where {failed([int(state.counts[k])])}."
    return f"{text} {from_there}".lstrip(), state.centres[k]


def region(names: Sequence[str], row: Sequence[float], count: int, what: str = "failure") -> str:
    """Where a form is (columns I to R of its row), in which so many failures were seen.

    Of a threshold that none was beyond, some were at the end of what was survived.

    Examples
    --------
    >>> region(["x", "y"], [0, 1, 101325.0, 2.0, 1.0, 0.5, 4.0, 0.0, 0.0, -1.0, 0.0, -1.0], 3)
    'inside an ellipse of x and y around (101325, 2), 4 wide and 8 high (3 failures)'
    >>> region(["x", "y"], [0, 1, 0.0, 0.0, 1.0, 1.0, -5.0, 3.0, 4.0, 0.0, 0.0, 0.0], 1)
    'where 0.6 x + 0.8 y is above 1 (1 failure)'
    """
    note = f" ({counted(count, what)})" if count else ""
    i, j, at, to, sx, sy, c, b, d, p, q, r = row
    x, y = in_a_line(names[int(i)]), in_a_line(names[int(j)])
    if i == j:
        if p == 0.0 and b != 0.0:
            beyond = _figures(at - c / (b * sx), sx, 4)
            beside, way = "at or " * (not count), "above" if b > 0.0 else "below"
            return f"where {x} is {beside}{way} {beyond}{note}"
        spare = b * b - 4.0 * p * c
        if p == 0.0 or spare < 0.0:
            return f"where {x} is near {_figures(at, sx)}{note}"
        ends = sorted(at + (-b + sign * math.sqrt(spare)) / (2.0 * p * sx) for sign in (1, -1))
        first, last = (_figures(end, sx) for end in ends)
        if p < 0.0:
            return f"where {x} is between {first} and {last}{note}"
        return f"where {x} is below {first} or above {last}{note}"
    if p == q == r == 0.0:
        length = math.hypot(b * sx, d * sy)
        u, v = b * sx / length, d * sy / length
        per, sign = length / math.hypot(b, d), "+" if v >= 0.0 else "-"
        text = f"{_figures(u, per * abs(at))} {x} {sign} {_figures(abs(v), per * abs(to))} {y}"
        return f"where {text} is above {_figures(u * at + v * to - c / length, per)}{note}"
    inner = p * r - 0.25 * q * q
    if inner > 0.0:
        u, v = (0.25 * q * d - 0.5 * r * b) / inner, (0.25 * q * b - 0.5 * p * d) / inner
        most = c + 0.5 * (b * u + d * v)
        if most * p < 0.0:
            wide, high = (2.0 * math.sqrt(-most * k / inner) for k in (r, p))
            where = f"around ({_figures(at + u / sx, sx)}, {_figures(to + v / sy, sy)})"
            size = f"{wide / sx:.3g} wide and {high / sy:.3g} high"
            side = "inside" if p < 0.0 else "outside"
            return f"{side} an ellipse of {x} and {y} {where}, {size}{note}"
    return f"beyond a curve of {x} and {y}, as at ({_figures(at, sx)}, {_figures(to, sy)}){note}"


def _figures(value: float, inverse: float, least: int = 3) -> str:
    """A number of so many figures or more, rounded by at most a quarter of a unit (its inverse)."""
    texts = [f"{value:.{n}g}" for n in range(least, 10)]
    return next((text for text in texts if abs(float(text) - value) * inverse <= 0.25), texts[-1])


def harm(known: Harm, *, learning: bool) -> str:
    """What is said of a guard that was not shown to help, or that is no filter any more."""
    text = known.told(learning=learning)
    text = f"; {text}" if text else ""
    return f"{text}; it {known.spoiling}" if known.spoiling else text


def constant(values: Sequence[float]) -> str:
    """A backup that does the same all the time."""
    text = ", ".join(f"{value:.4g}" for value in values)
    return f"always {text if len(values) == 1 else f'({text})'}"


def changes(size: float) -> str:
    """A distance to failure, in typical steps."""
    if abs(size) > _FARTHEST:
        return f"over {_FARTHEST:,} typical steps"
    text = f"{size:.2g}" if abs(size) < 100.0 else f"{size:,.0f}"
    return f"{text} typical step{'s' * (text != '1')}"

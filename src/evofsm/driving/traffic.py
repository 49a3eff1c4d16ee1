"""Many cars instead of one leader: a scene of objects, its pairs, and a judge of the worst of them.

Every pair is one car behind another, with a gap and two speeds. Whoever is ahead, cuts in or
crosses is a leader, and each is rehearsed as the one leader of `LatentRisk`. For whoever is behind,
oneself is the leader: by the same rehearsal, in which it keeps its speed until it has reacted, own
braking that is harder than it survives ends in a collision that one has caused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.driving.judge import LatentRisk
from evofsm.driving.naming import SPEEDS
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.naming import Labels
from evofsm.fsm.validation import real_array
from evofsm.guard.actions import Action
from evofsm.guard.api import TOLERANCE, ActionJudge, Fallback, Judgement, Search, Situation
from evofsm.guard.guard import Guard
from evofsm.guard.reviser import ActionReviser, Mode

_Floats = NDArray[np.float64]

#: What a row of a scene holds; the first is 1 where the row is in use.
COLUMNS = ("present", "x", "y", "vx", "vy", "length", "width")
#: Nothing on a road is farther away, or larger [m].
PLACES, SIZES = (-1e9, 1e9), (0.0, 1e3)

# Who will be in one's path within this time at the present lateral speed cuts in, or crosses [s].
_AHEAD = 2.0
# Between two accelerations that are looked at [m/s²]; width of an interval of them [m/s²].
_STEP, _WIDTH = 0.25, 0.3
# So hard leaders brake at most, unless told or seen otherwise: SUMO's emergencyDecel [m/s²].
LEADER_DECEL = 9.0
# So hard those behind brake [m/s²], once they have kept their speed for so long [s].
_BEHIND, _REACTION = 4.5, 1.0
# Once it revises, a proposal is kept again below this share of the tolerance.
_RELEASE = 0.9
_KEPT = "risk is within the tolerance"
_COASTING, _ONE = np.zeros(1), np.ones(1)


# -- Scenes -------------------------------------------------------------------------------------


class Object(NamedTuple):
    """Something on the road, along which x is counted."""

    id: str
    x: float  #: of its centre, along the road [m]
    y: float  #: of its centre, to the left [m]
    vx: float  #: [m/s]
    vy: float = 0.0  #: [m/s]
    length: float = 5.0  #: along its heading [m]
    width: float = 1.8  #: [m]
    lane: str | None = None  #: for people; who is in whose way depends on y


class Role(Enum):
    """Where the other one of a pair is."""

    AHEAD = "ahead"
    CUTTING_IN = "cutting in"
    CROSSING = "crossing"
    BEHIND = "behind"  #: it follows, and oneself is its leader


class Pair(NamedTuple):
    """Two that may meet if neither does anything about it."""

    role: Role
    number: int  #: of the object in its scene; 0 is oneself
    gap: float  #: from bumper to bumper [m]; 0 or less where they touch
    v_follower: float  #: [m/s]
    v_leader: float  #: [m/s]

    @property
    def observation(self) -> NDArray[np.float64]:
        """(3,) ndarray: gap [m], speed of the follower and of the leader [m/s]."""
        return np.array(self[2:])


class Scene:
    """Oneself and the objects around.

    Examples
    --------
    >>> own = Object("me", x=0.0, y=0.0, vx=25.0)
    >>> slow = Object("lorry", x=40.0, y=0.0, vx=20.0, length=12.0)
    >>> fast = Object("van", x=-20.0, y=0.0, vx=30.0)
    >>> far = Object("bus", x=0.0, y=3.5, vx=20.0)  # in the next lane
    >>> scene = Scene(own, [slow, fast, far])
    >>> for pair in scene.pairs():
    ...     print(scene.objects[pair.number].id, pair.role.value, pair.gap)
    van behind 15.0
    lorry ahead 31.5
    """

    def __init__(self, own: Object, others: Sequence[Object] = ()) -> None:
        #: Oneself, then the others, the closest along the road first.
        self.objects = (own, *sorted(others, key=lambda each: abs(each.x - own.x)))

    def pairs(self) -> list[Pair]:
        """With whom one may meet, the closest first.

        An object is in one's lane where their sides overlap; it cuts in, or crosses if it moves
        across more than along the road, where they will within 2 s.
        """
        return pairs_of(self.rows(len(self.objects) - 1))

    def rows(self, most: int) -> NDArray[np.float64]:
        """((most + 1) * 7,) ndarray: `COLUMNS` of oneself and the closest others; zeros else."""
        rows = np.zeros((most + 1, len(COLUMNS)))
        for row, each in zip(rows, self.objects, strict=False):
            row[:] = 1.0, *each[1:7]
        return rows.ravel()


def pairs_of(rows: ArrayLike) -> list[Pair]:
    """With whom one may meet, from a scene's `rows`; rows that hold NaN are left out."""
    flat = real_array("rows", rows, 1)
    if len(flat) % len(COLUMNS):
        raise ValueError(f"{len(flat)} numbers are no rows of {len(COLUMNS)}: {', '.join(COLUMNS)}")
    own, *others = flat.reshape(-1, len(COLUMNS)).tolist()
    found = []
    for index, other in enumerate(others, start=1):
        if other[0] > 0.5 and not math.isnan(sum(other)):
            pair = _pair(own, other, index)
            if pair is not None:
                found.append(pair)
    return sorted(found, key=lambda pair: pair.gap)


def _pair(own: list[float], other: list[float], index: int) -> Pair | None:
    _, x, y, vx, vy, length, width = other
    apart, aside = x - own[1], y - own[2]
    crosses = abs(vy) > abs(vx)
    along, across = (width, length) if crosses else (length, width)
    free = abs(aside) - 0.5 * (own[6] + across)  # between the sides
    closing = (own[4] - vy) * math.copysign(1.0, aside)
    if free >= max(0.0, closing * _AHEAD):  # not in one's path, nor soon
        return None
    gap = abs(apart) - 0.5 * (own[5] + along)
    if apart < 0.0:
        # Who moves across behind is none of one's business.
        return None if crosses else Pair(Role.BEHIND, index, gap, vx, own[3])
    role = Role.AHEAD if free < 0.0 else Role.CUTTING_IN
    return Pair(Role.CROSSING if crosses else role, index, gap, own[3], max(vx, 0.0))


# -- The judge ----------------------------------------------------------------------------------


class TrafficRisk(ActionJudge):
    """Judges accelerations among any number of objects, as the worst of the pairs with them.

    An observation is that of `Scene.rows`. It learns nothing itself; what leaders do can be taught
    to ``ahead.manoeuvres``.

    Parameters
    ----------
    ahead : LatentRisk
        Judges each pair in which oneself is the follower. The braking it counts on may be softer
        than what is possible, so that one brakes early.
    low, high : float
        The hardest braking, negative, and the hardest acceleration [m/s²].

    Raises
    ------
    ValueError
        If low and high are no range around 0.

    Notes
    -----
    Where no action is tolerable for all, it is the one that the car behind survives and that is
    least risky ahead. Where a leader who merely keeps its speed would be hit then, it is the
    softest braking that is tolerable ahead; the hardest if none is.

    Examples
    --------
    >>> from evofsm.driving import Object, Scene, guard_for_traffic
    >>> guard = guard_for_traffic(low=-9.0, high=2.6, decel=4.5, interval=0.1)
    >>> lorry, bike = Object("lorry", 22.0, 0.0, 9.0), Object("bike", -14.0, 0.0, 14.0, length=2.0)
    >>> scene = Scene(Object("me", 0.0, 0.0, 14.0), [lorry, bike])
    >>> revision = guard.decide(scene.rows(most=4), proposal=1.0)
    >>> round(revision.executed, 2)
    -3.7
    >>> revision.reason.partition("; ")[2]
    'nothing can, the least risky that who is behind survives'
    """

    fallback = Fallback(0.0, "keeping the speed")
    ranges = (0.0, 1.0), PLACES, PLACES, SPEEDS, SPEEDS, SIZES, SIZES

    def __init__(self, ahead: LatentRisk, low: float, high: float) -> None:
        if not -math.inf < low < 0.0 < high < math.inf:
            raise ValueError(f"low is {low} and high is {high}; they must lie around 0")
        self.ahead = ahead
        self.low, self.high = float(low), float(high)
        # Judges the one that follows, of which oneself is the leader.
        self._behind = LatentRisk.given(-_BEHIND, _BEHIND, _BEHIND, _REACTION)
        self.labels = Labels(dt=ahead.dt)
        steps = max(2, round((self.high - self.low) / _STEP) + 1)
        self._grid = np.linspace(self.low, self.high, steps)
        #: The worst pair of the first action that was judged last; None where there is none.
        self.worst: Pair | None = None

    def judge(self, situation: Situation, actions: ArrayLike) -> Judgement:
        """Risk of each acceleration [m/s²]: the highest of all pairs."""
        given = np.ascontiguousarray(actions, np.float64)
        return self._judge(pairs_of(situation.observation), given)[0]

    def _judge(self, pairs: list[Pair], actions: _Floats) -> tuple[Judgement, _Floats, _Floats]:
        """Of all pairs; and the risk ahead and that from behind alone."""
        nothing = np.zeros(len(actions))
        worst: Judgement | None = None
        self.worst, hardest, survived = None, -float(actions.min()), math.inf
        follower = None
        for pair in pairs:
            if pair.role is Role.BEHIND:
                # Who does not brake is hit by nobody that it has to mind.
                its = self._survived(pair) if hardest > 0.0 else math.inf
                if its < survived:
                    survived, follower = its, pair
                continue
            judged = self.ahead.judge(
                Situation(pair.observation, _ONE, None, math.nan, 0.0), actions
            )
            if worst is None or judged.risk[0] > worst.risk[0]:
                self.worst = pair
            worst = judged if worst is None else _worse(worst, judged)
        if worst is None:
            worst = Judgement(nothing, nothing, nothing, nothing + math.inf, 0.0)
        if hardest <= survived:
            return worst, worst.risk, nothing
        hit = np.where(actions < -survived, 1.0, 0.0)
        if self.worst is None or hit[0] > worst.risk[0]:
            self.worst = follower
        from_behind = Judgement(hit, hit, hit, nothing + math.inf, 0.0)
        return _worse(worst, from_behind), worst.risk, hit

    def _survived(self, pair: Pair) -> float:
        """The hardest braking of oneself that who is behind survives [m/s²]."""
        return float(self._behind.critical(pair.observation, _COASTING)[0])

    def search(
        self, situation: Situation, wanted: Action, *, tolerance: float, revising: bool
    ) -> Search:
        """The acceleration closest to ``wanted`` that is tolerable ahead and behind [m/s²].

        ``revising`` says that the proposal before was not kept.
        """
        pairs = pairs_of(situation.observation)
        options = np.concatenate([[wanted], self._grid])
        limit = tolerance * (_RELEASE if revising else 1.0)
        if not revising:  # most proposals are kept: look at this one first
            judged, _, _ = self._judge(pairs, options[:1])
            if judged.risk[0] <= limit:
                return Search(options[:1], judged, 0, _KEPT)
        judged, ahead, behind = self._judge(pairs, options)
        if judged.risk[0] <= limit:
            return Search(options, judged, 0, _KEPT)
        best, what = _best(options, judged, ahead, behind, (limit, tolerance))
        return Search(options, judged, best, f"{self.why(judged)}; {what}")

    def why(self, judged: Judgement) -> str:
        """Why the first action that was judged is dangerous, and who it is."""
        pair = self.worst
        if pair is None:
            return "nobody is near"
        who = f"object {pair.number}, {pair.role.value}"
        if pair.role is Role.BEHIND:
            return f"{who}, survives no braking harder than {self._survived(pair):.1f} m/s²"
        return f"{who}: {self.ahead.why(judged)}"

    def refuse_unfit(self, low: Action, high: Action) -> None:
        """Raise a ValueError if it counts on harder braking than there is."""
        self.ahead.refuse_unfit(low, high)
        if self.low < low or self.high > high:
            raise ValueError(
                f"the judge looks at accelerations from {self.low:g} to {self.high:g}, but the set "
                f"of actions is [{low}, {high}]"
            )


def _worse(one: Judgement, other: Judgement) -> Judgement:
    """The higher risk of each action."""
    risk, low, high = map(np.maximum, one[:3], other[:3])
    critical = np.minimum(one.critical, other.critical)
    return Judgement(risk, low, high, critical, max(one.evidence, other.evidence))


def _best(
    options: _Floats,
    judged: Judgement,
    ahead: _Floats,
    behind: _Floats,
    tolerances: tuple[float, float],
) -> tuple[int, str]:
    """Index of the best option, and what it is; the first option is the proposal."""
    change = np.abs(options - options[0])
    for tolerated in tolerances:
        tolerable = np.flatnonzero(judged.risk <= tolerated)
        if len(tolerable):
            return int(tolerable[change[tolerable].argmin()]), "the closest that can"
    survived = np.flatnonzero(behind <= tolerances[-1])
    if len(survived) and judged.critical[survived].max() > 0.0:
        # Of several that are least risky the hardest braking.
        rank = np.lexsort((options[survived], ahead[survived]))
        return int(survived[rank[0]]), "nothing can, the least risky that who is behind survives"
    tolerable = np.flatnonzero(ahead <= tolerances[-1])
    if len(tolerable):
        return int(tolerable[options[tolerable].argmax()]), "nothing can, the softest for ahead"
    return int(options.argmin()), "nothing can, the hardest braking"


def guard_for_traffic(
    low: float,
    high: float,
    decel: float,
    interval: float,
    *,
    judge: TrafficRisk | None = None,
    tolerance: float = TOLERANCE,
    mode: Mode = Mode.ACT,
) -> Guard:
    """A guard for a car among others; it observes `Scene.rows` and decides on the acceleration.

    Parameters
    ----------
    low, high : float
        The hardest braking that can be commanded, negative, and the hardest acceleration [m/s²].
    decel : float
        Braking that is counted on [m/s²], positive; softer than ``low``, it is begun earlier.
    interval : float
        Time between two decisions [s].
    judge : TrafficRisk, optional
        Without one it is given these limits, and leaders who brake by 9 m/s² at most.
    tolerance : float
        Highest risk that is accepted, in (0, 1).
    mode : Mode

    Examples
    --------
    >>> from evofsm.driving import Object, Scene
    >>> guard = guard_for_traffic(low=-9.0, high=2.6, decel=4.5, interval=0.1)
    >>> alone = Scene(Object("me", 0.0, 0.0, 14.0))
    >>> guard.decide(alone.rows(most=4), proposal=1.0).executed
    1.0
    """
    judge = judge or TrafficRisk(LatentRisk.given(-decel, decel, LEADER_DECEL, interval), low, high)
    actions = IntervalActions(low, high, _WIDTH, outside="clip")
    reviser = ActionReviser(judge, actions, tolerance=tolerance, mode=mode)
    return Guard.of(reviser, interval=interval, learn=False)

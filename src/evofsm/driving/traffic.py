"""Many cars instead of one leader: a scene of objects, its pairs, and a judge of the worst of them.

Whoever is ahead, oncoming, cuts in or crosses is a leader, and each is rehearsed as the one leader
of `LatentRisk`. For whoever is behind, oneself is the leader: by the same rehearsal, in which it
keeps its speed until it has reacted, own braking harder than it survives ends in a collision.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from evofsm.driving.judge import STANDS, LatentRisk, effective, in_proportion
from evofsm.driving.naming import REVERSE, SPEEDS
from evofsm.driving.rehearsal import ONCOMING
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.naming import Labels
from evofsm.fsm.validation import Floats, real_array
from evofsm.guard.actions import ActionSet
from evofsm.guard.api import TOLERANCE, ActionJudge, Fallback, Judgement, Situation
from evofsm.guard.guard import Guard
from evofsm.guard.reviser import ActionReviser, Mode

#: What a row of a scene holds; the first is 1 where the row is in use.
COLUMNS = ("present", "x", "y", "vx", "vy", "length", "width", "ax")
#: Nothing on a road is farther away, or larger [m], nor changes its speed faster [m/s²].
PLACES, SIZES, RATES = (-1e9, 1e9), (0.0, 1e3), (-1e3, 1e3)

# Who will be in one's path within this time at the present lateral speed cuts in, or crosses [s].
_AHEAD = 2.0
# Width of an interval of accelerations, of which one is looked at [m/s²].
_INTERVAL_WIDTH = 0.3
# So hard leaders brake at most, unless told or seen otherwise: SUMO's emergencyDecel [m/s²].
LEADER_DECEL = 9.0
# So hard those behind brake [m/s²], once they have kept their speed for so long [s].
_BEHIND, _REACTION = 4.5, 1.0
_COASTING, _ONE = np.zeros(1), np.ones(1)
# Where one's own speed stands in the rows of a scene.
_SPEED = COLUMNS.index("vx")


class Object(NamedTuple):
    """Something on the road; x is counted along it, in one's own direction of travel."""

    id: str
    x: float  #: of its centre, along the road [m]
    y: float  #: of its centre, to the left [m]
    vx: float  #: [m/s]
    vy: float = 0.0  #: [m/s]
    length: float = 5.0  #: along its heading; of who stands, up to 0.5 m/s, along the road [m]
    width: float = 1.8  #: [m]
    ax: float = 0.0  #: [m/s²]


# Where who is slower points is noise [m/s].
_TURNS = 0.5
# What is not seen of an object is as of most; where it is, and how fast, nobody can guess.
_USUAL = [math.nan] * 5 + [Object._field_defaults[name] for name in COLUMNS[5:]]


class _SceneLabels(Labels):
    def variable(self, index: int) -> str:
        """Whose number it is, and which."""
        number, column = divmod(index, len(COLUMNS))
        return f"{f'object {number}' if number else 'own'} {COLUMNS[column]}"


class Role(Enum):
    """Where the other one of a pair is."""

    AHEAD = "ahead"
    ONCOMING = "oncoming"
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
    braking: float = 0.0  #: of the leader [m/s²]

    @property
    def observation(self) -> Floats:
        """(3,) ndarray: gap [m], speed of the follower and of the leader [m/s]."""
        return np.array(self[2:5])


class Scene:
    """Oneself and the objects around.

    Examples
    --------
    >>> from evofsm.driving import Object, Scene
    >>> from evofsm.driving.traffic import pairs_of
    >>> own = Object("me", x=0.0, y=0.0, vx=25.0)
    >>> slow = Object("lorry", x=40.0, y=0.0, vx=20.0, length=12.0)
    >>> fast = Object("van", x=-20.0, y=0.0, vx=30.0)
    >>> far = Object("bus", x=0.0, y=3.5, vx=20.0)  # in the next lane
    >>> scene = Scene(own, [slow, fast, far])
    >>> for pair in pairs_of(scene.rows(most=3)):
    ...     print(scene.objects[pair.number].id, pair.role.value, pair.gap)
    van behind 15.0
    lorry ahead 31.5
    """

    def __init__(self, own: Object, others: Sequence[Object] = ()) -> None:
        near = sorted(others, key=lambda obj: np.nan_to_num(abs(obj.x - own.x)))
        near.sort(key=lambda obj: _pair([1.0, *own[1:]], [1.0, *obj[1:]], 0) is None)
        #: Oneself, then whom one may meet, then the others, the closest along the road first.
        self.objects = (own, *near)

    def rows(self, most: int) -> Floats:
        """((most + 1) * 8,) ndarray: `COLUMNS` of oneself and the first others; zeros else."""
        rows = np.zeros((most + 1, len(COLUMNS)))
        for row, obj in zip(rows, self.objects, strict=False):
            row[:] = 1.0, *obj[1:]
        return rows.ravel()


def pairs_of(rows: ArrayLike) -> list[Pair]:
    """With whom one may meet, the closest first, from a scene's `Scene.rows`.

    An object is in one's lane where their sides overlap; it cuts in, or crosses if it moves across
    more than along the road, where they will within 2 s. Who is behind counts in the lane
    alone. Rows without a place or speed (NaN) are left out; sizes that are not seen are usual ones,
    an acceleration 0.
    """
    flat = real_array("rows", rows, 1)
    if len(flat) % len(COLUMNS):
        raise ValueError(f"{len(flat)} numbers are no rows of {len(COLUMNS)}: {', '.join(COLUMNS)}")
    table = flat.reshape(-1, len(COLUMNS))
    ego, *objects = np.where(np.isnan(table), _USUAL, table).tolist()
    if ego[_SPEED] < REVERSE:
        raise ValueError(f"own vx is {ego[_SPEED]:g}; x counts along one's direction of travel")
    whole = ((k, obj) for k, obj in enumerate(objects, 1) if not math.isnan(sum(obj)))
    pairs = [_pair(ego, obj, index) for index, obj in whole if obj[0] > 0.5]
    return sorted(filter(None, pairs), key=lambda pair: pair.gap)


def lies_across(vx: float, vy: float) -> bool | None:
    """Whether who moves so lies across the road; None where it stands, as far as a sensor tells."""
    return abs(vy) > abs(vx) if max(abs(vx), abs(vy)) > _TURNS else None


def _pair(ego: list[float], obj: list[float], index: int) -> Pair | None:
    _, x, y, vx, vy, length, width, ax = obj
    apart, aside = x - ego[1], y - ego[2]
    crosses = lies_across(vx, vy)
    along, across = (width, length) if crosses else (length, width)
    free = abs(aside) - 0.5 * (ego[6] + across)  # between the sides
    closing_speed = (ego[4] - vy) * math.copysign(1.0, aside)
    if free >= max(0.0, closing_speed * _AHEAD):  # not in one's path, nor soon
        return None
    gap = abs(apart) - 0.5 * (ego[5] + along)
    if apart < 0.0:
        # Who moves across behind, or is not in the lane (yet), is none of one's business.
        return None if crosses or free >= 0.0 else Pair(Role.BEHIND, index, gap, vx, ego[3])
    role = (Role.ONCOMING if vx < ONCOMING else Role.AHEAD) if free < 0.0 else Role.CUTTING_IN
    braking = max(-ax, 0.0) if vx > 0.0 else 0.0
    return Pair(Role.CROSSING if crosses else role, index, gap, ego[3], vx, braking)


class TrafficRisk(ActionJudge):
    """Judges accelerations among any number of objects, as the worst of the pairs with them.

    An observation is that of `Scene.rows`. It learns nothing itself; what leaders do can be taught
    to ``ahead.manoeuvres``.

    Parameters
    ----------
    ahead : LatentRisk
        Judges each pair in which oneself is the follower.

    Notes
    -----
    Who is behind limits what the guard adds, never braking that is proposed: that may be for what
    no object tells of, such as a red light. It is said to be risky, and kept.

    Chosen is the action in proportion (`LatentRisk.choose`) that the car behind survives. Where
    none avoids a collision that is foreseen, it is the least risky ahead of those that the car
    behind survives; where a leader who goes on as it does, at its speed or braking, would be hit
    then, the softest that avoids it, or the hardest.

    Examples
    --------
    >>> from evofsm.driving import Object, Scene, guard_for_traffic
    >>> guard = guard_for_traffic(low=-9.0, high=2.6, decel=4.5, interval=0.1)
    >>> lorry, bike = Object("lorry", 22.0, 0.0, 9.0), Object("bike", -14.0, 0.0, 14.0, length=2.0)
    >>> scene = Scene(Object("me", 0.0, 0.0, 14.0), [lorry, bike])
    >>> revision = guard.decide(scene.rows(most=4), proposal=1.0)
    >>> round(revision.executed, 2)
    -2.1
    >>> revision.reason.partition("; ")[2]
    'the least braking that regains a safe gap in time'
    """

    fallback, lowest_first = Fallback(0.0, "keeping the speed"), True
    ranges = (0.0, 1.0), PLACES, PLACES, SPEEDS, SPEEDS, SIZES, SIZES, RATES

    def __init__(self, ahead: LatentRisk) -> None:
        self.ahead = ahead
        # Judges the one that follows, of which oneself is the leader.
        self._behind = LatentRisk(-_BEHIND, _REACTION, decel=_BEHIND, leader_decel=_BEHIND)
        self.labels = _SceneLabels(dt=ahead.dt)
        #: The worst pair of the first action that was judged last; None where there is none.
        self.worst: Pair | None = None

    def judge(self, situation: Situation, actions: ArrayLike) -> Judgement:
        """Risk of each acceleration [m/s²], the highest of all pairs; 0 is NaN if one is unseen."""
        actions = np.ascontiguousarray(actions, np.float64)
        zeros = np.zeros(len(actions))
        worst = Judgement(zeros, zeros, zeros, zeros + math.inf, 0.0)
        self.worst, hardest, pairs = None, -float(actions.min()), pairs_of(situation.observation)
        for pair in pairs:
            if pair.role is Role.BEHIND:
                continue
            here = Situation(pair.observation, _ONE, None, math.nan, 0.0)
            judgement = self.ahead.judge(here, actions)
            if self.worst is None or judgement.risk[0] > worst.risk[0]:
                self.worst = pair
            worst = _worse(worst, judgement)
        # Who does not brake is hit by nobody that it has to mind.
        limit, follower = self._survived(pairs) if hardest > 0.0 else (math.inf, None)
        if hardest > limit:
            hit = np.where(actions < -limit, 1.0, 0.0)
            if self.worst is None or hit[0] > worst.risk[0]:
                self.worst = follower
            worst = _worse(worst, Judgement(hit, hit, hit, zeros + math.inf, 0.0))
        rows = situation.observation.reshape(-1, len(COLUMNS))
        if worst.risk[0] == 0.0 and np.isnan(rows[rows[:, 0] != 0.0, :5]).any():
            unknown = zeros + math.nan
            return worst._replace(risk=unknown, low=unknown, high=unknown)
        return worst

    def _survived(self, pairs: Sequence[Pair]) -> tuple[float, Pair | None]:
        """The hardest braking of oneself that all behind survive [m/s²], and who survives least."""
        # The braking of who stands is hit by nobody.
        behind = [p for p in pairs if p.role is Role.BEHIND and p.v_leader >= STANDS]
        limits = [float(self._behind.critical(pair.observation, _COASTING)[0]) for pair in behind]
        return min(zip(limits, behind, strict=True), key=itemgetter(0), default=(math.inf, None))

    def choose(
        self,
        situation: Situation,
        options: Floats,
        judged: Judgement,
        tolerances: tuple[float, float],
    ) -> tuple[int, str] | None:
        """Index of the acceleration that is in proportion ahead and survived behind, and why."""
        avoids, regains = np.ones((2, len(options)), np.bool_)
        pairs = pairs_of(situation.observation)
        ahead = [pair for pair in pairs if pair.role is not Role.BEHIND]
        # No harder than who is behind survives, but never softer than what is proposed.
        bearable = options >= min(-self._survived(pairs)[0], options[0])
        # Without the risk from behind of what is bearable.
        risk = np.where(bearable, self.ahead.manoeuvres.harder(judged.critical), 1.0)
        if risk[0] <= tolerances[0]:
            return 0, "the proposed braking is kept: it may be for what is not seen"
        for pair in ahead:
            pair_arguments = pair[2:5], pair.braking, options, tolerances[-1]
            two = self.ahead._foreseen(*pair_arguments, hardest=-float(options.min()))
            if pair.v_leader < ONCOMING and not two[0].all():
                return None  # who goes on so is hit, however one brakes
            avoids, regains = avoids & two[0], regains & two[1]
        avoids &= options <= options[0]
        arguments = options, risk, tolerances, self.ahead.comfort, avoids & bearable, regains
        if (choice := in_proportion(*arguments)) is not None:
            return choice
        braking = max((pair.braking for pair in ahead), default=0.0)
        if bearable.any() and judged.critical[bearable].max() > braking:
            # Of several that are survived as well the hardest braking.
            rank = np.lexsort((options, -judged.critical, ~bearable))
            return int(rank[0]), "nothing can, the least risky that who is behind survives"
        if (brakes := avoids & (options <= 0.0)).any():  # who stands does not creep on
            softest = int(np.where(brakes, options, -np.inf).argmax())
            return softest, "nothing can, the softest for ahead"
        return int(options.argmin()), "nothing can, the hardest braking"

    def effective(self, situation: Situation, actions: Floats) -> Floats:
        """What actions come to here: where the car stands, to stay is enough."""
        return effective(situation.observation[_SPEED], actions)

    def why(self, judged: Judgement) -> str:
        """Why the first action that was judged is dangerous, and who it is."""
        pair = self.worst
        if pair is None:
            return "nobody is near"
        text = f"object {pair.number}, {pair.role.value}"
        if pair.role is Role.BEHIND:
            return f"{text}, survives no braking harder than {self._survived([pair])[0]:.1f} m/s²"
        return f"{text}: {self.ahead.why(judged)}"

    def refuse_unfit(self, actions: ActionSet) -> None:
        """Raise a ValueError if it counts on harder braking than there is."""
        self.ahead.refuse_unfit(actions)


def _worse(a: Judgement, b: Judgement) -> Judgement:
    """The higher risk of each action."""
    risk, low, high = map(np.maximum, a[:3], b[:3])
    critical = np.minimum(a.critical, b.critical)
    return Judgement(risk, low, high, critical, max(a.evidence, b.evidence))


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
    low, high, interval, tolerance, mode
        As in `guard_for_cars`.
    decel : float
        Braking that is counted on [m/s²], positive; softer than ``low``, it is begun earlier.
    judge : TrafficRisk, optional
        Without one it is given these limits, and leaders who brake by 9 m/s² at most.
    """
    if judge is None:
        judge = TrafficRisk(LatentRisk(-decel, interval, decel=decel, leader_decel=LEADER_DECEL))
    actions = IntervalActions(low, high, _INTERVAL_WIDTH, outside="clip")
    reviser = ActionReviser(judge, actions, tolerance=tolerance, mode=mode)
    return Guard.of(reviser, interval=interval, learn=False)

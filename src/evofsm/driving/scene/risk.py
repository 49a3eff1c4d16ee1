"""A judge among many cars: an action is as dangerous as the worst of its pairs.

Who is ahead, cuts in or crosses is a leader, and each is rehearsed as the one leader of
`LatentRisk`. Who is behind makes oneself the leader: by the same rehearsal, in which it keeps its
speed until it has reacted, braking harder than it survives ends in a collision that one has caused.
"""

from __future__ import annotations

import math
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.driving.risk.latent import LatentRisk
from evofsm.driving.scene.objects import COLUMNS, Pair, Role, pairs_of
from evofsm.fsm import Labels, positive
from evofsm.guard import Action, Fallback, Judgement, Search, Situation, Trial

_Floats = NDArray[np.float64]

# Between two accelerations that are looked at [m/s²].
_STEP = 0.25
# Once it revises, a proposal is kept again below this share of the tolerance.
_RELEASE = 0.9
# Who is behind after a lane change has to survive that one brakes so hard in front of it [m/s²].
_IN_FRONT = 2.0
_KEPT = "risk is within the tolerance"
_COASTING, _ONE = np.zeros(1), np.ones(1)


class TrafficRisk:
    """Judges accelerations among any number of objects, as the worst of the pairs with them.

    An observation is that of `Scene.rows`: a row for oneself, then one for each object. It learns
    nothing itself; what leaders do can be taught to ``ahead.manoeuvres``.

    Parameters
    ----------
    ahead : LatentRisk
        Judges each pair in which oneself is the follower. The braking it counts on may be softer
        than what is possible, so that one brakes early.
    low, high : float
        The hardest braking, negative, and the hardest acceleration [m/s²].
    behind_decel : float
        How hard those behind can brake [m/s²].
    reaction : float
        For so long those behind keep their speed before they brake in full [s].

    Raises
    ------
    ValueError
        If low and high are no range around 0, or another number is not positive.

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

    def __init__(
        self,
        ahead: LatentRisk,
        low: float,
        high: float,
        *,
        behind_decel: float = 4.5,
        reaction: float = 1.0,
    ) -> None:
        if not -math.inf < low < 0.0 < high < math.inf:
            raise ValueError(f"low is {low} and high is {high}; they must lie around 0")
        self.ahead = ahead
        self.low, self.high = float(low), float(high)
        self.behind_decel = positive("behind_decel", behind_decel)
        self.reaction = positive("reaction", reaction)
        #: The one that follows, of which oneself is the leader.
        self.behind = LatentRisk.told(-behind_decel, behind_decel, behind_decel, reaction)
        self.labels = Labels(dt=ahead.dt)
        steps = max(2, round((self.high - self.low) / _STEP) + 1)
        self._grid = np.linspace(self.low, self.high, steps)
        #: The worst pair of the first action that was judged last; None where there is none.
        self.worst: Pair | None = None

    @classmethod
    def told(
        cls,
        low: float,
        high: float,
        decel: float,
        interval: float,
        *,
        leader_decel: float = 9.0,
        behind_decel: float = 4.5,
        reaction: float = 1.0,
    ) -> Self:
        """Told the limits.

        Parameters
        ----------
        low, high : float
            As above.
        decel : float
            Braking that is counted on [m/s²].
        interval : float
            Time between two decisions [s].
        leader_decel : float
            Hardest braking of leaders, until they were seen to brake [m/s²].
        behind_decel, reaction : float
            As above.
        """
        ahead = LatentRisk.told(-decel, decel, leader_decel, interval)
        return cls(ahead, low, high, behind_decel=behind_decel, reaction=reaction)

    # -- Judging --------------------------------------------------------------------------------

    def judge(self, situation: Situation, actions: ArrayLike) -> Judgement:
        """Risk of each acceleration: the highest of all pairs.

        Parameters
        ----------
        situation : Situation
        actions : (k,) array_like
            [m/s²]

        Returns
        -------
        Judgement
            Its ``critical`` is the hardest braking of whoever is ahead that is survived.
        """
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
        return float(self.behind.critical(pair.observation, _COASTING)[0])

    def judge_change(self, situation: Situation, to: float, action: float = 0.0) -> Judgement:
        """Risk of changing into the lane beside, at once, with an acceleration.

        Parameters
        ----------
        situation : Situation
        to : float
            How far it is to that lane [m], positive to the left.
        action : float
            [m/s²]

        Returns
        -------
        Judgement
            With one entry: 1 where there is no room, or where who is then behind could not survive
            gentle braking.

        Examples
        --------
        >>> from evofsm.driving import Object, Scene
        >>> judge = TrafficRisk.told(low=-9.0, high=2.6, decel=4.5, interval=0.1)
        >>> scene = Scene(Object("me", 0.0, 0.0, 20.0), [Object("van", -12.0, 3.5, 28.0)])
        >>> here = Situation(scene.rows(1), np.ones(1), None, np.nan, 0.0)
        >>> judge.judge_change(here, to=3.5).risk, judge.judge_change(here, to=-3.5).risk
        (array([1.]), array([0.]))
        """
        rows = np.array(situation.observation)
        rows[COLUMNS.index("y")] += to
        pairs = pairs_of(rows)
        judged, _, _ = self._judge(pairs, np.array([float(action)]))
        behind = [pair for pair in pairs if pair.role is Role.BEHIND]
        if any(pair.gap <= 0.0 or self._survived(pair) < _IN_FRONT for pair in behind):
            sure = np.ones(1)
            return judged._replace(risk=sure, low=sure, high=sure)
        return judged

    # -- Deciding -------------------------------------------------------------------------------

    def search(
        self, situation: Situation, wanted: Action, *, tolerance: float, revising: bool
    ) -> Search:
        """The acceleration closest to ``wanted`` that is tolerable ahead and behind.

        Parameters
        ----------
        situation : Situation
        wanted : float
            [m/s²]
        tolerance : float
            Highest risk that is accepted.
        revising : bool
            Whether the proposal before was not kept.

        Returns
        -------
        Search
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
        best, what = _best(options, judged, ahead, behind, limit, tolerance)
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

    def trial(self) -> Trial | None:
        """None: it tries nothing."""
        return None

    def effective(self, situation: Situation, actions: _Floats) -> _Floats:
        """All actions as they are."""
        return actions

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
    return Judgement(
        np.maximum(one.risk, other.risk),
        np.maximum(one.low, other.low),
        np.maximum(one.high, other.high),
        np.minimum(one.critical, other.critical),
        max(one.evidence, other.evidence),
    )


def _best(
    options: _Floats,
    judged: Judgement,
    ahead: _Floats,
    behind: _Floats,
    limit: float,
    tolerance: float,
) -> tuple[int, str]:
    """Index of the best option, and what it is; the first option is the proposal."""
    change = np.abs(options - options[0])
    for tolerated in (limit, tolerance):
        tolerable = np.flatnonzero(judged.risk <= tolerated)
        if len(tolerable):
            return int(tolerable[change[tolerable].argmin()]), "the closest that can"
    survived = np.flatnonzero(behind <= tolerance)
    if len(survived) and judged.critical[survived].max() > 0.0:
        # Of several that are least risky the hardest braking.
        rank = np.lexsort((options[survived], ahead[survived]))
        return int(survived[rank[0]]), "nothing can, the least risky that who is behind survives"
    tolerable = np.flatnonzero(ahead <= tolerance)
    if len(tolerable):
        return int(tolerable[options[tolerable].argmax()]), "nothing can, the softest for ahead"
    return int(options.argmin()), "nothing can, the hardest braking"

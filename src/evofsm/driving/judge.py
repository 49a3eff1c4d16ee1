"""Latent risk: how likely failure is after an action, even if one is cautious from then on.

Failures are rare, but what leads to them can be learnt from every ordinary minute: how hard leaders
brake (`leaders`) and how well one brakes oneself (`brakes`). An action is then *rehearsed*
(`rehearsal`): it is taken, full braking follows, and the leader brakes. The hardest braking of the
leader that still ends well is the critical deceleration, and the latent risk is the probability
that the leader brakes harder than that. A situation is a dead end where, if the leader braked hard
now, even braking in full at once would be too late; while it does not, that can still be left.

It is left *in proportion* (`LatentRisk.choose`). What could begin is answered by a comfortable
deceleration at most. Harder braking answers what is seen: it is the least that avoids the collision
that is foreseen if the leader goes on as it does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm import store
from evofsm.driving import leaders, perception, rehearsal
from evofsm.driving.brakes import OwnBrakes, hardest_seen
from evofsm.driving.leaders import BrakeWatch, LeaderBrakes, Manoeuvres, is_another
from evofsm.driving.naming import LABELS, RANGES
from evofsm.driving.perception import Estimate, Perception, is_whole
from evofsm.driving.rehearsal import HARDEST, ONCOMING, Body, Three, critical_decelerations, foresee
from evofsm.driving.revisers import GENTLE_BRAKE
from evofsm.fsm.kernels import compiled, inner_kernel
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.model import FSMModel
from evofsm.fsm.proportions import wilson_bounds
from evofsm.fsm.sharing import Retraced, step
from evofsm.fsm.validation import Floats, positive, real_array, refuse_unusable, usable_array
from evofsm.guard import TOLERANCE, Judgement, LearntRisk, Situation
from evofsm.guard.actions import ActionSet, BoxActions, nearest_bounds
from evofsm.guard.api import LearningJudge, Trial, is_missing
from evofsm.store import COUNT, SIZE, SMALLEST, Kind, Numbers, Place

if TYPE_CHECKING:
    from evofsm.guard import ActionReviser
    from evofsm.guard.export import Part

#: Braking that needs no collision to be foreseen [m/s²], and the time in which a gap that is not
#: safe is to be safe again [s], as the study ``traffic`` chose them.
COMFORT, REGAIN = 3.0, 1.0
#: An acceleration that differs by no more is the same to whoever drives [m/s²].
SLIGHT = 0.1
#: Slower than this a car stands, though a sensor may show that it moves [m/s].
STANDS = 0.1
# Where a situation is not sure, it may be worse by so many standard deviations.
_CAUTION = 2.5
# Nearly no gap [m]: smaller than any that counts as no collision for who moves.
_ALMOST = 1e-9


# What a file may hold: no car is asked to brake harder [m/s²], decisions are no closer nor farther
# apart [s], and no braking that is seen so often is harder [m/s²].
_ASKED, _SHORTEST_DT, _LONGEST_DT = 100.0, 1e-6, 1e6
_MOST_BROUGHT = hardest_seen(_SHORTEST_DT)
_ACCELERATION = Numbers(least=SMALLEST, most=_ASKED)
_BRAKING = Numbers(least=-2.0 * _MOST_BROUGHT - _ASKED, most=2.0 * _MOST_BROUGHT + _ASKED)
# What `OwnBrakes` remembers: of each sample its value, and whether a run begins.
_SAMPLES = ("full", "brought", "shortfalls")
# Residuals that `Perception` remembers.
_NOISES = ("noise_gap", "noise_speed", "noise_leader")
_PRODUCT, _NOISE = Numbers(least=-1e300, most=1e300), Numbers(least=0.0, most=1e300)
_RISK = Kind(
    "risk",
    {
        **{name: _BRAKING.of(name, 2) for name in _SAMPLES},
        "decels": Numbers(("decels",), SMALLEST, HARDEST),
        "gentle": COUNT.of(1),
        "lagged": _PRODUCT.of(2),
        **{name: _NOISE.of(name) for name in _NOISES},
    },
    {
        "lowest": Numbers(least=-_ASKED, most=-SMALLEST),
        "dt": Numbers(least=_SHORTEST_DT, most=_LONGEST_DT),
        **dict.fromkeys(("leader_decel", "comfort"), _ACCELERATION),
        "regain": Numbers(least=0.0, most=60.0),
        "own_brakes": Numbers(least=SMALLEST, most=10.0),
        "margin": SIZE,
    },
)


class LatentRisk(Retraced, LearningJudge):
    """Learns online what an action leads to if the leader brakes and one is cautious from then on.

    Parameters
    ----------
    lowest : float
        The hardest braking that can be commanded [m/s²], negative.
    dt : float
        Time between decisions [s].
    decel : float, optional
        The hardest braking of the follower [m/s²], positive, where it is given instead of learnt.
    leader_decel : float
        Until enough was seen, leaders are assumed to brake so hard [m/s²].
    own_brakes : float
        Until it was seen, full braking is assumed to bring this share of what was commanded.
    margin : float
        Smallest gap that counts as no collision [m].
    comfort : float
        Braking that needs no collision to be foreseen [m/s²]. Adaptive cruise control may brake by
        3.5 m/s² at 20 m/s and above (ISO 15622).
    regain : float
        Within this time a gap that is not safe, such as after a cut-in, is to be safe again [s],
        if ``comfort`` is enough. Longer is gentler, and riskier if the leader brakes meanwhile.
    leaders : LeaderBrakes, optional
        Leaders' brakes to begin with, as if they had been seen; `leaders.REAL_DRIVES` are those
        of public drives. Without them it begins with the assumption alone.

    Examples
    --------
    >>> risk = LatentRisk(lowest=-2.5)
    >>> here = Situation(np.array([30.0, 20.0, 20.0]), np.ones(1), 0, np.nan, 0.0)
    >>> unseen = risk.judge(here, [0.0, -2.5])
    >>> unseen.risk, unseen.evidence  # nothing was learnt: the assumptions rule
    (array([1., 1.]), 0.0)
    """

    labels, ranges, lowest_first = LABELS, RANGES, True
    fallback = GENTLE_BRAKE

    def __init__(
        self,
        lowest: float,
        dt: float = 0.25,
        *,
        decel: float | None = None,
        leader_decel: float = 10.0,
        own_brakes: float = 0.6,
        margin: float = 0.5,
        comfort: float = COMFORT,
        regain: float = REGAIN,
        leaders: LeaderBrakes | None = None,
    ) -> None:
        if not -math.inf < lowest < 0.0:
            raise ValueError(f"lowest is {lowest}; the hardest braking must be negative and finite")
        self.lowest = float(lowest)
        self.dt = positive("dt", dt)
        self.leader_decel = positive("leader_decel", leader_decel)
        self.own_brakes = positive("own_brakes", own_brakes)
        self.margin = positive("margin", margin)
        self.comfort, self.regain = positive("comfort", comfort), positive("regain", regain)
        _RISK.refuse_others(self._settings)
        self.manoeuvres = Manoeuvres(leader_decel)
        if leaders is not None:
            self.manoeuvres.remember(*leaders.decels)
            self.manoeuvres.gentle += leaders.gentle
        self.brakes = OwnBrakes(lowest, own_brakes, dt)
        if decel is not None:
            self.brakes.trust(positive("decel", decel))
        self.perception = Perception(dt)
        self._watch = BrakeWatch(dt)
        self._own_watch = BrakeWatch(dt)  # of the car itself, where someone else drives it
        self._watched = False  # the latest decision
        self._commands = (0.0, 0.0)  # the latest two

    def learn(self, observation: ArrayLike, acceleration: float, *, watched: bool = False) -> None:
        """Take in an observation and the acceleration commanded after it [m/s²].

        Where one of gap [m] and both speeds [m/s] is NaN nothing is learnt, and what is under way
        is not gone on with; a TypeError or ValueError leaves what was learnt as it was.

        Where someone else drives (``watched``), as in shadow mode, hard braking shows what the
        brakes can do; ordinary braking not what they cannot.
        """
        self._take_in(observation, acceleration, learn=True, watched=watched)

    def follow(self, observation: ArrayLike, acceleration: float) -> None:
        """Keep up with what happens, as `learn`, without learning from it."""
        self._take_in(observation, acceleration, learn=False)

    def _take_in(
        self, observation: ArrayLike, acceleration: float, *, learn: bool, watched: bool = False
    ) -> None:
        triple = _three_finite(observation, whole=False)
        (command,) = usable_array("acceleration", [acceleration]).tolist()
        self._keep_up(triple, command, learn and is_whole(triple), watched)

    @step
    def _keep_up(self, seen: Three, command: float, learn: bool, watched: bool) -> None:
        estimate = self.perception.see(seen, self._expected, sure=self.brakes.known, learn=learn)
        self._commands = (self._commands[1], command)
        decel = None
        if is_whole(seen):
            decel = self._watch.see(*seen, self._of_change(2))
        else:
            self._watch.clear()
            self.brakes.clear()
        if learn:
            self.manoeuvres.remember(decel)
            self.brakes.see(seen[1], command, estimate.mean[1], watched=watched)
            if watched:
                if not self._watched:
                    self._own_watch.clear()
                self.brakes.show(self._own_watch.see(0.0, seen[1], seen[1], self._of_change(1)))
        self._watched = learn and watched

    @step
    def start_episode(self) -> None:
        """What comes is not a consequence of what was."""
        self._watch.clear()
        self._own_watch.clear()
        self.brakes.clear()
        self.perception.clear()
        self._commands = (0.0, 0.0)

    @step
    def end(self, observation: ArrayLike | None, *, failed: bool, terminated: bool = False) -> None:
        """A manoeuvre under way counts as it is; how it ended teaches nothing."""
        self.manoeuvres.remember(self._watch.end())
        self.brakes.show(self._own_watch.end())
        self.start_episode()

    def _of_change(self, variable: int) -> float:
        """Standard deviation of the noise on a difference of two of its values."""
        return math.sqrt(2.0) * self.perception.noise[variable]

    @property
    def _expected(self) -> float:
        """What the latest command brings until the next decision, most likely [m/s²]."""
        return self.brakes.expected(*self._commands)

    @property
    def told_by_experience(self) -> str:
        """What was learnt so far, in words."""
        brakes = f"{self.brakes.decel:.1f} m/s²" if self.brakes.known else "not known yet"
        decels = self.manoeuvres.decels
        hardest = f", the hardest by {max(decels):.1f} m/s²" if decels else ""
        text = f"manoeuvres of leaders: {len(decels)} given or seen{hardest}"
        return f"{text}, and one assumed, by {self.leader_decel:.1f} m/s²; own brakes: {brakes}"

    def judge(self, situation: Situation, accelerations: ArrayLike) -> Judgement:
        """Latent risk of each acceleration that could be commanded now [m/s²].

        What was not seen (NaN) is estimated from what was seen before; the less sure that is, the
        higher the risk. Where nothing was seen before either, every risk is 1. From the fifth
        observation on end that lacks something, such a risk decides, but is not known.
        """
        here = self._cautious(situation.observation)
        actions = usable_array("accelerations", accelerations)
        table, evidence = self.manoeuvres.table, float(len(self.manoeuvres))
        if self.perception.unseen + 1 >= LearntRisk.BLIND and is_missing(situation.observation):
            evidence = math.nan
        if not is_whole(here):  # where one is cannot be told: nothing can be survived for sure
            sure = np.ones(len(actions))
            return Judgement(sure, 0.0 * sure, sure, 0.0 * sure, evidence, situation.seen)
        rows = np.empty((4, len(actions)))
        _judge(here, actions, self.body, table, evidence, rows)
        risk, low, high, critical = rows
        return Judgement(risk, low, high, critical, evidence, situation.seen)

    def why(self, judged: Judgement) -> str:
        """Why the first action that was judged is dangerous, in a few words."""
        decel, risk = float(judged.critical[0]), float(judged.risk[0])
        text = f"could not survive a leader braking harder than {decel:.1f} m/s²"
        return text if math.isnan(judged.evidence) else f"{text} (risk {risk:.1%})"

    def trial(self) -> Trial | None:
        """Full braking, until it is known what it brings."""
        if self.brakes.known:
            return None
        assumption = f"{self.brakes.decel:.1f} m/s² assumed"
        activity = "braking in full to learn them"
        return Trial(self.lowest, "own brakes not known yet", "in full", activity, assumption)

    def effective(self, situation: Situation, actions: Floats) -> Floats:
        """What actions come to here: where the car stands, to stay is enough."""
        return effective(situation.observation[1], actions)

    def choose(
        self,
        situation: Situation,
        options: Floats,
        judged: Judgement,
        tolerances: tuple[float, float],
    ) -> tuple[int, str] | None:
        """Index of the option that is in proportion, and why; None where none avoids a collision.

        The closest one down to ``comfort`` that is tolerable, or that `foresee` says regains a safe
        gap within ``regain``; ``comfort`` where there is none, and harder only as far as it takes
        to avoid the collision that is foreseen.
        """
        here = self._cautious(situation.observation)
        if not is_whole(here) or here[2] < ONCOMING:  # who goes on so is hit, however one brakes
            return None
        foreseen = self._foreseen(here, self._leader_braking(situation), options, tolerances[-1])
        return in_proportion(options, judged.risk, tolerances, self.comfort, *foreseen)

    def _foreseen(
        self,
        observation: Three,
        braking: float,
        options: Floats,
        tolerance: float,
        hardest: float = 0.0,
    ) -> NDArray[np.bool_]:
        """(2, k) whether options avoid what is seen, and regain a safe gap, as `foresee` has it."""
        worst = self.manoeuvres.exceeded_by(tolerance)
        outcomes = np.empty((2, len(options)), np.bool_)
        inputs = observation, min(braking, worst), options, self.body
        foresee(*inputs, worst, self.regain, hardest, outcomes)
        return outcomes

    def _leader_braking(self, situation: Situation) -> float:
        now, before = self._estimate(situation.observation).mean, self.perception.latest
        if before is None or is_another(before.mean, now, self.dt):
            return 0.0
        return max(0.0, (before.mean[2] - now[2]) / self.dt)

    def refuse_unfit(self, actions: ActionSet) -> None:
        """Raise a ValueError if it counts on harder braking than there is."""
        if isinstance(actions, BoxActions):
            fault = f"an action is a vector of {len(actions.low)}; give low and high as numbers"
            raise ValueError(f"the risk judges one acceleration, but {fault}")
        if self.lowest < actions.low:
            fault = f"the set of actions ends at {actions.low:g}"
            raise ValueError(f"the risk counts on braking down to {self.lowest:g}, but {fault}")

    def _cautious(self, observation: ArrayLike) -> Three:
        """The situation as it most likely is, but closer by what is not sure about it."""
        here = self._estimate(observation)
        gap, speed, leader_speed = here.mean
        # What is wrong about a speed adds up while both brake.
        decel = self.brakes.decel
        doubt = here.deviation((1.0, -speed / decel, leader_speed / decel))
        # Not sure is not touching: who stands may stay.
        return max(gap - _CAUTION * doubt, min(gap, _ALMOST)), speed, leader_speed

    def _estimate(self, observation: ArrayLike) -> Estimate:
        triple = _three_finite(observation, whole=False)
        return self.perception.estimate(triple, self._expected, sure=self.brakes.known)

    def critical(self, observation: ArrayLike, accelerations: ArrayLike) -> Floats:
        """(k,) ndarray: hardest braking of the leader, from now on, that is survived [m/s²].

        With ``margin`` left. 0 where even a leader who keeps its speed is hit, `rehearsal.HARDEST`
        where none is.
        """
        triple, actions = _three_finite(observation), usable_array("accelerations", accelerations)
        critical = np.empty(len(actions))
        critical_decelerations(triple, actions, self.body, critical)
        return critical

    @property
    def body(self) -> Body:
        """What the follower is able to do, as far as was learnt, and what it was told."""
        brakes = self.brakes
        return Body(brakes.decel, brakes.lag, self.margin, self._commands[1], self.dt)

    def score(self, observations: Floats, dt: float = 0.25) -> Floats:
        """How surely each row is a dead end if the leader brakes now, as a `RiskMeasure` [m/s²].

        By how much the hardest braking of a leader that is survived by braking in full now falls
        short of the one that 2 % of leaders exceed. No margin is kept: a dead end is a collision,
        however small the gap that is left.
        """
        rows, critical = np.asarray(observations, np.float64), np.empty((len(observations), 1))
        settings = np.array([self.lowest]), self.body._replace(margin=0.0)
        for row, outcome in zip(rows, critical, strict=True):
            critical_decelerations(_three_finite(row), *settings, outcome)
        return self.manoeuvres.exceeded_by(TOLERANCE) - critical[:, 0]

    def in_c99(self, reviser: ActionReviser) -> Part:
        """What it decides by, frozen, for `evofsm.guard.export`."""
        from evofsm.guard.export import Part

        lowest, highest = nearest_bounds(reviser.actions)
        constants = {
            **{"DECEL": self.brakes.decel, "LAG": self.brakes.lag, "LIKELY": self.brakes._likely},
            **{"KNOWN": self.brakes.known, "LOWEST": self.lowest, "CLEARANCE": self.margin},
            **{"HARDEST": HARDEST, "HALVINGS": rehearsal._HALVINGS, "STANDS": STANDS},
            **{"COMFORT": self.comfort, "REGAIN": self.regain, "TOUCHING": rehearsal._TOUCHING},
            "WORST": self.manoeuvres.exceeded_by(reviser.tolerance),
            **{"ANOTHER_GAP": leaders._ANOTHER_GAP, "ANOTHER_SPEED": leaders._ANOTHER_SPEED},
            **{"LEADER": perception._LEADER, "UNEVEN": perception._UNEVEN, "CAUTION": _CAUTION},
            "ALMOST": _ALMOST,
            "DOUBT": perception._OWN if self.brakes.known else perception._OWN_UNKNOWN,
            **{"ANOTHER": perception._ANOTHER_LEADER, "EXACT": not any(self.perception.noise)},
            **{"EVIDENCE": float(len(self.manoeuvres)), "ONCOMING": ONCOMING},
            "BLIND": LearntRisk.BLIND,
            **{"TABLE": self.manoeuvres.table.shape[1], "harder": self.manoeuvres.table},
            **{"noise": self.perception.noise, "option_low": lowest, "option_high": highest},
        }
        runs = f"{len(lowest)} options times {rehearsal._HALVINGS + 2} rehearsals of 2 steps"
        about = f"a decision: at most {runs}\n"
        return Part(Path(__file__).with_suffix(".c"), 3, {"OPTIONS": len(lowest)}, constants, about)

    def save(self, path: Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write what was learnt, and what it learnt from for people, to a file (`evofsm.store`)."""
        settings = {**self._settings, "own_brakes": self.brakes.assumed}
        noises = self.perception.sizes
        learnt = {
            **{name: np.reshape(getattr(self.brakes, name), (-1, 2)) for name in _SAMPLES},
            "decels": np.array(self.manoeuvres.decels),
            "gentle": np.array([self.manoeuvres.gentle], np.float64),
            **{name: np.array(sizes.latest) for name, sizes in zip(_NOISES, noises, strict=True)},
            "lagged": np.array(self.brakes.lagged),
        }
        store.write(path, _RISK, settings, learnt, provenance)

    @classmethod
    def load(cls, path: Place) -> Self:
        """Read what was learnt, between two episodes."""
        settings, arrays = store.read(path, _RISK)
        with store.explained(path):
            risk = cls(**settings)
            risk.manoeuvres.remember(*arrays["decels"].tolist())
            risk.manoeuvres.gentle = int(arrays["gentle"][0])
            for name in _SAMPLES:
                getattr(risk.brakes, name).extend(map(tuple, arrays[name].tolist()))
            risk.brakes.remember(())  # it judges by them
            risk.perception = Perception(risk.dt, [arrays[name].tolist() for name in _NOISES])
            risk.brakes.set_lagged(*arrays["lagged"].tolist())
        return risk

    @property
    def _settings(self) -> dict[str, float]:
        return {name: getattr(self, name) for name in _RISK.settings}


def effective(speed: float, actions: Floats) -> Floats:
    """(k,) what accelerations come to at a speed [m/s], the first of which is the proposal."""
    return np.maximum(actions, min(float(actions[0]), 0.0)) if speed < STANDS else actions


def in_proportion(
    options: Floats,
    risk: Floats,
    tolerances: tuple[float, float],
    comfort: float,
    avoids: NDArray[np.bool_],
    regains: NDArray[np.bool_],
) -> tuple[int, str] | None:
    """Index of the acceleration that `LatentRisk.choose` speaks of, and why it is it.

    All arrays have an entry for each option (k,); the first option is the proposal.
    """
    gentle, lower = options >= min(-comfort, options[0]), avoids & (options <= options[0])
    passes = [gentle & ((risk <= tolerance) | (lower & regains)) for tolerance in tolerances]
    for candidates in (*passes, lower & (options <= -comfort)):
        if candidates.any():
            best = int(np.where(candidates, np.abs(options - options[0]), np.inf).argmin())
            if risk[best] <= tolerances[-1]:
                return best, "the closest that can"
            subject = "braking that" if best else "it"
            if not regains[best]:
                return best, f"{subject} avoids a collision if the leader goes on so"
            least = "the least " if best else ""
            return best, f"{least}{subject} regains a safe gap in time"
    return None


def dead_ends_of(known: EvolvingFSM | FSMModel, risk: LatentRisk) -> list[int]:
    """States at whose centre a hard brake of the leader more likely than not ends in failure.

    Even if one brakes in full at once, with the leader. They are told by their indices.

    Examples
    --------
    >>> machine = EvolvingFSM(n_actions=1, radius=0.5)
    >>> trace = machine.learn_many([[50.0, 5.0, 5.0], [9.0, 20.0, 20.0]], [0, 0])
    >>> dead_ends_of(machine, LatentRisk(lowest=-4.0))
    []
    """
    critical = [risk.critical(center, [risk.lowest])[0] for center in known.centers]
    indices: list[int] = np.flatnonzero(risk.manoeuvres.harder(critical) > 0.5).tolist()
    return indices


def _three_finite(observation: ArrayLike, *, whole: bool = True) -> Three:
    """Gap and speeds, as they can be judged; unless they must be ``whole``, NaN where not seen."""
    numbers = real_array("observation", observation, 1)
    if len(numbers) != 3:
        hint = "it must be (3,): gap, speed of the follower and of the leader"
        raise ValueError(f"observation has shape {numbers.shape}; {hint}")
    gap, speed, leader_speed = numbers.tolist()
    if not math.isfinite(gap + speed + leader_speed):  # looked at closely only where it has to be
        refuse_unusable("observation", numbers if whole else numbers[~np.isnan(numbers)])
    return gap, speed, leader_speed


@compiled
def _judge(
    observation: Three,
    accelerations: Floats,
    body: Body,
    table: Floats,
    evidence: float,
    judged: Floats,
) -> None:
    critical_decelerations(observation, accelerations, body, judged[3])
    for k in range(len(accelerations)):
        judged[0, k] = _interpolated(judged[3, k], table)
        judged[1, k], judged[2, k] = wilson_bounds(judged[0, k], evidence + 1.0)


@inner_kernel
def _interpolated(x: float, table: Floats) -> float:
    """What `numpy.interp` returns for 0 or more, which takes long to compile."""
    low, high = 0, table.shape[1] - 1
    if x >= table[0, high]:
        return float(table[1, high])
    while high - low > 1:
        middle = (low + high) // 2
        if table[0, middle] <= x:
            low = middle
        else:
            high = middle
    slope = (table[1, high] - table[1, low]) / (table[0, high] - table[0, low])
    return float(slope * (x - table[0, low]) + table[1, low])

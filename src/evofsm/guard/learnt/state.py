"""All that a learnt judge knows, as one frozen tuple; what rollouts, and files, take of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, get_args, get_type_hints

import numpy as np

from evofsm.guard.harm import OUTCOMES, SETTINGS
from evofsm.guard.learnt import failure, model, rollout
from evofsm.guard.learnt.failure import HELD, ONE, OTHER, SAYS, B, I, J, Survived
from evofsm.guard.learnt.rollout import CRASHES, ENDS, FAILS, FATAL, Floats, Model
from evofsm.store import COUNT, FROM_1, SHARE, SIZE, Kind, Numbers

#: From an observation and an encoded action (a,) to the observation a decision later.
Move = Callable[[Floats, Floats], Floats]

# What files hold of a field: observations, what is not negative, and ends that may be infinite.
_SEEN, _ABOVE_0 = Numbers(least=-1e30, most=1e30), Numbers(least=0.0)
_BOUNDS = Numbers(least=-np.inf, most=np.inf)
# Settings, of some of which 0 would be none left to draw from, or to divide by; numbers of steps.
_Count = Annotated[int, COUNT._replace(most=1e6)]
_Real = Annotated[float, _ABOVE_0]
_Some = Annotated[int, FROM_1._replace(most=1e6)]
_Size = Annotated[float, SIZE]
_Steps = Annotated[int, FROM_1._replace(most=1e4)]


@dataclass(frozen=True)
class LearntSettings:
    """Numbers of the learnt judge.

    They were chosen on the systems of the studies, with other draws than those that results are
    given of. A ValueError names one that cannot be.
    """

    n_disturbances: _Count = 10  #: disturbances that are remembered
    n_situations: _Some = 32  #: situations on which disturbances and backups are tried
    n_asked: _Some = 3  #: backups that are asked in a decision; of more than 12 variables 2
    n_linear: _Count = 3  #: linear backups
    n_mutants: _Count = 40  #: backups that are tried after an episode
    n_regulators: _Count = 4  #: and those beside them where actions are a box
    n_starts: _Some = 100  #: steps of an episode in which a disturbance may begin, at most
    max_failures: _Some = 200  #: observations in which it failed, of which it is learnt
    max_survived: _Some = 8000  #: and that were survived: of more every second one is left out
    margin: _Real = 3.0  #: what has to be left of the distance to failure at first [typical steps]
    margin_max: _Real = 8.0  #: and at most
    margin_fade: _Real = 0.9  #: the share of the margin that is left an episode later
    #: what a violated certificate adds to it, and the least margin [typical steps] ...
    margin_step: _Real = 0.25
    #: ... for which share of decisions (adaptive conformal inference, Gibbs & Candes 2021)
    violation_rate: _Real = 0.001
    #: how much harder disturbances are taken to be than they were, over the number of episodes ...
    caution: _Real = 4.0
    caution_max: _Real = 2.0  #: ... by so much at most, at first
    #: and after the system changed: a change half as large again as any there was has no sequel
    caution_again: _Real = 0.44
    horizon: _Steps = 64  #: how far it looks ahead at first [steps]
    horizon_min: _Steps = 32  #: at least
    horizon_max: _Steps = 144  #: at most
    ahead: _Size = 1.5  #: it looks so many times as far as it takes to fail
    latest: _Size = 0.98  #: of the time that it takes to fail, what is left an episode later
    refuted: _Real = 0.8  #: and after one that went on from where nothing seemed to help
    tries: _Count = 8  #: an action that was used less often is tried ...
    alike: _Real = 0.02  #: ... where backups are alike up to such a share of the horizon
    prior: _Real = 0.01  #: by how many observations weights are held to 0
    shy: _Real = 20.0  #: and those of bends and products
    lags: _Real = 10.0  #: so many times more those of the latest change and the action before
    #: which are left out from so much on that was missed more with them where failures that they
    #: foresaw did not come [ln(1 + square in typical steps)]
    misled: _Real = 1.0
    outlier: _Real = 4.0  #: from so many scales on residuals weigh less (Huber 1964)
    rare: _Count = 30  #: but not of an action at an end of its range that was used less often
    drift: _Real = 30.0  #: gained log likelihood from which on it moves otherwise (Page 1954)
    #: of the latest episodes, what is left an episode later; of ``misled`` after one that failed
    #: and in most of which nothing seemed to help
    drift_fade: _Real = 0.95
    refused: _Real = 0.1  #: forms that refuse more than this share of proposals ...
    #: ... in so many episodes without failure are doubted: a rival is tried while it learns
    patience: _Count = 6
    again: _Count = 2  #: so many times as late each time that this was wrong
    #: episodes without failure from which on a rival that was tried counts frozen, too; so long
    #: thresholds count, frozen, that fewer forms took the place of
    settled: _Count = 20
    longer: _Real = 0.002  #: share of the horizon that who takes over has to last longer
    work: _Real = 7e6  #: products in the rollouts of a decision at most
    work_rate: _Real = 8.75e8  #: and in a second of the interval

    def __post_init__(self) -> None:
        for name, numbers in KIND.settings["settings"].items():
            numbers.refuse_others(name, value := getattr(self, name))
            object.__setattr__(self, name, np.asarray(value).item())  # as files hold it


class Given(NamedTuple):
    """What a user says, None where that is learnt; actions are encoded, (a,)."""

    seed: int  #: of what is drawn, together with the number of the episode
    horizon: float | None  #: how far to look ahead [s]
    failed: Callable[[Floats], bool] | None  #: of an observation
    model: Move | None
    backup: Callable[[Floats], Floats] | None  #: action, of an observation


class Episode(NamedTuple):
    """An episode, or a part of a long one, as it was seen; NaN where something was not."""

    observations: Floats  #: (T + 1, m)
    actions: Floats  #: (T, a)
    failed: bool
    terminated: bool  #: whether it ended by itself, without failing
    refused: Floats  #: (T,) 1 where a proposal was refused
    lost: Floats  #: (T,) 1 where nothing helped, even without a disturbance
    certified: Floats  #: (T,) 1 where some backup survived all
    fails_after: float  #: steps after which what was refused fails, at the latest
    early: bool  #: whether it ended before four observations

    def every(self, stride: int) -> Episode:
        """Steps of so many decisions each, to the last observation; their actions in the mean."""
        if stride == 1:
            return self
        n = len(self.actions) // stride
        first = len(self.actions) - n * stride
        rows = slice(first, None, stride)
        actions = self.actions[first:].reshape(n, stride, self.actions.shape[1]).mean(1)
        notes = {name: getattr(self, name)[rows] for name in ("refused", "lost", "certified")}
        return self._replace(observations=self.observations[rows], actions=actions, **notes)


class State(NamedTuple):
    """What was learnt, of m variables and actions of a numbers; p features."""

    settings: LearntSettings
    choices: Annotated[int, COUNT]  #: number of actions; 0 where the action is a box
    n_episodes: Annotated[int, COUNT]  #: or parts of long ones
    n_failed: Annotated[int, COUNT]
    n_scanned: Annotated[int, COUNT]  #: episodes since some failure was understood
    n_seen: Annotated[int, COUNT]  #: observations
    n_moves: Annotated[int, COUNT]  #: changes of which the typical step was learnt
    # model
    origin: Annotated[Floats, _SEEN.of("m")]
    squares: Annotated[Floats, Numbers(("p", "p"))]
    products: Annotated[Floats, Numbers(("p", "m"))]
    unit: Annotated[Floats, _ABOVE_0.of("m")]  #: typical step
    least: Annotated[Floats, Numbers(("m",))]  #: most negative change that was no jump
    most: Annotated[Floats, Numbers(("m",))]  #: most positive one
    scale: Annotated[Floats, _ABOVE_0.of("m")]  #: of residuals; 0 as long as it is not known
    noise: Annotated[Floats, _ABOVE_0.of("m")]  #: mean square of residuals
    power: Annotated[Floats, _ABOVE_0.of("m")]  #: mean square of changes
    recent_squares: Annotated[Floats, Numbers(("p", "p"))]  #: as ``squares``, of the last episodes
    recent_products: Annotated[Floats, Numbers(("p", "m"))]
    doubt: Annotated[Floats, _ABOVE_0.of("m")]  #: whether a variable moves otherwise
    since: Annotated[Floats, COUNT.of("m")]  #: and since which episode
    drifts: Annotated[Floats, COUNT.of("drifts", 3)]  #: variable, since, noticed
    # failure
    lowest: Annotated[Floats, _BOUNDS.of(2, "m")]  #: least observations of two episodes
    highest: Annotated[Floats, _BOUNDS.of(2, "m")]
    reached: Annotated[Floats, COUNT.of("m", 2)]  #: episodes that came to these ends by moving
    survived: Annotated[Floats, _SEEN.of("survived", "m")]
    proven: Annotated[Floats, COUNT.of("survived")]  #: 1 where it went on for long
    brinks: Annotated[Floats, _SEEN.of("brinks", "m")]  #: last observations before failure
    failures: Annotated[Floats, _SEEN.of("failures", "m")]
    ended: Annotated[Floats, _SEEN.of("ended", "m")]  #: where episodes ended without failing
    forms: Annotated[Floats, Numbers(("forms", failure.SIZE))]  #: where it fails or ends
    #: thresholds that fewer forms took the place of, for so many episodes more (``HELD``)
    dropped: Annotated[Floats, Numbers(("dropped", failure.SIZE))]
    differs: Annotated[float, SHARE]  #: of what was asked, where a given function says otherwise
    #: episodes without failure in which much was refused; below 0 those in which a rival was tried
    n_doubted: Annotated[int, COUNT._replace(least=-COUNT.most)]
    wrong: Annotated[int, COUNT]  #: how often a rival was wrong
    misled: Annotated[float, _ABOVE_0]  #: how much more was missed with lags than without
    # dead ends
    centres: Annotated[Floats, _SEEN.of("dead_ends", "m")]
    radii: Annotated[Floats, _ABOVE_0.of("dead_ends")]
    counts: Annotated[Floats, _ABOVE_0.of("dead_ends")]
    fatal: Annotated[Floats, _SEEN.of("fatal", "m")]  #: where what nothing survives began
    #: of the latest episodes in which nothing seemed to help, 1 of those that then failed
    lost: Annotated[Floats, SHARE.of("lost")]
    # disturbances
    windows: Annotated[Floats, _SEEN.of("windows", "steps", "seen")]  #: observations and actions
    spans: Annotated[Floats, COUNT.of("windows", 2)]  #: steps of each, and its episode
    #: observation, its change, action before
    situations: Annotated[Floats, _SEEN.of("situations", "situation")]
    # backups
    policies: Annotated[Floats, Numbers(("policies", "a", "policy"))]  #: in their order
    #: 1 of those that evolve, 2 of the one that was given
    linear: Annotated[Floats, COUNT._replace(most=2.0).of("policies")]
    used: Annotated[Floats, COUNT.of("a", 2)]
    margin: Annotated[float, _ABOVE_0]  #: [typical steps]
    time_to_failure: Annotated[float, _ABOVE_0]  #: [steps]
    believed: Annotated[float, _ABOVE_0]  #: [steps]
    too_short: Annotated[float, _ABOVE_0]  #: [steps] before a failure that was certified not to be
    horizon: _Steps  #: [steps]
    stride: _Steps  #: decisions in a step

    @classmethod
    def none(
        cls, settings: LearntSettings, m: int, a: int, choices: int, horizon: int | None
    ) -> State:
        """Before anything was learnt: zeros, and no rows, but for what is named here."""
        p, steps = rollout.n_features(m, a, box=not choices), settings.horizon_max + 2
        size = {"m": m, "a": a, "p": p, "policy": 1 + m, "situation": 2 * m + a}
        size |= {"seen": m + a, "steps": steps}
        fields: dict[str, Any] = {
            name: np.zeros([n if isinstance(n, int) else size.get(n, 0) for n in numbers.shape])
            if kind == Floats
            else kind()
            for name, (kind, numbers) in _FIELDS.items()
        }
        return cls(settings, **fields)._replace(
            choices=choices,
            lowest=np.full((2, m), np.inf),
            highest=np.full((2, m), -np.inf),
            margin=settings.margin,
            time_to_failure=settings.horizon / settings.ahead,
            believed=float(settings.horizon_max),
            horizon=settings.horizon if horizon is None else horizon,
            stride=1,
        )

    @property
    def knows_failure(self) -> bool:
        """Whether anything is known to fail: not only where episodes end by themselves."""
        return len(self.centres) > 0 or bool((self.forms[:, SAYS] != ENDS).any())

    @property
    def is_doubted(self) -> bool:
        """Whether its forms are doubted: while it learns rivals are tried."""
        return self.n_doubted < 0

    @property
    def rivals(self) -> Floats:
        """Its forms, as small as they may be (`failure.rivals`)."""
        return failure.rivals(self.forms, self.failures, sizes(self))

    @property
    def is_settled(self) -> bool:
        """Whether rivals were tried for so long without a failure that they count, also frozen."""
        return self.n_doubted < -self.settings.settled

    @property
    def disturbance_scale(self) -> float:
        """How much harder than they were disturbances are taken to be, while little was seen."""
        settings = self.settings
        most = settings.caution_again if len(self.drifts) else settings.caution_max
        return 1.0 + min(most, settings.caution / max(1, self.n_scanned))

    def packed(self) -> dict[str, Floats]:
        """What was learnt, by name, as a file holds it."""
        return {name: np.asarray(getattr(self, name), np.float64) for name in _FIELDS}


def sizes(state: State) -> Survived:
    """What was survived, as forms are fitted to it."""
    rows = np.concatenate([state.survived, state.brinks])
    unit = 1.25 * np.maximum(state.unit, model.FLOOR * _spread(state) + 1e-300)
    noise = np.where(state.reached < 2, state.scale[:, None], 0.0)
    return Survived(rows, state.lowest, state.highest, unit, _spread(state), state.ended, noise)


def _spread(state: State) -> Floats:
    """(m,) standard deviation of what was survived; 0, not rounding, of what never changed."""
    rows = state.survived
    return (
        np.where((rows != rows[:1]).any(0), rows.std(0), 0.0) if len(rows) else 0.0 * state.origin
    )


def forms_of(state: State, *, daring: bool = False) -> Floats:
    """(r, 13) forms as rollouts take them (`failure.prepared`).

    Where they are ``daring``, as while it learns, rivals of what is doubted are tried, and it comes
    closer to where it crashes.
    """
    table = state.forms
    if daring:
        crash = table[:, SAYS] == CRASHES
        table = table.copy()
        table[crash] = failure.nearer(table[crash], state.failures, 0.5)
    if state.is_doubted and (daring or state.is_settled):
        table = failure.rivals(table, state.failures, sizes(state))
    if not daring:
        table = np.concatenate([table, state.dropped])
    return failure.prepared(table)


def model_of(state: State) -> Model:
    """Make what rollouts take; weights are solved of the sums each time."""
    settings, spread = state.settings, _spread(state)
    inverse = np.divide(1.0, spread, out=np.zeros_like(spread), where=spread > 0.0)
    lowest = np.where(state.reached[:, 0] >= 2, state.lowest[0], -np.inf)
    highest = np.where(state.reached[:, 1] >= 2, state.highest[0], np.inf)
    fails = failure.saying(state.forms, FAILS)
    for j, sign in fails[failure.are_sides(fails)][:, [I, B]].tolist():
        (lowest if sign < 0.0 else highest)[int(j)] = sign * np.inf  # nothing is held there
    typical = 1.25 * float(np.sqrt(np.mean((state.unit * inverse) ** 2))) if len(spread) else 1.0
    share = state.noise / np.where(state.power > 0.0, state.power, 1.0)
    noisy = np.where(state.scale > 0.0, share.clip(1e-3, 1.0), 1.0)
    lags = settings.lags if state.misled < settings.misled else np.inf
    prior = settings.prior, settings.shy, lags
    weights = model.solve(state.squares, state.products, noisy, len(state.used), prior)
    return Model(
        weights=weights if np.isfinite(weights).all() else np.zeros_like(weights),
        origin=state.origin,
        reach=1.5 * np.maximum(np.abs(state.least), np.abs(state.most)),
        lowest=lowest,
        highest=highest,
        least=state.least,
        most=state.most,
        forms=forms_of(state),
        dead_ends=np.column_stack(
            [state.centres, state.radii, np.full(len(state.radii), 1.0 / (typical + 1e-300))]
        ),
        mean=state.survived.mean(0) if len(state.survived) else state.origin,
        inverse=inverse,
        choices=state.choices,
    )


def residuals_of(state: State, known: Model, steps: int) -> Floats:
    """(H, m, 1 + K) residuals of disturbances as they are seen now; number 0 is none.

    Of a variable that moves otherwise since, nothing is known: what was not expected of it was
    seen with the model of then. Where some variable jumps, also where it lands, (H, 2m, 1 + K).
    """
    m = len(state.origin)
    residuals = model.undisturbed(steps, m, 1 + len(state.windows))
    rows = zip(state.windows, state.spans.astype(int).tolist(), strict=True)
    for k, (window, (n, episode)) in enumerate(rows, 1):
        inputs = window[:n, :m], window[: n - 1, m:], state.unit
        rest = model.disturbed(known, *inputs)[:steps]
        rest[:, state.drifts[state.drifts[:, 1] > episode, 0].astype(int)] = 0.0
        residuals[: len(rest), :, k] = rest
    return model.trimmed(residuals)


class Parts(NamedTuple):
    """What decides, made of a state."""

    model: Model
    daring: Model  #: while it learns
    residuals: Floats  #: (H, m, 1 + K) of disturbances; number 0 is none
    scale: float  #: how much harder than they were disturbances are taken to be
    n_asked: int  #: backups that a search asks
    n_tried: int  #: and while a rival is tried, by which another may save
    n_judged: int  #: and those by which a risk is found
    most: float  #: steps of rollouts after which a search is cut short
    usual: Floats  #: (2, m) beyond which nothing like it was seen

    @classmethod
    def of(cls, state: State, dt: float) -> Parts | None:
        """Make them; None as long as there are no backups."""
        if not len(state.policies):
            return None
        settings, motion = state.settings, model_of(state)
        daring_model = motion._replace(forms=forms_of(state, daring=True))
        residuals = residuals_of(state, motion, state.horizon)
        few = settings.n_asked if len(rollout.pairs(len(state.origin))[0]) else 2
        cost = (motion.weights.size + motion.dead_ends.size) * residuals.shape[2]
        most = max(min(settings.work, settings.work_rate * dt) / cost, few * state.horizon)
        n_judged = 1 if most < 2 * few * state.horizon else few
        n_policies = len(state.policies)
        n_tried = few if not state.is_doubted or most < n_policies * state.horizon else n_policies
        scale = state.disturbance_scale
        least, farthest = state.lowest[1], state.highest[1]  # if two episodes came there
        room = np.where(farthest >= least, 0.5 * (farthest - least), np.inf)
        usual = np.array([np.minimum(least, farthest) - room, np.maximum(least, farthest) + room])
        return cls(motion, daring_model, residuals, scale, few, n_tried, n_judged, most, usual)


# -- In a file -----------------------------------------------------------------------------------

# What a field holds: its type, and which numbers.
_FIELDS = {
    name: get_args(hint)
    for name, hint in get_type_hints(State, include_extras=True).items()
    if name != "settings"  # they stand beside it
}
_HINTS = get_type_hints(LearntSettings, include_extras=True).items()
KIND = Kind(
    "learntrisk",
    {"harm": OUTCOMES, **{name: numbers for name, (_, numbers) in _FIELDS.items()}},
    {
        "dt": SIZE,
        "given_horizon": SIZE._replace(optional=True),
        "n_actions": FROM_1._replace(optional=True),
        **dict.fromkeys(("low", "high"), Numbers(("ends",), -1e100, 1e100)),
        "seed": COUNT,
        **dict.fromkeys(("names", "units"), list[str]),
        "harm": SETTINGS,
        "settings": {name: get_args(hint)[1] for name, hint in _HINTS},
    },
)


def unpacked(arrays: Mapping[str, Any], blank: State) -> State:
    """Make a state of what `State.packed` gave, of actions as of a ``blank`` one.

    A ValueError if sizes or indices contradict each other, or the actions: kernels trust them.
    """
    fields: dict[str, Any] = {
        name: arrays[name] if kind == Floats else kind(arrays[name])
        for name, (kind, _) in _FIELDS.items()
    }
    state = State(blank.settings, **fields)
    m, a, choices = len(state.origin), len(state.used), state.choices
    if (choices, a) != (blank.choices, len(blank.used)):
        raise ValueError(f"it is of actions of {a} numbers, but they have {len(blank.used)}")
    rollout.refuse_too_many(m, a, box=not choices)
    right = State.none(state.settings, m, a, choices, None)
    for name in _FIELDS:
        shape, rows = np.shape(getattr(state, name)), int(name != "squares")
        if shape[rows:] != np.shape(getattr(right, name))[rows:]:
            fault = f"not one of {m} variables and actions of {a} numbers"
            raise ValueError(f"{name} has shape {shape}, {fault}")
    forms, steps = np.concatenate([state.forms, state.dropped]), state.windows.shape[1]
    indices = forms[:, [SAYS, I, J]]
    if ((indices != np.rint(indices)) | (indices < 0.0) | (indices >= [FATAL + 1, m, m])).any():
        raise ValueError("forms are of variables that there are not")
    if (forms[:, [ONE, OTHER]] <= 0.0).any() or (forms[:, HELD] < 0.0).any():
        raise ValueError("forms have units that are not positive")
    if (state.drifts[:, 0] >= m).any():
        raise ValueError("drifts are of variables that there are not")
    if ((state.spans[:, 0] < 3.0) | (state.spans[:, 0] > steps)).any():
        raise ValueError(f"windows have other than 3 to {steps} steps")
    return state

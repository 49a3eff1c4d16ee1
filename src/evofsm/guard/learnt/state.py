"""All that a learnt judge knows, as one frozen tuple; what rollouts, and files, take of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from evofsm.guard.harm import OUTCOMES, SETTINGS
from evofsm.guard.learnt import failure, model
from evofsm.guard.learnt.failure import HELD, ONE, OTHER, SAYS, B, I, J, Survived
from evofsm.guard.learnt.rollout import (
    CRASHES,
    DEAD,
    FAILS,
    Floats,
    Model,
    n_features,
    refuse_too_many,
)
from evofsm.store import COUNT, FROM_1, SHARE, SIZE, SMALLEST, Kind, Numbers

#: From an observation and an encoded action (a,) to the observation a decision later.
Move = Callable[[Floats, Floats], Floats]

# What files hold of a field: observations, what is not negative, and ends that may be infinite.
_SEEN, _ABOVE_0 = Numbers(least=-1e30, most=1e30), Numbers(least=0.0)
_BOUNDS = Numbers(least=-np.inf, most=np.inf)


@dataclass(frozen=True)
class LearntSettings:
    """Numbers of the learnt judge.

    Parameters
    ----------
    n_disturbances, n_situations : int
        Disturbances that are remembered, and situations on which these and backups are tried.
    n_asked : int
        Backups that are asked in a decision; of more than 12 variables 2.
    n_linear, n_mutants, n_regulators : int
        Linear backups, and mutants and, where actions are a box, regulators that are tried after an
        episode.
    n_starts : int
        Steps of an episode in which a disturbance may begin, at most.
    max_failures, max_survived : int
        Observations in which it failed, and that were survived, of which it is learnt; of the
        latter every second one is left out where there are more.
    margin, margin_max : float
        What has to be left of the distance to failure, at first and at most [typical steps].
    margin_fade : float
        The share of the margin that is left an episode later.
    margin_step, violation_rate : float
        What a violated certificate adds to the margin, which is also the least one [typical
        steps], and for which share of decisions (adaptive conformal inference, Gibbs & Candes
        2021).
    caution, caution_max, caution_again : float
        Disturbances are taken to be harder than they were by ``caution`` over the number of
        episodes; by the others at most, at first and after the system changed: a change half as
        large again as any there was has no sequel.
    horizon, horizon_min, horizon_max : int
        How far it looks ahead: at first, at least and at most [steps].
    ahead : float
        It looks so many times as far as it takes to fail.
    latest, refuted : float
        Of the time that it takes to fail, what is left an episode later, and after one that went on
        from where nothing seemed to help.
    tries, alike : float
        Where backups are alike up to such a share of the horizon, an action that was used less
        often is tried.
    prior, shy, lags : float
        By how many observations weights are held to 0, those of bends and products, and so many
        times more those of the latest change and the action before.
    misled : float
        Those are left out where they foresaw failures that did not come: from so much on that was
        missed more with them [ln(1 + square in typical steps)].
    outlier : float
        From so many scales on residuals weigh less (Huber 1964).
    rare : int
        But not of an action at an end of its range that was used less often.
    drift, drift_fade : float
        It moves otherwise from so much gained log likelihood on (Page 1954); of the latest episodes
        what is left an episode later.
    refused, patience, again, settled : float
        What refuses more than this share of proposals, in so many episodes without failure, is
        doubted: while it learns its smallest rival is tried, ``again`` times as late each time that
        was wrong. After so many episodes without failure in which it was tried it counts, also
        frozen; so long thresholds count, frozen, that fewer forms took the place of.
    work, work_rate : float
        Products in the rollouts of a decision at most: altogether, and in a second of the interval.

    Notes
    -----
    They were chosen on the systems of the studies, with other draws than those that results are
    given of.
    """

    n_disturbances: int = 10
    n_situations: int = 32
    n_asked: int = 3
    n_linear: int = 3
    n_mutants: int = 40
    n_regulators: int = 4
    n_starts: int = 100
    max_failures: int = 200
    max_survived: int = 8000
    margin: float = 3.0
    margin_max: float = 8.0
    margin_fade: float = 0.9
    margin_step: float = 0.25
    violation_rate: float = 0.001
    caution: float = 4.0
    caution_max: float = 2.0
    caution_again: float = 0.44
    horizon: int = 64
    horizon_min: int = 32
    horizon_max: int = 144
    ahead: float = 1.5
    latest: float = 0.98
    refuted: float = 0.8
    tries: int = 8
    alike: float = 0.02
    prior: float = 0.01
    shy: float = 20.0
    lags: float = 10.0
    misled: float = 1.0
    outlier: float = 4.0
    rare: int = 30
    drift: float = 30.0
    drift_fade: float = 0.95
    refused: float = 0.1
    patience: int = 6
    again: int = 2
    settled: int = 20
    longer: float = 0.002
    work: float = 7e6
    work_rate: float = 8.75e8


class Given(NamedTuple):
    """What a user says, None where that is learnt; actions are encoded, (a,)."""

    settings: LearntSettings
    seed: int  #: of what is drawn, together with the number of the episode
    without: Set[str]  #: parts that are left out (`LearntRisk.PARTS`)
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

    choices: Annotated[int, COUNT]  #: number of actions; 0 where the action is a box
    n_episodes: Annotated[int, COUNT]
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
    #: episodes without failure in which much was refused; below 0 those of doubt
    held: Annotated[int, COUNT._replace(least=-COUNT.most)]
    wrong: Annotated[int, COUNT]  #: how often a rival was wrong
    misled: Annotated[float, _ABOVE_0]  #: how much more was missed with lags than without
    # dead ends
    centres: Annotated[Floats, _SEEN.of("dead_ends", "m")]
    radii: Annotated[Floats, _ABOVE_0.of("dead_ends")]
    counts: Annotated[Floats, _ABOVE_0.of("dead_ends")]
    fatal: Annotated[Floats, _SEEN.of("fatal", "m")]  #: where what nothing survives began
    # disturbances
    windows: Annotated[Floats, _SEEN.of("windows", "steps", "seen")]  #: observations and actions
    lengths: Annotated[Floats, COUNT.of("windows")]
    seen_in: Annotated[Floats, COUNT.of("windows")]  #: episode
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
    horizon: Annotated[int, COUNT._replace(least=1.0, most=1e4)]  #: [steps]
    stride: Annotated[int, COUNT._replace(least=1.0, most=1e4)]  #: decisions in a step

    @classmethod
    def none(
        cls, m: int, a: int, choices: int, settings: LearntSettings, horizon: int | None
    ) -> State:
        """Before anything was learnt: zeros, and no rows, but for what is named here."""
        p, steps = n_features(m, a, box=not choices), settings.horizon_max + 2
        size = {"m": m, "a": a, "p": p, "policy": 1 + m, "situation": 2 * m + a}
        size |= {"seen": m + a, "steps": steps}
        fields: dict[str, Any] = {
            name: np.zeros([n if isinstance(n, int) else size.get(n, 0) for n in numbers.shape])
            if kind == Floats
            else kind()
            for name, (kind, numbers) in _FIELDS.items()
        }
        return cls(**fields)._replace(
            choices=choices,
            lowest=np.full((2, m), np.inf),
            highest=np.full((2, m), -np.inf),
            margin=settings.margin,
            time_to_failure=settings.horizon / settings.ahead,
            believed=float(settings.horizon_max),
            horizon=settings.horizon if horizon is None else horizon,
            stride=1,
        )


def sizes(state: State) -> Survived:
    """What was survived, as forms are fitted to it."""
    rows = np.concatenate([state.survived, state.brinks])
    unit = 1.25 * np.maximum(state.unit, model.FLOOR * _spread(state) + 1e-300)
    return Survived(rows, state.lowest, state.highest, unit, _spread(state), state.ended)


def _spread(state: State) -> Floats:
    """(m,) standard deviation of what was survived."""
    rows = state.survived
    return np.asarray(rows.std(0) if len(rows) else np.zeros(len(state.origin)))


def forms_of(state: State, settings: LearntSettings, *, daring: bool = False) -> Floats:
    """(r, 13) forms as rollouts take them (`failure.prepared`).

    Where they are ``daring``, as while it learns, rivals of what is doubted are tried, and it comes
    closer to where it crashes.
    """
    table = state.forms
    if daring:
        crash = table[:, SAYS] == CRASHES
        table = table.copy()
        table[crash] = failure.nearer(table[crash], state.failures, 0.5)
    if state.held < (0 if daring else -settings.settled):
        table = failure.rivals(table, state.failures, sizes(state))
    if not daring:
        table = np.concatenate([table, state.dropped])
    return failure.prepared(table)


def model_of(state: State, settings: LearntSettings) -> Model:
    """Make what rollouts take."""
    spread, table = _spread(state), state.forms
    inverse = 1.0 / np.where(spread > 0.0, spread, 1.0)
    lowest = np.where(state.reached[:, 0] >= 2, state.lowest[0], -np.inf)
    highest = np.where(state.reached[:, 1] >= 2, state.highest[0], np.inf)
    fails = table[:, SAYS] == FAILS
    for j, sign in table[failure.are_sides(table) & fails][:, [I, B]].tolist():
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
        forms=forms_of(state, settings),
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
    rows = zip(state.windows, state.lengths.astype(int), state.seen_in, strict=True)
    for k, (window, n, episode) in enumerate(rows, 1):
        inputs = window[:n, :m], window[: n - 1, m:], state.unit
        rest = model.disturbed(known, *inputs)[:steps]
        rest[:, state.drifts[state.drifts[:, 1] > episode, 0].astype(int)] = 0.0
        residuals[: len(rest), :, k] = rest
    return model.trimmed(residuals)


# -- In a file -----------------------------------------------------------------------------------

# What a field holds: its type, and which numbers.
_FIELDS = {
    name: get_args(hint) for name, hint in get_type_hints(State, include_extras=True).items()
}
_ARRAYS = {name: numbers for name, (kind, numbers) in _FIELDS.items() if kind == Floats}
_NUMBERS = {name: numbers for name, (_, numbers) in _FIELDS.items() if name not in _ARRAYS}
_SETTING = {int: COUNT._replace(most=1e6), float: Numbers(least=SMALLEST)}
KIND = Kind(
    "learntrisk",
    {"harm": OUTCOMES, **_ARRAYS},
    {
        "dt": SIZE,
        "given_horizon": SIZE._replace(optional=True),
        "n_actions": FROM_1._replace(optional=True),
        **dict.fromkeys(("low", "high"), Numbers(("ends",), -1e100, 1e100)),
        "seed": COUNT,
        **dict.fromkeys(("names", "units", "without"), list[str]),
        "harm": SETTINGS,
        "settings": {name: _SETTING[kind] for name, kind in get_type_hints(LearntSettings).items()},
        "state": _NUMBERS,
    },
)


def packed(state: State) -> tuple[dict[str, Any], dict[str, Floats]]:
    """Numbers and arrays of a state, by name."""
    fields = state._asdict()
    return {name: fields[name] for name in _NUMBERS}, {name: fields[name] for name in _ARRAYS}


def unpacked(
    numbers: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
    choices: int,
    size: int,
    settings: LearntSettings,
) -> State:
    """Make a state of what `packed` gave.

    A ValueError if sizes or indices contradict each other, or the actions: kernels trust them.
    """
    fields: dict[str, Any] = {**numbers, **{name: arrays[name] for name in _ARRAYS}}
    state = State(**fields)
    m, a = len(state.origin), len(state.used)
    if (state.choices, a) != (choices, size):
        raise ValueError(f"it is of actions of {a} numbers, but they have {size}")
    refuse_too_many(m, a, box=not choices)
    for name, array in State.none(m, a, choices, settings, None)._asdict().items():
        shape, rows = np.shape(getattr(state, name)), int(name != "squares")
        if shape[rows:] != np.shape(array)[rows:]:
            raise ValueError(
                f"{name} has shape {shape}, not one of {m} variables and actions of {a} numbers"
            )
    forms, steps = np.concatenate([state.forms, state.dropped]), state.windows.shape[1]
    indices = forms[:, [SAYS, I, J]]
    if ((indices != np.rint(indices)) | (indices < 0.0) | (indices >= [DEAD + 1, m, m])).any():
        raise ValueError("forms are of variables that there are not")
    if (forms[:, [ONE, OTHER]] <= 0.0).any() or (forms[:, HELD] < 0.0).any():
        raise ValueError("forms have units that are not positive")
    if (state.drifts[:, 0] >= m).any():
        raise ValueError("drifts are of variables that there are not")
    if ((state.lengths < 3.0) | (state.lengths > steps)).any():
        raise ValueError(f"windows have other than 3 to {steps} steps")
    return state

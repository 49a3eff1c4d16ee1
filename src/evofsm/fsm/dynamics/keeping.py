"""Dynamics in files: a file of their own, which stands within that of a machine or a model.

It holds what the next step needs and all that was learnt; not `Dynamics.latest`, from which a judge
learns as an episode ends, nor `Dynamics.told`, which is code.
"""

from __future__ import annotations

import math
from io import BytesIO
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from evofsm import store
from evofsm.fsm.dynamics.consequents import Consequents, Stretch, n_features
from evofsm.fsm.dynamics.drift import Drift, Recent
from evofsm.fsm.dynamics.dynamics import Dynamics
from evofsm.fsm.dynamics.following import LARGEST
from evofsm.fsm.dynamics.observer import GAINS
from evofsm.fsm.dynamics.regression import Sums
from evofsm.fsm.dynamics.undoing import side_by_side
from evofsm.store import COUNT, FLAG, FROM_1, SHARE, Kind, Numbers

_Shape: TypeAlias = tuple[int | str, ...]

_SOME = Numbers(least=-1e300, most=1e300)
_NOT_NEGATIVE = Numbers(least=0.0)
_OBSERVED = Numbers(least=-LARGEST, most=LARGEST)
# The first ones to come are infinitely far out.
_EXTREME = Numbers(least=-math.inf, most=math.inf)
_KNOWN = "known_"
# Of consequents: what they were made of may have changed since.
_CONSEQUENTS: dict[str, _Shape] = {
    "weights": ("p", "m"),
    "reach": ("m",),
    "lowest": ("m",),
    "highest": ("m",),
    "least": ("m",),
    "most": ("m",),
    "sides": ("s", 4),
    "mean": ("m",),
    "inverse": ("m",),
    "close": ("m",),
    "gains": ("m",),
}
_SUMS: dict[str, tuple[_Shape, Numbers]] = {
    "counts": ((2,), COUNT),
    "squares": (("p", "p"), _SOME),
    "products": (("p", "m"), _SOME),
    "mean": (("m",), _SOME),
    "scatter": (("m",), _NOT_NEGATIVE),
    "variance": (("m",), _NOT_NEGATIVE),
    "unit": (("m",), _NOT_NEGATIVE),
    "early": ((200, "m"), _NOT_NEGATIVE),
    "least": (("m",), _SOME),
    "most": (("m",), _SOME),
    "scale": (("m",), _NOT_NEGATIVE),
    "noise": (("m",), _NOT_NEGATIVE),
    "low": (("m",), _OBSERVED),
    "high": (("m",), _OBSERVED),
    "moving": (("m",), SHARE),
}
# Arrays of dynamics under their own names.
_OWN: dict[str, tuple[_Shape, Numbers]] = {
    "origin": (("m",), _OBSERVED),
    "lowest": (("m",), _EXTREME),
    "highest": (("m",), _EXTREME),
    "reached": (("m", 2), COUNT),
}
_ARRAYS: dict[str, tuple[_Shape, Numbers]] = {
    **{f"sum_{name}": told for name, told in _SUMS.items()},
    **{_KNOWN + name: (shape, _EXTREME) for name, shape in _CONSEQUENTS.items()},
    **_OWN,
    "used": (("a", 2), COUNT),
    "failures": (("failures", "m"), _OBSERVED),
    "jumps": (("jumps", 2), _OBSERVED),  # variable, and where it landed
    "jumps_from": (("jumps", "m"), _OBSERVED),
    "stretches": (("stretches", 2), COUNT),  # numbers of actions, and episodes
    "stretch_observations": (("stretched", "m"), _OBSERVED),
    "stretch_actions": (("acted", "a"), _SOME),
    "observations": (("observed", "m"), _OBSERVED),
    "actions": (("done", "a"), _SOME),
}
# Of whether the model still holds.
_RECENT: dict[str, tuple[_Shape, Numbers]] = {
    "squares": (("p", "p"), _SOME),
    "products": (("p", "m"), _SOME),
    "doubt": (("m",), _NOT_NEGATIVE),
    "since": (("m",), COUNT),
}
_MEMBERS = {
    name: numbers.of(*shape)
    for name, (shape, numbers) in {
        **_ARRAYS,
        **{f"recent_{name}": told for name, told in _RECENT.items()},
        "drifts": (("drifts", 3), COUNT),
        "stretch_unforeseen": (("unforeseen", "m"), _SOME),
        "stretch_is_of_then": (("stretches",), FLAG),
        "doubt_of_lags": ((1,), _NOT_NEGATIVE),
        "missed": (("m", len(GAINS)), _NOT_NEGATIVE),
    }.items()
}
_ENDS = Numbers(("a",), -1e100, 1e100, optional=True)
_KIND = Kind(
    "dynamics",
    _MEMBERS,
    {
        **dict.fromkeys(("horizon", "n_actions"), FROM_1._replace(optional=True)),
        "stretches": FROM_1,
        **dict.fromkeys(("n_episodes", "clock", "quiet"), COUNT),
        **dict.fromkeys(("low", "high"), _ENDS),
    },
)


def to_bytes(dynamics: Dynamics | None) -> NDArray[np.uint8]:
    """A file of dynamics, as bytes; none for None.

    Examples
    --------
    >>> dynamics = from_bytes(to_bytes(Dynamics(n_actions=2)))
    >>> dynamics
    Dynamics(n_actions=2, 0 episodes, 0 variables, 0 stretches)
    >>> from_bytes(to_bytes(None)) is None
    True
    """
    file = BytesIO()
    if dynamics is not None:
        store.write(file, _KIND, _content(dynamics), _arrays(dynamics))
    return np.frombuffer(file.getvalue(), np.uint8)


def from_bytes(encoded: NDArray[Any]) -> Dynamics | None:
    """Dynamics that go on as if they had never been kept.

    Raises
    ------
    ValueError
        If it is no such file, or a damaged one.
    """
    if not len(encoded):
        return None
    content, arrays = store.read(BytesIO(encoded.tobytes()), _KIND)
    numbers = {name: content.pop(name) for name in ("n_episodes", "clock", "quiet", "ready")}
    dynamics = Dynamics(**content)
    dynamics.n_episodes = int(numbers["n_episodes"])
    dynamics.clock, dynamics.quiet = float(numbers["clock"]), float(numbers["quiet"])
    if not isinstance(numbers["ready"], bool):
        raise ValueError(f"ready is {numbers['ready']!r}; it must be true or false")
    _refuse_impossible(dynamics, arrays)
    if len(arrays["origin"]):
        dynamics.begin(arrays["origin"])
        dynamics.ready = numbers["ready"]
        _restore(dynamics, arrays)
    return dynamics


def _content(dynamics: Dynamics) -> dict[str, Any]:
    return dynamics.settings | {
        "n_episodes": dynamics.n_episodes,
        "clock": dynamics.clock,
        "quiet": dynamics.quiet,
        "ready": bool(dynamics.n_variables and dynamics.ready),
    }


def _arrays(dynamics: Dynamics) -> dict[str, NDArray[np.float64]]:
    m, a = dynamics.n_variables, dynamics.size
    if not m:  # nothing was observed: all that depends on it is empty
        sizes = {"a": a}
        return {
            name: np.zeros([n if isinstance(n, int) else sizes.get(n, 0) for n in one.shape])
            for name, one in _MEMBERS.items()
        }
    jumps = [(j, jump) for j, one in enumerate(dynamics.jumps) for jump in one]
    stretches = dynamics.stretches
    observations, actions = dynamics.under_way
    return {
        **{f"sum_{name}": array for name, array in dynamics.sums._asdict().items()},
        **{_KNOWN + name: getattr(dynamics.consequents, name) for name in _CONSEQUENTS},
        **{name: getattr(dynamics, name) for name in _OWN},
        "missed": dynamics.missed,
        **{f"recent_{name}": array for name, array in dynamics.recent._asdict().items()},
        "drifts": np.array(dynamics.drifts, np.float64).reshape(-1, 3),
        "used": dynamics.used,
        "doubt_of_lags": np.array([dynamics.doubt_of_lags]),
        "failures": np.array(dynamics.failures).reshape(-1, m),
        "jumps": np.array([(j, jump[-1]) for j, jump in jumps], np.float64).reshape(-1, 2),
        "jumps_from": np.array([jump[:-1] for _, jump in jumps], np.float64).reshape(-1, m),
        "stretches": np.array(
            [(len(one.actions), one.episode) for one in stretches], np.float64
        ).reshape(-1, 2),
        "stretch_observations": np.concatenate(
            [np.empty((0, m)), *(one.observations for one in stretches)]
        ),
        "stretch_actions": np.concatenate([np.empty((0, a)), *(one.actions for one in stretches)]),
        "stretch_unforeseen": np.concatenate(
            [np.empty((0, m)), *(one.unforeseen for one in stretches)]
        ),
        "stretch_is_of_then": np.array([len(one.unforeseen) > 0 for one in stretches], np.float64),
        "observations": observations,
        "actions": actions,
    }


def _refuse_impossible(dynamics: Dynamics, arrays: dict[str, NDArray[Any]]) -> None:
    """Raise where arrays contradict each other, or the settings; kernels trust their sizes."""
    m, a = len(arrays["origin"]), dynamics.size
    if len(arrays["used"]) != a:
        raise ValueError(f"used has {len(arrays['used'])} rows, but an action has {a} numbers")
    if m and len(arrays["sum_squares"]) != n_features(m, a, box=not dynamics.choices):
        raise ValueError(f"squares has {len(arrays['sum_squares'])} rows, which {m} variables lack")
    of_variables = {name: arrays[name] for name in ("jumps", "drifts", f"{_KNOWN}sides")}
    for name, rows in of_variables.items():
        if len(rows) and not np.isin(rows[:, 0], np.arange(m)).all():
            raise ValueError(f"{name} are of variables that there are not")
    lengths = arrays["stretches"][:, 0]
    expected = lengths.sum() + len(lengths), lengths.sum()
    have = len(arrays["stretch_observations"]), len(arrays["stretch_actions"])
    if expected != have or (len(lengths) and lengths.min() < 2):
        raise ValueError(f"stretches have {have} observations and actions, not {expected}")
    missed = int(((lengths - 1.0) * arrays["stretch_is_of_then"]).sum())
    if missed != len(arrays["stretch_unforeseen"]):
        raise ValueError(
            f"stretches have {len(arrays['stretch_unforeseen'])} rows of what was unforeseen, not "
            f"{missed}"
        )
    observed, done = len(arrays["observations"]), len(arrays["actions"])
    if not max(observed - 1, 0) <= done <= observed:
        raise ValueError(f"there are {done} actions after {observed} observations")


def _restore(dynamics: Dynamics, arrays: dict[str, NDArray[Any]]) -> None:
    dynamics.sums = side_by_side(Sums(**{name: arrays[f"sum_{name}"] for name in _SUMS}))
    for name in _OWN:
        setattr(dynamics, name, arrays[name])
    dynamics.used = arrays["used"]
    dynamics.doubt_of_lags = float(arrays["doubt_of_lags"][0])
    known: dict[str, Any] = {name: arrays[_KNOWN + name] for name in _CONSEQUENTS}
    dynamics.missed = arrays["missed"]
    dynamics.drifts = [Drift(*row) for row in arrays["drifts"].astype(int).tolist()]
    known |= {"origin": arrays["origin"], "anew": dynamics.anew, "choices": dynamics.choices}
    dynamics.consequents = Consequents(**known)
    dynamics.weights = known["weights"]
    dynamics.sides = [(int(j), float(sign), float(at)) for j, sign, at, _ in known["sides"]]
    dynamics.recent = Recent(**{name: arrays[f"recent_{name}"] for name in _RECENT})
    dynamics.failures = list(arrays["failures"])
    for (j, after), before in zip(arrays["jumps"], arrays["jumps_from"], strict=True):
        dynamics.jumps[int(j)].append(np.append(before, after))
    ends = np.cumsum(arrays["stretches"][:, 0]).astype(int)
    begins = ends - arrays["stretches"][:, 0].astype(int)
    of_then = arrays["stretch_is_of_then"] > 0.0
    rows = np.cumsum((ends - begins - 1)[of_then])
    unforeseen = iter(np.split(arrays["stretch_unforeseen"], rows))
    for k, (begin, end) in enumerate(zip(begins.tolist(), ends.tolist(), strict=True)):
        dynamics.stretches.append(
            Stretch(
                arrays["stretch_observations"][begin + k : end + k + 1].copy(),
                arrays["stretch_actions"][begin:end].copy(),
                int(arrays["stretches"][k, 1]),
                next(unforeseen) if of_then[k] else np.empty((0, dynamics.n_variables)),
            )
        )
    dynamics.go_on(arrays["observations"], arrays["actions"])

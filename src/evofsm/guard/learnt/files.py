"""What a learnt judge keeps in a file: the fields of its state and settings, as their types say."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from evofsm.guard.harm import OUTCOMES, SETTINGS
from evofsm.guard.learnt.failure import HELD, ONE, OTHER, SAYS, I, J
from evofsm.guard.learnt.rollout import CRASHES, Floats, refuse_too_many
from evofsm.guard.learnt.state import Settings, State
from evofsm.store import COUNT, FROM_1, SIZE, SMALLEST, Kind, Numbers

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
        **dict.fromkeys(("seed", "n_violated"), COUNT),
        **dict.fromkeys(("names", "units", "without"), list[str]),
        "harm": SETTINGS,
        "settings": {name: _SETTING[kind] for name, kind in get_type_hints(Settings).items()},
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
    settings: Settings,
) -> State:
    """Make a state of what `packed` gave.

    Raises
    ------
    ValueError
        If sizes or indices contradict each other, or the actions: kernels take them on trust.
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
    forms, steps = state.forms, state.windows.shape[1]
    which = forms[:, [SAYS, I, J]]
    if ((which != np.rint(which)) | (which < 0.0) | (which >= [CRASHES + 1, m, m])).any():
        raise ValueError("forms are of variables that there are not")
    if (forms[:, [ONE, OTHER]] <= 0.0).any() or (forms[:, HELD] < 0.0).any():
        raise ValueError("forms have units that are not positive")
    if (state.drifts[:, 0] >= m).any():
        raise ValueError("drifts are of variables that there are not")
    if ((state.lengths < 3.0) | (state.lengths > steps)).any():
        raise ValueError(f"windows have other than 3 to {steps} steps")
    return state

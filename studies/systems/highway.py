"""Tasks of highway-env as they come: other cars, a decision a second, crashes.

`highway-fast-v0`, `merge-v0` and `intersection-v0` with their own actions and unchanged
configuration. A crash is what the environment itself calls ``crashed``. An observation is its
Kinematics, flattened: a row for the car itself and one for each of the nearest others.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.resources import as_file, files
from importlib.resources.abc import Traversable
from typing import Any

import numpy as np

from evofsm.extras import needs
from studies.systems.system import Action, Discrete, Start, System, Vector

with needs("highway-env", "highway", "a task of highway-env"):
    import gymnasium
    from highway_env.vehicle.behavior import IDMVehicle  # registers environments, too

# Names of the five actions, and of those of a car that cannot leave its lane.
_ALL = ("left", "idle", "right", "faster", "slower")
_ALONG = ("slower", "idle", "faster")
# Decisions of an episode, at most; merge has no limit of its own, and is over long before.
_STEPS = {"highway-fast": 30, "merge": 60, "intersection": 13}


class Highway(System):
    """One of the three tasks.

    Parameters
    ----------
    controller : str, optional
        ``random``, ``idle``, ``faster``, or ``dqn``: a deep Q-network that was trained on the task
        without any guard (``tools/train_dqn.py``).
    task : str
        ``"highway-fast"``, ``"merge"`` or ``"intersection"``.

    Raises
    ------
    ValueError
        If there is no such task or controller.
    """

    interval = 1.0
    train = 200

    def __init__(self, controller: str | None = None, *, task: str = "highway-fast") -> None:
        if task not in _STEPS:
            raise ValueError(f"there is no task {task!r}; there are {', '.join(_STEPS)}")
        self.name, self.steps = task, _STEPS[task]
        with warnings.catch_warnings():  # that newer versions of a task exist
            warnings.simplefilter("ignore", DeprecationWarning)
            self.env = gymnasium.make(f"{task}-v0").unwrapped
        config = self.env.config["observation"]  # type: ignore[attr-defined]
        count, columns = self.env.observation_space.shape  # type: ignore[misc]
        #: How a row is laid out: numbers in it, and whether others are relative to the car.
        self.columns, self.relative = columns, not config.get("absolute", False)
        features = config.get("features", ("presence", "x", "y", "vx", "vy"))
        self.variables = tuple(f"{name} {k}" for k in range(count) for name in features)
        n_actions = int(self.env.action_space.n)  # type: ignore[attr-defined]
        self.actions = Discrete(n_actions)
        #: What the actions are called, by index.
        self.names = _ALL if n_actions == len(_ALL) else _ALONG
        self._layers: list[tuple[Vector, Vector]] = []
        super().__init__(controller)

    @property
    def controllers(self) -> Mapping[str, Callable[[Vector], Action]]:
        """Those that act without looking, and one that was trained."""
        idle, faster = self.names.index("idle"), self.names.index("faster")
        return {
            "random": lambda z: int(self.whim.integers(len(self.names))),
            "idle": lambda z: idle,
            "faster": lambda z: faster,
            "dqn": self._trained,
        }

    @property
    def learners(self) -> Sequence[str]:
        """The judge of scenes."""
        return ("scene",)

    @property
    def rivals(self) -> Mapping[str, Callable[[], Any]]:
        """Told the road and all cars on it."""
        from studies.systems.rivals.highway import RIVALS

        along = self.name == "intersection"  # there are no lanes to choose from
        return {
            name: partial(make, self)
            for name, make in RIVALS.items()
            if not (along and make.needs_lanes)
        }

    @property
    def speed(self) -> float:
        """Mean speed of the episode so far [m/s]; NaN before the first decision."""
        return float(np.mean(self._speeds)) if self._speeds else float("nan")

    def _trained(self, observation: Vector) -> int:
        """The action that the network values most."""
        if not self._layers:
            self._layers = read_weights(self.name)
        value = observation
        for k, (weight, bias) in enumerate(self._layers):
            value = weight @ value + bias
            if k < len(self._layers) - 1:
                value = np.maximum(value, 0.0)
        return int(value.argmax())

    def _begin(self, start: Start) -> None:
        _set_habits(_HABITS)
        self._seen, _ = self.env.reset(seed=int(self.chance.integers(2**31)))
        self._habits = _habits()
        self._ended = False
        self._speeds: list[float] = []

    def _observation(self) -> Vector:
        return np.asarray(self._seen, dtype=np.float64).ravel()

    def _advance(self, action: Action) -> tuple[float, bool]:
        _set_habits(self._habits)
        self._seen, reward, terminated, truncated, info = self.env.step(int(action))
        self._speeds.append(float(info["speed"]))
        self._ended = bool(terminated or truncated)
        return float(reward), bool(info["crashed"])

    def _is_over(self) -> bool:
        return self._ended or super()._is_over()


def _habits() -> dict[str, Any]:
    """How other cars drive; an environment may set it for all that the process has."""
    return {name: value for name, value in vars(IDMVehicle).items() if name.isupper()}


def _set_habits(habits: Mapping[str, Any]) -> None:
    for name, value in habits.items():
        setattr(IDMVehicle, name, value)


# Before any environment did. Those of the intersection stay set when it is left, and a row would
# depend on what its process had run before.
_HABITS = _habits()


def read_weights(task: str) -> list[tuple[Vector, Vector]]:
    """Weights and biases of each layer of the network that was trained on a task."""
    with as_file(_weights(task)) as path, np.load(path) as arrays:
        return [
            (arrays[f"weight{k}"].astype(np.float64), arrays[f"bias{k}"].astype(np.float64))
            for k in range(len(arrays.files) // 2)
        ]


def _weights(task: str) -> Traversable:
    """The file that tools/train_dqn.py wrote."""
    return files("studies.systems") / "weights" / f"{task}.npz"

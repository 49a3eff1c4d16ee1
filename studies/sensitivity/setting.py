"""One choice of all that is varied, and what becomes of the paper's claims with it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import Episode, KinematicWorld, Scenario
from evofsm.guard import Controller
from evofsm.paper import CASES, PaperStudy, Settings, check_claims, run_paper

#: Standard deviations over the paper's 80 runs, rounded: gap [m], both speeds [m/s].
SCALES = (17.0, 7.5, 7.5)
#: Noise of the speeds [m/s] for each metre of noise of the gap, as in the families' switch.
SPEED_NOISE = 0.6
#: How often the paper drives its four cases.
ROUNDS = 20
# A setting takes eight different runs; two settings that differ in the machine share them.
_EPISODES = 16


class Scaling(StrEnum):
    """What the machine is shown."""

    RAW = "raw"  #: metres and metres per second, as in the paper
    STANDARDISED = "standardised"  #: divided by `SCALES`; the radius keeps its number


@dataclass(frozen=True)
class Setting:
    """All that is varied; named as in the paper study's ``settings.toml`` where it stands there."""

    brake_speed: float  #: v_p^max, at which the leader begins its full brake [m/s]
    brake_decel: float  #: leader's full brake [m/s²], positive
    initial_gap: float  #: bumper to bumper [m]
    bound: float  #: hardest braking of the follower [m/s²], positive
    spread: float
    learning_rate: float
    prior_frequency: float
    radius: float  #: in the unit of what is observed
    distance_weight: float
    order: tuple[int, ...] = CASES  #: of the cases in each round
    scaling: Scaling = Scaling.RAW
    noise: float = 0.0  #: standard deviation of the gap [m]; speeds have `SPEED_NOISE` of it [m/s]
    noise_seed: int = 0

    def paper_settings(self) -> Settings:
        """The paper's settings with these in their place."""
        limits = {"lowest": -self.bound}
        return Settings.with_changes(
            {
                "scenario": {"initial_gap": self.initial_gap},
                "leader": {"brake_speed": self.brake_speed, "brake_decel": self.brake_decel},
                "aggressive": limits,
                "normal": limits,
                "machine": {
                    "radius": self.radius,
                    "distance_weight": self.distance_weight,
                    "learning_rate": self.learning_rate,
                    "prior_frequency": self.prior_frequency,
                    "spread": self.spread,
                },
            }
        )

    def observe(self, number: int, episode: Episode) -> NDArray[np.float64]:
        """What the machine observes of a run; the driver sees what truly happens.

        Parameters
        ----------
        number : int
            How many runs came before: each has noise of its own.
        episode : Episode

        Returns
        -------
        (T, 3) ndarray
            Gap and both speeds [m, m/s, m/s]; without a unit where they are standardised.
        """
        seen = episode.observations
        if self.noise > 0.0:
            deviation = self.noise * np.array([1.0, SPEED_NOISE, SPEED_NOISE])
            rng = np.random.default_rng([self.noise_seed, number])
            seen += rng.normal(scale=deviation, size=seen.shape)
            seen[:, 1:] = np.maximum(seen[:, 1:], 0.0)
        return seen / np.array(SCALES) if self.scaling is Scaling.STANDARDISED else seen

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "order": list(self.order), "scaling": self.scaling.value}


@cache
def recovered() -> Setting:
    """The setting with which all claims of the paper come out.

    Examples
    --------
    >>> recovered().initial_gap, recovered().order, recovered().noise
    (5.0, (1, 2, 3, 4), 0.0)
    """
    settings = Settings.load()
    return Setting(
        brake_speed=settings.scenario.leader.brake_speed,
        brake_decel=settings.scenario.leader.brake_decel,
        initial_gap=settings.scenario.initial_gap,
        bound=settings.decel,
        **settings.machine,
    )


@dataclass(frozen=True)
class Row:
    """What became of the claims with one setting."""

    design: str  #: why it was tried: a name of `studies.sensitivity.designs.Design`
    varied: tuple[str, ...]  #: the parameters that were moved from the recovered setting
    setting: Setting
    verdicts: Mapping[str, bool]  #: by claim
    n_states: int  #: at the end

    @property
    def held(self) -> int:
        """How many claims hold."""
        return sum(self.verdicts.values())

    @property
    def holds(self) -> bool:
        """Whether all claims hold."""
        return all(self.verdicts.values())

    @property
    def broken(self) -> tuple[str, ...]:
        """Claims that do not hold."""
        return tuple(claim for claim, holds in self.verdicts.items() if not holds)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "design": self.design,
            "varied": list(self.varied),
            **self.setting.as_dict(),
            **self.verdicts,
            "n_states": self.n_states,
            "held": self.held,
            "holds": self.holds,
        }


class Remembering:
    """A world in which a run that was driven before is not driven again.

    The paper drives four cases twenty times, and without noise in the driver's eyes every round is
    the same.
    """

    def __init__(self, world: KinematicWorld) -> None:
        self._world = world
        # The drivers are frozen, and so can be looked up, which `Controller` does not promise.
        self._run: Callable[..., Any] = lru_cache(_EPISODES)(world.run)

    def open(self, scenario: Scenario) -> AbstractContextManager[Any]:
        """As the world itself."""
        return self._world.open(scenario)

    def run(self, scenario: Scenario, controller: Controller) -> Episode:
        """As the world itself; the same run is the same object."""
        episode: Episode = self._run(scenario, controller)
        return episode


def study_of(setting: Setting, world: Any, rounds: int = ROUNDS) -> PaperStudy:
    """The paper's runs and what follows them, with another setting."""
    return run_paper(
        world,
        "sensitivity",
        setting.paper_settings(),
        rounds,
        order=setting.order,
        observe=setting.observe,
        beliefs=False,
    )


def evaluate(
    setting: Setting,
    world: Any,
    design: str = "",
    varied: tuple[str, ...] = (),
    rounds: int = ROUNDS,
) -> Row:
    """The paper's own verdicts (`evofsm.paper.claims.check_claims`) on one setting.

    Parameters
    ----------
    setting : Setting
    world
        Where to drive; a `Remembering` one drives each case only once.
    design : str
        Why it is tried.
    varied : tuple of str
        Which parameters were moved.
    rounds : int
        How often the four cases are driven.

    Examples
    --------
    >>> from evofsm.driving import KinematicWorld
    >>> row = evaluate(recovered(), Remembering(KinematicWorld()))
    >>> row.held, row.n_states
    (10, 7)
    """
    study = study_of(setting, world, rounds)
    verdicts = {claim.id: claim.holds for claim in check_claims(study)}
    return Row(design, varied, setting, verdicts, study.model.n_states)

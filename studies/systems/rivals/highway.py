"""Rivals on the tasks of highway-env: told the road, every car on it, or how cars brake.

They read the environment itself, not its observation, so they also know what a guard is not shown:
lanes, cars behind, target speeds.
"""

from __future__ import annotations

from abc import abstractmethod
from copy import copy, deepcopy
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from studies.systems.rivals.rival import Rival
from studies.systems.system import Action, Vector

# Steps of the grid of times to collision, a second each.
_AHEAD = 10
# Between two speeds that a car keeps, the change that calls for the next one, as a share.
_HALF_WAY = 0.5
# Brakes of who follows, at least, of who leads, at most, and throttle while reacting [m/s²]; the
# reaction takes a decision. Those are what cars of highway-env keep to.
_BRAKES, _LEADER_BRAKES, _THROTTLE = 5.0, 5.0, 3.0
# Steps after an action in which a copy of the environment tells what happens.
_FORESEEN = 4
# The barrier's time headway [s], and the share of what is left of it that may be used in a step.
_HEADWAY, _USED = 1.0, 0.5


class OnTheRoad(Rival):
    """A judge that reads the environment itself."""

    needs_lanes: ClassVar[bool] = True  #: whether it only fits where lanes can be chosen

    def __init__(self, system: Any) -> None:  # one of `studies.systems.highway`
        self.system = system
        self.index = {name: k for k, name in enumerate(system.names)}

    def action(self, observation: Vector, proposal: Action) -> Action:
        """Index of the action to execute."""
        return int(self.chosen(int(proposal)))

    @abstractmethod
    def chosen(self, proposal: int) -> int:
        """Index of the action to execute instead of a proposal."""

    @property
    def car(self) -> Any:
        """The car itself."""
        return self.system.env.vehicle

    def lane_beside(self, to: int) -> Any | None:
        """Index of the lane by so many to the right of the car's target; None where none is."""
        car = self.car
        start, end, lane = car.target_lane_index
        beside = (start, end, lane + to)
        if not 0 <= lane + to < len(car.road.network.graph[start][end]):
            return None
        return beside if car.road.network.get_lane(beside).is_reachable_from(car.position) else None


class Slower(OnTheRoad):
    """Always slower: what can be had without looking."""

    told = "which action is slower"
    needs_lanes = False

    def chosen(self, proposal: int) -> int:
        """Slower."""
        return self.index["slower"]


class CarFollower(OnTheRoad):
    """The environment's own driver: IDM along the lane, MOBIL across; it heeds no proposal."""

    told = "road, all cars, how they drive"
    needs_lanes = False

    def chosen(self, proposal: int) -> int:
        """What is closest to what such a driver would do."""
        from highway_env.vehicle.behavior import IDMVehicle

        car = self.car
        driver = IDMVehicle.create_from(car)
        driver.target_speed = float(car.target_speeds[-1])
        driver.road = copy(car.road)  # where the car itself is not in its way
        driver.road.vehicles = [one for one in car.road.vehicles if one is not car]
        if "left" in self.index and car.lane_index == car.target_lane_index:
            for to, name in ((-1, "left"), (1, "right")):
                beside = self.lane_beside(to)
                if beside is not None and driver.mobil(beside):
                    return self.index[name]
        ahead = [
            car.road.neighbour_vehicles(car, lane)[0]
            for lane in (car.lane_index, car.target_lane_index)
        ]
        wanted = min(driver.acceleration(driver, front_vehicle=one) for one in ahead)
        wanted = float(np.clip(wanted, -driver.ACC_MAX, driver.ACC_MAX)) * self.system.interval
        between = float(car.target_speeds[1] - car.target_speeds[0])
        if wanted < -_HALF_WAY * between:
            return self.index["slower"]
        return self.index["faster" if wanted > _HALF_WAY * between else "idle"]


class TimeToCollision(OnTheRoad):
    """The environment's own grid of times to collision, solved by value iteration.

    A proposal is kept where the least that it costs is as little as that of any other action.
    """

    told = "road, all cars, at constant speed"

    def chosen(self, proposal: int) -> int:
        """The proposal, or an action that costs least."""
        from highway_env.envs.common.finite_mdp import compute_ttc_grid

        grid = compute_ttc_grid(self.system.env, 1.0, float(_AHEAD))
        speeds, lanes, times = grid.shape
        speed, lane = np.meshgrid(np.arange(speeds), np.arange(lanes), indexing="ij")
        moves: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = [
            (
                np.clip(speed + (name == "faster") - (name == "slower"), 0, speeds - 1),
                np.clip(lane + (name == "right") - (name == "left"), 0, lanes - 1),
            )
            for name in self.system.names
        ]
        cost = grid[:, :, -1]
        for t in range(times - 2, -1, -1):
            later = np.array([cost[move] for move in moves])
            cost = grid[:, :, t] + later.min(0)
        here = min(self.car.speed_index, speeds - 1), min(self.car.lane_index[2], lanes - 1)
        costs = later[(slice(None), *here)]
        return proposal if costs[proposal] <= costs.min() else int(costs.argmin())


class Mask(OnTheRoad):
    """Keeps a proposal whose gaps are long enough; else slower."""

    def chosen(self, proposal: int) -> int:
        """The proposal, or slower."""
        name, car = self.system.names[proposal], self.car
        to = {"left": -1, "right": 1}.get(name, 0)
        beside = self.lane_beside(to)
        lanes = {car.lane_index, car.target_lane_index} | ({beside} if beside else set())
        step = {"faster": 1, "slower": -1}.get(name, 0)
        speed = car.index_to_speed(
            int(np.clip(car.speed_to_index(car.speed) + step, 0, len(car.target_speeds) - 1))
        )
        changes = beside is not None and beside != car.lane_index
        for lane in lanes:
            leader, follower = car.road.neighbour_vehicles(car, lane)
            if leader is not None and not self.is_enough(car, leader, speed):
                return self.index["slower"]
            cut_in = changes and lane == beside and follower is not None
            if cut_in and not self.is_enough(follower, car, follower.speed):
                return self.index["slower"]
        return proposal

    @abstractmethod
    def is_enough(self, behind: Any, leader: Any, speed: float) -> bool:
        """Whether the gap is, if the one behind goes at this speed after a decision."""

    def gap(self, behind: Any, leader: Any) -> float:
        """From bumper to bumper [m]."""
        middle = float(behind.lane_distance_to(leader))
        return middle - 0.5 * float(behind.LENGTH + leader.LENGTH)


class Rss(Mask):
    """Responsibility-sensitive safety (Shalev-Shwartz et al. 2017), on each lane concerned."""

    told = "lanes, all cars, brakes"

    def is_enough(self, behind: Any, leader: Any, speed: float) -> bool:
        """Whether who follows can stop behind a leader that brakes in full."""
        react = self.system.interval
        now = max(float(behind.speed), speed)
        then = now + (react * _THROTTLE if speed > behind.speed else 0.0)
        least = now * react + then**2 / (2.0 * _BRAKES)
        least -= max(float(leader.speed), 0.0) ** 2 / (2.0 * _LEADER_BRAKES)
        return bool(self.gap(behind, leader) >= max(least, 0.0))


class Barrier(Mask):
    """A discrete-time control barrier: what is left of a time headway shrinks slowly enough."""

    told = "lanes, all cars"

    def is_enough(self, behind: Any, leader: Any, speed: float) -> bool:
        """Whether h(next) >= (1 - share) h(now), with h = gap - headway * speed."""
        gap, now = self.gap(behind, leader), float(behind.speed)
        closing = 0.5 * (now + speed) - float(leader.speed)
        here = gap - _HEADWAY * now
        then = gap - closing * self.system.interval - _HEADWAY * speed
        return bool(then >= (1.0 - _USED) * min(here, gap))


class Simulated(OnTheRoad):
    """Tries on copies of the environment, which draw the same chances: the most that can be known.

    A proposal is kept where some action that follows for good is survived. Otherwise the first
    action is taken of which that is true: the same speed, slower, faster, a lane change.
    """

    told = "the future, by copies of the simulator"
    needs_lanes = False

    def chosen(self, proposal: int) -> int:
        """The proposal, or the first action that is survived."""
        order = [self.index[name] for name in ("idle", "slower", "faster")]
        order += sorted(set(self.index.values()) - set(order))
        for action in dict.fromkeys((proposal, *order)):
            if any(self._is_survived(action, then) for then in order):
                return action
        return proposal

    def _is_survived(self, action: int, then: int) -> bool:
        env = deepcopy(self.system.env)
        for each in (action, *[then] * _FORESEEN):
            _, _, terminated, truncated, info = env.step(each)
            if info["crashed"]:
                return False
            if terminated or truncated:
                break
        return True


#: By name.
RIVALS: dict[str, type[OnTheRoad]] = {
    "slower": Slower,
    "idm-mobil": CarFollower,
    "ttc-grid": TimeToCollision,
    "rss": Rss,
    "barrier": Barrier,
    "simulated": Simulated,
}

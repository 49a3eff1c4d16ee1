"""By how much the whole loop (observe, recognise, judge, revise, learn) slows a SUMO run.

The reference is the same run: the same cars in the same SUMO, the same controller asked at the
same times, and what the reviser had executed, replayed, so that both drive the same way to the
last bit. It does not recognise, judge, revise or learn. Time is that of the processor, which both
sides keep busy, so that what else the computer does hardly counts.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import replace

import numpy as np

from evofsm.driving.family import Draw, Family, load_family
from evofsm.driving.sumo import SumoWorld
from evofsm.driving.trials import drive, teach
from evofsm.driving.world import Episode
from evofsm.guard.guard import Guard
from guard_rows import FAMILY, many_states
from timing import Result

# Time between decisions [s].
_INTERVAL = 0.25
# Episodes that are learnt from before, and those of a turn.
_LEARNT, _DRAWS = 60, 4


def measure(repeats: int) -> Result:
    """Seconds a step of SUMO with and without our loop: medians of turns on the same draws."""
    family = replace(load_family(FAMILY), interval=_INTERVAL)
    guard = many_states()
    teach(guard, (family.draw(0, index) for index in range(_LEARNT)))
    draws = [family.draw(0, index, split="test") for index in range(_DRAWS)]
    ours: list[float] = []
    reference: list[float] = []
    with SumoWorld() as world:
        drive_timed(guard, draws[0], world)  # compiles, or reads what was compiled
        for _ in range(repeats):
            taken, steps = np.zeros(2), 0
            for draw in draws:
                seconds, driven = drive_timed(guard, draw, world)
                seconds_without, replayed = replay(family, draw, driven.executed.tolist(), world)
                if not np.array_equal(driven.record, replayed.record):
                    raise RuntimeError("the reference drives another way: the ratio means nothing")
                taken += seconds, seconds_without
                steps += len(replayed.time) - 1
            ours.append(taken[0] / steps)
            reference.append(taken[1] / steps)
    assert guard.machine is not None
    return {
        "what": f"decisions every {_INTERVAL:g} s, {guard.machine.n_states} states",
        "ours_s": statistics.median(ours),
        "reference": "the same SUMO run, replayed",
        "reference_s": statistics.median(reference),
        "ours_turns_s": ours,
        "reference_turns_s": reference,
    }


def drive_timed(guard: Guard, draw: Draw, world: SumoWorld) -> tuple[float, Episode]:
    """Seconds taken, and what was driven under the guard, which goes on learning."""
    begun = time.process_time()
    driven = drive(guard, draw, world)
    return time.process_time() - begun, driven


def replay(
    family: Family, draw: Draw, executed: list[float], world: SumoWorld
) -> tuple[float, Episode]:
    """Seconds taken, and what was driven with these actions executed, whatever is proposed."""
    begun = time.process_time()
    steps = draw.scenario.steps(family.interval)
    with world.open(draw.scenario) as road:
        for action in executed:
            draw.controller.propose(road.observation, road.time)
            road.advance(action, steps)
        episode = road.episode()
    return time.process_time() - begun, episode

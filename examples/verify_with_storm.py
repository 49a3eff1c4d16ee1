"""How likely is a failure within some steps, at worst and at best? Storm says, of what was learnt.

Storm (https://www.stormchecker.org) is under the GPL 3: ``pip install stormpy``. The argument is a
machine or a model that was saved; without it, a walk to a wall is learnt first::

    python examples/verify_with_storm.py [learnt.evofsm]

It follows from what was counted, not that the counts are right: what was never tried is no choice,
and a state of which nothing is known leads nowhere, which must not be taken for safe.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import stormpy

from evofsm import EvolvingFSM
from evofsm.fsm import FSMModel
from evofsm.io import to_prism

ASKED = ('Pmax=? [F<=20 "failed"]', 'Pmin=? [F<=20 "failed"]', 'Pmax=? [F<=20 "unknown"]')


def learnt() -> FSMModel:
    """What a machine saw of 40 walks that fail beyond 5, where one of three actions leads."""
    machine, chance = EvolvingFSM(n_actions=3, radius=0.05), np.random.default_rng(3)
    for _ in range(40):
        actions, place, places = chance.integers(0, 3, 30), 0.0, []
        for action in actions:
            places.append([place])
            if place > 5.0:
                break
            place = max(place + 0.6 * (action - 0.8) + 0.1 * chance.normal(), 0.0)
        failures = [len(places) - 1] if place > 5.0 else []
        machine.learn_many(places, actions[: len(places)], failures=failures)
    return machine.model()


def main() -> None:
    """Ask Storm each property, from the state that was created first."""
    model = FSMModel.load(sys.argv[1]) if len(sys.argv) > 1 else learnt()
    with TemporaryDirectory() as folder:
        file = Path(folder) / "model.prism"
        file.write_text(to_prism(model), encoding="utf-8")
        program = stormpy.parse_prism_program(str(file))
    properties = stormpy.parse_properties("; ".join(ASKED), program)
    for text, asked in zip(ASKED, properties, strict=True):
        process = stormpy.build_model(program, [asked])
        answer = stormpy.model_checking(process, asked)
        print(f"{text}: {answer.get_value(process.initial_states[0]):.3f}")


if __name__ == "__main__":
    main()

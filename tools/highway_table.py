"""The table of the tasks of highway-env: every judge under every controller, held out.

    pip install '.[highway,study]'
    python tools/highway_table.py --tasks merge --train 200 --test 200

A row is printed as soon as it is known: 200 episodes of a task are some thousand decisions of an
environment that takes 15 to 50 ms for each.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial

from evofsm.evidence.systems import HIGHWAY, make_system
from evofsm.evidence.systems.system import System
from evofsm.evidence.systems.trial import JUDGES, Judge, Row, trial

LEARN = ("scene", "learnt")  #: judges that learn; all others are tried at once


def rows(
    task: str, controller: str, judge: str, seeds: Sequence[int], train: int, test: int, base: int
) -> list[Row]:
    """One for each learning seed; one alone of a judge that learns nothing."""
    made = JUDGES.get(judge) or partial(_rival, judge)
    told = {"train": train if judge in LEARN else 0, "test": test, "judge": made, "base": base}
    some = seeds if judge in LEARN else seeds[:1]
    return [trial(task, controller, seed=seed, **told) for seed in some]  # type: ignore[arg-type]


def _rival(name: str, system: System, without: Sequence[str], seed: int) -> Judge:
    made: Judge = system.rivals[name]()  # type: ignore[attr-defined]
    return made


def main(argv: Sequence[str] | None = None) -> None:
    """Try, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", default=",".join(HIGHWAY))
    parser.add_argument("--controllers", default="random,dqn")
    parser.add_argument("--judges", default="unrevised,scene,slower,idm-mobil,ttc-grid,rss,barrier")
    parser.add_argument("--train", type=int, default=200, help="episodes that are learnt from")
    parser.add_argument("--test", type=int, default=200, help="held-out episodes")
    parser.add_argument("--seeds", default="0", help="of learning")
    parser.add_argument("--base", type=int, default=0, help="other episodes than the study's")
    chosen = parser.parse_args(argv)
    seeds = [int(seed) for seed in chosen.seeds.split(",")]
    print("| task | controller | judge | seed | crashes while learning | held out | speed | kept |")
    print("|---|---|---|---|---|---|---|---|")
    for task in chosen.tasks.split(","):
        system = make_system(task)
        for controller in chosen.controllers.split(","):
            if controller not in system.controllers:
                continue
            for judge in chosen.judges.split(","):
                if judge not in JUDGES and judge not in system.rivals:  # type: ignore[attr-defined]
                    continue
                counts = (chosen.train, chosen.test, chosen.base)
                for row in rows(task, controller, judge, seeds, *counts):
                    print(
                        f"| {task} | {controller} | {judge} | {row.seed} "
                        f"| {row.failed_while_learning} of {row.trained} "
                        f"| {row.failed} of {row.episodes} | {row.speed:.2f} | {row.kept:.2f} |",
                        flush=True,
                    )


if __name__ == "__main__":
    main()

"""Cases that were found, written as families that drive them again."""

from __future__ import annotations

from pathlib import Path

from evofsm.driving import fixed_family
from studies.breaks.amounts import TOY
from studies.breaks.study import Breaks
from studies.breaks.subjects import load


def write_cases(found: Breaks, folder: Path, command: str) -> list[Path]:
    """Write what was found in each row as a family of its own, if anything was.

    Parameters
    ----------
    found : Breaks
    folder : Path
    command : str
        What was typed, told in the files.

    Returns
    -------
    list of Path
        The files.
    """
    written = []
    plan = found.plan
    for row, cases, raw in zip(found.rows, found.cases, found.raw, strict=True):
        if row.family == TOY or not cases:
            continue
        family = load(row.family, plan.switches)
        kept = {
            f"found {k}: {one.about}": family.draw_by(case.chance)
            for k, (one, case) in enumerate(zip(cases, raw, strict=True), 1)
        }
        about = f"Collisions of {family.name} that were found (judge: {row.judge}) by: {command}"
        path = folder / f"found-{family.name}-{row.judge}.py"
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(fixed_family(family, kept, about), encoding="utf-8")
        written.append(path)
    return written

"""Does exported C decide as Python does? A million situations, NaN and infinities among them.

Usage: python benchmarks/c99.py [--decisions 1e6] [--systems wall,disc,cartpole,emergency,cars]
       python benchmarks/c99.py --fmu 100 --systems cars  # FMUs drive so many held-out episodes

A guard learns, is frozen and exported, and drives; both are asked the same. Of some observations a
part is not seen, infinite, late or anywhere; some proposals are no numbers, or beyond the range.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm import Guard
from evofsm.driving import CarFollowing, LatentRisk, guard_for_family
from evofsm.guard import Proposal, make_usable
from evofsm.guard.actions import BoxActions, Choices, limits, no_action, same_action
from evofsm.guard.export import write_c99, write_fmu
from evofsm.guard.learnt import words
from evofsm.guard.learnt.rollout import CRASHES, ENDS, FAILS
from evofsm.guard.reviser import unseen_text

Floats = NDArray[np.float64]

FLAGS = (
    "-std=c99",
    "-Wall",
    "-Wextra",
    "-Wconversion",
    "-Wshadow",
    "-pedantic",
    "-Werror",
    "-ffp-contract=off",
)
SANITIZERS = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
# What can be observed, if hardly; the last is what cannot.
EXTREME = (-0.0, 5e-324, -1e-300, 1e-160, 1e-10, 150.0, -150.0, -1e3, 1e6, -1e18, 1e30, 1e300)
_FAR = 1e7
# Numbers of a decision, in the order in which the program below writes them.
NUMBERS = ("risk_proposed", "risk_executed", "risk_low", "risk_high", "evidence", "seen", "left")
CODES = ("reason", "remark", "intake", "is_new", "state", "backup", "unsurvived")
_MAIN = """#define _POSIX_C_SOURCE 199309L
#include "evofsm.h"
#include <stdio.h>
#include <time.h>
#define ROW (2 + EVOFSM_VARIABLES + EVOFSM_ACTIONS)
static evofsm_state state;
int main(void) {
  double row[ROW];
  evofsm_reset(&state);
  while (fread(row, sizeof row[0], ROW, stdin) == ROW) {
    double numbers[16 + 2 * EVOFSM_ACTIONS] = {0.0};
    evofsm_decision d = {0};
    struct timespec begin, end;
    int i;
    if (row[0] > 0.0) {
      evofsm_reset(&state);
    }
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &begin);
    numbers[0] = evofsm_decide_at(&state, row + 2, row + 2 + EVOFSM_VARIABLES, row[1], &d);
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &end);
    numbers[1] = (double)(end.tv_sec - begin.tv_sec) + 1e-9 * (double)(end.tv_nsec - begin.tv_nsec);
    numbers[2] = d.risk_proposed, numbers[3] = d.risk_executed, numbers[4] = d.risk_low;
    numbers[5] = d.risk_high, numbers[6] = d.evidence, numbers[7] = d.seen, numbers[8] = d.left;
    numbers[9] = d.reason, numbers[10] = d.remark, numbers[11] = d.intake, numbers[12] = d.is_new;
    numbers[13] = d.state, numbers[14] = d.backup, numbers[15] = d.unsurvived;
    for (i = 0; i < EVOFSM_ACTIONS; i++) {
      numbers[16 + i] = d.executed[i];
      numbers[16 + EVOFSM_ACTIONS + i] = d.advised[i];
    }
    fwrite(numbers, sizeof numbers[0], sizeof numbers / sizeof numbers[0], stdout);
  }
  return (int)(sizeof state == 0);
}
"""


# -- Systems --------------------------------------------------------------------------------------


class Wall:
    """The point of the README, pushed to a wall."""

    actions: ClassVar[dict[str, Any]] = {"low": -1.0, "high": 1.0, "interval": 0.1}
    noise = np.zeros(2)

    def reset(self, seed: int) -> Floats:
        self.chance, self.at, self.steps = np.random.default_rng(seed), np.zeros(2), 0
        return self.seen()

    def seen(self) -> Floats:
        return self.at + self.noise * self.chance.normal(size=2)

    def propose(self) -> Any:
        return self.chance.uniform(-0.2, 1.0)

    def step(self, action: Any) -> tuple[Floats, bool, bool]:
        speed = 0.9 * self.at[1] + 0.02 * float(action) + 0.001 * self.chance.normal()
        self.at, self.steps = np.array([self.at[0] + speed, speed]), self.steps + 1
        failed = bool(self.at[0] >= 1.0)
        return self.seen(), failed, failed or self.steps >= 60


class NoisyWall(Wall):
    """The same with a noisy sensor; it looks far ahead, in steps of two decisions."""

    actions: ClassVar[dict[str, Any]] = {**Wall.actions, "horizon": 20.0}
    noise = np.array([0.01, 0.004])


class Disc(Wall):
    """A point in the plane that is not to come into a disc: its action is a vector."""

    actions: ClassVar[dict[str, Any]] = {"low": [-1.0, -1.0], "high": [1.0, 1.0], "interval": 0.1}

    def reset(self, seed: int) -> Floats:
        self.chance, self.steps = np.random.default_rng(seed), 0
        corner = self.chance.choice([-1.0, 1.0], 2)
        self.at = np.append(corner * self.chance.uniform(1.0, 2.6, 2), [0.0, 0.0])
        self.to = self.chance.uniform(-2.6, 2.6, 2)
        return self.at

    def propose(self) -> Any:
        if self.chance.random() < 0.05:
            self.to = self.chance.uniform(-2.6, 2.6, 2)
        wanted = self.to - self.at[:2] - 1.2 * self.at[2:] + 0.1 * self.chance.normal(size=2)
        return np.clip(wanted, -1.0, 1.0)

    def step(self, action: Any) -> tuple[Floats, bool, bool]:
        speed = self.at[2:] + 0.1 * action + 0.004 * self.chance.normal(size=2)
        self.at, self.steps = np.append(self.at[:2] + 0.1 * speed, speed), self.steps + 1
        failed = bool(np.hypot(*self.at[:2]) < 0.8)
        return self.at, failed, failed or self.steps >= 120


class CartPole(Wall):
    """Gymnasium's, under a random policy."""

    actions: ClassVar[dict[str, Any]] = {"n_actions": 2, "interval": 0.02}

    def __init__(self) -> None:
        import gymnasium

        self.env = gymnasium.make("CartPole-v1")

    def reset(self, seed: int) -> Floats:
        self.chance = np.random.default_rng(seed)
        return np.asarray(self.env.reset(seed=seed)[0], np.float64)

    def propose(self) -> Any:
        return float(self.chance.integers(2))

    def step(self, action: Any) -> tuple[Floats, bool, bool]:
        seen, _, failed, over, _ = self.env.step(int(action))
        return np.asarray(seen, np.float64), bool(failed), bool(failed or over)


class Emergency(Wall):
    """Cars of the family of the README; whoever drives accelerates."""

    family = "emergency"

    def __init__(self) -> None:
        self.env = CarFollowing(self.family)

    def reset(self, seed: int) -> Floats:
        self.chance = np.random.default_rng(seed)
        return np.asarray(self.env.reset(seed=seed)[0], np.float64)

    def propose(self) -> Any:
        return self.chance.uniform(-0.5, 2.5)

    def step(self, action: Any) -> tuple[Floats, bool, bool]:
        seen, _, failed, over, _ = self.env.step(action)
        return np.asarray(seen, np.float64), bool(failed), bool(failed or over)


class NoisyCars(Emergency):
    """The same with noisy sensors, which are filtered."""

    def step(self, action: Any) -> tuple[Floats, bool, bool]:
        seen, failed, over = super().step(action)
        return seen + self.chance.normal(size=3) * [0.5, 0.2, 0.2], failed, over


class CutIn(Emergency):
    """Another car cuts in: gap and leader's speed jump."""

    family = "cut_in"


class Learnt(NamedTuple):
    """A system, and a guard that learnt of it and is frozen."""

    system: Any
    guard: Guard


def learnt(name: str, episodes: int | None = None) -> Learnt:
    """A guard that learnt so many episodes of a system by its name."""
    kind, most = SYSTEMS[name]
    told = _taught(name.removesuffix("+parts"), most if episodes is None else episodes)
    system, guard = kind(), told.copy()
    if name.endswith("+parts"):
        _add_parts(guard.judge)
    return Learnt(system, guard)


@cache
def _taught(name: str, episodes: int) -> Guard:
    system: Any = SYSTEMS[name][0]()
    if isinstance(system, Emergency):
        judge = "kinematic" if name.endswith("cars") else "learnt"
        guard = guard_for_family(system.env.family, judge=judge)
    else:
        guard = Guard(**system.actions)
    guard.shadow = False  # it decides, even if it did harm
    for seed in range(episodes):
        seen, failed, over = system.reset(seed), False, False
        while not over:
            seen, failed, over = system.step(guard.decide(seen, system.propose()).executed)
        guard.end(failed, seen)
    guard.freeze()
    return guard


def _add_parts(judge: Any) -> None:
    """Forms of each kind, and dead ends: not each system teaches each of them."""
    chance, state = np.random.default_rng(0), judge.state
    m, unit = judge.n_variables, 1.0 / state.unit
    seen = state.situations[:, :m]
    low, high, last = seen.min(0), seen.max(0), m - 1
    fails = [FAILS, 0, last, low[0], low[last], unit[0], unit[last], 1, 0.1, 0.2, -1, 0.3, -2, 3]
    ends = [ENDS, 0, 0, high[0], high[0], unit[0], unit[0], 2, 1, 0, 0, 0, 0, 3]
    crashes = [CRASHES, last, last, high[-1], high[-1], unit[-1], unit[-1], 0, 1, 0, 0, 0, 0, 3]
    centres = seen[chance.integers(len(seen), size=3)]
    judge.state = state._replace(
        forms=np.vstack([ends, crashes, state.forms, fails]),
        **{"centres": centres, "radii": np.full(3, 0.4), "counts": np.arange(1.0, 4.0)},
    )
    judge.remake()


SYSTEMS: dict[str, tuple[Any, int]] = {
    "wall": (Wall, 10),
    "noisy": (NoisyWall, 30),
    "disc": (Disc, 30),
    "cartpole": (CartPole, 25),
    "emergency": (Emergency, 40),
    "cut_in": (CutIn, 40),
    "disc+parts": (Disc, 30),
    "cut_in+parts": (CutIn, 40),
    "cars": (Emergency, 20),
    "noisy_cars": (NoisyCars, 20),
}


# -- Asking both ----------------------------------------------------------------------------------


def build(guard: Guard, folder: Path, *flags: str) -> Path:
    """Export and compile a guard with a program that reads situations and writes decisions."""
    write_c99(guard, folder)
    (folder / "main.c").write_text(_MAIN)
    program = folder / "decide"
    sources = [str(folder / name) for name in ("evofsm.c", "main.c")]
    subprocess.run(["cc", *FLAGS, *flags, "-o", str(program), *sources, "-lm"], check=True)
    return program


class Asked(NamedTuple):
    """What was asked, and what Python decided; one row each."""

    rows: Floats  #: whether an episode begins, time, observation, proposal
    codes: Floats  #: what `evofsm_decide` is to return, the intake, and the state
    numbers: Floats  #: as `NUMBERS`, but what is left
    actions: Floats  #: executed, advised
    said: list[tuple[str, str]]  #: reason, and what was said of what was not seen


def ask(learnt: Learnt, decisions: int, seed: int = 1) -> Asked:
    """Drive held-out episodes, in which senses, clocks and controllers fail now and then."""
    with warnings.catch_warnings(action="ignore"):
        found = list(_asked(learnt, decisions, np.random.default_rng(seed)))
    rows, codes, numbers, actions, said = zip(*found, strict=True)
    return Asked(np.array(rows), np.array(codes), np.array(numbers), np.array(actions), list(said))


def _asked(learnt: Learnt, decisions: int, chance: np.random.Generator) -> Iterator[Any]:
    system, guard = learnt
    labels = guard.reviser.risk.labels  # type: ignore[attr-defined]
    nothing = np.atleast_1d(no_action(guard.actions))
    low, high = (np.atleast_1d(end) for end in limits(guard.actions))
    episode, over, time, spread, blind, begun, stands = 0, True, 0.0, np.zeros(1), 0, 0, 0
    for _ in range(decisions):
        if begins := over:
            episode, time = episode + 1, -guard.interval
            seen, over = system.reset(1_000_000 + episode), False
            begun = 6 * (episode % 3 == 0)  # senses come one by one
            guard.end()
        spread = np.maximum(spread, np.abs(seen))
        z, wanted = seen.copy(), np.atleast_1d(np.asarray(system.propose(), np.float64))
        kind = chance.integers(40)
        blind = chance.choice([1, 8]) if kind == 0 else max(blind - 1, 0)  # also for long
        if blind:
            z[chance.random(len(z)) < 0.5] = math.nan
            z[0] = math.nan
        elif (begun := max(begun - 1, 0)) > 0:
            z[chance.random(len(z)) < 0.5] = math.nan
        elif kind == 1:
            z[chance.integers(len(z))] = chance.choice([math.inf, -math.inf, 1e31])
        elif kind == 2:
            z = chance.normal(size=len(z)) * spread
        elif kind == 6:
            z = np.where(chance.random(len(z)) < 0.7, chance.choice(EXTREME, len(z)), z)
        elif kind == 3:
            wanted = wanted + chance.choice([math.nan, math.inf, -math.inf], len(wanted))
        elif kind == 4:
            wanted = chance.uniform(low - (high - low), high + (high - low))
        stands = 8 if kind == 8 else max(stands - 1, 0)
        step = chance.choice([-8.0, -1.0, 0.0, 3.0]) if kind == 5 else float(stands == 0)
        time += guard.interval * step
        when = (math.inf, -math.inf, math.nan, 1e300)[episode % 4] if kind == 7 else time
        proposal: Any = wanted if isinstance(guard.actions, BoxActions) else float(wanted[0])
        row = np.concatenate([[begins, when], z, wanted])
        try:
            situation = guard.recognise(z, when)
        except ValueError:
            none = np.full(len(NUMBERS) - 1, math.nan), np.concatenate([nothing, nothing])
            yield row, (1.0, 0.0, 0.0), *none, ("", "")
            continue
        revision = guard.revise(situation, Proposal(proposal))
        state = -1 if situation.state is None else situation.state
        risks = revision.risk_proposed, revision.risk_executed, *revision.interval
        done = [np.atleast_1d(each) for each in (revision.executed, revision.advised)]
        unseen = unseen_text(situation, labels) if situation.intake else ""
        yield (
            row,
            (0.0, float(situation.intake), float(state)),
            np.array([*risks, revision.evidence, revision.seen]),
            np.concatenate(done),
            (revision.reason, unseen),
        )
        seen, _, over = system.step(revision.executed)


class Compared(NamedTuple):
    """How C decided, compared with Python."""

    decisions: int
    refused: int  #: observations that both refused
    changed: int  #: proposals that were not kept
    others: int  #: decisions in which the code that is returned, the action or a code differs
    said: int  #: and those of which the reason, in words, does
    off: float  #: largest difference of a number
    microseconds: Floats  #: that a decision took

    @property
    def agrees(self) -> bool:
        """Whether both decide the same."""
        return not (self.others or self.said) and self.off <= 1e-12


def compare(guard: Guard, program: Path, asked: Asked) -> Compared:
    """Ask a compiled program the same."""
    most = 60.0 + 0.01 * len(asked.rows)  # [s]
    told = subprocess.run(
        [program], input=asked.rows.tobytes(), capture_output=True, check=True, timeout=most
    )
    found = np.frombuffer(told.stdout).reshape(len(asked.rows), -1).copy()
    rc, seconds, numbers, codes = (
        found[:, 0],
        found[:, 1],
        found[:, 2:9],
        found[:, 9:16].astype(int),
    )
    actions, taken = found[:, 16:], asked.codes[:, 0] == 0.0
    # Squares are so large there that a last bit says which state is nearest.
    far = np.nan_to_num(np.abs(asked.rows), nan=0.0).max(1) > _FAR
    codes[far, 4], numbers[far, 5] = asked.codes[far, 2], asked.numbers[far, 5]
    other = (rc != asked.codes[:, 0]) | (
        taken & ((codes[:, 2] != asked.codes[:, 1]) | (codes[:, 4] != asked.codes[:, 2]))
    )
    off = np.hstack([numbers[:, :6] - asked.numbers, actions - asked.actions])
    unknown = np.isnan(np.hstack([asked.numbers, asked.actions]))
    other |= taken & (unknown != np.isnan(np.hstack([numbers[:, :6], actions]))).any(1)
    off = np.abs(np.where(unknown, 0.0, off))[taken]
    said = [
        _said(guard, dict(zip(CODES, code, strict=True)), number, row, unseen, done) != reason
        for code, number, row, (reason, unseen), done, is_taken in zip(
            codes.tolist(), numbers, asked.rows, asked.said, actions, taken & ~far, strict=True
        )
        if is_taken
    ]
    return Compared(
        len(rc),
        int((~taken).sum()),
        int((codes[taken, 0] != 0).sum()),
        int(other.sum()),
        sum(said),
        float(off.max(initial=0.0)),
        1e6 * seconds[taken],
    )


def _said(
    guard: Guard, code: dict[str, int], number: Floats, row: Floats, unseen: str, done: Floats
) -> str:
    """The reason that Python would give for what C says in codes."""
    reviser: Any = guard.reviser
    wanted = row[len(row) - len(np.atleast_1d(no_action(guard.actions))) :]
    proposal: Any = wanted if isinstance(guard.actions, BoxActions) else float(wanted[0])
    usable = make_usable(Proposal(proposal), guard.actions, reviser.risk.fallback)
    code = code | {"passes": bool((done[len(done) // 2 :] == usable.action).all())}
    remark = usable.remark
    is_told = code["remark"] == bool(remark) + remark.startswith("no ")
    is_kinematic = isinstance(reviser.risk, LatentRisk)
    tell = _kinematic if is_kinematic else _learnt
    reason = tell(guard, code, dict(zip(NUMBERS, number.tolist(), strict=True)))
    is_other = not code["passes"] if is_kinematic else code["reason"] in (1, 2, 3)
    if is_other and not reviser.acts:
        reason = f"{reviser.passing or reviser.mode.value}: {reason}"
    new = "never seen before, as far as the states tell" if code["is_new"] else ""
    return "; ".join(filter(None, (remark if is_told else "?", unseen, new, reason)))


def _learnt(guard: Guard, code: dict[str, int], number: dict[str, float]) -> str:
    reviser: Any = guard.reviser
    judge, kind = reviser.risk, code["reason"]
    if kind == 4:
        return words.NOTHING_SEEN
    remembered, backup = judge.remembered, judge.backup_text(code["backup"])
    allowed = judge._allowed(reviser.tolerance, remembered)
    remembered = remembered._replace(spared=allowed)
    doubt = words.BY_MODEL if math.isnan(number["risk_proposed"]) else ""
    if kind == 0:
        return doubt + words.kept(backup, remembered, number["left"])
    why = doubt + words.refused(
        code["unsurvived"], remembered, judge.state.margin, judge.parts.scale
    )
    if kind == 1:
        return f"{why}; {words.changed(backup, remembered, judge.state.margin)}"
    if kind == 3 and code["passes"]:
        return f"{why}; {words.NO_LONGER}"
    return f"{why}; {words.lasting(backup, cut=kind == 2)}"


def _kinematic(guard: Guard, code: dict[str, int], number: dict[str, float]) -> str:
    reviser: Any = guard.reviser
    trial = reviser.risk.trial()
    is_estimated = math.isnan(number["risk_proposed"])
    doubt = "by an estimate alone, so its risk is not known" * is_estimated
    if code["reason"] == 0:
        return doubt or "risk is within the tolerance"
    doubt += ": " * is_estimated
    if code["reason"] == 6:
        return f"{doubt}{trial.unknown}: {trial.doing}"
    why = f"{doubt}could not survive a leader braking harder than {number['left']:.1f} m/s²"
    why += "" if is_estimated else f" (risk {number['risk_proposed']:.1%})"
    if trial is not None:
        why += f"; {trial.unknown}, {f'so {trial.how}' if reviser.acts else trial.assumed}"
    return why if code["reason"] == 5 else f"{why}; {_CHOSEN[code['reason']]}"


_CHOSEN = {
    1: "the closest that can",
    3: "nothing can, the least risky",
    7: "it regains a safe gap in time",
    8: "the least braking that regains a safe gap in time",
    9: "it avoids a collision if the leader goes on so",
    10: "braking that avoids a collision if the leader goes on so",
}


class Driven(NamedTuple):
    """Held-out episodes, each driven twice: by a guard in Python, and by it as an FMU."""

    episodes: int
    decisions: int
    failed: int  #: episodes, in Python
    others: int  #: of which an action, a risk, whether it was revised, or the end differs


def drive_fmu(learnt: Learnt, folder: Path, episodes: int) -> Driven:
    """Drive with an FMU in FMPy as with the guard."""
    import fmpy

    system, guard = learnt
    write_fmu(guard, folder / "guard.fmu")
    told = fmpy.read_model_description(folder / "guard.fmu")
    place = fmpy.extract(folder / "guard.fmu", folder / "unit")
    unit = fmpy.instantiate_fmu(place, told, "CoSimulation")
    of = {one.name: one.valueReference for one in told.modelVariables}
    kind: Any = float
    put, get = unit.setReal, unit.getReal
    if isinstance(guard.actions, Choices):
        kind, put, get = int, unit.setInteger, unit.getInteger
    proposal, executed = (
        [of[name] for name in of if name.startswith(f"{what}[")]
        for what in ("proposal", "executed")
    )

    def in_python(seen: Floats, wanted: Any) -> tuple[Any, float, bool]:
        done = guard.decide(seen, wanted)
        return done.executed, done.risk_executed, not same_action(done.executed, wanted)

    def in_unit(seen: Floats, wanted: Any) -> tuple[Any, float, bool]:
        unit.setReal(list(range(len(seen))), seen.tolist())
        put(proposal, list(map(kind, np.ravel(wanted))))
        unit.doStep(0.0, guard.interval)
        done = np.array(get(executed)) if len(executed) > 1 else get(executed)[0]
        return done, unit.getReal([of["risk"]])[0], bool(unit.getBoolean([of["revised"]])[0])

    failed = others = decisions = 0
    for seed in range(2_000_000, 2_000_000 + episodes):
        guard.end()
        unit.reset()
        unit.setupExperiment()
        unit.enterInitializationMode()
        unit.exitInitializationMode()
        found, again = (_driven(system, seed, decide) for decide in (in_python, in_unit))
        decisions, failed = decisions + len(found), failed + int(found[-1, -1])
        alike = found.shape == again.shape and np.allclose(found, again, 0.0, 1e-12, equal_nan=True)
        others += not alike
    unit.terminate()
    unit.freeInstance()
    return Driven(episodes, decisions, failed, others)


def _driven(system: Any, seed: int, decide: Any) -> Floats:
    """Of each decision what was executed, its risk, whether it was revised, whether it failed."""
    seen, over, rows = system.reset(seed), False, []
    while not over:
        executed, *said = decide(seen, system.propose())
        seen, failed, over = system.step(executed)
        rows.append([*np.ravel(executed), *said, failed])
    return np.array(rows, np.float64)


def sizes(folder: Path, flags: Sequence[str]) -> str:
    """Bytes of the state, of constants and code, and all frames of functions at once."""
    command = ["cc", *FLAGS, *flags, "-fstack-usage", "-c", "evofsm.c"]
    subprocess.run(command, cwd=folder, check=True)
    frames = sum(int(line.split()[-2]) for line in (folder / "evofsm.su").read_text().splitlines())
    text = subprocess.run(["size", "evofsm.o"], cwd=folder, capture_output=True, text=True).stdout
    symbols = subprocess.run(["nm", "-S", "decide"], cwd=folder, capture_output=True, text=True)
    (state,) = (line.split()[1] for line in symbols.stdout.splitlines() if line.endswith(" state"))
    return f"state {int(state, 16):,}, constants and code {text.split()[6]}, stack {frames}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare, print counts and times, and fail where something differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--decisions", type=lambda text: int(float(text)), default=1_000_000)
    parser.add_argument("--systems", default=",".join(SYSTEMS))
    parser.add_argument("--flags", default="-O3")
    parser.add_argument("--fmu", type=int, default=0, metavar="EPISODES")
    given = parser.parse_args(arguments)
    names, agree = given.systems.split(","), True
    for name in names:
        one = learnt(name)
        if given.fmu:
            with tempfile.TemporaryDirectory() as place:
                driven = drive_fmu(one, Path(place), given.fmu)
            print(
                f"{name}, FMU: {driven.episodes} episodes, {driven.decisions:,} decisions, "
                f"{driven.failed} failed in Python; {driven.others} differ",
                flush=True,
            )
            agree &= driven.others == 0
            continue
        with tempfile.TemporaryDirectory() as place:
            folder, flags = Path(place), given.flags.split()
            program = build(one.guard, folder, *flags)
            begin = perf_counter()
            asked = ask(one, given.decisions // len(names))
            python = 1e6 * (perf_counter() - begin) / len(asked.rows)
            found, size = compare(one.guard, program, asked), sizes(folder, flags)
        half, most, all_of_them = np.quantile(found.microseconds, [0.5, 0.99, 1.0]).tolist()
        print(
            f"{name}: {found.decisions:,} decisions, {found.refused:,} refused, {found.changed:,} "
            f"changed; {found.others} differ, {found.said} reasons, numbers by {found.off:.1e}\n"
            f"  {given.flags}: {half:.1f} us, 99 % {most:.1f}, all {all_of_them:.1f} (Python, with "
            f"what it decides on: mean {python:.0f}); bytes: {size}",
            flush=True,
        )
        agree &= found.agrees
    return not agree


if __name__ == "__main__":
    sys.exit(main())

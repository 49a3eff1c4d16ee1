"""A ceiling: what a filter could do that is told the dynamics, on the same held-out episodes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from evofsm.paper import Table
from studies import lib
from studies.benchmark import Case
from studies.good import GOOD
from studies.judges import trial
from studies.rivals import Rival, as_action, tried
from studies.systems import Action, System, Vector

#: A row for each system and controller, and how many held-out episodes of which draws.
CEILINGS = Path(__file__).parents[1] / "docs" / "results" / "ceiling.json"
BASE = 62
Backup = Callable[[Any, Any], Action]
#: Good controllers by system, which are backups beside constant actions.
KNOWN: dict[str, Backup] = {name: act for (name, _), act in GOOD.items()}
KNOWN |= {
    "cartpole-gusts": KNOWN["cartpole"],
    "pendulum-cos": lambda s, z: KNOWN["pendulum"](s, (np.arctan2(z[1], z[0]), z[2])),
    "tanks": lambda s, z: np.clip(2.2 - 2.0 * z[:2] - 50.0 * z[2:] + 1.5 * z[:2] ** 0.5, 0.0, 1.0),
    "drift": lambda s, z: s._within([-4.0 * (z[0] + z[1]), -1.0]),
}
# Nothing is drawn in them once an episode began: one future is all there is.
_CERTAIN = ("cartpole", "pendulum", "pendulum-cos")


class Wilder(np.random.Generator):
    """Noise some times as large, and events so many times as likely: a few futures stand for many.

    At the edge of what can be saved, a filter has to be right in hundreds of decisions.
    """

    def __init__(self, bits: Any, times: float, often: float) -> None:
        super().__init__(bits)
        self.times, self.often = times, often

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        """So many times as far from the middle."""
        return super().normal(loc, self.times * scale, size)

    def random(self, *given: Any, **more: Any) -> Any:
        """Below a small number so many times as often."""
        return super().random(*given, **more) / self.often

    def __deepcopy__(self, memo: Any) -> Wilder:
        return Wilder(deepcopy(self.bit_generator, memo), self.times, self.often)


class Future(NamedTuple):
    """A copy of the system, what is seen there, and the seed of all that it draws."""

    system: System
    seen: Vector
    seed: int


class Ceiling(Rival):
    """Keeps a proposal after which some backup survives all futures that it draws.

    It is told the simulator and its hidden state, not what the episode will draw: it tries on
    copies that draw anew (`System.redraw`), and remembers the futures that were hardest. Backups
    are constant actions, and a good controller where one is known. Else the closest action of a
    grid passes after which one survives; where there is none, the backup acts that lasts longest.
    It proves nothing: futures that it did not draw may be harder, and other backups may save more.
    What cars do stands in their scenario and is not drawn: of them it knows the very future.
    """

    told = "the simulator, and the state that it hides"

    def __init__(self, system: System, seed: int = 0, samples: int = 8, steps: int = 80) -> None:
        self._system, self._steps, self._hard = system, steps, list[int]()
        self._samples = 1 if system.name in _CERTAIN else samples
        self._chance = np.random.default_rng([seed, 4711])
        self._times = 2.0 if system.name == "drift" else 4.0  # gusts last, noise does not
        box = system.actions
        middle = (some := _grid(box, 3))[len(some) // 2]
        self._tried = _grid(box, 9 if len(getattr(box, "low", ())) == 1 else 5)
        constant = [lambda s, z, one=one: one for one in (*_grid(box, 2), middle)]
        self._backups = [KNOWN[system.name]] if system.name in KNOWN else []
        self._backups += constant

    def action(self, observation: Vector, proposal: Action) -> Action:
        """The proposal, the closest action that passes, or the longest lasting backup's."""
        new = self._chance.integers(2**62, size=self._samples - len(self._hard))
        futures = [Future(deepcopy(self._system), observation, k) for k in (*self._hard, *new)]
        for one in futures:
            often = 4.0 if one.seed % 2 else 1.0
            one.system.redraw(Wilder(np.random.PCG64(one.seed), self._times, often))
        change = partial(self._system.actions.change, proposal)
        for action in (proposal, *sorted(filter(change, self._tried), key=change)):
            if self._passes(futures, action):
                return action
        lasts = [sum(self._lasts(one, act) for one in futures) for act in self._backups]
        return self._backups[int(np.argmax(lasts))](*futures[0][:2])

    def _passes(self, futures: list[Future], action: Action) -> bool:
        """Whether one backup survives all futures after an action; it is tried first next time."""
        after = []
        for one in futures:
            seen, _, ended, over, info = (system := deepcopy(one.system)).step(action)
            if info["failed"]:
                return False
            if not (ended or over):
                after.append(Future(system, seen, one.seed))
        for backup in self._backups:
            for place, one in enumerate(after):
                if self._lasts(one, backup) < self._steps:
                    after.insert(0, after.pop(place))
                    hard = [one.seed, *(seed for seed in self._hard if seed != one.seed)]
                    self._hard = hard[: self._samples // 2]
                    break
            else:
                self._backups.remove(backup)
                self._backups.insert(0, backup)
                return True
        return False

    def _lasts(self, begun: Future, backup: Backup) -> int:
        """Steps that a backup survives; all, if the episode ends well before."""
        system, seen = deepcopy(begun.system), begun.seen
        for step in range(self._steps):
            seen, _, ended, over, info = system.step(backup(system, seen))
            if info["failed"]:
                return step
            if ended or over:
                break
        return self._steps


def _grid(actions: Any, each: int) -> list[Action]:
    return [as_action(one, actions) for one in tried(actions, each)]


# -- Beside the learnt guard ----------------------------------------------------------------------

_BY, _SAID = ["system", "controller"], ("failed", "goals", "score")
_ALL = ("episodes", "kept", *_SAID, *(f"{name}_alone" for name in _SAID))


def renew(cases: Iterable[Case], episodes: int, workers: int | None) -> None:
    """Compute the ceilings of cases that do not change anew, at most 20 episodes; others stay."""
    asked = partial(trial, judge="studies.told:Ceiling", train=0, base=BASE, rounds=2)
    some = list(dict.fromkeys(case[:2] for case in cases if not case.change))
    tasks = [partial(asked, name, one or None, test=min(episodes, 20)) for name, one in some]
    then = json.loads(CEILINGS.read_text("utf-8"))
    rows = {tuple(old[name] for name in _BY): old for old in then}
    for case, row in zip(some, lib.parallel(tasks, workers), strict=True):
        rows[case] = dict(zip(_BY, case, strict=True)) | {k: round(row[k], 4) for k in _ALL}
    lines = ",\n".join(json.dumps(rows[case]) for case in sorted(rows))
    CEILINGS.write_text(f"[\n{lines}\n]\n", "utf-8")


def table(lines: pl.DataFrame) -> Table:
    """Lines of `studies.benchmark.compared` beside the ceiling; of systems that did not change."""
    told = pl.DataFrame(json.loads(CEILINGS.read_text("utf-8")), infer_schema_length=None)
    ours = lines.filter(change="", without="").unique(_BY, keep="first", maintain_order=True)
    both = ours.join(told, on=_BY, suffix="_told").with_columns(
        pl.col("goals") * pl.col("runs") / pl.col("episodes"),
        pl.col("goals_told", "goals_alone") / pl.col("episodes_told"),
    )
    shares = [
        pl.when(pl.col(f"{one}_told") > 0.0).then(pl.col(one) / pl.col(f"{one}_told")).alias(share)
        for one, share in (("kept", "of_kept"), ("goals", "of_goals"), ("score", "of_score"))
    ]
    shown = {
        **{"system": "{system}", "controller": "{controller}"},
        **{"failed": "{failed} of {episodes}", "ceiling": "{failed_told} of {episodes_told}"},
        **{"alone": "{failed_alone}", "kept": "{kept:.2f} of {kept_told:.2f}", "%": "{of_kept:p}"},
        **{"goals (alone)": "{goals:p} of {goals_told:p} ({goals_alone:p})", "% ": "{of_goals:p}"},
        "score (alone)": "{score:.4g} of {score_told:.4g} ({score_alone:.4g})",
        "%  ": "{of_score:p}",
    }
    note = (
        "Of: what a filter reaches that tries copies of the simulator; %: the share of that. It "
        f"and the controller alone: held-out episodes of seed {BASE}, computed once."
    )
    return Table("Beside one that is told the dynamics", both.with_columns(shares), shown, note)

"""The contract of a judge that learns: what it is asked changes nothing, what happens does."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.checks.contracts import Contract, drive, frozen, insist, refuse_growth, same
from evofsm.checks.kinds import Make
from evofsm.guard import AsksMachine, Guard, Judgement, Proposal, Situation

CONTRACT = Contract()
_LOWEST, _HIGHEST = -2.5, 2.5
_ACTIONS = np.array([_LOWEST, -0.7, 0.0, 1.3, _HIGHEST])
_EPISODES, _ROWS = 6, 40


class _Taught(NamedTuple):
    """A judge in a guard that drove, every other episode into a failure."""

    guard: Guard
    judge: Any
    decisions: list[tuple[Any, ...]]

    @property
    def sums(self) -> dict[str, float]:
        machine = self.guard.machine
        return dict(self.judge.sums(0 if machine is None else machine.n_states))

    def at(self, row: NDArray[np.float64]) -> Situation:
        machine = self.guard.machine
        belief = np.ones(1) if machine is None else np.asarray(machine.model().recognise(row))
        return Situation(row, belief, int(belief.argmax()), np.nan, 0.0)

    def asked(self) -> list[Judgement]:
        """What it says of some situations and actions."""
        return [self.judge.judge(self.at(row), _ACTIONS) for row in drive(8, seed=99)]


def _taught(make: Make, *, ask: bool = False) -> _Taught:
    judge = make()
    taught = _Taught(Guard(_LOWEST, _HIGHEST, interval=judge.dt, judge=judge), judge, [])
    return _go_on(taught, range(_EPISODES), ask=ask)


def _go_on(taught: _Taught, episodes: range, *, ask: bool = False) -> _Taught:
    guard, judge, decisions = taught
    for episode in episodes:
        rows, failed = drive(_ROWS, seed=episode), episode % 2 == 0
        for k, row in enumerate(rows):
            situation = guard.recognise(row, k * judge.dt)
            if ask:
                judge.why(judge.judge(situation, _ACTIONS))
            revision = guard.revise(situation, Proposal(float(_ACTIONS[k % len(_ACTIONS)])))
            decisions.append((revision.executed, revision.risk_proposed, revision.reason))
        last = np.array([-0.1, *rows[-1, 1:]]) if failed else rows[-1]
        guard.end(failed=failed, observation=last)
    return taught


@CONTRACT.clause()
def judges_each_action(make: Make) -> None:
    """It returns a probability for each action, within its interval, or NaN where it knows none."""
    for judged in _taught(make).asked():
        shapes = {name: np.shape(getattr(judged, name)) for name in ("risk", "low", "high")}
        insist(
            set(shapes.values()) == {_ACTIONS.shape},
            f"of {len(_ACTIONS)} actions it returns arrays of shapes {shapes}",
        )
        known = ~np.isnan(judged.risk)
        low, risk, high = judged.low[known], judged.risk[known], judged.high[known]
        insist(
            ((low >= 0.0) & (low <= risk) & (risk <= high) & (high <= 1.0)).all(),
            f"its risks are {risk} within {low} to {high}; probabilities lie in [0, 1], and in "
            "their interval",
        )


@CONTRACT.clause()
def inputs_not_changed(make: Make) -> None:
    """Observation, belief and actions stay as they are."""
    taught = _taught(make)
    for row in drive(8, seed=99):
        situation, actions = taught.at(row.copy()), _ACTIONS.copy()
        belief = situation.belief.copy()
        taught.judge.judge(situation, actions)
        insist(same(situation.observation, row), "judge changed the observation")
        insist(same(situation.belief, belief), "judge changed the belief")
        insist(same(actions, _ACTIONS), "judge changed the actions")
        fixed = situation._replace(observation=frozen(row), belief=frozen(belief))
        taught.judge.judge(fixed, frozen(_ACTIONS))


@CONTRACT.clause()
def asking_changes_nothing(make: Make) -> None:
    """Whoever asks it besides the driver changes neither decisions nor what is learnt."""
    quiet, asked = _taught(make), _taught(make, ask=True)
    insist(
        same(quiet.decisions, asked.decisions),
        "decisions change where somebody else asks it too (does judge note what it was asked?)",
    )
    insist(
        quiet.sums == asked.sums,
        f"it learns otherwise where somebody else asks it too: {_unlike(quiet, asked)}",
    )


@CONTRACT.clause()
def is_deterministic(make: Make) -> None:
    """Two that see the same learn and judge the same."""
    one, other = _taught(make), _taught(make)
    insist(
        one.sums == other.sums and same(one.asked(), other.asked()),
        "two judges that saw the same differ (a random number without a seed, or something shared "
        f"by all of the class?): {_unlike(one, other)}",
    )


@CONTRACT.clause()
def following_learns_nothing(make: Make) -> None:
    """While it is frozen it keeps up with what happens, and learns nothing."""
    taught = _taught(make)
    before = taught.sums
    taught.guard.freeze()
    _go_on(taught, range(10, 12))
    insist(
        taught.sums == before,
        "a frozen guard's judge went on learning (does follow, or a search, learn?)",
    )


@CONTRACT.clause()
def a_file_keeps_it(make: Make) -> None:
    """Between two episodes it is saved and read without a difference, also in what it learns."""
    taught = _taught(make)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "judge.evofsm"
        taught.judge.save(path)
        again = type(taught.judge).load(path)
    if isinstance(again, AsksMachine):
        assert taught.guard.machine is not None
        again.bind(taught.guard.machine)
    read = _Taught(taught.guard, again, [])
    insist(
        read.sums == taught.sums and same(read.asked(), taught.asked()),
        f"one that was saved and read judges otherwise: {_unlike(taught, read)}",
    )


@CONTRACT.clause()
def memory_is_bounded(make: Make) -> None:
    """Asking it again and again takes no more memory."""
    taught = _taught(make)
    situation = taught.at(drive(1)[0])

    def work(rounds: int) -> None:
        for _ in range(rounds):
            taught.judge.judge(situation, _ACTIONS)

    refuse_growth(work, 100, "the judge")


def _unlike(one: _Taught, other: _Taught) -> str:
    """What differs of what was learnt, in words."""
    names = [name for name in one.sums if one.sums[name] != other.sums.get(name)]
    return ", ".join(names) or "what it says"

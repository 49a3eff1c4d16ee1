"""Judges that are told nothing but failures: on ten systems, and on tasks that others set.

A judge learns a system while controlling it, is frozen, and is tried on held-out episodes, the same
ones for every judge. `Judges` takes each part of the learnt judge away; `Tasks` compares it with
judges that are told more.

Frame ``rows``: one judge on one system with one controller and one learning seed. ``failed``
counts held-out ``episodes``, ``failed_while_learning`` and ``failed_late`` training ones
(``failures`` says which, from 1); ``kept`` is the share of proposals that were executed exactly,
``mean_change`` that of an action in halves of its range (of discrete ones the share changed);
``score`` is the mean return, or mobility, with a bootstrap interval over episodes; ``p50_ms`` and
``p99_ms`` are of a held-out decision, and alone depend on the machine. ``goals`` counts held-out
episodes that arrived; ``steps`` is the mean of decisions to failure, at most those of an episode,
and ``steps_learning`` that of training episodes from the 11th on; columns that end in ``_alone``
say the same of the controller alone, in the same draws.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pkgutil import resolve_name
from typing import Annotated, Any, ClassVar, NamedTuple, Self
from unittest.mock import patch

import numpy as np
import polars as pl
from typer import Option

from evofsm.cli import imported
from evofsm.driving import guard_for_family
from evofsm.fsm import EvolvingFSM
from evofsm.guard import Guard, LearntRisk, LearntSettings, SceneRisk, run_episode
from evofsm.paper import Page, Table
from studies import benchmark, lib
from studies.lib import ALL, FIRST, Frames, Study, Target, at_least, at_most, frame_of
from studies.rivals import Counted, Unrevised, rivals_of
from studies.shapes import PEERS, SHAPES
from studies.systems import SYSTEMS, TASKS, Cars, Start, System, Vector, lacking, make_system

#: Parts of the learnt judge that can be taken away, each with what is left then.
PARTS: dict[str, str] = {
    "stretches": "no disturbances at all",
    "margin": "no margin",
    "backups": "constant backups alone",
    "states": "one state only: nothing may change",
    "regions": "failure by thresholds of single variables alone",
    "dead-ends": "no dead ends from certificates that were refuted",
    "rivals": "what hardly any failure tells is never doubted",
    "harm": "it is not tested whether the guard does harm",
    "lags": "no latest change and previous action",
    "products": "no bends and products of variables and actions",
    "shy": "bends and products are learnt as soon as all else",
    "outliers": "outliers weigh as much as all else",
    "drift": "nothing moves otherwise than it did",
    "caution": "disturbances are taken to be no harder than they were",
    "scan": "a disturbance begins with the episode",
    "horizon": "it looks 64 steps ahead",
    "exploration": "no action is tried to learn what it does",
    "misled": "lags stay in the model whatever they foresee",
    "regulators": "feedback evolves by mutants alone",
    "settled": "frozen, a rival never counts",
    "glitches": "what jumps there and back counts",
    "gaps": "what was not seen is not filled in",
    "held": "what rests at an end of a variable is learnt from, too",
    "witness": "what one episode alone survived takes back a failure",
    "blur": "an end that was seen once is as sharp as others",
    "dropped": "thresholds that fewer forms take the place of are forgotten",
    "endings": "what ended by itself counts as cut off",
    "fatal": "what nothing survives may begin anywhere",
    "landings": "a variable that jumps does not land where it did",
}

# What stands in its settings, or in its modules, where a part has no other switch.
_GONE: dict[str, dict[str, Any]] = {
    "stretches": {"learn.disturbances": lambda state, *_: state},
    "margin": {"margin": 0.0, "margin_step": 0.0},
    "backups": {"learn.evolved": lambda state, *_: state},
    "regions": {"failure._candidates": lambda *_: ()},
    "dead-ends": {"danger.dead_ends": lambda state, *_: state},
    "rivals": {"learn.doubted": lambda state, *_, tried: state},
    "lags": {"lags": 1e12},
    "products": {"shy": 1e12},
    "shy": {"shy": LearntSettings().prior},
    "outliers": {"outlier": 1e12},
    "drift": {"drift": 1e12},
    "caution": {"caution": 0.0},
    "scan": {"n_starts": 1},
    "horizon": {"horizon_min": 64, "horizon_max": 64},
    "exploration": {"tries": 0},
    "misled": {"misled": 1e12},
    "regulators": {"n_regulators": 0},
    "settled": {"settled": 10**6},
    "glitches": {"model.without_glitches": lambda z, unit: z},
    "gaps": {"model.filled": lambda z, failed: z},
    "held": {"motion._held": lambda state, to, after: np.zeros((2, *after.shape), bool)},
    "witness": {
        "motion._extremes": lambda old, new, _: (np.minimum(old[[0, 0]], new), new < old[0])
    },
    "blur": {"failure._BLURRED": 0.0},
    "dropped": {"danger._dropped": lambda state, was, *rest: was[:0]},
    "endings": {"danger._ENDED": math.inf},
    "fatal": {"learn._fatal": lambda state, known, found: (state, found)},
    "landings": {"model.trimmed": lambda found: found[:, : found.shape[1] // 2].copy()},
}
_SETTINGS = asdict(LearntSettings())
_LEARNT = "evofsm.guard.learnt"
# Private numbers of its modules, and of the test whether the guard does harm. Those of `rollout`
# are compiled into kernels.
_PLACES = dict.fromkeys(("backups", "danger", "failure", "learn", "model", "motion"), _LEARNT)
_PLACES |= {"harm": "evofsm.guard"}
_NUMBERS = {
    f"{module}.{name}": value
    for module, place in _PLACES.items()
    for name, value in vars(resolve_name(f"{place}.{module}")).items()
    if name.startswith("_") and type(value) in (int, float)
}
#: Each number of the learnt judge, halved and doubled; of what is near 1 how much it lacks.
SWEEP = tuple(
    f"{name}={1.0 - times * (1.0 - value) if 0.5 < value < 1.0 else type(value)(times * value):g}"
    for name, value in (_SETTINGS | _NUMBERS).items()
    for times in (0.5, 2.0)
)
#: Our judges: of variables, and of scenes.
OURS = ("learnt", "scene")
#: Tasks of which more was asked: learning seeds, and training episodes.
ACC, ACC_SEEDS, ACC_TRAIN = ("acc", "acc-5"), 20, 200


# -- Judges by name -------------------------------------------------------------------------------


def make_judge(name: str, system: System, without: Sequence[str] = (), seed: int = 0) -> Any:
    """A judge by its name, of the learnt one ``without`` some parts.

    ``told`` is the learnt guard, told the failure function; the others are `rivals_of` the system,
    or ``module:Name`` of a class that is made with the system and a seed. It has the methods of a
    `Rival`, or, as an `ActionJudge`, says how dangerous actions are: then a guard is made of it.
    """
    told: dict[str, Any] = {**system.actions.settings, "interval": system.interval, "seed": seed}
    if ":" in name:
        own = imported(name)(system, seed)
        if all(hasattr(own, method) for method in ("begin", "decide", "end", "freeze")):
            return own  # a guard, too, which has a judge beside
        if hasattr(own, "judge"):
            return Guard(**told, judge=own)
        raise TypeError(
            f"{name} makes a {type(own).__name__}, which is no judge: it has neither judge, "
            "nor begin, decide, end and freeze"
        )
    if name in ("learnt", "told"):
        if system.horizon is not None:
            told["horizon"] = system.horizon
        if name == "told":
            if system.has_failed is None:
                raise ValueError(f"{system.name} does not show in an observation that it failed")
            told["failed"] = system.has_failed
        return learnt_guard(**told, without=tuple(without))
    if name == "kinematic":
        if not isinstance(system, Cars):
            raise ValueError(f"{system.name} has no cars; the kinematic judge knows nothing else")
        return guard_for_family(system.family, seed=seed)
    if name == "scene":
        shown: Any = system
        if not hasattr(shown, "columns"):
            raise ValueError(f"{system.name} shows no objects; the judge of scenes knows no others")
        layout = {"columns": shown.columns, "relative": shown.relative}
        judge = SceneRisk(shown.interval, shown.actions.n_actions, **layout)
        return Guard(**told, judge=judge)
    known: dict[str, Callable[[], Any]] = {
        "unrevised": Unrevised,
        "counted": partial(Counted, system),
        **rivals_of(system),
    }
    if name not in known:
        names = ", ".join(("learnt", "told", "kinematic", "scene", *known))
        raise ValueError(f"{system.name} has no judge {name!r}; there are {names}")
    return known[name]()


# What judges of ours are told that stand in a guard.
_TOLD = {
    "LearntRisk": "nothing but failures",
    "LatentRisk": "how cars follow each other",
    "SceneRisk": "nothing but failures, and how a row is laid out",
}


def learnt_guard(
    *,
    interval: float,
    without: Sequence[str],
    failed: Callable[[Vector], bool] | None = None,
    **told: Any,
) -> Guard:
    """With the learnt judge without some parts; without ``states`` its machine has a single one.

    Without ``harm`` no episode is driven in shadow.
    """
    settings = LearntSettings(**_changes(without, in_modules=False))
    judge = LearntRisk(interval, **told, settings=settings)
    guard = Guard(**told, interval=interval, judge=judge, failed=failed)
    guard.shadow = "harm" not in without
    if "states" in without:
        guard.machine = EvolvingFSM(guard.actions.n_actions, max_states=1)
    return guard


def setting(part: str) -> dict[str, Any]:
    """A number of the learnt judge by NAME=VALUE; nothing of another part.

    >>> setting("horizon=32"), setting("motion._LATEST=0.4"), setting("harm")
    ({'horizon': 32}, {'motion._LATEST': 0.4}, {})
    """
    name, is_set, value = part.partition("=")
    if not is_set:
        return {}
    if (default := (known := _SETTINGS | _NUMBERS).get(name)) is None:
        raise ValueError(f"there is no number {name!r}; there are {', '.join(known)}")
    return {name: type(default)(float(value))}


def _changes(parts: Sequence[str], *, in_modules: bool) -> dict[str, Any]:
    """What parts change, by name: in the modules of the learnt judge, or in its settings."""
    changes = [item for part in parts for item in (_GONE.get(part) or setting(part)).items()]
    return {name: value for name, value in changes if ("." in name) == in_modules}


def taken_out(parts: Sequence[str]) -> ExitStack:
    """Within it what has no switch is left out of the learnt judge, or is another number."""
    stack = ExitStack()
    for place, instead in _changes(parts, in_modules=True).items():
        package = _PLACES[place.partition(".")[0]]
        stack.enter_context(patch(f"{package}.{place}", instead))
    return stack


def told_to(judge: Any) -> str:
    """What a judge is told, in a few words: as it says itself in ``told``, if it is not ours."""
    if isinstance(judge, Guard):  # its own judge is None where that does not learn
        if judge.failed is not None:
            return "which observations are failures"
        judge = getattr(judge.reviser, "risk", judge.judge)
    return str(getattr(judge, "told", _TOLD.get(type(judge).__name__, "not said")))


# -- A trial --------------------------------------------------------------------------------------


class Ended(NamedTuple):
    """What came of one episode."""

    failed: bool
    score: float
    kept: int  #: proposals that were executed exactly
    changes: float  #: sum over decisions
    times: list[float]  #: of each decision [s]
    speed: float  #: mean [m/s]; NaN where nothing drives
    arrived: bool
    steps: int  #: to failure; without it, as many as an episode may have


def run(system: System, judge: Any, start: Start, controller: Any = None) -> Ended:
    """One episode of a system under a judge, which learns from it unless it is frozen.

    Another ``controller`` than the system's own keeps what it wants as the system's ``proposed``.
    """
    times: list[float] = []
    kept, changes = 0, 0.0
    for one in run_episode(system, judge, controller or system, options={"start": start}):
        executed, proposed = one.revision.executed, system.proposed
        times.append(one.seconds)
        is_kept = np.array_equal(executed, proposed)
        if not is_kept and not system.actions.holds(executed):
            change = f"executed {executed!r} in place of {proposed!r}"
            raise ValueError(f"{type(judge).__name__} {change}, which is none of {system.actions}")
        kept += is_kept
        changes += system.actions.change(executed, proposed)
    steps = len(times) if one.failed else system.steps
    of_all = (kept, changes, times, system.speed)
    return Ended(one.failed, system.score, *of_all, system.arrived, steps)


_system = lru_cache(make_system)


@lru_cache(maxsize=4096)
def alone(name: str, controller: str, start: Start) -> Ended:
    """The same draw under the controller alone."""
    return run(_system(name, controller), Unrevised(), start)


def _reached(who: str, held_out: Sequence[Ended], late: Sequence[Ended]) -> dict[str, Any]:
    """What came of episodes, in columns that end in ``who``; means of none are null."""
    means = {"steps": held_out, "score": held_out, "steps_learning": late}
    found: dict[str, Any] = {"failed": sum(one.failed for one in held_out)}
    found["goals"] = sum(one.arrived for one in held_out)
    for of, some in means.items():
        steps = [getattr(one, of.removesuffix("_learning")) for one in some]
        found[of] = float(np.mean(steps)) if steps else None
    return {name + who: value for name, value in found.items()}


# Training episodes before steps are compared with those of the controller alone.
_LEARNING = 10


def trial(
    name: str,
    controller: str | None = None,
    judge: str = "learnt",
    without: str = "",
    seed: int = 0,
    train: int | None = None,
    test: int = 100,
    base: int = 0,
    late: int = 30,
    rounds: int = 100,
    beside: bool = True,
    change: str = "",
) -> dict[str, Any]:
    """Let a judge learn a system while controlling it, freeze it, and try it on held-out episodes.

    The ``seed`` is that of ``train`` episodes, the system's own number if not given, and of the
    judge; ``base`` that of everything: with another one the ``test`` held-out ones differ, too. A
    failure after ``late`` training episodes is a late one. With ``beside`` the controller alone is
    run in the same draws; ``change`` is one of `studies.benchmark.CHANGES`.

    >>> row = trial("acc", judge="unrevised", train=2, test=5)
    >>> row["failed"], row["kept"], row["mean_change"]
    (5, 1.0, 0.0)
    """
    system: Any = make_system(name, controller)
    system = benchmark.Changed(system, change) if change else system
    train = system.train if train is None else train
    with taken_out(parts := lib.names_in(without)):
        made = make_judge(judge, system, parts, seed)
        learnt = [run(system, made, Start.training(base, seed, k)) for k in range(train)]
        made.freeze()
        held_out = [run(system, made, Start.held_out(base, k)) for k in range(test)]
    failures = [place for place, one in enumerate(learnt, start=1) if one.failed]
    by_late = [one.score for one in learnt[max(0, late - 10) : late]]
    scores = np.array([one.score for one in held_out])
    low, high = lib.bootstrap(lambda chosen: float(scores[chosen].mean()), test, rounds)
    times = 1e3 * np.array([took for one in held_out for took in one.times])
    speed = float(np.mean([one.speed for one in held_out]))
    by_itself = partial(alone, name, system.controller)
    held, late_on = (range(test), range(_LEARNING, train)) if beside else (range(0), range(0))
    same = [by_itself(Start.held_out(base, k)) for k in held]
    later = [by_itself(Start.training(base, seed, k)) for k in late_on]
    return {
        "system": name,
        "controller": system.controller,
        "judge": judge,
        "told": told_to(made),
        "without": without,
        "seed": seed,
        "trained": train,
        "failed_while_learning": len(failures),
        "failed_late": sum(place > late for place in failures),
        "failures": failures,
        "score_by_late": float(np.mean(by_late)) if by_late else None,
        "episodes": test,
        "measure": system.measure,
        "score_low": low,
        "score_high": high,
        "kept": sum(one.kept for one in held_out) / len(times),
        "mean_change": sum(one.changes for one in held_out) / len(times),
        "p50_ms": float(np.quantile(times, 0.5)),
        "p99_ms": float(np.quantile(times, 0.99)),
        "speed": None if math.isnan(speed) else speed,
        **_reached("", held_out, learnt[_LEARNING:]),
        **_reached("_alone", same, later),
    }


_WHOLE = pl.col("without") == ""
_BY = ["system", "controller", "judge", "without"]


def summary(rows: pl.DataFrame, by: Sequence[str] = _BY) -> pl.DataFrame:
    """Learning seeds of one judge as one line: counts of all, the worst, the run in the middle."""
    middle = (pl.len() - 1) // 2
    of_middle = [pl.col(one).sort_by("score").get(middle) for one in ("score", *_ENDS)]
    medians = [pl.col(name).median() for name in ("kept", "mean_change", "p50_ms", "speed")]
    lines = rows.group_by(by, maintain_order=True).agg(
        pl.col("told", "trained", "measure").first(),
        pl.col("failed", "episodes").sum(),
        pl.col("failed_while_learning").sum().alias("learning"),
        (pl.col("failed") / pl.col("episodes")).max().alias("worst"),
        pl.col("failed_while_learning", "failed_late", "p99_ms").max(),
        pl.col("score").min().alias("score_worst"),
        pl.col("goals", "goals_alone").sum(),
        pl.col("steps", "steps_alone", "score_alone").mean(),
        (pl.col("steps") / pl.col("steps_alone")).min().alias("least"),
        (pl.col("steps_learning") / pl.col("steps_learning_alone")).min().alias("least_learning"),
        *of_middle,
        *medians,
        runs=pl.len(),
    )
    return lib.with_share(lines, "failed", "episodes", "rate")


_ENDS = ("score_low", "score_high")
_FAILS = {
    "failed": "{failed} of {episodes}",
    "rate (95 %)": "{rate:%} ({rate_low:p}–{rate_high:p})",
    "failed, worst seed": "{worst:%}",
    "trained": "{trained}",
    "failed while learning": "{failed_while_learning}",
    "late": "{failed_late}",
}
_COSTS = {
    "score (95 %)": "{score:.4g} ({score_low:.4g}–{score_high:.4g})",
    "score, worst seed": "{score_worst:.4g}",
    "kept": "{kept:%}",
    "change": "{mean_change:.2f}",
    "speed [m/s]": "{speed:.1f}",
    "p50 [ms]": "{p50_ms:.2f}",
    "p99 [ms]": "{p99_ms:.2f}",
}
_BESIDE = {
    "goals (alone)": "{goals} ({goals_alone})",
    "steps (alone)": "{steps:.0f} ({steps_alone:.0f})",
    "of alone, worst seed": "{least:%}",
    "while learning": "{least_learning:%}",
    "score alone": "{score_alone:.4g}",
}
_WHO = {"system": "{system}", "controller": "{controller}", "judge": "{judge}"}
_NOTE = (
    "Failed: held-out episodes of all learning seeds, which share them; intervals by Clopper and "
    "Pearson as if they were independent. Failed while learning, late, p99: of the worst seed. "
    "Score: mobility of cars, else the sum of rewards, of the seed in the middle, with a bootstrap "
    "interval over episodes. Kept: proposals that were executed exactly; change: of the action, in "
    "halves of its range. Times depend on the machine, and on --workers."
)
_NOTE_BESIDE = (
    " Alone: the controller without a guard, in the same draws. Steps: to failure; without one as "
    "many as an episode may have. Of alone: share of its steps; while learning, from the 11th "
    "training episode on."
)
_IS_OURS = pl.col("judge").is_in(OURS) & _WHOLE
_MARK = pl.when(_IS_OURS).then(pl.lit("ours"))


def _present(names: Iterable[str]) -> tuple[list[str], dict[str, str]]:
    """Those whose packages are there, and, as a fact of the page, what is left out."""
    lacks = {name: lacking(name) for name in dict.fromkeys(names)}
    said = "; ".join(f"{name} is left out: {lack}" for name, lack in lacks.items() if lack)
    return [name for name in lacks if not lacks[name]], {"left out": said} if said else {}


# -- The study of judges --------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Judges(Study):
    """How often systems fail under the learnt judge, whole and with each part taken away.

    It is told the range of the action, the interval, and which episodes failed. It learns while it
    decides; then it is frozen and tried on held-out episodes.
    """

    name = "judges"
    needed: ClassVar[dict[str, str]] = {"gymnasium": "gym"}

    systems: Annotated[
        str,
        Option(
            help="Systems with commas, or families of scenarios; all is ten, shapes those whose "
            "failure is no threshold, peers environments of others."
        ),
    ] = ALL
    judges: Annotated[
        str, Option(help="Judges beside the controller alone: learnt, told, counted.")
    ] = "learnt"
    without: Annotated[
        str,
        Option(
            help="Parts to take away, each by itself, with commas; all, or none. NAME=VALUE is "
            "another number of the learnt judge, sweep each of them halved and doubled."
        ),
    ] = ALL
    controllers: Annotated[
        str, Option(help="Controllers with commas; all, or first: the first one of each system.")
    ] = ALL
    seeds: Annotated[
        int | None, Option(min=1, help="Learning seeds; 5, of the benchmark 1, if not given.")
    ] = None
    train: Annotated[
        int | None, Option(min=1, help="Training episodes; as many as suit a system if not given.")
    ] = None
    test: Annotated[int, Option(min=1, help="Held-out episodes.")] = 100
    quick: Annotated[
        bool, Option("--quick", help="The frozen benchmark, beside what was accepted; one seed.")
    ] = False
    ceiling: Annotated[
        bool, Option("--ceiling", help="First compute anew what a filter told the dynamics does.")
    ] = False

    def shortened(self) -> Self:
        """One seed, one controller of each system, no part taken away."""
        return replace(
            self.smaller(seeds=1, train=30, test=20),
            without="none" if self.without == ALL else self.without,
            controllers=FIRST if self.controllers == ALL else self.controllers,
        )

    @property
    def parts(self) -> tuple[str, ...]:
        """Parts that are taken away; `ValueError` if there is no such part."""
        if self.without in (ALL, "none"):
            return tuple(PARTS) if self.without == ALL else ()
        named = tuple(dict.fromkeys(lib.names_in(self.without)))
        if "sweep" in named:
            return (*(part for part in named if part != "sweep"), *SWEEP)
        if wrong := [part for part in named if part not in PARTS and not setting(part)]:
            raise ValueError(f"there is no part {wrong[0]!r}; there are {', '.join(PARTS)}")
        return named

    @property
    def _wanted(self) -> list[str]:
        lists = {ALL: SYSTEMS, "shapes": SHAPES, "peers": PEERS}
        names = lib.names_in(self.systems)
        return [one for name in names for one in lists.get(name, [name])]

    def run(self, workers: int | None = None) -> dict[str, pl.DataFrame]:
        """Try all that is named, system by system."""
        if self.quick:
            without = () if self.without == ALL else self.parts
            seeds, base = self.seeds or 1, self.seed or benchmark.DRAWS
            only = "" if self.systems == ALL else self.systems
            if self.ceiling:
                from studies.told import renew

                renew(benchmark.chosen(only), self.test, workers)
            found = benchmark.run(seeds, base, self.judges, without, workers, only)
            return {"rows": found}
        tasks: list[partial[dict[str, Any]]] = []
        for name in _present(self._wanted)[0]:
            system = make_system(name)
            for controller in system.chosen(self.controllers):
                one = partial(trial, name, controller, test=self.test, base=self.seed)
                tasks.append(partial(one, "unrevised", train=0))
                for seed in range(self.seeds or 5):
                    learning = partial(one, seed=seed, train=self.train)
                    if isinstance(system, Cars):
                        tasks.append(partial(learning, judge="kinematic"))
                    for judge in lib.names_in(self.judges):
                        if judge != "told" or system.has_failed:
                            tasks.append(partial(learning, judge=judge))
                    tasks += [partial(learning, without=part) for part in self.parts]
        return {"rows": frame_of(lib.parallel(tasks, workers, "Learning and trying"))}

    def page(self, found: Frames) -> Page:
        """What fails, what each part is worth, and where it loses."""
        rows = found["rows"]
        if self.quick:
            return benchmark.page(self, rows)
        whole = summary(rows.filter(_WHOLE))
        parts = [
            Table(
                "The judges on every system",
                whole,
                _WHO | _FAILS | _COSTS | _BESIDE,
                _NOTE + _NOTE_BESIDE,
                _MARK,
            ),
        ]
        if self.parts:
            learnt = summary(rows.filter(judge="learnt"), ["system", "without"])
            left = pl.col("without").replace_strict(PARTS, default="whole")
            parts.append(
                Table(
                    "What each part is worth",
                    learnt.with_columns(left=left),
                    {"system": "{system}", "without": "{without}", "that is": "{left}"}
                    | {"failed": "{failed} of {episodes}", "while learning": "{learning}"}
                    | {"worst seed": "{worst:%}", **_COSTS},
                    "All controllers and learning seeds of a system together; failures while "
                    "learning of all of them.",
                    pl.when(_WHOLE).then(pl.lit("ours")),
                )
            )
        ours = whole.filter(judge="learnt")
        harm = (pl.col("least") < 0.9) | (pl.col("least_learning") < 0.9)
        few = (pl.col("failed") > 0) | (pl.col("kept") < 0.25) | (pl.col("p99_ms") > 1.5)
        both = lib.compared(
            whole.filter(pl.col("judge").is_in(["learnt", "kinematic"])), _IS_OURS, _BY[:2]
        )
        told = (pl.col("rate") < pl.col("rate_ours")) | (
            pl.col("score") > pl.col("score_ours") + 0.01
        )
        return self.shown(
            _ABOUT_JUDGES,
            parts,
            lost=[
                Table(
                    "Harm: less than 0.9 of the controller's own steps, held out or while learning",
                    ours.filter(harm),
                    _WHO | _FAILS | _BESIDE,
                ),
                Table(
                    "Failures held out, less than a quarter of the proposals kept, or one decision "
                    "of a hundred above 1.5 ms",
                    ours.filter(few),
                    _WHO | _FAILS | _COSTS,
                ),
                Table(
                    "The kinematic judge, which is told the physics, fails less or gets further",
                    both.filter(told),
                    {"system": "{system}", "failed": "{rate:%} against {rate_ours:%}"}
                    | {"mobility": "{score:.3f} against {score_ours:.3f}"},
                    "The kinematic judge against the learnt one.",
                ),
            ],
            facts=_present(self._wanted)[1],
            packages=("scipy", "gymnasium"),
        )


_ABOUT_JUDGES = """Does the learnt judge keep any system from failing, and which of its parts does
that?

The learnt judge is told the range of the action, the time between decisions, and which episodes
failed; nothing else, and the same settings everywhere. It learns while it decides; then it is
frozen, and decides held-out episodes, the same ones for every judge. Nothing is safe before the
first failure of each kind, as long as nobody tells of it."""

# -- The study of tasks ---------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Tasks(Study):
    """How often tasks that others set fail under ours, and under judges that are told more."""

    name = "tasks"
    needed: ClassVar[dict[str, str]] = {"gymnasium": "gym"}

    tasks: Annotated[
        str, Option(help="Tasks with commas; all, or none where --task is given, if not named.")
    ] = ""
    task: Annotated[str, Option(help="A task of your own, module:Class; see docs/judges.md.")] = ""
    judge: Annotated[str, Option(help="A judge of your own on every task, module:Class.")] = ""
    controllers: Annotated[
        str, Option(help="Controllers with commas; all, or first: the first one of each task.")
    ] = ALL
    seeds: Annotated[int, Option(min=1, help="Learning seeds; of acc 20 at least.")] = 5
    train: Annotated[
        int | None,
        Option(min=1, help="Training episodes; 200 of acc, as many as suit others if not given."),
    ] = None
    test: Annotated[int, Option(min=1, help="Held-out episodes.")] = 100
    acc_seeds: int = ACC_SEEDS
    rounds: int = 1000  #: of the bootstrap

    def shortened(self) -> Self:
        """One seed of 20 training episodes on three tasks."""
        return replace(
            self.smaller(seeds=1, train=20, test=10, acc_seeds=1, rounds=100),
            tasks=self.tasks or ("" if self.task else "acc,cartpole,pendulum"),
            controllers=FIRST if self.controllers == ALL else self.controllers,
        )

    @property
    def _wanted(self) -> list[str]:
        wanted = self.tasks or ("" if self.task else ALL)
        names = list(TASKS) if wanted == ALL else lib.names_in(wanted)
        return [self.task, *names] if self.task else names

    def run(self, workers: int | None = None) -> dict[str, pl.DataFrame]:
        """Try all that is named, task by task; it refuses what is no task or judge."""
        names, left_out = _present(self._wanted)
        if not names:
            raise ValueError(f"nothing to run: {left_out.get('left out', 'no task is named')}")
        tasks: list[partial[dict[str, Any]]] = []
        for name in names:
            system = make_system(name)
            rivals = ["unrevised", *rivals_of(system)]
            own = [self.judge] if self.judge and self.judge not in rivals else []
            for judge in own:
                make_judge(judge, system)  # so that a wrong one shows at once
            train = ACC_TRAIN if self.train is None and name in ACC else self.train
            train = train or system.train
            late = min(50, train // 2)
            for controller in system.chosen(self.controllers):
                one = partial(trial, name, controller, test=self.test, base=self.seed)
                one = partial(one, rounds=self.rounds, late=late, beside=False)
                tasks += [partial(one, judge, train=0, late=0) for judge in rivals]
                for seed in range(max(self.seeds, self.acc_seeds) if name in ACC else self.seeds):
                    learners = dict.fromkeys([*own, *system.learners])
                    tasks += [partial(one, judge, seed=seed, train=train) for judge in learners]
        return {"rows": frame_of(lib.parallel(tasks, workers, "Learning and trying"))}

    def page(self, found: Frames) -> Page:
        """What fails, what it costs, and where it loses."""
        rows = found["rows"]
        lines = summary(rows)
        told = ~pl.col("told").str.starts_with("nothing")
        unfailing = lines.filter(told & (pl.col("failed") == 0))
        best = unfailing.group_by("system", "controller").agg(best=pl.col("score").max())
        lines = lines.join(best, on=["system", "controller"], how="left", maintain_order="left")
        above = (pl.col("best") > 0) & (pl.col("score") > 0)
        lines = lines.with_columns(of_told=pl.when(above).then(pl.col("score") / pl.col("best")))
        who, ours = {**_WHO, "told": "{told}"}, rows.filter(pl.col("judge").is_in(OURS))
        return self.shown(
            _ABOUT_TASKS,
            [
                Table("What fails", lines, who | _FAILS, _NOTE, _MARK),
                Table(
                    "What it costs",
                    lines,
                    who | _COSTS | {"of told": "{of_told:%}"},
                    "Of told: the score, as a share of the highest one of those judges that are "
                    "told more and never failed.",
                    _MARK,
                ),
                Table(
                    "While learning, seed by seed",
                    ours,
                    {"task": "{system}", "controller": "{controller}", "seed": "{seed}"}
                    | {"episodes": "{trained}", "failed": "{failures}"}
                    | {
                        "return by then": "{score_by_late:.4g}",
                        "held out": "{failed} of {episodes}",
                    },
                    "Training episodes that failed, counted from 1. Return by then: mean of the "
                    "ten up to episode 50, or up to half of fewer than 100.",
                ),
            ],
            lost=_lost(lines),
            targets=[*_of_acc(ours), *_of_crashes(rows)],
            facts=_present(self._wanted)[1],
            packages=("scipy", "gymnasium"),
            sources={
                "ACC: G. Anderson et al., Guiding Safe Exploration with Weakest Preconditions, "
                "2023, arXiv:2209.14148": "https://arxiv.org/abs/2209.14148",
                "Labelled tasks: A. W. Goodall et al., MASA-Safe-RL, 2025": (
                    "https://github.com/sacktock/MASA-Safe-RL"
                ),
            },
        )


_ABOUT_TASKS = """Does it keep the tasks of others from failing, and at what cost?

Tasks as others set them, with their equations, actions and rewards. The learnt judge is told the
range of the action, the time between decisions, and which episodes failed; the same settings
everywhere. Those that learn do so while they decide; then all are tried on the same held-out
episodes. A failure ends an episode. Nothing is safe before the first failure of each kind, as long
as nobody tells of it."""


def _lost(lines: pl.DataFrame) -> Iterator[Table]:
    """Rows in which ours fails, keeps little, or another judge does better."""
    few = (pl.col("failed") > 0) | (pl.col("failed_late") > 0) | (pl.col("kept") < 0.25)
    yield Table(
        "Ours: failures held out or late in learning, or less than a quarter of proposals kept",
        lines.filter(_IS_OURS & few),
        _WHO | _FAILS | {"kept": "{kept:%}"},
    )
    both = lib.compared(lines, _IS_OURS, ["system", "controller"])
    none = (pl.col("failed") == 0) & (pl.col("failed_ours") == 0)
    same = 0.01 * pl.col("score_ours").abs()
    more = pl.col("score") > pl.col("score_ours") + same
    kept = pl.col("kept") > pl.col("kept_ours") + 0.05
    kept &= pl.col("score") > pl.col("score_ours") - same
    better = (pl.col("rate") < pl.col("rate_ours")) | (none & (more | kept))
    yield Table(
        "Judges that fail less often, or return more or keep more while none fails",
        both.filter((pl.col("judge") != "unrevised") & better),
        {**_WHO, "told": "{told}", "failed": "{rate:%} against {rate_ours:%}"}
        | {"score": "{score:.4g} against {score_ours:.4g}"}
        | {"kept": "{kept:%} against {kept_ours:%}"}
        | {"p50 [ms]": "{p50_ms:.2f} against {p50_ms_ours:.2f}"},
        "Theirs against ours.",
    )


def _of_acc(ours: pl.DataFrame) -> Iterator[Target]:
    """What was asked of acc, with as many seeds and episodes as it was asked of."""
    for task, least in (("acc", 545.0), ("acc-5", 520.0)):
        rows = ours.filter(pl.col("trained") >= ACC_TRAIN, system=task)
        if len(rows) < ACC_SEEDS:
            continue
        learning = rows["failed_while_learning"].to_numpy().max()
        yield at_most(f"{task}: failures while learning, worst seed", learning, 2)
        clean = float((rows["failed_late"] == 0).to_numpy().mean())
        what = f"{task}: seeds without a failure after episode 50"
        yield at_least(what, clean, 0.95, "{:.0%}")
        by_late = float(np.median(rows["score_by_late"].to_numpy()))
        yield at_least(f"{task}: return by episode 50, median seed", by_late, least, "{:.0f}")


def _of_crashes(rows: pl.DataFrame) -> Iterator[Target]:
    """Of highway-env: how many crashes fewer there are than without a guard, and at what speed."""
    lines = summary(rows.filter(pl.col("judge").is_in(["scene", "unrevised"])))
    both = lib.compared(lines, _IS_OURS, ["system", "controller"])
    for one in both.filter(pl.col("episodes") >= 200).to_dicts():
        who, fewer = f"{one['system']}, {one['controller']}", 1.0 - one["rate_ours"] / one["rate"]
        least = 0.7 if one["system"] == "intersection" else 0.9
        yield at_least(f"{who}: crashes fewer", fewer, least, "{:.0%}")
        kept = one["speed_ours"] / one["speed"]
        yield at_least(f"{who}: speed kept", kept, 0.85, "{:.0%}")

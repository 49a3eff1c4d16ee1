"""What all studies share: their commands, work over processes, intervals and scores.

A study is a frozen dataclass that derives from `Study`, in a file of its own. Its fields are the
options of its command, as Typer takes them; `run` returns rows as polars frames, one row per unit
of evidence; `page` says which tables and figures show them, and which rows go against us. The page
itself is `evofsm.paper.Page`; `README.md` beside this file has an example.
"""

from __future__ import annotations

import inspect
import math
import os
import pickle
import shlex
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields, replace
from functools import partial
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Self, TypeVar, get_origin, get_type_hints

import numpy as np
import polars as pl
import typer
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit
from scipy.stats import beta

from evofsm.cli import print_json, print_page
from evofsm.extras import install
from evofsm.paper import Figure, Page, Table, write_page

#: Rows of a study by name; those of its main table are called ``"rows"``.
Frames = Mapping[str, pl.DataFrame]
R = TypeVar("R")

#: What an option may take in place of names with commas: all there are, or the first one.
ALL, FIRST = "all", "first"


# -- A study and its command ----------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Study(ABC):
    """A question, and how much is done to answer it. The docstring is the help of its command."""

    name: ClassVar[str]  #: of its command, its page and its files
    needed: ClassVar[Mapping[str, str]] = {}  #: packages that it needs, with the extra of each

    seed: Annotated[int, typer.Option(min=0, help="Seed of all random draws.")] = 0

    def shortened(self) -> Self:
        """The same in a minute or a few: too small for conclusions."""
        return self

    def smaller(self, **most: float) -> Self:
        """The same, with at most so much of each of these amounts."""
        own = {name: getattr(self, name) for name in most}
        few: dict[str, Any] = {
            name: n if own[name] is None else min(own[name], n) for name, n in most.items()
        }
        return replace(self, **few)

    @abstractmethod
    def run(self, workers: int | None = None) -> dict[str, pl.DataFrame]:
        """Do it, with one process per core if not given; the numbers do not depend on that."""

    @abstractmethod
    def page(self, found: Frames) -> Page:
        """The tables and figures that show what `run` returned; see `shown`."""

    def write(self, found: Frames, folder: Path) -> None:  # noqa: B027
        """Write further files of one's own beside the rows."""

    @property
    def facts(self) -> dict[str, str]:
        """All its settings, for the page."""
        return {
            one.name.replace("_", " "): str(value)
            for one in fields(self)
            if (value := getattr(self, one.name)) not in (None, "")
        }

    def shown(
        self,
        about: str,
        parts: Iterable[Table | Figure],
        *,
        lost: Iterable[Table] = (),
        targets: Iterable[Target] = (),
        facts: Mapping[str, str] | None = None,
        **others: Any,
    ) -> Page:
        """A `Page` of these, which also says all settings, and what was typed."""
        told = {"lost": list(lost), "targets": frame_of(targets), **others}
        facts = self.facts | dict(facts or {})
        return Page(self.name, about, list(parts), command_line(), facts=facts, **told)


def command(study: type[Study]) -> Callable[..., None]:
    """The function of which Typer makes a study's command."""

    def run(
        short: Annotated[
            bool, typer.Option("--short", help="Quick run, too small for conclusions.")
        ] = False,
        workers: Annotated[
            int | None, typer.Option(min=1, help="Processes; one per core if not given.")
        ] = None,
        out: Annotated[
            Path | None,
            typer.Option(help="Folder for the page, figures and rows. evofsm-NAME if not given."),
        ] = None,
        as_json: Annotated[
            bool, typer.Option("--json", help="Print all rows as JSON; write nothing.")
        ] = False,
        **given: Any,
    ) -> None:
        with refused():
            require(study.needed)
            asked = study(**given).shortened() if short else study(**given)
            found = asked.run(workers)
            if as_json:
                print_json({name: frame.to_dicts() for name, frame in found.items()})
                return
            folder = out or Path(f"evofsm-{study.name}")
            folder.mkdir(parents=True, exist_ok=True)
            for name, frame in found.items():
                file = study.name if name == "rows" else f"{study.name}-{name}"
                frame.write_parquet(folder.absolute() / f"{file}.parquet")
            asked.write(found, folder.absolute())
            page = asked.page(found)
            path = write_page(folder / "index.html", [page])
            print_page(page)
            print(f"\nPage with all figures: {path}")

    hints = get_type_hints(study, include_extras=True)
    options = [
        inspect.Parameter(
            one.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if one.default is MISSING else one.default,
            annotation=hints[one.name],
        )
        for one in fields(study)
        if get_origin(hints[one.name]) is Annotated  # others say how much is done, for `shortened`
    ]
    *shared, _ = inspect.signature(run, eval_str=True).parameters.values()
    options += [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in shared]
    run.__name__, run.__doc__ = study.name, study.__doc__
    run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    return run


@contextmanager
def refused() -> Iterator[None]:
    """Print what a user can mend as one line on standard error, and end with status 2."""
    try:
        yield
    except (ValueError, TypeError, OSError, ModuleNotFoundError) as error:
        print(f"studies: {error}", file=sys.stderr)
        raise typer.Exit(2) from None


def require(packages: Mapping[str, str]) -> None:
    """Refuse before the long work what lacks a package after it, with what installs it."""
    if lacks := absent(packages):
        extras = dict.fromkeys(packages[package] for package in lacks)
        raise ModuleNotFoundError(f"this needs {' and '.join(lacks)}: {install(*extras)}")


def absent(packages: Iterable[str]) -> list[str]:
    """Those that are not installed."""
    return [package for package in packages if find_spec(package) is None]


def command_line() -> str:
    """What was typed."""
    return shlex.join(["python", "-m", "studies", *sys.argv[1:]])


def names_in(text: str) -> list[str]:
    """Names that were given with commas between them."""
    return [name.strip() for name in text.split(",") if name.strip()]


# -- Work over processes --------------------------------------------------------------------------


def parallel(
    tasks: Sequence[partial[R]], workers: int | None = None, doing: str = "Driving and learning"
) -> list[R]:
    """Results of all tasks, in the order of the tasks, with a progress bar on standard error.

    Tasks are partials of functions of modules; each should take a second or more, for it crosses a
    process boundary. With one of ``workers`` they are run in this very process; one per core is
    usual.

    >>> parallel([partial(pow, x, 2) for x in range(4)], workers=1)
    [0, 1, 4, 9]
    """
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    show = partial(
        track,
        description=doing,
        total=len(tasks),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    workers = min(workers or os.cpu_count() or 1, max(len(tasks), 1))
    if workers == 1:
        return [task() for task in show(pickle.loads(pickle.dumps(tasks)))]  # as in another
    # Forking a process that has started threads may hang; a fresh one costs a second.
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        running = {pool.submit(task): place for place, task in enumerate(tasks)}
        try:
            found = {running[one]: one.result() for one in show(as_completed(running))}
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [found[place] for place in range(len(tasks))]


# -- Rows -----------------------------------------------------------------------------------------


def frame_of(rows: Iterable[Any]) -> pl.DataFrame:
    """A frame of named tuples, dataclasses or dictionaries, all of one kind."""
    plain = [
        row
        if isinstance(row, dict)
        else row._asdict()
        if hasattr(row, "_asdict")
        else {one.name: getattr(row, one.name) for one in fields(row)}
        for row in rows
    ]
    return pl.DataFrame(plain, infer_schema_length=None)


def with_share(frame: pl.DataFrame, held: str, tried: str, name: str) -> pl.DataFrame:
    """Add a share and its exact 95 % interval (C. Clopper, E. Pearson, Biometrika 26, 1934).

    ``held`` of ``tried`` become ``name``, null of none, with ``name_low`` and ``name_high``.

    >>> frame = pl.DataFrame({"failed": [0, 3], "episodes": [1000, 10]})
    >>> with_share(frame, "failed", "episodes", "rate")["rate_high"].round(4).to_list()
    [0.0037, 0.6525]
    """
    low, high = exact_interval(frame[held].to_numpy(), frame[tried].to_numpy())
    share = pl.when(pl.col(tried) > 0).then(pl.col(held) / pl.col(tried))
    return frame.with_columns(
        share.alias(name), pl.Series(f"{name}_low", low), pl.Series(f"{name}_high", high)
    )


def exact_interval(
    held: ArrayLike, tried: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ends of the exact 95 % interval of a share, so many of so many; 0 and 1 of none."""
    k, n = np.asarray(held, np.float64), np.asarray(tried, np.float64)
    low, high = beta.ppf(0.025, k, n - k + 1.0), beta.ppf(0.975, k + 1.0, n - k)
    return np.where(k == 0.0, 0.0, low), np.where(k == n, 1.0, high)


def compared(frame: pl.DataFrame, ours: pl.Expr, by: Sequence[str]) -> pl.DataFrame:
    """Every other row together with ours of the same question, whose columns end in ``_ours``.

    The columns ``by`` say what was asked; of each question one row is ours.

    >>> frame = pl.DataFrame({"task": ["a"] * 3, "who": ["ours", "ttc", "rss"], "x": [1, 2, 0]})
    >>> both = compared(frame, pl.col("who") == "ours", ["task"])
    >>> both.filter(pl.col("x") > pl.col("x_ours"))["who"].to_list()
    ['ttc']
    """
    return frame.filter(~ours).join(frame.filter(ours), on=list(by), suffix="_ours")


class Target(NamedTuple):
    """Something that was asked for before it was measured, and what came out."""

    target: str
    asked: str
    measured: str
    met: bool


def at_most(target: str, value: float, most: float, show: str = "{:g}") -> Target:
    """That a number be no larger than another one.

    >>> at_most("episodes that fail", 3, 2)
    Target(target='episodes that fail', asked='≤ 2', measured='3', met=False)
    """
    return Target(target, f"≤ {show.format(most)}", show.format(value), bool(value <= most))


def at_least(target: str, value: float, least: float, show: str = "{:g}") -> Target:
    """That a number be no smaller than another one."""
    return Target(target, f"≥ {show.format(least)}", show.format(value), bool(value >= least))


# -- Scores and their uncertainty -----------------------------------------------------------------
# Rows of one episode are much alike, so whatever is uncertain is resampled by whole episodes
# (B. Efron, R. Tibshirani, "An Introduction to the Bootstrap", 1993).


class Interval(NamedTuple):
    """From and to, 95 %; NaN where there is none."""

    low: float
    high: float


def interval(values: ArrayLike) -> Interval:
    """That of bootstrap values, of which NaN is left out."""
    found = np.asarray(values, dtype=np.float64)
    found = found[~np.isnan(found)]
    if found.size == 0:
        return Interval(math.nan, math.nan)
    low, high = np.quantile(found, (0.025, 0.975))
    return Interval(float(low), float(high))


def resampled(episodes: int, rounds: int, seed: int = 0) -> Iterator[NDArray[np.intp]]:
    """Indices of as many episodes as there are, drawn with replacement, round by round."""
    rng = np.random.default_rng(seed)
    for _ in range(rounds):
        yield rng.integers(episodes, size=episodes)


def bootstrap(
    function: Callable[[NDArray[np.intp]], float], episodes: int, rounds: int = 200, seed: int = 0
) -> Interval:
    """95 % interval of a number that a function makes of the indices of episodes.

    >>> lasted = np.array([3.0, 4.0, 5.0, 6.0])
    >>> low, high = bootstrap(lambda chosen: float(lasted[chosen].mean()), len(lasted))
    >>> bool(low < lasted.mean() < high)
    True
    """
    return interval([function(chosen) for chosen in resampled(episodes, rounds, seed)])


class Areas(NamedTuple):
    """Areas under both curves; NaN where cases are too much alike.

    The area under the ROC curve is the probability that a dangerous case scores above another one,
    ties counting half. The area under precision over recall is the average precision: no line is
    drawn between thresholds, which would flatter (J. Davis, M. Goadrich, ICML 2006).
    """

    auroc: float
    auprc: float


class Ranked:
    """Scores in falling order: both areas for many weightings, sorted once.

    A higher ``score`` is more dangerous, and may be infinite; ``truth`` says whether it was, and
    ``episode`` which one each case is of, from 0. Without it each is one of its own.

    >>> ranked = Ranked([0.1, 0.4, 0.4, 0.8], [False, False, True, True])
    >>> ranked.areas().auroc, round(ranked.areas().auprc, 4)
    (0.875, 0.8333)
    >>> ranked.areas([1, 0, 1, 1])  # the second case left out
    Areas(auroc=1.0, auprc=1.0)
    """

    def __init__(
        self, score: ArrayLike, truth: ArrayLike, episode: ArrayLike | None = None
    ) -> None:
        values, dangerous = np.asarray(score, dtype=np.float64), np.asarray(truth, dtype=np.bool_)
        places = np.arange(len(values)) if episode is None else np.asarray(episode, dtype=np.intp)
        if values.ndim != 1 or not values.shape == dangerous.shape == places.shape:
            raise ValueError(
                f"score has shape {values.shape}, truth {dangerous.shape} and episode "
                f"{places.shape}; each must be one row, all equally long"
            )
        if np.isnan(values).any():
            raise ValueError("score holds NaN, which has no rank")
        order = np.argsort(-values, kind="stable")
        self._truth, self._episode = dangerous[order], places[order]
        # The last case of each score: a threshold cannot tell equal ones apart.
        falling = values[order]
        self._last = np.append(falling[1:] != falling[:-1], True)[: len(values)]
        self._episodes = int(places.max(initial=-1)) + 1

    def areas(self, weight: ArrayLike | None = None) -> Areas:
        """Both areas, with each episode counted as often as ``weight`` (episodes,) says."""
        often = np.ones(self._episodes) if weight is None else np.asarray(weight, np.float64)
        each = often[self._episode]
        true = np.cumsum(each * self._truth)[self._last]
        false = np.cumsum(each * ~self._truth)[self._last]
        if true.size == 0 or true[-1] == 0.0:
            return Areas(math.nan, math.nan)
        more, fewer = np.diff(true, prepend=0.0), np.diff(false, prepend=0.0)
        gained = more > 0.0
        precision = np.sum(more[gained] * true[gained] / (true + false)[gained])
        under = np.sum(fewer * (true - 0.5 * more))
        area = float(under / (true[-1] * false[-1])) if false[-1] > 0.0 else math.nan
        return Areas(area, float(precision / true[-1]))

    def interval(self, rounds: int = 200, seed: int = 0) -> tuple[Interval, Interval]:
        """95 % intervals of both areas, by bootstrap over episodes."""
        found = np.array(
            [
                self.areas(np.bincount(chosen, minlength=self._episodes))
                for chosen in resampled(self._episodes, rounds, seed)
            ]
        )
        return interval(found[:, 0]), interval(found[:, 1])


def logistic(rows: ArrayLike, came: ArrayLike, ridge: ArrayLike) -> NDArray[np.float64]:
    """(k,) weights of a logistic regression on ``rows`` (n, k), by Newton's method.

    The ridge, one of each weight, keeps them finite where few cases came.

    >>> logistic([[1.0], [1.0], [1.0], [1.0]], [True, True, True, False], [0.0]).round(4)
    array([1.0986])
    """
    X, y, penalty = (np.asarray(one, dtype=np.float64) for one in (rows, came, ridge))
    weights = np.zeros(X.shape[1])
    for _ in range(25):
        p = expit(X @ weights)
        slope = X.T @ (y - p) - penalty * weights
        curve = (X.T * np.maximum(p * (1.0 - p), 1e-6)) @ X + np.diag(penalty)
        step = np.linalg.solve(curve, slope)
        size = float(np.abs(step).max())
        weights += step * min(1.0, 5.0 / max(size, 1e-12))
        if size < 1e-6:
            break
    return weights

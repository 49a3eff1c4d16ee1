"""Alarms where nobody acts: thresholds on what is seen, on what is to come, and on where it failed.

A *limit* is a threshold of a variable, or of the nearness to a form of failure as `failure.explain`
learns them: now, or as it will be at the present rate in half the horizon, or in all of it. An
alarm is on while one of its limits is passed; it comes after a hold time, and stays while one will
be within the horizon at its rate, and for a quarter of it more. It is right if a failure comes
within the horizon after it began, on by then or not. Where it stays on, it says so once in each
horizon, and is false as often as no failure came; if it is right then, it is ahead by a horizon.

An alarm is of at most so many limits. Those are searched for that warn longest on average (none
counts as 0), less a price for each false alarm, and beside them plain thresholds in the same way;
each is then moved, with room to what is usual, or to the middle where it makes no difference. The
price is the highest with nearly the longest warning at no more false alarms than are stated, both
cross-validated (each third of a log, learnt from the others) and on all of it; the worse is told.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import groupby, product
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm import store
from evofsm.fsm.kernels import compiled, kernel
from evofsm.fsm.naming import Labels, in_a_line
from evofsm.fsm.proportions import wilson_bounds
from evofsm.fsm.sharing import Rollback, as_now
from evofsm.fsm.validation import positive, refuse_unusable
from evofsm.guard.actions import Action
from evofsm.guard.api import Fallback, Judgement, LearningJudge, Search, Situation
from evofsm.guard.learnt import failure
from evofsm.guard.learnt.rollout import FAILS, Flags, Floats, Ints
from evofsm.guard.learnt.words import changes, region
from evofsm.store import COUNT, FROM_1, SIZE, Kind, Numbers, Place

#: False alarms a day that an alarm may be asked for, the fewest first; and where nobody says.
RATES, RATE = (0.1, 0.3, 1.0, 3.0), 0.3
#: Times from here on are dates [s].
DATES = 1e8
# In horizons: how far ahead limits look, over what the rate is taken, how long an alarm stays on.
_AHEAD, _SMOOTHED, _STAYS = (0.0, 0.5, 1.0), 0.125, 0.25
# Limits of an alarm, prices of a false alarm, parts of a log; thresholds that are tried, and as
# many about the best, of which each is taken to be as often false as one some steps nearer: one
# step more for so many higher prices.
_MOST_LIMITS, _PRICES, _PARTS, _TRIED, _ROOM = 4, np.geomspace(0.02, 50.0, 24), 3, 24, 2
# Of a log of more rows some episodes are learnt from, if so many failures are left.
_MOST_ROWS, _FAILURES = 500_000, 100
# Blocks of rows in a horizon, as limits are searched for; of a long log fewer, but so many, where
# there would be more than that in all.
_BLOCKS, _FEWEST_BLOCKS, _MOST_BLOCKS = 15, 5, 100_000
# Kinds of alarms; plain ones, and of prices the highest, if others warn for so little longer.
_LEARNT, _PLAIN, _NO_KIND = range(3)
_BETTER, _LONG = 0.8, 0.97
# What a limit has to add to the share of the horizon that is warned before; survived rows of which
# forms of failure are learnt.
_WORTH, _ROWS = 2e-3, 4000
# An alarm is better than one at any time if it is by so many standard errors: of many the best was
# taken. A form is said if it holds such a share of the failures; and all, if they hold a share of
# those that they were not learnt from that is by so much larger than that of all rows.
_NO_CHANCE, _SAID, _KNOWN = 2.9, 0.1, 0.5
# Without a horizon: the share of the median episode, and the fewest rows. Rows that one that learns
# as it goes keeps; it learns anew where failures, or rows, are so many times as many.
_SHORT, _FEWEST, _HELD_ROWS, _MORE = 0.05, 10, 20_000, (1.1, 1.5)
#: Columns of a limit: which rate it is for, the kind of alarm, the variable or form,
#: which of `_AHEAD`, whether above (1) or below (-1), and the threshold.
_RATE, _KIND, _OF, _WHEN, _SIGN, _AT = range(6)
_DAY = 86400.0
_COUNTED = "cross-validated, and no better than on what it learnt from"
# Limits by their places, each with its threshold.
_Rule = tuple[tuple[int, float], ...]
#: The file of such a judge.
KIND = Kind(
    "foresight",
    {
        "forms": Numbers(("forms", failure.SIZE)),
        "limits": Numbers(("limits", 6)),
        "held_out": COUNT.of("rates", 4),
        "rows": Numbers(("rows", "variables")),
        **dict.fromkeys(("starts", "failed"), COUNT.of("episodes")),
    },
    {
        **{"dt": SIZE, "horizon": FROM_1, "hold": FROM_1, "names": list[str], "units": list[str]},
        **{"learns": bool, "asked": SIZE._replace(optional=True), "stated": SIZE},
        "bridges": SIZE._replace(least=0.0, optional=True),
    },
)


class Runs(NamedTuple):
    """Episodes, one after the other."""

    rows: Floats  #: (T, m)
    starts: Ints  #: (E,) at which row each begins
    failed: Flags  #: (E,) which of them ended in failure

    @property
    def lengths(self) -> Ints:
        """(E,) rows of each."""
        return np.diff(self.starts, append=len(self.rows))

    @property
    def last(self) -> Ints:
        """(E,) the last row of each."""
        return self.starts + self.lengths - 1

    @property
    def failures(self) -> Floats:
        """(F, m) rows in which they failed."""
        return self.rows[self.last[self.failed]]

    @classmethod
    def of(cls, episodes: Sequence[ArrayLike], failed: ArrayLike) -> Runs:
        """Those, (T,) or (T, m) each."""
        lengths = np.array([np.shape(run)[0] for run in episodes])
        odd = "".join([f", {x!r}" for x in np.ravel(failed).tolist() if x not in (True, False)][:1])
        if odd or not 0 < len(lengths) == np.size(failed) or 0 in lengths:
            text = f"{np.size(failed)} labels{odd}" + ", and one has no rows" * (0 in lengths)
            raise ValueError(f"failed is a truth value of each of {len(lengths)} episodes: {text}")
        rows = [np.asarray(run, np.float64).reshape(np.shape(run)[0], -1) for run in episodes]
        return cls(np.concatenate(rows), np.cumsum(lengths) - lengths, np.array(failed, np.bool_))

    def part(self, which: Flags) -> Runs:
        """Some of the episodes."""
        rows, lengths = self.rows[np.repeat(which, self.lengths)], self.lengths[which]
        return Runs(rows, np.cumsum(lengths) - lengths, self.failed[which])


def _nothing(m: int) -> Runs:
    return Runs(np.empty((0, m)), np.empty(0, np.int64), np.empty(0, np.bool_))


class Tally(NamedTuple):
    """What came of an alarm."""

    failures: int
    foreseen: int  #: with an alarm that was right
    lead: float  #: mean time since the first of them began, at most the horizon; else 0 [s]
    false: int
    days: float


class Foresight(LearningJudge):
    """Says that a failure is near, where nobody acts.

    It learns from a whole log (`learn_log`), or with ``log``, the episodes so far, as it goes: of
    the latest 20,000 rows (half of them of episodes that failed), where enough has come since.

    The risk is the share of such alarms that were right, by `held_out`; 0 while none is on. Of the
    alarms for several rates it is the one for most false ones a day that are no more than
    ``stated``; if there is none, the one for fewest.

    Examples
    --------
    >>> from evofsm.guard import Choices, ActionReviser, Guard
    >>> rng = np.random.default_rng(0)
    >>> heats = [np.cumsum(rng.random(100)) for _ in range(12)]  # it fails above 50, some stop
    >>> runs = [heat[: (np.append(heat > 50, True).argmax() + 1)] for heat in heats]
    >>> judge = Foresight.learn_log(runs, [run[-1] > 50 for run in runs], dt=60.0, horizon=600.0)
    >>> guard = Guard.of(ActionReviser(judge, Choices(1)), interval=60.0, learn=False)
    >>> [guard.decide([heat], 0).risk_proposed > 0.5 for heat in (10.0, 10.5, 49.0)]
    [False, False, True]
    """

    fallback = Fallback(0.0, "nobody acts")
    rates = RATES  #: for each there is an alarm
    runs = Runs.of

    def __init__(
        self,
        dt: float,
        horizon: int,
        hold: int,
        forms: Floats,
        limits: Floats,
        held_out: Floats,
        names: Sequence[str] = (),
        units: Sequence[str] = (),
        log: Runs | None = None,
        asked: float | None = None,
        stated: float = RATE,
        days: float = math.nan,
        bridges: float | None = None,
    ) -> None:
        self.dt = positive("dt", dt)
        self.horizon, self.hold = horizon, hold  #: [rows]
        self.bridges = bridges or 0.0  #: longest hole that it goes on across, as in a log [s]
        self.forms, self.limits = forms, limits
        #: (rates, 4) of each of `RATES`, the worse of cross-validated and of what it learnt from:
        #: failures foreseen, false alarms, failures; and its kind
        self.held_out = held_out
        self.labels = Labels(names=tuple(names), units=tuple(units), dt=dt)
        self.log = log  #: what it learns from, if it does as it goes
        self.asked = asked  #: horizon that was asked for, if any [s]
        self.stated = stated  #: false alarms a day
        self.days = days  #: in which `held_out` counts them, where it has just learnt
        self._seen: list[Floats] = []  # of the episode under way
        self._learnt = (0, 0) if log is None else (int(log.failed.sum()), len(log.rows))
        self.start_episode()

    @classmethod
    def learn_log(
        cls,
        episodes: Sequence[ArrayLike],
        failed: ArrayLike,
        *,
        dt: float,
        horizon: float | None = None,
        hold: float = 0.0,
        names: Sequence[str] = (),
        units: Sequence[str] = (),
    ) -> Self:
        """Learn from the episodes of a log.

        Parameters
        ----------
        episodes : sequence of (T,) or (T, m) array_like
            Rows of each, a column a variable.
        failed : (E,) array_like
            Which of them ended with a failure; a ValueError if none.
        dt : float
            Time between two rows [s].
        horizon : float, optional
            How long before a failure an alarm is right [s]; without it a twentieth of the median
            episode, 10 rows at least.
        hold : float
            How long a limit has to be passed [s].
        names, units : sequence of str
            Of the variables.
        """
        log, dt = Runs.of(episodes, failed), positive("dt", dt)
        if not log.failed.any():
            raise ValueError("no episode failed, so there is nothing to foresee")
        refuse_unusable("observations", log.rows)
        for name, texts in (("names", names), ("units", units)):
            if len(texts) not in (0, m := log.rows.shape[1]):
                raise ValueError(f"{name} are {len(texts)}, of {m} variables")
        labels = Labels(names=tuple(names), units=tuple(units))
        return cls._of_log(log, dt, horizon, 1 + round(hold / dt), labels)

    @classmethod
    def from_zero(
        cls, *, dt: float, names: Sequence[str], horizon: float | None = None, hold: float = 0.0
    ) -> Self:
        """One that has seen nothing, and learns as it goes.

        Parameters
        ----------
        dt, names, horizon, hold
            As in `learn_log`.
        """
        tables = np.empty((0, failure.SIZE)), np.empty((0, 6)), np.zeros((len(RATES), 4))
        tables[2][:, 3] = _NO_KIND
        keywords: dict[str, Any] = {"log": _nothing(len(names)), "asked": horizon}
        return cls(dt, _FEWEST, 1 + round(hold / dt), *tables, names, **keywords)

    @classmethod
    def _of_log(
        cls, log: Runs, dt: float, horizon: float | None, held: int, labels: Labels
    ) -> Self:
        """Learn from a log in which there are failures; of a long one from some of the episodes."""
        every = min(-(-len(log.rows) // _MOST_ROWS), int(log.failed.sum()) // _FAILURES)
        if every > 1:  # of both kinds as many of each
            of_kind = np.where(log.failed, np.cumsum(log.failed), np.cumsum(~log.failed))
            log = log.part(of_kind % every == 0)
        if horizon is None:
            horizon = max(float(np.median(log.lengths)) * _SHORT, _FEWEST) * dt
        ahead = max(round(positive("horizon", horizon) / dt), 1)
        names = labels.names or [f"variable {k + 1}" for k in range(log.rows.shape[1])]
        fresh = cls(dt, ahead, held, *np.empty((3, 0, failure.SIZE)))
        number = np.arange(len(log.failed)) * _PARTS // len(log.failed)
        tallies = np.zeros((2, 2, len(_PRICES), 3))  # cross-validated, and of all of the log
        there = np.zeros((2, 2))  # of failures, and rows: how many are where others failed, and all
        for k in range(_PARTS):
            if not (number == k).any() or not log.failed[number != k].any():
                continue
            judge, rest = fresh._fitted(log.part(number != k))[0], log.part(number == k)
            for n, z in enumerate((rest.failures, rest.rows)):
                there[n] += failure.inside(judge.forms, z).any(0).sum(), len(z)
            tallies[0] += judge._tallies(rest, judge.columns(rest))
        judge, columns = fresh._fitted(log)
        tallies[1] = judge._tallies(log, columns)
        worst = np.dstack([tallies[..., :2].min(0), tallies[..., 2].max(0)])
        days = np.array([there[1, 1], len(log.rows)])[:, None, None] * dt / _DAY
        holds, shares = judge.forms[:, failure.HELD], there[:, 0] / np.maximum(there[:, 1], 1.0)
        is_known = not there[0, 1] or shares[0] - shares[1] >= _KNOWN
        holds[holds < (_SAID * log.failed.sum() if is_known else np.inf)] = 0.0
        chance, limits = log.failed.sum() * ahead / len(log.rows), list[Floats]()
        score_of, scores = dict[Any, Any](), list[Any]()
        for rate, daily_rate in enumerate(RATES):
            fit = (tallies[..., 2] <= daily_rate * days).all(0) & (tallies[1, ..., 1] > 0)
            counts = worst * fit[..., None]
            best = [np.flatnonzero(leads >= _LONG * leads.max())[-1] for leads in counts[..., 0]]
            parts = [judge.of_rate(int(best[k]), plain=k > 0)[:, 1:] for k in range(2)]
            learnt, plain = counts[[0, 1], best]
            table = np.vstack([np.empty((0, 5)), *(parts[k] for k in range(2) if fit[k, best[k]])])
            as_many = np.minimum((plain[2] + 1.0) / (worst[0, :, 2] + 1.0), 1.0)
            kind = int(plain[0] >= _BETTER * (as_many * counts[0, :, 0]).max())
            _, right, false = (learnt, plain)[kind]
            low = wilson_bounds(right / (n := right + false), n, _NO_CHANCE)[0] if right else 0.0
            kind = kind if low > chance else _NO_KIND  # no better than an alarm at any time
            score = right, false, float(log.failed.sum()), kind  # one of each limits
            score = score_of.setdefault((kind, parts[kind % 2].tobytes()), score)
            if kind == _NO_KIND and scores and scores[-1][3] != _NO_KIND:  # one for fewer does
                score, table = scores[-1], limits[-1][:, 1:]
            scores.append(score)
            limits.append(np.insert(table, 0, rate, 1))
        tables = judge.forms, np.concatenate(limits), np.array(scores, np.float64)
        return cls(dt, ahead, held, *tables, names, labels.units, days=float(days.min()))

    def _fitted(self, log: Runs) -> tuple[Self, Floats]:
        """With forms and limits of both kinds, for all prices; and the `columns` of the log."""
        rows, failed = np.delete(log.rows, log.last[log.failed], 0), log.failures
        unit = np.median(np.abs(np.diff(log.rows, axis=0)), axis=0) + 1e-12
        box, sample = np.sort(rows, axis=0), rows[:: max(len(rows) // _ROWS, 1)]
        survival = failure.Survived(sample, box[:2], box[:-3:-1], unit, rows.std(0), rows[:0])
        forms = failure.explain(FAILS, failed, survival)
        judge = type(self)(self.dt, self.horizon, self.hold, forms, self.limits, self.held_out)
        columns = judge.columns(log)
        judge.limits = np.vstack([judge._searched(columns, log, plain=k) for k in (False, True)])
        return judge, columns

    def _tallies(self, log: Runs, columns: Floats) -> Floats:
        """(2, prices, 3) of both kinds of limits: time warned, failures foreseen, false alarms."""
        tables, tallies = dict[bytes, Tally](), list[tuple[float, ...]]()
        for side, price in np.ndindex(2, len(_PRICES)):
            table = self.of_rate(price, plain=bool(side))[:, _OF:].tobytes()
            if table not in tables:
                tables[table], _ = self.tally(log, price, plain=bool(side), columns=columns)
            n, foreseen, lead, false, _ = tables[table]
            tallies.append((lead * n, foreseen, false))
        return np.reshape(tallies, (2, -1, 3))

    def _searched(self, columns: Floats, log: Runs, *, plain: bool) -> Floats:
        """The limits that warn longest, of each rate."""
        m, of = log.rows.shape[1], len(columns) // len(_AHEAD)
        above = product(range(1 if plain else len(_AHEAD)), range(m if plain else of), (1, -1))
        limits = [(v, when, sign) for when, v, sign in above if v < m or sign > 0]
        # Rows are looked at by blocks, in which it is enough that one of them is beyond.
        # The last row, with which it may fail, is one by itself.
        coarse = min(len(log.rows) // _MOST_BLOCKS, self.horizon // _FEWEST_BLOCKS)
        size = max(self.horizon // _BLOCKS, coarse, 1)
        countdown = np.repeat(log.last, log.lengths) - np.arange(len(log.rows))
        blocks = np.union1d(np.flatnonzero(countdown % size == 0), log.starts)
        shares = 1.0 - np.geomspace(0.3, min(max(3.0 / len(log.rows), 1e-5), 0.3), _TRIED)
        series = [sign * columns[v + of * when] for v, when, sign in limits]
        thresholds = np.array([np.quantile(x, shares) for x in series])
        x = np.array([np.maximum.reduceat(x, blocks) for x in series])
        spans, starts = np.maximum(self._spans // size, 1), np.searchsorted(blocks, log.starts)
        most = spans[0] * log.failed.sum(), len(log.rows) * self.dt / _DAY

        def beyond(rule: _Rule) -> Flags:
            return np.asarray(np.any([x[0] > np.inf, *(x[k] > at for k, at in rule)], axis=0))

        @cache
        def more(rule: _Rule) -> Floats:
            """(limits, thresholds, 2) share that is warned, and false alarms a day, of one more."""
            return _one_more(x, thresholds, beyond(rule), starts, log.failed, spans) / most

        @cache
        def near(k: int, at: float, rest: _Rule) -> tuple[Floats, Floats]:
            """(steps,) thresholds about one of those, and (steps, 2) what comes of each of them."""
            j, rise = int(np.searchsorted(thresholds[k], at)), (*thresholds[k], x[k].max())
            steps = np.linspace(rise[max(j - 1, 0)], rise[j + 1], _TRIED)
            sums = _one_more(x[k, None], steps[None], beyond(rest), starts, log.failed, spans)
            return steps, sums[0] / most

        # What one failure alone speaks for is no further limit.
        table, alone = list[Any](), max(_WORTH, 1.0 / log.failed.sum())
        for number, price in enumerate(_PRICES):
            rule, worth, room = _Rule(), 0.0, number // _ROOM
            while len(rule) < _MOST_LIMITS:
                gain = more(rule) @ (1.0, -price)
                best = divmod(int(gain.argmax()), _TRIED)
                if gain[best] <= worth + (alone if rule else _WORTH):
                    break
                worth, rule = gain[best], (*rule, (best[0], float(thresholds[best])))
            for k, at in rule:
                rest = tuple(limit for limit in rule if limit != (k, at))
                steps, sums = near(k, at, rest)
                gain = sums[room:, 0] - price * sums[: _TRIED - room, 1]
                equals = np.flatnonzero(gain >= gain.max() - 1e-9)
                middle = k, float(steps[room + equals[len(equals) // 2]])
                is_more = not rest or (beyond((middle,)) & ~beyond(rest)).any()
                rule = (*rest, middle) if is_more else rest  # what others imply is no part of it
            table += [(number, plain, *limits[k], limits[k][2] * at) for k, at in rule]
        return np.array(table, np.float64).reshape(-1, 6)

    @property
    def _spans(self) -> Ints:
        """The horizon, how long a limit has to be passed, and how long an alarm stays on [rows]."""
        return np.array([self.horizon, self.hold, max(round(_STAYS * self.horizon), 1)])

    def columns(self, log: Runs, memory: Floats | None = None) -> Floats:
        """(3 v, T) variables and nearness to forms: now, and as far ahead as `_AHEAD` says."""
        x = np.vstack([log.rows.T, -failure.distances(self.forms, log.rows)])
        memory = np.full((2, len(x)), np.nan) if memory is None else memory
        keeps, ahead = np.exp(-1.0 / (_SMOOTHED * self.horizon)), np.empty((len(_AHEAD), *x.shape))
        _look_ahead(x, log.starts, keeps, np.array(_AHEAD) * self.horizon, memory, ahead)
        return np.reshape(ahead, (-1, len(log.rows)))

    def _passed(self, columns: Floats, limits: Floats, *, soon: bool = False) -> Flags:
        """(n, T) which limits are passed; or ``soon``, within the horizon at the present rate."""
        of, when, sign = limits[:, [_OF, _WHEN, _SIGN]].T.astype(int)
        ahead = columns.reshape(len(_AHEAD), -1, columns.shape[1])
        later = (np.maximum(when, least) for least in range(len(_AHEAD) if soon else 1))
        x = np.fmax.reduce([sign[:, None] * ahead[then, of] for then in later])
        return np.asarray(x > (sign * limits[:, _AT])[:, None])

    def of_rate(self, rate: int, *, plain: bool | None = None) -> Floats:
        """The limits of an alarm, by default of the kind that did better, cross-validated."""
        kind = self.held_out[rate, 3] if plain is None else _PLAIN if plain else _LEARNT
        is_of_rate = (self.limits[:, _RATE] == rate) & (self.limits[:, _KIND] == kind)
        return np.asarray(self.limits[is_of_rate])

    def where(self, rate: int) -> Floats:
        """(r, SIZE) forms beyond which an alarm is on while nothing changes; `HELD` is how near."""
        m, forms = len(self.labels.names), []
        for *_, v, _, sign, at in self.of_rate(rate).tolist():
            side = FAILS, v, v, 0.0, 0.0, 1.0, 1.0, -sign * at, sign, *np.zeros(5)
            forms.append(side if v < m else (*self.forms[int(v) - m, : failure.HELD], at))
        return np.array(forms).reshape(-1, failure.SIZE)

    def thresholds(self, rate: int) -> list[tuple[int, float]]:
        """The variables that alarm by themselves, and at which values."""
        limits, m = self.of_rate(rate).tolist(), len(self.labels.names)
        return [(int(v), at) for *_, v, when, _, at in limits if v < m and not when]

    def tally(
        self,
        log: Runs,
        rate: int,
        *,
        plain: bool | None = None,
        columns: Floats | None = None,
        times: Floats | None = None,
    ) -> tuple[Tally, Flags]:
        """What came of the alarm for one of `RATES`, and when it was on (T,).

        Parameters
        ----------
        log : Runs
        rate : int
        plain : bool, optional
            Whether it is that of plain thresholds; by default of the kind that did better.
        columns, times : ndarray, optional
            The `columns` of the log, if they are known; when its rows were [s], if not evenly.
        """
        limits = self.of_rate(rate, plain=plain)
        columns = self.columns(log) if columns is None else columns
        above, on = (np.any(self._passed(columns, limits, soon=k), axis=0) for k in (False, True))
        leads, rows = np.zeros(len(log.starts)), np.flatnonzero(on)
        clock = np.cumsum(np.ones(len(on))) if times is None else (times - times[0]) / self.dt
        false = _tally(above, on, rows, (log.starts, log.failed), self._spans, clock, leads)
        n, days = int(log.failed.sum()), len(log.rows) * self.dt / _DAY
        lead = float(leads.sum()) / max(n, 1) * self.dt
        return Tally(n, int((leads > 0.0).sum()), lead, int(false), days), on

    def words(self, rate: int, *, plain: bool | None = None) -> str:
        """Where an alarm is on, as `of_rate` has its limits."""
        return " or ".join(" ".join(self._words(row)) for row in self.of_rate(rate, plain=plain))

    def _words(self, limit: Floats) -> tuple[str, str]:
        v, when, sign, at = int(limit[_OF]), int(limit[_WHEN]), limit[_SIGN], limit[_AT]
        soon = f" in {span(_AHEAD[when] * self.horizon * self.dt)} at its rate" * (when > 0)
        names, m = [*map(in_a_line, self.labels.names)], len(self.labels.names)
        if v < m:
            unit = f" {in_a_line(units[v])}" if (units := self.labels.units) and units[v] else ""
            return names[v], f"{'above' if sign > 0.0 else 'below'} {at:.4g}{unit}{soon}"
        row = self.forms[v - m].copy()
        is_flat = not row[failure.P : failure.HELD].any()
        if is_flat:  # then a limit of nearness is one of the form
            row[failure.C] -= at * np.hypot(row[failure.B], row[failure.D])
        there = self._region(row)
        if is_flat:
            variable, _, beyond = there.partition(" is ")
            return variable, f"{beyond}{soon}"
        return "distance to failure", f"below {changes(0.0 - at)}{soon} (it fails {there})"

    def reason(self, z: Floats, column: Floats) -> str:
        """Why the alarm is on at an observation (m,), of which `columns` has this one."""
        rate = self.alarm
        assert rate is not None
        right, false, *_ = self.held_out[rate].tolist()
        limits = self.of_rate(rate)
        of, when = limits[:, [_OF, _WHEN]].T.astype(int)
        is_unseen = np.isnan(column.reshape(len(_AHEAD), -1)[when, of]).any()
        why = f"the alarm stays on {'until all is seen again' if is_unseen else 'for a while'}"
        if len(limits := limits[self._passed(column[:, None], limits)[:, 0]]):
            name, there = self._words(limits[0])
            why = f"{name} {self._value(limits[0], z):.4g}: {there}"
        came = f"after {right:.0f} of {right + false:.0f} such alarms it failed"
        soon = span(self.horizon * self.dt) + ", holes aside" * (self.bridges > 0.0)
        return f"{why}; {came} within {soon} ({_COUNTED})"

    def _value(self, limit: Floats, z: Floats) -> float:
        """What is compared with a limit, at an observation (m,), as `_words` has it."""
        if (v := int(limit[_OF])) < len(z):
            return float(z[v])
        row = self.forms[v - len(z)]
        if row[failure.P : failure.HELD].any():
            return float(failure.distances(row[None], z[None])[0, 0])
        i, j = row[[failure.I, failure.J]].astype(int)
        weights = row[[failure.B, failure.D]] * row[[failure.ONE, failure.OTHER]]
        return float(z[i] if i == j else weights @ z[[i, j]] / np.hypot(*weights))

    @property
    def shares(self) -> Floats:
        """(rates,) of the alarms those that were right; 0 where nothing foresees a failure."""
        right, false, _, kind = self.held_out.T
        return np.where(kind == _NO_KIND, 0.0, right / np.maximum(right + false, 1.0))

    @property
    def alarm(self) -> int | None:
        """Which of `RATES` the alarm is for; None if no alarm was better than chance."""
        rates = [k for k in range(len(RATES)) if self.shares[k] > 0.0]
        return max((k for k in rates if RATES[k] <= self.stated), default=min(rates, default=None))

    @property
    def alarm_in_words(self) -> str:
        """Which alarm it is, or why there is none."""
        if self.held_out[0, 2] == 1.0:
            return "with one failure nothing can be cross-validated"
        if self.alarm is None:
            return f"cross-validated, none of up to {RATES[-1]:g} false a day surely beats chance"
        fewest = ", as none is for fewer" * (RATES[self.alarm] > self.stated)
        return f"it alarms as for {RATES[self.alarm]:g} false alarms a day{fewest}"

    def fails(self, log: Runs) -> list[tuple[str, int, int]]:
        """Where it fails, in words; how many episodes came there, and how many of them failed."""
        there = failure.distances(self._said, log.rows) <= 0.0
        came = np.logical_or.reduceat(there, log.starts, axis=1)
        counts = came.sum(1).tolist(), (came & log.failed).sum(1).tolist()
        return list(zip(map(self._region, self._said), *counts, strict=True))

    @property
    def _said(self) -> Floats:
        """Those of the forms that are known well enough to be said."""
        return np.asarray(self.forms[self.forms[:, failure.HELD] > 0.0])

    def _region(self, form: Floats) -> str:
        """Where a form is, in words."""
        row = form[failure.I : failure.HELD].tolist()
        text = region(self.labels.names, row, 1)
        return text.removeprefix("where ").removesuffix(" (1 failure)")

    @property
    def told_by_experience(self) -> str:
        """Where it fails; what each alarm is, and how often it was right."""
        there = " or ".join(map(self._region, self._said))
        texts = [f"it fails where {there}"] if there else []
        texts += [f"for {name} false alarms a day {self.of(k)}" for name, k in self.alarms.items()]
        return "; ".join(texts)

    @property
    def alarms(self) -> dict[str, int]:
        """Those that differ: by all rates that one is for, in words, the last of these."""
        groups = (list(group) for _, group in groupby(range(len(self.held_out)), self.of))
        return {", ".join(f"{RATES[k]:g}" for k in rates): rates[-1] for rates in groups}

    def of(self, rate: int) -> str:
        """What the alarm for one of `RATES` is, and how often it was right, in words."""
        right, false, failures, kind = self.held_out[rate].tolist()
        if kind == _NO_KIND:
            return self.alarm_in_words if failures == 1.0 else "none for so few surely beats chance"
        plain = "plain thresholds do as well: " * (kind == _PLAIN)
        record = f"{right:.0f} of {failures:.0f} failures foreseen, {false:.0f} false, {_COUNTED}"
        return f"{plain}{self.words(rate)} ({record}; chosen by this count, which flatters it)"

    def start_episode(self) -> None:
        """Nothing was seen yet; what was before, of an episode that nobody ended, went well."""
        self._learn_from(self._seen, failed=False)
        kinds = self.held_out[self.limits[:, _RATE].astype(int), 3]
        self._limits: Floats = self.limits[self.limits[:, _KIND] == kinds]
        # Variables smoothed once and twice; rows since limits were passed, and not; what is on.
        self._now: tuple[Any, ...] = None, *np.zeros((3, len(self.held_out)), int)

    def _next(self, z: Floats) -> tuple[Floats, Flags, tuple[Any, ...]]:
        """Of an observation (m,) the one of `columns`, the rates blind to it, and the state after.

        An alarm that is on stays on as long as a variable of its limits is not seen.
        """
        memory, up, down, on = self._now
        memory = np.full((2, len(z) + len(self.forms)), np.nan) if memory is None else memory.copy()
        columns = self.columns(_nothing(0)._replace(rows=z[None]), memory)
        of, when = self._limits[:, [_OF, _WHEN]].T.astype(int)
        is_unseen = np.isnan(columns.reshape(len(_AHEAD), -1)[when, of])
        passes = (self._passed(columns, self._limits, soon=k)[:, 0] for k in (False, True))
        rates = (self._limits[flags, _RATE].astype(int) for flags in (*passes, is_unseen))
        above, near, blind = (np.bincount(rate, minlength=len(up)) > 0 for rate in rates)
        stays = above | ((near | blind) & (on > 0))
        up, down = np.where(above, up + 1, 0), np.where(stays, 0, down + 1)
        on = (up >= self.hold) | ((on > 0) & (down < self._spans[2]))
        return columns[:, 0], blind, (memory, up, down, on)

    def search(self, situation: Situation, wanted: Action, /, **others: Any) -> Search:
        """Keep what is proposed, as nobody acts; the risk is that of the alarm that is on."""
        column, blind, (*_, on) = self._next(situation.observation)
        rate, risk, reason = self.alarm, 0.0, "no alarm is on"
        evidence = 0.0 if rate is None else float(self.held_out[rate, :2].sum())
        if rate is not None and on[rate]:
            risk = float(self.shares[rate])
            reason = self.reason(situation.observation, column)
        elif rate is not None and blind[rate]:
            risk, reason = math.nan, "whether an alarm would be on is not known"
        low, high = wilson_bounds(risk, evidence) if risk > 0.0 else (0.0, 1.0)
        risks, lows, highs, slack = np.array([[risk], [low], [high], [np.nan]])
        judgement = Judgement(risks, lows, highs, slack, evidence)
        return Search(np.array([float(wanted)]), judgement, 0, reason)

    def judge(self, situation: Situation, actions: ArrayLike, /) -> Judgement:
        """The risk, whatever would be done."""
        judgement = self.search(situation, 0.0).judged
        risk, low, high, slack = (np.repeat(values, np.size(actions)) for values in judgement[:4])
        return Judgement(risk, low, high, slack, judgement.evidence)

    def why(self, judged: Judgement, /) -> str:
        """Why it is dangerous."""
        return "an alarm is on"

    def follow(self, observation: ArrayLike, action: Action, /) -> None:
        """Keep up with what happens; it learns from whole logs alone."""
        self._now = self._next(np.asarray(observation, np.float64))[-1]

    def learn(self, observation: ArrayLike, action: Action, /, *, watched: bool = False) -> None:
        """Keep up with what happens, and what it learns from."""
        self.follow(observation, action)
        if self.log is not None:
            self._seen.append(np.asarray(observation, np.float64))

    def end(self, observation: Floats | None, *, failed: bool, terminated: bool = False) -> None:
        """The episode is over; it learns anew where it learns as it goes, and there is enough."""
        last = [] if observation is None else [observation]
        self._learn_from([*self._seen, *last], failed=failed)
        self.start_episode()

    def _learn_from(self, seen: Sequence[Floats], *, failed: bool) -> None:
        """Add an episode, of whose rows those are left out in which something was not seen."""
        rows = [row for row in seen if np.isfinite(row).all()][-_HELD_ROWS // 4 :]
        if (log := self.log) is not None and rows:
            episodes = np.concatenate([log.rows, rows]), np.append(log.starts, len(log.rows))
            log = Runs(*episodes, np.append(log.failed, failed))
            if len(log.rows) > _HELD_ROWS:  # of failures and of others the latest
                sides = [np.where(side, log.lengths, 0) for side in (log.failed, ~log.failed)]
                recent = [np.cumsum(side[::-1])[::-1] <= _HELD_ROWS // 2 for side in sides]
                log = log.part(np.where(log.failed, *recent))
            count = int(log.failed.sum()), len(log.rows)
            if count[0] and any(np.array(count) > np.multiply(_MORE, self._learnt)):
                new = self._of_log(log, self.dt, self.asked, self.hold, self.labels)
                self.horizon, self.forms, self.limits = new.horizon, new.forms, new.limits
                self.held_out, self._learnt = new.held_out, count
            self.log = log
        self._seen = []

    def savepoint(self) -> Rollback:
        """What takes back all that it learns from now on."""
        return as_now(self, "_seen")

    def save(self, path: Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write what was learnt to a file, with what it learnt from, for people (`provenance`)."""
        log = _nothing(0) if self.log is None else self.log
        arrays = {name: getattr(self, name) for name in ("forms", "limits", "held_out")}
        arrays |= {name: np.asarray(values, np.float64) for name, values in log._asdict().items()}
        names = "dt", "horizon", "hold", "asked", "stated", "bridges"
        settings = {name: getattr(self, name) for name in names}
        settings["learns"] = self.log is not None
        settings |= {name: list(getattr(self.labels, name)) for name in ("names", "units")}
        store.write(path, KIND, settings, arrays, provenance)

    @classmethod
    def load(cls, path: Place) -> Self:
        """Read what was learnt; a ValueError if the file is damaged."""
        settings, arrays = store.read(path, KIND)
        with store.explained(path):
            count = len(settings["names"]) + len(arrays["forms"])
            indices, most = arrays["limits"][:, :_SIGN], (len(RATES), _NO_KIND, count, len(_AHEAD))
            if not ((indices >= 0) & (indices < most) & (indices % 1.0 == 0.0)).all():
                raise ValueError("a limit is of no variable, or of no rate")
            if not (np.isin(arrays["forms"][:, [failure.I, failure.J]], range(count))).all():
                raise ValueError("a form is of no variable")
            rows, starts, failed = (arrays.pop(name) for name in Runs._fields)
            if (np.diff(starts, append=len(rows)) <= 0).any() or (starts[:1] != 0).any():
                raise ValueError("an episode begins beyond its rows")
            log = Runs(rows, starts.astype(np.int64), failed > 0.0)
            keywords: dict[str, Any] = {**settings, **arrays}
            keywords["log"] = log if keywords.pop("learns") else None
            return cls(**keywords)


def span(seconds: float) -> str:
    """A time in words.

    >>> span(90.0), span(1800.0), span(9000.0)
    ('90 s', '30 min', '2.5 h')
    """
    for unit, size, most in (("s", 1.0, 120.0), ("min", 60.0, 7200.0)):
        if seconds < most:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 3600.0:.3g} h"


@kernel
def _look_ahead(
    x: Floats, starts: Ints, keeps: float, ahead: Floats, memory: Floats, found: NDArray[Any]
) -> None:
    """(h, v, T) what x (v, T) is in so many rows at its rate; memory (2, v) is smoothed x."""
    for v in range(x.shape[0]):
        once, twice, place = memory[0, v], memory[1, v], 0
        for t in range(x.shape[1]):
            if place < len(starts) and starts[place] == t:
                once, twice = np.nan, np.nan
                place += 1
            now = x[v, t]
            if not np.isnan(now):
                once = now if np.isnan(once) else keeps * once + (1.0 - keeps) * now
                twice = once if np.isnan(twice) else keeps * twice + (1.0 - keeps) * once
            rate = (once - twice) * (1.0 - keeps) / keeps
            found[0, v, t] = now
            for h in range(1, len(ahead)):
                found[h, v, t] = 2.0 * once - twice + ahead[h] * rate + 0.0 * now
        memory[0, v], memory[1, v] = once, twice


@kernel
def false_times(lasts: float, fails: float, horizon: float) -> tuple[float, bool]:
    """How often an alarm was false, first and after each horizon, as it fails then; if right."""
    count = math.ceil(lasts / horizon - 1e-6)
    false = min(max(math.ceil(min(fails, lasts + horizon) / horizon - 1e-6) - 1, 0), count)
    return false, false < count


@kernel
def _tally(
    above: Flags, on: Flags, rows: Ints, log: Any, spans: Ints, clock: Floats, leads: Floats
) -> float:
    """False alarms of rows (T,) above limits; on (T,) is where one stays, then is; leads (E,).

    Rows (n,) are those of ``on``, which has all above; the clock (T,) counts in rows.
    """
    starts, failed = log
    false, place, horizon, hold, stays = 0.0, 0, spans[0], spans[1], spans[2]
    for e in range(len(starts)):
        end = starts[e + 1] if e + 1 < len(starts) else len(above)
        fails = clock[end - 1] if failed[e] else np.inf
        up, onset, latest, leads[e] = 0, -1, starts[e] - 1, 0.0
        while True:
            t = rows[place] if place < len(rows) and rows[place] < end else end
            up = up if t == latest + 1 else 0
            if onset >= 0:
                over = min(latest + stays, t)
                on[latest + 1 : over] = True
                if over < t or t == end:
                    lead = fails - clock[onset]
                    lasts = (clock[over] if over < end else clock[end - 1] + 1.0) - clock[onset]
                    wrong, is_right = false_times(lasts, lead, horizon)
                    false += wrong
                    if is_right:
                        leads[e] = max(leads[e], min(lead, horizon))
                    onset = -1
            if t == end:
                break
            up = up + 1 if above[t] else 0
            onset = t if onset < 0 and up >= hold else onset
            on[t] = onset >= 0
            latest, place = t, place + 1
    return false


@compiled
def _one_more(
    x: Floats, thresholds: Floats, above: Flags, starts: Ints, failed: Flags, spans: Ints
) -> Floats:
    """(n, j, 2) leads and false alarms of rows ``above`` and where x (n, T) passes one of (n, j).

    Thresholds rise: what passes one has passed those before.
    """
    sums, leads = np.zeros((*thresholds.shape, 2)), np.zeros(len(starts))
    clock, log = np.cumsum(np.ones(len(above))), (starts, failed)
    on, rows = np.zeros(len(above), np.bool_), np.zeros(len(above), np.int64)
    for k in range(len(thresholds)):
        n, rows[:] = len(rows), np.arange(len(rows))
        for j in range(thresholds.shape[1]):
            count, n = n, 0
            for t in rows[:count]:
                on[t] = above[t] or x[k, t] > thresholds[k, j]
                rows[n] = t
                n += on[t]
            sums[k, j, 1] = _tally(on, on, rows[:n], log, spans, clock, leads)
            sums[k, j, 0] = leads.sum()
    return sums

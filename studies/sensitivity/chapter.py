"""The sensitivity study as a chapter: shares, reaches, and what decides."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from evofsm.cli import NONE, Column, Table, count, listed, number, percent, percents
from evofsm.paper import CASES
from studies.old.asked import Asked, failures, tables_of_asked
from studies.old.chapter import Chapter
from studies.old.html import Setting
from studies.old.scores import Share
from studies.sensitivity.designs import NEAR, PAIRS, Design
from studies.sensitivity.figures import sketches
from studies.sensitivity.parameters import PARAMETERS, Parameter, Standing
from studies.sensitivity.setting import SCALES, SPEED_NOISE, Scaling
from studies.sensitivity.shares import worst_sweeps
from studies.sensitivity.spaces import ALL, NEARBY, OPEN, SAME, SPACES, Space, short_name
from studies.sensitivity.study import Reach, Sensitivity

_STANDINGS = {Standing.OPEN: "open", Standing.STATED: "stated", Standing.ADDED: NONE}
# Of a claim that rarely breaks, and one that rarely holds.
_OFTEN, _SELDOM = 0.9, 0.5
# A parameter that may move less than this, of its recovered value, in both directions together.
_LITTLE = 0.1


def tell(study: Sensitivity) -> Chapter:
    """Shares, reaches, strips and maps."""
    asked = list(_what_was_asked(study))
    return Chapter(
        id=study.plan.id,
        title=study.plan.question,
        about=_about(study),
        headline=_headline(study),
        answer=tuple(_answer(study)),
        losses=tuple(_losses(study)),
        fails=failures(asked),
        tables=(*_tables(study), *tables_of_asked(asked)),
        sketches=tuple(sketches(study)),
        plan=tuple(_plan(study)),
        packages=("scipy",),
    )


# -- Words ----------------------------------------------------------------------------------------


def _about(study: Sensitivity) -> str:
    gap, speed, _ = SCALES
    return (
        f"The paper's {len(study.claims)} claims were checked with {len(study.rows):,} settings, "
        "each time on all 80 runs and by the checks of evofsm paper, in the closed-form world. "
        "Sweeps move one parameter away from the recovered setting, maps two. Latin hypercubes "
        "fill all that the paper leaves open, everything at once, and the numbers within "
        f"±{100 * NEAR:g} % of the recovered ones. A share is one of this space, as stated here: "
        "with other ranges it is another. "
        "Noise is white, new in every row and every run; the machine sees it, the driver "
        f"does not; the speeds have {SPEED_NOISE:g} m/s for each metre of the gap. Standardised: "
        f"divided by {gap:g} m and {speed:g} m/s, the radius keeps its number. "
        "That all collisions happen in one state, and that all happen in the dead end, is one "
        "claim in two wordings."
    )


def _interval(share: Share) -> str:
    return f"95 %: {percents(share.low, share.high)} %"


def _what_was_asked(study: Sensitivity) -> Iterator[Asked]:
    for space in (OPEN, NEARBY):
        share = space.share(study)
        yield Asked(
            f"All {len(study.claims)} claims hold together over {space.name}"
            if space is OPEN
            else f"All {len(study.claims)} claims hold together {space.name}",
            f"in most settings (more than {100 * _SELDOM:g} %)",
            f"in {percent(share.value)} of {share.tried:,} ({_interval(share)})",
            share.value > _SELDOM,
        )


def _headline(study: Sensitivity) -> str:
    share = OPEN.share(study)
    often = sum(OPEN.share(study, claim).value > _OFTEN for claim in study.ids)
    return (
        f"All {len(study.claims)} claims hold together in {percent(share.value)} of "
        f"{share.tried:,} settings that the paper leaves open ({_interval(share)}); "
        f"{often or 'none'} of them hold{'s' if often == 1 else ''} in more than "
        f"{100 * _OFTEN:g} %."
    )


def _answer(study: Sensitivity) -> Iterator[str]:
    same, everything, near = (space.share(study) for space in (SAME, ALL, NEARBY))
    yield (
        f"In {same.tried:,} of them the cases end as in the paper, which is a matter of traffic "
        f"and not of the machine; all the other claims hold in {percent(same.value)} of these "
        f"({_interval(same)})."
    )
    yield (
        f"With everything varied all hold in {percent(everything.value)} of {everything.tried:,} "
        f"({_interval(everything)}), within ±{100 * NEAR:g} % of the recovered setting in "
        f"{percent(near.value)} of {near.tried:,} ({_interval(near)})."
    )
    rows = OPEN.rows(study)
    held = np.array([row.held for row in rows])
    states = np.array([row.n_states for row in rows])
    low, high = np.quantile(states, [0.1, 0.9])
    yield (
        f"In the median {count(float(np.median(held)))} of {len(study.claims)} claims hold, with "
        f"{count(float(np.median(states)))} states ({low:.0f} to {high:.0f} in 80 % of settings; "
        f"7 in {percent(float(np.mean(states == 7)))})."
    )
    named = [
        f"{one.label} ({100 * index.value:.0f} %)"
        for one, index in OPEN.ranked(study, held)[:3]
        if index.counts
    ]
    if named:
        yield (
            "How many claims hold is decided first by "
            f"{listed(named)}; in brackets: share of the variance that each explains alone."
        )
    free = [reach.parameter.label for reach in study.reaches if _is_free(reach)]
    if free:
        yield (
            f"Over all that was tried, {listed(free)} alone break"
            f"{'s' if len(free) == 1 else ''} no claim."
        )


def _is_free(reach: Reach) -> bool:
    return reach.low_is_end and reach.high_is_end


def _losses(study: Sensitivity) -> Iterator[str]:
    """All that speaks against the claims, the most important first."""
    share, near = OPEN.share(study), NEARBY.share(study)
    if share.value < _SELDOM:
        yield (
            f"The reproduction is one of few settings: all claims together hold in "
            f"{percent(share.value)} of what the paper leaves open ({_interval(share)})."
        )
    shares = {claim: OPEN.share(study, claim).value for claim in study.ids}
    seldom = [
        f"{short_name(claim)} ({percent(value)})"
        for claim, value in sorted(shares.items(), key=lambda one: one[1])
        if value < _SELDOM
    ]
    if seldom:
        yield f"In less than half of what is left open hold: {listed(seldom)}."
    if near.value < _OFTEN:
        nearby = {claim: NEARBY.share(study, claim).value for claim in study.ids}
        least = min(nearby, key=nearby.__getitem__)
        yield (
            f"Even within ±{100 * NEAR:g} % of the recovered setting all hold in only "
            f"{percent(near.value)}; least often: {short_name(least)} ({percent(nearby[least])})."
        )
    for reach in sorted(study.reaches, key=_room):
        if _room(reach) < _LITTLE:
            yield _narrow(reach)
    yield from _lost_choices(study)
    yield from _lost_to_noise(study)


def _room(reach: Reach) -> float:
    """Width of a reach, in units of the recovered value."""
    recovered = reach.parameter.recovered
    return (reach.high - reach.low) / recovered if recovered > 0.0 else float("inf")


def _narrow(reach: Reach) -> str:
    one = reach.parameter
    sides = [
        f"{side} it {listed(map(short_name, broken))} break{'s' if len(broken) == 1 else ''}"
        for side, broken in (("below", reach.broken_below), ("above", reach.broken_above))
        if broken
    ]
    return (
        f"{one.label[0].upper()}{one.label[1:]} alone may lie between {one.show(reach.low, 4)} "
        f"and {one.show(reach.high, 4)}{one.in_unit} (recovered: {one.show(one.recovered)}): "
        f"{'; '.join(sides)}."
    )


def _lost_choices(study: Sensitivity) -> Iterator[str]:
    orders = study.of(Design.SWEEP, "order")
    kept = [row.setting.order for row in orders if row.holds]
    if len(kept) < len(orders):
        worst = min(orders, key=lambda row: row.held)
        yield (
            f"The order of the cases matters: with {len(kept)} of {len(orders)} orders all claims "
            f"hold; with {', '.join(map(str, worst.setting.order))} only {worst.held} do."
        )
    for row in study.of(Design.SWEEP, "scaling"):
        if row.setting.scaling is Scaling.STANDARDISED and not row.holds:
            yield (
                f"On standardised observations {row.held} of {len(study.claims)} claims hold, with "
                f"{row.n_states} states; broken: {listed(map(short_name, row.broken))}."
            )


def _lost_to_noise(study: Sensitivity) -> Iterator[str]:
    reach = next((one for one in study.reaches if one.parameter.name == "noise"), None)
    sweep = study.of(Design.SWEEP, "noise")
    if reach is None or reach.high_is_end:
        return
    most = max(sweep, key=lambda row: row.n_states)
    yield (
        f"With more than {100 * reach.high:.2g} cm of noise on the gap the first claim breaks: "
        f"{listed(map(short_name, reach.broken_above))}; at {100 * most.setting.noise:.2g} cm "
        f"there are {most.n_states} states instead of 7."
    )


# -- Tables ---------------------------------------------------------------------------------------


def _tables(study: Sensitivity) -> Iterator[Table]:
    """Shares by claim; what breaks and decides each; how far each parameter may move."""

    def share(space: Space) -> Column[str | None]:
        return Column(space.column, lambda claim: space.share(study, claim), _share)

    claims: list[str | None] = [*study.ids, None]
    yield Table.of(
        "In what share of settings each claim holds [%]",
        (Column[str | None]("claim", short_name), *map(share, SPACES)),
        claims,
        "Left open: all that the paper leaves open is drawn. Same ends: those of them in which "
        "the cases end as in the paper. All: everything is drawn, also what the paper states, the "
        f"scaling and noise. Near: numbers within ±{100 * NEAR:g} % of the recovered ones. In "
        "brackets: 95 % interval. The claims in full: "
        + "; ".join(f"{short_name(claim.id)}: {claim.claim}" for claim in study.claims)
        + ".",
        ours=lambda claim: claim is None,
    )
    harm = {claim: worst_sweeps(study.rows, claim)[0] for claim in study.ids}
    decider = {claim: OPEN.decider(study, claim) for claim in study.ids}
    yield Table.of(
        "Which parameter breaks, and which decides, each claim",
        (
            Column[str]("claim", short_name),
            Column("alone most harmful", lambda one: harm[one].label),
            Column("holds [%]", lambda one: harm[one].kept if harm[one].label else None, _brief),
            Column("decides most", lambda one: decider[one][0]),
            Column("explains [%]", lambda one: decider[one][1]),
        ),
        study.ids,
        "Alone most harmful: with all others as recovered, the claim still holds with this share "
        "of the parameter's other values. Decides most: explains the most of the variance of the "
        "verdict where all that the paper leaves open is drawn.",
    )
    yield _parameters(study)


def _share(share: Share) -> str:
    """A share in percent with its interval; small ones with more digits."""
    if not share.tried:
        return NONE
    return f"{_brief(share.value)} ({_brief(share.low)}–{_brief(share.high)})"


def _brief(share: float) -> str:
    """In percent, with a decimal where it is below ten."""
    value = 100.0 * share
    return number(value, 1).removesuffix(".0") if value < 9.95 else number(value, 0)


def _parameters(study: Sensitivity) -> Table:
    reaches = {reach.parameter.name: _reach_text(reach) for reach in study.reaches}

    def holds(one: Parameter) -> str:
        sweep = study.of(Design.SWEEP, one.name)
        counted = f"{sum(row.holds for row in sweep)} of {len(sweep)}"
        return reaches.get(one.name, NONE) if one.is_number else counted

    def explained(header: str, space: Space) -> Column[Parameter]:
        found = dict(space.ranked(study, [row.held for row in space.rows(study)]))
        return Column(header, lambda one: found[one].percent if one in found else None)

    return Table.of(
        "Parameters, how far each alone may move, and what it decides",
        (
            Column("parameter", lambda one: one.label + (f" [{one.unit}]" if one.unit else "")),
            Column("paper", lambda one: _STANDINGS[one.standing]),
            Column("found", lambda one: one.show(one.recovered)),
            Column("tried", lambda one: one.range),
            Column("all hold", holds),
            explained("open [%]", OPEN),
            explained("all [%]", ALL),
        ),
        PARAMETERS,
        "Paper: left open, stated, or not in it. Found: the recovered value. Tried: the plausible "
        "range. All hold: from where to where all claims hold, the others being as recovered; ≤ "
        "and ≥: to the end of the range. Last two columns: share of the variance of the number of "
        "claims that hold which the parameter explains alone, where what the paper leaves open, or "
        "everything, is drawn. Ranges: "
        + "; ".join(f"{one.label}: {one.why}" for one in PARAMETERS)
        + ".",
    )


def _reach_text(reach: Reach) -> str:
    one = reach.parameter
    low, high = one.show(reach.low, 4), one.show(reach.high, 4)
    at_low, at_high = reach.low_is_end and reach.low > 0.0, reach.high_is_end
    return f"{'≤' if at_low else ''}{low} to {'≥' if at_high else ''}{high}"


def _plan(study: Sensitivity) -> Iterator[Setting]:
    plan = study.plan
    yield Setting("seed of draws and noise", str(plan.seed))
    runs = plan.rounds * len(CASES)
    yield Setting("settings in all", f"{len(study.rows):,}, each of {runs} runs and 4 more")
    for space in (OPEN, ALL, NEARBY):
        points = len(space.rows(study))
        yield Setting(space.name, f"{points:,} points of a Latin hypercube")
    yield Setting("sweeps", f"{len(PARAMETERS)}, {plan.levels} values each; all of what is chosen")
    yield Setting("maps", f"{len(PAIRS)}, {plan.side} × {plan.side}")
    yield Setting("search for edges", f"{len(study.of(Design.EDGE))}, by {plan.halvings} halvings")
    yield Setting("world", "in closed form; SUMO agrees with it")

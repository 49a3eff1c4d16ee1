"""Learning from chunks: the same as row by row, and scored as the definitions say."""

import math

import numpy as np
import pytest

from evofsm.cli.inspect import passages
from evofsm.cli.learning import learn_traces
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.divergence import jensen_shannon
from evofsm.fsm.machine import EvolvingFSM
from evofsm.io.logs import Chunk

ACTIONS = IntervalActions(-1.0, 1.0, 0.5, outside="clip")
STARTS = [0, 37, 38, 150]


@pytest.fixture
def trace():
    """Two hundred rows in four episodes, with unknown actions in some."""
    random = np.random.default_rng(7)
    Z = np.cumsum(random.normal(size=(200, 2)), axis=0)
    actions = np.clip(random.normal(scale=0.7, size=200), -1.5, 1.5)
    actions[[36, 77, 149, 199]] = np.nan
    return Z, actions


def machine(**settings):
    return EvolvingFSM(ACTIONS.n_actions, **{"radius": 0.2, "spread": 0.2, **settings})


def chunks(Z, actions, starts=STARTS, dt=0.1, size=1000):
    """The trace in chunks of a size."""
    starts = np.array(starts)
    for first in range(0, len(Z), size):
        inside = starts[(starts >= first) & (starts < first + size)] - first
        rows = slice(first, first + size)
        times = dt * np.arange(len(Z))[rows]
        yield Chunk("made up", Z[rows], actions[rows], times, inside, dt)


def by_hand(Z, actions, starts=STARTS, steps=10):
    """The same one row at a time, with divergences of forecasts and of persistence, and beliefs."""
    fsm = machine()
    one, ahead = [], []
    beliefs, looks = [], {}
    for t, z in enumerate(Z):
        if t in starts:
            fsm.start_episode()
            begun = t
        step = fsm.observe(z)
        beliefs.append(step.belief)
        n = len(step.belief)
        if not math.isnan(step.surprise):
            one.append((step.surprise, jensen_shannon(wide(beliefs[t - 1], n), step.belief)))
        if (t - begun) % steps == 0:
            if t - steps >= begun and t - steps in looks:
                forecasts = [beliefs[t - steps], *looks[t - steps]]
                ahead.append([jensen_shannon(wide(f, n), step.belief) for f in forecasts])
            if not math.isnan(actions[t]):
                i = ACTIONS.encode(actions[t])
                looks[t] = [fsm.predict(i, steps, p) for p in ("marginal", "hold", "observed")]
        if not math.isnan(actions[t]):
            fsm.act(ACTIONS.encode(actions[t]))
    return fsm, np.array(one), np.array(ahead), beliefs


def wide(belief, n):
    return np.pad(belief, (0, n - len(belief)))


@pytest.mark.parametrize("size", [1, 7, 10, 64, 1000])
def test_chunks_of_any_size_learn_what_single_rows_do(trace, snapshot, size):
    learning = learn_traces(chunks(*trace, size=size), machine(), ACTIONS)
    fsm, *_ = by_hand(*trace)
    assert fsm.n_states > 3
    assert snapshot(learning.machine) == snapshot(fsm)


@pytest.mark.parametrize("size", [1, 7, 10, 64, 1000])
def test_skill_is_what_its_definition_says(trace, size):
    learning = learn_traces(chunks(*trace, size=size), machine(), ACTIONS)
    _, one, ahead, _ = by_hand(*trace)
    first, *others = learning.skills
    assert first.forecasts == len(one) > 150
    assert first.divergence == pytest.approx(one[:, 0].mean())
    assert first.persistence == pytest.approx(one[:, 1].mean())
    assert first.skill == pytest.approx(1 - one[:, 0].mean() / one[:, 1].mean())
    assert [skill.policy for skill in others] == ["marginal", "hold", "observed"]
    for k, skill in enumerate(others, 1):
        assert (skill.steps, skill.seconds) == (10, 1.0)
        assert skill.forecasts == len(ahead) > 10
        assert skill.persistence == pytest.approx(ahead[:, 0].mean())
        assert skill.divergence == pytest.approx(ahead[:, k].mean())


@pytest.mark.parametrize("rows_at_once", [1, 3, 50])
@pytest.mark.parametrize(("dt", "steps"), [(0.02, 50), (0.1, 10), (2.0, 0)])
def test_scores_are_the_same_however_many_rows_are_learnt_at_once(
    trace, monkeypatch, rows_at_once, dt, steps
):
    monkeypatch.setattr("evofsm.cli.learning._ROWS_AT_ONCE", rows_at_once)
    learning = learn_traces(chunks(*trace, dt=dt), machine(), ACTIONS)
    _, one, ahead, beliefs = by_hand(*trace, steps=steps or 10)
    first, *others = learning.skills
    assert first.forecasts == len(one)
    assert (first.divergence, first.persistence) == pytest.approx(tuple(one.mean(axis=0)))
    assert len(others) == (3 if steps else 0)
    for k, skill in enumerate(others, 1):
        assert skill.forecasts == len(ahead) > 0
        wanted = ahead[:, k].mean(), ahead[:, 0].mean()
        assert (skill.divergence, skill.persistence) == pytest.approx(wanted)
    assert learning.certainty == pytest.approx(np.mean([belief.max() for belief in beliefs]))


def test_rows_that_no_machine_takes_are_refused(trace):
    Z, actions = trace
    Z[130, 1] = math.nan
    with pytest.raises(ValueError, match="row 30, variable 1: nan"):
        learn_traces(chunks(Z, actions, size=100), machine(), ACTIONS)


def test_counts_say_what_was_learnt(trace):
    Z, actions = trace
    learning = learn_traces(chunks(Z, actions, size=50), machine(), ACTIONS)
    assert learning.rows == 200
    assert learning.episodes == 4
    assert learning.seconds == pytest.approx(0.1 * (200 - 4))
    # After rows 36, 149 and 199 no row of the episode follows anyway; after 37 neither.
    assert learning.transitions == 200 - 4 - 1 == learning.model.uses.sum()
    assert learning.clipped_below == np.nansum(actions < -1.0) > 0
    assert learning.clipped_above == np.nansum(actions > 1.0) > 0
    assert 0.0 < learning.certainty <= 1.0
    assert learning.model.visits.sum() == 200


def test_the_model_knows_its_actions_names_units_and_step(trace):
    model = learn_traces(chunks(*trace), machine(), ACTIONS, ["x", "y"], ["m", "s"]).model
    assert (model.actions, model.names, model.units, model.dt) == (
        ACTIONS,
        ("x", "y"),
        ("m", "s"),
        0.1,
    )


def test_jumps_and_cuts_of_chunks_add_up(trace):
    marked = [chunk._replace(jumps=1, cuts=2) for chunk in chunks(*trace, size=100)]
    learning = learn_traces(marked, machine(), ACTIONS)
    assert (learning.jumps, learning.cuts) == (2, 4)


def test_where_the_action_tells_what_comes_forecasts_beat_persistence():
    # A switch: the action says where to go, so the belief never stays and is always foreseen.
    places = np.random.default_rng(3).integers(0, 2, 4000)
    Z = 10.0 * places[:-1, None].astype(float)
    learning = learn_traces(
        chunks(Z, np.where(places[1:], 0.9, -0.9), [0]), machine(spread=0.01), ACTIONS
    )
    assert learning.model.n_states == 2
    assert learning.skills[0].skill > 0.9
    found = passages(learning.model)
    assert {(p.origin, p.target) for p in found} == {(0, 1), (1, 0)}
    up, down = ACTIONS.encode(0.9), ACTIONS.encode(-0.9)
    rising = int(learning.model.centers[1, 0] > 5.0)
    assert {p.target: p.action for p in found} == {rising: up, 1 - rising: down}
    assert all(p.under_action > 0.95 for p in found)
    happened = sum(places[k] != places[k + 1] for k in range(len(Z) - 1))
    assert sum(p.times for p in found) == pytest.approx(happened, abs=2)
    assert sum(p.taken for p in found) == pytest.approx(2000, rel=0.2)


@pytest.mark.parametrize(("dt", "steps"), [(0.5, 2), (0.3, 3), (0.04, 25), (1.0, 0), (5.0, 0)])
def test_the_longer_forecast_is_of_about_a_second_or_left_out(trace, dt, steps):
    skills = learn_traces(chunks(*trace, dt=dt), machine(), ACTIONS).skills
    assert [skill.steps for skill in skills] == [1, *[steps] * 3 * (steps > 0)]
    assert all(skill.seconds == pytest.approx(skill.steps * dt) for skill in skills)


def test_one_state_has_no_skill_and_no_passages():
    Z = np.zeros((30, 2))
    learning = learn_traces(chunks(Z, np.zeros(30), [0]), machine(), ACTIONS)
    assert learning.model.n_states == 1
    assert all(math.isnan(skill.skill) for skill in learning.skills)
    assert passages(learning.model) == []


def test_an_action_hardly_ever_tried_says_nothing(trace):
    Z, actions = trace
    rare = learn_traces(chunks(Z[:9], actions[:9], [0]), machine(), ACTIONS)
    assert rare.model.n_states > 1
    assert all(p.action is None for p in passages(rare.model))


@pytest.mark.parametrize("starts", [range(200), [0]])
def test_where_nothing_follows_nothing_is_learnt(trace, starts):
    Z, actions = trace
    if len(starts) == 1:
        actions = np.full(200, np.nan)
    with pytest.raises(ValueError, match="no transition could be learnt"):
        learn_traces(chunks(Z, actions, starts), machine(), ACTIONS)


def test_a_failure_on_the_way_leaves_the_machine_as_it_was(trace, snapshot):
    def broken():
        yield from chunks(*trace, size=100)
        raise ValueError("line 77 is bad")

    fsm = machine()
    fsm.learn_many(trace[0][:20], np.zeros(20, int), [0])
    before = snapshot(fsm)
    with pytest.raises(ValueError, match="line 77"):
        learn_traces(broken(), fsm, ACTIONS)
    assert snapshot(fsm) == before


def test_a_machine_with_other_actions_is_refused(trace):
    with pytest.raises(ValueError, match="17 actions, but there are 4 intervals"):
        learn_traces(chunks(*trace), EvolvingFSM.paper(), ACTIONS)

"""The plots show what models, beliefs and drives hold, on any axes, and set no style."""

from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from evofsm import EvolvingFSM, IntervalActions, Novelty, plot
from evofsm.driving import drive, guard_for_family, load_family
from evofsm.guard import Mode

OF_A_MODEL = (plot.states, plot.graph, plot.transitions)


def new():
    return Figure().subplots()


def texts(ax):
    return [text.get_text() for text in ax.texts]


@pytest.fixture(scope="module")
def machine():
    """Three states in the plane; the last one is where an episode failed."""
    machine = EvolvingFSM(n_actions=2, rule=Novelty(radius=1.0))
    machine.learn_many([[0, 0], [3, 0], [0, 0], [3, 4], [0, 0], [3, 4]], [0, 0, 0, 1, 0, 0])
    return machine


@pytest.fixture(scope="module")
def model(machine):
    actions = IntervalActions(low=-1.0, high=1.0, width=1.0)
    return machine.model(names=["gap", "speed"], units=["m", "m/s"], actions=actions)


def driven(mode):
    family = load_family("emergency")
    return drive(guard_for_family(family, mode=mode), family.draw(0, 1))


@pytest.fixture(scope="module")
def saved():
    return driven(Mode.ACT)


def test_they_answer_with_the_axes_they_were_given_and_leave_the_style(machine, model, saved):
    before = dict(matplotlib.rcParams)
    given = [*((draw, model) for draw in OF_A_MODEL), (plot.belief, [machine.belief])]
    for draw, what in (*given, (plot.risk, saved), (plot.accelerations, saved)):
        ax = new()
        assert draw(what, ax) is ax
    assert dict(matplotlib.rcParams) == before


def test_type_has_the_size_and_colour_of_the_users_style(model):
    with matplotlib.rc_context({"font.size": 16.0, "text.color": "#eeeeee"}):
        large = plot.graph(model, new()).texts[-1]
    assert (large.get_fontsize(), large.get_color()) == (14.0, "#eeeeee")


def test_states_stand_where_their_centres_are_and_what_is_on_the_axes_stays_in_view(model):
    ax = new()
    ax.plot([-50.0, 50.0], [-50.0, 50.0])
    plot.states(model, ax, variables=(1, 0), dead_ends=[2])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("speed [m/s]", "gap [m]")
    assert texts(ax) == ["1", "2", "3"]
    low, high = ax.get_xlim()
    assert low <= -50.0 < 50.0 <= high
    alone = plot.states(model, new())
    assert [text.xy for text in alone.texts] == [pytest.approx(tuple(z)) for z in model.centers]


def test_discs_that_would_meet_move_apart():
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=0.01))
    machine.learn_many([[0.0, 0.0], [0.02, 0.0], [9.0, 9.0]], [0, 0, 0])
    ax = plot.states(machine.model(), new())
    drawn = ax.transData.transform([text.xy for text in ax.texts])
    assert np.hypot(*(drawn[0] - drawn[1])) > 13.0 * ax.figure.dpi / 72.0


def test_the_graph_says_how_likely_states_stay_and_dead_ends_have_another_shape(model):
    stays = np.diag(model.averaged_matrix("marginal"))
    ax = plot.graph(model, new(), policy="marginal", dead_ends=[2])
    assert f"stays {100 * stays[0]:.0f} %" in texts(ax)
    assert f"dead end\nstays {100 * stays[2]:.0f} %" in texts(ax)
    assert [line.get_marker() for line in ax.lines] == ["o", "o", "h"]


def test_the_two_likeliest_ways_out_of_each_state_are_dark():
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=0.5))
    machine.learn_many([[0], [9], [0], [9], [3], [0], [6], [9], [0]], [0] * 9)
    arrows = plot.graph(machine.model(), new()).patches
    assert machine.n_states == 4
    assert sum(arrow.get_zorder() == 2.0 for arrow in arrows) == 4 * 2 < len(arrows)


@pytest.mark.parametrize("action", [None, 0, 1])
def test_transitions_are_those_of_the_action_or_of_all(model, action):
    ax = plot.transitions(model, new(), action=action, dead_ends=[2])
    matrix = model.averaged_matrix() if action is None else model.transition_matrices[action]
    assert np.array_equal(ax.images[0].get_array(), matrix)
    assert texts(ax) == [f"{100 * value:.0f} %" for value in matrix.ravel()]
    assert ax.get_title().startswith("all actions" if action is None else f"a({action + 1})  ")
    bold = [tick.get_fontweight() == "bold" for tick in ax.get_xticklabels()]
    assert bold == [False, False, True]
    assert ax.get_xlabel() == "to state (bold: dead end)"


def test_what_a_model_does_not_have_is_named(model):
    for draw in OF_A_MODEL:
        with pytest.raises(ValueError, match="dead_ends name state 3, but there are states 0 to 2"):
            draw(model, new(), dead_ends=[3])
        with pytest.raises(ValueError, match="no states: its machine had observed nothing"):
            draw(EvolvingFSM(n_actions=1).model(), new())
    with pytest.raises(ValueError, match="no variable 2: the model has 2"):
        plot.states(model, new(), variables=(0, 2))
    with pytest.raises(ValueError, match="no action 2: the model has 2"):
        plot.transitions(model, new(), action=2)


def test_many_states_can_be_drawn():
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=0.5))
    Z = np.column_stack([np.arange(30), np.arange(30) ** 2])
    trace = machine.learn_many(Z, np.zeros(30, np.int64), belief=True)
    axes = [draw(machine.model(), new(), dead_ends=[0]) for draw in OF_A_MODEL]
    for ax in (*axes, plot.belief(trace, new())):
        FigureCanvasAgg(ax.figure).draw()


def test_beliefs_over_time_are_a_map_and_a_line():
    rows = np.array([[1.0, 0.0], [0.4, 0.6], [0.3, 0.7]])
    ax = plot.belief(rows, new(), time=[0.0, 0.5, 2.0], dead_ends=[1])
    assert np.array_equal(ax.collections[0].get_array(), rows.T)
    assert np.array_equal(ax.lines[0].get_data(), [[0.0, 0.5, 2.0], [0, 1, 1]])
    assert [tick.get_text() for tick in ax.get_yticklabels()] == ["#1", "#2"]
    assert texts(ax) == ["dead end"]
    assert ax.get_xlabel() == "time [s]"


def test_beliefs_that_do_not_fit_are_refused(machine):
    with pytest.raises(ValueError, match=r"holds no beliefs \(learn_many\(..., belief=True\)"):
        plot.belief(machine.copy().learn_many([[0.0, 0.0]], [0]), new())
    with pytest.raises(ValueError, match=r"belief has shape \(1,\); it must be \(T, n\)"):
        plot.belief([1.0], new())
    with pytest.raises(ValueError, match=r"time has shape \(1,\); 2 beliefs need \(2,\)"):
        plot.belief([[1.0], [1.0]], new(), time=[0.0])


def lines(ax):
    return {line.get_label(): line for line in ax.lines}


def test_risk_is_that_of_the_decisions_and_holds_until_the_end(saved):
    ax = plot.risk(saved, new(), tolerance=0.02)
    revisions, drawn = [decision.revision for decision in saved.decisions], lines(ax)
    assert drawn["proposed"].get_ydata()[:-1].tolist() == [r.risk_proposed for r in revisions]
    assert drawn["executed"].get_ydata()[:-1].tolist() == [r.risk_executed for r in revisions]
    assert drawn["executed"].get_xdata()[-1] == saved.time[-1]
    assert set(drawn["tolerance, 0.02"].get_ydata()) == {0.02}
    highest = max(revision.interval[1] for revision in revisions)
    assert ax.collections[0].get_paths()[0].vertices[:, 1].max() == highest


def test_accelerations_are_what_was_proposed_and_executed(saved):
    ax = plot.accelerations(saved, new())
    drawn = lines(ax)
    assert saved.changed.any()
    assert np.array_equal(drawn["proposed"].get_ydata()[:-1], saved.proposed)
    assert np.array_equal(drawn["executed"].get_ydata()[:-1], saved.executed)


@pytest.mark.parametrize("draw", [plot.risk, plot.accelerations])
def test_a_collision_is_marked_where_there_was_one(draw, saved):
    lost = driven(Mode.SHADOW)
    assert (saved.collided, lost.collided) == (False, True)
    assert lines(draw(lost, new()))["collision"].get_xdata()[0] == lost.time[-1]
    assert "collision" not in lines(draw(saved, new()))


def test_a_drive_that_nobody_judged_is_refused(saved):
    with pytest.raises(ValueError, match="no decision of this drive was judged"):
        plot.risk(driven(Mode.OFF), new())
    with pytest.raises(ValueError, match="nothing was decided"):
        plot.accelerations(replace(saved, decisions=()), new())

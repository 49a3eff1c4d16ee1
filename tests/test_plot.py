"""The plots show what models, guards and logs hold, on any axes, and set no style."""

import importlib
from itertools import product
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, FancyArrowPatch
from studies.judges import run
from studies.systems import Start, make_system

from evofsm import EvolvingFSM, Guard, IntervalActions, Novelty, plot
from evofsm.driving import guard_for_family, load_family
from evofsm.guard import Foresight, LearntRisk

OF_A_MODEL = (plot.states, plot.graph)


def new():
    return Figure().subplots()


def texts(ax):
    return [text.get_text() for text in ax.texts]


@pytest.fixture(scope="module")
def model():
    """Three states in the plane; the last one is where an episode failed."""
    machine = EvolvingFSM(n_actions=2, rule=Novelty(radius=1.0))
    machine.learn_many([[0, 0], [3, 0], [0, 0], [3, 4], [0, 0], [3, 4]], [0, 0, 0, 1, 0, 0])
    actions = IntervalActions(low=-1.0, high=1.0, width=1.0)
    return machine.model(names=["gap", "speed"], units=["m", "m/s"], actions=actions)


def test_few_states_and_many_are_drawn_on_the_axes_that_are_given_and_leave_the_style(model):
    before, machine = dict(matplotlib.rcParams), EvolvingFSM(n_actions=1, rule=Novelty(radius=0.5))
    Z = np.column_stack([np.arange(30), np.arange(30) ** 2])
    machine.learn_many(Z, np.zeros(30, np.int64))
    for draw, drawn in product(OF_A_MODEL, (model, machine.model())):
        ax = new()
        assert draw(drawn, ax, dead_ends=[0]) is ax
        FigureCanvasAgg(ax.figure).draw()
    assert dict(matplotlib.rcParams) == before


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


def test_states_over_rows_have_their_reach_and_their_ways_on_in_frame():
    rule = Novelty(radius=1.0, scales=[2.0, 1.0], spread=0.25)
    machine = EvolvingFSM(n_actions=1, rule=rule)
    rows = np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 0.0], [5.0, 7.0], [30.0, -9.0]])
    machine.learn_many(rows[:4], [0] * 4)
    failed = np.arange(5) == 4
    ax = plot.states(machine.model(), new(), rows=rows, failed=failed, ways=True)
    for wrong in (failed[:3], [5]):
        with pytest.raises((TypeError, ValueError), match="failed"):
            plot.states(machine.model(), new(), rows=rows, failed=wrong)
    legend = [text.get_text() for text in ax.get_legend().get_texts()]
    assert legend == ["observed", "failed", "where a state reaches", "likeliest ways on", "state"]
    ends = zip(ax.axis()[::2], rows.min(0), rows.max(0), ax.axis()[1::2], strict=True)
    assert all(low <= least <= most <= high for low, least, most, high in ends)
    arrows = [patch for patch in ax.patches if isinstance(patch, FancyArrowPatch)]
    assert len(arrows) == 3  # 1 to 2 and back, and on to 3
    only = plot.states(machine.model(), new(), ways=True)
    ellipse = next(patch for patch in only.patches if isinstance(patch, Ellipse))
    assert (ellipse.width, ellipse.height) == (4.0, 2.0)  # the radius, whatever the spread


def test_a_few_spikes_do_not_set_the_axes_and_where_it_alarms_is_tinted():
    rows = np.column_stack([np.linspace(2.0, 7.0, 400), np.linspace(50.0, 90.0, 400)])
    rows = np.vstack([rows, [[7.6, 97.0], [-999.0, 60.0], [5.0, 4000.0]]])
    failed = range(400, len(rows))
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=1.0, scales=[2.0, 20.0]))
    machine.learn_many(rows, [0] * len(rows), [0], [len(rows) - 1])
    limits = np.array([[0, 0, 1, 0, 1, 92.0]])  # of the heat, which is the second variable
    judge = Foresight(60.0, 20, 1, np.empty((0, 14)), limits, np.zeros((1, 4)), ("oil", "heat"))
    table = judge.where(0)
    ax = plot.states(machine.model(), new(), rows=rows, failed=failed, ways=True, alarm=table)
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    assert -5.0 < left < 2.0 < 7.6 < right < 15.0
    assert 0.0 < low < 50.0 < 97.0 < high < 150.0
    said = [text.get_text() for text in ax.get_legend().get_texts()]
    assert said[-2] == "not in view: 2 observed, of which 2 failed"
    assert said[-1] == "at the edge: 2 states that lie beyond it"
    tinted = ax.collections[0].get_paths()[0]
    assert tinted.contains_points([[3.0, 99.0], [3.0, 60.0]]).tolist() == [True, False]
    alone = plot.states(machine.model(), new())  # of a model by itself, too
    assert -20.0 < alone.get_xlim()[0] < alone.get_xlim()[1] < 20.0


def test_the_graph_says_how_likely_states_stay_and_dead_ends_have_another_shape(model):
    stays = np.diag(model.averaged_matrix)
    ax = plot.graph(model, new(), dead_ends=[2])
    assert f"stays {100 * stays[0]:.0f} %" in texts(ax)
    assert f"dead end\nstays {100 * stays[2]:.0f} %" in texts(ax)
    assert [line.get_marker() for line in ax.lines] == ["o", "o", "h"]


def test_what_a_model_does_not_have_is_named(model):
    for draw in OF_A_MODEL:
        with pytest.raises(ValueError, match="state is 3; there are states 0 to 2"):
            draw(model, new(), dead_ends=[3])
        with pytest.raises(ValueError, match="no states: its machine had observed nothing"):
            draw(EvolvingFSM(n_actions=1).model(), new())
        with pytest.raises(TypeError, match=r"a snapshot, such as machine.model\(\)"):
            draw(EvolvingFSM(n_actions=1), new())
    machine = EvolvingFSM(n_actions=1)
    machine.observe([0.0])
    with pytest.raises(ValueError, match="takes two variables; there is one"):
        plot.states(machine.model(), new())
    with pytest.raises(ValueError, match="variable is 2; there are variables 0 to 1"):
        plot.states(model, new(), variables=(0, 2))


@pytest.fixture(scope="module")
def guard():
    """It has learnt where the disc is, and dead ends."""
    system = make_system("disc", "curious")
    told = {"names": system.variables, "units": ["m", "m", "m/s", "m/s"]}
    judge = LearntRisk(system.interval, **system.actions.settings, **told)
    guard = Guard(**system.actions.settings, interval=system.interval, judge=judge)
    for episode in range(16):
        run(system, guard, Start.training(0, 0, episode))
    return guard


def test_what_failed_is_tinted_and_what_is_not_in_view_is_said(guard):
    ax, known = plot.experience(guard, new()), guard.judge.state
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "y [m]")
    survived, failed = (line.get_xydata() for line in ax.lines[:2])
    assert np.array_equal(failed, known.failures[:, :2])
    tinted = ax.collections[0].get_paths()[0]
    assert tinted.contains_points([[0.0, 0.0], [-3.0, 0.0]]).tolist() == [True, False]
    assert not tinted.contains_points(survived).any()
    for ring, centre in zip(ax.patches, known.centres, strict=True):
        assert ring.center == pytest.approx(centre[:2])
    ax = plot.experience(guard, new(), variables=(0, 2))
    said = [text.get_text() for text in ax.get_legend().texts]
    assert said[0] == "survived (blank: nothing was seen)"
    assert said[-1] == "not in view: fails by y [m]"


def test_a_guard_that_has_not_learnt_where_it_fails_is_refused(guard):
    told, fresh = guard_for_family(load_family("emergency")), Guard(n_actions=2, interval=0.1)
    for one in (told, fresh):
        with pytest.raises(ValueError, match="has not learnt where it fails"):
            plot.experience(one, new())
    with pytest.raises(ValueError, match="variable is 4; there are variables 0 to 3"):
        plot.experience(guard, new(), variables=(0, 4))


@pytest.mark.slow
def test_in_the_example_another_controller_is_kept_out(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "examples")
    tried = importlib.import_module("disc").main(tmp_path / "disc.png")
    assert tried[0].failed > 20 > tried[40].failed == 0
    assert tried[40].arrived > tried[0].arrived + 10


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:this guard was not shown to help")  # after four flights
def test_in_the_example_a_quadrotor_hovers_where_it_has_to_and_crashes_alone(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "examples")
    example = importlib.import_module("quadrotor")
    weight, still = np.full(4, example.MASS * example.G / 4), np.zeros(12)
    np.testing.assert_allclose(example.change(still, weight, np.zeros(3)), 0.0, atol=1e-12)
    options = ["--seeds", "1", "--episodes", "4", "--held-out", "3"]
    ((learning, alone, guarded),) = example.main([*options, "--picture", f"{tmp_path}/it.png"])
    assert (len(learning.failed), sum(alone.failed), alone.kept, len(guarded.ways)) == (4, 3, 1, 3)
    assert (tmp_path / "it.png").exists()


def test_a_history_marks_alarms_and_failures_and_leaves_holes_blank():
    when = np.array([0.0, 60.0, 120.0, 9000.0, 9060.0, 9120.0])
    alarms, failures = [0, 0, 2, 1, 1, 1], [0, 0, 2, 0, 0, 1]
    axes = Figure().subplots(2)
    plot.history(axes, when, when[:, None], ["heat"], alarms, failures)
    heat, below = axes
    x, y = heat.lines[-1].get_data()
    whole = np.isfinite(y[1:] + y[:-1])
    assert np.diff(60.0 * x)[whole].max() < 1.5  # minutes: nothing leads through the hole
    assert {*np.round(60.0 * x[np.isfinite(y)])} >= {0.0, 1.0, 2.0, 150.0, 151.0, 152.0}
    right, false = (band.get_paths() for band in heat.collections)
    ends = [path.get_extents().intervalx * 60.0 for path in (*right, *false)]
    assert [end.tolist() for end in ends] == [pytest.approx([150, 152]), pytest.approx([2, 2])]
    foreseen, missed = (60.0 * line.get_xdata() for line in below.lines[-2:])
    assert (foreseen.round().tolist(), missed.round().tolist()) == ([152.0], [2.0])
    assert below.get_xlabel() == "time [hours]"
    labels = [text.get_text() for text in below.get_legend().get_texts()]
    assert labels == ["right alarm", "false alarm", "failure, foreseen", "failure, not foreseen"]


def test_a_history_has_dates_limits_and_what_is_far_out_is_counted():
    when, heat = 1.742e9 + 60.0 * np.arange(400), np.linspace(20.0, 60.0, 400)
    heat[[50, 51]] = -999.0
    axes = Figure().subplots(2)
    alarms, failures = (heat > 55.0).astype(int), (np.arange(400) == 399).astype(int)
    plot.history(axes, when, heat[:, None], ["heat"], alarms, failures, limits=[(0, 55.0)])
    assert -10.0 < axes[0].get_ylim()[0] < 20.0
    assert texts(axes[0]) == ["55", "heat", "2 rows beyond this range"]
    FigureCanvasAgg(axes[0].figure).draw()
    assert axes[1].get_xlabel() == "time"
    assert axes[1].xaxis.get_major_formatter().get_offset() == "2025-Mar-15"
    assert [55.0, 55.0] in [list(line.get_ydata()) for line in axes[0].lines]

"""The paper's figures are drawn whatever the study holds, and show what it holds."""

import matplotlib.text
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from tests.paper.test_paper import drive

from evofsm.paper.figures import draw_case
from evofsm.paper.figures import figures as figures_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def study():
    return drive(rounds=2)


def test_a_case_shows_what_it_was_its_moments_its_states_and_its_collision(study):
    for run in study.last_round:
        figure = draw_case(study, run)
        said = [text.get_text() for text in figure.findobj(matplotlib.text.Text)]
        assert any(text.startswith("leader brakes, ") for text in said)
        assert any(text.startswith("collision, ") for text in said) == (run.case in (1, 4))
        turns = [text for text in said if text.startswith("driver turns")]
        change = {3: ["driver turns normal, 15 s"], 4: ["driver turns aggressive, 10 s"]}
        assert turns == change.get(run.case, [])
        assert {"collisions", *(f"#{state}" for state in range(1, 8))} <= set(said)
        gap, speeds, acceleration, state, action = figure.axes
        drawn = [gap.lines[0], *speeds.lines[:2], acceleration.lines[1], state.lines[0]]
        rows = [*run.episode.observations.T, run.episode.accelerations, run.state, run.action]
        for line, values in zip([*drawn, action.lines[0]], rows, strict=True):
            assert np.array_equal(line.get_ydata(), values)


def test_a_dead_end_is_tinted_as_long_as_a_brake_could_not_be_survived(study):
    """Not as long as one state is recognised, which would look like a warning withdrawn."""
    lasted = []
    for run in study.last_round:
        tint = draw_case(study, run).axes[0].collections[0]
        found = [path.get_extents().intervalx for path in tint.get_paths() if len(path.vertices)]
        times = run.episode.time[study.in_dead_end(run)]
        expected = [(times[0], times[-1])] if len(times) else []  # one stretch in these cases
        np.testing.assert_allclose(found, expected, atol=0.05)
        lasted.append(bool(len(times)))
    assert lasted == [True, False, True, True]


@pytest.mark.parametrize(
    ("changes", "n_states"),
    [
        ({"leader": {"brake_decel": 2.0}}, None),  # no collision, so no dead end
        ({"machine": {"radius": 1e6}}, 1),
        ({"machine": {"spread": 0.02}, "scenario": {"dt": 0.1}}, 41),
        ({"leader": {"brake_speed": 99.0}, "actions": {"width": 1.0}}, None),  # no full brake
    ],
)
def test_any_study_can_be_drawn(changes, n_states):
    study = drive(**changes)
    assert study.dead_end == -1 if n_states is None else study.model.n_states == n_states
    for one in figures_of(study):
        FigureCanvasAgg(one.draw()).draw()

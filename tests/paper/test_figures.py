"""The paper's figures are drawn whatever the study holds, and show what it holds."""

from importlib.resources import files
from pathlib import Path

import matplotlib.style
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from evofsm.driving import KinematicWorld
from evofsm.paper.figures import draw_case, draw_divergence
from evofsm.paper.figures import figures as figures_of
from evofsm.paper.runs import Settings, run_paper

pytestmark = pytest.mark.slow


def study_of(settings, folder, rounds=1):
    path = folder / "settings.toml"
    path.write_text(settings)
    return run_paper(KinematicWorld(), "kinematic", Settings.load(path), rounds=rounds)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return study_of("", tmp_path_factory.mktemp("paper"), rounds=2)


def texts(figure):
    return [text.get_text() for text in figure.findobj(matplotlib.text.Text)]


def test_a_case_shows_what_it_was_its_moments_its_states_and_its_collision(study):
    for run in study.last_round:
        figure = draw_case(study, run)
        said = texts(figure)
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


def test_texts_above_a_case_do_not_meet(tmp_path):
    # The driver changes while the leader brakes, and both shortly before the collision.
    study = study_of("[cases]\nto_aggressive_at = 29.6\n[aggressive]\nlowest = -0.5\n", tmp_path)
    run = study.last_round[3]
    assert run.episode.collided
    with matplotlib.style.context(["default", files("evofsm.paper") / "house.mplstyle"]):
        figure = draw_case(study, run)
        renderer = FigureCanvasAgg(figure).get_renderer()
        marked = [text for text in figure.axes[0].texts if text.get_text().endswith(" s")]
        boxes = [text.get_window_extent(renderer) for text in marked]
    assert len(boxes) == 3
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:i])
        assert figure.bbox.x0 <= box.x0
        assert box.x1 <= figure.bbox.x1


def test_a_dead_end_is_tinted_as_long_as_a_brake_could_not_be_survived(study):
    """Not as long as one state is recognised, which would look like a warning withdrawn."""
    lasted = []
    for run in study.last_round:
        axes = draw_case(study, run).axes[0]
        found = [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in axes.patches]
        times = run.episode.time[study.in_dead_end(run)]
        expected = [(times[0], times[-1])] if len(times) else []  # one stretch in these cases
        np.testing.assert_allclose(found, expected, atol=0.05)
        lasted.append(bool(len(times)))
    assert lasted == [True, False, True, True]


def test_divergence_marks_the_first_forecast_the_largest_and_the_bound(study):
    for axes, run in zip(draw_divergence(study).axes, study.last_round, strict=True):
        lines = {line.get_label(): line.get_ydata() for line in axes.lines}
        assert lines["the run's first forecast"][0] == run.first_surprise
        assert set(lines["the paper's bound, 0.15 bit"]) == {0.15}
        assert lines["largest of them"][0] == np.nanmax(run.surprise) < axes.get_ylim()[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "n_states"),
    [
        ("[leader]\nbrake_decel = 2.0\n", None),  # no collision, so no dead end
        ("[machine]\nradius = 1e6\n", 1),
        ("[machine]\nspread = 0.02\n[scenario]\ndt = 0.1\n", 41),
        ("[leader]\nbrake_speed = 99.0\n[actions]\nwidth = 1.0\n", None),  # no full brake
    ],
)
def test_any_study_can_be_drawn(settings, n_states, tmp_path: Path):
    study = study_of(settings, tmp_path)
    assert study.dead_end == -1 if n_states is None else study.model.n_states == n_states
    for one in figures_of(study):
        assert one.caption.endswith(".")
        FigureCanvasAgg(one.draw()).draw()

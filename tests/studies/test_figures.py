"""The figures are drawn whatever the study holds, and leave nothing behind but their files."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest

from evofsm.driving import measures
from evofsm.driving.world import KinematicWorld
from evofsm.paper.figures import (
    draw_case,
    draw_divergence,
    draw_graph,
    draw_growth,
    draw_matrices,
    draw_space,
    sketches,
)
from evofsm.paper.report.drawing import Drawing, draw_all
from evofsm.paper.runs import PaperStudy, run_paper
from evofsm.paper.settings import Settings
from evofsm.plot.style import house_style

pytestmark = pytest.mark.slow

_NAMES = [
    *(f"case-{case}" for case in (1, 2, 3, 4)),
    "divergence",
    "growth",
    "space",
    "graph",
    "matrices",
]


def _study(settings: str, folder: Path, rounds: int = 1) -> PaperStudy:
    path = folder / "settings.toml"
    path.write_text(settings)
    return run_paper(KinematicWorld(), "kinematic", Settings.load(path), rounds=rounds)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> PaperStudy:
    return _study("", tmp_path_factory.mktemp("paper"), rounds=2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("drawn") / "made" / "when missing"


@pytest.fixture(scope="module")
def drawings(study: PaperStudy, folder: Path) -> list[Drawing]:
    return draw_all(list(sketches(study)), folder)


def _texts(figure: matplotlib.figure.Figure) -> list[str]:
    texts = figure.findobj(matplotlib.text.Text)
    return [text.get_text() for text in texts if text.get_text()]


@pytest.mark.slow
def test_every_figure_is_a_png_and_an_svg_of_some_size(
    drawings: list[Drawing], folder: Path
) -> None:
    assert [drawing.name for drawing in drawings] == _NAMES
    for drawing in drawings:
        png, svg = drawing.paths["png"], drawing.paths["svg"]
        assert png.parent == svg.parent == folder
        assert png.read_bytes().startswith(b"\x89PNG")
        assert png.stat().st_size > 20_000
        assert ElementTree.parse(svg).getroot().tag.endswith("svg")
        assert 20_000 < svg.stat().st_size < 600_000


def test_every_figure_says_what_it_shows(drawings: list[Drawing]) -> None:
    for drawing in drawings:
        assert drawing.title
        assert drawing.caption.endswith(".")
        assert drawing.alt.endswith(".")
    assert "collision (solid" in drawings[0].caption
    assert "collision (solid" not in drawings[1].caption
    assert "Tinted: a dead end, by an oracle" in drawings[0].caption
    assert "Tinted" not in drawings[1].caption


def test_the_same_study_gives_the_same_files(
    study: PaperStudy, drawings: list[Drawing], tmp_path: Path
) -> None:
    with house_style():
        draw_growth(study).savefig(tmp_path / "again.svg", metadata={"Date": None})
    growth = next(drawing for drawing in drawings if drawing.name == "growth")
    assert (tmp_path / "again.svg").read_bytes() == growth.paths["svg"].read_bytes()


def test_the_users_style_neither_matters_nor_changes(study: PaperStudy, tmp_path: Path) -> None:
    def draw(name: str) -> bytes:
        with house_style():
            draw_growth(study).savefig(tmp_path / name)
        return (tmp_path / name).read_bytes()

    plain = draw("plain.png")
    with matplotlib.rc_context({"font.size": 31.0, "lines.linewidth": 9.0, "axes.grid": False}):
        before = dict(matplotlib.rcParams)
        assert draw("shouting.png") == plain
        assert dict(matplotlib.rcParams) == before


@pytest.mark.slow
def test_pyplot_stays_out_and_a_missing_matplotlib_is_named() -> None:
    code = """
import sys
import evofsm.paper.figures
assert "matplotlib.pyplot" not in sys.modules
OURS = ("matplotlib", "studies", "evofsm.plot", "evofsm.paper")
for name in [name for name in sys.modules if name.startswith(OURS)]:
    del sys.modules[name]
sys.modules["matplotlib"] = None
try:
    import evofsm.paper.figures
except ModuleNotFoundError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install '.[plot]'" in done.stdout


def test_a_case_shows_its_moments_its_states_and_its_collision(study: PaperStudy) -> None:
    with house_style():
        figures = {run.case: draw_case(study, run) for run in study.last_round}
    texts = {case: _texts(figure) for case, figure in figures.items()}
    end = study.last_round[3].episode.time[-1]
    assert f"collision, {end:.1f} s" in texts[4]
    assert "driver turns aggressive, 10 s" in texts[4]
    assert "driver turns normal, 15 s" in texts[3]
    for case in (1, 2, 3, 4):
        assert any(text.startswith("leader brakes, ") for text in texts[case])
        assert any(text.startswith("collision, ") for text in texts[case]) == (case in (1, 4))
        assert {f"#{state}" for state in range(1, 8)} <= set(texts[case])
        assert "collisions" in texts[case]
        assert all(np.allclose(axes.get_xlim(), (0.0, 35.0)) for axes in figures[case].axes)


def test_a_case_draws_states_and_actions_as_they_are_counted_from_0(study: PaperStudy) -> None:
    run = study.last_round[0]
    with house_style():
        gap, speeds, acceleration, state, action = draw_case(study, run).axes
    assert np.array_equal(gap.lines[0].get_ydata(), run.episode.observations[:, 0])
    assert np.array_equal(speeds.lines[0].get_ydata(), run.episode.observations[:, 1])
    assert np.array_equal(speeds.lines[1].get_ydata(), run.episode.observations[:, 2])
    assert np.array_equal(acceleration.lines[1].get_ydata(), run.episode.accelerations)
    assert np.array_equal(state.lines[0].get_ydata(), run.state)
    assert np.array_equal(action.lines[0].get_ydata(), run.action)


def test_texts_above_a_case_do_not_meet(tmp_path: Path) -> None:
    # The driver changes while the leader brakes, and both shortly before the collision.
    study = _study("[cases]\nto_aggressive_at = 29.6\n[aggressive]\nlowest = -0.5\n", tmp_path)
    run = study.last_round[3]
    assert run.episode.collided
    with house_style():
        figure = draw_case(study, run)
        renderer = matplotlib.backends.backend_agg.FigureCanvasAgg(figure).get_renderer()
        boxes = [
            text.get_window_extent(renderer)
            for text in figure.axes[0].texts
            if text.get_text().endswith(" s")
        ]
    assert len(boxes) == 3
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:i])
        assert figure.bbox.x0 <= box.x0
        assert box.x1 <= figure.bbox.x1


def test_divergence_marks_the_first_forecast_and_the_bound(study: PaperStudy) -> None:
    with house_style():
        figure = draw_divergence(study)
    assert len(figure.axes) == 4
    for axes, run in zip(figure.axes, study.last_round, strict=True):
        lines = {line.get_label(): line for line in axes.lines}
        assert lines["the run's first forecast"].get_ydata()[0] == run.first_surprise
        assert set(lines["the paper's bound, 0.15 bit"].get_ydata()) == {0.15}
        assert lines["largest of them"].get_ydata()[0] == np.nanmax(run.surprise)
        assert axes.get_ylim()[1] > np.nanmax(run.surprise)


def test_growth_ends_at_the_number_of_states(study: PaperStudy) -> None:
    with house_style():
        whole, overview = draw_growth(study).axes[0], draw_growth(study).axes[-1]
    for axes in (whole, overview):
        assert list(axes.lines[0].get_ydata()) == [*range(study.model.n_states + 1), 7]


def test_only_used_actions_have_a_matrix(study: PaperStudy) -> None:
    with house_style():
        figure = draw_matrices(study)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    used = np.flatnonzero(study.model.uses)
    assert sum(title.startswith("a(") for title in titles) == len(used)
    assert f"a(1)  < −2.2 m/s²\n{study.model.uses[0]:,.0f} transitions" in titles
    for axes, action in zip(figure.axes, used, strict=False):
        assert np.array_equal(axes.images[0].get_array(), study.model.transition_matrices[action])
    assert (
        len(
            {
                (axes.images[0].norm.vmin, axes.images[0].norm.vmax)
                for axes in figure.axes
                if axes.images
            }
        )
        == 1
    )


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
def test_any_study_can_be_drawn(settings: str, n_states: int | None, tmp_path: Path) -> None:
    study = _study(settings, tmp_path)
    if n_states is not None:
        assert study.model.n_states == n_states
    else:
        assert study.dead_end == -1
    with house_style():
        figures = [
            draw_case(study, study.last_round[2]),
            draw_divergence(study),
            draw_growth(study),
            draw_space(study),
            draw_graph(study),
        ]
        for figure in figures:
            figure.savefig(tmp_path / "figure.png", dpi=40)
            assert (tmp_path / "figure.png").stat().st_size > 2_000
    assert any("collisions" in text for text in _texts(figures[0])) == (study.dead_end >= 0)
    assert any("dead end: if the leader braked" in text for text in _texts(figures[0])) == (
        study.settings.scenario.leader.brake_decel > study.settings.decel
    )


def test_a_dead_end_is_tinted_as_long_as_a_brake_could_not_be_survived(study: PaperStudy) -> None:
    """Not as long as one state is recognised, which would look like a warning withdrawn."""
    lasted = []
    for run in study.last_round:
        axes = draw_case(study, run).axes[0]
        to_time = axes.transData.inverted()
        boxes = [patch.get_window_extent() for patch in axes.patches]
        found = [to_time.transform([(box.x0, 0.0), (box.x1, 0.0)])[:, 0] for box in boxes]
        times = run.episode.time[measures.is_dead_end(run.episode.observations, 4.0, 9.0)]
        expected = [[times[0], times[-1]]] if len(times) else []  # one stretch in these cases
        np.testing.assert_allclose(found, expected, atol=0.05)
        lasted.append(bool(len(times)))
    assert lasted == [True, False, True, True]


def test_a_model_without_transitions_can_be_drawn(study: PaperStudy) -> None:
    untaught = replace(study.model, uses=np.zeros_like(study.model.uses), actions=None)
    with house_style():
        assert draw_matrices(replace(study, model=untaught)).axes

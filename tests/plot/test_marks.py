"""The five marks draw what they are given, and nothing where there is nothing."""

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from evofsm import plot


@pytest.fixture
def axes():
    return plot.panels(1, 1, 2.0)[1][0, 0]


def test_panels_are_laid_out_so_that_texts_do_not_meet():
    figure, grid = plot.panels(2, 3, 4.0, sharey=True)
    assert grid.shape == (2, 3)
    assert figure.get_layout_engine() is not None
    assert figure.get_figwidth() == plot.WIDTH


def test_dots_stand_on_their_lines_with_intervals(axes):
    plot.name_lines(axes, ["ours", "ttc"], striped=True, bold=["ours"])
    plot.dots(axes, plot.OURS, [0, 1], [0.5, np.nan], [0.4, np.nan], [0.6, np.nan])
    (line,) = axes.lines
    assert line.get_ydata().tolist() == [0, 1]
    assert line.get_linestyle() == "None"
    bold = [label.get_fontweight() for label in axes.get_yticklabels()]
    assert bold == ["bold", "normal"]
    (low, high), *_ = axes.collections[0].get_segments()
    assert [low[0], high[0]] == [0.4, 0.6]


def test_heat_writes_bright_on_dark_and_dark_on_bright(axes):
    drawn = plot.heat(axes, [[0.0, 1.0], [np.nan, 0.5]], (0.0, 1.0), text="{:.1f}".format)
    texts = {text.get_text(): text.get_color() for text in axes.texts}
    assert texts["1.0"] == "white"  # cividis_r is dark at its end
    assert texts["0.0"] == texts["nan"] == plot.INK
    assert drawn.get_clim() == (0.0, 1.0)
    assert [text.get_position() for text in axes.texts][1] == (1.0, 0.0)


def test_heat_has_as_many_colours_as_steps(axes):
    drawn = plot.heat(axes, [[0, 1, 2]], (-0.5, 2.5), steps=3, edges=([0, 1, 2, 3], [0, 1]))
    assert drawn.cmap.N == 3
    assert not axes.texts


def test_a_curve_has_a_band_only_where_it_is_told_one(axes):
    plot.curves(axes, plot.OURS, [1, 2], [0.5, 0.6], label="ours")
    assert not axes.collections
    plot.curves(axes, plot.OURS, [1, 2], [0.5, 0.6], [0.4, 0.5], [0.6, 0.7])
    assert len(axes.collections) == 1
    assert axes.lines[0].get_label() == "ours"


def test_strips_have_a_line_for_each_name(axes):
    plot.strips(axes, [0.0, 0.5, 1.0], [[True, False], [True, True]], ["a", "b"])
    assert axes.collections[0].get_array().ravel().tolist() == [1, 0, 1, 1]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["a", "b"]


def test_reliability_shows_percent_above_and_cases_below():
    figure = plot.reliability({"one": [(0.1, 0.2, 1000), (1.0, 0.9, 7)], "none": []})
    above, _, below, _ = figure.axes
    assert above.lines[1].get_xydata().tolist() == [[10.0, 20.0], [100.0, 90.0]]
    assert [bar.get_height() for bar in below.patches] == [1000, 7]
    assert [text.get_text() for text in below.texts] == ["1,000", "7"]
    middles = [bar.get_x() + 0.5 * bar.get_width() for bar in below.patches]
    assert middles == pytest.approx([15.0, 95.0])


def test_the_legend_explains_every_look():
    figure, _ = plot.panels(1, 1, 2.0)
    plot.legend(figure, {"ours": plot.OURS, "fixed": plot.FIXED})
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["ours", "fixed"]

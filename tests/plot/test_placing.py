"""Texts and marks are placed where they cover nothing, near what they belong to."""

import numpy as np
from matplotlib.figure import Figure

from evofsm.plot.placing import around, in_points, place_labels, settle
from evofsm.plot.style import write


def ring(width, height):
    return around(width, height, (5.0, 20.0, 60.0))


def boxes(anchors, offsets, sizes):
    centers = np.asarray(anchors) + offsets
    return np.hstack([centers - 0.5 * np.asarray(sizes), centers + 0.5 * np.asarray(sizes)])


def meet(one, other):
    return bool((np.minimum(one[2:], other[2:]) > np.maximum(one[:2], other[:2])).all())


def test_boxes_cover_neither_one_another_nor_what_is_taken_and_stay_in_the_frame():
    anchors = [[50.0, 50.0], [52.0, 50.0], [50.0, 53.0], [3.0, 3.0]]
    sizes = [[30.0, 10.0]] * 4
    taken, frame = [[40.0, 55.0, 60.0, 70.0]], [0.0, 0.0, 100.0, 100.0]
    placed = boxes(anchors, settle(anchors, sizes, ring, taken, frame), sizes)
    for place, box in enumerate(placed):
        assert not any(meet(box, other) for other in (*placed[:place], *np.array(taken)))
        assert (box >= 0.0).all()
        assert (box <= 100.0).all()


def test_a_box_with_room_stays_as_near_as_is_asked():
    (offset,) = settle([[0.0, 0.0]], [[30.0, 10.0]], ring)
    assert np.allclose(offset, [0.0, 10.0])  # above: 5 points and half its height


def test_nothing_is_placed_where_there_is_nothing():
    assert settle(np.empty((0, 2)), np.empty((0, 2)), ring).shape == (0, 2)
    assert place_labels([], [], ring).shape == (0, 2)


def test_labels_of_one_place_are_drawn_apart():
    axes = Figure().subplots()
    notes = [write(axes, "the same place", (0.5, 0.5)) for _ in range(3)]
    sizes = place_labels(notes, in_points(axes, [note.xy for note in notes]), ring)
    assert (sizes > 0.0).all()
    drawn = [note.get_window_extent() for note in notes]
    for place, box in enumerate(drawn):
        assert not any(box.overlaps(other) for other in drawn[:place])

"""Tables of objects: who follows whom, and how far apart they are."""

import math
import re

import numpy as np
import pytest

from evofsm.io.traces import LogColumns, read_traces

HEADER = "id,t,x,y,vx,vy,length,lane"


def episodes(path, **columns):
    """Every episode as (observations, actions, times)."""
    found = []
    for chunk in read_traces([str(path)], LogColumns(**columns)):
        ends = [*chunk.starts[1:], len(chunk.times)]
        for start, end in zip(chunk.starts, ends, strict=True):
            part = slice(start, end)
            found.append((chunk.observations[part], chunk.actions[part], chunk.times[part]))
    return found


def write(path, rows, header=HEADER):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def refusal(path):
    with pytest.raises(ValueError, match=re.escape(str(path))) as caught:
        episodes(path)
    return str(caught.value)


def test_gap_is_between_bumpers_and_the_action_is_what_came_next(tmp_path):
    rows = []
    for k in range(3):
        rows += [
            ("a", 0.1 * k, 50 + k, 0, 10, 0, 6, 1),
            ("b", 0.1 * k, 20 + 2 * k, 0, 20 - k, 0, 4, 1),
        ]
    ((observations, actions, times),) = episodes(write(tmp_path / "a.csv", rows))
    assert observations.tolist() == [[25.0, 20.0, 10.0], [24.0, 19.0, 10.0], [23.0, 18.0, 10.0]]
    assert actions[:2] == pytest.approx([-10.0, -10.0])
    assert np.isnan(actions[2])
    assert times == pytest.approx([0.0, 0.1, 0.2])


def test_the_leader_is_the_nearest_one_ahead_on_the_same_lane(tmp_path):
    rows = [
        row
        for t in (0.0, 0.1)
        for row in [
            ("ego", t, 0, 0, 10, 0, 4, 1),
            ("beside", t, 8, 4, 11, 0, 4, 2),
            ("far", t, 60, 0, 12, 0, 4, 1),
            ("near", t, 30, 0, 13, 0, 4, 1),
            ("off the road", t, 10, 0, 14, 0, 4, ""),
        ]
    ]
    found = episodes(write(tmp_path / "a.csv", rows))
    assert {tuple(observations[0]) for observations, _, _ in found} == {
        (26.0, 10.0, 13.0),
        (26.0, 13.0, 12.0),
    }


@pytest.mark.parametrize("turned", [0.0, 0.7, math.pi / 2, math.pi, -2.0])
def test_any_direction_of_the_road_is_alike(tmp_path, turned):
    def row(name, t, along, speed):
        c, s = math.cos(turned), math.sin(turned)
        return (name, t, along * c, along * s, speed * c, speed * s, 5, 7)

    rows = [r for t in (0.0, 0.1) for r in (row("b", t, 0, 10), row("a", t, 25, 12))]
    ((observations, _, _),) = episodes(write(tmp_path / "a.csv", rows))
    assert observations[0] == pytest.approx([20.0, 10.0, 12.0])


def test_who_stands_points_where_it_moved_last_or_where_it_is_said_to(tmp_path):
    rows = [
        row
        for t, v in ((0.0, 1.0), (0.1, 0.0), (0.2, 0.0))
        for row in [("b", t, 0, 0, -v, 0, 4, 1), ("a", t, -20, 0, 0, 0, 4, 1)]
    ]
    ((observations, _, _),) = episodes(write(tmp_path / "a.csv", rows))
    assert observations[:, 0].tolist() == [16.0, 16.0, 16.0]
    told = [(*row[:4], 0, 0, *row[6:], math.pi) for row in rows]
    assert len(episodes(write(tmp_path / "b.csv", told, HEADER + ",heading"))[0][0]) == 3


def test_a_new_leader_is_a_new_episode(tmp_path):
    rows = []
    for k in range(6):
        t = round(0.1 * k, 1)
        rows += [("b", t, 0, 0, 10, 0, 4, 1), ("a", t, 40, 0, 10, 0, 4, 1)]
        rows += [("c", t, 20, 0, 10, 0, 4, 1 if k > 2 else 2)]
    lengths = sorted(len(times) for _, _, times in episodes(write(tmp_path / "a.csv", rows)))
    assert lengths == [3, 3, 3]  # b behind a, then b behind c and c behind a


def test_parquet_is_read_alike(tmp_path):
    polars = pytest.importorskip("polars")
    rows = [("b", t, 0.0, 0.0, 10.0, 0.0, 4.0, 1) for t in (0.0, 0.1)]
    rows += [("a", t, 30.0, 0.0, 9.0, 0.0, 4.0, 1) for t in (0.0, 0.1)]
    rows.sort(key=lambda row: row[1])
    frame = polars.DataFrame(rows, schema=HEADER.split(","), orient="row")
    frame.write_parquet(tmp_path / "a.parquet")
    ((observations, _, _),) = episodes(tmp_path / "a.parquet")
    assert observations[0].tolist() == [26.0, 10.0, 9.0]


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([("a", 0, 0, 0, 1, 0, 4, ""), ("b", 0, 9, 0, 1, 0, 4, "")], "no object is on a lane"),
        ([("a", 0, 0, 0, 1, 0, 4, 1), ("a", 0, 9, 0, 1, 0, 4, 1)], "'a' is there twice"),
        ([("a", 0, 0, 0, 1, 0, 0, 1)], "line 2: the length is 0"),
        ([("a", 1, 0, 0, 1, 0, 4, 1), ("a", 0, 0, 0, 1, 0, 4, 1)], "must run forward"),
        ([("a", 0, "x", 0, 1, 0, 4, 1)], "column 'x'"),
        ([("a", 0, 0, 0, 1, 0, 4, 1)], "no vehicle ever follows another one"),
    ],
)
def test_what_cannot_be_right_is_refused_in_words(tmp_path, rows, said):
    assert said in refusal(write(tmp_path / "a.csv", rows))

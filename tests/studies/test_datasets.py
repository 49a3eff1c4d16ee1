"""Public car-following data in its own layouts: every reader on a small file of the same layout."""

import gzip
import hashlib

import numpy as np
import pytest
from studies.datasets.checksums import find_checksums, verify_checksums
from studies.datasets.episodes import as_chunks, cut
from studies.datasets.layouts import Layout, read_episodes

from evofsm.fsm.machine import EvolvingFSM

ROWS = 40
SECONDS = np.arange(ROWS) / 10.0
FOOT, MPH = 0.3048, 0.44704


def write(path, lines):
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def only(path, layout):
    (episode,) = read_episodes([path], layout)
    return episode


# -- The plain layout -----------------------------------------------------------------------------


def pair_lines(segments=(("v1-v2", 0),), gap=20.0):
    yield "run,pair,segment,time,gap,v_follower,v_leader,a_follower"
    for pair, segment in segments:
        for k in range(ROWS):
            yield f"day,{pair},{segment},{k / 10:.1f},{gap + k},{10 + k},{9 + k},{-k / 10}"


def test_pairs_are_parted_by_segment_and_keep_their_own_acceleration(tmp_path):
    path = tmp_path / "day.csv.gz"
    lines = "\n".join(pair_lines([("v1-v2", 0), ("v1-v2", 1), ("v2-v3", 0)]))
    path.write_bytes(gzip.compress(f"{lines}\n".encode()))
    episodes = list(read_episodes([path]))
    assert [(one.run, one.pair) for one in episodes] == [
        ("day", "v1-v2"),
        ("day", "v1-v2"),
        ("day", "v2-v3"),
    ]
    assert episodes[2].dt == 0.1
    np.testing.assert_allclose(episodes[2].observations[3], [23.0, 13.0, 12.0])
    np.testing.assert_allclose(episodes[2].accelerations[3], -0.3)


def test_a_column_that_is_missing_is_named_with_its_file(tmp_path):
    path = write(tmp_path / "day.csv", ["pair,segment,time,gap", "v1-v2,0,0.0,3.0"])
    with pytest.raises(ValueError, match=r"day\.csv has no column 'v_follower'"):
        list(read_episodes([path]))


def test_a_machine_learns_from_episodes_as_chunks(tmp_path):
    path = write(tmp_path / "day.csv", pair_lines([("v1-v2", 0), ("v2-v3", 0)]))
    machine = EvolvingFSM(n_actions=1)
    chunks = list(as_chunks(read_episodes([path])))
    for chunk in chunks:
        machine.learn_many(chunk.observations, np.zeros(len(chunk.times), int), chunk.starts)
    assert machine.n_states > 0
    assert [chunk.source for chunk in chunks] == ["day, v1-v2", "day, v2-v3"]


# -- Holes, missing values, contact ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("row", "column", "value"), [(30, 0, np.nan), (30, 0, -0.1), (30, 2, np.nan)]
)
def test_an_episode_ends_where_a_value_is_missing_or_no_gap_is_left(row, column, value):
    times, rows = np.arange(60) / 10.0, np.full((60, 3), 10.0)
    rows[row, column] = value
    found = list(cut("run", "pair", times, rows))
    assert [len(one.times) for one in found] == [row, 60 - row - 1]


def test_a_hole_in_time_begins_another_episode_and_short_ones_are_left_out():
    times = np.append(np.arange(10) / 10.0, 5.0 + np.arange(30) / 10.0)
    (found,) = cut("run", "pair", times, np.full((40, 3), 10.0))
    assert found.times[0] == 5.0
    assert len(found.times) == 30


def test_without_accelerations_they_are_the_change_of_speed_to_the_next_row():
    rows = np.full((40, 3), 10.0)
    rows[:, 1] = 20.0 - 0.3 * np.arange(40)
    (found,) = cut("run", "pair", np.arange(40) / 10.0, rows)
    np.testing.assert_allclose(found.accelerations[:-1], -3.0)
    assert np.isnan(found.accelerations[-1])


# -- OpenACC --------------------------------------------------------------------------------------


def openacc_lines():
    yield from ("Date,9,10,2019", "Vehicle_order,A,B,C", "Number_of_vehicles,3", "ACC,1")
    yield "Time,Speed1,Lat1,Lon1,Speed2,Lat2,Lon2,Speed3,IVS1,IVS2"
    for k in range(ROWS):
        third = "" if k == 0 else f"{14 + k}"  # its GNSS comes a moment later
        yield f"{100 + k / 10:.1f},{10 + k},46.8,16.8,{12 + k},46.8,16.8,{third},{20 + k},{30 + k}"


def test_openacc_every_spacing_is_a_pair(tmp_path):
    path = write(tmp_path / "ASta_part1.csv", openacc_lines())
    first, second = read_episodes([path], Layout.OPENACC)
    assert (first.run, first.pair, second.pair) == ("ASta_part1", "v1-v2", "v2-v3")
    np.testing.assert_allclose(first.observations[5], [25.0, 17.0, 15.0])  # 2 follows 1
    assert len(second.times) == ROWS - 1
    assert second.times[0] == pytest.approx(100.1)


def test_openacc_without_its_header_is_refused(tmp_path):
    path = write(tmp_path / "other.csv", ["a,b", "1,2"])
    with pytest.raises(ValueError, match=r"other\.csv: none of its first 20 lines"):
        list(read_episodes([path], Layout.OPENACC))


# -- NGSIM ----------------------------------------------------------------------------------------


def ngsim_lines(preceding="Preceding"):
    yield f"Vehicle_ID,Frame_ID,v_Length,v_Vel,{preceding},Following,Space_Headway"
    for k in range(ROWS):
        yield f"7,{500 + k},15,{40 + k},0,9,0"
        yield f"9,{500 + k},14,{50 + k},7,0,{80 + k}"


@pytest.mark.parametrize("spelling", ["Preceding", "Preceeding"])
def test_ngsim_feet_become_metres_and_the_leaders_length_is_no_gap(tmp_path, spelling):
    episode = only(write(tmp_path / "us-101.csv", ngsim_lines(spelling)), Layout.NGSIM)
    assert episode.pair == "v7-v9"
    assert episode.dt == 0.1
    expected = FOOT * np.array([80.0 + 5 - 15.0, 55.0, 45.0])
    np.testing.assert_allclose(episode.observations[5], expected)


def test_ngsim_two_recordings_in_one_file_are_refused(tmp_path):
    lines = list(ngsim_lines())
    path = write(tmp_path / "both.csv", lines + lines[1:])
    with pytest.raises(ValueError, match=r"both\.csv: vehicle 7 is in frame 500 twice"):
        list(read_episodes([path], Layout.NGSIM))


def test_a_file_in_which_nobody_follows_anybody_is_refused(tmp_path):
    alone = [line for line in ngsim_lines() if not line.startswith("9,")]
    path = write(tmp_path / "alone.csv", alone)
    with pytest.raises(ValueError, match=r"alone\.csv: nobody in it follows anybody"):
        list(read_episodes([path], Layout.NGSIM))


# -- highD ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_highd_the_gap_lies_between_both_boxes_on_either_carriageway(tmp_path, direction):
    write(tmp_path / "01_recordingMeta.csv", ["id,frameRate,locationId", "1,25,2"])
    lines = ["frame,id,x,y,width,height,xVelocity,precedingId"]
    for frame in range(1, 80):
        along = direction * 30.0 * frame / 25.0
        # x is the left edge, whichever way a vehicle drives: the front, if to the left.
        follower = along - (4.0 if direction > 0.0 else 0.0)
        leader = along + direction * 20.0 - (0.0 if direction > 0.0 else 10.0)
        lines.append(f"{frame},1,{follower},8,4.0,2,{direction * 30.0},2")
        lines.append(f"{frame},2,{leader},8,10.0,2,{direction * 29.0},0")
    episode = only(write(tmp_path / "01_tracks.csv", lines), Layout.HIGHD)
    assert episode.dt == pytest.approx(0.04)
    np.testing.assert_allclose(episode.observations, [[20.0, 30.0, 29.0]] * 79)


# -- 100-Car --------------------------------------------------------------------------------------


def hundred_car_row(k, targets):
    """Targets are identity, range [ft], range rate [ft/s], azimuth [rad]."""
    row = ["."] * 80
    row[0], row[1], row[2], row[4] = "8360", str(k), f"{k / 10:.1f}", "45"
    for place, target in enumerate(targets):
        for first, value in zip((20, 34, 48, 62), target, strict=True):
            row[first + place] = str(value)
    return ",".join(row)


@pytest.mark.parametrize("headed", [True, False])
def test_hundred_car_follows_the_nearest_target_on_its_lane(tmp_path, headed):
    aside = (3, 40.0, -2.0, 0.5)  # nearer, but 5.8 m aside
    far = (5, 150.0, 0.0, 0.0)
    lines = [",".join(f"column {k}" for k in range(80))] if headed else []
    lines += [hundred_car_row(k, [aside, (4, 100.0 - k, -10.0, 0.0), far]) for k in range(ROWS)]
    episode = only(write(tmp_path / "near.txt", lines), Layout.HUNDRED_CAR)
    assert episode.pair == "event 8360, target 4"
    speed = 45.0 * MPH
    np.testing.assert_allclose(episode.observations[5], [95 * FOOT, speed, speed - 10 * FOOT])


def test_hundred_car_another_leader_is_another_episode(tmp_path):
    lines = [hundred_car_row(k, [(4 if k < 30 else 6, 100.0, 0.0, 0.0)]) for k in range(60)]
    found = list(read_episodes([write(tmp_path / "near.txt", lines)], Layout.HUNDRED_CAR))
    assert [one.pair for one in found] == ["event 8360, target 4", "event 8360, target 6"]


def test_hundred_car_what_is_no_number_is_named_with_its_line(tmp_path):
    lines = [hundred_car_row(k, [(4, 100.0, 0.0, 0.0)]) for k in range(ROWS)]
    lines[3] = lines[3].replace("45", "fast")
    path = write(tmp_path / "near.txt", lines)
    with pytest.raises(ValueError, match=r"near\.txt, line 4, column 5: 'fast' is no number"):
        list(read_episodes([path], Layout.HUNDRED_CAR))


# -- Checksums ------------------------------------------------------------------------------------


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def manifest(checksum):
    return ["file,split,sha256", f"elsewhere/day.csv,dev,{checksum}"]


def sums(checksum):
    return [f"{checksum} *day.csv"]


LISTS = [("MANIFEST.csv", manifest), ("SHA256SUMS", sums)]


@pytest.mark.parametrize(("name", "lines"), LISTS)
def test_a_file_as_the_list_has_it_is_read(tmp_path, name, lines):
    path = write(tmp_path / "day.csv", pair_lines())
    write(tmp_path / name, lines(sha256(path)))
    assert verify_checksums([path], find_checksums(tmp_path)) == 1
    assert len(list(read_episodes([path]))) == 1


@pytest.mark.parametrize(("name", "lines"), LISTS)
def test_a_file_that_was_changed_is_refused_by_name(tmp_path, name, lines):
    path = write(tmp_path / "day.csv", pair_lines())
    write(tmp_path / name, lines(sha256(path)))
    write(path, pair_lines(gap=21.0))
    with pytest.raises(ValueError, match=r"day\.csv: its SHA-256 is"):
        list(read_episodes([path]))


def test_a_file_that_no_list_names_is_passed_over(tmp_path):
    path = write(tmp_path / "new.csv", pair_lines())
    write(tmp_path / "SHA256SUMS", sums("0" * 64))
    assert verify_checksums([path], find_checksums(tmp_path)) == 0


@pytest.mark.parametrize(
    ("name", "text"), [("MANIFEST.csv", "file,size\na.csv,3"), ("SHA256SUMS", "abc  a.csv")]
)
def test_a_list_that_is_none_is_refused(tmp_path, name, text):
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=name):
        find_checksums(tmp_path)

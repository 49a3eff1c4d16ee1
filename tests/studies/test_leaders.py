"""Leaders' brakes and alarms in shadow mode, counted on small made-up drives."""

import json

import numpy as np
import pytest
from studies.__main__ import application
from studies.real.leaders import TOLD, Limits, run_leaders
from studies.real.tables_of_leaders import leader_tables
from typer.testing import CliRunner

pytestmark = pytest.mark.slow

# When leaders of the pairs brake [s], and how hard [m/s²].
BRAKES = {"a_1": [(3.0, 4.2)], "a_2": [], "b_1": [(3.0, 3.1), (6.0, 2.9)]}
SECONDS = 12.0


def write_run(folder, name, brakes):
    """A pair for every brake, each as long as the others; drivers keep the leader's speed."""
    lines = ["run,pair,segment,time,gap,v_follower,v_leader,a_follower"]
    for pair, (begins, decel) in enumerate(brakes or [(99.0, 1.0)]):
        times = np.arange(0.0, SECONDS, 0.1)
        speed = 25.0 - decel * np.clip(times - begins, 0.0, 2.0)
        did = np.append(np.diff(speed) / 0.1, 0.0)
        lines += [
            f"{name},v{pair}-v{pair + 1},0,{time:.1f},12.0,{v:.3f},{v:.3f},{a:.3f}"
            for time, v, a in zip(times, speed, did, strict=True)
        ]
    (folder / f"{name}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drives")
    for name, brakes in BRAKES.items():
        write_run(folder, name, brakes)
    return folder


@pytest.fixture(scope="module")
def study(folder):
    return run_leaders(folder, Limits(-8.0, 7.0), workers=1)


def test_brakes_are_counted_by_source_and_waves_once(study):
    found = {one.source: one for one in study.braked}
    assert list(found) == ["a", "b", "all"]
    assert [sum(one.brakes.counts) for one in found.values()] == [1, 2, 3]
    assert [one.waves for one in found.values()] == [1, 1, 2]
    assert found["all"].hardest == pytest.approx(4.2, abs=0.05)
    assert found["all"].brakes.hours == pytest.approx(4 * SECONDS / 3600.0)


def test_what_is_told_makes_fewer_alarms_and_the_first_runs_can_be_asked_alone(folder, study):
    shares = {one.told: one.alarms / one.decisions for one in study.alarms if one.source == "all"}
    assert list(shares) == list(TOLD)
    assert shares[TOLD[0]] > shares[TOLD[1]] > shares[TOLD[2]]
    assert shares[TOLD[2]] <= 0.05
    one = run_leaders(folder, Limits(-8.0, 7.0), most=1, workers=1)
    assert {alarms.runs for alarms in one.alarms} == {1}
    assert one.braked == study.braked


def test_in_words_no_number_is_missing_and_bounds_are_rounded_up(study):
    brakes, bins, alarms = leader_tables(study, Limits(-8.0, 7.0))
    assert brakes.rows[-1][:6] == ("all", "3", "0.0", "0", "3", "2")
    assert "none of 3 was harder than the hardest says that at most 63.2 %" in brakes.note
    assert [row[1] for row in bins.rows if row[1] != "0"] == ["1", "1", "1"]
    assert alarms.rows[-1][2] == "480"


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no runs"):
        run_leaders(tmp_path, Limits(), workers=1)


def test_as_a_command_it_prints_tables_or_numbers(folder):
    run = CliRunner().invoke
    command = ["leaders", "--data", str(folder), "--first", "1", "--workers", "1"]
    said = run(application(), command)
    assert said.exit_code == 0
    assert "Alarms in shadow mode" in said.stdout
    told = json.loads(run(application(), [*command, "--json"]).stdout)
    assert [one["source"] for one in told["leaders"]] == ["a", "b", "all"]
    assert {one["told"] for one in told["alarms"]} == set(TOLD)

"""`evofsm learn` and `evofsm inspect`, as a user meets them."""

import json
import math
import os
import random
import re
from pathlib import Path
from unittest.mock import Mock

import pytest
from tests.test_recipes import write

from evofsm import FSMModel, Guard, Novelty, Paper
from evofsm.cli.options import read_with, reading_of
from evofsm.cli.watch.session import watched_log
from evofsm.io import tables


def lines(rows=400, pair="v1-v2"):
    """A drive with two odd actions, and a hole in time after 35 s; it ends in a collision."""
    found = []
    for k in range(rows):
        gap, speed = 20.0 + 8.0 * math.sin(k / 30), 15.0 + math.cos(k / 20)
        action = -0.05 * math.sin(k / 20) * (100 if k in (30, 99) else 1)
        time = k / 10 + (k >= 350)
        row = f"r,{pair},0,{time:.1f},{gap:.3f},{speed:.3f},15,{action:.3f}"
        found.append(f"{row},{int(k >= rows - 10)}")
    return found


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "log.csv"
    header = "run,pair,segment,time,gap,v_follower,v_leader,a_follower,hit"
    path.write_text("\n".join([header, *lines(), *lines(300, "v2-v3"), ""]))
    return path


# -- Learn ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("at_once", [100, 1 << 20])
def test_learn_prints_what_was_read_and_learnt(evofsm, log, monkeypatch, at_once):
    monkeypatch.setattr(tables, "_CSV_BYTES", at_once)
    result = evofsm("learn", log)
    assert (result.exit_code, result.stderr) == (0, "")
    text = " ".join(result.stdout.split())
    for part in (
        "rows 700, one every 0.1 s",
        "episodes 3, together 69.7 s",
        "time jumps 1; each begins an episode",
        "17 intervals of a_follower from -2.5 to 2.5; 2 below and 2 above",
        "gap [m] v_follower [m/s] v_leader [m/s]",
        "#1 20.0",
        "Transitions that matter",
        "Nothing was saved; --out MODEL",
    ):
        assert part in text


@pytest.mark.parametrize(
    ("numbers", "between"), [((0, 1, 2), "-0.5:2.5:1"), ((10, 20, 30), "5:35:10")]
)
def test_it_is_said_which_number_is_which_action_and_which_is_none(evofsm, numbers, between):
    rows = [f"{k},{k % 9},{-9999 if k % 40 == 7 else numbers[k % 3]}" for k in range(200)]
    (path := Path("log.csv")).write_text("\n".join(["time,heat,cmd", *rows]))
    looked = evofsm("learn", path).stdout
    assert f"--action-range {between}" in looked
    assert "; -9999 for none" in looked
    read = "learn", path, "--observe", "heat", "--action", "cmd", "--action-range"
    told = evofsm(*read, between)
    said = ", ".join(f"{number} is a({k + 1})" for k, number in enumerate(numbers))
    assert f"none was beyond; {said}" in " ".join(told.stdout.split())
    assert "warning: 5 numbers of the action are far from all others" in told.stderr
    left_out = evofsm(*read, between, "--no-leader", "cmd==-9999")  # as who knows them says
    assert ("5 rows: a number" in left_out.stdout, left_out.stderr) == (True, "")
    together = evofsm(*read, f"{numbers[0] - 1}:99:50").stdout
    assert f"several are one action (--action-range {between}" in " ".join(together.split())


def test_options_reach_the_machine_and_the_log(evofsm, tmp_path):
    path, model = tmp_path / "log.csv", tmp_path / "model.evofsm"
    rows = [f"{k % 7},{'red' if k % 20 < 10 else 'green'},{k % 3}" for k in range(100)]
    path.write_text("\n".join(["x,light,u", *rows, ""]))
    asked = "learn", path, "--observe", "x,light=red/green", "--action", "u", "--dt", "0.5"
    asked += "--action-range", "0:3:1", "--max-states", 9, "--episode", "", "--out", model
    assert evofsm(*asked).exit_code == 0
    learnt = FSMModel.load(model)
    assert learnt.names == ("x", "light=red", "light=green")
    assert learnt.n_actions == 3
    assert learnt.dt == 0.5
    assert learnt.centers[:, 1].max() == pytest.approx(1 / math.sqrt(2))


def test_json_is_one_document_with_counts_from_zero(evofsm, log, tmp_path):
    path = tmp_path / "model.evofsm"
    learnt = json.loads(evofsm("learn", log, "--json", "--failed", "gap<=0", "--out", path).stdout)
    assert learnt["files"] == [str(log)]
    assert learnt["saved"] == str(path)
    assert (learnt["rows"], learnt["episodes"], learnt["clipped_above"]) == (700, 3, 2)
    shown = json.loads(evofsm("inspect", path, "--json").stdout)
    assert {"file": str(path), **learnt["model"]} == shown
    assert shown["states"][0]["state"] == 0
    assert sum(action["uses"] for action in shown["actions"]) == learnt["transitions"] == 697


def test_transitions_go_from_where_it_was_to_where_it_came(evofsm, refused, tmp_path):
    path, found = tmp_path / "log.csv", []
    asked = "learn", path, "--observe", "x", "--action", "u", "--dt", 1
    for places in ((0, 10, 30), (0, 0, 0)):
        path.write_text("\n".join(["x,u", *(f"{x},0" for x in places * 40), ""]))
        told = evofsm(*asked, "--rule", "novelty", "--scale", "x=2", "--json")
        found.append(json.loads(told.stdout)["model"]["transitions"])
    walk, rest = found
    times = {(one["origin"], one["target"]): one["times"] for one in walk}
    assert times == {(0, 1): 40, (1, 2): 40, (2, 0): 39}
    assert rest == []
    assert "The recognised state never changed." in evofsm(*asked).stdout
    path.write_text("x,u\n0,0\n1,0\n")
    assert "no transition could be learnt" in refused(*asked, "--episode", "x")


OWN = ("--observe", "dist [m],ego_kmh,lead_kmh", "--action", "accel", "--unit", "ego_kmh=km/h")
OWN += ("--unit", "lead_kmh=km/h", "--episode", "trip")


@pytest.fixture
def own(tmp_path):
    """Drives in somebody's own columns, in km/h; each second one ends in a collision."""
    path = tmp_path / "own.csv"
    rows = ["trip,time,dist [m],ego_kmh,lead_kmh,accel,hit"]
    for trip in range(6):
        for k in range(60):
            gap, lead = 22.0 - (0.4 * k if trip % 2 else 0.0), 72.0 - 15.0 * (trip % 2)
            rows.append(f"{trip},{k / 10:.1f},{gap:.2f},72,{lead},{k % 2 / 100},{int(gap <= 0.0)}")
    path.write_text("\n".join([*rows, ""]))
    return path


@pytest.mark.parametrize(
    ("fails", "end", "failures", "rows"),
    [
        *(("gap<=0", end, 1, 10) for end in ("0\n", "-0.1", "0\n4,5,6")),
        *(("gap<=0", "0", 0, 9), ("gap<=0", "4", 0, 10), ("gap<=0", "-", 0, 9)),
        *(("gap>10", "10.5", 0, 9), ("gap>10", "11", 1, 10)),  # of 10.5e-5
    ],
)
def test_a_number_that_is_cut_off_is_no_failure(evofsm, tmp_path, fails, end, failures, rows):
    lines = [f"{k / 10},15,15,0.1,{9 - k}.432" for k in range(9)]
    text = "\n".join(["time,v_follower,v_leader,a_follower,gap", *lines, f"0.9,15,15,0.1,{end}"])
    (tmp_path / "log.csv").write_text(text)
    told = evofsm("learn", tmp_path / "log.csv", "--failed", fails)
    assert f"rows         {rows}," in told.stdout
    assert f"failures     {failures} episode" in told.stdout
    assert ("line 11, column 'gap': '0' has no line end" in told.stderr) == (end == "0")


@pytest.mark.parametrize(
    ("judge", "keys"),
    [
        ("kinematic", ("gap", "v_follower", "v_leader")),
        ("learnt", ("dist [m]", "ego_kmh", "lead_kmh")),
    ],
)
def test_learn_writes_a_guard_that_the_monitor_takes(evofsm, own, tmp_path, judge, keys):
    path, rows = tmp_path / "car.evofsm", tmp_path / "rows.jsonl"
    options = ("--failed", "hit", "--action-range", "-6:-2:0.5", "--judge", judge)
    told = evofsm("learn", own, *OWN, *options, "--guard", path)
    assert f"--guard {path} takes rows of time [s], {keys[0]}" in told.stdout
    for words in ("It judges: fails where dist [m] is below", "% of the log's"):
        assert (words in told.stdout) == (judge == "learnt")
    seen = dict(zip(keys, (3.0, 20.0, 15.8), strict=True))
    odd = {keys[0]: "near"}, {}, {"time": 0.1, keys[1]: 72.0}, {"time": 0.2, keys[0]: 9999}
    sent = [{"time": 0.0, "proposal": 1.0, **seen, **one} for one in odd]
    rows.write_text("".join(json.dumps(one) + "\n" for one in sent))
    answers = evofsm("monitor", rows, "--guard", path).stdout.splitlines()
    wrong, answer, fast, far = map(json.loads, answers)
    assert far["note"].startswith(f"{keys[0]} is 9999, far from all others: a missing value?")
    assert fast["note"] == f"{keys[1]} is above 60 m/s: is that km/h?"
    assert (wrong["about"], wrong["error"]) == (keys[0], 'is "near"; it must be float or null')
    summed = evofsm("monitor", own, *OWN[2:], *options[:2], "--guard", path, "--summary")
    live = evofsm("monitor", own, "--guard", path).stdout  # as CSV
    assert ("decision" in live, "error" in live) == (True, False)
    watched = watched_log(str(own), reading_of(**read_with(path)[0]), guard=Guard.load(path))
    assert watched.system.of_cars == (judge == "kinematic")
    assert "failures   3; 3 in alarm by then, for " in summed.stdout
    assert answer["alarm"]
    assert answer["mode"] == "shadow"
    assert answer["evidence"] > 0
    text = " ".join(evofsm("inspect", path).stdout.split())
    assert "3 episodes ended in one" in text


@pytest.mark.parametrize("names", [("gap", "v_follower", "v_leader"), ("d", "own", "lead")])
def test_columns_that_are_named_in_another_order_are_what_they_are_called(evofsm, tmp_path, names):
    path, guard = tmp_path / "log.csv", tmp_path / "car.evofsm"
    fields = ("time", *names, "a", "hit")
    rows = [f"{k / 10:.1f},{30 - 0.4 * k:.2f},20,16,{k % 2 / 100},{int(k > 75)}" for k in range(80)]
    path.write_text("\n".join([",".join(fields), *rows, ""]))
    asked = "--action", "a", "--failed", "hit", "--observe"
    judge = "--judge", "kinematic" if names[0] == "gap" else "learnt"
    told = ",".join(names[::-1] if names[0] == "gap" else names)
    saved = evofsm("learn", path, *asked, told, "--guard", guard, *judge)
    assert f"takes rows of time [s], {names[0]}" in saved.stdout
    usual, turned = (
        evofsm("monitor", path, "--guard", guard, "--summary", *asked, ",".join(order)).stdout
        for order in (names, names[::-1])
    )
    assert "The worst moments" in usual
    assert turned == usual


@pytest.mark.slow
def test_a_guard_that_refuses_most_of_the_time_is_said_to(evofsm, tmp_path):
    """A tank whose inlet, which nobody sees, opens and closes now and then."""
    path, guard, chance = tmp_path / "tank.csv", tmp_path / "tank.evofsm", random.Random(3)
    rows = ["run,time,level,pump"]
    for run in range(12):
        level, inlet = chance.uniform(0.2, 0.6), False
        for k in range(200):
            pump, inlet = chance.random(), inlet != (chance.random() < 0.1)
            rows.append(f"{run},{k / 2},{level:.4f},{pump:.3f}")
            if level >= 0.9:
                break
            level = max(0.0, level + 0.03 * inlet - 0.02 * pump)
    path.write_text("\n".join([*rows, ""]))
    read = "--action", "pump", "--failed", "level>=0.9"
    to = "--action-range", "0:1:0.1", "--guard", guard
    why = "perhaps what moves the system is not observed (a valve, a set point, a load"
    told = evofsm("learn", path, "--observe", "level", *read, *to)
    assert re.search(rf"the guard refuses \d\d+% of the time: {re.escape(why)}", told.stderr)
    summed = evofsm("monitor", path, "--guard", guard, *read, "--summary").stdout
    assert why in " ".join(summed.split())
    assert "\nBy risk of what was proposed\n" in summed


def test_a_guard_that_could_not_be_taught_is_refused_before_the_work(refused, own, tmp_path):
    options = ("learn", own, *OWN, "--guard", tmp_path / "car.evofsm")
    assert "which there were is not known: --failed" in refused(*options)
    two = ("--observe", "dist [m],ego_kmh", "--judge", "kinematic", "--unit", "ego_kmh=km/h")
    assert "--observe has to name the three columns" in refused(*options[:2], *two, *options[-2:])
    discrete = ("--observe", "dist [m],hit=0/1", "--failed", "hit")
    assert "numbers alone" in refused(*options[:2], *discrete, *options[-2:])


def test_what_no_action_tried_is_said_and_of_one_that_never_moved_there_is_no_guard(
    evofsm, refused, tmp_path
):
    rows = [f"{k},{k % 20},{(40, 55)[k % 3 > 0]},7,{int(k % 20 > 18)}" for k in range(200)]
    (path := tmp_path / "log.csv").write_text("\n".join(["time,level,valve,fixed,hit", *rows]))
    read = "learn", path, "--observe", "level", "--failed", "hit", "--action-range", "0:100:10"
    said = "it was in 2, 40 to 60: what others do is extrapolated"
    assert said in " ".join(evofsm(*read, "--action", "valve").stdout.split())
    guard = "--guard", tmp_path / "guard.evofsm"
    assert "fixed is always the same, so" in refused(*read, "--action", "fixed", *guard)


# -- What goes wrong ------------------------------------------------------------------------------


def test_files_that_are_none_end_with_one_line(evofsm, refused, log, tmp_path, monkeypatch):
    assert refused("learn", "nosuch.csv") == "evofsm: nosuch.csv: no such file or directory"
    assert refused("inspect", "nosuch") == "evofsm: nosuch: no such file or directory"
    assert "is a folder" in refused("learn", tmp_path)
    assert "another program" in refused("inspect", log)
    assert "is named twice" in refused("learn", log, log.parent / ".." / log.parent.name / log.name)
    assert "is no file of evofsm; it was left alone" in refused("learn", log, "--out", log)
    os.mkfifo(tmp_path / "pipe")  # to open it would wait for whoever writes
    assert "pipe is a device, a pipe" in refused("learn", log, "--out", tmp_path / "pipe")
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert "the folder that this runs in is not there" in refused("learn", log, "--out", "model")


def test_ctrl_c_says_so_and_saves_nothing(evofsm, log, tmp_path, monkeypatch):
    monkeypatch.setattr("evofsm.io.logs._Reader.chunks", Mock(side_effect=KeyboardInterrupt))
    result = evofsm("learn", log, "--out", tmp_path / "model")
    assert result.exit_code == 130
    assert "stopped before the end" in result.stderr
    assert not (tmp_path / "model").exists()


def test_failures_are_learnt_and_how_often_they_came_is_said(evofsm, log, tmp_path):
    path = tmp_path / "model"
    text = " ".join(evofsm("learn", log, "--failed", "hit", "--out", path).stdout.split())
    assert "failures 2 episodes ended with hit; 18 rows after them" in text
    assert "failures 2 episodes ended in one" in " ".join(evofsm("inspect", path).stdout.split())
    assert "2 of 3" in " ".join(evofsm("explain", path, "--state", "1").stdout.split())
    evofsm("learn", log, "--failed", "gap<-99", "--out", path)  # nor does the last one fail
    assert "0 of 3" in " ".join(evofsm("explain", path, "--state", "1").stdout.split())
    path = tmp_path / "guard"
    evofsm("learn", log, "--guard", path)  # nor does anything tell of failures
    assert "not known" in " ".join(evofsm("explain", path, "--state", "1").stdout.split())


def test_a_failure_that_no_row_meets_is_said_with_the_range_of_its_column(evofsm, tmp_path):
    path, level = tmp_path / "tank.csv", "level [mm]"
    rows = [f"{k},{500 + 50 * k},0.1,{k == 20}" for k in range(9)]
    path.write_text("\n".join([f"time,{level},u,spilt", *rows, ""]))
    asked = "learn", path, "--observe", level, "--action", "u", "--failed"
    told = evofsm(*asked, f"{level}>=900")
    assert "converts it, before --failed compares it (--unit" in told.stderr
    assert "1 episode ended with" in told.stdout
    told = evofsm(*asked, f"{level}>=900", "--unit", f"{level}=mm").stderr
    assert f"'{level}>=900': {level}, as compared, goes from 0.5 to 0.9 m\n" in told
    assert "no row meets --failed spilt\n" in evofsm(*asked, "spilt").stderr


@pytest.mark.parametrize(("scale", "gap"), [((), 4.0), (("--scale", "gap=8"), 8.0)])
def test_another_rule_is_told_by_its_name(evofsm, log, scale, gap):
    assert evofsm("learn", log, "--rule", "novelty", *scale, "--out", "model").exit_code == 0
    assert FSMModel.load("model").rule == Novelty(1.0, (gap, 2.0, 2.0))


def test_a_rule_of_one_s_own_is_named_by_its_module_or_as_it_is_registered(
    evofsm, refused, log, tmp_path, monkeypatch
):
    write("Add a state rule", tmp_path)
    said = "'coarse'; it must be one of paper, novelty"
    assert said in refused("learn", log, "--rule", "coarse")
    monkeypatch.setattr("evofsm.fsm.rules._RULES", {"paper": Paper, "novelty": Novelty})
    for name in ("my_rule:Coarse", "coarse"):  # which its module has registered
        text = " ".join(evofsm("learn", log, "--rule", name, "--out", "m").stdout.split())
        assert "rule coarse (--rule), apart 2.0" in text
        assert FSMModel.load("m").rule.apart == 2.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--observe", ""], "--observe"),
        (["--observe", "hit=0/2"], "column 'hit': '1' is none of the values"),
        (["--action-range", "1:2"], "write LOW:HIGH:WIDTH"),
        (["--action-range", "0:1:1e-9"], "more than 1000 intervals"),
        (["--horizon", "4 weeks"], "'--horizon': it is '4 weeks'; write how long"),
        (["--dt", "0"], "--dt is 0.0; it must be a positive"),
        (["--dt", "20", "--guard", "new.evofsm"], "20 s from a decision to the next: too long for"),
        (["--out", "/no/such/folder/model"], "there is no folder"),
        (["--failed", "gap<"], "--failed is 'gap<'"),
        (["--failed", "gap<0<1"], "--failed is 'gap<0<1'"),
        (["--failed", "crash"], "no column 'crash'; it has run, pair, segment, time, gap, v_foll"),
        (["--unit", "v=warp"], "--unit is 'v=warp'"),
        (["--unit", "speed=km/h"], "no column that is read is called so"),
        (["--unit", "time=km/h"], "needs a unit of time"),
        (["--scale", "gap=4"], "--scale is for --rule novelty, not paper"),
        (["--rule", "novelty", "--scale", "speed=4"], "--scale names 'speed'; observed are gap"),
        (["--rule", "novelty", "--scale", "gap=0"], "--scale is 'gap=0'; write COLUMN=NUMBER"),
        (["--rule", "novelty", "--observe", "gap,hit"], "difference that counts as 1 in 'hit'"),
        (["--resample", "often"], "--resample is 'often'; write how long, such as 30s"),
        (["--resample", "30s,gap=most"], "NAME=HOW with one of mean, last, max, min"),
        (["--hole", "5 weeks"], "--hole is '5 weeks'; write how long"),
        (["--hole", "1min", "--dt", "1"], "--hole goes by a clock, and --dt stands in for one"),
        (["--where", "gap>"], "--where is 'gap>'; write a column of truth values"),
        (["--where", "gap>9999", "--resample", "30s"], "and --where gap>9999 must hold"),
        (["--action", "", "--tolerance", "0.1"], "--false-a-day counts"),
        (["--false-a-day", "1"], "--false-a-day is of alarms where nobody"),
        (["--horizon", "4h"], "--horizon is of alarms where nobody"),
    ],
)
def test_wrong_options_end_with_one_line(refused, log, options, message):
    assert message in refused("learn", log, *options)

"""Every hint in a message about a log works when it is followed: message, what it advises, read."""

import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import polars
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore


def table(names="time,gap,v_follower,v_leader,a_follower", rows=60, **columns):
    """Text of a CSV: of each column a function of the row, or what it usually has."""
    usual = {
        "time": lambda k: f"{k / 10:.1f}",
        "t": lambda k: f"{k / 10:.1f}",
        "gap": lambda k: f"{20 + math.sin(k / 9):.3f}",
        "v_follower": lambda k: f"{15 + math.sin(k / 7):.3f}",
        "v_leader": lambda k: f"{15 + math.cos(k / 7):.3f}",
        "a_follower": lambda k: f"{math.cos(k / 7) / 0.7:.2f}",
        "u": lambda k: k % 3,
    }
    of_each = [{**usual, **columns}.get(name, lambda k: k % 7) for name in names.split(",")]
    return "\n".join([names, *(",".join(str(of(k)) for of in of_each) for k in range(rows)), ""])


def beside(*across):
    """FCD of two bikes and a car."""
    seen = zip("abc", (50, 49, 20), across, ("bike", "bike", "car"), strict=True)
    cars = [
        f'<vehicle id="{name}" lane="e" pos="{pos}" speed="9" posLat="{lat}" type="{kind}"/>'
        for name, pos, lat, kind in seen
    ]
    steps = (f'<timestep time="{k}">{"".join(cars)}</timestep>' for k in range(5))
    return f"<fcd-export>{''.join(steps)}</fcd-export>"


CARS = "time,gap,v_follower,v_leader,a_follower"
LEVEL = "--observe level --action u"
OWN = "--observe d,v,w --action u --guard car.evofsm"
OF_KMH = table("time,ego_kmh,u"), "--observe ego_kmh --action u"
EPOCH = 17 * 10**17
LAPS = {"time": lambda k: k % 30 / 10, "id": lambda k: k // 30}
#: A log, how it is read, and where in what is said then stands what is to be added; and its value.
OPTIONS = {
    "no leader": (table(gap=lambda k: 9 if k < 20 else ""), "", r"\? (--no-leader end) leaves", ""),
    "less often": (table(gap=lambda k: "" if k % 4 else k), "", r"\? (--hold 0.5) holds", ""),
    "0 is nobody": (
        table("id," + CARS, **LAPS, gap=lambda k: k // 30 and 9 + k),
        "--episode id --failed 'gap<=0'",
        *(r"\? (--no-leader gap==0) leaves", ""),
    ),
    "-1 is nobody": (
        *(table(gap=lambda k: -1 if k % 20 < 4 else 9 + k), ""),
        *(r"\? (--no-leader gap==-1.0) leaves", ""),
    ),
    "65535 is nobody": (
        *(table(gap=lambda k: 65535 if k % 20 < 4 else 9 + k), ""),
        *(r"\? (--no-leader gap==65535.0) leaves", ""),
    ),
    "km/h": (table(v_leader=lambda k: 70 + k / 9), "", r"\? (--unit v_leader=km/h) converts", ""),
    "ms": (table(time=lambda k: 100 * k), "", r"\? (--unit time=ms) converts", ""),
    "ns": (table(time=lambda k: EPOCH + 10**8 * k), "", r"\? (--unit time=ns) converts", ""),
    "called km/h": (*OF_KMH, r"of the SI: (--unit ego_kmh=km/h) converts", ""),
    "called km/h, and right": (*OF_KMH, r"\((--unit ego_kmh=m/s): it is right", ""),
    "no scale": (
        *(table("time,level,u"), LEVEL + " --rule novelty", r": (--scale) level=NUMBER", "level=2"),
    ),
    "no failures": (table("time,d,v,w,u"), OWN, r"cars in pairs (--judge kinematic) needs", ""),
    "no failures of a judge": (
        *(table(gap=lambda k: 30 - k), "--guard car.evofsm --judge learnt"),
        *(r"(--failed 'gap<=0') says it", ""),
    ),
    "beside": (beside(0.6, -0.6, 0), "", r"\? (--vehicle-length bike=5x0.8) says its length", ""),
    "a coarse clock": (table(time=lambda k: k // 20), "", r"and (--dt) stands in", "0.05"),
    "several episodes": (table("id," + CARS, **LAPS), "", r"\? (--episode) names", "id"),
    "another clock": (table(CARS.replace("time", "t")), "", r"\((--time) names the right", "t"),
    "no clock": (table(CARS[5:]), "", r"and (--dt) stands in for a clock", "0.1"),
    "another action": (table("time,gap,v_follower,v_leader,u"), "", r"\((--action) names", "u"),
    "others": (table("time,level,a_follower"), "", r"(--observe) level", "level"),
    "bad rows": (table() + "1,2\n" * 12, "", r"; (--skip-bad) 10 leaves out", "12"),
}


def said(result):
    return " ".join((result.stderr + result.stdout).split())


@pytest.mark.parametrize(("log", "how", "where", "value"), OPTIONS.values(), ids=OPTIONS.keys())
def test_an_option_that_is_advised_mends_it(evofsm, log, how, where, value):
    Path("drive.log").write_text(log)
    asked = ["learn", "drive.log", *shlex.split(how)]
    told = re.search(where, said(evofsm(*asked)))
    added = shlex.split(f"{told[1]} {value}")
    mended = evofsm(*asked, *added)
    assert mended.exit_code == 0, mended.stderr
    assert re.search(where, said(mended)) is None


def test_an_option_that_is_too_much_is_left_out(evofsm):
    Path("drive.csv").write_text(table())
    assert evofsm("learn", "drive.csv").stderr == ""
    Path("fcd.xml").write_text(beside(0, 0, 0))
    asked = "learn", "fcd.xml", "--failed", "crash"
    found = re.search(r"--failed crash \(but with '(\S+)'\)", said(evofsm(*asked, "--dt", 1)))
    assert evofsm(*asked[:-1], found[1]).exit_code == 0
    found = re.search(r"the types are (\w+)", said(evofsm(*asked[:2], "--vehicle-length", "bik=2")))
    assert evofsm(*asked[:2], "--vehicle-length", f"{found[1]}=2").exit_code == 0


def test_rows_are_sorted_as_it_is_advised(evofsm):
    rows = [(k // 2 / 10, k % 2, 0.5) for k in range(80)]
    frame = polars.DataFrame(rows, ["time", "car", "u"], orient="row")
    frame.write_csv("drive.csv")
    asked = "--observe", "car", "--action", "u", "--episode", "car"
    told = said(evofsm("learn", "drive.csv", *asked))
    found = re.search(r"; sort the file by (\w+) and then by (\w+)", told)
    frame.sort(found.groups()).write_csv("drive.csv")
    assert evofsm("learn", "drive.csv", *asked).exit_code == 0


def at(minutes):
    return datetime(2025, 10, 25, 20, tzinfo=UTC) + timedelta(minutes=minutes)


LOOKED_AT = {
    "ts,machine": (lambda k: f"{1_700_000_000 + k // 3 * 60},{'ABC'[k % 3]}", "each machine, but"),
    "Frame_ID,id": (lambda k: f"{k // 3},{k % 3}", "each id, but mixed"),
    "Date": (lambda k: f"{at(k * 60):%m/%d/%Y %H:%M}", "--unit 'Date=%m/%d/%Y %H:%M'"),
    "Stamp": (lambda k: f"{at(k * 60):%d-%b-%y %H:%M}".upper(), "--unit 'Stamp=%d-%b-%y %H:%M'"),
    "Day": (lambda k: f"{45945 + k / 288:.6f}".replace(".", "@"), "--unit Day=d"),
    "Date,Time": (lambda k: f"{at(k):%d/%m/%Y,%H:%M}", "--time Date,Time"),
    "Datum,Uhrzeit": (
        lambda k: f"{at(k - 1):%d.%m.%Y},{at(k):%H:%M}".replace(",00:00", ",24:00"),
        "--time Datum,Uhrzeit",
    ),
    "Elapsed [h]": (lambda k: f"{k / 3600:.6f}".replace(".", "@"), "--unit 'Elapsed [h]=h'"),
    "Timestamp": (lambda k: f"{at(k):%Y%m%d%H%M%S}", "--unit Timestamp=%Y%m%d%H%M%S"),
    "timestamp,roll": (lambda k: f"{12349657 + 60 * k},{k % 5}", "the clock timestamp rows"),
    "Zeit": (lambda k: f"{at(k):%Y-%m-%d %H:%M:%S}@5", "the clock Zeit"),
    "time": (lambda k: 600 - k, "time runs backwards"),
    "__time": (lambda k: k, "--time __time "),
    "time_zone,SimTime": (lambda k: f"1,{k}", "--time SimTime "),
    "read on,Elapsed (s)": (lambda k: f"2025-03-10 06:00:00,{k}", "--time 'Elapsed (s)' "),
    "read on,seconds": (lambda k: f"3/10/2025 6:00:00,{k}", "--time seconds "),
    "_start,at": (lambda k: f"{at(0):%Y-%m-%d %H:%M},{at(k):%Y-%m-%d %H:%M:%S}", "--time at "),
    "t": (lambda k: k + 7200 * (k > 500) + 60 * (k > 550), "rows looked at 600, one every 1 s"),
}


@pytest.mark.parametrize("names", LOOKED_AT)
def test_what_a_first_look_proposes_reads_all_rows(evofsm, names):
    clock, part = LOOKED_AT[names]
    rows = (f"{clock(k)},{k % 7 + 99 * (k in (297, 303))}@5,{k == 300}" for k in range(600))
    text = "\n".join([f"{names},level,f", *rows]).replace(",", ";")
    Path("log.csv").write_text(text.replace("@", ","))  # decimal commas
    looked = evofsm("learn", "log.csv").stdout
    assert part in " ".join(looked.split())
    assert "--where" not in looked
    assert "--resample" not in looked
    before, _, command = looked.partition("to learn from it:\n")[2].rpartition("  evofsm ")
    if before:
        shell(before.strip())
    found = said(evofsm(*shlex.split(command.replace("\\\n", ""))))
    assert "rows 600, one every" in found
    assert "1 episode ended with f==True" in found


def test_a_first_look_takes_no_good_ending_for_a_failure_and_observes_no_outcome(evofsm, refused):
    rows = ["run,step,level,reward,next_level,success,terminated,failed"]
    for run in range(24):
        for k in range(n := 20 + run % 5):
            level, ends = k / 9 * (run % 2) + k % 3 + run % 4, int(k + 1 == n)
            bad = run % 2 * ends
            rows.append(f"{run},{k},{level:.2f},{-bad},{level},{ends - bad},{bad},{run % 2}")
    Path("gym.csv").write_text("\n".join(rows))
    found = " ".join(evofsm("learn", "gym.csv").stdout.split())
    assert "left out reward, next_level, success: how well it went" in found
    assert "--observe level " in found  # nor the label of whole runs, nor a count of rows
    assert "--failed terminated==1 " in found
    asked = "learn", "gym.csv", "--observe", "level", "--action", "", "--dt", 1, "--episode", "run"
    assert "does --failed mark all its rows?" in evofsm(*asked, "--failed", "failed").stderr
    assert "does --failed say the reverse?" in refused(*asked, "--failed", "level>-1")
    bare = "\n".join(row.partition(",")[2] for row in rows)  # which tells no runs
    Path("bare.csv").write_text(bare.replace("step", "time", 1))
    _, _, proposal = evofsm("learn", "bare.csv").stdout.partition("to learn from it:\n")
    before, _, command = proposal.replace("\\\n", "").rpartition("  evofsm ")
    shell(before.strip())
    assert "12 episodes ended with terminated==1" in evofsm(*shlex.split(command)).stdout


def test_a_first_look_observes_what_is_infinite_where_nobody_is_near(evofsm, refused):
    rows = (f"{k // 10},{k % 10},{'inf' if k % 60 < 30 else 6 - k % 60 / 10}" for k in range(600))
    Path("scan.csv").write_text("\n".join(["sec,nanosec,front", *rows]))
    looked = evofsm("learn", "scan.csv")
    assert looked.stderr == ""
    assert re.search(r"--observe \S*front", looked.stdout)
    asked = "learn", "scan.csv", "--observe", "front", "--action", "", "--time", "sec,nanosec"
    assert "sec and nanosec are no date and time of day" in refused(*asked)


@pytest.mark.parametrize(
    ("field", "live"), [(" Fault ", "Fault"), ('"too hot\ntrip"', "too hot\ntrip"), ("TRUE", True)]
)
def test_rows_meet_a_failure_that_is_proposed_in_the_log_and_live(evofsm, field, live):
    rows = (f"{k}, {k % 7},{field if k == 300 else ' FALSE'}" for k in range(600))
    Path("log.csv").write_text("\n".join(["time,level,f", *rows]))
    command = evofsm("learn", "log.csv").stdout.replace("\\\n", "").rpartition("  evofsm ")[2]
    assert "1 episode ended with f==" in said(evofsm(*shlex.split(command)))
    Path("row.json").write_text(json.dumps({"time": 0, "level": 3, "f": live}))
    assert json.loads(evofsm("monitor", "row.json", "--guard", "guard.evofsm").stdout)["failed"]


def test_a_first_look_asks_of_a_clock_that_it_cannot_read(evofsm):
    clocks = {
        "time": (lambda k: f"2025-{62 + k:03}T06:00:00", "time, dates that are not read"),
        "tick_ms": (lambda k: (2**32 - 999_000 + 10_000 * k) % 2**32, "did the clock begin anew?"),
    }
    for name, (clock, said) in clocks.items():
        rows = (f"{clock(k)},{k % 7},{k % 99 == 98}" for k in range(300))
        Path("log.csv").write_text("\n".join([f"{name},level,f", *rows]))
        looked = evofsm("learn", "log.csv").stdout
        assert said in " ".join(looked.split())
        assert f"--time {name}" in looked
        assert "--where" not in looked


@pytest.mark.parametrize("names", ["time,tag,value", "time,entity_id,state", "time,tag,x,quality"])
def test_a_row_of_each_signal_becomes_a_column_as_it_is_advised(evofsm, names):
    more, fan = ",192" * ("quality" in names), "value" in names
    rows = [f"{k // 2},{('level', 'flow')[k % 2]},{k % 7}{more}" for k in range(200)]
    rows += [f"{k},fan,on" for k in range(100, 110) if fan]
    Path("tags.csv").write_text("\n".join([names, *rows]))
    command, again = evofsm("learn", "tags.csv").stdout.splitlines()[-2:]
    shell(command.strip())
    assert "--observe level,flow" in evofsm(*again.split()[1:]).stdout


def test_a_first_look_says_what_it_cannot_tell(evofsm):
    header, rows = "at,heat,at 2,oil,event,oil", []
    for k in range(200):
        event = "LOW" if k % 40 == 39 else ""
        rows.append(f"{at(k):%Y-%m-%d %H:%M},{k % 7},{at(2 * k):%Y-%m-%d %H:%M},{k},{event},1")
    Path("log.csv").write_text("\n".join([header, *rows]))
    looked = " ".join(evofsm("learn", "log.csv").stdout.split())
    assert "a clock, too? at 2; its columns are read at times of at" in looked
    assert "two columns are called oil; each needs its own name" in looked
    assert "a failure? event==LOW (5 times" in looked
    end, *more = "***End_of_Header***", "Date\t2025/03/03\t", "X_Value\tlevel\tComment"
    for tab in ("\t", ""):  # which stands before a comment
        above = "Channels\t1\t", "Samples\t9\t", more[0], end, more[1]
        rows = [f"{k / 10}\t{k % 17}{tab}" for k in range(200)]
        lines = [end, "", *above, *rows[:20], "", *above, *rows[20:40], "", *above, *rows[40:]]
        Path("log.lvm").write_text("\n".join(lines))
        command = evofsm("learn", "log.lvm").stdout.replace("\\\n", "").rpartition("  evofsm ")[2]
        assert "--time X_Value" in command
        found = said(evofsm(*shlex.split(command)))
        assert "rows 200, one every 0.1 s" in found
        assert "episodes 3" in found


def test_signals_of_two_clocks_are_held_as_it_is_proposed(evofsm):
    rows = (f"{k / 10:.1f},,{k % 17}\n{k / 10 + 0.03:.2f},{k % 17}," for k in range(600))
    Path("log.csv").write_text("\n".join(["stamps,heat,oil", *rows]))
    command = evofsm("learn", "log.csv").stdout.replace("\\\n", "").rpartition("  evofsm ")[2]
    assert "--time stamps --hold 0.5 --rule" in " ".join(command.split())
    learnt = json.loads(evofsm(*shlex.split(command), "--json").stdout)
    assert learnt["rows"] >= 599
    assert learnt["seconds"] == pytest.approx(0.1 * (learnt["rows"] - 1))


def test_a_first_look_names_the_cause(evofsm):
    for text, cause in {"": "no rows", '0,"1,200.5"\n1,"1,300.5"\n': "commas between"}.items():
        Path("log.csv").write_text(f"time,level\n{text}")
        assert cause in evofsm("learn", "log.csv").stderr


# -- Files of other kinds -------------------------------------------------------------------------


def shell(command):
    """What a reader does in a terminal, where the Python in a message runs as it stands."""
    names = "header='time,gap,v_follower,v_leader,a_follower'"
    if command.startswith(("numpy.", "polars.")):
        code = command.replace("header='time,gap,...'", names)
        command = shlex.join([sys.executable, "-c", f"import numpy, polars; {code}"])
    if shutil.which(command.split()[0], path=PATH) is None:
        pytest.skip(f"{command.split()[0]} is not installed")
    subprocess.run(command, shell=True, check=True, env=os.environ | {"PATH": PATH})


PATH = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])


def packed(tool, ending):
    def make(text):
        Path("drive.csv").write_text(text)
        shell(f"{tool} drive.csv")
        Path("drive.csv").unlink(missing_ok=True)
        return f"drive.csv.{ending}"

    return make


def written(name, write):
    def make(text):
        write(name, polars.read_csv(text.encode()))
        return name

    return make


def as_utf_16(name, table):
    Path(name).write_text(table.write_csv(), encoding="utf-16")


@pytest.mark.parametrize(
    ("make", "read"),
    [
        (packed("xz", "xz"), "drive.csv"),
        (packed("xz --format=lzma", "lzma"), "drive.csv"),
        (packed("bzip2", "bz2"), "drive.csv"),
        (packed("zstd --rm -q", "zst"), "drive.csv"),
        (written("drive.npy", np.save), "drive.csv"),
        (written("drive.arrow", lambda name, table: table.write_ipc(name)), "drive.parquet"),
        (written("rows.jsonl", lambda name, table: table.write_ndjson(name)), "drive.csv"),
        (written("own.csv", as_utf_16), "drive.csv"),
    ],
)
def test_a_command_that_is_advised_makes_a_file_that_is_read(evofsm, make, read):
    text = table()
    told = evofsm("learn", make(text)).stderr
    shell(told.strip().rpartition(": ")[2])
    assert json.loads(evofsm("learn", read, "--json").stdout)["rows"] == 60


def test_a_bag_of_ros_1_is_converted_and_its_topics_are_told_as_it_is_advised(evofsm):
    store, kind = get_typestore(Stores.ROS1_NOETIC), "std_msgs/msg/Float64"
    with Writer("drive.bag") as bag:
        topic = bag.add_connection("/v", kind, typestore=store)
        for k in range(50):
            message = store.serialize_ros1(store.types[kind](k / 10), kind)
            bag.write(topic, 100_000_000 * k, message)
    shell(evofsm("learn", "drive.bag").stderr.strip().rpartition(": ")[2].replace("FOLDER", "bag"))
    assert "--topics names a file" in evofsm("learn", "bag").stderr
    variables = (f'{name} = "/v.data"' for name in ("gap", "v_follower", "v_leader"))
    topics = "\n".join(['stamp = "header"', "[variables]", *variables])
    Path("topics.toml").write_text(topics)
    asked = "learn", "bag", "--topics", "topics.toml"
    advice = re.search('write (stamp = "received")', evofsm(*asked).stderr)[1]
    Path("topics.toml").write_text(topics.replace('stamp = "header"', advice))
    assert evofsm(*asked).exit_code == 0
    advice = re.search("write --failed '(\\S+)'", evofsm(*asked, "--failed", "gap").stderr)[1]
    assert "1 episode ended with gap>0" in said(evofsm(*asked, "--failed", advice))

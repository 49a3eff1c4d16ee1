"""A machine's log, as plants export them: from what is in it to what a guard of it says."""

import json
import random
import re
import shlex
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from zoneinfo import ZoneInfo

import polars
import pytest
from tests.cli.test_cli_monitor import told
from tests.cli.test_watching import drive

from evofsm import Guard
from evofsm.cli.monitor.decider import Decider
from evofsm.cli.monitor.slots import Slots
from evofsm.cli.monitor.summary import decided_on_log
from evofsm.cli.options import read_with, reading_of
from evofsm.cli.watch.session import watched_log
from evofsm.cli.watch.words import introduce, tell
from evofsm.io import LogColumns, episodes_of, read_traces

VIBRATION, BEARING = "Schwingung, mm/s", "Lagertemperatur °C"
RUNS = "--where", "Drehzahl>100", "--failed", "Status==Störung"
BOTH = "--observe", f'"{VIBRATION}",{BEARING}', "--action", "", "--hole", "5min", *RUNS
TRIPS = "--observe", "heat", "--action", "", "--time", "t", "--failed", "trip"


@pytest.fixture(autouse=True)
def _in_so_wide_a_terminal(monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")


@pytest.fixture
def written(pump):
    """Exports it, in one of several forms."""

    def write(form="german"):
        path, frame, when = "pump.csv", pump(), polars.col("Zeit")
        if form == "parquet":
            path = "pump.parquet"
            frame.with_row_index().write_parquet(path)
        elif form == "codes":  # a clock in ms, and codes
            of = polars.col("Status").replace_strict({"Betrieb": 1, "Störung": 4}, default=0)
            epoch = when.dt.epoch("ms")
            frame.select("Drehzahl", VIBRATION, BEARING, t=epoch, code=of).write_csv(path)
        elif form == "american":
            of_us = when.dt.strftime("%m/%d/%Y %I:%M:%S %p")
            frame.with_columns(of_us).write_csv(path, float_precision=3)
        else:
            dialect = {"separator": ";", "decimal_comma": True, "quote_style": "never"}
            text = frame.with_columns(when.dt.strftime("%d.%m.%Y %H:%M:%S"))
            text = text.write_csv(None, float_precision=3, **dialect)
            text = f"Pumpe 4;;;;\nvom 5.12.;;;;\n{text}" if form == "titles" else text
            if form == "units":  # and how values were made, as loggers write both
                names, _, rows = text.partition("\n")
                told = ";mm/s;mm/s;mm/s;\n;Avg;Avg;Avg;\n"
                text = f"TOA5;CR6;CR6;33;std.09;CPU:pump;1;rows\n{names}\n{told}{rows}"
            Path(path).write_bytes(text.encode("cp1252"))
        return path

    return write


@pytest.mark.parametrize("form", ["titles", "units", "american", "parquet", "codes"])
def test_what_is_in_a_log_is_said_with_a_command_that_learns_from_it(evofsm, written, form):
    path = written(form)
    first = evofsm("learn", path)
    assert (first.exit_code, first.stderr) == (0, "")
    found = " ".join(first.stdout.split())
    failed = "code==4" if form == "codes" else "Status==Störung"
    for part in (f"What {path} holds", "one every 5 s", "by Drehzahl", f"{failed} (7 times"):
        assert part in found
    (command,) = re.findall(r"^  evofsm (learn .*)", first.stdout.replace("\\\n", ""), re.M | re.S)
    learnt = evofsm(*shlex.split(command))
    assert learnt.exit_code == 0, learnt.stderr
    text = " ".join(learnt.stdout.split())
    for part in (
        "one every 20 s",
        "episodes 14,",
        f"7 episodes ended with {failed}",
        "became means of 20 s (--resample 20s,NAME=max",
        "of at most 300 s (--hole) cost a transition each",
        "840 rows: --where Drehzahl>100 does not hold; there an episode ends",
    ):
        assert part in text
    summed = evofsm("monitor", path, "--summary", "--guard", "guard.evofsm")
    assert " 7 of 7 " in summed.stdout
    limit = re.search(rf"{VIBRATION}\s+above\s+([0-9.]+)", summed.stdout)
    assert bool(re.search(r"\d\s+mm/s\s", summed.stdout)) == (form == "units")
    assert 5.0 < float(limit[1]) < 7.1
    assert "warning" not in summed.stderr
    if form in ("titles", "units"):  # the export itself, row by row
        live = evofsm("monitor", path, "--guard", "guard.evofsm", "--text").stdout
        failures = r"^2025-03-1\d [0-9:]+  failure, \S+ \S+ after the alarm$"
        assert len(re.findall(failures, live, re.M)) == 7
        rows, began = Path(path).read_bytes().splitlines(keepends=True), live.find("  alarm: ")
        at = datetime.fromisoformat(live[:began].splitlines()[-1]).strftime("%d.%m.%Y %H:%M")
        cut = max(k for k, row in enumerate(rows) if row.startswith(at.encode())) + 8
        parts = []
        for part in (rows[:cut], rows):  # as it is ended and begun anew in an alarm
            Path("part.csv").write_bytes(b"".join(part))
            words = "--guard", "guard.evofsm", "--state", "state", "--text"
            parts.append(evofsm("monitor", "part.csv", *words))
        assert ("alarm: " in parts[0].stdout, "".join(p.stdout for p in parts)) == (True, live)
        assert re.search(rf"^evofsm: \S+ \S+  alarm.*: {VIBRATION} [0-9.]+", parts[1].stderr, re.M)
        assert re.findall(rf"  alarm: {VIBRATION} [0-9.]+: above", live)
        assert "refused" not in live


def test_units_of_names_are_part_of_the_command_that_is_proposed(evofsm):
    rows = (f"{100 * k},{63 + k * k % 19},{k % 70},{k % 3}" for k in range(300))
    Path("a.csv").write_text("\n".join(["t_ms,ego_kmh,reset_acc_way,acc", *rows, ""]))
    first = evofsm("learn", "a.csv").stdout
    assert "17.5 to 22.222 m/s, from km/h" in first
    assert "an action?      acc, by its name" in first  # which reset_acc_way is not
    assert "one every 0.1 s" in first
    learnt = evofsm(*shlex.split(first.replace("\\\n", "").rpartition("  evofsm ")[2]))
    assert (learnt.exit_code, learnt.stderr) == (0, "")
    assert "converted    t_ms from ms, ego_kmh from km/h" in learnt.stdout


def test_a_guard_s_file_knows_how_its_log_is_read(evofsm, refused, written):
    path = written()
    asked = "learn", path, "--observe", f'"{VIBRATION}"', "--action", "", "--time", "Zeit"
    told = evofsm(*asked)
    assert "is the time in" not in told.stderr  # which is a date
    assert "(a longer --hole bridges them)" in " ".join(told.stdout.split())
    told = evofsm(*asked, *RUNS, "--resample", "30s", "--guard", "guard.evofsm")
    assert told.stderr == ""
    of_guard = "monitor", path, "--summary", "--guard", "guard.evofsm"
    assert "nobody acts" in refused("export", of_guard[-1], "--to", "c99", "--out", "c")
    as_learnt = evofsm(*of_guard, "--json", "--false-a-day", 1)  # the rest the guard's file knows
    assert (as_learnt.exit_code, as_learnt.stderr) == (0, "")
    stated = {row["stated"]: row["is_own"] for row in json.loads(as_learnt.stdout)["alarms"]}
    assert stated == {0.1: False, 0.3: False, 1.0: True, 3.0: False}
    by_half = "--summary", "--observe", f'"{VIBRATION}"', *asked[4:], *RUNS, "--resample", "30s"
    assert "the last 5" in evofsm("monitor", path, *by_half, "--split", 0.5).stdout
    other = evofsm(*of_guard, "--resample", "1min")
    assert "a row every 60 s, and guard.evofsm decides each 30 s: --resample 30s" in other.stderr
    hint = refused(*asked[:3], VIBRATION, *asked[4:])
    assert f"""stands in double quotes: '"{VIBRATION}"'""" in hint


def test_a_first_look_says_what_is_odd_in_a_log(evofsm, refused):
    chance, rows = random.Random(1), []
    for k in range(3000):
        heat = chance.gauss(6.0, 0.2) + 900 * (k % 1000 == 500) - 900 * (k == 7)
        rows.append(f"{k + (k > 2000)},{heat:.2f},{chance.gauss(60, 2):.1f}")
    rows[0] = rows[0].rpartition(",")[0] + ",Bad Input"  # so the column seems to hold texts
    rows[50] = "50,Bad Input,60"
    rows[70], rows[71] = rows[71], rows[70]
    rows.insert(90, rows[90])
    Path("odd.csv").write_text("\n".join(["t,heat,oil", *rows]))
    found = " ".join(evofsm("learn", "odd.csv").stdout.split())
    assert re.search(r"heat -89\d\S+ to 90\S+; 99 % in 5\.\d+ to 6\.\d+, 4 far outside", found)
    (where,) = re.findall(r"\(--where '(heat>\S+ and heat<\S+)' leaves them out", found)
    for part in (
        "bad fields 1 in column 'oil', the first: 'Bad Input'",
        "bad fields 1, the first: odd.csv, line 52, column 'heat': 'Bad Input' is no number",
        "--observe heat,oil",
    ):
        assert part in found
    rows = [f"{k},{k // 3},{k % 40 / 9:.2f},{int(k % 40 == 39)}" for k in range(400)]
    Path("km.csv").write_text("\n".join(["t,km,level,failed", *rows]))
    found = evofsm("learn", "km.csv").stdout
    assert "km: never comes back" in found
    assert "--observe level " in found
    rows = [f"{k % 50},{k},{k % 7}" for k in range(400)]
    Path("laps.csv").write_text("\n".join(["lap_time,frame,heat", *rows]))
    assert "--dt 1 " in evofsm("learn", "laps.csv").stdout
    rows = "0,5", "99999,5", *(f"{k},{k % 7}" for k in range(1, 400))
    Path("late.csv").write_text("\n".join(["t,heat", *rows]))
    found = evofsm("learn", "late.csv").stdout
    assert ("399, after a row of 9" in found, "--skip-bad" in found) == (True, False)
    rows = (f"{k % 28 + 1}-Okt-{k // 28 + 10},{'-' if k % 9 == 5 else k % 7},ö" for k in range(400))
    text = "\n".join(["ts,T_in,of", *rows]).encode()
    Path("okt.csv").write_bytes(text.replace(b"\xb6", b"", 50))  # half letters cost nothing
    found = evofsm("learn", "okt.csv").stdout
    assert [part in found for part in ("--dt 1", "--skip-bad ")] == [False, False]
    assert [part in found for part in ("44 rows, as above", "--time ts ")] == [True, True]
    assert "ts, dates that are not read: --unit says" in " ".join(found.split())
    Path("bare.csv").write_text("10.03.2025 06:00:00;6,5;on\n10.03.2025 06:00:10;6,6;on\n")
    assert "is no header" in refused("learn", "bare.csv")
    read = "learn", "odd.csv", "--action", "", "--time", "t"
    left_out = evofsm(*read, "--observe", "heat", "--where", where)
    assert " rows: --where heat>" in " ".join(left_out.stdout.split())
    assert "(--observe names the right one)" in refused(*read, "--observe", "heated")
    unsaid = evofsm("learn", "odd.csv", "--out", "m.evofsm")
    assert unsaid.exit_code == 2
    assert "say what is observed in odd.csv" in unsaid.stderr


def test_a_later_file_is_read_by_its_own_header_or_refused_with_what_differs(evofsm, refused):
    def write(name, header="t,heat,u\n", row="{t},{heat}.5,{u}\n", step=1):
        rows = (row.format(t=step * k, heat=k % 50, u=k % 3) for k in range(200))
        Path(f"{name}.csv").write_text("".join([header, *rows]))

    def learn(files, *words, how=evofsm):
        return how("learn", *files, "--observe", "heat", "--time", "t", "--action", "u", *words)

    write("a")
    write("again")
    write("own", "u;note;heat;t\n", "{u};on;{heat},5;{t}\n")
    write("lacks", "t,u\n", "{t},{u}\n")
    write("slow", step=60)
    for unit in ("mm", "cm", "degC", "degF"):
        write(unit, f"t,heat,u\ns,{unit},-\n")
    same, own = (json.loads(learn(["a.csv", f], "--json").stdout) for f in ("again.csv", "own.csv"))
    assert own["model"]["states"] == same["model"]["states"]
    assert learn(["mm.csv", "cm.csv"]).exit_code == 0
    for first, other, words, fault in (
        ("a", "lacks", (), "lacks.csv has no column 'heat'"),
        ("a", "slow", (), "slow.csv has a row every 60 s, but a.csv has one every 1 s"),
        ("a", "slow", ("--resample", "2s"), "row every 60 s, and --resample makes one every 2 s"),
        ("degC", "degF", (), "degF.csv: column 'heat' has degF, and degC in the files before"),
        ("a", "mm", (), "mm.csv: column 'heat' has mm, and no unit in the files before"),
        ("mm", "a", (), "no unit, and mm in the files before; --unit heat=mm says one for all"),
    ):
        assert fault in learn([f"{first}.csv", f"{other}.csv"], *words, how=refused)
    assert learn(["mm.csv", "a.csv"], "--unit", "heat=mm").exit_code == 0


@pytest.mark.parametrize("month", [3, 10])
def test_local_time_of_irregular_rows_runs_on_where_summer_time_changes(evofsm, month):
    chance, rows = random.Random(1), []
    at = datetime(2025, month, 29 if month == 3 else 25, 23, 30, tzinfo=UTC)
    for k in range(1500):
        at += timedelta(seconds=5 + chance.uniform(-3, 3) + 30 * (chance.random() < 0.02))
        local = at.astimezone(ZoneInfo("Europe/Berlin"))
        rows.append(f"{local:%d.%m.%Y %H:%M:%S};{k % 9};{int(k == 1400)}")
    Path("night.csv").write_text("\n".join(["Zeit;heat;trip", *rows, ""]))
    assert f"ends or begins 2025-{month:02}" in evofsm("learn", "night.csv").stdout
    asked = "--observe", "heat", "--action", "", "--time", "Zeit", "--failed", "trip"
    told = evofsm("learn", "night.csv", *asked, "--resample", "20s", "--hole", "1min")
    (line,) = told.stderr.splitlines()
    assert "summer time ends or begins; hours run on there" in line
    assert "time jumps" not in told.stdout
    begun = *asked, "--interval", 5, "--hole", "1min"
    live = [json.loads(x) for x in evofsm("monitor", "night.csv", *begun).stdout.splitlines()]
    assert not any("a new episode" in answer.get("note", "") for answer in live)
    hours, ran = live[-1]["hours"], live[-1]["time"] - live[1]["time"]
    assert (hours, ran // 3600) == ((1, 1) if month == 10 else (-1, 3))
    zoned = f"{local:%Y-%m-%dT%H:%M:%S}+01:00;4;0"
    again = *rows[:2], zoned, '{"end": true}', zoned
    Path("night.csv").write_text("\n".join(["Zeit;heat;trip", *again, ""]))
    *_, other, _, again = evofsm("monitor", "night.csv", *begun).stdout.splitlines()
    assert "line 4: is no local time, unlike that of the row before; all have" in other
    assert '"kind":"decision"' in again
    assert "times of day are told in UTC" in again


def test_where_summer_time_ends_rows_that_stand_still_are_none_of_an_hour_before(evofsm):
    at, zone, rows = datetime(2025, 10, 25, 23, 30, tzinfo=UTC), ZoneInfo("Europe/Berlin"), []
    for k in [*range(90), *range(93, 183)]:  # no first ones of the second hour
        local = (at + timedelta(minutes=k)).astimezone(zone)
        rows.append(f"{local:%d.%m.%Y %H:%M:%S};20")
    again = *rows[:80], *rows[10:160], *rows[150:]  # from before it ended, and after
    Path("still.csv").write_text("\n".join(["Zeit;heat", *again, ""]))
    begun = "--observe", "heat", "--action", "", "--time", "Zeit", "--interval", 60
    numbers = [*range(81), *range(11, 161), *range(151, 181)]
    assert [answer["n"] for answer in told(evofsm("monitor", "still.csv", *begun))] == numbers


def test_failures_right_after_a_hole_are_counted_wherever_others_are(evofsm):
    chance, time, rows = random.Random(1), 0, []
    for run in range(24):
        for k in range(60):
            rises = max(0, k - 50) * 0.3 * (run % 2 == 0)
            rows.append(f"{time},{5 + rises + chance.gauss(0, 0.1):.2f},0")
            time += 60
        time += 7200 * (run % 2)
        rows.append(f"{time},{chance.gauss(9, 0.1):.2f},1")
        time += 7200
    Path("holes.csv").write_text("\n".join(["t,heat,trip", *rows]))
    asked = *TRIPS, "--hole", "10min"
    novelty = "--rule", "novelty", "--scale", "heat=1", "--guard", "holes.evofsm"
    learnt = evofsm("learn", "holes.csv", *asked, *novelty)
    assert "24 episodes ended with trip" in " ".join(learnt.stdout.split())
    for read, failures in ((asked, 5), (("--guard", "holes.evofsm"), 12)):
        told = evofsm("monitor", "holes.csv", "--summary", *read)
        found = json.loads(evofsm("monitor", "holes.csv", "--summary", *read, "--json").stdout)
        assert (found["failures"], found["failures_at_once"]) == (failures, failures)
        assert f"{failures}, and {failures} right after a hole or standstill" in told.stdout
        foreseen = {one["episode"] for one in found["listed"] if one["failed"]}
        assert len(foreseen) + len(found["missed"]) == failures
        assert re.search(rf"Alarms: (all|the last 12 of) {len(found['listed'])}\n", told.stdout)
        for stderr in (learnt.stderr, told.stderr):
            assert "12 of 24 failures came right after a hole or standstill: what led" in stderr


def test_an_alarm_that_came_long_before_counts_once_in_each_horizon(evofsm):
    chance, rows = random.Random(1), ["run,t,heat,trip"]
    for run, k in ((n // 300, n % 300) for n in range(6000) if not 1200 < n < 1500):  # one of a row
        rises = run % 2 * max(0, k - (80 if run == 17 else 200)) / 20
        heat = f"{5 + rises + chance.gauss(0, 0.2):.2f}"
        rows.append(f"{run},{60 * (k + 1000 * run)},{heat},{int(run % 2 and k == 299)}")
    Path("wear.csv").write_text("\n".join(rows))
    told = evofsm("monitor", "wear.csv", "--summary", *TRIPS, "--horizon", "20min").stdout
    assert "; one that stays on counts anew each 20 min" in " ".join(told.split())
    assert re.findall(r"^(\d+) .* h  yes, the last of [78] ", told, re.M) == ["18"]


def test_live_rows_stand_as_in_the_log_and_what_cannot_be_compared_is_refused(evofsm):
    begun = "--observe", "heat", "--action", "", "--interval", 60, "--time", "Zeit"
    begun = *begun, "--failed", "trip==1 or heat==Low", "--where", "runs"

    def answers(*rows):
        lines = [row if isinstance(row, str) else json.dumps(row) for row in rows]
        Path("rows.jsonl").write_text("\n".join([*lines, ""]))
        live = evofsm("monitor", "rows.jsonl", *begun)
        return [json.loads(line) for line in live.stdout.splitlines()]

    usual = {"heat": 6, "trip": 0, "runs": "yes"}
    dates = "10.03.2025 06:00:00", "10.03.2025, 6:01:00,0", "2025-03-10T06:02:00"
    trips = [f"2025-03-10 06:{k:02}:00" for k in range(3, 9)]
    came = answers(
        *({"Zeit": date, **usual} for date in dates),
        {"Zeit": trips[0], **usual, "heat": "Low"},
        *({"Zeit": date, **usual, "heat": "Bad", "trip": 1} for date in trips[1:]),
        {"Zeit": "2025-03-10 06:09:00", **usual, "heat": "Bad", "runs": 0},
    )
    assert [one["time"] - came[0]["time"] for one in came] == [60.0 * k for k in range(10)]
    kinds = ["decision"] * 3 + ["end"] + ["waiting"] * 6  # one end of each failure
    assert [one["kind"] for one in came] == kinds
    assert came[3]["failed"]
    trips = ";0;Low;yes", *[";1;Bad;yes"] * 5, ";0;Bad;0"
    times = [f"2025-03-10 06:{k:02}:00" for k in range(3, 10)]
    lines = *(f"{date};0; 6,0;yes" for date in dates), *map("".join, zip(times, trips, strict=True))
    odd = "10.03.2025 06:10:00;0;Bad;1", "10.03.2025 06:10:00;0", "10.03.2025 06:11:00;0;NaN;yes"
    title, header, *in_csv = answers("Mühle;;;", "Zeit;trip;heat;runs", *lines, *odd)
    assert (title["kind"], header["kind"], in_csv[:10]) == ("waiting", "waiting", came)
    bad, short, unseen = in_csv[10:]
    assert (bad["about"], bad["error"][:27]) == ("heat", "line 13: 'Bad' is no number")
    assert "line 14: 2 fields, but the header names 4" in short["error"]
    assert "not seen: heat" in unseen["reason"]
    # What is not read is never told as no alarm; nor without names above.
    first, *others = (a["error"] for a in answers("zeit;trip;heat;runs", *lines))
    assert [a["kind"] for a in answers(*lines)] == ["error"] * len(others) == ["error"] * len(lines)
    assert "is no column; there are zeit, trip, heat, runs (zeit? case counts)" in first
    twice, row, *_ = answers("Zeit;trip;heat;heat;runs", *lines)
    assert (twice["about"], row["about"], row["kind"]) == ("heat", "line", "error")
    assert "heat is the name of several columns" in row["error"]
    faults = {
        "'1'; it is compared with the number 1.0 (--failed)": {"trip": "1"},
        "'TRIP'; it must be a truth value": {"runs": "TRIP"},
        "it must be float or null (a decimal comma? send 6.6)": {"heat": "6,6"},
        "is 1773478013500: milliseconds? It must be in seconds": {"Zeit": 1773478013500},
        "a date as logs have them": {"Zeit": "today"},
        "is missing, or 'Zeit'": {"Zeit": ...},
    }
    rows = ({"Zeit": 0, **usual} | changed for changed in faults.values())
    rows = ({k: v for k, v in row.items() if v is not ...} for row in rows)
    found = answers(*rows, "10.03.2025 06:00:00;6;0", {"time": 0, "heat": 6, "runs": 1})
    assert found.pop()["note"] == "no trip in the row, which --failed or --where names"
    text = evofsm("monitor", "rows.jsonl", *begun, "--text").stdout
    for one, fault in zip(found, [*faults, "rows are JSON, one per line"], strict=True):
        assert fault in one["error"] in text


def test_live_rows_of_several_machines_become_no_means_of_them(evofsm):
    log = [f"{k},A,{max(6, k % 40)},{int(k > 42 and k % 40 < 3)}" for k in range(243)]
    Path("log.csv").write_text("\n".join(["t,asset,heat,trip", *log]))
    asked = *TRIPS, "--resample", "2s", "--episode", "asset", "--rule", "novelty"
    assert not evofsm("learn", "log.csv", *asked, "--scale", "heat=9", "--guard", "g").exit_code
    rows = [row for k, one in enumerate(log) for row in (one, f"{k},B,5,0", f"{k},C,5,0")]
    Path("live.csv").write_text("\n".join(["t,asset,heat,trip", *rows]))
    found = told(evofsm("monitor", "--guard", "g", "live.csv"))
    ends = [one["time"] for one in found if one["kind"] == "end" and one["failed"]]
    assert ends == [*range(80, 241, 40)]  # each counts once
    assert found[2]["note"] == "asset B after A: a new episode"


def sent(frame, path):
    """Rows of a log as a machine sends them, in the order in which they came."""
    time = polars.col("Zeit").dt.epoch("us") / 1e6
    frame.select(time.alias("time"), polars.exclude("Zeit")).write_ndjson(path)
    return path


@pytest.mark.slow
def test_rows_that_come_live_become_what_they_were_in_the_log(evofsm, written, pump):
    path, asked = written("parquet"), (*BOTH, "--time", "Zeit", "--rule", "novelty")
    asked += "--resample", f"20s,{BEARING}=last"
    scales = "--scale", f"{VIBRATION}=1", "--scale", f"{BEARING}=2"
    assert evofsm("learn", path, *asked, *scales, "--guard", "guard.evofsm").exit_code == 0
    log = pump()
    live = evofsm("monitor", sent(log, "rows.jsonl"), "--guard", "guard.evofsm")
    answers = [json.loads(line) for line in live.stdout.splitlines()]
    assert len(answers) == len(log)  # of which the last stands still
    ends = [answer for answer in answers if answer["kind"] == "end"]
    assert [end["failed"] for end in ends].count(True) == 7
    # An episode that did not fail ends live only as the next row comes, after its last decision.
    found = [a.get("last", a) if a.get("failed", True) else a for a in answers]
    found = [one for one in found if one["kind"] == "decision"]
    # As the log is read: by the options that are in the guard's file.
    told, _ = read_with(Path("guard.evofsm"))
    chunks = read_traces([path], reading_of(**told))
    decider = Decider(Guard.load("guard.evofsm"), slots=Slots(LogColumns(hole=300.0)))
    expected = [a for a, row in decided_on_log(decider, episodes_of(chunks)) if row is not None]
    began = log["Zeit"][0].replace(tzinfo=UTC).timestamp()
    assert [one["time"] - began for one in found] == [one["time"] for one in expected]
    for name in ("alarm", "risk_proposed", "reason"):
        assert [one[name] for one in found] == [one[name] for one in expected]
    assert sum(one["alarm"] for one in found) > 20
    guard = Guard.load("guard.evofsm")
    shown = watched_log(path, reading_of(**told), guard=guard)
    assert "(alarm, failure)" in shown.start.cases[shown.start.case]
    with pytest.raises(ValueError, match=f"read as {BEARING} every 20 s; this guard decides on"):
        watched_log(path, reading_of(**told | {"observe": BEARING, "resample": "20s"}), guard=guard)
    assert "as in a log: --" in live.stderr
    assert "--hole 5min" in live.stderr
    beside = evofsm("monitor", "guard.evofsm")
    assert (beside.exit_code, "ready: reads standard input" in beside.stderr) == (0, True)


@pytest.mark.slow
def test_a_guard_from_zero_where_nobody_acts_learns_as_it_goes(evofsm, pump):
    log, alarmed = pump(18), []
    for part in (log[: len(log) // 2], log[len(log) // 2 :]):  # the second one goes on
        rows = sent(part, "rows.jsonl")
        done = evofsm("monitor", rows, *BOTH, "--resample", "20s", "--state", "pump.evofsm")
        assert done.exit_code == 0, done.stderr
        for said in (f"a guard of {VIBRATION}, {BEARING} learns", "ready: reads rows.jsonl"):
            assert said in done.stderr
        answers = [json.loads(line) for line in done.stdout.splitlines()]
        for before, end in pairwise(answers):
            if end["kind"] == "end" and end["failed"]:
                alarmed.append(end.get("last", before)["alarm"])
    assert len(alarmed) == 9
    assert not any(alarmed[:2])
    assert all(alarmed[-5:])
    assert f"{VIBRATION} above" in " ".join(evofsm("inspect", "pump.evofsm").stdout.split())


@pytest.mark.parametrize("acts", [("--n-actions", 2), ("--low", -1, "--high", 1)])
def test_a_guard_from_zero_of_who_acts_learns_what_fails(evofsm, acts):
    chance, time, rows = random.Random(1), 0.0, []
    for _ in range(12):
        x, v, pushes = 0.0, 0.0, chance.choices([-1, 1], k=40)
        for k in range(200):
            push = pushes[k // 5]
            proposal = (1 + push) // 2 if len(acts) == 2 else push
            rows.append({"time": time, "x": x, "v": v, "proposal": proposal})
            v += 0.1 * push + chance.gauss(0.0, 0.01)
            x, time = x + 0.1 * v, time + 0.1
            if abs(rows[-1]["x"]) > 1.0:
                break
        time += 10.0
    Path("rows.jsonl").write_text("\n".join(map(json.dumps, rows)))
    fails = "--failed", "x>1 or x<-1", "--interval", 0.1, "--state", "cart.evofsm"
    answers = told(evofsm("monitor", "rows.jsonl", "--observe", "x,v", *acts, *fails))
    ends = [answer for answer in answers if answer["kind"] == "end"]
    assert all("executed" in end for end in ends)
    refused = [answer for answer in answers if answer.get("advised") != answer.get("proposed")]
    assert all(one["alarm"] for one in refused)
    assert any(one["risk_proposed"] <= 0.02 for one in refused)  # for want of the margin alone
    assert [end["time"] for end in ends] == [row["time"] for row in rows if abs(row["x"]) > 1.0]
    learnt = evofsm("inspect", "cart.evofsm")
    assert learnt.exit_code == 0, learnt.stderr
    text = " ".join(learnt.stdout.split())
    assert re.search(r"fails where x is (below -1|above 1) or x is (below -1|above 1);", text)


def test_a_log_of_any_machine_is_watched(evofsm, written):
    path, asked = written("parquet"), (*BOTH, "--time", "Zeit", "--resample", "20s")
    assert evofsm("learn", path, *asked, "--guard", "guard.evofsm").exit_code == 0
    reading = reading_of(**read_with(Path("guard.evofsm"))[0])
    with watched_log(path, reading, guard=Guard.load("guard.evofsm")) as shown:
        first, second, *_, last = shown.start.cases
        assert first == "episode 1, 2025-03-10 06:00:20 (alarm, failure)"
        assert (second, last[:12]) == ("episode 2, 2025-03-10 06:29", "episode 14, ")
        assert "nobody acts" in introduce(shown.start)["intro"]
        assert shown.graph().states
        frames = drive(shown)
        assert not any("after a(1)" in frame.explanation for frame in frames)
        for frame in frames[:-1]:  # by the alarm that was chosen, and by no other one
            assert (frame.proposed_risk.risk > shown.start.tolerance) == (frame.reason[:2] != "no")
        before = [tell(frame, shown.start).headline for frame in frames[:-1]]
        assert before == sorted(before, key="Alarm".__eq__)  # none, then it is on
        told = tell(frames[-1], shown.start)
        assert told.headline == "Failure"
        assert re.match(r"An alarm came at 06:\d\d:\d\d\.", told.when)
        assert f"{VIBRATION} above" in shown.known().told
        assert re.search(VIBRATION + r" \d\S+: above .+; after \d+ of \d+ such alarms", told.why)
        shown.restart(len(shown.start.cases) - 1)  # one that went well
        while not (frame := shown.step()).over:
            assert tell(frame, shown.start).headline == "No alarm"
        assert tell(frame, shown.start).why == "No limit of its alarm was passed."
    assert shown.start.about == "row by row."
    zoned = polars.col("Zeit").dt.replace_time_zone("Europe/Berlin")
    polars.read_parquet(path).with_columns(zoned).write_parquet(path)
    about = watched_log(path, reading, guard=Guard.load("guard.evofsm")).start.about
    assert about == "row by row; times of day are told in UTC."
    with pytest.raises(ValueError, match="is of no cars: --guard names a guard"):
        watched_log(path, reading)

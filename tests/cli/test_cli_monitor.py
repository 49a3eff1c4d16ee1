import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from itertools import chain, product
from pathlib import Path

import numpy as np
import pytest
from tests.cli.monitor.test_decider import answers_to
from typer.testing import CliRunner

from evofsm.cli import application
from evofsm.cli.monitor.decider import Decider
from evofsm.driving.cars import guard_of_monitor
from evofsm.guard import audit
from monitor_rows import JUNK, closing_in, line, traffic

EXAMPLES = Path(__file__).parents[2] / "examples" / "monitor"
PATIENCE = 120.0
ROWS = [line(row) for row in closing_in(40)]
posix = pytest.mark.skipif(sys.platform == "win32", reason="signals and sockets of POSIX")


def evofsm(*arguments, lines=()):
    sent = b"".join(one + b"\n" for one in lines)
    return CliRunner().invoke(application(), ["monitor", *map(str, arguments)], input=sent)


def told(result):
    assert result.exit_code == 0, result.stderr
    return [json.loads(one) for one in result.stdout.splitlines()]


def started(*arguments, **pipes):
    command = [sys.executable, "-m", "evofsm", *map(str, arguments)]
    given = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE) | pipes
    return subprocess.Popen(command, **given)


def asked(process, row):
    process.stdin.write(row + b"\n")
    process.stdin.flush()
    return json.loads(process.stdout.readline())


def ended(process):
    out, err = process.communicate(timeout=PATIENCE)
    return process.returncode, out, err.decode()


# -- What it is given -----------------------------------------------------------------------------


def test_rows_from_a_file_and_from_standard_input_are_answered_alike(tmp_path):
    file = tmp_path / "rows.jsonl"
    file.write_bytes(b"\n".join(ROWS))
    by_hand = answers_to(ROWS, learn=False)
    piped = evofsm(lines=ROWS), evofsm("-", lines=ROWS), evofsm("--warm", lines=ROWS)
    for result in (evofsm(file), *piped):
        assert told(result) == by_hand


def test_a_state_goes_on_over_runs_and_may_be_the_guards_own_file(tmp_path):
    rows = [line(row) for row in traffic(200)]
    by_hand = answers_to(rows)
    state = tmp_path / "state.evofsm"
    guard_of_monitor(0.1, 6.0).save(state)
    options = ("--learn", "--guard", state, "--state", state)
    first, second = (evofsm(*options, lines=part) for part in (rows[:90], rows[90:]))
    assert [*told(first), *told(second)] == by_hand
    assert "goes on after decision 90 (90 rows taken in again)" in second.stderr
    refused = evofsm("--guard", state, "--state", state, "--episode", "lane", lines=rows)
    assert refused.exit_code == 2
    assert "learn was true and is now false" in refused.stderr
    assert 'episode was 6000 and is now [6000, "lane"]' in refused.stderr


@pytest.mark.parametrize("content", [b"", b'{"tyme": 0.0}\n', ROWS[0].decode().encode("utf-16")])
def test_a_file_of_which_no_row_is_decided_on_ends_with_2(content, tmp_path):
    (path := tmp_path / "rows.jsonl").write_bytes(content)
    result = evofsm(path)
    assert result.exit_code == evofsm(path, "--summary").exit_code == 2
    assert f"no row of {path} was decided on" in result.stderr


def test_a_file_is_taken_in_once_and_as_it_grows_what_is_new_of_it(tmp_path):
    log, other, state = (tmp_path / name for name in ("log.csv", "other.csv", "state.evofsm"))
    names = "time,gap,v_follower,v_leader,a_follower"
    rows = [",".join(map(str, row.values())) for row in closing_in(40)]

    def answers(file, *lines, half=""):
        file.write_text("\n".join([names, *lines, half]))
        result = evofsm(file, "--learn", "--state", state)
        assert ("no line end behind it, and may be cut off" in result.stdout) == bool(half)
        return [one["n"] for one in told(result)], result.stderr

    seen, _ = answers(log, *rows[:30], half=rows[30][:-1])  # a row that is still being written
    assert seen == [0, *range(1, 31), 30]
    again, said = answers(log, *rows[:30])
    assert (again, f"{log} was read before, up to line 31" in said) == ([], True)
    assert answers(log, *rows)[0] == [*range(31, 41)]
    assert answers(other, *rows[:20])[0] == [*range(40, 61)]  # though the other begins so
    assert answers(log, *rows)[0] == answers(other, *rows[:20])[0] == []


def test_a_guard_that_began_beside_a_machine_is_given_to_another_monitor(tmp_path):
    state, other = tmp_path / "state.evofsm", tmp_path / "other.evofsm"
    rows = [json.dumps({"time": t, "x": x, "proposal": 0}).encode() for t, x in enumerate((0, 2))]
    system = ("--observe", "x", "--low", -1, "--high", 1, "--interval", 1, "--failed", "x>1")
    assert evofsm(*system, "--state", state, lines=rows).exit_code == 0
    for options in ((), ("--failed", "x>1 and x<9"), ("--state", other), ("--state", other)):
        result = evofsm("--guard", state, *options, lines=rows)
        assert told(result)[-1]["failed"] is True  # though --failed need not be typed again


@pytest.mark.parametrize("goes_on", [False, True])
def test_csv_is_read_in_the_units_that_stood_below_the_names_of_the_log(tmp_path, goes_on):
    """Also without that row; one that says others is right."""
    log, guard, state = (tmp_path / name for name in ("log.csv", "guard", "state"))
    names, far = "time,gap,v_follower,v_leader,a_follower", 10.0 / 0.3048
    rows = [f"{k / 10},{far:.4f},20,20,0" for k in range(40)]
    log.write_text("\n".join([names, "s,ft,m/s,m/s,m/s²", *rows, ""]))
    learn = ["learn", str(log), "--guard", str(guard)]
    learnt = CliRunner().invoke(application(), learn)
    assert "CSV without a row of units has gap in ft." in learnt.output
    if goes_on:
        evofsm("--guard", guard, "--state", state)
        guard = state
    log.write_text("\n".join([names, f"0.0,{far},20,15,0", f"0.1,{far},20,15,0", ""]))
    assert "1, or " in evofsm(log, "--summary", "--guard", guard).stdout  # an alarm
    risks = []
    for unit, gap in (("", far), ("s,ft,m/s,m/s,m/s²", far), ("s,m,m/s,m/s,m/s²", 10.0)):
        lines = [names, *[unit] * bool(unit), f"0.0,{gap:.4f},20,15,0"]
        *_, answer = told(evofsm("--guard", guard, lines=map(str.encode, lines)))
        risks.append(answer["risk_proposed"])
    assert risks == pytest.approx([risks[0]] * 3, rel=1e-3)
    assert risks[0] > 0.02


def test_the_audit_log_is_good(tmp_path):
    log, state = tmp_path / "audit.jsonl", tmp_path / "state.evofsm"
    assert evofsm("--audit", log, lines=ROWS).exit_code == 0
    found = audit(log)
    assert (found.is_good, found.replayed) == (True, 40)
    log.unlink()
    rows = [*ROWS[:12], b'{"end": true, "failed": true}', *ROWS]
    for part in (rows[:25], rows[25:30], [], rows[30:]):  # what it goes on after is in the log
        assert evofsm("--learn", "--audit", log, "--state", state, lines=part).exit_code == 0
    found = audit(log)
    assert (found.is_good, found.replayed) == (True, 52)
    assert found.contents[:3] == (1, 2, 52)


def test_the_audit_log_of_alarms_that_go_on_across_holes_is_good(tmp_path):
    log, times = tmp_path / "audit.jsonl", (*range(30), *range(50, 101))
    rows = [json.dumps({"time": t, "heat": t}).encode() for t in times]
    system = ("--observe", "heat", "--action", "", "--interval", 1, "--failed", "heat>=100")
    assert evofsm(*system, "--hole", "30s", "--audit", log, lines=rows).exit_code == 0
    assert (audit(log).is_good, audit(log).replayed) == (True, 80)


def numbers_of(text):
    """The cells of each line that begins with a number."""
    cells = [one.split() for one in text.splitlines()]
    return [one for one in cells if one and one[0].replace(".", "").isdecimal()]


def test_a_summary_takes_no_unknown_risk_for_0_and_no_alarm_for_one_of_another_episode(tmp_path):
    file, rows = tmp_path / "rows.jsonl", [{"time": float(k), "x": 1.0} for k in range(10)]
    file.write_text("".join(json.dumps({**row, "proposal": 0.0}) + "\n" for row in rows))
    zero = "--observe", "x", "--low", -1, "--high", 1, "--interval", 1, "--failed", "x>9"
    said = evofsm(file, "--summary", *zero).stdout
    assert "not known  its risk 100.00% of the time\n" in said
    assert "By risk" not in said
    apart = {"time": 9.5, "gap": None, "v_follower": 20.0, "v_leader": None, "proposal": 0.0}
    ends = [b'{"end": true}', line(apart), b'{"end": true, "failed": true}']
    ego = {"x": 0.0, "lane": 1, "vx": 20.0, "length": 4.6}
    free = [{"time": 10.0 + k / 10, "proposal": 0, "ego": ego, "objects": []} for k in range(10)]
    file.write_bytes(b"\n".join([*map(line, closing_in(90)), *ends, *map(line, free)]))
    said = evofsm(file, "--summary").stdout
    assert "alarms     1, or " in said
    assert "failures   1; 0 in alarm by then\n" in said
    assert "not known  its risk 10.00% of the time, or nobody was ahead\n" in said
    _, count, hourly, _ = numbers_of(said)[0]
    assert "By risk of what was proposed,\nwhile it is known" in said
    assert float(hourly) == 3600.0 / 9.0 * int(count) > 0.0


def test_a_summary_says_that_rows_come_too_seldom(tmp_path):
    file = tmp_path / "rows.jsonl"
    file.write_bytes(b"".join(line(row) + b"\n" for row in closing_in(9, dt=1.0)))
    said = " ".join(evofsm(file, "--summary").stdout.split())
    sent = [{**row, "time": round(1e9 * row["time"])} for row in closing_in(9, dt=1.0)]
    file.write_bytes(b"".join(line(row) + b"\n" for row in sent))
    again = evofsm(file, "--summary", "--unit", "time=ns")
    assert " ".join(again.stdout.split()) == said
    assert "in JSON all but its column of the time is in the SI" in again.stderr
    assert "; they come every 1 s, and count as 0.1 s each (--interval)" in said
    assert "alarms 1, or " in said  # which lasts across them


@pytest.mark.slow
def test_a_summary_says_how_often_it_alarms_and_is_risky_and_where_it_is_worst(tmp_path):
    decider = Decider(guard_of_monitor(0.1, 5.0, 0.05))
    decider.guard.learn = False
    risky = [decider.answer(line(row))["risk_proposed"] > 0.05 for row in traffic(2000)]
    cut, rows = next(k for k in range(9, 1990) if all(risky[k - 5 : k + 5])), [*traffic(2000)]
    late = [{**row, "time": row["time"] + 900.0} for row in rows[cut - 4 :]]  # not sent again
    trips = [rows[: cut + 1], late]  # it is risky where one ends and one begins
    answers = []
    for trip in trips:
        decider.answer(b'{"end": true}')
        answers.append([decider.answer(line(row)) for row in trip[:-1]])
    risks = [[one["risk_proposed"] for one in trip] for trip in answers]
    alarms = [[one["alarm"] for one in trip] for trip in answers]
    log, lines = tmp_path / "own.csv", tmp_path / "rows.jsonl"
    cells = [(k, *row.values()) for k, trip in enumerate(trips) for row in trip]
    text = "\n".join(",".join(map(str, one)) for one in cells)
    log.write_text(f"trip,t,dist,own,lead,acc\n{text}\n")
    calm = {"time": 0.0, "gap": 150.0, "v_follower": 20.0, "v_leader": 20.0, "proposal": 0.0}
    failed = b'{"end": true, "failed": true}'
    ends = [[failed], [b'{"end": true}', line(calm), failed]]
    sent = [[*map(line, trip[:-1]), *end] for trip, end in zip(trips, ends, strict=True)]
    lines.write_bytes(b"junk\n" + b"\n".join(chain(*sent)))
    decided = sum(map(len, risks))
    columns = ("--observe", "dist,own,lead", "--action", "acc", "--time", "t", "--episode", "trip")
    made = ("--summary", "--brakes", 5, "--tolerance", 0.05)
    result = evofsm(log, *made, *columns)
    assert result.exit_code == 0, result.stderr
    assert "assumed: the own car brakes with 5 m/s²" in result.stderr
    assert "(83 are given)" in " ".join(result.stderr.split())
    assert f"{decided:,} in 2 episodes, {decided / 36000.0:.3g} h" in result.stdout
    found = numbers_of(result.stdout)
    by_risk, worst = found[:6], found[6:]

    def counted(on):
        begun = sum((np.diff([0, *trip]) == 1).sum() for trip in on)
        share = f"{sum(map(sum, on)) / decided:.2%}"
        return f"{begun:,}", f"{begun * 36000.0 / decided:,.1f}", share

    assert f"alarms     {'{}, or {} an hour, {}'.format(*counted(alarms))}" in result.stdout
    for least, *told in by_risk:
        assert tuple(told) == counted([[risk > float(least) for risk in trip] for trip in risks])
    assert 0 < len(worst) <= 10
    assert worst[0][-2] == f"{max(map(max, risks)):.1%}"
    by_lines = evofsm(lines, *made)
    assert "refused    1 message, the first because line 1: is no JSON" in by_lines.stdout
    assert "failures   2; 1 in alarm by then, for " in by_lines.stdout
    assert [one[1] for one in numbers_of(by_lines.stdout)[:6]] == [one[1] for one in by_risk]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--summary",), "--summary needs FILE"),
        (("--episode", "0"), "--episode is '0'; it is a number of"),
        (("--mode", "drive"), "'drive' is not one of 'off', 'shadow', 'act'"),
        (("--zenoh", "k", "--socket", "x"), "give one of FILE, --socket and --zenoh"),
        (("--guard", "nowhere"), "nowhere: no such file or directory"),
        (("nowhere.jsonl",), "nowhere.jsonl: no such file or directory"),
        (("--interval", -1), "interval"),
        (("--tolerance", 2), "tolerance is 2"),
        (("--guard", "nowhere", "--brakes", 5), "nowhere has learnt its own"),
        (("--guard", "nowhere", "--n-actions", 3), "--n-actions: only for a guard that is made"),
        (("--observe", "heat", "--interval", 1), "say who acts: --low and --high, --n-actions"),
        (("--observe", "heat", "--low", 0, "--high", 1), "say how often rows come [s]"),
        (("--action", "", "--interval", 1), "say what is observed, the keys of rows: --observe"),
        (("--observe", "heat", "--low", 0, "--interval", 1), "give either low and high"),
        (("--n-actions", 2, "--traffic"), "--traffic is of cars"),
        (("a.csv", "--plot", "x.png"), "--plot draws what --summary says"),
        (("a.parquet", "--text"), "a.parquet is read with --summary; live rows are JSON or CSV"),
        (("a.csv", "b.csv", "--summary"), "one FILE is read; cat joins several"),
        (("--hold", 0.5), "--hold: only for logs (.csv, .parquet, "),
        (("--skip-bad", 0), "--skip-bad: only for logs"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(refused, arguments, said):
    assert said in refused("monitor", *arguments)


# -- As a process ---------------------------------------------------------------------------------


@posix
@pytest.mark.slow
def test_however_it_ends_it_goes_on_bit_for_bit(tmp_path):
    rows = [line(row) for row in traffic(90)]
    by_hand, answers = answers_to(rows), []
    for part, name in enumerate(("SIGKILL", "SIGTERM", "SIGINT")):
        number = getattr(signal, name)
        with started("monitor", "--learn", "--state", tmp_path / "state.evofsm") as process:
            for row in rows[30 * part : 30 * part + 30]:
                assert asked(process, JUNK[1])["kind"] == "error"
                answers.append(asked(process, row))
            process.send_signal(number)
            status, _, said = ended(process)
        assert status == (-number if name == "SIGKILL" else 0), said
        assert "Traceback" not in said
    assert answers == by_hand


@posix
@pytest.mark.slow
def test_streams_that_are_closed_or_do_not_wait_end_it_in_a_line_or_not_at_all():
    program = shlex.join([sys.executable, "-m", "evofsm"])
    base, another = f"{program} monitor", f"{program} check evofsm.fsm:Novelty"
    closed = {f"{base} <&-": "input", f"{base} >&-": "output", f"{another} >&-": "output"}
    closed |= {f"{program} --{option} >&-": "output" for option in ("version", "help")}
    for command, name in closed.items():
        done = subprocess.run(command, shell=True, capture_output=True, text=True)
        assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
        assert f"standard {name} is closed" in done.stderr
    done = subprocess.run(f"{base} 2>&-", shell=True, capture_output=True, input=ROWS[0])
    assert (done.returncode, done.stdout.count(b"\n"), done.stdout[:1]) == (0, 1, b"{")
    (source, feed), (drain, sink) = os.pipe(), os.pipe()
    with started("monitor", stdin=source, stdout=sink) as process:
        os.write(feed, ROWS[0] + b"\n")
        out = os.read(drain, 1 << 16)
        for shared in (source, sink):  # as who shares them with it may do at any time
            os.set_blocking(shared, False)
        os.close(sink)
        os.write(feed, b"x\n" * 3000 + ROWS[1])
        os.close(feed)
        time.sleep(0.5)  # the answers are more than a pipe holds
        while data := os.read(drain, 1 << 16):
            out += data
        said = process.stderr.read().decode()
    assert (process.returncode, len(out.splitlines())) == (0, 3002)
    assert [text[:14] for text in said.splitlines()] == ["evofsm: assume", "evofsm: ready:"]
    os.close(source)
    os.close(drain)


@posix
@pytest.mark.slow
def test_a_reader_that_vanishes_ends_it_in_a_line():
    with started("monitor") as process:
        asked(process, ROWS[0])
        process.stdout.close()
        process.stdin.write(ROWS[1] + b"\n")
        process.stdin.close()
        said = process.stderr.read().decode()
        assert process.wait(PATIENCE) == 1
    assert said.splitlines()[-1] == "evofsm: nobody reads the decisions any more"


@posix
def test_where_nothing_can_be_written_on_standard_error_decisions_go_on():
    with open("/dev/full", "w") as full, started("monitor", stderr=full) as process:
        assert asked(process, ROWS[0].strip())["kind"] == "decision"
        process.communicate(timeout=PATIENCE)


@posix
@pytest.mark.slow
def test_a_client_in_c_gets_its_alarm_by_a_socket(tmp_path):
    compiler = shlex.split(os.environ.get("CC", "cc"))
    if shutil.which(compiler[0]) is None:
        pytest.skip("there is no such compiler")
    path, client = tmp_path / "monitor.sock", tmp_path / "client"
    with started("monitor", "--warm", "--socket", path) as process:
        next(one for one in iter(process.stderr.readline, b"") if b"listens" in one)
        flags = "-std=c99", "-D_POSIX_C_SOURCE=200809L", "-Wall", "-Wextra", "-Werror"
        subprocess.run([*compiler, *flags, "-o", client, EXAMPLES / "client.c"], check=True)
        done = subprocess.run([client, path], capture_output=True, text=True, timeout=PATIENCE)
        process.terminate()
        status, _, said = ended(process)
    assert (status, said, path.exists()) == (0, "", False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("alarm at ")
    assert json.loads(done.stdout[done.stdout.index("{") :])["alarm"]
    assert subprocess.run([client, path], capture_output=True).returncode == 2  # it is gone


# -- Where nobody acts ----------------------------------------------------------------------------


def test_a_summary_says_where_failures_are_and_how_long_an_alarm_was_on_before(refused, tmp_path):
    asked = tmp_path / "log.csv", "--summary", "--action", "", "--observe", "heat", "--horizon", 300
    asked += ("--failed", "hit", "--episode", "run", "--split", 0.5)

    def write(first, late=0):  # in minutes 36 to 39 of odd runs from there on
        lines = ["run,time,heat,hit"]
        for run, k in product(range(30), range(40)):
            fails = run > first and run % 2
            here = 60 * k + late * (k > 37), k % 9 + 9 * (fails and k > 35)
            lines.append(f"{run},{','.join(map(str, here))},{int(fails and k > 38)}")
        asked[0].write_text("\n".join([*lines, ""]))

    write(16)
    said = "none failed in the first 50% of the rows, which it learns from, but 7 later did"
    assert f"{said} (--split)" in refused("monitor", *asked)
    write(0)
    hits = json.loads(evofsm(*asked, "--json").stdout)["listed"]
    assert {hit["lasts"] for hit in hits if hit["failed"]} == {180.0}
    write(0, late=100)  # of which a hole is no single row
    found = json.loads(evofsm(*asked, "--json", "--hole", 300).stdout)
    assert {hit["lasts"] for hit in found["listed"]} == {280.0}
    leads = [own["learnt"]["lead"] for own in found["alarms"] if own["is_own"]]
    assert leads == pytest.approx([280.0])


def test_where_nobody_acts_a_summary_judges_alarms_on_what_they_did_not_learn_from(pump, tmp_path):
    pump(70).write_csv(log := tmp_path / "pump.csv")
    vibration = "Schwingung, mm/s"
    asked = ("--action", "", "--time", "Zeit", "--where", "Drehzahl>100", "--resample", "20s")
    asked += ("--hole", "300s", "--failed", "Status==Störung")
    asked += ("--observe", f'"{vibration}"', "--horizon", 1800)
    picture = tmp_path / "pump.png"
    result = evofsm(log, "--summary", *asked, "--plot", picture)
    assert result.exit_code == 0, result.stderr
    printed = " ".join(result.stdout.split())
    assert "learnt from its first 42 episodes, judged by the rest" in printed
    assert f"plain thresholds do as well: {vibration} above" in printed
    assert picture.stat().st_size > 10_000
    found = json.loads(evofsm(log, "--summary", *asked, "--json").stdout)
    assert [*found["limits"][3]["thresholds"][0]] == ["variable", "above"]
    own = next(one["learnt"] for one in found["alarms"] if one["is_own"])
    assert own["failures"] == own["foreseen"] == found["failures"] == 14
    foreseen = [one["episode"] for one in found["listed"] if one["failed"]]
    assert (len({*foreseen}), found["missed"]) == (14, [])
    (there,) = found["fails"]
    assert there["where"].startswith(f"{vibration} is above ")
    assert (there["came"], there["failed"]) == (14, 14)
    assert f"{there['where']} 14 14" in printed
    lead = f"{own['lead'] / 60.0:.3g} min ahead (mean, 30 min at most; not foreseen: 0)"
    assert f"14 of 14 failures foreseen, {lead}" in printed
    assert "2025-03-11 " in printed

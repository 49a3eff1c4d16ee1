"""A machine's log, as plants export them: from what is in it to what a guard of it says."""

import re
import shlex
from pathlib import Path

import pytest

polars = pytest.importorskip("polars")
pytest.importorskip("typer")

VIBRATION, BEARING = "Schwingung, mm/s", "Lagertemperatur °C"


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
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
        elif form in ("english", "american"):
            how = "%Y-%m-%d %H:%M:%S%.3f" if form == "english" else "%m/%d/%Y %I:%M:%S %p"
            frame.with_columns(when.dt.strftime(how)).write_csv(path, float_precision=3)
        else:
            how = "%d.%m.%Y;%H:%M:%S" if form == "two columns" else "%d.%m.%Y %H:%M:%S"
            dialect = {"separator": ";", "decimal_comma": True, "quote_style": "never"}
            text = frame.with_columns(when.dt.strftime(how))
            text = text.write_csv(None, float_precision=3, **dialect)
            text = text.replace("Zeit", "Datum;Uhrzeit") if form == "two columns" else text
            Path(path).write_bytes(text.encode("cp1252"))
        return path

    return write


@pytest.mark.parametrize(
    "form", ["german", "two columns", "english", "american", "parquet", "codes"]
)
def test_what_is_in_a_log_is_said_with_a_command_that_learns_from_it(evofsm, written, form):
    path = written(form)
    first = evofsm("learn", path)
    assert first.exit_code == 2
    assert "a way stands above" in first.stderr
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
    asked = dict(zip(*[iter(shlex.split(command)[2:])] * 2, strict=False))
    asked = [word for name in READ if name in asked for word in (name, asked[name])]
    summed = evofsm("monitor", path, "--summary", "--guard", "guard.evofsm", *asked)
    assert " 7 of 7 " in summed.stdout
    limit = re.search(f"{VIBRATION} above ([0-9.]+)", summed.stdout)
    assert 5.0 < float(limit[1]) < 7.1
    assert "warning" not in summed.stderr


READ = "--action", "--time", "--unit", "--where", "--failed", "--resample", "--hole"


def test_what_a_log_seems_to_need_is_said_before_the_work(evofsm, refused, written):
    path = written()
    asked = "learn", path, "--observe", f'"{VIBRATION}"', "--action", "", "--time", "Zeit"
    told = evofsm(*asked)
    for part in (
        "begin an episode each: --resample 20s",
        "the machine seems to stand still in some rows: --where 'Drehzahl>100'",
        "nothing says what failed; perhaps: --failed 'Status==Störung'",
    ):
        assert part in told.stderr
    assert "is the time in" not in told.stderr  # which is a date
    assert "(a longer --hole bridges them)" in " ".join(told.stdout.split())
    needs = "--where", "Drehzahl>100", "--failed", "Status==Störung"
    told = evofsm(*asked, *needs, "--resample", "30s", "--guard", "guard.evofsm")
    assert told.stderr == ""
    other = evofsm("monitor", *asked[1:], *needs, "--summary", "--guard", "guard.evofsm")
    assert "a row every 5 s, and guard.evofsm decides each 30 s: --resample 30s" in other.stderr
    hint = refused(*asked[:3], VIBRATION, *asked[4:])
    assert f"""stands in double quotes: '"{VIBRATION}"'""" in hint


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--resample", "often"], "--resample is 'often'; write how long, such as 30s"),
        (["--resample", "30s,Drehzahl=most"], "NAME=HOW with one of mean, last, max, min"),
        (["--hole", "5 weeks"], "--hole is '5 weeks'; write how long"),
        (["--hole", "1min", "--dt", "1"], "--hole goes by a clock, and --dt stands in for one"),
        (["--where", "Drehzahl>"], "--where is 'Drehzahl>'; write a column of truth values"),
        (["--where", "Drehzahl>9999", "--resample", "30s"], "and --where Drehzahl>9999 must hold"),
    ],
)
def test_what_cannot_be_done_with_rows_is_refused(refused, written, options, message):
    path = written()
    asked = "--observe", BEARING, "--action", "Drehzahl", "--time", "Zeit"
    assert message in refused("learn", path, *asked, "--failed", "Status==Störung", *options)

import json
import re
import tracemalloc
from pathlib import Path

import pytest

from evofsm.driving import guard_for_cars
from evofsm.guard import AuditLog, Guard


@pytest.fixture
def log(tmp_path):
    """A log of ten records, seven of them decisions; and its head."""
    with AuditLog(tmp_path / "log.jsonl") as written:
        guard = guard_for_cars(-2.5, 2.5, audit=written)
        for step in range(7):
            guard.decide([20.0 - step, 15.0 - 0.6 * step, 11.0], 1.0)
        guard.end(failed=False, observation=[13.0, 10.0, 11.0])
    return written.path, str(written.head)


@pytest.mark.parametrize(
    "words",
    [("audit", "huge"), ("monitor", "huge", "--summary"), ("monitor", "--state", "huge.evofsm")],
)
def test_a_file_of_one_line_is_refused_by_name_and_not_held_in_memory(evofsm, words):
    for name in ("huge", "huge.evofsm.journal"):
        with open(name, "wb") as file:
            file.truncate(1 << 32)  # without holding that on the disk either
    tracemalloc.start()
    result = evofsm(*words)
    assert tracemalloc.get_traced_memory()[1] < 1 << 28
    tracemalloc.stop()
    assert (result.exit_code, result.stdout) == (2, "")
    assert re.search(r"huge\S* has a line of more than \d+ MiB: is it another", result.stderr)


def test_a_log_that_is_whole(evofsm, log):
    path, head = log
    result = evofsm("audit", path)
    assert result.exit_code == 0, result.output
    assert "unbroken: 10 records" in result.output
    assert "7 decisions as recorded, to the last bit" in result.output
    assert head in result.output
    assert "Keep the head" in result.output
    assert max(map(len, result.output.splitlines()[1:])) <= 80
    assert "Keep the head" not in evofsm("audit", path, "--head", head).output
    beyond = evofsm("audit", path, "--head", f"11:{head.partition(':')[2]}")
    assert beyond.exit_code == 1
    assert "the head was record 11, but the log ends with 10" in " ".join(beyond.output.split())


def test_the_record_that_was_tampered_with_is_named(evofsm, log):
    path, _ = log
    lines = path.read_bytes().splitlines(keepends=True)
    lines[4] = lines[4].replace(b'"executed":-2.5', b'"executed":-1.5')
    path.write_bytes(b"".join(lines))
    result = evofsm("audit", path)
    assert result.exit_code == 1
    said = " ".join(result.output.split())
    assert "TAMPERED WITH at record 5: record 5 was altered" in said
    assert "2 decisions as recorded" in said  # those before it
    found = json.loads(evofsm("audit", path, "--json", "--failed", "other<0").stdout)
    assert found["finding"]["record"] == 5
    assert not found["is_good"]
    path.write_bytes(b"".join([lines[0].replace(b'"guard":"', b'"guard":"!!'), *lines[1:]]))
    forged = evofsm("audit", path, "--failed", "gap<0")
    assert (forged.exit_code, "at record 1" in forged.output) == (1, True)


def is_too_close(z):
    return bool(z[0] <= 6.0)


def test_what_told_the_guard_where_it_fails_is_named_by_its_module_or_typed(evofsm, refused):
    path, names = Path("log.jsonl"), ("gap", "speed")
    with AuditLog(path) as written:
        system = {"low": -2.5, "high": 2.5, "interval": 0.25, "names": names}
        guard = Guard(**system, failed=is_too_close, audit=written)
        for step in range(5):
            guard.decide([20.0 - step, 15.0], 1.0)
        guard.end(observation=[15.0, 15.0])
    assert "5 decisions compared with nothing" in evofsm("audit", path).output
    for text in (f"{__name__}:is_too_close", "gap<=6"):
        again = evofsm("audit", path, "--failed", text)
        assert again.exit_code == 0, again.output
        assert "5 decisions as recorded" in again.output
    assert "log.jsonl observes gap, speed" in refused("audit", path, "--failed", "Gap<=6")
    other = evofsm("audit", path, "--failed", "builtins:any")
    assert "DIFFERS at record 8" in other.output
    assert "failed: recorded false, replayed true" in other.output

import json
import resource
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path

import pytest

from evofsm.fleet.campaign import run_campaign
from evofsm.fleet.executors import Here, Processes, Task, as_they_come
from evofsm.fleet.journal import Journal

SETTINGS = {"seed": 0, "family": {"limits": {"decel": 2.5}, "waves": [[1.0, -2.0]]}}
RECORDS = {k: {"collided": k % 3 == 0, "mobility": 1.0 / (k + 1), "time": None} for k in range(9)}


@pytest.fixture
def chores(monkeypatch):
    """A module that workers can import too."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    return import_module("chores")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "journal.jsonl"


def collected(tasks, open_executor, ahead=4):
    found = {}
    for results in as_they_come(tasks, open_executor, ahead):
        assert not found.keys() & results.keys()
        found |= results
    return [found[k] for k in range(len(found))]


def is_alive(process):
    try:
        return "\nState:\tZ" not in Path(f"/proc/{process}/status").read_text()
    except FileNotFoundError:
        return False


def wait_until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


# -- Executors ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "open_executor", [Here, partial(ThreadPoolExecutor, 3), partial(Processes, 2)]
)
def test_every_executor_gives_the_same(open_executor):
    tasks = [Task(f"{x}", partial(pow, x, 2)) for x in range(30)]
    assert collected(tasks, open_executor) == [x**2 for x in range(30)]


def test_a_worker_that_is_killed_loses_nothing(chores, tmp_path):
    tasks = [Task(f"{x}", partial(chores.die_once, tmp_path / f"{x % 3}", x)) for x in range(12)]
    assert collected(tasks, partial(Processes, 2)) == list(range(12))


def test_a_task_that_kills_every_worker_is_named_and_the_others_are_done():
    killer = Task("the bad one", partial(signal.raise_signal, signal.SIGKILL))
    others = [Task(f"{x}", partial(pow, x, 2)) for x in range(8)]
    found = {}
    with pytest.raises(ChildProcessError, match="the bad one: 5 workers died over it"):  # noqa: PT012
        for results in as_they_come([*others[:4], killer, *others[4:]], partial(Processes, 2), 4):
            found |= results
    assert {0, 1, 2, 3} <= found.keys()


def test_what_a_task_raises_is_raised_and_says_where():
    tasks = [Task("the good one", partial(pow, 2, 2)), Task("the bad one", partial(int, "x"))]
    with pytest.raises(ValueError, match="invalid literal") as caught:
        collected(tasks, partial(ThreadPoolExecutor, 2))
    assert caught.value.__notes__ == ["in the bad one"]


def test_few_tasks_are_in_flight_however_many_there_are():
    taken, done = [], threading.Semaphore(0)

    def tasks():
        for k in range(1000):
            taken.append(k)
            yield Task(f"{k}", done.acquire)

    with closing(as_they_come(tasks(), partial(ThreadPoolExecutor, 2), 5)) as arriving:
        done.release(10)
        came = 0
        while came < 10:
            came += len(next(arriving))
            assert len(taken) <= came + 5
        done.release(10)


def test_workers_end_when_nobody_waits_for_them_any_more(chores, tmp_path):
    tasks = [Task("first", partial(pow, 2, 2))]
    tasks += [Task("long", partial(chores.sleep_long, tmp_path)) for _ in range(2)]
    arriving = as_they_come(tasks, partial(Processes, 2), 4)
    assert next(arriving) == {0: 4}
    wait_until(lambda: len(list(tmp_path.iterdir())) == 2)
    workers = [int(file.name) for file in tmp_path.iterdir()]
    assert all(map(is_alive, workers))
    arriving.close()
    assert not any(map(is_alive, workers))


# -- The journal -------------------------------------------------------------------------------


@contextmanager
def files_limited_to(size):
    """A disk that is full from there on."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def read(path, settings=SETTINGS):
    with Journal(path, settings) as journal:
        return journal.records


@pytest.fixture
def written(path):
    """The bytes of a journal of two batches."""
    with Journal(path, SETTINGS) as journal:
        journal.append({k: RECORDS[k] for k in (3, 4)})
        journal.append({k: RECORDS[k] for k in (0, 1)})
    return path.read_bytes()


def test_a_journal_gives_back_what_was_written_and_is_json_lines(path, written):
    assert read(path) == {k: RECORDS[k] for k in (3, 4, 0, 1)}
    header, *lines = (json.loads(line) for line in written.splitlines())
    assert header["settings"] == SETTINGS
    assert [line["episode"] for line in lines] == [3, 4, 0, 1]


def test_wherever_writing_broke_off_whole_records_are_kept_and_it_goes_on(path, written):
    whole = written.rindex(b'{"episode":1,')
    for end in range(whole, len(written)):
        path.write_bytes(written[:end])
        with Journal(path, SETTINGS) as journal:
            assert journal.records == {k: RECORDS[k] for k in (3, 4, 0)}
            journal.append({1: RECORDS[1]})
        assert path.read_bytes() == written
    header = written.index(b"\n")
    for end in (0, 1, header // 2, header):
        path.write_bytes(written[:end])
        assert read(path) == {}
        assert path.read_bytes() == written[: header + 1]


def test_a_record_with_a_changed_digit_is_not_believed(path, written):
    path.write_bytes(
        written.replace(b'{"episode":1,"collided":false', b'{"episode":1,"collided":true')
    )
    assert set(read(path)) == {3, 4, 0}
    path.write_bytes(written.replace(b'{"episode":4,', b'{"episode":5,'))
    with pytest.raises(ValueError, match="line 3 is damaged"):
        Journal(path, SETTINGS)


def test_a_file_of_another_kind_is_refused_and_left_alone(path):
    path.write_text("my diary\n")
    with pytest.raises(ValueError, match="no journal"):
        Journal(path, SETTINGS)
    assert path.read_text() == "my diary\n"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (SETTINGS | {"seed": 1}, "seed was 0 and is now 1;"),
        (
            SETTINGS | {"family": {"limits": {"decel": 2.5}, "waves": [[1.0, -2.5]]}},
            "family.waves.0.1 was -2.0 and is now -2.5;",
        ),
        (SETTINGS | {"mode": "off"}, 'mode was null and is now "off";'),
        (SETTINGS | {str(k): 1 for k in range(6)}, "and 2 more;"),
    ],
)
def test_other_settings_are_refused_and_named(path, written, settings, message):
    with pytest.raises(ValueError, match="begun with other settings") as caught:
        Journal(path, settings)
    assert message in str(caught.value)
    assert path.read_bytes() == written


def test_without_an_episode_settings_may_change(path):
    read(path)
    assert read(path, {"seed": 1}) == {}
    assert json.loads(path.read_text())["settings"] == {"seed": 1}


def test_two_at_once_are_refused(path):
    with Journal(path, SETTINGS), pytest.raises(ValueError, match="another process"):
        Journal(path, SETTINGS)
    read(path)


def test_a_full_disk_is_named_and_what_was_written_before_is_kept(path, written):
    with Journal(path, SETTINGS) as journal:
        with files_limited_to(len(written) + 30), pytest.raises(OSError, match="kept") as caught:
            journal.append({5: RECORDS[5]})
        assert caught.value.filename == str(path)
        assert 5 not in journal.records
    assert len(path.read_bytes()) == len(written) + 30
    assert read(path) == {k: RECORDS[k] for k in (3, 4, 0, 1)}
    assert path.read_bytes() == written


# -- Campaigns ---------------------------------------------------------------------------------


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_a_campaign_is_the_same_however_it_is_split(chores, path, workers):
    told = []
    with Journal(path, SETTINGS) as journal:
        records = run_campaign(
            *(chores.squares, 300, journal, partial(ThreadPoolExecutor, workers), workers),
            lambda done, total: told.append((done, total)),
        )
    assert records == [{"square": k**2} for k in range(300)]
    assert (told[0], told[-1]) == ((0, 300), (300, 300))
    assert told == sorted(told)


def test_what_the_journal_holds_is_not_driven_again(chores, path):
    asked, told = [], []

    def drive(batch):
        asked.extend(batch)
        return chores.squares(batch)

    with Journal(path, SETTINGS) as journal:
        journal.append({k: {"square": k**2} for k in (7, 2)})
        records = run_campaign(drive, 9, journal, Here, 1, lambda *now: told.append(now))
        assert run_campaign(drive, 4, journal, Here, 1) == records[:4]
    assert records == [{"square": k**2} for k in range(9)]
    assert sorted(asked) == [0, 1, 3, 4, 5, 6, 8]
    assert told[0] == (2, 9)

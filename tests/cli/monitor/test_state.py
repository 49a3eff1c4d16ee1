from contextlib import suppress
from unittest.mock import Mock

import msgspec
import pytest
from tests.cli.monitor.test_decider import answers_to, full, made

from evofsm.cli.monitor.decider import Decider
from evofsm.cli.monitor.slots import Slots
from evofsm.cli.monitor.state import State
from evofsm.cli.monitor.transports import Server
from evofsm.guard import Guard, Mode
from evofsm.io import LogColumns
from evofsm.io.logs import Resample
from monitor_rows import JUNK, line, scenes, traffic


@pytest.fixture
def opened(tmp_path):
    """Opens a state as a monitor does, where the one before was killed; so is the last one."""
    states = []

    def open_state(path=tmp_path / "state.evofsm", learn=True, fresh=made, **settings):
        abandon()
        states.append(state := State(path, {"learn": True, "guard": None}))
        try:
            guard = state.guard(fresh)
        except ValueError:
            state.close()
            raise
        guard.learn = learn
        decider = Decider(guard, **{"episode": 700, **settings})
        state.begin(decider)
        return decider, state

    def abandon():
        """As the death of the process leaves it: nothing is written, the lock is gone."""
        for state in states:
            state._journal._file.close()

    yield open_state
    abandon()


def slotted():
    """Settings under which rows wait for their slot; each decider has its own."""
    columns = LogColumns(resample=Resample(0.3), failed="gap<=0", where="gap<300")
    return {"episode": 30, "slots": Slots(columns)}


@pytest.mark.parametrize(
    ("learn", "mode", "settings"),
    [
        (True, Mode.SHADOW, dict),
        (True, Mode.SHADOW, slotted),
        pytest.param(False, Mode.SHADOW, dict, marks=pytest.mark.slow),
        pytest.param(True, Mode.ACT, dict, marks=pytest.mark.slow),
    ],
)
def test_it_goes_on_bit_for_bit_wherever_it_is_killed(opened, learn, mode, settings):
    plain = Decider(made(learn, mode), **{"episode": 700, **settings()})
    told = {"learn": learn, "fresh": lambda: made(learn, mode)}
    (decider, _), kinds = opened(**told, **settings()), set()
    for k, row in enumerate(traffic(1600)):
        if k in (3, 4, 601, 690, 701, 1399, 1400, 1402, 1403):
            decider, _ = opened(**told, **settings())
        if k % 50 == 0:
            assert decider.answer(JUNK[k // 50 % len(JUNK)])["kind"] == "error"
        answer = decider.answer(line(row))
        assert answer == plain.answer(line(row)), k
        kinds.add(answer["kind"])
        if settings is slotted and k % 100 == 50:
            assert decider.lapse() == plain.lapse() is not None
    assert kinds >= ({"waiting", "decision", "error"} if settings is slotted else {"decision"})


def test_a_journal_or_a_guard_that_was_lost_emptied_or_changed_is_said(tmp_path, opened):
    path = tmp_path / "state.evofsm"
    decider, state = opened(path)
    for row in traffic(5):
        decider.answer(line(row))
    state.close()
    journal = state._journal.path
    whole = journal.read_bytes()
    journal.write_bytes(whole.replace(b'":0.1', b'"0.1', 1))
    with pytest.raises(ValueError, match="record 3 was altered: its hash is not that of what"):
        opened(path)
    lines = whole.splitlines(keepends=True)
    other = lines[2].replace(b'"observation":[', b'"observation":[9')
    others = [lines[0].replace(b":1", b":0"), *lines[1:]]  # as if the guard's file had it all
    for altered in ([*lines[:2], other, *lines[3:]], [*lines[:2], *lines[3:]], others):
        journal.write_bytes(b"".join(altered))
        with pytest.raises(ValueError, match=r"record \d (was altered: its|is not there once)"):
            opened(path)
    for lose in (lambda: journal.write_bytes(b""), journal.unlink):
        lose()
        with pytest.raises(ValueError, match=r"state.evofsm.journal is missing or empty: rows"):
            opened(path)
    journal.write_bytes(whole)
    guard = path.read_bytes()
    for lose in (path.unlink, lambda: made(learn=True).save(path)):  # it is missing, or another one
        lose()
        with pytest.raises(ValueError, match=r"a guard that is not in .*state\.evofsm; put"):
            opened(path)
    path.write_bytes(guard)
    for end, known in ((None, 5), (-10, 4)):  # of a record that was half written nothing is
        journal.write_bytes(whole[:end])
        decider, state = opened(path)
        assert decider.n == known


@pytest.mark.parametrize("is_saved", [False, True])
def test_killed_as_the_guard_is_saved_it_goes_on(opened, is_saved, monkeypatch):
    rows = [line(row) for row in traffic(702)]
    expected = answers_to(rows, episode=700)
    decider, state = opened()
    last = (state._journal, "begin_anew") if is_saved else (decider.guard, "save")
    monkeypatch.setattr(*last, Mock(side_effect=SystemExit))
    with pytest.raises(SystemExit):
        any(decider.answer(row) is None for row in rows)
    decider, state = opened()
    assert [decider.answer(row) for row in rows[699:]] == expected[699:]


def test_rows_in_flight_across_an_end_are_decided_once_though_it_is_killed(opened):
    rows = [line(row) for row in traffic(720)]
    messages = [*rows[:700], b'{"end": true, "failed": true}', *rows[700:]]
    expected = answers_to(messages)
    decider, _ = opened()
    for lost in (5, 695, 699, 702):  # the guard is written with message 700
        for message in messages[max(0, lost - 9) : lost + 9]:
            decider.answer(message)
        decider, _ = opened()
        assert [decider.answer(m) for m in messages[lost : lost + 9]] == expected[lost : lost + 9]
        for message in messages[lost + 9 : 690]:
            decider.answer(message)


def test_rows_that_a_sender_does_not_wait_with_are_decided_once_though_it_is_killed(opened):
    rows = [line(row) for row in traffic(620)]
    answers, expected = [], msgspec.json.decode(msgspec.json.encode(answers_to(rows)))
    for count in (400, 619, 999):  # with so many it is killed, before the last is answered
        decider, _ = opened()
        keep, pieces = decider.keep, iter([b"".join(row + b"\n" for row in rows[len(answers) :])])

        def kept(told, keep=keep, decider=decider, count=count):
            keep(told)
            if decider.n == count:
                raise SystemExit

        decider.keep = kept
        with suppress(SystemExit):
            Server(decider).converse(
                lambda _, pieces=pieces: next(pieces, b""),
                lambda data: answers.extend(map(msgspec.json.decode, data.splitlines())),
            )
    assert answers == expected
    assert decider.n == 620


def test_a_refused_end_stops_no_restart(opened):
    decider, _ = opened(fresh=lambda: Guard(n_actions=2, interval=0.1))
    for k, seen in enumerate(("[3.4e38]", "[1, 2, 3]", "[1e100, 1]", "[null]")):
        row = {"time": 0.1 * k, "observation": [1.0, 2.0], "proposal": 0}
        assert decider.answer(line(row))["kind"] == "decision"
        end = f'{{"end": true, "failed": true, "observation": {seen}}}'
        assert decider.answer(end.encode())["kind"] == "error"
        decider, _ = opened()
        assert (decider.n, decider.rows) == (k + 1, k + 1)


def test_what_cannot_be_taken_in_again_is_left_out_and_said(opened, monkeypatch, caplog):
    decider, _ = opened()
    for message in [*(line(row) for row in traffic(3)), b'{"end": true}']:
        decider.answer(message)
    monkeypatch.setattr(Guard, "end", Mock(side_effect=RuntimeError("another version")))
    decider, _ = opened()
    assert (decider.n, decider.rows) == (3, 3)
    assert "a message is left out: another version" in caplog.text


def test_two_monitors_do_not_keep_themselves_in_one_place(tmp_path, opened):
    opened()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "link.evofsm").symlink_to(tmp_path / "state.evofsm")
    for path in (tmp_path / "state.evofsm", tmp_path / "elsewhere" / "link.evofsm"):
        with pytest.raises(ValueError, match="is being written by another process"):
            State(path, {})


def test_where_it_can_not_be_kept_it_goes_on_says_so_and_keeps_it_later(opened, monkeypatch):
    decider, state = opened()
    rows = [line(row) for row in traffic(9)]
    with monkeypatch.context() as patched:
        for keeper, name in ((state._journal, "append"), (decider.guard, "save")):
            patched.setattr(keeper, name, full)
        for message in (rows[0], b'{"end": true}', rows[1]):
            assert decider.answer(message)["kind"] != "error"
        assert "No space left" in state.failure
    decider.answer(rows[2])
    with pytest.raises(OSError, match="No space left on device; what came since then is lost"):
        state.close()
    assert state._journal._file.closed
    decider, state = opened()
    assert decider.n == 0
    with monkeypatch.context() as patched:
        patched.setattr("evofsm.cli.journal.os.replace", full)
        patched.setattr(state._journal, "append", full)
        for message in (rows[0], b'{"end": true}', rows[1]):
            decider.answer(message)
    decider.answer(b'{"end": true, "failed": true}')
    assert not state.failure
    decider.answer(rows[2])
    decider, state = opened()
    assert (decider.n, decider.rows, decider.guard.n_failed) == (3, 1, 1)


def test_scenes_and_ends_are_kept(opened):
    messages = [*scenes(5), b'{"end": true}', *scenes(9)][:12]
    for message, expected in zip(messages, answers_to(messages), strict=True):
        decider, _ = opened()
        assert decider.answer(message) == expected

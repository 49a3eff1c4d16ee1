import numpy as np
import pytest

from evofsm.cli.monitor.decider import Decider
from evofsm.cli.monitor.defaults import guard_of_monitor
from evofsm.cli.monitor.state import State
from evofsm.guard.guard import Guard
from evofsm.guard.reviser import Mode
from evofsm.store import read_header
from monitor_rows import JUNK, line, scenes, traffic

SETTINGS = {"learn": True, "guard": None}


def made(learn=True, mode=Mode.SHADOW):
    guard = guard_of_monitor(0.1, 6.0)
    guard.learn, guard.reviser.mode = learn, mode
    return guard


def opened(path, settings=SETTINGS, episode=700, learn=True, fresh=made):
    state = State(path, settings)
    guard = state.guard(fresh)
    guard.learn = learn
    decider = Decider(guard, episode=episode)
    state.begin(decider)
    decider.keeper = state
    return decider, state


def abandoned(state):
    """As the death of the process leaves it: nothing is written, the lock is gone."""
    if state._journal is not None:
        state._journal._file.close()


@pytest.mark.parametrize(
    ("learn", "mode"),
    [
        (True, Mode.SHADOW),
        pytest.param(False, Mode.SHADOW, marks=pytest.mark.slow),
        pytest.param(True, Mode.ACT, marks=pytest.mark.slow),
    ],
)
def test_it_goes_on_bit_for_bit_wherever_it_is_killed(tmp_path, learn, mode):
    plain = Decider(made(learn, mode), episode=700)
    decider, state = opened(tmp_path / "state.evofsm", learn=learn, fresh=lambda: made(learn, mode))
    for k, row in enumerate(traffic(1600)):
        if k in (3, 4, 690, 701, 1399, 1400, 1402):
            abandoned(state)
            decider, state = opened(tmp_path / "state.evofsm", learn=learn)
        if k % 50 == 0:
            assert decider.answer(JUNK[k // 50 % len(JUNK)])["kind"] == "error"
        assert decider.answer(line(row)) == plain.answer(line(row)), k
    state.close()


@pytest.mark.slow
def test_a_learnt_judge_goes_on_bit_for_bit(tmp_path):
    """One that is told nothing but failures, and draws random numbers as it learns."""

    def fresh():
        return Guard(low=-1.0, high=1.0, interval=0.1)

    def messages():
        rng = np.random.default_rng(0)
        for k in range(8):
            x = v = 0.0
            for j in range(60):
                push = float(rng.uniform(-1.0, 1.0))
                seen = {"observation": [x, v], "proposal": push}
                yield line({"time": 100.0 * k + 0.1 * j, **seen})
                v += 0.1 * (push + 2.0 * x)
                x += 0.1 * v
                if abs(x) > 1.0:
                    break
            yield line({"end": True, "failed": abs(x) > 1.0, "observation": [x, v]})

    plain = Decider(fresh())
    decider, state = opened(tmp_path / "state.evofsm", fresh=fresh)
    for k, message in enumerate(messages()):
        if k % 37 == 20:
            abandoned(state)
            decider, state = opened(tmp_path / "state.evofsm", fresh=fresh)
        assert decider.answer(message) == plain.answer(message), k
    assert decider.n > 200
    state.close()


def test_a_row_that_was_taken_in_but_not_answered_is_answered_when_it_is_sent_again(tmp_path):
    rows = [line(row) for row in traffic(30)]
    plain = Decider(made())
    expected = [plain.answer(row) for row in rows]
    decider, state = opened(tmp_path / "state.evofsm")
    for row in rows[:20]:
        decider.answer(row)
    state.before(decider.form.read(rows[20]))  # and then it is killed
    abandoned(state)
    decider, state = opened(tmp_path / "state.evofsm")
    assert decider.n == 21
    assert [decider.answer(row) for row in rows[20:]] == expected[20:]
    state.close()


def test_it_remembers_the_latest_answer_over_a_save(tmp_path):
    rows = [line(row) for row in traffic(701)]
    decider, state = opened(tmp_path / "state.evofsm")
    answers = [decider.answer(row) for row in rows[:700]]
    assert decider.rows == 0  # the episode has just ended, and the guard was saved
    abandoned(state)
    decider, state = opened(tmp_path / "state.evofsm")
    assert decider.answer(rows[699]) == answers[699]
    assert decider.answer(rows[700])["n"] == 701
    state.close()


def test_what_is_kept_is_a_guard_that_has_learnt_and_one_journal(tmp_path):
    path = tmp_path / "state.evofsm"
    decider, state = opened(path)
    for row in traffic(1500):
        decider.answer(line(row))
    state.close()
    assert 1 < Guard.load(path).machine.n_states <= decider.guard.machine.n_states
    assert len([*tmp_path.iterdir()]) == 2


def test_a_saved_guard_is_gone_on_from_and_keeps_where_it_came_from(tmp_path):
    path = tmp_path / "guard.evofsm"
    made().save(path, {"drive": "Monday"})
    decider, state = opened(path)
    decider.answer(line(next(traffic(1))))
    state.close()
    assert read_header(path).provenance["drive"] == "Monday"
    decider, state = opened(path)
    assert decider.n == 1
    state.close()


@pytest.mark.parametrize("left", [b"", b'{"num', b'{"number":1,"pre'])
def test_a_journal_whose_first_record_was_half_written_is_empty(tmp_path, left):
    decider, state = opened(tmp_path / "state.evofsm")
    decider.answer(line(next(traffic(1))))
    journal = state._journal.path
    abandoned(state)
    journal.write_bytes(left)
    decider, state = opened(tmp_path / "state.evofsm")
    assert decider.n == 0
    state.close()


def test_a_last_record_that_was_half_written_is_left_out(tmp_path):
    decider, state = opened(tmp_path / "state.evofsm")
    for row in traffic(5):
        decider.answer(line(row))
    journal = state._journal.path
    abandoned(state)
    journal.write_bytes(journal.read_bytes()[:-10])
    decider, state = opened(tmp_path / "state.evofsm")
    assert decider.n == 4
    state.close()


def test_a_journal_that_was_lost_is_begun_anew(tmp_path):
    decider, state = opened(tmp_path / "state.evofsm")
    decider.answer(line(next(traffic(1))))
    state.close()
    state._journal.path.unlink()
    decider, state = opened(tmp_path / "state.evofsm")
    assert decider.n == 0
    state.close()


def test_a_journal_that_was_changed_is_refused(tmp_path):
    decider, state = opened(tmp_path / "state.evofsm")
    for row in traffic(5):
        decider.answer(line(row))
    state.close()
    journal = state._journal.path
    journal.write_bytes(journal.read_bytes().replace(b"0.1", b"0.2", 1))
    with pytest.raises(ValueError, match="was tampered with"):
        opened(tmp_path / "state.evofsm")


def test_other_settings_are_refused(tmp_path):
    _, state = opened(tmp_path / "state.evofsm")
    state.close()
    with pytest.raises(ValueError, match="learn was True and is False"):
        opened(tmp_path / "state.evofsm", {"learn": False, "guard": None})


def test_two_monitors_do_not_keep_themselves_in_one_place(tmp_path):
    _, state = opened(tmp_path / "state.evofsm")
    with pytest.raises(ValueError, match="is being written by another process"):
        opened(tmp_path / "state.evofsm")
    state.close()


def test_where_it_can_not_be_kept_it_goes_on_and_says_so(tmp_path, monkeypatch):
    decider, state = opened(tmp_path / "state.evofsm")

    def full(_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(state._journal, "append", full)
        first, second = (line(row) for row in traffic(2))
        assert decider.answer(first)["kind"] == "decision"
    assert decider.answer(second)["kind"] == "decision"
    assert "No space left" in state.failure
    state.close()


def test_scenes_and_ends_are_kept(tmp_path):
    plain = Decider(made())
    messages = [*scenes(5), b'{"end": true}', *scenes(9)][:12]
    decider, state = opened(tmp_path / "state.evofsm")
    for message in messages:
        abandoned(state)
        decider, state = opened(tmp_path / "state.evofsm")
        assert decider.answer(message) == plain.answer(message)
    state.close()

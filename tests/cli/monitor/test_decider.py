import itertools
from unittest.mock import Mock

import numpy as np
import pytest

from evofsm.cli.monitor.decider import Decider
from evofsm.cli.monitor.slots import Slots
from evofsm.cli.monitor.summary import Text
from evofsm.driving import EnvelopeReviser, guard_for_cars, measures
from evofsm.driving.cars import guard_of_monitor
from evofsm.guard import AuditLog, Guard, Mode, audit
from evofsm.io import LogColumns
from monitor_rows import closing_in as rows
from monitor_rows import line


def made(learn=False, mode=Mode.SHADOW):
    guard = guard_of_monitor(0.1, 6.0)
    guard.learn, guard.reviser.mode = learn, mode
    return guard


def answers_to(messages, learn=True, **settings):
    """What a monitor says that nothing happens to."""
    decider = Decider(made(learn), **settings)
    return [decider.answer(message) for message in messages]


@pytest.mark.parametrize("mode", [Mode.SHADOW, Mode.ACT])
def test_it_decides_as_the_guard_does(mode):
    decider, guard = Decider(made(mode=mode)), made(mode=mode)
    for row in rows(80):
        answer = decider.answer(line(row))
        observation = [row[name] for name in ("gap", "v_follower", "v_leader")]
        revision = guard.decide(observation, 0.5, row["time"])
        executed = 0.5 if mode is Mode.SHADOW else revision.advised
        assert answer["executed"] == revision.executed == executed
        for name in ("risk_proposed", "advised", "reason"):
            assert answer[name] == getattr(revision, name)
        risky = revision.risk_proposed > 0.02
        assert answer["alarm"] == risky == (revision.advised < 0.4)
    assert (answer["n"], answer["alarm"], answer["mode"]) == (80, True, mode.value)


def test_an_alarm_begins_where_something_would_be_changed_and_lasts_until_the_risk_is_tolerable():
    decider = Decider(made())

    def seen(gap, own, leader, proposal):
        row = {"gap": gap, "v_follower": own, "v_leader": leader, "proposal": proposal}
        return decider.answer(line(row | {"time": 0.1 * decider.n}))

    def opens(proposal=0.0):  # the gap is not safe, but will be soon
        answer = seen(4.0, 20.0, 24.0, proposal)
        assert answer["risk_proposed"] > 0.02
        assert answer["advised"] == proposal
        return answer["alarm"]

    assert not opens()
    least = seen(12.0, 20.0, 20.0, 2.0)["advised"]
    decider.answer(b'{"end": true}')
    assert not seen(12.0, 20.0, 20.0, least + 0.05)["alarm"]  # too little to be felt
    assert seen(12.0, 20.0, 20.0, least + 0.3)["alarm"]
    assert opens()
    assert not seen(60.0, 20.0, 24.0, 0.0)["alarm"]
    assert not opens()


def test_time_that_stands_or_goes_backward():
    decider = Decider(made())
    row = next(iter(rows(1))) | {"time": 50.0}
    decider.answer(line(row))
    other = decider.answer(line(row | {"gap": 3.0}))
    assert (other["kind"], other["about"], other["n"]) == ("error", "time", 1)
    late = decider.answer(line(row | {"time": 49.5}))
    assert late["error"] == "49.5 s comes after 50 s: late rows are left out"
    anew = decider.answer(line(row | {"time": 0.0}))
    assert (anew["kind"], anew["n"]) == ("decision", 2)
    assert anew["note"] == "time went back from 50 s: a new episode"
    assert "note" not in decider.answer(line(row | {"time": 0.1}))
    assert decider.answer(line(row))["n"] == 4  # newer than the latest, it is not sent again


def test_in_words_it_is_said_where_the_risk_is_not_known():
    text, told = Text(), {"kind": "decision", "alarm": False, "reason": "not seen: heat", "time": 3}
    lines = [text.line({**told, "risk_proposed": risk}) for risk in (0.0, None, None, 0.0)]
    assert lines == [b"", b"3  not seen: heat\n", b"", b"3  the risk is known again\n"]
    end = {"kind": "end", "failed": True}  # which may come without a time
    answers = [end, {**told, "alarm": True, "risk_proposed": 0.5}, end, end]
    assert text.line(answers[0]) == b"failure, no alarm was on\n"
    assert [text.line(x) for x in answers[1:3]][1] == b"failure, after the alarm\n"
    stop = {"kind": "end", "failed": False, "reason": "not --where runs", "time": 63}
    anew = {**answers[1], "time": 9, "alarm": False, "note": "time went back: a new episode"}
    for last, words in ((stop, b"after 60 s (not --where runs)"), (anew, b"time went back: a new")):
        assert (text.line(answers[1])[:9], words in text.line(last)) == (b"3  alarm:", True)
    refused = {"kind": "error", "about": "line"}
    lines = [text.line({**refused, "error": f"line {k}: is no row"}) for k in range(1, 30)]
    assert lines[0] == b"refused: line 1: is no row\n"
    assert [x for x in lines[1:] if x] == [b"refused: line 10: is no row (10 times by now)\n"]
    lacks = [text.line({"kind": "waiting", "time": 9, "note": "no trip in the row"}) for _ in lines]
    assert lacks[:2] == [b"9  note: no trip in the row\n", b""]


@pytest.mark.parametrize(("gap", "alarm"), [(30.0, False), (5.0, True)])
def test_of_cars_the_risk_is_not_known_where_the_gap_was_seen_long_ago(gap, alarm):
    row, seen = {"v_follower": 20.0, "v_leader": 20.0, "proposal": 0.0}, [*range(3), 90]
    gaps = [{"time": k / 10, "gap": gap if k in seen else None} for k in range(91)]
    answers, text = answers_to([line({**one, **row}) for one in gaps], learn=False), Text()
    assert {answer["alarm"] for answer in answers} == {alarm}
    names = ("risk_proposed", "risk_executed", "risk_low", "risk_high")
    unknown = [[one[name] is None for name in names] for one in answers]
    assert unknown == [[7 <= k < 90] * 4 for k in range(91)]
    assert (answers[6]["evidence"] > 9.0, answers[7]["evidence"]) == (True, 0.0)
    said = b"".join(map(text.line, answers)).decode().splitlines()
    blind, last = said[-2:]
    assert blind.startswith("0.7  not seen: gap; ")
    assert "by an estimate alone, so its risk is not known" in blind
    assert last.startswith("9  the risk is known again")


def test_in_words_it_is_said_where_an_alarm_goes_blind_and_what_stands():
    usual = {"kind": "decision", "risk_proposed": 0.9, "alarm": True, "reason": "heat 9: above 7"}
    blind = {**usual, "reason": "not seen: heat; the alarm stays on"}
    over = {**usual, "alarm": False, "risk_proposed": 0.0, "reason": "not seen: oil"}
    answers = over, usual, blind, blind, usual, blind, over, {**over, "reason": ""}, blind, usual
    text, stands = Text(), "1  alarm: heat 9: above 7"
    told = [(text.line({**one, "time": k}), text.standing) for k, one in enumerate(answers)]
    lost, seen = blind["reason"], "all is seen again"
    words = ["", stands, f"2  {lost}", "", f"4  {seen}", f"5  {lost}", "6  over, after 5 s"]
    words += [f"7  {seen}", f"8  alarm: {lost}", f"9  {seen}"]
    assert [said.decode().rstrip() for said, _ in told] == words
    standing = [standing for _, standing in told]
    assert standing[:3] == ["", stands, f"2  alarm, for 1 s: {lost}"]
    assert standing[6:8] == ["6  not seen: oil", ""]
    more = {**usual, "reason": "not seen: heat, oil; the alarm stays on"}
    unknown = {**over, "risk_proposed": None, "reason": "nothing is seen"}
    said = "".join(text.line(one).decode() for one in (blind, more, more, blind, unknown, usual))
    told = [one["reason"] for one in (blind, more, blind)]
    told += ["over", "nothing is seen", stands[3:], "the risk is known again"]
    assert said.splitlines() == told


def test_gaps_in_time_and_rows_that_come_too_often_are_noted():
    decider = Decider(made(), slots=Slots(LogColumns(hole=5.0)))
    row, times = next(iter(rows(1))), (0, 0.1, 3.1, 3.12, 3.14, 9, 3609)
    notes = [decider.answer(line(row | {"time": t})).get("note") for t in times]
    assert notes[:3] == [None, None, "3 s without a row: nothing is learnt or carried across"]
    assert notes[3].startswith("rows come every 0.02 s, but the guard was made for 0.1 s")
    anew = "without a row (--hole 5s): a new episode"
    assert notes[4:] == [None, f"5.86 s {anew}", f"60 min {anew}"]


@pytest.mark.parametrize("answered", [1, 2, 10, 19, 22, 23, 24, 27, 28])
@pytest.mark.parametrize("decided", [24, 26, 28, 29])
def test_what_was_in_flight_and_is_sent_again_is_decided_once(answered, decided):
    """Episodes by one clock, the first two of which end alike; then one by its time."""
    end = b'{"end": true, "failed": true}'
    told = [row | {"gap": 60.0 + row["time"]} for row in rows(20)]
    for count, gap in ((4, 50.0), (2, 61.0), (1, 62.0)):
        told += [row | {"gap": gap} for row in rows(count)]
    told = [row | {"time": 0.1 * k} for k, row in enumerate(told)]
    messages = [line(row) for row in told]
    messages[26:26] = [line({"end": True, "failed": True, "time": told[25]["time"]})]
    messages[24:24] = messages[20:20] = [end]
    plain, guard = Decider(made(learn=True)), made(learn=True)
    expected = [plain.answer(message) for message in messages]
    decider = Decider(guard)
    for message in messages[:decided]:
        decider.answer(message)
    again = min(answered, decided)
    assert [decider.answer(message) for message in messages[again:]] == expected[again:]
    assert guard.machine.endings.sum() == plain.guard.machine.endings.sum() == 3.0


@pytest.mark.parametrize("differs", [0.0, 1.0])
@pytest.mark.parametrize("ends", [[], [{}], [{"time": 2}]])
def test_rows_of_a_clock_that_begins_anew_are_none_of_an_episode_before(ends, differs):
    """At most one row in the middle differs; the rest, and the end, are as in the one before."""
    decider = Decider(made(learn=True))
    end = [line({"end": True, "failed": True, **when}) for when in ends]
    for k in range(4):
        told = [row | {"gap": 60.0 + k * differs * (n == 9)} for n, row in enumerate(rows(20))]
        lap = [*map(line, told), *end]
        for n, message in enumerate(lap):
            answer = decider.answer(message)
            assert answer["n"] == 20 * k + min(n + 1, 20)
            if n in (5, 15):  # a connection is lost within the episode
                sent = [decider.answer(one) for one in lap[n - 3 : n + 1]]
                assert sent[-1] == answer
    assert decider.guard.n_failed == 4 * len(end)


@pytest.mark.parametrize("length", [1, 20, 255, 256])
def test_episodes_of_one_length_end_at_the_same_time_and_each_end_counts(length):
    guard = made(learn=True)
    decider = Decider(guard)
    for gap in (60.0, 70.0, 80.0):
        told = [row | {"gap": gap, "time": 0.1 * k} for k, row in enumerate(rows(length))]
        end = line({"end": True, "failed": True, "time": told[-1]["time"]})
        answers = [decider.answer(message) for message in [*map(line, told), end, end]]
    assert (decider.n, answers[-1]["n"]) == (3 * length, 3 * length)
    assert guard.n_failed == 3
    later = told[-1]["time"] + 0.1
    assert decider.answer(line(told[0] | {"time": later}))["kind"] == "decision"
    if length < 255:
        assert decider.answer(end) == answers[-1]  # sent again, after a row of another episode
        assert guard.n_failed == 3


def test_an_episode_ends_by_itself_while_there_is_no_alarm():
    calm = next(iter(rows(1)))
    close = calm | {"gap": 3.0, "v_leader": 5.0}
    for row, alarms, length in ((calm, False, 10), (close, True, 20)):
        decider = Decider(made(), episode=10)
        for k in range(25):
            assert decider.answer(line(row | {"time": 0.1 * k}))["alarm"] == alarms
            assert decider.rows == (k + 1) % length


def in_scenes(decider, **ego):
    """What it answers at a time, with these objects around this car."""

    def seen(time, *objects, proposal=0.5):
        told = {"time": time, "ego": ego, "objects": objects, "proposal": proposal}
        return decider.answer(line(told))

    return seen


def test_a_scene_names_who_is_ahead_and_a_change_begins_anew():
    seen = in_scenes(Decider(made()), x=0.0, lane=0, vx=20.0, length=5.0)
    car = {"id": "a", "x": 40.0, "lane": 0, "vx": 20.0, "length": 5.0}
    assert seen(0.0, car)["ahead"] == "a"
    assert "note" not in seen(0.1, car)
    other = seen(0.2, car, car | {"id": "b", "x": 15.0})
    assert (other["ahead"], other["note"]) == ("b", "another one is ahead: a new episode")
    gone = seen(0.3)
    assert (gone["ahead"], gone["alarm"], gone["executed"]) == (None, False, 0.5)
    assert (gone["risk_proposed"], gone["reason"]) == (None, "nothing is ahead in the lane")
    assert seen(0.4, car)["n"] == 5
    beyond, nothing = seen(0.5, proposal=99), seen(0.6, proposal=None)
    assert (beyond["executed"], nothing["executed"]) == (99, -1.0)
    assert beyond["reason"] == f"proposal 99 is outside [-6, 2.5]; {gone['reason']}"


@pytest.mark.parametrize("mode", [*Mode])
def test_only_who_acts_takes_harder_braking_away_and_says_so_once(mode, caplog):
    decider, row = Decider(made(mode=mode)), {"gap": 9, "v_follower": 20, "v_leader": 5}
    for k, proposal in enumerate((4.0, -9.0, -9.0)):
        answer = decider.answer(line({**row, "time": 0.1 * k, "proposal": proposal}))
    assert (answer["advised"], answer["executed"]) == (-6.0, -6.0 if mode is Mode.ACT else -9.0)
    told = [record.getMessage()[:21] for record in caplog.records]
    assert told == ["proposal 4 is outside", "proposal -9 is outsid"] * (mode is Mode.ACT)


@pytest.mark.parametrize("rule", [None, "end", "leader==0"])
def test_where_nobody_is_ahead_nothing_is_judged_and_lost_sight_is_no_free_road(rule):
    decider = Decider(made(mode=Mode.ACT), slots=Slots(LogColumns(no_leader=rule)))
    nobody = {"gap": None, "v_leader": None}

    def seen(**changed):
        row = next(rows(1)) | {"time": 0.1 * next(clock)} | changed
        answer = decider.answer(line(row))
        return answer["kind"], answer.get("executed")

    clock = itertools.count()
    free = ("waiting", 2.5)
    assert [seen(**nobody, proposal=9), seen(**nobody, proposal=9)] == [free, free]
    assert seen()[0] == "decision"
    if rule == "leader==0":
        assert seen(leader=0) == ("end", 0.5)
        assert seen(leader=1)[0] == "decision"
    if rule == "end":
        assert seen(**nobody) == ("end", 0.5)
    else:
        assert seen(**nobody)[0] == seen(**nobody)[0] == "decision"
        decider.answer(b'{"end": true}')
    assert seen(**nobody, proposal=9) == free
    assert seen(gap=None)[0] == "decision"  # but for v_leader


def test_a_judge_that_raises_is_answered_and_gone_on_after(monkeypatch):
    guard = made()
    decider = Decider(guard)
    first, second, third = (line(row) for row in rows(3))
    decider.answer(first)
    with monkeypatch.context() as patched:
        fails = Mock(side_effect=RuntimeError("a bug of somebody's own"))
        patched.setattr(guard.judge, "judge", fails)
        answer = decider.answer(second)
    assert (answer["kind"], answer["about"], answer["n"]) == ("error", "guard", 2)
    assert answer["error"] == "failed: RuntimeError: a bug of somebody's own"
    assert decider.answer(third)["kind"] == "decision"


def full(*_, **__):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize(("is_removed", "logged"), [(False, 40), (True, 30)])
def test_without_an_audit_log_decisions_go_on_and_are_logged_again_when_they_can_be(
    tmp_path, monkeypatch, is_removed, logged
):
    guard = made()
    guard.audit = log = AuditLog(tmp_path / "audit.jsonl")
    decider, plain = Decider(guard), Decider(made())
    for k, row in enumerate(rows(60)):
        if k == 20 and is_removed:
            log.path.unlink()
        elif k == 20:
            monkeypatch.setattr("evofsm.guard.audit_log.os.fsync", full)
            monkeypatch.setattr("evofsm.guard.audit_log.Chain", None)  # it is not read anew
        elif k == 40:
            monkeypatch.undo()
        for message in [line(row), b'{"end": true}'][: 2 if k % 10 == 9 else 1]:
            assert decider.answer(message) == plain.answer(message)
    with pytest.raises(OSError, match="the audit log ends with record"):
        decider.close()
    found = audit(log.path)
    assert (found.is_good, found.replayed) == (True, logged)


def test_a_reviser_without_risks_alarms_where_it_differs():
    cars = guard_for_cars(-6.0, 2.5)
    headway = EnvelopeReviser(measures.TimeHeadway(2.0), cars.actions, 0.1)
    guard = Guard.of(headway, interval=0.1)
    answer = Decider(guard).answer(b'{"time": 0, "observation": [9, 9, 9], "proposal": 2}')
    assert (answer["alarm"], answer["mode"], answer["risk_proposed"]) == (True, "act", None)


def test_what_nothing_averts_by_the_model_alone_alarms_also_where_an_episode_begins_with_it():
    guard = Guard(low=-1.0, high=1.0, interval=0.1, horizon=1.0, mode=Mode.SHADOW)
    for _ in range(3):
        place = speed = 0.0
        while place < 1.0:
            guard.decide([place, speed], 1.0)
            place, speed = place + 0.1 * speed, speed + 0.1
        guard.end(failed=True, observation=[place, speed])
    decider, guard.learn = Decider(guard), False
    for place, speed, alarms in ((0.5, 40.0, True), (-0.5, 0.0, False)):
        told = {"time": decider.n, "observation": [place, speed], "proposal": -1.0}
        answer = decider.answer(line(told))
        assert (answer["alarm"], answer["advised"]) == (alarms, -1.0)
        assert answer["risk_proposed"] is None
        assert ("no backup prevents failure" in answer["reason"]) == alarms
        decider.answer(b'{"end": true}')


def test_in_traffic_who_came_across_the_lane_and_stands_there_is_still_there():
    decider = Decider(guard_of_monitor(0.1, 6.0, traffic=True))
    answer = in_scenes(decider, x=0.0, y=0.0, vx=15.0, length=5.0)
    lorry = {"id": "lorry", "x": 40.0, "y": 5.0, "length": 12.0, "width": 2.5}

    def seen(k, vx, vy):
        told = answer(0.1 * k, lorry | {"vx": vx, "vy": vy})
        return told["role"], told["risk_proposed"]

    speeds = [(0.0, -4.0), (0.0, -0.3), (0.0, 0.0), (5.0, 0.0), (0.0, 0.0), (0.0, -4.0)]
    roles = [seen(k, *speed)[0] for k, speed in enumerate(speeds)]
    assert roles == ["crossing", "ahead", "ahead", None, None, "crossing"]
    lorry["x"] = 27.0  # 23.25 m to its side, 18.5 m to its rear if it lies along the road
    assert [seen(6, 0.0, -4.0), seen(7, 0.0, 0.0)] == [("crossing", 0.0), ("ahead", 1.0)]
    decider.answer(b'{"end": true, "failed": false}')
    assert seen(9, 0.0, 0.0) == (None, 0.0)  # another lorry, perhaps


def test_in_traffic_the_worst_object_is_named_and_who_is_behind_counts():
    decider = Decider(guard_of_monitor(0.1, 6.0, traffic=True))
    seen = in_scenes(decider, x=0.0, y=0.0, vx=14.0, length=5.0)
    ahead = {"id": "lorry", "x": 16.0, "y": 0.2, "vx": 9.0, "length": 10.0, "width": 2.5}
    beside = ahead | {"id": "bus", "y": 3.5}
    close = {"id": 7, "x": -7.0, "y": 0.0, "vx": 16.0, "length": 4.0}
    free = seen(0.0, beside)
    assert (free["alarm"], free["object"], free["role"]) == (False, None, None)
    stuck = seen(0.1, beside, ahead)
    assert (stuck["alarm"], stuck["object"], stuck["role"]) == (True, "lorry", "ahead")
    assert "object lorry, ahead" in stuck["reason"]
    braking = seen(0.2, close, proposal=-6.0)
    assert (braking["alarm"], braking["object"], braking["role"]) == (True, "7", "behind")
    assert braking["executed"] == -6.0  # in the shadow
    flat = {key: value for key, value in ahead.items() if key != "y"}
    refused = seen(0.3, flat | {"lane": 1}, ahead)
    assert (refused["kind"], refused["about"]) == ("error", "objects[0].lane")
    assert (decider.warm(), seen(0.4)["alarm"]) == (None, False)  # by a copy

    def roles_at(time, *places):
        cars = (beside | {"id": f"{time}", "y": y} for y in places)
        return [seen(time + 0.1 * k, car)["role"] for k, car in enumerate(cars)]

    # Without vy. The last one leaps.
    assert roles_at(0.5, 3.5, 3.4, 3.3, 3.2, 6.9) == [None, None, None, "cutting in", None]
    noise = 0.05 * np.random.default_rng(0).standard_normal(50)
    assert {*roles_at(2.0, *(3.5 + noise).tolist())} == {None}

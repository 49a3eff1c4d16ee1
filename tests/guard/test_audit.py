"""The audit log: what is tampered with is found where it was, and what is replayed is the same."""

import errno
import inspect
import json
import logging
import math
import os
import sys
from contextlib import contextmanager, suppress
from hashlib import sha256

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from evofsm.driving import episodes
from evofsm.driving.by_state import RiskByState
from evofsm.driving.drivers import IDM
from evofsm.driving.judge import LatentRisk
from evofsm.driving.measures import TimeToCollision
from evofsm.driving.revisers import AlwaysBrake, EnvelopeReviser, Unrevised
from evofsm.driving.scenarios import Leader, Scenario, Sensors
from evofsm.fleet import sealed as chain
from evofsm.fleet.sealed import (
    NOTHING,
    ChainedFile,
    Fault,
    Head,
    Sync,
    canonical,
    seal,
    unseal,
    verify,
)
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.states.novelty import Novelty
from evofsm.guard.auditing.form import SINCE
from evofsm.guard.auditing.log import AuditLog
from evofsm.guard.auditing.participants import describe, restore
from evofsm.guard.auditing.replay import audit
from evofsm.guard.guard import Guard
from evofsm.guard.protocols import Participants, Proposal
from evofsm.guard.reviser import ActionReviser, Mode, Way

ACTIONS = IntervalActions(low=-2.5, high=2.5, width=0.3, outside="clip")
HASTY = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-2.5, highest=2.5)


def scenario(brake_time=6.0, **others):
    leader = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=4.0, brake_time=brake_time)
    return Scenario(leader, initial_gap=8.0, duration=others.pop("duration", 10.0), **others)


class Learner:
    """A machine, a risk and a guard that teaches both."""

    def __init__(self, **of_reviser):
        rule = Novelty(radius=1.0, scales=(4.0, 2.0, 2.0))
        self.machine = EvolvingFSM(ACTIONS.n_actions, rule=rule, belief_tolerance=1e-6)
        self.risk = LatentRisk(ACTIONS.low)
        self.reviser = ActionReviser(self.risk, ACTIONS, **of_reviser)

    def guard(self, log, **others):
        taking_part = {"machine": self.machine, "judge": self.risk, "interval": 0.25}
        reviser = others.pop("reviser", self.reviser)
        return Guard.of(reviser, actions=ACTIONS, audit=log, **(taking_part | others))


def drive(log, *scenarios, learner=None, controller=HASTY, **others):
    guard = (learner or Learner()).guard(log, **others)
    return [episodes.drive(guard, one, controller=controller) for one in scenarios]


def contents(path):
    return [json.loads(line) for line in path.read_bytes().splitlines()]


def kinds(path):
    return [record["kind"] for record in contents(path)]


# -- The chain ------------------------------------------------------------------------------------

RECORDS = 7


def written(count=RECORDS):
    """Lines of a small log, and its head."""
    lines, head = [], Head(0, NOTHING)
    for k in range(count):
        line, head = seal({"kind": "note", "value": k / 3, "text": "a, b"}, head)
        lines.append(line)
    return lines, head


def found(tmp_path, lines, kept=None):
    path = tmp_path / "log.jsonl"
    path.write_bytes(b"".join(lines))
    finding = verify(path, kept).finding
    return finding and (finding.fault, finding.record, finding.line)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("chain")


places = st.integers(1, RECORDS)


def test_what_was_written_is_whole(folder):
    lines, head = written()
    assert found(folder, lines) is None
    assert found(folder, lines, head) is None
    assert [unseal(line).content["value"] for line in lines] == [k / 3 for k in range(RECORDS)]


@given(places, st.sampled_from(["kind", "value", "text", "number", "previous", "hash"]))
def test_a_field_that_is_changed_is_found_in_its_record(folder, at, field):
    lines, _ = written()
    record = json.loads(lines[at - 1])
    record[field] = {"value": 9.5, "number": 99}.get(field, "f" * 64)
    lines[at - 1] = canonical(record).encode() + b"\n"
    assert found(folder, lines) == (Fault.ALTERED, at, at)


@given(st.data(), st.integers(0, 255))
def test_any_byte_that_is_changed_is_found_in_its_record(folder, data, new):
    lines, _ = written()
    at = data.draw(places)
    place = data.draw(st.integers(0, len(lines[at - 1]) - 2))
    line = bytearray(lines[at - 1])
    if line[place] == new:
        new ^= 1
    line[place] = new
    lines[at - 1] = bytes(line)
    fault, record, line = found(folder, lines)
    assert (fault, record, line) == (Fault.ALTERED, at, at)


@given(st.integers(1, RECORDS - 1), st.sampled_from(["kind", "value", "text", "number"]))
def test_a_record_that_is_changed_with_its_hash_is_found_by_the_one_after(folder, at, field):
    lines, _ = written()
    record = unseal(lines[at - 1])
    content = {**record.content, field: 9}
    number = 99 if field == "number" else at
    text = canonical({**content, "number": number, "previous": record.previous})[:-1].encode()
    digest = sha256(text).hexdigest()
    lines[at - 1] = text + b',"hash":"' + digest.encode() + b'"}\n'
    assert found(folder, lines) == (Fault.ALTERED, at, at)


@given(st.integers(1, RECORDS - 1), st.integers(1, 3))
def test_records_that_are_removed_are_found(folder, at, count):
    lines, _ = written()
    del lines[at - 1 : min(at - 1 + count, RECORDS - 1)]
    assert found(folder, lines) == (Fault.MISSING, at, at)


@given(st.lists(places, min_size=2, max_size=2, unique=True))
def test_records_that_are_swapped_are_found(folder, pair):
    lines, _ = written()
    first, second = sorted(pair)
    lines[first - 1], lines[second - 1] = lines[second - 1], lines[first - 1]
    assert found(folder, lines) == (Fault.MOVED, first, first)


@given(places, places)
def test_a_record_that_is_moved_is_found(folder, start, to):
    lines, _ = written()
    lines.insert(to - 1, lines.pop(start - 1))
    first = min(start, to)
    assert found(folder, lines) == (None if start == to else (Fault.MOVED, first, first))


@given(places, places)
def test_a_record_that_is_repeated_is_found(folder, of, after):
    lines, _ = written()
    of, after = min(of, after), max(of, after)
    lines.insert(after, lines[of - 1])
    assert found(folder, lines) == (Fault.REPEATED, of, after + 1)


@given(st.integers(1, RECORDS - 1), st.booleans())
def test_a_record_that_is_inserted_is_found(folder, at, well_chained):
    lines, _ = written()
    before = unseal(lines[at - 2]).digest if at > 1 else NOTHING
    after = Head(at - 1, before if well_chained else "1" * 64)
    lines.insert(at - 1, seal({"kind": "note", "text": "forged"}, after)[0])
    assert found(folder, lines) == (Fault.INSERTED, at, at)


@given(st.integers(1, RECORDS - 1), st.booleans())
def test_an_end_that_is_cut_off_shows_with_the_head_only(folder, left, with_number):
    lines, head = written()
    kept = head if with_number else Head(None, head.digest)
    assert found(folder, lines[:left]) is None
    assert found(folder, lines[:left], kept) == (Fault.CUT, left + 1, left + 1)


@given(places)
def test_a_log_that_is_written_anew_shows_with_the_head_only(folder, at):
    lines, kept = written()
    forged, head = [], Head(0, NOTHING)
    for k, line in enumerate(lines, 1):
        content = unseal(line).content
        anew, head = seal({**content, "value": 9.0} if k == at else content, head)
        forged.append(anew)
    assert found(folder, forged) is None
    assert found(folder, forged, kept) == (Fault.REWRITTEN, RECORDS, RECORDS)


def test_a_log_that_went_on_still_has_its_head(folder):
    lines, _ = written()
    _, early = written(3)
    assert found(folder, lines, early) is None
    assert found(folder, lines, Head(None, early.digest)) is None


def test_a_last_line_without_an_end_is_said_to_be_half_written(folder):
    lines, _ = written()
    path = folder / "log.jsonl"
    path.write_bytes(b"".join(lines)[:-20])
    chain = verify(path)
    assert chain.finding is None
    assert chain.head.number == RECORDS - 1
    assert chain.half_written == len(lines[-1]) - 20


@pytest.mark.parametrize("text", ["", "12", "x:" + NOTHING, "3:" + NOTHING[1:], "g" * 64])
def test_a_head_that_is_none_is_refused(text):
    with pytest.raises(ValueError, match="head is"):
        Head.parse(text)


def test_a_head_is_read_as_it_is_printed():
    head = Head(12, "ab" * 32)
    assert Head.parse(str(head)) == head
    assert Head.parse(head.digest) == Head(None, head.digest)


@pytest.mark.parametrize("text", [b"", b"# Notes\n", b"{}\n", b"[" * 100_000 + b"\n"])
def test_another_file_is_no_audit_log(tmp_path, text):
    path = tmp_path / "other"
    path.write_bytes(text)
    with pytest.raises(ValueError, match="no audit log"):
        audit(path)
    if text:
        with pytest.raises(ValueError, match="no audit log"):
            AuditLog(path)
        assert path.read_bytes() == text


def test_a_file_without_an_end_of_line_is_not_cut_off_unless_it_is_ours(tmp_path):
    path = tmp_path / "other"
    path.write_bytes(b'{"precious":1}')
    with pytest.raises(ValueError, match="left alone"):
        AuditLog(path)
    assert path.read_bytes() == b'{"precious":1}'
    path.write_bytes(b'{"about":"evofsm audit log","act')
    AuditLog(path).close()
    assert path.read_bytes() == b""


def test_one_writes_at_a_time(tmp_path):
    pytest.importorskip("fcntl")
    with ChainedFile(tmp_path / "log"), pytest.raises(ValueError, match="another process"):
        ChainedFile(tmp_path / "log")


# -- What is written ------------------------------------------------------------------------------


def test_decisions_that_changed_something_are_written_and_others_are_held(tmp_path):
    path = tmp_path / "log"
    with AuditLog(path) as log:
        told = drive(log, scenario())[0]
    decisions = [record for record in contents(path) if record["kind"] == "decision"]
    spoke = [
        one
        for one in told.decisions
        if one.revision.executed != one.revision.proposed or one.revision.risk_proposed > 0.02
    ]
    assert 3 < len(spoke) < len(told.decisions) - 3
    assert [one["executed"] for one in decisions] == [one.revision.executed for one in spoke]
    assert [one["reason"] for one in decisions] == [one.revision.reason for one in spoke]
    assert [one["time"] for one in decisions] == [one.situation.time for one in spoke]
    held = sum(len(record.get("before", ())) for record in contents(path))
    assert held + len(spoke) == len(told.decisions)
    assert kinds(path)[:2] == ["start", "begin"]
    assert kinds(path)[-1] == "end"


def test_a_controller_that_fails_and_one_out_of_range_are_written(tmp_path):
    path = tmp_path / "log"
    proposals = iter([1.0, math.nan, 99.0, math.inf])
    with AuditLog(path) as log:
        guard = Guard.of(Unrevised(ACTIONS), audit=log)
        for step, proposed in enumerate(proposals):
            situation = guard.recognise(np.array([50.0, 9.0, 9.0]), step * 0.25)
            guard.revise(situation, Proposal(proposed, (0.5, -math.inf)))
    decisions = [record for record in contents(path) if record["kind"] == "decision"]
    assert [one["proposed"] for one in decisions] == ["NaN", 99.0, "Infinity"]
    assert decisions[0]["candidates"] == [0.5, "-Infinity"]
    assert audit(path).replay == (4, (), (), None)


def test_quiet_decisions_are_held_back_for_a_while_only(tmp_path):
    path = tmp_path / "log"
    with AuditLog(path, most_quiet=5) as log:
        guard = Guard.of(Unrevised(ACTIONS), audit=log)
        for step in range(12):
            situation = guard.recognise(np.array([50.0, 9.0, 9.0]), step * 0.25)
            guard.revise(situation, Proposal(0.5))
        assert kinds(path) == ["start", "begin", "quiet", "quiet"]
    assert kinds(path)[-1] == "quiet"  # closing writes the rest
    assert audit(path).replay.decisions == 12


def test_each_record_is_on_the_disk_before_its_action_is_executed(tmp_path, monkeypatch):
    forced = []
    monkeypatch.setattr(ChainedFile, "sync", lambda file: forced.append(file.head.number))
    with AuditLog(tmp_path / "each") as log:
        drive(log, scenario(duration=2.0))
        assert forced == list(range(1, log.head.number + 1))
    forced.clear()
    with AuditLog(tmp_path / "episodes", sync=Sync.EPISODE) as log:
        drive(log, scenario(duration=2.0), scenario(duration=2.0))
        assert len(forced) == 4  # as each begins and ends


# -- Replaying ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_episodes_of_learning_come_out_the_same(tmp_path):
    path, learner = tmp_path / "log", Learner(tolerance=0.3)
    noisy = scenario(sensors=Sensors(gap_noise=0.5, speed_noise=0.2))
    with AuditLog(path) as log:
        drives = drive(log, scenario(), noisy, learner=learner)
        drives += drive(log, scenario(), learner=learner, reviser=learner.reviser, learn=False)
        collided = drive(log, scenario(), learner=learner, reviser=Unrevised(ACTIONS))
        drives += collided + drive(log, scenario(7.0), learner=learner)
    assert collided[0].collided
    assert learner.machine.n_states > 10
    result = audit(path, log.head)
    assert result.is_good
    assert result.chain.known
    assert result.replay.difference is None
    assert result.replay.decisions == sum(len(one.decisions) for one in drives)
    assert result.contents.episodes == 5
    assert result.contents.sessions == 3  # the reviser was another one for an episode


REVISERS = {
    "unrevised": lambda learner: Unrevised(ACTIONS),
    "always brakes": lambda learner: AlwaysBrake(ACTIONS),
    "measure": lambda learner: EnvelopeReviser(TimeToCollision(4.0), ACTIONS),
    "by state": lambda learner: ActionReviser(RiskByState(learner.risk, learner.machine), ACTIONS),
    "shadow": lambda learner: ActionReviser(learner.risk, ACTIONS, mode=Mode.SHADOW),
    "off": lambda learner: ActionReviser(learner.risk, ACTIONS, mode=Mode.OFF),
    "choose": lambda learner: ActionReviser(learner.risk, ACTIONS, way=Way.CHOOSE),
}


@pytest.mark.parametrize("name", REVISERS)
def test_every_reviser_comes_out_the_same(tmp_path, name):
    learner = Learner()
    with AuditLog(tmp_path / "log") as log:
        runs = drive(log, scenario(), learner=learner, reviser=REVISERS[name](learner))
    result = audit(tmp_path / "log", log.head)
    assert result.replay == (len(runs[0].decisions), (), (), None)


def test_a_log_is_gone_on_with_and_what_was_learnt_elsewhere_is_written_anew(tmp_path):
    path, learner = tmp_path / "log", Learner()
    with AuditLog(path) as log:
        drive(log, scenario(), learner=learner)
        drive(log, scenario(), learner=learner)
        drive(None, scenario(), learner=learner)
        drive(log, scenario(), learner=learner)
    with AuditLog(path) as log:
        drive(log, scenario(), learner=learner)
    starts = [k for k, kind in enumerate(kinds(path)) if kind == "start"]
    assert len(starts) == 3
    assert [one["episode"] for one in contents(path) if one["kind"] == "begin"] == [1, 2, 3, 4]
    result = audit(path)
    assert result.is_good
    assert result.contents.sessions == 3


def brake(brakes, decel, decisions):
    """What is counted on while full braking brings ``decel``."""
    counted_on, speed = [], 20.0
    brakes.clear()
    for _ in range(decisions):
        brakes.see(speed, ACTIONS.low)
        speed -= 0.25 * decel
        counted_on.append(brakes.decel)
    return counted_on


def test_what_a_risk_suspects_of_its_brakes_is_written_with_it():
    risk = LatentRisk(ACTIONS.low)
    brake(risk.brakes, 2.5, 14)
    brake(risk.brakes, 1.8, 4)  # weaker than they were, but too briefly to be sure
    who = Participants(ACTIONS, ActionReviser(risk, ACTIONS), None, risk)
    again = restore(describe(who)).risk
    before = risk.brakes.decel
    assert brake(again.brakes, 1.8, 8) == brake(risk.brakes, 1.8, 8)
    assert risk.brakes.decel < 0.9 * before


def test_who_takes_over_is_written_and_replayed(tmp_path):
    path, learner = tmp_path / "log", Learner()

    class Driver:
        def propose(self, observation, time=0.0):
            if time == 2.0:
                learner.reviser.take_over()
            if time == 4.0:
                learner.reviser.hand_back()
                learner.reviser.tolerance = 0.1
            return Proposal(2.5)

    with AuditLog(path) as log:
        drive(log, scenario(), learner=learner, controller=Driver())
    changes = [one["settings"] for one in contents(path) if one["kind"] == "settings"]
    assert [(one["overridden"], one["tolerance"]) for one in changes] == [
        (True, 0.02),
        (False, 0.1),
    ]
    assert audit(path).is_good


def test_sensors_that_fail_come_out_the_same(tmp_path):
    path, learner = tmp_path / "log", Learner()
    nan = math.nan
    came = [
        (0.0, [30.0, 15.0, 14.0]),
        (0.25, [nan, 15.0, 14.0]),
        (0.5, [29.0, 15.0, 13.0]),
        (0.5, [29.0, 15.0, 13.0]),  # twice
        (0.25, [29.5, 15.0, 13.5]),  # late
        (2.0, [20.0, 15.0, 9.0]),  # after a hole
        (2.25, [18.0, 14.0, 8.0]),
    ]
    with AuditLog(path) as log:
        guard = Guard.of(
            learner.reviser,
            machine=learner.machine,
            judge=learner.risk,
            interval=0.25,
            audit=log,
        )
        for time, observation in came:
            situation = guard.recognise(np.array(observation), time)
            guard.revise(situation, Proposal(-0.5))
        guard.recognise(np.array([16.0, 13.0, 7.0]), 2.5)  # nothing is decided
        guard.end(failed=False, observation=np.array([14.0, 12.0, 6.0]))
    result = audit(path)
    assert result.replay == (len(came), (), (), None)


def test_an_episode_that_was_broken_off_is_no_obstacle(tmp_path):
    path, learner = tmp_path / "log", Learner()

    class Driver:
        def propose(self, observation, time=0.0):
            if time == 3.0:
                raise KeyboardInterrupt
            return Proposal(1.0)

    with AuditLog(path) as log:
        with pytest.raises(KeyboardInterrupt):
            drive(log, scenario(), learner=learner, controller=Driver())
        drive(log, scenario(), learner=learner)
    assert kinds(path).count("start") == 2  # it learnt what no record says
    assert audit(path).is_good


def test_a_reviser_of_ones_own_is_verified_and_said_not_to_be_replayed(tmp_path):
    class Own(AlwaysBrake):
        pass

    with AuditLog(tmp_path / "log") as log:
        drive(log, scenario(duration=2.0), reviser=Own(ACTIONS))
    result = audit(tmp_path / "log")
    assert result.is_good
    assert result.replay.decisions == 0
    assert "Own" in result.replay.not_replayed[0]


# -- Forging --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    path = tmp_path_factory.mktemp("driven") / "log"
    with AuditLog(path) as log:
        drive(log, scenario(), scenario(7.0))
    return path


def forge(path, target, kind, which, change):
    """Change a record, and chain all anew: the record's number."""
    head, lines, number, met = Head(0, NOTHING), [], 0, 0
    for line in path.read_bytes().splitlines(keepends=True):
        content = unseal(line).content
        if content["kind"] == kind:
            if met == which:
                change(content)
                number = head.number + 1
            met += 1
        line, head = seal(content, head)
        lines.append(line)
    target.write_bytes(b"".join(lines))
    assert verify(target).finding is None
    return number


def with_ulp(name):
    def change(content):
        content[name] = math.nextafter(content[name], math.inf)

    return change


def with_other(name, value):
    return lambda content: content.update({name: value})


def without_last_row(content):
    content["before"].pop()


FORGERIES = {
    "executed": ("decision", 3, with_ulp("executed")),
    "observation": ("decision", 3, with_other("observation", [90.0, 15.0, 15.0])),
    "risk": ("decision", 5, with_ulp("risk_proposed")),
    "reason": ("decision", 2, with_other("reason", "the driver wished it")),
    "state": ("decision", 4, with_other("state", 99)),
    "explanation": ("decision", 4, with_other("explanation", "all was well here")),
    "learnt": ("end", 0, lambda content: content["learnt"].update(manoeuvres=99)),
    "failed": ("end", 0, with_other("failed", True)),
    "no number": ("decision", 1, with_other("observation", ["x", 1.0, 2.0])),
    "settings": ("start", 0, lambda content: content["reviser"]["settings"].update(tolerance=0.5)),
    "machine": ("start", 0, lambda content: content["machine"].update(file="AAAA")),
    "what was never learnt": ("end", 0, lambda content: content["learnt"].update(wisdom=1.0)),
    "an action's name": ("start", 0, lambda content: content["actions"].pop("closed")),
    "a reviser's name": ("start", 0, lambda content: content["reviser"].update(more=1)),
}

# A forger may write any of these on top of forged decisions, and chain it all anew.
MISFITS = {
    **{f"version {one!r}": ("start", with_other("version", one)) for one in (0, -7, 0.5, False)},
    "version 'two'": ("start", with_other("version", "2")),
    "a name that version 1 has not": ("start", with_other("version", 1)),
    "no version": ("start", lambda content: content.pop("version")),
    "another kind": ("end", with_other("kind", "nonsense")),
    "no explanation in version 2": ("decision", lambda content: content.pop("explanation")),
    "what nobody writes": ("decision", with_other("comment", "all was well")),
    "a flag that is none": ("end", with_other("failed", 0)),
    "a file with more in it": ("start", lambda content: content["machine"].update(more=1)),
    "another episode": ("begin", with_other("episode", 7)),
    "no time": ("decision", with_other("clock", "yesterday")),
    "a time before clocks": ("decision", with_other("clock", "0001-01-01T00:00:00+00:00")),
    "another time zone": ("decision", with_other("clock", "2026-03-01T00:00:00+01:00")),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forgery_behind_a_chain_that_was_made_anew_is_found_by_replaying(driven, tmp_path, name):
    number = forge(driven, tmp_path / "forged", *FORGERIES[name])
    result = audit(tmp_path / "forged")
    assert result.chain.finding is None
    assert not result.is_good
    if name == "settings":  # it shows where it first matters
        assert result.replay.difference.record > number
    elif name == "failed":  # of which the machine learns, and says so at the end
        assert result.replay.difference.record >= number
    else:
        assert result.replay.difference.record == number
    assert audit(tmp_path / "forged", replay=False).is_good


def test_a_decision_is_written_with_what_the_machine_had_seen_of_its_situation(driven):
    told = [one for one in contents(driven) if one["kind"] == "decision"]
    assert all(one["explanation"].startswith(f"#{one['state'] + 1}: ") for one in told)
    assert "No earlier episode that was counted came here" in told[0]["explanation"]
    assert any("episode came here" in one["explanation"] for one in told)


@pytest.mark.parametrize("name", MISFITS)
def test_what_no_log_holds_is_a_forgery(driven, tmp_path, name):
    kind, change = MISFITS[name]
    number = forge(driven, tmp_path / "forged", kind, 0, change)
    result = audit(tmp_path / "forged", replay=False)
    if name == "a name that version 1 has not":  # it stands where the first episode begins
        number = 1 + next(k for k, one in enumerate(contents(driven)) if one["kind"] == "begin")
    assert result.misfit.record == number
    assert not result.is_good
    assert audit(tmp_path / "forged").replay is None


def test_a_name_given_twice_is_found_behind_its_own_hash(driven, tmp_path):
    """Some readers take the first of them, others the last."""
    lines = driven.read_bytes().splitlines(keepends=True)
    text = lines[-1].rpartition(b',"hash":"')[0]
    twice = text.replace(b'"failed":false', b'"failed":true,"failed":false')
    assert twice != text
    lines[-1] = twice + b',"hash":"' + sha256(twice).hexdigest().encode() + b'"}\n'
    (tmp_path / "forged").write_bytes(b"".join(lines))
    finding = verify(tmp_path / "forged").finding
    assert (finding.fault, finding.record) == (Fault.ALTERED, len(lines))
    assert "not written as records are" in finding.explanation


def as_version_1(driven, target, change=lambda content: None):
    """The log as it was written at first: without explanations, among others."""
    head, lines = Head(0, NOTHING), []
    for line in driven.read_bytes().splitlines(keepends=True):
        content = unseal(line).content
        for name in SINCE:
            content.pop(name, None)
        content |= {"version": 1} if "version" in content else {}
        change(content)
        line, head = seal(content, head)
        lines.append(line)
    target.write_bytes(b"".join(lines))


def test_a_log_from_before_there_were_explanations_is_replayed_without(driven, tmp_path):
    as_version_1(driven, tmp_path / "old")
    result, now = audit(tmp_path / "old"), audit(driven)
    assert result.is_good
    assert result.replay.decisions == now.replay.decisions
    assert f"{now.contents.spoke} decisions are compared without" in result.remarks[0]
    assert not now.remarks


def test_decisions_that_are_forged_in_an_old_log_are_found(driven, tmp_path):
    def change(content):
        if content["kind"] == "decision":
            content["executed"] = 1.25

    as_version_1(driven, tmp_path / "old", change)
    assert audit(tmp_path / "old").replay.difference.fields[0].name == "executed"


def test_a_clock_that_goes_back_is_said(driven, tmp_path):
    """It may have been set, so that it is no proof of anything."""
    forge(driven, tmp_path / "log", "decision", 3, with_other("clock", "2001-01-01T00:00:00+00:00"))
    result = audit(tmp_path / "log")
    assert result.is_good
    assert "the clock goes back" in result.remarks[0]
    forge(driven, tmp_path / "log", "end", 1, with_other("clock", "9001-01-01T00:00:00+00:00"))
    assert "ahead of this computer" in audit(tmp_path / "log").remarks[0]


def test_a_decision_that_was_hidden_is_found_by_replaying(driven, tmp_path):
    """As if the proposal had been executed: its row stands among the quiet ones."""
    lines = [unseal(line).content for line in driven.read_bytes().splitlines(keepends=True)]
    at = next(k for k, one in enumerate(lines) if one["kind"] == "decision")
    hidden = lines[at]
    row = [hidden["time"], hidden["observation"], hidden["proposed"]]
    lines[at] = {"kind": "quiet", "clock": hidden["clock"], "before": [*hidden["before"], row]}
    head, forged = Head(0, NOTHING), b""
    for content in lines:
        line, head = seal(content, head)
        forged += line
    (tmp_path / "forged").write_bytes(forged)
    difference = audit(tmp_path / "forged").replay.difference
    assert difference.record == at + 1
    assert "nothing to speak of" in difference.explanation


def test_what_differs_is_named(driven, tmp_path):
    forge(driven, tmp_path / "forged", "decision", 3, with_other("executed", 1.25))
    difference = audit(tmp_path / "forged").replay.difference
    assert [one.name for one in difference.fields] == ["executed"]
    assert difference.fields[0].recorded == "1.25"


def test_a_log_of_a_newer_version_is_refused(driven, tmp_path):
    forge(driven, tmp_path / "newer", "start", 0, with_other("version", 99))
    with pytest.raises(ValueError, match="newer"):
        audit(tmp_path / "newer")


# -- When things go wrong -------------------------------------------------------------------------


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_process_that_was_killed_while_writing_loses_the_half_record(driven, tmp_path, data):
    whole = driven.read_bytes()
    path = tmp_path / "log"
    left = data.draw(st.integers(whole.index(b"\n") + 1, len(whole)))
    path.write_bytes(whole[:left])
    finished = whole[:left].count(b"\n")
    with AuditLog(path) as log:
        assert log.head.number == finished
        assert log.cut_off == left - (whole.rfind(b"\n", 0, left) + 1)
        guard = Guard.of(Unrevised(ACTIONS), audit=log)
        guard.end(failed=False)
    assert audit(path, log.head, replay=False).is_good
    again = contents(path)[finished]
    assert (again["kind"], again["cut_off"]) == ("start", log.cut_off)


def test_a_log_that_was_tampered_with_is_not_gone_on_with(driven, tmp_path):
    path = tmp_path / "log"
    path.write_bytes(driven.read_bytes().replace(b'"failed":false', b'"failed":true ', 1))
    before = path.read_bytes()
    with pytest.raises(ValueError, match="tampered with"):
        AuditLog(path)
    assert path.read_bytes() == before


def test_where_the_disk_is_full_it_drives_on_and_says_so_at_the_end(tmp_path, monkeypatch, caplog):
    path, learner = tmp_path / "log", Learner()
    log = AuditLog(path)
    append, decided = ChainedFile.append, []

    def full(self, content):
        if self.head.number == 4:
            raise OSError(errno.ENOSPC, "No space left on device")
        append(self, content)

    class Driver:
        def propose(self, observation, time=0.0):
            decided.append(time)
            return Proposal(2.5)

    monkeypatch.setattr(ChainedFile, "append", full)
    with caplog.at_level(logging.ERROR), pytest.raises(OSError, match="ends with record 4"):
        drive(log, scenario(duration=5.0), learner=learner, controller=Driver())
    assert decided[-1] >= 4.75
    assert len(caplog.records) == 1
    with pytest.raises(OSError, match="ends with record 4"):
        drive(log, scenario(), learner=learner)
    with pytest.raises(OSError, match="ends with record 4"):
        log.close()
    monkeypatch.undo()
    with AuditLog(path) as log:
        drive(log, scenario(), learner=learner)
    assert audit(path).is_good


def test_a_part_of_a_record_is_taken_back_where_the_disk_is_full(tmp_path):
    file = ChainedFile(tmp_path / "log")
    file.append({"kind": "note"})
    kept = (tmp_path / "log").read_bytes()

    class Full:
        def __init__(self, file):
            self.file = file

        def write(self, data):
            if len(data) < 60:
                raise OSError(errno.ENOSPC, "No space left on device")
            return self.file.write(data[: len(data) - 50])

        def __getattr__(self, name):
            return getattr(self.file, name)

    file._file = Full(file._file)
    with pytest.raises(OSError, match="No space"):
        file.append({"kind": "note", "text": "x" * 200})
    file.close()
    assert (tmp_path / "log").read_bytes() == kept


# -- Interrupts, forks, and readers meanwhile -----------------------------------------------------


class CtrlCError(KeyboardInterrupt):
    """Ctrl-C at a place of one's choice."""


@contextmanager
def interrupt(functions, at):
    """Ctrl-C before line ``at`` of those that run in some functions, or as one of them returns."""
    codes, left = {inspect.unwrap(function).__code__ for function in functions}, at

    def trace(frame, event, argument):
        nonlocal left
        if frame.f_code not in codes:
            return None
        if event in ("line", "return"):
            left -= 1
            if left == -1:
                raise CtrlCError
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield
    finally:
        sys.settrace(before)


def interrupted_everywhere(functions, run, every=1):
    """Run it until nothing interrupts it any more: where something did."""
    for at in range(0, 1000, every):
        try:
            with interrupt(functions, at):
                run(at)
        except CtrlCError:
            yield at
        else:
            return


def test_an_interrupt_while_a_record_is_written_breaks_no_chain(tmp_path):
    path = tmp_path / "log"
    with ChainedFile(path) as file:
        file.append({"kind": "note"})
        functions = (ChainedFile.append, ChainedFile.settle)
        for at in interrupted_everywhere(functions, lambda at: file.append({"value": at})):
            assert verify(path).finding is None
            if at % 2:
                with suppress(CtrlCError), interrupt(functions, at):  # and again
                    file.append({"kind": "another"})
            file.append({"kind": "after", "value": at})
            assert verify(path, file.head).finding is None
            assert verify(path).head == file.head
    assert at > 10
    assert verify(path, file.head).finding is None


def brief(log):
    """An episode of two decisions, of which one speaks."""
    risk = LatentRisk(ACTIONS.low)
    guard = Guard.of(ActionReviser(risk, ACTIONS), judge=risk, audit=log)
    for step in range(2):
        seen = np.array([60.0 - 40.0 * step, 15.0, 8.0])
        guard.revise(guard.recognise(seen, 0.25 * step), Proposal(0.0))
    guard.end(failed=False, observation=np.array([5.0, 15.0, 8.0]))


def test_an_interrupt_while_a_log_is_written_costs_that_episode_only(tmp_path, monkeypatch):
    monkeypatch.setattr(ChainedFile, "sync", lambda file: None)  # which takes its time
    path, functions = tmp_path / "log", (AuditLog._write, ChainedFile.append)
    with AuditLog(path) as log:
        times = len([*interrupted_everywhere(functions, lambda at: brief(log), every=4)])
        brief(log)
    result = audit(path, log.head)
    assert result.is_good
    assert result.contents.episodes > times / 2 > 4


def test_an_episode_that_goes_on_after_an_interrupt_is_not_written_any_more(tmp_path, caplog):
    path, risk = tmp_path / "log", LatentRisk(ACTIONS.low)
    with AuditLog(path) as log:
        guard = Guard.of(ActionReviser(risk, ACTIONS), judge=risk, audit=log)
        for step in range(6):
            seen = np.array([30.0 - 4.0 * step, 15.0, 8.0])
            situation = guard.recognise(seen, 0.25 * step)
            with suppress(CtrlCError):
                functions = (ChainedFile.sync,) if step == 3 else ()
                with interrupt(functions, 0):
                    guard.revise(situation, Proposal(1.0))
        guard.end(failed=False, observation=np.array([9.0, 15.0, 8.0]))
        brief(log)
    assert [one.message for one in caplog.records if "was interrupted" in one.message]
    result = audit(path, log.head)
    assert result.is_good
    assert result.contents.episodes == 2


def in_a_child(do):
    """Do it in a process that inherits everything: whether it raised nothing."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            do()
            code = 0
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="nothing can fork here")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_child_that_inherits_a_log_leaves_it_to_its_parent(tmp_path):
    path = tmp_path / "log"
    log = AuditLog(path, most_quiet=50)
    guard = Guard.of(Unrevised(ACTIONS), audit=log)

    def decide(time):
        situation = guard.recognise(np.array([50.0, 9.0, 9.0]), time)
        guard.revise(situation, Proposal(0.5))

    def drive_on():
        decide(1.0)
        with pytest.raises(OSError, match="belongs to the process"):
            guard.end(failed=False)
        with pytest.raises(OSError, match="belongs to the process"):
            log.close()

    decide(0.0)
    assert in_a_child(log.close)
    assert in_a_child(drive_on)
    assert kinds(path) == ["start", "begin"]
    decide(1.0)
    guard.end(failed=False)
    log.close()
    result = audit(path, log.head)
    assert result.is_good
    assert result.replay.decisions == 2


@pytest.mark.skipif(not hasattr(os, "fork"), reason="nothing can fork here")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_child_that_lives_on_does_not_keep_a_log_that_its_parent_closed(tmp_path):
    reading, writing = os.pipe()
    file = ChainedFile(tmp_path / "log")
    child = os.fork()
    if child == 0:
        os.read(reading, 1)
        os._exit(0)
    try:
        file.close()
        ChainedFile(tmp_path / "log").close()
    finally:
        os.write(writing, b".")
        os.waitpid(child, 0)
        os.close(reading)
        os.close(writing)


def test_of_a_log_that_grows_what_was_there_at_first_is_read(tmp_path, monkeypatch):
    path = tmp_path / "log"
    with ChainedFile(path) as file:
        for _ in range(3):
            file.append({"kind": "note"})
        size = path.stat().st_size
        reading = chain.lines(path)
        first = next(reading)
        file.append({"kind": "note", "text": "x" * 100_000})
        assert len(first + b"".join(reading)) == size
        unseal = chain.unseal

        def slowly(line):
            file.append({"kind": "note"})
            return unseal(line)

        monkeypatch.setattr(chain, "unseal", slowly)
        found = verify(path)
    assert found.finding is None
    assert (found.head.number, found.half_written) == (4, 0)


# -- Gymnasium ------------------------------------------------------------------------------------


def test_a_wrapped_environment_is_audited(tmp_path):
    pytest.importorskip("gymnasium")
    from evofsm.driving.env import CarFollowing
    from evofsm.guard.gym import RevisedActions

    env = CarFollowing()
    risk = LatentRisk(env.family.actions.low, env.family.interval)
    reviser = ActionReviser(risk, env.family.actions)
    machine = EvolvingFSM(env.family.actions.n_actions, radius=4.0)
    with AuditLog(tmp_path / "log") as log:
        guard = Guard.of(reviser, machine=machine, interval=env.family.interval, audit=log)
        env = RevisedActions(env, guard, failed=lambda info: info["failed"])
        steps = 0
        for seed in (1, 2):
            env.reset(seed=seed)
            over = False
            while not over:
                _, _, terminated, truncated, _ = env.step(env.action_space.high)
                over, steps = terminated or truncated, steps + 1
    result = audit(tmp_path / "log", log.head)
    assert result.is_good
    assert result.replay.decisions == steps
    assert result.contents.episodes == 2


def _is_too_close(z):
    return bool(z[0] <= 6.0)


def test_a_guard_that_was_told_where_it_fails_is_replayed_with_that_function_alone(tmp_path):
    path = tmp_path / "log"
    with AuditLog(path) as log:
        guard = Guard(low=-2.5, high=2.5, interval=0.25, failed=_is_too_close, audit=log)
        for _ in range(6):
            gap, speed = 30.0, 10.0
            while gap > 6.0:
                speed = max(0.0, speed + 0.25 * guard.decide([gap, speed], 1.0).executed)
                gap += 0.25 * (8.0 - speed)
                if speed < 8.0:
                    break
            guard.end(observation=[gap, speed])
    without, with_it = audit(path), audit(path, failed=_is_too_close)
    assert without.is_good
    assert without.replay.decisions == 0
    assert "--failed MODULE:FUNCTION" in without.replay.not_replayed[0]
    assert with_it.is_good
    assert with_it.replay.decisions == with_it.contents.decisions > 20
    assert with_it.replay.not_replayed == ()
    wrong = audit(path, failed=lambda z: bool(z[0] <= 20.0))
    assert wrong.replay.difference is not None

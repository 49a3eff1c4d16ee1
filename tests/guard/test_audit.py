"""The audit log: what is tampered with is found where it was, and what is replayed is the same."""

import copy
import json
import logging
import math
import os
from functools import partial
from hashlib import sha256
from inspect import getfile
from multiprocessing import get_context

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import one_machine
from evofsm import Guard, IntervalActions
from evofsm.driving import EnvelopeReviser, LatentRisk, Unrevised, guard_for_cars, measures
from evofsm.guard import ActionReviser, AuditLog, Head, Mode, Proposal, audit, audit_log
from evofsm.guard.audit_log import FIELDS, NOTHING, Chain, canonical, seal, unseal

ACTIONS = IntervalActions(low=-2.5, high=2.5, width=0.3, outside="clip")


def cars(log=None, reviser=None, judge=None):
    """A guard of cars, which asks one judge and teaches it, or another one."""
    guard = guard_for_cars(-2.5, 2.5)
    reviser, judge = reviser or ActionReviser(guard.judge, ACTIONS), judge or guard.judge
    return Guard.of(reviser, interval=0.25, machine=guard.machine, judge=judge, audit=log)


def drive(guard, brake=8, steps=24, wanted=lambda k: 2.0):
    """Behind a leader who brakes at some decision; the revisions."""
    (gap, speed, ahead), said = (30.0, 15.0, 15.0), []
    for k in range(steps):
        said.append(guard.decide([gap, speed, ahead], wanted(k)))
        ahead = max(0.0, ahead - (1.0 if k >= brake else 0.0))
        speed = max(0.0, speed + 0.25 * said[-1].executed)
        gap += 0.25 * (ahead - speed)
        if gap <= 0.0:
            break
    guard.end(gap <= 0.0, [gap, speed, ahead])
    return said


def contents(path):
    return [json.loads(line) for line in path.read_bytes().splitlines()]


def kinds(path):
    return [record["kind"] for record in contents(path)]


def verified(path, kept=None):
    chain = Chain(path, kept)
    for _ in chain.records():
        pass
    return chain


# -- The chain ------------------------------------------------------------------------------------

RECORDS = 7


def written(count=RECORDS):
    """Lines of a small log, and its head."""
    lines, head = [], NOTHING
    for k in range(count):
        line, head = seal({"kind": "note", "value": k / 3, "text": "a, b"}, head)
        lines.append(line)
    return lines, head


def found(folder, lines, kept=None):
    """The number of the first bad record; None if there is none."""
    path = folder / "log.jsonl"
    path.write_bytes(b"".join(lines))
    finding = verified(path, kept).finding
    assert finding is None or str(finding.record) in finding.explanation or kept
    return finding and finding.record


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("chain")


places = st.integers(1, RECORDS)
inner = st.integers(1, RECORDS - 1)


@given(places, st.data(), st.integers(0, 255))
def test_any_byte_that_is_changed_is_found_in_its_record(folder, at, data, new):
    lines, _ = written()
    place = data.draw(st.integers(0, len(lines[at - 1]) - 2))
    line = bytearray(lines[at - 1])
    line[place] = new ^ (line[place] == new)
    lines[at - 1] = bytes(line)
    assert found(folder, lines) == at


@given(inner, st.sampled_from(["kind", "value", "text", "number"]))
def test_a_record_that_is_changed_with_its_hash_is_found_by_the_one_after(folder, at, field):
    lines, _ = written()
    record = unseal(lines[at - 1])
    content = {"number": at, "previous": record.previous, **record.content, field: 99}
    text = canonical(content)[:-1].encode()
    lines[at - 1] = text + b',"hash":"' + sha256(text).hexdigest().encode() + b'"}\n'
    assert found(folder, lines) == at


@given(places, places, st.sampled_from(["remove", "swap", "move", "repeat", "insert"]))
def test_records_that_are_not_there_once_in_their_order_are_found(folder, one, other, how):
    lines, _ = written()
    first = min(one, other)
    match how:
        case "remove":  # not the last, which nothing follows
            first = min(first, RECORDS - 1)
            del lines[first - 1 : min(max(one, other), RECORDS - 1)]
        case "swap":
            lines[one - 1], lines[other - 1] = lines[other - 1], lines[one - 1]
        case "move":
            lines.insert(other - 1, lines.pop(one - 1))
        case "repeat":
            lines.insert(max(one, other), lines[first - 1])
        case "insert":  # well chained to the one before, or not
            before = unseal(lines[first - 2]).digest if first > 1 else NOTHING.digest
            after = Head(first - 1, before if one < other else "1" * 64)
            lines.insert(first - 1, seal({"kind": "note", "text": "forged"}, after)[0])
    assert found(folder, lines) == (None if one == other and how in ("swap", "move") else first)


@given(inner, places)
def test_an_end_that_is_cut_off_and_a_log_written_anew_show_with_the_head_only(folder, left, at):
    lines, kept = written()
    assert found(folder, lines[:left]) is None
    assert found(folder, lines[:left], kept) == left + 1
    forged, head = [], NOTHING
    for k, line in enumerate(lines, 1):
        content = unseal(line).content
        anew, head = seal({**content, "value": 9.0} if k == at else content, head)
        forged.append(anew)
    assert found(folder, forged) is None
    assert found(folder, forged, kept) == RECORDS


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
    for text in (b'{"precious":1}', *written(1)[0]):  # or has one, and is a chain of other records
        path.write_bytes(text)
        with pytest.raises(ValueError, match="left alone"):
            AuditLog(path)
        assert path.read_bytes() == text
    path.write_bytes(b'{"about":"evofsm audit log","act')
    AuditLog(path).close()
    assert path.read_bytes() == b""


def test_one_writes_at_a_time_and_between_episodes_of_a_guard_only(tmp_path):
    pytest.importorskip("fcntl")
    with AuditLog(tmp_path / "log") as log:
        with pytest.raises(ValueError, match="another process"):
            AuditLog(tmp_path / "log")
        guard = cars()
        guard.decide([50.0, 9.0, 9.0], 0.0)
        guard.audit = log
        with pytest.raises(ValueError, match="within an episode"):
            guard.decide([50.0, 9.0, 9.0], 0.0)
        guard.begin()
        guard.decide([50.0, 9.0, 9.0], 0.0)
        with pytest.raises(ValueError, match="one decision on an observation"):
            guard.revise(guard.situation, Proposal(1.0))


# -- What is written ------------------------------------------------------------------------------


def test_decisions_that_changed_something_are_written_in_full_and_others_in_short(tmp_path):
    path = tmp_path / "log"
    with AuditLog(path) as log:
        said = drive(cars(log))
    decisions = [record for record in contents(path) if record["kind"] == "decision"]
    spoke = [one for one in said if one.executed != one.proposed or one.risk_proposed > 0.02]
    assert 3 < len(spoke) < len(said) - 3
    for name in ("executed", "reason", "risk_executed"):
        assert [one[name] for one in decisions] == [getattr(one, name) for one in spoke]
    assert all(one["explanation"].startswith(f"#{one['state'] + 1}: ") for one in decisions)
    assert kinds(path).count("quiet") + len(spoke) == len(said)
    assert (kinds(path)[:2], kinds(path)[-1]) == (["start", "begin"], "end")


def test_what_was_changed_is_on_the_disk_before_it_is_executed(tmp_path, monkeypatch):
    forced = []
    monkeypatch.setattr(audit_log, "_MOST_QUIET", 4)
    monkeypatch.setattr(os, "fsync", lambda file: forced.append(log.head.number))
    with AuditLog(tmp_path / "each") as log:
        drive(cars(log))
        every = enumerate(kinds(log.path), 1)
        assert forced == [n for n, kind in every if kind != "quiet" or n % 4 == 0]
    forced.clear()
    with AuditLog(tmp_path / "episodes", sync="episode") as log:
        guard = cars(log)
        drive(guard)
        drive(guard)
        assert len(forced) == 4  # as each begins and ends


# -- Replaying ------------------------------------------------------------------------------------


def test_a_log_is_gone_on_with_and_what_was_learnt_elsewhere_is_written_anew(tmp_path):
    path, guard = tmp_path / "log", cars()
    for logs in (True, True, False, True):
        with AuditLog(path) as log:
            guard.audit = log if logs else None
            drive(guard)
            drive(guard)
    assert kinds(path).count("start") == 3  # as each log is opened
    with AuditLog(path) as guard.audit:
        drive(guard)
        log, guard.audit = guard.audit, None
        drive(guard)
        guard.audit = log
        drive(guard)
    result = audit(path)
    assert result.is_good
    assert (result.contents.sessions, result.contents.episodes) == (5, 8)


def test_who_takes_over_is_written_and_replayed(tmp_path):
    path = tmp_path / "log"

    def wanted(k):
        if k == 8:
            guard.reviser.mode = Mode.SHADOW
        if k == 12:
            guard.reviser.mode, guard.reviser.tolerance = Mode.ACT, 0.1
        return 2.5

    with AuditLog(path) as log:
        guard = cars(log)
        drive(guard, wanted=wanted)
    changes = [one["settings"]["reviser"] for one in contents(path) if one["kind"] == "settings"]
    assert [(one["mode"], one["tolerance"]) for one in changes] == [("shadow", 0.02), ("act", 0.1)]
    assert audit(path).is_good
    assert audit(path).contents.settings == 2


def test_sensors_and_controllers_that_fail_are_written_and_come_out_the_same(tmp_path):
    path = tmp_path / "log"
    gaps = {0.0: 30.0, 0.25: math.nan, 0.5: 29.0, 2.0: 20.0, 2.25: 18.0}
    came = (0.0, 0.25, 0.5, 0.5, 0.25, 2.0, 2.25)  # one is missing, twice, late, after a hole
    wanted = (-0.5, -0.5, math.nan, 99.0, math.inf, -0.5, -0.5)
    with AuditLog(path) as log:
        guard = cars(log)
        for when, proposed in zip(came, wanted, strict=True):
            guard.decide([gaps[when], 15.0, 12.0], proposed, when)
        guard.recognise([16.0, 13.0, 7.0], 2.5)  # nothing is decided
        guard.end(failed=False, observation=[14.0, 12.0, 6.0])
    told = [one["proposed"] for one in contents(path) if one["kind"] == "decision"]
    assert [proposed for proposed in told if proposed != -0.5] == ["NaN", 99.0, "Infinity"]
    result = audit(path)
    assert (result.is_good, result.replayed) == (True, len(came))


def test_what_came_in_last_before_an_episode_was_broken_off_is_written_and_replayed(tmp_path):
    with AuditLog(tmp_path / "log") as log:
        guard = cars(log)
        for _ in range(2):  # another episode begins; the log is closed
            guard.begin()
            guard.recognise([30.0, 15.0, 12.0], 0.0)
    rows = [record for record in contents(tmp_path / "log") if record["kind"] == "seen"]
    assert [(row["time"], row["observation"]) for row in rows] == [(0.0, [30.0, 15.0, 12.0])] * 2
    assert audit(tmp_path / "log", log.head).is_good


def test_what_is_not_known_is_verified_and_said_not_to_be_replayed(tmp_path):
    with AuditLog(tmp_path / "log") as log:
        known = drive(cars(log, EnvelopeReviser(measures.TimeToCollision(4.0), ACTIONS)))
        own = type("Own", (Unrevised,), {})  # no package declares it
        drive(cars(log, own(ACTIONS)))
        drive(cars(log, judge=LatentRisk(-2.5, 0.25)))  # another one than its reviser asks
        guard = Guard(-2.5, 2.5, interval=0.25, audit=log, model=lambda z, u: z)
        drive(guard)
        guard.freeze()  # from here on nothing of the functions is asked
        frozen = drive(guard)
        assert copy.deepcopy(guard).audit is None
    result = audit(tmp_path / "log", log.head)
    assert (result.is_good, result.replayed) == (True, len(known) + len(frozen))
    assert [why.split()[0] for why in result.not_replayed] == ["Own", *["ActionReviser"] * 2]


# -- Forging --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    path = tmp_path_factory.mktemp("driven") / "log"
    with AuditLog(path) as log:
        guard = cars(log)
        drive(guard)
        drive(guard, brake=10)
    return path


def forge(path, target, kind, which, change):
    """Change a record, and chain all anew: the record's number."""
    lines = [unseal(line).content for line in path.read_bytes().splitlines(keepends=True)]
    number = [k for k, one in enumerate(lines, 1) if one["kind"] == kind][which]
    change(lines[number - 1])
    head, forged = NOTHING, b""
    for content in lines:
        line, head = seal(content, head)
        forged += line
    target.write_bytes(forged)
    assert verified(target).finding is None
    return number


def other(name, value):
    return lambda content: content.update({name: value})


def become(kind):
    """A record of a kind that holds less."""

    def change(content):
        kept = {name: content[name] for name in (*FIELDS[kind], "clock")}
        content.clear()
        content.update(kind=kind, **kept)

    return change


REPLAYED = {
    "hidden": ("decision", 0, become("quiet")),  # as if the proposal had been executed
    "executed": ("decision", 3, lambda it: it.update(executed=math.nextafter(it["executed"], 9))),
    "observation": ("decision", 3, other("observation", [90.0, 15.0, 15.0])),
    "reason": ("decision", 2, other("reason", "the driver wished it")),
    "explanation": ("decision", 4, other("explanation", "all was well here")),
    "learnt": ("end", 0, lambda content: content["learnt"].update(judge="0" * 64)),
    "nothing learnt": ("end", 0, other("learnt", {})),
    "a flag that is none": ("end", 0, other("failed", 0)),
    "no number": ("decision", 1, other("observation", ["x", 1.0, 2.0])),
    "no guard": ("start", 0, other("guard", "AAAA")),
    "failed": ("end", 0, other("failed", True)),  # the machine learns it, and says so at the end
    "mode": ("start", 0, lambda one: one["settings"]["reviser"].update(mode="shadow")),
}
MISFITS = {
    **{f"version {one!r}": ("start", other("version", one)) for one in (0, 99, 1.0, True, "1")},
    "no version": ("start", lambda content: content.pop("version")),
    "before the first guard": ("start", become("begin")),
    "another kind": ("end", other("kind", "nonsense")),
    "no explanation": ("decision", lambda content: content.pop("explanation")),
    "what nobody writes": ("decision", other("comment", "all was well")),
    "a part of a row": ("quiet", lambda content: content.pop("mask")),
}


@pytest.mark.parametrize("name", REPLAYED)
def test_a_forgery_behind_a_chain_that_was_made_anew_is_found_by_replaying(driven, tmp_path, name):
    number = forge(driven, tmp_path / "forged", *REPLAYED[name])
    result = audit(tmp_path / "forged")
    assert (result.finding, result.is_good, result.difference.record) == (None, False, number)


@pytest.mark.parametrize(("kind", "change"), MISFITS.values(), ids=MISFITS.keys())
def test_what_no_log_holds_is_a_forgery(driven, tmp_path, kind, change):
    number = forge(driven, tmp_path / "forged", kind, 0, change)
    result = audit(tmp_path / "forged")
    assert result.finding.record == number
    assert "was forged" in result.finding.explanation


def test_a_name_given_twice_is_found_behind_its_own_hash_and_who_made_a_log_is_named(
    driven, tmp_path
):
    """Some readers take the first of them, others the last."""
    lines = driven.read_bytes().splitlines(keepends=True)
    text = lines[-1].rpartition(b',"hash":"')[0]
    twice = text.replace(b'"failed":false', b'"failed":true,"failed":false')
    assert twice != text
    lines[-1] = twice + b',"hash":"' + sha256(twice).hexdigest().encode() + b'"}\n'
    (tmp_path / "forged").write_bytes(b"".join(lines))
    assert audit(tmp_path / "forged").finding.record == len(lines)
    forge(driven, tmp_path / "forged", "start", 0, lambda one: one["made_by"].update(numpy="1.0"))
    (other_maker,) = audit(tmp_path / "forged").other_makers
    assert (other_maker.name, other_maker.recorded) == ("numpy", "1.0")


# -- When things go wrong -------------------------------------------------------------------------


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_process_that_was_killed_while_writing_loses_the_half_record(driven, tmp_path, data):
    whole, path = driven.read_bytes(), tmp_path / "log"
    left = data.draw(st.integers(whole.index(b"\n") + 1, len(whole)))
    path.write_bytes(whole[:left])
    finished = whole[:left].count(b"\n")
    with AuditLog(path) as log:
        assert log.head.number == finished
        Guard.of(Unrevised(ACTIONS), interval=0.25, audit=log).end(failed=False)
    assert audit(path, log.head).is_good
    assert contents(path)[finished]["kind"] == "start"


def test_a_log_that_was_tampered_with_is_not_gone_on_with(driven, tmp_path):
    path = tmp_path / "log"
    path.write_bytes(driven.read_bytes().replace(b'"failed":false', b'"failed":true ', 1))
    before = path.read_bytes()
    with pytest.raises(ValueError, match="tampered with"):
        AuditLog(path)
    assert path.read_bytes() == before


def test_where_the_disk_is_full_it_drives_on_and_says_so_at_the_end(tmp_path, caplog, full_at):
    path, decided = tmp_path / "log", []
    log = AuditLog(path)
    guard = cars(log)
    drive(guard)
    kept, number = path.read_bytes(), log.head.number
    with full_at(len(kept) + 1500):  # which takes a part of a record
        with caplog.at_level(logging.ERROR), pytest.raises(OSError, match="ends with record"):
            drive(guard, wanted=lambda k: decided.append(k) or 2.5)
        assert decided[-1] == 23
        assert len(caplog.records) == 1
        with pytest.raises(OSError, match=f"ends with record {log.head.number}"):
            drive(guard)
        with pytest.raises(OSError, match="ends with record"):
            log.close()
    assert log.head.number > number
    assert path.read_bytes().startswith(kept)
    assert path.read_bytes().endswith(b"\n")  # the part of a record was taken back
    guard.audit = None
    guard.end()
    with AuditLog(path) as guard.audit:
        drive(guard)
    assert audit(path).is_good


def test_what_an_interrupt_breaks_off_is_done_again_and_written_once(tmp_path, monkeypatch):
    """At every second line of the log's and the guard's, in every call of an episode."""
    monkeypatch.setattr(audit_log, "_MOST_QUIET", 2)
    monkeypatch.setattr(one_machine, "_PACKAGE", (getfile(AuditLog), getfile(Guard)))
    written, times = [], 0
    for path in (tmp_path / "told", tmp_path / "again"):
        with AuditLog(path, sync="episode") as log:
            guard = cars(log)
            calls = [
                partial(guard.decide, [30.0 - 4.0 * k, 15.0, 8.0], 1.0, 0.25 * k) for k in range(6)
            ]
            for call in [*calls, partial(guard.end, False, [9.0, 15.0, 8.0])]:
                for at in range(1, 1_000, 2) if written else ():
                    try:
                        with one_machine.Interrupter(at):
                            call()
                        break
                    except KeyboardInterrupt:
                        times += 1
                else:
                    call()
        assert audit(path, log.head).is_good
        written.append([{**one.content, "clock": ""} for one in Chain(path).records()])
    assert written[0] == written[1]
    assert times > 100


@pytest.mark.skipif(not hasattr(os, "fork"), reason="nothing can fork here")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")  # there are threads
def test_a_child_that_inherits_a_log_leaves_it_to_its_parent(tmp_path):
    path = tmp_path / "log"
    log = AuditLog(path)
    guard = Guard.of(Unrevised(ACTIONS), interval=0.25, audit=log)

    def drive_on():
        guard.decide([50.0, 9.0, 9.0], 0.5)
        with pytest.raises(OSError, match="belongs to the process"):
            guard.end(failed=False)
        log.close()

    guard.decide([50.0, 9.0, 9.0], 0.5)
    for work in (log.close, drive_on):
        child = get_context("fork").Process(target=work)
        child.start()
        child.join()
        assert child.exitcode == 0
    assert kinds(path) == ["start", "begin", "quiet"]
    guard.decide([50.0, 9.0, 9.0], 0.5)
    guard.end(failed=False)
    log.close()
    assert audit(path, log.head).is_good
    assert audit(path).replayed == 2


def test_a_child_that_lives_on_does_not_keep_a_log_that_its_parent_closed(tmp_path):
    log = AuditLog(tmp_path / "log")
    inherited = os.dup(log._file.fileno())
    log.close()
    AuditLog(tmp_path / "log").close()
    os.close(inherited)

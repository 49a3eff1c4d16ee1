import hashlib
import io
import json
import os
import pickle
import resource
import signal
import stat
import sys
import threading
import tracemalloc
import warnings
import zipfile
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from evofsm import __version__
from evofsm.driving.risk.latent import LatentRisk
from evofsm.driving.risk.ranges import hardest_seen
from evofsm.driving.risk.rehearsal import HARDEST
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.crowding import WhenFull
from evofsm.fsm.dynamics.dynamics import Dynamics
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.model import FSMModel
from evofsm.fsm.states.failure import FailureSplit
from evofsm.fsm.states.novelty import Novelty
from evofsm.fsm.states.paper import Paper
from evofsm.store import ranges, storage
from evofsm.store.storage import kind_of


def full_model(grown):
    return grown.model(
        actions=IntervalActions(-0.5, 1.0, 0.5, closed="right", outside="clip"),
        names=("gap", "speed"),
        units=("m", "m/s"),
        dt=0.01,
    )


@pytest.fixture
def forged(monkeypatch):
    """Change arrays (their first number) or settings of a file; its checksum is then right."""

    def forge(path, changes):
        kind = storage.kind_of(path)
        content, arrays = storage.read(path, kind)
        for name, value in changes.items():
            if name in arrays:
                arrays[name].flat[0] = value
            else:
                content[name] = value
        with monkeypatch.context() as patched:
            patched.setattr(ranges, "refuse_others", lambda *_: None)
            storage.write(path, kind, content, arrays)

    return forge


def zip_of(**members):
    """A ZIP archive with the given members, as bytes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members.items():
            archive.writestr(name.replace("_npy", ".npy"), content)
    return file.getvalue()


def npz(header, **arrays):
    """What the library writes, with any header and arrays, as bytes."""
    file = io.BytesIO()
    encoded = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(file, header=encoded, **arrays)
    return file.getvalue()


# -- Machines ----------------------------------------------------------------------------------


def untouched(machine):
    return EvolvingFSM(n_actions=3, radius=0.01)


def in_mid_episode_with_an_action_pending(machine):
    return machine


def in_mid_episode_without_an_action(machine):
    machine.observe([0.1, 0.1])
    return machine


def between_episodes(machine):
    machine.start_episode()
    return machine


@pytest.mark.parametrize(
    "situation",
    [
        untouched,
        in_mid_episode_with_an_action_pending,
        in_mid_episode_without_an_action,
        between_episodes,
    ],
)
def test_a_loaded_machine_goes_on_bit_for_bit(situation, grown, spiral, snapshot, tmp_path):
    machine = situation(grown)
    machine.save(tmp_path / "machine")
    loaded = EvolvingFSM.load(tmp_path / "machine")
    assert repr(loaded) == repr(machine)
    assert snapshot(loaded) == snapshot(machine)
    Z, I = spiral(100)[::-1], np.arange(100) % 3
    traces = [m.learn_many(Z, I, belief=True) for m in (machine, loaded)]
    for a, b in zip(*traces, strict=True):
        assert a.tobytes() == b.tobytes()
    assert snapshot(loaded) == snapshot(machine)


def test_saving_changes_nothing_in_the_machine(grown, spiral, tmp_path):
    twin = grown.copy()
    grown.save(tmp_path / "machine")
    surprise = [m.learn_many(spiral(30), [0, 1, 2] * 10).surprise for m in (grown, twin)]
    assert surprise[0].tobytes() == surprise[1].tobytes()


def test_a_file_says_what_it_holds(grown, tmp_path):
    grown.save(tmp_path / "machine")
    grown.model().save(tmp_path / "model")
    assert kind_of(tmp_path / "machine") == "machine"
    assert kind_of(str(tmp_path / "model")) == "model"


# -- Models ------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [full_model, EvolvingFSM.model, lambda _: EvolvingFSM(2).model()])
def test_a_loaded_model_has_every_field_of_the_saved_one(make, grown, tmp_path):
    model = make(grown)
    model.save(tmp_path / "model")
    loaded = FSMModel.load(tmp_path / "model")
    for field in fields(FSMModel):
        value, expected = getattr(loaded, field.name), getattr(model, field.name)
        if isinstance(expected, np.ndarray):
            assert (value.shape, value.tobytes()) == (expected.shape, expected.tobytes())
            assert not value.flags.writeable
        else:
            assert value == expected
            assert type(value) is type(expected) or field.name == "width"


# -- Files that are something else -------------------------------------------------------------


def test_a_machines_file_is_no_models_and_the_reverse(grown, tmp_path):
    path = tmp_path / "file"
    grown.save(path)
    with pytest.raises(ValueError, match=f"{path} holds a machine, not a model"):
        FSMModel.load(path)
    grown.model().save(path)
    with pytest.raises(ValueError, match=f"{path} holds a model, not a machine"):
        EvolvingFSM.load(path)


HEADER = {"format": "evofsm", "version": 1, "kind": "machine", "content": {"n_actions": 1}}


OTHERS = {
    "empty": b"",
    "a table": b"gap,speed\n1.0,2.0\n",
    "a pickle": pickle.dumps({"header": 1}),
    "an empty ZIP": zip_of(),
    "a ZIP of a text": zip_of(readme="hello"),
    "a ZIP of a text called header": zip_of(header="hello"),
    "a ZIP of a text called header.npy": zip_of(header_npy="hello"),
    "a header that is a list": npz([]),
    "a header without entries": npz({}),
    "another format": npz({**HEADER, "format": "other"}),
    "a version that is no number": npz({**HEADER, "version": "new"}),
    "no kind": npz({name: HEADER[name] for name in ("format", "version", "content")}),
    "no content": npz({name: HEADER[name] for name in ("format", "version", "kind")}),
}


@pytest.mark.parametrize("which", [EvolvingFSM, FSMModel])
@pytest.mark.parametrize("content", OTHERS.values(), ids=OTHERS.keys())
def test_any_other_file_is_refused_by_name(which, content, tmp_path):
    path = tmp_path / "other"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=str(path)):
        which.load(path)


def test_what_a_file_without_a_kind_holds_cannot_be_told(tmp_path):
    path = tmp_path / "other"
    path.write_bytes(OTHERS["no kind"])
    with pytest.raises(ValueError, match=str(path)):
        kind_of(path)


@pytest.mark.parametrize("content", [{}, [], {"n_actions": 0}, {"n_actions": 1, "gain": 2.0}])
def test_a_header_that_makes_no_sense_is_refused_by_name(content, tmp_path):
    path = tmp_path / "other"
    path.write_bytes(npz({**HEADER, "content": content}, centers=np.zeros((1, 1))))
    for load in (EvolvingFSM.load, FSMModel.load):
        with pytest.raises(ValueError, match=str(path)):
            load(path)


def test_a_file_of_a_newer_version_asks_for_a_newer_library(tmp_path):
    path = tmp_path / "newer"
    path.write_bytes(npz({**HEADER, "version": 10}))
    with pytest.raises(ValueError, match=r"version 10 is newer.*a newer evofsm reads it"):
        EvolvingFSM.load(path)


class Bomb:
    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return Path.touch, (self.target,)


def test_a_pickle_inside_is_refused_and_never_run(grown, tmp_path):
    path, touched = tmp_path / "machine", tmp_path / "touched"
    grown.save(path)
    with np.load(path) as archive:
        arrays = dict(archive)
    arrays["belief"] = np.array([Bomb(touched)], dtype=object)
    with path.open("wb") as file:
        np.savez(file, **arrays)
    for load in (EvolvingFSM.load, FSMModel.load):
        with pytest.raises(ValueError, match=str(path)):
            load(path)
    assert not touched.exists()


@pytest.mark.parametrize("which", [EvolvingFSM, FSMModel])
def test_a_file_that_lost_an_array_or_has_one_of_another_shape_is_refused(which, grown, tmp_path):
    path = tmp_path / "damaged"
    (grown if which is EvolvingFSM else grown.model()).save(path)
    with np.load(path) as archive:
        arrays = dict(archive)
    for name in set(arrays) - {"header"}:
        without = {key: value for key, value in arrays.items() if key != name}
        for damaged in (without, {**arrays, name: np.zeros((7, 7, 7, 7))}):
            with path.open("wb") as file:
                np.savez(file, **damaged)
            with pytest.raises(ValueError, match=str(path)):
                which.load(path)


@pytest.mark.parametrize("which", [EvolvingFSM, FSMModel])
def test_a_file_cut_off_anywhere_is_refused(which, grown, tmp_path):
    path = tmp_path / "cut"
    (grown if which is EvolvingFSM else grown.model()).save(path)
    whole = path.read_bytes()
    for length in range(0, len(whole), 97):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=str(path)):
            which.load(path)


def test_a_file_with_a_flipped_byte_is_refused_or_gives_the_same_machine(snapshot, tmp_path):
    machine, path = EvolvingFSM(n_actions=1), tmp_path / "flipped"
    machine.learn_many([[0.0], [2.0], [1.0]], [0, 0, 0])
    machine.save(path)
    expected, whole = snapshot(machine), path.read_bytes()
    refusals = []
    for place in range(0, len(whole), 41):
        damaged = bytearray(whole)
        damaged[place] ^= 0xFF
        path.write_bytes(damaged)
        try:
            loaded = EvolvingFSM.load(path)
        except ValueError as error:
            refusals.append(str(error))
        else:
            assert snapshot(loaded) == expected
    assert refusals
    assert all(str(path) in refusal for refusal in refusals)


# -- Saving that fails -------------------------------------------------------------------------


def test_a_missing_folder_is_named(grown, tmp_path):
    missing = tmp_path / "missing"
    for item in (grown, grown.model()):
        with pytest.raises(FileNotFoundError, match=f"no folder {missing}"):
            item.save(missing / "file")


def test_a_missing_file_is_named(tmp_path):
    for load in (EvolvingFSM.load, FSMModel.load):
        with pytest.raises(FileNotFoundError, match="missing"):
            load(tmp_path / "missing")


@pytest.fixture
def full_disk():
    """No file may grow beyond 100 bytes, which the system reports like a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

    def fill():
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))

    def free():
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    yield fill, free
    free()
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("old", [None, b"what was there before"])
def test_a_save_that_fails_leaves_the_folder_as_it_was(old, grown, full_disk, tmp_path):
    fill, free = full_disk
    path = tmp_path / "machine"
    if old is not None:
        path.write_bytes(old)
    for item in (grown, grown.model()):
        fill()
        try:
            with pytest.raises(OSError, match=r"File too large"):
                item.save(path)
        finally:
            free()
        assert [p.read_bytes() for p in tmp_path.iterdir()] == ([] if old is None else [old])


def test_saving_onto_a_folder_leaves_no_temporary_file(grown, tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(OSError, match="folder"):
        grown.save(folder)
    assert list(tmp_path.iterdir()) == [folder]


def test_saving_replaces_what_was_there(grown, snapshot, tmp_path):
    path = tmp_path / "machine"
    path.write_bytes(b"something longer than nothing" * 1000)
    grown.save(str(path))
    assert snapshot(EvolvingFSM.load(str(path))) == snapshot(grown)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("n_states", 1e6, "n_states is 1e"),
        ("n_states", -3.0, "n_states of -3"),
        ("n_states", 0.5, "n_states holds a fraction"),
        ("action", 1e9, "action is 1e"),
        ("action", 0.5, "action holds a fraction"),
        ("belief", np.nan, "belief of nan"),
        ("belief", 0.5, "belief is no distribution"),
        ("matrices", 7.0, "a row of matrices is no distribution"),
        ("scatter", -1.0, "scatter of -1"),
        ("centers", 1e308, r"centers of 1e\+308"),
        ("visits", -1.0, "visits of -1"),
        ("decisions", -1.0, "decisions of -1"),
        ("failures", 1e9, "failures cannot be more than decisions"),
        ("endings", -1.0, "endings of -1"),
    ],
)
def test_numbers_that_learning_could_not_have_left_are_refused(
    grown, forged, tmp_path, name, value, words
):
    grown.save(tmp_path / "machine")
    forged(tmp_path / "machine", {name: value})
    with pytest.raises(ValueError, match=words):
        EvolvingFSM.load(tmp_path / "machine")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("transition_matrices", np.nan, "transition_matrices of nan"),
        ("visits", -1.0, "visits of -1"),
        ("centers", -1e308, r"centers of -1e\+308"),
        ("width", np.nan, "width of nan"),
        ("width", -1.0, "width of -1"),
        ("dt", 1e308, r"dt of 1e\+308"),
        ("settings", {"spread": 1e308}, r"settings.spread of 1e\+308"),
        ("settings", {"failure_horizon": 0.5}, "settings.failure_horizon of 0.5"),
        ("actions", {"low": -1e308, "high": 0.0, "width": 1e308}, "actions.low of -1e"),
    ],
)
def test_a_model_that_no_learning_could_have_left_is_refused(
    grown, forged, tmp_path, name, value, words
):
    full_model(grown).save(tmp_path / "model")
    forged(tmp_path / "model", {name: value})
    with pytest.raises(ValueError, match=words):
        FSMModel.load(tmp_path / "model")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("radius", 1e308, r"radius of 1e\+308"),
        ("max_states", 0.5, "max_states of 0.5"),
        ("learning_rate", 1.0, "learning_rate of 1"),
        ("spread", "wide", "spread is 'wide'; it must be a number"),
        ("radius", True, "radius is True; it must be a number"),
        ("rule", {"name": "novelty", "scales": [1e308, 1.0]}, r"rule.scales of 1e\+308"),
        (
            "rule",
            {"name": "failure", "base": {"name": "novelty", "spread": 1e308}},
            r"rule.base.spread of 1e\+308",
        ),
    ],
)
def test_settings_that_no_machine_can_have_are_refused(grown, forged, tmp_path, name, value, words):
    grown.save(tmp_path / "machine")
    forged(tmp_path / "machine", {name: value})
    with pytest.raises(ValueError, match=words):
        EvolvingFSM.load(tmp_path / "machine")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("gentle", -5.0, "gentle of -5"),
        ("gentle", 0.5, "gentle holds a fraction"),
        ("brakes", 100.0, "brakes of 100"),
        ("doubts_brought", 100.0, "doubts_brought of 100"),
        ("decels", 100.0, "decels of 100"),
        ("decels", np.nan, "decels of nan"),
        ("stretches", -1.0, "stretches of -1"),
        ("lowest", 1.0, "lowest of 1"),
        ("lowest", -1e308, r"lowest of -1e\+308"),
        ("dt", 0.0, "dt of 0"),
    ],
)
def test_a_risk_that_no_drive_could_have_left_is_refused(forged, tmp_path, name, value, words):
    risk = LatentRisk(lowest=-2.5)
    risk.manoeuvres.remember(4.0)
    for step in range(12):
        risk.learn([30.0, 30.0 - 0.625 * step, 20.0], -2.5)
    risk.save(tmp_path / "risk")
    forged(tmp_path / "risk", {name: value})
    with pytest.raises(ValueError, match=words):
        LatentRisk.load(tmp_path / "risk")


def test_every_array_of_every_kind_has_its_range():
    for kind in ranges.KINDS.values():
        settings = {"dt": 0.25}
        for name in kind.members or ():
            with pytest.raises(ValueError, match=f"{name} of nan"):
                ranges.refuse_others(kind.name, settings, {name: np.array([np.nan])})


def test_the_hardest_braking_is_the_same_for_leaders_and_in_files():
    assert hardest_seen(np.inf) == HARDEST


@pytest.mark.parametrize("kind", ["machine", "model", "risk"])
def test_what_could_not_be_read_is_not_written_either(kind, grown, forged, tmp_path):
    whole = {"machine": grown, "model": grown.model(), "risk": LatentRisk(lowest=-2.5)}[kind]
    name = "seconds" if kind == "risk" else "visits"
    whole.save(tmp_path / "kept")
    content, arrays = storage.read(tmp_path / "kept", kind)
    before = (tmp_path / "kept").read_bytes()
    arrays[name] = np.full_like(arrays[name], -1.0)
    content = {**content, **({"dt": -1.0} if kind == "risk" else {})}
    with pytest.raises(ValueError, match="of -1"):
        storage.write(tmp_path / "kept", kind, content, arrays)
    assert (tmp_path / "kept").read_bytes() == before


def test_numbers_of_every_size_are_kept_and_read_again(snapshot, tmp_path):
    """What can be learnt can be kept: whatever the observations, the rule, and who is given up."""
    random = np.random.default_rng(0)
    sizes = (0.0, 5e-324, 1e-200, 1e-9, 1.0, 1e9, 1e100)
    machines = [
        EvolvingFSM(2, max_states=3, rule=Novelty(1.0, (1e-20, 1e20))),
        EvolvingFSM(2, max_states=3, when_full=WhenFull.RETIRE, rule=Novelty(2.0)),
        EvolvingFSM(2, radius=1e-9, distance_weight=1e50, prior_frequency=1e50),
        EvolvingFSM(2, radius=1e100, spread=1e100, prior_frequency=1e-300),
        EvolvingFSM(2, rule=Paper(memory=2), belief_tolerance=1e-3, learning_rate=0.999),
        EvolvingFSM(2, rule=FailureSplit(Novelty(2.0), distance=1e-3), failure_horizon=2),
    ]
    for machine in machines:
        for _ in range(2):
            Z = random.choice(sizes, (60, 2)) * random.uniform(-1.0, 1.0, (60, 2))
            machine.learn_many(Z, random.integers(-1, 2, 60), [7, 31], failures=[6, 59])
            machine.save(tmp_path / "machine")
            assert snapshot(EvolvingFSM.load(tmp_path / "machine")) == snapshot(machine)
            machine.model().save(tmp_path / "model")
            FSMModel.load(tmp_path / "model")


def test_a_risk_that_saw_jumps_and_odd_numbers_is_kept_and_read_again(tmp_path):
    random = np.random.default_rng(0)
    odd = (0.0, 1e-9, 1.0, 30.0, 200.0, 1e9, 1e100, np.nan)
    for dt in (0.01, 0.25, 10.0):
        risk = LatentRisk(lowest=-2.5, dt=dt)
        for turn in range(300):
            risk.learn(random.choice(odd, 3), random.choice([-2.5, 1.0, -1e100, 1e100]))
            if turn % 100 == 0:
                risk.start_episode()
        risk.save(tmp_path / "risk")
        LatentRisk.load(tmp_path / "risk").save(tmp_path / "again")
        assert (tmp_path / "again").read_bytes() == (tmp_path / "risk").read_bytes()


# -- Files of earlier versions -----------------------------------------------------------------

FILES = Path(__file__).parents[1] / "kept"


def test_a_machine_saved_by_version_0_1_goes_on_as_if_it_had_never_been(spiral, snapshot):
    old, new = EvolvingFSM.load(FILES / "machine-0.1.evofsm"), EvolvingFSM(3, radius=0.01)
    new.learn_many(spiral(40)[:12], np.arange(12) % 3, [0, 9])
    assert repr(old) == repr(new)
    assert old.rule == Paper()
    for name in ("decisions", "failures", "endings"):
        counts = getattr(old, name)
        assert (counts.shape, counts.any()) == (getattr(new, name).shape, False)
    assert_go_on_alike(old, new, spiral(40)[12:], [0, 1] * 14)
    assert old.decisions.sum() == pytest.approx(28.0)


def assert_go_on_alike(old, new, Z, I):
    """To rounding: versions may add numbers up in another order."""
    for a, b in zip(*(m.learn_many(Z, I, belief=True) for m in (old, new)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-14)
    for name in ("centers", "potentials", "transition_matrices", "origin_frequency", "belief"):
        np.testing.assert_allclose(getattr(old, name), getattr(new, name), rtol=1e-9, atol=1e-14)


def test_a_machine_of_format_2_goes_on_as_if_it_had_never_been(spiral):
    rule = FailureSplit(Novelty(radius=2.0, scales=(1.0, 2.0)), distance=0.1)
    old, new = EvolvingFSM.load(FILES / "machine-format-2.evofsm"), EvolvingFSM(3, rule=rule)
    new.learn_many(spiral(40)[:24], np.arange(24) % 2, [0, 9], failures=[15])
    assert repr(old) == repr(new)
    assert old.state_ids.tolist() == new.state_ids.tolist()
    assert_go_on_alike(old, new, spiral(40)[24:], [0, 1, 2, 2] * 4)
    np.testing.assert_allclose(old.failures, new.failures, rtol=1e-9)


def test_a_model_of_format_2_is_read():
    model = FSMModel.load(FILES / "model-format-2.evofsm")
    machine = EvolvingFSM.load(FILES / "machine-format-2.evofsm")
    assert model.names == ("gap", "speed")
    np.testing.assert_array_equal(model.transition_matrices, machine.transition_matrices)


def test_a_model_saved_by_version_0_1_has_counted_no_failures():
    model = FSMModel.load(FILES / "model-0.1.evofsm")
    assert (model.names, model.units, model.dt) == (("gap", "speed"), ("m", "m/s"), 0.01)
    assert model.rule == Paper()
    assert model.decisions.shape == model.failures.shape == model.origin_frequency.shape
    for name in ("decisions", "failures", "endings"):
        assert not getattr(model, name).any()
    assert model.recognise([1.0, 0.5]).sum() == pytest.approx(1.0)
    machine = EvolvingFSM.load(FILES / "machine-0.1.evofsm")
    assert model.recognise([1.0, 0.5]).tobytes() == machine.model().recognise([1.0, 0.5]).tobytes()


def test_a_machine_of_format_3_goes_on_as_if_it_had_never_been(spiral):
    rule = FailureSplit(Novelty(radius=2.0, scales=(1.0, 2.0)), distance=0.1)
    new = EvolvingFSM(4, rule=rule, max_states=12, belief_tolerance=1e-9)
    new.learn_many(spiral(40)[:24], np.arange(24) % 3, [0, 9], failures=[15])
    old = EvolvingFSM.load(FILES / "machine-format-3.evofsm")
    assert repr(old) == repr(new)
    assert_go_on_alike(old, new, spiral(40)[24:], [0, 1, 2, 3] * 4)


def test_a_model_of_format_3_is_read():
    model = FSMModel.load(FILES / "model-format-3.evofsm")
    machine = EvolvingFSM.load(FILES / "machine-format-3.evofsm")
    assert model.actions == IntervalActions(-0.5, 1.5, 0.5, outside="clip")
    np.testing.assert_array_equal(model.transition_matrices, machine.transition_matrices)


@pytest.mark.slow
def test_a_machine_of_format_4_goes_on_and_counts_episodes_from_then_on(spiral):
    rule = FailureSplit(Novelty(radius=2.0, scales=(1.0, 2.0)), distance=0.1)
    new = EvolvingFSM(4, rule=rule, max_states=12, belief_tolerance=1e-9)
    new.learn_many(spiral(40)[:24], np.arange(24) % 3, [0, 9], failures=[15])
    old = EvolvingFSM.load(FILES / "machine-format-4.evofsm")
    assert repr(old) == repr(new)
    assert not old.episodes.any()
    assert not FSMModel.load(FILES / "model-format-4.evofsm").tried.any()
    assert_go_on_alike(old, new, spiral(40)[24:], [0, 1, 2, 3] * 4)
    old.fail()
    assert 0 < old.failed_soon.sum() == old.episodes.sum() <= old.n_states


def test_files_of_format_5_knew_no_dynamics(spiral):
    rule = FailureSplit(Novelty(radius=2.0, scales=(1.0, 2.0)), distance=0.1)
    new = EvolvingFSM(4, rule=rule, max_states=12, belief_tolerance=1e-9)
    new.learn_many(spiral(40)[:24], np.arange(24) % 3, [0, 9], failures=[15])
    old = EvolvingFSM.load(FILES / "machine-format-5.evofsm")
    model = FSMModel.load(FILES / "model-format-5.evofsm")
    assert repr(old) == repr(new)
    assert old.dynamics is model.dynamics is None
    assert not old.onsets.any()
    assert not model.onsets.any()
    np.testing.assert_array_equal(model.tried, old.tried)
    assert_go_on_alike(old, new, spiral(40)[24:], [0, 1, 2, 3] * 4)


def test_a_machine_of_format_6_goes_on_and_follows_changes_from_then_on():
    draw = np.random.default_rng(0)
    Z, U = draw.normal(size=(64, 2)).cumsum(0), draw.uniform(-1, 1, 64)
    old = EvolvingFSM.load(FILES / "machine-format-6.evofsm")
    new = EvolvingFSM(2, radius=0.5, dynamics=Dynamics(-1.0, 1.0))
    I = (U > 0).astype(int)
    new.learn_many(Z, I, [0, 40], executed=U)
    assert repr(old) == repr(new)
    assert old.dynamics.drifts == []
    assert not old.dynamics.recent.squares.any()
    for machine in (old, new):
        machine.learn_many(Z, I, [0, 40], executed=U)
    np.testing.assert_allclose(old.dynamics.weights, new.dynamics.weights, rtol=1e-6, atol=1e-9)


def test_a_machine_of_format_7_doubted_no_lags():
    old = EvolvingFSM.load(FILES / "machine-format-7.evofsm")
    assert (old.dynamics.n_episodes, old.dynamics.doubt_of_lags) == (1, 0.0)
    old.save(again := io.BytesIO())
    again.seek(0)
    assert EvolvingFSM.load(again).dynamics.doubt_of_lags == 0.0


def test_a_machine_of_format_8_took_all_as_it_was_seen():
    old = EvolvingFSM.load(FILES / "machine-format-8.evofsm")
    old.save(again := io.BytesIO())
    again.seek(0)
    for machine in (old, EvolvingFSM.load(again)):
        assert not machine.dynamics.is_noisy
        np.testing.assert_array_equal(machine.dynamics.consequents.gains, 1.0)
        np.testing.assert_array_equal(
            machine.dynamics.consequents.close, 1e-9 / machine.dynamics.consequents.inverse
        )


def test_a_risk_of_format_3_is_read():
    risk = LatentRisk.load(FILES / "risk-format-3.evofsm")
    assert (len(risk.manoeuvres), len(risk.brakes.samples)) == (3, 80)
    assert risk.brakes.decel == pytest.approx(2.25)


def test_files_of_earlier_versions_have_no_checksum_and_say_nothing_of_their_origin():
    header = storage.read_header(FILES / "machine-format-3.evofsm")
    assert (header.version, header.library, header.provenance) == (3, None, {})


# -- What a file says of itself ------------------------------------------------------------------


def test_a_file_says_who_wrote_it_and_what_it_learnt_from(grown, tmp_path):
    provenance = {"files": [{"name": "drive.csv", "bytes": 12}], "rows": 40}
    for item, kind in ((grown, "machine"), (grown.model(), "model")):
        item.save(tmp_path / kind, provenance)
        header = storage.read_header(tmp_path / kind)
        assert (header.kind, header.version) == (kind, 9)
        assert header.library == __version__
        assert header.provenance == provenance


def test_the_same_machine_gives_the_same_file(grown, tmp_path):
    grown.save(tmp_path / "a")
    EvolvingFSM.load(tmp_path / "a").save(tmp_path / "b")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_the_checksum_is_taken_as_the_documentation_says(grown, tmp_path):
    grown.save(tmp_path / "machine")
    with np.load(tmp_path / "machine") as archive:
        arrays = dict(archive)
    header = json.loads(arrays.pop("header").tobytes())
    told = header.pop("sha256")

    def line(value):
        return json.dumps(value, sort_keys=True, separators=(",", ":")).encode() + b"\n"

    digest = hashlib.sha256(line(header))
    for name, array in sorted(arrays.items()):
        digest.update(line([name, array.dtype.str, array.shape]) + array.tobytes())
    assert digest.hexdigest() == told


def test_an_open_file_will_do_in_place_of_a_name(grown, snapshot):
    file = io.BytesIO()
    grown.save(file)
    assert snapshot(EvolvingFSM.load(io.BytesIO(file.getvalue()))) == snapshot(grown)


# -- Files that are damaged, or made to do harm ----------------------------------------------------


@pytest.fixture
def members(grown, tmp_path):
    """What is in a machine's file, as bytes by name."""
    grown.save(tmp_path / "whole")
    with zipfile.ZipFile(tmp_path / "whole") as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def packed(members, method=zipfile.ZIP_DEFLATED):
    """An archive in which all checksums of the ZIP are right."""
    file = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w", method) as archive:
        warnings.simplefilter("ignore")  # that a name is there twice
        for name, content in members:
            archive.writestr(name, content)
    return file.getvalue()


def array(values, shape=None):
    """An array's member, which may claim another shape."""
    file = io.BytesIO()
    told = {"descr": values.dtype.str, "fortran_order": False, "shape": shape or values.shape}
    np.lib.format.write_array_header_1_0(file, told)
    return file.getvalue() + values.tobytes()


def changed(members, **others):
    return packed({**members, **{f"{name}.npy": data for name, data in others.items()}}.items())


def flipped(data, place):
    place %= len(data)
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


def lying(data, size):
    """A file whose directory claims another size of its last member, packed and unpacked."""
    where = data.rindex(b"PK\x01\x02")
    sizes = (size // 1000).to_bytes(4, "little") + size.to_bytes(4, "little")
    return data[: where + 20] + sizes + data[where + 28 :]


def encrypted(data):
    for mark, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        where = data.rindex(mark) + place
        data = data[:where] + bytes([data[where] | 1]) + data[where + 1 :]
    return data


HARMFUL = {
    "cut off": (lambda m: packed(m.items())[:-1], "was cut off"),
    "something behind it": (lambda m: packed(m.items()) + b"x", "was cut off"),
    "something before it": (lambda m: b"x" + packed(m.items()), "not a ZIP archive"),
    "a number changed": (
        lambda m: changed(m, belief=flipped(m["belief.npy"], -1)),
        "SHA-256 is another",
    ),
    "a setting changed": (
        lambda m: changed(m, header=m["header.npy"].replace(b'"radius": 0.01', b'"radius": 0.02')),
        "SHA-256 is another",
    ),
    "an origin changed": (
        lambda m: changed(m, header=m["header.npy"].replace(b"{}", b"[]")),
        "the provenance in its header",
    ),
    "arrays swapped": (
        lambda m: changed(m, visits=m["founded.npy"], founded=m["visits.npy"]),
        "SHA-256 is another",
    ),
    "an array lost": (lambda m: packed(list(m.items())[:-1]), "it lacks"),
    "an array more": (lambda m: changed(m, more=array(np.zeros(3))), "it has more, which no"),
    "an array twice": (lambda m: packed([*m.items(), *m.items()]), "two arrays called header"),
    "a shape of its own": (
        lambda m: changed(m, visits=array(np.zeros(3))),
        r"visits has shape \(3,\), not \(\d+,\)",
    ),
    "too many dimensions": (
        lambda m: changed(m, visits=array(np.zeros((3, 1)))),
        r"visits has shape \(3, 1\)",
    ),
    "other actions": (lambda m: changed(m, uses=array(np.zeros(4))), r"uses has shape \(4,\)"),
    "a shape that does not fit": (
        lambda m: changed(m, visits=array(np.zeros(3), (1 << 40,))),
        "does not fit",
    ),
    "a size that does not fit": (lambda m: lying(packed(m.items()), 1 << 30), "too many|overlap"),
    "objects": (
        lambda m: changed(m, visits=m["visits.npy"].replace(b"<f8", b"|O ")),
        "of type",
    ),
    "texts": (lambda m: changed(m, visits=array(np.array(["a"]))), "of type"),
    "a header that is evaluated": (
        lambda m: changed(m, visits=m["visits.npy"].replace(b"False", b"exit()")),
        "does not begin as an array",
    ),
    "a folder": (lambda m: packed([*m.items(), ("a/b.npy", b"")]), "'a/b.npy', which is no"),
    "a way out": (lambda m: packed([*m.items(), ("../b.npy", b"")]), "'../b.npy', which is no"),
    "a root": (lambda m: packed([*m.items(), ("/b.npy", b"")]), "'/b.npy', which is no"),
    "a text": (lambda m: packed([*m.items(), ("readme", b"")]), "'readme', which is no"),
    "encrypted": (lambda m: encrypted(packed(m.items())), "is encrypted"),
    "packed otherwise": (lambda m: packed(m.items(), zipfile.ZIP_LZMA), "packed in a way"),
    "many members": (
        lambda m: packed((f"a{k}.npy", b"") for k in range(200)),
        "200 arrays; there are no more than",
    ),
    "a header without end": (
        lambda m: changed(m, header=array(np.full(1 << 25, 32, np.uint8))),
        "far too long",
    ),
    "a header nested without end": (
        lambda m: changed(m, header=array(np.full(100_000, ord("["), np.uint8))),
        "recursion|nested",
    ),
}


@pytest.mark.parametrize(("damage", "words"), HARMFUL.values(), ids=HARMFUL.keys())
def test_what_was_damaged_or_made_to_do_harm_is_refused_and_told(damage, words, members, tmp_path):
    path = tmp_path / "harmful"
    path.write_bytes(damage(members))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=words) as raised:
            EvolvingFSM.load(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert str(path) in str(raised.value)
    assert peak < 4 << 20


def test_a_file_of_the_greatest_size_is_refused_before_there_is_room_for_it(tmp_path):
    """Zeros pack so well that 5 GiB of them are a small file; here it only claims them."""
    path = tmp_path / "bomb"
    data = packed([("header.npy", array(np.zeros(0, np.uint8))), ("a.npy", bytes(10_000_000))])
    path.write_bytes(lying(data, 1 << 31))
    with pytest.raises(ValueError, match=r"claims [\d,]+ bytes|overlap"):
        EvolvingFSM.load(path)


def test_a_kind_that_is_not_known_is_refused(members, tmp_path):
    path = tmp_path / "odd"
    path.write_bytes(changed(members, header=m_header(members, b'"machine"', b'"engine!"')))
    with pytest.raises(ValueError, match="it holds a 'engine!'"):
        storage.kind_of(path)


def m_header(members, old, new):
    assert old in members["header.npy"]
    return members["header.npy"].replace(old, new)


def test_actions_without_end_are_refused_before_there_is_room_for_them(grown, tmp_path):
    full_model(grown).save(tmp_path / "model")
    content, arrays = storage.read(tmp_path / "model", "model")
    content["actions"]["width"] = 1e-12
    storage.write(tmp_path / "model", "model", content, arrays)
    with pytest.raises(ValueError, match="more than 3 intervals"):
        FSMModel.load(tmp_path / "model")


def test_what_could_not_be_read_again_is_not_written(grown, tmp_path):
    grown.save(tmp_path / "machine")
    content, arrays = storage.read(tmp_path / "machine", "machine")
    for wrong, words in (
        ({"more": np.zeros(1)}, "more, which no machine has"),
        ({"visits": np.zeros(1)}, "shape"),
        ({"visits": arrays["visits"].astype(object)}, "cannot be kept"),
    ):
        with pytest.raises(ValueError, match=words):
            storage.write(tmp_path / "new", "machine", content, {**arrays, **wrong})
    assert not (tmp_path / "new").exists()


# -- On the disk -----------------------------------------------------------------------------------


def test_a_file_and_its_name_are_on_the_disk_when_saving_returns(grown, tmp_path, monkeypatch):
    flushed = []

    def fsync(descriptor):
        flushed.append(stat.S_ISDIR(os.fstat(descriptor).st_mode))

    monkeypatch.setattr(os, "fsync", fsync)
    grown.save(tmp_path / "machine")
    assert flushed == [False, True]


def test_an_error_in_saving_names_the_file(grown, full_disk, tmp_path):
    fill, free = full_disk
    fill()
    try:
        with pytest.raises(OSError, match="File too large") as raised:
            grown.save(tmp_path / "machine")
    finally:
        free()
    assert raised.value.filename == str(tmp_path / "machine")


def test_what_a_killed_process_left_behind_is_swept_and_what_is_being_written_is_not(tmp_path):
    path = tmp_path / "machine"
    left = tmp_path / ".machine.0123456789abcdef.part"
    others = [tmp_path / ".machine.7.part", tmp_path / ".other.0123456789abcdef.part"]
    for one in (left, *others):
        one.touch()
    with storage.replacing(path) as file:
        written = Path(file.name)
        storage.sweep(path)
        assert sorted(tmp_path.iterdir()) == sorted([written, *others])
        file.write(b"whole")
    assert sorted(tmp_path.iterdir()) == sorted([path, *others])


def test_what_was_swept_before_it_was_locked_is_begun_anew(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")
    lock, swept = fcntl.flock, []

    def sweep_first(file, how):
        if how == fcntl.LOCK_EX and not swept:
            swept.append(file.name)
            storage.sweep(tmp_path / "machine")
        lock(file, how)

    monkeypatch.setattr(fcntl, "flock", sweep_first)
    with storage.replacing(tmp_path / "machine") as file:
        file.write(b"whole")
    assert swept
    assert [path.name for path in tmp_path.iterdir()] == ["machine"]


# -- Several writers, and what stands in the way ---------------------------------------------------


def test_two_who_write_one_path_do_not_meet(grown, tmp_path):
    with storage.replacing(tmp_path / "file") as one, storage.replacing(tmp_path / "file") as two:
        one.write(b"one, which ends last")
        two.write(b"two")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"one, which ends last"]


def test_threads_that_save_to_one_path_leave_it_whole_at_every_moment(grown, tmp_path):
    grown.save(tmp_path / "machine")
    done = []

    def save():
        for _ in range(15):
            grown.save(tmp_path / "machine")
        done.append(True)

    threads = [threading.Thread(target=save) for _ in range(2)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        storage.read(tmp_path / "machine", "machine")
    assert done == [True, True]
    assert [path.name for path in tmp_path.iterdir()] == ["machine"]


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444])
def test_a_file_keeps_its_mode(mode, grown, tmp_path):
    grown.save(tmp_path / "machine")
    (tmp_path / "machine").chmod(mode)
    grown.save(tmp_path / "machine")
    assert stat.S_IMODE((tmp_path / "machine").stat().st_mode) == mode


def test_a_new_file_has_the_mode_of_any_other(grown, tmp_path):
    grown.save(tmp_path / "machine")
    (tmp_path / "other").touch()
    assert (tmp_path / "machine").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_a_link_stays_and_what_it_leads_to_is_replaced(grown, tmp_path):
    (tmp_path / "far").mkdir()
    link, target = tmp_path / "link", tmp_path / "far" / "machine"
    link.symlink_to(target)
    for _ in range(2):  # where there is nothing yet, and where there is
        grown.save(link)
        assert link.is_symlink()
        assert not target.is_symlink()
        assert storage.kind_of(target) == "machine"
    assert sorted(tmp_path.rglob("*")) == sorted([link, target, target.parent])


def test_what_is_no_file_is_left_alone(grown, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "device").symlink_to("/dev/null")
    for name in ("pipe", "device"):
        with pytest.raises(OSError, match=f"{name} is a device, a pipe"):
            grown.save(tmp_path / name)
    with pytest.raises(OSError, match="is a folder"):
        grown.save(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["device", "pipe"]
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


def test_what_cannot_be_read_again_takes_no_place(grown, tmp_path, monkeypatch):
    path = tmp_path / "machine"
    grown.save(path)
    before, pack = path.read_bytes(), storage._pack

    def pack_badly(file, members):
        pack(file, members)
        file.seek(100)
        file.write(b"x")

    monkeypatch.setattr(storage, "_pack", pack_badly)
    with pytest.raises(OSError, match=f"{path} was left as it was"):
        grown.save(path)
    assert [one.read_bytes() for one in tmp_path.iterdir()] == [before]


# Where it comes as an archive is made or closed, Python says that it could not be closed once more.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_anywhere_in_a_save_is_an_interrupt_and_leaves_a_whole_file(tmp_path):
    machine, path = EvolvingFSM(n_actions=1), tmp_path / "machine"
    machine.learn_many([[0.0], [2.0]], [0, 0])
    machine.save(path)

    def stop_at(line):
        """Save, interrupted at a line; answers whether it came so far."""
        lines = 0

        def trace(frame, event, _):
            nonlocal lines
            if not frame.f_code.co_filename.endswith(("storage.py", "zipfile.py", "__init__.py")):
                return None
            lines += event == "line"
            if lines == line and event == "line":
                sys.settrace(None)
                raise KeyboardInterrupt
            return trace

        before = sys.gettrace()
        sys.settrace(trace)
        try:
            machine.save(path)
        except KeyboardInterrupt:
            return True
        finally:
            sys.settrace(before)
        return False

    line = 1
    while stop_at(line):
        line += 97
        assert [one.name for one in tmp_path.iterdir()] == ["machine"]
        EvolvingFSM.load(path)
    assert line > 1000


def test_a_disk_that_is_full_as_one_interrupts_is_told_as_such(grown, full_disk, tmp_path):
    fill, free = full_disk
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt:  # who saves on Ctrl-C
        fill()
        try:
            with pytest.raises(OSError, match="File too large"):
                grown.save(tmp_path / "machine")
        finally:
            free()


@pytest.mark.parametrize("provenance", ["drive 7", ["drive 7"], 7])
def test_a_provenance_that_is_no_mapping_is_named(provenance, grown, tmp_path):
    for item in (grown, grown.model(), LatentRisk(lowest=-2.5)):
        with pytest.raises(TypeError, match=r"provenance is .*; it must be a mapping"):
            item.save(tmp_path / "file", provenance)
    assert not list(tmp_path.iterdir())

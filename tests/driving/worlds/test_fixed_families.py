"""Draws by given chances, and draws that are kept as families of their own."""

import json

import numpy as np
import pytest

from evofsm.driving.families.family import FAMILIES, SWITCHES, load_family
from evofsm.driving.families.fixed import NamedDraw, fixed_family


def chances(seed):
    """A number for each place, the same whenever it is asked for."""
    rng, known = np.random.default_rng(seed), {}
    return lambda place: known.setdefault(place, rng.random())


def kept(path, family, n=4):
    cases = [NamedDraw(f"case {k}", f"About {k}.", family.draw_by(chances(k))) for k in range(n)]
    path.write_text(fixed_family(family, cases, "All of them."), encoding="utf-8")
    return cases, load_family(path)


@pytest.mark.parametrize("name", FAMILIES)
def test_what_is_kept_is_what_was_drawn_to_the_last_bit(name, tmp_path):
    family = load_family(name)
    cases, again = kept(tmp_path / "kept.json", family)
    for k, case in enumerate(cases):
        for split in ("train", "test"):
            draw = again.draw(seed=5, index=k, split=split)
            assert draw[:2] == case.draw[:2]
            assert draw.variant == f"case {k}"
    assert (again.interval, again.actions) == (family.interval, family.actions)
    assert (again.decel, again.leader_decel) == (family.decel, family.leader_decel)
    assert again.about == "All of them."


def test_switches_and_a_shift_are_kept_with_it(tmp_path):
    for family in (load_family("cut_in").with_switches(SWITCHES), load_family("shift").shifted):
        cases, again = kept(tmp_path / "kept.json", family)
        assert [again.draw(0, k)[:2] for k in range(4)] == [case.draw[:2] for case in cases]
        assert again.decel == family.decel


def test_it_is_json_for_other_programs(tmp_path):
    kept(tmp_path / "kept.json", load_family("cut_in"))

    def refuse(name):
        raise AssertionError(name)

    tables = json.loads((tmp_path / "kept.json").read_text(), parse_constant=refuse)
    assert tables["variant"][1]["about"] == "About 1."


def test_there_is_nothing_to_keep_of_nothing():
    with pytest.raises(ValueError, match="there are no cases"):
        fixed_family(load_family("emergency"), [], "Nothing.")


def test_given_chances_are_places_in_ranges_and_what_was_drawn_is_told():
    family, drawn = load_family("emergency"), {}
    least = family.draw_by(lambda place: 0.0, drawn)
    assert least.scenario.initial_gap == drawn["scenario.initial_gap"] == 2.0
    assert drawn["leader.brake_time"] == 5.0
    most = family.draw_by(lambda place: np.nextafter(1.0, 0.0))
    assert 29.999 < most.scenario.initial_gap <= 30.0
    drawn = {}
    ncap = load_family("ncap")
    last = ncap.draw_by(lambda place: 0.999, drawn)
    assert drawn["variant"] == len(ncap.variants) - 1
    assert last.variant == ncap.variants[-1]


def test_evenly_distributed_chances_draw_as_a_seed_does():
    family = load_family("stop_and_go")
    ours = [family.draw_by(chances(k)).scenario.initial_gap for k in range(300)]
    seeds = [family.draw(0, k).scenario.initial_gap for k in range(300)]
    assert abs(np.mean(ours) - np.mean(seeds)) < 4.0 * np.std(seeds) / np.sqrt(150)


@pytest.mark.parametrize("chance", [-0.1, 1.0, np.nan])
def test_a_chance_that_is_none_is_refused(chance):
    with pytest.raises(ValueError, match=r"the chance of .* must be from 0 up to 1"):
        load_family("emergency").draw_by(lambda place: chance)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "is not JSON"),
        ("[1]", "holds no table"),
        ('{"about": 1}', "must be a text"),
        ('{"about": null}', "must be a text"),
        ('{"sensors": {"seed": 1.5}}', "must be a whole number"),
        ('{"sensors": {"seed": -1}}', "must be a whole number"),
        ('{"extra": 1}', "there is no 'extra'"),
        ("[" * 100_000, "is not JSON"),
        ("{}", "about is missing"),
    ],
)
def test_json_with_a_mistake_is_refused(text, reason, tmp_path):
    path = tmp_path / "mine.JSON"
    path.write_text(text)
    with pytest.raises(ValueError, match=reason):
        load_family(path)


def test_who_is_asked_at_an_interval_keeps_its_command_between():
    from evofsm.driving.world import KinematicWorld

    draw = load_family("emergency").draw(0, 0)
    often = KinematicWorld().run(draw.scenario, draw.controller, draw.scenario.dt)
    assert (
        often.observations.tolist()
        == KinematicWorld().run(draw.scenario, draw.controller).observations.tolist()
    )
    seldom = KinematicWorld().run(draw.scenario, draw.controller, 0.25)
    commands = seldom.accelerations[:100].reshape(4, 25)
    assert (commands == commands[:, :1]).all()

    class Slow:
        def propose(self, observation, time=0.0):
            return draw.controller.propose(observation, time)

    python = KinematicWorld().run(draw.scenario, Slow(), 0.25)
    assert python.observations.tolist() == seldom.observations.tolist()
    with pytest.raises(ValueError, match="no whole number of the scenario's steps"):
        KinematicWorld().run(draw.scenario, draw.controller, 0.123456)

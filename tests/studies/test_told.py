"""The ceiling keeps systems from failing at little cost, and does not look into the future."""

import json

import numpy as np
from studies import benchmark, told
from studies.systems import Start, make_system


def test_the_ceiling_keeps_from_failing_and_keeps_what_does_no_harm(monkeypatch, tmp_path):
    """Others stay in the file."""
    monkeypatch.setattr(told, "CEILINGS", tmp_path / "ceiling.json")
    told.CEILINGS.write_text('[{"system": "disc", "controller": "", "failed": 7}]')
    told.renew(benchmark.chosen("oblique"), episodes=1, workers=1)
    other, found = sorted(json.loads(told.CEILINGS.read_text()), key=lambda row: row["system"])
    assert (found["episodes"], found["failed"], found["failed_alone"]) == (1, 0, 1)
    assert found["kept"] > 0.5
    assert other["failed"] == 7


def test_the_ceiling_does_not_see_what_the_episode_will_draw():
    found = []
    for loud in (1.0, 50.0):
        system = make_system("acc")
        system.reset(options={"start": Start.held_out(0, 0)})
        system._noise, system._v = loud * system._noise, 1.0
        state = system.chance.bit_generator.state
        ceiling, decided = told.Ceiling(system), []
        for system._x in np.linspace(-0.8, -0.2, 7):
            decided.append(ceiling.action(np.array([system._x, 1.0]), 2.0))
        found.append(decided)
        assert system.chance.bit_generator.state == state
    assert found[0] == found[1]
    assert 2.0 in found[0]

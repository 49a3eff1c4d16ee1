"""Tasks of highway-env come as they are, and a judge of scenes lowers their crashes."""

import numpy as np
import pytest
from studies.systems import HIGHWAY, SYSTEMS, make_system
from studies.systems.rivals.rival import Unrevised
from studies.systems.system import Start
from studies.systems.trial import JUDGES, run, trial

pytest.importorskip("highway_env")


def test_they_are_no_part_of_what_every_study_takes():
    assert not set(HIGHWAY) & set(SYSTEMS)


@pytest.mark.parametrize("task", HIGHWAY)
def test_an_episode_is_drawn_by_its_start_alone(task):
    system, start = make_system(task), Start.held_out(3, 1)
    first, again, other = (system.reset(one) for one in (start, start, Start.held_out(3, 2)))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert len(first) == len(system.variables)
    assert len(first) % system.columns == 0


def test_an_episode_does_not_hang_on_what_the_process_ran_before():
    """The intersection sets how cars drive, for every environment there is."""

    def passed(system):
        return [step.observation for step in (system.step(1) for _ in range(3))]

    merge, start = make_system("merge", "idle"), Start.held_out(3, 1)
    merge.reset(start)
    before = passed(merge)
    merge.reset(start)
    make_system("intersection").reset(start)
    amid = passed(merge)
    merge.reset(start)
    after = passed(merge)
    assert np.array_equal(before, amid)
    assert np.array_equal(before, after)


@pytest.mark.slow
@pytest.mark.parametrize("task", HIGHWAY)
def test_it_drives_to_the_end_under_each_rival(task):
    system = make_system(task)
    for make in [Unrevised, *system.rivals.values()]:
        ended = run(system, make(), Start.held_out(3, 1))
        assert 0 < len(ended.times) <= system.steps
        assert 0.0 <= ended.speed <= 40.0
        assert np.isfinite(ended.score)


def test_the_driver_of_the_environment_is_not_in_its_own_way():
    """Else it changes lanes with every decision, away from itself."""
    system = make_system("highway-fast", "idle")
    driver = system.rivals["idm-mobil"]()
    observation, lanes = system.reset(Start.held_out(3, 1)), []
    for _ in range(12):
        step = system.step(driver.decide(observation, 1).executed)
        observation = step.observation
        lanes.append(system.env.vehicle.target_lane_index[2])
        assert not step.failed
    assert np.count_nonzero(np.diff(lanes)) <= 3


@pytest.mark.slow
def test_the_judge_of_scenes_learns_to_merge():
    alone = trial("merge", judge="unrevised", train=0, test=10, base=9)
    guarded = trial("merge", judge="scene", train=20, test=10, base=9)
    assert alone.failed >= 7
    assert guarded.failed <= 3
    assert guarded.speed > 0.85 * alone.speed


@pytest.mark.parametrize("task", HIGHWAY)
def test_the_network_that_was_trained_fits_the_task_and_looks(task):
    from studies.systems.highway import read_weights

    system, layers = make_system(task, "dqn"), read_weights(task)
    assert layers[0][0].shape[1] == len(system.variables)
    assert len(layers[-1][1]) == system.actions.n_actions
    seen = [system.reset(Start.held_out(3, k)) for k in range(30)]
    assert len({system.propose(observation) for observation in seen}) > 1


def test_what_is_not_there_is_said():
    with pytest.raises(ValueError, match="has no controller 'pilot'"):
        make_system("intersection", "pilot")
    with pytest.raises(ValueError, match="shows no objects"):
        JUDGES["scene"](make_system("acc"), (), 0)

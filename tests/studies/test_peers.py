"""What is finished is not trained again, rows say where the filter loses, and tasks are as said."""

import json

import pytest
from studies import lib, peers
from studies.peers import TASKS, WAYS, Job, Peers


def row(task="cartpole", way="alone", seed=0, **what):
    told = WAYS[way].filter != "alone"
    found = {"task": task, "way": way, "seed": seed, "steps": 600, "episodes": 30, "failed": 20}
    found |= {"late_return": 100.0, "changed_first": 0.5 * told}
    found |= {"changed_last": 0.05 * told, "held_out": 20, "alone_failed": 3, "seconds": 1.0}
    found |= {"alone_return": 90.0, "under_failed": 0 if told else None, "under_changed": None}
    return found | {"under_return": 95.0 if told else None, "passes": False, **what}


DONE = []


def finish(job, runs):
    DONE.append(job)
    job.file(runs).write_text(json.dumps(row(*job[:3])))


@pytest.fixture
def finished(monkeypatch):
    """Jobs that are trained, which takes no time here."""
    monkeypatch.setattr(peers, "finish", finish)
    DONE.clear()
    return DONE


def test_what_is_finished_is_not_trained_again(tmp_path, finished):
    asked = Peers(tasks="cartpole,hopper", ways="alone,filter-1", seeds=2, runs=tmp_path)
    found = asked.run(workers=1)["rows"]
    assert len(finished) == len(found) == 8
    keys = found.select("task", "way", "seed").rows()
    assert keys == sorted(keys)
    next(tmp_path.glob("hopper-filter-1-*-1.json")).unlink()
    finished.clear()
    assert asked.run(workers=1)["rows"].equals(found)
    assert [job[:3] for job in finished] == [("hopper", "filter-1", 1)]


def test_what_is_finished_is_shown_without_training_of_tasks_that_there_are(tmp_path, finished):
    with pytest.raises(ValueError, match="there is no task 'kettle'; there are cartpole"):
        _ = Peers(tasks="cartpole,kettle").jobs
    shown = Peers(tasks="pendulum", seeds=1, runs=tmp_path, show=True)
    with pytest.raises(ValueError, match="nothing is finished"):
        shown.run()
    Job("pendulum", "told-1", 0, TASKS["pendulum"].steps).file(tmp_path).write_text(
        json.dumps(row("pendulum", "told-1"))
    )
    assert shown.run()["rows"]["way"].to_list() == ["told-1"]
    assert not finished


def test_the_page_says_where_the_filter_loses(tmp_path):
    good = [row("cartpole", "alone", seed) for seed in range(3)]
    good += [row("cartpole", "filter-1", seed, failed=0, alone_failed=1) for seed in range(3)]
    bad = [row("walker2d", "alone"), row("walker2d", "filter-1", changed_last=0.9)]
    page = Peers().page({"rows": lib.frame_of([*good, *bad])})
    walker = ["walker2d"]
    assert [table.frame["task"].to_list() for table in page.lost] == [walker, walker, [], walker]
    assert page.targets["met"].to_list() == [False, False]
    (line,) = (one for one in page.parts[0].cells if one[0] == "filter-1")
    assert line[1:3] == ("nothing but failures", "0.0 (0.0–0.0)")
    Peers().write({"rows": lib.frame_of(good)}, tmp_path)
    assert "| filter-1 | nothing but failures | 0.0 (" in (tmp_path / "peers.md").read_text()


def test_a_filter_learns_while_a_learner_does():
    pytest.importorskip("stable_baselines3")
    pytest.importorskip("mujoco")
    from studies import learners

    found = learners.trained("cartpole", "filter-1", 0, 600, 1)
    assert 0 < found["failed"] <= found["episodes"]
    assert found["changed_last"] > 0.0
    assert found["held_out"] == 1

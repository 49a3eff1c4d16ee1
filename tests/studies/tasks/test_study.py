"""The study runs what it names, the same with any number of processes, and takes one's own."""

import re
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import studies.systems as systems
from studies.systems import TASKS, make_system
from studies.systems.rivals.rival import Rival
from studies.systems.trial import make_judge, told_to
from studies.tasks import study
from studies.tasks.plan import Plan
from studies.tasks.policies import search
from studies.tasks.study import run_tasks

PAGE = Path(__file__).parents[3] / "docs" / "tasks.md"


def without_times(rows):
    return [replace(row, p50_ms=0.0, p99_ms=0.0) for row in rows]


@pytest.fixture
def in_page(tmp_path, monkeypatch):
    """The modules of the page, in the present folder."""
    for name, text in re.findall(
        r"```python\n# (\w+\.py)\n(.*?)```", PAGE.read_text("utf-8"), re.S
    ):
        (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def no_packages(monkeypatch):
    monkeypatch.setattr(systems, "find_spec", lambda name: None)


@pytest.mark.slow
def test_the_task_and_the_judge_of_the_page_are_tried(in_page):
    plan = Plan(task="my_task:Kettle", judge="my_judge:Careful", seeds=1, test=5, rounds=10)
    found = run_tasks(plan, workers=1)
    by_judge = {row.judge: row for row in found.rows}
    assert list(by_judge) == ["unrevised", "my_judge:Careful", "learnt", "counted"]
    assert {row.task for row in found.rows} == {"my_task:Kettle"}
    assert by_judge["unrevised"].failed == 5
    careful = by_judge["my_judge:Careful"]
    assert (careful.failed, careful.told, careful.trained) == (0, "where it boils", 30)
    assert by_judge["learnt"].failed == 0
    assert found.policies == []


@pytest.mark.slow
def test_a_judge_that_says_how_dangerous_actions_are_is_put_into_a_guard(tmp_path, monkeypatch):
    recipe = (PAGE.parents[1] / "CONTRIBUTING.md").read_text("utf-8")
    (text,) = re.findall(r"# my_judge\.py\n(.*?)```", recipe, re.S)
    text = (
        re.sub(r"^   ", "", text, flags=re.M) + "\ndef kettle(system, seed):\n    return Kettle()\n"
    )
    text += "Kettle.told = 'where it boils'\n"
    (tmp_path / "danger.py").write_text(text, encoding="utf-8")
    (tmp_path / "half.py").write_text("def made(system, seed):\n    return 3\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    judge = make_judge("danger:kettle", make_system("acc"))
    assert judge.decide([50.0], 1.0).executed == 1.0
    assert told_to(judge) == "where it boils"
    with pytest.raises(TypeError, match="half:made makes a int, which is no judge"):
        make_judge("half:made", make_system("acc"))


def test_a_guard_of_ones_own_is_tried_as_it_is(tmp_path, monkeypatch):
    text = (
        "from evofsm.guard import Guard\n\ndef timid(system, seed):\n    "
        "return Guard(**system.actions.settings, interval=system.interval, tolerance=0.01)\n"
    )
    (tmp_path / "guards.py").write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    judge = make_judge("guards:timid", make_system("acc"))
    assert judge.reviser.tolerance == 0.01
    assert told_to(judge) == "nothing but failures"


@pytest.mark.parametrize(
    ("plan", "error", "text"),
    [
        (Plan(tasks="aac"), ValueError, "there is no system 'aac'; there are acc, acc-5"),
        (Plan(task="collections:Counter"), TypeError, "makes a Counter, which is no System"),
        (Plan(task="nowhere:Task"), ValueError, "is it in this folder, or installed?"),
        (Plan(tasks="pendulum", judge="barrier"), ValueError, "pendulum has no judge 'barrier'"),
        (Plan(tasks="acc", judge="acc"), ValueError, "acc has no judge 'acc'; there are learnt"),
        (Plan(tasks="acc", controllers="dqn"), ValueError, "acc has no controller 'dqn'; it has"),
    ],
)
def test_wrong_names_show_at_once(plan, error, text):
    with pytest.raises(error, match=text):
        run_tasks(replace(plan, policies=False, seeds=1, test=1, rounds=1), workers=1)


def test_what_lacks_its_package_is_left_out_and_told(no_packages, monkeypatch):
    with pytest.raises(ValueError, match="nothing to run: masa-road_1d is left out: it needs masa"):
        run_tasks(Plan(tasks="masa-road_1d"), workers=1)
    monkeypatch.setattr(study, "_trial", lambda plan, *who: [])
    found = run_tasks(Plan(tasks="masa-obstacle,acc", policies=False), workers=1)
    assert found.left_out == (
        "masa-obstacle is left out: it needs masa (pip install --no-deps masa-safe-rl).",
        "acc: the rival cbfpy is left out: it needs cbfpy (pip install cbfpy).",
    )


def test_nothing_is_tried_twice(monkeypatch):
    monkeypatch.setattr(study, "_trial", lambda plan, *who: [who])
    twice = Plan(tasks="acc,acc", task="acc", seeds=1, acc_seeds=2, policies=False)
    for judge in ("", "learnt", "barrier", "unrevised"):
        tried = run_tasks(replace(twice, judge=judge), workers=1).rows
        assert len(tried) == len(set(tried))
        assert {who[2] for who in tried} >= {"unrevised", "barrier", "learnt", "counted"}


def test_amounts_of_the_short_form_are_small():
    short = Plan().shortened()
    assert short.seeds_of("acc") == short.seeds_of("cartpole") == 1
    assert short.train_of("acc") == short.train_of("cartpole") == 20
    assert (Plan().seeds_of("acc"), Plan().train_of("acc")) == (20, 200)
    assert (Plan().seeds_of("cartpole"), Plan().train_of("cartpole")) == (5, None)
    assert Plan(train=30).train_of("acc") == 30


def test_all_tasks_can_be_made_or_say_what_they_lack():
    for name in TASKS:
        if not systems.lacking(name):
            assert make_system(name).name == name


@pytest.mark.slow
def test_the_table_does_not_depend_on_processes():
    plan = replace(Plan(tasks="acc-5", policies=False).shortened(), train=6, test=4)
    one, two = (run_tasks(plan, workers=workers) for workers in (1, 2))
    assert without_times(one.rows) == without_times(two.rows)
    assert [row.judge for row in one.rows] == [
        *("unrevised", "stopping-distance", "barrier"),
        *(("cbfpy",) if not systems.lacking("cbfpy") else ()),
        *("learnt", "counted"),
    ]


@pytest.mark.slow
def test_the_short_form_runs_and_ours_loses_nothing_while_told_nothing():
    found = Plan(tasks="acc-5,cartpole").shortened().run(workers=2)
    learnt = {row.task: row for row in found.rows if row.judge == "learnt"}
    assert learnt["acc-5"].failed == learnt["cartpole"].failed == 0
    assert {row.told for row in found.rows} == {
        "nothing",
        "nothing but failures",
        "dynamics and noise",
        "linear model and limits",
    }
    assert {row.judge for row in found.policies} == {"filter off", "filter on"}


def test_policies_get_better_by_generations():
    env = gymnasium.make("CartPole-v1")
    weights, learnt = search(env, generations=4, population=10, seed=0)
    assert (weights.shape, len(learnt)) == ((4,), 40)
    first, last = (np.mean([one.score for one in some]) for some in (learnt[:10], learnt[-10:]))
    assert last > 2.0 * first
    again, _ = search(env, generations=4, population=10, seed=0)
    assert np.array_equal(again, weights)


def test_a_rival_is_told_something():
    for name in ("acc", "cartpole", "pendulum"):
        system = make_system(name)
        for rival, make in system.rivals.items():
            if not systems.lacking(rival):
                made = make()
                assert isinstance(made, Rival)
                assert made.told not in ("", "nothing")


def test_controllers_are_all_or_the_first_or_those_that_are_named(monkeypatch):
    tried = []
    monkeypatch.setattr(study, "_trial", lambda plan, task, who, *_: tried.append(who))
    monkeypatch.setattr(study, "in_order", lambda trials, *_: [one() or [] for one in trials])

    def controllers(wanted):
        tried.clear()
        run_tasks(Plan(tasks="cartpole", controllers=wanted, policies=False, seeds=1))
        return list(dict.fromkeys(tried))

    assert controllers("all") == ["random", "hasty", "badgain"]
    assert controllers("first") == ["random"]
    assert controllers("badgain, random, badgain") == ["badgain", "random"]

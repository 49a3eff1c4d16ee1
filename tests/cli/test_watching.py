"""A run that is watched: what is shown of it, its story, and the clock it is played by."""

import math
import time
from functools import cache

import pytest

from evofsm.cli.options import reading_of
from evofsm.cli.watch.session import OnRoads, Session, learn_first, read_simulated, watched_log
from evofsm.cli.watch.words import introduce, tell
from evofsm.driving import KinematicWorld, load_family, teach

pytestmark = pytest.mark.usefixtures("compiled")

PAPER = load_family("paper")
EMERGENCY = load_family("emergency")


@cache
def taught(family=PAPER, episodes=6, judge="kinematic"):
    roads = OnRoads(family, KinematicWorld(), judge=judge)
    learn_first(roads, episodes)
    return roads.guard


def opened(family=PAPER, guard=None, **settings):
    roads = OnRoads(family, KinematicWorld())
    roads.guard = guard or taught().copy()
    return Session(roads, **settings)


def drive(session):
    """All frames up to the end."""
    frames = [session.step()]
    while not frames[-1].over:
        frames.append(session.step())
    return frames


def test_danger_shows_long_before_time_to_collision_notices_and_is_told_from_when_it_began():
    frames = drive(opened(on=False))
    story = frames[-1].story
    risky = next(frame for frame in frames if frame.proposed_risk.risk > 0.02)
    assert story.first == story.danger.began.time == risky.time
    assert risky.proposed_risk.critical < risky.needed
    assert story.first < story.danger.dead_end < story.leader_brakes
    assert story.time_to_collision - story.first > 20.0
    assert story.leader_decel == pytest.approx(9.0)
    late = [frame.story for frame in frames if frame.time >= story.danger.dead_end]
    assert {one.danger.dead_end for one in late} == {story.danger.dead_end}


def test_the_same_run_is_shown_the_same_and_restarting_begins_anew():
    first, again = drive(opened()), drive(opened())
    assert repr(first) == repr(again)
    session = opened()
    for _ in range(30):
        session.step()
    session.restart(3)
    frames = drive(session)
    assert session.start.case == 3
    assert [frame.number for frame in frames] == list(range(len(frames)))
    assert frames[0].cars.x_follower == 0.0
    assert frames[0].story.danger is None
    with pytest.raises(ValueError, match="case is 5; paper has 1 to 4"):
        session.restart(4)


@pytest.mark.slow
def test_any_environment_is_watched_by_a_guard_that_is_given_nothing_but_which_episodes_failed():
    system = read_simulated("CartPole-v1")
    learn_first(system, 12)
    assert 6 < system.guard.n_episodes <= 12
    with Session(system, on=False) as session:
        *_, alone = drive(session)
        assert alone.failed
        assert alone.time == pytest.approx(alone.story.alone)
        session.revising = True
        session.restart()
        *frames, last = drive(session)
        known, start = session.known(), session.start
    assert last.time > 10.0 * alone.time  # what is seen first is what it has learnt to do
    assert any(frame.revised for frame in frames)
    assert {frame.executed for frame in frames} == {(0.0,), (1.0,)}
    assert max(frame.proposed_risk.risk for frame in frames) > 0.5
    assert (start.names[2], start.discrete, start.high) == ("pole angle [rad]", True, (1.0,))
    assert "pole angular velocity" in last.here
    assert known.plane[0] in {form[1] for form in known.forms}
    assert "The controller alone would have failed at" in tell(last, start).alone


@pytest.mark.parametrize("on", [True, False])
def test_the_first_failure_of_a_kind_is_called_so_and_no_other_one(on):
    system, said = read_simulated("CartPole-v1"), []
    with Session(system, on=on) as session:
        for case in (0, 0, 2):  # the pole falls to the left, again, and to the right
            session.restart(case)
            last = drive(session)[-1]
            if last.failed:
                before, told = set(said), tell(last, session.start)
                first = told.headline == "Failure, the first of its kind"
                sides = {(form[1], form[8] > 0.0) for form in session.known().forms}
                assert first == bool(sides - before)
                assert first == ("A guard cannot prevent the first failure" in told.done)
                said += sides
    assert len(set(said)) >= 2 - on


def test_a_file_holds_an_environment_of_ones_own(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(
        "import gymnasium\ndef environment():\n    return gymnasium.make('Pendulum-v1')\n"
        "def controller(seen, random):\n    return [2.0 * random.random()]\n"
        "def failed(step):\n    return step.observation[0] < -0.9\nvariables = 'cos', 'sin', 's'\n"
    )
    with Session(read_simulated(str(path))) as session:
        assert (session.start.system, session.start.names) == ("own", ("cos", "sin", "s"))
        for frame in drive(session)[:-1]:
            assert 0.0 <= frame.proposed[0] <= 2.0
    (tmp_path / "beside.py").write_text("def environment():\n    return 1 / 0\n")
    path.write_text("import beside\ndef environment():\n    return beside.environment()\n")
    with pytest.raises(ValueError, match=r"own\.py, line 3, in environment: ZeroDivisionError: "):
        read_simulated(str(path))
    path.write_text("def environment():\n    return [1]\n")
    with pytest.raises(ValueError, match=r"returns list, not one gymnasium\.Env"):
        read_simulated(str(path))
    path.write_text(
        "from gymnasium import make, spaces, wrappers\ndef environment():\n    return wrappers."
        "TransformAction(make('CartPole-v1'), lambda a: int(a[0]), spaces.MultiDiscrete([2, 3]))"
    )
    assert read_simulated(str(path)).guard.actions.n_actions == 6


@pytest.mark.parametrize(
    ("how", "idle"),  # whether it acts, or passes all, or is off, and why nothing is done
    [
        ("on", ""),
        ("passing", "was not shown to help yet, so what is proposed passes"),
        ("off", "the reviser is off"),
    ],
)
def test_every_sentence_says_what_was_so(how, idle):
    guard = taught().copy()
    teach(guard, [PAPER.draw(0, 1)])
    if how == "passing":  # as one of which is known that it fails sooner than the controller alone
        guard._why_passing = lambda: "shadow"
    with opened(guard=guard, on=how != "off") as session:
        frames, start = drive(session), session.start
    changed = sum(frame.executed != frame.proposed for frame in frames)
    told = [tell(frame, start) for frame in frames]
    assert bool(changed) == (not idle)
    # What the reviser did, or would have done.
    done = " ".join(one.done for one in told)
    assert ("The reviser stepped in" in done) == (not idle)
    assert ("would have changed" in done) == bool(idle)
    assert "Nothing had to be done" in done
    assert all(idle in one.done for one in told if "would have" in one.done)
    if not idle:
        assert f"changed {changed} " in told[-1].done
    # What was judged.
    assert {one.status for one in told[:-1]} <= {"safe", "danger", "averted", "dead end"}
    assert ("averted" in {one.status for one in told}) == (not idle)
    assert not any("Nothing was judged" in one.why for one in told)
    # What came of it.
    hit = frames[-1].cars.gap <= 0.0
    assert told[-1].headline == ("Collision" if hit else "No collision")
    assert (f"Collision at {frames[-1].time:.1f}" in told[-1].outcome) == hit
    # What is said before it begins.
    intro, learning = introduce(start).values()
    assert "replaces actions" in intro
    assert "goes on learning" in learning


# -- A log of others ------------------------------------------------------------------------------


def test_a_guard_decides_on_each_row_of_a_log_and_changes_nothing(tmp_path):
    lines, x, v = ["id,t,x,y,vx,vy,length,lane"], 40.0, 20.0
    for k in range(80):
        lines.append(f"ego,{0.1 * k:.1f},{2.0 * k:.2f},0,20,0,4,1")
        lines.append(f"other,{0.1 * k:.1f},{x:.3f},0,{v:.2f},0,4,1")
        x, v = x + 0.1 * v, max(0.0, v - (0.5 if k >= 40 else 0.0))  # it brakes with 5 m/s²
    (path := tmp_path / "objects.csv").write_text("\n".join([*lines, ""]))
    shown = watched_log(str(path), reading_of())
    assert shown.start.cases == ("ego behind other, from 0.0 s (collision)",)
    assert not shown.revising
    first, *_, last = frames = drive(shown)
    assert not any(frame.revised for frame in frames)
    assert first.cars.gap == pytest.approx(36.0)
    # The leader brakes, nobody else does: in the end the guard would have.
    assert frames[60].advised[0] < -2.0
    assert frames[60].proposed_risk.risk > first.proposed_risk.risk
    assert shown.graph().states
    assert first.cars.v_follower == pytest.approx(20.0)
    found = last.cars.a_follower, last.cars.a_leader, last.cars.x_follower
    assert found == pytest.approx((0.0, -5.0, 158.0))


def test_episodes_of_a_log_end_with_a_contact_and_it_opens_on_one(tmp_path):
    lines = ["pair,time,gap,v_follower,v_leader,a_follower"]
    for pair, (far, closing) in enumerate([(90, 0), (20, 1), (4, 0)]):
        for k in range(500):
            # Contact after 26.7 s; the impact slows the follower, and the leader drives off.
            gap, crashed = far - max(0, k - 200) * 0.3 * closing, False
            if gap <= 0.0:
                gap, crashed = (-0.1, True) if k < 275 else (k - 275.0, False)
            slow = crashed and gap < 0.0
            lines.append(f"{pair},{k / 10:.1f},{gap:.2f},{12 if slow else 20},{20 - 3 * closing},0")
    (tmp_path / "log.csv").write_text("\n".join([*lines, ""]))
    path = str(tmp_path / "log.csv")
    shown = watched_log(path, reading_of())
    # It begins anew where they came apart.
    assert shown.start.cases == ("episode 1", "episode 2 (collision)", "episode 2", "episode 3")
    frames = drive(shown)
    assert frames[-1].failed
    assert shown.start.begins == 0.0
    told = tell(frames[-1], shown.start)
    assert "Collision at 26.7\xa0s." in told.outcome
    assert "only watched, in shadow mode" in told.done
    fourth = watched_log(path, reading_of(), case=4).start
    assert (fourth.case, fourth.begins) == (3, pytest.approx(10.0))  # of 50 s the last 40 s


def test_what_was_before_is_shown_at_once(shown):
    session = opened()
    session.start = session.start._replace(begins=2.0)
    with shown(lambda: session, speed=0.25) as page:
        time.sleep(1.0)
    assert 8 <= len(page._frames) <= 12  # one every 0.25 s of the run, then one a second


# -- A judge that was told nothing but which episodes failed --------------------------------------


def told_over(episodes, *, on=True):
    """Frames of a run under a learnt judge, each with its story in words."""
    guard = taught(EMERGENCY, episodes, "learnt").copy()
    with opened(EMERGENCY, guard, case=1, on=on) as session:
        return [(frame, tell(frame, session.start)) for frame in drive(session)]


def test_before_the_first_failure_nothing_is_called_safe():
    for frame, told in told_over(0)[:-1]:
        assert math.isnan(frame.proposed_risk.risk)
        assert (told.status, told.headline) == ("unjudged", "Nothing is judged")
        assert told.why == "Nothing was judged, for no failure was known yet."
        assert frame.reason == "nothing was learnt yet"


@pytest.mark.slow
def test_a_learnt_judge_is_not_said_to_know_how_leaders_brake():
    frames = [*told_over(12), *told_over(12, on=False)]
    leaders = "leader brake", "leaders", "latent risk", "braking in full"
    for _, told in frames:
        said = " ".join((told.headline, told.when, told.why, told.done)).lower()
        assert not any(words in said for words in leaders), said
    assert any("disturbances remembered from" in told.why for _, told in frames)
    assert {"dead end", "failure"} <= {told.status for _, told in frames}
    for frame, told in frames:  # what it changes where it sees no danger, it changes for the margin
        story = frame.story
        assert ("by a margin" in told.done) == (story.danger is None and story.advised > 0)
        assert ("came close" in told.when) == ("by a margin" in told.done)

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.states.paper import Paper


def test_the_papers_rule_is_the_default(walk, snapshot):
    Z, I, starts, failures = walk(200)
    told, untold = EvolvingFSM(3, rule=Paper()), EvolvingFSM(3)
    for machine in (told, untold):
        machine.learn_many(Z, I, starts, failures)
    assert snapshot(told) == snapshot(untold)
    assert repr(told) == repr(untold)
    assert told.rule == Paper()


def test_a_failure_founds_no_state_by_the_papers_rule(walk):
    Z, I, starts, failures = walk(200)
    with_failures, without = EvolvingFSM(3), EvolvingFSM(3)
    a = with_failures.learn_many(Z, I, starts, failures)
    b = without.learn_many(Z, I, starts)
    assert a.event.tolist() == b.event.tolist()
    assert with_failures.centers.tobytes() == without.centers.tobytes()

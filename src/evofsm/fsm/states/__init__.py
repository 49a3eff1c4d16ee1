"""How states are determined and recognised: one rule, one file.

A machine is given its rule as an object: ``EvolvingFSM(17, rule=Novelty(radius=0.5))``. Without
one it follows the paper.
"""

from evofsm.fsm.states.edges import Edges
from evofsm.fsm.states.failure import FailureSplit
from evofsm.fsm.states.novelty import Novelty
from evofsm.fsm.states.paper import Paper
from evofsm.fsm.states.rule import StateRule

__all__ = ["Edges", "FailureSplit", "Novelty", "Paper", "StateRule"]

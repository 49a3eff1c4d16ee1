"""How states are determined and recognised: one rule, one file.

A machine is given its rule as an object: ``EvolvingFSM(17, rule=Novelty(radius=0.5))``. Without
one it follows the paper.
"""

from evofsm.states.edges import Edges
from evofsm.states.ets import Paper
from evofsm.states.failure import FailureSplit
from evofsm.states.novelty import Novelty
from evofsm.states.rule import StateRule

__all__ = ["Edges", "FailureSplit", "Novelty", "Paper", "StateRule"]

"""The paper's Section 3: 80 runs of car following, and every claim beside what was measured."""

from evofsm.evidence.paper.claims import Claim, check_claims
from evofsm.evidence.paper.context import OURS, context_tables, divergences
from evofsm.evidence.paper.files import write_data
from evofsm.evidence.paper.runs import CASES, Founding, PaperStudy, Run, run_paper
from evofsm.evidence.paper.settings import Settings

__all__ = [
    "CASES",
    "OURS",
    "Claim",
    "Founding",
    "PaperStudy",
    "Run",
    "Settings",
    "check_claims",
    "context_tables",
    "divergences",
    "run_paper",
    "write_data",
]

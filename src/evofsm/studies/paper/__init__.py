"""The paper's Section 3: 80 runs of car following, and every claim beside what was measured."""

from evofsm.studies.paper.claims import Claim, check_claims
from evofsm.studies.paper.context import OURS, context_tables, divergences
from evofsm.studies.paper.files import write_data
from evofsm.studies.paper.runs import CASES, Founding, PaperStudy, Run, run_paper
from evofsm.studies.paper.settings import Settings

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

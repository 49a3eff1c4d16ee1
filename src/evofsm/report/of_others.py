"""The paper's study and that of the closed loop as chapters; each has a page of its own as well."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from evofsm.report.chapter import Chapter
from evofsm.report.closed_loop import closed_loop_sketches, policy_table
from evofsm.report.comparison import answer, headline, note_on_the_table
from evofsm.report.drawing import draw_all
from evofsm.report.figures import paper_figures
from evofsm.report.html import Setting
from evofsm.report.losses import InWords, losses_in_words
from evofsm.studies.closed_loop import ClosedLoop
from evofsm.studies.paper import PaperStudy, check_claims, context_tables
from evofsm.studies.table import Table

Progress = Callable[[int, int], None]
# So many losses are told one by one; the page of the study has all.
_TOLD = 12


def paper_chapter(study: PaperStudy, folder: Path, command: str, progress: Progress) -> Chapter:
    """Every claim of the paper beside what was measured."""
    claims = check_claims(study)
    failing = [claim for claim in claims if not claim.holds]
    table = Table(
        "Claims",
        ("claim", "paper", "measured", "holds"),
        tuple(
            (claim.claim, claim.paper, claim.measured, "yes" if claim.holds else "no")
            for claim in claims
        ),
        in_words=True,
    )
    return Chapter(
        id="paper",
        title="Does the paper's machine do what the paper says?",
        about="Han, Filev and Özgüner let a machine grow on 80 runs of car following in SUMO: four "
        "cases, 20 rounds. The same runs are driven here, with the settings that the paper leaves "
        "open recovered.",
        headline=f"{len(claims) - len(failing)} of {len(claims)} claims hold",
        answer=(f"{len(study.runs)} runs in {study.world}, {study.model.n_states} states.",),
        losses=tuple(f"{claim.claim}: {claim.measured}" for claim in failing),
        tables=(table, *context_tables(study)),
        figures=tuple(paper_figures(study, folder, progress)[:1]),  # its own page has all
        plan=(Setting("runs", str(len(study.runs))), Setting("world", study.world)),
        command=command,
    )


def closed_loop_chapter(
    study: ClosedLoop, folder: Path, command: str, progress: Progress
) -> Chapter:
    """Collisions prevented, and at what cost."""
    lost = losses_in_words(study)
    told = sorted(lost, key=lambda loss: not loss.loud)[:_TOLD]
    more = len(lost) - len(told)
    return Chapter(
        id="closed-loop",
        title="Does the reviser prevent collisions, and at what cost?",
        about=f"Family {study.family.name}: {study.family.about} {note_on_the_table(study)}",
        headline=headline(study),
        answer=tuple(answer(study)),
        losses=(*map(_in_a_line, told), *([f"and {more} more rows"] if more else [])),
        tables=(policy_table(study),),
        figures=tuple(draw_all(closed_loop_sketches(study), folder, progress)),
        plan=(
            Setting("seed of everything", str(study.plan.seed)),
            Setting("learning seeds", str(study.plan.seeds)),
            Setting("training episodes", f"{study.plan.train:,}"),
            Setting("held-out episodes", f"{study.plan.test:,}"),
        ),
        command=command,
    )


def _in_a_line(loss: InWords) -> str:
    return f"{loss.what}: {loss.who}, {loss.theirs}, against {loss.ours} of ours"

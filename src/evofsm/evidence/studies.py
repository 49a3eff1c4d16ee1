"""All studies, in the order in which the evidence tells them."""

from __future__ import annotations

from typing import Any

from evofsm.evidence.alarms.plan import Plan as Alarms
from evofsm.evidence.breaks.plan import Plan as Breaks
from evofsm.evidence.closed_loop.plan import Plan as ClosedLoop
from evofsm.evidence.detection.plan import Plan as Detection
from evofsm.evidence.foresight.plan import Plan as Foresight
from evofsm.evidence.judges.plan import Plan as Judges
from evofsm.evidence.paper.plan import Plan as Paper
from evofsm.evidence.prediction.plan import Plan as Prediction
from evofsm.evidence.real.plan import Plan as Real
from evofsm.evidence.sensitivity.plan import Plan as Sensitivity
from evofsm.evidence.study import Study
from evofsm.evidence.tasks.plan import Plan as Tasks

#: By id. The paper's is a command of its own, ``evofsm paper``.
STUDIES: dict[str, type[Study[Any]]] = {
    study.id: study
    for study in (
        Paper,
        ClosedLoop,
        Judges,
        Tasks,
        Breaks,
        Detection,
        Alarms,
        Prediction,
        Foresight,
        Sensitivity,
        Real,
    )
}

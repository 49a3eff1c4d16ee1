"""All studies, in the order in which the evidence tells them."""

from __future__ import annotations

from typing import Any

from evofsm.paper.plan import Plan as Paper
from evofsm.paper.study import Study
from studies.alarms.plan import Plan as Alarms
from studies.breaks.plan import Plan as Breaks
from studies.closed_loop.plan import Plan as ClosedLoop
from studies.detection.plan import Plan as Detection
from studies.foresight.plan import Plan as Foresight
from studies.judges.plan import Plan as Judges
from studies.prediction.plan import Plan as Prediction
from studies.real.plan import Plan as Real
from studies.sensitivity.plan import Plan as Sensitivity
from studies.tasks.plan import Plan as Tasks

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

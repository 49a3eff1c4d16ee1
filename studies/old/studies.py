"""Studies that are not yet rewritten on `studies.lib`."""

from __future__ import annotations

from typing import Any

from studies.old.study import Study
from studies.real.plan import Plan as Real

#: By id.
STUDIES: dict[str, type[Study[Any]]] = {study.id: study for study in (Real,)}

"""How well the state some seconds ahead is forecast, and against what.

`sources` says what is driven or read, `forecasters` who forecasts, `scoring` how that is judged,
and `study` does it for all of them.
"""

from evofsm.evidence.prediction.forecasters import REFERENCES, Method, Variant
from evofsm.evidence.prediction.scoring import Row
from evofsm.evidence.prediction.sources import FAMILIES, Pace, log_sources
from evofsm.evidence.prediction.study import Plan, Prediction, run_prediction

__all__ = [
    "FAMILIES",
    "REFERENCES",
    "Method",
    "Pace",
    "Plan",
    "Prediction",
    "Row",
    "Variant",
    "log_sources",
    "run_prediction",
]

"""A risk measure of somebody else's, beside those of a study."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING

from studies.old.shim import imported

if TYPE_CHECKING:
    from evofsm.guard import RiskMeasure

#: What the option of every study says that takes one.
ABOUT = "A measure of your own beside the others, module:Class; evofsm check holds it to its kind."


def own_measure(name: str) -> RiskMeasure:
    """A measure by the name ``module:Name`` of a class, an instance, or a function that makes one.

    Raises
    ------
    ValueError
        If there is nothing of that name.
    TypeError
        If it is no measure, or a class that needs arguments.

    Examples
    --------
    >>> own_measure("evofsm.driving.measures:TimeToCollision")
    TimeToCollision(threshold=1.5)
    """
    thing = imported(name)
    is_made = hasattr(thing, "score") and not inspect.isclass(thing)
    try:
        made: RiskMeasure = thing if is_made else thing()
    except TypeError as error:
        raise TypeError(f"{name} cannot be made without arguments: {error}") from error
    if not hasattr(made, "score"):
        raise TypeError(f"{name} is no measure: it has no method score")
    return made
